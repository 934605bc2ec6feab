"""Coverage of the recorded person by the predicted volumes: the same definition for report, compare and audit.

A limb is covered at a tick if all its recorded points, from every camera and each with the limb's radius around it,
stay inside its volume until the end of the horizon.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hrcreplay.evaluation.recorded_person import LIMB_POINTS, RecordedPerson
from hrcreplay.geometry.distances import farthest_at_most
from hrcreplay.geometry.inflated_hull import InflatedHull, union_volume_m3
from hrcreplay.human.prediction.sound_reach import THIGH_M
from hrcreplay.human.prediction.swept_volumes import limb_radii
from hrcreplay.pipeline.surroundings import PredictionStage
from hrcreplay.records import BODY, LIMBS, POINTS, Bools, Floats, HumanStates, Ints, SweptVolumes, Table
from hrcreplay.settings.sections import Fusion
from hrcreplay.store.stored_array import Rows

#: Rate of the checked ticks [Hz].
AUDIT_HZ = 25.0
#: Share of the horizon that counts as its end: the last quarter. A limb that was last seen earlier could have left
#: later.
_END = 0.75
#: Number of sample points for the volume of a tick's union.
_COUNT = 1024
#: Number of recorded bodies that are read together.
_BATCH = 15_000
#: Rounding of a distance [m].
_ROUNDING_M = 1e-9
_NECK, *_SHOULDERS = (POINTS.index(name) for name in ("neck", "shoulder_l", "shoulder_r"))
#: Limb -> indices of its recorded points.
_OF_LIMB = {limb: [POINTS.index(name) for name in names] for limb, names in LIMB_POINTS.items()}


@dataclass(frozen=True)
class Outcome(Table):
    """One method's volumes compared with the recorded motion, one row per audited tick."""

    t_ns: Ints  #: (n,)
    beyond_m: (
        Floats  #: (n, l) maximum distance of the limb's recorded points from the hull, before the ball; NaN: unseen
    )
    radius_m: Floats  #: (n, l) radius of the ball
    volume_m3: Floats  #: (n, l) volume; NaN if the limb could not be predicted
    union_m3: Floats  #: (n,) volume of the union of all limbs; NaN if not computed
    union_std_m3: Floats  #: (n,) standard error of that volume
    upper_m3: Floats  #: (n,) volume of the union of the six LIMBS, which every method has
    upper_std_m3: Floats  #: (n,)
    limbs: tuple[str, ...]  #: LIMBS first
    limb_radius_m: tuple[float, ...]  #: radius of each limb itself, Table 2 and a thigh's [m]

    def escape_m(self, *, points_alone: bool = False) -> Floats:
        """(n, l) distance by which the limb left its volume within the horizon; 0 inside, NaN if not audited [m].

        The whole limb counts: a ball of the limb radius around each of its recorded points. Volumes are convex, so a
        point between two others is never further out than the worse of them. ``points_alone`` ignores limb thickness.
        """
        radius = np.zeros(len(self.limbs)) if points_alone else np.array(self.limb_radius_m)
        depth = self.beyond_m + radius - self.radius_m
        return np.where(np.isnan(depth), np.nan, np.where(depth > _ROUNDING_M, depth, 0.0))

    def worst_m(self, limbs: int | None = None, *, points_alone: bool = False) -> Floats:
        """(n,) largest escape of all limbs or of the first few, each from its own volume; NaN: none checked [m]."""
        escapes = self.escape_m(points_alone=points_alone)[:, :limbs]
        known = np.isfinite(escapes).any(axis=1)
        return np.where(known, np.where(np.isnan(escapes), -1.0, escapes).max(axis=1), np.nan)


@dataclass(frozen=True)
class RecordedFuture:
    """The recorded future of some ticks."""

    states: HumanStates  #: (n,) the fused person at the ticks
    points_m: Floats  #: (m, 20, 3) the recorded POINTS from the first of these ticks on, world [m]
    first: Ints  #: (n,) row of the first recorded instant after the tick
    last: Ints  #: (n,) row past the last one within the horizon
    seen: dict[str, Bools]  #: limb -> (n, k) True: the point was seen in the last quarter of the horizon

    def rows(self, which: slice | Ints) -> RecordedFuture:
        """Selects some of the ticks."""
        seen = {limb: part[which] for limb, part in self.seen.items()}
        return RecordedFuture(self.states.rows(which), self.points_m, self.first[which], self.last[which], seen)

    def of_limb(self, limb: str, tick: int) -> Floats:
        """(m, k, 3) recorded points of a limb within the horizon of a tick, world [m]; the neck is the model's."""
        of, whole = _OF_LIMB[limb], self.points_m[self.first[tick] : self.last[tick]]
        found = np.take(whole, of, axis=1)
        if _NECK in of:
            found[:, of.index(_NECK)] = _neck(whole)
        return found

    def checked(self, limb: str) -> Bools:
        """(n,) True if the limb can be checked: both its ends were seen near the horizon's end."""
        return np.asarray(self.seen[limb][:, :2].all(axis=1))

    def points(self) -> dict[str, dict[str, int]]:
        """Limb -> each point other than its ends -> number of the limb's checked ticks at which it was seen."""
        return {
            limb: {
                point: int((self.seen[limb][:, 2 + k] & self.checked(limb)).sum()) for k, point in enumerate(names[2:])
            }
            for limb, names in LIMB_POINTS.items()
        }


@dataclass(frozen=True)
class RecordedLimbs:
    """The recorded points of a person, and how many of them each limb has."""

    t_ns: Ints  #: (m,) instants, increasing
    points_m: Rows  #: (m, 20, 3) POINTS, world [m]; NaN if not recorded or rejected
    counts: dict[str, NDArray[np.int32]]  #: limb -> (m + 1, k) number of rows before each that have a point

    @classmethod
    def of(cls, t_ns: Ints, points_m: Rows) -> RecordedLimbs:
        """Selects the points of each limb.

        Args:
            t_ns: (m,) instants, increasing [ns].
            points_m: (m, 20, 3) POINTS of the person, world [m]; NaN if not recorded or rejected.
        """
        parts = [_known(points_m[first : first + _BATCH]) for first in range(0, len(t_ns), _BATCH)]
        known = np.concatenate([np.zeros((0, len(POINTS)), dtype=np.bool_), *parts])
        counts = {}
        for limb, of in _OF_LIMB.items():
            counts[limb] = np.zeros((len(known) + 1, len(of)), np.int32)
            np.cumsum(known[:, of], axis=0, out=counts[limb][1:])
        return cls(t_ns, points_m, counts)

    def future(self, states: HumanStates, horizon_s: float | Floats) -> RecordedFuture:
        """Returns the recorded future (t, t + T] of some ticks.

        Args:
            states: (n,) the fused person at the ticks.
            horizon_s: T, the prediction's horizon plus the latency, one per tick or one for all [s].
        """
        horizon_ns = np.round(np.asarray(horizon_s) * 1e9).astype(np.int64)
        first = np.searchsorted(self.t_ns, states.t_ns, side="right")
        last = np.searchsorted(self.t_ns, states.t_ns + horizon_ns, side="right")
        end = np.searchsorted(self.t_ns, states.t_ns + np.round(_END * horizon_ns).astype(np.int64), side="right")
        seen = {limb: np.asarray(count[last] > count[end]) for limb, count in self.counts.items()}
        begin, past = (int(first.min()), int(last.max())) if len(first) else (0, 0)
        points_m = self.points_m[begin:past]  # once, as a file may have to be read
        return RecordedFuture(states, points_m, first - begin, last - begin, seen)


def _known(points_m: Floats) -> Bools:
    """(n, 20) whether each point of bodies (n, 20, 3) is known; for the neck, whether both shoulders are."""
    known: Bools = np.asarray(np.isfinite(points_m).all(axis=2))
    known[:, _NECK] = np.isfinite(_neck(points_m)).all(axis=1)
    return known


def _neck(points_m: Floats) -> Floats:
    """(n, 3) the middle of the shoulders of bodies (n, 20, 3) [m]."""
    return np.asarray(0.5 * (points_m[:, _SHOULDERS[0]] + points_m[:, _SHOULDERS[1]]))


def recorded_future(t_ns: Ints, points_m: Rows, states: HumanStates, horizon_s: float | Floats) -> RecordedFuture:
    """Returns the recorded future (t, t + T] of some ticks.

    Args:
        t_ns: (m,) instants of the recorded points, increasing [ns].
        points_m: (m, 20, 3) POINTS of the person, world [m]; NaN if not recorded or rejected.
        states: (n,) the fused person at the ticks.
        horizon_s: T, the prediction's horizon plus the latency, one per tick or one for all [s].
    """
    return RecordedLimbs.of(t_ns, points_m).future(states, horizon_s)


def body_radii_m(prediction_stage: PredictionStage) -> dict[str, float]:
    """Limb -> its radius, Table 2; for the legs the radius of a thigh [m]."""
    return dict(zip(BODY, (*limb_radii(prediction_stage.settings).tolist(), THIGH_M), strict=True))


def check_containment(
    volumes: SweptVolumes,
    future: RecordedFuture,
    limb_radius: Mapping[str, float],
    counted: Bools,
    first_sample: int = 0,
    *,
    sizes: bool = True,
    exact: bool = True,
) -> Outcome:
    """Compares one method's volumes with the recorded future.

    Args:
        volumes: Volumes of the n ticks.
        future: Recorded future of the same ticks.
        limb_radius: Limb -> its radius, from ``body_radii_m`` [m].
        counted: (n,) the ticks whose union volume is estimated.
        first_sample: Number of ticks estimated before, see ``union_volume_m3``.
        sizes: True: compute the volume of each limb.
        exact: False: of limbs that stay inside an upper bound of their distance is enough, if no volume is asked for.
    """
    n, limbs = len(volumes), volumes.limbs
    beyond, size = np.full((n, len(limbs)), np.nan), np.full((n, len(limbs)), np.nan)
    union, union_std, upper, upper_std = np.full((4, n), np.nan)
    checked = np.column_stack([future.checked(limb) for limb in limbs])
    for i in range(n):
        solids = []
        for k, limb in enumerate(limbs):
            vertices = volumes.vertices(i, k)
            if np.isnan(vertices).any():
                continue
            if not (exact or sizes or counted[i]):
                enough_m = float(volumes.radius_m[i, k]) - limb_radius[limb]
                beyond[i, k] = _at_most(vertices, future, i, limb, enough_m) if checked[i, k] else np.nan
                if not beyond[i, k] + limb_radius[limb] > volumes.radius_m[i, k]:
                    continue
            solid = InflatedHull.around(vertices, float(volumes.radius_m[i, k]))
            if sizes:
                size[i, k] = solid.volume_m3()
            solids.append(solid)
            if checked[i, k]:
                beyond[i, k] = _farthest(solid, future, i, limb)
        if counted[i] and len(solids) == len(limbs):
            upper[i], upper_std[i] = union_volume_m3(solids[: len(LIMBS)], _COUNT, _COUNT * (first_sample + i))
            union[i], union_std[i] = upper[i], upper_std[i]
            if len(limbs) > len(LIMBS):
                union[i], union_std[i] = union_volume_m3(solids, _COUNT, _COUNT * (first_sample + i))
    radius = np.array(volumes.radius_m)
    thick = tuple(limb_radius[limb] for limb in limbs)
    return Outcome(volumes.t_ns, beyond, radius, size, union, union_std, upper, upper_std, limbs, thick)


def _farthest(solid: InflatedHull, future: RecordedFuture, tick: int, limb: str) -> float:
    """Returns the maximum distance of a limb's recorded points from a hull; at least one was seen [m]."""
    return float(np.nanmax(solid.distances_m(_points(future, tick, limb))))


def _at_most(vertices_m: Floats, future: RecordedFuture, tick: int, limb: str, enough_m: float) -> float:
    """Returns an upper bound of the same, of the hull of some points, which need not be its corners [m]."""
    return float(farthest_at_most(_points(future, tick, limb), np.ascontiguousarray(vertices_m), enough_m))


def _points(future: RecordedFuture, tick: int, limb: str) -> Floats:
    return future.of_limb(limb, tick).reshape(-1, 3)


def select_rows(
    states: HumanStates, end_ns: int, rate_hz: float, horizon_s: float | Floats, fresh_s: float, first: int = 0
) -> Ints:
    """Selects the rows of the states to check: evenly spaced, with a known person, a whole horizon before the end.

    Args:
        states: (n,) ticks of a run, without a gap.
        end_ns: The last tick of the run or, if later, the last instant of the recording [ns].
        rate_hz: Ticks a second of ``states`` [Hz].
        horizon_s: Horizon of all ticks or of each, with the latency [s].
        fresh_s: Maximum age of the newest frame of a known person [s].
        first: Number of the run's ticks before these.
    """
    every = max(1.0, rate_hz / AUDIT_HZ)
    number = np.arange(first, first + len(states))
    chosen = np.floor(number / every) != np.floor((number - 1) / every)
    chosen &= np.isfinite(states.p).all(axis=1) & (states.frame_age_s <= fresh_s)
    chosen &= np.round(np.asarray(horizon_s) * 1e9) <= end_ns - states.t_ns
    return np.flatnonzero(chosen)


class Coverage:
    """Compares a recorded person with a run's volumes at the checked ticks, part by part of the run."""

    def __init__(self, stage: PredictionStage, person: RecordedPerson, fusion: Fusion, end_ns: int) -> None:
        """Starts before the first tick.

        Args:
            stage: Stage 2.
            person: The recorded person.
            fusion: Settings of stage 1.
            end_ns: The person's last tick [ns].
        """
        self._stage, self._fusion, self._ticks = stage, fusion, 0
        self._limbs = RecordedLimbs.of(person.t_ns, person.points_m)
        self._end_ns = max(end_ns, int(person.t_ns[-1]) if len(person.t_ns) else 0)
        self._outcomes: list[Outcome] = []

    def add(self, states: HumanStates, horizon_s: Floats) -> None:
        """Checks the next ticks.

        Args:
            states: (n,) the person.
            horizon_s: (n,) horizon of each tick's volumes, without the latency; NaN: tick not checked [s].
        """
        until_s, fusion = horizon_s + self._stage.settings.latency_s, self._fusion
        whole_s = np.where(np.isfinite(until_s), until_s, np.inf)
        rows = select_rows(states, self._end_ns, fusion.rate_hz, whole_s, fusion.fresh_s, self._ticks)
        self._ticks += len(states)
        if len(rows):
            asked = states.rows(rows)
            volumes = self._stage.predictor.prepare(asked).volumes(horizon_s[rows])
            future, nobody = self._limbs.future(asked, until_s[rows]), np.zeros(len(rows), dtype=np.bool_)
            radii_m = body_radii_m(self._stage)
            self._outcomes.append(check_containment(volumes, future, radii_m, nobody, sizes=False, exact=False))

    def outcome(self) -> Outcome | None:
        """The outcome so far; None without a checked tick."""
        return Outcome.join(self._outcomes) if self._outcomes else None
