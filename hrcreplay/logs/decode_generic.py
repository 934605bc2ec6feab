"""Skeletons of a message type that settings describe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from hrcreplay.errors import LogError
from hrcreplay.logs.messages import Message
from hrcreplay.logs.skeletons import Row, blank, stamp_ns
from hrcreplay.records import POINTS

_METRES = {"m": 1.0, "mm": 1e-3}


@dataclass(frozen=True)
class GenericDecoder:
    """How to read skeletons from a message type the package does not know; one body, called 0."""

    topic: str
    camera: str
    points: str  #: path to the array of points, fields joined by dots; its elements have x, y, z
    index: Mapping[str, int]  #: body point -> element
    unit: str = "m"  #: "m" or "mm"
    stamp: str | None = "header.stamp"  #: path to the capture time; None: the arrival time is used
    confidence: str | None = None  #: path to an array of confidences in [0, 1]; None: 1 for every finite point

    notes: ClassVar[tuple[str, ...]] = ()
    always_heard: ClassVar[bool] = True

    @property
    def cameras(self) -> tuple[str, ...]:
        """The one sensor."""
        return (self.camera,)

    def fresh(self) -> GenericDecoder:
        """Itself: it remembers nothing."""
        return self

    def rows(self, message: Message) -> list[Row]:
        """The one row of a message; none where the array is empty."""
        content = message.read()
        where = f"{self.topic} ({message.topic.type})"
        elements = _array(content, self.points, where)
        trust = None if self.confidence is None else _array(content, self.confidence, where)
        if not len(elements):
            return []
        points, confidence = blank()
        scale = _METRES[self.unit]
        for name, element in self.index.items():
            if not 0 <= element < len(elements):
                continue  # a shorter array has no such point
            at, i = elements[element], POINTS.index(name)
            try:
                points[i] = scale * at.x, scale * at.y, scale * at.z
            except AttributeError as error:
                raise LogError(
                    f"{where}: elements of {self.points!r} have no x, y, z; name an array of points"
                ) from error
            confidence[i] = 1.0 if trust is None else float(trust[element]) if element < len(trust) else 0.0
        stamp = None if self.stamp is None else stamp_ns(_field(content, self.stamp, where), where)
        return [Row(stamp or None, self.camera, 0, points, confidence, stamp_zero=stamp == 0)]


def _array(content: Any, path: str, where: str) -> Any:
    found = _field(content, path, where)
    if isinstance(found, str) or not hasattr(found, "__len__"):
        raise LogError(f"{where}: {path!r} is no array but {found!r}; name an array")
    return found


def _field(content: Any, path: str, where: str) -> Any:
    for name in path.split("."):
        if not hasattr(content, name):
            known = ", ".join(f for f in getattr(content, "__dataclass_fields__", ()) if not f.startswith("__"))
            raise LogError(f"{where}: has no field {path!r}; {name!r} is not among {known or 'its fields'}")
        content = getattr(content, name)
    return content
