"""An incremental convex hull, and the reduction of a point set to those points that may be its corners.

A point is dropped only when it is on the inner side of every triangle of a closed surface by more than the rounding
error of that test. Such a point is inside the hull of the surface's corners for any shape of the surface, even if it is
not convex. All other points are kept, corners or not, and all points of a flat set.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hrcreplay.geometry.vectors import Vector, cross, dot, edge, norm
from hrcreplay.kernels import njit
from hrcreplay.records import Bools, Floats, Ints

Int32s = NDArray[np.int32]

#: Maximum number of points in the surface; further points are kept without a test.
MOST_SLOTS = 512
#: Maximum number of triangles of a closed surface with that many points.
MOST_FACES = 2 * MOST_SLOTS
#: Rounding error of a side test over (product of the triangle's edges times largest coordinate), with a wide margin.
_ROUNDING = 64 * np.finfo(np.float64).eps
#: Points that protrude by less are kept but not added to the surface, as they would make slivers [m].
_THIN_M = 1e-10
#: Thickness of a set, relative to its largest coordinate (or 1 m), below which its hull is not proven here.
_THIN_SHARE = 1e-6
#: Rows of ``Surface.planes``: outward normal, not of unit length, its product with a corner, rounding error of the side
#: test, and the protrusion at which a point is added; and per slot: the position of its point [m].
NX, NY, NZ, OFFSET, ROUNDING, THIN, X, Y, Z = range(9)
#: Rows of ``Surface.faces``: slots of the corners, counterclockwise from outside; for the next point to add, a mark for
#: each triangle visible from it, the numbers of these triangles, and the rim around them, from slots to slots.
A, B, C, SEEN, HIDDEN, START, END = range(7)
#: Per slot: the next slot on the rim, and the index of its point.
FOLLOWS, POINT = 7, 8


class Surface(NamedTuple):
    """A closed surface of triangles with its memory; it has few arrays, as each costs time in every call."""

    planes: Floats  #: (9, faces) one triangle or slot per column
    faces: Int32s  #: (9, faces) a triangle, slot or edge each column
    owner: Int32s  #: (slots^2,) the face left of the edge from slot i to slot j, at i * width + j


def surface() -> Surface:
    """Allocates a surface; it can be reused for any number of sets."""
    most = 3 * MOST_FACES  # edges of as many triangles
    return Surface(np.empty((9, MOST_FACES)), np.empty((9, most), np.int32), np.empty(MOST_SLOTS**2, np.int32))


@njit(cache=True, inner=True)
def is_inside(x: float, y: float, z: float, count: int, planes: Floats) -> bool:  # noqa: D417
    """Returns True if a point is proven to be inside all triangles.

    Args:
        x, y, z: The point [m].
        count, planes: Number of triangles, and the surface's planes.
    """
    outside = 0
    for f in range(count):
        height = planes[NX, f] * x + planes[NY, f] * y + planes[NZ, f] * z - planes[OFFSET, f]
        outside += height >= -planes[ROUNDING, f]
    return outside == 0


@njit(cache=True, inner=True)
def _look(x: float, y: float, z: float, count: int, planes: Floats, faces: Int32s) -> tuple[int, int]:  # noqa: D417
    """Counts the triangles for which a point is not proven to be inside, and those for which it is clearly outside.

    Args:
        x, y, z: The point [m].
        count, planes, faces: Number of triangles, and the surface; row SEEN of ``faces`` is written.
    """
    outside, beyond = 0, 0
    for f in range(count):
        height = planes[NX, f] * x + planes[NY, f] * y + planes[NZ, f] * z - planes[OFFSET, f]
        outside += height >= -planes[ROUNDING, f]
        beyond += height > planes[THIN, f]
        faces[SEEN, f] = height > planes[THIN, f]
    return outside, beyond


@njit(cache=True, inner=True)
def _set_plane(f: int, i: int, j: int, k: int, size: float, planes: Floats, faces: Int32s) -> None:  # noqa: D417
    """Writes triangle f with corners in slots i, j, k, without joining it to its neighbours.

    Args:
        f, i, j, k: The triangle, and its corners counterclockwise seen from outside.
        size, planes, faces: Largest absolute coordinate of the points [m], and the surface; column f is written.
    """
    x, y, z = planes[X, i], planes[Y, i], planes[Z, i]
    ux, uy, uz = planes[X, j] - x, planes[Y, j] - y, planes[Z, j] - z
    vx, vy, vz = planes[X, k] - x, planes[Y, k] - y, planes[Z, k] - z
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    edges = np.sqrt((ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz))
    planes[NX, f], planes[NY, f], planes[NZ, f] = nx, ny, nz
    planes[OFFSET, f] = nx * x + ny * y + nz * z
    rounding = _ROUNDING * edges * size
    planes[ROUNDING, f] = rounding
    planes[THIN, f] = rounding + _THIN_M * np.sqrt(nx * nx + ny * ny + nz * nz)
    faces[A, f], faces[B, f], faces[C, f] = i, j, k


@njit(cache=True, inner=True)
def _join(f: int, width: int, faces: Int32s, owner: Int32s) -> None:  # noqa: D417
    """Makes triangle f the owner of its edges.

    Args:
        f, width, faces, owner: The triangle, the number of slots in a row of ``owner``, and the surface.
    """
    i, j, k = faces[A, f], faces[B, f], faces[C, f]
    owner[i * width + j] = f
    owner[j * width + k] = f
    owner[k * width + i] = f


@njit(cache=True, inner=True)
def _hide(count: int, faces: Int32s) -> int:
    """Lists the triangles visible from the last tested point; returns their number."""
    hidden = 0
    for f in range(count):
        faces[HIDDEN, hidden] = f
        hidden += faces[SEEN, f]
    return hidden


@njit(cache=True, inner=True)
def _outline(hidden: int, width: int, faces: Int32s, owner: Int32s) -> int:  # noqa: D417
    """Lists the edges between visible and hidden triangles; returns their number.

    Args:
        hidden, width: Number of visible triangles, and of slots in a row of ``owner``.
        faces, owner: The surface; rows START and END of ``faces`` are written.
    """
    n = 0
    for h in range(hidden):
        f = faces[HIDDEN, h]
        i, j, k = faces[A, f], faces[B, f], faces[C, f]
        faces[START, n], faces[END, n] = i, j
        n += faces[SEEN, owner[j * width + i]] == 0
        faces[START, n], faces[END, n] = j, k
        n += faces[SEEN, owner[k * width + j]] == 0
        faces[START, n], faces[END, n] = k, i
        n += faces[SEEN, owner[i * width + k]] == 0
    return n


@njit(cache=True)
def is_loop(edges: int, faces: Int32s) -> bool:
    """Returns True if the edges are one simple loop, so that the surface stays closed when the inside is replaced.

    The edges enter each slot as often as they leave it, so a walk along them can always continue. A walk that returns
    to the start after as many steps as there are edges, and not before, has used each of them.
    """
    for e in range(edges):
        faces[FOLLOWS, faces[START, e]] = faces[END, e]
    start = faces[START, 0]
    corner, back = faces[FOLLOWS, start], 0
    for _ in range(edges - 1):
        back += corner == start
        corner = faces[FOLLOWS, corner]
    return back == 0 and corner == start


@njit(cache=True, inner=True)
def _fan(inner: Vector, size: float, count: int, edges: int, slot: int, planes: Floats, faces: Int32s) -> bool:  # noqa: D417
    """Adds triangles from the edges to the point in a slot, not joined yet; returns True if all face outward.

    Args:
        inner, size: A point inside the surface, and the largest absolute coordinate of the points [m].
        count, edges, slot: Number of triangles before, number of edges, and the slot of the point.
        planes, faces: The surface; columns from ``count`` on are written.
    """
    inward = 0
    for n in range(edges):
        f = count + n
        _set_plane(f, faces[START, n], faces[END, n], slot, size, planes, faces)
        height = planes[NX, f] * inner[0] + planes[NY, f] * inner[1] + planes[NZ, f] * inner[2] - planes[OFFSET, f]
        inward += height >= -planes[THIN, f]
    return inward == 0


@njit(cache=True, inner=True)
def _join_all(start: int, end: int, width: int, faces: Int32s, owner: Int32s) -> None:  # noqa: D417
    """Joins new triangles to their neighbours.

    Args:
        start, end: The first of the new triangles, and the one after the last.
        width, faces, owner: Number of slots in a row of ``owner``, and the surface.
    """
    for f in range(start, end):
        faces[SEEN, f] = 0
        _join(f, width, faces, owner)


@njit(cache=True, inner=True)
def _fill(hidden: int, end: int, width: int, planes: Floats, faces: Int32s, owner: Int32s) -> int:  # noqa: D417
    """Moves the last triangles into the columns of removed ones; returns the number of triangles.

    Args:
        hidden, end: Number of removed triangles, and of all triangles including these.
        width, planes, faces, owner: Number of slots in a row of ``owner``, and the surface.
    """
    for h in range(hidden):
        hole = faces[HIDDEN, h]
        while end > hole and faces[SEEN, end - 1]:
            end -= 1
        if end > hole:
            end -= 1
            _move(end, hole, planes, faces)
            _join(hole, width, faces, owner)
    return end


@njit(cache=True, inner=True)
def _move(f: int, hole: int, planes: Floats, faces: Int32s) -> None:
    for k in (NX, NY, NZ, OFFSET, ROUNDING, THIN):
        planes[k, hole] = planes[k, f]
    for k in (A, B, C):
        faces[k, hole] = faces[k, f]
    faces[SEEN, hole] = 0


#: A set whose four most distant points are flatter than this has no surface [m].
_FLAT_M = 1e-7
#: Directions whose extreme points are added first: the axes and the diagonals of faces and space.
_SEEDS = np.array(
    [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)], dtype=np.float64
)


@njit(cache=True)
def keep_corners(points: Floats, count: int, work: Surface) -> tuple[int, int]:
    """Moves every point that may be a corner of the hull of the first ``count`` to the front, in their order.

    Args:
        points: (m, 3), reordered in place [m].
        count: Number of points to test.
        work: Receives the surface around the points.

    Returns:
        Number of points kept, and of triangles around them (0: the set is flat or too small for a reduction).
    """
    keep = np.ones(count, np.bool_)
    faces, slots = _grow(points, count, work, keep) if count > 4 else (0, 0)
    moved = np.full(count, -1)
    marks = np.empty(count)  # the same for equal points
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
def solid_hull(points: Floats, work: Surface) -> tuple[Ints, Ints]:
    """The convex hull of a set, if its surface is proven to be that: closed, and no point protrudes from a triangle.

    A point that protrudes by less than ``_THIN_M`` is no corner; one between corners may be among them.

    Args:
        points: (n, 3), all finite [m].
        work: Receives the surface.

    Returns:
        (m,) indices of the corners, increasing, and (f, 3) triangles of them, counterclockwise seen from outside. Both
        are empty if nothing is proven, as for a thin set, one of less than 5 points, or one with a triangle so narrow
        that rounding decides on its normal.
    """
    nothing, n = np.empty(0, np.int64), len(points)
    count, _ = _grow(points, n, work, np.ones(n, np.bool_)) if n > 4 else (0, 0)
    planes, triangles, _ = work
    count = 0 if count and (_is_thin(planes) or _has_sliver(count, planes)) else count
    for i in range(n):
        if count and _look(points[i, 0], points[i, 1], points[i, 2], count, planes, triangles)[1] > 0:
            count = 0
    place = np.full(n, -1)
    for f in range(count):
        for k in (A, B, C):
            place[triangles[POINT, triangles[k, f]]] = 0
    corners = np.flatnonzero(place == 0) if count else nothing
    for k in range(len(corners)):
        place[corners[k]] = k
    faces = np.empty((count, 3), np.int64)
    for f in range(count):
        for k in range(3):
            faces[f, k] = place[triangles[POINT, triangles[k, f]]]
    return corners, faces


@njit(cache=True, inner=True)
def _is_thin(planes: Floats) -> bool:
    """Returns True if the first four points of a surface are near a line or a plane, relative to their coordinates."""
    corners = np.ascontiguousarray(planes[X : Z + 1, :4].T)
    size, along, normal = np.abs(corners).max(), edge(corners, 0, 1), cross(edge(corners, 0, 1), edge(corners, 0, 2))
    area = norm(normal)
    least = _THIN_SHARE * max(size, 1.0)
    return area < least * norm(along) or abs(dot(normal, edge(corners, 0, 3))) < least * area


@njit(cache=True, inner=True)
def _has_sliver(count: int, planes: Floats) -> bool:
    """Returns True if the side test of a triangle may be off by more than ``_THIN_M``."""
    for f in range(count):
        if not planes[ROUNDING, f] <= _THIN_M * np.sqrt(planes[NX, f] ** 2 + planes[NY, f] ** 2 + planes[NZ, f] ** 2):
            return True
    return False


@njit(cache=True, inner=True)
def _among(mark: float, marks: Floats, kept: int) -> bool:
    """Returns True if a mark is among the first ones."""
    alike = 0
    for k in range(kept):
        alike += marks[k] == mark
    return alike > 0


@njit(cache=True, inner=True)
def _same(points: Floats, kept: int, i: int) -> int:
    """Returns the index at which a point is kept already or would be inserted."""
    for k in range(kept):
        if points[k, 0] == points[i, 0] and points[k, 1] == points[i, 1] and points[k, 2] == points[i, 2]:
            return k
    return kept


@njit(cache=True, inner=True)
def _grow(points: Floats, count: int, work: Surface, keep: Bools) -> tuple[int, int]:
    """Builds the surface and marks the points to keep; returns the numbers of triangles and of slots."""
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
        outside, beyond = _look(x, y, z, faces, planes, triangles)
        if outside == 0:
            keep[i] = False
        elif beyond > 0 and slots < MOST_SLOTS:
            triangles[POINT, slots] = i
            planes[X, slots], planes[Y, slots], planes[Z, slots] = x, y, z
            hidden = _hide(faces, triangles)
            edges = _outline(hidden, width, triangles, owner)
            end = faces + edges
            if edges == 0 or end > MOST_FACES or not is_loop(edges, triangles):
                continue
            if _fan(inner, size, faces, edges, slots, planes, triangles):
                _join_all(faces, end, width, triangles, owner)
                faces = _fill(hidden, end, width, planes, triangles, owner)
                slots += 1
    _drop_inner(points, count, faces, planes, triangles, keep)
    return faces, slots


@njit(cache=True, inner=True)
def _drop_inner(points: Floats, count: int, faces: int, planes: Floats, triangles: Int32s, keep: Bools) -> None:
    """Drops points that were added, or were near the surface, and are now deep inside; corners of the surface stay."""
    corner = np.zeros(count, np.bool_)
    for f in range(faces):
        for k in (A, B, C):
            corner[triangles[POINT, triangles[k, f]]] = True
    for i in range(count):
        if keep[i] and not corner[i]:
            keep[i] = not is_inside(points[i, 0], points[i, 1], points[i, 2], faces, planes)


@njit(cache=True, inner=True)
def _mean(along: Floats) -> float:
    return 0.25 * (along[0] + along[1] + along[2] + along[3])


@njit(cache=True, inner=True)
def _seeds_first(points: Floats, count: int) -> Ints:
    """Returns the indices of the points, extreme ones first, so that the surface grows quickly."""
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


@njit(cache=True, inner=True)
def _simplex(points: Floats, order: Ints, size: float, width: int, work: Surface) -> int:
    """Builds the first surface from four distant points; returns 4, its number of triangles, or 0 for a flat set."""
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
        _set_plane(f, i, j, k, size, planes, faces)
        _join(f, width, faces, owner)
    return 4


@njit(cache=True, inner=True)
def _farthest(points: Floats, a: int, v: Vector, rank: int, count: int) -> int:
    """Finds the point farthest from a point a (1), from the line along v through a (2) or the plane normal to v (3)."""
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
