"""The minimiser of Eq. (66) under its rows, by ProxQP. The only user of proxsuite.

Every vertex of every limb has rows, and few of them are active at the minimiser. Therefore rows are added only while a
candidate violates them: first the candidate of coordinate descent, then that of ProxQP. If the rows are soft, one slack
[m/s] loosens all of them, so that the rows of people always leave a solution.

In about one of a hundred ticks near people, ProxQP returns a wrong solution or misses an existing one. Therefore it
works in the metric of the cost and starts near the solution. If it fails, it runs again with other penalties. A
solution is accepted only if its multipliers prove it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hrcreplay.geometry.small_matrices import apply, nonnegative_least_squares
from hrcreplay.geometry.vectors import dot_n
from hrcreplay.kernels import forgo
from hrcreplay.records import Floats
from hrcreplay.robot.control.metric_rows import (
    CLEAR,
    EMPTY,
    HOPELESS,
    KNOWN,
    NONE,
    Limits,
    Metric,
    are_numbers_known,
    build_metric,
    denied,
    descend,
    gather,
    join,
    next_row,
    residual,
)
from hrcreplay.robot.control.separation import Approach


@dataclass(frozen=True, slots=True)
class Problem:
    """Minimise ``w @ H @ w / 2 + g @ w`` over the next joint velocity w [rad/s], within limits and clear of people."""

    H: Floats  #: (nv, nv)
    g: Floats  #: (nv,)
    limits: Limits
    rows: Approach  #: Eq. (66i)
    soft: bool  #: whether the rows of Eq. (66i) may be violated at a cost


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


#: Weight of the squared slack: the cost prefers a row violation of 1 mm/s to a TCP that is slower by 1 m/s.
SLACK = 1000.0
#: Largest number of rounds of adding rows and solving; then the problem counts as unsolved, and the robot stops.
ROUNDS = 16
#: Sweeps of coordinate descent before a row is added, and largest number of rows added before each run of ProxQP.
SWEEPS, JOIN = 10, 40
#: Multiplier, in the metric, above which a row holds the robot back.
BINDING = 1e-8
#: Largest residual, in the metric, with which multipliers prove a solution; the tolerance of ProxQP is a tenth of it.
PROVEN = 2e-10
#: Bounds of the TCP hold if they are violated by no more than this [m/s, rad/s].
KEPT = 1e-8
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


def minimise(task: Problem) -> Solution | Unsolved:
    """Finds the minimiser over all rows. Raises no error for any numbers."""
    limits, rows = task.limits, task.rows
    if not are_numbers_known(task.H, task.g, limits, rows):
        return Unsolved("not finite")
    problem = build_metric(task.H, task.g, limits, task.soft, SLACK)
    if not math.isfinite(problem.b.sum() + problem.E.sum()):
        return Unsolved("not finite")
    if np.any(problem.low > problem.high):
        return Unsolved("infeasible")
    fixed, known = len(problem.E), np.empty((0, 4), dtype=np.int64)
    z = np.zeros(fixed)
    for _ in range(ROUNDS):
        problem, z, known = gather(problem, z, limits, rows, known, SWEEPS, JOIN)
        solved = _solve(problem, z, limits)
        if isinstance(solved, Unsolved):
            return solved
        y, z = solved
        found = next_row(problem, y, limits, rows, known)
        if found.outcome == HOPELESS:
            return Unsolved("infeasible")
        if found.outcome == KNOWN or not _keeps(limits, found.w):
            return Unsolved("residual")
        if found.outcome == CLEAR:
            return Solution(found.w, bool(np.any(z[fixed:] > BINDING)), found.slack)
        problem, z, known = join(problem, z, known, found)
    return Unsolved("too many rows")


def compile_second_tries() -> None:
    """Compiles the kernels that run only after a try of ProxQP has failed, so that no session compiles them."""
    none, rows = np.zeros(1), np.zeros(2)
    problem = Metric(np.eye(1), none, np.zeros((2, 1)), rows, rows)
    denied(problem, rows, Limits(none, none, np.zeros((6, 1)), np.zeros(6), np.zeros(6)))
    _least_distance(problem)


def _keeps(limits: Limits, w: Floats) -> bool:
    """Return whether a velocity, clipped to the axes' bounds, also keeps the bounds of the TCP."""
    twist = apply(limits.J, w)
    return bool(np.all((limits.J_low - KEPT <= twist) & (twist <= limits.J_high + KEPT)))


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
