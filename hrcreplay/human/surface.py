"""A closed surface of triangles that grows point by point: the working part of ``corners``."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hrcreplay.human.vectors import Vector
from hrcreplay.records import Floats

Int32s = NDArray[np.int32]

#: Most points that the surface takes in; those beyond stay as they are.
MOST_SLOTS = 512
#: Most triangles: no closed surface has more.
MOST_FACES = 2 * MOST_SLOTS
#: Rounding error of a side test over (product of the triangle's edges times largest coordinate), with a wide margin.
_ROUNDING = 64 * np.finfo(np.float64).eps
#: Points that stick out less are kept but not built into the surface: they would make slivers [m].
_THIN_M = 1e-10
#: Rows of ``Surface.planes``: outward normal, not of unit length, its product with a corner, rounding error of the side
#: test, and how far out a point must be to be built in; and of a slot: where its point is [m].
NX, NY, NZ, OFFSET, ROUNDING, THIN, X, Y, Z = range(9)
#: Rows of ``Surface.faces``: slots of the corners, counterclockwise from outside; for the next point to build in,
#: whether it sees a triangle, the numbers of those, and the rim around them, from slots to slots.
A, B, C, SEEN, HIDDEN, START, END = range(7)
#: And of a slot: the next one on the rim, and the index of its point.
FOLLOWS, POINT = 7, 8


class Surface(NamedTuple):
    """A closed surface of triangles, room for it included: few arrays, as each costs time in every call."""

    planes: Floats  #: (9, faces) a triangle or slot each column
    faces: Int32s  #: (9, faces) a triangle, slot or edge each column
    owner: Int32s  #: (slots^2,) the face left of the edge from slot i to slot j, at i * width + j


def surface() -> Surface:
    """Room for a surface; one serves for any number of sets."""
    most = 3 * MOST_FACES  # edges of as many triangles
    return Surface(np.empty((9, MOST_FACES)), np.empty((9, most), np.int32), np.empty(MOST_SLOTS**2, np.int32))


@njit(cache=True)
def is_inside(x: float, y: float, z: float, count: int, planes: Floats) -> bool:
    """Whether a point is proven to be inside of all triangles."""
    outside = 0
    for f in range(count):
        height = planes[NX, f] * x + planes[NY, f] * y + planes[NZ, f] * z - planes[OFFSET, f]
        outside += height >= -planes[ROUNDING, f]
    return outside == 0


@njit(cache=True)
def look(x: float, y: float, z: float, count: int, planes: Floats, faces: Int32s) -> tuple[int, int]:
    """For how many triangles a point is not proven to be inside, and how many it sees from clearly outside."""
    outside, beyond = 0, 0
    for f in range(count):
        height = planes[NX, f] * x + planes[NY, f] * y + planes[NZ, f] * z - planes[OFFSET, f]
        outside += height >= -planes[ROUNDING, f]
        beyond += height > planes[THIN, f]
        faces[SEEN, f] = height > planes[THIN, f]
    return outside, beyond


@njit(cache=True)
def set_plane(f: int, i: int, j: int, k: int, size: float, planes: Floats, faces: Int32s) -> None:
    """Writes triangle f with corners in slots i, j, k, without joining it to its neighbours."""
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


@njit(cache=True)
def join(f: int, width: int, faces: Int32s, owner: Int32s) -> None:
    """Makes triangle f the owner of its edges."""
    i, j, k = faces[A, f], faces[B, f], faces[C, f]
    owner[i * width + j] = f
    owner[j * width + k] = f
    owner[k * width + i] = f


@njit(cache=True)
def hide(count: int, faces: Int32s) -> int:
    """Lists the triangles that the last point looked at sees; returns how many."""
    hidden = 0
    for f in range(count):
        faces[HIDDEN, hidden] = f
        hidden += faces[SEEN, f]
    return hidden


@njit(cache=True)
def outline(hidden: int, width: int, faces: Int32s, owner: Int32s) -> int:
    """Lists the edges between seen and unseen triangles; returns how many."""
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
    """Whether the edges are one simple loop: a closed surface stays closed when that is cut out of it and filled.

    They enter each slot as often as they leave it, so who follows them stays on them. Who is back at the start after as
    many steps as there are edges, and not before, has been along each of them.
    """
    for e in range(edges):
        faces[FOLLOWS, faces[START, e]] = faces[END, e]
    start = faces[START, 0]
    corner, back = faces[FOLLOWS, start], 0
    for _ in range(edges - 1):
        back += corner == start
        corner = faces[FOLLOWS, corner]
    return back == 0 and corner == start


@njit(cache=True)
def fan(inner: Vector, size: float, count: int, edges: int, slot: int, planes: Floats, faces: Int32s) -> bool:
    """Adds triangles from the edges to the point in a slot, not joined yet; returns whether all face outward."""
    inward = 0
    for n in range(edges):
        f = count + n
        set_plane(f, faces[START, n], faces[END, n], slot, size, planes, faces)
        height = planes[NX, f] * inner[0] + planes[NY, f] * inner[1] + planes[NZ, f] * inner[2] - planes[OFFSET, f]
        inward += height >= -planes[THIN, f]
    return inward == 0


@njit(cache=True)
def join_all(start: int, end: int, width: int, faces: Int32s, owner: Int32s) -> None:
    """Joins new triangles to their neighbours."""
    for f in range(start, end):
        faces[SEEN, f] = 0
        join(f, width, faces, owner)


@njit(cache=True)
def fill(hidden: int, end: int, width: int, planes: Floats, faces: Int32s, owner: Int32s) -> int:
    """Moves the last triangles into the places of those no longer needed; returns the number of triangles."""
    for h in range(hidden):
        hole = faces[HIDDEN, h]
        while end > hole and faces[SEEN, end - 1]:
            end -= 1
        if end > hole:
            end -= 1
            _move(end, hole, planes, faces)
            join(hole, width, faces, owner)
    return end


@njit(cache=True)
def _move(f: int, hole: int, planes: Floats, faces: Int32s) -> None:
    for k in (NX, NY, NZ, OFFSET, ROUNDING, THIN):
        planes[k, hole] = planes[k, f]
    for k in (A, B, C):
        faces[k, hole] = faces[k, f]
    faces[SEEN, hole] = 0
