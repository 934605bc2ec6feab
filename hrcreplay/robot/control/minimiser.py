"""The minimiser of Eq. (66) under its rows, by ``row_search`` and, where that proves none, ProxQP.

The only user of proxsuite. If the rows are soft, one slack [m/s] loosens all of them, so that the rows of people always
leave a solution.

In about one of a hundred ticks near people, ProxQP returns a wrong solution or misses an existing one. Therefore it
works in the metric of the cost and starts near the solution. If it fails, it runs again with other penalties. A
solution is accepted only if its multipliers prove it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hrcreplay.geometry.small_matrices import apply, nonnegative_least_squares
from hrcreplay.geometry.vectors import dot_n
from hrcreplay.kernels import forgo
from hrcreplay.records import Floats
from hrcreplay.robot.control.metric_rows import EMPTY, NONE, Limits, Metric, Problem, denied, descend, residual
from hrcreplay.robot.control.row_search import (
    INFEASIBLE,
    MANY,
    PROVEN,
    RESIDUAL,
    SOLVED,
    UNKNOWN,
    UNPROVEN,
    go_on,
    search,
)
from hrcreplay.robot.control.separation import Approach


@dataclass(frozen=True, slots=True)
class Solution:
    """The minimiser of Eq. (66)."""

    dq_next: Floats  #: (nv,) [rad/s]
    held: bool  #: whether an approach row holds the robot back
    slack: float  #: speed by which a link may approach a limb faster than its row allows; 0 if the rows are hard [m/s]


@dataclass(frozen=True, slots=True)
class Unsolved:
    """The problem has no minimiser, or the search did not find it."""

    status: str  #: the problem: "not finite", "infeasible" (proven), or the last status of the search


#: Tries of ProxQP, one after the other: sweeps of coordinate descent before the try, inverse penalty, and largest
#: number of multiplier updates. Values and order were chosen on replays. The second try (-1) starts at the result of
#: non-negative least squares: deep inside people the rows are nearly dependent, and ProxQP fails.
TRIES = ((100, 1e-6, 6), (-1, 1e-6, 6), (0, 1e-6, 20), (0, 1e-5, 20), (5000, 1e-3, 40), (0, 1e-7, 40))
#: Largest number of Newton steps between two updates of the multipliers.
INNER = 20


def _load_proxqp() -> Any:
    """Loads proxsuite's ProxQP, in its AVX2 library also on a processor with AVX-512.

    proxsuite has three libraries, loads the one with the widest vectors, and each rounds differently. The last bits of
    a robot's motion would then depend on the computer. If the AVX-512 library is hidden, proxsuite loads the next one.
    """
    forgo("proxsuite.proxsuite_pywrap_avx512")
    import proxsuite

    return proxsuite.proxqp


_proxqp = _load_proxqp()
_dense = _proxqp.dense


#: Outcome of a search without a minimiser -> its status.
STATUS = {INFEASIBLE: "infeasible", UNKNOWN: "not finite", RESIDUAL: "residual", MANY: "too many rows"}


def minimise(task: Problem) -> Solution | Unsolved:
    """Finds the minimiser over all rows. Raises no error for any numbers."""
    at = search(task)
    while at.outcome == UNPROVEN:  # a row more in each round
        solved = _solve(at.problem, at.z, task.limits)
        if isinstance(solved, Unsolved):
            return solved
        y, z = solved
        at = go_on(task, at.problem, z, at.known, y)
    if at.outcome == SOLVED:
        return Solution(at.w, at.held, at.slack)
    return Unsolved(STATUS[at.outcome])


def compile_second_tries() -> None:
    """Compiles the kernels that run only where ``row_search`` proves no solution, so that no session compiles them."""
    one, none = np.ones(1), np.zeros(1)
    limits = Limits(-one, one, np.zeros((6, 1)), -np.ones(6), np.ones(6))
    empty = np.empty((0, 2, 3)), np.empty((0, 2, 3, 1)), np.empty((0, 3)), np.zeros(1, np.int64), np.empty((0, 2, 3))
    rows = Approach(*empty, np.empty((0, 0)), np.empty((0, 0)), 1.0, np.empty((0, 1)), np.empty(0))
    task = Problem(np.eye(1), none, limits, rows, soft=False)
    at = search(task)
    solved = _solve(at.problem, at.z, limits)
    if not isinstance(solved, Unsolved):
        go_on(task, at.problem, solved[1], at.known, solved[0])
    denied(at.problem, at.z, limits)
    _least_distance(at.problem)


def _solve(problem: Metric, z: Floats, limits: Limits) -> tuple[Floats, Floats] | Unsolved:
    """The minimiser in the metric and the multipliers of the rows, which prove it.

    Args:
        problem: The problem in its metric.
        z: (m,) initial multipliers.
        limits: Limits of axes and TCP.
    """
    status = ""
    for sweeps, penalty, rounds in TRIES:
        y, z = descend(problem, z, sweeps) if sweeps >= 0 else _least_distance(problem)
        if sweeps < 0 and denied(problem, z, limits):
            return Unsolved("infeasible")
        y, z, status = _by_proxqp(problem, y, z, penalty, rounds)
        if residual(problem, y, z) <= PROVEN:  # false for NaN
            return y, z
        if denied(problem, z, limits):
            return Unsolved("infeasible")
        z = np.zeros(len(z))
    return Unsolved(status)


def _least_distance(problem: Metric) -> tuple[Floats, Floats]:
    """The minimiser as the point nearest to -b, by non-negative least squares (Lawson and Hanson).

    If no point satisfies the rows, returns -b and multipliers that may prove this (``denied``).
    """
    _, b, E, low, high = problem
    n, m = len(b), len(E)
    above, below = high < NONE, low > -NONE
    G = np.concatenate((-E[above], E[below]))
    at = apply(E, b)
    f = np.concatenate((-(high + at)[above], (low + at)[below]))
    columns = np.ascontiguousarray(np.vstack((G.T, f)))  # one memory layout needs one kernel
    pull, found = nonnegative_least_squares(columns, np.append(np.zeros(n), 1.0), 3 * m)
    if not found:
        return -b, np.zeros(m)
    z = np.zeros(m)
    z[above] += pull[: np.count_nonzero(above)]
    z[below] -= pull[np.count_nonzero(above) :]
    left = 1.0 - dot_n(f, pull)
    if not left > EMPTY:
        return -b, z
    z /= left
    return -b - apply(E.T, z), z


def _by_proxqp(problem: Metric, y: Floats, z: Floats, penalty: float, rounds: int) -> tuple[Floats, Floats, str]:
    """Solution of ProxQP, and its status."""
    n, m = len(y), len(z)
    # with the other backend the last bits of the result depend on memory addresses
    qp = _dense.QP(n, 0, m, False, _dense.HessianType.Dense, _dense.DenseBackend.PrimalLDLT)
    settings = qp.settings
    settings.initial_guess = _proxqp.InitialGuess.WARM_START
    settings.eps_abs, settings.eps_rel = 0.1 * PROVEN, 0.0
    settings.eps_primal_inf = settings.eps_dual_inf = 0.0  # its own tests reject solvable problems
    settings.max_iter, settings.max_iter_in = rounds, INNER
    qp.init(np.eye(n), problem.b, None, None, problem.E, problem.low, problem.high, False, mu_in=penalty)
    qp.solve(y, None, z)
    results = qp.results
    return np.array(results.x), np.array(results.z), str(results.info.status)
