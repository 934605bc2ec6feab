"""The three stages as generators over batches of ticks. Each passes its rows on to the next and writes its tables."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from hrcreplay.calibration.clock_check import ClockCheck
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.human.fusion import inverse_kinematics, vacancy
from hrcreplay.human.fusion.disbelief import disbelieved
from hrcreplay.logs.camera_checks import CameraChecks
from hrcreplay.logs.clocks import delay_text
from hrcreplay.logs.reader import Log
from hrcreplay.pipeline.assembly import Follower
from hrcreplay.pipeline.fusion_stage import FusionStage
from hrcreplay.pipeline.people_smoother import PeopleSmoother
from hrcreplay.pipeline.person_fuser import PersonFuser
from hrcreplay.pipeline.run_config import RunConfig
from hrcreplay.pipeline.seen_bodies import SeenBodies
from hrcreplay.pipeline.stored_volumes import StoredVolumes, select_stored_ticks, store_ticks, store_volumes
from hrcreplay.pipeline.surroundings import Forecast, PredictionStage, Surroundings
from hrcreplay.records import NOBODY, CameraFrames, Floats, HumanStates, Ints, Measurements, Motion, SkeletonTrack
from hrcreplay.robot.control.static_obstacles import StaticObstacles, nearest
from hrcreplay.robot.model import RobotModel
from hrcreplay.store.columns import (
    measurement_columns,
    motion_columns,
    record_columns,
    state_columns,
    static_columns,
    truth_columns,
)
from hrcreplay.store.run_folder import Stopwatch, Tables, TableWriter

NS = 1_000_000_000
#: Prefixes of the names of counters for defective points and lost bodies.
_LOST = (
    "points_",
    "person_frames_without",
    "frames_late",
    "frames_repeated",
    "frames_trembling",
    "frames_out_of_order",
)

#: Maximum length of a session; a longer log contains an arrival time from another clock [s].
LONGEST_S = 24 * 3600


class Told(NamedTuple):
    """Counts and notes of a stage."""

    counts: Counter[str]
    notes: tuple[str, ...]


@dataclass
class Sink:
    """Output of the stages: tables, times, progress, counters and notes."""

    tables: Tables
    watch: Stopwatch
    progress: Callable[[str, int], None]  #: stage, ticks done
    counts: Counter[str] = field(default_factory=Counter)
    notes: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))  #: stage -> notes on it
    seen: SeenBodies | None = None  #: receives the bodies that cameras show; None: they are not asked for


def collect_fusion_findings(log: Log, sink: Sink) -> Told:
    """Collects findings of the latest pass over a log's frames and of stage 1, in files, frames and person."""
    return Told(log.defects - log.joint_defects + sink.counts, (*log.notes, *sink.notes["fuse"]))


def collect_plan_findings(log: Log, sink: Sink) -> Told:
    """Collects findings of the latest reading of a log's joints and of stage 3."""
    return Told(log.joint_defects, tuple(sink.notes["plan"]))


def tick_times(start_ns: int, end_ns: int, rate_hz: float) -> Ints:
    """Returns (n,) tick times: from the first instant on, at the filter's rate, none after the last [ns].

    Raises:
        LogError: The span is longer than any session, so a message has a wrong arrival time.
    """
    if end_ns - start_ns > LONGEST_S * NS:
        raise LogError(
            f"arrivals: the log goes on for {(end_ns - start_ns) / (3600 * NS):.0f} h from its first message to its "
            f"last; would be right: at most {LONGEST_S // 3600} h, as a span with --start and --end"
        )
    count = int((end_ns - start_ns) * rate_hz / NS) + 1
    ticks: Ints = start_ns + np.round(np.arange(count) * (NS / rate_hz)).astype(np.int64)
    return ticks[ticks <= end_ns]


def span_ns(run_config: RunConfig, log: Log) -> tuple[int, int]:
    """Begin and end of a run, as the command line and the log have them; the end may be before the begin [ns]."""
    first, last = log.header.start_ns, log.header.end_ns
    end_ns = last if run_config.end_s is None else min(last, first + round(run_config.end_s * NS))
    return first + round((run_config.start_s or 0.0) * NS), end_ns


def span_ticks(run_config: RunConfig, log: Log) -> Ints:
    """(n,) ticks of a run [ns].

    Args:
        run_config: The run.
        log: Its log.

    Raises:
        LogError: The log holds a single instant.
        SettingsError: Nothing of the log is between begin and end.
    """
    first, last = log.header.start_ns, log.header.end_ns
    if first == last:
        raise LogError(f"{run_config.log}: holds a single instant; would be right: two frames or more")
    start_ns, end_ns = span_ns(run_config, log)
    if not first <= start_ns < end_ns:
        option = (
            f"--start {run_config.start_s:g}" if run_config.start_s is not None else f"--end {run_config.end_s or 0:g}"
        )
        raise SettingsError(f"{option}: nothing of the log is left; it lasts {(last - first) / NS:.1f} s")
    return tick_times(start_ns, end_ns, run_config.settings.fusion.rate_hz)


def batches(frames: Iterator[CameraFrames], ticks_ns: Ints, size: int) -> Iterator[tuple[Ints, CameraFrames | None]]:
    """Yields batches of ticks, each with the frames that arrived after the previous batch and up to its last tick."""
    waiting: list[CameraFrames] = []
    arrived_ns = -1
    for first in range(0, len(ticks_ns), size):
        ticks = ticks_ns[first : first + size]
        while arrived_ns <= ticks[-1] and (chunk := next(frames, None)) is not None:
            waiting.append(chunk)
            arrived_ns = int(chunk.arrival_ns[-1])
        due = None
        if waiting:
            table = CameraFrames.join(waiting)
            count = int(np.searchsorted(table.arrival_ns, ticks[-1], side="right"))
            due = table.rows(slice(0, count)) if count else None
            waiting = [table.rows(slice(count, None))] if count < len(table) else []
        yield ticks, due


def fuse_batches(
    log: Log,
    ticks_ns: Ints,
    size: int,
    fusion_stage: FusionStage,
    sink: Sink,
    *,
    smooth: bool = False,
    store: bool = True,
) -> Iterator[HumanStates]:
    """Stage 1: camera frames to the fused person; writes measurements and state and, if requested, ``smooth``.

    Args:
        log: Log to read.
        ticks_ns: (n,) ticks, increasing [ns].
        size: Ticks of a batch.
        fusion_stage: Cameras and settings of the stage.
        sink: Receives rows, counts and times.
        smooth: True: write the smoothed person at the end.
        store: False: the second process writes state.

    Raises:
        LogError: At the end: the log certainly shows no person, or no person was ever seen.
    """
    fuser = PersonFuser(fusion_stage, log.header.cameras, traced=smooth)
    watched = fusion_stage.watched is not None
    frames = log.frames(int(ticks_ns[0]), int(ticks_ns[-1]) + 1, nobody=watched)
    people = PeopleSmoother(fusion_stage.filter)
    checks = PeopleChecks(log.header.cameras)
    clocks = ClockCheck(log.header.cameras, fusion_stage.T_world_camera, int(ticks_ns[0]), int(ticks_ns[-1]))
    ever = False
    for ticks, seen in batches(frames, ticks_ns, size):
        with sink.watch.stage("angles", len(ticks)):
            sightings = fuser.measure(seen)
        if seen is not None:
            clocks.add(fusion_stage.on_one_clock(seen.rows(seen.body != NOBODY)))
        with sink.watch.stage("fuse", len(ticks)):
            (states, events, trace), sightings = fuser.advance(ticks, sightings)
        if seen is not None:
            sink.tables.table("measurements", measurement_columns(sightings.measured))
            checks.add(sightings.measured)
            if sink.seen is not None:
                sink.seen.add(sightings)
        if smooth:
            _write_smoothed(people.add(states, trace), sink)
        sink.counts.update(sightings.counts)
        sink.counts.update(events)
        ever = ever or bool(states.valid.any()) or max(fuser.area.vacant_ns) >= 0
        if store:
            sink.tables.table("state", state_columns(states))
        sink.progress("fuse", len(ticks))
        yield states
    log.check()
    if not ever:
        raise _nobody(log, sink.counts)
    with sink.watch.stage("clocks", len(ticks_ns)):
        sink.notes["fuse"].extend(clocks.remarks())
    _note_findings(log, fusion_stage.clock_offset_ns, checks, fuser.area if watched else None, sink)
    if smooth:
        _write_smoothed(people.finish(), sink)


def _note_findings(
    log: Log, clock_offset_ns: Ints, checks: PeopleChecks, area: vacancy.VacancyState | None, sink: Sink
) -> None:
    """Writes the checks of cameras and people, and notes what stage 1 found.

    Args:
        log: The log, which is read to its end.
        clock_offset_ns: (c,) offset of each camera's clock [ns].
        checks: The checks.
        area: Last state of the watched area; None: there is none.
        sink: Receives rows and notes.
    """
    notes = sink.notes["fuse"]
    notes.extend(_describe_late_frames(log, sink.counts, clock_offset_ns))
    checks.write(sink)
    if area is not None:
        notes.extend(_describe_area(log, area, sink.counts))
    notes.extend(_describe_others(sink.counts))
    notes.extend(_describe_disbelief(sink.counts))


def _write_smoothed(parts: Iterable[HumanStates], sink: Sink) -> None:
    for part in parts:
        write_smoothed(part, sink.tables)


def write_smoothed(part: HumanStates, tables: Tables) -> None:
    """Writes a stretch of the smoothed people, some rows at a time: as columns they would be in memory three times."""
    for first in range(0, len(part), TableWriter.ROWS):
        tables.table("smooth", state_columns(part.rows(slice(first, first + TableWriter.ROWS))))


def _describe_others(counts: Counter[str]) -> Iterator[str]:
    """Returns a note on bodies other than the person."""
    if others := counts["person_frames_beside_others"]:
        yield (
            f"{others} frames show at least one other body than the person: it counts for contact, but there is no "
            "prediction for it and the robot does not react to it"
        )


def _describe_disbelief(counts: Counter[str]) -> Iterator[str]:
    """Returns a note on each camera whose view of some points was not believed."""
    for camera, points in disbelieved(counts).items():
        frames = ", ".join(f"{point} {count}" for point, count in points.items())
        yield (
            f"camera {camera} shows points of a person wrong over time, and another camera shows them elsewhere; "
            f"left out of the filter and the volumes, in frames: {frames}; more cameras agree on another place, a bone "
            "has a wrong length, or the point is below the floor; look at what hides them from it, and at its pose"
        )


def _describe_area(log: Log, seen: vacancy.VacancyState, counts: Counter[str]) -> Iterator[str]:
    """Returns notes on a watched area: missing observations and contradictions."""
    if refuting := counts["watched_frames_refuting"]:
        yield (
            f"watched area: {refuting} frames show a person deeper inside than people can walk since all cameras "
            "showed it without people: the cameras do not see all of it, or people were faster; would be right: a "
            "smaller area, or a larger watched.margin_m, in the cell file"
        )
    if max(seen.vacant_ns) >= 0:
        return
    silent = [camera for camera, newest_ns in zip(log.header.cameras, seen.newest_ns, strict=True) if newest_ns < 0]
    if silent:
        yield f"watched area: never known to be without people, as no frame came from {', '.join(silent)}"
    else:
        yield (
            "watched area: never known to be without people beside the person: another body was in it all along, or "
            "not all cameras showed it for watched.clear_s without a gap; trackers whose messages only name people, as "
            "on tf, cannot show that nobody is there"
        )


def write_checks(checks: CameraChecks, sink: Sink) -> None:
    """Writes the checks of each camera's person and of each pair of cameras; adds notes on values out of bounds."""
    sink.notes["fuse"].extend(checks.remarks())
    for name, rows in zip(("bodies", "agreement"), checks.figures(), strict=True):
        if rows:
            sink.tables.table(name, record_columns(rows))


class PersonExtent(NamedTuple):
    """Where and when the measurements of a person are."""

    frames: int
    first_ns: int  #: of the captures
    last_ns: int
    cameras: frozenset[int]
    low_m: Floats  #: (3,) least coordinates of the middle of its points, world [m]
    high_m: Floats  #: (3,) greatest ones [m]

    @classmethod
    def of(cls, seen: Measurements) -> PersonExtent:
        """Finds the extent of some measurements."""
        known = np.isfinite(seen.points_m).sum(axis=1)
        middle_m = np.nansum(seen.points_m, axis=1) / np.where(known > 0, known, np.nan)  # nanmean would warn
        return cls(
            frames=len(seen),
            first_ns=int(seen.capture_ns.min()),
            last_ns=int(seen.capture_ns.max()),
            cameras=frozenset(seen.camera.tolist()),
            low_m=np.fmin.reduce(middle_m),
            high_m=np.fmax.reduce(middle_m),
        )

    def join(self, other: PersonExtent | None) -> PersonExtent:
        """Returns the extent of both."""
        if other is None:
            return self
        return PersonExtent(
            self.frames + other.frames,
            min(self.first_ns, other.first_ns),
            max(self.last_ns, other.last_ns),
            self.cameras | other.cameras,
            np.fmin(self.low_m, other.low_m),
            np.fmax(self.high_m, other.high_m),
        )


class PeopleChecks:
    """The checks of the cameras by each person; those by the person shown most are written.

    It also notes the people: from when to when, and who may be a thing that a tracker takes for a person.
    """

    #: A person that one of several cameras alone shows for this time within this distance may be a thing [s, m].
    STILL_S, STILL_M = 5.0, 0.3

    def __init__(self, cameras: tuple[str, ...]) -> None:
        self._cameras = cameras
        self._checks: dict[int, CameraChecks] = {}
        self._extents: dict[int, PersonExtent] = {}

    def add(self, measured: Measurements) -> None:
        """Adds the measurements of some frames."""
        for number in sorted(set(measured.numbers.tolist())):
            mine = measured.rows(measured.numbers == number)
            checks = self._checks.setdefault(number, CameraChecks(self._cameras))
            checks.add(mine.camera, SkeletonTrack(mine.capture_ns, mine.points_m, mine.confidence))
            self._extents[number] = PersonExtent.of(mine).join(self._extents.get(number))

    def write(self, sink: Sink) -> None:
        """Writes the checks and notes."""
        most = max(self._extents, key=lambda number: self._extents[number].frames, default=None)
        write_checks(CameraChecks(self._cameras) if most is None else self._checks[most], sink)
        sink.notes["fuse"].extend(self.describe())

    def describe(self) -> Iterator[str]:
        """Returns the note on several people, and one for each that may be a thing; none for one person."""
        people = self._extents
        if len(people) < 2:
            return
        start_ns = min(seen.first_ns for seen in people.values())
        spans = {
            number: ((seen.first_ns - start_ns) / NS, (seen.last_ns - start_ns) / NS)
            for number, seen in sorted(people.items())
        }
        each = ", ".join(f"person {number} from {a:.1f} to {b:.1f} s" for number, (a, b) in spans.items())
        yield (
            f"{len(people)} bodies were tracked, and the robot keeps clear of all of them: {each} after the first frame"
        )
        for number, (a, b) in spans.items():
            seen = people[number]
            if len(seen.cameras) == 1 < len(self._cameras) and b - a >= self.STILL_S:
                within_m = float(np.nanmax(seen.high_m - seen.low_m))
                if within_m <= self.STILL_M:
                    yield (
                        f"person {number} may be no person: {self._cameras[min(seen.cameras)]} alone shows this body, "
                        f"which stays within {within_m:.2f} m for {b - a:.1f} s; the robot keeps clear of it; would be "
                        "right, if it is a thing: what hides it from the camera's tracker, or logs.people = nearest"
                    )


def _nobody(log: Log, found: Counter[str]) -> LogError:
    """Returns the error for a log without a person: what was found, and what would be right."""
    rows = sum(log.defects[f"frames_{camera}"] for camera in log.header.cameras)
    text = (
        f"{log.header.path}: nobody was ever seen: {rows} bodies in the frames of {', '.join(log.header.cameras)} hold "
        f"{log.points_seen} points with a place and a confidence"
    )
    why = [f"{name} {count}" for name, count in sorted((log.defects + found).items()) if name.startswith(_LOST)]
    text += f" ({', '.join(why)})" if why else ""
    if any(found[f"frames_late_{camera}"] for camera in log.header.cameras):
        return LogError(
            f"{text}: by their stamps the frames came more than fusion.fresh_s after their capture; would be right: "
            "the clocks of cameras and recorder set, or what is wrong with them as clock_offset_s in the cell file"
        )
    return LogError(
        f"{text}; would be right: a person's pelvis, shoulders and arms, confidence at least fusion.confidence_min. "
        "Look at it with hrcreplay info"
    )


def _describe_late_frames(log: Log, counts: Counter[str], offsets_ns: Ints) -> Iterator[str]:
    """Returns notes on frames that arrived too late."""
    for camera, offset_ns in zip(log.header.cameras, offsets_ns.tolist(), strict=True):
        late = counts[f"frames_late_{camera}"]
        if late:
            yield (
                f"camera {camera}: {late} of {log.defects[f'frames_{camera}']} rows came more than fusion.fresh_s "
                f"after their capture and are not used; {delay_text(log.clocks[camera], offset_ns / 1e9)}"
            )


def write_truth(log: Log, start_ns: int, end_ns: int, sink: Sink) -> None:
    """Writes the closed-form joints of the log's ground truth, if it has one.

    Args:
        log: Log to read.
        start_ns: First instant to write [ns].
        end_ns: Last instant to write [ns].
        sink: Receives the rows.
    """
    for truth in log.truth():
        within = truth.rows((truth.t_ns >= start_ns) & (truth.t_ns <= end_ns))
        if len(within):
            sink.tables.table("truth", truth_columns(within.t_ns, *inverse_kinematics.inverse(within.points_m)))


def predict_batches(
    states: Iterable[HumanStates], prediction_stage: PredictionStage, store_every: float, sink: Sink
) -> Iterator[HumanStates]:
    """Stage 2 alone: writes the volumes for the braking time T_s, for one tick in ``store_every``.

    Args:
        states: Batches of the fused people.
        prediction_stage: Settings of the stage.
        store_every: Number of ticks per tick whose volumes are stored, 1 or more; need not be an integer.
        sink: Receives rows and times.
    """
    done = 0
    for batch in states:
        ticks, first = batch.ticks()
        stored = select_stored_ticks(done, len(ticks), store_every)
        with sink.watch.stage("predict", len(ticks)):
            volumes = prediction_stage.volumes(batch)
        rows = np.concatenate([np.arange(first[tick], first[tick + 1]) for tick in stored] or [stored])
        with sink.watch.stage("hulls", len(ticks)):
            store_volumes([StoredVolumes(volumes, prediction_stage.horizon_s, batch.person, rows)], sink.tables)
        done += len(ticks)
        sink.progress("predict", len(ticks))
        yield batch


class Elsewhere(Protocol):
    """Where the other methods of a run move the robot, and where its volumes are stored."""

    def take(self, batch: HumanStates, stored: Ints, horizon_s: Floats) -> None:
        """Takes a batch of the fused people, and the ticks whose volumes are stored with the horizon of each [s]."""


def plan_batches(
    states: Iterable[HumanStates],
    surroundings: Surroundings,
    planners: Mapping[str, Follower],
    store_every: float,
    sink: Sink,
    elsewhere: Elsewhere | None = None,
) -> Iterator[None]:
    """Stages 2 and 3: computes the robot's motion by each method; each method requests the volumes that it needs.

    Writes a motion per method, and the volumes of the chosen method for one tick in ``store_every``.

    Args:
        states: Batches of the fused people.
        surroundings: Obstacles of the robot.
        planners: Method -> its robot; the chosen one is first.
        store_every: Number of ticks per tick whose volumes are stored, 1 or more; need not be an integer; inf: none.
        sink: Receives rows and times.
        elsewhere: Stores the volumes, and moves the robot by the methods that ``planners`` lacks; None: there are none.
    """
    done = 0
    follow = MethodsFollowing(surroundings, planners, sink)
    for batch in states:
        forecast = Forecast(surroundings, batch)
        ticks, chosen = len(forecast.t_ns), follow.take(forecast)
        stored = select_stored_ticks(done, ticks, store_every)
        if chosen is not None:
            if elsewhere is None:
                with sink.watch.stage("hulls", ticks):
                    store_ticks(forecast, stored, chosen.horizon_s[stored], sink.tables)
            else:
                elsewhere.take(batch, stored, chosen.horizon_s[stored])
        done += ticks
        sink.progress("plan", ticks)
        yield


@dataclass
class MethodsFollowing:
    """Moves the robot by some methods, batch by batch, and writes their motions."""

    surroundings: Surroundings
    planners: Mapping[str, Follower]  #: method -> its robot
    sink: Sink
    _most: int = 1  #: number of people so far

    def take(self, forecast: Forecast) -> Motion | None:
        """The next batch; returns the motion of the chosen method, None if it is not among these."""
        t_ns, sink, chosen = forecast.t_ns, self.sink, None
        self._most = max(self._most, int(forecast.states.numbers.max()))
        with sink.watch.stage("predict", len(t_ns)):
            _ = forecast.person  # shared by the methods
        for name, planner in self.planners.items():
            with sink.watch.stage(f"plan {name}", len(t_ns)):
                motion = planner.follow(t_ns, forecast, self.surroundings.names_of(self._most))
            columns = motion_columns(motion) | nearest_columns(planner.robot, planner.static, motion)
            sink.tables.table("motion" if planner.chosen else f"motion_{name}", columns)
            chosen = motion if planner.chosen else chosen
        return chosen


def nearest_columns(robot: RobotModel, static: StaticObstacles | None, motion: Motion) -> dict[str, Any]:
    """Returns the columns of the nearest objects and links; none if the cell has no objects."""
    if static is None:
        return {}
    found = nearest(robot, static, motion.q)
    return static_columns(
        object_m=found.object_m,
        nearest_object=(found.object, static.names),
        object_link=(found.object_link, motion.links),
        self_m=found.links_m,
        self_links=(found.links[:, 0], found.links[:, 1], motion.links),
    )
