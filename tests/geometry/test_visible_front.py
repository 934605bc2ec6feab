"""The front of a convex solid against the planes of all its faces, pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from hrcreplay.geometry.convex_hull import visible_front


@pytest.mark.parametrize("seed", range(4))
def test_depth_is_that_of_the_last_plane_before_the_solid(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(60, 3))
    hull = ConvexHull(points)
    triangles = points[hull.simplices]
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    inward = (np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) * normals).sum(axis=1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    u = v = np.linspace(-3.0, 3.0, 121)
    depth, light = visible_front(triangles, np.arange(len(triangles), dtype=float), u, v)
    flat = np.stack(np.meshgrid(u, v), axis=-1)
    along = -(flat @ normals[:, :2].T + offsets) / normals[:, 2]  # where a pixel's line meets each plane
    facing = normals[:, 2] > 0
    front, back = along[..., facing].min(axis=-1), along[..., ~facing].max(axis=-1)
    clear = np.abs(front - back) > 1e-6  # on the outline itself either will do
    np.testing.assert_array_equal(np.isfinite(depth)[clear], (front >= back)[clear])
    seen = np.isfinite(depth) & clear
    assert seen.sum() > 500
    np.testing.assert_allclose(depth[seen], front[seen], atol=1e-9)
    two = np.sort(along[..., facing], axis=-1)[..., :2]
    plain = seen & (two[..., 1] - two[..., 0] > 1e-6)
    np.testing.assert_array_equal(light[plain], np.flatnonzero(facing)[np.argmin(along[..., facing], axis=-1)][plain])
