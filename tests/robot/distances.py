"""Distances by coal alone, pair by pair."""

from __future__ import annotations

import coal
import numpy as np

from hrcreplay.geometry.distances import EXACT_M
from hrcreplay.kernels import njit
from hrcreplay.records import Floats
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.kinematics import RobotPose

#: coal searches a polytope of up to this many points one by one, so it needs no hull's edges.
MOST_POINTS = 32

#: coal's distance and ours are the same when they differ by no more [m].
AGREED_M = 1e-9

_PLACE = coal.Transform3s()
_NO_FACE = coal.StdVec_Triangle()
_NO_FACE.append(coal.Triangle(0, 0, 0))  # a polytope must have one; the search over points does not look at it


def by_coal(pose: RobotPose, seen: Obstacles) -> Floats:
    """(s, l) from the axis of every link to the hull of every limb [m]."""
    hulls = [seen.vertices_m[first:last] for first, last in zip(seen.offsets, seen.offsets[1:], strict=False)]
    return np.array([[axis_distance(a, b, hull, [0]) for hull in hulls] for a, b in pose.ends_m])


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
