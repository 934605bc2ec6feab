"""Limits of the axes and of the TCP, Eq. (66d)-(66h), as bounds on the joint velocity of the next tick."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from hrcreplay.records import Floats

#: Bound on the rotation of the TCP for each unit of the bound on its translation [rad/m].
RAD_PER_M = 2 * math.pi / 2.5


@njit(cache=True)
def joint_bounds(
    q: Floats, dq: Floats, q_min: Floats, q_max: Floats, dq_max: Floats, ddq_max: Floats, dt_s: float
) -> tuple[Floats, Floats]:
    """Next velocities from which an axis can still stop before its position limit, Eq. (66d)-(66f), corrected.

    An axis at v that brakes by Eq. (67) travels S(v): the braking parabola v^2 / (2 u_max), sampled at whole steps
    v = n u_max dt and linear between them. A state with q + S(dq) <= q_max (and likewise below) is admissible; the
    returned interval holds exactly the velocities whose next state, Eq. (69), is admissible again. From an
    admissible state it always contains the braking step, so the limits never make the QP infeasible; from any other
    it still contains that step, the best an axis can do.

    Args:
        q: (nv,) [rad].
        dq: (nv,) [rad/s].
        q_min: (nv,) [rad]; may be -inf.
        q_max: (nv,) [rad]; may be inf.
        dq_max: (nv,) [rad/s].
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of the tick [s].

    Returns:
        Lower and upper bound, (nv,) each [rad/s].
    """
    low, high = np.empty_like(q), np.empty_like(q)
    for i in range(len(q)):
        gain = ddq_max[i] * dt_s
        ahead = q[i] + 0.5 * dt_s * dq[i]
        brake = math.copysign(max(abs(dq[i]) - gain, 0.0), dq[i])
        top = min(dq_max[i], dq[i] + gain, fastest(q_max[i] - ahead, gain, dt_s))
        bottom = max(-dq_max[i], dq[i] - gain, -fastest(ahead - q_min[i], gain, dt_s))
        low[i], high[i] = min(bottom, brake), max(top, brake)
    return low, high


@njit(cache=True)
def fastest(room: float, gain: float, dt_s: float) -> float:
    """Largest w with S(w) + dt w / 2 <= room, the inverse of a piecewise linear function [rad/s].

    Args:
        room: Way left beyond what the present velocity covers within this tick [rad].
        gain: Change of velocity an axis manages in a tick [rad/s].
        dt_s: Length of the tick [s].
    """
    if room <= 0.0 or room == np.inf:
        return 2.0 * room / dt_s
    steps = 2.0 * room / (gain * dt_s)  # n (n + 1) where w = n gain
    n = math.floor(0.5 * (math.sqrt(1.0 + 4.0 * steps) - 1.0))
    return (n + (steps - n * (n + 1.0)) / (2.0 * (n + 1.0))) * gain


@njit(cache=True)
def cartesian_bounds(
    J: Floats, dJdq: Floats, dq: Floats, speed_max: float, acceleration_max: float, dt_s: float
) -> tuple[Floats, Floats]:
    """Bounds on ``J @ dq_next`` from the TCP's speed and acceleration limits, Eq. (66g), (66h), corrected.

    Args:
        J: (6, nv) Jacobian of the TCP, linear first [m/rad, rad/rad].
        dJdq: (6,) Jdot dq [m/s^2, rad/s^2].
        dq: (nv,) [rad/s].
        speed_max: Of each axis of the world [m/s]; rotation in the proportion ``RAD_PER_M``.
        acceleration_max: Likewise [m/s^2].
        dt_s: Length of the tick [s].

    Returns:
        Lower and upper bound, (6,) each [m/s, rad/s].
    """
    low, high = np.empty(6), np.empty(6)
    for i in range(6):
        unit = 1.0 if i < 3 else RAD_PER_M
        now = 0.0
        for j in range(len(dq)):
            now += J[i, j] * dq[j]
        drift = dt_s * dJdq[i]
        change = dt_s * unit * acceleration_max
        low[i] = max(-unit * speed_max, now - change) - drift
        high[i] = min(unit * speed_max, now + change) - drift
    return low, high
