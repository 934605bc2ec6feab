"""The recorded robot joints: joint states of all topics, joined by name into one track of the robot's axes.

Joints are matched to axes by name, never by the order in a message. Each axis is read on its own clock, and each
irregularity gives a note.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.errors import LogError
from hrcreplay.logs.joint_names import NAMELESS, list_names, match_names
from hrcreplay.logs.log_files import LogFiles
from hrcreplay.logs.messages import Message, Undecodable, stamp_ns, topic_list
from hrcreplay.records import AxisFrame, Bools, Floats, Ints, Table
from hrcreplay.settings.sections import Logs

_ROS, _OWN = "sensor_msgs/JointState", "hrcreplay.JointState"
_NS = 1_000_000_000

#: Time without a position of an axis above which there is a gap [s].
GAP_S = 0.2
#: Lead of a stamp over its neighbours that marks it as wrong; also the tolerated difference in transport time [s].
_APART_S = 0.1
#: Maximum transport delay of a message; above it the stamp is wrong [s].
_HELD_S = 10.0
#: Excess of a clock's step over the log's between two messages that marks a reset clock [s].
_STEP_S = 0.25
#: Maximum time from robot to logger; above it the stamp is from another clock [s].
_LATE_S = 0.25
#: Maximum lead of stamps over their arrival, as two clocks always differ slightly [s].
_AHEAD_S = 1e-3
#: Maximum variation of the smallest delays over the log for a constant clock offset [s].
_CONSTANT_S = 0.05
#: Maximum difference between two topics with the same axis [rad].
_AGREE_RAD = 0.05
#: Maximum motion of a resting joint that is not an axis of the robot [rad or m].
_AT_REST = 1e-3


@dataclass(frozen=True)
class JointTrack(Table):
    """Positions of the robot's axes in the log, one row per instant with a position of any axis."""

    t_ns: Ints  #: (n,) on the log's clock, increasing
    q: Floats  #: (n, nv) [rad]
    dq: Floats  #: (n, nv) as recorded; NaN where the log gives none [rad/s]
    names: tuple[str, ...]  #: the robot's axes
    gaps_ns: tuple[tuple[int, int], ...] = ()  #: begin and end of each silence of an axis, in order


class Samples(NamedTuple):
    """One joint on one topic."""

    message: Ints  #: (n,) row of the topic's ``arrival_ns`` and ``stamp_ns``
    position: Floats  #: (n,) in the log's unit
    velocity: Floats  #: (n,) in the log's unit per second; NaN where the message gives none


@dataclass(frozen=True)
class JointTopic:
    """All joint states of one topic."""

    name: str
    arrival_ns: Ints  #: (m,)
    stamp_ns: Ints  #: (m,) 0 where a message has none
    joints: Mapping[str, Samples]  #: by name, in order of appearance; unnamed joints are '#1', '#2', ...
    by_links: bool = False  #: True: read from the poses of the robot's links


@dataclass(frozen=True)
class Clock:
    """Relation of a topic's stamps to the log's clock, and the basis of its instants."""

    topic: str
    delay_s: tuple[float, float, float]  #: arrival - stamp: median, 5th and 95th percentile; NaN without stamps [s]
    basis: str  #: "stamps", "stamps, shifted" or "arrival"
    shift_s: float  #: added to the stamps [s]
    remark: str  #: note for the user; empty without a problem


@dataclass(frozen=True)
class JointReading:
    """The joint track, and the way it was read."""

    track: JointTrack
    sources: Mapping[str, tuple[str, str]]  #: axis -> topic and name in the log
    clocks: tuple[Clock, ...]  #: clocks of the topics that are read
    notes: tuple[str, ...]  #: for the user


def find_topics(source: LogFiles, name: str | None) -> tuple[str, ...]:
    """Finds the topics of joint states: the named one, else all.

    Raises:
        LogError: The named topic is missing or contains none.
    """
    found = dict.fromkeys(t.name for t in source.topics() if t.type in (_ROS, _OWN) and t.count)
    if name is None:
        return tuple(found)
    if name not in found:
        raise LogError(f"{source.path}: no joint states on {name}; found {topic_list(source.topics())}")
    return (name,)


def read_topics(source: LogFiles, names: Sequence[str], defects: Counter[str]) -> list[JointTopic]:
    """Reads the joint states of the topics with positions.

    Args:
        source: The log's files.
        names: Topics of joint states.
        defects: Receives the number of messages left out.
    """
    return [topic for name in names if (topic := _read_topic(source, name, defects)).joints]


def _read_topic(source: LogFiles, name: str, defects: Counter[str]) -> JointTopic:
    arrival, stamp = array("q"), array("q")
    joints: dict[str, tuple[array[int], array[float], array[float]]] = {}
    for message in source.messages([name]):
        try:
            t_ns, names, positions, velocities = _joint_state(message)
        except Undecodable:
            defects["messages_undecodable"] += 1
            continue
        if not len(positions):
            continue  # velocities or efforts alone
        names = names or [f"{NAMELESS}{i}" for i in range(1, len(positions) + 1)]
        if len(names) != len(positions) or len(set(names)) != len(names):
            defects["joints_malformed"] += 1
            continue
        if len(velocities) != len(names):
            velocities = [np.nan] * len(names)
        for joint, position, velocity in zip(names, positions, velocities, strict=True):
            rows, values, rates = joints.setdefault(joint, (array("q"), array("d"), array("d")))
            rows.append(len(arrival))
            values.append(position)
            rates.append(velocity)
        arrival.append(message.arrival_ns)
        stamp.append(t_ns if 0 < t_ns < 1 << 62 else 0)
    series = {
        joint: Samples(_ints(rows), *(np.array(column, dtype=np.float64) for column in (values, rates)))
        for joint, (rows, values, rates) in joints.items()
    }
    return JointTopic(name, _ints(arrival), _ints(stamp), series)


#: Maximum turn of a link about other than its axis, as frames are rounded [rad].
_ASIDE_RAD = 0.02


def read_frames(
    source: LogFiles, names: Sequence[str], axes: Sequence[str], frames: Sequence[AxisFrame], defects: Counter[str]
) -> JointTopic | None:
    """Reads the robot's axes from the poses of its links; None if the log lacks the link of an axis.

    A pose counts if it is that of an axis' child link in its parent link. The position is the turn about the axis.

    Args:
        source: The log's files.
        names: Topics of transforms.
        axes: The robot's joints, from the base on.
        frames: Links at both sides of each axis.
        defects: Receives the number of messages left out.

    Raises:
        LogError: A link turns about another axis than that of the robot.
    """
    of = {(frame.parent, frame.child): (axis, frame) for axis, frame in zip(axes, frames, strict=True)}
    arrival, stamp = array("q"), array("q")
    found: dict[str, tuple[array[int], array[float]]] = {}
    for message in source.messages(names):
        try:
            transforms = message.read().transforms
        except Undecodable:
            defects["messages_undecodable"] += 1
            continue
        ours = [
            (*of[key], transform)
            for transform in transforms
            if (key := (transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/"))) in of
        ]
        for axis, frame, transform in ours:
            rows, values = found.setdefault(axis, (array("q"), array("d")))
            rows.append(len(arrival))
            values.append(_turn(transform, frame, axis, str(source.path)))
        if ours:
            t_ns = stamp_ns(ours[0][2].header.stamp, message.topic.name)
            arrival.append(message.arrival_ns)
            stamp.append(t_ns if 0 < t_ns < 1 << 62 else 0)
    if len(found) < len(axes):
        return None
    series = {
        axis: Samples(_ints(rows), _unwrapped(np.array(values)), np.full(len(values), np.nan))
        for axis, (rows, values) in found.items()
    }
    return JointTopic(", ".join(names), _ints(arrival), _ints(stamp), series, by_links=True)


def _unwrapped(q: Floats) -> Floats:
    """Removes the jumps by full turns; a position that is not finite is left out."""
    finite = np.isfinite(q)
    found = q.copy()
    found[finite] = np.unwrap(q[finite])
    return found


def _turn(transform: Any, frame: AxisFrame, axis: str, where: str) -> float:
    """Position of an axis by the pose of its child link [rad]; NaN if it is no rotation."""
    q = transform.transform.rotation
    quaternion = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
    if not 0.9 < float(np.linalg.norm(quaternion)) < 1.1:  # also NaN
        return float("nan")
    R = frame.R_parent_joint.T @ Rotation.from_quat(quaternion).as_matrix()
    turn = Rotation.from_matrix(R).as_rotvec()
    along = float(turn @ frame.axis)
    if np.abs(turn - along * frame.axis).max() > _ASIDE_RAD:
        raise LogError(
            f"{where}: the link {frame.child} does not turn about {axis} of the robot; would be right: the URDF of the "
            "recorded robot in robot.urdf"
        )
    return along


def _ints(values: array[int]) -> Ints:
    return np.array(values, dtype=np.int64)


def _joint_state(message: Message) -> tuple[int, list[str], list[float], list[float]]:
    """Returns stamp [ns], names, positions and velocities; an empty list for what the message lacks."""
    content = message.read()
    if message.topic.type == _OWN:
        return content.t_ns, list(content.names), list(content.q), []
    names, velocities = [str(name) for name in content.name], [float(dq) for dq in content.velocity]
    stamp = stamp_ns(content.header.stamp, message.topic.name)
    return stamp, names, [float(q) for q in content.position], velocities


def read_track(
    topics: Sequence[JointTopic], axes: Sequence[str], options: Logs, where: str, defects: Counter[str]
) -> JointReading:
    """Makes one track of the robot's axes.

    Args:
        topics: Result of ``read_topics``.
        axes: The robot's joints, from the base on.
        options: Settings of names, unit and clock.
        where: Start of error messages: the log.
        defects: Receives the numbers of messages and positions left out, and ``joint_gaps_ms``, the sum of all gaps.

    Raises:
        LogError: The joints do not fit the robot, two topics contradict each other, or an axis has no position.
        SettingsError: ``logs.joint_names`` does not fit robot or log.
    """
    found = list(dict.fromkeys(name for topic in topics for name in topic.joints))
    names = match_names(found, axes, options.joint_names, f"{where}: {', '.join(topic.name for topic in topics)}")
    chosen = _choose(topics, names)
    clocks: dict[str, Clock] = {}
    instants: dict[str, Ints] = {}
    for topic in topics:
        used = [joint for joint in names.values() if joint in topic.joints]
        if used:
            clocks[topic.name], instants[topic.name] = place_in_time(topic, used, options.joints_offset_s, defects)
    scale = np.pi / 180.0 if options.joints_unit == "deg" else 1.0
    tracks: dict[tuple[str, str], _Series] = {}
    for topic in topics:
        late: Bools = np.zeros(len(topic.arrival_ns), dtype=np.bool_)
        for joint in set(names.values()) & set(topic.joints):
            tracks[(topic.name, joint)] = _in_order(topic.joints[joint], instants[topic.name], scale, late, defects)
        defects["joints_out_of_order"] += int(late.sum())
    agreed = _agree(topics, names, chosen, tracks, where)
    track = _join([tracks[(chosen[axis].name, names[axis])] for axis in axes], tuple(axes), where)
    defects["joint_gaps_ms"] += round(_covered_ns(track.gaps_ns) / 1e6)
    read = dict.fromkeys(topic.name for topic in chosen.values())
    notes = [
        *_name_remarks(topics, names, chosen),
        *agreed,
        *(clocks[name].remark for name in read if clocks[name].remark),
        *_small_degrees(track, options.joints_unit),
    ]
    sources = {axis: (chosen[axis].name, names[axis]) for axis in axes}
    return JointReading(track, sources, tuple(clocks[name] for name in read), tuple(notes))


def _choose(topics: Sequence[JointTopic], names: Mapping[str, str]) -> dict[str, JointTopic]:
    """Chooses axis -> topic to read: the one with the most axes, then with the most messages."""

    def rank(topic: JointTopic) -> tuple[int, int, str]:
        held = [topic.joints[name] for name in names.values() if name in topic.joints]
        return -len(held), -sum(len(samples.message) for samples in held), topic.name

    ranked = sorted(topics, key=rank)
    return {axis: next(topic for topic in ranked if name in topic.joints) for axis, name in names.items()}


def _agree(
    topics: Sequence[JointTopic],
    names: Mapping[str, str],
    chosen: Mapping[str, JointTopic],
    tracks: Mapping[tuple[str, str], _Series],
    where: str,
) -> Iterator[str]:
    """Returns remarks on axes in several topics, whose positions must agree."""
    beside: dict[tuple[str, str], float] = {}
    for axis, name in names.items():
        t_ns, q, _ = tracks[(chosen[axis].name, name)]
        for topic in topics:
            if topic is chosen[axis] or name not in topic.joints:
                continue
            other_ns, other, _ = tracks[(topic.name, name)]
            within = (other_ns >= t_ns[0]) & (other_ns <= t_ns[-1]) if len(t_ns) else np.zeros(0, dtype=np.bool_)
            apart = np.abs(_at(other_ns[within], t_ns, q) - other[within]) if within.any() else np.zeros(1)
            pair = chosen[axis].name, topic.name
            beside[pair] = max(beside.get(pair, 0.0), float(apart.max()))
            if beside[pair] > _AGREE_RAD:
                raise LogError(
                    f"{where}: {name} is on {pair[0]} and on {pair[1]}, up to {np.degrees(apart.max()):.1f} deg apart; "
                    f"choose with --set logs.joints_topic={pair[0]} (or {pair[1]})"
                )
    for (read, other_name), apart_rad in beside.items():
        yield (
            f"robot joints: read from {read}; {other_name} holds some of them too, at most "
            f"{np.degrees(apart_rad):.2g} deg apart"
        )


def place_in_time(
    topic: JointTopic, joints: Sequence[str], offset_s: float | None, defects: Counter[str]
) -> tuple[Clock, Ints]:
    """Computes the instants of a topic's messages on the log's clock.

    A stamp is better than an arrival, as it contains no network delay and jitter. So stamps are used if they can be on
    the log's clock: never after their arrival, and usually at most 0.25 s before it. If they differ from it by a
    constant, they are shifted so that the fastest messages (the 5th percentile of arrival - stamp) have no delay: this
    keeps the even spacing of the stamps, and its error is at most the smallest delay, like that of the arrivals. If the
    offset between the two clocks is not constant (a clock that was reset, a simulation at another speed), the arrivals
    are used. An offset given by the user is used unchanged, unless the robot's clock was reset.

    A single missing stamp, or one ahead of its neighbours or over 10 s behind them, gets the delay of its neighbours. A
    message that arrives late keeps its stamp, as it was delayed on the way.

    Args:
        topic: All messages.
        joints: Joints that are axes; messages without them are not used for the robot's clock.
        offset_s: The robot's clock minus the log's, if given [s].
        defects: Receives the number of wrong stamps.

    Returns:
        The clock, and (m,) instants [ns].
    """
    mine = np.unique(np.concatenate([topic.joints[joint].message for joint in joints]))
    arrival, stamp = topic.arrival_ns[mine], topic.stamp_ns[mine]
    known = stamp > 0
    t_ns = topic.arrival_ns.copy()
    if not known.any():
        remark = f"robot joints: the stamps of {topic.name} are all zero; arrival times are used instead"
        return Clock(topic.name, (np.nan, np.nan, np.nan), "arrival", 0.0, remark), t_ns
    given_ns = round((offset_s or 0.0) * _NS)
    delays, wrong = _delays(arrival, stamp - given_ns, known)
    defects["joints_stamp_wrong"] += int(wrong.sum())
    stamp = np.where(wrong, arrival - delays, stamp - given_ns)
    match = _match_clocks(arrival, stamp, delays, wrong)
    basis, remark = _check_track(match, f"robot joints: the stamps of {topic.name}", offset_s)
    shift_ns = match.quickest_ns if basis == "stamps, shifted" else 0
    if basis != "arrival":
        t_ns[mine] = stamp + shift_ns
    return Clock(topic.name, match.delay_s, basis, (shift_ns - given_ns) / _NS, remark), t_ns


class _Match(NamedTuple):
    """Comparison of stamps with arrivals."""

    delay_s: tuple[float, float, float]  #: arrival - stamp: median, 5th and 95th percentile [s]
    quickest_ns: int  #: the 5th percentile
    least_s: list[float]  #: smallest delays in the parts of the log [s]
    steps: int  #: number of resets of the robot's clock
    step_at_s: float  #: the first time, after the first message [s]
    step_by_s: float  #: by so much [s]


def _match_clocks(arrival_ns: Ints, stamp_ns: Ints, delays_ns: Ints, wrong: Bools) -> _Match:
    late = arrival_ns - stamp_ns
    order = np.sort(late)
    low, high = (int(order[round(share * (len(late) - 1))]) for share in (0.05, 0.95))
    steady = ~wrong & (np.abs(late - delays_ns) <= _APART_S * _NS)
    steady = steady if steady.any() else ~wrong
    steps = _steps(arrival_ns[steady], stamp_ns[steady])
    at_s = by_s = 0.0
    if len(steps):
        at_s = float(arrival_ns[steady][steps[0]] - arrival_ns[0]) / _NS
        by_s = float(late[steady][steps[0] - 1] - late[steady][steps[0]]) / _NS
    least_s = [float(np.sort(part)[len(part) // 4]) / _NS for part in _parts(late[steady])]
    return _Match((float(np.median(late)) / _NS, low / _NS, high / _NS), low, least_s, len(steps), at_s, by_s)


def _check_track(match: _Match, stamps: str, offset_s: float | None) -> tuple[str, str]:
    """Returns the basis of the instants (see ``Clock.basis``), and the remark."""
    median_s, low_s, high_s = match.delay_s
    least_s, most_s = min(match.least_s), max(match.least_s)
    told = (
        f"{stamps} (arrival - stamp: median {_seconds(median_s)}, "
        f"5th to 95th percentile {_seconds(low_s)} to {_seconds(high_s)})"
    )
    if least_s >= -_AHEAD_S and float(np.median(match.least_s)) <= _LATE_S and not match.steps:
        over = f"{told} are used, though 5 % of the messages arrive later than {_LATE_S:g} s after them"
        return "stamps", over if high_s > _LATE_S else ""
    if match.steps:
        return "arrival", (
            f"{stamps} jump by {_seconds(match.step_by_s)} at {match.step_at_s:.2f} s"
            + (f", and {match.steps - 1} times more" if match.steps > 1 else "")
            + ": the robot's clock, or the recorder's, was set meanwhile; arrival times are used instead"
        )
    if offset_s is not None:
        return "stamps", (
            f"{told} do not fit the log's clock with logs.joints_offset_s = {offset_s:g}, and are used as you set it"
        )
    if most_s - least_s <= _CONSTANT_S:
        side = "ahead of" if low_s < 0 else "behind"
        return "stamps, shifted", (
            f"{told} are {_seconds(abs(low_s))} {side} the log's clock{_epoch(low_s)}; they are shifted by that much, "
            "as if the quickest messages took no time. If you know the offset of the robot's clock, set "
            "logs.joints_offset_s (0: the stamps are right as they are)"
        )
    return "arrival", (
        f"{told} keep another pace than the log's clock, {_seconds(least_s)} to {_seconds(most_s)} from it; arrival "
        "times are used instead"
    )


def _seconds(value_s: float) -> str:
    return f"{value_s:.3f} s" if abs(value_s) < 1e5 else f"{value_s:.6g} s"


def _epoch(apart_s: float) -> str:
    """Returns a remark on clocks that differ by years."""
    years = abs(apart_s) > 365 * 86_400
    return ": they count from another epoch, as simulation time or the time since start-up does" if years else ""


def _delays(arrival_ns: Ints, stamp_ns: Ints, known: Bools) -> tuple[Ints, Bools]:
    """(n,) running median of arrival - stamp over five messages, and True for wrong or missing stamps."""
    at = np.flatnonzero(known)
    delay = arrival_ns[at] - stamp_ns[at]
    padded = np.pad(delay, 2, mode="reflect" if len(delay) > 2 else "edge")
    middle = np.sort(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)[:, 2]
    nearest = np.clip(np.searchsorted(at, np.arange(len(arrival_ns))), 0, len(at) - 1)
    delays = middle[nearest]
    usual = np.sort(delay)[round(0.05 * (len(delay) - 1))]
    ahead = arrival_ns - stamp_ns < np.minimum(delays, usual) - round(_APART_S * _NS)
    behind = arrival_ns - stamp_ns > delays + round(_HELD_S * _NS)
    return delays, ~known | ahead | behind


def _steps(arrival_ns: Ints, stamp_ns: Ints) -> Ints:
    """Finds messages before which the robot's clock was reset: ahead of the log's, or back."""
    way, passed = np.diff(stamp_ns), np.diff(arrival_ns)
    return np.flatnonzero((way - passed > _STEP_S * _NS) | (way < -_APART_S * _NS)) + 1


def _parts(delay_ns: Ints) -> list[Ints]:
    """Divides delays into up to 20 parts of the log of at least 20 messages each."""
    return np.array_split(delay_ns, int(np.clip(len(delay_ns) // 20, 1, 20)))


class _Series(NamedTuple):
    """One axis on its own clock."""

    t_ns: Ints  #: (n,) increasing
    q: Floats  #: (n,) [rad]
    dq: Floats  #: (n,) NaN where not given [rad/s]


def _in_order(samples: Samples, t_ns: Ints, scale: float, late: Bools, defects: Counter[str]) -> _Series:
    """Returns the series of a joint, without positions that are not finite or not later than earlier ones."""
    finite: Bools = np.isfinite(samples.position)
    defects["joints_not_finite"] += int((~finite).sum())
    messages = samples.message[finite]
    times = t_ns[messages]
    before = np.concatenate([[np.iinfo(np.int64).min], np.maximum.accumulate(times)[:-1]]) if len(times) else times
    increasing = times > before
    late[messages[~increasing]] = True
    q, dq = (column[finite][increasing] * scale for column in (samples.position, samples.velocity))
    return _Series(times[increasing], q, dq)


def _at(t_ns: Ints, known_ns: Ints, q: Floats) -> Floats:
    """Interpolates positions linearly."""
    return np.asarray(np.interp((t_ns - known_ns[0]).astype(float), (known_ns - known_ns[0]).astype(float), q))


def _join(series: Sequence[_Series], axes: tuple[str, ...], where: str) -> JointTrack:
    """Joins all axes at each instant with a position of any axis, while all are known."""
    for axis, one in zip(axes, series, strict=True):
        if not len(one.t_ns):
            raise LogError(f"{where}: {axis} has no position that is a number; a joint track needs two of every axis")
    first, last = max(int(one.t_ns[0]) for one in series), min(int(one.t_ns[-1]) for one in series)
    if first > last:
        raise LogError(f"{where}: the robot's axes {', '.join(axes)} are never known at one time")
    union = np.unique(np.concatenate([one.t_ns for one in series]))
    union = union[(union >= first) & (union <= last)]
    q, dq = (
        np.column_stack([c if np.array_equal(one.t_ns, union) else _at(union, one.t_ns, c) for one, c in columns])
        for columns in ([(one, one.q) for one in series], [(one, one.dq) for one in series])
    )
    return JointTrack(union, q, dq, axes, _gaps(series, first, last))


def _gaps(series: Sequence[_Series], first: int, last: int) -> tuple[tuple[int, int], ...]:
    """Returns instants from ``first`` to ``last`` between which an axis has no position for longer than GAP_S."""
    found: set[tuple[int, int]] = set()
    for times, _, _ in series:
        at = np.flatnonzero(np.diff(times) > GAP_S * _NS)
        found |= {(int(a), int(b)) for a, b in zip(times[at], times[at + 1], strict=True)}
    return tuple(sorted((max(a, first), min(b, last)) for a, b in found if b > first and a < last))


def _covered_ns(gaps_ns: Sequence[tuple[int, int]]) -> int:
    """Computes the total time with at least one missing axis [ns], from gaps in order."""
    covered, until = 0, 0
    for begin, end in gaps_ns:
        covered += max(0, end - max(begin, until))
        until = max(until, end)
    return covered


def coverage_remarks(reading: JointReading, start_ns: int, end_ns: int) -> Iterator[str]:
    """Returns remarks on a track with gaps, or one shorter than the log.

    Args:
        reading: The track.
        start_ns: First arrival of the log.
        end_ns: Last arrival.
    """
    gaps_ns, times = reading.track.gaps_ns, reading.track.t_ns
    begin_s, last_s, length_s = ((int(t) - start_ns) / _NS for t in (times[0], times[-1], end_ns))
    if begin_s > GAP_S or length_s - last_s > GAP_S:
        yield (
            f"robot joints: known from {begin_s:.2f} s to {last_s:.2f} s of the log, which lasts {length_s:.2f} s; "
            "before and after, the robot is not known, and a programme made of its motion stands still"
        )
    if not gaps_ns:
        return
    covered_s = _covered_ns(gaps_ns) / _NS
    longest = max(gaps_ns, key=lambda gap: gap[1] - gap[0])
    yield (
        f"robot joints: gaps of more than {GAP_S:g} s: {len(gaps_ns)}, {covered_s:.2f} s in all, the longest of "
        f"{(longest[1] - longest[0]) / _NS:.2f} s from {(longest[0] - start_ns) / _NS:.2f} s of the log on. There the "
        "robot is not known, and a programme made of its motion is a straight line in joint space from the last known "
        "position to the next"
    )


def _name_remarks(
    topics: Sequence[JointTopic], names: Mapping[str, str], chosen: Mapping[str, JointTopic]
) -> Iterator[str]:
    """Returns remarks on names other than the robot's, and on joints that are not axes."""
    if all(name.startswith(NAMELESS) for name in names.values()):
        order = ", ".join(names)
        yield f"robot joints: {next(iter(chosen.values())).name} has no names; the assumed order is {order}"
    elif list(names.values()) != list(names):
        yield f"robot joints: read as {', '.join(f'{axis} = {name}' for axis, name in names.items())}"
    others: dict[str, float] = {}
    for topic in topics:
        for name, samples in topic.joints.items():
            finite = samples.position[np.isfinite(samples.position)]
            if name not in names.values():
                others[name] = max(others.get(name, 0.0), float(np.ptp(finite)) if len(finite) else 0.0)
    if others:
        moving = {name: f"{name} (moves by {way:.3g})" for name, way in others.items() if way > _AT_REST}
        carrying = "; if a moving one carries the arm, the assumed pose of the robot's base is wrong"
        ignored = list_names([moving.get(name, name) for name in others])
        yield f"robot joints: ignored, as no axis of the robot: {ignored}{carrying if moving else ''}"


def _small_degrees(track: JointTrack, unit: str) -> Iterator[str]:
    """Returns a remark on degrees that are small enough to be radians."""
    most_deg = float(np.degrees(np.abs(track.q).max()))
    if unit == "deg" and 0.0 < most_deg <= 2 * np.pi:
        yield (
            f"robot joints: with logs.joints_unit = deg no axis is ever beyond {most_deg:.2f} deg; if the log is in "
            "radians, leave the setting out"
        )


def wait_s(topic: JointTopic, of: Callable[[Ints], float]) -> float:
    """Returns the median or longest time between two arrivals of a joint [s]; NaN if none arrives twice."""
    waits = [np.diff(topic.arrival_ns[samples.message]) for samples in topic.joints.values()]
    every = np.concatenate(waits) if waits else np.zeros(0, dtype=np.int64)
    return float(of(every)) / _NS if len(every) else float("nan")
