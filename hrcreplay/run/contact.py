"""The person as recorded, and the robot against them: a row a tick and method in contact.parquet.

The links' capsules at the commanded joint positions, and the recorded body's capsules: neither knows of predictions.
Where they overlap while the robot moves, the row also says whether the part of the body that is touched was inside the
volume by which the motion had been certified: then the robot is at fault, else the prediction.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from hrcreplay.geometry.distances import nearest_pair, protrusion_m
from hrcreplay.human.fusion import fuse
from hrcreplay.human.model import LEG_PARTS, PARTS, part_axes, part_radii, skeleton
from hrcreplay.logs.clean import PersonMemory
from hrcreplay.logs.reader import Log
from hrcreplay.records import Bools, Floats, HumanStates, Ints
from hrcreplay.report.metrics_contact import deciding_rows
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.robot.model import RobotModel
from hrcreplay.run import build, stages
from hrcreplay.run.build import PredictionStage
from hrcreplay.run.job import Job
from hrcreplay.store.columns import Columns, body_columns, contact_columns, read_states, state_columns
from hrcreplay.store.run_folder import RunWriter

#: Between samples of the recorded person further apart nothing is known [s].
GAP_S = 0.1
_TICKS = 4096


@dataclass(frozen=True)
class RecordedPerson:
    """Body points over time, from one source."""

    source: str  #: "truth", or "smoothed"
    t_ns: Ints  #: (n,) increasing
    points_m: Floats  #: (n, 20, 3) POINTS, world [m]; NaN where they are not known

    def part_axes(self, at_ns: Ints, hand_m: float) -> Floats:
        """(m, 10, 2, 3) axes of the capsules of ``PARTS`` at some instants [m]."""
        points_m = at_instants(self.t_ns, self.points_m, at_ns, GAP_S)
        return part_axes(points_m, hand_m)


def at_instants(t_ns: Ints, points_m: Floats, at_ns: Ints, gap_s: float) -> Floats:
    """Body points between the two samples around each instant, linear.

    Args:
        t_ns: (n,) instants of the samples, increasing [ns].
        points_m: (n, 20, 3) samples, world [m].
        at_ns: (m,) instants asked for [ns].
        gap_s: Between samples further apart nothing is known [s].

    Returns:
        (m, 20, 3); NaN outside the samples, in a gap, and where one of the two samples lacks the point. An instant
        that meets a sample gets that sample.
    """
    found = np.full((len(at_ns), *points_m.shape[1:]), np.nan)
    if not len(t_ns):
        return found
    right = np.searchsorted(t_ns, at_ns, side="left")
    inside = (at_ns >= t_ns[0]) & (at_ns <= t_ns[-1])
    right = np.clip(right, 0, len(t_ns) - 1)
    met = inside & (t_ns[right] == at_ns)
    found[met] = points_m[right[met]]
    left = np.maximum(right - 1, 0)
    step_ns = t_ns[right] - t_ns[left]
    between = inside & ~met & (step_ns > 0) & (step_ns * 1e-9 <= gap_s)
    share = ((at_ns - t_ns[left])[between] / step_ns[between])[:, None, None]
    found[between] = (1.0 - share) * points_m[left[between]] + share * points_m[right[between]]
    return found


def recorded_person(job: Job, log: Log, writer: RunWriter) -> RecordedPerson:
    """The person of a run. Without ground truth and smooth.parquet the log is fused again, and smooth.parquet written.

    Args:
        job: What was asked for.
        log: Log of the job.
        writer: Run folder, its tables complete.
    """
    if log.header.has_truth:
        parts = list(log.truth())
        t_ns, first = np.unique(np.concatenate([part.t_ns for part in parts]), return_index=True)
        return RecordedPerson("truth", t_ns, np.concatenate([part.points_m for part in parts])[first])
    path = writer.partial / "smooth.parquet"
    if path.exists():
        states = HumanStates.join(list(read_states(path, _TICKS)))
    else:
        states = _smoothed(job, log, _ticks_of(writer))
        writer.table("smooth", state_columns(states))
    return from_states(states, job.settings.fusion.memory_s)


def from_states(states: HumanStates, memory_s: float) -> RecordedPerson:
    """The smoothed person, but for where no camera saw them: there is nothing to smooth.

    Args:
        states: The smoothed states.
        memory_s: Between two ticks that used a camera further apart than this, nothing is known [s].
    """
    points_m = skeleton(states.p, states.lengths_m)
    points_m[~_seen(states, memory_s)] = np.nan
    return RecordedPerson("smoothed", states.t_ns, points_m)


def _seen(states: HumanStates, memory_s: float) -> Bools:
    """(n,) ticks that lie between two ticks with a camera not further apart than ``memory_s`` [s], both included."""
    used = np.flatnonzero(states.valid.any(axis=1))
    if not len(used):
        return np.zeros(len(states), dtype=np.bool_)
    ticks = np.arange(len(states))
    before = used[np.maximum(np.searchsorted(used, ticks, side="right") - 1, 0)]
    after = used[np.minimum(np.searchsorted(used, ticks, side="left"), len(used) - 1)]
    apart_s = (states.t_ns[after] - states.t_ns[before]) * 1e-9
    return np.asarray((before <= ticks) & (ticks <= after) & (apart_s <= memory_s))


def _ticks_of(writer: RunWriter) -> Ints:
    """The ticks of the fused person."""
    return np.concatenate([states.t_ns for states in read_states(writer.partial / "state.parquet", _TICKS)])


def _smoothed(job: Job, log: Log, ticks_ns: Ints) -> HumanStates:
    """The person fused and smoothed, where the stage was not run or was taken over."""
    fusion_stage, cameras = build.fusion_stage(job, log), log.header.cameras
    state, memory = fuse.start(cameras), PersonMemory()
    passed = []
    for ticks, seen in stages.batches(log.frames(int(ticks_ns[0]), int(ticks_ns[-1]) + 1), ticks_ns, _TICKS):
        measured = stages.no_frames(cameras)
        if seen is not None:
            memory, measured, _ = fusion_stage.measure(seen, memory)
        state, states, _, trace = fuse.fuse(
            state, ticks, measured, fusion_stage.filter, fusion_stage.limits, traced=True
        )
        passed.append((states, trace))
    return stages.smoothed(passed, fusion_stage.filter)


#: Part of the body -> limb whose volume it has to be in.
VOLUME_OF = {part: "LEGS" if part in LEG_PARTS else part for part in PARTS}

#: Of the ticks until a horizon, the last and one in so many are looked at: people do not tremble that fast.
_EVERY = 4

#: Rows of body.parquet a second, for those who draw it.
_BODY_HZ = 25.0

#: Limb -> vertices (m, 3) and radius of the volume around them [m].
Volumes = Mapping[str, tuple[Floats, float]]


def write_contact(job: Job, log: Log, writer: RunWriter, T_world_base: Floats) -> None:
    """Writes contact.parquet for every motion table of a run.

    Args:
        job: What was asked for.
        log: Log of the job.
        writer: Run folder, its tables complete.
        T_world_base: (4, 4) robot base in the world.
    """
    robot, occupancy = build.robot(job, T_world_base), job.settings.occupancy
    person = recorded_person(job, log, writer)
    predicted = Predicted(build.prediction_stage(job), writer.partial / "state.parquet")
    chosen = job.settings.plan.method
    for path in sorted(writer.partial.glob("motion*.parquet")):
        method = path.stem.removeprefix("motion").removeprefix("_") or chosen
        motion = pq.read_table(path).to_pandas()
        volumes: Iterator[tuple[int, float, Volumes]] = iter(())
        if path.stem == "motion":
            volumes = stored_volumes(writer, occupancy.stop_s)
            shown_ns = motion["t_ns"].to_numpy()[:: max(1, round(job.settings.fusion.rate_hz / _BODY_HZ))]
            writer.table("body", body_columns(shown_ns, person.part_axes(shown_ns, occupancy.hand_m), PARTS))
        writer.table("contact", contact_table(job, robot, method, motion, person, predicted, volumes))
    writer.close_tables()


def contact_table(
    job: Job,
    robot: RobotModel,
    method: str,
    motion: pd.DataFrame,
    person: RecordedPerson,
    predicted: Predicted,
    volumes: Iterator[tuple[int, float, Volumes]],
    lines_m: float | None = None,
) -> Columns:
    """The rows of contact.parquet for one motion.

    Args:
        job: What was asked for.
        robot: At its place in the world.
        method: That made the motion.
        motion: Rows of a motion table.
        person: As recorded.
        predicted: Volumes of any tick.
        volumes: Instant [ns], horizon [s] and volumes of the ticks at which the person may be found to have left them.
        lines_m: None: the parts with their radii leave them; else their lines, with a hand of this length [m].
    """
    radii_m = part_radii(job.settings.occupancy, job.settings.report.leg_radius_m)
    t_ns = motion["t_ns"].to_numpy()
    body = Body(person.source, person.part_axes(t_ns, job.settings.occupancy.hand_m), radii_m)
    found = compare(robot, motion, body)
    if method != "none":
        found.by_volume_m[:] = by_volume(motion, found, body, predicted)
    if lines_m is not None:
        body = Body(person.source, person.part_axes(t_ns, lines_m), np.zeros(len(radii_m)))
    mark_left(found, t_ns, body, volumes)
    return _columns(motion, method, body.source, found, tuple(segment.name for segment in robot.segments))


@dataclass(frozen=True)
class Body:
    """The recorded person's capsules at the ticks of a motion."""

    source: str  #: as ``RecordedPerson`` has it
    axes_m: Floats  #: (n, 10, 2, 3) of PARTS, world [m]; NaN where not known
    radius_m: Floats  #: (10,) [m]


@dataclass(frozen=True)
class Contact:
    """What is nearest between robot and body, a row a tick."""

    distance_m: Floats  #: (n,) surface to surface, negative in overlap; NaN where the body is not known [m]
    link: Ints  #: (n,) index into the robot's segments; -1 where the body is not known
    part: Ints  #: (n,) index into PARTS; -1 likewise
    moving: Bools  #: (n,) whether any axis turns
    speed: Floats  #: (n,) of the link's surface where it is nearest to the body [m/s]
    #: (n,) how far the part was outside the volume by which the motion had been certified, negative inside; NaN where
    #: robot and body do not overlap, the robot stands, or nothing was predicted [m]
    by_volume_m: Floats
    #: (n,) how far, at most, a part left the stored volume of this tick until its horizon; NaN without one [m]
    left_m: Floats
    left_part: Ints  #: (n,) index into PARTS of that part; -1 without one


def _columns(motion: pd.DataFrame, method: str, person: str, found: Contact, links: tuple[str, ...]) -> Columns:
    return contact_columns(
        t_ns=motion["t_ns"].to_numpy(),
        method=method,
        person=person,
        moving=found.moving,
        distance_m=found.distance_m,
        part=(found.part, PARTS),
        link=(found.link, links),
        speeds=(motion["tcp_speed"].to_numpy(dtype=float), found.speed),
        outside_m=found.by_volume_m,
        left=(found.left_m, found.left_part, PARTS),
    )


def compare(robot: RobotModel, motion: pd.DataFrame, body: Body) -> Contact:
    """The distance between robot and body at every tick of a motion.

    Args:
        robot: The manipulator.
        motion: Rows of a motion table.
        body: At the same ticks.
    """
    q, dq = (motion[[f"{name}{i + 1}" for i in range(robot.nv)]].to_numpy(dtype=float) for name in ("q", "dq"))
    links = robot.link_motion(q, dq)
    radius_m = np.array([segment.radius_m for segment in robot.segments])
    pair = nearest_pair(links.ends_m, radius_m, body.axes_m, body.radius_m)
    apart = pair.at_second_m - pair.at_first_m
    length = np.linalg.norm(apart, axis=1, keepdims=True)
    towards = apart / np.where(length > 0.0, length, np.inf)  # on the axis itself where the axes cross
    at_m = pair.at_first_m + radius_m[pair.first][:, None] * towards
    nothing = np.full(len(motion), np.nan)
    moving = np.asarray((dq != 0.0).any(axis=1))
    return Contact(
        pair.distance_m,
        pair.first,
        pair.second,
        moving,
        links.speed(pair.first, at_m),
        nothing,
        nothing.copy(),
        np.full(len(motion), -1),
    )


@dataclass
class Predicted:
    """The volumes of any tick at any horizon, predicted again from the fused person."""

    stage: PredictionStage
    states: Path  #: state.parquet
    _states: HumanStates | None = field(default=None, init=False)

    def volumes(self, t_ns: int, horizon_s: float) -> Volumes:
        """Those of the last state that is not later than ``t_ns``; none where the person was not known."""
        if self._states is None:
            self._states = HumanStates.join(list(read_states(self.states, 4096)))
        row = int(np.searchsorted(self._states.t_ns, t_ns, side="right")) - 1
        if row < 0:
            return {}
        volumes = self.stage.volumes(self._states.rows(slice(row, row + 1)), horizon_s)
        return solids(obstacles(volumes, 0), volumes.limbs)


def solids(around: Obstacles, limbs: tuple[str, ...]) -> Volumes:
    """Limb -> vertices and radius, of those of one tick that are known."""
    found = {
        limb: (around.vertices_m[around.offsets[i] : around.offsets[i + 1]], float(around.radius_m[i]))
        for i, limb in enumerate(limbs)
    }
    return {limb: solid for limb, solid in found.items() if np.isfinite(solid[0]).all() and np.isfinite(solid[1])}


def by_volume(motion: pd.DataFrame, found: Contact, body: Body, predicted: Predicted) -> Floats:
    """``Contact.by_volume_m``.

    The volumes of the tick at which it was decided what moves the robot hold until the stop that was found clear of
    them has ended.

    Args:
        motion: Rows of a motion table.
        found: Distances at the same ticks.
        body: At the same ticks.
        predicted: Volumes of any tick.
    """
    outside_m = np.full(len(motion), np.nan)
    t_ns, horizon_s = motion["t_ns"].to_numpy(), motion["horizon_s"].to_numpy(dtype=float)
    decided = deciding_rows(motion)
    volumes: Volumes = {}
    last = -1
    for i in np.flatnonzero(found.moving & (found.distance_m <= 0.0)).tolist():
        k = int(decided[i])
        if k < 0:
            continue
        if k != last:
            volumes, last = predicted.volumes(int(t_ns[k]), float(horizon_s[k])), k
        part = int(found.part[i])
        solid = volumes.get(VOLUME_OF[PARTS[part]])
        if solid is not None:
            outside_m[i] = protrusion_m(body.axes_m[i : i + 1, part], float(body.radius_m[part]), *solid)[0]
    return outside_m


def stored_volumes(writer: RunWriter, stop_s: float) -> Iterator[tuple[int, float, Volumes]]:
    """The volumes of occupancy.parquet, tick by tick: instant [ns], horizon [s], volumes."""
    path = writer.partial / "occupancy.parquet"
    if not path.exists():
        return
    table = pq.read_table(path)
    t_ns, radius_m, limbs = table["t_ns"].to_numpy(), table["radius_m"].to_numpy(), table["limb"].to_pylist()
    stored = "horizon_s" in table.column_names
    horizon_s = table["horizon_s"].to_numpy() if stored else np.full(len(t_ns), stop_s)
    vertices = table["vertices"].combine_chunks()
    ends, numbers = vertices.offsets.to_numpy(), vertices.values.to_numpy()
    starts = np.flatnonzero(np.diff(t_ns, prepend=t_ns[:1] - 1))
    for first, last in zip(starts, [*starts[1:], len(t_ns)], strict=True):
        rows = range(first, last)
        solids = {limbs[i]: (numbers[ends[i] : ends[i + 1]].reshape(-1, 3), float(radius_m[i])) for i in rows}
        yield int(t_ns[first]), float(horizon_s[first]), solids


def mark_left(found: Contact, t_ns: Ints, body: Body, volumes: Iterator[tuple[int, float, Volumes]]) -> None:
    """Writes ``left_m`` and ``left_part`` of a contact.

    Args:
        found: Its rows are the ticks.
        t_ns: (n,) ticks of the motion [ns].
        body: At the same ticks.
        volumes: Instant [ns], horizon [s] and volumes of the stored ticks.
    """
    for at_ns, horizon_s, solids in volumes:
        first = int(np.searchsorted(t_ns, at_ns, side="left"))
        last = int(np.searchsorted(t_ns, at_ns + round(horizon_s * 1e9), side="right"))
        if first >= last:
            continue
        ticks = np.unique(np.append(np.arange(first, last, _EVERY), last - 1))
        for part, name in enumerate(PARTS):
            axes_m = body.axes_m[ticks, part]
            axes_m = axes_m[np.isfinite(axes_m).all(axis=(1, 2))]
            if VOLUME_OF[name] not in solids or not len(axes_m):
                continue
            out_m = float(protrusion_m(axes_m, float(body.radius_m[part]), *solids[VOLUME_OF[name]]).max())
            if not out_m <= found.left_m[first]:  # the first one meets NaN
                found.left_m[first], found.left_part[first] = out_m, part
