"""Distances between the robot's links and the swept volumes of one tick.

The right-hand side of the safety constraints is corrected as docs/paper.md says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from hrcreplay.geometry.distances import distances
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
    horizon_s: float = math.inf  #: until when they hold, from their tick on [s]


def obstacles(volumes: SweptVolumes, tick: int, horizon_s: float = math.inf) -> Obstacles:
    """The obstacles of one tick.

    Args:
        volumes: Any number of ticks.
        tick: Row of ``volumes``.
        horizon_s: Until when they hold, from that tick on [s].
    """
    limbs = len(volumes.limbs)
    offsets = volumes.offsets[tick * limbs : (tick + 1) * limbs + 1]
    vertices, radius = volumes.vertices_m[offsets[0] : offsets[-1]], volumes.radius_m[tick]
    offsets = offsets - offsets[0]
    boxes, known = _boxes(vertices, offsets, radius)
    return Obstacles(vertices, offsets, radius, boxes, known, horizon_s)


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


@dataclass(frozen=True, slots=True)
class Separation:
    """Distances between the axes of the links and the hulls of the limbs in one tick."""

    distance_m: Floats  #: (s, l) proven lower bound, tight to rounding, 0 in penetration [m]
    clearance_m: Floats  #: (s, l) Delta of Eq. (2) [m]

    def room_m2(self, room: str, give_way_m: float = 0.0) -> Floats:
        """(s, l) right-hand side of Eq. (14), corrected (docs/paper.md), Eq. (6), (10) [m^2].

        Args:
            room: ``square`` is (distance - clearance)^2, as printed; what (3) needs is no more than ``product``,
                distance (distance - clearance).
            give_way_m: product: less than this short of a volume it is negative, so the link must move away [m].
        """
        gap = self.distance_m - self.clearance_m
        if room == "square":
            return np.asarray(np.maximum(0.0, gap) ** 2)
        return np.asarray(self.distance_m * (np.maximum(0.0, gap) - give_way_m))

    def nearest(self) -> tuple[float, int, int]:
        """Smallest distance between surfaces, negative where they overlap, NaN where one is [m]; link and limb."""
        surface = self.distance_m - self.clearance_m
        link, limb = divmod(int(np.argmin(surface)), surface.shape[1])
        return float(surface[link, limb]), link, limb


def separation(pose: RobotPose, obstacles: Obstacles, clearance_m: Floats) -> Separation:
    """Distances of all pairs: what is proven to be free between them.

    A plane between link and limb bounds their distance from below however far the search for the distance came, so
    every pair has a bound and one in doubt costs only what is in doubt.

    Args:
        pose: The robot.
        obstacles: The swept volumes, all known.
        clearance_m: (s, l) Delta of Eq. (2) for every pair of link and limb [m].
    """
    low, _, _ = distances(pose.ends_m, obstacles.vertices_m, obstacles.offsets)
    return Separation(low, clearance_m)
