"""The motion of the robot as recorded, beside the person. It is no controller: it proposes and certifies nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hrcreplay.records import Floats, Ints, Motion, MotionRow
from hrcreplay.robot.control.control_step import (
    REASONS,
    PlanSettings,
    RobotState,
    nearest_of,
    observe,
)
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.control.static_obstacles import StaticObstacles
from hrcreplay.robot.control.stops import Stop, stop_straight
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.recorded import UNKNOWN, RecordedCapsules, RecordedJoints


class Outlook(Protocol):
    """The swept volumes of a batch of ticks."""

    def until(self, horizon_s: Floats) -> list[Obstacles]:
        """Volumes of every tick, each until its own horizon (n,) after it [s]."""


@dataclass(frozen=True)
class RecordedMotion:
    """Gives the recorded motion, tick by tick, in the form of a controller's."""

    robot: RobotModel
    joints: RecordedJoints
    settings: PlanSettings
    static: StaticObstacles | None = None  #: objects of the cell and pairs of links, for the record
    chosen: bool = False  #: it is never the run's method

    def follow(self, t_ns: Ints, outlook: Outlook, limbs: tuple[str, ...]) -> Motion:
        """The recorded motion at a batch of ticks.

        The distance is that from the volumes until the robot could have stopped: from the velocity of the tick, with
        the axes' limits, after the latency. A tick at which the joints are not known has no number but a reason.

        Args:
            t_ns: (n,) ticks [ns].
            outlook: Volumes of the ticks for any horizon.
            limbs: Names of all possible volumes.
        """
        sample = self.joints.sample(t_ns)
        reasons, dt_s = sample.reason.tolist(), self.settings.dt_s
        stops = [
            None if reason else stop_straight(q, dq, self.robot.ddq_max, dt_s)
            for q, dq, reason in zip(sample.q, sample.dq, reasons, strict=True)
        ]
        horizons_s = [0.0 if stop is None else self.settings.horizon_s(stop) for stop in stops]
        rows = [
            _without_numbers(self.robot.nv, UNKNOWN[reason]) if stop is None else self._row(stop, horizon_s, people)
            for stop, reason, horizon_s, people in zip(
                stops, reasons, horizons_s, outlook.until(np.array(horizons_s)), strict=True
            )
        ]
        links = tuple(segment.name for segment in self.robot.segments)
        return Motion.of_rows(t_ns, rows, limbs=limbs, links=links, reasons=(*REASONS, *UNKNOWN[1:]))

    def _row(self, stop: Stop, horizon_s: float, people: Obstacles) -> MotionRow:
        """The row of a tick with known joints: those at which its stop begins."""
        q, dq = stop.q[0], stop.dq[0]
        sight = observe(self.robot, RobotState(q, dq), people, self.settings.plan.clearance_m)
        return _without_numbers(self.robot.nv, REASONS[sight.reason])._replace(
            q=q,
            dq=dq,
            tcp_m=sight.pose.T_world_tcp[:3, 3],
            tcp_speed=sight.pose.tcp_speed,
            horizon_s=horizon_s,
            tau_s=stop.ticks * self.settings.dt_s,
            **nearest_of(sight),
        )


#: Reason for which the distance from the volumes is not known where the record has no joints.
NO_JOINTS = "no joints are recorded"


@dataclass(frozen=True)
class RecordedCapsuleMotion:
    """Gives the motion of a robot that is recorded by its capsules: the TCP alone, the end of the last capsule."""

    robot: RobotModel  #: the robot of the settings, which is another one
    capsules: RecordedCapsules
    static: None = None  #: it is not measured against objects
    chosen: bool = False  #: it is never the run's method

    def follow(self, t_ns: Ints, _outlook: Outlook, limbs: tuple[str, ...]) -> Motion:
        """The recorded motion at a batch of ticks; without joints there are no stops, so no distance from volumes.

        Args:
            t_ns: (n,) ticks [ns].
            _outlook: Not used.
            limbs: Names of all possible volumes.
        """
        sample = self.capsules.sample(t_ns)
        speed = np.linalg.norm(sample.velocity[:, -1, 1], axis=1).tolist()
        rows = [
            _without_numbers(self.robot.nv, UNKNOWN[reason] or NO_JOINTS)._replace(tcp_m=tcp_m, tcp_speed=tcp_speed)
            for reason, tcp_m, tcp_speed in zip(sample.reason.tolist(), sample.ends_m[:, -1, 1], speed, strict=True)
        ]
        reasons = ("", *UNKNOWN[1:], NO_JOINTS)
        return Motion.of_rows(t_ns, rows, limbs=limbs, links=self.capsules.names, reasons=reasons)


def _without_numbers(axes: int, reason: str) -> MotionRow:
    """The row of a tick without any number."""
    joints, point = np.full(axes, math.nan), np.full(3, math.nan)
    return MotionRow(
        q=joints,
        dq=joints,
        u=joints,
        ref_m=point,
        tcp_m=point,
        tcp_speed=math.nan,
        ref_speed=math.nan,
        programme_s=math.nan,
        distance_m=math.nan,
        overlap_m=math.nan,
        limb=-1,
        link=-1,
        status=-1,
        reason=reason,
        horizon_s=math.nan,
        tau_s=math.nan,
        certified=False,
    )
