"""What a log holds beside the skeletons: camera poses, task, robot base, recorded joints, ground truth."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.logs.decoders import points_of
from hrcreplay.logs.log_files import LogFiles
from hrcreplay.logs.messages import Message, Topic, Undecodable, stamp_ns, topic_list
from hrcreplay.records import Floats, Ints, Table


@dataclass(frozen=True)
class Header:
    """What is known of a log before its first frame."""

    path: Path
    kind: str  #: "hrcreplay", "mcap", "ros1" or "ros2"
    cameras: tuple[str, ...]
    T_world_camera: dict[str, Floats]  #: (4, 4); only of the cameras whose extrinsics are in the log
    task: dict[str, Any] | None  #: programmed task in the log, of the same structure as a task file
    start_ns: int  #: first arrival of a skeleton, joint state or truth; of anything where there are none
    end_ns: int  #: last arrival of anything
    T_world_base: Floats | None  #: (4, 4) robot base, where the log knows it
    has_truth: bool
    joint_names: tuple[str, ...]  #: of the joint track; () where there is none


@dataclass(frozen=True)
class JointTrack(Table):
    """Robot joints as the log has them, a row a message."""

    t_ns: Ints  #: (n,)
    q: Floats  #: (n, nv) [rad]
    names: tuple[str, ...]


@dataclass(frozen=True)
class Truth(Table):
    """Ground truth of the person, from a reference better than the cameras, a row an instant."""

    t_ns: Ints  #: (n,)
    points_m: Floats  #: (n, 20, 3) POINTS in the world [m]


_ROS_JOINTS, _OWN_JOINTS, _OWN_TRUTH = "sensor_msgs/JointState", "hrcreplay.JointState", "hrcreplay.Truth"
_OWN_CAMERA, _OWN_TASK, _OWN_BASE = "hrcreplay.Camera", "hrcreplay.Task", "hrcreplay.Base"
_CHUNK_NS = 10**9
_RIGID = 1e-2  # of the axes of a pose: those of a recording may have been rounded, those of a cell file not so much


@dataclass(frozen=True)
class Latched:
    """Values that hold for the whole log: camera poses, task, robot base."""

    cameras: tuple[str, ...]  #: declared, in that order
    T_world_camera: dict[str, Floats]
    task: dict[str, Any] | None
    T_world_base: Floats | None


def latched(source: LogFiles) -> Latched:
    """Reads the messages that hold for a whole log of our own. Raises LogError where one is broken."""
    kinds = (_OWN_CAMERA, _OWN_TASK, _OWN_BASE)
    names = [topic.name for topic in source.topics() if topic.type in kinds]
    cameras: list[str] = []
    poses: dict[str, Floats] = {}
    task = base = None
    for message in source.messages(names) if names else ():
        content, kind = message.read(), message.topic.type
        if kind == _OWN_CAMERA:
            cameras.append(content.camera)
            if content.T_world_camera:
                poses[content.camera] = _pose(content.T_world_camera, message)
        elif kind == _OWN_TASK:
            task = _task(content.json, message)
        else:
            base = _pose(content.T_world_base, message)
    return Latched(tuple(cameras), poses, task, base)


def _task(text: str, message: Message) -> dict[str, Any]:
    try:
        return dict(json.loads(text))
    except (ValueError, TypeError) as error:
        raise LogError(
            f"{message.topic.name}: the task in the log is not JSON ({error}); import the log again"
        ) from error


def _pose(values: Any, message: Message) -> Floats:
    if len(values) != 16:
        raise LogError(f"{message.topic.name}: a pose of {len(values)} numbers; 16 are right")
    pose = np.array(values, dtype=np.float64).reshape(4, 4)
    if not np.isfinite(pose).all():
        raise LogError(f"{message.topic.name}: a pose with {pose[~np.isfinite(pose)][0]}; finite numbers are right")
    R = pose[:3, :3]
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > _RIGID or np.linalg.det(R) < 0.0 or (pose[3] != (0.0, 0.0, 0.0, 1.0)).any():
        what = f"axes off by {off:.2g}" if off > _RIGID else "a mirror image, or a last row that is not 0 0 0 1"
        raise LogError(f"{message.topic.name}: a pose with {what}; a rotation and a place are right")
    pose.flags.writeable = False
    return pose


@dataclass(frozen=True)
class JointTopic:
    """The topic of the robot's joints, and the joints of its first message."""

    topic: Topic
    names: tuple[str, ...]


def find_joints(source: LogFiles, name: str | None) -> JointTopic | None:
    """The joint track: of the topic named, else of the first that carries one.

    Raises:
        LogError: The topic named is not there or carries none.
    """
    found = [topic for topic in source.topics() if topic.type in (_ROS_JOINTS, _OWN_JOINTS)]
    if name is not None:
        found = [topic for topic in found if topic.name == name]
        if not found:
            raise LogError(f"{source.path}: no joint states on {name}; found {topic_list(source.topics())}")
    for topic in found:
        for message in source.messages([topic.name]):
            _, q = _joint_state(message)
            if q:
                return JointTopic(topic, tuple(q))
    return None


def joints(source: LogFiles, track: JointTopic, defects: Counter[str]) -> Iterator[JointTrack]:
    """The joint track in chunks of at most a second."""
    times: list[int] = []
    rows: list[list[float]] = []
    last_ns = None
    for message in source.messages([track.topic.name]):
        try:
            t_ns, q = _joint_state(message)
        except Undecodable:
            defects["messages_undecodable"] += 1
            continue
        if not q.keys() >= set(track.names):
            defects["joints_incomplete"] += 1
            continue
        if last_ns is not None and t_ns <= last_ns:
            defects["joints_out_of_order"] += 1
            continue
        last_ns = t_ns
        if times and t_ns - times[0] >= _CHUNK_NS:
            yield JointTrack(np.array(times, dtype=np.int64), np.array(rows, dtype=np.float64), track.names)
            times, rows = [], []
        times.append(t_ns)
        rows.append([q[joint] for joint in track.names])
    if times:
        yield JointTrack(np.array(times, dtype=np.int64), np.array(rows, dtype=np.float64), track.names)


def _joint_state(message: Message) -> tuple[int, dict[str, float]]:
    content = message.read()
    if message.topic.type == _OWN_JOINTS:
        return content.t_ns, dict(zip(content.names, content.q, strict=False))
    t_ns = stamp_ns(content.header.stamp, message.topic.name) or message.arrival_ns
    return t_ns, {str(name): float(q) for name, q in zip(content.name, content.position, strict=False)}


def truth_topic(source: LogFiles) -> str | None:
    """The topic of the ground truth, where the log has one."""
    return next((topic.name for topic in source.topics() if topic.type == _OWN_TRUTH and topic.count), None)


def truth(source: LogFiles, topic: str) -> Iterator[Truth]:
    """The ground truth in chunks of at most a second."""
    times: list[int] = []
    rows: list[Floats] = []
    for message in source.messages([topic]):
        content = message.read()
        if times and content.t_ns - times[0] >= _CHUNK_NS:
            yield Truth(np.array(times, dtype=np.int64), np.array(rows))
            times, rows = [], []
        times.append(content.t_ns)
        rows.append(points_of(content.points, message.topic.name))
    if times:
        yield Truth(np.array(times, dtype=np.int64), np.array(rows))
