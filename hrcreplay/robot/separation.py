"""Distances between the robot's links and the swept volumes. The only module that imports coal."""

from __future__ import annotations

import coal
import numpy as np

from hrcreplay.records import Floats
from hrcreplay.robot.bracket import brackets, plane
from hrcreplay.robot.model import RobotPose
from hrcreplay.robot.obstacles import Obstacles

#: coal searches a polytope of up to this many points one by one, so it needs no hull's edges, and points in a plane,
#: on a line or all in one are as good as any.
MOST_POINTS = 32

#: A distance is exact when no vertex comes closer than this [m].
EXACT_M = 1e-10

_PLACE = coal.Transform3s()
_NO_FACE = coal.StdVec_Triangle()
_NO_FACE.append(coal.Triangle(0, 0, 0))  # a polytope must have one; the search over points does not look at it


class Separation:
    """Distances between the axes of the links and the hulls of the limbs in one tick, made exact where asked.

    A pair starts with certain bounds. Only the nearest pair of a tick and those whose rows come into question need
    more, and what the controller does is the same as if all had been exact from the start.
    """

    def __init__(self, pose: RobotPose, obstacles: Obstacles, clearance_m: Floats) -> None:
        """Bounds for every pair.

        Args:
            pose: The robot.
            obstacles: The swept volumes, all known.
            clearance_m: (s, l) Delta of Eq. (2) for every pair of link and limb [m].
        """
        self.clearance_m = clearance_m
        self._ends, self._obstacles = pose.ends_m, obstacles
        self._low, self._high, self._near = brackets(pose.ends_m, obstacles.vertices_m, obstacles.offsets)
        self.exact = np.zeros(self._low.shape, dtype=bool)

    def distance_m(self, link: int, limb: int) -> float:
        """Exact distance from a link's axis to a limb's hull; 0 in penetration, NaN where coal found none [m]."""
        if not self.exact[link, limb]:
            first, last = self._obstacles.offsets[limb : limb + 2]
            near = sorted(set((self._near[link, limb] - first).tolist()))
            a, b = self._ends[link]
            self._low[link, limb] = axis_distance(a, b, self._obstacles.vertices_m[first:last], near)
            self.exact[link, limb] = True
        return float(self._low[link, limb])

    def room_m2(self) -> Floats:
        """(s, l) right-hand side of Eq. (14), corrected, [m^2]: exact, or else a lower bound."""
        return np.maximum(0.0, self._low - self.clearance_m) ** 2

    def exact_room_m2(self, link: int, limb: int) -> float:
        """Right-hand side of Eq. (14), corrected, of one pair: max(0, distance - clearance)^2 [m^2]."""
        return max(0.0, self.distance_m(link, limb) - float(self.clearance_m[link, limb])) ** 2

    @property
    def failed(self) -> bool:
        """Whether a distance could not be found."""
        return bool(np.isnan(self._low).any())

    def nearest(self) -> tuple[float, int, int]:
        """Smallest distance between surfaces, negative where they overlap, NaN where not found [m]; link and limb."""
        while True:
            surface = self._low - self.clearance_m
            link, limb = divmod(int(np.argmin(surface)), surface.shape[1])
            if self.exact[link, limb]:
                return float(surface[link, limb]), link, limb
            self.distance_m(link, limb)


def separation(pose: RobotPose, obstacles: Obstacles) -> Floats:
    """Distance between the axis of every link and the hull of every limb: (s, l) [m], 0 in penetration."""
    limbs = len(obstacles.radius_m)
    pairs = Separation(pose, obstacles, np.zeros((len(pose.ends_m), limbs)))
    return np.array([[pairs.distance_m(s, k) for k in range(limbs)] for s in range(len(pose.ends_m))])


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
        The distance, exact to EXACT_M and not above the true one [m]; 0 in penetration; NaN where coal fails.
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
        below, furthest = plane(a, b, normal, vertices_m)
        if not above - below > EXACT_M:
            return 0.0 if below < 0.0 else below  # NaN passes through
        if furthest in chosen:
            return np.nan
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
