"""The library: the steps of the commands as functions. ``import hrcreplay as hr`` gives all names in ``__all__``.

Every result holds numpy records; ``to_pandas()`` converts it to a DataFrame, with the columns of the tables in a run
folder (``store/columns.py``). Settings are passed as a nested mapping with the keys of a settings file:
``settings={"fusion": {"rate_hz": 250.0}}``.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
import pyarrow as pa

from hrcreplay.calibration.cell import Cell
from hrcreplay.commands import replay
from hrcreplay.commands.replay import demo_log
from hrcreplay.errors import SettingsError
from hrcreplay.geometry.inflated_hull import InflatedHull
from hrcreplay.logs.cleaning import Cleaner
from hrcreplay.logs.frame_table import frames_of_table, table_of_frames
from hrcreplay.logs.messages import RawSkeleton
from hrcreplay.logs.reader import Log
from hrcreplay.logs.reader import open_log as read_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.pipeline import assembly, reuse, stages
from hrcreplay.pipeline.person_fuser import PersonFuser
from hrcreplay.pipeline.planner import Planner
from hrcreplay.pipeline.run_config import RunConfig, resolve
from hrcreplay.pipeline.stages import Sink, Told, collect_fusion_findings, collect_plan_findings
from hrcreplay.pipeline.stored_volumes import StoredVolumes, store_every, store_volumes
from hrcreplay.pipeline.surroundings import Forecast, Surroundings
from hrcreplay.records import CameraFrames, Floats, HumanStates, Ints, Motion, SweptVolumes
from hrcreplay.robot.task import parse_task
from hrcreplay.settings.load import load_settings
from hrcreplay.settings.sections import Robot as RobotSettings
from hrcreplay.store.columns import motion_columns, occupancy_columns, state_columns
from hrcreplay.store.run_folder import RunWriter, Stopwatch, arrow_table, fill_optional
from hrcreplay.toml_file import read_toml

__all__ = [
    "Controller",
    "Fusion",
    "People",
    "Plan",
    "Recording",
    "Robot",
    "Volumes",
    "demo_log",
    "frames",
    "fuse",
    "load_task",
    "open_log",
    "plan",
    "predict",
    "report",
]

_BATCH = 250  # ticks; does not change the result
Settings = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Recording:
    """A log, with the cell and the settings that it is used with."""

    log: Log
    run_config: RunConfig
    _kept: Any = None  #: resources kept as long as the log is in use

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self.log.header.cameras

    @property
    def T_world_base(self) -> Floats | None:
        """(4, 4) pose of the robot's base in the world: from the cell file, else from the log; None if both lack it."""
        return assembly.known_robot_base(self.run_config, self.log)

    @property
    def task(self) -> dict[str, Any] | None:
        """The programmed task in the log, structured like a task file."""
        return self.run_config.task or self.log.header.task

    def camera_frames(self) -> Iterator[CameraFrames]:
        """Yields the cleaned frames in order of arrival, in chunks of at most 1 s."""
        return self.log.frames()

    def to_pandas(self) -> pd.DataFrame:
        """Returns the cleaned frames in the form that ``frames`` takes, one row per body and frame."""
        return table_of_frames(list(self.log.frames()), self.cameras)


def open_log(
    path: str | Path,
    *,
    cell: str | Path | None = None,
    config: str | Path | None = None,
    settings: Settings | None = None,
) -> Recording:
    """Opens an MCAP file, a ROS 1 bag or a ROS 2 bag.

    Args:
        path: The log.
        cell: Cell file: poses of cameras and robot; None: those in the log.
        config: Settings file (TOML), or the name of a shipped one: ``paper``.
        settings: Section -> key -> value; they override the file.

    Raises:
        LogError: The log is missing or cannot be read.
        SettingsError: A setting or the cell cannot be used.
    """
    run_config = resolve(
        "plan",
        Path(path),
        config=None if config is None else Path(config),
        cell_file=None if cell is None else Path(cell),
        given=settings,
    )
    return Recording(read_log(run_config.log, run_config.settings.logs), run_config)


def frames(
    table: pd.DataFrame,
    cameras: Mapping[str, Floats],
    *,
    T_world_base: Floats | None = None,
    task: Mapping[str, Any] | None = None,
    path: str | Path | None = None,
    **how: Any,
) -> Recording:
    """Makes a recording from a DataFrame with one row per body and frame.

    Args:
        table: Columns ``arrival_ns``, ``camera``, and per body point (``records.POINTS``) ``<point>_x``, ``_y``, ``_z``
            in the camera's frame [m]; NaN where a point was not observed. Optional: ``body``, needed with more than one
            body; ``capture_ns``, for frames with a transport delay; ``<point>_confidence`` in [0, 1].
        cameras: Camera -> its pose (4, 4) in the world, z up, floor at z = 0 [m].
        T_world_base: (4, 4) robot base in the world [m].
        task: The programmed task, structured like a task file.
        path: MCAP file to write the recording to; None: a temporary file, deleted with the recording.
        **how: ``cell``, ``config`` and ``settings``, as for ``open_log``.

    Raises:
        SettingsError: A column is missing, or names a camera without a pose.
    """
    found, folder = frames_of_table(table, tuple(cameras)), None
    if path is None:
        folder = tempfile.TemporaryDirectory(prefix="hrcreplay-")
        path = Path(folder.name) / "frames.mcap"
    file = Path(path)
    with LogWriter(file) as writer:
        for name, pose in cameras.items():
            writer.camera(name, pose)
        if task is not None:
            writer.task(dict(task))
        if T_world_base is not None:
            writer.base(T_world_base)
        writer.frames(found)
    return replace(open_log(file, **how), _kept=folder)


@dataclass(frozen=True)
class People:
    """The fused people, one row per tick and person, ordered by both; one row per tick if there was one person."""

    recording: Recording  #: with the span of the fused part
    states: HumanStates
    tables: dict[str, pa.Table] = field(default_factory=dict)  #: tables of a run folder with the results of stage 1
    told: Told = field(default_factory=lambda: Told(Counter(), ()))  #: counts and notes of stage 1

    def __len__(self) -> int:
        return len(self.states)

    def rows(self, which: slice | Ints) -> People:
        """Selects some rows."""
        return People(self.recording, self.states.rows(which))

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of all people, from 1."""
        return tuple(sorted(set(self.states.numbers.tolist())))

    def of_person(self, number: int) -> People:
        """The rows of one person, to predict this person alone; a plan needs all people."""
        return People(self.recording, self.states.of_person(number))

    def to_pandas(self) -> pd.DataFrame:
        """Returns the columns of state.parquet: angles and their derivatives, lengths, standard deviations."""
        return arrow_table(state_columns(self.states)).to_pandas()


def fuse(
    recording: Recording, *, start_s: float | None = None, end_s: float | None = None, smooth: bool | None = None
) -> People:
    """Stage 1: computes joint angles from the skeletons of all cameras and merges them by a Kalman filter.

    Args:
        recording: A log.
        start_s: Start of the span, from the log's first message [s]; None: its beginning.
        end_s: End of the span [s]; None: its end.
        smooth: True: also smooth the person; None: only if a report needs it, for a log without ground truth.

    Raises:
        LogError: The log shows no person, or a camera's pose is unknown.
    """
    log = recording.log
    run_config = replace(recording.run_config, start_s=start_s, end_s=end_s)
    ticks_ns = stages.span_ticks(run_config, log)
    found = _MemoryTables()
    sink = found.sink()
    stages.write_truth(log, int(ticks_ns[0]), int(ticks_ns[-1]), sink)
    smooth = not log.header.has_truth if smooth is None else smooth
    batches = stages.fuse_batches(log, ticks_ns, _BATCH, assembly.fusion_stage(run_config, log), sink, smooth=smooth)
    states = HumanStates.join(list(batches))
    return People(replace(recording, run_config=run_config), states, found.tables, collect_fusion_findings(log, sink))


@dataclass(frozen=True)
class Volumes:
    """The space that the person can reach within the horizon: ``volumes[tick][limb]`` is a hull plus a radius."""

    volumes: SweptVolumes
    horizon_s: float

    def __len__(self) -> int:
        return len(self.volumes)

    def __getitem__(self, tick: int) -> dict[str, InflatedHull]:
        """Limb -> its volume at a tick. A limb that cannot be predicted has one NaN vertex: no bound."""
        found = {}
        for limb, volume in self.volumes.at(tick).items():
            nothing = InflatedHull(volume.vertices_m, np.zeros((0, 3), np.int64), volume.radius_m)
            found[limb] = InflatedHull.around(*volume) if volume.known else nothing
        return found

    def to_pandas(self) -> pd.DataFrame:
        """Returns the columns of occupancy.parquet, one row per tick and known limb."""
        found = _MemoryTables()
        found.table("occupancy", occupancy_columns(np.zeros(0, np.int64), [], self.volumes.method, [], [], [], []))
        store_volumes([StoredVolumes(self.volumes, self.horizon_s)], found)
        return found.tables["occupancy"].to_pandas()


def predict(people: People, horizon_s: float | None = None, *, method: str | None = None) -> Volumes:
    """Stage 2: computes the space that the person can reach, as one convex swept volume per limb.

    Args:
        people: The fused person; a tick takes about 20 kB, so pass ``people.rows(...)`` for a long recording.
        horizon_s: Time after each tick until which the volumes hold; None: the robot's braking time T_s [s].
        method: ``sound``, ``paper`` or ``positions``; None: as in the settings.
    """
    stage = assembly.prediction_stage(people.recording.run_config)
    until_s = stage.horizon_s if horizon_s is None else horizon_s
    return Volumes(stage.volumes(people.states, until_s, method=method), until_s)


@dataclass(frozen=True)
class Robot:
    """A manipulator and the pose of its base."""

    settings: RobotSettings = field(default_factory=RobotSettings)
    T_world_base: Floats | None = None  #: (4, 4); None: from the cell file or the log

    @classmethod
    def from_urdf(cls, path: str | Path, T_world_base: Floats | None = None, **how: Any) -> Self:
        """Makes a robot from a URDF.

        Args:
            path: URDF; link capsules come from its collision shapes.
            T_world_base: (4, 4) pose of its base in the world [m].
            **how: Keys of the settings' section ``robot``, such as ``tcp_frame`` and ``tool_m``.

        Raises:
            SettingsError: A key or its value is unknown.
        """
        return cls(load_settings(given={"robot": {"urdf": str(path), **how}}).robot, T_world_base)

    @classmethod
    def irb140(cls, T_world_base: Floats | None = None, **how: Any) -> Self:
        """Makes the ABB IRB 140."""
        return cls(load_settings(given={"robot": how}).robot, T_world_base)


def load_task(path: str | Path) -> dict[str, Any]:
    """Reads the programmed task from a task file (TOML).

    Raises:
        SettingsError: The file cannot be read or holds no task.
    """
    table = read_toml(Path(path), "name a task file")
    parse_task(table, str(path))
    return table


@dataclass(frozen=True)
class Plan:
    """The robot's motion near the person, by the chosen method and its baselines."""

    run_config: RunConfig
    tables: dict[str, pa.Table]  #: tables of a run folder: motion, motion_<baseline>, occupancy
    told: Told

    def to_pandas(self, baseline: str | None = None) -> pd.DataFrame:
        """Returns the columns of motion.parquet of a method: positions, velocities, status, distances."""
        return self.tables["motion" if baseline is None else f"motion_{baseline}"].to_pandas()


def plan(
    people: People,
    robot: Robot | None = None,
    task: Mapping[str, Any] | None = None,
    *,
    method: str | None = None,
    baselines: Sequence[str] | None = None,
) -> Plan:
    """Stage 3: plans the robot's motion along its task, tick by tick, outside the space that the person can reach.

    Args:
        people: The fused person.
        robot: None: as in the settings.
        task: From ``load_task``; None: the task in the log, else its recorded joints.
        method: ``qp``, ``scaling``, ``shield``, ``ssm`` or ``none``; None: as in the settings.
        baselines: Methods to run for comparison; None: as in the settings.

    Raises:
        SettingsError: The robot, its base pose or the task is unknown or cannot be used.
    """
    run_config, log = _planned(people.recording.run_config, robot, task, method, baselines), people.recording.log
    found = _MemoryTables()
    sink = found.sink()
    model = assembly.robot(run_config, assembly.robot_base(run_config, log))
    programme = assembly.programme(run_config, log, model)
    sink.notes["plan"].extend(programme.notes)
    moved = assembly.followers(run_config, programme, int(people.states.t_ns[0]))
    sink.notes["plan"].extend(assembly.scene_notes(run_config, log, moved))
    ticks, first = people.states.ticks()
    edges = [int(first[i]) for i in range(0, len(ticks), _BATCH)] + [len(people)]
    batches = (people.states.rows(slice(begin, end)) for begin, end in pairwise(edges))
    around = assembly.surroundings(run_config, model)
    for _ in stages.plan_batches(batches, around, moved, store_every(run_config), sink):
        pass
    return Plan(run_config, found.tables, collect_plan_findings(log, sink))


def report(recording: Recording, people: People, motion: Plan, out: str | Path) -> Path:
    """Writes a run folder: all tables, metrics.json, figures and report.html, as ``hrcreplay report`` does.

    Args:
        recording: The log.
        people: From ``fuse``, all ticks.
        motion: From ``plan``.
        out: Folder to create.

    Raises:
        SettingsError: The folder exists or cannot be created, or the person or the motion lacks ticks.
    """
    if "state" not in people.tables or len(motion.tables["motion"]) != len(people.states.ticks()[0]):
        raise SettingsError("report: some ticks only; would be right: all ticks that fuse returned, and their plan")
    began = datetime.now(UTC)
    run_config, log = replace(motion.run_config, command="report"), recording.log
    with RunWriter(Path(out)) as writer:
        for name, table in (people.tables | motion.tables).items():
            writer.table(name, {column: table[column] for column in table.column_names})
        parts = reuse.dependencies(run_config, log, people.states.ticks()[0])
        found = replay.findings(run_config, {"fuse": people.told, "plan": motion.told})
        meta = {**run_config.meta(), **found, **replay.describe_run(run_config, began, parts, smooth=False)}
        replay.complete(run_config, log, writer, Stopwatch(time.perf_counter_ns), meta)
        return writer.folder


class Fusion:
    """Stage 1 tick by tick, for frames as they arrive. The states equal those of ``fuse`` bit for bit."""

    def __init__(self, recording: Recording) -> None:
        """Starts before the first frame, with the cameras, cell and settings of a recording."""
        self._cameras, run_config = recording.cameras, recording.run_config
        stage = assembly.fusion_stage(run_config, recording.log)
        self._fuser = PersonFuser(stage, self._cameras)
        self.counts = Counter[str]()  #: defects and events so far
        self._cleaner = Cleaner(
            self._cameras, run_config.settings.logs.gap_s, self.counts, nobody=stage.watched is not None
        )

    def update(self, found: CameraFrames | pd.DataFrame | None, t_ns: int) -> HumanStates:
        """Computes the fused people at a tick, as a table of one row per person; one row at least.

        Args:
            found: All frames that arrived after the previous tick and up to this one, in order and in the form that
                ``frames`` takes.
            t_ns: The tick, later than that of the last call [ns].
        """
        table = frames_of_table(found, self._cameras) if isinstance(found, pd.DataFrame) else found
        parts = [] if table is None else [part for part in self._clean(table) if part is not None]
        fused, seen = self._fuser.update(np.array([t_ns]), CameraFrames.join(parts) if parts else None)
        self.counts.update(seen.counts)
        self.counts.update(fused.counts)
        return fused.states

    def _clean(self, table: CameraFrames) -> Iterator[CameraFrames | None]:
        for i in range(len(table)):
            camera, capture_ns = self._cameras[table.camera[i]], int(table.capture_ns[i])
            row = RawSkeleton(capture_ns, camera, int(table.body[i]), table.points_m[i], table.confidence[i])
            yield self._cleaner.add(row, int(table.arrival_ns[i]))
        yield self._cleaner.flush()


class Controller:
    """Stages 2 and 3 tick by tick: the robot's next step near a person. The steps equal those of ``plan``."""

    def __init__(
        self,
        recording: Recording,
        robot: Robot | None = None,
        task: Mapping[str, Any] | None = None,
        *,
        method: str | None = None,
    ) -> None:
        """Starts at the beginning of the programme; the arguments are those of ``plan``."""
        self._run_config = _planned(recording.run_config, robot, task, method, ())
        self._log = recording.log
        self._started: tuple[Planner, Surroundings] | None = None

    def step(self, person: HumanStates) -> Motion:
        """Computes the robot's motion at a tick, one row.

        Args:
            person: The rows from ``Fusion.update``, one per person.
        """
        if self._started is None:
            robot = assembly.robot(self._run_config, assembly.robot_base(self._run_config, self._log))
            programme = assembly.programme(self._run_config, self._log, robot)
            (planner,) = assembly.planners(self._run_config, programme, int(person.t_ns[0])).values()
            self._started = planner, assembly.surroundings(self._run_config, robot)
        planner, around = self._started
        forecast = Forecast(around, person)
        return planner.follow(forecast.t_ns, forecast, around.names_of(int(person.numbers.max())))

    def to_pandas(self, steps: Sequence[Motion]) -> pd.DataFrame:
        """Returns the columns of motion.parquet for some of its steps."""
        motion = Motion.join(list(steps))
        planner = None if self._started is None else self._started[0]
        near = {} if planner is None else stages.nearest_columns(planner.robot, planner.static, motion)
        return arrow_table(motion_columns(motion) | near).to_pandas()


class _MemoryTables:
    """Keeps in memory the tables that a run folder would store."""

    def __init__(self) -> None:
        self.tables: dict[str, pa.Table] = {}

    def table(self, name: str, columns: Mapping[str, Any]) -> None:
        """Appends rows."""
        rows = arrow_table(columns)
        if name in self.tables:
            before = fill_optional(self.tables[name], rows.column_names)
            rows = pa.concat_tables([before, fill_optional(rows, before.column_names)])
        self.tables[name] = rows

    def sink(self) -> Sink:
        """Returns a sink that keeps all output of a stage and shows no progress."""
        return Sink(self, Stopwatch(time.perf_counter_ns), lambda _stage, _ticks: None)


def _planned(
    run_config: RunConfig,
    robot: Robot | None,
    task: Mapping[str, Any] | None,
    method: str | None,
    baselines: Sequence[str] | None,
) -> RunConfig:
    """Returns the run with another robot, task or method."""
    chosen = {"method": method, "baselines": None if baselines is None else list(baselines)}
    given = {"plan": {name: value for name, value in chosen.items() if value is not None}}
    settings, cell = load_settings(base=run_config.settings.model_dump(mode="json"), given=given), run_config.cell
    if robot is not None:
        settings = settings.model_copy(update={"robot": robot.settings})
        if robot.T_world_base is not None:
            cell = replace(cell or Cell(), T_world_base=np.asarray(robot.T_world_base, dtype=float))
    return replace(run_config, settings=settings, cell=cell, task=run_config.task if task is None else dict(task))
