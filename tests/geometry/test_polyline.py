from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.geometry.polyline import advance_foot, follow_nearer, nearest_vertices
from hrcreplay.records import Floats, Ints


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


@pytest.mark.parametrize("count", [1, 31, 33, 700, 2000])
def test_the_nearest_vertex_is_that_of_all(count: int) -> None:
    """Points that jump about and points that move little, near the vertices and far from them."""
    rng = np.random.default_rng(count)
    vertices = np.cumsum(rng.normal(size=(count, 3)), axis=0)
    points = np.concatenate([30.0 * rng.normal(size=(200, 3)), np.cumsum(0.1 * rng.normal(size=(200, 3)), axis=0)])
    apart = np.linalg.norm(vertices[None] - points[:, None], axis=2)
    assert np.array_equal(nearest_vertices(points, vertices), apart.argmin(axis=1))


def test_along_a_line_it_finds_the_nearest_vertex() -> None:
    path = np.linspace(0.0, 1.0, 101)[:, None] * np.array([[1.0, 2.0, -1.0]])
    points, at = path[[7, 50, 100]] + 1e-3, np.array([100, 0, 3])
    follow_nearer(points, path, at)
    assert at.tolist() == [7, 50, 100]


def _advance(points: Floats, path: Floats, way_m: Floats, until: Ints, ahead_m: float) -> tuple[int, float]:
    """The foot of every position by numpy, over all segments of the section at once."""
    passed, share = 0, 0.0
    for point, last in zip(points, until.tolist(), strict=True):
        if passed == last:
            continue
        here_m = way_m[passed] + share * (way_m[passed + 1] - way_m[passed])
        end = min(last, max(passed + 1, int(np.searchsorted(way_m, here_m + ahead_m))))
        start, along = path[passed:end], np.diff(path[passed : end + 1], axis=0)
        part = np.clip(np.vecdot(point - start, along) / np.vecdot(along, along), 0.0, 1.0)
        part[0] = max(part[0], share)
        nearest = int(np.argmin(np.linalg.norm(start + part[:, None] * along - point, axis=1)))
        passed, share = passed + nearest, float(part[nearest])
        if share == 1.0:
            passed, share = passed + 1, 0.0
    return passed, share


def test_a_foot_only_advances_and_stays_within_the_section_ahead_of_it() -> None:
    rng = np.random.default_rng(8)
    path = np.cumsum(rng.normal(size=(80, 3)), axis=0)
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    until = np.minimum(np.arange(300) // 3, 79)
    points = path[np.maximum(until - 4, 0)] + 0.4 * rng.normal(size=(300, 3))
    places = []
    for n in range(1, 301, 7):
        found = advance_foot(points[:n], path, way_m, until[:n], 5.0, 0.0)
        expected = _advance(points[:n], path, way_m, until[:n], 5.0)
        assert found[0] == expected[0]
        np.testing.assert_allclose(found[1], expected[1], atol=1e-12)
        places.append(found[0] + found[1])
    assert (np.diff(places) >= 0.0).all()
    assert places[-1] > 60.0


def test_a_foot_is_not_searched_again_for_a_point_that_hardly_moves_except_at_its_last_position() -> None:
    path, way_m = np.linspace(0.0, 1.0, 11)[:, None] * np.array([[1.0, 0.0, 0.0]]), np.linspace(0.0, 1.0, 11)
    points, until = np.linspace(0.0, 0.55, 12)[:, None] * np.array([[1.0, 0.0, 0.0]]), np.full(12, 10)
    assert sum(advance_foot(points, path, way_m, until, 0.2, 0.0)) == pytest.approx(5.5)
    assert sum(advance_foot(points, path, way_m, until, 0.2, 1.0)) == pytest.approx(2.0), "0.2 m from its first foot"
