"""Whether a motion keeps clear of the swept volumes from its first instant to its last. The only user of coal.

By conservative advancement (Mirtich, 1996): between two positions of the axes no point of a link moves by more than the
sum over the axes of its largest distance from the axis times the angle the axis turns. Where the link is further than
that from a volume, the motion between is clear. The distance at a position is bounded from below by a plane between
link and volume, found by coal; one pass over the vertices proves it, wherever the plane came from. Nothing is shared
with the distances of the rows of Eq. (66i), so that a fault in them is no fault here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import coal
import numpy as np
from numba import njit

from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.control.stopping import Stop
from hrcreplay.robot.model import RobotModel

#: Distance that a motion must keep beyond what it needs: more than all rounding on the way [m].
MARGIN_M = 1e-9

#: coal searches a polytope of up to this many points one by one, so it needs no hull's edges, and points in a plane,
#: on a line or all in one are as good as any.
MOST_POINTS = 32

#: A plane is as good as it gets when it proves all but this of the distance that coal found [m].
ENOUGH_M = 1e-3

_PLACE = coal.Transform3s()
_NO_FACE = coal.StdVec_Triangle()
_NO_FACE.append(coal.Triangle(0, 0, 0))  # a polytope must have one; the search over points does not look at it


@dataclass
class Certifier:
    """Certifies the motions of one robot; remembers the planes of the tick before, which seldom turn by much."""

    robot: RobotModel
    clearance_m: float  #: beyond limb radius + link radius [m]
    dt_s: float  #: length of a tick [s]
    measured: int = 0  #: distances that coal has measured so far
    _normals: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)), repr=False)

    def __post_init__(self) -> None:
        self._radius_m = np.array([segment.radius_m for segment in self.robot.segments])

    def clear(self, state_q: Floats, state_dq: Floats, stop: Stop, obstacles: Obstacles) -> bool:
        """Whether a step and the stop after it keep every link clear of every volume at all times.

        Args:
            state_q: (nv,) where the step begins [rad].
            state_dq: (nv,) velocity there [rad/s].
            stop: From the end of the step on.
            obstacles: The swept volumes, valid until the stop has ended.

        Returns:
            False as well where a number is not finite, a limit of an axis would be passed, or coal finds no distance.
        """
        if not obstacles.known:
            return False
        q, dq = np.vstack((state_q, stop.q)), np.vstack((state_dq, stop.dq))
        last = stop.q[-1]
        if not (np.isfinite(q.sum() + dq.sum()) and np.all((self.robot.q_min <= last) & (last <= self.robot.q_max))):
            return False
        travel = _travel(np.abs(dq), self.robot.axis_reach_m, self.dt_s)
        ends = self.robot.ends_m(state_q)
        shape = (len(self._radius_m), len(obstacles.radius_m))
        if self._normals.shape[:2] != shape:
            self._normals = np.zeros((*shape, 3))
        keep_m = self._radius_m[:, None] + obstacles.radius_m + (self.clearance_m + MARGIN_M)
        far = travel[-1][:, None] + keep_m
        open_ = _undecided(ends, obstacles.vertices_m, obstacles.offsets, obstacles.boxes_m, self._normals, far)
        return all(
            self._pair(int(link), int(limb), q, travel[:, link], keep_m[link, limb], obstacles) for link, limb in open_
        )

    def _pair(self, link: int, limb: int, q: Floats, travel: Floats, keep_m: float, obstacles: Obstacles) -> bool:
        """Conservative advancement of one link towards one limb."""
        vertices = obstacles.vertices_m[obstacles.offsets[limb] : obstacles.offsets[limb + 1]]
        row, last = 0, len(q) - 1
        while True:
            a, b = self.robot.ends_m(q[row])[link]
            gap = _gap(a, b, self._normals[link, limb], vertices) - keep_m
            if gap <= travel[last] - travel[row]:  # the plane of before does not do
                self.measured += 1
                normal = separating_normal(a, b, vertices)
                if normal is None:
                    return False
                self._normals[link, limb] = normal
                gap = _gap(a, b, normal, vertices) - keep_m
            if not gap > 0.0:
                return False
            if row == last or gap > travel[last] - travel[row]:
                return True
            there = int(np.searchsorted(travel, travel[row] + gap, side="left")) - 1
            if there <= row:
                return False
            row = there


@njit(cache=True)
def _travel(speed: Floats, reach: Floats, dt_s: float) -> Floats:
    """(n, s) how far a point of each link can have moved until each row of a motion [m].

    Within a tick an axis does not turn by more than the larger of the speeds at its ends allows.

    Args:
        speed: (n, nv) of the axes [rad/s].
        reach: (nv, s) largest distance of each link from each axis [m].
        dt_s: Length of a tick [s].
    """
    travel = np.zeros((len(speed), reach.shape[1]))
    for i in range(1, len(speed)):
        for s in range(reach.shape[1]):
            way = 0.0
            for j in range(speed.shape[1]):
                way += max(speed[i - 1, j], speed[i, j]) * reach[j, s]
            travel[i, s] = travel[i - 1, s] + dt_s * way
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
        if not above > 0.0 or not abs(normal @ normal - 1.0) < 1e-6:
            return best if above > 0.0 else None
        normal = normal / math.sqrt(normal @ normal)
        along = vertices_m @ normal
        furthest = int(np.argmin(along))
        below = along[furthest] - max(a @ normal, b @ normal)
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
