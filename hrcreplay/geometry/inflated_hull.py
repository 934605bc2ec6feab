"""A convex hull with a ball around every point: distances from it, its volume above a height, volumes of unions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hrcreplay.geometry.convex_hull import hull, sphere_swept_volume_m3
from hrcreplay.geometry.vectors import Vector, dot
from hrcreplay.kernels import njit
from hrcreplay.records import Bools, Floats, Ints

#: A triangle counts as visible from a point that is not clearly behind it, as no point in the plane of a flat set is in
#: front of it. Distance behind a triangle that is clear, and that distance relative to the largest coordinate.
_BEHIND_M = 1e-9
_COARSE = 16.0 * float(np.finfo(np.float64).eps)
#: Largest root of g^4 = g + 1: powers of 1/g fill a cube evenly (a generalised golden ratio).
_G = 1.2207440846057594759
_STEPS = np.array([1.0 / _G, 1.0 / _G**2, 1.0 / _G**3])
_PARTS = 4
#: Number of sample points in the box of the part below a height: their error is 0.2 % of that box.
_BELOW = 2048
#: Number of points whose triangles are found at once.
_BLOCK = 256


@dataclass(frozen=True)
class InflatedHull:
    """A convex hull with a ball around every point, Eq. (41)."""

    vertices_m: Floats  #: (m, 3) corners of the hull [m]
    faces: Ints  #: (f, 3) triangles as ``hull`` gives them
    radius_m: float

    @classmethod
    def around(cls, points_m: Floats, radius_m: float) -> InflatedHull:
        """Makes the solid of a set of points (n, 3), all finite [m]."""
        vertices, faces = hull(points_m)
        return cls(np.ascontiguousarray(vertices), np.ascontiguousarray(faces), radius_m)

    def volume_m3(self) -> float:
        """Its volume [m^3]."""
        return sphere_swept_volume_m3(self.vertices_m, self.radius_m, self.faces)

    def volume_above_m3(self, height_m: float) -> float:
        """Volume of the part above a height: the total minus that below, estimated from evenly spread points [m^3].

        Args:
            height_m: Height, such as that of the floor [m].
        """
        low, high = self.vertices_m.min(axis=0) - self.radius_m, self.vertices_m.max(axis=0) + self.radius_m
        if low[2] >= height_m:
            return self.volume_m3()
        high[2] = min(high[2], height_m)
        return max(
            self.volume_m3() - float(np.prod(high - low)) * float(_inside([self], low, high, _BELOW).mean()), 0.0
        )

    def distances_m(self, points_m: Floats) -> Floats:
        """(k,) distance of points (k, 3) from the hull, before the ball; 0 inside, NaN for a NaN point [m].

        Exact: from a point outside, the nearest point of a hull lies on a triangle that the point sees.
        """
        return _distances(np.ascontiguousarray(points_m), self.vertices_m, self.faces)


def union_volume_m3(solids: Sequence[InflatedHull], points: int, first: int = 0) -> tuple[float, float]:
    """Volume of a union of inflated hulls, from the share of evenly spread points of their common box.

    The points are those of an additive recurrence with a generalised golden ratio, so the result is repeatable. Its
    error is estimated from the spread between four parts of the sequence, each of which fills the box.

    Args:
        solids: At least one.
        points: Number of points, a multiple of 4.
        first: Start in the sequence, so that errors of different calls do not add up.

    Returns:
        The volume and its standard error [m^3].
    """
    low = np.min([s.vertices_m.min(axis=0) - s.radius_m for s in solids], axis=0)
    high = np.max([s.vertices_m.max(axis=0) + s.radius_m for s in solids], axis=0)
    shares = _inside(solids, low, high, points, first).reshape(_PARTS, -1).mean(axis=1)
    box = float(np.prod(high - low))
    return box * float(shares.mean()), box * float(shares.std(ddof=1)) / _PARTS**0.5


def _inside(solids: Sequence[InflatedHull], low: Floats, high: Floats, points: int, first: int = 0) -> Bools:
    """Marks the points in any of the solids, for points spread evenly in a box from ``low`` to ``high`` (3,) [m]."""
    samples = _spread(first, points) * (high - low) + low
    inside = np.zeros(points, dtype=np.bool_)
    for solid in solids:
        _mark(samples, solid.vertices_m, solid.faces, solid.radius_m, inside)
    return inside


@lru_cache(maxsize=2)
def _spread(first: int, points: int) -> Floats:
    """(points, 3) of the unit cube, evenly spread."""
    return np.asarray((0.5 + np.arange(first, first + points)[:, None] * _STEPS) % 1.0)


@njit(cache=True)
def _distances(points: Floats, vertices: Floats, faces: Ints) -> Floats:
    normals, offsets = _planes(vertices, faces)
    behind = _behind(vertices)
    found = np.empty(len(points))
    for i in range(len(points)):
        found[i] = _distance(_corner(points, i), vertices, faces, normals, offsets, behind, 0.0)
    return found


@njit(cache=True, inner=True)
def _behind(vertices: Floats) -> float:
    """Distance behind a triangle at which a point counts as clearly behind it [m]."""
    size = 0.0
    for vertex in vertices:
        for k in range(3):
            size = max(size, abs(vertex[k]))
    return max(_BEHIND_M, _COARSE * size)


@njit(cache=True)
def _mark(points: Floats, vertices: Floats, faces: Ints, radius: float, inside: Bools) -> None:
    """Sets ``inside`` where a point is within ``radius`` of the hull."""
    normals, offsets = _planes(vertices, faces)
    behind = _behind(vertices)
    low, high = vertices[0].copy(), vertices[0].copy()
    for vertex in vertices:
        for k in range(3):
            low[k], high[k] = min(low[k], vertex[k]), max(high[k], vertex[k])
    some, which, count = np.empty((3, _BLOCK)), np.empty(_BLOCK, np.int64), 0
    highest, facing = np.empty(_BLOCK), np.empty(_BLOCK, np.int64)
    for i in range(len(points)):
        outside = inside[i]
        for k in range(3):
            outside = outside or points[i, k] < low[k] - radius or points[i, k] > high[k] + radius
            some[k, count] = points[i, k]
        which[count] = i
        count += not outside
        if count < _BLOCK and i + 1 < len(points):
            continue
        _find_facing(some, normals, offsets, highest, facing)
        for j in range(count):
            if highest[j] > radius:
                continue
            point, f, near = (some[0, j], some[1, j], some[2, j]), facing[j], False
            if len(faces):  # mostly the nearest triangle is the one that faces the point most
                near = highest[j] < -behind
                near = near or _triangle(point, vertices, faces, normals, f, highest[j]) <= radius * radius
                if not near and _is_beyond(point, vertices, faces[f], radius):
                    continue
            inside[which[j]] = near or _distance(point, vertices, faces, normals, offsets, behind, radius) <= radius
        count = 0


@njit(cache=True, inner=True)
def _find_facing(points: Floats, normals: Floats, offsets: Floats, highest: Floats, facing: Ints) -> None:
    """The triangle that faces each point most.

    Args:
        points: (3, k) [m].
        normals: (f, 3) of the triangles.
        offsets: (f,) of their planes [m].
        highest: (k,) receives the largest height above a plane [m].
        facing: (k,) receives that triangle.
    """
    x, y, z = points[0], points[1], points[2]
    highest[:], facing[:] = -np.inf, 0
    for f in range(len(normals)):
        u, v, w, offset = normals[f, 0], normals[f, 1], normals[f, 2], offsets[f]
        for i in range(len(x)):  # written so that several points are taken at once
            height = u * x[i] + v * y[i] + w * z[i] - offset
            higher = height > highest[i]
            highest[i] = height if higher else highest[i]
            facing[i] = f if higher else facing[i]


@njit(cache=True, inner=True)
def _planes(vertices: Floats, faces: Ints) -> tuple[Floats, Floats]:
    """Outward unit normals (f, 3) and their products with a corner (f,); a triangle without area has normal 0."""
    normals, offsets = np.zeros((len(faces), 3)), np.zeros(len(faces))
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        x = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
        y = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
        z = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        size = np.sqrt(x * x + y * y + z * z)
        if size > 0.0:
            normals[f, 0], normals[f, 1], normals[f, 2] = x / size, y / size, z / size
        offsets[f] = normals[f, 0] * a[0] + normals[f, 1] * a[1] + normals[f, 2] * a[2]
    return normals, offsets


@njit(cache=True, inner=True)
def _corner(vertices: Floats, v: int) -> Vector:
    return vertices[v, 0], vertices[v, 1], vertices[v, 2]


@njit(cache=True, inner=True)
def _distance(
    point: Vector,
    vertices: Floats,
    faces: Ints,
    normals: Floats,
    offsets: Floats,
    behind: float,
    enough: float,
) -> float:
    """Distance of a point from the hull, or any upper bound of it that is at most ``enough`` [m]."""
    if np.isnan(point[0] + point[1] + point[2]):
        return np.nan
    if len(faces) == 0:
        return np.sqrt(_segment(point, _corner(vertices, 0), _corner(vertices, len(vertices) - 1)))
    nearest = np.inf
    for f in range(len(faces)):
        height = dot((normals[f, 0], normals[f, 1], normals[f, 2]), point) - offsets[f]
        if height > -behind and height * height < nearest:
            nearest = min(nearest, _triangle(point, vertices, faces, normals, f, height))
            if np.sqrt(nearest) <= enough:
                break
    return 0.0 if nearest == np.inf else np.sqrt(nearest)


@njit(cache=True, inner=True)
def _triangle(p: Vector, vertices: Floats, faces: Ints, normals: Floats, f: int, height: float) -> float:
    """Squared distance of p from triangle f: from its plane where p is above it, else from its edges."""
    a, b, c = _corner(vertices, faces[f, 0]), _corner(vertices, faces[f, 1]), _corner(vertices, faces[f, 2])
    normal = normals[f, 0], normals[f, 1], normals[f, 2]
    above = normal[0] != 0.0 or normal[1] != 0.0 or normal[2] != 0.0
    above = above and _left(p, a, b, normal) and _left(p, b, c, normal) and _left(p, c, a, normal)
    if above:
        return height * height
    return min(_segment(p, a, b), _segment(p, b, c), _segment(p, c, a))


@njit(cache=True, inner=True)
def _is_beyond(p: Vector, vertices: Floats, triangle: Ints, radius: float) -> bool:
    """Returns True if a plane square to the way from the nearest edge of a triangle to p is too far from the hull."""
    away, apart2 = (0.0, 0.0, 0.0), np.inf
    for k in range(3):
        other = _from_segment(p, _corner(vertices, triangle[k]), _corner(vertices, triangle[(k + 1) % 3]))
        if dot(other, other) < apart2:
            away, apart2 = other, dot(other, other)
    top = -np.inf
    for v in range(len(vertices)):
        top = max(top, dot(away, _corner(vertices, v)))
    return dot(away, p) - top > radius * np.sqrt(apart2)


@njit(cache=True, inner=True)
def _left(p: Vector, a: Vector, b: Vector, normal: Vector) -> bool:
    """Returns True if p is on the inner side of the edge from a to b of a triangle with that normal."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    wx, wy, wz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    x, y, z = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    return x * normal[0] + y * normal[1] + z * normal[2] >= 0.0


@njit(cache=True, inner=True)
def _segment(p: Vector, a: Vector, b: Vector) -> float:
    """Squared distance of p from the segment a b, which may be a point."""
    away = _from_segment(p, a, b)
    return dot(away, away)


@njit(cache=True, inner=True)
def _from_segment(p: Vector, a: Vector, b: Vector) -> Vector:
    """Vector to p from the nearest point of the segment a b, which may be a point."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    wx, wy, wz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    length = ux * ux + uy * uy + uz * uz
    t = 0.0
    if length > 0.0:
        t = max(0.0, min((ux * wx + uy * wy + uz * wz) / length, 1.0))
    return wx - t * ux, wy - t * uy, wz - t * uz
