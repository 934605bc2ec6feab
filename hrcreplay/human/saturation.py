"""Bounds on the fused state, Eq. (62)-(65)."""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.human.filter import Rules
from hrcreplay.human.model import clamp_row
from hrcreplay.records import Floats


@njit(cache=True)
def saturate(mean: Floats, dt: float, rules: Rules) -> bool:
    """Eq. (62)-(65) on the state of all joints (12, 4), then the same for the accelerations, in place.

    The filter goes on from the saturated state; P is not changed by it. x and y are bounded along and across the
    body, Eq. (33), and turned back, Eq. (32). A joint's velocity may not carry it over its position bound within dt,
    its acceleration not over its velocity bound; without a dt yet (0) only the plain bounds hold.

    Returns:
        Whether anything had to give.
    """
    low, high = np.empty(12), np.empty(12)
    before = mean[:, :3].copy()
    p = mean[:, 0].copy()
    clamp_row(p, rules.p_min, rules.p_max, rules.coupled, low, high)
    mean[:, 0] = p
    low[:2], high[:2] = -np.inf, np.inf  # bounds of x and y are the world's, those of their velocities the body's
    v = _into_body(mean[:, 1], p[2])
    v_out = _clip(v, p, low, high, rules.v_min, rules.v_max, dt)
    a = _into_body(mean[:, 2], p[2])
    a_out = _clip(a, v_out, rules.v_min, rules.v_max, rules.a_min, rules.a_max, dt)
    _write(mean[:, 1], v, v_out, p[2])
    _write(mean[:, 2], a, a_out, p[2])
    return bool((before != mean[:, :3]).any())


@njit(cache=True)
def _clip(
    rate: Floats, value: Floats, low: Floats, high: Floats, rate_low: Floats, rate_high: Floats, dt: float
) -> Floats:
    """Eq. (63)-(65): the rates (12,) within their bounds and those that keep the value within its own for dt."""
    clipped = np.empty(12)
    for j in range(12):
        least, most = rate_low[j], rate_high[j]
        if dt > 0.0:
            least = min(max(least, (low[j] - value[j]) / dt), most)
            most = max(min(most, (high[j] - value[j]) / dt), least)
        clipped[j] = max(least, min(rate[j], most))
    return clipped


@njit(cache=True)
def _into_body(world: Floats, theta: float) -> Floats:
    """Eq. (33): the first two of (12,) forward and to the left."""
    body = world.copy()
    c, s = np.cos(theta), np.sin(theta)
    body[0], body[1] = c * world[0] + s * world[1], -s * world[0] + c * world[1]
    return body


@njit(cache=True)
def _write(world: Floats, body: Floats, clipped: Floats, theta: float) -> None:
    """Eq. (32): writes back only what was clipped, so that the rest keeps its bits."""
    world[2:] = clipped[2:]
    if body[0] != clipped[0] or body[1] != clipped[1]:
        c, s = np.cos(theta), np.sin(theta)
        world[0], world[1] = c * clipped[0] - s * clipped[1], s * clipped[0] + c * clipped[1]
