"""The quadratic program of Eq. (66) in the metric of its cost, in which it is well conditioned for a solver.

With ``H = L @ L.T`` and ``y = L.T @ x`` the cost is ``y @ y / 2 + y @ b``, and every row is scaled to length 1. x is
the next joint velocity w [rad/s] and, where the approach rows are soft, the slack [m/s]. The eigenvalues of H may
differ by a factor of 10^6 (a stretched wrist); in the metric a residual of size r means an error of about r.
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
#: A row holds if it is violated by no more than this, in the metric; [m/s] if it does not depend on the velocity.
HELD = 1e-9
#: A row whose length in the metric is below this does not depend on the velocity.
EMPTY = 1e-9
#: A combination of rows proves that there is no solution if its violation is everywhere larger than this.
DENIED = 1e-9

#: First index of a plane's row in the list of known rows, in place of a link.
PLANE = -1

#: Outcomes of `next_row`: no violated row; all violated rows are known; a new one; one that no velocity satisfies.
CLEAR, KNOWN, NEW, HOPELESS = range(4)


class Limits(NamedTuple):
    """Bounds that do not depend on people."""

    low: Floats  #: (nv,) Eq. (66d)-(66f) [rad/s]
    high: Floats  #: (nv,) [rad/s]
    J: Floats  #: (6, nv) of the TCP
    J_low: Floats  #: (6,) Eq. (66g), (66h): bounds on ``J @ w`` [m/s, rad/s]
    J_high: Floats  #: (6,) [m/s, rad/s]


class Problem(NamedTuple):
    """Minimise ``w @ H @ w / 2 + g @ w`` over the next joint velocity w [rad/s], within limits and clear of people."""

    H: Floats  #: (nv, nv)
    g: Floats  #: (nv,)
    limits: Limits
    rows: Approach  #: Eq. (66i)
    soft: bool  #: whether the rows of Eq. (66i) may be violated at a cost


class Metric(NamedTuple):
    """Minimise ``y @ y / 2 + y @ b`` where ``low <= E @ y <= high``."""

    L: Floats  #: (n, n) lower triangle
    b: Floats  #: (n,)
    E: Floats  #: (m, n) the rows of axes and TCP come first
    low: Floats  #: (m,)
    high: Floats  #: (m,)


class Found(NamedTuple):
    """Constraint that a candidate violates."""

    outcome: int  #: CLEAR, KNOWN, NEW or HOPELESS
    w: Floats  #: (nv,) the candidate, within the axes' bounds [rad/s]
    slack: float  #: [m/s]
    row: Floats  #: (n,) the new row that it violates most
    high: float  #: upper bound of the row
    key: Ints  #: (4,) indices of the row, as in `worst_rows`


@njit(cache=True, inner=True, error_model="numpy")
def are_numbers_known(H: Floats, g: Floats, limits: Limits, rows: Approach) -> bool:
    """Return whether no number is NaN and only missing bounds are infinite.

    Args:
        H: (nv, nv).
        g: (nv,).
        limits: Limits of axes and TCP.
        rows: Approach rows of people.
    """
    total = H.sum() + g.sum() + limits.J.sum() + rows.ends_m.sum() + rows.J_ends.sum() + rows.vertices_m.sum()
    total += rows.boxes_m.sum() + rows.per_speed.sum() + rows.stop_s + rows.planes.sum() + rows.plane_high.sum()
    known = math.isfinite(total) and not np.isnan(rows.rhs_m2.sum())
    for bounds in (limits.low, limits.high, limits.J_low, limits.J_high):
        known = known and not np.isnan(bounds.sum())
    return known


@njit(cache=True, inner=True, error_model="numpy")
def build_metric(H: Floats, g: Floats, limits: Limits, soft: bool, slack_weight: float) -> Metric:
    """Builds the problem without approach rows; NaN if H is not positive definite.

    Args:
        H: (nv, nv) positive definite.
        g: (nv,).
        limits: Limits of axes and TCP.
        soft: Whether there is a slack.
        slack_weight: Weight of the slack; its cost is half of this times its square.
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
    """Initial values for a solver: candidate and multipliers after coordinate descent over the multipliers.

    Hildreth's method satisfies one row after the other, each without regard to the others. It usually finds the active
    rows of the minimiser and so saves the solver most of its steps.

    Args:
        problem: The problem in its metric.
        z: (m,) initial multipliers; positive for upper bounds, negative for lower bounds.
        sweeps: Number of passes over all rows.
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
    for i in range(len(E)):  # a solver would keep the multiplier of an inactive row
        if z[i] != 0.0 and abs(dot_n(E[i], y) - (high[i] if z[i] > 0.0 else low[i])) > 1e-9:
            z[i] = 0.0
    return y, z


@njit(cache=True)
def residual(problem: Metric, y: Floats, z: Floats) -> float:
    """Residual of y and z in the Karush-Kuhn-Tucker conditions, which prove a minimiser; NaN for NaN."""
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
    """Return whether the multipliers prove that no velocity satisfies all rows (Farkas).

    The rows of TCP and people are added with the multipliers as weights. The proof holds if no velocity within the
    axes' bounds satisfies the sum. With a slack, rows of people cannot contribute, because the slack loosens them.

    Args:
        problem: The problem in its metric.
        z: (m,) multipliers; positive for upper bounds, negative for lower bounds.
        limits: Limits of axes and TCP.
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
        a = dot_n(L[j], total)  # coefficient of x, since y = L.T @ x
        if j >= nv:
            least = least if abs(a) < EMPTY else -np.inf
        elif a != 0.0:
            least += min(a * limits.low[j], a * limits.high[j])
    return least > bound + DENIED


@njit(cache=True, inner=True, error_model="numpy")
def next_row(problem: Metric, y: Floats, limits: Limits, rows: Approach, known: Ints) -> Found:
    """Finds the new approach row that a candidate violates most, in the metric.

    Args:
        problem: The problem in its metric.
        y: (n,) the candidate.
        limits: Limits of axes and TCP.
        rows: Approach rows of people.
        known: (k, 4) indices of the known rows, as in `worst_rows`.
    """
    L, nv, n = problem.L, len(limits.low), len(y)
    x = solve_transposed(L, y)
    w = np.minimum(np.maximum(x[:nv], limits.low), limits.high)
    slack = max(0.0, x[nv]) if n > nv else 0.0
    loose = rows.rhs_m2 + rows.per_speed * slack
    ends, J_ends, vertices, offsets, boxes, _, per_speed, stop_s, planes, plane_high = rows
    loosened = Approach(ends, J_ends, vertices, offsets, boxes, loose, per_speed, stop_s, planes, plane_high)
    which, A, values = worst_rows(loosened, w, 0.0)
    outcome, key, most = CLEAR, np.zeros(4, dtype=np.int64), HELD
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
                outcome, key, most, found, high = NEW, which[i].copy(), broken, e / length, bound
    found_row = Found(outcome, w, slack, found, high, key)
    return found_row if outcome == HOPELESS else _with_planes(problem, y, rows, known, found_row, most)


@njit(cache=True, inner=True, error_model="numpy")
def _with_planes(problem: Metric, y: Floats, rows: Approach, known: Ints, found: Found, most: float) -> Found:
    """The new row of a plane that a candidate violates most, if it violates it more than ``found``; else ``found``.

    Args:
        problem: The problem in its metric.
        y: (n,) the candidate.
        rows: Approach rows.
        known: (k, 4) indices of the known rows, as in `worst_rows`.
        found: The row of people that it violates most.
        most: Its violation, in the metric.
    """
    n, nv = len(y), len(found.w)
    for i in range(len(rows.planes)):
        if not dot_n(rows.planes[i], found.w) > rows.plane_high[i] + found.slack:
            continue
        row = np.zeros(n)
        row[:nv] = rows.planes[i]
        if n > nv:
            row[nv] = -1.0
        e = solve_lower(problem.L, row)
        length = norm_n(e)
        if not length > EMPTY:  # the bound is not negative, so the row holds
            continue
        bound = rows.plane_high[i] / length
        broken = dot_n(e, y) / length - bound
        if not broken > most:
            continue
        key = np.array([PLANE, i, 0, 0])
        if not _among(known, key):
            most = broken
            found = Found(NEW, found.w, found.slack, e / length, bound, key)
        elif found.outcome == CLEAR:
            found = Found(KNOWN, found.w, found.slack, found.row, found.high, found.key)
    return found


@njit(cache=True, inner=True)
def join(problem: Metric, known: Ints, found: Found) -> tuple[Metric, Ints]:
    """Adds an approach row; returns the problem and the indices of its approach rows.

    Args:
        problem: The problem in its metric.
        known: (k, 4) indices of the approach rows in the problem, as in `worst_rows`.
        found: The new row.
    """
    E, low = np.concatenate((problem.E, found.row.reshape(1, -1))), np.append(problem.low, -NONE)
    more = Metric(problem.L, problem.b, E, low, np.append(problem.high, found.high))
    return more, np.concatenate((known, found.key.reshape(1, -1)))


@njit(cache=True, inner=True)
def _among(known: Ints, key: Ints) -> bool:
    found = False
    for i in range(len(known)):
        found = found or bool(np.all(known[i] == key))
    return found
