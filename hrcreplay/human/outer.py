"""Polytopes around swept sets from how far the sets reach along fixed directions: always the same number of corners.

The directions are the corners of triangles around the unit sphere. For numbers that are nowhere below a set's support
function, each triangle gives one corner: the point that is as far along its three directions as the numbers say. Any
direction u lies over a triangle (a, b, c), so u = k a + l b + m c with weights >= 0, and no point of the set is further
along u than k h(a) + l h(b) + m h(c): where the corner is. So the hull of the corners holds the set, whether or not
every number is reached.

How far a point gets along a direction while it turns about an axis is exact, so here no arc is widened to triangles.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial import ConvexHull

from hrcreplay.records import Floats


def _directions() -> Floats:
    """(42, 3) unit vectors: an icosahedron's corners, two of them up and down, and the middles of its edges."""
    around = 2.0 * np.pi * np.arange(5) / 5.0
    ring = [np.column_stack([np.cos(around + turn), np.sin(around + turn)]) * 2.0 for turn in (0.0, np.pi / 5.0)]
    upper, lower = (np.column_stack([ring[k], np.full(5, 1.0 - 2.0 * k)]) / np.sqrt(5.0) for k in range(2))
    corners = np.concatenate([[[0.0, 0.0, 1.0]], upper, lower, [[0.0, 0.0, -1.0]]])
    i, j = np.triu_indices(12, 1)
    edges = np.einsum("ij,ij->i", corners[i], corners[j]) > 0.4
    middles = corners[i][edges] + corners[j][edges]
    both: Floats = np.concatenate([corners, middles / np.linalg.norm(middles, axis=1)[:, None]])
    return both


DIRECTIONS = _directions()
_TRIANGLES = ConvexHull(DIRECTIONS).simplices.astype(np.int64)
_TRIANGLES = _TRIANGLES[np.lexsort(np.sort(_TRIANGLES).T)]
#: (corners, 3, 3): from how far along its three directions a corner is to where it is.
_SOLUTIONS = np.linalg.inv(DIRECTIONS[_TRIANGLES])
CORNERS = len(_TRIANGLES)


@njit(cache=True)
def reach_turning(points: Floats, count: int, axis: int, low: float, high: float, far: Floats) -> None:
    """Raises far (directions,) to how far points get that turn by low to high [rad] about a coordinate axis [m].

    Across the axis a point gets as far as its circle where it passes the direction, else as far as at the nearer end.
    """
    i, j = (axis + 1) % 3, (axis + 2) % 3
    middle, half = 0.5 * (low + high), min(0.5 * (high - low), np.pi)
    c, s, cos_half, sin_half = np.cos(middle), np.sin(middle), np.cos(half), np.sin(half)
    for d in range(len(DIRECTIONS)):
        u, v, w = DIRECTIONS[d, i], DIRECTIONS[d, j], DIRECTIONS[d, axis]
        across = np.sqrt(u * u + v * v)
        u, v = c * u + s * v, c * v - s * u  # the direction, turned back by the middle
        largest = far[d]
        for k in range(count):
            x, y = points[k, i], points[k, j]
            radius = across * np.sqrt(x * x + y * y)
            along, aside = u * x + v * y, abs(u * y - v * x)
            ends = cos_half * along + sin_half * aside
            largest = max(largest, w * points[k, axis] + (radius if along >= cos_half * radius else ends))
        far[d] = largest


@njit(cache=True)
def around(far: Floats, points: Floats) -> int:
    """Writes the corners of the polytope for far (directions,) [m] into points (>= CORNERS, 3); returns how many."""
    for t in range(CORNERS):
        a, b, c = far[_TRIANGLES[t, 0]], far[_TRIANGLES[t, 1]], far[_TRIANGLES[t, 2]]
        for k in range(3):
            points[t, k] = _SOLUTIONS[t, k, 0] * a + _SOLUTIONS[t, k, 1] * b + _SOLUTIONS[t, k, 2] * c
    return CORNERS
