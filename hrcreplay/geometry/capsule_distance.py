"""The distance between capsules: segments with a radius, in closed form, over many instants at once."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hrcreplay.geometry.vectors import dot3
from hrcreplay.records import Floats, Ints


class NearestPair(NamedTuple):
    """The pair of capsules with the smallest distance between surfaces, a row an instant."""

    distance_m: Floats  #: (n,) negative where they overlap: the radii's sum is more than between the axes [m]
    first: Ints  #: (n,) which capsule of the first set; -1 without a pair
    second: Ints  #: (n,) which of the second
    at_first_m: Floats  #: (n, 3) nearest point of the first one's axis [m]
    at_second_m: Floats  #: (n, 3) and of the second one's [m]


def nearest_pair(first_m: Floats, first_radius_m: Floats, second_m: Floats, second_radius_m: Floats) -> NearestPair:
    """The nearest pair of capsules of two sets at every instant.

    A capsule with an end that is not finite counts as not there. Without a pair the distance is NaN.

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


@njit(cache=True)
def _nearest_rows(
    first: Floats, first_radius: Floats, second: Floats, second_radius: Floats, found: NearestPair
) -> None:
    on_first, on_second = np.empty(3), np.empty(3)
    for i in range(len(first)):
        least = np.inf
        for a in range(first.shape[1]):
            if not _is_finite(first[i, a]):
                continue
            for b in range(second.shape[1]):
                if not _is_finite(second[i, b]):
                    continue
                gap = segment_distance(first[i, a], second[i, b], on_first, on_second)
                gap -= first_radius[a] + second_radius[b]
                if gap < least:
                    least = gap
                    found.distance_m[i], found.first[i], found.second[i] = gap, a, b
                    found.at_first_m[i], found.at_second_m[i] = on_first, on_second


@njit(cache=True)
def _is_finite(ends: Floats) -> bool:
    for k in range(3):
        if not (math.isfinite(ends[0, k]) and math.isfinite(ends[1, k])):
            return False
    return True


@njit(cache=True)
def segment_distance(first: Floats, second: Floats, on_first: Floats, on_second: Floats) -> float:
    """The distance between two segments (2, 3); writes the nearest points (3,) [m].

    It is least at an end of one of them, or between the feet of the common perpendicular where both lie inside.
    """
    least = np.inf
    for k in range(2):
        share = _foot(second, first[k])
        least = _shorter(first, second, float(k), share, least, on_first, on_second)
        share = _foot(first, second[k])
        least = _shorter(first, second, share, float(k), least, on_first, on_second)
    u, v, w = first[1] - first[0], second[1] - second[0], first[0] - second[0]
    uu, uv, vv, uw, vw = dot3(u, u), dot3(u, v), dot3(v, v), dot3(u, w), dot3(v, w)
    across = uu * vv - uv * uv  # 0 for parallel ones, whose distance is found at an end
    if across > 0.0:
        share, other = (uv * vw - vv * uw) / across, (uu * vw - uv * uw) / across
        if 0.0 < share < 1.0 and 0.0 < other < 1.0:
            least = _shorter(first, second, share, other, least, on_first, on_second)
    return least


@njit(cache=True)
def _foot(segment: Floats, point: Floats) -> float:
    """Share of the way along a segment (2, 3) at which it is nearest to a point (3,)."""
    along = segment[1] - segment[0]
    length2 = dot3(along, along)
    if length2 <= 0.0:
        return 0.0
    return min(1.0, max(0.0, dot3(point - segment[0], along) / length2))


@njit(cache=True)
def _shorter(
    first: Floats, second: Floats, share: float, other: float, least: float, on_first: Floats, on_second: Floats
) -> float:
    """The smaller of ``least`` and the distance between two points of the segments, which are written if they win."""
    gap2 = 0.0
    for k in range(3):
        a = first[0, k] + share * (first[1, k] - first[0, k])
        b = second[0, k] + other * (second[1, k] - second[0, k])
        gap2 += (a - b) ** 2
    gap = math.sqrt(gap2)
    if gap >= least:
        return least
    for k in range(3):
        on_first[k] = first[0, k] + share * (first[1, k] - first[0, k])
        on_second[k] = second[0, k] + other * (second[1, k] - second[0, k])
    return gap
