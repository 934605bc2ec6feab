"""The distance between capsules: segments with a radius, in closed form, over many instants at once."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

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
    for i in range(len(first)):
        least = np.inf
        for a in range(first.shape[1]):
            if not _is_finite(first[i, a]):
                continue
            for b in range(second.shape[1]):
                if not _is_finite(second[i, b]):
                    continue
                gap, share, other = segment_distance(first[i, a], second[i, b])
                gap -= first_radius[a] + second_radius[b]
                if gap < least:
                    least = gap
                    found.distance_m[i], found.first[i], found.second[i] = gap, a, b
                    for k in range(3):
                        found.at_first_m[i, k] = _at(first[i, a], share, k)
                        found.at_second_m[i, k] = _at(second[i, b], other, k)


@njit(cache=True)
def _is_finite(ends: Floats) -> bool:
    total = 0.0
    for k in range(3):
        total += abs(ends[0, k]) + abs(ends[1, k])
    return math.isfinite(total)


@njit(cache=True)
def _at(ends: Floats, share: float, k: int) -> float:
    return ends[0, k] + share * (ends[1, k] - ends[0, k])


@njit(cache=True)
def segment_distance(first: Floats, second: Floats) -> tuple[float, float, float]:
    """The distance between two segments (2, 3) [m], and the shares of the way along each to the nearest points.

    It is least at an end of one of them, or between the feet of the common perpendicular where both lie inside.
    """
    uu, uv, vv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0  # products of both directions and of what is between starts
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
            across = uu * vv - uv * uv  # 0 for parallel ones, whose distance is found at an end
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


@njit(cache=True)
def _clipped(along: float, length2: float) -> float:
    """Share of the way along a segment at which it is nearest to a point."""
    return min(1.0, max(0.0, along / length2)) if length2 > 0.0 else 0.0
