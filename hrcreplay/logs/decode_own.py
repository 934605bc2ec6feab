"""Skeletons of our own log."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from hrcreplay.logs.messages import Message, Undecodable
from hrcreplay.logs.skeletons import Row
from hrcreplay.records import POINTS, Floats


class OwnDecoder:
    """Topic /camera/<name>/skeleton of our own log."""

    notes: ClassVar[tuple[str, ...]] = ()
    always_heard: ClassVar[bool] = False

    def __init__(self, topic: str, camera: str) -> None:
        self.topic = topic
        self.cameras = (camera,)

    def fresh(self) -> OwnDecoder:
        """Itself: it remembers nothing."""
        return self

    def rows(self, message: Message) -> list[Row]:
        """The one row of a message."""
        skeleton = message.read()
        confidence = np.array(skeleton.confidence, dtype=np.float64)
        if len(confidence) != len(POINTS):
            raise Undecodable(f"{self.topic}: a skeleton of {len(confidence)} confidences; {len(POINTS)} are right")
        points = points_of(skeleton.points, self.topic)
        return [Row(skeleton.capture_ns, self.cameras[0], skeleton.body, points, confidence)]


def points_of(values: Any, topic: str) -> Floats:
    """(20, 3) points from the packed values of a message."""
    if len(values) != 3 * len(POINTS):
        raise Undecodable(f"{topic}: a body of {len(values)} numbers; {3 * len(POINTS)} are right")
    return np.array(values, dtype=np.float64).reshape(len(POINTS), 3)
