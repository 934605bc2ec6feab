"""Methods that stay on the programmed path and choose the speed along it: the baselines of the trajectory generator.

- ``scaling`` [24]: the largest share of the programmed speed that meets the rows of Eq. (66i).
- ``shield``: the programmed speed while the next stop is certified, otherwise the stop.
- ``ssm``: stop and go by the protective separation distance of ISO/TS 15066, 5.5.4.
- ``pfl``: so slow near people that a contact keeps the limits of ISO/TS 15066, A.3; the stop before their heads.
- ``none``: the programmed speed, without regard to people.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hrcreplay.geometry.small_matrices import apply
from hrcreplay.kernels import njit
from hrcreplay.records import Floats
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.contact_speed import largest_rate
from hrcreplay.robot.control.control_step import PlanSettings, Proposal, Proposals, Sight, Stop, stop_along_path
from hrcreplay.robot.control.qp_controller import cartesian_bounds
from hrcreplay.robot.control.separation import Obstacles, rows_of_people, worst_rows
from hrcreplay.robot.kinematics import RobotPose
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.task import Reference, place

#: Rates that differ by no more than this are equal.
SAME = 1e-7

#: An approach row holds if it is violated by no more than this [m^2].
HELD = 1e-11

#: Largest number of iterations in the search for a rate.
ROUNDS = 40


@dataclass(frozen=True, slots=True)
class PathState:
    """Progress of the robot along its programmed path, and its share of the programmed speed."""

    s_s: float  #: programmed time [s]
    rate: float  #: in [0, 1]


def propose(
    robot: RobotModel,
    reference: Reference,
    current_stop: Stop,
    sight: Sight,
    obstacles: Obstacles | None,
    horizon_s: float,
    settings: PlanSettings,
    link_speeds: Floats | None = None,
) -> Proposals:
    """One tick: the largest rate in [0, 1] that meets the limits of the robot and, with ``obstacles``, Eq. (66i).

    The robot is exactly on the path. Position and velocity one tick later are those of the path, and ``u`` leads from
    this tick's velocity to the next one, so the safety rows hold for ``dq + dt u`` as in the QP. Eq. (69) gives the
    next position up to the third order in dt. The rate changes as fast as the axes' acceleration limits allow.

    Args:
        robot: The manipulator.
        reference: The programmed path.
        current_stop: The stop that continues without a better step; its row 0 is the present state of the robot.
        sight: The robot's pose, and its distances from people.
        obstacles: The swept volumes of the tick, whose rows bound the rate; None: only the robot's limits bound it.
        horizon_s: Time from the tick on for which the volumes are valid [s].
        settings: Limits; weights are not used.
        link_speeds: (s,) largest speed of each link's ends; None: not limited [m/s].

    Returns:
        The step and the stop after it, along the path; or the reason why there is none.
    """
    state, slowest = PathState(*current_stop.along[0].tolist()), current_stop.rest().along[0, 1]
    fastest, slowed = _fastest(robot, reference, state, sight, obstacles, horizon_s, settings, link_speeds)
    if fastest is None or fastest.rate < slowest - SAME:
        return control_step.NO_SOLUTION
    stop = stop_along_path(reference.grid, fastest.s_s, fastest.rate, robot.ddq_max, settings.dt_s)
    if stop is None:
        return control_step.NO_SOLUTION
    return [Proposal(stop, control_step.LIMITED if slowed else control_step.TRACKING)]


def protective_distance_m(pose: RobotPose, stop: Stop, human_speed: float, latency_s: float, dt_s: float) -> float:
    """S_p of ISO/TS 15066, Eq. (3): way of the person and the robot until the robot is at rest [m].

    It is S_h + S_r + S_s with the present speed of the robot. C, Z_d and Z_r are part of the distance that is compared
    with it: the distance to the person's present volume, which includes the hand and the measurement uncertainty.

    Args:
        pose: Pose of the robot.
        stop: The stop that begins at the end of the step.
        human_speed: Speed at which the person may approach [m/s].
        latency_s: Reaction time T_r in addition to the tick [s].
        dt_s: Length of a tick [s].
    """
    speeds = apply(pose.J_ends.reshape(-1, pose.J_ends.shape[3]), stop.dq[0]).reshape(-1, 3)
    speed = float(np.linalg.norm(speeds, axis=1).max())
    reaction_s, stop_s = latency_s + dt_s, stop.ticks * dt_s
    return human_speed * (reaction_s + stop_s) + speed * reaction_s + 0.5 * speed * stop_s


def _fastest(
    robot: RobotModel,
    reference: Reference,
    state: PathState,
    sight: Sight,
    obstacles: Obstacles | None,
    horizon_s: float,
    settings: PlanSettings,
    link_speeds: Floats | None,
) -> tuple[PathState | None, bool]:
    """The largest rate that meets all constraints, and whether an approach row or a link's speed bounds it.

    Every bound is linear in the next velocity, which is the rate times the path's derivative at the next position.
    """
    dt_s, gain, pose, grid = settings.dt_s, robot.ddq_max * settings.dt_s, sight.pose, reference.grid
    dq = state.rate * place(grid, state.s_s)[1]
    low, high = np.maximum(-robot.dq_max, dq - gain), np.minimum(robot.dq_max, dq + gain)
    J_low, J_high = cartesian_bounds(
        pose.J_tcp, pose.dJdq_tcp, dq, settings.plan.tcp_speed_max, settings.plan.tcp_acceleration_max, dt_s
    )
    slowed = False

    def ahead(rate: float) -> float:
        return state.s_s + 0.5 * dt_s * (state.rate + rate)

    def most(rate: float) -> float:
        nonlocal slowed
        towards = place(grid, ahead(rate))[1]
        free = min(1.0, rates(towards, low, high)[1], rates(apply(pose.J_tcp, towards), J_low, J_high)[1])
        safe = free
        if obstacles is not None and free >= 0.0:
            safe = _safe_rate(sight, obstacles, towards, free, horizon_s + settings.plan.lead_s, settings)
        if link_speeds is not None and free >= 0.0:
            safe = min(safe, largest_rate(pose, towards, link_speeds))
        slowed = safe < free
        return safe

    rate = _largest(1.0, most)
    return (None, True) if rate is None else (PathState(ahead(rate), rate), slowed)


def _largest(top: float, bound: Callable[[float], float]) -> float | None:
    """Largest x in [0, top] with ``x <= bound(x)``, for a bound that changes little with x; None without one."""
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


def _safe_rate(
    sight: Sight, obstacles: Obstacles, towards: Floats, rate: float, ahead_s: float, settings: PlanSettings
) -> float:
    """The largest rate, up to ``rate``, for which all approach rows hold, Eq. (16)."""
    pairs = sight.pairs
    if pairs is None:
        return math.nan
    rhs_m2 = pairs.constraint_rhs_m2(settings.plan.constraint_rhs)
    rows = rows_of_people(sight.pose, obstacles, pairs, rhs_m2, ahead_s)
    for _ in range(ROUNDS):
        which, _, values = worst_rows(rows, rate * towards, HELD)
        if not len(which):
            return rate
        rate *= float((rows.rhs_m2[which[:, 0], which[:, 1]] / values).min())
    return math.nan


@njit(cache=True)
def rates(towards: Floats, low: Floats, high: Floats) -> tuple[float, float]:
    """Smallest and largest factor with ``low <= factor * towards <= high``; no factor if the first is larger.

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
