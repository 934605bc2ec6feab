"""Stage 3: a method that follows its reference tick by tick, beside the people of each tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hrcreplay.records import HumanStates, Motion, SweptVolumes
from hrcreplay.robot.control import control_step, qp_controller, scaling_controller
from hrcreplay.robot.control.control_step import PlanSettings, RobotState, Step
from hrcreplay.robot.control.scaling_controller import PathState
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.programme.reference import Reference, ReferencePoint, advance

_FIRST_S = 1.0  # with a person: a shorter time says nothing, for the volumes still hold what is not known yet


class FollowerTick(NamedTuple):
    """State, reference and decision of a method at one tick."""

    state: RobotState
    point: ReferencePoint  #: of the reference
    programme_s: float  #: its programmed time [s]
    step: Step


@dataclass
class QpFollower:
    """The trajectory generator of Section 5 along a reference that waits for it or not."""

    robot: RobotModel
    reference: Reference
    settings: PlanSettings
    s_s: float = 0.0

    def __post_init__(self) -> None:
        self.point = self.reference.sample(self.s_s)
        self.state = RobotState(self.point.q, np.zeros(self.robot.nv))

    def step(self, volumes: Obstacles) -> FollowerTick:
        """One tick of the trajectory generator."""
        state, point, now_s = self.state, self.point, self.s_s
        pose = self.robot.pose(state.q, state.dq)
        error_m = float(np.linalg.norm(pose.T_world_tcp[:3, 3] - point.T_world_tcp[:3, 3]))
        self.s_s, rate = advance(self.reference, self.s_s, self.settings.dt_s, error_m, self.settings.plan)
        self.point = self.reference.sample(self.s_s)
        step = qp_controller.step(
            self.robot, state, self.point.T_world_tcp, rate * self.point.twist, volumes, self.settings, pose
        )
        self.state = step.next
        return FollowerTick(state, point, now_s, step)


@dataclass
class ScalingFollower:
    """The baseline [24]: the robot stays on the programmed path, and its speed along it is scaled."""

    robot: RobotModel
    reference: Reference
    settings: PlanSettings
    s_s: float = 0.0

    def __post_init__(self) -> None:
        self.along = PathState(self.s_s, 0.0)
        self.state = RobotState(self.reference.sample(self.s_s).q, np.zeros(self.robot.nv))

    def step(self, volumes: Obstacles) -> FollowerTick:
        """One tick of the baseline."""
        state, now_s = self.state, self.along.s_s
        point = self.reference.sample(now_s)
        step, self.along = scaling_controller.step(
            self.robot, self.reference, self.along, volumes, self.settings, point
        )
        self.state = step.next
        return FollowerTick(state, point, now_s, step)


@dataclass
class Planner:
    """One method beside the people of each tick; brakes when nobody has seen them for too long."""

    follower: QpFollower | ScalingFollower
    chosen: bool  #: the run's method, not a baseline
    memory_s: float  #: without a camera for longer than this the person counts as lost [s]
    seen_ns: int | None = None

    @property
    def dt_s(self) -> float:
        """The time between two ticks [s]."""
        return self.follower.settings.dt_s

    def follow(self, states: HumanStates, volumes: SweptVolumes, around: Sequence[Obstacles]) -> Motion:
        """The motion of a batch of ticks, beside the obstacles that the volumes of each are."""
        robot = self.follower.robot
        seen = np.any(states.valid, axis=1)
        rows = [self._tick(around[i], int(t), bool(seen[i])) for i, t in enumerate(volumes.t_ns)]
        found, points, steps = ([getattr(row, name) for row in rows] for name in ("state", "point", "step"))
        poses = [step.pose for step in steps]
        return Motion(
            t_ns=volumes.t_ns,
            q=np.array([state.q for state in found]),
            dq=np.array([state.dq for state in found]),
            u=np.array([step.u for step in steps]),
            ref_m=np.array([point.T_world_tcp[:3, 3] for point in points]),
            tcp_m=np.array([pose.T_world_tcp[:3, 3] for pose in poses]),
            tcp_speed=np.array(
                [np.linalg.norm(pose.J_tcp[:3] @ state.dq) for pose, state in zip(poses, found, strict=True)]
            ),
            ref_speed=np.array([np.linalg.norm(point.twist[:3]) for point in points]),
            programme_s=np.array([row.programme_s for row in rows]),
            distance_m=np.array([step.distance_m for step in steps]),
            limb=np.array([step.limb for step in steps]),
            link=np.array([step.link for step in steps]),
            status=np.array([step.status for step in steps]),
            reason=np.array([step.reason for step in steps]),
            limbs=volumes.limbs,
            links=tuple(segment.name for segment in robot.segments),
            reasons=control_step.REASONS,
        )

    def _tick(self, around: Obstacles, t_ns: int, seen: bool) -> FollowerTick:
        if seen:
            self.seen_ns = t_ns
        if self.seen_ns is None or t_ns - self.seen_ns > self.memory_s * 1e9:
            around = replace(around, known=False)
        return self.follower.step(around)


@dataclass
class InitialOverlap:
    """Whether robot and person overlap from the start: at every tick of the first second with a person in view."""

    dt_s: float
    ticks: int = 0
    inside: bool = True
    pair: tuple[str, str] = ("", "")  #: link and limb at the first of them

    def add(self, states: HumanStates, motion: Motion) -> None:
        """Takes a batch of ticks into account."""
        rows = np.flatnonzero(np.isfinite(states.p[:, 0]) & (motion.limb >= 0))
        rows = rows[: max(0, round(_FIRST_S / self.dt_s) - self.ticks)]
        if not len(rows):
            return
        if not self.ticks:
            self.pair = (motion.links[motion.link[rows[0]]], motion.limbs[motion.limb[rows[0]]])
        self.ticks += len(rows)
        self.inside = self.inside and bool((motion.distance_m[rows] <= 0.0).all())

    def remark(self) -> str | None:
        """The note for the user; None where there is a distance between the two."""
        if not self.ticks or not self.inside:
            return None
        link, limb = self.pair
        return (
            f"the robot's link {link} stands inside the volume of the person's {limb} from the first tick with a "
            f"person on, for {self.ticks * self.dt_s:.2f} s at least; is T_world_base right? "
            "hrcreplay calibrate tells where the person stood"
        )
