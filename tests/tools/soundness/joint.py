"""One joint's motion, exactly: pieces of constant acceleration between bounds."""

from __future__ import annotations

import numpy as np

from hrcreplay.human.model import LimitSet
from hrcreplay.records import Floats
from tests.tools.soundness.compiled import kernel

#: Rows of bounds, (6, 13). The first two are NaN where (34b), (34c) tell instead.
P_MIN, P_MAX, V_MIN, V_MAX, A_MIN, A_MAX = range(6)

#: Smallest and largest velocity, smallest and largest acceleration of one joint.
Rates = tuple[float, float, float, float]


def bounds_of(limits: LimitSet) -> Floats:
    """(6, 13) bounds of all joints; x and y bound the forward and lateral motion of the body."""
    bounds = np.stack([limits.p_min, limits.p_max, limits.v_min, limits.v_max, limits.a_min, limits.a_max])
    if limits.coupled:
        bounds[:2, [5, 6, 9, 10]] = np.nan
    return bounds


@kernel
def rates_of(bounds: Floats, j: int) -> Rates:
    return bounds[V_MIN, j], bounds[V_MAX, j], bounds[A_MIN, j], bounds[A_MAX, j]


@kernel
def along(q: float, v: float, wish: float, until: float, h: float, rates: Rates) -> tuple[float, float, float, float]:
    """A joint that accelerates as it wishes for ``until`` and then brakes: position, velocity, and the range passed."""
    q, v, low, high = accelerate(q, v, wish, min(until, h), rates)
    if h > until and v != 0.0:
        a = rates[2] if v > 0.0 else rates[3]
        rest = -v / a
        t = min(h - until, rest)
        q += v * t + 0.5 * a * t * t
        v = 0.0 if t == rest else v + a * t
    return q, v, min(low, q), max(high, q)


@kernel
def accelerate(q: float, v: float, a: float, h: float, rates: Rates) -> tuple[float, float, float, float]:
    """A joint that accelerates until its velocity is at a bound: position, velocity, and the range passed."""
    t = saturates(v, a, h, rates)
    v_end = v + a * t
    if t < h:
        v_end = rates[1] if a > 0.0 else rates[0]
    q_end = q + v * t + 0.5 * a * t * t + v_end * (h - t)
    low, high = min(q, q_end), max(q, q_end)
    if a != 0.0 and 0.0 < -v / a < t:
        turning = q - 0.5 * v * v / a
        low, high = min(low, turning), max(high, turning)
    return q_end, v_end, low, high


@kernel
def saturates(v: float, a: float, h: float, rates: Rates) -> float:
    """When the velocity comes to a bound, at the latest h [s]."""
    if a > 0.0 and v + a * h > rates[1]:
        return max(0.0, (rates[1] - v) / a)
    if a < 0.0 and v + a * h < rates[0]:
        return max(0.0, (rates[0] - v) / a)
    return h


@kernel
def stops_at(q: float, v: float, rates: Rates) -> float:
    """Where a joint comes to rest that brakes from now on."""
    return q - 0.5 * v * v / (rates[2] if v > 0.0 else rates[3])
