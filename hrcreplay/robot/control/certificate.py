"""Certificate that a motion keeps clear of the swept volumes at every instant, and the decision based on it.

The certificate uses conservative advancement (Mirtich, 1996). Between two positions of the axes, a point of a link
moves by at most the sum over the axes of its largest distance from the axis times the angle that the axis turns. If the
distance between link and volume is larger, the motion between the two positions is clear. A plane between link and
volume bounds the distance from below. coal finds the plane, and one pass over the vertices proves the bound for any
plane. The certificate shares no code with the distances in the rows of Eq. (66i), so an error there does not affect it.

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
from hrcreplay.geometry.vectors import dot3, dot_n, norm_n
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints
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
    Stop,
    Taken,
)
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.control.static_obstacles import StaticObstacles
from hrcreplay.robot.model import RobotModel

#: Rounding tolerance of the check that a link moves away [m^2/s].
AWAY = 1e-9

#: Additional distance that a motion must keep; larger than the sum of all rounding errors [m].
MARGIN_M = 1e-9

#: Up to this many points coal searches a polytope point by point. Then it needs no edges of the hull, and the points
#: may lie in a plane, on a line or in one place.
MOST_POINTS = 32

#: Tolerances because a path bends within a tick: additional angle of an axis beyond its velocities at the ends of the
#: tick [rad], and largest share of its acceleration limit.
LEAP_RAD, LEAP = 1e-4, 1.05

#: If a plane proves fewer rows of a motion than this, coal searches a better plane.
FEW = 4

#: The search for a plane ends when the plane proves the distance that coal found up to this difference [m].
ENOUGH_M = 1e-3

_PLACE = coal.Transform3s()
_NO_FACE = coal.StdVec_Triangle()
_NO_FACE.append(coal.Triangle(0, 0, 0))  # coal requires a face; the search over points does not use it


#: Planes between links and limbs before the first tick.
NO_PLANES: Floats = np.zeros((0, 0, 3))


#: Verdicts of `clear`: not certified; clear of every volume; moving away from the volumes that a link is inside, and
#: clear of all others.
REFUSED, CLEAR, OPENING = range(3)

#: Speed limit of a robot that moves out of a volume: the reduced speed of ISO 10218 [m/s].
RETREAT_SPEED = 0.25


class _Course:
    """A step and the stop after it, row by row; the ends of the links are computed at their first use."""

    def __init__(self, robot: RobotModel, q: Floats, dq: Floats, dt_s: float) -> None:
        self.robot, self.q, self.dq, self.dt_s = robot, q, dq, dt_s
        self.radius_m = np.array([segment.radius_m for segment in robot.segments])
        self.travel = _travel(q, dq, robot.axis_reach_m, dt_s)  #: (n, s) upper bound of the travel until each row [m]
        self._rows: dict[int, Floats] = {}

    def ends(self, row: int) -> Floats:
        """(s, 2, 3) ends of the links at a row [m]."""
        if row not in self._rows:
            self._rows[row] = self.robot.ends_m(self.q[row])
        return self._rows[row]


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
    q, dq = np.vstack((current_stop.q[:1], stop.q)), np.vstack((current_stop.dq[:1], stop.dq))
    last = stop.q[-1]
    within = np.all((robot.q_min <= last) & (last <= robot.q_max))
    if not (obstacles.known and within and _can_be_done(q, dq, robot.ddq_max * dt_s, dt_s)):
        return REFUSED, planes
    course = _Course(robot, q, dq, dt_s)
    if static is None:
        return _clear_of_people(course, obstacles, clearance_m, planes, retreat_m)
    limbs, objects = len(obstacles.radius_m), len(static.radius_m)
    if planes.shape[:2] != (len(robot.segments), limbs + objects):
        planes = np.zeros((len(robot.segments), limbs + objects, 3))
    people, beside = (np.ascontiguousarray(part) for part in np.split(planes, [limbs], axis=1))
    verdict, people = _clear_of_people(course, obstacles, clearance_m, people, retreat_m)
    if verdict != REFUSED and not _clear_of_static(course, static, beside):
        verdict = REFUSED
    return verdict, np.concatenate((people, beside), axis=1)


def _clear_of_people(
    course: _Course, obstacles: Obstacles, clearance_m: float, planes: Floats, retreat_m: float
) -> tuple[int, Floats]:
    """The verdict of `clear` on the volumes of people, and the planes for the next tick."""
    keep_m = course.radius_m[:, None] + obstacles.radius_m + (clearance_m + MARGIN_M)
    if planes.shape[:2] != keep_m.shape:
        planes = np.zeros((*keep_m.shape, 3))
    far, hulls = course.travel[-1][:, None] + keep_m, (obstacles.vertices_m, obstacles.offsets)
    undecided = _undecided(course.ends(0), *hulls, obstacles.boxes_m, planes, far)
    if len(undecided):
        planes = planes.copy()
    verdict, motion = CLEAR, None
    for link, limb in undecided.tolist():
        vertices = obstacles.vertices_m[obstacles.offsets[limb] : obstacles.offsets[limb + 1]]
        if _keeps_off(course, link, vertices, course.travel[:, link], keep_m[link, limb], planes[link, limb]):
            continue
        a, b = course.ends(0)[link]
        gap = _gap(a, b, planes[link, limb], vertices) - keep_m[link, limb]
        if not -retreat_m < gap <= 0.0:
            return REFUSED, planes
        motion = course.robot.link_motion(course.q, course.dq) if motion is None else motion
        if not _moves_away(motion.ends_m[:, link], motion.twist[:, link], vertices):
            return REFUSED, planes
        verdict = OPENING
    return verdict, planes


def _clear_of_static(course: _Course, static: StaticObstacles, planes: Floats) -> bool:
    """Checks objects and pairs of links; writes the planes of objects for the next tick to ``planes``.

    A point of the outer link of a pair moves relative to the inner one only by the axes between them.
    """
    keep_m = static.keep_m + MARGIN_M
    far, hulls = course.travel[-1][:, None] + keep_m, (static.vertices_m, static.offsets)
    for link, hull in _undecided(course.ends(0), *hulls, static.boxes_m, planes, far).tolist():
        vertices = static.vertices_m[static.offsets[hull] : static.offsets[hull + 1]]
        if not _keeps_off(course, link, vertices, course.travel[:, link], keep_m[link, hull], planes[link, hull]):
            return False
    travel = _travel(course.q, course.dq, static.pair_reach_m, course.dt_s)
    pair_keep_m = static.pair_keep_m + MARGIN_M
    for pair in _pairs_undecided(course.ends(0), static.pairs, travel[-1] + pair_keep_m).tolist():
        link, other = static.pairs[pair].tolist()
        if not _keeps_off(course, link, other, travel[:, pair], pair_keep_m[pair], np.zeros(3)):
            return False
    return True


@njit(cache=True)
def _moves_away(ends: Floats, twist: Floats, vertices: Floats) -> bool:
    """Checks at every tick that no point of a link's axis comes nearer to a point of a hull, and that none is fast.

    The condition is (r - p) @ v <= 0 for a point p of the axis with velocity v and every vertex r. It is linear along
    the axis, Eq. (11), and in r, so the check of the ends and the vertices covers all points. Between two ticks the
    link moves by at most 1 mm.

    Args:
        ends: (n, 2, 3) ends of the link's axis at each tick [m].
        twist: (n, 6) as in `LinkMotion` [m/s, rad/s].
        vertices: (m, 3) [m].
    """
    for i in range(len(ends)):
        u, w = twist[i, :3], twist[i, 3:]
        for e in range(2):
            p = ends[i, e]
            v = np.array(
                [
                    u[0] + w[1] * p[2] - w[2] * p[1],
                    u[1] + w[2] * p[0] - w[0] * p[2],
                    u[2] + w[0] * p[1] - w[1] * p[0],
                ]
            )
            if not norm_n(v) <= RETREAT_SPEED:
                return False
            for j in range(len(vertices)):
                if not dot3(vertices[j] - p, v) <= AWAY:
                    return False
    return True


def _keeps_off(course: _Course, link: int, other: Floats | int, travel: Floats, keep_m: float, plane: Floats) -> bool:
    """Checks one link against a limb, an object or another link by conservative advancement.

    Args:
        course: The motion.
        link: Index of the link.
        other: (m, 3) vertices of the limb or object [m], or the index of the other link.
        travel: (n,) result of `_travel` for the link, relative to the other [m].
        keep_m: Distance to keep [m].
        plane: (3,) initial direction from the link to the other; the last one is written to it.
    """
    row, last = 0, len(travel) - 1
    while True:
        ends = course.ends(row)
        a, b = ends[link]
        vertices = ends[other] if isinstance(other, int) else other
        there = _proven(travel, row, _gap(a, b, plane, vertices) - keep_m)
        if there < min(row + FEW, last):  # the previous plane proves too few rows
            normal = separating_normal(a, b, vertices)
            if normal is None:
                return False
            plane[:] = normal
            there = _proven(travel, row, _gap(a, b, plane, vertices) - keep_m)
        if there == last:
            return True
        if there <= row:
            return False
        row = there


@njit(cache=True)
def _proven(travel: Floats, row: int, gap: float) -> int:
    """The last row up to which a link moves by less than its gap at ``row``; -1 if there is no gap."""
    there = row if gap > 0.0 else -1
    while 0 <= there < len(travel) - 1 and travel[there + 1] - travel[row] < gap:
        there += 1
    return there


@njit(cache=True)
def _can_be_done(q: Floats, dq: Floats, gain: Floats, dt_s: float) -> bool:
    """Checks that no axis jumps from a row of a motion to the next; false if a number is not finite.

    Args:
        q: (n, nv) [rad].
        dq: (n, nv) [rad/s].
        gain: (nv,) largest change of velocity of an axis in a tick [rad/s].
        dt_s: Length of a tick [s].
    """
    for i in range(1, len(q)):
        for j in range(q.shape[1]):
            turned, most = abs(q[i, j] - q[i - 1, j]), dt_s * max(abs(dq[i - 1, j]), abs(dq[i, j]))
            if not (turned <= most + LEAP_RAD and abs(dq[i, j] - dq[i - 1, j]) <= LEAP * gain[j]):
                return False
    return True


@njit(cache=True)
def _travel(q: Floats, dq: Floats, reach: Floats, dt_s: float) -> Floats:
    """(n, s) upper bound of the travel of a point of each link until each row of a motion [m].

    Within a tick an axis turns by at most the larger of its speeds at the ends of the tick times the tick's length.

    Args:
        q: (n, nv) [rad].
        dq: (n, nv) [rad/s].
        reach: (nv, s) largest distance of each link from each axis [m].
        dt_s: Length of a tick [s].
    """
    travel = np.zeros((len(q), reach.shape[1]))
    for i in range(1, len(q)):
        for j in range(q.shape[1]):
            turned = max(abs(q[i, j] - q[i - 1, j]), dt_s * max(abs(dq[i - 1, j]), abs(dq[i, j])))
            for s in range(reach.shape[1]):
                travel[i, s] += turned * reach[j, s]
        for s in range(reach.shape[1]):
            travel[i, s] += travel[i - 1, s]
    return travel


@njit(cache=True)
def _undecided(ends: Floats, vertices: Floats, offsets: Ints, boxes: Floats, normals: Floats, far: Floats) -> Ints:
    """(n, 2) pairs of link and limb whose boxes and planes do not prove a distance larger than ``far``."""
    links, limbs = far.shape
    pairs = np.empty((links * limbs, 2), np.int64)
    n = 0
    for s in range(links):
        for k in range(limbs):
            square = 0.0
            for c in range(3):
                low, high = min(ends[s, 0, c], ends[s, 1, c]), max(ends[s, 0, c], ends[s, 1, c])
                away = max(boxes[k, 0, c] - high, low - boxes[k, 1, c], 0.0)
                square += away * away
            if square > far[s, k] ** 2:
                continue
            if _gap(ends[s, 0], ends[s, 1], normals[s, k], vertices[offsets[k] : offsets[k + 1]]) > far[s, k]:
                continue
            pairs[n, 0], pairs[n, 1] = s, k
            n += 1
    return pairs[:n]


@njit(cache=True)
def _pairs_undecided(ends: Floats, pairs: Ints, far: Floats) -> Ints:
    """(n,) pairs of links whose balls around their middles do not prove a distance larger than ``far`` (p,) [m]."""
    found = np.empty(len(pairs), np.int64)
    n = 0
    for p in range(len(pairs)):
        apart, one, two = 0.0, 0.0, 0.0
        for c in range(3):
            a, b = ends[pairs[p, 0], :, c], ends[pairs[p, 1], :, c]
            apart += (0.5 * (a[0] + a[1] - b[0] - b[1])) ** 2
            one, two = one + (0.5 * (a[1] - a[0])) ** 2, two + (0.5 * (b[1] - b[0])) ** 2
        if not math.sqrt(apart) - math.sqrt(one) - math.sqrt(two) > far[p]:
            found[n] = p
            n += 1
    return found[:n]


@njit(cache=True)
def _gap(a: Floats, b: Floats, normal: Floats, vertices: Floats) -> float:
    """Lower bound of the distance between a segment and the hull of points: the gap along a direction [m].

    Args:
        a: (3,) end of the segment [m].
        b: (3,) other end [m].
        normal: (3,) unit vector from the segment towards the hull; a zero vector gives no bound.
        vertices: (m, 3) [m].
    """
    depth = np.inf
    for j in range(len(vertices)):
        along = normal[0] * vertices[j, 0] + normal[1] * vertices[j, 1] + normal[2] * vertices[j, 2]
        depth = min(depth, along)
    back = max(
        normal[0] * a[0] + normal[1] * a[1] + normal[2] * a[2],
        normal[0] * b[0] + normal[1] * b[1] + normal[2] * b[2],
    )
    return depth - back


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
