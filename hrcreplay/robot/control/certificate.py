"""Certificate that a motion keeps clear of the swept volumes at every instant, and the decision by it.

By conservative advancement (Mirtich, 1996): between two positions of the axes no point of a link moves by more than the
sum over the axes of its largest distance from the axis times the angle the axis turns. Where the link is further than
that from a volume, the motion between is clear. The distance at a position is bounded from below by a plane between
link and volume, found by coal; one pass over the vertices proves it, wherever the plane came from. Nothing is shared
with the distances of the rows of Eq. (66i), so that a fault in them is no fault here.

By induction from standstill no link touches the person while the robot moves, as long as it does not retreat and the
person stays inside the volumes of each tick until their horizon, the end of the stop that would follow.

A robot that a volume has reached may retreat. A retreating step begins inside a volume, so that the link may touch the
person already: it is not clear of them. What is certified is that no point of the link comes nearer to any point of the
volume, and slowly, so that who touched it at rest is let go.
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
from hrcreplay.robot.model import RobotModel

#: Rounding that moving away allows for [m^2/s].
AWAY = 1e-9

#: Distance that a motion must keep beyond what it needs: more than all rounding on the way [m].
MARGIN_M = 1e-9

#: coal searches a polytope of up to this many points one by one, so it needs no hull's edges, and points in a plane,
#: on a line or all in one are as good as any.
MOST_POINTS = 32

#: What an axis may turn beyond its velocities at the ends of a tick [rad], and share of its acceleration limit that it
#: may need: a path bends within a tick.
LEAP_RAD, LEAP = 1e-4, 1.05

#: Rows of a motion that a plane must prove at a time, lest coal be asked for a better one.
FEW = 4

#: A plane is as good as it gets when it proves all but this of the distance that coal found [m].
ENOUGH_M = 1e-3

_PLACE = coal.Transform3s()
_NO_FACE = coal.StdVec_Triangle()
_NO_FACE.append(coal.Triangle(0, 0, 0))  # a polytope must have one; the search over points does not look at it


#: Planes between links and limbs before any was found.
NO_PLANES: Floats = np.zeros((0, 0, 3))


#: What `clear` finds: not certified; clear of every volume; away from those that a link is inside of, and clear of all
#: others.
REFUSED, CLEAR, OPENING = range(3)

#: Speed at which a robot may leave a volume that it is inside of: the reduced speed of ISO 10218 [m/s].
RETREAT_SPEED = 0.25


def clear(
    robot: RobotModel,
    current_stop: Stop,
    stop: Stop,
    obstacles: Obstacles,
    clearance_m: float,
    dt_s: float,
    planes: Floats,
    retreat_m: float = 0.0,
) -> tuple[int, Floats]:
    """Check that a step and the stop after it keep every link clear of every volume at all times.

    A link that begins inside a volume may move if no point of it comes nearer to any point of the volume, wherever the
    person is inside it.

    Args:
        robot: The manipulator.
        current_stop: Its row 0 is where the step begins.
        stop: From the end of the step on.
        obstacles: The swept volumes, valid until the stop has ended.
        clearance_m: Beyond limb radius + link radius [m].
        dt_s: Length of a tick [s].
        planes: (s, l, 3) directions from link to limb of the tick before, which seldom turn by much; or NO_PLANES.
        retreat_m: A link that begins inside a volume by no more than this may move out of it [m].

    Returns:
        The verdict, REFUSED as well where a number is not finite, the stop would leave the range of an axis, an axis
        would have to leap, or coal finds no distance; and the planes for the next tick.
    """
    q, dq = np.vstack((current_stop.q[:1], stop.q)), np.vstack((current_stop.dq[:1], stop.dq))
    last = stop.q[-1]
    within = np.all((robot.q_min <= last) & (last <= robot.q_max))
    if not (obstacles.known and within and _can_be_done(q, dq, robot.ddq_max * dt_s, dt_s)):
        return REFUSED, planes
    radius = np.array([segment.radius_m for segment in robot.segments])
    keep_m = radius[:, None] + obstacles.radius_m + (clearance_m + MARGIN_M)
    if planes.shape[:2] != keep_m.shape:
        planes = np.zeros((*keep_m.shape, 3))
    travel = _travel(q, dq, robot.axis_reach_m, dt_s)
    far, hulls = travel[-1][:, None] + keep_m, (obstacles.vertices_m, obstacles.offsets)
    ends = _Ends(robot, q)
    undecided = _undecided(ends.at(0), *hulls, obstacles.boxes_m, planes, far)
    if len(undecided):
        planes = planes.copy()
    verdict, motion = CLEAR, None
    for link, limb in undecided.tolist():
        vertices = obstacles.vertices_m[obstacles.offsets[limb] : obstacles.offsets[limb + 1]]
        if _keeps_off(ends, link, travel[:, link], vertices, keep_m[link, limb], planes[link, limb]):
            continue
        a, b = ends.at(0)[link]
        gap = _gap(a, b, planes[link, limb], vertices) - keep_m[link, limb]
        if not -retreat_m < gap <= 0.0:
            return REFUSED, planes
        motion = robot.link_motion(q, dq) if motion is None else motion
        if not _moves_away(motion.ends_m[:, link], motion.twist[:, link], vertices):
            return REFUSED, planes
        verdict = OPENING
    return verdict, planes


@njit(cache=True)
def _moves_away(ends: Floats, twist: Floats, vertices: Floats) -> bool:
    """Check that no point of a link's axis comes nearer to a point of a hull at any tick of a motion, and none is fast.

    (r - p) @ v <= 0 for a point p of the axis with velocity v and every vertex r; it is linear along the axis, Eq.
    (11), and in r, so the ends and the vertices speak for all. Between two ticks the link moves by 1 mm at most.

    Args:
        ends: (n, 2, 3) of the link's axis at each tick [m].
        twist: (n, 6) as of `LinkMotion` [m/s, rad/s].
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


def _keeps_off(ends: _Ends, link: int, travel: Floats, vertices: Floats, keep_m: float, plane: Floats) -> bool:
    """Conservative advancement of one link towards one limb; writes the last plane between them.

    Args:
        ends: Of the links at each row of the motion.
        link: Which one.
        travel: (n,) of `_travel` [m].
        vertices: (m, 3) of the limb [m].
        keep_m: Distance to keep [m].
        plane: (3,) to begin with.
    """
    row, last = 0, len(travel) - 1
    while True:
        a, b = ends.at(row)[link]
        there = _proven(travel, row, _gap(a, b, plane, vertices) - keep_m)
        if there < min(row + FEW, last):  # the plane of before proves little
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


class _Ends:
    """Ends of the links along a motion, each row computed when it is first asked for."""

    def __init__(self, robot: RobotModel, q: Floats) -> None:
        self._robot, self._q = robot, q
        self._rows: dict[int, Floats] = {}

    def at(self, row: int) -> Floats:
        """(s, 2, 3) at a row of the motion [m]."""
        if row not in self._rows:
            self._rows[row] = self._robot.ends_m(self._q[row])
        return self._rows[row]


@njit(cache=True)
def _proven(travel: Floats, row: int, gap: float) -> int:
    """The last row before which a link cannot have bridged a gap that it has at a row; -1 where there is no gap."""
    there = row if gap > 0.0 else -1
    while 0 <= there < len(travel) - 1 and travel[there + 1] - travel[row] < gap:
        there += 1
    return there


@njit(cache=True)
def _can_be_done(q: Floats, dq: Floats, gain: Floats, dt_s: float) -> bool:
    """Check that no axis leaps from a row of a motion to the next; false where a number is not finite.

    Args:
        q: (n, nv) [rad].
        dq: (n, nv) [rad/s].
        gain: (nv,) change of velocity that an axis manages in a tick [rad/s].
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
    """(n, s) how far a point of each link can have moved until each row of a motion [m].

    Within a tick an axis does not turn by more than the larger of the speeds at its ends allows.

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
    """(n, 2) pairs of link and limb that neither their boxes nor their planes show to be further apart than ``far``."""
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
def _gap(a: Floats, b: Floats, normal: Floats, vertices: Floats) -> float:
    """Lower bound of the distance between a segment and the hull of points: the gap across a direction [m].

    Args:
        a: (3,) end of the segment [m].
        b: (3,) other end [m].
        normal: (3,) unit vector from the segment towards the hull; zero bounds nothing.
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
    """Direction from a segment to the convex hull of points across which they are furthest apart, by coal's GJK.

    coal measures the distance to few of the vertices. While another one lies nearer across the direction found, it
    joins in.

    Args:
        a: (3,) end of the segment [m].
        b: (3,) other end [m].
        vertices_m: (m, 3) [m].

    Returns:
        (3,) unit vector; None in penetration and where coal finds no direction.
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
        if len(chosen) == MOST_POINTS:  # those far from the plane do not carry the nearest point
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
) -> tuple[Taken, Floats]:
    """Takes a proposal that is certified, or goes on with the stop.

    Args:
        robot: The manipulator.
        current_stop: The stop that goes on where nothing else is taken; its row 0 is where the robot is.
        proposals: The proposals of the method, the one it would like best first; or the reason why there is none.
        obstacles: The swept volumes of the tick.
        horizon_s: Until when they hold [s].
        planes: (s, l, 3) planes between links and limbs, of the tick before.
        settings: Of the method.

    Returns:
        What is executed, and the planes for the next tick.
    """
    certify, reason = settings.certified, proposals if isinstance(proposals, int) else NOT_CERTIFIED
    for stop, status in () if isinstance(proposals, int) else proposals:
        if not certify:
            return Taken(stop, status, 0, not stop.ticks and not current_stop.ticks), planes
        if (stop.ticks + 1) * settings.dt_s > horizon_s + 1e-9:
            continue
        clearance_m, dt_s = settings.plan.clearance_m, settings.dt_s
        verdict, planes = clear(robot, current_stop, stop, obstacles, clearance_m, dt_s, planes, settings.retreat_m)
        if verdict == CLEAR:
            return Taken(stop, status, 0, certified=True), planes
        if verdict == OPENING and (stop.ticks or current_stop.ticks):
            return Taken(stop, RETREATING, 0, certified=True), planes
        reason = INSIDE if verdict == OPENING else reason
    held = not current_stop.ticks and reason not in (NO_HUMAN, NOT_FINITE)
    status = LIMITED if held else BRAKING
    return Taken(current_stop.rest(), status, reason, certify or not current_stop.ticks), planes
