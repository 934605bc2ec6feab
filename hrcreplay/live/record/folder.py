"""The run folder of a live session, which is made from its log after the session has ended or was killed."""

from __future__ import annotations

import shutil
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from hrcreplay.commands.report import write_report
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.evaluation.judging import write_contact
from hrcreplay.live import processes
from hrcreplay.live.control.setup import build_scene, run_config_of
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import PHASES
from hrcreplay.live.record.recorder import SessionLogReader
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.person_fuser import PersonFuser
from hrcreplay.pipeline.run_config import RunConfig
from hrcreplay.pipeline.stages import PeopleChecks, batches, nearest_columns
from hrcreplay.pipeline.stored_volumes import StoredVolumes, store_volumes
from hrcreplay.records import BODY, DOF, LENGTHS, POINTS, HumanStates, Ints, Motion, volume_name
from hrcreplay.robot.control.static_obstacles import StaticObstacles
from hrcreplay.robot.model import RobotModel
from hrcreplay.store import run_folder
from hrcreplay.store.columns import Columns, measurement_columns, motion_columns, state_columns
from hrcreplay.store.run_folder import RunWriter, TableWriter

_BATCH = TableWriter.ROWS


@dataclass
class SessionTables:
    """Writes the tables of state, occupancy and motion from messages; counts the messages, and keeps the events."""

    run: RunWriter
    cameras: tuple[str, ...]
    robot: RobotModel
    static: StaticObstacles | None  #: what the robot keeps clear of beside people
    limbs: tuple[str, ...]  #: limbs with a swept volume
    neighbours: tuple[str, ...]  #: volumes beside one person: limbs, then the sides of a watched area
    method: str  #: of the swept volumes
    counts: Counter[str] = field(default_factory=Counter)
    took_us: list[int] = field(default_factory=list)  #: duration of every reply
    events: list[dict[str, Any]] = field(default_factory=list)  #: all recorded events
    looks_ns: list[int] = field(default_factory=list)  #: instants of the perception updates [ns]
    remarks: list[str] = field(default_factory=list)  #: on the people
    _looks: list[codec.RecordedPerception] = field(default_factory=list)
    _answers: list[codec.RecordedDecision] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._links = tuple(segment.name for segment in self.robot.segments)

    def add(self, message: bytes) -> None:
        """Takes a message of the record."""
        kind = codec.kind(message)
        self.counts[_COUNTED[kind]] += 1
        if kind == codec.PERCEPTION:
            self._looks.append(codec.decode_perception(message))
            self.looks_ns.append(codec.clock_ns(message))
        elif kind == codec.VOLUMES:
            self._store(codec.decode_volumes(message, self.limbs, self.method))
        elif kind == codec.DECISION:
            self._answered(codec.decode_decision(message))
        elif kind == codec.EVENT:
            self.events.append(codec.decode_event(message))
        if max(len(self._looks), len(self._answers)) >= _BATCH:
            self.flush()

    def flush(self) -> None:
        """Writes the rows collected so far."""
        if self._looks:
            self.run.table("state", state_columns(_states(self._looks, self.cameras, self.run.partial)))
        if self._answers:
            motion, measured = self._motion()
            self.run.table(
                "motion", motion_columns(motion) | nearest_columns(self.robot, self.static, motion) | measured
            )
        self._looks, self._answers = [], []

    def _store(self, recorded: codec.RecordedVolumes) -> None:
        person = _persons(recorded.people)
        store_volumes([StoredVolumes(recorded.volumes, recorded.horizon_s, person)], self.run)

    def _motion(self) -> tuple[Motion, Columns]:
        """The motion of the answers, and the columns that only a live session has."""
        answers = self._answers
        rows = [answered.row for answered in answers if answered.row is not None]
        t_ns = np.array([answered.t_ns for answered in answers])
        reasons = ("", *sorted({row.reason for row in rows} - {""}))
        volumes = max(len(self.neighbours), *(row.limb + 1 for row in rows))
        limbs = tuple(volume_name(i, self.neighbours, self.limbs) for i in range(volumes))
        motion = Motion.of_rows(t_ns, rows, limbs=limbs, links=self._links, reasons=reasons)
        joints = np.array([answered.measured for answered in answers])
        measured = {f"q_measured{i + 1}": np.ascontiguousarray(q) for i, q in enumerate(joints.T)}
        return motion, {**measured, "phase": pa.array([PHASES[one.phase] for one in answers], type=pa.string())}

    def _answered(self, answered: codec.RecordedDecision) -> None:
        if answered.row is not None:  # otherwise there was no packet to answer
            self._answers.append(answered)
            self.took_us.append(answered.took_us)

    def timing(self) -> dict[str, Any]:
        """Quantiles of the time from a packet's arrival to its reply, in the format of timing.json."""
        took = np.array(self.took_us, dtype=np.float64)
        if not len(took):
            return {}
        shares = {"median_us": 0.5, "p99_us": 0.99, "p99_9_us": 0.999, "max_us": 1.0}
        found = {name: float(np.quantile(took, share)) for name, share in shares.items()}
        return {"reply": {"ticks": len(took), **found, "real_time_factor": None}}


_COUNTED = {
    codec.ROBOT: "robot_packets",
    codec.REPLY: "replies",
    codec.SKELETON: "skeletons",
    codec.PERCEPTION: "looks",
    codec.VOLUMES: "looks_with_volumes",
    codec.DECISION: "answers",
    codec.TIMEOUT: "silences",
    codec.EVENT: "events",
}


def _states(looks: list[codec.RecordedPerception], cameras: tuple[str, ...], where: Path) -> HumanStates:
    numbers = np.concatenate([look.state for look in looks])
    widths = dict.fromkeys(("p", "v", "a", "j", "p_std", "v_std"), DOF)
    widths |= dict.fromkeys(("lengths_m", "lengths_std_m"), len(LENGTHS))
    widths |= {"residual_m": len(BODY), "unseen_s": len(BODY), "frame_age_s": 1, "points_m": 3 * len(POINTS)}
    widths |= {"camera_points_m": 3 * len(POINTS) * len(cameras), "legs_sway_m": 1}
    watched = ("nobody_s", "nobody_else_s") if numbers.shape[1] == sum(widths.values()) + 2 else ()
    widths |= dict.fromkeys(watched, 1)
    ends = np.cumsum(list(widths.values()))
    if numbers.shape[1] != ends[-1]:
        raise LogError(
            f"{where}: found {numbers.shape[1]} numbers a look where this version has {ends[-1]}; "
            "would be right: the version of hrcreplay that recorded the session"
        )
    parts = dict(zip(widths, np.split(numbers, ends[:-1], axis=1), strict=True))
    for name in ("frame_age_s", "legs_sway_m", *watched):
        parts[name] = parts[name][:, 0]
    parts["points_m"] = parts["points_m"].reshape(len(numbers), len(POINTS), 3)
    parts["camera_points_m"] = parts["camera_points_m"].reshape(len(numbers), len(cameras), len(POINTS), 3)
    return HumanStates(
        t_ns=np.repeat([look.t_ns for look in looks], [len(look.people) for look in looks]),
        **parts,
        valid=np.concatenate([look.valid for look in looks]),
        cameras=cameras,
        person=_persons(np.concatenate([look.people for look in looks])),
    )


def _persons(numbers: Ints) -> Ints | None:
    """The numbers of people as records have them: None if person 1 is alone."""
    return numbers if (numbers != 1).any() else None


LOG = "log.mcap"
#: Note for a session that was killed, or whose recorder was killed.
NO_END = "the record has no end: how the robot came to rest after it is not on it"
_PARTIAL = ".partial"


def make_partial(out: Path) -> Path:
    """Makes the folder for a session's log; ``finish`` gives the folder its final name.

    Raises:
        SettingsError: The folder exists, or cannot be made.
    """
    return RunWriter(out).__enter__().partial  # no __exit__, so the record is always kept


def finish(partial: Path) -> Path:
    """Makes the run folder of a session that has ended or was killed.

    Returns:
        The run folder.

    Raises:
        SettingsError: The folder is no unfinished session, or the run folder exists already.
        LogError: The record cannot be read, or has no start event.
    """
    if partial.suffix != _PARTIAL or not (partial / LOG).is_file():
        raise SettingsError(f"{partial}: no session to be finished; those end in {_PARTIAL} and hold {LOG}")
    writer = RunWriter(partial.with_name(partial.name.removesuffix(_PARTIAL)))
    if writer.folder.exists():
        raise SettingsError(f"{writer.folder}: exists already; move it away, then finish {partial}")
    log = SessionLogReader(partial / LOG)
    start = log.start()
    run_config = run_config_of(start, writer.folder / LOG, run_folder.sha256(partial / LOG))
    cameras, limbs, neighbours = (tuple(start[name]) for name in ("cameras", "limbs", "neighbours"))
    robot, _, static = build_scene(start)
    tables = SessionTables(writer, cameras, robot, static, limbs, neighbours, start["method"])
    for message in log.messages():
        tables.add(message)
    tables.flush()
    tables.remarks = _measure(run_config, writer, np.array(tables.looks_ns, dtype=np.int64))
    writer.close_tables()
    crashes = processes.read_crashes(partial)
    meta = _meta(run_config, start, tables, log, crashes)
    if tables.counts["looks"] and tables.counts["answers"]:
        _compare(run_config, writer, start)
    write_report(run_config, writer, meta)
    writer.timing.update(tables.timing())
    writer.finish(meta, complete=not crashes)
    return writer.folder


def keep_incomplete(partial: Path, crashes: list[str]) -> None:
    """Reduces a session without a run folder to its log and its crash files, and marks it in run.json."""
    for path in sorted(partial.iterdir()):
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != LOG and not path.name.startswith(processes.PREFIX):
            path.unlink()
    found = _crashed(crashes) | {"command": "live", "complete": False}
    if _breaks_off(partial / LOG):
        found["notes"] = [NO_END]
    with suppress(OSError):  # full disk: the log itself shows that it has no end
        (partial / "run.json").write_text(run_folder.to_json(found))


def _breaks_off(log: Path) -> bool:
    """Return whether a record exists and has no end event."""
    if not log.exists():
        return False
    try:
        events = [codec.decode_event(m) for m in SessionLogReader(log).messages() if codec.kind(m) == codec.EVENT]
    except (LogError, OSError):
        return True
    return not any(event.get("what") == "end" for event in events)


def _crashed(crashes: list[str]) -> dict[str, Any]:
    """Entries of run.json about crashes."""
    return {"crashes": crashes, "reason": crashes[0]} if crashes else {}


def _measure(run_config: RunConfig, writer: RunWriter, looks_ns: Ints) -> list[str]:
    """Writes the table of measurements, one row per frame and person; returns notes on several people.

    Args:
        run_config: The run.
        writer: The run folder.
        looks_ns: (n,) instants of the perception updates [ns].
    """
    log = open_log(writer.partial / LOG, run_config.settings.logs, skeletons=False)
    stage, cameras = assembly.fusion_stage(run_config, log), log.header.cameras
    fuser, checks = PersonFuser(stage, cameras), PeopleChecks(cameras)
    for ticks, frames in batches(log.frames(nobody=stage.watched is not None), looks_ns, _BATCH):
        _, seen = fuser.update(ticks, frames)
        if frames is not None:
            writer.table("measurements", measurement_columns(seen.measured))
            checks.add(seen.measured)
    return list(checks.describe())


def _compare(run_config: RunConfig, writer: RunWriter, start: dict[str, Any]) -> None:
    """Writes the table of contact between the robot and the recorded person."""
    log = open_log(writer.partial / LOG, run_config.settings.logs, skeletons=False)
    write_contact(run_config, log, writer, np.array(start["T_world_base"]))


def _meta(
    run_config: RunConfig, start: dict[str, Any], tables: SessionTables, log: SessionLogReader, crashes: list[str]
) -> dict[str, Any]:
    """run.json of the session."""
    end: dict[str, Any] = next((event for event in tables.events if event.get("what") == "end"), {})
    notes = [str(event["text"]) for event in tables.events if event.get("what") == "note"]
    notes += [f"{LOG}: {flaw}" for flaw in log.flaws]
    notes += [*tables.remarks, *(f"not complete: {line}" for line in crashes)]
    if not end:
        notes.append(NO_END)
    counts = {name.replace(" ", "_"): int(count) for name, count in end.get("counts", {}).items()}
    counts |= dict(tables.counts) | {"messages_dropped": int(end.get("dropped", 0))}
    counts |= {"looks_skipped": int(end.get("looks_skipped", 0))}
    return {
        **run_config.meta(),
        "versions": start["versions"],
        "machine": start.get("machine"),  # the machine of the session, not of this process
        "inputs": [{"path": LOG, "sha256": run_config.log_sha256}],  # a relative path, so the folder can be moved
        "stages": {},  # a replay of the log has other ticks, so it reuses no results
        "T_world_base": start["T_world_base"],
        "sending": start["sending"],
        "created": f"{datetime.fromtimestamp(log.first_ns // 10**9, UTC):%Y-%m-%dT%H:%M:%SZ}",
        "stops": end.get("stops", []),
        "reason": end.get("reason"),
        "counts": dict(sorted(counts.items())),
        "notes": notes,
        **_crashed(crashes),
    }
