"""The trajectory generator: the quadratic program of Eq. (66).

The variable is the joint velocity of the next tick. The cost is Eq. (66a)-(66c), the bounds are the limits of the axes
and of the TCP, Eq. (66d)-(66h), and the approach rows are Eq. (66i). docs/paper.md lists the corrections of the printed
equations and their reasons. With ``plan.smooth_s`` the variable is a target velocity, and the velocity of the next tick
moves a share of the way to it. This filters the jitter of the swept volumes, which is some millimetres.

A proposal of this module is not yet safe: (66i) bounds speeds at the present posture and does not consider the stop.
The certificate decides. Therefore the rows may be soft, and they may look further ahead than the stop takes
(``plan.lead_s``), because a robot that brakes early rarely has to stop.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.vectors import dot_n, norm_n, turn_between
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.control_step import (
    PlanSettings,
    Proposal,
    Proposals,
    QpRules,
    RobotState,
    Sight,
)
from hrcreplay.robot.control.metric_rows import Limits, Problem
from hrcreplay.robot.control.minimiser import Solution, minimise
from hrcreplay.robot.control.motion_check import RETREAT_SPEED
from hrcreplay.robot.control.row_search import SOLVED, search
from hrcreplay.robot.control.separation import Obstacles, Separation, constraint_rhs, tick_rows
from hrcreplay.robot.control.static_obstacles import StaticObstacles, StaticShapes, plane_rows, shapes_of
from hrcreplay.robot.control.stops import Stop, axis_by_axis, straight
from hrcreplay.robot.kinematics import Arm, RobotPose, axis_frames, tcp_jacobian
from hrcreplay.robot.model import RobotModel

#: Bound on the rotation of the TCP for each unit of the bound on its translation [rad/m].
RAD_PER_M = 2 * math.pi / 2.5


@njit(cache=True)
def joint_bounds(
    q: Floats, dq: Floats, q_min: Floats, q_max: Floats, dq_max: Floats, ddq_max: Floats, dt_s: float
) -> tuple[Floats, Floats]:
    """Next velocities from which an axis can still stop before its position limit, Eq. (66d)-(66f), corrected.

    An axis with velocity v that brakes by Eq. (67) travels S(v): the braking parabola v^2 / (2 u_max), sampled at whole
    steps v = n u_max dt and linear between them. A state with q + S(dq) <= q_max is admissible, likewise for q_min. The
    returned interval contains exactly the velocities whose next state, Eq. (69), is admissible again. From an
    admissible state it always contains the braking step, so the limits never make the QP infeasible. From any other
    state it also contains the braking step, the hardest that an axis can do.

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


@njit(cache=True, inner=True)
def fastest(room: float, gain: float, dt_s: float) -> float:
    """Largest w with S(w) + dt w / 2 <= room, the inverse of a piecewise linear function [rad/s].

    Args:
        room: Remaining way after the way that the present velocity covers within this tick [rad].
        gain: Largest change of velocity of an axis in a tick [rad/s].
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
        speed_max: Speed limit along each axis of the world [m/s]; times ``RAD_PER_M`` for rotation.
        acceleration_max: Acceleration limit, likewise [m/s^2].
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
#: where the paper's cost is flat (a stretched wrist: axes 4 and 6 turn against each other). Elsewhere its effect is
#: negligible.
DAMPING = 1e-6


class Target(NamedTuple):
    """Target of the robot one tick later."""

    T_world_tcp: Floats  #: (4, 4)
    twist: Floats  #: (6,) velocity in the world, linear first [m/s, rad/s]
    q: Floats  #: (nv,) joint positions of the programme [rad]
    tcp_speed_max: float = math.inf  #: speed limit of the TCP on the way to the target [m/s]


class QpContext(NamedTuple):
    """Input of Eq. (66) at one tick, without the settings."""

    robot: RobotModel
    state: RobotState  #: at the tick
    u_before: Floats  #: (nv,) acceleration of the previous tick [rad/s^2]
    target: Target  #: the reference one tick later
    sight: Sight  #: the robot's pose, and its distances from people
    obstacles: Obstacles  #: the swept volumes of the tick
    horizon_s: float  #: time from the tick on for which the volumes are valid [s]
    static: StaticObstacles | None = None  #: objects of the cell and pairs of links


@njit(cache=True)
def pose_error(T_world_tcp: Floats, T_world_ref: Floats) -> Floats:
    """(6,) error of the TCP relative to the reference: translation [m], then rotation vector in the world [rad]."""
    error = np.empty(6)
    error[:3] = T_world_tcp[:3, 3] - T_world_ref[:3, 3]
    error[3:] = turn_between(T_world_ref, T_world_tcp)
    return error


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
    """Eq. (66a), corrected, as ``w @ H @ w / 2 + g @ w`` of the next velocity w, without a constant and a factor of 2.

    The variable is w = dq + dt u instead of the acceleration u, so Eq. (66b), (66c) are linear in w.

    With the printed weights a position error changes the velocity by only dt q_p / q_v times the error, so the error
    practically never decays. Therefore ``path_gain_per_s`` times the error at this tick is subtracted from the
    reference velocity.

    Args:
        error: (6,) `pose_error` of the TCP at the tick and the reference one tick later [m, rad].
        J: (6, nv) Jacobian of the TCP, linear first [m/rad, rad/rad].
        dJdq: (6,) Jdot dq [m/s^2, rad/s^2].
        dq: (nv,) [rad/s].
        twist_ref: (6,) velocity of the reference, linear first [m/s, rad/s].
        q_p: Weights of the errors in position, translation and rotation, Eq. (71).
        q_v: Weights of the errors in velocity, Eq. (72).
        path_gain_per_s: Gain on the position error; 0 gives the printed equation [1/s].
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


@njit(cache=True)
def with_posture(H: Floats, g: Floats, away: Floats, weight: float) -> tuple[Floats, Floats]:
    """Adds a cost that pulls the joints back to the programmed posture, with a gain of 1/s.

    A TCP that detours around people past a stretched wrist may come back with the wrist turned over. Axis 4 then winds
    up to its limit, and the robot stops there. The cost leads the robot back to the posture of the programme.

    Args:
        H: (nv, nv) of `tracking_cost`.
        g: (nv,) likewise.
        away: (nv,) joint positions minus those of the reference [rad].
        weight: Weight relative to the mean curvature of the cost.
    """
    mean = max(np.trace(H) / len(g), 1e-6)
    return H + weight * mean * np.eye(len(g)), g + weight * mean * away


def problem(context: QpContext, settings: PlanSettings) -> Problem:
    """Builds Eq. (66) at one instant, without solving it; see ``build``.

    Args:
        context: Robot, reference and people of the tick.
        settings: Weights and limits.
    """
    return build(*_numbers(context, settings))


class Instant(NamedTuple):
    """What Eq. (66) depends on at one tick, without arm and settings, as numbers for kernels."""

    q: Floats  #: (nv,) [rad]
    dq: Floats  #: (nv,) [rad/s]
    u_before: Floats  #: (nv,) acceleration of the previous tick [rad/s^2]
    target: Target
    pose: RobotPose
    pairs: Separation
    vertices: Floats  #: (m, 3) of all limbs, which are known [m]
    offsets: Ints  #: (l + 1,) index of each limb's first vertex
    boxes: Floats  #: (l, 2, 3) boxes around the limbs' vertices [m]
    ahead_s: float  #: time that the rows of people look ahead [s]
    static_ahead_s: float  #: time that the rows of objects and links look ahead [s]
    speed_max: float  #: limit of the TCP's speed along each axis of the world [m/s]


def _numbers(context: QpContext, settings: PlanSettings) -> tuple[Arm, QpRules, Instant, StaticShapes]:
    """The input of Eq. (66) as numbers for kernels."""
    robot, state, u_before, target, sight, obstacles, horizon_s, static = context
    plan, pairs = settings.plan, sight.pairs
    if pairs is None:
        raise ValueError("problem: the distances from people are not known")
    speed_max = min(plan.tcp_speed_max, RETREAT_SPEED) if settings.retreats(sight.overlap_m) else plan.tcp_speed_max
    hulls = obstacles.vertices_m, obstacles.offsets, obstacles.boxes_m
    ahead_s = horizon_s + plan.lead_s, static_ahead_s(horizon_s, plan.smooth_s)
    now = Instant(state.q, state.dq, u_before, target, sight.pose, pairs, *hulls, *ahead_s, speed_max)
    shapes = shapes_of(robot, static)
    return robot.arm, settings.rules, now, shapes


@njit(cache=True)
def build(arm: Arm, rules: QpRules, now: Instant, static: StaticShapes) -> Problem:
    """Builds Eq. (66) at one instant, without solving it.

    In addition to the printed equation the posture has a small weight (`with_posture`), the TCP keeps the programme's
    speed limit (`add_speed_row`), and ``plan.jerk_s`` can limit the change of the acceleration in a tick. If the
    variable is a target velocity (``plan.smooth_s``), cost and rows stay as printed. The bounds are then extended by
    the factor by which the target velocity is further away than the velocity of the next tick (`dq_after`).

    Args:
        arm: The manipulator.
        rules: Weights and limits.
        now: State, reference and people of the tick.
        static: Objects of the cell and pairs of links.
    """
    pose, target, dt_s = now.pose, now.target, rules.dt_s
    error = pose_error(pose.T_world_tcp, target.T_world_tcp)
    weights = rules.q_p, rules.q_v, rules.path_gain_per_s, dt_s
    H, g = tracking_cost(error, pose.J_tcp, pose.dJdq_tcp, now.dq, target.twist, *weights)
    H, g = with_posture(H, g, now.q - target.q, rules.posture)
    rhs_m2 = constraint_rhs(now.pairs, rules.square, rules.give_way_m)
    _, planes = plane_rows(static, pose.ends_m, pose.J_ends, now.static_ahead_s)
    hulls = now.vertices, now.offsets, now.boxes
    rows = tick_rows(pose, *hulls, rhs_m2, now.pairs.distance_m, now.ahead_s, planes)
    return Problem(H, g, _limits(arm, rules, now), rows, rules.soft)


@njit(cache=True, inner=True)
def _limits(arm: Arm, rules: QpRules, now: Instant) -> Limits:
    """The bounds of axes and TCP at one tick, Eq. (66d)-(66h), extended to those of the target velocity."""
    pose, dq, dt_s = now.pose, now.dq, rules.dt_s
    low, high = joint_bounds(now.q, dq, arm.q_min, arm.q_max, arm.dq_max, arm.ddq_max, dt_s)
    further = 1.0 + rules.smooth_s / dt_s
    least, most = dq + further * (low - dq), dq + further * (high - dq)
    if rules.jerk_s > dt_s:
        low, high = smooth_bounds(low, high, dq + dt_s * now.u_before, dt_s**2 / rules.jerk_s * arm.ddq_max)
    acceleration_max, twist = rules.tcp_acceleration_max, pose.twist_tcp
    J_low, J_high = cartesian_bounds(pose.J_tcp, pose.dJdq_tcp, dq, now.speed_max, acceleration_max, dt_s)
    low, high = dq + further * (low - dq), dq + further * (high - dq)
    J_low, J_high = twist + further * (J_low - twist), twist + further * (J_high - twist)
    limits = Limits(low, high, pose.J_tcp, J_low, J_high)
    if math.isfinite(now.target.tcp_speed_max):
        drift = further * dt_s * pose.dJdq_tcp
        limits = add_speed_row(limits, twist, drift, now.target.tcp_speed_max, least, most)
    return limits


@njit(cache=True)
def static_ahead_s(horizon_s: float, smooth_s: float) -> float:
    """Time that the rows of objects and links look ahead [s].

    A stop at constant deceleration covers the way of half its duration, and the robot follows its target velocity with
    the time constant ``plan.smooth_s``. The horizon contains the stop and two ticks.

    Args:
        horizon_s: Time from the tick on until the end of the stop after the step [s].
        smooth_s: ``plan.smooth_s`` [s].
    """
    return 0.5 * horizon_s + smooth_s


#: A TCP that is slower than this has no direction of motion [m/s].
SLOW_M_PER_S = 1e-6
#: Iterations of the search for a velocity that keeps the speed limit; few, as the posture hardly depends on it.
SPEED_ROUNDS = 4


@njit(cache=True, inner=True)
def add_speed_row(limits: Limits, twist: Floats, drift: Floats, speed_max: float, low: Floats, high: Floats) -> Limits:
    """Bounds the TCP's velocity along its direction of motion: the linearised bound on its speed.

    The bound applies to the target velocity, so the TCP approaches the bound smoothly. The bound is never lower than
    the lowest value that the axes and Eq. (66h) allow, so braking is always allowed. `limit_speed` corrects the error
    of the linearisation.

    Args:
        limits: Limits of axes and TCP.
        twist: (6,) velocity of the TCP at the tick, linear first [m/s, rad/s].
        drift: (6,) change of the TCP's velocity at constant joint velocities until the target [m/s, rad/s].
        speed_max: Speed limit of the TCP [m/s].
        low: (nv,) smallest target velocities of the axes [rad/s].
        high: (nv,) largest target velocities of the axes [rad/s].
    """
    nv, speed = len(low), norm_n(twist[:3])
    row, bound, least, least_tcp = np.zeros((1, nv)), speed_max, 0.0, 0.0
    if speed > SLOW_M_PER_S:
        for i in range(3):
            along = twist[i] / speed
            bound -= along * drift[i]
            least_tcp += min(along * limits.J_low[i], along * limits.J_high[i])
            for j in range(nv):
                row[0, j] += along * limits.J[i, j]
        for j in range(nv):
            least += min(row[0, j] * low[j], row[0, j] * high[j])
    J_low, J_high = np.append(limits.J_low, -np.inf), np.append(limits.J_high, max(bound, least, least_tcp))
    return Limits(limits.low, limits.high, np.concatenate((limits.J, row)), J_low, J_high)


@njit(cache=True, inner=True)
def limit_speed(arm: Arm, rules: QpRules, now: Instant, dq_next: Floats) -> Floats:
    """Moves a proposed velocity towards that of the hardest braking until the TCP keeps its speed limit.

    The limit holds at the end of the tick, with the posture at that time. The TCP may already be faster, because a
    slower move begins or because of its stop; then it slows down with the time constant ``plan.smooth_s``.

    Args:
        arm: The manipulator.
        rules: Length of a tick, and the time constant.
        now: State and reference of the tick.
        dq_next: (nv,) velocity proposed for the end of the tick [rad/s].

    Returns:
        (nv,) velocity at the end of the tick; ``dq_next`` itself if it keeps the limit [rad/s].
    """
    speed_max, dt_s, J = now.target.tcp_speed_max, rules.dt_s, now.pose.J_tcp
    if not math.isfinite(speed_max):
        return dq_next
    present, _ = _speed_and_share(J, np.zeros_like(dq_next), now.dq, 1.0, 0.0)
    allowed = max(speed_max, present + (speed_max - present) / (1.0 + rules.smooth_s / dt_s))
    brake = np.copysign(np.maximum(np.abs(now.dq) - arm.ddq_max * dt_s, 0.0), now.dq)
    dq, share = dq_next, 1.0
    for _ in range(SPEED_ROUNDS):
        _, J = tcp_jacobian(arm.chain, axis_frames(arm.chain, now.q + 0.5 * dt_s * (now.dq + dq)))
        speed, less = _speed_and_share(J, brake, dq_next - brake, share, allowed)
        if speed <= allowed or less == share:
            break
        share = less
        dq = brake + share * (dq_next - brake)
    return dq


@njit(cache=True, inner=True)
def _speed_and_share(J: Floats, brake: Floats, way: Floats, share: float, allowed: float) -> tuple[float, float]:
    """Speed of the TCP at ``brake + share * way``, and the share in [0, 1] up to which it is at most ``allowed``.

    If the TCP is faster at every share, the share of the lowest speed.
    """
    aa, ab, bb, square = 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        a, b = dot_n(J[i], brake), dot_n(J[i], way)
        aa, ab, bb, square = aa + a * a, ab + a * b, bb + b * b, square + (a + share * b) ** 2
    if bb == 0.0:
        return math.sqrt(square), share
    within = ab * ab - bb * (aa - allowed * allowed)
    most = (math.sqrt(within) - ab if within > 0.0 else -ab) / bb
    return math.sqrt(square), min(max(most, 0.0), 1.0)


@njit(cache=True, inner=True)
def dq_after(dq: Floats, aim: Floats, rules: QpRules) -> Floats:
    """(nv,) velocity one tick later of a robot with velocity ``dq`` and target velocity ``aim`` [rad/s]."""
    return dq + (aim - dq) / (1.0 + rules.smooth_s / rules.dt_s) if rules.smooth_s > 0.0 else aim


@njit(cache=True, inner=True)
def smooth_bounds(low: Floats, high: Floats, steady: Floats, change: Floats) -> tuple[Floats, Floats]:
    """Bounds within which the acceleration changes little, unless the limits of the axes require a larger change.

    Args:
        low: (nv,) lower bounds on the next velocity [rad/s].
        high: (nv,) upper bounds [rad/s].
        steady: (nv,) next velocity at the acceleration of the previous tick [rad/s].
        change: (nv,) largest difference from ``steady`` [rad/s].
    """
    near_low, near_high = np.empty_like(low), np.empty_like(high)
    for j in range(len(low)):
        near_low[j] = min(max(low[j], steady[j] - change[j]), high[j])
        near_high[j] = max(min(high[j], steady[j] + change[j]), low[j])
    return near_low, near_high


class Stops(NamedTuple):
    """The step to a proposed velocity with two stops after it, as rows of ``Stop``."""

    straight: tuple[Floats, Floats, Floats]
    axis_by_axis: tuple[Floats, Floats, Floats]


@njit(cache=True)
def stops_after(arm: Arm, rules: QpRules, now: Instant, aim: Floats) -> Stops:
    """The step towards a target velocity, Eq. (68), (69), and the stops after it.

    Args:
        arm: The manipulator.
        rules: Length of a tick, and the time constant.
        now: State and reference of the tick.
        aim: (nv,) [rad/s].
    """
    dq_next = limit_speed(arm, rules, now, dq_after(now.dq, aim, rules))
    q_next = now.q + 0.5 * rules.dt_s * (now.dq + dq_next)  # Eq. (68), (69)
    return Stops(
        straight(q_next, dq_next, arm.ddq_max, rules.dt_s), axis_by_axis(q_next, dq_next, arm.ddq_max, rules.dt_s)
    )


@njit(cache=True, inner=True)
def no_stops(nv: int) -> Stops:
    """No step, for a robot of ``nv`` axes."""
    none = np.empty((0, nv)), np.empty((0, nv)), np.empty((0, 2))
    return Stops(none, none)


@njit(cache=True)
def propose_stops(arm: Arm, rules: QpRules, now: Instant, static: StaticShapes) -> tuple[bool, bool, Stops]:
    """Whether ``row_search`` proves the minimiser of Eq. (66), whether a row holds it, and the stops after it.

    Args:
        arm: The manipulator.
        rules: Weights and limits.
        now: State, reference and people of the tick.
        static: Objects of the cell and pairs of links.
    """
    found = search(build(arm, rules, now, static))
    if found.outcome != SOLVED:
        return False, False, no_stops(len(now.dq))
    return True, found.held, stops_after(arm, rules, now, found.w)


def compile_second_tries(context: QpContext, settings: PlanSettings) -> None:
    """Compiles the kernels that run only where ``row_search`` proves no solution; see ``try_again``."""
    numbers = _numbers(context, settings)
    build(*numbers)
    stops_after(*numbers[:3], np.zeros_like(context.state.dq))


def propose(context: QpContext, settings: PlanSettings) -> Proposals:
    """One tick of Section 5: the best step by Eq. (66) and the stop after it; or the reason why there is none.

    Args:
        context: Robot, reference and people of the tick.
        settings: Weights and limits.
    """
    solved, held, stops = propose_stops(*_numbers(context, settings))
    return proposals_of(stops, settings, held=held) if solved else try_again(context, settings)


def try_again(context: QpContext, settings: PlanSettings) -> Proposals:
    """The proposals where ``row_search`` proves no minimiser: by ProxQP, and without the limit on sudden changes.

    Args:
        context: Robot, reference and people of the tick.
        settings: Weights and limits.
    """
    numbers = _numbers(context, settings)
    found = minimise(build(*numbers))
    if not isinstance(found, Solution) and settings.plan.jerk_s > 0.0:  # a limit may require a sudden change
        found = minimise(problem(context, settings.without_jerk()))
    if not isinstance(found, Solution):
        if found.status == "not finite":
            return control_step.NOT_FINITE
        too_fast = settings.retreats(context.sight.overlap_m)  # too fast for a retreat
        return control_step.INSIDE if too_fast else control_step.NO_SOLUTION
    return proposals_of(stops_after(*numbers[:3], found.dq_next), settings, held=found.held)


def proposals_of(stops: Stops, settings: PlanSettings, *, held: bool) -> list[Proposal]:
    """The proposals of one solution.

    Args:
        stops: The stops after it.
        settings: Whether it must be certified.
        held: Whether a row of people or objects holds it.
    """
    status = control_step.LIMITED if held else control_step.TRACKING
    # a straight stop may leave the range of an axis, a stop by Eq. (67) does not
    rows = stops if settings.certified else stops[1:]
    return [Proposal(Stop(*stop), status) for stop in rows]
