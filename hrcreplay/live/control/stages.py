"""The stages of a live session, one update at a time: skeletons to swept volumes, and the next step of the robot.

The robot follows the approach, follows the programme, or stops; its steps are pure functions.

This module decodes exactly the recorded skeletons and cleans them like a reader of the log. The cleaning in the
person's process is not sufficient, for two reasons: the message rounds to 32 bits, so a skeleton may become equal to
that of the previous frame; and only here a capture is compared with the session's clock.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from hrcreplay.live.record.codec import Perception
from hrcreplay.logs.cleaning import Cleaner
from hrcreplay.logs.decoders import own_row
from hrcreplay.logs.messages import Undecodable
from hrcreplay.logs.skeleton_pb2 import Skeleton
from hrcreplay.pipeline.fusion_stage import FusionStage
from hrcreplay.pipeline.person_fuser import PersonFuser
from hrcreplay.pipeline.surroundings import Surroundings
from hrcreplay.records import CameraFrames, Floats, HumanStates, Ints, SweptVolumes
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.control_step import (
    PlanSettings,
    RobotState,
    Step,
    Taken,
    make_step,
)
from hrcreplay.robot.control.controllers import Controller, Predict
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.robot.control.static_obstacles import StaticObstacles
from hrcreplay.robot.control.stops import Stop, stop_axis_by_axis, stop_straight
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.path import approach
from hrcreplay.robot.task import Reference
from hrcreplay.settings.sections import Live


class Observer:
    """Stages 1 and 2; each update uses the skeletons that have arrived since the previous update."""

    def __init__(
        self, fusion_stage: FusionStage, surroundings: Surroundings, cameras: tuple[str, ...], gap_s: float
    ) -> None:
        self._fuser = PersonFuser(fusion_stage, cameras)
        self._surroundings = surroundings
        self._cameras = cameras
        self.counts: Counter[str] = Counter()
        self._cleaner = Cleaner(cameras, gap_s, self.counts, nobody=fusion_stage.watched is not None)
        self.newest_ns: dict[str, int] = {}  #: per camera: last capture of a person, in the reference clock [ns]

    def fuse(self, t_ns: int, skeletons: Sequence[bytes]) -> HumanStates:
        """Fused people at ``t_ns``, which must be later than that of the previous call.

        Args:
            t_ns: Session clock; it counts as the arrival of all skeletons of this update [ns].
            skeletons: Serialised Skeleton messages; unreadable ones are counted and left out.
        """
        (states, events, _), seen = self._fuser.update(np.array([t_ns]), self._frames(t_ns, skeletons))
        self.counts.update(seen.counts)
        self.counts.update(events)
        for camera, capture_ns in zip(seen.measured.camera.tolist(), seen.measured.capture_ns.tolist(), strict=True):
            self.newest_ns[self._cameras[camera]] = capture_ns
        return states

    def predict(self, t_ns: int, states: HumanStates, horizon_s: float) -> Perception:
        """Swept volumes of the people fused at ``t_ns`` [ns], valid for ``horizon_s`` without the latency [s]."""
        volumes = self._surroundings.prediction.volumes(states, horizon_s)
        return Perception(t_ns, states, volumes, _each(volumes, horizon_s), horizon_s)

    def around(self, look: Perception, horizon_s: float, *, believed: bool) -> Obstacles:
        """Obstacles that the robot keeps clear of, from a perception update.

        Args:
            look: The last perception update.
            horizon_s: 0 for the present volumes of people, for ``ssm``; otherwise the horizon of the update [s].
            believed: Whether the update is recent enough.
        """
        people = look.people
        if not horizon_s:
            people = _each(self._surroundings.prediction.volumes(look.states, 0.0), 0.0)
        found = self._surroundings.obstacles(look.states, slice(None), people)
        return found if believed else found._replace(known=False)

    def _frames(self, t_ns: int, skeletons: Sequence[bytes]) -> CameraFrames | None:
        for data in skeletons:
            try:
                skeleton = Skeleton.FromString(data)
                row = own_row(skeleton, skeleton.camera, skeleton.camera)
            except (DecodeError, Undecodable):
                self.counts["skeletons_unreadable"] += 1
                continue
            if row.camera not in self._cameras:
                self.counts["skeletons_of_unknown_cameras"] += 1
                continue
            if self._fuser.stage.watched is None and not row.confidence.any():
                continue  # a body without points is only relevant for a watched area
            self._cleaner.add(row, t_ns)
        return self._cleaner.flush()


def _each(volumes: SweptVolumes, horizon_s: float) -> tuple[Obstacles, ...]:
    """The volumes of each person at one instant."""
    return tuple(obstacles(volumes, row, horizon_s) for row in range(len(volumes)))


@dataclass(frozen=True)
class ControlSetup:
    """Everything that the decisions of a session depend on, apart from its inputs."""

    robot: RobotModel
    programme: Reference
    plan: PlanSettings
    static: StaticObstacles | None  #: what the robot keeps clear of beside people
    follow: Callable[[Reference, float], Controller]  #: path and programmed time -> controller
    waypoint_m: float  #: the approach ends when the TCP is this close to its end [m]
    approach_speed: float  #: share of the axes' top speeds during the approach
    bounds: Live
    fresh_s: float  #: if the newest frame is older than this, the person is unknown and the robot stops [s]
    sending: bool  #: False in shadow mode: the robot does not follow
    joint_order: Ints  #: (n,) axis of the robot for each joint of EGM, external joints last

    def stop_from(self, state: RobotState) -> Stop:
        """A new stop for a robot that is not at the start of its last stop, because of a limit or an echo."""
        brake = stop_straight if self.plan.certified else stop_axis_by_axis
        # copies: for a read-only array numba would compile the kernel again while the robot waits
        return brake(state.q.copy(), state.dq.copy(), self.robot.ddq_max, self.plan.dt_s)


class MotionState(NamedTuple):
    """State of the commanded motion after an answer."""

    state: RobotState
    programme_s: float  #: time in the programme [s]
    stop: Stop  #: the stop that continues if no better step is certified; its row 0 is ``state``
    controller: Controller | None = None  #: None: the robot stands or brakes
    arrived: bool = False  #: whether the robot follows the programme, and not the approach


class MotionStep(NamedTuple):
    """The step of one tick, and the state of the motion after it."""

    reference_m: Floats
    reference_speed: float
    step: Step
    after: MotionState


def start_approach(setup: ControlSetup, motion: MotionState) -> MotionState:
    """Starts the approach from the robot's position to the current point of the programme."""
    goal = setup.programme.sample(motion.programme_s).q
    controller = setup.follow(approach(setup.robot, motion.state.q, goal, setup.approach_speed), 0.0)
    controller.take_over(motion.stop)
    return motion._replace(controller=controller, arrived=False)


def follow(setup: ControlSetup, motion: MotionState, predict: Predict) -> MotionStep:
    """One tick along the approach or the programme.

    Raises:
        ValueError: The approach has not started.
    """
    if motion.controller is None:
        raise ValueError("follow: the robot has not set out")
    controller = copy(motion.controller)
    tick = controller.step(predict)
    after = motion._replace(state=tick.step.next, stop=tick.step.stop, controller=controller)
    if motion.arrived:
        after = after._replace(programme_s=tick.programme_s)
    elif _at_the_end(setup, controller):
        controller = setup.follow(setup.programme, motion.programme_s)
        controller.take_over(tick.step.stop)
        after = after._replace(controller=controller, arrived=True)
    return MotionStep(tick.point.T_world_tcp[:3, 3], tick.point.tcp_speed, tick.step, after)


def _at_the_end(setup: ControlSetup, controller: Controller) -> bool:
    """Return whether the approach has ended."""
    if controller.s_s < controller.reference.duration_s:
        return False
    goal = controller.reference.sample(controller.s_s).T_world_tcp[:3, 3]
    pose = setup.robot.pose(controller.state.q, controller.state.dq)
    return math.dist(pose.T_world_tcp[:3, 3], goal) <= setup.waypoint_m


def brake(setup: ControlSetup, motion: MotionState, predict: Predict) -> MotionStep:
    """One tick of the certified stop; a robot at rest stays at rest."""
    robot, plan, state = setup.robot, setup.plan, motion.state
    horizon_s = plan.horizon_s(motion.stop)
    with np.errstate(all="ignore"):
        seen = control_step.observe(robot, state, predict(horizon_s), plan.plan.clearance_m)
    taken = Taken(motion.stop.rest(), control_step.BRAKING, 0, plan.certified or not motion.stop.ticks)
    step = make_step(seen, motion.stop, taken, horizon_s, plan.dt_s)
    point = setup.programme.sample(motion.programme_s)
    after = MotionState(step.next, motion.programme_s, step.stop)
    return MotionStep(point.T_world_tcp[:3, 3], 0.0, step, after)
