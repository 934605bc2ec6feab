"""Reach of one joint: bang-bang motions between bounds, including the effect of joint stops.

A joint obeys v_min <= v <= v_max and a_min <= a <= a_max. A state beyond a velocity bound returns as fast as the
acceleration bounds allow. Let v_hi be the largest initial velocity. Then the velocity is never above the profile that
starts at v_hi and approaches v_max with a_max (from above: with a_min), and the displacement is never above that
profile's integral.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.human.model import ALPHA_2, ALPHA_3, LEFT_ARM, RIGHT_ARM, alpha_2_bounds, alpha_3_bounds
from hrcreplay.kernels import njit
from hrcreplay.records import Floats

#: Range of a joint's lower and upper stops over a reachable box: (lowest lower, highest lower, lowest upper, highest
#: upper).
Stops = tuple[float, float, float, float]


@njit(cache=True, inner=True)
def saturation_s(v: float, top: float, gain: float, brake: float) -> float:
    """Time at which the fastest velocity profile reaches its bound [s]; inf if it never does.

    Args:
        v: Largest initial velocity [m/s or rad/s].
        top: Velocity bound [m/s or rad/s].
        gain: Largest acceleration, >= 0 [m/s^2 or rad/s^2].
        brake: Smallest acceleration, <= 0 [m/s^2 or rad/s^2].
    """
    a = gain if v <= top else brake
    return np.inf if a == 0.0 else (top - v) / a


@njit(cache=True, inner=True)
def fastest(v: float, top: float, gain: float, brake: float, t: float) -> float:
    """The largest velocity at time t of motions that start with at most v.

    Args:
        v: Largest initial velocity [m/s or rad/s].
        top: Velocity bound [m/s or rad/s].
        gain: Largest acceleration, >= 0 [m/s^2 or rad/s^2].
        brake: Smallest acceleration, <= 0 [m/s^2 or rad/s^2].
        t: Time since the start [s].
    """
    if v <= top:
        return min(v + gain * t, top)
    return max(v + brake * t, top)


@njit(cache=True)
def rise(v: float, top: float, gain: float, brake: float, horizon: float) -> float:
    """The largest displacement at any time in [0, horizon] of motions that start with at most v.

    It is the integral of the fastest profile. For a rising profile the integral is convex and its maximum is at an end.
    For a falling profile the maximum may be at the zero of the profile.

    Args:
        v: Largest initial velocity.
        top: Velocity bound.
        gain: Largest acceleration, >= 0.
        brake: Smallest acceleration, <= 0.
        horizon: [s].
    """
    a = gain if v <= top else brake
    end = min(horizon, saturation_s(v, top, gain, brake))
    at_end = v * end + 0.5 * a * end**2
    largest = max(0.0, at_end, at_end + top * (horizon - end))
    if v > 0.0 and a < 0.0:
        peak = min(end, -v / a)
        largest = max(largest, v * peak + 0.5 * a * peak**2)
    return largest


@njit(cache=True, inner=True)
def braking(v: float, brake: float, horizon: float) -> float:
    """Distance that a joint travels during maximum braking."""
    return rise(v, 0.0, 0.0, brake, horizon) if v > 0.0 else 0.0


@njit(cache=True, inner=True)
def stops(j: int, bounds: Floats, coupled: bool, low: Floats, high: Floats) -> Stops:
    """Computes the range of the stops of joint j while the joints that they depend on are in [low, high].

    The outermost stop is never exceeded; the joint may be stopped anywhere in the range. The coupled stops, Eq. (34b),
    (34c), are monotonic or bilinear: their extremes are at the corners.

    Args:
        j: Index into JOINTS.
        bounds: (6, 13) of ``human.model.bounds_of``.
        coupled: True: Eq. (34b), (34c) hold.
        low: (13,) lower ends of the joints' reachable intervals [m, m, rad..., m].
        high: (13,) their upper ends.
    """
    if not coupled or not (j in ALPHA_2 or j in ALPHA_3):
        return bounds[0, j], bounds[0, j], bounds[1, j], bounds[1, j]
    least, inner_least, inner_most, most = np.inf, -np.inf, np.inf, -np.inf
    first = RIGHT_ARM if j < LEFT_ARM else LEFT_ARM
    for k in range(4):
        a1 = high[first] if k % 2 else low[first]
        if j == first + 1:
            start, end = alpha_2_bounds(a1, a1)
        else:
            a2 = high[first + 1] if k // 2 else low[first + 1]
            start, end = alpha_3_bounds(a1, a1, a2, a2)
        least, inner_least = min(least, start), max(inner_least, start)
        inner_most, most = min(inner_most, end), max(most, end)
    return least, inner_least, inner_most, most


@njit(cache=True, inner=True)
def interval(
    p: tuple[float, float], v: tuple[float, float], speed: Floats, limit: Stops, horizon: float
) -> tuple[float, float]:
    """Computes the reachable interval of a joint at any time in [0, horizon]; replaces Alg. 1 in ``sound``.

    At a stop the velocity becomes zero at once, and the joint starts again from rest. A state that may be beyond a stop
    brakes outward and then stays; a stop never removes a part of the initial state interval.

    Args:
        p: Smallest and largest initial position.
        v: Smallest and largest initial velocity.
        speed: (4,) v_min, v_max, a_min, a_max.
        limit: Range of its stops.
        horizon: [s].
    """
    least, inner_least, inner_most, most = limit
    v_min, v_max, a_min, a_max = speed[0], speed[1], speed[2], speed[3]
    up = p[1] + rise(v[1], v_max, a_max, a_min, horizon)
    down = p[0] - rise(-v[0], -v_min, -a_min, -a_max, horizon)
    for _ in range(2):  # a motion away from one stop may reach the other
        if down < inner_least:
            up = max(up, inner_least + rise(0.0, v_max, a_max, a_min, horizon))
        if up > inner_most:
            down = min(down, inner_most - rise(0.0, -v_min, -a_min, -a_max, horizon))
    low, high = max(down, least), min(up, most)
    if p[1] > inner_most:
        high = max(high, p[1] + braking(v[1], a_min, horizon))
    if p[0] < inner_least:
        low = min(low, p[0] - braking(-v[0], -a_max, horizon))
    return min(low, p[0]), max(high, p[1])
