"""The minimiser of Eq. (66) under its rows, by proxqp. The only user of proxsuite.

Every vertex of every limb has rows and the minimiser lies on few of them. So rows join in while a candidate breaks
any: first while that of coordinate descent does, then while proxqp's does. Where the rows are soft, one slack [m/s]
loosens all of them, so that the people leave a solution.

Proxqp claims solutions that are none and misses others, in about one tick in a hundred near people. So it works in the
metric of the cost, begins near the solution, is asked again with other penalties where it fails, and what it finds
counts only when its multipliers prove it.
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
    soft: bool  #: whether the rows of Eq. (66i) may be broken at a cost


@dataclass(frozen=True, slots=True)
class Solution:
    """The minimiser of Eq. (66)."""

    dq_next: Floats  #: (nv,) [rad/s]
    held: bool  #: whether an approach row holds the robot back
    slack: float  #: speed by which a link approaches a limb faster than its row allows; 0 where the rows are hard [m/s]


@dataclass(frozen=True, slots=True)
class Unsolved:
    """There is no minimiser, or none was found."""

    status: str  #: what went wrong: "not finite", "infeasible" (proven), or how the search for a solution ended


#: Weight of the squared slack: a row is broken by 1 mm/s rather than that the TCP is slower by 1 m/s.
SLACK = 1000.0
#: Rounds of finding rows and solving before the problem counts as unsolved: a late step is worth less than the stop.
ROUNDS = 16
#: Sweeps of coordinate descent before a row joins in, and rows that may join in before proxqp is asked again.
SWEEPS, JOIN = 10, 40
#: Multiplier, in the metric, above which a row holds the robot back.
BINDING = 1e-8
#: Largest residual, in the metric, with which multipliers prove a solution; proxqp is asked for a tenth.
PROVEN = 2e-10
#: Bounds of the TCP broken by no more than this hold [m/s, rad/s].
KEPT = 1e-8
#: Tries of proxqp, one after the other: sweeps of coordinate descent before it begins, its inverse penalty, and how
#: many times it may change the multipliers. Which, and in which order, was tried on replays. The second one (-1) begins
#: at what non-negative least squares find: deep inside people rows are nearly dependent, and ProxQP fails.
TRIES = ((100, 1e-6, 6), (-1, 1e-6, 6), (0, 1e-6, 20), (0, 1e-5, 20), (5000, 1e-3, 40), (0, 1e-7, 40))
#: Newton steps between them.
INNER = 20


def _load_proxqp() -> Any:
    """Proxsuite's ProxQP, by its AVX2 library where the processor would do AVX-512, too.

    It comes in three, takes the widest and rounds otherwise in each: a robot would move otherwise by the last bits on
    every other computer. Without the name of one of them it takes the next.
    """
    forgo("proxsuite.proxsuite_pywrap_avx512")
    import proxsuite

    return proxsuite.proxqp


_proxqp = _load_proxqp()
_dense = _proxqp.dense


def minimise(task: Problem) -> Solution | Unsolved:
    """The minimiser over all rows. Never raises for numbers."""
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
    """Compiles what is asked only after a try of proxqp has failed, so that no session is the first to ask."""
    none, rows = np.zeros(1), np.zeros(2)
    problem = Metric(np.eye(1), none, np.zeros((2, 1)), rows, rows)
    denied(problem, rows, Limits(none, none, np.zeros((6, 1)), np.zeros(6), np.zeros(6)))
    _least_distance(problem)


def _keeps(limits: Limits, w: Floats) -> bool:
    """Return whether a velocity, rounded into the axes' bounds, also keeps those of the TCP."""
    twist = apply(limits.J, w)
    return bool(np.all((limits.J_low - KEPT <= twist) & (twist <= limits.J_high + KEPT)))


def _solve(problem: Metric, z: Floats, limits: Limits) -> tuple[Floats, Floats] | Unsolved:
    """The minimiser in the metric and the rows' multipliers, proven by them.

    Args:
        problem: In its metric.
        z: (m,) multipliers to begin with.
        limits: Of axes and TCP.
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

    Where no point keeps the rows: -b itself, and multipliers that may prove it (``denied``).
    """
    _, b, E, low, high = problem
    n, m = len(b), len(E)
    above, below = high < NONE, low > -NONE
    G = np.concatenate((-E[above], E[below]))
    at = apply(E, b)
    f = np.concatenate((-(high + at)[above], (low + at)[below]))
    columns = np.ascontiguousarray(np.vstack((G.T, f)))  # one order in memory, so one compiled kernel
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
    # the last bits of what its other backend returns depend on where its memory happens to lie
    qp = _dense.QP(n, 0, m, False, _dense.HessianType.Dense, _dense.DenseBackend.PrimalLDLT)
    settings = qp.settings
    settings.initial_guess = _proxqp.InitialGuess.WARM_START
    settings.eps_abs, settings.eps_rel = 0.1 * PROVEN, 0.0
    settings.eps_primal_inf = settings.eps_dual_inf = 0.0  # with its own tests it denies problems that have solutions
    settings.max_iter, settings.max_iter_in = rounds, INNER
    qp.init(np.eye(n), problem.b, None, None, problem.E, problem.low, problem.high, False, mu_in=penalty)
    qp.solve(y, None, z)
    results = qp.results
    return np.array(results.x), np.array(results.z), str(results.info.status)
