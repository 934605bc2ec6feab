"""The trajectory generator: the quadratic program of Eq. (66), or else the stop of Eq. (67).

The variable is the joint velocity of the next tick: it has the cost of Eq. (66a)-(66c), the limits of the axes and of
the TCP, Eq. (66d)-(66h), as bounds, and the approach rows of Eq. (66i). The only module that imports proxsuite. What is
corrected in the printed equations, and why: docs/paper.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import proxsuite
from numba import njit

from hrcreplay.geometry.vectors import to_vector
from hrcreplay.records import Floats
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.approach_rows import (
    OUTCOMES,
    SOLVED,
    Approach,
    Limits,
    Optimum,
    optimum,
    tick_rows,
    worst_rows,
)
from hrcreplay.robot.control.control_step import PlanSettings, RobotState, Step, observe
from hrcreplay.robot.control.separation import Obstacles, Separation
from hrcreplay.robot.model import RobotModel, RobotPose

#: Bound on the rotation of the TCP for each unit of the bound on its translation [rad/m].
RAD_PER_M = 2 * math.pi / 2.5


@njit(cache=True)
def joint_bounds(
    q: Floats, dq: Floats, q_min: Floats, q_max: Floats, dq_max: Floats, ddq_max: Floats, dt_s: float
) -> tuple[Floats, Floats]:
    """Next velocities from which an axis can still stop before its position limit, Eq. (66d)-(66f), corrected.

    An axis at v that brakes by Eq. (67) travels S(v): the braking parabola v^2 / (2 u_max), sampled at whole steps
    v = n u_max dt and linear between them. A state with q + S(dq) <= q_max (and likewise below) is admissible; the
    returned interval holds exactly the velocities whose next state, Eq. (69), is admissible again. From an
    admissible state it always contains the braking step, so the limits never make the QP infeasible; from any other
    it still contains that step, the best an axis can do.

    Args:
        q: (nv,) [rad].
        dq: (nv,) [rad/s].
        q_min: (nv,) [rad]; may be -inf.
        q_max: (nv,) [rad]; may be inf.
        dq_max: (nv,) [rad/s].
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of the tick [s].

    Returns:
        Lower and upper bound, (nv,) each [rad/s].
    """
    low, high = np.empty_like(q), np.empty_like(q)
    for i in range(len(q)):
        gain = ddq_max[i] * dt_s
        ahead = q[i] + 0.5 * dt_s * dq[i]
        brake = math.copysign(max(abs(dq[i]) - gain, 0.0), dq[i])
        top = min(dq_max[i], dq[i] + gain, fastest(q_max[i] - ahead, gain, dt_s))
        bottom = max(-dq_max[i], dq[i] - gain, -fastest(ahead - q_min[i], gain, dt_s))
        low[i], high[i] = min(bottom, brake), max(top, brake)
    return low, high


@njit(cache=True)
def fastest(room: float, gain: float, dt_s: float) -> float:
    """Largest w with S(w) + dt w / 2 <= room, the inverse of a piecewise linear function [rad/s].

    Args:
        room: Way left beyond what the present velocity covers within this tick [rad].
        gain: Change of velocity an axis manages in a tick [rad/s].
        dt_s: Length of the tick [s].
    """
    if room <= 0.0 or room == np.inf:
        return 2.0 * room / dt_s
    steps = 2.0 * room / (gain * dt_s)  # n (n + 1) where w = n gain
    n = math.floor(0.5 * (math.sqrt(1.0 + 4.0 * steps) - 1.0))
    return (n + (steps - n * (n + 1.0)) / (2.0 * (n + 1.0))) * gain


@njit(cache=True)
def cartesian_bounds(
    J: Floats, dJdq: Floats, dq: Floats, speed_max: float, acceleration_max: float, dt_s: float
) -> tuple[Floats, Floats]:
    """Bounds on ``J @ dq_next`` from the TCP's speed and acceleration limits, Eq. (66g), (66h), corrected.

    Args:
        J: (6, nv) Jacobian of the TCP, linear first [m/rad, rad/rad].
        dJdq: (6,) Jdot dq [m/s^2, rad/s^2].
        dq: (nv,) [rad/s].
        speed_max: Of each axis of the world [m/s]; rotation in the proportion ``RAD_PER_M``.
        acceleration_max: Likewise [m/s^2].
        dt_s: Length of the tick [s].

    Returns:
        Lower and upper bound, (6,) each [m/s, rad/s].
    """
    low, high = np.empty(6), np.empty(6)
    for i in range(6):
        unit = 1.0 if i < 3 else RAD_PER_M
        now = 0.0
        for j in range(len(dq)):
            now += J[i, j] * dq[j]
        drift = dt_s * dJdq[i]
        change = dt_s * unit * acceleration_max
        low[i] = max(-unit * speed_max, now - change) - drift  # Eq. (66g), (66h)
        high[i] = min(unit * speed_max, now + change) - drift
    return low, high


#: Weight on the squared joint velocities, relative to the mean curvature of the cost. It makes the minimiser unique
#: where the paper's cost is flat (a stretched wrist: axes 4 and 6 turn against each other) and is too small to be
#: seen anywhere else.
DAMPING = 1e-6


def pose_error(T_world_tcp: Floats, T_world_ref: Floats) -> Floats:
    """(6,) from the reference to the TCP: way [m], then rotation vector in the world [rad]."""
    turn = to_vector(T_world_tcp[:3, :3] @ T_world_ref[:3, :3].T)
    return np.concatenate([T_world_tcp[:3, 3] - T_world_ref[:3, 3], turn])


@njit(cache=True)
def tracking_cost(
    error: Floats,
    J: Floats,
    dJdq: Floats,
    dq: Floats,
    twist_ref: Floats,
    q_p: tuple[float, float],
    q_v: tuple[float, float],
    path_gain_per_s: float,
    dt_s: float,
) -> tuple[Floats, Floats]:
    """Eq. (66a), corrected, as ``w @ H @ w / 2 + g @ w`` (and a constant, and a factor of 2) of the next velocity w.

    The variable is w = dq + dt u instead of the acceleration u, so Eq. (66b), (66c) are linear in w.

    With the printed weights a position error changes the velocity by dt q_p / q_v of it, that is, it never decays; so
    ``path_gain_per_s`` times the error at this tick is taken off the reference velocity.

    Args:
        error: (6,) `pose_error` of the TCP at the tick and the reference one tick later [m, rad].
        J: (6, nv) Jacobian of the TCP, linear first [m/rad, rad/rad].
        dJdq: (6,) Jdot dq [m/s^2, rad/s^2].
        dq: (nv,) [rad/s].
        twist_ref: (6,) velocity of the reference, linear first [m/s, rad/s].
        q_p: Weights of the errors in position, translation and rotation, Eq. (71).
        q_v: Weights of the errors in velocity, Eq. (72).
        path_gain_per_s: 0 as printed [1/s].
        dt_s: Length of the tick [s].

    Returns:
        ``H`` (nv, nv), positive definite, and ``g`` (nv,).
    """
    nv = len(dq)
    H, g = np.zeros((nv, nv)), np.zeros(nv)
    for i in range(6):
        weight_p, weight_v = (q_p[0], q_v[0]) if i < 3 else (q_p[1], q_v[1])
        speed = 0.0
        for j in range(nv):
            speed += J[i, j] * dq[j]
        wanted = twist_ref[i] - path_gain_per_s * (error[i] + dt_s * twist_ref[i])
        rest_v = dt_s * dJdq[i] - wanted  # Eq. (66c): J w + rest_v
        rest_p = error[i] + 0.5 * dt_s * (speed + dt_s * dJdq[i])  # Eq. (66b), corrected: dt/2 J w + rest_p
        curvature = weight_v + 0.25 * dt_s**2 * weight_p
        slope = weight_v * rest_v + 0.5 * dt_s * weight_p * rest_p
        for j in range(nv):
            g[j] += slope * J[i, j]
            for k in range(nv):
                H[j, k] += curvature * J[i, j] * J[i, k]
    mean = 0.0
    for j in range(nv):
        mean += H[j, j] / nv
    for j in range(nv):
        H[j, j] += DAMPING * max(mean, 1e-6)
    return H, g


@dataclass(frozen=True, slots=True)
class Problem:
    """Minimise ``w @ H @ w / 2 + g @ w`` over the next joint velocity w [rad/s], within limits and clear of people."""

    H: Floats  #: (nv, nv)
    g: Floats  #: (nv,)
    limits: Limits
    rows: Approach  #: Eq. (66i)

    def keeps(self, w: Floats, within: float) -> bool:
        """Whether a velocity breaks no row by more than ``within`` [m^2; m/s, rad/s]."""
        low, high, J, J_low, J_high = self.limits
        twist = J @ w
        fits = np.all((low <= w) & (w <= high)) and np.all((J_low - within <= twist) & (twist <= J_high + within))
        return bool(fits) and not len(worst_rows(self.rows, w, within)[0])


def problem(
    robot: RobotModel,
    state: RobotState,
    pose: RobotPose,
    T_world_ref: Floats,
    twist_ref: Floats,
    obstacles: Obstacles,
    pairs: Separation,
    settings: PlanSettings,
) -> Problem:
    """Eq. (66) at one instant; building it is separate from solving it.

    Args:
        robot: The manipulator.
        state: At the tick.
        pose: Of the robot in that state.
        T_world_ref: (4, 4) reference of the TCP one tick later.
        twist_ref: (6,) its velocity, linear first, world frame [m/s, rad/s].
        obstacles: The swept volumes of the tick.
        pairs: Distances between links and limbs.
        settings: Weights and limits.
    """
    dt_s, J, dJdq = settings.dt_s, pose.J_tcp, pose.dJdq_tcp
    H, g = tracking_cost(
        pose_error(pose.T_world_tcp, T_world_ref),
        J,
        dJdq,
        state.dq,
        twist_ref,
        settings.plan.q_p,
        settings.plan.q_v,
        settings.plan.path_gain_per_s,
        dt_s,
    )
    low, high = joint_bounds(state.q, state.dq, robot.q_min, robot.q_max, robot.dq_max, robot.ddq_max, dt_s)
    J_low, J_high = cartesian_bounds(
        J, dJdq, state.dq, settings.plan.tcp_speed_max, settings.plan.tcp_acceleration_max, dt_s
    )
    rows = tick_rows(pose, obstacles, pairs.room_m2(), settings.stop_s)
    return Problem(H, g, Limits(low, high, J, J_low, J_high), rows)


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
    pose: RobotPose | None = None,
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
        pose: Of the robot in that state, where it has been computed already.
    """
    with np.errstate(all="ignore"):  # numbers beyond reason end as a reason to brake, not as a warning
        sight = observe(robot, state, obstacles, settings.plan.clearance_m, pose)
        reason = sight.reason
        if sight.pairs is not None:
            task = problem(robot, state, sight.pose, T_world_ref, twist_ref, obstacles, sight.pairs, settings)
            solution = solve(task)
            if isinstance(solution, Solution):
                status = control_step.LIMITED if solution.held else control_step.TRACKING
                return sight.step(state, solution.dq_next, settings.dt_s, status)
            reason = control_step.NOT_FINITE if solution.status == "not finite" else control_step.NO_SOLUTION
        return sight.step(
            state, control_step.braked(state, robot.ddq_max, settings.dt_s), settings.dt_s, control_step.BRAKING, reason
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
