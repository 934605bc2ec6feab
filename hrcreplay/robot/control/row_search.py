"""The minimiser of Eq. (66) by the dual active-set method of Goldfarb and Idnani, as kernels.

The method (Mathematical Programming 27, 1983) begins at the minimiser without rows. The row that the candidate violates
most joins the active rows, on which the candidate moves; an active row whose multiplier becomes 0 on the way leaves
them. In the metric of the cost the candidate is the point nearest to -b.

Every vertex of every limb has rows, and few of them are active at the minimiser. Therefore a row of people is computed
only when a candidate violates it, and the method goes on from there. A candidate counts only if its multipliers prove
it: by its residual in the Karush-Kuhn-Tucker conditions. Where they do not, ``minimiser`` asks ProxQP.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.vectors import dot_n, norm_n
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control.metric_rows import (
    CLEAR,
    HOPELESS,
    KNOWN,
    Limits,
    Metric,
    Problem,
    are_numbers_known,
    build_metric,
    denied,
    join,
    next_row,
    residual,
)

#: Weight of the squared slack: the cost prefers a row violation of 1 mm/s to a TCP that is slower by 1 m/s.
SLACK = 1000.0
#: Largest number of rows of people that are added; then the problem counts as unsolved, and the robot stops.
MOST_ROWS = 300
#: Largest number of changes of the active rows between two added rows.
CHANGES = 60
#: Multiplier, in the metric, above which a row holds the robot back.
BINDING = 1e-8
#: Largest residual, in the metric, with which multipliers prove a solution.
PROVEN = 2e-10
#: A row is violated if it is so by more than this, in the metric.
VIOLATED = 0.1 * PROVEN
#: A row of length 1 whose part outside the active rows is shorter than this depends on them.
DEPENDENT = 1e-10
#: Bounds of the TCP hold if they are violated by no more than this [m/s, rad/s].
KEPT = 1e-8

#: Outcomes of a search: the minimiser; the next candidate is not proven; proven to have no solution; a number is not
#: finite; the candidate violates rows that it knows, or a bound of the TCP; too many rows.
SOLVED, UNPROVEN, INFEASIBLE, UNKNOWN, RESIDUAL, MANY = range(6)


class Search(NamedTuple):
    """State of the search for the minimiser."""

    outcome: int  #: SOLVED, UNPROVEN, INFEASIBLE, UNKNOWN, RESIDUAL or MANY
    w: Floats  #: (nv,) the minimiser, if solved [rad/s]
    slack: float  #: speed by which a link may approach a limb faster than its row allows [m/s]
    held: bool  #: whether an approach row holds the robot back
    problem: Metric  #: with the rows added so far
    z: Floats  #: (m,) multipliers; positive for upper bounds, negative for lower bounds
    known: Ints  #: (k, 4) indices of the added rows, as in ``worst_rows``


class Active(NamedTuple):
    """The active rows; space for as many as there are variables."""

    rows: Ints  #: (n,) index of each row
    sides: Floats  #: (n,) 1 for an upper, -1 for a lower bound
    pulls: Floats  #: (n,) multipliers, not negative
    basis: Floats  #: (n, n) orthonormal directions that span the rows
    triangle: Floats  #: (n, n) the rows in this basis, one per column


@njit(cache=True)
def search(task: Problem) -> Search:
    """Searches the minimiser over all rows. Raises no error for any numbers."""
    limits, nothing, known = task.limits, np.zeros(0), np.empty((0, 4), np.int64)
    if not are_numbers_known(task.H, task.g, limits, task.rows):
        empty = Metric(np.zeros((0, 0)), nothing, np.zeros((0, 0)), nothing, nothing)
        return _ended(UNKNOWN, empty, nothing, known)
    problem = build_metric(task.H, task.g, limits, task.soft, SLACK)
    z = np.zeros(len(problem.E))
    if not math.isfinite(problem.b.sum() + problem.E.sum()):
        return _ended(UNKNOWN, problem, z, known)
    if np.any(problem.low > problem.high):
        return _ended(INFEASIBLE, problem, z, known)
    return _add_rows(task, problem, known)


@njit(cache=True)
def go_on(task: Problem, problem: Metric, z: Floats, known: Ints, y: Floats) -> Search:
    """Goes on from a candidate that another solver has found and its multipliers have proven.

    Args:
        task: The problem.
        problem: The problem in its metric, with the rows added so far.
        z: (m,) multipliers of the candidate.
        known: (k, 4) indices of the added rows.
        y: (n,) the candidate in the metric.
    """
    at = _check(task, problem, z, known, y)
    return at if at.outcome != UNPROVEN else _add_rows(task, at.problem, at.known)


@njit(cache=True, inner=True)
def _add_rows(task: Problem, problem: Metric, known: Ints) -> Search:
    """Moves the candidate and adds rows that it violates, until it violates none."""
    n = len(problem.b)
    square = np.empty((n, n))
    on = Active(np.empty(n, np.int64), np.empty(n), np.empty(n), square, square.copy())
    y, count = -problem.b, 0
    while len(known) < MOST_ROWS:
        count, feasible = _move(problem, y, on, count)
        z = _multipliers(problem, on, count)
        if not feasible:
            return _ended(INFEASIBLE if denied(problem, z, task.limits) else UNPROVEN, problem, z, known)
        if not residual(problem, y, z) <= PROVEN:  # also for NaN
            return _ended(UNPROVEN, problem, z, known)
        at = _check(task, problem, z, known, y)
        if at.outcome != UNPROVEN:
            return at
        problem, known = at.problem, at.known
    return _ended(MANY, problem, np.zeros(len(problem.E)), known)


@njit(cache=True, inner=True)
def _ended(outcome: int, problem: Metric, z: Floats, known: Ints) -> Search:
    """The state of a search without a minimiser."""
    return Search(outcome, np.empty(0), 0.0, False, problem, z, known)


@njit(cache=True, inner=True)
def _check(task: Problem, problem: Metric, z: Floats, known: Ints, y: Floats) -> Search:
    """The minimiser, if a proven candidate violates no row; UNPROVEN: with the row added that it violates most."""
    limits, fixed = task.limits, len(task.limits.low) + len(task.limits.J)
    found = next_row(problem, y, limits, task.rows, known)
    if found.outcome == HOPELESS:
        return _ended(INFEASIBLE, problem, z, known)
    if found.outcome == KNOWN or not _keeps(limits, found.w):
        return _ended(RESIDUAL, problem, z, known)
    if found.outcome == CLEAR:
        return Search(SOLVED, found.w, found.slack, bool(np.any(z[fixed:] > BINDING)), problem, z, known)
    problem, known = join(problem, known, found)
    return _ended(UNPROVEN, problem, np.append(z, 0.0), known)


@njit(cache=True, inner=True)
def _keeps(limits: Limits, w: Floats) -> bool:
    """Return whether a velocity, clipped to the axes' bounds, also keeps the bounds of the TCP."""
    for i in range(len(limits.J)):
        twist = dot_n(limits.J[i], w)
        if not limits.J_low[i] - KEPT <= twist <= limits.J_high[i] + KEPT:
            return False
    return True


@njit(cache=True, inner=True)
def _multipliers(problem: Metric, on: Active, count: int) -> Floats:
    """(m,) multipliers of all rows."""
    z = np.zeros(len(problem.E))
    for i in range(count):
        z[on.rows[i]] = on.sides[i] * on.pulls[i]
    return z


@njit(cache=True, inner=True)
def _move(problem: Metric, y: Floats, on: Active, count: int) -> tuple[int, bool]:
    """Moves the candidate until it violates no row of the problem.

    Args:
        problem: The problem in its metric.
        y: (n,) the candidate, on the active rows; receives the next one.
        on: The active rows; receives those of the next candidate, or those that contradict each other.
        count: Number of active rows.

    Returns:
        Number of active rows, and False if rows contradict each other or too many changes were made.
    """
    for _ in range(CHANGES):
        row, side, violation = _most_violated(problem, y)
        if row < 0:
            return _settle(problem, y, on, count), True
        count, joined = _move_onto(problem, y, on, count, row, side, violation)
        if not joined:
            return count, False
    return count, False


@njit(cache=True, inner=True)
def _move_onto(
    problem: Metric, y: Floats, on: Active, count: int, row: int, side: float, violation: float
) -> tuple[int, bool]:
    """Moves the candidate until it is on a row that it violates, and makes the row active.

    Args:
        problem: The problem in its metric.
        y: (n,) the candidate; receives the next one.
        on: The active rows; those whose multiplier becomes 0 on the way leave them.
        count: Number of active rows.
        row: Index of the row.
        side: 1 for its upper, -1 for its lower bound.
        violation: Positive.

    Returns:
        Number of active rows, and False if rows contradict each other or too many changes were made.
    """
    n, pull = len(y), 0.0
    along, rest, shares = np.empty(n), np.empty(n), np.empty(n)
    for _ in range(CHANGES):
        length = _split(on, count, side * problem.E[row], along, rest)
        _solve_upper(on.triangle, count, along, shares)
        step, leaves = np.inf, -1  # until the multiplier of an active row is 0
        for i in range(count):
            if shares[i] > 0.0 and on.pulls[i] < step * shares[i]:
                step, leaves = on.pulls[i] / shares[i], i
        if length > DEPENDENT and count < n and violation <= step * length**2:  # until the row holds
            step, leaves = violation / length**2, -1
        if step == np.inf:
            return _contradict(on, count, row, side, shares), False
        pull += step
        for i in range(count):
            on.pulls[i] -= step * shares[i]
        if length > DEPENDENT:
            violation -= step * length**2
            for k in range(n):
                y[k] -= step * rest[k]
        if leaves < 0:
            return _join(on, count, row, side, pull, along, rest, length), True
        count = _leave(problem, on, count, leaves)
    return count, False


@njit(cache=True, inner=True)
def _most_violated(problem: Metric, y: Floats) -> tuple[int, float, float]:
    """The row that a candidate violates most, its side, and by how much; -1 without one."""
    row, side, most = -1, 0.0, VIOLATED
    for i in range(len(problem.E)):
        at = dot_n(problem.E[i], y)
        if at - problem.high[i] > most:
            row, side, most = i, 1.0, at - problem.high[i]
        if problem.low[i] - at > most:
            row, side, most = i, -1.0, problem.low[i] - at
    return row, side, most


@njit(cache=True, inner=True)
def _split(on: Active, count: int, normal: Floats, along: Floats, rest: Floats) -> float:
    """Writes the part of a row in the basis of the active rows and the rest of it; returns the length of the rest."""
    rest[:] = normal
    along[:count] = 0.0
    for _ in range(2):  # two passes suffice
        for i in range(count):
            part = dot_n(on.basis[i], rest)
            along[i] += part
            for k in range(len(rest)):
                rest[k] -= part * on.basis[i, k]
    return norm_n(rest)


@njit(cache=True, inner=True)
def _solve_upper(triangle: Floats, count: int, right: Floats, x: Floats) -> None:
    """Solves ``triangle @ x = right`` for the first ``count`` rows of an upper triangle."""
    for i in range(count - 1, -1, -1):
        x[i] = right[i]
        for j in range(i + 1, count):
            x[i] -= triangle[i, j] * x[j]
        x[i] /= triangle[i, i]


@njit(cache=True, inner=True)
def _join(
    on: Active, count: int, row: int, side: float, pull: float, along: Floats, rest: Floats, length: float
) -> int:
    """Adds a row with its multiplier and its parts from ``_split``; returns the number of active rows."""
    on.rows[count], on.sides[count], on.pulls[count] = row, side, pull
    for i in range(count):
        on.triangle[i, count] = along[i]
    on.triangle[count, count] = length
    for k in range(len(rest)):
        on.basis[count, k] = rest[k] / length
    return count + 1


@njit(cache=True, inner=True)
def _leave(problem: Metric, on: Active, count: int, leaves: int) -> int:
    """Removes an active row; returns the number left."""
    along, rest = np.empty(len(on.rows)), np.empty(len(on.rows))
    for i in range(leaves + 1, count):
        row, side, pull = on.rows[i], on.sides[i], on.pulls[i]
        length = _split(on, i - 1, side * problem.E[row], along, rest)
        _join(on, i - 1, row, side, pull, along, rest, length)
    return count - 1


@njit(cache=True, inner=True)
def _settle(problem: Metric, y: Floats, on: Active, count: int) -> int:
    """Computes candidate and multipliers of the active rows again, without the errors of the steps; returns ``count``.

    The candidate is the point nearest to -b at which the active rows hold with equality.
    """
    parts = np.empty(count)  # of the way from -b, in the basis
    y[:] = -problem.b
    for i in range(count):
        row, side = on.rows[i], on.sides[i]
        parts[i] = side * (dot_n(problem.E[row], y) - (problem.high[row] if side > 0.0 else problem.low[row]))
        for j in range(i):
            parts[i] -= on.triangle[j, i] * parts[j]
        parts[i] /= on.triangle[i, i]
    for i in range(count):
        for k in range(len(y)):
            y[k] -= parts[i] * on.basis[i, k]
    _solve_upper(on.triangle, count, parts, on.pulls)
    return count


@njit(cache=True, inner=True)
def _contradict(on: Active, count: int, row: int, side: float, shares: Floats) -> int:
    """Writes the multipliers with which a row and the active rows contradict each other; returns their number.

    The row is a sum of active rows with weights that are not positive, so the weighted sum of all is 0.
    """
    for i in range(count):
        on.pulls[i] = -shares[i]
    if count < len(on.rows):
        on.rows[count], on.sides[count], on.pulls[count] = row, side, 1.0
        return count + 1
    return count
