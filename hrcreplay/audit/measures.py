"""What an audit measures with: distances from swept volumes, volumes of unions, and shares with bootstrap intervals.

Neighbouring ticks share most of their future, and a motion lasts longer than a tick, so n ticks hold much less
information than n independent samples. The intervals come from a circular moving-block bootstrap: each log is
resampled from blocks of consecutive ticks, three horizons long (longer for long logs, as the cube root of the ticks),
the quantity is estimated on each resampled log, and the interval holds the middle 95 % of these estimates. Blocks do
not cross from one log to another, and each log keeps its length.

With few escapes, or none, resampling shows little variation. So the interval of a share also holds the exact binomial
interval for as many independent samples as there are horizons in the logs: an excursion shows in the ticks of the one
horizon before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from scipy.special import betaincinv

from hrcreplay.geometry.convex_hull import hull, sphere_swept_volume_m3
from hrcreplay.records import Bools, Floats, Ints

#: A triangle counts as seen by a point that is not clearly behind it: in the plane of a flat set nothing is in front.
#: How far behind is clear, and how far relative to the largest coordinate.
_BEHIND_M = 1e-9
_COARSE = 16.0 * float(np.finfo(np.float64).eps)
#: Largest root of g^4 = g + 1: powers of 1/g fill a cube evenly (a generalised golden ratio).
_G = 1.2207440846057594759
_STEPS = np.array([1.0 / _G, 1.0 / _G**2, 1.0 / _G**3])
_PARTS = 4


@dataclass(frozen=True)
class InflatedHull:
    """A convex hull with a ball around every point, Eq. (41)."""

    vertices_m: Floats  #: (m, 3) corners of the hull [m]
    faces: Ints  #: (f, 3) triangles as ``hull`` gives them
    radius_m: float

    @classmethod
    def around(cls, points_m: Floats, radius_m: float) -> InflatedHull:
        """The solid of a set of points (n, 3), all finite [m]."""
        vertices, faces = hull(points_m)
        return cls(np.ascontiguousarray(vertices), np.ascontiguousarray(faces), radius_m)

    def volume_m3(self) -> float:
        """Its volume [m^3]."""
        return sphere_swept_volume_m3(self.vertices_m, self.radius_m, self.faces)

    def distances_m(self, points_m: Floats) -> Floats:
        """(k,) distance of points (k, 3) from the hull, before the ball; 0 inside, NaN for a NaN point [m].

        Exact: from a point outside, the nearest point of a hull lies on a triangle that the point sees.
        """
        return _distances(np.ascontiguousarray(points_m), self.vertices_m, self.faces)


def union_volume_m3(solids: Sequence[InflatedHull], points: int, first: int = 0) -> tuple[float, float]:
    """Volume of a union of inflated hulls, from the share of evenly spread points of their common box.

    The points are those of an additive recurrence with a generalised golden ratio, so the result is the same every
    time. Its error is told from the spread between four stretches of the sequence, each of which fills the box.

    Args:
        solids: At least one.
        points: How many points, a multiple of 4.
        first: Where in the sequence to start, so that errors of different calls do not add up.

    Returns:
        The volume and its standard error [m^3].
    """
    low = np.min([s.vertices_m.min(axis=0) - s.radius_m for s in solids], axis=0)
    high = np.max([s.vertices_m.max(axis=0) + s.radius_m for s in solids], axis=0)
    samples = (0.5 + np.arange(first, first + points)[:, None] * _STEPS) % 1.0 * (high - low) + low
    inside = np.zeros(points, dtype=np.bool_)
    for solid in solids:
        _mark(samples, solid.vertices_m, solid.faces, solid.radius_m, inside)
    shares = inside.reshape(_PARTS, -1).mean(axis=1)
    box = float(np.prod(high - low))
    return box * float(shares.mean()), box * float(shares.std(ddof=1)) / _PARTS**0.5


@njit(cache=True)
def _distances(points: Floats, vertices: Floats, faces: Ints) -> Floats:
    normals, offsets = _planes(vertices, faces)
    behind = _behind(vertices)
    found = np.empty(len(points))
    for i in range(len(points)):
        found[i] = _distance(points[i], vertices, faces, normals, offsets, behind)
    return found


@njit(cache=True)
def _behind(vertices: Floats) -> float:
    """How far behind a triangle a point must be to be clearly behind it [m]."""
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
    for i in range(len(points)):
        point = points[i]
        outside = inside[i]
        for k in range(3):
            outside = outside or point[k] < low[k] - radius or point[k] > high[k] + radius
        f = 0
        while not outside and f < len(faces):
            outside = _height(point, normals[f], offsets[f]) > radius
            f += 1
        if not outside:
            inside[i] = _distance(point, vertices, faces, normals, offsets, behind) <= radius


@njit(cache=True)
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


@njit(cache=True)
def _height(point: Floats, normal: Floats, offset: float) -> float:
    return normal[0] * point[0] + normal[1] * point[1] + normal[2] * point[2] - offset


@njit(cache=True)
def _distance(point: Floats, vertices: Floats, faces: Ints, normals: Floats, offsets: Floats, behind: float) -> float:
    if np.isnan(point[0] + point[1] + point[2]):
        return np.nan
    if len(faces) == 0:
        return np.sqrt(_segment(point, vertices[0], vertices[-1]))
    nearest = np.inf
    for f in range(len(faces)):
        height = _height(point, normals[f], offsets[f])
        if height > -behind and height * height < nearest:
            a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
            nearest = min(nearest, _triangle(point, a, b, c, normals[f], height))
    return 0.0 if nearest == np.inf else np.sqrt(nearest)


@njit(cache=True)
def _triangle(p: Floats, a: Floats, b: Floats, c: Floats, normal: Floats, height: float) -> float:
    """Squared distance of p from a triangle: from its plane where p is above it, else from its edges."""
    above = normal[0] != 0.0 or normal[1] != 0.0 or normal[2] != 0.0
    above = above and _left(p, a, b, normal) and _left(p, b, c, normal) and _left(p, c, a, normal)
    if above:
        return height * height
    return min(_segment(p, a, b), _segment(p, b, c), _segment(p, c, a))


@njit(cache=True)
def _left(p: Floats, a: Floats, b: Floats, normal: Floats) -> bool:
    """Whether p is on the inner side of the edge from a to b of a triangle with that normal."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    wx, wy, wz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    x, y, z = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    return x * normal[0] + y * normal[1] + z * normal[2] >= 0.0


@njit(cache=True)
def _segment(p: Floats, a: Floats, b: Floats) -> float:
    """Squared distance of p from the segment a b, which may be a point."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    wx, wy, wz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    length = ux * ux + uy * uy + uz * uz
    t = 0.0
    if length > 0.0:
        t = max(0.0, min((ux * wx + uy * wy + uz * wz) / length, 1.0))
    x, y, z = wx - t * ux, wy - t * uy, wz - t * uz
    return x * x + y * y + z * z


LEVEL = 0.95
DRAWS = 500
_CHUNK = 50


@dataclass(frozen=True)
class Estimate:
    """A figure with its interval; NaN where there is nothing to estimate it from."""

    value: float
    low: float
    high: float
    samples: int  #: ticks behind it

    def to_dict(self) -> dict[str, Any]:
        """JSON form; what is not known is null."""
        numbers = {"value": self.value, "low": self.low, "high": self.high}
        return {k: float(v) if np.isfinite(v) else None for k, v in numbers.items()} | {"samples": self.samples}


@dataclass(frozen=True)
class Resampling:
    """Weight of each tick in each resampled log: how often it occurs there."""

    weights: Floats  #: (draws, n) whole numbers
    block: int  #: ticks a stretch
    sample_ticks: float  #: ticks for one independent sample of a share: those of a horizon

    def of(self, which: slice) -> Resampling:
        """The same for some of the ticks."""
        return Resampling(self.weights[:, which], self.block, self.sample_ticks)

    def share(self, hits: Floats) -> Estimate:
        """Share of ticks with 1 among those with 0 or 1, (n,); NaN is no sample."""
        found = self.mean(hits)
        if found.samples == 0:
            return found
        trials = max(1.0, found.samples / self.sample_ticks)
        low, high = _binomial(found.value * trials, trials)
        return Estimate(found.value, min(found.low, low), max(found.high, high), found.samples)

    def mean(self, values: Floats) -> Estimate:
        """Mean of (n,); NaN is no sample."""
        known = np.isfinite(values)
        if not known.any():
            return Estimate(np.nan, np.nan, np.nan, 0)
        weights = self.weights[:, known]
        total = weights.sum(axis=1)
        means = (weights @ values[known])[total > 0] / total[total > 0]
        return _estimate(float(values[known].mean()), means, int(known.sum()))

    def quantile(self, values: Floats, q: float) -> Estimate:
        """The smallest value of (n,) that at least a share ``q`` does not exceed; NaN is no sample."""
        known = np.isfinite(values)
        if not known.any():
            return Estimate(np.nan, np.nan, np.nan, 0)
        order = np.argsort(values[known], kind="stable")
        ordered = values[known][order]
        weights = self.weights[:, known]
        found = []
        for first in range(0, len(weights), _CHUNK):
            sums = np.cumsum(weights[first : first + _CHUNK][:, order], axis=1)
            some = sums[sums[:, -1] > 0]
            found.append(ordered[np.argmax(some >= q * some[:, -1:] - 1e-9, axis=1)])
        rank = max(0, int(np.ceil(q * len(ordered) - 1e-9)) - 1)
        return _estimate(float(ordered[rank]), np.concatenate(found), len(ordered))


def _estimate(value: float, resampled: Floats, samples: int) -> Estimate:
    if not len(resampled):
        return Estimate(value, np.nan, np.nan, samples)
    tail = 0.5 * (1.0 - LEVEL)
    low, high = np.quantile(resampled, [tail, 1.0 - tail])
    return Estimate(value, min(float(low), value), max(float(high), value), samples)


def _binomial(hits: float, trials: float) -> tuple[float, float]:
    """Clopper and Pearson's interval of a share; the counts need not be whole."""
    tail = 0.5 * (1.0 - LEVEL)
    misses = trials - hits
    low = betaincinv(hits, misses + 1.0, tail) if hits > 0.0 else 0.0
    high = betaincinv(hits + 1.0, misses, 1.0 - tail) if misses > 0.0 else 1.0
    return float(low), float(high)


def block_ticks(horizon_s: float, rate_hz: float, ticks: int) -> int:
    """Length of a block: three horizons, or the cube root of the ticks of the longest log where that is more."""
    return max(1, int(np.ceil(3.0 * horizon_s * rate_hz)), int(np.ceil(ticks ** (1.0 / 3.0))))


def resample(lengths: Sequence[int], block: int, sample_ticks: float, seed: int, draws: int = DRAWS) -> Resampling:
    """Weights of the ticks in logs resampled block by block.

    Args:
        lengths: Ticks of each log, in the order in which the values will come.
        block: Ticks a stretch; cut to a log that is shorter.
        sample_ticks: Ticks for one independent sample of a share.
        seed: Of the random numbers: the same seed and lengths give the same weights.
        draws: Number of resampled logs.
    """
    random = np.random.default_rng(seed)
    parts = []
    for n in lengths:
        if n == 0:
            continue
        size = min(block, n)
        pieces = -(-n // size)
        starts = random.integers(0, n, size=(draws, pieces))
        weights = np.zeros((draws, n))
        for row, first in zip(weights, starts, strict=True):
            ticks = (first[:, None] + np.arange(size)).ravel()[:n]  # the last stretch is cut: a log keeps its length
            row[:] = np.bincount(ticks % n, minlength=n)
        parts.append(weights)
    return Resampling(np.concatenate(parts, axis=1) if parts else np.zeros((draws, 0)), block, sample_ticks)
