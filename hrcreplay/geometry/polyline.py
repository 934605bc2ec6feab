"""The nearest points of a polyline: its vertices, and a foot that only advances along it."""

from __future__ import annotations

import numpy as np

from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints

#: Number of consecutive vertices in a block, and of blocks in a group.
_BLOCK, _BLOCKS = 32, 16
#: Rounding of a distance [m].
_ROUNDING_M = 1e-9


@njit(cache=True)
def nearest_vertices(points: Floats, vertices: Floats) -> Ints:
    """Returns (n,) which of some vertices (m, 3) are nearest to (n, 3) points [m].

    The points are those of a motion: the vertex nearest to one is near to the next one, too. So only few blocks of
    vertices can hold a nearer one, by the balls around them, and around groups of them. Vertices that follow one
    another should be neighbours.
    """
    blocks, groups = _balls(vertices, _BLOCK), _balls(vertices, _BLOCK * _BLOCKS)
    found, nearest = np.empty(len(points), np.int64), 0
    for i in range(len(points)):
        least2 = _apart2(points, i, vertices, nearest)
        for g in range(len(groups)):
            if _apart2(points, i, groups, g) > (np.sqrt(least2) + groups[g, 3]) ** 2:
                continue
            for b in range(g * _BLOCKS, min((g + 1) * _BLOCKS, len(blocks))):
                if _apart2(points, i, blocks, b) > (np.sqrt(least2) + blocks[b, 3]) ** 2:
                    continue
                for k in range(b * _BLOCK, min((b + 1) * _BLOCK, len(vertices))):
                    apart2 = _apart2(points, i, vertices, k)
                    if apart2 < least2:
                        nearest, least2 = k, apart2
        found[i] = nearest
    return found


@njit(cache=True, inner=True)
def _balls(vertices: Floats, size: int) -> Floats:
    """Balls around each ``size`` consecutive vertices: (k, 4) their middles, and their radii rounded up [m]."""
    found = np.zeros(((len(vertices) + size - 1) // size, 4))
    for b in range(len(found)):
        part = vertices[b * size : (b + 1) * size]
        for axis in range(3):
            found[b, axis] = 0.5 * (part[:, axis].min() + part[:, axis].max())
        for k in range(len(part)):
            found[b, 3] = max(found[b, 3], np.sqrt(_apart2(found, b, part, k)))
        found[b, 3] += _ROUNDING_M
    return found


@njit(cache=True)
def follow_nearer(points: Floats, path: Floats, at: Ints) -> None:
    """Follows a polyline from a vertex for each point, towards both ends, as long as the next vertex is nearer.

    Args:
        points: (n, 3) [m].
        path: (m, 3) vertices [m].
        at: (n,) vertex from which each point starts; replaced by the last one.
    """
    for i in range(len(points)):
        now = _apart2(points, i, path, at[i])
        for step in (-1, 1):
            other = at[i] + step
            while 0 <= other < len(path) and _apart2(points, i, path, other) < now:
                now, at[i] = _apart2(points, i, path, other), other
                other += step


@njit(cache=True)
def advance_foot(
    points: Floats, path: Floats, way_m: Floats, until: Ints, ahead_m: float, step_m: float
) -> tuple[int, float]:
    """Follows a moving point with a foot on a polyline that never moves back.

    Args:
        points: (n, 3) positions of the point [m].
        path: (m, 3) vertices [m].
        way_m: (m,) distance along the path from its first vertex [m].
        until: (n,) vertex that the foot must not pass at each position, increasing.
        ahead_m: Length of the next section of the path that is searched for the foot [m].
        step_m: Motion of the point after which its foot is searched again; it is for its last position [m].

    Returns:
        The last passed vertex, and the fraction of the distance to the next one.
    """
    passed, share, before = 0, 0.0, 0
    for tick in range(len(points)):
        waits = tick + 1 < len(points) and _apart2(points, before, points, tick) < step_m**2
        if waits or passed == until[tick]:
            continue
        before = tick
        here_m = way_m[passed] + share * (way_m[passed + 1] - way_m[passed])
        end = min(until[tick], max(passed + 1, np.searchsorted(way_m, here_m + ahead_m)))
        nearest, least, part = passed, np.inf, share
        for k in range(passed, end):
            found = _share_along(points, tick, path, k)
            if k == passed:
                found = max(found, share)
            apart = _foot_apart2(points, tick, path, k, found)
            if apart < least:
                nearest, least, part = k, apart, found
        passed, share = nearest, part
        if share == 1.0:
            passed, share = passed + 1, 0.0
    return passed, share


@njit(cache=True, inner=True)
def _share_along(points: Floats, i: int, path: Floats, k: int) -> float:
    """Place of the foot of a point on segment k: fraction of its length from vertex k, in [0, 1]."""
    to, along2 = 0.0, 0.0
    for axis in range(3):
        along = path[k + 1, axis] - path[k, axis]
        to += (points[i, axis] - path[k, axis]) * along
        along2 += along * along
    return min(max(to / along2, 0.0), 1.0)


@njit(cache=True, inner=True)
def _foot_apart2(points: Floats, i: int, path: Floats, k: int, share: float) -> float:
    """Squared distance of a point from that place on segment k [m^2]."""
    apart2 = 0.0
    for axis in range(3):
        apart = path[k, axis] + share * (path[k + 1, axis] - path[k, axis]) - points[i, axis]
        apart2 += apart * apart
    return apart2


@njit(cache=True, inner=True)
def _apart2(points: Floats, i: int, path: Floats, k: int) -> float:
    x, y, z = path[k, 0] - points[i, 0], path[k, 1] - points[i, 1], path[k, 2] - points[i, 2]
    return x * x + y * y + z * z
