"""The smallest velocity and acceleration bounds under which Alg. 1 contains the recorded motion of the joints.

A joint's recorded future lies in its interval if its highest and its lowest position do, so each tick is reduced to
three numbers: the velocity, and the largest displacement up and down within the horizon. For a given velocity bound the
acceleration bound that a tick needs has a closed form, and the number of ticks that may be missed selects one of these
bounds. Of all pairs that miss no more ticks, the fit takes the pair with the shortest mean interval.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.human.model import SHOWN_BY, LimitSet, canonical, clamp, nearest
from hrcreplay.records import DOF, Bools, Floats, HumanStates, Ints, Table

#: A joint that moves less than this within a horizon is at rest [m, m, rad..., m].
STIR = np.array([0.03] * 2 + [np.radians(5.0)] * 10 + [0.03])
#: Minimum number of non-overlapping horizons with motion for the bounds of a joint.
EXCURSIONS = 10
#: Minimum bounds [per second; per second squared], and number of digits to which they are rounded up.
LEAST, _DIGITS = 0.01, 3
#: Number of velocity bounds tried; and relative excess over the shortest mean reach at which one with less acceleration
#: is preferred.
_TRIED, _HARDLY = 48, 1.05
#: Approximate number of steps in which the allowed misses are distributed, and number of doublings of a step.
_STEPS, _DOUBLINGS = 40, 6
#: Approximate lever arm of a joint: makes reaches of different joints comparable [m/m, m/rad].
_LEVER_M = np.array([1.0, 1.0, 0.5, 0.5] + 2 * [0.6, 0.6, 0.4, 0.4] + [1.0])
#: Tolerance for a posture outside its limits [m, m, rad..., m].
_OUTSIDE = np.radians(0.1)
_ROUNDING = 1e-9
#: Joints of both arms in JOINTS.
ARMS = slice(4, 12)


@dataclass(frozen=True)
class Futures(Table):
    """Motion of each joint within the horizon of a tick, relative to the fused state. (n, 13) each.

    x and y are in the body frame at the tick: forward, to the left. NaN if not recorded to the end.
    """

    t_ns: Ints  #: (n,)
    v: Floats  #: estimated velocity [m/s, m/s, rad/s...]
    down: Floats  #: lowest recorded position, from the estimated one [m, m, rad..., m]
    up: Floats  #: highest one

    @property
    def moved(self) -> Floats:
        """Highest minus lowest recorded position."""
        return self.up - self.down


@dataclass(frozen=True)
class Fit:
    """Fitted bounds (13,), and the amount of motion behind them."""

    v_min: Floats
    v_max: Floats
    a_min: Floats
    a_max: Floats
    kept: Bools  #: True: too little motion, so the standard bounds are kept
    excursions: Ints  #: number of horizons with motion

    def onto(self, limits: LimitSet, name: str) -> LimitSet:
        """Makes a limit set with these bounds and the positions of ``limits``."""
        return replace(limits, name=name, v_min=self.v_min, v_max=self.v_max, a_min=self.a_min, a_max=self.a_max)


def futures(
    states: HumanStates, ticks: Ints, t_ns: Ints, joints: Floats, *, horizon_s: float, memory_s: float
) -> Futures:
    """Returns the recorded futures (t, t + T_s] of some ticks.

    Args:
        states: The fused person.
        ticks: (n,) rows of ``states``.
        t_ns: (m,) instants of the recorded joints, increasing.
        joints: (m, 13) recorded JOINTS [m, m, rad..., m].
        horizon_s: T_s [s].
        memory_s: Maximum time since a camera saw a joint at the tick [s].
    """
    at = states.rows(ticks)
    end_ns = at.t_ns + round(horizon_s * 1e9)
    first, last = (np.searchsorted(t_ns, t, side="right") for t in (at.t_ns, end_ns))
    c, s = np.cos(at.p[:, 2]), np.sin(at.p[:, 2])
    low, high = np.full(at.p.shape, np.nan), np.full(at.p.shape, np.nan)
    for i in np.flatnonzero((last > first) & (end_ns <= t_ns[-1])):
        future = joints[first[i] : last[i]]
        now = np.repeat(at.p[i : i + 1], len(future), axis=0)
        apart = _turned(nearest(future, now) - now, c[i], s[i])
        low[i], high[i] = apart.min(axis=0), apart.max(axis=0)
    low, high = recently_seen(low, at.unseen_s, memory_s), recently_seen(high, at.unseen_s, memory_s)
    return Futures(at.t_ns, _turned(at.v, c, s), low, high)


def recently_seen(joints: Floats, unseen_s: Floats, memory_s: float) -> Floats:
    """Sets rows of JOINTS (n, 13) to NaN for limbs that no camera saw recently; ``unseen_s`` (n, 6) by LIMBS."""
    return np.where((unseen_s <= memory_s)[:, SHOWN_BY], joints, np.nan)


def outside_positions(p: Floats, limits: LimitSet) -> Bools:
    """(n,) True if a posture (n, 13) is outside the position limits; False if unknown."""
    named = canonical(p)
    return np.asarray((np.abs(clamp(named, limits) - named) > _OUTSIDE).any(axis=1))


def arms_move(some: Futures) -> Bools:
    """(n,) True if a joint of an arm moves within the horizon."""
    return np.asarray((some.moved > STIR)[:, ARMS].any(axis=1))


def fit(training: Futures, standard: LimitSet, share: float, horizon_s: float) -> Fit:
    """Fits the tightest bounds with which a share of the ticks has all fitted joints inside their intervals.

    Starts from bounds that miss no tick. Then the sides of the joints may miss a few more ticks one after the other,
    always the side whose interval shrinks most per missed tick, until the share is used up.

    Args:
        training: Ticks to fit on.
        standard: Bounds for joints with too little motion.
        share: Share of the ticks, in (0, 1).
        horizon_s: T_s [s].

    Raises:
        LogError: No arm moved.
    """
    excursions = np.array(
        [count_excursions(training.t_ns, training.moved[:, j] > STIR[j], horizon_s) for j in range(DOF)]
    )
    if not arms_move(training).any():
        raise LogError(
            f"found no arm motion: within no horizon of {horizon_s:g} s does a joint of an arm move by "
            f"{np.degrees(STIR[ARMS.start]):.0f} deg; limits are fitted to logs of people at work"
        )
    kept = excursions < EXCURSIONS
    sides = [_Side(training, j, upward, horizon_s) for j in np.flatnonzero(~kept).tolist() for upward in (False, True)]
    ticks = np.isfinite(training.moved[:, ~kept]).any(axis=1).sum()
    if sides:
        _give_up(sides, int((1.0 - share) * ticks + _ROUNDING))
    v, a = np.stack([-standard.v_min, standard.v_max]), np.stack([-standard.a_min, standard.a_max])
    for side in sides:
        at = int(side.upward), side.joint
        v[at], a[at] = side.now.v_bound, side.now.a_bound
    return Fit(-v[0], v[1], -a[0], a[1], kept, excursions)


def inside_intervals(some: Futures, bounds: Fit | LimitSet, horizon_s: float) -> Floats:
    """(n, 13) 1 if the joint stayed in its interval without stops, else 0; NaN if not recorded."""
    high = largest_displacement(some.v, bounds.v_max, bounds.a_max, horizon_s)
    low = -largest_displacement(-some.v, -bounds.v_min, -bounds.a_min, horizon_s)
    within = (some.up <= high) & (some.down >= low)
    return np.where(np.isfinite(some.moved), within.astype(float), np.nan)


def are_all_inside(within: Floats) -> Floats:
    """(n,) 1 if all recorded joints of (n, k) stayed inside, else 0; NaN if none was recorded."""
    return np.where(np.isfinite(within).any(axis=1), (within != 0.0).all(axis=1).astype(float), np.nan)


def largest_displacement(v: Floats, v_bound: Floats, a_bound: Floats, horizon_s: float) -> Floats:
    """(n, k) largest displacement upward from velocities v under bounds, by Alg. 1 with Eq. (40); at least 0.

    Args:
        v: (n, k) velocities at the tick [m/s, m/s, rad/s...].
        v_bound: (k,) largest velocities [m/s, m/s, rad/s...].
        a_bound: (k,) largest accelerations [m/s^2, m/s^2, rad/s^2...].
        horizon_s: T_s [s].
    """
    t_star = np.clip((v_bound - v) / a_bound, 0.0, horizon_s)
    return np.maximum(v * t_star + 0.5 * a_bound * t_star**2 + v_bound * (horizon_s - t_star), 0.0)


@dataclass(frozen=True)
class _Pair:
    """Bounds of one side."""

    v_bound: float
    a_bound: float
    length: float  #: shortest mean reach over the ticks, with this number of misses [m] or [rad]
    missed: Ints  #: (n,) 1 if the joint moved further


class _Side:
    """One joint's motion upward, or downward with the signs changed, and its allowed number of misses."""

    def __init__(self, some: Futures, joint: int, upward: bool, horizon_s: float) -> None:
        self.joint, self.upward = joint, upward
        v, gone = (some.v, some.up) if upward else (-some.v, -some.down)
        self._v, self._gone, self._horizon_s = v[:, joint], gone[:, joint], horizon_s
        self._known: dict[int, _Pair] = {}
        self.misses = 0

    @property
    def now(self) -> _Pair:
        """The bounds with the present number of misses."""
        return self.with_misses(self.misses)

    def with_misses(self, misses: int) -> _Pair:
        """Returns the bounds with a number of misses."""
        if misses not in self._known:
            self._known[misses] = self._tightest(misses)
        return self._known[misses]

    def _tightest(self, misses: int) -> _Pair:
        """Returns the pair with the shortest mean reach; among similar ones, that with the least acceleration."""
        known = np.isfinite(self._gone)
        v, gone, horizon_s = self._v[known], self._gone[known], self._horizon_s
        rank = max(0, len(v) - 1 - misses)
        slowest = max(float(np.partition(gone, rank)[rank]) / horizon_s, LEAST)
        free = float(np.partition(least_acceleration(v, gone, np.inf, horizon_s), rank)[rank])
        tried = rounded_up(np.geomspace(slowest, max(float(v.max()) + free * horizon_s, slowest), _TRIED))
        needed = np.array([np.partition(least_acceleration(v, gone, bound, horizon_s), rank)[rank] for bound in tried])
        tried, a = tried[np.isfinite(needed)], rounded_up(np.maximum(needed[np.isfinite(needed)], LEAST))
        lengths = largest_displacement(v[:, None], tried, a, horizon_s).mean(axis=0)
        k = np.argmin(np.where(lengths <= _HARDLY * lengths.min(), a, np.inf))
        reached = largest_displacement(self._v[:, None], tried[k : k + 1], a[k : k + 1], horizon_s)[:, 0]
        return _Pair(float(tried[k]), float(a[k]), float(lengths.min()), (known & (self._gone > reached)).astype(int))


def _give_up(sides: list[_Side], budget: int) -> None:
    """Tightens sides while at most ``budget`` ticks are missed in total.

    Tries steps of several sizes, because a fast motion lasts several ticks: to miss only one of them lowers no bound.
    """
    missed = np.sum([side.now.missed for side in sides], axis=0)
    smallest = max(1, budget // _STEPS)
    steps = [smallest << k for k in range(_DOUBLINGS) if smallest << k <= budget]
    while True:
        best, most = None, 0.0
        lost = np.count_nonzero(missed)
        for side in sides:
            for step in steps:
                then = side.with_misses(side.misses + step)
                more = np.count_nonzero(missed + then.missed - side.now.missed) - lost
                gain = _LEVER_M[side.joint] * (side.now.length - then.length) / max(more, 0.5)
                if lost + more <= budget and gain > most:
                    best, most = (side, step), gain
        if best is None:
            return
        side, step = best
        missed = missed - side.now.missed
        side.misses += step
        missed = missed + side.now.missed


def least_acceleration(v: Floats, gone: Floats, bound: float, horizon_s: float) -> Floats:
    """(n,) smallest acceleration bound with which Alg. 1 reaches ``gone``; inf if none does.

    Either the joint accelerates during the whole horizon, gone = v T + a T^2 / 2, or it reaches the velocity bound V,
    and the area between V and the profile is a triangle: V T - gone = (V - v)^2 / (2 a).

    Args:
        v: (n,) velocities at the tick [m/s] or [rad/s].
        gone: (n,) largest displacement within the horizon [m] or [rad].
        bound: Velocity bound V [m/s] or [rad/s]; inf: none.
        horizon_s: T_s [s].
    """
    whole = np.maximum(2.0 * (gone - v * horizon_s) / horizon_s**2, 0.0)
    if bound == np.inf:
        return np.where(gone <= 0.0, 0.0, whole)
    lacks = bound * horizon_s - gone
    bent = np.where(lacks > 0.0, (bound - v) ** 2 / (2.0 * np.maximum(lacks, 1e-12)), np.inf)
    rising = np.where(v + whole * horizon_s <= bound, whole, bent)
    return np.where(gone <= 0.0, 0.0, np.where(v < bound, rising, np.where(lacks >= 0.0, 0.0, np.inf)))


def rounded_up(values: Floats) -> Floats:
    """Rounds positive values up to a few digits, as the shortest decimals."""
    digits = _DIGITS - 1 - np.floor(np.log10(values)).astype(int)
    return np.array(
        [np.round(np.ceil(x * 10.0**n - _ROUNDING) / 10.0**n, n) for x, n in zip(values, digits.tolist(), strict=True)]
    )


def count_excursions(t_ns: Ints, moving: Bools, horizon_s: float) -> int:
    """Counts moving ticks with non-overlapping futures."""
    count, free_ns = 0, -1
    for t in t_ns[moving].tolist():
        if t >= free_ns:
            count, free_ns = count + 1, t + round(horizon_s * 1e9)
    return count


def _turned(rows: Floats, c: Floats, s: Floats) -> Floats:
    """Returns rows (n, 13) of JOINTS or their rates with x and y along the body's axes, Eq. (33)."""
    turned = rows.copy()
    turned[:, 0], turned[:, 1] = c * rows[:, 0] + s * rows[:, 1], c * rows[:, 1] - s * rows[:, 0]
    return turned
