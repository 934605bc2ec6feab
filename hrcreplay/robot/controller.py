"""The trajectory generator: QP (66), or else the stop (67). The only module that imports proxsuite."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import proxsuite

from hrcreplay.records import Floats
from hrcreplay.robot import stepping
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.obstacles import Obstacles
from hrcreplay.robot.problem import BoundedRows, Problem, problem
from hrcreplay.robot.sight import observe
from hrcreplay.robot.stepping import PlanSettings, RobotState, Step
from hrcreplay.robot.tracking import minimiser

#: Largest residual with which a row counts as held [m^2; m/s, rad/s].
HELD = 1e-11

#: Multiplier above which an approach row holds the robot back.
BINDING = 1e-7

#: Rows that this much of the present velocity breaks are among the first to be tried.
AHEAD = 1.1

#: Rounds of solving and adding broken rows before the problem counts as unsolved.
ROUNDS = 40


@dataclass(frozen=True, slots=True)
class _Attempt:
    """How the solver goes about a problem."""

    bcl: bool  #: its rule for the penalty
    penalty: float  #: the penalty it begins with
    infeasible: float  #: its tolerance for there being no solution; 0: it never claims so
    rounds: int


#: Tried in turn until one finds a solution that can be checked. About one in a thousand of the problems near people
#: defeats the first and is solved by another; the tolerance for infeasibility is far below the solver's default,
#: with which it denies many more.
ATTEMPTS = (
    _Attempt(bcl=True, penalty=1e-2, infeasible=1e-14, rounds=200),
    _Attempt(bcl=False, penalty=1e-2, infeasible=0.0, rounds=60),
    _Attempt(bcl=False, penalty=1e-1, infeasible=0.0, rounds=60),
    _Attempt(bcl=False, penalty=1e-3, infeasible=0.0, rounds=60),
)

#: Largest product of a multiplier and what its row lacks to its bound, in the scaled problem.
GAP = 1e-9

#: Norm below which a row is not scaled up: no link moves along it.
TINY = 1e-9

_dense = proxsuite.proxqp.dense
_SOLVED = proxsuite.proxqp.QPSolverOutput.PROXQP_SOLVED


@dataclass(frozen=True, slots=True)
class Solution:
    """The minimiser of Eq. (66); every row has been checked."""

    dq_next: Floats  #: (nv,) [rad/s]
    held: bool  #: whether an approach row holds the robot back
    rounds: int  #: how often rows joined in


@dataclass(frozen=True, slots=True)
class Unsolved:
    """No minimiser that could be checked: the robot brakes."""

    status: str  #: what went wrong


def step(
    robot: RobotModel,
    state: RobotState,
    T_world_ref: Floats,
    twist_ref: Floats,
    obstacles: Obstacles,
    settings: PlanSettings,
) -> Step:
    """One tick of Section 5: the acceleration of Eq. (66), or that of Eq. (67) where there is none.

    Never raises for numbers: a robot whose state, reference or people are not known brakes with a reason.

    Args:
        robot: The manipulator.
        state: At the tick.
        T_world_ref: (4, 4) reference of the TCP one tick later.
        twist_ref: (6,) its velocity, linear first, world frame [m/s, rad/s].
        obstacles: The swept volumes of the tick.
        settings: Weights and limits.
    """
    with np.errstate(all="ignore"):  # numbers beyond reason end as a reason to brake, not as a warning
        sight = observe(robot, state, obstacles, settings.clearance_m)
        reason = sight.reason
        if sight.pairs is not None:
            task = problem(robot, state, sight.pose, T_world_ref, twist_ref, obstacles, sight.pairs, settings)
            solution = solve(task)
            if isinstance(solution, Solution):
                status = stepping.LIMITED if solution.held else stepping.TRACKING
                return sight.step(state, solution.dq_next, settings.dt_s, status)
            reason = _REASONS.get(solution.status, stepping.NO_SOLUTION)
        return sight.step(state, stepping.braked(state, robot.ddq_max, settings.dt_s), settings.dt_s, 2, reason)


_REASONS = {"not finite": stepping.NOT_FINITE, "separation failed": stepping.NO_DISTANCE}


def solve(task: Problem) -> Solution | Unsolved:
    """The minimiser over all rows, found with few of them.

    Beginning with the minimiser without rows, the rows that the candidate breaks join in and the problem is solved
    again, until all rows of all links, limbs and vertices hold. A minimiser over some of the rows that breaks none
    of the others is the minimiser over all of them.
    """
    free = minimiser(task.H, task.g)
    if not math.isfinite(free.sum()):
        return Unsolved("not finite")
    w = np.clip(free, task.low, task.high)
    solved, held = bool((w == free).all()), False
    rows = BoundedRows((), np.empty((0, len(w))), np.empty(0), np.empty(0))
    for rounds in range(ROUNDS):
        broken = task.broken_rows(w, HELD)
        if task.pairs.failed:
            return Unsolved("separation failed")
        if solved and not broken.keys:
            return Solution(w, held, rounds)
        if not rounds:  # the rows that held the robot until now are likely to hold it again
            broken = broken.joined(task.broken_rows(AHEAD * task.dq, HELD))
        before, rows = len(rows.keys), rows.joined(broken)
        if solved and len(rows.keys) == before:
            return Unsolved("residual")
        if _hopeless(rows, task):
            return Unsolved("infeasible")
        result = _minimise(task, rows)
        if isinstance(result, Unsolved):
            return result
        w, multipliers = result
        held = any(key[0] >= 0 and z > BINDING for key, z in zip(rows.keys, multipliers, strict=True))
        solved = True
    return Unsolved("rounds")


def _hopeless(rows: BoundedRows, task: Problem) -> bool:
    """Whether no velocity within the axes' limits satisfies some row by itself. Spares the solver a long search."""
    at_low, at_high = rows.A * task.low, rows.A * task.high
    least, most = np.minimum(at_low, at_high).sum(axis=1), np.maximum(at_low, at_high).sum(axis=1)
    return bool(np.any((least > rows.high + HELD) | (most < rows.low - HELD)))


def _minimise(task: Problem, rows: BoundedRows) -> tuple[Floats, Floats] | Unsolved:
    """Minimiser over the axes' limits and some rows, and the rows' multipliers.

    A fresh solver each time: what it returns depends on the problem alone, not on what it solved before. Cost and
    rows are scaled to 1, so that its tolerances mean the same in every pose.
    """
    cost, norms = 1.0 / task.H.diagonal().max(), 1.0 / np.maximum(np.linalg.norm(rows.A, axis=1), TINY)
    A, low, high = rows.A * norms[:, None], rows.low * norms, rows.high * norms
    status = ""
    for attempt in ATTEMPTS:
        qp = _dense.QP(len(task.g), 0, len(low), True, _dense.HessianType.Dense, _dense.DenseBackend.PrimalDualLDLT)
        settings = qp.settings
        settings.initial_guess = proxsuite.proxqp.InitialGuess.NO_INITIAL_GUESS
        settings.eps_abs, settings.eps_rel = 1e-13, 0.0
        settings.default_rho = 1e-8  # well below the damping of the cost, or flat directions take forever
        settings.bcl_update, settings.default_mu_in = attempt.bcl, attempt.penalty
        settings.eps_primal_inf, settings.max_iter, settings.max_iter_in = attempt.infeasible, attempt.rounds, 100
        qp.init(task.H * cost, task.g * cost, None, None, A, low, high, task.low, task.high)
        qp.solve()
        x, z = qp.results.x, qp.results.z
        status = qp.results.info.status.name
        if qp.results.info.status == _SOLVED and _complementary(
            z, np.concatenate([A @ x, x]), np.concatenate([low, task.low]), np.concatenate([high, task.high])
        ):
            return np.clip(x, task.low, task.high), z[: len(low)]
    return Unsolved(status)


def _complementary(z: Floats, values: Floats, low: Floats, high: Floats) -> bool:
    """Whether only rows at their bound carry a multiplier: the solver claims solutions where this does not hold."""
    return bool(
        np.all(np.where(z > 0.0, z * np.minimum(high - values, 1.0), z * np.maximum(low - values, -1.0)) <= GAP)
    )
