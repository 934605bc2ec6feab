"""A closed surface of triangles that grows point by point: the working part of ``corners``."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hrcreplay.records import Bools, Floats, Ints

Int32s = NDArray[np.int32]

#: Most points that the surface takes in; those beyond stay as they are.
MOST_SLOTS = 512
#: Rounding error of a side test over (product of the triangle's edges times largest coordinate), with a wide margin.
_ROUNDING = 64 * np.finfo(np.float64).eps
#: Points that stick out less are kept but not built into the surface: they would make slivers [m].
_THIN_M = 1e-10


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
    faces, slots = 2 * MOST_SLOTS, MOST_SLOTS
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
def sides(x: float, y: float, z: float, faces: int, work: Surface) -> tuple[int, int]:
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
def set_plane(points: Floats, f: int, i: int, j: int, k: int, size: float, work: Surface) -> None:
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
def join(f: int, work: Surface) -> None:
    """Makes triangle f the owner of its edges."""
    i, j, k = work.faces[f, 0], work.faces[f, 1], work.faces[f, 2]
    work.owner[i, j], work.owner[j, k], work.owner[k, i] = f, f, f


@njit(cache=True)
def insert(points: Floats, index: int, inner: Floats, size: float, faces: int, slots: int, work: Surface) -> int:
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
        set_plane(points, f, work.rim[0, n], work.rim[1, n], slots, size, work)
        nx, ny, nz = work.planes[0, f], work.planes[1, f], work.planes[2, f]
        if nx * inner[0] + ny * inner[1] + nz * inner[2] - work.planes[3, f] >= -work.slack[1, f]:
            return 0
    for f in range(faces, faces + rim):
        work.seen[f] = False
        join(f, work)
    return _fill(hidden, faces + rim, work)


@njit(cache=True)
def _look(point: Floats, faces: int, work: Surface) -> int:
    """Lists the triangles that a point sees; returns how many."""
    x, y, z = point[0], point[1], point[2]
    nx, ny, nz, d = work.planes[0], work.planes[1], work.planes[2], work.planes[3]
    seen, thin, hidden = work.seen, work.slack[1], work.hidden
    for f in range(faces):
        seen[f] = nx[f] * x + ny[f] * y + nz[f] * z - d[f] > thin[f]
    n = 0
    for f in range(faces):
        if seen[f]:
            hidden[n] = f
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
        join(hole, work)
    return end
