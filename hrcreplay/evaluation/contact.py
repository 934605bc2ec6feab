"""Contact between the robot and all recorded people: one row per tick and method in contact.parquet.

It compares the links' capsules at the commanded joint positions with the capsules of every recorded body from every
source: the ground truth, else the smoothed person and each camera's points; and every other body of every camera. These
sources are independent of the predictions, and the smallest distance counts. If the moving robot touches the person,
the row also says if the touched part was inside the volume used to certify the motion: then the fault lies with the
controller, else with the prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from hrcreplay.evaluation.containment import Coverage, Outcome
from hrcreplay.evaluation.recorded_person import BodyTrack, RecordedPeople
from hrcreplay.evaluation.severity import MET
from hrcreplay.geometry.distances import nearest_pair, protrusion_m
from hrcreplay.human.model import LEG_PARTS, PARTS, part_radii
from hrcreplay.pipeline.run_config import RunConfig
from hrcreplay.pipeline.surroundings import PredictionStage
from hrcreplay.records import ALLOWING_CONTACT, BODY, UNGUARDED, Bools, Floats, HumanStates, Ints, SweptVolume
from hrcreplay.robot.model import LinkMotion, RobotModel
from hrcreplay.robot.recorded import CapsuleSample, RecordedCapsules
from hrcreplay.store.columns import Columns, contact_columns, person_columns, read_states, read_states_at
from hrcreplay.store.run_folder import arrow_table
from hrcreplay.store.stored_table import RunTable, StoredTable, text_column

_BATCH = 4096
#: Ticks whose rows are made and written together, fewer where many people need columns: a long run's motions would fill
#: the memory.
STRETCH = 16 * _BATCH

#: Part of the body -> limb whose volume must contain it.
VOLUME_OF = (
    {part: part for part in PARTS}
    | dict.fromkeys((*LEG_PARTS, "FOOT_R", "FOOT_L"), "LEGS")
    | {"HAND_R": "LRA", "HAND_L": "LLA"}
)

#: Limb -> vertices (m, 3) and radius of the volume around them [m].
Volumes = Mapping[str, SweptVolume]


#: Coverage of each person; None if not computed.
Coverages = Sequence[Outcome | None]


def compute_own_coverage(
    run_config: RunConfig, people: RecordedPeople, predicted: Predicted, motion: RunTable
) -> Coverages:
    """Coverage of every checked tick until the horizon of the volumes that the controller used.

    Args:
        run_config: The run.
        people: Recorded people.
        predicted: Volumes of any tick.
        motion: Rows of a motion table.
    """
    used = motion["t_ns"].to_numpy(), motion["horizon_s"].to_numpy(dtype=float)
    return _coverage(run_config, people, predicted, lambda states: _at(states.t_ns, *used))


def compute_full_coverage(run_config: RunConfig, people: RecordedPeople, predicted: Predicted) -> Coverages:
    """Coverage of every checked tick until the braking time T_s, as ``audit`` counts it."""
    stop_s = predicted.stage.horizon_s
    return _coverage(run_config, people, predicted, lambda states: np.full(len(states), stop_s))


def _coverage(
    run_config: RunConfig,
    people: RecordedPeople,
    predicted: Predicted,
    horizons_s: Callable[[HumanStates], Floats],
) -> Coverages:
    """Coverage of each person."""
    if run_config.settings.plan.method in UNGUARDED:
        return [None] * len(people.people)
    fusion, end_ns = run_config.settings.fusion, predicted.last_ns
    checks = {one.number: Coverage(predicted.stage, one, fusion, end_ns.get(one.number, 0)) for one in people.people}
    for states in predicted.parts():
        for number, check in checks.items():
            own = states.of_person(number)
            check.add(own, horizons_s(own))
    return [check.outcome() for check in checks.values()]


def write_rows(every: Iterator[Columns], write: Callable[[Columns], None]) -> pd.DataFrame:
    """Writes the rows of a ``JudgedMotion`` in turn; returns what ``severity_table`` needs of all of them."""
    met = []
    for rows in every:
        write(rows)
        met.append(arrow_table({name: rows[name] for name in MET}))
    return pa.concat_tables(met).to_pandas(split_blocks=True, self_destruct=True)


@dataclass(frozen=True)
class JudgedMotion:
    """A motion beside the recorded people, of which the rows of contact.parquet are made."""

    run_config: RunConfig
    robot: RobotModel  #: at its base pose in the world
    method: str  #: of the motion
    motion: RunTable
    people: RecordedPeople
    predicted: Predicted  #: volumes of any tick
    own: Coverages | None  #: result of ``compute_own_coverage``; None if not computed
    full: Coverages | None  #: result of ``compute_full_coverage``; None if not computed
    capsules: RecordedCapsules | None = None  #: the robot as recorded by them, in place of its links; None: none

    def rows(self) -> Iterator[Columns]:
        """Computes the rows of contact.parquet, one stretch of ticks after the other."""
        decisions = None if self.method in (*UNGUARDED, *ALLOWING_CONTACT) else Decisions.of(self.motion)
        stretch = max(_BATCH, STRETCH // len(self.people.people))
        for first in range(0, len(self.motion), stretch):
            rows = slice(first, first + stretch)
            yield self._stretch(self.motion.iloc[rows], None if decisions is None else decisions.by_rows(rows))

    def _stretch(self, motion: pd.DataFrame, decisions: Decisions | None) -> Columns:
        """Computes some rows of contact.parquet.

        Args:
            motion: The rows of the motion.
            decisions: Those that led to these rows; None: the method uses no volumes.
        """
        people, prediction, t_ns = self.people, self.run_config.settings.prediction, motion["t_ns"].to_numpy()
        radii_m = part_radii(prediction, self.run_config.settings.report.leg_radius_m)
        groups = [*(one.tracks for one in people.people), people.others]
        if self.capsules is None:
            links, moving = tuple(segment.name for segment in self.robot.segments), _is_turning(motion)
            *each, other = nearest(self.robot, motion, groups, radii_m, prediction.hand_m)
        else:
            links, sample = self.capsules.names, self.capsules.sample(t_ns)
            moving = np.asarray(np.nan_to_num(sample.velocity).any(axis=(1, 2, 3)))
            *each, other = (nearest_capsule(sample, t_ns, tracks, radii_m, prediction.hand_m) for tracks in groups)
        person = _nearest_person(each, people)
        worst, of_other = choose_nearer(person, other)
        outside_m = np.full(len(t_ns), np.nan)
        if decisions is not None:
            outside_m = by_volume(motion, decisions, person, people, radii_m, prediction.hand_m, self.predicted)
        nobody: Coverages = [None] * len(each)
        pairs = zip(self.own or nobody, self.full or nobody, strict=True)
        of_each = [(_measure_left(a, t_ns), _measure_left(b, t_ns)) for a, b in pairs]
        columns = contact_columns(
            t_ns=t_ns,
            method=self.method,
            person=people.source,
            moving=moving,
            distance_m=worst.distance_m,
            part=(worst.part, PARTS),
            link=(worst.link, links),
            speeds=(motion["tcp_speed"].to_numpy(dtype=float), worst.speed),
            source=(np.where(of_other, len(people.person) + worst.track, worst.track), people.names),
            apart=(person.distance_m, other.distance_m),
            outside_m=outside_m,
            left=(*_worst_left([a for a, _ in of_each]), BODY),
            left_full=(*_worst_left([b for _, b in of_each]), BODY),
        )
        if len(each) > 1:
            for one, pair, (a, b) in zip(people.people, each, of_each, strict=True):
                columns |= person_columns(one.number, pair.distance_m, a[0], b[0])
        return columns


def _nearest_person(each: Sequence[Nearest], people: RecordedPeople) -> Nearest:
    """The nearest of all people, its track counted among those of all of them."""
    found, first = each[0], len(people.people[0].tracks)
    for pair, one in zip(each[1:], people.people[1:], strict=True):
        found, _ = choose_nearer(found, replace(pair, track=np.where(pair.track >= 0, pair.track + first, -1)))
        first += len(one.tracks)
    return found


def _worst_left(each: Sequence[tuple[Floats, Ints]]) -> tuple[Floats, Ints]:
    """The person furthest outside its volumes, tick by tick."""
    out_m, limb = each[0]
    for other_m, other_limb in each[1:]:
        worse = ~(out_m >= other_m) & np.isfinite(other_m)
        out_m, limb = np.where(worse, other_m, out_m), np.where(worse, other_limb, limb)
    return out_m, limb


@dataclass(frozen=True)
class Nearest:
    """Nearest pair of a link and a body part, one row per tick."""

    distance_m: Floats  #: (n,) distance between the surfaces, negative in overlap; NaN without a known body [m]
    link: Ints  #: (n,) index into the robot's segments; -1 without a known body
    part: Ints  #: (n,) index into PARTS; -1 likewise
    track: Ints  #: (n,) index into the bodies' tracks; -1 likewise
    speed: Floats  #: (n,) speed of the link's surface at its nearest point to the body [m/s]


def choose_nearer(first: Nearest, second: Nearest) -> tuple[Nearest, Bools]:
    """Returns the nearer of two pairs, tick by tick, and (n,) True where it is the second."""
    is_second: Bools = np.asarray(~(first.distance_m <= second.distance_m) & np.isfinite(second.distance_m))
    pairs = ((getattr(first, name), getattr(second, name)) for name in first.__dataclass_fields__)
    return Nearest(*(np.where(is_second, b, a) for a, b in pairs)), is_second


def nearest(
    robot: RobotModel, motion: RunTable, groups: Sequence[Sequence[BodyTrack]], radii_m: Floats, hand_m: float
) -> tuple[Nearest, ...]:
    """Finds the nearest pair of link and body for each group of tracks, at every tick of a motion.

    Args:
        robot: The manipulator.
        motion: Rows of a motion table.
        groups: Groups of bodies.
        radii_m: (14,) radii of PARTS [m].
        hand_m: Length of a hand beyond the wrist [m].
    """
    q, dq = (motion[[f"{name}{i + 1}" for i in range(robot.nv)]].to_numpy(dtype=float) for name in ("q", "dq"))
    t_ns, parts = motion["t_ns"].to_numpy(), []
    for first in range(0, len(t_ns), _BATCH):
        rows = slice(first, first + _BATCH)
        links = robot.link_motion(q[rows], dq[rows])
        parts.append([_nearest(robot, links, t_ns[rows], tracks, radii_m, hand_m) for tracks in groups])
    return tuple(_join(batches) for batches in zip(*parts, strict=True))


def _nearest(
    robot: RobotModel, links: LinkMotion, t_ns: Ints, tracks: Sequence[BodyTrack], radii_m: Floats, hand_m: float
) -> Nearest:
    """Finds the nearest pair among some tracks, at a batch of ticks."""
    unknown, nothing = np.full(len(t_ns), np.nan), np.full(len(t_ns), -1)
    found = Nearest(unknown, nothing, nothing, nothing, unknown)
    link_radius_m = np.array([segment.radius_m for segment in robot.segments])
    for k, track in enumerate(tracks):
        if not track.is_near(int(t_ns[0]), int(t_ns[-1])):
            continue
        pair = nearest_pair(links.ends_m, link_radius_m, track.axes_m(t_ns, hand_m), radii_m)
        apart = pair.at_second_m - pair.at_first_m
        length = np.linalg.norm(apart, axis=1, keepdims=True)
        towards = apart / np.where(length > 0.0, length, np.inf)  # the point on the axis itself if the axes cross
        at_m = pair.at_first_m + link_radius_m[pair.first][:, None] * towards
        index = np.where(pair.first >= 0, k, -1)
        speed = links.speed(pair.first, at_m)
        found, _ = choose_nearer(found, Nearest(pair.distance_m, pair.first, pair.second, index, speed))
    return found


def nearest_capsule(
    links: CapsuleSample, t_ns: Ints, tracks: Sequence[BodyTrack], radii_m: Floats, hand_m: float
) -> Nearest:
    """Finds the nearest pair of a recorded capsule and a body among some tracks, at every tick.

    Args:
        links: Capsules of the robot at the ticks.
        t_ns: (n,) ticks [ns].
        tracks: Bodies.
        radii_m: (14,) radii of PARTS [m].
        hand_m: Length of a hand beyond the wrist [m].
    """
    unknown, nothing = np.full(len(t_ns), np.nan), np.full(len(t_ns), -1)
    found = Nearest(unknown, nothing, nothing, nothing, unknown)
    for k, track in enumerate(tracks):
        axes_m = track.axes_m(t_ns, hand_m)
        for link in range(links.radius_m.shape[1]):
            ends, radius_m = links.ends_m[:, link], links.radius_m[:, link]
            pair = nearest_pair(ends[:, None], np.zeros(1), axes_m, radii_m)
            along = ends[:, 1] - ends[:, 0]
            length2 = np.maximum((along**2).sum(axis=1), 1e-18)
            share = (((pair.at_first_m - ends[:, 0]) * along).sum(axis=1) / length2)[:, None]
            velocity = (1 - share) * links.velocity[:, link, 0] + share * links.velocity[:, link, 1]
            speed = np.linalg.norm(velocity, axis=1)
            known = pair.first >= 0
            index, which = np.where(known, link, -1), np.where(known, k, -1)
            found, _ = choose_nearer(found, Nearest(pair.distance_m - radius_m, index, pair.second, which, speed))
    return found


def _join(batches: Sequence[Nearest]) -> Nearest:
    """Concatenates the pairs of consecutive ticks."""
    return Nearest(*(np.concatenate([getattr(b, name) for b in batches]) for name in Nearest.__dataclass_fields__))


def _is_turning(motion: RunTable) -> Bools:
    """(n,) True if any axis turns; False where its velocity is not known."""
    joints = [name for name in motion.columns if name[:2] == "dq" and name[2:].isdigit()]
    dq = motion[joints].to_numpy(dtype=float)
    return np.asarray((np.isfinite(dq) & (dq != 0.0)).any(axis=1))


def _at(from_ns: Ints, motion_ns: Ints, values: Floats) -> Floats:
    """Returns the values of a motion's ticks at other instants; NaN for an instant without a tick."""
    row = np.clip(np.searchsorted(motion_ns, from_ns), 0, len(motion_ns) - 1)
    return np.where(motion_ns[row] == from_ns, values[row], np.nan)


def _measure_left(outcome: Outcome | None, t_ns: Ints) -> tuple[Floats, Ints]:
    """(n,) maximum distance by which a limb left its volume, 0 if none did, NaN if not checked [m]; (n,) that limb."""
    out_m, limb = np.full(len(t_ns), np.nan), np.full(len(t_ns), -1)
    if outcome is None:
        return out_m, limb
    row = np.clip(np.searchsorted(t_ns, outcome.t_ns), 0, len(t_ns) - 1)
    same = t_ns[row] == outcome.t_ns
    escape_m = outcome.escape_m()
    out_m[row[same]] = outcome.worst_m()[same]
    worst = np.argmax(np.where(np.isnan(escape_m), -1.0, escape_m), axis=1)
    limb[row[same]] = np.where(outcome.worst_m() > 0.0, [BODY.index(outcome.limbs[k]) for k in worst], -1)[same]
    return out_m, limb


@dataclass
class Predicted:
    """The volumes of any tick at any horizon, predicted again from the fused person."""

    stage: PredictionStage
    states: Path  #: state.parquet

    def parts(self) -> Iterator[HumanStates]:
        """Reads the fused people at every tick, part by part."""
        return read_states(self.states, _BATCH)

    @cached_property
    def _ticks_ns(self) -> dict[int, Ints]:
        """Number of a person -> the person's ticks."""
        table = StoredTable(self.states)
        t_ns = table["t_ns"].to_numpy()
        if "person" not in table:
            return {1: t_ns}
        person = table["person"].to_numpy()
        return {number: t_ns[person == number] for number in np.unique(person).tolist()}

    @property
    def last_ns(self) -> dict[int, int]:
        """Number of a person -> the person's last tick [ns]."""
        return {number: int(t_ns[-1]) for number, t_ns in self._ticks_ns.items()}

    def volumes(self, asked: Sequence[tuple[int, float, int]]) -> list[Volumes]:
        """Volumes of a person's last state that is not later than an instant; none if the person was unknown.

        Args:
            asked: Instant [ns], horizon [s] and number of the person for each.
        """
        ticks_ns = [self._last_tick(t_ns, person) for t_ns, _, person in asked]
        if not any(known := [tick >= 0 for tick in ticks_ns]):
            return [{} for _ in asked]
        states = read_states_at(self.states, np.unique([tick for tick in ticks_ns if tick >= 0]))
        people = {person: states.of_person(person) for _, _, person in asked}
        found: list[Volumes] = []
        for tick_ns, there, (_, horizon_s, person) in zip(ticks_ns, known, asked, strict=True):
            row = int(np.searchsorted(people[person].t_ns, tick_ns))
            volumes = self.stage.volumes(people[person].rows(slice(row, row + 1)), horizon_s).at(0) if there else {}
            found.append({limb: volume for limb, volume in volumes.items() if volume.known})
        return found

    def _last_tick(self, t_ns: int, person: int) -> int:
        """A person's last tick that is not later than ``t_ns``; -1 without one [ns]."""
        ticks_ns = self._ticks_ns.get(person, np.zeros(0, np.int64))
        row = int(np.searchsorted(ticks_ns, t_ns, side="right")) - 1
        return -1 if row < 0 else int(ticks_ns[row])


@dataclass(frozen=True)
class Decisions:
    """The decisions that led to some rows of a motion."""

    t_ns: Ints  #: (n,) tick of the decision [ns]; -1: none
    horizon_s: Floats  #: (n,) horizon of the volumes used there [s]

    @classmethod
    def of(cls, motion: RunTable) -> Decisions:
        """Finds those of all rows of a motion."""
        decided = deciding_rows(motion)
        t_ns, horizon_s = motion["t_ns"].to_numpy(), motion["horizon_s"].to_numpy(dtype=float)
        return cls(np.where(decided >= 0, t_ns[decided], -1), horizon_s[decided])

    def by_rows(self, rows: slice) -> Decisions:
        """Those of some of the rows."""
        return Decisions(self.t_ns[rows], self.horizon_s[rows])


def by_volume(
    motion: RunTable,
    decisions: Decisions,
    found: Nearest,
    people: RecordedPeople,
    radii_m: Floats,
    hand_m: float,
    predicted: Predicted,
) -> Floats:
    """(n,) distance of the touched part outside the volume used to certify the motion, negative inside [m].

    The volumes are those of the tick at which the present motion was decided; they hold until the end of the stop
    certified with them. NaN if the robot touches no person or is stationary, or if there was no prediction.

    Args:
        motion: Rows of a motion table.
        decisions: The decisions that led to them.
        found: Nearest pair with the tracks of all people at the same ticks.
        people: Recorded people.
        radii_m: (14,) radii of PARTS [m].
        hand_m: Length of a hand beyond the wrist [m].
        predicted: Volumes of any tick.
    """
    outside_m, tracks, numbers = np.full(len(motion), np.nan), people.person, people.numbers
    t_ns, decided_ns, horizon_s = motion["t_ns"].to_numpy(), decisions.t_ns.tolist(), decisions.horizon_s.tolist()
    touching = np.flatnonzero(_is_turning(motion) & (found.distance_m <= 0.0) & (decisions.t_ns >= 0)).tolist()
    used = {i: (decided_ns[i], horizon_s[i], int(numbers[found.track[i]])) for i in touching}
    each = sorted(set(used.values()))
    volumes = dict(zip(each, predicted.volumes(each), strict=True))
    for i, key in used.items():
        part = int(found.part[i])
        solid = volumes[key].get(VOLUME_OF[PARTS[part]])
        if solid is not None:
            axes_m = tracks[int(found.track[i])].axes_m(t_ns[i : i + 1], hand_m)[:, part]
            outside_m[i] = protrusion_m(axes_m, float(radii_m[part]), *solid)[0]
    return outside_m


def deciding_rows(motion: RunTable) -> Ints:
    """(n,) the row at which the motion of each tick was decided; -1 if none.

    That is the last row before the tick that did not just continue a stop.
    """
    going_on = text_column(motion, "status") == "braking"
    last = np.maximum.accumulate(np.where(going_on, -1, np.arange(len(motion))))
    return np.concatenate([[-1], last])[:-1]
