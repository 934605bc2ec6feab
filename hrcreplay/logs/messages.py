"""Types that all log formats share: messages, topics, skeleton rows, and the interface of a decoder.

Also the topics of hrcreplay's own log (skeleton.proto defines its messages), the joints of other trackers that
correspond to POINTS (those that a tracker lacks are missing), and the merging of files and chunks by arrival.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.records import NOBODY, POINTS, Floats

#: First and last bytes of an MCAP file.
MCAP_MAGIC = b"\x89MCAP0\r\n"


class Undecodable(LogError):
    """A message that does not follow its own type."""


@dataclass(frozen=True)
class Topic:
    """A topic of one file."""

    name: str
    type: str  #: without the "msg" of ROS 2: tf2_msgs/TFMessage
    count: int  #: number of messages in this file
    parse: Callable[[bytes], Any]  #: bytes of a message -> its fields; raises Undecodable


def topic_list(found: Iterable[Topic]) -> str:
    """Lists topics and their types in one line."""
    return ", ".join(f"{topic.name} ({topic.type})" for topic in found) or "no topics at all"


class Message(NamedTuple):
    """A message as stored in the file."""

    arrival_ns: int
    topic: Topic
    data: bytes
    position: int = 0  #: a number that increases along its file; 0 if the order in the file is unknown

    def read(self) -> Any:
        """Decodes the fields. Raises Undecodable."""
        return self.topic.parse(self.data)


class MessageStream(Protocol):
    """One file of a log."""

    topics: tuple[Topic, ...]
    start_ns: int  #: first arrival
    end_ns: int  #: last arrival
    profile: str  #: program that wrote it, if the format contains it
    defects: Counter[str]
    notes: list[str]

    def messages(self, names: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        """Messages on these topics with start <= arrival < end, in order of arrival."""


@dataclass
class Damage:
    """Defects of a file."""

    defects: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    def ends_at(self, last_ns: int, start_ns: int) -> None:
        """Records that the file is truncated."""
        self.defects["truncated_at_ns"] = last_ns
        self.notes.append(f"the file breaks off {(last_ns - start_ns) / 1e9:.3f} s after its first message")


def note_damaged_chunks(damaged: Mapping[int, str]) -> str:
    """Returns a note on chunks that are left out; ``damaged``: first byte of each -> its defect."""
    offset = min(damaged)
    first = f"at byte {offset} is damaged and left out ({damaged[offset]})"
    return f"the chunk {first}" if len(damaged) == 1 else f"{len(damaged)} chunks are damaged; the first {first}"


class LazyChunk(NamedTuple):
    """A sequence of messages that is opened only when the merged stream reaches it."""

    start_ns: int  #: earliest possible arrival of its messages
    open: Callable[[], Iterator[Message]]  #: the messages in order of arrival


def merge_by_arrival(parts: Iterable[LazyChunk]) -> Iterator[Message]:
    """Merges the messages of all parts in order of arrival; parts that do not overlap are never open together.

    Messages of one arrival keep the order of their parts.
    """
    waiting = deque(sorted(parts, key=lambda part: part.start_ns))
    heads: list[tuple[int, int, Message, Iterator[Message]]] = []
    opened = 0
    while waiting or heads:
        while waiting and (not heads or waiting[0].start_ns <= heads[0][0]):
            messages = waiting.popleft().open()
            first = next(messages, None)
            if first is not None:
                heapq.heappush(heads, (first.arrival_ns, opened, first, messages))
            opened += 1
        if not heads:
            continue
        _, order, message, messages = heads[0]
        yield message
        following = next(messages, None)
        if following is None:
            heapq.heappop(heads)
        else:
            heapq.heapreplace(heads, (following.arrival_ns, order, following, messages))


PROFILE = "hrcreplay"  #: profile in the MCAP header of hrcreplay's own logs
TASK = "/task"
BASE = "/robot/base"
JOINTS = "/robot/joints"
CAPSULES = "/robot/capsules"
TRUTH = "/truth"


def skeleton_topic(camera: str) -> str:
    """Returns the topic of a camera's skeletons."""
    return f"/camera/{camera}/skeleton"


def camera_info_topic(camera: str) -> str:
    """Returns the topic of a camera's description."""
    return f"/camera/{camera}/info"


def camera_of_topic(topic: str) -> str:
    """Returns the camera of a topic of hrcreplay's own log."""
    return topic.split("/")[2]


_SIDES = (("l", "LEFT", "Left", "left"), ("r", "RIGHT", "Right", "right"))

#: Azure Kinect Body Tracking: joint index -> name.
AZURE_JOINTS = (
    *("PELVIS", "SPINE_NAVEL", "SPINE_CHEST", "NECK"),
    *("CLAVICLE_LEFT", "SHOULDER_LEFT", "ELBOW_LEFT", "WRIST_LEFT", "HAND_LEFT", "HANDTIP_LEFT", "THUMB_LEFT"),
    *("CLAVICLE_RIGHT", "SHOULDER_RIGHT", "ELBOW_RIGHT", "WRIST_RIGHT", "HAND_RIGHT", "HANDTIP_RIGHT", "THUMB_RIGHT"),
    *("HIP_LEFT", "KNEE_LEFT", "ANKLE_LEFT", "FOOT_LEFT", "HIP_RIGHT", "KNEE_RIGHT", "ANKLE_RIGHT", "FOOT_RIGHT"),
    *("HEAD", "NOSE", "EYE_LEFT", "EAR_LEFT", "EYE_RIGHT", "EAR_RIGHT"),
)

#: Kinect v2: joint index -> name.
KINECT2_JOINTS = (
    *("SpineBase", "SpineMid", "Neck", "Head"),
    *("ShoulderLeft", "ElbowLeft", "WristLeft", "HandLeft", "ShoulderRight", "ElbowRight", "WristRight", "HandRight"),
    *("HipLeft", "KneeLeft", "AnkleLeft", "FootLeft", "HipRight", "KneeRight", "AnkleRight", "FootRight"),
    *("SpineShoulder", "HandTipLeft", "ThumbLeft", "HandTipRight", "ThumbRight"),
)

_PAIRED = ("shoulder", "elbow", "wrist", "hand", "hip", "knee", "ankle", "foot")

#: POINTS -> joint of the Azure Kinect.
AZURE_POINTS: Mapping[str, str] = {"pelvis": "PELVIS", "chest": "SPINE_CHEST", "neck": "NECK", "head": "HEAD"} | {
    f"{joint}_{s}": f"{joint.upper()}_{side}" for joint in _PAIRED for s, side, _, _ in _SIDES
}

#: POINTS -> joint of the Kinect v2. Its Neck lies above the shoulder line; the neck of POINTS is on it.
KINECT2_POINTS: Mapping[str, str] = {
    "pelvis": "SpineBase",
    "chest": "SpineMid",
    "neck": "SpineShoulder",
    "head": "Head",
} | {f"{joint}_{s}": f"{joint.title()}{side}" for joint in _PAIRED for s, _, side, _ in _SIDES}

#: POINTS -> frame of openni_tracker, taken as named: OpenNI may mirror left and right, which a log does not show. It
#: has no ankle (its foot is at the ankle) and no wrist: the hand is used as the wrist, as there would otherwise be no
#: forearm. The pelvis is the middle of its hips.
OPENNI_POINTS: Mapping[str, str] = {"chest": "torso", "neck": "neck", "head": "head"} | {
    f"{point}_{s}": f"{side}_{joint}"
    for point, joint in (
        *(("shoulder", "shoulder"), ("elbow", "elbow"), ("wrist", "hand"), ("hand", "hand")),
        *(("hip", "hip"), ("knee", "knee"), ("foot", "foot")),
    )
    for s, _, _, side in _SIDES
}

#: Joints that openni_tracker publishes of a person, without the trailing id.
OPENNI_JOINTS = frozenset(OPENNI_POINTS.values())

#: Azure Kinect joint index -> index into POINTS.
AZURE_INDEX: Mapping[int, int] = {
    AZURE_JOINTS.index(joint): POINTS.index(point) for point, joint in AZURE_POINTS.items()
}

#: Kinect v2 joint index -> index into POINTS.
KINECT2_INDEX: Mapping[int, int] = {
    KINECT2_JOINTS.index(joint): POINTS.index(point) for point, joint in KINECT2_POINTS.items()
}


#: Units of points -> metres.
METRES: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


class RawSkeleton(NamedTuple):
    """One body in one frame, not yet cleaned; NOBODY for a frame without one."""

    capture_ns: int | None  #: None: only the arrival is known
    camera: str
    body: int
    points_m: Floats  #: (20, 3) camera frame [m]; NaN if the sensor lacks the point
    confidence: Floats  #: (20,); 0 if the sensor lacks the point
    stamp_zero: bool = False  #: True: the capture is missing because a ROS header's stamp is zero


class SkeletonDecoder(Protocol):
    """Reads the skeletons of one topic."""

    @property
    def topic(self) -> str:
        """The topic."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras on it."""

    @property
    def frames(self) -> Mapping[str, str]:
        """Camera -> tf frame of its points, where known."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user on the reading of the topic."""

    @property
    def shows_camera_alive(self) -> bool:
        """Returns True if a message without a body still shows that the only camera delivers frames."""

    def fresh_copy(self) -> SkeletonDecoder:
        """Returns the decoder without state, for the start of a pass."""

    def rows(self, message: Message) -> list[RawSkeleton]:
        """Returns the rows that this message completes. Raises Undecodable, LogError."""


def missing_body() -> tuple[Floats, Floats]:
    """Returns points and confidence of an unknown body."""
    return np.full((len(POINTS), 3), np.nan), np.zeros(len(POINTS))


def nobody(camera: str, capture_ns: int | None = None) -> RawSkeleton:
    """Makes a frame without a body."""
    return RawSkeleton(capture_ns, camera, NOBODY, *missing_body())


def stamp_ns(stamp: Any, where: str) -> int:
    """Converts a ROS time to nanoseconds."""
    try:
        return int(stamp.sec) * 10**9 + int(stamp.nanosec)
    except AttributeError as error:
        raise LogError(
            f"{where}: found {stamp!r} for a capture time; a field of type time is needed, or none"
        ) from error


def camera_of(name: str) -> str:
    """Makes a camera's name from a topic or a frame: without slashes, for names of columns."""
    return name.strip("/").replace("/", "_")
