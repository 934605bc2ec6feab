"""Convex hulls, their volume with a ball around every point, their visible front, and polytopes that enclose a set.

Hulls and volumes are also defined for flat and thin sets, because the set swept by a segment may be flat.

The polytope replaces sets with too many points: it is computed from the extents of a set along fixed directions and
always has the same number of corners. The directions are the corners of triangles around the unit sphere. Let h be at
least the set's support function along each of them. Each triangle gives one corner: the point whose extents along its
three directions equal h. Any direction u lies over a triangle (a, b, c), so u = k a + l b + m c with weights >= 0, and
no point of the set has a larger extent along u than k h(a) + l h(b) + m h(c), the extent of the corner. So the hull of
the corners contains the set, also if h is larger than the support function.

The extent of a turning point along a direction is exact, so arcs are not widened to triangles here.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import combinations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from hrcreplay.geometry.hull_reduction import Surface, solid_hull, surface
from hrcreplay.geometry.small_matrices import apply, multiply, singular_values
from hrcreplay.geometry.vectors import cross, dot, edge, norm, norm_n
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints

#: A set thinner than this in a direction has no extent in it [m].
_THIN_M = 1e-9
#: Nor does a set thinner than this times its largest coordinate: the rounding of coordinates grows with the distance
#: from the origin.
_COARSE = 16.0 * float(np.finfo(np.float64).eps)


def hull(points_m: Floats) -> tuple[Floats, Ints]:
    """Corners and triangles of a convex hull.

    Args:
        points_m: (n, 3), n >= 1, all finite [m].

    Returns:
        ``vertices`` (m, 3) [m], the corners in the order of the points, and ``faces`` (f, 3), three rows of vertices
        for each triangle, counterclockwise seen from outside. A flat set has triangles on both sides; a line has its
        two ends and no triangles, a point one vertex.
    """
    corners, faces = solid_hull(np.array(points_m, order="C"), _surface())  # a copy: the kernel knows one layout
    if len(faces):
        return points_m[corners], faces
    axes = _axes(points_m)
    while len(axes) > 1:
        try:
            return _solid(points_m) if len(axes) == 3 else _flat(points_m, axes)
        except QhullError:  # too thin to be distinguished from a flat set in floating point: treat it as flat
            axes = axes[:-1]
    if len(axes) == 1:
        along = apply(points_m - points_m[0], axes[0])
        return points_m[np.sort([along.argmin(), along.argmax()])], np.empty((0, 3), np.int64)
    return points_m[:1], np.empty((0, 3), np.int64)


@cache
def _surface() -> Surface:
    """The memory of this process for hulls."""
    return surface()


def _solid(points_m: Floats) -> tuple[Floats, Ints]:
    solid = ConvexHull(points_m)
    corners = np.sort(solid.vertices)
    faces = np.searchsorted(corners, solid.simplices).astype(np.int64)
    _turn_outward(points_m[corners], faces, solid.neighbors)
    return points_m[corners], faces


def _flat(points_m: Floats, axes: Floats) -> tuple[Floats, Ints]:
    """Returns the polygon in the plane of two axes (2, 3), with both sides."""
    around = ConvexHull(multiply(points_m - points_m[0], axes.T)).vertices  # counterclockwise
    corners = np.sort(around)
    loop = np.searchsorted(corners, around)
    # from different corners, so that no two triangles lie left of one edge
    return points_m[corners], np.concatenate([_fan(loop), _fan(np.roll(loop, -1))[:, ::-1]])


@njit(cache=True)
def above(points_m: Floats, triangles: Ints, height_m: float) -> tuple[Floats, Ints]:
    """Cuts off the part of a convex polytope below a height; no corners if all of it is below.

    Args:
        points_m: (n, 3) points, its corners among them [m].
        triangles: (f, 3) of its surface, counterclockwise seen from outside.
        height_m: Height [m].

    Returns:
        Corners (k, 3) [m] and triangles (g, 3) of the closed surface of the rest, as ``hull`` has them.
    """
    high, count, faces = points_m[:, 2] - height_m, 0, 0
    corners, cut = np.empty((len(points_m) + 3 * len(triangles), 3)), np.empty((2 * len(triangles), 3), np.int64)
    places = np.full((len(points_m), len(points_m)), -1, np.int32)  # of a corner, or of the cut of an edge
    for i in np.sort(triangles.ravel()):
        if high[i] >= 0.0 and places[i, i] < 0:
            corners[count], places[i, i] = points_m[i], count
            count += 1
    around = np.empty(4, np.int64)  # corners of what is left of a triangle
    for triangle in triangles:
        size = 0
        for k in range(3):
            i, j = triangle[k], triangle[(k + 1) % 3]
            if high[i] >= 0.0:
                around[size], size = places[i, i], size + 1
            if high[i] * high[j] < 0.0:
                i, j = min(i, j), max(i, j)
                if places[i, j] < 0:
                    corners[count] = (high[j] * points_m[i] - high[i] * points_m[j]) / (high[j] - high[i])
                    corners[count, 2], places[i, j] = height_m, count
                    count += 1
                around[size], size = places[i, j], size + 1
        for k in range(1, size - 1):
            cut[faces, 0], cut[faces, 1], cut[faces, 2] = around[0], around[k], around[k + 1]
            faces += 1
    below = _lid(corners[:count], height_m) if high.min() < 0.0 else np.empty((0, 3), np.int64)
    return corners[:count].copy(), np.concatenate((cut[:faces], below))


@njit(cache=True, inner=True)
def _lid(corners: Floats, height: float) -> Ints:
    """Triangles between the corners at a height, which form a convex polygon; seen from below."""
    loop = np.flatnonzero(corners[:, 2] == height)
    x, y = corners[loop, 0], corners[loop, 1]
    loop = loop[np.argsort(np.arctan2(y - y.mean(), x - x.mean()))]
    found = np.empty((max(len(loop) - 2, 0), 3), np.int64)
    for k in range(len(found)):
        found[k, 0], found[k, 1], found[k, 2] = loop[0], loop[k + 2], loop[k + 1]
    return found


@njit(cache=True)
def _turn_outward(vertices: Floats, faces: Ints, neighbors: Ints) -> None:
    """Makes all triangles counterclockwise from outside, in place; the normal of a sliver is unreliable.

    Neighbours traverse their common edge in opposite directions. This leaves one choice for all; the hull's volume must
    be positive.
    """
    known = np.zeros(len(faces), np.bool_)
    known[0] = True
    queue = [0]
    for f in queue:
        for k in range(3):
            other = neighbors[f, k]
            if not known[other]:
                known[other] = True
                if _runs_same_way(faces[f], faces[other]):
                    faces[other, 0], faces[other, 1] = faces[other, 1], faces[other, 0]
                queue.append(other)
    if _measures(vertices, faces)[0] < 0.0:
        for f in range(len(faces)):
            faces[f, 0], faces[f, 1] = faces[f, 1], faces[f, 0]


@njit(cache=True, inner=True)
def _runs_same_way(a: Ints, b: Ints) -> bool:
    """Returns True if two triangles have a common edge in the same direction."""
    for i in range(3):
        for k in range(3):
            if a[i] == b[k] and a[(i + 1) % 3] == b[(k + 1) % 3]:
                return True
    return False


def _fan(loop: Ints) -> Ints:
    return np.column_stack([np.full(len(loop) - 2, loop[0]), loop[1:-1], loop[2:]]).astype(np.int64)


def sphere_swept_volume_m3(points_m: Floats, radius_m: float, faces: Ints | None = None) -> float:
    """Volume of a convex hull with a ball around every point, Eq. (41), by Steiner's formula [m^3].

    V + A r + M r^2 + 4/3 pi r^3, where M is half the sum over edges of length times exterior angle. A flat set counts
    as two-sided (A twice its area, angles of pi), so a segment gives a capsule and a point a ball.

    Args:
        points_m: (n, 3), n >= 1, all finite [m].
        radius_m: Radius of the ball [m].
        faces: Result of ``hull`` for these points; without it the hull is computed here.
    """
    if faces is None:
        points_m, faces = hull(points_m)
    if len(faces):
        volume, area, bend = _measures(points_m, faces)
    else:
        volume, area, bend = 0.0, 0.0, np.pi * norm_n(points_m[-1] - points_m[0])
    return float(volume + area * radius_m + bend * radius_m**2 + 4.0 / 3.0 * np.pi * radius_m**3)


@njit(cache=True)
def _measures(vertices: Floats, faces: Ints) -> tuple[float, float, float]:
    """V [m^3], A [m^2] and M [m] of Steiner's formula for a closed surface of triangles."""
    left = np.zeros((len(vertices), len(vertices)), np.int32)  # the triangle left of an edge
    normals = [(0.0, 0.0, 0.0)] * len(faces)
    volume, area, bend = 0.0, 0.0, 0.0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        normals[f] = cross(edge(vertices, a, b), edge(vertices, a, c))
        volume += dot(edge(vertices, 0, a), normals[f]) / 6.0
        area += 0.5 * norm(normals[f])
        left[a, b], left[b, c], left[c, a] = f, f, f
    for f in range(len(faces)):
        for k in range(3):
            i, j = faces[f, k], faces[f, (k + 1) % 3]
            beyond = normals[left[j, i]]
            angle = np.arctan2(norm(cross(normals[f], beyond)), dot(normals[f], beyond))
            bend += 0.25 * norm(edge(vertices, i, j)) * angle  # half of it, and every edge occurs twice
    return volume, area, bend


def _axes(points_m: Floats) -> Floats:
    """(0 to 3, 3) principal directions in which the set has an extent, the longest first."""
    centred = points_m - points_m.mean(axis=0)
    directions = singular_values(centred)[2].T
    extents = np.ptp(multiply(centred, directions.T), axis=0)
    axes: Floats = directions[extents > max(_THIN_M, _COARSE * float(np.abs(points_m).max()))]
    return axes


def _directions() -> Floats:
    """(92, 3) unit vectors: an icosahedron's corners, two of them up and down, thirds of its edges, its faces."""
    around = [2.0 * math.pi * k / 5.0 for k in range(5)]  # numpy's own cosine depends on the processor
    ring = [np.array([(2.0 * math.cos(a + t), 2.0 * math.sin(a + t)) for a in around]) for t in (0.0, math.pi / 5.0)]
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


def _levels(directions: Floats) -> tuple[Floats, Ints]:
    found = [np.unique(column, return_inverse=True) for column in directions.T]
    most = max(len(values) for values, _ in found)
    padded = [np.append(values, np.full(most - len(values), np.nan)) for values, _ in found]
    return np.stack(padded), np.stack([which for _, which in found]).astype(np.int64)


def _inverses(A: Floats) -> Floats:
    """(n, 3, 3) inverses of matrices, by the cross products of their rows."""
    a, b, c = A[:, 0], A[:, 1], A[:, 2]
    columns = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    return np.asarray(columns / (a * columns[:, :, 0]).sum(axis=1)[:, None, None])


DIRECTIONS = _directions()
_TRIANGLES = ConvexHull(DIRECTIONS).simplices.astype(np.int64)
_TRIANGLES = _TRIANGLES[np.lexsort(np.sort(_TRIANGLES).T)]
#: (corners, 3, 3): maps the extents along its three directions to a corner.
_SOLUTIONS = _inverses(DIRECTIONS[_TRIANGLES])
CORNERS = len(_TRIANGLES)
#: For each axis the different components of the directions along it (levels,), NaN beyond their number; that of each
#: direction (directions,).
_LEVELS, _OF_LEVEL = _levels(DIRECTIONS)
#: The directions as (3, directions), and the length of each across each axis.
_COLUMNS = np.ascontiguousarray(DIRECTIONS.T)
_ACROSS = np.sqrt(1.0 - _COLUMNS**2)


@njit(cache=True)
def reach_turning(points: Floats, count: int, axis: int, low: float, high: float, far: Floats) -> None:
    """Raises far (directions,) to the extents of points that turn by low to high [rad] about a coordinate axis [m].

    Across the axis the extent is the radius of the point's circle if it passes the direction, else that at the nearer
    end.

    Args:
        points: (m, 3), the first ``count`` are turned [m].
        count: Number of points.
        axis: 0, 1, 2 for x, y, z.
        low: Smallest angle [rad].
        high: Largest angle [rad].
        far: (directions,) largest extent so far along each of DIRECTIONS, raised in place [m].
    """
    if high - low >= 2.0 * np.pi:
        _reach_all_around(points, count, axis, far)
        return
    i, j = (axis + 1) % 3, (axis + 2) % 3
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
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


@njit(cache=True, inner=True)
def _reach_all_around(points: Floats, count: int, axis: int, far: Floats) -> None:
    """As ``reach_turning`` for a whole turn: an extent depends only on the direction's component along the axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    of_level = _OF_LEVEL[axis]
    along = _LEVELS[axis, : of_level.max() + 1]
    top, across = np.full(len(along), -np.inf), np.sqrt(1.0 - along**2)
    for k in range(count):
        x, y, z = points[k, i], points[k, j], points[k, axis]
        r = np.sqrt(x * x + y * y)
        for m in range(len(along)):
            there = along[m] * z + across[m] * r
            top[m] = there if there > top[m] else top[m]
    for d in range(len(far)):
        far[d] = max(far[d], top[of_level[d]])


@njit(cache=True)
def around(far: Floats, points: Floats) -> int:
    """Writes the corners of the polytope for far (directions,) [m] into points (>= CORNERS, 3); returns how many."""
    for t in range(CORNERS):
        a, b, c = far[_TRIANGLES[t, 0]], far[_TRIANGLES[t, 1]], far[_TRIANGLES[t, 2]]
        for k in range(3):
            points[t, k] = _SOLUTIONS[t, k, 0] * a + _SOLUTIONS[t, k, 1] * b + _SOLUTIONS[t, k, 2] * c
    return CORNERS


#: Maximum distance outside a triangle, as a share of it, at which a pixel counts as on its edge; avoids gaps between
#: neighbours.
_EDGE = 1e-9


@njit(cache=True)
def visible_front(triangles: Floats, light: Floats, u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Computes the depth of the front of a convex solid at pixels, and the light on the face there.

    Only triangles that face the viewer are drawn, each on the pixels that it covers.

    Args:
        triangles: (f, 3, 3) corners of each, along the view's right, up and towards the viewer, counterclockwise seen
            from outside [m].
        light: (f,) on each of them.
        u: (columns,) of the pixels, to the right, evenly spaced [m].
        v: (rows,) of the pixels, up, evenly spaced [m].

    Returns:
        (rows, columns) depth [m], -inf beside the solid, and (rows, columns) light.
    """
    depth = np.full((len(v), len(u)), -np.inf)
    lit = np.zeros((len(v), len(u)))
    for f in range(len(triangles)):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        bu, bv, cu, cv = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
        area = bu * cv - bv * cu
        if area <= 0.0:  # it faces away or is seen edge-on
            continue
        first, last = np.searchsorted(v, min(a[1], b[1], c[1])), np.searchsorted(v, max(a[1], b[1], c[1]))
        left, right = np.searchsorted(u, min(a[0], b[0], c[0])), np.searchsorted(u, max(a[0], b[0], c[0]))
        for i in range(first, last):
            pv = v[i] - a[1]
            for j in range(left, right):
                pu = u[j] - a[0]
                of_b, of_c = (pu * cv - pv * cu) / area, (bu * pv - bv * pu) / area
                if of_b < -_EDGE or of_c < -_EDGE or of_b + of_c > 1.0 + _EDGE:
                    continue
                near = a[2] + of_b * (b[2] - a[2]) + of_c * (c[2] - a[2])
                if near > depth[i, j]:
                    depth[i, j], lit[i, j] = near, light[f]
    return depth, lit
