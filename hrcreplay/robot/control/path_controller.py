"""Methods that stay on the programmed path and choose the speed along it: the baselines of the trajectory generator.

- ``scaling`` [24]: the largest share of the programmed speed that meets the rows of Eq. (66i).
- ``shield``: the programmed speed while the next stop is certified, otherwise the stop.
- ``ssm``: stop and go by the protective separation distance of ISO/TS 15066, 5.5.4.
- ``pfl``: so slow near people that a contact keeps the limits of ISO/TS 15066, A.3; the stop before their heads.
- ``none``: the programmed speed, without regard to people.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.small_matrices import apply
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.contact_speed import largest_rate
from hrcreplay.robot.control.control_step import (
    PathRules,
    PlanSettings,
    Proposal,
    Proposals,
    Sight,
)
from hrcreplay.robot.control.qp_controller import cartesian_bounds
from hrcreplay.robot.control.separation import (
    Approach,
    Obstacles,
    PlaneRows,
    Separation,
    constraint_rhs,
    no_obstacles,
    tick_rows,
    worst_rows,
)
from hrcreplay.robot.control.stops import Stop, stop_rows
from hrcreplay.robot.kinematics import RobotPose
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.task import Grid, Reference, place

#: Rates that differ by no more than this are equal.
SAME = 1e-7

#: An approach row holds if it is violated by no more than this [m^2].
HELD = 1e-11

#: Largest number of iterations in the search for a rate.
ROUNDS = 40


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
    rows, pairs = (obstacles, sight.pairs) if obstacles is not None else (_NOBODY, _NO_PAIRS)
    if pairs is None:
        return sight.reason or control_step.NO_DISTANCE
    speeds = np.full(len(robot.segments), np.inf) if link_speeds is None else link_speeds
    bounds = RateBounds(rows.vertices_m, rows.offsets, rows.boxes_m, pairs, speeds)
    at, rules = current_stop.along[0], settings.path_rules
    limits, slowest = (robot.dq_max, robot.ddq_max), float(current_stop.rest().along[0, 1])
    found, slowed, q, dq, along = propose_rows(
        reference.grid, at, slowest, sight.pose, limits, bounds, horizon_s, rules
    )
    if not found:
        return control_step.NO_SOLUTION
    return [Proposal(Stop(q, dq, along), control_step.LIMITED if slowed else control_step.TRACKING)]


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


class RateBounds(NamedTuple):
    """What bounds the rate beside the robot's own limits."""

    vertices_m: Floats  #: (m, 3) of the volumes whose rows bound it [m]
    offsets: Ints  #: (l + 1,) index of each volume's first vertex
    boxes_m: Floats  #: (l, 2, 3) boxes around the volumes' vertices [m]
    pairs: Separation  #: distances of all pairs of link and volume
    link_speeds: Floats  #: (s,) largest speed of each link's ends; inf: not limited [m/s]


#: No volumes. Arrays that are not written to, as those of people, so that numba compiles one version.
_NOBODY = no_obstacles()
_NO_PAIRS = Separation(np.empty((0, 0)), np.empty((0, 0)))


@njit(cache=True)
def propose_rows(
    grid: Grid,
    at: Floats,
    slowest: float,
    pose: RobotPose,
    limits: tuple[Floats, Floats],
    bounds: RateBounds,
    horizon_s: float,
    rules: PathRules,
) -> tuple[bool, bool, Floats, Floats, Floats]:
    """The stop after the step with the largest rate.

    Every bound is linear in the next velocity, which is the rate times the path's derivative at the next position.

    Args:
        grid: The path.
        at: (2,) programmed time [s] and rate of the robot.
        slowest: Rate of the stop that continues without a better step.
        pose: The robot.
        limits: (nv,) largest velocities and accelerations of the axes [rad/s, rad/s^2].
        bounds: Further bounds.
        horizon_s: Time from the tick on for which the volumes are valid [s].
        rules: Settings.

    Returns:
        Whether there is such a step; whether an approach row or a link's speed bounds its rate; and the rows of
        ``stop_rows``.
    """
    dq_max, gain, dt_s = limits[0], limits[1] * rules.dt_s, rules.dt_s
    dq = at[1] * place(grid, at[0])[1]
    axes = np.maximum(-dq_max, dq - gain), np.minimum(dq_max, dq + gain)
    tcp = cartesian_bounds(pose.J_tcp, pose.dJdq_tcp, dq, rules.tcp_speed_max, rules.tcp_acceleration_max, dt_s)
    rhs_m2 = constraint_rhs(bounds.pairs, rules.square, 0.0)
    hulls, apart_m = (bounds.vertices_m, bounds.offsets, bounds.boxes_m), bounds.pairs.distance_m
    rows = tick_rows(
        pose, *hulls, rhs_m2, apart_m, horizon_s + rules.lead_s, PlaneRows(np.empty((0, len(dq))), gain[:0])
    )
    rate, slowed = _largest(grid, at, pose, axes, tcp, rows, bounds.link_speeds, dt_s)
    if not rate >= slowest - SAME:
        return False, slowed, np.empty((0, len(dq))), np.empty((0, len(dq))), np.empty((0, 2))
    q, dq_stop, along, done = stop_rows(grid, at[0] + 0.5 * dt_s * (at[1] + rate), rate, gain, dt_s)
    return done, slowed, q, dq_stop, along


@njit(cache=True, inner=True)
def _largest(
    grid: Grid,
    at: Floats,
    pose: RobotPose,
    axes: tuple[Floats, Floats],
    tcp: tuple[Floats, Floats],
    rows: Approach,
    link_speeds: Floats,
    dt_s: float,
) -> tuple[float, bool]:
    """Largest rate in [0, 1] that its own bound allows; NaN without one. A bound changes little with the rate.

    Args:
        grid: The path.
        at: (2,) programmed time [s] and rate of the robot.
        pose: The robot.
        axes: (nv,) bounds on the axes' velocities [rad/s].
        tcp: (6,) bounds on the TCP's velocity [m/s, rad/s].
        rows: Approach rows.
        link_speeds: (s,) largest speed of each link's ends [m/s].
        dt_s: Length of a tick [s].

    Returns:
        The rate, and whether the rows or a link's speed bound it.
    """
    found, low, high, rate, slowed = np.nan, -1.0, 1.0, 1.0, False
    for _ in range(ROUNDS):
        _, towards, _ = place(grid, at[0] + 0.5 * dt_s * (at[1] + rate))
        free = min(1.0, rates(towards, *axes)[1], rates(apply(pose.J_tcp, towards), *tcp)[1])
        most = free
        if free >= 0.0:
            most, by_speed = _safe_rate(rows, towards, free), largest_rate(pose, towards, link_speeds)
            if not by_speed >= most:
                most = by_speed
        slowed = most < free
        if rate <= most:
            found = low = rate
            if rate == 1.0 or most - rate <= SAME:
                break
        else:
            high = rate
            if not rate > 0.0:
                break
        guess = most if most > 0.0 else 0.0
        rate = guess if low < guess < high else max(0.0, 0.5 * (low + high))
    return found, slowed


@njit(cache=True, inner=True, error_model="numpy")
def _safe_rate(rows: Approach, towards: Floats, rate: float) -> float:
    """The largest rate, up to ``rate``, for which all approach rows hold, Eq. (16); NaN if none is found."""
    for _ in range(ROUNDS):
        which, _, values = worst_rows(rows, rate * towards, HELD)
        if not len(which):
            return rate
        share = np.inf
        for i in range(len(which)):
            allowed = rows.rhs_m2[which[i, 0], which[i, 1]] / values[i]
            if allowed < share or math.isnan(allowed):
                share = allowed
        rate *= share
    return np.nan


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
