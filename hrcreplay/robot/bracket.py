"""Cheap and certain bounds of the distance between a segment and the convex hull of points."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from hrcreplay.records import Floats, Ints

#: Vertices that a bracket remembers for the exact distance.
SUPPORTS = 6

#: A bracket this narrow is not narrowed further: share of its lower end.
NARROW = 0.02


@njit(cache=True)
def brackets(ends: Floats, vertices: Floats, offsets: Ints) -> tuple[Floats, Floats, Ints]:
    """Bounds of the distance between the axis of every link and the hull of every limb.

    Args:
        ends: (s, 2, 3) ends of the axes [m].
        vertices: (m, 3) of all limbs [m].
        offsets: (l + 1,) where each limb's vertices begin; no limb is empty.

    Returns:
        Lower and upper bound, (s, l) each [m], and (s, l, SUPPORTS) rows of ``vertices`` near the nearest point
        (repeated where there are fewer).
    """
    links, limbs = len(ends), len(offsets) - 1
    low, high = np.empty((links, limbs)), np.empty((links, limbs))
    near = np.empty((links, limbs, SUPPORTS), dtype=np.int64)
    for s in range(links):
        for k in range(limbs):
            low[s, k], high[s, k] = _bracket(ends[s, 0], ends[s, 1], vertices, offsets[k], offsets[k + 1], near[s, k])
    return low, high, near


@njit(cache=True)
def _bracket(a: Floats, b: Floats, vertices: Floats, first: int, last: int, near: Ints) -> tuple[float, float]:
    """Gilbert's algorithm: walk towards the vertex that lies furthest back; each one met bounds the distance."""
    low, high = 0.0, np.inf
    x0, x1, x2 = vertices[first, 0], vertices[first, 1], vertices[first, 2]  # a point of the hull
    near[:] = first
    for i in range(SUPPORTS):
        t = _share(a, b, x0, x1, x2)  # the point of the segment nearest to it
        p0, p1, p2 = a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2])
        n0, n1, n2 = x0 - p0, x1 - p1, x2 - p2
        gap = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        high = min(high, gap)
        if gap < 1e-9 or high - low <= NARROW * low:
            break
        best, depth = first, np.inf
        for j in range(first, last):
            along = n0 * vertices[j, 0] + n1 * vertices[j, 1] + n2 * vertices[j, 2]
            if along < depth:
                best, depth = j, along
        near[i:] = best
        back = max(n0 * a[0] + n1 * a[1] + n2 * a[2], n0 * b[0] + n1 * b[1] + n2 * b[2])
        low = max(low, (depth - back) / gap)
        # the point between x and that vertex that is nearest to p
        d0, d1, d2 = vertices[best, 0] - x0, vertices[best, 1] - x1, vertices[best, 2] - x2
        length = d0 * d0 + d1 * d1 + d2 * d2
        if length == 0.0:
            break
        step = min(1.0, max(0.0, -(d0 * n0 + d1 * n1 + d2 * n2) / length))
        x0, x1, x2 = x0 + step * d0, x1 + step * d1, x2 + step * d2
    return low, high


@njit(cache=True)
def _share(a: Floats, b: Floats, x0: float, x1: float, x2: float) -> float:
    """Where on the segment from a to b the point nearest to x is, in [0, 1]."""
    d0, d1, d2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    length = d0 * d0 + d1 * d1 + d2 * d2
    if length == 0.0:
        return 0.0
    return min(1.0, max(0.0, (d0 * (x0 - a[0]) + d1 * (x1 - a[1]) + d2 * (x2 - a[2])) / length))


@njit(cache=True)
def plane(a: Floats, b: Floats, normal: Floats, vertices: Floats) -> tuple[float, int]:
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
