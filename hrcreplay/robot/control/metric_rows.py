"""The quadratic program of Eq. (66) in the metric of its cost, where a solver has the least trouble with it.

With ``H = L @ L.T`` and ``y = L.T @ x`` the cost is ``y @ y / 2 + y @ b``, and every row is scaled to length 1. x is
the next joint velocity w [rad/s] and, where the approach rows are soft, the slack [m/s]. The eigenvalues of H may
differ by a factor of 10^6 (a stretched wrist); here a residual of the size r means an error of about r.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.small_matrices import cholesky, solve_lower, solve_transposed
from hrcreplay.geometry.vectors import dot_n, norm_n
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control.separation import Approach, worst_rows

#: Marks a missing bound.
NONE = 1e20
#: Rows broken by no more than this hold, in the metric; and where a row does not depend on the velocity [m/s].
HELD = 1e-9
#: Length in the metric below which a row does not depend on the velocity.
EMPTY = 1e-9
#: By how much a combination of rows must be broken everywhere to prove that there is no solution.
DENIED = 1e-9

#: What `next_row` finds: no broken row; broken ones that are all known; one that is new; one that nothing can help.
CLEAR, KNOWN, NEW, HOPELESS = range(4)


class Limits(NamedTuple):
    """Bounds that do not depend on people."""

    low: Floats  #: (nv,) Eq. (66d)-(66f) [rad/s]
    high: Floats  #: (nv,) [rad/s]
    J: Floats  #: (6, nv) of the TCP
    J_low: Floats  #: (6,) Eq. (66g), (66h): bounds on ``J @ w`` [m/s, rad/s]
    J_high: Floats  #: (6,) [m/s, rad/s]


class Metric(NamedTuple):
    """Minimise ``y @ y / 2 + y @ b`` where ``low <= E @ y <= high``."""

    L: Floats  #: (n, n) lower triangle
    b: Floats  #: (n,)
    E: Floats  #: (m, n) the rows of axes and TCP come first
    low: Floats  #: (m,)
    high: Floats  #: (m,)


class Found(NamedTuple):
    """Constraint that a candidate breaks."""

    outcome: int  #: CLEAR, KNOWN, NEW or HOPELESS
    w: Floats  #: (nv,) the candidate, within the axes' bounds [rad/s]
    slack: float  #: [m/s]
    row: Floats  #: (n,) the row that it breaks most of those that are new
    high: float  #: its bound
    key: Ints  #: (4,) which one it is, as of `worst_rows`


@njit(cache=True, error_model="numpy")
def are_numbers_known(H: Floats, g: Floats, limits: Limits, rows: Approach) -> bool:
    """Return whether nothing is NaN, and nothing infinite but for bounds that do not exist.

    Args:
        H: (nv, nv).
        g: (nv,).
        limits: Of axes and TCP.
        rows: Of people.
    """
    total = H.sum() + g.sum() + limits.J.sum() + rows.ends_m.sum() + rows.J_ends.sum() + rows.vertices_m.sum()
    total += rows.boxes_m.sum() + rows.per_speed.sum() + rows.stop_s
    known = math.isfinite(total) and not np.isnan(rows.rhs_m2.sum())
    for bounds in (limits.low, limits.high, limits.J_low, limits.J_high):
        known = known and not np.isnan(bounds.sum())
    return known


@njit(cache=True, error_model="numpy")
def build_metric(H: Floats, g: Floats, limits: Limits, soft: bool, slack_weight: float) -> Metric:
    """The problem without approach rows; NaN where H is not positive definite.

    Args:
        H: (nv, nv) positive definite.
        g: (nv,).
        limits: Of axes and TCP.
        soft: Whether there is a slack.
        slack_weight: Its cost is half of this times its square.
    """
    nv = len(g)
    n = nv + 1 if soft else nv
    scale = H[0, 0]
    for i in range(nv):
        scale = max(scale, H[i, i])
    L, b = np.zeros((n, n)), np.zeros(n)
    L[:nv, :nv], b[:nv] = cholesky(H / scale), g / scale
    if soft:
        L[nv, nv] = math.sqrt(slack_weight / scale)
    m = nv + len(limits.J)
    E, low, high, row = np.zeros((m, n)), np.empty(m), np.empty(m), np.zeros(n)
    for i in range(m):
        row[:] = 0.0
        if i < nv:
            row[i], low[i], high[i] = 1.0, limits.low[i], limits.high[i]
        else:
            row[:nv], low[i], high[i] = limits.J[i - nv], limits.J_low[i - nv], limits.J_high[i - nv]
        e = solve_lower(L, row)
        length = norm_n(e)
        length = length if length > EMPTY else 1.0
        E[i], low[i], high[i] = e / length, max(low[i] / length, -NONE), min(high[i] / length, NONE)
    return Metric(L, solve_lower(L, b), E, low, high)


@njit(cache=True)
def descend(problem: Metric, z: Floats, sweeps: int) -> tuple[Floats, Floats]:
    """A start for a solver: a candidate and multipliers after some sweeps of coordinate descent over the multipliers.

    Hildreth's method: a row after the other is met as if it were alone. It mostly finds the rows that the minimiser
    lies on, which saves the solver most of its steps.

    Args:
        problem: In its metric.
        z: (m,) multipliers to begin with; positive for upper bounds, negative for lower ones.
        sweeps: How often every row is met.
    """
    _, b, E, low, high = problem
    y, z = -b, z.copy()
    for i in range(len(E)):
        for k in range(len(y)):
            y[k] -= z[i] * E[i, k]
    for _ in range(sweeps):
        most = 0.0
        for i in range(len(E)):
            free = dot_n(E[i], y) + z[i]
            new = free - high[i] if free > high[i] else free - low[i] if free < low[i] else 0.0
            change = new - z[i]
            if change != 0.0:
                z[i], most = new, max(most, abs(change))
                for k in range(len(y)):
                    y[k] -= change * E[i, k]
        if most < 1e-12:
            break
    for i in range(len(E)):  # a solver would keep a multiplier of a row that does not hold y
        if z[i] != 0.0 and abs(dot_n(E[i], y) - (high[i] if z[i] > 0.0 else low[i])) > 1e-9:
            z[i] = 0.0
    return y, z


@njit(cache=True)
def residual(problem: Metric, y: Floats, z: Floats) -> float:
    """By how much y and z miss the conditions of Karush, Kuhn and Tucker, which prove a minimiser; NaN for NaN."""
    _, b, E, low, high = problem
    gradient, most = y + b, 0.0
    for i in range(len(E)):
        at = dot_n(E[i], y)
        for k in range(len(y)):
            gradient[k] += z[i] * E[i, k]
        room = high[i] - at if z[i] > 0.0 else at - low[i]
        most = max(most, at - high[i], low[i] - at, min(abs(z[i]), abs(room)))
    for k in range(len(y)):
        most = max(most, abs(gradient[k]))
    return most if math.isfinite(norm_n(y) + norm_n(z)) else np.nan


@njit(cache=True)
def denied(problem: Metric, z: Floats, limits: Limits) -> bool:
    """Return whether multipliers prove that no velocity keeps all rows (Farkas).

    The rows of TCP and people are added up with them as weights; no velocity within the axes' bounds keeps the sum.
    Beside a slack that is never so: it loosens all rows of people.

    Args:
        problem: In its metric.
        z: (m,) positive for upper bounds, negative for lower ones.
        limits: Of axes and TCP.
    """
    L, _, E, low, high = problem
    nv, n = len(limits.low), len(L)
    largest = np.abs(z[nv:]).max()
    if not (0.0 < largest < np.inf):
        return False
    total, bound = np.zeros(n), 0.0
    for i in range(nv, len(E)):
        weight = z[i] / largest
        if weight < 0.0 and low[i] == -NONE:
            continue
        bound += weight * (high[i] if weight > 0.0 else low[i])
        for k in range(n):
            total[k] += weight * E[i, k]
    least = 0.0
    for j in range(n):
        a = dot_n(L[j], total)  # of x, since y = L.T @ x
        if j >= nv:
            least = least if abs(a) < EMPTY else -np.inf
        elif a != 0.0:
            least += min(a * limits.low[j], a * limits.high[j])
    return least > bound + DENIED


@njit(cache=True, error_model="numpy")
def next_row(problem: Metric, y: Floats, limits: Limits, rows: Approach, known: Ints) -> Found:
    """The approach row that a candidate breaks most, in the metric, of those that are not among the known ones.

    Args:
        problem: In its metric.
        y: (n,) the candidate.
        limits: Of axes and TCP.
        rows: Of the people.
        known: (k, 4) which ones are known.
    """
    L, nv, n = problem.L, len(limits.low), len(y)
    x = solve_transposed(L, y)
    w = np.minimum(np.maximum(x[:nv], limits.low), limits.high)
    slack = max(0.0, x[nv]) if n > nv else 0.0
    loose = rows.rhs_m2 + rows.per_speed * slack
    ends, J_ends, vertices, offsets, boxes, _, per_speed, stop_s = rows
    which, A, values = worst_rows(Approach(ends, J_ends, vertices, offsets, boxes, loose, per_speed, stop_s), w, 0.0)
    outcome, best, most = CLEAR, -1, HELD
    found, high, row = np.zeros(n), 0.0, np.zeros(n)
    for i in range(len(which)):
        pair = which[i, 0], which[i, 1]
        row[:nv] = A[i] / per_speed[pair]
        if n > nv:
            row[nv] = -1.0
        e = solve_lower(L, row)
        length = norm_n(e)
        if not length > EMPTY:
            if values[i] > loose[pair] + per_speed[pair] * HELD:
                outcome = HOPELESS
                break
            continue
        bound = rows.rhs_m2[pair] / per_speed[pair] / length
        broken = dot_n(e, y) / length - bound
        if broken > most:
            if _among(known, which[i]):
                outcome = max(outcome, KNOWN)
            else:
                outcome, best, most, found, high = NEW, i, broken, e / length, bound
    return Found(outcome, w, slack, found, high, which[best].copy() if best >= 0 else np.zeros(4, dtype=np.int64))


@njit(cache=True, error_model="numpy")
def gather(
    problem: Metric, z: Floats, limits: Limits, rows: Approach, known: Ints, sweeps: int, most: int
) -> tuple[Metric, Floats, Ints]:
    """The problem with the approach rows that its minimiser is likely to lie on, found by coordinate descent alone.

    A row too many costs a solver little, a row that is missing costs another call of it.

    Args:
        problem: In its metric.
        z: (m,) multipliers to begin with.
        limits: Of axes and TCP.
        rows: Of the people.
        known: (k, 4) which rows the problem has, as of `worst_rows`.
        sweeps: How often every row is met before the next one joins in.
        most: Rows that may join in.

    Returns:
        The problem, the multipliers, and which rows it has.
    """
    for _ in range(most):
        y, z = descend(problem, z, sweeps)
        found = next_row(problem, y, limits, rows, known)
        if found.outcome != NEW:
            break
        problem, z, known = join(problem, z, known, found)
    return problem, z, known


@njit(cache=True)
def join(problem: Metric, z: Floats, known: Ints, found: Found) -> tuple[Metric, Floats, Ints]:
    """The problem with the approach row found, its multiplier 0, and which rows it has then.

    Args:
        problem: In its metric.
        z: (m,) multipliers.
        known: (k, 4) which rows the problem has, as of `worst_rows`.
        found: A row that is new.
    """
    E, low = np.concatenate((problem.E, found.row.reshape(1, -1))), np.append(problem.low, -NONE)
    more = Metric(problem.L, problem.b, E, low, np.append(problem.high, found.high))
    return more, np.append(z, 0.0), np.concatenate((known, found.key.reshape(1, -1)))


@njit(cache=True)
def _among(known: Ints, key: Ints) -> bool:
    found = False
    for i in range(len(known)):
        found = found or bool(np.all(known[i] == key))
    return found
