"""People in tf: one transform per joint, with names by pattern; poses of cameras and robot base in /tf_static."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice, pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.logs import presets
from hrcreplay.logs.decoders import DECODABLE, number_of
from hrcreplay.logs.messages import METRES, Message, RawSkeleton, camera_of, missing_body, stamp_ns
from hrcreplay.records import POINTS, Floats
from hrcreplay.settings.sections import Decoder

TF_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
_FRAME_NS = 15_000_000  # half a period of 30 Hz: openni_tracker stamps every joint separately, a few ms apart
_LEAST_JOINTS = 6
_PEEK = 300  # number of messages used to describe a topic
_LISTED = 6
_STAND_INS = {"wrist": "hand", "pelvis": "middle of the hips"}  #: points told where another joint stands for them


_STRING = re.compile(rb"([\x02-\xff])\0\0\0(?=([ -~]+))")


class FrameName(NamedTuple):
    """A person's frame."""

    joint: str  #: as ``presets.plain`` writes it
    user: str  #: "" without one


class FrameNames:
    """Names of people's frames: patterns and the places of body points among the joints."""

    def __init__(self, how: Decoder) -> None:
        self._patterns = [_compile(pattern) for pattern in how.frames]
        self.places = presets.places_of(how)
        self.joints = frozenset(key for ways in self.places.values() for keys in ways for key in keys)
        self._known: dict[str, FrameName | None] = {}
        self._of_user: dict[str, FrameName | None] = {}

    def match(self, frame: str) -> FrameName | None:
        """Returns joint and user of a frame; None if it is no person's, by the first pattern that fits."""
        if frame not in self._known:
            self._known[frame] = next(self._matches(frame), None)
        return self._known[frame]

    def _matches(self, frame: str) -> Iterator[FrameName]:
        for pattern in self._patterns:
            found = pattern.fullmatch(frame.lstrip("/"))
            if found:
                name = FrameName(presets.plain(found["joint"]), found.groupdict().get("user") or "")
                if name.joint in self.joints:
                    yield name

    def of_user(self, frame: str) -> FrameName | None:
        """Returns joint and user of a frame that may also lie between two body points; None without a user."""
        if frame not in self._of_user:
            self._of_user[frame] = self._with_user(frame)
        return self._of_user[frame]

    def _with_user(self, frame: str) -> FrameName | None:
        known = self.match(frame)
        if known is not None:
            return known if known.user else None
        for pattern in self._patterns:
            found = pattern.fullmatch(frame.lstrip("/"))
            if found and found.groupdict().get("user"):
                return FrameName(presets.plain(found["joint"]), found["user"])
        return None


def _compile(pattern: str) -> re.Pattern[str]:
    parts = re.split(r"(\{joint\}|\{user\}|\{id\}|\*)", pattern.lstrip("/"))
    means = {"{joint}": r"(?P<joint>[^\W\d][\w-]*?)", "{user}": r"(?P<user>\d+)", "{id}": r"(?P<user>[a-z]{5})"}
    return re.compile("".join(means.get(part, ".*" if part == "*" else re.escape(part)) for part in parts))


def strings_in(data: bytes) -> list[str]:
    """Returns the strings in a message of ROS: length in four bytes, little endian, then the characters.

    Numbers may look like short strings, too. A message of another layout has none.
    """
    found = []
    for length, text in _STRING.findall(data):
        whole = text[: length[0]].rstrip(b"\0")
        if len(whole) >= length[0] - 1:  # a string of CDR ends with a zero that counts
            found.append(whole.decode().lstrip("/"))
    return found


@dataclass(frozen=True)
class Link:
    """A frame in its parent."""

    parent: str
    child: str
    translation: Floats  #: (3,), in the unit of the log
    rotation: Floats  #: (4,) quaternion x y z w

    @property
    def T_parent_child(self) -> Floats:
        """Returns the pose (4, 4) of the frame in its parent, in metres if the log is."""
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(self.rotation).as_matrix()
        T[:3, 3] = self.translation
        return T


def links_of(message: Message) -> Iterator[Link]:
    """Yields the transforms of a message; frames without a leading slash. Raises Undecodable."""
    yield from map(_link, message.read().transforms)


def _link(transform: Any) -> Link:
    at, q = transform.transform.translation, transform.transform.rotation
    return Link(
        str(transform.header.frame_id).lstrip("/"),
        str(transform.child_frame_id).lstrip("/"),
        np.array([at.x, at.y, at.z], dtype=np.float64),
        np.array([q.x, q.y, q.z, q.w], dtype=np.float64),
    )


@dataclass(frozen=True)
class PeopleSurvey:
    """People in a tf topic."""

    frames: Mapping[str, str]  #: camera -> the frame in which its people are
    joints: frozenset[str]  #: joints that it has of them


def survey_people(messages: Iterable[Message], names: FrameNames, static: Mapping[str, Link]) -> PeopleSurvey:
    """Finds the cameras of a tf topic, and the joints of the people they see.

    The whole topic is read, as a camera may start late, but only messages with a new pair of frames are decoded.

    Args:
        messages: All messages of the topic.
        names: Names of people's frames.
        static: Child -> link of /tf_static, for joints that do not move within their parent.
    """
    met: set[tuple[str, str]] = set()
    pairs: dict[tuple[str, str], None] = {}
    for message in messages:
        strings = strings_in(message.data)
        found = {(parent, child) for parent, child in pairwise(strings) if names.match(child)}
        if strings and found <= met:
            continue
        met |= found
        pairs.update(dict.fromkeys((link.parent, link.child) for link in links_of(message)))
    pairs.update(dict.fromkeys((link.parent, link.child) for link in static.values()))
    parents = {child: parent for parent, child in pairs}
    joints: dict[str, set[str]] = defaultdict(set)
    for parent, child in pairs:
        name = names.match(child)
        if name is not None:
            joints[_root(names, parents, parent, name.user)].add(name.joint)
    frames = {camera_of(frame): frame for frame, seen in joints.items() if len(seen) >= _LEAST_JOINTS}
    seen = frozenset(joint for frame in frames.values() for joint in joints[frame])
    return PeopleSurvey(frames, seen)


def _root(names: FrameNames, parents: Mapping[str, str], frame: str, user: str) -> str:
    """Returns the first frame from a joint's parent upwards that is not of the same person."""
    for _ in range(len(parents) + 1):
        up = names.of_user(frame) if user else None
        if up is None or up.user != user or frame not in parents:
            return frame
        frame = parents[frame]
    return frame


@dataclass
class _Person:
    """A person's joints of the frame being assembled."""

    known: set[str] = field(default_factory=set)  #: joints of the person seen so far
    links: dict[str, tuple[str | None, Link]] = field(default_factory=dict)  #: joint -> joint above it, its transform
    first_ns: int = 0


_OPENNI = frozenset(
    {"head", "neck", "torso"}
    | {f"{side}{j}" for side in ("left", "right") for j in ("shoulder", "elbow", "hand", "hip", "knee", "foot")}
)


class TfDecoder:
    """A tf topic. The camera is the frame in which a person's joints are, or in which the first of their chain is.

    A person's transforms form one frame. It is complete, and arrives, with the last of the joints seen so far of this
    person or, if one of them is missing, when the next frame begins: a joint is repeated or the stamp changes by more
    than 15 ms. The capture is the first transform's stamp. Left and right are taken as named. Of the names that may
    stand for a body point, the first that this person has ever had counts.
    """

    shows_camera_alive: ClassVar[bool] = False

    def __init__(
        self,
        topic: str,
        cameras: tuple[str, ...],
        unit: str,
        how: Decoder | None = None,
        survey: PeopleSurvey | None = None,
        static: Mapping[str, Link] | None = None,
    ) -> None:
        self.topic = topic
        self.cameras = cameras
        self._unit = unit
        self._how = how or presets.of_type(TF_TYPES[0], topic, unit)[-1][0]
        self._names = FrameNames(self._how)
        self._survey = survey
        self._static = static or {}
        self._fixed = dict(self._fixed_links())
        self._people: dict[tuple[str, str], _Person] = defaultdict(_Person)
        self._roots: dict[str, str] = {}  # user -> camera

    def fresh_copy(self) -> TfDecoder:
        """Returns a decoder without state."""
        return TfDecoder(self.topic, self.cameras, self._unit, self._how, self._survey, self._static)

    @property
    def joints(self) -> int:
        """Number of joints that its people have."""
        return len(self._survey.joints) if self._survey else 0

    @property
    def frames(self) -> Mapping[str, str]:
        """Frame of each camera's points."""
        return self._survey.frames if self._survey else {}

    @property
    def notes(self) -> tuple[str, ...]:
        """Returns the joints that the tracker lacks, and those that stand for them."""
        joints = self._survey.joints if self._survey else _OPENNI
        if joints <= _OPENNI:
            return ("openni has no wrist and no pelvis: the hand and the middle of the hips stand for them",)
        has = {point for point, ways in self._names.places.items() if any(set(keys) <= joints for keys in ways)}
        wrist = next((ways[0] for keys in self._names.places.get("wrist_l", ()) if set(ways := keys) <= joints), "")
        stands = ["the hand stands for the wrist"] if "hand" in wrist else []
        missing = presets.lacking(has)
        return tuple(
            f"{self.topic}: {told}" for told in (*stands, *([f"its joints lack {missing}"] if missing else []))
        )

    def _fixed_links(self) -> Iterator[tuple[tuple[str, str], tuple[str | None, Link]]]:
        """Yields user and joint -> joint above and transform, of joints that do not move within their parent."""
        for link in self._static.values():
            name, up = self._names.of_user(link.child), self._names.of_user(link.parent)
            if name is not None and up is not None and name.user == up.user:
                yield (name.user, name.joint), (up.joint, link)

    def rows(self, message: Message) -> list[RawSkeleton]:
        """Returns the frames that this message completes."""
        rows: list[RawSkeleton] = []
        strings = strings_in(message.data)
        if strings and not any(map(self._names.match, strings)):
            return rows
        for transform in message.read().transforms:
            found = self._place(transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/"))
            if found is None:
                continue
            camera, name, up = found
            capture_ns = stamp_ns(transform.header.stamp, self.topic)
            person = self._people[(camera, name.user)]
            if person.links and (name.joint in person.links or abs(capture_ns - person.first_ns) > _FRAME_NS):
                rows.append(self._finish(person, camera, name.user))
            if not person.links:
                person.first_ns = capture_ns
            person.links[name.joint] = (up, _link(transform))
            if person.links.keys() >= (person.known if len(person.known) >= _LEAST_JOINTS else _OPENNI):
                rows.append(self._finish(person, camera, name.user))
        return rows

    def _place(self, parent: str, child: str) -> tuple[str, FrameName, str | None] | None:
        """Returns camera, name and the joint above of a person's frame; None if it is not one."""
        name = self._names.match(child)
        within = self._names.of_user(child)
        up = self._names.of_user(parent) if within is not None else None
        if within is not None and up is not None and up.user == within.user:
            camera = self._roots.get(within.user)
            return None if camera is None else (camera, within, up.joint)
        camera = camera_of(parent)
        if name is None or camera not in self.cameras:
            return None
        self._roots[name.user] = camera
        return camera, name, None

    def _finish(self, person: _Person, camera: str, user: str) -> RawSkeleton:
        person.known.update(person.links)
        points, confidence = missing_body()
        for point, ways in self._names.places.items():
            keys = next((keys for keys in ways if all(self._ever(person, user, key) for key in keys)), ())
            found = [self._at(person, user, key) for key in keys]
            known = [at for at in found if at is not None]
            if known and len(known) == len(keys):
                at = known[0] if len(known) == 1 else np.mean(known, axis=0)
                points[POINTS.index(point)] = METRES[self._unit] * at
                confidence[POINTS.index(point)] = 1.0
        person.links = {}
        stamp = person.first_ns
        body = number_of(user) if user else 0
        return RawSkeleton(stamp or None, camera, body, points, confidence, stamp_zero=not stamp)

    def _ever(self, person: _Person, user: str, joint: str) -> bool:
        return joint in person.known or (user, joint) in self._fixed

    def _at(self, person: _Person, user: str, joint: str) -> Floats | None:
        """Returns the position of a joint in the camera's frame (3,); None if a transform to it is missing."""
        at: Floats | None = None
        up: str | None = joint
        for _ in range(len(person.links) + len(self._fixed) + 1):
            found = person.links.get(up or "") or self._fixed.get((user, up or ""))
            if found is None:
                return None
            up, link = found
            turned = None if at is None else Rotation.from_quat(link.rotation).apply(at)
            at = link.translation if turned is None else turned + link.translation
            if up is None:
                return at
        return None


def describe_transforms(messages: Iterable[Message]) -> str:
    """Describes the frames of a tf topic in a few words, from its first messages."""
    children: dict[str, None] = {}
    within: dict[str, set[str]] = defaultdict(set)
    for message in islice(messages, _PEEK):
        for transform in message.read().transforms:
            children[str(transform.child_frame_id)] = None
            within[str(transform.header.frame_id)].add(str(transform.child_frame_id))
    more = f" and {len(children) - _LISTED} more" if len(children) > _LISTED else ""
    told = (
        f"has the frames {', '.join(list(children)[:_LISTED])}{more}; known names are those of openni_tracker (head_1, "
        "torso_1, left_elbow_1...), NITE, Kinect, Azure and ROS4HRI"
    )
    if any(len(frames) >= _LEAST_JOINTS for frames in within.values()):
        return f"{told}; joints of other names {DECODABLE} by its frames and index"
    return f"{told}, at least {_LEAST_JOINTS} in one frame"


#: Frames of /tf_static that count as world and robot base, if the settings name none.
WORLD_FRAMES = ("world", "map")
BASE_FRAMES = ("base_link", "base", "robot_base")


def static_links(messages: Iterable[Message]) -> dict[str, Link]:
    """Returns child -> link of the static transforms; a child with several different ones is left out."""
    found: dict[str, Link] = {}
    unsure: set[str] = set()
    for message in messages:
        for link in links_of(message):
            before = found.setdefault(link.child, link)
            same = before.parent == link.parent and np.allclose(before.T_parent_child, link.T_parent_child, atol=1e-6)
            if not np.linalg.norm(link.rotation) > 0.0 or not same:
                unsure.add(link.child)
    return {child: link for child, link in found.items() if child not in unsure}


@dataclass(frozen=True)
class StaticPoses:
    """Poses from /tf_static."""

    T_world_camera: dict[str, Floats]  #: camera -> (4, 4)
    T_world_base: Floats | None  #: (4, 4)
    notes: tuple[str, ...]


def find_poses(
    links: Mapping[str, Link], frames: Mapping[str, str], world: str | None, base: str | None
) -> StaticPoses:
    """Finds the poses of cameras and robot base among static transforms.

    Args:
        links: Child -> link.
        frames: Camera -> frame of its points.
        world: Frame of the world; None: one of WORLD_FRAMES.
        base: Frame of the robot's base; None: the first of BASE_FRAMES.
    """
    bases = BASE_FRAMES if base is None else (base,)
    for name in WORLD_FRAMES if world is None else (world.lstrip("/"),):
        found = ((camera, _pose_in(links, frame.lstrip("/"), name)) for camera, frame in frames.items())
        poses = {camera: T for camera, T in found if T is not None}
        stands = ((frame, _pose_in(links, frame.lstrip("/"), name)) for frame in bases)
        stand, T_world_base = next(((frame, T) for frame, T in stands if T is not None), ("", None))
        if poses or stand:
            told = [*(f"camera {camera}" for camera in poses), *([f"the robot's base ({stand})"] if stand else [])]
            note = (
                f"/tf_static gives the poses of {', '.join(told)} in {name}, whose z = 0 counts as the floor; they "
                "are used unless a cell file has the pose of a camera"
            )
            return StaticPoses(poses, T_world_base, (note,))
    return StaticPoses({}, None, ())


def _pose_in(links: Mapping[str, Link], frame: str, world: str) -> Floats | None:
    """Returns the pose (4, 4) of a frame in the world; None if static transforms do not lead there."""
    T = np.eye(4)
    for _ in range(len(links) + 1):
        if frame == world:
            T.flags.writeable = False
            return T
        if frame not in links:
            return None
        T = links[frame].T_parent_child @ T
        frame = links[frame].parent
    return None
