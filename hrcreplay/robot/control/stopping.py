"""Stops that can be certified: motions to rest in whole ticks, every position of which is known before they begin.

Eq. (67) lets every axis brake for itself, so that the links leave the direction they moved in and come nearer to people
that they passed by. A straight stop lets all axes come to rest together, along a straight line in joint space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from hrcreplay.records import Floats
from hrcreplay.robot.programme.reference import Grid, place


@dataclass(frozen=True, slots=True)
class Stop:
    """A motion to rest, a row a tick; row 0 is where it begins. What is certified is what is executed, bit for bit."""

    q: Floats  #: (n + 1, nv) [rad]
    dq: Floats  #: (n + 1, nv); the last row is zero [rad/s]
    along: Floats  #: (n + 1, 2) programmed time [s] and rate of a robot that stays on its path; NaN for any other

    @property
    def ticks(self) -> int:
        """Number of ticks until the robot is at rest; 0 at rest."""
        return len(self.q) - 1

    def rest(self) -> Stop:
        """What is left one tick later; at rest, the same."""
        return Stop(self.q[1:], self.dq[1:], self.along[1:]) if self.ticks else self


def straight(q: Floats, dq: Floats, ddq_max: Floats, dt_s: float) -> Stop:
    """The stop in which all axes come to rest together, as soon as the slowest of them can.

    The velocity falls by the same share of itself in each of n ticks, so that no axis turns back, none decelerates by
    more than its limit, and the path is the straight line in joint space of length n dt / 2 times the velocity. Each
    tick is that of Eq. (68), (69).

    Args:
        q: (nv,) where it begins [rad].
        dq: (nv,) velocity there, finite [rad/s].
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of a tick [s].
    """
    rows_q, rows_dq = _straight(q, dq, ddq_max, dt_s)
    return Stop(rows_q, rows_dq, np.full((len(rows_q), 2), math.nan))


@njit(cache=True)
def _straight(q: Floats, dq: Floats, ddq_max: Floats, dt_s: float) -> tuple[Floats, Floats]:
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
    return rows_q, rows_dq


def axis_by_axis(q: Floats, dq: Floats, ddq_max: Floats, dt_s: float) -> Stop:
    """The stop of Eq. (67): every axis comes to rest as soon as it can.

    Args:
        q: (nv,) where it begins [rad].
        dq: (nv,) velocity there; an axis of unknown velocity counts as standing [rad/s].
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of a tick [s].
    """
    rows_q, rows_dq = _axis_by_axis(q, np.where(np.isfinite(dq), dq, 0.0), ddq_max, dt_s)
    return Stop(rows_q, rows_dq, np.full((len(rows_q), 2), math.nan))


@njit(cache=True)
def _axis_by_axis(q: Floats, dq: Floats, ddq_max: Floats, dt_s: float) -> tuple[Floats, Floats]:
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
    return rows_q, rows_dq


#: Ticks after which a stop along a path counts as none: the path allows no lower rate.
MOST_TICKS = 2000
#: Rounds of looking for a rate, and how near the limit of an axis it must be found.
_ROUNDS, _SHARE = 30, 1e-9


def along_path(grid: Grid, s_s: float, rate: float, ddq_max: Floats, dt_s: float) -> Stop | None:
    """The stop of a robot that stays on its path: its rate falls as fast as the axes' limits allow.

    Args:
        grid: The path.
        s_s: Programmed time where it begins [s].
        rate: Share of the programmed speed there, in [0, 1].
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of a tick [s].

    Returns:
        None where the path does not let the robot come to rest.
    """
    q, dq, along, ticks = _along_path(grid, s_s, rate, ddq_max * dt_s, dt_s)
    return Stop(q[: ticks + 1], dq[: ticks + 1], along[: ticks + 1]) if ticks < MOST_TICKS else None


@njit(cache=True)
def _along_path(grid: Grid, s_s: float, rate: float, gain: Floats, dt_s: float) -> tuple[Floats, Floats, Floats, int]:
    nv = grid.q.shape[1]
    rows_q, rows_dq, along = np.empty((128, nv)), np.empty((128, nv)), np.empty((128, 2))
    q, towards, _ = place(grid, s_s)
    rows_q[0], rows_dq[0], along[0, 0], along[0, 1] = q, rate * towards, s_s, rate
    i = 0
    while i < MOST_TICKS and rows_dq[i].any():
        if i + 1 == len(rows_q):
            rows_q, rows_dq = np.concatenate((rows_q, rows_q)), np.concatenate((rows_dq, rows_dq))
            along = np.concatenate((along, along))
        before, at = along[i, 1], along[i, 0]
        slower, tried = before, 0.0  # the path may bend so much that no lower rate keeps the limits
        for _ in range(_ROUNDS):
            _, towards, _ = place(grid, at + 0.5 * dt_s * (before + tried))
            least = _least_rate(towards, rows_dq[i], gain)
            if least <= tried + _SHARE:
                slower = min(slower, tried)
            if abs(least - tried) <= _SHARE or not least < before:
                break
            tried = least
        there = at + 0.5 * dt_s * (before + slower)
        q, towards, _ = place(grid, there)
        i += 1
        rows_q[i], rows_dq[i], along[i, 0], along[i, 1] = q, slower * towards, there, slower
    return rows_q, rows_dq, along, i


@njit(cache=True)
def _least_rate(towards: Floats, dq: Floats, gain: Floats) -> float:
    """Smallest rate, 0 or more, with which no axis loses more than ``gain`` of its velocity."""
    least = 0.0
    for j in range(len(dq)):
        if towards[j] > 0.0:
            least = max(least, (dq[j] - gain[j]) / towards[j])
        elif towards[j] < 0.0:
            least = max(least, (dq[j] + gain[j]) / towards[j])
    return least


def at_rest(q: Floats, along: Floats | None = None) -> Stop:
    """A robot that stands.

    Args:
        q: (nv,) [rad].
        along: (2,) programmed time and rate on its path; None: it is not on one.
    """
    return Stop(q[None], np.zeros((1, len(q))), np.full((1, 2), math.nan) if along is None else along[None])
