"""The minimiser of Eq. (66) over all rows, found with few of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hrcreplay.records import Floats, Ints
from hrcreplay.robot.active_set import Working, add, settle, solution, working
from hrcreplay.robot.constraints import Approach, worst_rows
from hrcreplay.robot.vectors import norm

#: Approach rows that may join in before the problem counts as unsolved.
MOST = 200
#: What came of it; SOLVED must be the first.
OUTCOMES = ("solved", "not finite", "infeasible", "residual", "too many rows")
SOLVED, NOT_FINITE, INFEASIBLE, RESIDUAL, UNFINISHED = range(5)


class Limits(NamedTuple):
    """Bounds that do not depend on people."""

    low: Floats  #: (nv,) Eq. (66d)-(66f) [rad/s]
    high: Floats  #: (nv,) [rad/s]
    J: Floats  #: (6, nv) of the TCP
    J_low: Floats  #: (6,) Eq. (66g), (66h): bounds on ``J @ w`` [m/s, rad/s]
    J_high: Floats  #: (6,) [m/s, rad/s]


class Optimum(NamedTuple):
    """A candidate, and the rows that it was found with."""

    outcome: int  #: index into ``OUTCOMES``
    w: Floats  #: (nv,) [rad/s]
    A: Floats  #: (m, nv) ``A @ w <= high``
    high: Floats  #: (m,)
    z: Floats  #: (m,) multipliers
    fixed: int  #: rows of ``Limits``, which come first


@njit(cache=True)
def optimum(H: Floats, g: Floats, limits: Limits, rows: Approach, above_m2: float) -> Optimum:
    """Minimiser of ``w @ H @ w / 2 + g @ w`` within limits and clear of people.

    Beginning with the minimiser without approach rows, the row that the candidate breaks most joins in and the search
    goes on, until all rows of all links, limbs and vertices hold. A minimiser over some of the rows that breaks none of
    the others is the minimiser over all of them.

    Args:
        H: (nv, nv) positive definite.
        g: (nv,).
        limits: Of axes and TCP.
        rows: Of the people.
        above_m2: Approach rows broken by no more than this hold [m^2].
    """
    n = len(g)
    work = working(H, g, 2 * n + 12 + MOST)
    which = np.empty((MOST, 4), dtype=np.int64)
    fixed = m = _limit(work, limits)
    count, outcome = settle(work, m, 0), UNFINISHED
    for _ in range(MOST):
        if count < 0:
            outcome = INFEASIBLE
            break
        w, _ = _candidate(work, m, limits)
        if not np.isfinite(w.sum()):
            outcome = NOT_FINITE
            break
        before = m
        m, clear = _join(work, which, fixed, m, rows, w, above_m2)
        if m == before:
            outcome = SOLVED if clear else RESIDUAL
            break
        count = settle(work, m, count)
    w, z = _candidate(work, m, limits)
    return Optimum(outcome, w, work.A[:m].copy(), work.high[:m].copy(), z, fixed)


@njit(cache=True)
def _candidate(work: Working, m: int, limits: Limits) -> tuple[Floats, Floats]:
    """What it has settled on, rounded into the axes' bounds, and the multipliers."""
    w, z = solution(work, m)
    return np.minimum(np.maximum(w, limits.low), limits.high), z


@njit(cache=True)
def _limit(work: Working, limits: Limits) -> int:
    """Adds the rows of axes and TCP; returns how many."""
    n, m = len(limits.low), 0
    axes = np.eye(n)
    for i in range(n):
        add(work, m, axes[i], 1.0, limits.high[i])
        add(work, m + 1, axes[i], -1.0, -limits.low[i])
        m += 2
    for i in range(len(limits.J)):
        add(work, m, limits.J[i], 1.0, limits.J_high[i])
        add(work, m + 1, limits.J[i], -1.0, -limits.J_low[i])
        m += 2
    return m


@njit(cache=True)
def _join(work: Working, which: Ints, fixed: int, m: int, rows: Approach, w: Floats, above: float) -> tuple[int, bool]:
    """Adds the approach row that a velocity breaks most of those not there yet; rows then, and whether all hold."""
    keys, A, values = worst_rows(rows, w, above)
    worst, most = -1, 0.0
    for b in range(len(keys)):
        broken = (values[b] - rows.room_m2[keys[b, 0], keys[b, 1]]) / norm(A[b])
        if broken > most and not _among(which, m - fixed, keys[b]):
            worst, most = b, broken
    if worst >= 0:
        which[m - fixed] = keys[worst]
        add(work, m, A[worst], 1.0, rows.room_m2[keys[worst, 0], keys[worst, 1]])
        m += 1
    return m, len(keys) == 0


@njit(cache=True)
def _among(which: Ints, count: int, key: Ints) -> bool:
    found = False
    for i in range(count):
        same = True
        for k in range(len(key)):
            same = same and which[i, k] == key[k]
        found = found or same
    return found
