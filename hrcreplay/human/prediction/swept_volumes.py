"""Reachable intervals of the joints within the horizon, and swept volumes of the limbs: Eq. (18)-(30), Alg. 1, Alg. 2.

Corrections: docs/paper.md. With ``sound``, both enclose every motion of Eq. (25), see ``sound_volumes``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hrcreplay.errors import SettingsError
from hrcreplay.geometry.hull_reduction import Surface, keep_corners, surface
from hrcreplay.human.model import (
    ALPHA_2,
    ALPHA_3,
    HEIGHT,
    RHO,
    SHOWN_BY,
    THX,
    LimitSet,
    alpha_2_bounds,
    alpha_3_bounds,
    bounds_of,
)
from hrcreplay.human.prediction.shown_points import SHOWN_S, around_points, bound_by_seen, count_by_points
from hrcreplay.human.prediction.sound_reach import SoundMotionLimits, enclose, start_states
from hrcreplay.human.prediction.sound_volumes import SoundRows, SoundRules, sound_rows, sound_rules, sweep_sound
from hrcreplay.human.prediction.sweep import (
    MOST_COPIES,
    TRIANGLE_RAD,
    append,
    box,
    kinematic_chain,
    sweep_rot,
    sweep_walk,
)
from hrcreplay.kernels import Held, hold, njit
from hrcreplay.records import BODY, DOF, LIMBS, Bools, Floats, HumanStates, Ints, SweptVolumes, Table
from hrcreplay.settings.sections import Prediction

#: Methods of prediction, in the order of their codes in the kernels: two from the literature, and ``sound``.
PRINTED = ("paper", "positions")
METHODS = (*PRINTED, "sound")
PAPER, SOUND = METHODS.index("paper"), METHODS.index("sound")


@dataclass(frozen=True)
class Reach(Table):
    """Reachable interval of every joint, one row per tick, Eq. (36), (38), (39), with the current posture, Eq. (40)."""

    t_ns: Ints  #: (n,)
    low: Floats  #: (n, 13) JOINTS [m, m, rad..., m]; NaN if the state is NaN
    high: Floats  #: (n, 13)


class MotionLimits(NamedTuple):
    """Bounds on the motions in a printed method."""

    bounds: Floats  #: (6, 13) of ``bounds_of``
    coupled: bool  #: True: Eq. (34b), (34c) hold
    horizon: float  #: braking time T_s of the robot [s]
    method: int  #: index into METHODS of one of PRINTED


def reachable(
    states: HumanStates, limits: LimitSet, prediction: Prediction, *, horizon_s: float, memory_s: float
) -> Reach:
    """Reachable sets within the horizon, Eq. (36), (38), (39), joint by joint.

    ``paper``: Eq. (20)-(30), corrected, for walking and Alg. 1 for the other joints: from positions, velocities and
    bounds on velocity and acceleration. ``positions``: the older method of [26], from positions and velocity bounds.
    Both keep the angles within their limits, with Eq. (34b), (34c) evaluated over the reachable intervals of the joints
    they depend on; a posture outside the limits stays included. In every method, an arm joint that was never measured
    may be anywhere within its limits. ``sound``: every motion within the limits from every likely state, at all times
    until the end of horizon and latency; x and y lie in a polygon, see ``sound_reach``.

    Args:
        states: The fused person.
        limits: Bounds.
        prediction: Method, one of METHODS, and the margins of ``sound``; the printed methods add nothing.
        horizon_s: Braking time T_s of the robot [s].
        memory_s: Time for which the filter continues without a measurement [s].

    Raises:
        SettingsError: The method is unknown.
    """
    code = code_of(prediction.method)
    if code == SOUND:
        within = SoundMotionLimits(bounds_of(limits), limits.coupled, horizon_s + prediction.latency_s, memory_s)
        low, high = enclose(start_states(states, prediction, memory_s), within)
        return Reach(states.t_ns, low, high)
    low, high = np.empty_like(states.p), np.empty_like(states.p)
    p, v = np.ascontiguousarray(states.p), np.ascontiguousarray(states.v)
    allowed = MotionLimits(bounds_of(limits), limits.coupled, horizon_s, code)
    _reach_rows(p, v, find_never_measured(states), allowed, low, high)
    return Reach(states.t_ns, low, high)


def find_never_measured(states: HumanStates) -> Bools:
    """(n, 13) True for joints that no camera has observed yet: the filter only has their prior."""
    return np.ascontiguousarray(np.isinf(states.unseen_s)[:, SHOWN_BY])


def code_of(method: str) -> int:
    """Returns the code of a method of METHODS in the kernels.

    Raises:
        SettingsError: The method is unknown.
    """
    if method not in METHODS:
        raise SettingsError(f"prediction.method: found {method!r}; choose one of {', '.join(METHODS)}")
    return METHODS.index(method)


@njit(cache=True)
def _reach_rows(p: Floats, v: Floats, never: Bools, within: MotionLimits, low: Floats, high: Floats) -> None:
    for i in range(len(p)):
        reach_row(p[i], v[i], never[i], within, low[i], high[i])


@njit(cache=True, inner=True)
def reach_row(p: Floats, v: Floats, never: Bools, within: MotionLimits, low: Floats, high: Floats) -> None:
    """Writes the reachable interval of every joint from p, v (13,) into low, high (13,).

    Alg. 1 and its clipping to Eq. (34), (35); walking is Eq. (18)-(30).

    Args:
        p: (13,) JOINTS [m, m, rad..., m].
        v: (13,) their velocities [m/s, m/s, rad/s...].
        never: (13,) True if no camera has ever observed the joint.
        within: Bounds on the motions.
        low: (13,) receives the lower ends [m, m, rad..., m].
        high: (13,) receives the upper ends [m, m, rad..., m].
    """
    bounds, coupled, horizon, method = within
    _walk(p, v, bounds, horizon, method, low, high)
    low[HEIGHT], high[HEIGHT] = p[HEIGHT], p[HEIGHT]  # a constant length in the paper
    for j in range(RHO, HEIGHT):
        if method == PAPER:
            low[j], high[j] = _joint(p[j], v[j], bounds[2:, j], horizon)
        else:
            low[j], high[j] = p[j] + bounds[2, j] * horizon, p[j] + bounds[3, j] * horizon
        least, most = bounds[0, j], bounds[1, j]
        if coupled and j in ALPHA_2:
            least, most = alpha_2_bounds(low[j - 1], high[j - 1])
        elif coupled and j in ALPHA_3:
            least, most = alpha_3_bounds(low[j - 2], high[j - 2], low[j - 1], high[j - 1])
        if never[j]:
            low[j], high[j] = least, most
        elif not np.isnan(low[j] + high[j]):
            low[j], high[j] = max(least, min(low[j], most)), max(least, min(high[j], most))
        _include(p, j, low, high)


@njit(cache=True, inner=True)
def _include(p: Floats, j: int, low: Floats, high: Floats) -> None:
    """Eq. (40), the ends sorted first; an interval with a NaN anywhere is NaN at both ends."""
    if np.isnan(p[j] + low[j] + high[j]):
        low[j], high[j] = np.nan, np.nan
    else:
        low[j], high[j] = min(p[j], low[j], high[j]), max(p[j], low[j], high[j])


@njit(cache=True, inner=True)
def _joint(p: float, v: float, bounds: Floats, horizon: float) -> tuple[float, float]:
    """Alg. 1, corrected, for one joint; its bounds are v_min, v_max, a_min, a_max."""
    return _farthest(p, v, bounds[0], bounds[2], horizon), _farthest(p, v, bounds[1], bounds[3], horizon)


@njit(cache=True, inner=True)
def _farthest(p: float, v: float, v_bound: float, a_bound: float, horizon: float) -> float:
    """Position of a joint that accelerates at its bound until it reaches its velocity bound at T* of Alg. 1."""
    t_star = max(0.0, min((v_bound - v) / a_bound, horizon))  # an estimate over the bound has T* < 0
    if t_star == horizon:
        return p + v * horizon + 0.5 * a_bound * horizon**2
    return p + v * t_star + 0.5 * a_bound * t_star**2 + v_bound * (horizon - t_star)


@njit(cache=True, inner=True)
def _walk(p: Floats, v: Floats, bounds: Floats, horizon: float, method: int, low: Floats, high: Floats) -> None:
    """Eq. (18)-(30), corrected: x, y and heading.

    The bounds of x and y are those of v and v_perp, so the velocity is turned into the body frame, Eq. (33), and the
    displacements back, Eq. (32). beta = omega T_s; (27), (28) take the lateral acceleration; the two displacements
    add up as intervals, whatever the signs of cos(theta) and sin(theta).
    """
    c, s = np.cos(p[2]), np.sin(p[2])
    least, most = bounds[2, :3].copy(), bounds[3, :3].copy()
    if method == PAPER:
        body = (c * v[0] + s * v[1], c * v[1] - s * v[0], v[2])
        for k in range(3):
            gain = bounds[5, k] * horizon  # Eq. (27), (28), corrected: k = 1 is the lateral acceleration
            most[k] = min(body[k] + gain, most[k])
            if k > 0:  # as printed, a walker can stop at once: v^min is the bound, independent of the acceleration
                least[k] = max(body[k] + bounds[4, k] * horizon, least[k])
    ahead = (least[0] * horizon, most[0] * horizon)
    left = (least[1] * horizon, most[1] * horizon)
    low[0], high[0] = _sum(p[0], c, ahead, -s, left)  # Eq. (22), (29)
    low[1], high[1] = _sum(p[1], s, ahead, c, left)  # Eq. (23), (30)
    low[2], high[2] = p[2] + least[2] * horizon, p[2] + most[2] * horizon  # Eq. (20), (21), corrected, (24)
    for k in range(3):
        _include(p, k, low, high)


@njit(cache=True, inner=True)
def _sum(start: float, f: float, a: tuple[float, float], g: float, b: tuple[float, float]) -> tuple[float, float]:
    """Interval start + f a + g b."""
    low = start + min(f * a[0], f * a[1]) + min(g * b[0], g * b[1])
    high = start + max(f * a[0], f * a[1]) + max(g * b[0], g * b[1])
    return low, high


#: Size above which a set is reduced before the next rotation; for smaller sets it is faster to keep all points.
_WORTH_REDUCING = 50
#: Size above which the result is reduced once more; walking adds few redundant points unless the heading range is
#: large.
_TOO_MANY = 256


def limb_radii(prediction: Prediction) -> Floats:
    """(6,) radii of the limbs, Eq. (41), Table 2, in the order of LIMBS [m]."""
    upper, lower = prediction.radius_upper_arm_m, prediction.radius_lower_arm_m
    return np.array([prediction.radius_head_m, prediction.radius_thorax_m, upper, lower, upper, lower])


def limbs_of(prediction: Prediction) -> tuple[str, ...]:
    """Limbs that have volumes under these settings."""
    return BODY if code_of(prediction.method) == SOUND and prediction.legs else LIMBS


def predict(
    states: HumanStates,
    limits: LimitSet,
    prediction: Prediction,
    *,
    horizon_s: float,
    memory_s: float,
) -> SweptVolumes:
    """Computes swept volumes of all limbs from the reachable sets of the joints: Alg. 2, or ``sound``.

    Args:
        states: The fused person; the result of a row does not depend on the other rows.
        limits: Bounds on the joints.
        prediction: Method, radii of Table 2, and the margins of ``sound``; the printed methods add nothing.
        horizon_s: Braking time T_s of the robot [s].
        memory_s: Time for which the filter continues without a measurement [s].

    Returns:
        Points whose convex hulls are those of Alg. 2; they include every corner of a hull and few other points. For
        ``sound``, points whose hulls enclose all motions; with ``prediction.legs`` the last limb is ``LEGS``. A limb
        whose state or lengths are NaN has one NaN vertex.

    Raises:
        SettingsError: The method is unknown.
    """
    return Predictor(limits, prediction, memory_s).prepare(states).volumes(horizon_s)


@dataclass(frozen=True)
class Predictor:
    """Swept volumes under some settings, for any person and horizon; see ``predict``."""

    limits: LimitSet
    prediction: Prediction
    memory_s: float  #: time for which the filter continues without a measurement [s]

    def prepare(self, states: HumanStates) -> PreparedPerson:
        """Computes what the volumes of all horizons have in common.

        Raises:
            SettingsError: The method is unknown.
        """
        sound = code_of(self.prediction.method) == SOUND
        rows, held = sound_rows(states, self.prediction, self.rules, self.how) if sound else (None, None)
        return PreparedPerson(self, states, rows, held)

    @cached_property
    def limbs(self) -> tuple[str, ...]:
        """Limbs that have volumes."""
        return limbs_of(self.prediction)

    @cached_property
    def limbs_m(self) -> Floats:
        """(6,) radii of the limbs [m]."""
        return limb_radii(self.prediction)

    @cached_property
    def rules(self) -> SoundRules:
        """Settings and bounds of ``sound``."""
        return sound_rules(self.limits, self.prediction, self.limbs_m, self.memory_s)

    @cached_property
    def how(self) -> Held:
        """Rules and surface for kernels that compute volumes."""
        return hold((self.rules, self.work))

    @cached_property
    def work(self) -> Surface:
        """Memory of the kernels."""
        return surface()


@dataclass(frozen=True)
class PreparedPerson:
    """The person of some ticks, prepared for volumes at any horizon."""

    predictor: Predictor
    states: HumanStates
    rows: SoundRows | None  #: None for the printed methods
    held: Held | None  #: the same, with the rules, for kernels that compute volumes; None likewise

    def volumes(self, horizon_s: float | Floats, first: int = 0, last: int | None = None) -> SweptVolumes:
        """Computes the swept volumes of the ticks ``first`` to ``last`` - 1; see ``predict``.

        Args:
            horizon_s: Time after each tick until which they hold, for all or (n,) for each [s].
            first: First tick.
            last: Tick after the last one; None: all.
        """
        last, prediction = len(self.states) if last is None else last, self.predictor.prediction
        until_s = np.full(last - first, horizon_s, dtype=np.float64)
        found = self._filtered(until_s, first, last)
        if self._has_by_points and self.by_points[first:last].any():
            states = self.states.rows(slice(first, last))
            found = around_points(found, states, prediction, self.predictor.limbs_m, until_s)
        if self.rows is not None and self._has_partly_seen and self.partly_seen[first:last].any():
            rows = np.flatnonzero(self.partly_seen[first:last])
            states, radii_m = self.states.rows(slice(first, last)), self.rows.radii[first:last]
            found = bound_by_seen(found, states, radii_m, rows, prediction, until_s)
        return found

    @cached_property
    def by_points(self) -> Bools:
        """(n,) True for rows of bodies that count by their points alone."""
        return count_by_points(self.states)

    @cached_property
    def partly_seen(self) -> Bools:
        """(n,) True for known people whose torso is out of sight."""
        if self.rows is None or not self.predictor.rules.bounded or self.states.camera_points_m is None:
            return np.zeros(len(self.states), dtype=np.bool_)
        lost = self.states.unseen_s[:, THX] > SHOWN_S
        return np.asarray(lost & np.isfinite(self.states.p[:, 0]))

    @cached_property
    def _has_by_points(self) -> bool:
        return bool(self.by_points.any())

    @cached_property
    def _has_partly_seen(self) -> bool:
        return bool(self.partly_seen.any())

    def _filtered(self, horizon_s: Floats, first: int, last: int) -> SweptVolumes:
        """Volumes from the filtered states; unknown for bodies that have none."""
        t_ns, prediction = self.states.t_ns[first:last], self.predictor.prediction
        if self.held is None:
            return self._printed(self.states.rows(slice(first, last)), horizon_s)
        span_s = horizon_s + prediction.latency_s
        vertices, offsets, radii = sweep_sound(self.held, first, last, span_s)
        return SweptVolumes(t_ns, offsets, vertices, radii, self.predictor.limbs, prediction.method)

    def _printed(self, states: HumanStates, horizon_s: Floats) -> SweptVolumes:
        limits, method = self.predictor.limits, self.predictor.prediction.method
        vertices, offsets = _predict_rows(
            np.ascontiguousarray(states.p),
            np.ascontiguousarray(states.v),
            find_never_measured(states),
            np.ascontiguousarray(states.lengths_m),
            horizon_s,
            MotionLimits(bounds_of(limits), limits.coupled, 0.0, code_of(method)),
            self.predictor.work,
        )
        radii = np.tile(self.predictor.limbs_m, (len(states), 1))
        return SweptVolumes(states.t_ns, offsets, vertices, radii, LIMBS, method)


@njit(cache=True)
def _predict_rows(
    p: Floats, v: Floats, never: Bools, lengths: Floats, horizon_s: Floats, within: MotionLimits, work: Surface
) -> tuple[Floats, Ints]:
    limbs = 6
    offsets = np.zeros(len(p) * limbs + 1, np.int64)
    vertices = np.empty((len(p) * 256 + 256, 3))
    low, high = np.empty(DOF), np.empty(DOF)
    n = 0
    for i in range(len(p)):
        until = MotionLimits(within.bounds, within.coupled, horizon_s[i], within.method)
        reach_row(p[i], v[i], never[i], until, low, high)
        for limb in range(limbs):
            swept, count = _sweep_limb(limb, low, high, lengths[i], work)
            vertices = append(vertices, n, swept, count)
            n += count
            offsets[i * limbs + limb + 1] = n
    return vertices[:n].copy(), offsets


@njit(cache=True, inner=True)
def _sweep_limb(limb: int, low: Floats, high: Floats, lengths: Floats, work: Surface) -> tuple[Floats, int]:
    """Applies Alg. 2 to one limb, given the reachable intervals (13,) and the lengths (7,)."""
    points, chain = kinematic_chain(limb, low, high, lengths)
    if not np.isfinite(points.sum() + chain.sum() + low[:3].sum() + high[:3].sum()):
        return np.full((1, 3), np.nan), 1
    count, faces = len(points), 0
    for k, step in enumerate(chain):
        swept = np.empty((MOST_COPIES * count, 3))
        count = sweep_rot(points, count, int(step[0]), step[1], step[2], swept, TRIANGLE_RAD)
        points = swept
        for i in range(count):
            for axis in range(3):
                points[i, axis] += step[3 + axis]
        if count > _WORTH_REDUCING or k == len(chain) - 1:
            count, faces = keep_corners(points, count, work)
    swept = np.empty((4 * MOST_COPIES * count, 3))
    count = sweep_walk(points, count, faces, work, (low[2], high[2]), box(low, high), swept, TRIANGLE_RAD)
    if count > _TOO_MANY:
        count, faces = keep_corners(swept, count, work)
    return swept, count
