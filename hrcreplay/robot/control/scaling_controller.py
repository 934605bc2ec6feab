"""The baseline [24]: the robot stays on the programmed path, and only its speed along it is scaled."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from hrcreplay.records import Floats
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.approach_rows import tick_rows, worst_rows
from hrcreplay.robot.control.control_step import PlanSettings, RobotState, Sight, Step, observe
from hrcreplay.robot.control.qp_controller import cartesian_bounds
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.programme.reference import Reference, ReferencePoint

#: Rates that differ by no more are one.
SAME = 1e-7

#: Largest residual of an approach row that counts as held [m^2].
HELD = 1e-11

#: Rounds of looking for a rate.
ROUNDS = 40


@dataclass(frozen=True, slots=True)
class PathState:
    """How far along its programmed path the robot is, and the share of the programmed speed it moves with."""

    s_s: float  #: programmed time [s]
    rate: float  #: in [0, 1]


@dataclass(frozen=True, slots=True)
class _Try:
    """A rate and where it leads."""

    rate: float
    s_s: float
    point: ReferencePoint


def step(
    robot: RobotModel,
    reference: Reference,
    state: PathState,
    obstacles: Obstacles,
    settings: PlanSettings,
    now: ReferencePoint | None = None,
) -> tuple[Step, PathState]:
    """One tick of the baseline: the largest rate in [0, 1] that meets the constraints of Section 5.

    The robot is where the path is, to the last bit: position and velocity one tick later are those of the path, and
    ``u`` leads from this tick's velocity to that one, so the safety rows hold for ``dq + dt u`` as they do for the
    QP; Eq. (69) then gives the next position but for the third order in dt. Rates change as fast as the axes'
    acceleration limits allow along the path. Where no such rate meets the constraints, the robot brakes along the
    path, as fast as it can.

    Args:
        robot: The manipulator.
        reference: The programmed path.
        state: At the tick.
        obstacles: The swept volumes of the tick.
        settings: Limits; weights are not used.
        now: The reference at ``state``, where it has been computed already.

    Returns:
        What was decided, and the state one tick later.
    """
    with np.errstate(all="ignore"):  # numbers beyond reason end as a reason to brake, not as a warning
        now = reference.sample(state.s_s) if now is None else now
        axes = RobotState(now.q, state.rate * now.dq)
        sight = observe(robot, axes, obstacles, settings.plan.clearance_m)
        if sight.reason == control_step.NOT_FINITE:
            stand = np.zeros(robot.nv)
            held = sight.step(RobotState(now.q, stand), stand, settings.dt_s, control_step.BRAKING, sight.reason)
            return held, state
        slowest = _slowest(robot, reference, state, axes, settings.dt_s)
        if sight.reason:
            return _result(sight, axes, slowest, settings.dt_s, control_step.BRAKING, sight.reason)
        fastest, slowed = _fastest(robot, reference, state, axes, sight, obstacles, settings)
        if fastest is None or fastest.rate < slowest.rate - SAME:
            return _result(sight, axes, slowest, settings.dt_s, control_step.BRAKING, control_step.NO_SOLUTION)
        status = control_step.LIMITED if slowed else control_step.TRACKING
        return _result(sight, axes, fastest, settings.dt_s, status, 0)


def _result(
    sight: Sight, axes: RobotState, chosen: _Try, dt_s: float, status: int, reason: int
) -> tuple[Step, PathState]:
    made = sight.step(axes, chosen.rate * chosen.point.dq, dt_s, status, reason)
    on_path = RobotState(chosen.point.q, made.next.dq)
    result = Step(made.pose, made.u, on_path, made.distance_m, made.limb, made.link, status, reason)
    return result, PathState(chosen.s_s, chosen.rate)


def _attempt(reference: Reference, state: PathState, rate: float, dt_s: float) -> _Try:
    s_s = state.s_s + 0.5 * dt_s * (state.rate + rate)
    return _Try(rate, s_s, reference.sample(s_s))


def _slowest(robot: RobotModel, reference: Reference, state: PathState, axes: RobotState, dt_s: float) -> _Try:
    """The smallest rate that the axes' acceleration limits allow, or the present one where the path allows none."""
    gain = robot.ddq_max * dt_s

    def most_taken_off(drop: float) -> float:
        towards = _attempt(reference, state, state.rate - drop, dt_s).point.dq
        least, most = rates(towards, axes.dq - gain, axes.dq + gain)
        return state.rate - max(0.0, least) if least <= most else -1.0

    drop = _largest(state.rate, most_taken_off)
    return _attempt(reference, state, state.rate - (drop or 0.0), dt_s)


def _fastest(
    robot: RobotModel,
    reference: Reference,
    state: PathState,
    axes: RobotState,
    sight: Sight,
    obstacles: Obstacles,
    settings: PlanSettings,
) -> tuple[_Try | None, bool]:
    """The largest rate that meets all constraints, and whether an approach row is what bounds it.

    Every bound is linear in the next velocity, which is the rate times the path's direction where it leads to.
    """
    dt_s, gain, pose = settings.dt_s, robot.ddq_max * settings.dt_s, sight.pose
    low, high = np.maximum(-robot.dq_max, axes.dq - gain), np.minimum(robot.dq_max, axes.dq + gain)
    J_low, J_high = cartesian_bounds(
        pose.J_tcp, pose.dJdq_tcp, axes.dq, settings.plan.tcp_speed_max, settings.plan.tcp_acceleration_max, dt_s
    )
    slowed = False

    def most(rate: float) -> float:
        nonlocal slowed
        towards = _attempt(reference, state, rate, dt_s).point.dq
        free = min(1.0, rates(towards, low, high)[1], rates(pose.J_tcp @ towards, J_low, J_high)[1])
        safe = _safe_rate(sight, obstacles, towards, free, settings.stop_s) if free >= 0.0 else free
        slowed = safe < free
        return safe

    rate = _largest(1.0, most)
    return (None, True) if rate is None else (_attempt(reference, state, rate, dt_s), slowed)


def _largest(top: float, bound: Callable[[float], float]) -> float | None:
    """Largest x in [0, top] with ``x <= bound(x)``, for a bound that changes little with x; or none."""
    found, low, high, x = None, -1.0, top, top
    for _ in range(ROUNDS):
        most = bound(x)
        if x <= most:
            found = low = x
            if x == top or most - x <= SAME * top:
                break
        else:
            high = x
            if not x > 0.0:
                break
        guess = max(0.0, most)
        x = guess if low < guess < high else max(0.0, 0.5 * (low + high))
    return found


def _safe_rate(sight: Sight, obstacles: Obstacles, towards: Floats, rate: float, stop_s: float) -> float:
    """The largest rate up to a given one with which all approach rows hold, Eq. (16)."""
    pairs = sight.pairs
    if pairs is None:
        return math.nan
    rows = tick_rows(sight.pose, obstacles, pairs.room_m2(), stop_s)
    for _ in range(ROUNDS):
        which, _, values = worst_rows(rows, rate * towards, HELD)
        if not len(which):
            return rate
        rate *= float((rows.room_m2[which[:, 0], which[:, 1]] / values).min())
    return math.nan


@njit(cache=True)
def rates(towards: Floats, low: Floats, high: Floats) -> tuple[float, float]:
    """Smallest and largest factor with ``low <= factor * towards <= high``; empty where the first is larger.

    Args:
        towards: (m,).
        low: (m,).
        high: (m,).
    """
    least, most = -np.inf, np.inf
    for i in range(len(towards)):
        if towards[i] > 0.0:
            least, most = max(least, low[i] / towards[i]), min(most, high[i] / towards[i])
        elif towards[i] < 0.0:
            least, most = max(least, high[i] / towards[i]), min(most, low[i] / towards[i])
    return least, most
