"""Input and output of one tick of a controller, and the observation of people.

Corrections to the paper: docs/paper.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypedDict

import numpy as np

from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints, MotionRow
from hrcreplay.robot.control.contact_speed import ContactSpeeds
from hrcreplay.robot.control.separation import NearestLink, Obstacles, Separation, measure
from hrcreplay.robot.control.stops import Stop
from hrcreplay.robot.kinematics import Arm, RobotPose, pose_at
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.task import Waits, waits
from hrcreplay.settings.sections import Plan

#: Reasons why a robot braked or stood still. The first one is for ticks without braking or standing still.
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


class RobotState(NamedTuple):
    """Positions and velocities of the axes."""

    q: Floats  #: (nv,) [rad]
    dq: Floats  #: (nv,) [rad/s]


class Ahead(NamedTuple):
    """Settings of ``PlanSettings.horizon_s`` as numbers for kernels."""

    spare_ticks: int
    least_s: float  #: shortest horizon of a tick's volumes [s]
    most_s: float  #: longest one [s]
    dt_s: float


class QpRules(NamedTuple):
    """Settings of Eq. (66) as numbers for kernels; see ``settings.sections.Plan``."""

    q_p: tuple[float, float]
    q_v: tuple[float, float]
    path_gain_per_s: float
    posture: float
    jerk_s: float
    smooth_s: float
    tcp_acceleration_max: float
    square: bool  #: whether the right-hand side of Eq. (14) is as printed
    give_way_m: float
    soft: bool
    dt_s: float


class PathRules(NamedTuple):
    """Settings of the methods that stay on the path as numbers for kernels; see ``settings.sections.Plan``."""

    tcp_speed_max: float
    tcp_acceleration_max: float
    lead_s: float
    square: bool  #: whether the right-hand side of Eq. (14) is as printed
    dt_s: float


class TickRules(NamedTuple):
    """Settings of a whole tick as numbers for kernels; see ``settings.sections.Plan``."""

    qp: QpRules
    path: PathRules
    waits: Waits
    ahead: Ahead
    clearance_m: float
    lead_s: float
    tcp_speed_max: float
    retreat_m: float  #: largest depth inside a volume from which a robot may move out of it [m]
    certified: bool  #: whether a step must be certified


@dataclass(frozen=True)
class PlanSettings:
    """Settings of Section 5, without the robot."""

    plan: Plan
    dt_s: float  #: length of a tick [s]
    stop_s: float  #: T_s of Eq. (70) [s]
    latency_s: float = 0.0  #: from the newest capture to the robot's reaction [s]
    spare_ticks: int = 0  #: number of further ticks in which the volumes of a tick may be used
    certified: bool = True  #: whether a step must be certified
    retreat_m: float = 0.0  #: largest depth inside a volume from which a robot may move out of it [m]
    contact: ContactSpeeds | None = None  #: speeds at which links may touch limbs; None: they must not

    def horizon_s(self, stop: Stop) -> float:
        """Required horizon of a tick's volumes: the end of the stop that follows the step [s].

        It is the duration of the stop from the present velocity, plus one tick for the step, plus one tick because
        the step may increase the velocity.

        Args:
            stop: The stop from the present velocity.
        """
        return horizon_after(stop.ticks, self.tick_rules.ahead)

    def retreats(self, overlap_m: float) -> bool:
        """Return whether a robot whose link is ``overlap_m`` [m] inside a volume may slowly move out of it."""
        return 0.0 < overlap_m < self.retreat_m

    @cached_property
    def rules(self) -> QpRules:
        """The settings of Eq. (66) as numbers."""
        plan = self.plan
        return QpRules(
            q_p=(float(plan.q_p[0]), float(plan.q_p[1])),
            q_v=(float(plan.q_v[0]), float(plan.q_v[1])),
            path_gain_per_s=float(plan.path_gain_per_s),
            posture=float(plan.posture),
            jerk_s=float(plan.jerk_s),
            smooth_s=float(plan.smooth_s),
            tcp_acceleration_max=float(plan.tcp_acceleration_max),
            square=plan.constraint_rhs == "square",
            give_way_m=float(plan.give_way_m),
            soft=plan.rows == "soft",
            dt_s=float(self.dt_s),
        )

    @cached_property
    def tick_rules(self) -> TickRules:
        """The settings of a whole tick as numbers."""
        plan, adaptive = self.plan, self.plan.horizon == "adaptive"
        ahead = Ahead(
            int(self.spare_ticks),
            0.0 if adaptive else float(self.stop_s),
            math.inf if adaptive or self.certified else float(self.stop_s),
            float(self.dt_s),
        )
        limits = float(plan.clearance_m), float(plan.lead_s), float(plan.tcp_speed_max), float(self.retreat_m)
        return TickRules(self.rules, self.path_rules, self.waits, ahead, *limits, self.certified)

    @cached_property
    def path_rules(self) -> PathRules:
        """The settings of the methods that stay on the path as numbers."""
        plan = self.plan
        square = plan.constraint_rhs == "square"
        limits = float(plan.tcp_speed_max), float(plan.tcp_acceleration_max), float(plan.lead_s)
        return PathRules(*limits, square, float(self.dt_s))

    @cached_property
    def waits(self) -> Waits:
        """The settings of the reference as numbers."""
        return waits(self.plan)

    def without_jerk(self) -> PlanSettings:
        """The same settings without the limit on changes of the acceleration."""
        return replace(self, plan=self.plan.model_copy(update={"jerk_s": 0.0}))


@njit(cache=True)
def horizon_after(ticks: int, rules: Ahead) -> float:
    """The horizon of a tick's volumes for a stop of so many ticks; see ``PlanSettings.horizon_s`` [s]."""
    return min(max((ticks + 2 + rules.spare_ticks) * rules.dt_s, rules.least_s), rules.most_s)


class Proposal(NamedTuple):
    """A step that a method proposes."""

    stop: Stop  #: the stop after the step; its row 0 is the end of the step
    status: int  #: index into ``records.STATUSES``


#: Steps that a method proposes, best first; or the index into REASONS of the reason why there are none.
Proposals = list[Proposal] | int


class Step(NamedTuple):
    """Decision of the controller in one tick."""

    tcp_m: Floats  #: (3,) at the tick, world [m]
    tcp_speed: float  #: at the tick [m/s]
    u: Floats  #: (nv,) applied from the tick on [rad/s^2]
    next: RobotState  #: one tick later, Eq. (68), (69)
    distance_m: float  #: surface to surface, smallest over all pairs; 0 in contact, NaN where not known [m]
    overlap_m: float  #: depth of the link inside the volume, radii included; NaN where not known [m]
    limb: int  #: of the nearest pair; -1 without one
    link: int  #: of the nearest pair; -1 without one
    status: int  #: index into ``records.STATUSES``
    reason: int  #: index into ``REASONS``
    horizon_s: float  #: horizon of the volumes used, from the tick on [s]
    tau_s: float  #: duration of the stop from the velocity of the tick [s]
    certified: bool  #: whether the step, or the stop that it continues, is clear of volumes that are still valid
    stop: Stop  #: the stop that continues at the next tick if no better step is certified


class Sight(NamedTuple):
    """The robot and the people at one tick."""

    pose: RobotPose
    pairs: Separation | None  #: None if ``reason`` is not 0
    distance_m: float  #: surface to surface, smallest over all pairs; NaN if there is no pair [m]
    limb: int
    link: int
    reason: int  #: index into ``REASONS``; 0 if there is no problem
    overlap_m: float = 0.0  #: depth of the link inside the volume, radii included [m]


def observe(robot: RobotModel, state: RobotState, obstacles: Obstacles, clearance_m: float) -> Sight:
    """Pose of the robot and nearest pair of link and limb.

    The clearance of Eq. (1), (2) of a pair is the limb's radius, Eq. (41), plus the link's, plus ``clearance_m``.

    Args:
        robot: The manipulator.
        state: State of the robot at the tick.
        obstacles: The swept volumes of the tick.
        clearance_m: Clearance beyond limb radius + link radius [m].
    """
    hulls = obstacles.vertices_m, obstacles.offsets, obstacles.radius_m
    pose, finite, found = look(robot.arm, state.q, state.dq, *hulls, obstacles.known, clearance_m)
    return sight_of(pose, finite, found, obstacles)


def sight_of(pose: RobotPose, finite: bool, found: NearestLink, obstacles: Obstacles) -> Sight:
    """The observation from the result of ``look``.

    Args:
        pose: The robot's pose at the tick.
        finite: Whether its numbers are finite.
        found: Distances of all pairs, and the nearest pair.
        obstacles: The swept volumes of the tick.
    """
    if not finite or not obstacles.known:
        return Sight(pose, None, math.nan, -1, -1, NO_HUMAN if finite else NOT_FINITE)
    return _sight(pose, found, obstacles)


def _sight(pose: RobotPose, found: NearestLink, obstacles: Obstacles) -> Sight:
    pairs, surface, link, limb = found
    if not pairs.distance_m.size:
        return Sight(pose, pairs, math.nan, -1, -1, 0)
    if math.isnan(surface):
        return Sight(pose, None, math.nan, -1, -1, NO_DISTANCE)
    return Sight(pose, pairs, max(0.0, surface), obstacles.among_all(limb), link, 0, max(0.0, -surface))


@njit(cache=True)
def look(
    arm: Arm,
    q: Floats,
    dq: Floats,
    vertices: Floats,
    offsets: Ints,
    radius: Floats,
    known: bool,
    clearance_m: float,
) -> tuple[RobotPose, bool, NearestLink]:
    """Pose of the robot, whether it is finite, and the distances from people, without pairs if anything is unknown.

    Args:
        arm: The manipulator.
        q: (nv,) [rad].
        dq: (nv,) [rad/s].
        vertices: (m, 3) of all limbs [m].
        offsets: (l + 1,) index of each limb's first vertex.
        radius: (l,) of the limbs' balls [m].
        known: Whether all limbs are known.
        clearance_m: Clearance beyond limb radius + link radius [m].
    """
    pose, finite = finite_pose(arm, q, dq)
    if not (finite and known):
        none = np.empty((0, 0))
        return pose, finite, NearestLink(Separation(none, none), np.nan, -1, -1)
    return pose, finite, measure(pose.ends_m, arm.radius_m, vertices, offsets, radius, clearance_m)


@njit(cache=True, inner=True)
def finite_pose(arm: Arm, q: Floats, dq: Floats) -> tuple[RobotPose, bool]:
    """Pose of the robot, and whether it is finite."""
    pose = pose_at(arm.chain, q, dq)
    return pose, math.isfinite(q.sum()) and math.isfinite(pose.J_tcp.sum() + pose.dJdq_tcp.sum())


class Taken(NamedTuple):
    """Motion executed in a tick."""

    stop: Stop  #: the stop after the step; its row 0 is the end of the step
    status: int  #: index into ``records.STATUSES``
    reason: int  #: index into ``REASONS``
    certified: bool  #: whether step and stop are clear of volumes that are still valid


def standstill_reason(sight: Sight, settings: PlanSettings) -> int:
    """Reason to propose no step: people are not known, or the robot is inside a volume; 0 if there is no reason.

    Args:
        sight: The robot's distances from people.
        settings: Settings of the method.
    """
    if sight.reason:
        return sight.reason
    return INSIDE if settings.certified and sight.overlap_m >= settings.retreat_m and sight.distance_m <= 0.0 else 0


@njit(cache=True)
def reason_to_stand(finite: bool, known: bool, nearest: NearestLink, certified: bool, retreat_m: float) -> int:
    """The same for kernels, from the result of ``look``.

    Args:
        finite: Whether the robot's pose is finite.
        known: Whether all limbs are known.
        nearest: Distances of all pairs.
        certified: Whether a step must be certified.
        retreat_m: Largest depth inside a volume from which a robot may move out of it [m].
    """
    if not finite or not known:
        return NO_HUMAN if finite else NOT_FINITE
    if nearest.pairs.distance_m.size and math.isnan(nearest.surface_m):
        return NO_DISTANCE
    inside = nearest.surface_m <= 0.0 and max(0.0, -nearest.surface_m) >= retreat_m
    return INSIDE if certified and inside else 0


@njit(cache=True)
def go_on(stop: Stop, reason: int, certified: bool) -> Taken:
    """The motion where no step is taken: the current stop goes on; for kernels, as in ``certificate.decide``.

    Args:
        stop: The current stop; row 0 is the state of the robot.
        reason: Why, index into ``REASONS``.
        certified: Whether a step must be certified.
    """
    rests = len(stop.q) == 1
    status = LIMITED if rests and reason not in (NO_HUMAN, NOT_FINITE) else BRAKING
    return Taken(stop if rests else Stop(stop.q[1:], stop.dq[1:], stop.along[1:]), status, reason, certified or rests)


def motion_row(
    state: RobotState, step: Step, ref_m: Floats, ref_speed: float, programme_s: float, reason: str | None = None
) -> MotionRow:
    """The row of a tick.

    Args:
        state: State of the robot at the tick.
        step: The decision of the controller.
        ref_m: (3,) programmed TCP position, world [m].
        ref_speed: TCP speed of the reference [m/s].
        programme_s: Programmed time of the reference [s].
        reason: Why the robot braked or stood still, instead of the step's reason.
    """
    return MotionRow(
        q=state.q,
        dq=state.dq,
        u=step.u,
        ref_m=ref_m,
        tcp_m=step.tcp_m,
        tcp_speed=step.tcp_speed,
        ref_speed=ref_speed,
        programme_s=programme_s,
        distance_m=step.distance_m,
        overlap_m=step.overlap_m,
        limb=step.limb,
        link=step.link,
        status=step.status,
        reason=REASONS[step.reason] if reason is None else reason,
        horizon_s=step.horizon_s,
        tau_s=step.tau_s,
        certified=step.certified,
    )


class PairRecord(TypedDict):
    """What a step and its row say of the nearest pair."""

    distance_m: float
    overlap_m: float
    limb: int
    link: int


def nearest_of(sight: Sight) -> PairRecord:
    """The nearest pair of link and limb of an observation."""
    overlap_m = math.nan if math.isnan(sight.distance_m) else sight.overlap_m
    return {"distance_m": sight.distance_m, "overlap_m": overlap_m, "limb": sight.limb, "link": sight.link}


def make_step(sight: Sight, current_stop: Stop, taken: Taken, horizon_s: float, dt_s: float) -> Step:
    """The record of a tick.

    Args:
        sight: The observation at the tick.
        current_stop: The current stop; its row 0 is the present state of the robot.
        taken: The executed motion.
        horizon_s: Time from the tick on for which its volumes are valid [s].
        dt_s: Length of a tick [s].
    """
    after = RobotState(taken.stop.q[0], taken.stop.dq[0])
    return Step(
        tcp_m=sight.pose.T_world_tcp[:3, 3],
        tcp_speed=sight.pose.tcp_speed,
        u=np.asarray((after.dq - current_stop.dq[0]) / dt_s),
        next=after,
        status=taken.status,
        reason=taken.reason,
        horizon_s=horizon_s,
        tau_s=current_stop.ticks * dt_s,
        certified=taken.certified,
        stop=taken.stop,
        **nearest_of(sight),
    )
