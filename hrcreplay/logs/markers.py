"""Bodies in MarkerArray topics, one marker per joint of the Azure Kinect: numbering of the markers, and decoder.

Many nodes publish markers, and those of bodies are numbered in several ways. The whole topic is surveyed before it is
read: the assignment of markers to cameras, bodies and joints is valid for all of its messages, for any span.
"""

from __future__ import annotations

import re
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.logs.messages import (
    AZURE_INDEX,
    AZURE_JOINTS,
    METRES,
    Message,
    RawSkeleton,
    Undecodable,
    camera_of,
    missing_body,
    nobody,
    stamp_ns,
)
from hrcreplay.logs.plausibility import bone_ratio, looks_like_person
from hrcreplay.records import Floats

MARKER_TYPE: Final = "visualization_msgs/MarkerArray"
_LEAST_MARKERS = 8
_FEW = 10  # with fewer messages, proportions are not judged
_GONE = (2, 3)  # actions DELETE and DELETEALL
#: Types of markers that may be joints, the most likely first: if spheres are joints, cylinders are bones. Lists of
#: points (as an octomap's cubes) and texts are not joints.
_JOINT_TYPES: Final = {2: "spheres", 1: "cubes", 0: "arrows", 3: "cylinders", 10: "meshes"}
_OTHER_TYPES: Final = {
    4: "line strips",
    5: "line lists",
    6: "cube lists",
    7: "sphere lists",
    8: "points",
    9: "texts",
    11: "triangle lists",
}
#: Known numbers of ids per body: that of the Azure driver, and those of trackers with consecutive numbers.
_STRIDES: Final = (100, 33, 32)
_STRANGE = 0.1  # maximum share of ids that are joints which other bodies lack
_PEEK = 300  # messages that are always decoded: ten seconds of a sensor


@dataclass(frozen=True)
class MarkerLayout:
    """Numbering of a topic's markers: id = body * ids_per_body + joint."""

    frames: tuple[str, ...] = ()  #: frames in the headers, in order of appearance; () if not searched
    ids_per_body: int = 100
    given: bool = False  #: True: set by the user; then other ids are not joints
    joint_type: int | None = None  #: type of the markers that are joints; None: any possible type
    has_alpha: bool = False  #: True: the alpha of the colours differs within a body
    namespaces: tuple[str, ...] = ()  #: namespaces that contain joints


@dataclass(frozen=True)
class NoBodies:
    """Reason for which the markers of a topic are not bodies."""

    found: str
    certain: bool  #: False without markers, or with too few for a decision
    layout: MarkerLayout | None = None  #: their numbering, if they may still be bodies


@dataclass
class _Survey:
    """State of the survey of a topic."""

    frames: dict[str, None] = field(default_factory=dict)
    types: set[int] = field(default_factory=set)
    ids: dict[tuple[int, str], set[int]] = field(default_factory=lambda: defaultdict(set))  # by type and namespace
    arrays: list[list[Any]] = field(default_factory=list)  # first messages with markers
    most: int = 0  # size of the longest decoded message [bytes]
    has_alpha: bool = False


def survey_markers(messages: Iterable[Message], ids_per_body: int | None) -> MarkerLayout | NoBodies:
    """Finds the numbering of a topic's markers, from all its messages.

    Args:
        messages: All messages of the topic.
        ids_per_body: As in the settings; None: determined here.

    Returns:
        The layout, or the reason for which there are no bodies.
    """
    survey = _Survey()
    for number, message in enumerate(messages):
        # Only messages with possibly new content are decoded: new frames, or more markers than before.
        if number < _PEEK or len(message.data) > survey.most or not _frames_known(message.data, survey.frames):
            _take(survey, message)
    joint_type = next((kind for kind in _JOINT_TYPES if _has_body(survey, kind)), None)
    if joint_type is None:
        names = [name for kind, name in (_JOINT_TYPES | _OTHER_TYPES).items() if kind in survey.types]
        return NoBodies(f"{', '.join(names)}, never {_LEAST_MARKERS} that may be joints", bool(survey.types))
    ids = {namespace: numbers for (kind, namespace), numbers in survey.ids.items() if kind == joint_type}
    stride = ids_per_body or _stride(list(ids.values()))
    layout = MarkerLayout(
        frames=tuple(survey.frames),
        ids_per_body=stride or _STRIDES[0],
        given=ids_per_body is not None,
        joint_type=joint_type,
        namespaces=tuple(sorted(ids)),
    )
    if stride is None:
        most = max(max(found) for found in ids.values())
        whole = f"{_JOINT_TYPES[joint_type]} with ids up to {most}, which are no joints of bodies of 100, 33 or 32 ids"
        return NoBodies(whole, certain=True)
    bodies = _shapes(layout, survey.arrays)
    if not any(looks_like_person(points) for points in bodies.values()):
        ratio = min((bone_ratio(points) for points in bodies.values()), default=np.inf)
        kind = _JOINT_TYPES[joint_type]
        found = f"{kind} that are no person, {ratio:.1f} times as tall by one bone as by another"
        return NoBodies(found, any(len(points) >= _FEW for points in bodies.values()), layout)
    alpha = any(_alpha_differs(markers) for array in survey.arrays for markers in _by_body(layout, array).values())
    return replace(layout, has_alpha=alpha)


def _take(survey: _Survey, message: Message) -> None:
    try:
        markers = [marker for marker in message.read().markers if marker.action not in _GONE]
    except Undecodable:
        return  # the reader counts the defect
    survey.most = max(survey.most, len(message.data))
    if markers and len(survey.arrays) < _PEEK:
        survey.arrays.append(markers)
    for marker in markers:
        survey.types.add(marker.type)
        if marker.type in _JOINT_TYPES and marker.id >= 0:
            survey.frames.setdefault(marker.header.frame_id)
            survey.ids[(marker.type, marker.ns)].add(marker.id)


def _frames_known(data: bytes, frames: Iterable[str]) -> bool:
    """Returns True if a message names as many known frames as it has markers, so that none is new."""
    found = sum(data.count(b"%c\0\0\0%b\0" % (len(frame) + 1, frame.encode())) for frame in frames)
    return found > 0 and data[:1] == b"\0" and found == int.from_bytes(data[4:8], "little")  # of ROS 2; else decode


def _has_body(survey: _Survey, kind: int) -> bool:
    return any(len(found) >= _LEAST_MARKERS for (of, _), found in survey.ids.items() if of == kind)


def _stride(ids: list[set[int]]) -> int | None:
    """Returns the number of ids per body with which all bodies have the same joints; None if no known one fits."""
    fitting = [n for n in _STRIDES if all(at % n < len(AZURE_JOINTS) for found in ids for at in found)]
    if _STRIDES[0] in fitting:
        return _STRIDES[0]
    best = min(((*_differing(ids, n), n) for n in fitting), default=None)
    if best is None or best[0] > _STRANGE * sum(map(len, ids)):
        return None
    return best[2]


def _differing(ids: list[set[int]], stride: int) -> tuple[int, int]:
    """Counts joints of bodies that the most complete body lacks, and joints that one of the two lacks."""
    bodies: dict[tuple[int, int], set[int]] = defaultdict(set)
    for namespace, found in enumerate(ids):
        for at in found:
            bodies[(namespace, at // stride)].add(at % stride)
    fullest = max(bodies.values(), key=len)
    return sum(len(body - fullest) for body in bodies.values()), sum(len(body ^ fullest) for body in bodies.values())


_Body = tuple[str, str, int]  # frame, namespace and number


def _by_body(layout: MarkerLayout, markers: Iterable[Any]) -> dict[_Body, dict[int, Any]]:
    """The joints' markers by body. Raises LogError for an id that is not a body's joint, or a repeated one."""
    bodies: dict[_Body, dict[int, Any]] = {}
    for marker in markers:
        kind_fits = marker.type in _JOINT_TYPES if layout.joint_type is None else marker.type == layout.joint_type
        if marker.action in _GONE or not kind_fits or marker.id < 0:
            continue
        number, joint = divmod(marker.id, layout.ids_per_body)
        if joint >= len(AZURE_JOINTS):
            if layout.given:
                continue
            raise LogError(
                f"found a marker with id {marker.id}, which is no joint of a body of {layout.ids_per_body} ids; say "
                "how many ids a body has with --set logs.marker_ids_per_body=N"
            )
        body = bodies.setdefault((marker.header.frame_id, marker.ns, number), {})
        if joint in body:
            raise LogError(
                f"found two markers with id {marker.id} in one message, so bodies cannot be told apart; would be "
                "right: ids or a namespace for each body"
            )
        body[joint] = marker
    return bodies


def _shapes(layout: MarkerLayout, arrays: list[list[Any]]) -> dict[_Body, Floats]:
    """Returns points (n, 20, 3) of each body."""
    found: dict[_Body, list[Floats]] = defaultdict(list)
    for array in arrays:
        for body, markers in _by_body(layout, array).items():
            found[body].append(_points(markers)[0])
    return {body: np.array(points) for body, points in found.items()}


def _points(markers: dict[int, Any]) -> tuple[Floats, Floats]:
    """Returns the points of the message, and 1 for each present one."""
    points, confidence = missing_body()
    for joint, marker in markers.items():
        if joint in AZURE_INDEX:
            at = marker.pose.position
            points[AZURE_INDEX[joint]] = at.x, at.y, at.z
            confidence[AZURE_INDEX[joint]] = 1.0
    return points, confidence


def _alpha_differs(markers: dict[int, Any]) -> bool:
    return len({marker.color.a for marker in markers.values()}) > 1


class MarkerDecoder:
    """A MarkerArray topic with a body's joints in the cameras' frames.

    The camera is named after the topic or, if the headers have several frames, after the frame. Bodies are
    distinguished by their ids, or by their namespaces. If the alpha of the colours differs within a body, it is the
    confidence; otherwise the confidence is 1.
    """

    def __init__(self, topic: str, layout: MarkerLayout | None = None, *, unit: str) -> None:
        self.topic = topic
        self._layout = layout or MarkerLayout()
        self._scale = METRES[unit]
        self._only: str | None = None  # the single frame, if frames were not searched
        several = len(self._layout.frames) > 1
        self.cameras = tuple(map(camera_of, self._layout.frames)) if several else (camera_of(topic),)
        self.shows_camera_alive = not several

    @property
    def frames(self) -> dict[str, str]:
        """Frame of each camera's markers."""
        return dict(zip(self.cameras, self._layout.frames, strict=False))

    @property
    def notes(self) -> tuple[str, ...]:
        """Returns remarks on the reading of the topic."""
        return tuple(self._told())

    def _told(self) -> Iterator[str]:
        if self._layout.has_alpha:
            yield f"{self.topic}: the alpha of a marker's colour is taken for its confidence"
        else:
            yield "markers carry no confidence: 1 for every point"
        if len(self.cameras) > 1:
            yield f"{self.topic}: {len(self.cameras)} cameras, by the frames of the markers: {', '.join(self.cameras)}"
        if self._layout.ids_per_body != _STRIDES[0]:
            yield f"{self.topic}: a body's markers have {self._layout.ids_per_body} ids"
        if len(self._layout.namespaces) > 1:
            yield f"{self.topic}: bodies by the namespaces of the markers: {', '.join(self._layout.namespaces[:8])}"

    def fresh_copy(self) -> MarkerDecoder:
        """Returns itself, as it has no state between passes."""
        return self

    def rows(self, message: Message) -> list[RawSkeleton]:
        """Returns one row per body; for an array without a body, an empty row if the topic has only one camera."""
        try:
            markers = message.read().markers
            if self.shows_camera_alive and all(marker.action in _GONE for marker in markers):
                return [nobody(self.cameras[0])]
            bodies = sorted(_by_body(self._layout, markers).items())
            return [self._row(*body, markers) for body, markers in bodies]
        except LogError as error:
            text = str(error)
            raise type(error)(text if self.topic in text else f"{self.topic}: {text}") from error

    def _row(self, frame: str, namespace: str, number: int, markers: dict[int, Any]) -> RawSkeleton:
        points, confidence = _points(markers)
        if self._layout.has_alpha or _alpha_differs(markers):
            for joint, marker in markers.items():
                if joint in AZURE_INDEX:
                    confidence[AZURE_INDEX[joint]] = marker.color.a
        stamp = stamp_ns(next(iter(markers.values())).header.stamp, self.topic)
        return RawSkeleton(
            stamp or None,
            self._camera(frame),
            _number_of(namespace, number, self._layout.namespaces),
            self._scale * points,
            confidence,
            stamp_zero=not stamp,
        )

    def _camera(self, frame: str) -> str:
        known = self._layout.frames
        if not known:
            self._only = frame if self._only is None else self._only
            known = (self._only,)
        if frame not in known:
            raise LogError(
                f"found markers in the frames {known[0]!r} and {frame!r}: two cameras in one topic; would be right: a "
                "topic for each"
            )
        return self.cameras[0] if len(self.cameras) == 1 else camera_of(frame)


def _number_of(namespace: str, number: int, namespaces: tuple[str, ...]) -> int:
    """Returns a body's number: that in its namespace, else that of its ids; an own number per named namespace."""
    digits = re.search(r"(\d+)\D*$", namespace)
    if digits and number == 0:
        return int(digits[1][-9:])
    if len(namespaces) < 2:
        return number
    return zlib.crc32(f"{namespace}/{number}".encode()) % 10**9
