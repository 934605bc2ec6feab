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
    more than its limit, and the path is the straight line in joint space of length n dt / 2 times the velocity.

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


def at_rest(q: Floats, along: Floats | None = None) -> Stop:
    """A robot that stands.

    Args:
        q: (nv,) [rad].
        along: (2,) programmed time and rate on its path; None: it is not on one.
    """
    return Stop(q[None], np.zeros((1, len(q))), np.full((1, 2), math.nan) if along is None else along[None])
