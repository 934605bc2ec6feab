"""Swept volumes of point sets, one degree of freedom at a time, and the rotations that carry each limb: Alg. 2.

Every sweep maps the whole set by a few fixed linear maps. So the hull of a swept set is the swept hull: points that are
not corners of the hull may be dropped before any sweep without changing the result.

The last sweeps, heading and position, are done in one step, and only copies that can be corners of the result are
written. All copies of a point have the same height. A copy is not a corner of the result if it lies between another
copy and a point of its own set, that is, if a small step from the point away from the other copy stays inside the set.
These steps are proven with the surface around the set, so only points inside the hull of the rest are dropped.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.geometry.hull_reduction import NX, NY, POINT, A, B, C, Surface, is_inside
from hrcreplay.human.model import HD, HEIGHT, LEFT_ARM, RHO, RIGHT_ARM, THX, ULA, URA
from hrcreplay.kernels import njit
from hrcreplay.records import Floats

_X, _Y, _Z = 0, 1, 2


@njit(cache=True, inner=True)
def kinematic_chain(limb: int, low: Floats, high: Floats, lengths: Floats) -> tuple[Floats, Floats]:
    """Returns a limb's end points in the frame of its first rotation, and the rotations up to the human base, Alg. 2.

    A row of the chain contains axis, smallest and largest angle [rad], and the origin of its frame in the next (3,)
    [m]. Walking follows the chain. The thorax also spans the shoulder line, whose midpoint is the neck.

    Args:
        limb: Index into LIMBS.
        low: (13,) lower ends of the joints' reachable intervals [m, m, rad..., m].
        high: (13,) their upper ends.
        lengths: (7,) LENGTHS [m].
    """
    torso, head, half_shoulder = lengths[0], lengths[1], lengths[2]
    turn_rho = (_Y, low[RHO], high[RHO], 0.0, 0.0, low[HEIGHT])
    if limb == HD:
        points = np.array([[0.0, 0.0, torso], [0.0, 0.0, torso + head]])
        return points, np.array([turn_rho])
    if limb == THX:
        points = np.array([[0.0, 0.0, 0.0], [0.0, -half_shoulder, torso], [0.0, half_shoulder, torso]])
        return points, np.array([turn_rho])
    left = limb >= ULA
    side = 1.0 if left else -1.0
    upper, forearm = (lengths[3], lengths[5]) if left else (lengths[4], lengths[6])
    a1 = LEFT_ARM if left else RIGHT_ARM
    a2, a3, a4 = a1 + 1, a1 + 2, a1 + 3
    turn_2 = (_Y, -high[a2], -low[a2], 0.0, 0.0, 0.0)
    turn_1 = (
        _X,
        min(side * low[a1], side * high[a1]),
        max(side * low[a1], side * high[a1]),
        0.0,
        side * half_shoulder,
        torso,
    )
    if limb in (URA, ULA):
        points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -upper]])
        return points, np.array([turn_2, turn_1, turn_rho])
    turn_4 = (_Y, low[a4] - np.pi, high[a4] - np.pi, 0.0, 0.0, 0.0)
    turn_3 = (_Z, min(side * low[a3], side * high[a3]), max(side * low[a3], side * high[a3]), 0.0, 0.0, -upper)
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -forearm]])
    return points, np.array([turn_4, turn_3, turn_2, turn_1, turn_rho])


#: Largest angle that one triangle spans [rad], Alg. 2, corrected (docs/paper.md): its apex is then at most 15.5 % of
#: the radius off the arc.
TRIANGLE_RAD = np.pi / 3.0
#: Maximum number of copies of a point in a rotation: both ends and an apex for each of six triangles.
MOST_COPIES = 8


@njit(cache=True)
def sweep_rot(points: Floats, count: int, axis: int, low: float, high: float, swept: Floats, widest: float) -> int:
    """Rotational sweep about a coordinate axis through the origin, Fig. 8 and Alg. 2: arcs inside triangles.

    An arc is divided into equal pieces of at most ``widest``; each lies in the triangle of its ends and the
    intersection of their tangents. A division point lies on the common tangent of its two triangles, between their
    apexes, so only the arc's ends and the apexes are corners. A whole turn gives the polygon around the circle.

    Args:
        points: (m, 3), the first ``count`` are swept [m].
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


@njit(cache=True, inner=True)
def copies(low: float, high: float, widest: float = TRIANGLE_RAD) -> int:
    """Maximum number of copies of a point in a rotation."""
    return 1 if low == high else 2 + int(np.ceil(min(high - low, 2.0 * np.pi) / widest))


@njit(cache=True, inner=True)
def turns(low: float, high: float, cosines: Floats, sines: Floats, widest: float = TRIANGLE_RAD) -> int:
    """Computes the maps of a rotational sweep: rotations, for an apex scaled by 1 / cos(half the piece).

    Writes the first columns (cos, sin) of their matrices, and returns their number.

    Args:
        low: Smallest angle [rad].
        high: Largest angle [rad].
        cosines: (>= copies(low, high, widest),) receives the first elements.
        sines: Array of the same shape, receives the second elements.
        widest: Largest angle of a triangle [rad].
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


#: Directions in the plane: EMPTY, POINTED (within less than half a turn) or ALL_ROUND (they can cancel), and the
#: outermost clockwise and counterclockwise unit vectors of pointed ones.
Cone = tuple[int, float, float, float, float]
EMPTY, POINTED, ALL_ROUND = 0, 1, 2

#: Length of a step [m], and its margin to the boundary of the directions that lead inside [rad].
_STEP_M, _OFF_EDGE = 1e-6, 1e-3
#: Directions that differ by less count as equal [rad].
_SAME = 1e-12


@njit(cache=True, inner=True)
def sweep_walk(
    points: Floats,
    count: int,
    faces: int,
    work: Surface,
    heading: tuple[float, float],
    floor: Floats,
    swept: Floats,
    widest: float,
) -> int:
    """Rotational sweep about the z axis, then a translational one over a polygon, Fig. 7: the end of Alg. 2.

    Args:
        points: (m, 3), the first ``count`` are those kept by ``keep_corners``, in the human base frame [m].
        count: Number of points.
        faces: Number of triangles around them; if 0, only copies inside the hull of a point's other copies are dropped.
        work: The surface from ``keep_corners``.
        heading: Smallest and largest heading [rad].
        floor: (k, 6) positions of the human base: x, y, and the vectors from the two neighbouring corners of the
            polygon, zero if there is none [m].
        swept: (>= copies(*heading, widest) k count, 3) receives the points, world [m].
        widest: Largest angle of a triangle [rad].

    Returns:
        Number of points written.
    """
    most = copies(heading[0], heading[1], widest)
    cosines, sines = np.empty(most), np.empty(most)
    made = turns(heading[0], heading[1], cosines, sines, widest)
    steps = _steps_inside(points, count, faces, work)
    sides = _directions(floor)
    n = 0
    for i in range(count):
        x, y = points[i, 0], points[i, 1]
        for copy in range(1 if x == 0.0 and y == 0.0 else made):
            c, s = cosines[copy], sines[copy]
            away = _away_from_turned(x, y, copy, made, cosines, sines)
            for k in (0, 2):
                away = _widen(away, s * steps[i, k + 1] - c * steps[i, k], -s * steps[i, k] - c * steps[i, k + 1])
            for k in range(len(floor)):
                if _is_between(away, k, sides):
                    continue
                swept[n, 0] = c * x - s * y + floor[k, 0]
                swept[n, 1] = s * x + c * y + floor[k, 1]
                swept[n, 2] = points[i, 2]
                n += 1
    return n


@njit(cache=True, inner=True)
def _directions(floor: Floats) -> Floats:
    """(k, 4) the two vectors of each place as unit vectors; zero vectors are kept."""
    sides = np.zeros((len(floor), 4))
    for k in range(len(floor)):
        for j in (0, 2):
            x, y = floor[k, 2 + j], floor[k, 3 + j]
            length = np.sqrt(x * x + y * y)
            if length > 0.0:
                sides[k, j], sides[k, j + 1] = x / length, y / length
    return sides


@njit(cache=True, inner=True)
def _is_between(away: Cone, k: int, sides: Floats) -> bool:
    """Returns True if a copy is not a corner at a position, by the directions from its set and its turned copies."""
    if away[0] == ALL_ROUND:
        return True
    for j in (0, 2):
        x, y = sides[k, j], sides[k, j + 1]
        if x != 0.0 or y != 0.0:
            away = _widen_to(away, x, y)
    return away[0] == ALL_ROUND


@njit(cache=True, inner=True)
def box(low: Floats, high: Floats) -> Floats:
    """Makes ``floor`` of ``sweep_walk`` for x and y in separate intervals; an interval of length 0 has one end."""
    wide, deep = 1 + (low[0] < high[0]), 1 + (low[1] < high[1])
    floor = np.zeros((wide * deep, 6))
    for right in range(wide):
        for far in range(deep):
            place = floor[deep * right + far]
            place[0], place[1] = high[0] if right else low[0], high[1] if far else low[1]
            place[2] = (2 * right - 1) * (high[0] - low[0])
            place[5] = (2 * far - 1) * (high[1] - low[1])
    return floor


@njit(cache=True, inner=True)
def polygon(corners: Floats) -> Floats:
    """Makes ``floor`` of ``sweep_walk`` for the hull of corners (k, 2) in order around it [m]."""
    floor = np.empty((len(corners), 6))
    for i in range(len(corners)):
        before, after = corners[i - 1], corners[(i + 1) % len(corners)]
        floor[i, 0], floor[i, 1] = corners[i, 0], corners[i, 1]
        floor[i, 2], floor[i, 3] = corners[i, 0] - before[0], corners[i, 1] - before[1]
        floor[i, 4], floor[i, 5] = corners[i, 0] - after[0], corners[i, 1] - after[1]
    return floor


@njit(cache=True, inner=True)
def _away_from_turned(x: float, y: float, copy: int, made: int, cosines: Floats, sines: Floats) -> Cone:
    """Directions from the other turned copies of a point to this one."""
    away = (EMPTY, 0.0, 0.0, 0.0, 0.0)
    if x == 0.0 and y == 0.0:
        return away
    for other in range(made):
        if other != copy:
            c, s = cosines[copy] - cosines[other], sines[copy] - sines[other]
            away = _widen(away, c * x - s * y, s * x + c * y)
    return away


@njit(cache=True, inner=True)
def _widen(cone: Cone, x: float, y: float) -> Cone:
    """Adds a direction to the cone; a zero vector is ignored."""
    length = np.sqrt(x * x + y * y)
    if cone[0] == ALL_ROUND or length == 0.0:
        return cone
    return _widen_to(cone, x / length, y / length)


@njit(cache=True, inner=True)
def _widen_to(cone: Cone, x: float, y: float) -> Cone:
    """Adds a unit vector to the cone."""
    kind, ax, ay, bx, by = cone
    if kind == ALL_ROUND:
        return cone
    if kind == EMPTY:
        return POINTED, x, y, x, y
    from_a, to_b = ax * y - ay * x, x * by - y * bx
    if from_a < -_SAME and to_b < -_SAME:
        return ALL_ROUND, 0.0, 0.0, 0.0, 0.0
    if from_a < 0.0 <= to_b:
        return POINTED, x, y, bx, by
    if to_b < 0.0 <= from_a:
        return POINTED, ax, ay, x, y
    return cone


@njit(cache=True, inner=True)
def _steps_inside(points: Floats, count: int, faces: int, work: Surface) -> Floats:
    """(count, 4) two horizontal directions (x, y, x, y); a small step along them, or between them, leads inside.

    They are near the limits set by the triangles at a corner, and zero if no direction is allowed or proven.
    """
    normals = [(EMPTY, 0.0, 0.0, 0.0, 0.0) for _ in range(count)]
    for f in range(faces):
        for k in (A, B, C):
            i = work.faces[POINT, work.faces[k, f]]
            normals[i] = _widen(normals[i], work.planes[NX, f], work.planes[NY, f])
    steps = np.zeros((count, 4))
    for i in range(count):
        kind, ax, ay, bx, by = normals[i]
        if kind != POINTED:
            continue
        for k, x, y in ((0, -by, bx), (2, ay, -ax)):  # orthogonal to the outermost normals
            x, y = x - _OFF_EDGE * (ax + bx), y - _OFF_EDGE * (ay + by)
            px, py = points[i, 0] + _STEP_M * x, points[i, 1] + _STEP_M * y
            if is_inside(px, py, points[i, 2], faces, work.planes):
                steps[i, k], steps[i, k + 1] = x, y
    return steps


@njit(cache=True, inner=True)
def append(vertices: Floats, n: int, swept: Floats, count: int) -> Floats:
    """Appends vertices behind the first ``n`` rows, in a larger array if needed.

    Args:
        vertices: (m, 3), the first n are valid [m].
        n: Number of valid vertices.
        swept: (k, 3) vertices to append [m].
        count: Number of vertices to append.
    """
    if n + count > len(vertices):
        roomier = np.empty((2 * (n + count), 3))
        roomier[:n] = vertices[:n]
        vertices = roomier
    vertices[n : n + count] = swept[:count]
    return vertices
