"""Which points of a set can be corners of its convex hull: a reduction that never drops a true one.

A hull is grown point by point as a closed surface of triangles. Its arithmetic is only trusted where that can be
proven: a point goes when it is on the inner side of every triangle by more than the rounding error of that test.
Such a point sees the whole closed surface from inside, so it is inside the hull of the surface's corners, however
badly shaped or dented the surface may be. Everything else stays, corner or not. So does every point of a flat set.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hrcreplay.records import Bools, Floats, Ints

Int32s = NDArray[np.int32]

#: Most points that the surface takes in; those beyond stay as they are.
_MOST_SLOTS = 512
#: Rounding error of a side test over (product of the triangle's edges times largest coordinate), with a wide margin.
_ROUNDING = 64 * np.finfo(np.float64).eps
#: Points that stick out less are kept but not built into the surface: they would make slivers [m].
_THIN_M = 1e-10
#: A set whose four most distant points are flatter than this has no surface [m].
_FLAT_M = 1e-7
#: Directions whose extreme points are built in first: the axes and the diagonals of faces and space.
_SEEDS = np.array(
    [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)], dtype=np.float64
)


class Surface(NamedTuple):
    """A closed surface of triangles, room for it included. Row f of the planes and faces is a triangle."""

    planes: Floats  #: (4, faces) outward normal, not of unit length, and its product with a corner
    slack: Floats  #: (2, faces) rounding error of the side test, and how far out a point must be to be built in
    faces: Int32s  #: (faces, 3) slots of the corners, counterclockwise from outside
    owner: Int32s  #: (slots, slots) the face left of the edge from one slot to another
    slots: Ints  #: (slots,) index of the point in each slot
    seen: Bools  #: (faces,) scratch: the faces that the next point can see
    hidden: Ints  #: (faces,) scratch: their numbers
    rim: Int32s  #: (2, slots) scratch: the edges around them, each from a slot to a slot
    follows: Int32s  #: (slots,) scratch: the next slot on the rim


def surface() -> Surface:
    """Room for a surface; one serves for any number of sets."""
    return _surface()


@njit(cache=True)
def _surface() -> Surface:
    faces, slots = 2 * _MOST_SLOTS, _MOST_SLOTS
    return Surface(
        np.empty((4, faces)),
        np.empty((2, faces)),
        np.empty((faces, 3), np.int32),
        np.empty((slots, slots), np.int32),
        np.empty(slots, np.int64),
        np.empty(faces, np.bool_),
        np.empty(faces, np.int64),
        np.empty((2, slots), np.int32),
        np.empty(slots, np.int32),
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
    moved = np.empty(count, np.int64)
    kept = 0
    for i in range(count):
        moved[i] = _same(points, kept, i) if keep[i] else -1
        if moved[i] == kept:
            points[kept] = points[i]
            kept += 1
    for slot in range(slots):
        work.slots[slot] = moved[work.slots[slot]]
    return kept, faces


@njit(cache=True)
def _same(points: Floats, kept: int, i: int) -> int:
    """Where a point stands already among the kept, or where it would go."""
    for k in range(kept):
        if points[k, 0] == points[i, 0] and points[k, 1] == points[i, 1] and points[k, 2] == points[i, 2]:
            return k
    return kept


@njit(cache=True)
def is_inside(x: float, y: float, z: float, faces: int, work: Surface) -> bool:
    """Whether a point is proven to be inside the surface that ``keep_corners`` left."""
    return _sides(x, y, z, faces, work)[0] == 0


@njit(cache=True)
def _grow(points: Floats, count: int, work: Surface, keep: Bools) -> tuple[int, int]:
    """Builds the surface and says which points must stay; returns the numbers of triangles and of slots."""
    size = 0.0
    for i in range(count):
        for k in range(3):
            size = max(size, abs(points[i, k]))
    order = _seeds_first(points, count)
    faces = _simplex(points, order, size, work)
    if faces == 0:
        return 0, 0
    slots = 4
    inner = 0.25 * (points[work.slots[0]] + points[work.slots[1]] + points[work.slots[2]] + points[work.slots[3]])
    for i in order:
        outside, beyond = _sides(points[i, 0], points[i, 1], points[i, 2], faces, work)
        if outside == 0:
            keep[i] = False
        elif beyond > 0 and slots < _MOST_SLOTS:
            grown = _insert(points, i, inner, size, faces, slots, work)
            if grown > 0:
                faces = grown
                slots += 1
    # what was built in, or was near the surface, may be deep inside by now
    for i in range(count):
        if keep[i]:
            outside, beyond = _sides(points[i, 0], points[i, 1], points[i, 2], faces, work)
            keep[i] = outside > 0
    return faces, slots


@njit(cache=True)
def _sides(x: float, y: float, z: float, faces: int, work: Surface) -> tuple[int, int]:
    """For how many triangles a point is not proven to be inside, and for how many it is clearly outside."""
    nx, ny, nz, d = work.planes[0], work.planes[1], work.planes[2], work.planes[3]
    rounding, thin = work.slack[0], work.slack[1]
    outside, beyond = 0, 0
    for f in range(faces):
        height = nx[f] * x + ny[f] * y + nz[f] * z - d[f]
        outside += height >= -rounding[f]
        beyond += height > thin[f]
    return outside, beyond


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
def _simplex(points: Floats, order: Ints, size: float, work: Surface) -> int:
    """Four points far from each other as the first surface; returns its 4 triangles, or 0 for a flat set."""
    a = points[order[0]]
    ib = _farthest(points, order, a, a, a, 1)
    ic = _farthest(points, order, a, points[ib], a, 2)
    idd = _farthest(points, order, a, points[ib], points[ic], 3)
    u, v, w = points[ib] - a, points[ic] - a, points[idd] - a
    normal = _cross(u, v)
    area = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    height = normal[0] * w[0] + normal[1] * w[1] + normal[2] * w[2]
    if area < _FLAT_M**2 or abs(height) < _FLAT_M * area:
        return 0
    work.slots[0], work.slots[3] = order[0], idd
    work.slots[1], work.slots[2] = (ic, ib) if height > 0.0 else (ib, ic)
    for f, (i, j, k) in enumerate(((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0))):
        _set_plane(points, f, i, j, k, size, work)
        _join(f, work)
    return 4


@njit(cache=True)
def _cross(u: Floats, v: Floats) -> tuple[float, float, float]:
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit(cache=True)
def _farthest(points: Floats, order: Ints, a: Floats, b: Floats, c: Floats, corners: int) -> int:
    """The point farthest from a point (1), from the line a b (2), or from the plane a b c (3)."""
    best, index = -1.0, 0
    across = _cross(b - a, c - a)
    for i in order:
        w = points[i] - a
        if corners == 1:
            far = w[0] ** 2 + w[1] ** 2 + w[2] ** 2
        elif corners == 2:
            n = _cross(b - a, w)
            far = n[0] ** 2 + n[1] ** 2 + n[2] ** 2
        else:
            far = abs(across[0] * w[0] + across[1] * w[1] + across[2] * w[2])
        if far > best:
            best, index = far, i
    return index


@njit(cache=True)
def _set_plane(points: Floats, f: int, i: int, j: int, k: int, size: float, work: Surface) -> None:
    """Writes triangle f with corners in slots i, j, k, without joining it to its neighbours."""
    a, b, c = work.slots[i], work.slots[j], work.slots[k]
    x, y, z = points[a, 0], points[a, 1], points[a, 2]
    ux, uy, uz = points[b, 0] - x, points[b, 1] - y, points[b, 2] - z
    vx, vy, vz = points[c, 0] - x, points[c, 1] - y, points[c, 2] - z
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    edges = np.sqrt((ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz))
    work.planes[0, f], work.planes[1, f], work.planes[2, f] = nx, ny, nz
    work.planes[3, f] = nx * x + ny * y + nz * z
    work.slack[0, f] = _ROUNDING * edges * size
    work.slack[1, f] = work.slack[0, f] + _THIN_M * np.sqrt(nx * nx + ny * ny + nz * nz)
    work.faces[f, 0], work.faces[f, 1], work.faces[f, 2] = i, j, k


@njit(cache=True)
def _join(f: int, work: Surface) -> None:
    """Makes triangle f the owner of its edges."""
    i, j, k = work.faces[f, 0], work.faces[f, 1], work.faces[f, 2]
    work.owner[i, j], work.owner[j, k], work.owner[k, i] = f, f, f


@njit(cache=True)
def _insert(points: Floats, index: int, inner: Floats, size: float, faces: int, slots: int, work: Surface) -> int:
    """Replaces the triangles that a point sees by a fan from their rim to it; returns the number of triangles.

    Where rounding leaves no simple rim, or a new triangle that does not face outward, nothing changes: the point
    just stays outside the surface.
    """
    hidden = _look(points[index], faces, work)
    rim = _rim(hidden, work)
    if rim == 0 or faces + rim > len(work.seen):
        return 0
    work.slots[slots] = index
    for n in range(rim):
        f = faces + n
        _set_plane(points, f, work.rim[0, n], work.rim[1, n], slots, size, work)
        nx, ny, nz = work.planes[0, f], work.planes[1, f], work.planes[2, f]
        if nx * inner[0] + ny * inner[1] + nz * inner[2] - work.planes[3, f] >= -work.slack[1, f]:
            return 0
    for f in range(faces, faces + rim):
        work.seen[f] = False
        _join(f, work)
    return _fill(hidden, faces + rim, work)


@njit(cache=True)
def _look(point: Floats, faces: int, work: Surface) -> int:
    """Lists the triangles that a point sees; returns how many."""
    x, y, z = point[0], point[1], point[2]
    n = 0
    for f in range(faces):
        height = work.planes[0, f] * x + work.planes[1, f] * y + work.planes[2, f] * z - work.planes[3, f]
        work.seen[f] = height > work.slack[1, f]
        if work.seen[f]:
            work.hidden[n] = f
            n += 1
    return n


@njit(cache=True)
def _rim(hidden: int, work: Surface) -> int:
    """Lists the edges between seen and unseen triangles; returns how many, 0 unless they are one simple loop.

    A closed surface stays closed when one simple loop is cut out of it and filled anew.
    """
    n = 0
    for h in range(hidden):
        for k in range(3):
            i, j = work.faces[work.hidden[h], k], work.faces[work.hidden[h], (k + 1) % 3]
            if not work.seen[work.owner[j, i]]:
                if n == work.rim.shape[1]:
                    return 0
                work.rim[0, n], work.rim[1, n] = i, j
                n += 1
    for e in range(n):
        work.follows[work.rim[0, e]] = -1
    for e in range(n):
        if work.follows[work.rim[0, e]] != -1:
            return 0
        work.follows[work.rim[0, e]] = work.rim[1, e]
    if n == 0:
        return 0
    corner, steps = work.follows[work.rim[0, 0]], 1
    while corner != work.rim[0, 0] and steps < n:
        corner = work.follows[corner]
        steps += 1
    return n if steps == n and corner == work.rim[0, 0] else 0


@njit(cache=True)
def _fill(hidden: int, end: int, work: Surface) -> int:
    """Moves the last triangles into the places of those no longer needed; returns the number of triangles."""
    for h in range(hidden):
        hole = work.hidden[h]
        while end > hole and work.seen[end - 1]:
            end -= 1
        if end <= hole:
            break
        end -= 1
        for k in range(4):
            work.planes[k, hole] = work.planes[k, end]
        for k in range(2):
            work.slack[k, hole] = work.slack[k, end]
        for k in range(3):
            work.faces[hole, k] = work.faces[end, k]
        work.seen[hole] = False
        _join(hole, work)
    return end
