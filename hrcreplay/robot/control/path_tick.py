"""One tick of a method that stays on the path in one kernel, as ``qp_tick`` is one of ``qp``.

It gives the numbers of ``PathController``, bit by bit, and leaves to Python what is not certified without coal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control.control_step import (
    LIMITED,
    NO_SOLUTION,
    NOT_CERTIFIED,
    NOT_FINITE,
    TRACKING,
    Taken,
    TickRules,
    finite_pose,
    go_on,
    look,
    reason_to_stand,
)
from hrcreplay.robot.control.motion_check import CLEAR, REFUSED, UNDECIDED, judge
from hrcreplay.robot.control.path_controller import RateBounds, propose_rows
from hrcreplay.robot.control.qp_tick import TickHulls, TickStart
from hrcreplay.robot.control.separation import NearestLink, Separation
from hrcreplay.robot.control.static_obstacles import StaticShapes
from hrcreplay.robot.control.stops import Stop
from hrcreplay.robot.kinematics import Arm, RobotPose
from hrcreplay.robot.task import Grid


class PathTick(NamedTuple):
    """What the kernel found in a tick."""

    pose: RobotPose  #: at the tick
    nearest: NearestLink
    decided: bool  #: False: Python decides
    taken: Taken  #: the motion that the robot executes, if it is decided
    planes: Floats  #: for the next tick, if it is decided


@njit(cache=True, inner=True)
def decide_on_path(
    arm: Arm,
    grid: Grid,
    rules: TickRules,
    by_rows: bool,
    static: StaticShapes,
    start: TickStart,
    people: TickHulls,
) -> PathTick:
    """Observes the people, finds the largest rate along the path and certifies the step.

    Args:
        arm: The manipulator.
        grid: The programmed path.
        rules: Limits.
        by_rows: Whether the rows of Eq. (66i) bound the rate.
        static: Objects of the cell and pairs of links.
        start: Robot when the tick begins, on its path; the reference in it is not used.
        people: Their volumes.
    """
    now, planes, clearance_m, dt_s = start.stop, start.planes, rules.clearance_m, rules.qp.dt_s
    hulls = people.vertices, people.offsets
    pose, finite, nearest = look(arm, now.q[0], now.dq[0], *hulls, people.radius, people.known, clearance_m)
    reason = reason_to_stand(finite, people.known, nearest, rules.certified, rules.retreat_m)
    if reason:
        return PathTick(pose, nearest, True, go_on(now, reason, rules.certified), planes)
    pairs = nearest.pairs if by_rows else Separation(np.empty((0, 0)), np.empty((0, 0)))
    count = len(people.radius) if by_rows else 0
    beside = people.vertices, people.offsets[: count + 1], people.boxes[:count], pairs
    found, taken = _go_along(arm, grid, rules, now, pose, beside, people.horizon_s)
    if not found or not rules.certified:
        return PathTick(pose, nearest, True, taken, planes)
    verdict = REFUSED
    if len(taken.stop.q) * dt_s <= people.horizon_s + 1e-9:
        around = *hulls, people.radius, people.boxes, clearance_m, dt_s
        verdict, planes = judge(arm, now, taken.stop, *around, planes, 0.0, static)
    taken = Taken(taken.stop, taken.status, 0, True) if verdict == CLEAR else go_on(now, NOT_CERTIFIED, True)
    return PathTick(pose, nearest, verdict != UNDECIDED, taken, planes)


@njit(cache=True, inner=True)
def go_blindly(arm: Arm, grid: Grid, rules: TickRules, now: Stop) -> tuple[RobotPose, Taken]:
    """The step along the path of a robot that ignores people; nothing certifies it.

    Args:
        arm: The manipulator.
        grid: The programmed path.
        rules: Limits.
        now: The current stop, on the path; its row 0 is the state of the robot.
    """
    pose, finite = finite_pose(arm, now.q[0], now.dq[0])
    if not finite:
        return pose, go_on(now, NOT_FINITE, rules.certified)
    none = np.empty((0, 0))
    nobody = np.empty((0, 3)), np.zeros(1, np.int64), np.empty((0, 2, 3)), Separation(none, none)
    return pose, _go_along(arm, grid, rules, now, pose, nobody, 0.0)[1]


@njit(cache=True, inner=True)
def _go_along(
    arm: Arm,
    grid: Grid,
    rules: TickRules,
    now: Stop,
    pose: RobotPose,
    beside: tuple[Floats, Ints, Floats, Separation],
    horizon_s: float,
) -> tuple[bool, Taken]:
    """The step with the largest rate, which nothing has certified; without one the stop that continues, and False.

    Args:
        arm: The manipulator.
        grid: The programmed path.
        rules: Limits.
        now: The current stop; its row 0 is the state of the robot.
        pose: The robot's pose.
        beside: Volumes whose rows bound the rate: vertices, index of each one's first, boxes and distances of pairs.
        horizon_s: Time from the tick on for which they are valid [s].
    """
    slowest, limits = now.along[min(1, len(now.along) - 1), 1], (arm.dq_max, arm.ddq_max)
    bounds = RateBounds(*beside, np.full(len(arm.radius_m), np.inf))
    given = grid, now.along[0], slowest, pose, limits, bounds, horizon_s, rules.path
    found, slowed, q, dq, along = propose_rows(*given)
    if not found:
        return False, go_on(now, NO_SOLUTION, rules.certified)
    return True, Taken(Stop(q, dq, along), LIMITED if slowed else TRACKING, 0, len(q) == 1 and len(now.q) == 1)
