"""The swept volumes of one tick, as every controller of that tick uses them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from hrcreplay.records import Floats, Ints, SweptVolumes


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
