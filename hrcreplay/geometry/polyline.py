"""The nearest vertices of a polyline."""

from __future__ import annotations

from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints


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


@njit(cache=True, inner=True)
def _apart2(points: Floats, i: int, path: Floats, k: int) -> float:
    x, y, z = path[k, 0] - points[i, 0], path[k, 1] - points[i, 1], path[k, 2] - points[i, 2]
    return x * x + y * y + z * z
