"""One tick of a method that stays on the path in one kernel, as ``qp_tick`` is one of ``qp``.

It gives the numbers of ``PathController``, bit by bit, and leaves to Python what is not certified without coal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hrcreplay.kernels import njit
from hrcreplay.records import Floats
from hrcreplay.robot.control.certificate import TOO_CLOSE, Unproven, check
from hrcreplay.robot.control.control_step import (
    BRAKING,
    LIMITED,
    NO_HUMAN,
    NO_SOLUTION,
    NOT_CERTIFIED,
    NOT_FINITE,
    TRACKING,
    TickRules,
    look,
    reason_to_stand,
)
from hrcreplay.robot.control.path_controller import RateBounds, propose_rows
from hrcreplay.robot.control.qp_tick import TickHulls, TickStart
from hrcreplay.robot.control.separation import NearestLink, Separation
from hrcreplay.robot.control.static_obstacles import StaticShapes
from hrcreplay.robot.kinematics import Arm, RobotPose
from hrcreplay.robot.task import Grid


class Rows(NamedTuple):
    """The rows of a ``Stop``."""

    q: Floats  #: (n + 1, nv) [rad]
    dq: Floats  #: (n + 1, nv) [rad/s]
    along: Floats  #: (n + 1, 2) programmed time [s] and rate


class Decision(NamedTuple):
    """The motion that a robot executes in a tick; see ``Taken``."""

    rows: Rows  #: the stop after the step; row 0 is the end of the step
    status: int  #: index into ``records.STATUSES``
    reason: int  #: index into ``REASONS``
    certified: bool  #: whether step and stop are clear of volumes that are still valid


class PathTick(NamedTuple):
    """What the kernel found in a tick."""

    pose: RobotPose  #: at the tick
    nearest: NearestLink
    decided: bool  #: False: the tick is left to Python
    decision: Decision
    planes: Floats  #: for the next tick


@njit(cache=True, inner=True)
def go_on(now: Rows, reason: int, certified: bool) -> Decision:
    """The stop that continues where no step is taken, as in ``certificate.decide``.

    Args:
        now: The current stop; row 0 is the state of the robot.
        reason: Why, index into ``REASONS``.
        certified: Whether a step must be certified.
    """
    rests = len(now.q) == 1
    status = LIMITED if rests and reason not in (NO_HUMAN, NOT_FINITE) else BRAKING
    rows = now if rests else Rows(now.q[1:], now.dq[1:], now.along[1:])
    return Decision(rows, status, reason, certified or rests)


@njit(cache=True, inner=True)
def decide_on_path(
    arm: Arm,
    grid: Grid,
    rules: TickRules,
    heeds: tuple[bool, bool],
    static: StaticShapes,
    start: TickStart,
    along: Floats,
    people: TickHulls,
) -> PathTick:
    """Observes the people, finds the largest rate along the path and certifies the step.

    Args:
        arm: The manipulator.
        grid: The programmed path.
        rules: Limits.
        heeds: Whether people matter, and whether the rows of Eq. (66i) bound the rate.
        static: Objects of the cell and pairs of links.
        start: Robot when the tick begins; the reference in it is not used.
        along: (m, 2) programmed time [s] and rate of the rows of the current stop.
        people: Their volumes.
    """
    now, clearance_m, dt_s = Rows(start.stop_q, start.stop_dq, along), rules.clearance_m, rules.qp.dt_s
    hulls = people.vertices, people.offsets
    pose, finite, nearest = look(arm, now.q[0], now.dq[0], *hulls, people.radius, people.known, clearance_m)
    careful, by_rows = heeds
    reason = 0 if finite else NOT_FINITE
    if careful:
        reason = reason_to_stand(finite, people.known, nearest, rules.certified, rules.retreat_m)
    if reason:
        return PathTick(pose, nearest, True, go_on(now, reason, rules.certified), start.planes)
    links = len(arm.radius_m)
    pairs = nearest.pairs if by_rows else Separation(np.empty((0, 0)), np.empty((0, 0)))
    count = len(people.radius) if by_rows else 0
    bounds = RateBounds(
        people.vertices, people.offsets[: count + 1], people.boxes[:count], pairs, np.full(links, np.inf)
    )
    slowest, limits = along[min(1, len(along) - 1), 1], (arm.dq_max, arm.ddq_max)
    found, slowed, q, dq, then = propose_rows(
        grid, along[0], slowest, pose, limits, bounds, people.horizon_s, rules.path
    )
    if not found:
        return PathTick(pose, nearest, True, go_on(now, NO_SOLUTION, rules.certified), start.planes)
    status, rests = LIMITED if slowed else TRACKING, len(q) == 1 and len(now.q) == 1
    if not rules.certified:
        return PathTick(pose, nearest, True, Decision(Rows(q, dq, then), status, 0, rests), start.planes)
    if len(q) * dt_s > people.horizon_s + 1e-9:
        return PathTick(pose, nearest, True, go_on(now, NOT_CERTIFIED, True), start.planes)
    rows = now.q, now.dq, q, dq
    done, _, planes, near, beside = check(
        arm, *rows, *hulls, people.radius, people.boxes, clearance_m, dt_s, start.planes, static
    )
    if done and not len(near.pairs) and not len(beside.pairs):
        return PathTick(pose, nearest, True, Decision(Rows(q, dq, then), status, 0, True), planes)
    refused = not done or _is_refused(near, beside)
    return PathTick(pose, nearest, refused, go_on(now, NOT_CERTIFIED, True), planes)


@njit(cache=True, inner=True)
def _is_refused(near: Unproven, beside: Unproven) -> bool:
    """Whether ``certificate.clear`` refuses a motion before it asks coal, for a method that does not retreat."""
    if len(near.results):
        return bool(near.results[0] == TOO_CLOSE)
    return bool((beside.results == TOO_CLOSE).any())
