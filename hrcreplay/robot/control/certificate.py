"""Certificate that a motion keeps clear of the swept volumes at every instant, and the decision based on it.

The certificate uses conservative advancement (Mirtich, 1996). Between two positions of the axes, a point of a link
moves by at most the sum over the axes of its largest distance from the axis times the angle that the axis turns. If the
distance between link and volume is larger, the motion between the two positions is clear. A plane between link and
volume bounds the distance from below, and one pass over the vertices proves the bound of any plane. The plane is that
of the previous tick, else that of the search for the distance (``geometry.distances``), else coal's. The proof shares
no code with these searches: an error in them can only refuse a motion.

By induction from standstill, no link touches the person while the robot moves, under two conditions: the robot does
not retreat, and the person stays inside the volumes of each tick until their horizon, the end of the stop that follows.

A robot inside a volume may retreat. The link may already touch the person when a retreating step begins, so the step is
not clear of the person. Instead the certificate proves that no point of the link comes nearer to any point of the
volume and that the link moves slowly. A link at rest that touches a person therefore only moves away.

The objects of the cell and the robot's own links are checked in the same way: an object is a hull that stands, and of
two links one is the hull. No link enters an object or another link, from standstill clear of them, by induction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import coal
import numpy as np

from hrcreplay.geometry.small_matrices import apply
from hrcreplay.geometry.vectors import dot_n, norm_n
from hrcreplay.records import Floats
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
    Taken,
)
from hrcreplay.robot.control.motion_check import (
    CLEAR,
    FEW,
    MARGIN_M,
    OPEN,
    OPENING,
    REFUSED,
    TOO_CLOSE,
    Course,
    Unproven,
    check,
    kept,
    leaves,
    plane_gap,
    proven,
    travel_of,
)
from hrcreplay.robot.control.separation import Obstacles, no_obstacles
from hrcreplay.robot.control.static_obstacles import StaticObstacles, StaticShapes, shapes_of
from hrcreplay.robot.control.stops import Stop, at_rest
from hrcreplay.robot.kinematics import Chain, ends_at
from hrcreplay.robot.model import RobotModel

#: Up to this many points coal searches a polytope point by point. Then it needs no edges of the hull, and the points
#: may lie in a plane, on a line or in one place.
MOST_POINTS = 32

#: The search for a plane ends when the plane proves the distance that coal found up to this difference [m].
ENOUGH_M = 1e-3

_PLACE = coal.Transform3s()
_NO_FACE = coal.StdVec_Triangle()
_NO_FACE.append(coal.Triangle(0, 0, 0))  # coal requires a face; the search over points does not use it


#: Planes between links and limbs before the first tick.
NO_PLANES: Floats = np.zeros((0, 0, 3))


def clear(
    robot: RobotModel,
    current_stop: Stop,
    stop: Stop,
    obstacles: Obstacles,
    clearance_m: float,
    dt_s: float,
    planes: Floats,
    retreat_m: float = 0.0,
    static: StaticObstacles | None = None,
) -> tuple[int, Floats]:
    """Checks that a step and the stop after it keep every link clear of every volume at all times.

    A link that begins inside a volume may move if no point of the link comes nearer to any point of the volume. This
    holds for every position of the person inside the volume. Objects and other links are always kept off.

    Args:
        robot: The manipulator.
        current_stop: The current stop; the step begins at its row 0.
        stop: The stop that begins at the end of the step.
        obstacles: The swept volumes, valid until the stop has ended.
        clearance_m: Clearance beyond limb radius + link radius [m].
        dt_s: Length of a tick [s].
        planes: (s, l + o, 3) directions from link to limb and to object of the previous tick, which are good initial
            values; or NO_PLANES.
        retreat_m: Largest depth inside a volume from which a link may move out of it [m].
        static: Objects of the cell and pairs of links that are kept apart; None: there are none.

    Returns:
        The verdict and the planes for the next tick. The verdict is also REFUSED if a number is not finite, the stop
        leaves the range of an axis, an axis jumps, or coal finds no distance.
    """
    if not obstacles.known:
        return REFUSED, planes
    shapes = shapes_of(robot, static)
    hulls = obstacles.vertices_m, obstacles.offsets, obstacles.radius_m, obstacles.boxes_m
    rows = current_stop.q, current_stop.dq, stop.q, stop.dq
    done, course, planes, people, beside = check(robot.arm, *rows, *hulls, clearance_m, dt_s, planes, shapes)
    if not done:
        return REFUSED, planes
    verdict = CLEAR
    if len(people.pairs):
        keep_m = kept(robot.arm, obstacles.radius_m, clearance_m)
        verdict = _clear_of_people(robot, course, obstacles, keep_m, planes, retreat_m, people)
    if verdict != REFUSED and len(beside.pairs) and not _clear_of_static(robot, course, shapes, planes, beside, dt_s):
        verdict = REFUSED
    return verdict, planes


def _clear_of_people(
    robot: RobotModel,
    course: Course,
    obstacles: Obstacles,
    keep_m: Floats,
    planes: Floats,
    retreat_m: float,
    unproven: Unproven,
) -> int:
    """The verdict of `clear` on the pairs of links and limbs that are not proven without coal; writes to ``planes``."""
    verdict, chain = CLEAR, robot.arm.chain
    for (link, limb), result in zip(unproven.pairs.tolist(), unproven.results.tolist(), strict=True):
        vertices = obstacles.vertices_m[obstacles.offsets[limb] : obstacles.offsets[limb + 1]]
        travel, plane, keep = course.travel[link], planes[link, limb], float(keep_m[link, limb])
        if result == OPEN and _keeps_off(chain, course, link, vertices, travel, keep, plane):
            continue
        if not leaves(chain, course, link, vertices, plane, keep, retreat_m):
            return REFUSED
        verdict = OPENING
    return verdict


def _clear_of_static(
    robot: RobotModel, course: Course, static: StaticShapes, planes: Floats, unproven: Unproven, dt_s: float
) -> bool:
    """Checks the objects and pairs of links that are not proven without coal; writes to ``planes``."""
    if np.any(unproven.results == TOO_CLOSE):
        return False
    limbs, chain = planes.shape[1] - static.keep.shape[1], robot.arm.chain
    apart = travel_of(course.q, course.dq, static.pair_reach, dt_s)
    for one, hull in unproven.pairs.tolist():
        if hull < 0:
            link, other = static.pairs[one].tolist()
            keep_m = float(static.pair_keep[one]) + MARGIN_M
            if not _keeps_off(chain, course, link, other, apart[one], keep_m, np.zeros(3)):
                return False
            continue
        vertices, keep_m = static.vertices[static.offsets[hull] : static.offsets[hull + 1]], static.keep[one, hull]
        plane = planes[one, limbs + hull]
        if not _keeps_off(chain, course, one, vertices, course.travel[one], float(keep_m) + MARGIN_M, plane):
            return False
    return True


def _keeps_off(
    chain: Chain, course: Course, link: int, other: Floats | int, travel: Floats, keep_m: float, plane: Floats
) -> bool:
    """Checks one link against a limb, an object or another link by conservative advancement, with planes of coal.

    Args:
        chain: The robot.
        course: The motion.
        link: Index of the link.
        other: (m, 3) vertices of the limb or object [m], or the index of the other link.
        travel: (n,) result of `travel_of` for the link, relative to the other [m].
        keep_m: Distance to keep [m].
        plane: (3,) initial direction from the link to the other; the last one is written to it.
    """
    row, last = 0, len(travel) - 1
    while True:
        ends = ends_at(chain, course.q[row])
        a, b = ends[link]
        vertices = ends[other] if isinstance(other, int) else other
        there = proven(travel, row, plane_gap(a, b, plane, vertices) - keep_m)
        if there < min(row + FEW, last):  # the previous plane proves too few rows
            normal = separating_normal(a, b, vertices)
            if normal is None:
                return False
            plane[:] = normal
            there = proven(travel, row, plane_gap(a, b, plane, vertices) - keep_m)
        if there == last:
            return True
        if there <= row:
            return False
        row = there


def compile_second_tries(robot: RobotModel) -> None:
    """Compiles `clear` and what it calls where ``check`` leaves a pair unproven, so that no session compiles them."""
    rest, nobody = at_rest(np.zeros(robot.nv)), no_obstacles()
    clear(robot, rest, rest, nobody, 0.0, 1.0, NO_PLANES)
    kept(robot.arm, nobody.radius_m, 0.0)
    q, far = np.zeros((2, robot.nv)), np.full((1, 3), 100.0)
    course = Course(q, q, np.empty((0, 0, 2, 3)), travel_of(q, q, robot.axis_reach_m, 1.0))
    if len(robot.segments):
        _keeps_off(robot.arm.chain, course, 0, far, course.travel[0], 0.0, np.zeros(3))
        leaves(robot.arm.chain, course._replace(ends=robot.ends_m(q[0])[None]), 0, far, np.zeros(3), 0.0, 1.0)


def separating_normal(a: Floats, b: Floats, vertices_m: Floats) -> Floats | None:
    """Direction along which a segment and the convex hull of points are furthest apart, by coal's GJK.

    coal measures the distance to a few of the vertices. While another vertex is nearer along the direction found, it is
    added to them.

    Args:
        a: (3,) end of the segment [m].
        b: (3,) other end [m].
        vertices_m: (m, 3) [m].

    Returns:
        (3,) unit vector; None in penetration or if coal finds no direction.
    """
    segment = _polytope(np.stack((a, b)))
    chosen = [int(np.argmin(((vertices_m - 0.5 * (a + b)) ** 2).sum(axis=1)))]
    best, most = None, -math.inf
    for _ in range(len(vertices_m) + MOST_POINTS):
        try:
            above, normal = _gjk(segment, _polytope(vertices_m[chosen]))
        except (RuntimeError, ValueError):
            return best
        if not above > 0.0 or not abs(dot_n(normal, normal) - 1.0) < 1e-6:
            return best if above > 0.0 else None
        normal = normal / norm_n(normal)
        along = apply(vertices_m, normal)
        furthest = int(np.argmin(along))
        below = along[furthest] - max(dot_n(a, normal), dot_n(b, normal))
        if below > most:
            best, most = normal, below
        if above - below <= ENOUGH_M * min(1.0, above) or furthest in chosen:
            return best
        if len(chosen) == MOST_POINTS:  # the nearest point does not depend on points far from the plane
            order = np.argsort(along[chosen], kind="stable")[: MOST_POINTS // 2]
            chosen = [chosen[i] for i in order]
        chosen.append(furthest)
    return best


def _polytope(points: Floats) -> coal.Convex:
    vector = coal.StdVec_Vec3s()
    for point in points:
        vector.append(point)
    return coal.Convex(vector, _NO_FACE)


def _gjk(segment: coal.Convex, hull: coal.Convex) -> tuple[float, Floats]:
    request = coal.DistanceRequest()
    request.enable_signed_distance = False
    request.gjk_tolerance = 1e-10
    result = coal.DistanceResult()
    distance = coal.distance(segment, _PLACE, hull, _PLACE, request, result)
    return distance, np.asarray(result.normal)


def decide(
    robot: RobotModel,
    current_stop: Stop,
    proposals: Sequence[Proposal] | int,
    obstacles: Obstacles,
    horizon_s: float,
    planes: Floats,
    settings: PlanSettings,
    static: StaticObstacles | None = None,
) -> tuple[Taken, Floats]:
    """Takes the first certified proposal, or continues the current stop.

    Args:
        robot: The manipulator.
        current_stop: The stop that continues if no proposal is certified; its row 0 is the present state of the robot.
        proposals: The proposals of the method, best first; or the reason why there is none.
        obstacles: The swept volumes of the tick.
        horizon_s: Time from the tick on for which the volumes are valid [s].
        planes: (s, l + o, 3) planes of the previous tick between links and limbs, then objects.
        settings: Settings of the method.
        static: Objects of the cell and pairs of links; None: there are none.

    Returns:
        The executed motion, and the planes for the next tick.
    """
    certify, reason = settings.certified, proposals if isinstance(proposals, int) else NOT_CERTIFIED
    for stop, status in () if isinstance(proposals, int) else proposals:
        if not certify:
            return Taken(stop, status, 0, not stop.ticks and not current_stop.ticks), planes
        if (stop.ticks + 1) * settings.dt_s > horizon_s + 1e-9:
            continue
        plan, dt_s, retreat_m = settings.plan, settings.dt_s, settings.retreat_m
        verdict, planes = clear(robot, current_stop, stop, obstacles, plan.clearance_m, dt_s, planes, retreat_m, static)
        if verdict == CLEAR:
            return Taken(stop, status, 0, certified=True), planes
        if verdict == OPENING and (stop.ticks or current_stop.ticks):
            return Taken(stop, RETREATING, 0, certified=True), planes
        reason = INSIDE if verdict == OPENING else reason
    held = not current_stop.ticks and reason not in (NO_HUMAN, NOT_FINITE)
    status = LIMITED if held else BRAKING
    return Taken(current_stop.rest(), status, reason, certify or not current_stop.ticks), planes
