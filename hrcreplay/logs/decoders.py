"""Decoders of skeleton topics, one class per message format.

They read hrcreplay's own Skeleton message, the transforms of openni_tracker (camera to left_elbow_1 on /tf, one message
per joint), and message types that the settings describe. ``markers`` reads the markers of the Azure Kinect ROS driver.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, ClassVar

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.logs.messages import (
    METRES,
    OPENNI_JOINTS,
    OPENNI_POINTS,
    Message,
    RawSkeleton,
    Undecodable,
    camera_of,
    missing_body,
    nobody,
    stamp_ns,
)
from hrcreplay.records import NOBODY, POINTS, Floats
from hrcreplay.settings.sections import Decoder

_BODY_BELOW = NOBODY - 1  # a tracker's body with the id of an empty frame


class OwnDecoder:
    """Topic /camera/<name>/skeleton of hrcreplay's own log."""

    notes: ClassVar[tuple[str, ...]] = ()
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


_PEEK = 300  # number of messages used to describe a topic
TF_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
_FRAME_NS = 15_000_000  # half a period of 30 Hz: openni_tracker stamps every joint separately, a few ms apart
_LEAST_JOINTS = 6
_NAMES = "|".join(sorted(OPENNI_JOINTS))
_CHILD = re.compile(rf"/?({_NAMES})_(\d+)")
_JOINT_BYTES = re.compile(rf"(?:{_NAMES})_\d".encode())
_PAIR_BYTES = re.compile(rf"([!-~]+)\0{{0,4}}[\x01-\xff]\0\0\0(/?(?:{_NAMES})_\d+)".encode())
_WHERE = {joint: [POINTS.index(p) for p, named in OPENNI_POINTS.items() if named == joint] for joint in OPENNI_JOINTS}


@dataclass
class _Person:
    """A person's joints of the frame being assembled."""

    known: set[str] = field(default_factory=set)  #: joints of the person seen so far
    joints: dict[str, Floats] = field(default_factory=dict)
    first_ns: int = 0


class TfDecoder:
    """A tf topic. The camera is the parent frame; the body is the number at the end of the child's name.

    A person's transforms form one frame. It is complete, and arrives, with the last of the joints seen so far of this
    person or, if one of them is missing, when the next frame begins: a joint is repeated or the stamp changes by more
    than 15 ms. The capture is the first transform's stamp. Left and right are taken as named. OpenNI has no pelvis: it
    is the middle of the hips.
    """

    notes: ClassVar[tuple[str, ...]] = (
        "openni has no wrist and no pelvis: the hand and the middle of the hips stand for them",
    )
    shows_camera_alive: ClassVar[bool] = False

    def __init__(self, topic: str, cameras: tuple[str, ...], unit: str) -> None:
        self.topic = topic
        self.cameras = cameras
        self._unit = unit
        self._people: dict[tuple[str, int], _Person] = defaultdict(_Person)

    def fresh_copy(self) -> TfDecoder:
        """Returns a decoder without state."""
        return TfDecoder(self.topic, self.cameras, self._unit)

    def rows(self, message: Message) -> list[RawSkeleton]:
        """Returns the frames that this message completes."""
        rows: list[RawSkeleton] = []
        if not _JOINT_BYTES.search(message.data):
            return rows
        for transform in message.read().transforms:
            child = _CHILD.fullmatch(transform.child_frame_id)
            camera = camera_of(transform.header.frame_id)
            if not child or camera not in self.cameras:
                continue
            joint, body = child[1], int(child[2])
            capture_ns = stamp_ns(transform.header.stamp, self.topic)
            person = self._people[(camera, body)]
            if person.joints and (joint in person.joints or abs(capture_ns - person.first_ns) > _FRAME_NS):
                rows.append(_finish(person, camera, body))
            if not person.joints:
                person.first_ns = capture_ns
            at = transform.transform.translation
            person.joints[joint] = METRES[self._unit] * np.array([at.x, at.y, at.z])
            if person.joints.keys() >= (person.known if len(person.known) >= _LEAST_JOINTS else OPENNI_JOINTS):
                rows.append(_finish(person, camera, body))
        return rows


def _finish(person: _Person, camera: str, body: int) -> RawSkeleton:
    person.known.update(person.joints)
    points, confidence = missing_body()
    for joint, at in person.joints.items():
        points[_WHERE[joint]] = at
        confidence[_WHERE[joint]] = 1.0
    left, right = person.joints.get("left_hip"), person.joints.get("right_hip")
    if left is not None and right is not None:
        points[POINTS.index("pelvis")] = (left + right) / 2.0
        confidence[POINTS.index("pelvis")] = 1.0
    person.joints = {}
    return RawSkeleton(person.first_ns or None, camera, body, points, confidence, stamp_zero=not person.first_ns)


def find_cameras(messages: Iterable[Message]) -> tuple[str, ...]:
    """Finds the parent frames of tracked people, in order of appearance.

    The whole topic is read, as a camera may start late, but only messages with a new pair of frames are decoded.
    """
    met: set[tuple[bytes, bytes]] = set()
    joints: dict[str, set[str]] = defaultdict(set)
    for message in messages:
        if not _JOINT_BYTES.search(message.data):
            continue
        pairs = set(_PAIR_BYTES.findall(message.data))
        if pairs and pairs <= met:
            continue
        met |= pairs
        for transform in message.read().transforms:
            child = _CHILD.fullmatch(transform.child_frame_id)
            if child:
                joints[camera_of(transform.header.frame_id)].add(child[1])
    return tuple(camera for camera, names in joints.items() if len(names) >= _LEAST_JOINTS)


@dataclass(frozen=True)
class GenericDecoder:
    """Reads skeletons from a message type that settings describe; one body, called 0."""

    how: Decoder

    notes: ClassVar[tuple[str, ...]] = ()
    shows_camera_alive: ClassVar[bool] = True

    @property
    def topic(self) -> str:
        """Topic of the messages."""
        return self.how.topic

    @property
    def cameras(self) -> tuple[str, ...]:
        """Name of the sensor."""
        return (self.how.camera,)

    def fresh_copy(self) -> GenericDecoder:
        """Returns itself, as it has no state."""
        return self

    def rows(self, message: Message) -> list[RawSkeleton]:
        """Returns the one row of a message; for an empty array, a row without a body."""
        content = message.read()
        where = f"{self.how.topic} ({message.topic.type})"
        elements = _array(content, self.how.points, where)
        trust = None if self.how.confidence is None else _array(content, self.how.confidence, where)
        stamp = None if self.how.stamp is None else stamp_ns(_field(content, self.how.stamp, where), where)
        if not len(elements):
            return [nobody(self.how.camera, stamp or None)]
        points, confidence = missing_body()
        scale = METRES[self.how.unit]
        for name, element in self.how.index.items():
            if not 0 <= element < len(elements):
                continue  # a shorter array lacks the point
            at, i = elements[element], POINTS.index(name)
            try:
                points[i] = scale * at.x, scale * at.y, scale * at.z
            except AttributeError as error:
                raise LogError(
                    f"{where}: elements of {self.how.points!r} have no x, y, z; name an array of points"
                ) from error
            confidence[i] = 1.0 if trust is None else float(trust[element]) if element < len(trust) else 0.0
            if confidence[i] > 1.0:
                raise LogError(
                    f"{where}: found a confidence of {confidence[i]:g} in {self.how.confidence!r}; would be right: 0 "
                    'to 1, so leave it out (confidence = "none")'
                )
        return [RawSkeleton(stamp or None, self.how.camera, 0, points, confidence, stamp_zero=stamp == 0)]


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


_ARRAY_DEPTH = 4
_LISTED = 6


def describe_transforms(messages: Iterable[Message]) -> str:
    """Describes the frames of a tf topic in a few words, from its first messages."""
    children: dict[str, None] = {}
    for message in islice(messages, _PEEK):
        children.update(dict.fromkeys(str(transform.child_frame_id) for transform in message.read().transforms))
    more = f" and {len(children) - _LISTED} more" if len(children) > _LISTED else ""
    return (
        f"has the frames {', '.join(list(children)[:_LISTED])}{more}; known are those of openni_tracker (head_1, "
        "torso_1, left_elbow_1...), so publish the joints under these names"
    )


#: Phrase in the description of a topic that settings can make readable.
DECODABLE = "[[logs.decoders]] can read"


def describe_arrays(messages: Iterable[Message]) -> str:
    """Describes the arrays of points that a decoder in the settings could read in a topic, from its first messages."""
    found: dict[str, int] = {}
    for message in islice(messages, _PEEK):
        for path, count in _point_arrays(message.read(), ""):
            found[path] = max(found.get(path, 0), count)
    if not found:
        return "has no array of points with x, y, z that [[logs.decoders]] could read"
    arrays = ", ".join(f"{path!r} (up to {count})" for path, count in found.items())
    return f"has arrays of points, which {DECODABLE} if they are one body's: {arrays}"


def _point_arrays(content: Any, path: str) -> Iterator[tuple[str, int]]:
    """Returns path and length of each array of points in a message."""
    if path.count(".") >= _ARRAY_DEPTH:
        return
    for name in getattr(content, "__dataclass_fields__", ()):
        value, at = getattr(content, name), f"{path}.{name}".lstrip(".")
        if isinstance(value, list):
            if value and all(hasattr(value[0], axis) for axis in "xyz"):
                yield at, len(value)
        elif hasattr(value, "__dataclass_fields__"):
            yield from _point_arrays(value, at)
