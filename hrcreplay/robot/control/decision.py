"""What is executed: a proposed step where it is certified, else the stop that was certified before.

By induction from standstill: as long as the person stays inside the volumes of each tick until their horizon, no link
touches the person while the robot moves, whatever the method proposes. The horizon of a tick is the end of the stop
that would follow (``PlanSettings.horizon_s``), so a stop under way was certified with volumes that still hold. A robot
that a volume has reached may retreat (``plan.retreat_m``): then no point of a link comes nearer to any point of it, so
that a person who touched the robot at rest is let go.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hrcreplay.records import Floats
from hrcreplay.robot.control.certificate import CLEAR, OPENING, clear
from hrcreplay.robot.control.control_step import (
    BRAKING,
    INSIDE,
    LIMITED,
    NO_HUMAN,
    NOT_CERTIFIED,
    NOT_FINITE,
    RETREATING,
    PlanSettings,
    Proposal,
    RobotState,
    Sight,
    Step,
    Stop,
)
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.model import RobotModel


class Taken(NamedTuple):
    """What is executed in a tick."""

    stop: Stop  #: from the end of the step on; its row 0 is where the step leads
    status: int  #: index into ``records.STATUSES``
    reason: int  #: index into ``control_step.REASONS``
    certified: bool  #: whether step and stop were found clear of volumes that still hold


def stands(sight: Sight, settings: PlanSettings) -> int:
    """Why nothing is proposed at all: people are not known, or the robot is inside a volume; 0 where neither is so.

    Args:
        sight: The robot's distances from people.
        settings: Of the method.
    """
    if sight.reason:
        return sight.reason
    return INSIDE if settings.certified and sight.overlap_m >= settings.retreat_m and sight.distance_m <= 0.0 else 0


def decide(
    robot: RobotModel,
    going: Stop,
    wanted: Sequence[Proposal] | int,
    around: Obstacles,
    horizon_s: float,
    planes: Floats,
    settings: PlanSettings,
) -> tuple[Taken, Floats]:
    """Takes a proposal that is certified, or goes on with the stop.

    Args:
        robot: The manipulator.
        going: The stop that goes on where nothing else is taken; its row 0 is where the robot is.
        wanted: The proposals of the method, the one it would like best first; or the reason why there is none.
        around: The swept volumes of the tick.
        horizon_s: Until when they hold [s].
        planes: (s, l, 3) planes between links and limbs, of the tick before.
        settings: Of the method.

    Returns:
        What is executed, and the planes for the next tick.
    """
    certify, inside = settings.certified, False
    if not isinstance(wanted, int):
        for stop, status in wanted:
            if not certify:
                return Taken(stop, status, 0, not stop.ticks and not going.ticks), planes
            if (stop.ticks + 1) * settings.dt_s > horizon_s + 1e-9:
                continue
            verdict, planes = clear(
                robot, going, stop, around, settings.plan.clearance_m, settings.dt_s, planes, settings.retreat_m
            )
            if verdict == CLEAR:
                return Taken(stop, status, 0, certified=True), planes
            if verdict == OPENING and (stop.ticks or going.ticks):
                return Taken(stop, RETREATING, 0, certified=True), planes
            inside = inside or verdict == OPENING
        wanted = INSIDE if inside else NOT_CERTIFIED
    held = not going.ticks and wanted not in (NO_HUMAN, NOT_FINITE)
    return Taken(going.rest(), LIMITED if held else BRAKING, wanted, certify or not going.ticks), planes


def made(sight: Sight, going: Stop, taken: Taken, horizon_s: float, dt_s: float) -> Step:
    """The record of a tick.

    Args:
        sight: What was seen at the tick.
        going: Its row 0 is where the robot is.
        taken: What is executed.
        horizon_s: Until when the volumes of the tick hold [s].
        dt_s: Length of a tick [s].
    """
    after = RobotState(taken.stop.q[0], taken.stop.dq[0])
    return Step(
        pose=sight.pose,
        u=np.asarray((after.dq - going.dq[0]) / dt_s),
        next=after,
        distance_m=sight.distance_m,
        limb=sight.limb,
        link=sight.link,
        status=taken.status,
        reason=taken.reason,
        horizon_s=horizon_s,
        tau_s=going.ticks * dt_s,
        certified=taken.certified,
        stop=taken.stop,
    )
