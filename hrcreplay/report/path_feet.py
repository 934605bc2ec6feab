"""The nearest points of a path that was driven again and again."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from hrcreplay.records import Floats, Ints
from hrcreplay.report.metrics import thin_path

#: Vertices of a path nearer to each other than this are looked at together, and nearer than that are one [m].
_CELL_M, _SAME_M = 2e-4, 1e-6


def path_feet(points: Floats, path: Floats) -> Floats:
    """(n, 3) for each of (n, 3) points the nearest one of a (m, 3) polyline, all in one frame [m].

    Searched on the two segments at the nearest vertex, which is exact where vertices are denser than the path bends.
    """
    path = thin_path(path[np.isfinite(path).all(axis=1)], _SAME_M)
    feet = np.full(points.shape, np.nan)
    known = np.isfinite(points).all(axis=1)
    if not len(path) or not known.any():
        return feet
    at = points[known]
    nearest = _nearest_vertices(at, path)
    best = path[nearest]
    best_m = np.linalg.norm(at - best, axis=1)
    for other in (np.maximum(nearest - 1, 0), np.minimum(nearest + 1, len(path) - 1)):
        along = path[other] - path[nearest]
        length2 = (along**2).sum(axis=1)
        share = np.clip(((at - path[nearest]) * along).sum(axis=1) / np.where(length2 > 0, length2, 1.0), 0.0, 1.0)
        foot = path[nearest] + share[:, None] * along
        foot_m = np.linalg.norm(at - foot, axis=1)
        better = foot_m < best_m
        best, best_m = np.where(better[:, None], foot, best), np.where(better, foot_m, best_m)
    feet[known] = best
    return feet


def _nearest_vertices(points: Floats, path: Floats) -> Ints:
    """(n,) vertices of a (m, 3) path that are nearest to (n, 3) points.

    A programme comes by the same places in each cycle, and a tree of all that vertices is slow: of those in one cell
    one is looked at, and from there the search goes along the path as long as it comes nearer.
    """
    _, first = np.unique(np.floor(path / _CELL_M).astype(np.int64), axis=0, return_index=True)
    vertices = np.sort(first)
    found: Ints = vertices[cKDTree(path[vertices]).query(points)[1]].astype(np.int64)
    for step in (-1, 1):
        active = np.arange(len(points))
        while len(active):
            other = np.clip(found[active] + step, 0, len(path) - 1)
            gap, now = (((path[at] - points[active]) ** 2).sum(axis=1) for at in (other, found[active]))
            active, other = active[gap < now], other[gap < now]
            found[active] = other
    return found
