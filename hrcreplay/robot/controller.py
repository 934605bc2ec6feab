"""The trajectory generator: QP (66), or else the stop (67). The only module that imports proxsuite."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import proxsuite

from hrcreplay.records import Floats
from hrcreplay.robot import stepping
from hrcreplay.robot.active_set import active_set, minimiser
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.obstacles import Obstacles
from hrcreplay.robot.problem import BoundedRows, Problem, problem
from hrcreplay.robot.sight import observe
from hrcreplay.robot.stepping import PlanSettings, RobotState, Step

#: Largest residual with which a row counts as held [m^2; m/s, rad/s].
HELD = 1e-11

#: Multiplier above which a row holds the robot back.
BINDING = 1e-9

#: Rows that this much of the present velocity breaks are among the first to be tried.
AHEAD = 1.1

#: Rounds of solving and adding broken rows before the problem counts as unsolved.
ROUNDS = 40

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
            reason = stepping.NOT_FINITE if solution.status == "not finite" else stepping.NO_SOLUTION
        return sight.step(
            state, stepping.braked(state, robot.ddq_max, settings.dt_s), settings.dt_s, stepping.BRAKING, reason
        )


def solve(task: Problem) -> Solution | Unsolved:
    """The minimiser over all rows, found with few of them.

    Beginning with the minimiser without rows, the rows that the candidate breaks join in and the problem is solved
    again, until all rows of all links, limbs and vertices hold. A minimiser over some of the rows that breaks none
    of the others is the minimiser over all of them.
    """
    w = minimiser(task.H, task.g)
    if not math.isfinite(w.sum()):
        return Unsolved("not finite")
    solved, w = bool(np.all((task.low <= w) & (w <= task.high))), np.clip(w, task.low, task.high)
    rows, z = BoundedRows((), np.empty((0, len(w))), np.empty(0), np.empty(0)), np.zeros(len(w))
    for rounds in range(ROUNDS):
        broken = task.broken_rows(w, HELD)
        if broken.keys and not rounds:  # the rows that held the robot until now are likely to hold it again
            broken = broken.joined(task.broken_rows(AHEAD * task.dq, HELD))
        if solved and not broken.keys:
            held = any(key[0] >= 0 and z_i > BINDING for key, z_i in zip(rows.keys, z.tolist(), strict=False))
            return Solution(_by_proxqp(task, rows, w, z) if rounds else w, held, rounds)
        before, rows = len(rows.keys), rows.joined(broken)
        if solved and len(rows.keys) == before:
            return Unsolved("residual")
        w, z = _minimise(task, rows)
        if math.isnan(w[0]):
            return Unsolved("infeasible")
        w, solved = np.clip(w, task.low, task.high), True
    return Unsolved("rounds")


def _minimise(task: Problem, rows: BoundedRows) -> tuple[Floats, Floats]:
    """Minimiser over some rows and the axes' limits, and the multipliers of both, negative at a lower bound.

    NaN where there is none, or none that the multipliers prove: the gradient must vanish, and only rows at their
    bound may carry one.
    """
    A = np.concatenate([rows.A, np.eye(len(task.g))])
    high, low = np.concatenate([rows.high, task.high]), np.concatenate([rows.low, task.low])
    w, both = active_set(task.H, task.g, np.concatenate([A, -A]), np.concatenate([high, -low]))
    z, values = both[: len(A)] - both[len(A) :], A @ w
    gradient = task.H @ w + task.g + z @ A
    unused = z * np.where(z > 0.0, np.minimum(high - values, 1.0), np.maximum(low - values, -1.0))
    most = PROVEN * max(1.0, np.abs(task.g).max())
    proven = np.abs(gradient).max() <= most and np.abs(unused).max() <= most
    return w if proven else np.full_like(w, np.nan), z


def _by_proxqp(task: Problem, rows: BoundedRows, w: Floats, z: Floats) -> Floats:
    """The solution as proxqp returns it from a proven one, or that one where proxqp loses it.

    From elsewhere proxqp 0.8 misses or denies the solutions of about one problem in a hundred near people, claims a
    few that are none, and needs 15 times as long as `active_set`. So it begins at the solution and its multipliers,
    with the rows that hold it, and what it returns must keep all rows.
    """
    holding = np.flatnonzero(z)
    A = np.concatenate([rows.A, np.eye(len(w))])[holding]
    low, high = np.concatenate([rows.low, task.low])[holding], np.concatenate([rows.high, task.high])[holding]
    cost, norms = 1.0 / task.H.diagonal().max(), 1.0 / np.linalg.norm(A, axis=1)  # its tolerances are absolute
    # the last bits of what its other backend returns depend on where its memory happens to lie
    qp = _dense.QP(len(w), 0, len(holding), False, _dense.HessianType.Dense, _dense.DenseBackend.PrimalLDLT)
    qp.settings.initial_guess = proxsuite.proxqp.InitialGuess.WARM_START
    qp.settings.eps_abs, qp.settings.eps_rel = 1e-10, 0.0
    qp.settings.max_iter, qp.settings.max_iter_in = 5, 5
    qp.init(task.H * cost, task.g * cost, None, None, A * norms[:, None], low * norms, high * norms)
    qp.solve(w, None, cost * z[holding] / norms)
    found = np.clip(qp.results.x, task.low, task.high)
    kept = qp.results.info.status == _SOLVED and np.abs(found - w).max() <= AGREED
    return found if kept and not task.broken_rows(found, HELD).keys else w
