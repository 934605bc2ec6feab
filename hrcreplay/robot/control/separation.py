"""Distances between the robot's links and the swept volumes of one tick. The only module that imports coal.

The right-hand side of the safety constraints is corrected as docs/paper.md says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import coal
import numpy as np
from numba import njit

from hrcreplay.geometry.segment_hull_distance import EXACT_M, distances
from hrcreplay.records import Floats, Ints, SweptVolumes
from hrcreplay.robot.model import RobotPose


@dataclass(frozen=True, slots=True)
class Obstacles:
    """The swept volumes of one tick: per limb the convex hull of its vertices + a ball. Built once per tick."""

    vertices_m: Floats  #: (m, 3) world, limb after limb [m]
    offsets: Ints  #: (l + 1,) where each limb's vertices begin
    radius_m: Floats  #: (l,) of the balls [m]
    boxes_m: Floats  #: (l, 2, 3) lowest and highest corner around each limb's vertices [m]
    known: bool  #: False where a limb could not be predicted: whoever plans against it must brake


def obstacles(volumes: SweptVolumes, tick: int) -> Obstacles:
    """The obstacles of one tick.

    Args:
        volumes: Any number of ticks.
        tick: Row of ``volumes``.
    """
    limbs = len(volumes.limbs)
    offsets = volumes.offsets[tick * limbs : (tick + 1) * limbs + 1]
    vertices, radius = volumes.vertices_m[offsets[0] : offsets[-1]], volumes.radius_m[tick]
    offsets = offsets - offsets[0]
    boxes, known = _boxes(vertices, offsets, radius)
    return Obstacles(vertices, offsets, radius, boxes, known)


@njit(cache=True)
def _boxes(vertices: Floats, offsets: Ints, radius: Floats) -> tuple[Floats, bool]:
    """Boxes around the limbs, and whether every limb has vertices and all numbers are finite."""
    boxes = np.empty((len(radius), 2, 3))
    known = True
    for i in range(len(radius)):
        known = known and math.isfinite(radius[i]) and offsets[i] < offsets[i + 1]
        for k in range(3):
            low, high = np.inf, -np.inf
            for j in range(offsets[i], offsets[i + 1]):
                known = known and math.isfinite(vertices[j, k])
                low, high = min(low, vertices[j, k]), max(high, vertices[j, k])
            boxes[i, 0, k], boxes[i, 1, k] = low, high
    return boxes, known


#: coal searches a polytope of up to this many points one by one, so it needs no hull's edges, and points in a plane,
#: on a line or all in one are as good as any.
MOST_POINTS = 32

#: coal's distance and ours are the same when they differ by no more [m].
AGREED_M = 1e-9

_PLACE = coal.Transform3s()
_NO_FACE = coal.StdVec_Triangle()
_NO_FACE.append(coal.Triangle(0, 0, 0))  # a polytope must have one; the search over points does not look at it


@dataclass(frozen=True, slots=True)
class Separation:
    """Distances between the axes of the links and the hulls of the limbs in one tick."""

    distance_m: Floats  #: (s, l) proven lower bound, tight to rounding, 0 in penetration [m]
    clearance_m: Floats  #: (s, l) Delta of Eq. (2) [m]

    def room_m2(self) -> Floats:
        """(s, l) right-hand side of Eq. (14), corrected: max(0, distance - clearance)^2, Eq. (6), (10) [m^2]."""
        return np.maximum(0.0, self.distance_m - self.clearance_m) ** 2

    def nearest(self) -> tuple[float, int, int]:
        """Smallest distance between surfaces, negative where they overlap, NaN where one is [m]; link and limb."""
        surface = self.distance_m - self.clearance_m
        link, limb = divmod(int(np.argmin(surface)), surface.shape[1])
        return float(surface[link, limb]), link, limb


def separation(pose: RobotPose, obstacles: Obstacles, clearance_m: Floats) -> Separation:
    """Distances of all pairs: what is proven to be free between them, with coal's word on the nearest pair.

    A plane between link and limb bounds their distance from below however far the search for the distance came, so
    every pair has a bound and one in doubt costs only what is in doubt. coal measures the nearest pair by another
    algorithm; where it finds less than was proven its distance counts, since the smaller one is the safe one, and
    where it finds none ours is proven all the same.

    Args:
        pose: The robot.
        obstacles: The swept volumes, all known.
        clearance_m: (s, l) Delta of Eq. (2) for every pair of link and limb [m].
    """
    low, _, near = distances(pose.ends_m, obstacles.vertices_m, obstacles.offsets)
    found = Separation(low, clearance_m)
    if low.size:
        _, link, limb = found.nearest()
        first, last = obstacles.offsets[limb : limb + 2]
        start = sorted(set((near[link, limb] - first).tolist()))
        a, b = pose.ends_m[link]
        by_coal = axis_distance(a, b, obstacles.vertices_m[first:last], start)
        if by_coal < low[link, limb] - AGREED_M:
            low[link, limb] = by_coal
    return found


def axis_distance(a: Floats, b: Floats, vertices_m: Floats, near: list[int]) -> float:
    """Distance between a segment and the convex hull of points: GJK on few of them, checked against all.

    The distance to the hull of some vertices bounds the one to the hull of all from above, the plane across its
    direction from below. While the bounds differ, the vertex that lies furthest back joins in.

    Args:
        a: (3,) end of the segment [m].
        b: (3,) other end [m].
        vertices_m: (m, 3) [m].
        near: Rows of ``vertices_m`` to begin with, at least one.

    Returns:
        The distance, exact to AGREED_M and not above the true one [m]; 0 in penetration; NaN where coal finds none.
    """
    segment = _polytope(np.stack([a, b]))
    chosen = list(near)
    for _ in range(len(vertices_m) + MOST_POINTS):
        try:
            above, normal = _gjk(segment, _polytope(vertices_m[chosen]))
        except (RuntimeError, ValueError):
            return np.nan
        if above <= EXACT_M:
            return 0.0
        below, furthest = _plane(a, b, normal, vertices_m)
        if not above - below > EXACT_M:
            return 0.0 if below < 0.0 else below  # NaN passes through
        if furthest in chosen:  # as near as coal comes, e.g. beside an edge that is nearly parallel
            return max(0.0, below) if above - below <= AGREED_M else np.nan
        if len(chosen) == MOST_POINTS:  # those far from the plane do not carry the nearest point
            order = np.argsort(vertices_m[chosen] @ normal, kind="stable")[: MOST_POINTS // 2]
            chosen = [chosen[i] for i in order]
        chosen.append(furthest)
    return np.nan


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
    return distance, result.normal


@njit(cache=True)
def _plane(a: Floats, b: Floats, normal: Floats, vertices: Floats) -> tuple[float, int]:
    """Lower bound of the distance from the planes across a normal, and the vertex that lies furthest back.

    Args:
        a: (3,) end of the segment [m].
        b: (3,) other end [m].
        normal: (3,) unit vector from the segment towards the hull.
        vertices: (m, 3) [m].
    """
    best, depth = 0, np.inf
    for j in range(len(vertices)):
        along = normal[0] * vertices[j, 0] + normal[1] * vertices[j, 1] + normal[2] * vertices[j, 2]
        if along < depth:
            best, depth = j, along
    back = max(
        normal[0] * a[0] + normal[1] * a[1] + normal[2] * a[2],
        normal[0] * b[0] + normal[1] * b[1] + normal[2] * b[2],
    )
    return depth - back, best
