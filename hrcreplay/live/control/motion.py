"""The next step of a live robot: along the approach, along the programme, or to a stop. Pure functions."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hrcreplay.records import Floats
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.control_step import PlanSettings, RobotState, Step
from hrcreplay.robot.control.decision import Taken, made
from hrcreplay.robot.control.stopping import Stop, axis_by_axis, straight
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.programme.path import approach
from hrcreplay.robot.programme.reference import Reference
from hrcreplay.run.followers import Follower, Predict
from hrcreplay.settings.sections import Live


@dataclass(frozen=True)
class ControlSetup:
    """Everything that the decisions of a session depend on beside its inputs."""

    robot: RobotModel
    programme: Reference
    plan: PlanSettings
    follow: Callable[[Reference, float], Follower]  #: a robot at a programmed time of a path
    waypoint_m: float  #: the approach is over when the TCP is this close to its end [m]
    approach_speed: float  #: share of the axes' top speeds on the way to the programme
    bounds: Live
    memory_s: float  #: a person unseen for longer counts as unknown [s]
    sending: bool  #: False in shadow mode: the robot does not follow

    def stop_from(self, state: RobotState) -> Stop:
        """The stop of a robot whose last one ended elsewhere: it was held at a limit, or only echoed."""
        brake = straight if self.plan.certified else axis_by_axis
        # a copy: for an array that is read-only numba would compile the kernel anew, while the robot waits
        return brake(state.q.copy(), state.dq.copy(), self.robot.ddq_max, self.plan.dt_s)


@dataclass(frozen=True, eq=False)
class MotionState:
    """State of the commanded motion after an answer."""

    state: RobotState
    programme_s: float  #: of the programme
    stop: Stop  #: what goes on where no better step is certified; its row 0 is ``state``
    follower: Follower | None = None  #: None: it stands, or brakes
    arrived: bool = False  #: whether it follows the programme, not the way to it


class MotionStep(NamedTuple):
    """The step of one tick, and the state of the motion after it."""

    reference_m: Floats
    reference_speed: float
    step: Step
    after: MotionState


def start_approach(setup: ControlSetup, motion: MotionState) -> MotionState:
    """Starts the approach from where the robot stands to the point that its programme has reached."""
    goal = setup.programme.sample(motion.programme_s).q
    follower = setup.follow(approach(setup.robot, motion.state.q, goal, setup.approach_speed), 0.0)
    follower.take_over(motion.stop)
    return replace(motion, follower=follower, arrived=False)


def follow(setup: ControlSetup, motion: MotionState, predict: Predict) -> MotionStep:
    """One tick along the approach or the programme.

    Raises:
        ValueError: No approach was started.
    """
    if motion.follower is None:
        raise ValueError("follow: the robot has not set out")
    follower = copy(motion.follower)
    tick = follower.step(predict)
    after = replace(motion, state=tick.step.next, stop=tick.step.stop, follower=follower)
    if motion.arrived:
        after = replace(after, programme_s=tick.programme_s)
    elif _at_the_end(setup, follower):
        follower = setup.follow(setup.programme, motion.programme_s)
        follower.take_over(tick.step.stop)
        after = replace(after, follower=follower, arrived=True)
    return MotionStep(tick.point.T_world_tcp[:3, 3], float(np.linalg.norm(tick.point.twist[:3])), tick.step, after)


def _at_the_end(setup: ControlSetup, follower: Follower) -> bool:
    """Whether the approach has come to its end."""
    if follower.s_s < follower.reference.duration_s:
        return False
    goal = follower.reference.sample(follower.s_s).T_world_tcp[:3, 3]
    pose = setup.robot.pose(follower.state.q, follower.state.dq)
    return float(np.linalg.norm(pose.T_world_tcp[:3, 3] - goal)) <= setup.waypoint_m


def brake(setup: ControlSetup, motion: MotionState, predict: Predict) -> MotionStep:
    """The stop that was certified goes on; a robot that stands stays."""
    robot, plan, state = setup.robot, setup.plan, motion.state
    horizon_s = plan.horizon_s(motion.stop)
    with np.errstate(all="ignore"):
        seen = control_step.observe(robot, state, predict(horizon_s), plan.plan.clearance_m)
    going = Taken(motion.stop.rest(), control_step.BRAKING, 0, plan.certified or not motion.stop.ticks)
    step = made(seen, motion.stop, going, horizon_s, plan.dt_s)
    point = setup.programme.sample(motion.programme_s)
    after = MotionState(step.next, motion.programme_s, step.stop)
    return MotionStep(point.T_world_tcp[:3, 3], 0.0, step, after)
