"""What every skeleton decoder gives: rows, one a body a frame."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.logs.messages import Message
from hrcreplay.records import POINTS, Floats


class Row(NamedTuple):
    """One body in one frame, not yet cleaned."""

    capture_ns: int | None  #: None: the arrival is the best that is known
    camera: str
    body: int
    points_m: Floats  #: (20, 3) camera frame [m]; NaN where the sensor has no such point
    confidence: Floats  #: (20,); 0 where the sensor has no such point
    stamp_zero: bool = False  #: whether the capture is missing because a ROS header's stamp is zero


class Decoder(Protocol):
    """Reads the skeletons of one topic."""

    @property
    def topic(self) -> str:
        """The topic."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras on it."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know of how it reads."""

    @property
    def always_heard(self) -> bool:
        """Whether a message without a body still tells that the camera (the only one) is alive."""

    def fresh(self) -> Decoder:
        """The decoder at the start of a pass, with nothing remembered."""

    def rows(self, message: Message) -> list[Row]:
        """The rows that are complete with this message. Raises Undecodable, LogError."""


def blank() -> tuple[Floats, Floats]:
    """Points and confidence of a body of which nothing is known."""
    return np.full((len(POINTS), 3), np.nan), np.zeros(len(POINTS))


def stamp_ns(stamp: Any, where: str) -> int:
    """A ROS time as nanoseconds."""
    try:
        return int(stamp.sec) * 10**9 + int(stamp.nanosec)
    except AttributeError as error:
        raise LogError(
            f"{where}: found {stamp!r} for a capture time; a field of type time is needed, or none"
        ) from error


def camera_of(name: str) -> str:
    """A camera's name from a topic or a frame: without slashes, as it is used in names of columns."""
    return name.strip("/").replace("/", "_")
