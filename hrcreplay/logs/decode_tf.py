"""Skeletons as openni_tracker publishes them: transforms camera -> left_elbow_1 on /tf, one message a joint."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from hrcreplay.logs.joints import OPENNI_JOINTS, OPENNI_POINTS
from hrcreplay.logs.messages import Message
from hrcreplay.logs.skeletons import Row, blank, camera_of, stamp_ns
from hrcreplay.records import POINTS, Floats

TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
_FRAME_NS = 15_000_000  # half a period of 30 Hz: openni_tracker stamps every joint by itself, some ms apart
_LEAST_JOINTS = 6
_NAMES = "|".join(sorted(OPENNI_JOINTS))
_CHILD = re.compile(rf"/?({_NAMES})_(\d+)")
_JOINT_BYTES = re.compile(rf"(?:{_NAMES})_\d".encode())
_PAIR_BYTES = re.compile(rf"([!-~]+)\0{{0,4}}[\x01-\xff]\0\0\0(/?(?:{_NAMES})_\d+)".encode())
_WHERE = {joint: [POINTS.index(p) for p, named in OPENNI_POINTS.items() if named == joint] for joint in OPENNI_JOINTS}


@dataclass
class _Person:
    """A person's joints of the frame being assembled."""

    known: set[str] = field(default_factory=set)  #: joints ever seen of the person
    joints: dict[str, Floats] = field(default_factory=dict)
    first_ns: int = 0


class TfDecoder:
    """A tf topic. The camera is the parent frame, the body the number at the end of the child's name.

    A person's transforms make one frame; it is complete, and arrives, with the last of the joints that this person
    has had so far, or, where one of them stays away, when the next frame begins: a joint comes again or the stamp
    moves by more than 15 ms. The capture is the first transform's stamp. Left and right are taken as named. OpenNI has
    no pelvis: it is the middle of the hips.
    """

    notes: ClassVar[tuple[str, ...]] = (
        "openni has no wrist and no pelvis: the hand and the middle of the hips stand for them",
    )
    always_heard: ClassVar[bool] = False

    def __init__(self, topic: str, cameras: tuple[str, ...]) -> None:
        self.topic = topic
        self.cameras = cameras
        self._people: dict[tuple[str, int], _Person] = defaultdict(_Person)

    def fresh(self) -> TfDecoder:
        """A decoder that has seen nobody yet."""
        return TfDecoder(self.topic, self.cameras)

    def rows(self, message: Message) -> list[Row]:
        """The frames that this message completes."""
        rows: list[Row] = []
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
            person.joints[joint] = np.array([at.x, at.y, at.z])
            if person.joints.keys() >= (person.known if len(person.known) >= _LEAST_JOINTS else OPENNI_JOINTS):
                rows.append(_finish(person, camera, body))
        return rows


def _finish(person: _Person, camera: str, body: int) -> Row:
    person.known.update(person.joints)
    points, confidence = blank()
    for joint, at in person.joints.items():
        points[_WHERE[joint]] = at
        confidence[_WHERE[joint]] = 1.0
    left, right = person.joints.get("left_hip"), person.joints.get("right_hip")
    if left is not None and right is not None:
        points[POINTS.index("pelvis")] = (left + right) / 2.0
        confidence[POINTS.index("pelvis")] = 1.0
    person.joints = {}
    return Row(person.first_ns or None, camera, body, points, confidence, stamp_zero=not person.first_ns)


def find_cameras(messages: Iterable[Message]) -> tuple[str, ...]:
    """Frames under which people are tracked, in order of appearance.

    The whole topic is gone through, as a camera may start late, but only messages with a pair of frames not met
    before are decoded.
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
