"""Reachable sets under ``sound``: intervals of all joints, and a polygon that encloses the positions of the pelvis.

They start from a box of likely states, not from the estimate alone, and a joint that has not been seen for long may
have moved since: so real people stay inside, whose states are never known exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hrcreplay.human.model import SHOWN_BY
from hrcreplay.human.prediction.joint_reach import Stops, interval, stops
from hrcreplay.human.prediction.walking_reach import SIDES, body_velocity, corners_of, turned, walked
from hrcreplay.records import DOF, Floats, HumanStates
from hrcreplay.settings.sections import Occupancy

Range = tuple[float, float]


class Likely(NamedTuple):
    """Where people may be at the tick, a row each: a box around the estimate, and what nobody has seen for long."""

    p: Floats  #: (n, 13)
    v: Floats  #: (n, 13)
    p_off: Floats  #: (n, 13) largest error of p
    v_off: Floats  #: (n, 13) largest error of v
    unseen_s: Floats  #: (n, 13) for how long a joint has not been seen, 0 within its memory [s]


class SoundMotionLimits(NamedTuple):
    """What bounds the motions that ``sound`` encloses."""

    bounds: Floats  #: (6, 13) of ``reachable_sets.bounds_of``
    coupled: bool  #: whether Eq. (34b), (34c) hold
    horizon: float  #: horizon and latency [s]
    memory: float  #: how long the filter goes on without a measurement [s]


def likely(states: HumanStates, occupancy: Occupancy, memory_s: float) -> Likely:
    """The states that ``sound`` starts from; a limb unseen for longer than ``memory_s`` [s] may have moved since."""
    unseen = np.where(states.unseen_s > memory_s, states.unseen_s, 0.0)[:, SHOWN_BY]
    off = (occupancy.sigmas * states.p_std, occupancy.sigmas * states.v_std)
    return Likely(*(np.ascontiguousarray(a) for a in (states.p, states.v, *off, unseen)))


@njit(cache=True)
def enclose_row(i: int, at: Likely, within: SoundMotionLimits, low: Floats, high: Floats, corners: Floats) -> None:
    """Writes the intervals (13,) of row i, and the corners (SIDES, 2) of the polygon around the pelvis [m].

    A joint unseen for longer than its memory may since have had any velocity within the bounds; its horizon starts
    when it was last seen. Its estimate has coasted from there, for at most the memory.

    Args:
        i: Row of ``at``.
        at: Where people may be.
        within: What bounds their motions.
        low: (13,) receives the lower ends [m, m, rad..., m]; NaN where the state is.
        high: (13,) receives the upper ends.
        corners: (SIDES, 2) receives the corners, world [m]; NaN where the state is.
    """
    _walk(i, at, within, low, high, corners)
    for j in range(3, DOF):
        limit = stops(j, within.bounds, within.coupled, low, high)
        if at.unseen_s[i, j] == np.inf:
            low[j], high[j] = limit[0], limit[3]
        else:
            low[j], high[j] = _joint(i, j, at, within, limit)


@njit(cache=True)
def _joint(i: int, j: int, at: Likely, within: SoundMotionLimits, limit: Stops) -> Range:
    bounds, _, horizon, memory = within
    p, off, unseen = at.p[i, j], at.p_off[i, j], at.unseen_s[i, j]
    if np.isnan(p + off + at.v[i, j] + at.v_off[i, j]):
        return np.nan, np.nan
    if unseen > 0.0:
        drift = memory * max(-bounds[2, j], bounds[3, j])
        span = unseen + horizon
        low, high = p - off - drift + bounds[2, j] * span, p + off + drift + bounds[3, j] * span
        return min(p, max(low, limit[0])), max(p, min(high, limit[3]))
    v, v_off = at.v[i, j], at.v_off[i, j]
    return interval((p - off, p + off), (v - v_off, v + v_off), bounds[2:, j], limit, horizon)


@njit(cache=True)
def _walk(i: int, at: Likely, within: SoundMotionLimits, low: Floats, high: Floats, corners: Floats) -> None:
    bounds, _, horizon, memory = within
    p, off, v, v_off = at.p[i, :3], at.p_off[i, :3], at.v[i, :3], at.v_off[i, :3]
    low[:3], high[:3], corners[:] = np.nan, np.nan, np.nan
    span = horizon + at.unseen_s[i, :3].max()
    if not np.isfinite(p.sum() + off.sum() + v.sum() + v_off.sum() + span):
        return
    heading = (p[2] - off[2], p[2] + off[2])
    ahead, left = body_velocity(v, v_off, heading)
    velocity = (ahead, left, (v[2] - v_off[2], v[2] + v_off[2]))
    drift = 0.0
    if span > horizon:
        turn = memory * max(-bounds[2, 2], bounds[3, 2])
        heading = (heading[0] - turn, heading[1] + turn)
        velocity = ((bounds[2, 0], bounds[3, 0]), (bounds[2, 1], bounds[3, 1]), (bounds[2, 2], bounds[3, 2]))
        drift = memory * np.hypot(max(-bounds[2, 0], bounds[3, 0]), max(-bounds[2, 1], bounds[3, 1]))
    far = np.empty(SIDES)
    for side in range(SIDES):
        phi = p[2] + 2.0 * np.pi * side / SIDES
        c, s = np.cos(phi), np.sin(phi)
        far[side] = c * p[0] + s * p[1] + abs(c) * off[0] + abs(s) * off[1] + drift
    walked(heading, velocity, bounds, span, far)
    corners_of(far, p[2], corners)
    for k in range(2):
        low[k], high[k] = corners[:, k].min(), corners[:, k].max()
    low[2], high[2] = turned(heading, velocity[2], bounds, span)


def enclose(at: Likely, within: SoundMotionLimits) -> tuple[Floats, Floats]:
    """Reachable intervals of all rows: lower and upper ends, (n, 13) each [m, m, rad..., m]."""
    low, high = np.empty_like(at.p), np.empty_like(at.p)
    _enclose_rows(at, within, low, high)
    return low, high


@njit(cache=True)
def _enclose_rows(at: Likely, within: SoundMotionLimits, low: Floats, high: Floats) -> None:
    corners = np.empty((SIDES, 2))
    for i in range(len(at.p)):
        enclose_row(i, at, within, low[i], high[i], corners)
