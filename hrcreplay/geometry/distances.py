"""Distances between a segment and the convex hull of points, proven from both sides, and between capsules.

The distance from a hull is the length of the shortest vector in the convex hull of all differences between a vertex and
an end of the segment, found by Wolfe's algorithm (Mathematical Programming 11, 1976). Each vector visited is in that
hull, so its length is an upper bound; the plane orthogonal to it gives a lower bound. Capsules, segments with a radius,
have a closed form, here over many instants at once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hrcreplay.kernels import njit
from hrcreplay.records import Bools, Floats, Ints

#: A distance is proven when its bounds are this close [m].
EXACT_M = 1e-10
#: Maximum number of differences that span the shortest one.
MOST = 4
#: Maximum number of steps; only rounding can require more.
_STEPS = 60
#: An edge that leaves the plane of others by less than this share of its length counts as inside the plane. Smaller
#: shares are rounding; larger ones would take links that are nearly parallel to an edge of the hull for parallel.
_FLAT = 1e-12
#: A shorter difference has too few exact digits for its direction [m].
_SHORT_M = 1e-5


class Carriers(NamedTuple):
    """The differences whose convex combination is the shortest so far, in the first rows; space for MOST."""

    points: Floats  #: (MOST, 3) [m]
    weights: Floats  #: (MOST,) positive, 1 in all
    wanted: Floats  #: (MOST,) weights of the shortest vector of their plane, of any sign
    basis: Floats  #: (MOST - 1, 3) orthonormal: the directions of their plane
    triangle: Floats  #: (MOST - 1, MOST - 1) their edges in this basis
    codes: Ints  #: (MOST,) twice the vertex, plus the end


@njit(cache=True)
def distances(ends: Floats, vertices: Floats, offsets: Ints) -> tuple[Floats, Floats, Ints]:
    """Computes bounds of the distance between the axis of every link and the hull of every limb.

    Args:
        ends: (s, 2, 3) ends of the axes [m].
        vertices: (m, 3) of all limbs [m].
        offsets: (l + 1,) first vertex of each limb; no limb is empty.

    Returns:
        Lower and upper bound, (s, l) each [m]. The lower one is proven by a plane between link and limb, also if the
        bounds differ: the difference is at most EXACT_M unless rounding prevents it. In penetration the bounds are 0
        and at most EXACT_M. Also (s, l, MOST), the rows of ``vertices`` that span the nearest point.
    """
    links, limbs = len(ends), len(offsets) - 1
    low, high = np.empty((links, limbs)), np.empty((links, limbs))
    near = np.empty((links, limbs, MOST), dtype=np.int64)
    work = carriers()
    for s in range(links):
        for k in range(limbs):
            start = near[s - 1, k, 0] if s else offsets[k]  # the previous link is usually near this one
            low[s, k], high[s, k], count = _distance(ends[s], vertices, offsets[k], offsets[k + 1], start, work)
            for i in range(MOST):
                near[s, k, i] = work.codes[i if i < count else 0] // 2
    return low, high, near


@njit(cache=True, inner=True)
def _distance(
    ends: Floats, vertices: Floats, first: int, last: int, start: int, on: Carriers
) -> tuple[float, float, int]:
    """Returns both bounds of one distance, and the number of differences that span it."""
    code, before, count = 2 * start, -1, 0
    low, high = 0.0, np.inf
    for _ in range(_STEPS):
        count = _shortest(on, _join(on, count, code, ends, vertices))
        x0, x1, x2 = 0.0, 0.0, 0.0
        for i in range(count):
            x0 += on.weights[i] * on.points[i, 0]
            x1 += on.weights[i] * on.points[i, 1]
            x2 += on.weights[i] * on.points[i, 2]
        gap = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
        high = min(high, gap)
        if gap <= EXACT_M:
            return 0.0, high, count
        if gap < _SHORT_M:  # orthogonal to the plane of its carriers to the last digit
            for i in range(count - 1):
                e0, e1, e2 = on.basis[i, 0], on.basis[i, 1], on.basis[i, 2]
                part = x0 * e0 + x1 * e1 + x2 * e2
                x0, x1, x2 = x0 - part * e0, x1 - part * e1, x2 - part * e2
            gap = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
            if gap <= EXACT_M:
                return 0.0, high, count
        vertex, depth = first, np.inf
        for j in range(first, last):
            along = x0 * vertices[j, 0] + x1 * vertices[j, 1] + x2 * vertices[j, 2]
            if along < depth:
                vertex, depth = j, along
        a = x0 * ends[0, 0] + x1 * ends[0, 1] + x2 * ends[0, 2]
        b = x0 * ends[1, 0] + x1 * ends[1, 1] + x2 * ends[1, 2]
        low = max(low, (depth - max(a, b)) / gap)
        code, before = 2 * vertex + (b > a), code
        if not high - low > EXACT_M or count == MOST or code == before:
            break
    return min(low, high), high, count


@njit(cache=True, inner=True)
def _join(on: Carriers, count: int, code: int, ends: Floats, vertices: Floats) -> int:
    """Adds a difference, with weight 0 unless it is the first; returns the number of carriers."""
    for c in range(3):
        on.points[count, c] = vertices[code // 2, c] - ends[code % 2, c]
    on.codes[count], on.weights[count] = code, 0.0 if count else 1.0
    return count + 1


@njit(cache=True, inner=True)
def _shortest(on: Carriers, count: int) -> int:
    """Moves the weights to the shortest vector of a plane through carriers that lies between them.

    Carriers with weight 0 at the end, or in the plane of earlier ones, are dropped; returns the number left.
    """
    while True:
        flat = _plane(on, count)
        if flat >= 0:
            count = _drop(on, count, flat)
            total = on.weights[:count].sum()
            for i in range(count):
                on.weights[i] = on.weights[i] / total if total > 0.0 else 1.0 / count
            continue
        share, leaving = 1.0, -1
        for i in range(count):
            way = on.weights[i] - on.wanted[i]
            if on.wanted[i] <= 0.0 and on.weights[i] <= share * way:
                share, leaving = on.weights[i] / way if way > 0.0 else 0.0, i
        for i in range(count):
            on.weights[i] += share * (on.wanted[i] - on.weights[i])
        if leaving < 0:
            return count
        count = _drop(on, count, leaving)


@njit(cache=True, inner=True)
def _drop(on: Carriers, count: int, leaving: int) -> int:
    """Removes a carrier; returns the number left."""
    for i in range(leaving, count - 1):
        on.weights[i], on.codes[i] = on.weights[i + 1], on.codes[i + 1]
        for c in range(3):
            on.points[i, c] = on.points[i + 1, c]
    return count - 1


@njit(cache=True, inner=True)
def _plane(on: Carriers, count: int) -> int:
    """Computes the target weights; returns the first carrier in the plane of earlier ones, -1 if none."""
    for i in range(count - 1):
        if not _edge(on, i):
            return i + 1
    on.wanted[0] = 1.0
    for i in range(count - 2, -1, -1):
        rest = -(on.basis[i, 0] * on.points[0, 0] + on.basis[i, 1] * on.points[0, 1] + on.basis[i, 2] * on.points[0, 2])
        for j in range(i + 1, count - 1):
            rest -= on.triangle[i, j] * on.wanted[j + 1]
        on.wanted[i + 1] = rest / on.triangle[i, i]
        on.wanted[0] -= on.wanted[i + 1]
    return -1


@njit(cache=True, inner=True)
def _edge(on: Carriers, i: int) -> bool:
    """Adds the direction from carrier 0 to i + 1 to the basis, by Gram-Schmidt; False if it lies in the plane."""
    x = on.points[i + 1, 0] - on.points[0, 0]
    y = on.points[i + 1, 1] - on.points[0, 1]
    z = on.points[i + 1, 2] - on.points[0, 2]
    length = math.sqrt(x * x + y * y + z * z)
    for j in range(i):
        on.triangle[j, i] = 0.0
    for _ in range(2):  # two passes suffice
        for j in range(i):
            part = on.basis[j, 0] * x + on.basis[j, 1] * y + on.basis[j, 2] * z
            on.triangle[j, i] += part
            x, y, z = x - part * on.basis[j, 0], y - part * on.basis[j, 1], z - part * on.basis[j, 2]
    size = math.sqrt(x * x + y * y + z * z)
    on.triangle[i, i] = size
    if not size > _FLAT * length:
        return False
    on.basis[i, 0], on.basis[i, 1], on.basis[i, 2] = x / size, y / size, z / size
    return True


@njit(cache=True)
def separating_planes(ends: Floats, vertices: Floats, offsets: Ints, wanted: Bools) -> tuple[Floats, Floats]:
    """Computes a plane between the axis of every link and every hull, orthogonal to the shortest way between them.

    Args:
        ends: (s, 2, 3) ends of the axes [m].
        vertices: (m, 3) of all hulls [m].
        offsets: (l + 1,) first vertex of each hull; no hull is empty.
        wanted: (s, l) pairs to compute.

    Returns:
        Lower bound of the distance that the plane proves, (s, l), 0 in penetration and inf for pairs that are not
        wanted [m]; and (s, l, 3) unit vectors from link to hull, zero without a plane.
    """
    links, hulls = len(ends), len(offsets) - 1
    low, normals = np.full((links, hulls), np.inf), np.zeros((links, hulls, 3))
    work = carriers()
    for s in range(links):
        for k in range(hulls):
            if wanted[s, k]:
                low[s, k], _ = separating_plane(ends[s], vertices, offsets[k], offsets[k + 1], work, normals[s, k])
    return low, normals


@njit(cache=True, inner=True)
def carriers() -> Carriers:
    """Memory of the kernels."""
    square = np.empty((MOST - 1, MOST - 1))
    return Carriers(
        np.empty((MOST, 3)), np.empty(MOST), np.empty(MOST), np.empty((MOST - 1, 3)), square, np.empty(MOST, np.int64)
    )


@njit(cache=True, inner=True)
def separating_plane(
    ends: Floats, vertices: Floats, first: int, last: int, work: Carriers, normal: Floats
) -> tuple[float, float]:
    """Computes the plane between a segment and a hull, orthogonal to the shortest way between them.

    Args:
        ends: (2, 3) ends of the segment [m].
        vertices: (m, 3) of which the rows ``first`` to ``last`` - 1 span the hull [m].
        first: First vertex of the hull.
        last: Vertex after the last one.
        work: From ``carriers``.
        normal: (3,) receives the unit vector from segment to hull; unchanged in penetration.

    Returns:
        Lower and upper bound of the distance [m]; see ``distances``.
    """
    low, high, count = _distance(ends, vertices, first, last, first, work)
    x0, x1, x2 = 0.0, 0.0, 0.0
    for i in range(count):
        x0 += work.weights[i] * work.points[i, 0]
        x1 += work.weights[i] * work.points[i, 1]
        x2 += work.weights[i] * work.points[i, 2]
    length = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
    if low > 0.0 and length > 0.0:
        normal[0], normal[1], normal[2] = x0 / length, x1 / length, x2 / length
    return low, high


@njit(cache=True)
def farthest_at_most(points: Floats, vertices: Floats, enough_m: float) -> float:
    """Upper bound of the largest distance of some points from a hull [m].

    Where a point is within ``enough_m`` of a vertex, the bound is its distance from that; else it is as ``distances``.

    Args:
        points: (k, 3); points that are not finite are ignored [m].
        vertices: (m, 3) [m].
        enough_m: Distance below which any bound will do [m].
    """
    most, work, ends = 0.0, carriers(), np.empty((2, 3))
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not math.isfinite(x + y + z):
            continue
        apart2 = np.inf
        for j in range(len(vertices)):
            a, b, c = vertices[j, 0] - x, vertices[j, 1] - y, vertices[j, 2] - z
            apart2 = min(apart2, a * a + b * b + c * c)
        bound = math.sqrt(apart2)
        if bound > enough_m:
            for k in range(2):
                ends[k, 0], ends[k, 1], ends[k, 2] = x, y, z
            bound = min(bound, _distance(ends, vertices, 0, len(vertices), 0, work)[1])
        most = max(most, bound)
    return most


def protrusion_m(axes: Floats, radius_m: float, vertices: Floats, ball_m: float) -> Floats:
    """Computes the protrusion of capsules from a hull with a ball around each point; negative: inside the ball.

    The distance from a convex set is convex, so no point of an axis is further away than one of its ends.

    Args:
        axes: (k, 2, 3) ends of the capsules' axes, finite [m].
        radius_m: Radius of the capsules [m].
        vertices: (m, 3) at least one [m].
        ball_m: Radius of the ball [m].

    Returns:
        (k,) [m]; no less than ``radius_m - ball_m``, which is that of an axis inside the hull.
    """
    points = np.repeat(np.ascontiguousarray(axes).reshape(-1, 1, 3), 2, axis=1)
    _, high, _ = distances(points, np.ascontiguousarray(vertices), np.array([0, len(vertices)]))
    return np.asarray(high.reshape(-1, 2).max(axis=1) + radius_m - ball_m)


class NearestPair(NamedTuple):
    """The pair of capsules with the smallest distance between surfaces, one row per instant."""

    distance_m: Floats  #: (n,) distance between the surfaces, negative in overlap [m]
    first: Ints  #: (n,) index of the capsule in the first set; -1 without a pair
    second: Ints  #: (n,) index in the second set
    at_first_m: Floats  #: (n, 3) nearest point of the first one's axis [m]
    at_second_m: Floats  #: (n, 3) nearest point of the second one's axis [m]


def nearest_pair(first_m: Floats, first_radius_m: Floats, second_m: Floats, second_radius_m: Floats) -> NearestPair:
    """Finds the nearest pair of capsules of two sets at every instant.

    A capsule with an end that is not finite is ignored. Without a pair the distance is NaN.

    Args:
        first_m: (n, a, 2, 3) ends of the axes [m].
        first_radius_m: (a,) [m].
        second_m: (n, b, 2, 3) ends of the axes of the other set [m].
        second_radius_m: (b,) [m].
    """
    n = len(first_m)
    found = NearestPair(
        np.full(n, np.nan), np.full(n, -1), np.full(n, -1), np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    )
    sets = [np.array(part, dtype=np.float64, order="C") for part in (first_m, first_radius_m, second_m)]
    _nearest_rows(*sets, np.array(second_radius_m, dtype=np.float64), found)
    return found


#: Share of the sum of the coordinates by which balls around axes are enlarged, more than all rounding errors.
_BALL_SHARE = 1e-7


@njit(cache=True)
def _nearest_rows(
    first: Floats, first_radius: Floats, second: Floats, second_radius: Floats, found: NearestPair
) -> None:
    """Measures the pairs whose balls around the axes do not prove that another pair is nearer."""
    ones, others = np.empty((first.shape[1], 4)), np.empty((second.shape[1], 4))
    apart = np.empty((len(ones), len(others)))
    for i in range(len(first)):
        _write_balls(first[i], ones)
        _write_balls(second[i], others)
        least = np.inf
        for a in range(len(ones)):
            for b in range(len(others)):
                x, y, z = ones[a, 0] - others[b, 0], ones[a, 1] - others[b, 1], ones[a, 2] - others[b, 2]
                gap = math.sqrt(x * x + y * y + z * z) - (first_radius[a] + second_radius[b])
                apart[a, b] = gap - ones[a, 3] - others[b, 3]  # at least so far, and at most as their middles
                if gap < least:
                    least = gap
        most, least = least, np.inf
        for a in range(len(ones)):
            for b in range(len(others)):
                if not apart[a, b] <= min(most, least):
                    continue
                gap, share, other = segment_distance(first[i, a], second[i, b])
                gap -= first_radius[a] + second_radius[b]
                if gap < least:
                    least = gap
                    found.distance_m[i], found.first[i], found.second[i] = gap, a, b
                    for k in range(3):
                        found.at_first_m[i, k] = _at(first[i, a], share, k)
                        found.at_second_m[i, k] = _at(second[i, b], other, k)


@njit(cache=True, inner=True)
def _write_balls(axes: Floats, balls: Floats) -> None:
    """Writes middles and radii (a, 4) of balls around axes (a, 2, 3) [m]; NaN for an axis that is not finite."""
    for a in range(len(axes)):
        total, half2 = 0.0, 0.0
        for k in range(3):
            total += abs(axes[a, 0, k]) + abs(axes[a, 1, k])
            half2 += (0.5 * (axes[a, 1, k] - axes[a, 0, k])) ** 2
            balls[a, k] = 0.5 * (axes[a, 0, k] + axes[a, 1, k])
        balls[a, 3] = math.sqrt(half2) + _BALL_SHARE * (1.0 + total) if math.isfinite(total) else np.nan


@njit(cache=True, inner=True)
def _at(ends: Floats, share: float, k: int) -> float:
    return ends[0, k] + share * (ends[1, k] - ends[0, k])


@njit(cache=True)
def segment_distance(first: Floats, second: Floats) -> tuple[float, float, float]:
    """Returns the distance between two segments (2, 3) [m], and the positions of the nearest points along each, 0 to 1.

    The minimum is at an end of one of them, or at the feet of the common perpendicular if both lie inside.
    """
    uu, uv, vv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0  # products of both directions and of the vector between the starts
    for k in range(3):
        u, v, w = first[1, k] - first[0, k], second[1, k] - second[0, k], first[0, k] - second[0, k]
        uu, uv, vv = uu + u * u, uv + u * v, vv + v * v
        uw, vw = uw + u * w, vw + v * w
    least, share, other = np.inf, 0.0, 0.0
    for k in range(5):
        if k < 2:
            s = float(k)
            t = _clipped(vw + s * uv, vv)
        elif k < 4:
            t = float(k - 2)
            s = _clipped(t * uv - uw, uu)
        else:
            across = uu * vv - uv * uv  # 0 for parallel segments, whose minimum is at an end
            if across <= 0.0:
                break
            s, t = (uv * vw - vv * uw) / across, (uu * vw - uv * uw) / across
            if not (0.0 < s < 1.0 and 0.0 < t < 1.0):
                break
        gap2 = 0.0
        for i in range(3):
            gap2 += (_at(first, s, i) - _at(second, t, i)) ** 2
        if gap2 < least:
            least, share, other = gap2, s, t
    return math.sqrt(least), share, other


@njit(cache=True, inner=True)
def _clipped(along: float, length2: float) -> float:
    """Returns the position along a segment, 0 to 1, at which it is nearest to a point."""
    return min(1.0, max(0.0, along / length2)) if length2 > 0.0 else 0.0
