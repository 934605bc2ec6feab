"""Motions that obey the model.

A joint wishes for an acceleration. It gets it until its velocity is at a bound, and then keeps that velocity.

Position limits: a *careful* motion brakes in time. One that would nevertheless cross a limit (reckless, too fast from
the start, or met by a limit of the coupling (34) that moves) is followed only until there, since to stop at once takes
a deceleration without bound. So all that is measured obeys every bound at every instant before it.

Two things more can be had that no bound allows but that happen to estimates and to people (*beyond*): a velocity above
its bound comes back at the acceleration bound, and a joint that meets a limit loses its velocity and goes on from rest.
"""

from __future__ import annotations

import math

import numpy as np

from hrcreplay.records import DOF, Floats, Ints
from tests.tools.soundness.compiled import kernel
from tests.tools.soundness.joint import P_MAX, P_MIN, V_MAX, V_MIN, Rates, accelerate, along, rates_of, stops_at
from tests.tools.soundness.walking import walk

#: Joints whose limits are checked together: the torso, the right arm, the left arm, the pelvis's height. First joint
#: and one past the last.
GROUPS = ((3, 4), (4, 8), (8, 12), (12, 13))
_DEGREE = math.pi / 180.0
#: Halvings in search of the last instant to brake, and the finest steps towards a limit: to end there, to rest there.
_HALVINGS = 10
_FINEST, _EXACT = 2.0**-7, 2.0**-40
#: More steps are not spent on one limit: what lasted so far is what lasts.
_TRIALS = 200

Range = tuple[float, float]
#: Careful or not, and whether limits bring joints to rest.
Style = tuple[bool, bool]
#: For how long [s], and whether a limit was met.
Moved = tuple[float, bool]


@kernel
def step(
    q: Floats, v: Floats, wish: Floats, h: float, style: Style, ended: Ints, bounds: Floats, work: Floats
) -> Moved:
    """Moves the whole body on, by ``h`` [s] or until something happens to a joint.

    Args:
        q: (13,) posture, heading and place in the world; moved in place [m, m, rad...].
        v: (13,) velocities, the first two forward and to the left [m/s, m/s, rad/s...].
        wish: (13,) accelerations.
        h: How long at most [s].
        style: Whether joints brake in time for their limits, and whether a limit brings a joint to rest.
        ended: (4,) which of GROUPS are no longer followed; set for one that meets a limit.
        bounds: (6, 13).
        work: (8, 13) scratch.

    Returns:
        How long it moved [s], and whether a limit was met.
    """
    careful, stops = style
    h = _come_back(v, wish, h, bounds, work[7])
    wish, until = work[7], work[0]
    until[:] = h
    if careful:
        _brake_in_time(q, v, wish, h, bounds, until, work[1], work[2])
    finest = _EXACT if stops else _FINEST
    lasts = (
        h if ended[0] else _lasts(q, v, wish, h, 0, finest, bounds, work),
        h if ended[1] else _lasts(q, v, wish, h, 1, finest, bounds, work),
        h if ended[2] else _lasts(q, v, wish, h, 2, finest, bounds, work),
        h if ended[3] else _lasts(q, v, wish, h, 3, finest, bounds, work),
    )
    moved = min(lasts)
    met = moved < h
    for g in range(len(GROUPS)):
        if not ended[g]:
            for j in range(GROUPS[g][0], GROUPS[g][1]):
                q[j], v[j], _, _ = along(q[j], v[j], wish[j], until[j], moved, rates_of(bounds, j))
                until[j] = max(0.0, until[j] - moved)
            if lasts[g] == moved and met:
                ended[g] = not (stops and _rest(q, v, wish, until, h * _EXACT, g, bounds))
                if ended[g]:
                    v[GROUPS[g][0] : GROUPS[g][1]] = 0.0
    walk(q, v, wish, moved, bounds)
    for j in range(DOF):  # not to come back for ever
        for bound in (bounds[V_MIN, j], bounds[V_MAX, j]):
            if abs(v[j] - bound) < 1e-12:
                v[j] = bound
    return moved, met


@kernel
def _come_back(v: Floats, wish: Floats, h: float, bounds: Floats, effective: Floats) -> float:
    """Writes the wishes (13,), those of joints above a velocity bound replaced; how long they hold, at most h [s]."""
    for j in range(DOF):
        v_min, v_max, a_min, a_max = rates_of(bounds, j)
        effective[j] = wish[j]
        if v[j] > v_max:
            effective[j], h = a_min, min(h, (v_max - v[j]) / a_min)
        elif v[j] < v_min:
            effective[j], h = a_max, min(h, (v_min - v[j]) / a_max)
    return h


@kernel
def _rest(q: Floats, v: Floats, wish: Floats, until: Floats, dt: float, group: int, bounds: Floats) -> bool:
    """Takes their velocity from the joints that meet a limit within dt; False where that does not help."""
    first, end = GROUPS[group]
    low, high = np.empty(DOF), np.empty(DOF)
    helped = False
    for j in range(first, end):
        _, _, low[j], high[j] = along(q[j], v[j], wish[j], until[j], dt, rates_of(bounds, j))
    for j in range(first, end):
        least, most = allowed(j, low, high, bounds)
        if (low[j] < least and v[j] < 0.0) or (high[j] > most and v[j] > 0.0):
            v[j], helped = 0.0, True
    return helped


@kernel
def _brake_in_time(
    q: Floats, v: Floats, wish: Floats, h: float, bounds: Floats, until: Floats, low: Floats, high: Floats
) -> None:
    """Writes how long each joint may do as it wishes; the coupled ones after those that they depend on."""
    for j in range(3, DOF):
        least, most = allowed(j, low, high, bounds)
        rates = rates_of(bounds, j)
        until[j] = _last_moment(q[j], v[j], wish[j], h, least, most, rates)
        _, _, low[j], high[j] = along(q[j], v[j], wish[j], until[j], h, rates)


@kernel
def _last_moment(q: float, v: float, wish: float, h: float, least: float, most: float, rates: Rates) -> float:
    if _can_stop(q, v, wish, h, least, most, rates):
        return h
    if not _can_stop(q, v, wish, 0.0, least, most, rates):
        return 0.0
    good, bad = 0.0, h
    for _ in range(_HALVINGS):
        middle = 0.5 * (good + bad)
        if _can_stop(q, v, wish, middle, least, most, rates):
            good = middle
        else:
            bad = middle
    return good


@kernel
def _can_stop(q: float, v: float, wish: float, t: float, least: float, most: float, rates: Rates) -> bool:
    """Whether a joint that does as it wishes for t stays within its limits, and still can after that."""
    q, v, low, high = accelerate(q, v, wish, t, rates)
    return least <= low and high <= most and least <= stops_at(q, v, rates) <= most


@kernel
def _lasts(
    q: Floats, v: Floats, wish: Floats, h: float, group: int, finest: float, bounds: Floats, work: Floats
) -> float:
    """How long a group's motion surely stays within the limits, at the latest h [s]."""
    first, end = GROUPS[group]
    until, low, high, q_now, v_now, q_next, v_next, _ = work
    for j in range(first, end):
        _, _, low[j], high[j] = along(q[j], v[j], wish[j], until[j], h, rates_of(bounds, j))
    if within(low, high, first, end, bounds):
        return h
    for j in range(first, end):
        q_now[j], v_now[j] = q[j], v[j]
    t, dt = 0.0, 0.5 * h
    for _ in range(_TRIALS):
        for j in range(first, end):
            q_next[j], v_next[j], low[j], high[j] = along(
                q_now[j], v_now[j], wish[j], max(0.0, until[j] - t), dt, rates_of(bounds, j)
            )
        if not within(low, high, first, end, bounds):
            dt *= 0.5
            if dt < finest * h:
                break
            continue
        if dt >= h - t:
            return h
        t += dt
        dt = min(2.0 * dt, h - t)
        for j in range(first, end):
            q_now[j], v_now[j] = q_next[j], v_next[j]
    return t


@kernel
def within(low: Floats, high: Floats, first: int, end: int, bounds: Floats) -> bool:
    """Whether all postures of a box, (13,) each, are within the limits of one group of joints."""
    for j in range(first, end):
        least, most = allowed(j, low, high, bounds)
        if low[j] < least or high[j] > most:
            return False
    return True


@kernel
def allowed(j: int, low: Floats, high: Floats, bounds: Floats) -> Range:
    """Position limits of a joint that hold whatever the joints before it do in their ranges (13,) [m, m, rad...]."""
    if not np.isnan(bounds[P_MIN, j]):
        return bounds[P_MIN, j], bounds[P_MAX, j]
    if j in (5, 9):  # Eq. (34b)
        return high[j - 1] / 3.0 - 43.0 * _DEGREE, 153.0 * _DEGREE - high[j - 1] / 6.0
    least, most = -np.inf, np.inf
    for a in (low[j - 2] / _DEGREE, high[j - 2] / _DEGREE):  # Eq. (34c) is linear in each, so corners tell
        for b in (low[j - 1] / _DEGREE, high[j - 1] / _DEGREE):
            least = max(least, -90.0 + 7.0 / 9.0 * a - b / 9.0 + 2.0 / 810.0 * a * b)
            most = min(most, 60.0 + 4.0 / 9.0 * a - 5.0 / 9.0 * b + 5.0 / 810.0 * a * b)
    return least * _DEGREE, most * _DEGREE
