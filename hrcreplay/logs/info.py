"""Summary of a log: its content, and the missing data for the next step."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs import joints
from hrcreplay.logs.camera_checks import BodyInWorld, CameraChecks, LimbAgreement, agreement_lines, body_line
from hrcreplay.logs.cleaning import PersonMemory, select_person
from hrcreplay.logs.clocks import late_remark
from hrcreplay.logs.joints import Clock
from hrcreplay.logs.reader import DEFAULT, Log
from hrcreplay.records import AxisFrame, CameraFrames, Floats, SkeletonTrack
from hrcreplay.settings.sections import Logs


@dataclass(frozen=True)
class TopicSummary:
    """A topic of the log."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True)
class CameraSummary:
    """Frames of one camera, after duplicates and late ones are dropped."""

    name: str
    frames: int  #: instants; several bodies in one frame count once
    rate_hz: float  #: rate from the median period between captures [Hz]; NaN below two frames
    first_ns: int | None  #: first arrival
    last_ns: int | None  #: last arrival
    longest_gap_s: float  #: longest time between arrivals of frames with a body [s]; NaN below two frames
    delay_s: float  #: median delay from capture to arrival, including the offset of the two clocks [s]
    delay_p95_s: float  #: its 95th percentile [s]
    delay_range_s: tuple[float, float]  #: minimum and maximum [s]
    bodies: dict[int, int]  #: body id -> number of rows
    pose_from: str  #: source of its extrinsics: the log, the cell; none
    stature_m: float  #: stature of its bodies from their bones, median [m]; NaN if no bone was seen
    side_cue: str | None  #: body part by which left and right were checked; None: not checked

    @property
    def posed(self) -> bool:
        """Returns True if its extrinsics are known."""
        return self.pose_from != "none"


@dataclass(frozen=True)
class JointSummary:
    """Joint positions of one topic."""

    topic: str
    names: tuple[str, ...]
    axes: dict[str, int]  #: name in the log -> number of the robot's axis read from it, from 1
    rate_hz: float  #: rate from the median time between arrivals [Hz]; NaN below two messages
    longest_gap_s: float  #: longest time between arrivals of one joint [s]; NaN below two messages
    clock: Clock


@dataclass(frozen=True)
class Summary:
    """Content of the output of ``hrcreplay info``."""

    path: Path
    kind: str
    start_ns: int
    end_ns: int
    topics: tuple[TopicSummary, ...]
    cameras: tuple[CameraSummary, ...]
    has_task: bool
    base_from: str
    has_truth: bool
    joints: tuple[JointSummary, ...]
    recorded: str  #: the robot as recorded, and what can be asked of it; empty without one
    defects: dict[str, int]
    bodies: tuple[BodyInWorld, ...]  #: heights of the person above the floor, for each camera of known pose
    agreements: tuple[LimbAgreement, ...]  #: agreement limb by limb, for each pair of such cameras
    notes: tuple[str, ...]
    missing: tuple[str, ...]  #: missing data for the next step, each with a remedy

    @property
    def span_s(self) -> float:
        """Time from first to last arrival [s]."""
        return (self.end_ns - self.start_ns) / 1e9


@dataclass
class _Tally:
    frames: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    last_capture_ns: int | None = None
    longest_ns: int = 0
    periods_ns: list[int] = field(default_factory=list)
    delays_ns: list[int] = field(default_factory=list)
    bodies: Counter[int] = field(default_factory=Counter)

    def add(self, capture_ns: int, arrival_ns: int, body: int) -> None:
        self.bodies[body] += 1
        if capture_ns == self.last_capture_ns:
            return  # another body of the same frame
        if self.last_ns is not None and self.last_capture_ns is not None:
            self.longest_ns = max(self.longest_ns, arrival_ns - self.last_ns)
            self.periods_ns.append(capture_ns - self.last_capture_ns)
        self.frames += 1
        self.first_ns = arrival_ns if self.first_ns is None else self.first_ns
        self.last_ns, self.last_capture_ns = arrival_ns, capture_ns
        self.delays_ns.append(arrival_ns - capture_ns)


def summarize(
    log: Log,
    *,
    axes: Sequence[str] = (),
    frames: Sequence[AxisFrame] = (),
    options: Logs = DEFAULT,
    T_world_camera: Mapping[str, Floats] | None = None,
    clock_offset_s: Mapping[str, float] | None = None,
    T_world_base: Floats | None = None,
) -> Summary:
    """Summarizes a log in one pass over its frames and one over its joints.

    Args:
        log: An open log; also one without skeletons (``open_log(path, options, skeletons=False)``).
        axes: The robot's joints, to match the joints of the log to axes; () if unknown.
        frames: Links at both sides of each axis: a log without joint states is searched for their poses; () if unknown.
        options: Settings of the person selection.
        T_world_camera: (4, 4) poses from a cell; they have priority over those of the log.
        clock_offset_s: Each camera's clock minus the reference camera's, from a cell [s].
        T_world_base: (4, 4) pose of the robot's base from a cell; it has priority over that of the log.

    Raises:
        LogError: The log is damaged beyond recovery.
    """
    header = log.header
    known, known_base = header.poses_beside(T_world_camera or {})
    base = known_base if T_world_base is None else T_world_base
    tallies = [_Tally() for _ in header.cameras]
    cell = T_world_camera or {}
    poses = {**known, **cell}
    person = _PersonInWorld(log, poses, clock_offset_s or {}, options)
    for seen in log.frames():
        _count(seen, tallies)
        person.add(seen)
    joint_topics, joint_notes = _joints(log, axes, frames)
    recorded = _recorded(log, joint_topics)
    cameras = tuple(
        _camera(name, tally, log, "the cell" if name in cell else "the log" if name in poses else "none")
        for name, tally in zip(header.cameras, tallies, strict=True)
    )
    bodies, agreements = person.checks.figures()
    return Summary(
        path=header.path,
        kind=header.kind,
        start_ns=header.start_ns,
        end_ns=header.end_ns,
        topics=tuple(TopicSummary(topic.name, topic.type, topic.count) for topic in log.topics),
        cameras=cameras,
        has_task=header.task is not None,
        base_from="none" if base is None else "in the log" if T_world_base is None else "in the cell",
        has_truth=header.has_truth,
        joints=joint_topics,
        recorded=recorded,
        defects=dict(log.defects),
        bodies=tuple(body for body in bodies if body.camera in poses),
        agreements=agreements,
        notes=(
            *log.notes,
            *_late(log, clock_offset_s or {}),
            *joint_notes,
            *person.checks.remarks(),
            *_strangers(header.cameras, cell),
        ),
        missing=tuple(_missing(log, cameras, joint_topics, has_base=base is not None)),
    )


def _late(log: Log, clock_offset_s: Mapping[str, float]) -> Iterator[str]:
    """Returns notes on cameras whose frames arrive long after their capture."""
    for name, clock in log.clocks.items():
        remark = late_remark(name, clock, clock_offset_s.get(name, 0.0))
        if remark is not None:
            yield remark


def _strangers(cameras: Sequence[str], cell: Mapping[str, Floats]) -> Iterator[str]:
    """Returns a note on each camera of a cell that the log lacks."""
    for name in sorted(set(cell) - set(cameras)):
        there = ", ".join(cameras) or "none"
        yield f"the cell's camera {name} is not in the log; its cameras are {there}; no other command takes such a cell"


class _PersonInWorld:
    """Collects the person in the world from the cameras with known poses."""

    def __init__(
        self, log: Log, poses: Mapping[str, Floats], clock_offset_s: Mapping[str, float], options: Logs
    ) -> None:
        cameras = log.header.cameras
        self.checks = CameraChecks(cameras)
        unknown = np.full((4, 4), np.nan)
        self._poses = np.array([poses.get(name, unknown) for name in cameras]).reshape(-1, 4, 4)
        self._offset_ns = np.array([round(1e9 * clock_offset_s.get(name, 0.0)) for name in cameras], dtype=np.int64)
        self._memory, self._options = PersonMemory(), options

    def add(self, frames: CameraFrames) -> None:
        jump_m, memory_s = self._options.person_jump_m, self._options.person_memory_s
        self._memory, which, _ = select_person(frames, self._memory, self._poses, jump_m, memory_s)
        mine = frames.rows(which)
        T = self._poses[mine.camera]
        points_m = np.einsum("nij,npj->npi", T[:, :3, :3], mine.points_m) + T[:, None, :3, 3]
        track = SkeletonTrack(mine.capture_ns - self._offset_ns[mine.camera], points_m, mine.confidence)
        self.checks.add(mine.camera, track)


def _joints(
    log: Log, axes: Sequence[str], frames: Sequence[AxisFrame]
) -> tuple[tuple[JointSummary, ...], tuple[str, ...]]:
    """Returns the topics of the robot's joints, and remarks on their reading or its failure."""
    states, reading = log.joint_states(), None
    notes: tuple[str, ...] = ()
    if axes:
        try:
            states = states or log.link_states(axes, frames)
            reading = log.read_joints(states, axes) if states else None
            notes = log.joint_notes
        except (LogError, SettingsError) as error:
            notes = (str(error).removeprefix(f"{log.header.path}: "),)
    clocks = {clock.topic: clock for clock in reading.clocks} if reading else {}
    sources = reading.sources if reading else {}
    return tuple(
        JointSummary(
            topic=topic.name,
            names=tuple(topic.joints),
            axes={name: axes.index(axis) + 1 for axis, (of, name) in sources.items() if of == topic.name},
            rate_hz=1.0 / joints.wait_s(topic, np.median),
            longest_gap_s=joints.wait_s(topic, np.max),
            clock=clocks.get(topic.name) or joints.place_in_time(topic, tuple(topic.joints), None, Counter())[0],
        )
        for topic in states
    ), notes


def _recorded(log: Log, joint_topics: Sequence[JointSummary]) -> str:
    """Describes the robot as recorded, and what can be asked of it; empty without one."""
    axes = sum(len(topic.axes) for topic in joint_topics)
    if axes:
        whose = "its motion" if log.header.task is None else "the task"
        return (
            f"by {axes} joints: report and compare say first if it was safe as it ran, and beside it what each "
            f"controller would have made of {whose}"
        )
    if not joint_topics and log.capsules_topic is not None:
        return (
            f"by capsules on {log.capsules_topic}: with a task for the robot of the settings, report and compare say "
            "first if it was safe as it ran"
        )
    return ""


def _count(frames: CameraFrames, tallies: list[_Tally]) -> None:
    rows = (frames.camera.tolist(), frames.capture_ns.tolist(), frames.arrival_ns.tolist(), frames.body.tolist())
    for camera, capture_ns, arrival_ns, body in zip(*rows, strict=True):
        tallies[camera].add(capture_ns, arrival_ns, body)


def _camera(name: str, tally: _Tally, log: Log, pose_from: str) -> CameraSummary:
    several = tally.frames > 1
    return CameraSummary(
        name=name,
        frames=tally.frames,
        rate_hz=1e9 / float(np.median(tally.periods_ns)) if several else float("nan"),
        first_ns=tally.first_ns,
        last_ns=tally.last_ns,
        longest_gap_s=tally.longest_ns / 1e9 if several else float("nan"),
        delay_s=_percentile_s(tally.delays_ns, 50.0),
        delay_p95_s=_percentile_s(tally.delays_ns, 95.0),
        delay_range_s=(_percentile_s(tally.delays_ns, 0.0), _percentile_s(tally.delays_ns, 100.0)),
        bodies=dict(sorted(tally.bodies.items())),
        pose_from=pose_from,
        stature_m=log.stature_m[name],
        side_cue=log.side_cue[name],
    )


def _percentile_s(values_ns: list[int], percent: float) -> float:
    return float(np.percentile(values_ns, percent)) / 1e9 if values_ns else float("nan")


def _missing(
    log: Log, cameras: tuple[CameraSummary, ...], joint_topics: tuple[JointSummary, ...], *, has_base: bool
) -> Iterator[str]:
    header = log.header
    if not cameras:
        yield f"skeletons: {log.skeletons_remedy[0].lower()}{log.skeletons_remedy[1:-1]}"
    for camera in cameras:
        if not camera.frames:
            yield f"frames of camera {camera.name}: it is named but delivers nothing"
        elif not camera.posed:
            yield f"extrinsics of camera {camera.name}: run hrcreplay calibrate, or give a cell file with --cell"
    if not has_base:
        yield "the robot's base pose: give a cell file with --cell"
    if header.task is None and not joint_topics:
        yield "the robot's task: name a task file with --set plan.task=FILE"


def as_json(summary: Summary) -> str:
    """Returns the summary as JSON: the fields of ``Summary``, null for unknown numbers, and the span in seconds."""
    return json.dumps(_plain(asdict(summary) | {"span_s": summary.span_s}), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    """Returns a value in types that JSON has."""
    if isinstance(value, dict):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, np.generic | np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def lines(summary: Summary) -> list[str]:
    """Returns the summary as plain text, one line per item."""
    begin = datetime.fromtimestamp(summary.start_ns / 1e9, tz=UTC).strftime("%Y-%m-%d %H:%M:%S")
    out = [
        f"{summary.path}",
        f"kind     {summary.kind}",
        f"span     {summary.span_s:.3f} s from {begin} UTC ({summary.start_ns} ns)",
        "topics",
    ]
    width = max((len(topic.name) for topic in summary.topics), default=0)
    out += [f"  {topic.name:<{width}}  {topic.messages:>8}  {topic.type}" for topic in summary.topics]
    out += ["cameras", *(_camera_line(camera, summary.start_ns) for camera in summary.cameras)]
    if not summary.cameras:
        out.append("  none")
    out += [
        f"task     {'in the log' if summary.has_task else 'none'}",
        f"base     {summary.base_from}",
        f"truth    {'in the log' if summary.has_truth else 'none'}",
        *(["joints", *map(_joint_line, summary.joints)] if summary.joints else ["joints   none"]),
        *([f"recorded {summary.recorded}"] if summary.recorded else []),
        f"person   {', '.join(_tall(camera) for camera in summary.cameras) or 'none'}",
    ]
    out += [f"sides    {', '.join(_sided(camera) for camera in summary.cameras) or 'none'}"]
    out += ["floor", *(f"  {body_line(body)}" for body in summary.bodies)] if summary.bodies else ["floor    not known"]
    out += ["agreement", *(f"  {line}" for line in agreement_lines(summary.agreements))] if summary.agreements else []
    delivered = {f"frames_{camera.name}" for camera in summary.cameras}  # counted with the defects, but not a defect
    found = {name: n for name, n in summary.defects.items() if n and name not in delivered}
    out += ["defects", *(f"  {name}  {n}" for name, n in found.items())] if found else ["defects  none"]
    if summary.notes:
        out += ["notes", *(f"  {note}" for note in summary.notes)]
    if summary.missing:
        out += ["missing for the next step", *(f"  {sentence}" for sentence in summary.missing)]
    return out


def _tall(camera: CameraSummary) -> str:
    tall = "of no bone" if np.isnan(camera.stature_m) else f"{camera.stature_m:.2f} m tall by the bones"
    return f"{tall} ({camera.name})"


def _sided(camera: CameraSummary) -> str:
    checked = f"checked as the {camera.side_cue}" if camera.side_cue else "not checked, no feet or bent knees seen"
    return f"left and right {checked} ({camera.name})"


def _joint_line(topic: JointSummary) -> str:
    names = ", ".join(f"{name} = axis {topic.axes[name]}" if name in topic.axes else name for name in topic.names[:20])
    more = f" and {len(topic.names) - 20} more" if len(topic.names) > 20 else ""
    median_ms, low_ms, high_ms = (1e3 * delay_s for delay_s in topic.clock.delay_s)
    shift = f" by {topic.clock.shift_s:.6g} s" if topic.clock.basis == "stamps, shifted" else ""
    return (
        f"  {topic.topic}: {names}{more}; {topic.rate_hz:.2f} Hz, longest gap {topic.longest_gap_s:.3f} s, arrival - "
        f"stamp {median_ms:.1f} ms (5 to 95 %: {low_ms:.1f} to {high_ms:.1f}), instants are {topic.clock.basis}{shift}"
    )


def _camera_line(camera: CameraSummary, start_ns: int) -> str:
    if camera.first_ns is None or camera.last_ns is None:
        return f"  {camera.name}: no frames"
    ids, (low_s, high_s) = list(camera.bodies), camera.delay_range_s
    bodies = ", ".join(str(body) for body in ids[:8]) + (f" and {len(ids) - 8} more" if len(ids) > 8 else "")
    return (
        f"  {camera.name}: {camera.frames} frames at {camera.rate_hz:.2f} Hz, "
        f"from {(camera.first_ns - start_ns) / 1e9:.3f} to {(camera.last_ns - start_ns) / 1e9:.3f} s, "
        f"longest gap {camera.longest_gap_s:.3f} s, delay {1e3 * camera.delay_s:.1f} ms "
        f"(95 % within {1e3 * camera.delay_p95_s:.1f}, range {1e3 * low_s:.1f} to {1e3 * high_s:.1f}), "
        f"bodies {bodies}, extrinsics {f'in {camera.pose_from}' if camera.posed else 'none'}"
    )
