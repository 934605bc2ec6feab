"""Input and output of one tick of a controller, and what every controller computes first: how near the people are.

Corrections to the paper: docs/paper.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hrcreplay.records import Floats
from hrcreplay.robot.control.separation import Obstacles, Separation, separation
from hrcreplay.robot.model import RobotModel, RobotPose
from hrcreplay.settings.sections import Plan

#: Why a robot braked. The first stands for ticks in which it did not.
REASONS = ("", "no human state", "no solution", "separation failed", "not finite")
NO_HUMAN, NO_SOLUTION, NO_DISTANCE, NOT_FINITE = 1, 2, 3, 4

#: Indices into ``records.STATUSES``.
TRACKING, LIMITED, BRAKING = 0, 1, 2


@dataclass(frozen=True, slots=True)
class RobotState:
    """Where the axes are and how fast they turn."""

    q: Floats  #: (nv,) [rad]
    dq: Floats  #: (nv,) [rad/s]


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """Section 5 without the robot."""

    plan: Plan
    dt_s: float  #: length of a tick [s]
    stop_s: float  #: T_s of Eq. (70) [s]


@dataclass(frozen=True, slots=True)
class Step:
    """What the controller decided in one tick."""

    pose: RobotPose  #: at the tick
    u: Floats  #: (nv,) applied from the tick on [rad/s^2]
    next: RobotState  #: one tick later, Eq. (68), (69)
    distance_m: float  #: surface to surface, smallest over all pairs; 0 in contact, NaN where not known [m]
    limb: int  #: of the nearest pair; -1 without one
    link: int  #: of the nearest pair; -1 without one
    status: int  #: index into ``records.STATUSES``
    reason: int  #: index into ``REASONS``


def integrate(state: RobotState, dq_next: Floats, dt_s: float) -> tuple[Floats, RobotState]:
    """Acceleration that leads to a velocity within one tick, and the state it leads to, Eq. (68), (69).

    Args:
        state: Now.
        dq_next: (nv,) one tick later [rad/s]. It is taken over as it is, so that a robot at rest is exactly at rest.
        dt_s: Length of the tick [s].

    Returns:
        ``u`` (nv,) [rad/s^2] and the next state. An axis of unknown velocity counts as standing.
    """
    dq = np.where(np.isfinite(state.dq), state.dq, 0.0)
    u = (dq_next - dq) / dt_s
    q_next = state.q + dt_s * dq + 0.5 * dt_s**2 * u
    return u, RobotState(q_next, dq_next)


def braked(state: RobotState, ddq_max: Floats, dt_s: float) -> Floats:
    """Next velocity of a robot that stops as fast as each axis can, Eq. (67).

    Args:
        state: Now.
        ddq_max: (nv,) [rad/s^2].
        dt_s: Length of the tick [s].

    Returns:
        (nv,) [rad/s]; exactly 0 for an axis that comes to rest within the tick, and for one of unknown velocity.
    """
    speed = np.abs(state.dq)
    slower = np.sign(state.dq) * (speed - ddq_max * dt_s)
    return np.where(np.isfinite(speed) & (speed > ddq_max * dt_s), slower, 0.0)


@dataclass(frozen=True, slots=True)
class Sight:
    """The robot and the people of one tick."""

    pose: RobotPose
    pairs: Separation | None  #: none where ``reason`` says why
    distance_m: float  #: surface to surface, smallest over all pairs; NaN where there is none [m]
    limb: int
    link: int
    reason: int  #: index into ``REASONS``; 0 where nothing is wrong

    def step(self, state: RobotState, dq_next: Floats, dt_s: float, status: int, reason: int = 0) -> Step:
        """What the controller decided.

        Args:
            state: At the tick.
            dq_next: (nv,) one tick later [rad/s].
            dt_s: Length of the tick [s].
            status: Index into ``records.STATUSES``.
            reason: Index into ``REASONS``.
        """
        u, after = integrate(state, dq_next, dt_s)
        return Step(self.pose, u, after, self.distance_m, self.limb, self.link, status, reason)


def observe(
    robot: RobotModel, state: RobotState, obstacles: Obstacles, clearance_m: float, pose: RobotPose | None = None
) -> Sight:
    """Pose of the robot and nearest pair of link and limb.

    The clearance of Eq. (1), (2) of a pair is the limb's radius, Eq. (41), plus the link's, plus ``clearance_m``.

    Args:
        robot: The manipulator.
        state: At the tick.
        obstacles: The swept volumes of the tick.
        clearance_m: Clearance beyond limb radius + link radius [m].
        pose: Of the robot in that state, where it has been computed already.
    """
    pose = robot.pose(state.q, state.dq) if pose is None else pose
    finite = math.isfinite(state.q.sum()) and math.isfinite(pose.J_tcp.sum() + pose.dJdq_tcp.sum())
    if not finite or not obstacles.known:
        return Sight(pose, None, math.nan, -1, -1, NO_HUMAN if finite else NOT_FINITE)
    radius = np.array([segment.radius_m for segment in robot.segments])
    pairs = separation(pose, obstacles, radius[:, None] + obstacles.radius_m + clearance_m)
    if not pairs.distance_m.size:
        return Sight(pose, pairs, math.nan, -1, -1, 0)
    surface, link, limb = pairs.nearest()
    if math.isnan(surface):
        return Sight(pose, None, math.nan, -1, -1, NO_DISTANCE)
    return Sight(pose, pairs, max(0.0, surface), limb, link, 0)
