"""One tick of ``qp`` in one kernel: from the people's volumes to the certified step.

A call of a kernel from Python converts every array, which takes as long as much of the work of a tick. So the kernels
of a tick are called by one kernel here. It gives the numbers of those kernels, bit by bit, and leaves to Python what a
tick rarely needs: a problem that ``row_search`` does not solve, and a motion about which coal is asked.
"""

from __future__ import annotations

from typing import NamedTuple

from hrcreplay.geometry.vectors import norm_n
from hrcreplay.kernels import Held, njit
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control.control_step import (
    INSIDE,
    LIMITED,
    NOT_CERTIFIED,
    RETREATING,
    TRACKING,
    Taken,
    TickRules,
    go_on,
    look,
    reason_to_stand,
)
from hrcreplay.robot.control.motion_check import CLEAR, OPENING, RETREAT_SPEED, UNDECIDED, judge
from hrcreplay.robot.control.qp_controller import Instant, Stops, Target, propose_stops, static_ahead_s
from hrcreplay.robot.control.separation import Gap, NearestLink, gap_of
from hrcreplay.robot.control.static_obstacles import StaticShapes
from hrcreplay.robot.control.stops import Stop
from hrcreplay.robot.kinematics import Arm, RobotPose
from hrcreplay.robot.task import Grid, ReferencePoint, follow


class TickStart(NamedTuple):
    """Robot and reference when the tick begins."""

    stop: Stop  #: the current stop; row 0 is the state of the robot
    u_before: Floats  #: (nv,) acceleration of the previous tick [rad/s^2]
    s_s: float  #: programmed time of the reference [s]
    T_world_ref: Floats  #: (4, 4) the reference at that time
    planes: Floats  #: (s, l + o, 3) planes of the previous tick, as in ``certificate.clear``


class TickHulls(NamedTuple):
    """The swept volumes of a tick, as in ``separation.Obstacles``."""

    vertices: Floats  #: (m, 3) of all limbs [m]
    offsets: Ints  #: (l + 1,) index of each limb's first vertex
    radius: Floats  #: (l,) of the limbs' balls [m]
    boxes: Floats  #: (l, 2, 3) boxes around the limbs' vertices [m]
    known: bool  #: whether all limbs are known
    horizon_s: float  #: time from the tick on for which they are valid [s]


class QpTick(NamedTuple):
    """What the kernel found in a tick."""

    pose: RobotPose  #: at the tick
    finite: bool  #: whether the pose is
    nearest: NearestLink
    reason: int  #: index into ``REASONS`` of the reason why no step is sought; 0 if there is none
    s_s: float  #: programmed time of the reference at the next tick [s]
    rate: float  #: of the reference
    point: ReferencePoint  #: the reference at the next tick
    tcp_speed_max: float  #: speed limit of the TCP on the way to it [m/s]
    solved: bool  #: whether ``row_search`` proves the minimiser of Eq. (66)
    decided: bool  #: False: Python decides
    taken: Taken  #: the motion that the robot executes, if it is decided
    planes: Floats  #: for the next tick, if it is decided


@njit(cache=True)
def decide_at_once(
    arm: Arm, grid: Grid, rules: TickRules, static: StaticShapes, moment: TickStart, people: TickHulls
) -> QpTick:
    """Observes the people, moves the reference, solves Eq. (66) and certifies the first step.

    Args:
        arm: The manipulator.
        grid: The programmed path.
        rules: Weights and limits.
        static: Objects of the cell and pairs of links.
        moment: Robot and reference when the tick begins.
        people: Their volumes.
    """
    stop, dt_s, hulls = moment.stop, rules.qp.dt_s, (people.vertices, people.offsets)
    q, dq = stop.q[0], stop.dq[0]
    pose, finite, nearest = look(arm, q, dq, *hulls, people.radius, people.known, rules.clearance_m)
    s_s, rate, point, cap = follow(grid, arm.chain, moment.s_s, moment.T_world_ref, pose.T_world_tcp, dt_s, rules.waits)
    reason = reason_to_stand(finite, people.known, nearest, rules.certified, rules.retreat_m)
    solved, decided = False, reason != 0
    taken, planes = go_on(stop, reason, rules.certified), moment.planes
    if not reason:
        retreats = 0.0 < -nearest.surface_m < rules.retreat_m
        speed_max = min(rules.tcp_speed_max, RETREAT_SPEED) if retreats else rules.tcp_speed_max
        target = Target(point.T_world_tcp, rate * point.twist, point.q, cap)
        ahead_s = people.horizon_s + rules.lead_s, static_ahead_s(people.horizon_s, rules.qp.smooth_s)
        now = Instant(q, dq, moment.u_before, target, pose, nearest.pairs, *hulls, people.boxes, *ahead_s, speed_max)
        solved, held, stops = propose_stops(arm, rules.qp, now, static)
        if solved and rules.certified:
            decided, taken, planes = _decide(arm, rules, stop, stops, held, people, planes, static)
    return QpTick(pose, finite, nearest, reason, s_s, rate, point, cap, solved, decided, taken, planes)


class BriefTick(NamedTuple):
    """What Python needs of a tick: each array more would cost it half a microsecond."""

    tcp_m: Floats  #: (3,) at the tick, world [m]
    tcp_speed: float  #: [m/s]
    gap: Gap  #: the limb by its place among the tick's volumes
    s_s: float  #: as in ``QpTick``, like what follows
    rate: float
    point: ReferencePoint
    tcp_speed_max: float
    solved: bool
    decided: bool
    taken: Taken
    u: Floats  #: (nv,) acceleration of the tick, if it is decided [rad/s^2]
    planes: Floats


@njit(cache=True)
def decide_held(scene: Held, moment: TickStart, people: TickHulls) -> BriefTick:
    """The same for calls from Python, which would convert the scene's arrays each time.

    Args:
        scene: Arm, programmed path, rules and objects.
        moment: Robot and reference when the tick begins.
        people: Their volumes.
    """
    arm, grid, rules, static = scene.value
    found = decide_at_once(arm, grid, rules, static, moment, people)
    tcp_m, tcp_speed, taken = found.pose.T_world_tcp[:3, 3].copy(), norm_n(found.pose.twist_tcp[:3]), found.taken
    u = (taken.stop.dq[0] - moment.stop.dq[0]) / rules.qp.dt_s
    reference = found.s_s, found.rate, found.point, found.tcp_speed_max
    gap, outcome = gap_of(found.nearest), (found.solved, found.decided)
    return BriefTick(tcp_m, tcp_speed, gap, *reference, *outcome, taken, u, found.planes)


@njit(cache=True, inner=True)
def _decide(
    arm: Arm,
    rules: TickRules,
    now: Stop,
    stops: Stops,
    held: bool,
    people: TickHulls,
    planes: Floats,
    static: StaticShapes,
) -> tuple[bool, Taken, Floats]:
    """What ``certificate.decide`` takes of the stops after a solution, as far as it does not ask coal.

    Args:
        arm: The manipulator.
        rules: Limits.
        now: The current stop.
        stops: The stops after the solution.
        held: Whether a row of people or objects holds it.
        people: Their volumes.
        planes: Planes of the previous tick.
        static: Objects of the cell and pairs of links.

    Returns:
        Whether it is decided, the motion, and the planes for the next tick.
    """
    reason, dt_s, hulls = NOT_CERTIFIED, rules.qp.dt_s, (people.vertices, people.offsets, people.radius, people.boxes)
    for which in range(2):
        q, dq, along = stops.straight if which == 0 else stops.axis_by_axis
        if len(q) * dt_s > people.horizon_s + 1e-9:
            continue
        after, limits = Stop(q, dq, along), (rules.clearance_m, dt_s)
        verdict, planes = judge(arm, now, after, *hulls, *limits, planes, rules.retreat_m, static)
        if verdict == UNDECIDED:
            return False, go_on(now, reason, True), planes
        if verdict == CLEAR:
            return True, Taken(after, LIMITED if held else TRACKING, 0, True), planes
        if verdict == OPENING:
            if len(q) > 1 or len(now.q) > 1:
                return True, Taken(after, RETREATING, 0, True), planes
            reason = INSIDE
    return True, go_on(now, reason, True), planes
