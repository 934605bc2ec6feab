"""The robot as recorded by the capsules of its links, in the frame of its base, where a log has no joints of it."""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.logs import joints
from hrcreplay.logs.joints import JointTopic, JointTrack, Samples
from hrcreplay.logs.log_files import LogFiles
from hrcreplay.logs.messages import Undecodable, stamp_ns, topic_list
from hrcreplay.records import Floats, Ints
from hrcreplay.settings.sections import Logs, RobotCapsules

#: Message types of capsules that need no setting, with what differs from the defaults of ``logs.robot_capsules``.
_TYPES: dict[str, dict[str, Any]] = {
    "reachable_occupancy/ReachableOccupancy": {},
    "hrcreplay.RobotCapsules": {"capsules": "capsules", "stamp": None},
}
#: Numbers of a capsule, in the order of ``CapsuleTrack.numbers``.
PARTS = (*(f"{end}_{axis}" for end in ("start", "end") for axis in "xyz"), "radius")


@dataclass(frozen=True)
class CapsuleTrack:
    """Capsules of the robot's links in the frame of its base."""

    numbers: JointTrack  #: ``q`` (n, 7 s): for each capsule start, end and radius [m]; ``dq`` is NaN
    names: tuple[str, ...]  #: (s,) numbers of the capsules in the message
    notes: tuple[str, ...]  #: for the user


def find_capsules(source: LogFiles, given: RobotCapsules | None) -> RobotCapsules | None:
    """Finds the topic of the robot's capsules: the given one, else the first of a known type.

    Raises:
        LogError: The given topic is not in the log.
    """
    found = {topic.name: topic.type for topic in source.topics() if topic.count}
    if given is not None:
        if given.topic not in found:
            raise LogError(
                f"{source.path}: logs.robot_capsules: no topic {given.topic}; found {topic_list(source.topics())}"
            )
        return given
    return next((RobotCapsules(topic=name, **_TYPES[kind]) for name, kind in found.items() if kind in _TYPES), None)


def read_capsules(source: LogFiles, how: RobotCapsules, defects: Counter[str]) -> CapsuleTrack | None:
    """Reads the capsules of a topic; None without any. Capsules that are always a point without a radius are left out.

    Instants, gaps and defects are those of joint states, as ``joints.read_track`` finds them.

    Args:
        source: The log's files.
        how: Topic and fields.
        defects: Receives the numbers of messages and numbers left out.

    Raises:
        LogError: The fields are not in the messages, or no capsule has two instants.
    """
    arrival, stamp = array("q"), array("q")
    rows: list[Floats] = []
    for message in source.messages([how.topic]):
        try:
            content = message.read()
        except Undecodable:
            defects["messages_undecodable"] += 1
            continue
        capsules = [_numbers(capsule, how, str(source.path)) for capsule in _field(content, how.capsules, how, source)]
        rows.append(np.array(capsules, dtype=float).reshape(-1, len(PARTS)))
        arrival.append(message.arrival_ns)
        stamp.append(0 if how.stamp is None else stamp_ns(_field(content, how.stamp, how, source), how.topic))
    most = max((len(row) for row in rows), default=0)
    table = np.full((len(rows), most, len(PARTS)), np.nan)
    for i, row in enumerate(rows):
        table[i, : len(row)] = row
    shown = [i for i in range(most) if np.nanmax(np.abs(table[:, i]), initial=0.0) > 0.0]
    if not shown:
        return None
    return _track(how.topic, table, shown, np.array(arrival, np.int64), np.array(stamp, np.int64), defects, source)


def _track(
    topic: str,
    table: Floats,
    shown: list[int],
    arrival_ns: Ints,
    stamp_ns: Ints,
    defects: Counter[str],
    source: LogFiles,
) -> CapsuleTrack:
    """Reads the numbers of the capsules as if each were a joint."""
    every = np.arange(len(table))
    nothing = np.full(len(table), np.nan)
    series = {
        f"capsule {i} {part}": Samples(every, table[:, i, k], nothing) for i in shown for k, part in enumerate(PARTS)
    }
    stamps = np.where((stamp_ns > 0) & (stamp_ns < 1 << 62), stamp_ns, 0)
    found = [JointTopic(topic, arrival_ns, stamps, series)]
    reading = joints.read_track(found, tuple(series), Logs(), str(source.path), defects)
    names = tuple(f"capsule {i}" for i in shown)
    note = (
        f"the robot as recorded: {len(names)} capsules on {topic}, without joints: contact is judged by them, but not "
        "whether it could have stopped; their motion is no programme for the robot of the settings"
    )
    return CapsuleTrack(reading.track, names, (note, *reading.notes))


def _field(content: Any, path: str, how: RobotCapsules, source: LogFiles) -> Any:
    for name in path.split("."):
        if not hasattr(content, name):
            raise LogError(
                f"{source.path}: {how.topic}: found no field {path}; would be right: its path in logs.robot_capsules"
            )
        content = getattr(content, name)
    return content


def _numbers(capsule: Any, how: RobotCapsules, where: str) -> list[float]:
    """Returns start, end and radius of a capsule [m]."""
    try:
        points = [getattr(capsule, name) for name in (how.start, how.end)]
        return [*(float(getattr(at, axis)) for at in points for axis in "xyz"), float(getattr(capsule, how.radius))]
    except AttributeError as error:
        raise LogError(
            f"{where}: {how.topic}: a capsule of it has no such field ({error}); would be right: the names of its "
            "points and its radius in logs.robot_capsules"
        ) from error
