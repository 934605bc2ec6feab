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
from typing import NamedTuple

import coal
import numpy as np

from hrcreplay.geometry.distances import Carriers, carriers, segment_distance, separating_plane
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
    at_rest,
)
from hrcreplay.robot.control.separation import Obstacles, no_obstacles
from hrcreplay.robot.control.static_obstacles import StaticObstacles, StaticShapes, no_shapes
from hrcreplay.robot.kinematics import Arm, Chain, ends_at, motion_of_links
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
#: clear of all others. `judge` may also find none, as coal must be asked.
REFUSED, CLEAR, OPENING, UNDECIDED = range(4)

#: Speed limit of a robot that moves out of a volume: the reduced speed of ISO 10218 [m/s].
RETREAT_SPEED = 0.25


class Course(NamedTuple):
    """A step and the stop after it, row by row."""

    q: Floats  #: (n, nv) [rad]
    dq: Floats  #: (n, nv) [rad/s]
    ends: Floats  #: (n, s, 2, 3) ends of the links; NaN until a row is needed [m]
    travel: Floats  #: (s, n) upper bound of the travel of a point of each link until each row [m]


#: Results of the check of a pair without coal: it keeps clear; it certainly does not, because it is too near;
#: it is not proven.
KEEPS, TOO_CLOSE, OPEN = range(3)


class Unproven(NamedTuple):
    """Pairs of a motion that are not proven to keep clear."""

    pairs: Ints  #: (n, 2) link and limb or object, or index of the pair of links and -1
    results: Ints  #: (n,) TOO_CLOSE or OPEN


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
    shapes = no_shapes(len(robot.segments), robot.nv) if static is None else static.shapes
    hulls = obstacles.vertices_m, obstacles.offsets, obstacles.radius_m, obstacles.boxes_m
    rows = current_stop.q, current_stop.dq, stop.q, stop.dq
    done, course, planes, people, beside = check(robot.arm, *rows, *hulls, clearance_m, dt_s, planes, shapes)
    if not done:
        return REFUSED, planes
    verdict = CLEAR
    if len(people.pairs):
        keep_m = _kept(robot.arm, obstacles.radius_m, clearance_m)
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
    verdict, motion = CLEAR, None
    for (link, limb), result in zip(unproven.pairs.tolist(), unproven.results.tolist(), strict=True):
        vertices = obstacles.vertices_m[obstacles.offsets[limb] : obstacles.offsets[limb + 1]]
        travel, plane, keep = course.travel[link], planes[link, limb], float(keep_m[link, limb])
        if result == OPEN and _keeps_off(robot.arm.chain, course, link, vertices, travel, keep, plane):
            continue
        a, b = course.ends[0, link]
        gap = _gap(a, b, plane, vertices) - keep
        if not -retreat_m < gap <= 0.0:
            return REFUSED
        motion = robot.link_motion(course.q, course.dq) if motion is None else motion
        if not _moves_away(motion.ends_m[:, link], motion.twist[:, link], vertices):
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


@njit(cache=True)
def check(
    arm: Arm,
    q_now: Floats,
    dq_now: Floats,
    q_stop: Floats,
    dq_stop: Floats,
    vertices: Floats,
    offsets: Ints,
    radius: Floats,
    boxes: Floats,
    clearance_m: float,
    dt_s: float,
    planes: Floats,
    static: StaticShapes,
) -> tuple[bool, Course, Floats, Unproven, Unproven]:
    """Checks a motion without coal.

    Args:
        arm: The manipulator.
        q_now: (m, nv) rows of the current stop; the step begins at row 0 [rad].
        dq_now: (m, nv) [rad/s].
        q_stop: (n, nv) rows of the stop that begins at the end of the step [rad].
        dq_stop: (n, nv) [rad/s].
        vertices: (v, 3) of all limbs [m].
        offsets: (l + 1,) index of each limb's first vertex.
        radius: (l,) of the limbs' balls [m].
        boxes: (l, 2, 3) boxes around the limbs' vertices [m].
        clearance_m: Clearance beyond limb radius + link radius [m].
        dt_s: Length of a tick [s].
        planes: Planes of the previous tick, as in ``clear``.
        static: Objects of the cell and pairs of links.

    Returns:
        False if a number is not finite, or the motion cannot be done or ends outside the range of an axis; the motion;
        the planes for the next tick; the unproven pairs of links and limbs; and those of links and objects, then pairs
        of links.
    """
    q, dq = np.concatenate((q_now[:1], q_stop)), np.concatenate((dq_now[:1], dq_stop))
    links, limbs, objects = len(arm.radius_m), len(radius), static.keep.shape[1]
    remembered = planes.shape[0] == links and planes.shape[1] == limbs + objects
    planes = planes.copy() if remembered else np.zeros((links, limbs + objects, 3))
    course = Course(q, dq, np.full((len(q), links, 2, 3), np.nan), travel_of(q, dq, arm.axis_reach_m, dt_s))
    within = bool(np.all((arm.q_min <= q[-1]) & (q[-1] <= arm.q_max)))
    known = math.isfinite(vertices.sum() + boxes.sum() + radius.sum())
    if not (within and known and _can_be_done(q, dq, arm.ddq_max * dt_s, dt_s)):
        none = Unproven(np.empty((0, 2), np.int64), np.empty(0, np.int64))
        return False, course, planes, none, none
    course.ends[0] = ends_at(arm.chain, q[0])
    keep = _kept(arm, radius, clearance_m)
    people = _check_hulls(arm.chain, course, vertices, offsets, boxes, keep, planes, 0)
    hulls = static.vertices, static.offsets, static.boxes
    beside = _check_hulls(arm.chain, course, *hulls, static.keep + MARGIN_M, planes, limbs)
    between = _check_links(arm.chain, course, static, travel_of(q, dq, static.pair_reach, dt_s))
    both = Unproven(np.concatenate((beside.pairs, between.pairs)), np.concatenate((beside.results, between.results)))
    return True, course, planes, people, both


@njit(cache=True, inner=True)
def judge(
    arm: Arm,
    now: Stop,
    after: Stop,
    vertices: Floats,
    offsets: Ints,
    radius: Floats,
    boxes: Floats,
    clearance_m: float,
    dt_s: float,
    planes: Floats,
    retreat_m: float,
    static: StaticShapes,
) -> tuple[int, Floats]:
    """The verdict of `clear` and the planes for the next tick, for kernels; UNDECIDED where coal must be asked.

    Args:
        arm: The manipulator.
        now: The current stop; the step begins at its row 0.
        after: The stop that begins at the end of the step.
        vertices: (v, 3) of all limbs [m].
        offsets: (l + 1,) index of each limb's first vertex.
        radius: (l,) of the limbs' balls [m].
        boxes: (l, 2, 3) boxes around the limbs' vertices [m].
        clearance_m: Clearance beyond limb radius + link radius [m].
        dt_s: Length of a tick [s].
        planes: Planes of the previous tick, as in ``clear``.
        retreat_m: Largest depth inside a volume from which a link may move out of it [m].
        static: Objects of the cell and pairs of links.
    """
    rows = now.q, now.dq, after.q, after.dq
    done, course, planes, near, beside = check(
        arm, *rows, vertices, offsets, radius, boxes, clearance_m, dt_s, planes, static
    )
    if not done:
        return REFUSED, planes
    verdict, keep = CLEAR, _kept(arm, radius, clearance_m)
    for i in range(len(near.pairs)):
        link, limb = near.pairs[i]
        hull = vertices[offsets[limb] : offsets[limb + 1]]
        if near.results[i] == OPEN:
            return UNDECIDED, planes
        gap = _gap(course.ends[0, link, 0], course.ends[0, link, 1], planes[link, limb], hull) - keep[link, limb]
        if not -retreat_m < gap <= 0.0:
            return REFUSED, planes
        ends, twists = motion_of_links(arm.chain, course.q, course.dq)
        if not _moves_away(ends[:, link], twists[:, link], hull):
            return REFUSED, planes
        verdict = OPENING
    if len(beside.pairs):
        verdict = REFUSED if (beside.results == TOO_CLOSE).any() else UNDECIDED
    return verdict, planes


@njit(cache=True)
def _kept(arm: Arm, radius: Floats, clearance_m: float) -> Floats:
    """(s, l) distance to keep between the axis of a link and a limb's hull [m]."""
    keep = np.empty((len(arm.radius_m), len(radius)))
    for s in range(len(arm.radius_m)):
        for k in range(len(radius)):
            keep[s, k] = arm.radius_m[s] + radius[k] + (clearance_m + MARGIN_M)
    return keep


@njit(cache=True, inner=True)
def _check_hulls(
    chain: Chain,
    course: Course,
    vertices: Floats,
    offsets: Ints,
    boxes: Floats,
    keep: Floats,
    planes: Floats,
    first: int,
) -> Unproven:
    """Pairs of links and hulls that are not proven to keep clear; writes the planes found to ``planes``.

    Args:
        chain: The robot.
        course: The motion; the ends of the links are added where they are needed.
        vertices: (m, 3) of all hulls [m].
        offsets: (l + 1,) index of each hull's first vertex.
        boxes: (l, 2, 3) boxes around the hulls' vertices [m].
        keep: (s, l) distance to keep [m].
        planes: (s, >= first + l, 3) initial directions from link to hull.
        first: Place of the first hull in ``planes``.
    """
    far, work = course.travel[:, -1].copy().reshape(-1, 1) + keep, carriers()
    pairs = _undecided(course.ends[0], vertices, offsets, boxes, planes, first, far)
    left, results, n = np.empty_like(pairs), np.empty(len(pairs), np.int64), 0
    for s, k in pairs:
        hull = vertices[offsets[k] : offsets[k + 1]]
        result = _advance(chain, course, s, hull, keep[s, k], planes[s, first + k], work)
        if result != KEEPS:
            left[n, 0], left[n, 1], results[n] = s, k, result
            n += 1
    return Unproven(left[:n], results[:n])


@njit(cache=True, inner=True)
def _advance(chain: Chain, course: Course, link: int, hull: Floats, keep: float, plane: Floats, work: Carriers) -> int:
    """Checks one link against a hull by conservative advancement, with planes of ``separating_plane``.

    Args:
        chain: The robot.
        course: The motion; the ends of the links are added where they are needed.
        link: Index of the link.
        hull: (m, 3) [m].
        keep: Distance to keep [m].
        plane: (3,) initial direction from the link to the hull; the last one is written to it.
        work: Memory.
    """
    row, last, travel = 0, len(course.q) - 1, course.travel[link]
    while True:
        if math.isnan(course.ends[row, 0, 0, 0]):
            course.ends[row] = ends_at(chain, course.q[row])
        ends = course.ends[row, link]
        there, high = _proven(travel, row, _gap(ends[0], ends[1], plane, hull) - keep), np.inf
        if there < min(row + FEW, last):  # the previous plane proves too few rows
            _, high = separating_plane(ends, hull, 0, len(hull), work, plane)
            _make_unit(plane)
            there = _proven(travel, row, _gap(ends[0], ends[1], plane, hull) - keep)
        if there == last:
            return KEEPS
        if there <= row:
            return OPEN if _proven(travel, row, high - keep) > row else TOO_CLOSE
        row = there


@njit(cache=True, inner=True)
def _check_links(chain: Chain, course: Course, static: StaticShapes, travel: Floats) -> Unproven:
    """Pairs of links that are not proven to keep apart.

    A point of the outer link of a pair moves relative to the inner one only by the axes between them.

    Args:
        chain: The robot.
        course: The motion; the ends of the links are added where they are needed.
        static: The pairs of links.
        travel: (p, n) upper bound of the travel of the links of each pair against each other until each row [m].
    """
    keep, last = static.pair_keep + MARGIN_M, len(course.q) - 1
    undecided = _pairs_undecided(course.ends[0], static.pairs, travel[:, -1] + keep)
    left, results, n = np.full((len(undecided), 2), -1), np.empty(len(undecided), np.int64), 0
    for p in undecided:
        row, there, high = 0, 0, 0.0
        while there < last:
            if math.isnan(course.ends[row, 0, 0, 0]):
                course.ends[row] = ends_at(chain, course.q[row])
            low, high = _apart(course.ends[row, static.pairs[p, 0]], course.ends[row, static.pairs[p, 1]])
            there = _proven(travel[p], row, low - keep[p])
            if there <= row:
                break
            row = there
        if there < last:
            left[n, 0], results[n] = p, OPEN if _proven(travel[p], row, high - keep[p]) > row else TOO_CLOSE
            n += 1
    return Unproven(left[:n], results[:n])


@njit(cache=True, inner=True)
def _apart(first: Floats, second: Floats) -> tuple[float, float]:
    """Bounds of the distance between two segments (2, 3): the gap along the way between nearest points, its length."""
    high, share, other = segment_distance(first, second)
    normal = np.empty(3)
    for c in range(3):
        at = first[0, c] + share * (first[1, c] - first[0, c])
        normal[c] = second[0, c] + other * (second[1, c] - second[0, c]) - at
    _make_unit(normal)
    return _gap(first[0], first[1], normal, second), high


@njit(cache=True, inner=True)
def _make_unit(normal: Floats) -> None:
    """Scales a direction (3,) to length 1, so that ``_gap`` is a bound; a zero vector proves nothing and stays."""
    length = norm_n(normal)
    if length > 0.0:
        for c in range(3):
            normal[c] /= length


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


@njit(cache=True, inner=True)
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
def travel_of(q: Floats, dq: Floats, reach: Floats, dt_s: float) -> Floats:
    """(s, n) upper bound of the travel of a point of each link until each row of a motion [m].

    Within a tick an axis turns by at most the larger of its speeds at the ends of the tick times the tick's length.

    Args:
        q: (n, nv) [rad].
        dq: (n, nv) [rad/s].
        reach: (nv, s) largest distance of each link from each axis [m].
        dt_s: Length of a tick [s].
    """
    travel = np.zeros((reach.shape[1], len(q)))
    for i in range(1, len(q)):
        for j in range(q.shape[1]):
            turned = max(abs(q[i, j] - q[i - 1, j]), dt_s * max(abs(dq[i - 1, j]), abs(dq[i, j])))
            for s in range(reach.shape[1]):
                travel[s, i] += turned * reach[j, s]
        for s in range(reach.shape[1]):
            travel[s, i] += travel[s, i - 1]
    return travel


@njit(cache=True, inner=True)
def _undecided(
    ends: Floats, vertices: Floats, offsets: Ints, boxes: Floats, planes: Floats, first: int, far: Floats
) -> Ints:
    """(n, 2) pairs of link and hull whose boxes and planes do not prove a distance larger than ``far``."""
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
            plane, hull = planes[s, first + k], vertices[offsets[k] : offsets[k + 1]]
            if _gap(ends[s, 0], ends[s, 1], plane, hull) > far[s, k]:
                continue
            pairs[n, 0], pairs[n, 1] = s, k
            n += 1
    return pairs[:n]


@njit(cache=True, inner=True)
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


def compile_second_tries(robot: RobotModel) -> None:
    """Compiles `clear` and what it calls where ``check`` leaves a pair unproven, so that no session compiles them."""
    rest, nobody = at_rest(np.zeros(robot.nv)), no_obstacles()
    clear(robot, rest, rest, nobody, 0.0, 1.0, NO_PLANES)
    _kept(robot.arm, nobody.radius_m, 0.0)
    q, far = np.zeros((2, robot.nv)), np.full((1, 3), 100.0)
    course = Course(q, q, np.empty((0, 0, 2, 3)), travel_of(q, q, robot.axis_reach_m, 1.0))
    if len(robot.segments):
        _keeps_off(robot.arm.chain, course, 0, far, course.travel[0], 0.0, np.zeros(3))
        motion = robot.link_motion(q, q)
        _moves_away(motion.ends_m[:, 0], motion.twist[:, 0], far)


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
