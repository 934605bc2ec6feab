"""What a controller sees in one tick before it decides: how near the people are, or why that is not known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hrcreplay.records import Floats
from hrcreplay.robot import stepping
from hrcreplay.robot.model import RobotModel, RobotPose
from hrcreplay.robot.obstacles import Obstacles
from hrcreplay.robot.separation import Separation, separation
from hrcreplay.robot.stepping import RobotState, Step


@dataclass(frozen=True, slots=True)
class Sight:
    """The robot and the people of one tick."""

    pose: RobotPose
    pairs: Separation | None  #: none where ``reason`` says why
    distance_m: float  #: surface to surface, smallest over all pairs; NaN where there is none [m]
    limb: int
    link: int
    reason: int  #: index into ``stepping.REASONS``; 0 where nothing is wrong

    def step(self, state: RobotState, dq_next: Floats, dt_s: float, status: int, reason: int = 0) -> Step:
        """What the controller decided.

        Args:
            state: At the tick.
            dq_next: (nv,) one tick later [rad/s].
            dt_s: Length of the tick [s].
            status: Index into ``records.STATUSES``.
            reason: Index into ``stepping.REASONS``.
        """
        u, after = stepping.integrate(state, dq_next, dt_s)
        return Step(self.pose, u, after, self.distance_m, self.limb, self.link, status, reason)


def observe(robot: RobotModel, state: RobotState, obstacles: Obstacles, clearance_m: float) -> Sight:
    """Pose of the robot and nearest pair of link and limb.

    Args:
        robot: The manipulator.
        state: At the tick.
        obstacles: The swept volumes of the tick.
        clearance_m: Clearance beyond limb radius + link radius [m].
    """
    pose = robot.pose(state.q, state.dq)
    finite = math.isfinite(state.q.sum()) and math.isfinite(pose.J_tcp.sum() + pose.dJdq_tcp.sum())
    if not finite or not obstacles.known:
        return Sight(pose, None, math.nan, -1, -1, stepping.NO_HUMAN if finite else stepping.NOT_FINITE)
    radius = np.array([segment.radius_m for segment in robot.segments])
    pairs = separation(pose, obstacles, radius[:, None] + obstacles.radius_m + clearance_m)
    if not pairs.distance_m.size:
        return Sight(pose, pairs, math.nan, -1, -1, 0)
    surface, link, limb = pairs.nearest()
    if math.isnan(surface):
        return Sight(pose, None, math.nan, -1, -1, stepping.NO_DISTANCE)
    return Sight(pose, pairs, max(0.0, surface), limb, link, 0)
