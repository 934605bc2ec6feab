"""Speed limits on the robot's links from the swept volumes, Eq. (12)-(16), and the minimiser of Eq. (66) under them.

Corrections: docs/paper.md. The rows join in one at a time, where a candidate breaks them, because every vertex of every
limb has rows and the minimiser lies on few of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hrcreplay.geometry.dual_active_set_qp import Working, add, settle, solution, working
from hrcreplay.geometry.vectors import dot3, norm_n
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.model import RobotPose


class Approach(NamedTuple):
    """What the approach rows of a tick are made of."""

    ends_m: Floats  #: (s, 2, 3) ends of the links' axes [m]
    J_ends: Floats  #: (s, 2, 3, nv) their position Jacobians [m/rad]
    vertices_m: Floats  #: (m, 3) of all limbs [m]
    offsets: Ints  #: (l + 1,) where each limb's vertices begin
    boxes_m: Floats  #: (l, 2, 3) around each limb's vertices [m]
    room_m2: Floats  #: (s, l) right-hand side of Eq. (14) for every pair of link and limb [m^2]
    stop_s: float  #: T_s of Eq. (70) [s]


def tick_rows(pose: RobotPose, obstacles: Obstacles, room_m2: Floats, stop_s: float) -> Approach:
    """The approach rows of a tick, none of them written down.

    Args:
        pose: The robot.
        obstacles: The swept volumes, all known.
        room_m2: (s, l) right-hand side of Eq. (14) for every pair of link and limb [m^2].
        stop_s: T_s of Eq. (70) [s].
    """
    hulls = obstacles
    return Approach(pose.ends_m, pose.J_ends, hulls.vertices_m, hulls.offsets, hulls.boxes_m, room_m2, stop_s)


@njit(cache=True)
def worst_rows(rows: Approach, dq_next: Floats, above_m2: float) -> tuple[Ints, Floats, Floats]:
    """The row of Eq. (16) that a velocity breaks most, for every pair and either end of the link; Eq. (66i), corrected.

    The rows are linear in the vertex, so the worst vertex is the one furthest along the end's velocity: one pass
    over the vertices checks them all, without any row being written down. For a vertex r and an end's velocity v,
    Eq. (15), (16) times the joint velocity is T_s (r @ v + rest), and rest does not depend on r.

    Args:
        rows: Of the tick.
        dq_next: (nv,) [rad/s].
        above_m2: Rows that exceed their right-hand side by no more than this hold [m^2].

    Returns:
        For the n broken ones: ``which`` (n, 4) link, limb, row of Eq. (12), row of ``vertices_m``; ``A`` (n, nv)
        [m^2 s/rad]; ``A @ dq_next`` (n,) [m^2].
    """
    ends, J_ends, vertices, offsets, boxes, room, stop_s = rows
    links, limbs = room.shape
    which = np.empty((2 * links * limbs, 4), dtype=np.int64)
    A, values = np.empty((len(which), len(dq_next))), np.empty(len(which))
    n = 0
    for s in range(links):
        for end in range(2):  # Eq. (7)-(9), (11): linear along the link, so s = 0 and s = 1 bound all points between
            v = _times(J_ends[s, end], dq_next)
            rest = -dot3(ends[s, 0], v)  # Eq. (15): E_1 @ dq
            if end == 1:
                rest -= dot3(ends[s, 1] - ends[s, 0], _times(J_ends[s, 0], dq_next))
            for k in range(limbs):
                bound = room[s, k] + above_m2
                if stop_s * (_box_top(boxes[k], v) + rest) <= bound:
                    continue
                best, top = offsets[k], -np.inf
                for i in range(offsets[k], offsets[k + 1]):
                    along = dot3(vertices[i], v)
                    if along > top:
                        best, top = i, along
                value = stop_s * (top + rest)  # Eq. (66i), corrected: T_s belongs here
                if value > bound:
                    which[n] = s, k, end, best
                    A[n] = stop_s * _row(ends[s], J_ends[s], vertices[best], end)
                    values[n] = value
                    n += 1
    return which[:n], A[:n], values[:n]


@njit(cache=True)
def _row(ends: Floats, J_ends: Floats, vertex: Floats, end: int) -> Floats:
    """(nv,) one row of E of Eq. (12), without T_s."""
    row = np.zeros(J_ends.shape[2])
    for j in range(len(row)):
        for i in range(3):
            row[j] += (vertex[i] - ends[0, i]) * J_ends[end, i, j]
            if end == 1:
                row[j] -= (ends[1, i] - ends[0, i]) * J_ends[0, i, j]
    return row


@njit(cache=True)
def _box_top(box: Floats, v: Floats) -> float:
    """How far along v a point of the box can lie."""
    top = 0.0
    for i in range(3):
        top += max(box[0, i] * v[i], box[1, i] * v[i])
    return top


@njit(cache=True)
def _times(J: Floats, dq: Floats) -> Floats:
    v = np.zeros(3)
    for i in range(3):
        for j in range(len(dq)):
            v[i] += J[i, j] * dq[j]
    return v


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
        broken = (values[b] - rows.room_m2[keys[b, 0], keys[b, 1]]) / norm_n(A[b])
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
