"""Tubes around where the fused velocity takes the limbs: as wide as recorded people were found to depart from it.

Bounds on thirteen joints, each at its worst, enclose two to three times what people do. So a limit set may also bound
how far whole limbs depart from constant velocity (``Departure``), fitted on recordings. The tube of a limb is the hull
of its ends at the tick and after the horizon, raised and lowered as people get up and sit down, with a ball around it:
who stops or slows down stays in that hull. No motion that keeps to the bound leaves the tube, whatever the joints do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hrcreplay.human.model import ARM_POINTS, BENDS, HANDS, HEAD, LEG_POINTS, NECK, PELVIS, LimitSet, skeleton_row
from hrcreplay.kernels import njit
from hrcreplay.records import BODY, Bools, Floats, HumanStates

#: Time step of the difference that gives the velocities of the points [s].
_STEP_S = 1e-4
#: A limb seen longer ago has had so much more time to depart: recorded limbs were as old as this [s].
_FRESH_S = 0.1
#: A larger residual is no noise of one place but another place, which the filter does not believe yet [m].
NOISE_M = 0.2
#: Longest extrapolation at constant velocity, of trunk and legs, and of arms [s].
_CARRIES_S, _CARRIES_ARMS_S = 0.25, 0.15
#: A swinging leg is so many times as fast as the body: it stands for about half of the time.
_STRIDE = 2.0
#: No direction can be told of a hand that is nearer to its wrist [m].
_SHORT_M = 0.02
HEAD_LIMB, THORAX, LEGS = (BODY.index(limb) for limb in ("HD", "THX", "LEGS"))
#: For each limb of BODY, itself and those of LIMBS that carry it: an arm on a torso that nobody sees is anywhere.
_CARRIED_BY = ((0, 1), (1,), (1, 2), (1, 2, 3), (1, 4), (1, 4, 5), (1,))
#: Most points of a tube.
MOST_POINTS = 2 * (len(LEG_POINTS) + 2)
_ARMS = np.array(ARM_POINTS)


class Tubes(NamedTuple):
    """Data of the tubes, a row a tick."""

    points: Floats  #: (n, 20, 3) of ``HumanStates.points_m``
    residual: Floats  #: (n, 7) what is added for each limb of BODY times ``residuals`` [m]
    usable: Bools  #: (n, 7) whether the limb has a tube
    legs_shown: Bools  #: (n,) whether it is known where both knees and ankles are
    legs_m: Floats  #: (n,) how far from the line below the pelvis they were [m]; NaN: not known, or does not count
    reach_s: Floats  #: (n, 7) until when it may depart [s]
    horizon_s: Floats  #: (h,) of ``Departure``
    beyond_m: Floats  #: (7, h)
    residuals: Floats  #: (7, h)
    rise_m: Floats  #: (h,) [m]
    sink_m: Floats  #: (h,) [m]


def tubes(
    states: HumanStates, limits: LimitSet, residual: bool, unknown_m: float, span_s: float, memory_s: float
) -> Tubes:
    """The limbs that have tubes: those seen within the filter's memory, if the limit set bounds departures.

    Args:
        states: The fused person.
        limits: Bounds.
        residual: Whether the distance from the model counts.
        unknown_m: That distance until it is known [m].
        span_s: Horizon and latency [s].
        memory_s: How long the filter goes on without a measurement [s].
    """
    known = limits.departure
    unseen = np.column_stack([states.unseen_s[:, list(carrying)].max(axis=1) for carrying in _CARRIED_BY])
    usable, legs_shown = unseen <= memory_s, np.isfinite(states.points_m[:, BENDS].sum(axis=(1, 2)))
    unseen[legs_shown, LEGS] = np.maximum(unseen, states.unseen_s)[legs_shown, LEGS]
    of = states.residual_m[:, [0, 1, 2, 3, 4, 5, 1]]  # legs have none of their own that tells of departures
    empty = np.zeros((len(BODY), 1))
    return Tubes(
        points=np.ascontiguousarray(states.points_m),
        residual=np.where(np.isnan(of), unknown_m, of) if residual else np.zeros_like(of),
        usable=np.ascontiguousarray(usable if known is not None else np.zeros_like(usable)),
        legs_shown=legs_shown,
        legs_m=np.where(residual, states.residual_m[:, LEGS], np.nan),
        reach_s=span_s + np.clip(unseen - _FRESH_S, 0.0, memory_s),
        horizon_s=np.ones(1) if known is None else np.ascontiguousarray(known.horizon_s),
        beyond_m=empty if known is None else np.ascontiguousarray(known.beyond_m),
        residuals=empty if known is None else np.ascontiguousarray(known.residuals),
        rise_m=np.zeros(1) if known is None else np.ascontiguousarray(known.rise_m),
        sink_m=np.zeros(1) if known is None else np.ascontiguousarray(known.sink_m),
    )


@njit(cache=True)
def departs_m(limb: int, reach_s: float, residual_m: float, at: Tubes) -> float:
    """Largest departure of a limb until ``reach_s`` [m].

    Never less than the residual: the limb may be there already.

    Args:
        limb: Index into BODY.
        reach_s: Since the tick [s].
        residual_m: The limb's residual [m]
        at: Holds the table.
    """
    beyond = _until(reach_s, at.horizon_s, at.beyond_m[limb])
    times = np.interp(reach_s, at.horizon_s, at.residuals[limb])
    return max(residual_m, beyond + times * min(residual_m, NOISE_M) + max(0.0, residual_m - NOISE_M))


@njit(cache=True)
def _until(reach_s: float, horizon_s: Floats, most_m: Floats) -> float:
    """A row (h,) of the table at ``reach_s`` [m].

    Between the horizons that were measured linear, for it grows faster than the horizon; before the first as at it;
    after the last as fast as before it, for people's speeds are bounded.
    """
    found, last = np.interp(reach_s, horizon_s, most_m), len(horizon_s) - 1
    if reach_s > horizon_s[last] and last > 0:
        slope = (most_m[last] - most_m[last - 1]) / (horizon_s[last] - horizon_s[last - 1])
        found += max(0.0, slope) * (reach_s - horizon_s[last])
    return found


@njit(cache=True)
def velocities(p: Floats, v: Floats, lengths: Floats, found: Floats) -> None:
    """Writes the velocities (20, 3) of the model's points [m/s]; NaN where it has none.

    Args:
        p: (13,) posture.
        v: (13,) its velocity.
        lengths: (7,) [m].
        found: (20, 3) receives them.
    """
    later, earlier = np.full(found.shape, np.nan), np.full(found.shape, np.nan)
    skeleton_row(p + _STEP_S * v, lengths, later)
    skeleton_row(p - _STEP_S * v, lengths, earlier)
    found[:] = (later - earlier) / (2.0 * _STEP_S)


@njit(cache=True)
def tube(
    limb: int, points: Floats, velocity: Floats, span_s: float, reach_s: float, hand_m: float, at: Tubes, swept: Floats
) -> int:
    """Writes the points whose hull is a limb's tube before the ball, in place of Alg. 2; returns how many.

    The hand lies along the forearm, and where a camera shows it. Of the lower body the pelvis rises and sinks.

    Args:
        limb: Index into BODY.
        points: (20, 3) where the body's points are [m].
        velocity: (20, 3) of the model's points [m/s].
        span_s: Horizon and latency [s].
        reach_s: Until when the limb may depart, since the tick [s].
        hand_m: Length of the hand beyond the wrist [m].
        at: Holds the table.
        swept: (MOST_POINTS, 3) receives the points.
    """
    carries_s = _CARRIES_S if limb in (HEAD_LIMB, THORAX, LEGS) else _CARRIES_ARMS_S
    unmeasured_s = max(0.0, span_s - at.horizon_s[-1])  # of that nothing is known but the velocity
    n = _ends(limb, points, velocity, min(span_s, carries_s + unmeasured_s), hand_m, swept)
    rising = 2 if limb == LEGS else n
    for i in range(rising):
        swept[n + i] = swept[i]
        swept[n + i, 2] -= _until(reach_s, at.horizon_s, at.sink_m)
        swept[i, 2] += _until(reach_s, at.horizon_s, at.rise_m)
    return n + rising


@njit(cache=True)
def _ends(limb: int, points: Floats, velocity: Floats, span_s: float, hand_m: float, swept: Floats) -> int:
    """Writes where a limb's ends are at the tick and after ``span_s``; returns how many points, the pelvis's first."""
    n = 0
    if limb == HEAD_LIMB:
        n = _add(points[NECK], velocity[NECK], span_s, swept, n)
        return _add(points[HEAD], velocity[HEAD], span_s, swept, n)
    if limb == THORAX:
        for k in (PELVIS, _ARMS[0, 0], _ARMS[1, 0]):
            n = _add(points[k], velocity[k], span_s, swept, n)
        return n
    if limb == LEGS:
        n = _add(points[PELVIS], velocity[PELVIS], span_s, swept, n)
        along = _STRIDE * velocity[PELVIS]
        along[2] = 0.0  # feet stay on the floor
        for k in LEG_POINTS:
            if np.isfinite(points[k].sum()):
                n = _add(points[k], along, span_s, swept, n)
        if not np.isfinite(points[BENDS].sum()):  # somewhere about the line from the floor to the pelvis
            below = points[PELVIS].copy()
            below[2] = 0.0
            n = _add(below, along, span_s, swept, n)
        return n
    return _arm(limb, points, velocity, span_s, hand_m, swept)


@njit(cache=True)
def _arm(limb: int, points: Floats, velocity: Floats, span_s: float, hand_m: float, swept: Floats) -> int:
    n = 0
    arm = (limb - 2) // 2
    shoulder, elbow, wrist = _ARMS[arm]
    if (limb - 2) % 2 == 0:
        n = _add(points[shoulder], velocity[shoulder], span_s, swept, n)
        return _add(points[elbow], velocity[elbow], span_s, swept, n)
    n = _add(points[elbow], velocity[elbow], span_s, swept, n)
    n = _add(points[wrist], velocity[wrist], span_s, swept, n)
    forearm = points[wrist] - points[elbow]
    length = np.sqrt((forearm**2).sum())
    if length > 0.0 and hand_m > 0.0:
        turning = velocity[wrist] + (velocity[wrist] - velocity[elbow]) * (hand_m / length)
        n = _add(points[wrist] + forearm * (hand_m / length), turning, span_s, swept, n)
        bent = points[HANDS[arm]] - points[wrist]
        size = np.sqrt((bent**2).sum())
        if size > _SHORT_M:
            n = _add(points[wrist] + bent * (hand_m / size), turning, span_s, swept, n)
    return n


@njit(cache=True)
def _add(point: Floats, velocity: Floats, span_s: float, swept: Floats, n: int) -> int:
    for i in range(3):
        swept[n, i] = point[i]
        swept[n + 1, i] = point[i] + velocity[i] * span_s
    return n + 2
