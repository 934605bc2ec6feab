"""Which points of a set can be corners of its convex hull: a reduction that never drops a true one.

A hull is grown point by point as a closed surface of triangles. Its arithmetic is only trusted where that can be
proven: a point goes when it is on the inner side of every triangle by more than the rounding error of that test.
Such a point sees the whole closed surface from inside, so it is inside the hull of the surface's corners, however
badly shaped or dented the surface may be. Everything else stays, corner or not. So does every point of a flat set.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.human.surface import (
    MOST_FACES,
    MOST_SLOTS,
    POINT,
    A,
    B,
    C,
    Int32s,
    Surface,
    X,
    Y,
    Z,
    fan,
    fill,
    hide,
    is_inside,
    is_loop,
    join,
    join_all,
    look,
    outline,
    set_plane,
)
from hrcreplay.human.vectors import Vector, cross, dot, edge, norm
from hrcreplay.records import Bools, Floats, Ints

#: A set whose four most distant points are flatter than this has no surface [m].
_FLAT_M = 1e-7
#: Directions whose extreme points are built in first: the axes and the diagonals of faces and space.
_SEEDS = np.array(
    [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)], dtype=np.float64
)


@njit(cache=True)
def keep_corners(points: Floats, count: int, work: Surface) -> tuple[int, int]:
    """Moves every point that may be a corner of the hull of the first ``count`` to the front, in their order.

    Args:
        points: (m, 3), reordered in place [m].
        count: Number of points to look at.
        work: Left with the surface around the points.

    Returns:
        Number of points kept, and of triangles around them (0: the set is flat, or too small to have any to drop).
    """
    keep = np.ones(count, np.bool_)
    faces, slots = _grow(points, count, work, keep) if count > 4 else (0, 0)
    moved = np.full(count, -1)
    marks = np.empty(count)  # the same for points that are the same
    kept = 0
    for i in range(count):
        mark = points[i, 0] + 0.7 * points[i, 1] + 0.3 * points[i, 2]
        if not keep[i]:
            continue
        moved[i] = _same(points, kept, i) if _among(mark, marks, kept) else kept
        if moved[i] == kept:
            points[kept], marks[kept] = points[i], mark
            kept += 1
    for slot in range(slots):
        work.faces[POINT, slot] = moved[work.faces[POINT, slot]]
    return kept, faces


@njit(cache=True)
def _among(mark: float, marks: Floats, kept: int) -> bool:
    """Whether a mark is among the first."""
    alike = 0
    for k in range(kept):
        alike += marks[k] == mark
    return alike > 0


@njit(cache=True)
def _same(points: Floats, kept: int, i: int) -> int:
    """Where a point stands already among the kept, or where it would go."""
    for k in range(kept):
        if points[k, 0] == points[i, 0] and points[k, 1] == points[i, 1] and points[k, 2] == points[i, 2]:
            return k
    return kept


@njit(cache=True)
def _grow(points: Floats, count: int, work: Surface, keep: Bools) -> tuple[int, int]:
    """Builds the surface and says which points must stay; returns the numbers of triangles and of slots."""
    size = 0.0
    for i in range(count):
        for k in range(3):
            size = max(size, abs(points[i, k]))
    order = _seeds_first(points, count)
    width = min(count, MOST_SLOTS)
    faces = _simplex(points, order, size, width, work)
    if faces == 0:
        return 0, 0
    planes, triangles, owner = work
    inner = (_mean(planes[X]), _mean(planes[Y]), _mean(planes[Z]))
    slots = 4
    for n in range(count):
        i = order[n]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        outside, beyond = look(x, y, z, faces, planes, triangles)
        if outside == 0:
            keep[i] = False
        elif beyond > 0 and slots < MOST_SLOTS:
            triangles[POINT, slots] = i
            planes[X, slots], planes[Y, slots], planes[Z, slots] = x, y, z
            hidden = hide(faces, triangles)
            edges = outline(hidden, width, triangles, owner)
            end = faces + edges
            if edges == 0 or end > MOST_FACES or not is_loop(edges, triangles):
                continue
            if fan(inner, size, faces, edges, slots, planes, triangles):
                join_all(faces, end, width, triangles, owner)
                faces = fill(hidden, end, width, planes, triangles, owner)
                slots += 1
    _drop_inner(points, count, faces, planes, triangles, keep)
    return faces, slots


@njit(cache=True)
def _drop_inner(points: Floats, count: int, faces: int, planes: Floats, triangles: Int32s, keep: Bools) -> None:
    """Drops what was built in, or was near the surface, and is deep inside by now; its corners cannot be."""
    corner = np.zeros(count, np.bool_)
    for f in range(faces):
        for k in (A, B, C):
            corner[triangles[POINT, triangles[k, f]]] = True
    for i in range(count):
        if keep[i] and not corner[i]:
            keep[i] = not is_inside(points[i, 0], points[i, 1], points[i, 2], faces, planes)


@njit(cache=True)
def _mean(along: Floats) -> float:
    return 0.25 * (along[0] + along[1] + along[2] + along[3])


@njit(cache=True)
def _seeds_first(points: Floats, count: int) -> Ints:
    """Indices of the points, the extreme ones of some directions first: they make the surface big soon."""
    first = np.zeros(count, np.bool_)
    order = np.empty(count, np.int64)
    n = 0
    for seed in _SEEDS:
        x, y, z = seed[0], seed[1], seed[2]
        low, high, lowest, highest = 0, 0, np.inf, -np.inf
        for i in range(count):
            along = x * points[i, 0] + y * points[i, 1] + z * points[i, 2]
            if along < lowest:
                low, lowest = i, along
            if along > highest:
                high, highest = i, along
        for i in (low, high):
            if not first[i]:
                first[i] = True
                order[n] = i
                n += 1
    for i in range(count):
        if not first[i]:
            order[n] = i
            n += 1
    return order


@njit(cache=True)
def _simplex(points: Floats, order: Ints, size: float, width: int, work: Surface) -> int:
    """Four points far from each other as the first surface; returns its 4 triangles, or 0 for a flat set."""
    a = order[0]
    b = _farthest(points, a, (0.0, 0.0, 0.0), 1, len(order))
    along = edge(points, a, b)
    c = _farthest(points, a, along, 2, len(order))
    normal = cross(along, edge(points, a, c))
    d = _farthest(points, a, normal, 3, len(order))
    area, height = norm(normal), dot(normal, edge(points, a, d))
    if area < _FLAT_M**2 or abs(height) < _FLAT_M * area:
        return 0
    planes, faces, owner = work
    p = faces[POINT]
    p[0], p[3] = a, d
    p[1], p[2] = (c, b) if height > 0.0 else (b, c)
    for slot in range(4):
        planes[X, slot], planes[Y, slot], planes[Z, slot] = points[p[slot], 0], points[p[slot], 1], points[p[slot], 2]
    for f, (i, j, k) in enumerate(((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0))):
        set_plane(f, i, j, k, size, planes, faces)
        join(f, width, faces, owner)
    return 4


@njit(cache=True)
def _farthest(points: Floats, a: int, v: Vector, rank: int, count: int) -> int:
    """The point farthest from point a (1), from the line through it along v (2), or from the plane across v (3)."""
    best, index = -1.0, a
    for i in range(count):
        w = edge(points, a, i)
        if rank == 3:
            far = abs(dot(v, w))
        else:
            n = cross(v, w) if rank == 2 else w
            far = dot(n, n)
        if far > best:
            best, index = far, i
    return index
