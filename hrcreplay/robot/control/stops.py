"""Stops: motions to rest in whole ticks.

All positions of a stop are known before it begins, so it can be certified. By Eq. (67) every axis brakes independently;
the links then leave their direction of motion and may come nearer to people beside them. In a straight stop all axes
come to rest together, along a straight line in joint space.

Corrections to the paper: docs/paper.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hrcreplay.kernels import njit
from hrcreplay.records import Floats
from hrcreplay.robot.task import Grid, write_place


class Stop(NamedTuple):
    """A motion to rest, one row per tick; it begins at row 0. The robot executes exactly the certified numbers."""

    q: Floats  #: (n + 1, nv) [rad]
    dq: Floats  #: (n + 1, nv); the last row is zero [rad/s]
    along: Floats  #: (n + 1, 2) programmed time [s] and rate of a robot that stays on its path; otherwise NaN

    @property
    def ticks(self) -> int:
        """Number of ticks until the robot is at rest; 0 if it is at rest."""
        return len(self.q) - 1

    def rest(self) -> Stop:
        """Remainder of the stop one tick later; at rest, the stop itself."""
        return Stop(self.q[1:], self.dq[1:], self.along[1:]) if self.ticks else self


def stop_straight(q: Floats, dq: Floats, ddq_max: Floats, dt_s: float) -> Stop:
    """The stop in which all axes come to rest together, as soon as the slowest axis can.

    In each of n ticks the velocity falls by the same share of its initial value. Hence no axis turns back, no axis
    decelerates by more than its limit, and the path is a straight line in joint space, n dt / 2 times the velocity.
    Each tick follows Eq. (68), (69).

    Args:
        q: (nv,) initial position [rad].
        dq: (nv,) initial velocity, finite [rad/s].
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of a tick [s].
    """
    return Stop(*straight(q, dq, ddq_max, dt_s))


@njit(cache=True)
def straight(q: Floats, dq: Floats, ddq_max: Floats, dt_s: float) -> tuple[Floats, Floats, Floats]:
    """The rows of ``stop_straight``.

    Args:
        q: (nv,) initial position [rad].
        dq: (nv,) initial velocity, finite [rad/s].
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of a tick [s].
    """
    ticks = 0
    for j in range(len(q)):
        ticks = max(ticks, math.ceil(abs(dq[j]) / (ddq_max[j] * dt_s)))
    rows_q, rows_dq = np.empty((ticks + 1, len(q))), np.empty((ticks + 1, len(q)))
    rows_q[0], rows_dq[0] = q, dq
    for i in range(1, ticks + 1):
        left = (ticks - i) / ticks
        for j in range(len(q)):
            rows_dq[i, j] = left * dq[j]
            rows_q[i, j] = rows_q[i - 1, j] + 0.5 * dt_s * (rows_dq[i - 1, j] + rows_dq[i, j])  # Eq. (68), (69)
    return rows_q, rows_dq, np.full((ticks + 1, 2), np.nan)


def stop_axis_by_axis(q: Floats, dq: Floats, ddq_max: Floats, dt_s: float) -> Stop:
    """The stop of Eq. (67): every axis comes to rest as soon as it can.

    Args:
        q: (nv,) initial position [rad].
        dq: (nv,) initial velocity; an axis with unknown velocity counts as at rest [rad/s].
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of a tick [s].
    """
    return Stop(*axis_by_axis(q, np.where(np.isfinite(dq), dq, 0.0), ddq_max, dt_s))


@njit(cache=True)
def axis_by_axis(q: Floats, dq: Floats, ddq_max: Floats, dt_s: float) -> tuple[Floats, Floats, Floats]:
    """The rows of ``stop_axis_by_axis``.

    Args:
        q: (nv,) initial position [rad].
        dq: (nv,) initial velocity, finite [rad/s].
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of a tick [s].
    """
    ticks = 0
    for j in range(len(q)):
        ticks = max(ticks, math.ceil(abs(dq[j]) / (ddq_max[j] * dt_s)))
    rows_q, rows_dq = np.empty((ticks + 1, len(q))), np.zeros((ticks + 1, len(q)))
    rows_q[0], rows_dq[0] = q, dq
    for i in range(1, ticks + 1):
        for j in range(len(q)):
            before, gain = rows_dq[i - 1, j], ddq_max[j] * dt_s
            if i < ticks and abs(before) > gain:
                rows_dq[i, j] = before - math.copysign(gain, before)
            rows_q[i, j] = rows_q[i - 1, j] + 0.5 * dt_s * (before + rows_dq[i, j])  # Eq. (68), (69)
    return rows_q, rows_dq, np.full((ticks + 1, 2), np.nan)


#: Largest number of ticks of a stop along a path; if it takes longer, there is no stop along the path.
MOST_TICKS = 2000
#: Largest number of iterations in the search for a rate, and the tolerance of the rate.
_ROUNDS, _SHARE = 30, 1e-9


def stop_along_path(grid: Grid, s_s: float, rate: float, ddq_max: Floats, dt_s: float) -> Stop | None:
    """The stop of a robot that stays on its path: its rate falls as fast as the axes' limits allow.

    Args:
        grid: The path.
        s_s: Programmed time at the start of the stop [s].
        rate: Share of the programmed speed at the start, in [0, 1].
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of a tick [s].

    Returns:
        The stop; None if the robot cannot come to rest along the path.
    """
    q, dq, along, done = stop_rows(grid, s_s, rate, ddq_max * dt_s, dt_s)
    return Stop(q, dq, along) if done else None


@njit(cache=True)
def stop_rows(grid: Grid, s_s: float, rate: float, gain: Floats, dt_s: float) -> tuple[Floats, Floats, Floats, bool]:
    """The rows of ``stop_along_path``, and whether they end at rest.

    Args:
        grid: The path.
        s_s: Programmed time at the start of the stop [s].
        rate: Share of the programmed speed at the start, in [0, 1].
        gain: (nv,) largest change of velocity of an axis in a tick [rad/s].
        dt_s: Length of a tick [s].
    """
    nv = grid.q.shape[1]
    rows_q, rows_dq, along = np.empty((128, nv)), np.empty((128, nv)), np.empty((128, 2))
    q, towards, bend = np.empty(nv), np.empty(nv), np.empty(nv)
    write_place(grid, s_s, q, towards, bend)
    rows_q[0], rows_dq[0], along[0, 0], along[0, 1] = q, rate * towards, s_s, rate
    i = 0
    while i < MOST_TICKS and rows_dq[i].any():
        if i + 1 == len(rows_q):
            rows_q, rows_dq = np.concatenate((rows_q, rows_q)), np.concatenate((rows_dq, rows_dq))
            along = np.concatenate((along, along))
        before, at = along[i, 1], along[i, 0]
        slower, tried = before, 0.0  # the path may bend so much that no lower rate keeps the limits
        for _ in range(_ROUNDS):
            write_place(grid, at + 0.5 * dt_s * (before + tried), q, towards, bend)
            least = _least_rate(towards, rows_dq[i], gain)
            if least <= tried + _SHARE:
                slower = min(slower, tried)
            if abs(least - tried) <= _SHARE or not least < before:
                break
            tried = least
        there = at + 0.5 * dt_s * (before + slower)
        write_place(grid, there, q, towards, bend)
        i += 1
        rows_q[i], rows_dq[i], along[i, 0], along[i, 1] = q, slower * towards, there, slower
    return rows_q[: i + 1], rows_dq[: i + 1], along[: i + 1], i < MOST_TICKS


@njit(cache=True, inner=True)
def _least_rate(towards: Floats, dq: Floats, gain: Floats) -> float:
    """Smallest non-negative rate at which no axis changes its velocity by more than ``gain``."""
    least = 0.0
    for j in range(len(dq)):
        if towards[j] > 0.0:
            least = max(least, (dq[j] - gain[j]) / towards[j])
        elif towards[j] < 0.0:
            least = max(least, (dq[j] + gain[j]) / towards[j])
    return least


def at_rest(q: Floats, along: Floats | None = None) -> Stop:
    """The stop of a robot at rest.

    Args:
        q: (nv,) [rad].
        along: (2,) programmed time and rate on its path; None: the robot is not on a path.
    """
    # A copy, because q may be read-only, for which numba would compile the kernels again.
    return Stop(q[None].copy(), np.zeros((1, len(q))), np.full((1, 2), math.nan) if along is None else along[None])
