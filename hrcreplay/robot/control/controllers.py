"""Stage 3: methods that follow their reference tick by tick, near the people of each tick."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from hrcreplay.kernels import Held, hold
from hrcreplay.records import MotionRow
from hrcreplay.robot.control import path_controller, qp_controller
from hrcreplay.robot.control.certificate import NO_PLANES, decide
from hrcreplay.robot.control.contact_speed import SLOW, end_speeds, pair_speeds, select
from hrcreplay.robot.control.control_step import (
    NO_SOLUTION,
    NOT_FINITE,
    TOO_NEAR,
    PlanSettings,
    Proposal,
    Proposals,
    RobotState,
    Sight,
    Step,
    make_step,
    motion_row,
    observe,
    standstill_reason,
)
from hrcreplay.robot.control.qp_controller import QpContext
from hrcreplay.robot.control.qp_tick import BriefTick, TickHulls, TickStart, decide_held
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.control.static_obstacles import StaticObstacles, shapes_of
from hrcreplay.robot.control.stops import Stop, at_rest
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.task import Reference, ReferencePoint, follow, place


class ControllerTick(NamedTuple):
    """State, reference and decision of a method at one tick."""

    state: RobotState
    point: ReferencePoint  #: the reference at the tick
    programme_s: float  #: programmed time of the reference [s]
    step: Step

    @property
    def row(self) -> MotionRow:
        """The row of the motion."""
        return motion_row(self.state, self.step, self.point.T_world_tcp[:3, 3], self.point.tcp_speed, self.programme_s)


#: Horizon from the tick on [s] -> the swept volumes of the tick that are valid until then.
Predict = Callable[[float], Obstacles]


class Observation(NamedTuple):
    """Observation of people at a tick."""

    sight: Sight  #: the robot's pose, and its distances from people
    obstacles: Obstacles  #: the swept volumes
    horizon_s: float  #: time from the tick on for which the volumes are valid [s]
    predict: Predict  #: the volumes for any horizon


@dataclass
class Controller(ABC):
    """A robot that follows a reference by a method; without a certified step it continues its last stop."""

    robot: RobotModel
    reference: Reference
    settings: PlanSettings
    s_s: float = 0.0  #: programmed time of the reference [s]
    static: StaticObstacles | None = None  #: objects of the cell and pairs of links; None: there are none

    def __post_init__(self) -> None:
        self.point = self.reference.sample(self.s_s)
        self.take_over(at_rest(self.point.q, np.array([self.s_s, 0.0])))

    @property
    def state(self) -> RobotState:
        """State of the robot."""
        return RobotState(self.stop.q[0], self.stop.dq[0])

    @property
    def moment(self) -> TickStart:
        """Robot and reference as numbers for the kernel of a tick."""
        return TickStart(self.stop, self.u, self.s_s, self.point.T_world_tcp, self.planes)

    @cached_property
    def scene(self) -> Held:
        """What no tick changes, for the kernel of a tick: arm, programmed path, rules and objects."""
        static = shapes_of(self.robot, self.static)
        return hold((self.robot.arm, self.reference.grid, self.settings.tick_rules, static))

    def take_over(self, stop: Stop) -> None:
        """Takes over the robot from another controller, together with its certified stop."""
        self.stop = stop if stop.ticks else at_rest(stop.q[0], np.array([self.s_s, 0.0]))
        self.u = np.zeros(self.robot.nv)
        self.planes = NO_PLANES

    def step(self, predict: Predict) -> ControllerTick:
        """One tick."""
        state, point, now_s = self.state, self.point, self.s_s
        with np.errstate(all="ignore"):  # invalid numbers lead to braking, not to warnings
            step = self.decide(predict)
        self.stop, self.u = step.stop, step.u
        self._move_on()
        return ControllerTick(state, point, now_s, step)

    def decide(self, predict: Predict) -> Step:
        """What the robot executes."""
        seen = self.observe(predict)
        return self._certify(seen, self.propose(seen))

    def _certify(self, seen: Observation, proposals: Proposals) -> Step:
        """The step of the first certified proposal, or of the stop that continues."""
        seen_until = seen.obstacles, seen.horizon_s
        taken, self.planes = decide(
            self.robot, self.stop, proposals, *seen_until, self.planes, self.settings, self.static
        )
        return make_step(seen.sight, self.stop, taken, seen.horizon_s, self.settings.dt_s)

    def observe(self, predict: Predict) -> Observation:
        """The people at the tick, with volumes that are valid until the end of the stop after the step."""
        return self._observe(*self._volumes(predict), predict)

    def _observe(self, obstacles: Obstacles, horizon_s: float, predict: Predict) -> Observation:
        """The people at the tick, with these volumes."""
        return Observation(
            observe(self.robot, self.state, obstacles, self.settings.plan.clearance_m), obstacles, horizon_s, predict
        )

    def _volumes(self, predict: Predict) -> tuple[Obstacles, float]:
        """The volumes of the tick, and the time from the tick on for which they are valid [s]."""
        horizon_s = self.settings.horizon_s(self.stop)
        obstacles = predict(horizon_s)
        return obstacles, min(horizon_s, obstacles.horizon_s)  # a live session may reuse older volumes

    @abstractmethod
    def propose(self, seen: Observation) -> Proposals:
        """Proposals of the method, or the reason why there are none."""

    @abstractmethod
    def _move_on(self) -> None:
        """Moves the reference to the next tick."""


class QpController(Controller):
    """The trajectory generator of Section 5, along a reference that waits for the robot or runs with the clock."""

    def decide(self, predict: Predict) -> Step:
        """What the robot executes, by one kernel, see ``qp_tick``; what that leaves to Python is looked at again."""
        obstacles, horizon_s = self._volumes(predict)
        hulls = obstacles.vertices_m, obstacles.offsets, obstacles.radius_m, obstacles.boxes_m
        found = decide_held(self.scene, self.moment, TickHulls(*hulls, obstacles.known, horizon_s))
        self.s_s, self.point = found.s_s, found.point
        if not found.decided:
            seen = self._observe(obstacles, horizon_s, predict)
            return self._certify(seen, self._proposals(seen, found))
        self.planes, taken, (distance_m, overlap_m, limb, link) = found.planes, found.taken, found.gap
        return Step(
            tcp_m=found.tcp_m,
            tcp_speed=found.tcp_speed,
            u=found.u,
            next=RobotState(taken.stop.q[0], taken.stop.dq[0]),
            distance_m=distance_m,
            overlap_m=overlap_m,
            limb=obstacles.among_all(limb) if limb >= 0 else limb,
            link=link,
            status=taken.status,
            reason=taken.reason,
            horizon_s=horizon_s,
            tau_s=self.stop.ticks * self.settings.dt_s,
            certified=taken.certified,
            stop=taken.stop,
        )

    def _proposals(self, seen: Observation, found: BriefTick) -> Proposals:
        """The proposals of a tick that the kernel has not decided."""
        context = self._context(seen, found.rate, found.tcp_speed_max)
        again = qp_controller.propose if found.solved else qp_controller.try_again
        return again(context, self.settings)

    def propose(self, seen: Observation) -> Proposals:
        """The best step by Eq. (66), and the stop after it."""
        context = self.qp_context(seen)
        return standstill_reason(seen.sight, self.settings) or qp_controller.propose(context, self.settings)

    def qp_context(self, seen: Observation) -> QpContext:
        """Advances the reference by one tick and returns the input of Eq. (66), whose target it is."""
        at, settings, path = seen.sight.pose.T_world_tcp, self.settings, self.reference
        self.s_s, rate, self.point, cap = follow(
            path.grid, path.model.chain, self.s_s, self.point.T_world_tcp, at, settings.dt_s, settings.waits
        )
        return self._context(seen, rate, cap)

    def _context(self, seen: Observation, rate: float, tcp_speed_max: float) -> QpContext:
        """The input of Eq. (66), whose target is the reference."""
        target = qp_controller.Target(self.point.T_world_tcp, rate * self.point.twist, self.point.q, tcp_speed_max)
        seen_until = seen.sight, seen.obstacles, seen.horizon_s
        return QpContext(self.robot, self.state, self.u, target, *seen_until, self.static)

    def _move_on(self) -> None:
        """Does nothing: ``qp_context`` has already advanced the reference."""


class PathController(Controller):
    """A robot that stays on the programmed path: the baselines of ``path_controller``."""

    #: Whether the method takes people into account, and whether the rows of Eq. (66i) bound its rate.
    careful, by_rows = True, False

    def propose(self, seen: Observation) -> Proposals:
        """The step with the largest allowed rate along the path, and the stop after it."""
        sight = seen.sight
        reason = standstill_reason(sight, self.settings) if self.careful else 0
        if reason or sight.reason == NOT_FINITE:
            return reason or sight.reason
        if np.isnan(self.stop.along[0, 0]):
            return NO_SOLUTION  # continue the stop of another method
        rows = seen.obstacles if self.by_rows else None
        return path_controller.propose(
            self.robot, self.reference, self.stop, sight, rows, seen.horizon_s, self.settings
        )

    def _move_on(self) -> None:
        if np.isnan(self.stop.along[0, 0]):
            self.take_over(self.stop)
        else:
            self.s_s = float(self.stop.along[0, 0])
        self.point = self.reference.sample(self.s_s)


class ScalingController(PathController):
    """The baseline [24]: the largest share of the programmed speed that meets the constraints."""

    by_rows = True


class BlindController(PathController):
    """Follows the programme and ignores people."""

    careful = False


class SsmController(PathController):
    """Speed and separation monitoring, ISO/TS 15066: moves while the protective separation distance is kept."""

    def propose(self, seen: Observation) -> Proposals:
        """The proposals along the path, while the protective separation distance is kept."""
        proposals = super().propose(seen)
        if isinstance(proposals, int):
            return proposals
        present, needed_m = self.protective(seen, proposals[0])
        return proposals if present.distance_m >= needed_m else TOO_NEAR

    def protective(self, seen: Observation, proposal: Proposal) -> tuple[Sight, float]:
        """The observation of the people's present volumes, and the protective separation distance of a step [m]."""
        pose, settings = seen.sight.pose, self.settings
        present = observe(self.robot, self.state, seen.predict(0.0), settings.plan.clearance_m)
        return present, path_controller.protective_distance_m(
            pose, proposal.stop, settings.plan.human_speed, settings.latency_s, settings.dt_s
        )


class PflController(PathController):
    """Power and force limiting, ISO/TS 15066: may touch some limbs, as slowly as they bear; stops before the others.

    No certificate says that it keeps clear of all volumes, so none is recorded.
    """

    def step(self, predict: Predict) -> ControllerTick:
        """One tick."""
        tick = super().step(predict)
        return tick._replace(step=tick.step._replace(certified=False))

    def observe(self, predict: Predict) -> Observation:
        """The people at the tick: the robot's distances from all of them, and the volumes that it must not touch."""
        seen = super().observe(predict)
        self.speeds = self.settings.contact.speeds(seen.obstacles)  # type: ignore[union-attr]
        self.beside = [seen.obstacles.among_all(k) for k in range(len(self.speeds))]
        return seen._replace(obstacles=select(seen.obstacles, np.isnan(self.speeds)))

    def propose(self, seen: Observation) -> Proposals:
        """The step with the largest allowed rate along the path, and the stop after it."""
        sight, settings = seen.sight, self.settings
        guarded = observe(self.robot, self.state, seen.obstacles, settings.plan.clearance_m)
        reason = sight.reason or standstill_reason(guarded, settings)
        if reason or sight.pairs is None:
            return reason
        if np.isnan(self.stop.along[0, 0]):
            return NO_SOLUTION  # continue the stop of another method
        limits = pair_speeds(sight.pairs, self.speeds, seen.horizon_s).min(axis=1, initial=np.inf)
        return path_controller.propose(
            self.robot, self.reference, self.stop, sight, None, seen.horizon_s, settings, limits
        )

    def slowest(self, seen: Observation) -> list[dict[str, Any]]:
        """The link and the volume, by its place among all possible volumes, that bound the rate; none without one."""
        if seen.sight.pairs is None or np.isnan(self.stop.along[0, 0]):
            return []
        limits = pair_speeds(seen.sight.pairs, self.speeds, seen.horizon_s)
        towards = place(self.reference.grid, float(self.stop.along[0, 0]))[1]
        moving = end_speeds(seen.sight.pose, towards)
        link, volume = divmod(int(np.argmin(limits / np.maximum(moving, SLOW)[:, None])), limits.shape[1])
        if moving[link] <= limits[link, volume]:
            return []
        return [{"kind": "contact", "link": link, "volume": self.beside[volume], "speed_m_per_s": limits[link, volume]}]


#: Method -> its controller.
CONTROLLERS: dict[str, type[Controller]] = {
    "qp": QpController,
    "scaling": ScalingController,
    "shield": PathController,
    "ssm": SsmController,
    "pfl": PflController,
    "none": BlindController,
}
