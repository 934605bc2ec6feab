from __future__ import annotations

import numpy as np

from hrcreplay.geometry.polyline import follow_nearer


def test_it_goes_on_to_the_first_vertex_from_which_both_neighbours_are_farther() -> None:
    rng = np.random.default_rng(5)
    path, points = np.cumsum(rng.normal(size=(60, 3)), axis=0), 3.0 * rng.normal(size=(200, 3))
    start = rng.integers(0, 60, 200)
    at = start.copy()
    follow_nearer(points, path, at)
    apart = np.linalg.norm(path[None] - points[:, None], axis=2)
    for row, (first, last) in enumerate(zip(start, at, strict=True)):
        way = first
        for step in (-1, 1):
            while 0 <= way + step < 60 and apart[row, way + step] < apart[row, way]:
                way += step
        assert last == way
    assert (at != start).mean() > 0.3


def test_along_a_line_it_finds_the_nearest_vertex() -> None:
    path = np.linspace(0.0, 1.0, 101)[:, None] * np.array([[1.0, 2.0, -1.0]])
    points, at = path[[7, 50, 100]] + 1e-3, np.array([100, 0, 3])
    follow_nearer(points, path, at)
    assert at.tolist() == [7, 50, 100]
