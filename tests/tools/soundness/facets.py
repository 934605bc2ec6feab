"""How far points are outside convex volumes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull

from hrcreplay.records import Floats, Ints
from tests.tools.soundness.compiled import kernel

#: A set thinner than this in a direction has no extent in it [m].
_FLAT_M = 1e-10
#: A ball smaller than this is as good as a shift of the sides [m].
_THIN_M = 1e-6


class Facets(NamedTuple):
    """Sides of several polytopes; those of the k-th are ``first[k]`` up to ``first[k + 1]``.

    A point x is inside where ``normals @ x + offsets <= 0``. The largest of these is how far outside it is at least,
    or how far inside exactly [m].
    """

    normals: Floats
    offsets: Floats
    first: Ints


def facets_of(clouds: list[Floats], balls_m: Floats) -> Facets:
    """Sides of convex hulls of point sets, (m, 3) each [m], with a ball around every point of each hull.

    Around a ball there are no sides, but any plane that touches the whole cuts away nothing of it: what is on its
    outer side is outside. Beside the hull's own sides, planes halfway between neighbours are taken.
    """
    planes = [
        _rounded(cloud, ball) if ball > _THIN_M else _planes(cloud) - [0.0, 0.0, 0.0, ball]
        for cloud, ball in zip(clouds, balls_m, strict=True)
    ]
    stacked = np.concatenate(planes)
    first = np.concatenate([[0], np.cumsum([len(p) for p in planes])])
    return Facets(np.ascontiguousarray(stacked[:, :3]), np.ascontiguousarray(stacked[:, 3]), first.astype(np.int64))


def _rounded(cloud: Floats, ball: float) -> Floats:
    """(f, 4) planes that touch a hull with balls around its points."""
    hull = ConvexHull(cloud)
    normals = hull.equations[:, :3]
    halfway = (normals[:, None] + normals[hull.neighbors]).reshape(-1, 3)
    length = np.linalg.norm(halfway, axis=1)
    directions = np.concatenate([normals, halfway[length > 1e-3] / length[length > 1e-3, None]])
    directions = np.unique(directions.round(9), axis=0)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return np.column_stack([directions, -(directions @ cloud.T).max(axis=1) - ball])


def _planes(cloud: Floats) -> Floats:
    """(f, 4) sides of one hull; a flat one (joints that cannot move) has its plane twice and sides at right angles."""
    middle = cloud.mean(axis=0)
    _, extents, axes = np.linalg.svd(np.vstack([cloud - middle, np.zeros((3, 3))]), full_matrices=False)
    rank = int((extents > _FLAT_M).sum())
    if rank == 3:
        planes: Floats = ConvexHull(cloud).equations
    else:
        flat = (cloud - middle) @ axes[:rank].T
        edges = ConvexHull(flat).equations if rank == 2 else np.array([[-1.0, flat.min()], [1.0, -flat.max()]])
        across = np.concatenate([edges[:, :-1] @ axes[:rank], axes[rank:], -axes[rank:]])
        inner = np.concatenate([edges[:, -1], np.zeros(2 * (3 - rank))])
        planes = np.column_stack([across, inner - across @ middle])
    return np.unique(planes, axis=0)


@kernel
def outside(facets: Facets, k: int, points: Floats, enough: float, margins: Floats) -> None:
    """Raises ``margins`` (b,) to how far outside the k-th polytope the points (3, b) are [m].

    A result that is not above ``enough`` may be too small: a side from which the box around all the points is farther
    than that is passed over.
    """
    x, y, z = points[0], points[1], points[2]
    cx, cy, cz = 0.5 * (x.min() + x.max()), 0.5 * (y.min() + y.max()), 0.5 * (z.min() + z.max())
    rx, ry, rz = 0.5 * (x.max() - x.min()), 0.5 * (y.max() - y.min()), 0.5 * (z.max() - z.min())
    for f in range(facets.first[k], facets.first[k + 1]):
        nx, ny, nz = facets.normals[f, 0], facets.normals[f, 1], facets.normals[f, 2]
        offset = facets.offsets[f]
        farthest = nx * cx + ny * cy + nz * cz + offset + abs(nx) * rx + abs(ny) * ry + abs(nz) * rz
        if farthest > enough:
            for i in range(len(margins)):
                margin = nx * x[i] + ny * y[i] + nz * z[i] + offset
                margins[i] = margin if margin > margins[i] else margins[i]


def distance_m(vertices: Floats, point: Floats) -> float:
    """Distance of a point from the convex hull of (m, 3) [m], 0 inside: Lawson and Hanson's least distance."""
    towards = vertices - point
    scale = np.abs(towards).max()
    rows = np.vstack([towards.T / scale, np.ones(len(vertices))])
    weights, _ = nnls(rows, np.array([0.0, 0.0, 0.0, 1.0]))
    return float(np.linalg.norm(weights / weights.sum() @ towards))
