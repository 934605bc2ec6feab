"""The trajectory generator: QP (66), or else the stop (67). The only module that imports proxsuite."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import proxsuite

from hrcreplay.records import Floats
from hrcreplay.robot import stepping
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.obstacles import Obstacles
from hrcreplay.robot.optimum import OUTCOMES, SOLVED, Optimum, optimum
from hrcreplay.robot.problem import Problem, problem
from hrcreplay.robot.sight import observe
from hrcreplay.robot.stepping import PlanSettings, RobotState, Step

#: Largest residual with which a row counts as held [m^2; m/s, rad/s].
HELD = 1e-11

#: Multiplier above which a row holds the robot back.
BINDING = 1e-9

#: Largest gradient left, and product of a multiplier and its row's slack, with which multipliers prove a solution.
PROVEN = 1e-9

#: How far proxqp's solution may be from the proven one [rad/s].
AGREED = 1e-7

_dense = proxsuite.proxqp.dense
_SOLVED = proxsuite.proxqp.QPSolverOutput.PROXQP_SOLVED


@dataclass(frozen=True, slots=True)
class Solution:
    """The minimiser of Eq. (66); every row has been checked."""

    dq_next: Floats  #: (nv,) [rad/s]
    held: bool  #: whether an approach row holds the robot back


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
            reason = stepping.NOT_FINITE if solution.status == "not finite" else stepping.NO_SOLUTION
        return sight.step(
            state, stepping.braked(state, robot.ddq_max, settings.dt_s), settings.dt_s, stepping.BRAKING, reason
        )


def solve(task: Problem) -> Solution | Unsolved:
    """The minimiser over all rows, proven; found as ``optimum`` does, and by proxqp where rows hold it."""
    found = optimum(task.H, task.g, task.limits, task.rows, HELD)
    if found.outcome != SOLVED:
        return Unsolved(OUTCOMES[found.outcome])
    if not task.keeps(found.w, HELD):
        return Unsolved("residual")
    if not _proven(task, found):
        return Unsolved("unproven")
    w = _by_proxqp(task, found) if np.any(found.z) else found.w
    return Solution(w, bool(np.any(found.z[found.fixed :] > BINDING)))


def _proven(task: Problem, found: Optimum) -> bool:
    """Whether the multipliers prove a minimiser: the gradient must vanish, and only rows at their bound carry one."""
    gradient = task.H @ found.w + task.g + found.z @ found.A
    unused = found.z * np.minimum(found.high - found.A @ found.w, 1.0)
    most = PROVEN * max(1.0, np.abs(task.g).max())
    return bool(np.abs(gradient).max() <= most and np.abs(unused).max() <= most and found.z.min() >= 0.0)


def _by_proxqp(task: Problem, known: Optimum) -> Floats:
    """The solution as proxqp returns it from a proven one, or that one where proxqp loses it.

    From elsewhere proxqp 0.8 misses or denies the solutions of about one problem in a hundred near people, claims a
    few that are none, and needs 15 times as long as `optimum`. So it begins at the solution and its multipliers, with
    the rows that hold it, and what it returns must keep all rows.
    """
    holding = np.flatnonzero(known.z)
    A, high, w = known.A[holding], known.high[holding], known.w
    cost, norms = 1.0 / task.H.diagonal().max(), 1.0 / np.linalg.norm(A, axis=1)  # its tolerances are absolute
    # the last bits of what its other backend returns depend on where its memory happens to lie
    qp = _dense.QP(len(w), 0, len(holding), False, _dense.HessianType.Dense, _dense.DenseBackend.PrimalLDLT)
    qp.settings.initial_guess = proxsuite.proxqp.InitialGuess.WARM_START
    qp.settings.eps_abs, qp.settings.eps_rel = 1e-10, 0.0
    qp.settings.max_iter, qp.settings.max_iter_in = 5, 5
    low = np.full(len(holding), -np.inf)
    qp.init(task.H * cost, task.g * cost, None, None, A * norms[:, None], low, high * norms)
    qp.solve(w, None, cost * known.z[holding] / norms)
    found = np.clip(qp.results.x, task.limits.low, task.limits.high)
    kept = qp.results.info.status == _SOLVED and np.abs(found - w).max() <= AGREED
    return found if kept and task.keeps(found, HELD) else w
