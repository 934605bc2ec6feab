"""Polytopes around swept sets from how far the sets reach along fixed directions: always the same number of corners.

The directions are the corners of triangles around the unit sphere. For numbers that are nowhere below a set's support
function, each triangle gives one corner: the point that is as far along its three directions as the numbers say. Any
direction u lies over a triangle (a, b, c), so u = k a + l b + m c with weights >= 0, and no point of the set is further
along u than k h(a) + l h(b) + m h(c): where the corner is. So the hull of the corners holds the set, whether or not
every number is reached.

How far a point gets along a direction while it turns about an axis is exact, so here no arc is widened to triangles.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numba import njit
from scipy.spatial import ConvexHull

from hrcreplay.records import Floats


def _directions() -> Floats:
    """(92, 3) unit vectors: an icosahedron's corners, two of them up and down, thirds of its edges, its faces."""
    around = 2.0 * np.pi * np.arange(5) / 5.0
    ring = [np.column_stack([np.cos(around + turn), np.sin(around + turn)]) * 2.0 for turn in (0.0, np.pi / 5.0)]
    upper, lower = (np.column_stack([ring[k], np.full(5, 1.0 - 2.0 * k)]) / np.sqrt(5.0) for k in range(2))
    corners = np.concatenate([[[0.0, 0.0, 1.0]], upper, lower, [[0.0, 0.0, -1.0]]])
    near = corners @ corners.T > 0.4
    thirds = [2.0 * corners[i] + corners[j] for i in range(12) for j in range(12) if i != j and near[i, j]]
    faces = [
        corners[i] + corners[j] + corners[k]
        for i, j, k in combinations(range(12), 3)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    every = np.concatenate([corners, thirds, faces])
    unit: Floats = every / np.linalg.norm(every, axis=1)[:, None]
    return unit


DIRECTIONS = _directions()
_TRIANGLES = ConvexHull(DIRECTIONS).simplices.astype(np.int64)
_TRIANGLES = _TRIANGLES[np.lexsort(np.sort(_TRIANGLES).T)]
#: (corners, 3, 3): from how far along its three directions a corner is to where it is.
_SOLUTIONS = np.linalg.inv(DIRECTIONS[_TRIANGLES])
CORNERS = len(_TRIANGLES)
#: The directions as (3, directions), and how far each is across each axis.
_COLUMNS = np.ascontiguousarray(DIRECTIONS.T)
_ACROSS = np.sqrt(1.0 - _COLUMNS**2)


@njit(cache=True)
def reach_turning(points: Floats, count: int, axis: int, low: float, high: float, far: Floats) -> None:
    """Raises far (directions,) to how far points get that turn by low to high [rad] about a coordinate axis [m].

    Across the axis a point gets as far as its circle where it passes the direction, else as far as at the nearer end.
    """
    i, j = (axis + 1) % 3, (axis + 2) % 3
    middle, half = 0.5 * (low + high), min(0.5 * (high - low), np.pi)
    c, s, cos_half, sin_half = np.cos(middle), np.sin(middle), np.cos(half), np.sin(half)
    along, across, level = _COLUMNS[axis], _ACROSS[axis], np.empty((2, len(far)))
    for d in range(len(far)):  # the directions, turned back by the middle
        level[0, d] = c * _COLUMNS[i, d] + s * _COLUMNS[j, d]
        level[1, d] = c * _COLUMNS[j, d] - s * _COLUMNS[i, d]
    u, v = level[0], level[1]
    for k in range(count):
        x, y, z = points[k, i], points[k, j], points[k, axis]
        r = np.sqrt(x * x + y * y)
        for d in range(len(far)):
            facing, circle = u[d] * x + v[d] * y, across[d] * r
            end = cos_half * facing + sin_half * abs(u[d] * y - v[d] * x)
            there = along[d] * z + (circle if facing >= cos_half * circle else end)
            far[d] = there if there > far[d] else far[d]


@njit(cache=True)
def around(far: Floats, points: Floats) -> int:
    """Writes the corners of the polytope for far (directions,) [m] into points (>= CORNERS, 3); returns how many."""
    for t in range(CORNERS):
        a, b, c = far[_TRIANGLES[t, 0]], far[_TRIANGLES[t, 1]], far[_TRIANGLES[t, 2]]
        for k in range(3):
            points[t, k] = _SOLUTIONS[t, k, 0] * a + _SOLUTIONS[t, k, 1] * b + _SOLUTIONS[t, k, 2] * c
    return CORNERS
