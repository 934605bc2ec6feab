"""Swept volumes of point sets, one degree of freedom at a time: the two strategies of Alg. 2.

Every sweep maps the whole set by a few fixed linear maps. So the hull of a swept set is the swept hull: points that
are not corners of the hull may be dropped before any sweep without changing what comes out at the end.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.records import Floats

#: Largest angle that one triangle spans [rad]: its apex is then at most 15.5 % of the radius off the arc.
TRIANGLE_RAD = np.pi / 3.0
#: Most points that a rotation makes of one: both ends and an apex for each of six triangles.
MOST_COPIES = 8


@njit(cache=True)
def sweep_lin(points: Floats, count: int, axis: int, low: float, high: float, swept: Floats) -> int:
    """Translational sweep along a coordinate axis, Fig. 7.

    Args:
        points: (m, 3), of which the first ``count`` are swept [m].
        count: Number of points.
        axis: 0, 1, 2 for x, y, z.
        low: Smallest displacement [m].
        high: Largest displacement [m]; equal to ``low`` it moves the points and adds none.
        swept: (>= 2 count, 3) receives the points, whose hull is the swept volume [m].

    Returns:
        Number of points written.
    """
    copies = 1 if low == high else 2
    for i in range(count):
        for copy in range(copies):
            for k in range(3):
                swept[copies * i + copy, k] = points[i, k]
            swept[copies * i + copy, axis] += high if copy else low
    return copies * count


@njit(cache=True)
def sweep_rot(
    points: Floats, count: int, axis: int, low: float, high: float, swept: Floats, widest: float = TRIANGLE_RAD
) -> int:
    """Rotational sweep about a coordinate axis through the origin, Fig. 8: arcs inside triangles.

    An arc is cut into equal pieces of at most ``widest``; each lies in the triangle of its ends and the point where
    their tangents meet. A cut lies on the tangent that its two triangles share, between their apexes, so only the
    arc's ends and the apexes are corners. A whole turn is the polygon around the circle.

    Args:
        points: (m, 3), of which the first ``count`` are swept [m].
        count: Number of points.
        axis: 0, 1, 2 for x, y, z.
        low: Smallest angle [rad].
        high: Largest angle [rad]; equal to ``low`` it turns the points and adds none.
        swept: (>= copies(low, high, widest) count, 3) receives the points, whose hull contains every arc [m].
        widest: Largest angle of a triangle [rad].

    Returns:
        Number of points written.
    """
    most = copies(low, high, widest)
    cosines, sines = np.empty(most), np.empty(most)
    made = turns(low, high, cosines, sines, widest)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    n = 0
    for row in range(count):
        u, v = points[row, i], points[row, j]
        for copy in range(1 if u == 0.0 and v == 0.0 else made):
            swept[n, axis] = points[row, axis]
            swept[n, i] = cosines[copy] * u - sines[copy] * v
            swept[n, j] = sines[copy] * u + cosines[copy] * v
            n += 1
    return n


@njit(cache=True)
def copies(low: float, high: float, widest: float = TRIANGLE_RAD) -> int:
    """Most points that a rotation makes of one."""
    return 1 if low == high else 2 + int(np.ceil(min(high - low, 2.0 * np.pi) / widest))


@njit(cache=True)
def turns(low: float, high: float, cosines: Floats, sines: Floats, widest: float = TRIANGLE_RAD) -> int:
    """The maps of a rotational sweep: rotations, for an apex stretched by 1 / cos(half the piece).

    Writes the first columns (cos, sin) of their matrices, and returns how many there are.
    """
    if low == high:
        cosines[0], sines[0] = np.cos(low), np.sin(low)
        return 1
    width = min(high - low, 2.0 * np.pi)
    pieces = int(np.ceil(width / widest))
    half = 0.5 * width / pieces
    for piece in range(pieces):
        middle = low + (2 * piece + 1) * half
        cosines[piece], sines[piece] = np.cos(middle) / np.cos(half), np.sin(middle) / np.cos(half)
    if width == 2.0 * np.pi:
        return pieces
    cosines[pieces], sines[pieces] = np.cos(low), np.sin(low)
    cosines[pieces + 1], sines[pieces + 1] = np.cos(high), np.sin(high)
    return pieces + 2
