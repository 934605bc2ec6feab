"""Convex polygons against matplotlib's even-odd test and sampled borders."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.path import Path
from scipy.spatial import ConvexHull

from hrcreplay.geometry.polygon import ConvexPolygon
from hrcreplay.records import Floats


def corners_of(seed: int) -> Floats:
    """Corners of a random convex polygon; every second one clockwise."""
    points = np.random.default_rng(seed).normal(size=(12, 2)) * [2.0, 1.0]
    corners = points[ConvexHull(points).vertices]
    return corners[::-1] if seed % 2 else corners


@pytest.mark.parametrize("seed", range(20))
def test_a_point_is_as_deep_as_the_nearest_point_of_the_border_is_far(seed: int) -> None:
    corners = corners_of(seed)
    points = np.random.default_rng(seed + 100).uniform(-4.0, 4.0, (200, 3))
    depth = ConvexPolygon.of_corners(corners).depth_m(points)
    inside = Path(corners).contains_points(points[:, :2])
    assert ((depth > 0.0) == inside).all()
    share = np.linspace(0.0, 1.0, 2001)[:, None, None]
    border = ((1.0 - share) * corners + share * np.roll(corners, -1, axis=0)).reshape(-1, 2)
    far = np.linalg.norm(points[inside][:, None, :2] - border, axis=2).min(axis=1)
    np.testing.assert_allclose(depth[inside], far, atol=2e-3)


def test_an_unknown_point_has_no_depth() -> None:
    assert np.isnan(ConvexPolygon.of_corners(corners_of(0)).depth_m(np.array([np.nan, 0.0, 1.0])))


@pytest.mark.parametrize(
    "corners",
    [
        [[0, 0], [1, 0]],
        [[0, 0], [1, 0], [2, 0]],
        [[0, 0], [1, 1], [1, 0], [0, 1]],
        [[0, 0], [2, 0], [1, 0.5], [2, 2], [0, 2]],
        [[0, 0], [1, 0], [1, 0], [1, 1]],
        [[0, 0], [1, 0], [np.nan, 1]],
        [[np.cos(a), np.sin(a)] for a in 4 * np.pi * np.arange(5) / 5],
    ],
    ids=["two", "a line", "crossed", "a dent", "twice", "no number", "a star"],
)
def test_what_is_no_convex_polygon_is_refused(corners: list[list[float]]) -> None:
    with pytest.raises(ValueError, match=r"no convex polygon|corners"):
        ConvexPolygon.of_corners(np.array(corners, dtype=float))
