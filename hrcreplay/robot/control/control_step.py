"""Input and output of one tick of a controller, and what every controller computes first: how near the people are.

Corrections to the paper: docs/paper.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hrcreplay.records import Floats
from hrcreplay.robot.control.separation import Obstacles, Separation, separation
from hrcreplay.robot.control.stopping import Stop
from hrcreplay.robot.model import RobotModel, RobotPose
from hrcreplay.settings.sections import Plan

#: Why a robot braked, or stood where it was. The first is that of ticks in which it did neither.
REASONS = (
    "",
    "no human state",
    "no solution",
    "separation failed",
    "not finite",
    "not certified",
    "inside a volume",
    "too near",
)
NO_HUMAN, NO_SOLUTION, NO_DISTANCE, NOT_FINITE, NOT_CERTIFIED, INSIDE, TOO_NEAR = range(1, 8)

#: Indices into ``records.STATUSES``.
TRACKING, LIMITED, BRAKING, RETREATING = range(4)


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
    latency_s: float = 0.0  #: from the newest capture to the robot's reaction [s]
    spare_ticks: int = 0  #: ticks for which the volumes of a tick must serve beyond their own
    certified: bool = True  #: whether a step must be certified
    retreat_m: float = 0.0  #: a robot that is inside a volume by no more than this may move out of it [m]

    def horizon_s(self, stop: Stop) -> float:
        """Until when the volumes of a tick must hold: the end of the stop that would follow the step [s].

        Beside the stop from the present velocity that is the step itself, and the tick more that a stop takes from
        the velocity it may have gained.

        Args:
            stop: From the present velocity.
        """
        needed = (stop.ticks + 2 + self.spare_ticks) * self.dt_s
        if self.plan.horizon == "adaptive":
            return needed
        return max(self.stop_s, needed) if self.certified else self.stop_s

    def retreats(self, overlap_m: float) -> bool:
        """Whether a robot with a link so deep inside a volume may move out of it, slowly [m]."""
        return 0.0 < overlap_m < self.retreat_m

    def without_jerk(self) -> PlanSettings:
        """The same where the acceleration may change by any amount in a tick."""
        return replace(self, plan=self.plan.model_copy(update={"jerk_s": 0.0}))


class Proposal(NamedTuple):
    """A step that a method would like to take."""

    stop: Stop  #: the stop after it; its row 0 is where the step leads
    status: int  #: index into ``records.STATUSES``


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
    horizon_s: float  #: until when the volumes held that it was decided with [s]
    tau_s: float  #: how long the stop from the velocity of the tick takes [s]
    certified: bool  #: whether the step, or the stop that it continues, was found clear of volumes that still hold
    stop: Stop  #: what goes on from the next tick where no better step is certified


@dataclass(frozen=True, slots=True)
class Sight:
    """The robot and the people of one tick."""

    pose: RobotPose
    pairs: Separation | None  #: none where ``reason`` says why
    distance_m: float  #: surface to surface, smallest over all pairs; NaN where there is none [m]
    limb: int
    link: int
    reason: int  #: index into ``REASONS``; 0 where nothing is wrong
    overlap_m: float = 0.0  #: how deep the link is inside the volume, as far as their radii go [m]


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
    return Sight(pose, pairs, max(0.0, surface), limb, link, 0, max(0.0, -surface))
