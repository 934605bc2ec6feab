"""Decoders of skeleton topics: hrcreplay's own Skeleton message, and message types that settings or presets describe.

``transforms`` reads people in tf, ``markers`` the markers of the Azure Kinect ROS driver.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, ClassVar, cast

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.logs import presets
from hrcreplay.logs.messages import METRES, Message, RawSkeleton, Undecodable, camera_of, missing_body, nobody, stamp_ns
from hrcreplay.records import NOBODY, POINTS, Floats
from hrcreplay.settings.sections import Decoder

_BODY_BELOW = NOBODY - 1  # a tracker's body with the id of an empty frame


class OwnDecoder:
    """Topic /camera/<name>/skeleton of hrcreplay's own log."""

    notes: ClassVar[tuple[str, ...]] = ()
    frames: ClassVar[Mapping[str, str]] = {}
    shows_camera_alive: ClassVar[bool] = False

    def __init__(self, topic: str, camera: str) -> None:
        self.topic = topic
        self.cameras = (camera,)

    def fresh_copy(self) -> OwnDecoder:
        """Returns itself, as it has no state."""
        return self

    def rows(self, message: Message) -> list[RawSkeleton]:
        """Returns the one row of a message."""
        return [own_row(message.read(), self.cameras[0], self.topic)]


def own_row(skeleton: Any, camera: str, topic: str) -> RawSkeleton:
    """Decodes the row in a Skeleton message of hrcreplay. Raises Undecodable, with its topic."""
    confidence = np.array(skeleton.confidence, dtype=np.float64)
    if len(confidence) != len(POINTS):
        raise Undecodable(f"{topic}: a skeleton of {len(confidence)} confidences; {len(POINTS)} are right")
    body = _BODY_BELOW if skeleton.body == NOBODY and confidence.any() else skeleton.body
    return RawSkeleton(skeleton.capture_ns, camera, body, points_of(skeleton.points, topic), confidence)


def points_of(values: Any, topic: str) -> Floats:
    """Returns (20, 3) points from the packed values of a message."""
    if len(values) != 3 * len(POINTS):
        raise Undecodable(f"{topic}: a body of {len(values)} numbers; {3 * len(POINTS)} are right")
    return np.array(values, dtype=np.float64).reshape(len(POINTS), 3)


@dataclass(frozen=True)
class GenericDecoder:
    """Reads skeletons from a message type that settings or a preset describe.

    Several descriptions are variants: a body is read by the first one whose ``only`` it fulfils.
    """

    hows: tuple[Decoder, ...]
    frame: str | None = None  #: frame of the points, from a message's header; None if unknown
    lacks: str = ""  #: body points that it lacks, for the notes

    shows_camera_alive: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raises SettingsError for an unknown order of points."""
        _ = self._wanted

    @cached_property
    def _wanted(self) -> tuple[presets.Places, ...]:
        return tuple(map(presets.places_of, self.hows))

    @property
    def topic(self) -> str:
        """Topic of the messages."""
        return self.hows[0].topic

    @property
    def cameras(self) -> tuple[str, ...]:
        """Name of the sensor."""
        return (self.hows[0].camera or camera_of(self.topic),)

    @property
    def frames(self) -> Mapping[str, str]:
        """Frame of the camera's points."""
        return {} if self.frame is None else {self.cameras[0]: self.frame}

    @property
    def notes(self) -> tuple[str, ...]:
        """Returns the body points that the bodies lack."""
        return (f"{self.topic}: its points lack {self.lacks}",) if self.lacks else ()

    def fresh_copy(self) -> GenericDecoder:
        """Returns itself, as it has no state."""
        return self

    def rows(self, message: Message) -> list[RawSkeleton]:
        """Returns a row per body; for a message without bodies or points, a row without a body.

        A body that no description reads gives no row, but is somebody: then the message does not show that nobody is
        there.
        """
        content = message.read()
        where = f"{self.topic} ({message.topic.type})"
        try:
            return self._read(content, where)
        except (TypeError, ValueError) as error:
            raise LogError(
                f"{where}: a part by its description is of another kind ({error}); would be right: numbers for "
                "positions and confidences, and lists for bodies and points"
            ) from error

    def _read(self, content: Any, where: str) -> list[RawSkeleton]:
        stamp_path = self.hows[0].stamp
        stamp = None if stamp_path is None else stamp_ns(_field(content, stamp_path, where), where)
        rows, met = [], False
        for number, body, elements in self._bodies(content, where):
            which = next((i for i, how in enumerate(self.hows) if _fulfils(body, how.only, where)), None)
            met = met or which is None or len(elements) > 0
            if which is not None and len(elements):
                how = self.hows[which]
                at = _places(how, elements, where)
                trust = _confidences(how, content, body, elements, where)
                points, confidence = _body_points(how, self._wanted[which], at, elements, trust, where)
                rows.append(
                    RawSkeleton(stamp or None, self.cameras[0], number, points, confidence, stamp_zero=stamp == 0)
                )
        return rows if met else [nobody(self.cameras[0], stamp or None)]

    def _bodies(self, content: Any, where: str) -> Iterator[tuple[int, Any, Sequence[Any]]]:
        """Yields number, message part and elements of each body."""
        how = self.hows[0]
        if how.bodies is None:
            elements = _elements(how, content, where)
            if how.body is None:
                yield 0, content, elements
                return
            groups: dict[Any, list[Any]] = {}
            for element in elements:
                groups.setdefault(_field(element, how.body, where), []).append(element)
            for value, group in groups.items():
                yield number_of(value), content, group
            return
        for place, body in enumerate(_array(content, how.bodies, where)):
            value = place if how.body is None else _field(body, how.body, where)
            yield number_of(value), body, _elements(how, body, where)


def points_lacking(hows: tuple[Decoder, ...], messages: Iterable[Message]) -> str:
    """Lists the body points that the descriptions lack which read a body in some messages."""
    read = list(islice(messages, _PEEK))
    used = [how for how in hows if any(row.body != NOBODY for m in read for row in GenericDecoder((how,)).rows(m))]
    told = dict.fromkeys(presets.lacking(presets.places_of(how)) for how in used)
    return " or ".join(points for points in told if points)


def frame_of(messages: Iterable[Message]) -> str | None:
    """Returns the frame in the header of the first message; None without one."""
    first = next(iter(messages), None)
    frame = None if first is None else getattr(getattr(first.read(), "header", None), "frame_id", None)
    return str(frame) if frame else None


def number_of(value: Any) -> int:
    """Returns the number of a body from its number or name; a name without a number gets one of its own."""
    try:
        return int(value)
    except (TypeError, ValueError):
        return zlib.crc32(str(value).encode()) % 10**9


def _fulfils(body: Any, only: Mapping[str, bool | int | str], where: str) -> bool:
    return all(_field(body, path, where) == value for path, value in only.items())


def _elements(how: Decoder, part: Any, where: str) -> Sequence[Any]:
    """Returns the elements of a body: those of the array, or its numbers in groups."""
    array = _array(part, how.points or "", where)
    if how.numbers is None:
        return cast("Sequence[Any]", array)
    if len(array) % how.numbers:
        raise LogError(
            f"{where}: {how.points!r} has {len(array)} numbers; would be right: a multiple of {how.numbers} (numbers)"
        )
    return [array[i : i + how.numbers] for i in range(0, len(array), how.numbers)]


def _body_points(
    how: Decoder,
    wanted: presets.Places,
    at: Mapping[str, int],
    elements: Sequence[Any],
    trust: Sequence[float],
    where: str,
) -> tuple[Floats, Floats]:
    """Returns points (20, 3) [m] and confidence (20,) of a body from the elements that its description names."""
    points, confidence = missing_body()
    scale, met = METRES[how.unit], False
    for name, alternatives in wanted.items():
        keys = next((keys for keys in alternatives if all(key in at for key in keys)), None)
        if keys is None:
            continue  # a shorter array lacks the point
        met = True
        found = [(_xyz(how, elements[at[key]], where), trust[at[key]] if at[key] < len(trust) else 0.0) for key in keys]
        i = POINTS.index(name)
        points[i] = scale * (found[0][0] if len(found) == 1 else np.mean([xyz for xyz, _ in found], axis=0))
        confidence[i] = min(value for _, value in found)
        if confidence[i] > 1.0:
            raise LogError(
                f"{where}: found a confidence of {confidence[i] * how.confidence_max:g} in {how.confidence!r}; would "
                'be right: 0 to 1, or their greatest value in confidence_max, or confidence = "none"'
            )
    if how.name is not None and not met:
        named = ", ".join(str(_field(element, how.name, where)) for element in elements[:_LISTED])
        raise LogError(
            f"{where}: found points named {named}, none of which is a body point of the description; would be right: "
            'their names in index, e.g. index = { head = "..." }'
        )
    return points, confidence


def _places(how: Decoder, elements: Sequence[Any], where: str) -> dict[str, int]:
    """Returns the place of each element by its name; the first of equal names counts."""
    if how.name is None:
        return {str(place): place for place in range(len(elements))}
    places: dict[str, int] = {}
    for place, element in enumerate(elements):
        places.setdefault(presets.plain(_field(element, how.name, where)), place)
    return places


def _confidences(how: Decoder, content: Any, body: Any, elements: Sequence[Any], where: str) -> Sequence[float]:
    """Returns the confidence of each element: from itself, from its body, from the message, or constant."""
    given = how.confidence
    if given is None:
        return [1.0] * len(elements)
    if not isinstance(given, str):
        return [given / how.confidence_max] * len(elements)
    for path in (alternative.strip() for alternative in given.split("|")):
        if path == "none":
            return [1.0] * len(elements)
        if _has(elements[0], path):
            return [_certain(_field(element, path, where), how.confidence_max) for element in elements]
        for part in (body, content):
            if _has(part, path):
                found = _field(part, path, where)
                if isinstance(found, (int, float)):
                    return [_certain(found, how.confidence_max)] * len(elements)
                return [_certain(value, how.confidence_max) for value in _array(part, path, where)]
    _field(content, given, where)  # raises the error
    return []


def _certain(value: Any, most: float) -> float:
    number = float(value)
    return number / most if np.isfinite(number) else 0.0


def _xyz(how: Decoder, element: Any, where: str) -> Floats:
    """Returns the position of an element along the axes of the log, in the unit of the message."""
    at = element if how.position is None else _field(element, how.position, where)
    at = getattr(at, "position", at)
    if all(hasattr(at, axis) for axis in "xyz"):
        xyz = (at.x, at.y, at.z)
    elif hasattr(at, "__len__") and not isinstance(at, str) and len(at) >= 3:
        xyz = (at[0], at[1], at[2])
    else:
        raise LogError(
            f"{where}: elements of {how.points!r} have no x, y, z and are no three numbers; name an array of points, "
            "or the path in a point with position"
        )
    if how.axes == ("x", "y", "z"):
        return np.array(xyz, dtype=np.float64)
    return np.array([(-1 if axis[0] == "-" else 1) * xyz["xyz".index(axis[-1])] for axis in how.axes], dtype=np.float64)


def _array(content: Any, path: str, where: str) -> Any:
    found = _field(content, path, where)
    if isinstance(found, str) or not hasattr(found, "__len__"):
        raise LogError(f"{where}: {path!r} is no array but {found!r}; name an array")
    return found


def _has(content: Any, path: str) -> bool:
    try:
        _field(content, path, "")
    except LogError:
        return False
    return True


def _field(content: Any, path: str, where: str) -> Any:
    """Returns the part of a message at a path; of alternatives, the first that exists. Raises LogError."""
    *before, last = (alternative.strip() for alternative in path.split("|"))
    for alternative in before:
        if _has(content, alternative):
            return _follow(content, alternative.split("."), alternative, where)
    return _follow(content, last.split("."), last, where)


def _follow(content: Any, names: Sequence[str], path: str, where: str) -> Any:
    for step, name in enumerate(names):
        if name.isdigit():
            if not hasattr(content, "__len__") or int(name) >= len(content):
                raise LogError(f"{where}: {path!r}: there is no element {name}; name one that the list has")
            content = content[int(name)]
            continue
        if isinstance(content, list):
            parts = [_follow(element, names[step:], path, where) for element in content]
            return [inner for part in parts for inner in (part if isinstance(part, list) else [part])]
        if not hasattr(content, name):
            known = ", ".join(f for f in getattr(content, "__dataclass_fields__", ()) if not f.startswith("__"))
            raise LogError(f"{where}: has no field {path!r}; {name!r} is not among {known or 'its fields'}")
        content = getattr(content, name)
    return content


_PEEK = 300  # number of messages used to describe a topic
_ARRAY_DEPTH = 4
_LEAST_NUMBERS = 18  # six points
_LISTED = 6


#: Phrase in the description of a topic that settings can make readable.
DECODABLE = "[[logs.decoders]] can read"


def describe_arrays(messages: Iterable[Message]) -> str:
    """Describes the arrays of points that a decoder in the settings could read in a topic, from its first messages."""
    found: dict[str, int] = {}
    numbers: dict[str, int] = {}
    for message in islice(messages, _PEEK):
        content = message.read()
        for counts, arrays in ((found, _point_arrays(content, "")), (numbers, _number_arrays(content))):
            for path, count in arrays:
                counts[path] = max(counts.get(path, 0), count)
    if found:
        arrays_found = ", ".join(f"{path!r} (up to {count})" for path, count in found.items())
        return f"has arrays of points, which {DECODABLE} if they are bodies': {arrays_found}"
    if numbers:
        arrays_found = ", ".join(f"{path!r} (up to {count})" for path, count in numbers.items())
        return f"has arrays of numbers, which {DECODABLE} if they are points, one after another: {arrays_found}"
    return "has no array of points with x, y, z that [[logs.decoders]] could read"


def _number_arrays(content: Any) -> Iterator[tuple[str, int]]:
    """Returns path and length of each array of numbers in a message that may be a body's points."""
    for name in getattr(content, "__dataclass_fields__", ()):
        value = getattr(content, name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f" and len(value) >= _LEAST_NUMBERS:
            yield name, len(value)


def _point_arrays(content: Any, path: str) -> Iterator[tuple[str, int]]:
    """Returns path and length of each array of points in a message."""
    if path.count(".") >= _ARRAY_DEPTH:
        return
    for name in getattr(content, "__dataclass_fields__", ()):
        value, at = getattr(content, name), f"{path}.{name}".lstrip(".")
        if isinstance(value, list):
            if value and _is_point(value[0]):
                yield at, len(value)
            elif value:
                yield from _point_arrays(value[0], at)
        elif hasattr(value, "__dataclass_fields__"):
            yield from _point_arrays(value, at)


def _is_point(element: Any) -> bool:
    """Returns True if an element of an array is a point, holds a pose, or holds three numbers."""
    at = getattr(element, "position", element)
    if all(hasattr(at, axis) for axis in "xyz"):
        return True
    fields = [name for name in getattr(element, "__dataclass_fields__", ()) if not name.startswith("__")]
    return any(_is_xyz(getattr(element, name)) for name in fields)


def _is_xyz(value: Any) -> bool:
    return all(hasattr(value, axis) for axis in "xyz") or (isinstance(value, np.ndarray) and value.shape == (3,))
