"""The check that a motion keeps clear of hulls at every instant, in kernels; see ``certificate`` for what it proves.

What it does not prove, ``certificate`` may prove with planes of coal.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.distances import Carriers, carriers, segment_distance, separating_plane
from hrcreplay.geometry.vectors import dot3, norm_n
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control.static_obstacles import StaticShapes
from hrcreplay.robot.control.stops import Stop
from hrcreplay.robot.kinematics import Arm, Chain, ends_at, motion_of_links

#: Rounding tolerance of the check that a link moves away [m^2/s].
AWAY = 1e-9

#: Additional distance that a motion must keep; larger than the sum of all rounding errors [m].
MARGIN_M = 1e-9

#: Tolerances because a path bends within a tick: additional angle of an axis beyond its velocities at the ends of the
#: tick [rad], and largest share of its acceleration limit.
LEAP_RAD, LEAP = 1e-4, 1.05

#: If a plane proves fewer rows of a motion than this, coal searches a better plane.
FEW = 4

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
    keep = kept(arm, radius, clearance_m)
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
    verdict, keep = CLEAR, kept(arm, radius, clearance_m)
    for i in range(len(near.pairs)):
        link, limb = near.pairs[i]
        hull = vertices[offsets[limb] : offsets[limb + 1]]
        if near.results[i] == OPEN:
            return UNDECIDED, planes
        if not leaves(arm.chain, course, link, hull, planes[link, limb], keep[link, limb], retreat_m):
            return REFUSED, planes
        verdict = OPENING
    if len(beside.pairs):
        verdict = REFUSED if (beside.results == TOO_CLOSE).any() else UNDECIDED
    return verdict, planes


@njit(cache=True)
def kept(arm: Arm, radius: Floats, clearance_m: float) -> Floats:
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
        there, high = proven(travel, row, plane_gap(ends[0], ends[1], plane, hull) - keep), np.inf
        if there < min(row + FEW, last):  # the previous plane proves too few rows
            _, high = separating_plane(ends, hull, 0, len(hull), work, plane)
            _make_unit(plane)
            there = proven(travel, row, plane_gap(ends[0], ends[1], plane, hull) - keep)
        if there == last:
            return KEEPS
        if there <= row:
            return OPEN if proven(travel, row, high - keep) > row else TOO_CLOSE
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
            there = proven(travel[p], row, low - keep[p])
            if there <= row:
                break
            row = there
        if there < last:
            left[n, 0], results[n] = p, OPEN if proven(travel[p], row, high - keep[p]) > row else TOO_CLOSE
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
    return plane_gap(first[0], first[1], normal, second), high


@njit(cache=True, inner=True)
def _make_unit(normal: Floats) -> None:
    """Scales a direction (3,) to length 1, so that ``_gap`` is a bound; a zero vector proves nothing and stays."""
    length = norm_n(normal)
    if length > 0.0:
        for c in range(3):
            normal[c] /= length


@njit(cache=True)
def leaves(chain: Chain, course: Course, link: int, hull: Floats, plane: Floats, keep: float, retreat_m: float) -> bool:
    """Whether a link begins inside a volume, not too deep, and moves away from every point of it.

    Args:
        chain: The robot.
        course: The motion.
        link: Index of the link.
        hull: (m, 3) vertices of the volume [m].
        plane: (3,) direction from the link to the volume.
        keep: Distance to keep [m].
        retreat_m: Largest depth inside a volume from which a link may move out of it [m].
    """
    gap = plane_gap(course.ends[0, link, 0], course.ends[0, link, 1], plane, hull) - keep
    if not -retreat_m < gap <= 0.0:
        return False
    ends, twists = motion_of_links(chain, course.q, course.dq)
    return _moves_away(ends[:, link], twists[:, link], hull)


@njit(cache=True, inner=True)
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


@njit(cache=True)
def proven(travel: Floats, row: int, gap: float) -> int:
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
            if plane_gap(ends[s, 0], ends[s, 1], plane, hull) > far[s, k]:
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
def plane_gap(a: Floats, b: Floats, normal: Floats, vertices: Floats) -> float:
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
