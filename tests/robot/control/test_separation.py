from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import nnls

from hrcreplay.geometry.distances import EXACT_M, distances
from hrcreplay.records import Floats
from hrcreplay.robot.control import separation as module
from hrcreplay.robot.control.separation import NearestLink, Obstacles, measure, obstacles
from tests.robot.distances import axis_distance, by_coal
from tests.robot.people import cloud, volumes


def nearest_of_hull(vertices: Floats, a: Floats, b: Floats) -> float:
    """Distance from the origin to the hull of all differences of vertices: least squares over convex weights."""
    differences = np.concatenate([vertices - a, vertices - b])
    heavy = 1e3
    weights, _ = nnls(np.vstack([differences.T, np.full(len(differences), heavy)]), np.array([0, 0, 0, heavy]))
    return float(np.linalg.norm(weights / weights.sum() @ differences))


def arm(*segments: Floats) -> Any:
    return SimpleNamespace(ends_m=np.array(segments))


def measured(pose: Any, seen: Obstacles, radius: Floats, clearance_m: float) -> NearestLink:
    return measure(pose.ends_m, radius, seen.vertices_m, seen.offsets, seen.radius_m, clearance_m)


SHAPES: dict[str, Callable[[np.random.Generator], Floats]] = {
    "solid": lambda rng: cloud(rng, 60, rng.uniform(0.05, 0.4, 3)),
    "inner points too": lambda rng: rng.normal(size=(80, 3)) * 0.2,
    "box": lambda _: np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T * 0.2,
    "point": lambda _: np.zeros((1, 3)),
    "one point many times": lambda _: np.zeros((40, 3)),
    "two points": lambda rng: rng.normal(size=(2, 3)) * 0.3,
    "on a line": lambda rng: rng.normal(size=(50, 1)) * rng.normal(size=3) * 0.2,
    "in a plane": lambda rng: cloud(rng, 70, np.array([0.3, 0.2, 0.0])),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_distance_is_that_of_brute_force(shape: str) -> None:
    rng = np.random.default_rng(5)
    for _ in range(25):
        vertices = SHAPES[shape](rng) + rng.normal(size=3) * 0.8
        a, b = rng.normal(size=(2, 3)) * 0.5
        expected = nearest_of_hull(vertices, a, b)
        assert axis_distance(a, b, vertices, [0]) == pytest.approx(expected, abs=1e-8)


def test_an_axis_inside_the_hull_is_at_distance_zero() -> None:
    rng = np.random.default_rng(6)
    for _ in range(50):
        vertices = cloud(rng, 60, np.array([0.5, 0.4, 0.6]))
        a, b = rng.normal(size=(2, 3)) * 0.05
        assert axis_distance(a, b, vertices, [0]) == 0.0
        assert axis_distance(a, b + 5.0, vertices, [3]) == 0.0, "one end out"


def test_a_segment_without_length_is_a_point() -> None:
    vertices = np.array([[1.0, -1, -1], [1, 1, -1], [1, -1, 1], [1, 1, 1]])
    assert axis_distance(np.zeros(3), np.zeros(3), vertices, [2]) == pytest.approx(1.0, abs=1e-12)


def test_a_distance_never_depends_on_where_the_search_begins() -> None:
    rng = np.random.default_rng(7)
    vertices = cloud(rng, 100, np.array([0.3, 0.3, 0.3])) + 1.0
    a, b = np.zeros(3), np.array([0.3, 0.0, 0.2])
    found = [axis_distance(a, b, vertices, [i]) for i in range(0, 100, 7)]
    np.testing.assert_allclose(found, found[0], atol=2e-10)


def test_both_methods_find_the_same_distances() -> None:
    """Shapes of 1 mm to 10 m, near, far and in contact; ours is proven wherever it is."""
    rng = np.random.default_rng(8)
    for _ in range(60):
        size, away = 10.0 ** rng.uniform(-3.0, 1.0), rng.choice([0.01, 0.3, 1.0])
        limbs = [SHAPES[name](rng) * size + rng.normal(size=3) * away for name in rng.permutation(list(SHAPES))[:6]]
        seen, pose = obstacles(volumes(limbs), 0), arm(*rng.normal(size=(4, 2, 3)) * 0.4)
        low, high, near = distances(pose.ends_m, seen.vertices_m, seen.offsets)
        exact = by_coal(pose, seen)
        np.testing.assert_allclose(low, exact, rtol=0, atol=1e-10)
        assert np.all(high - low <= EXACT_M)
        assert np.all((near >= seen.offsets[:-1, None]) & (near < seen.offsets[1:, None]))


def test_the_carriers_hold_the_nearest_point() -> None:
    rng = np.random.default_rng(12)
    limbs = [cloud(rng, 60, rng.uniform(0.05, 0.3, 3)) + rng.normal(size=3) for _ in range(6)]
    seen, pose = obstacles(volumes(limbs), 0), arm(*rng.normal(size=(5, 2, 3)) * 0.4)
    low, _, near = distances(pose.ends_m, seen.vertices_m, seen.offsets)
    for link, limb in np.ndindex(low.shape):
        carried = nearest_of_hull(seen.vertices_m[near[link, limb]], *pose.ends_m[link])
        assert carried == pytest.approx(low[link, limb], abs=1e-8)


def test_the_nearest_pair_is_that_of_all_distances() -> None:
    rng = np.random.default_rng(9)
    for _ in range(60):
        limbs = [cloud(rng, 30, rng.uniform(0.02, 0.3, 3)) + rng.normal(size=3) * 0.7 for _ in range(6)]
        seen, pose = obstacles(volumes(limbs), 0), arm(*rng.normal(size=(5, 2, 3)) * 0.4)
        radius, ball = rng.uniform(0.05, 0.1, 5), rng.uniform(0.0, 0.2, 6)
        ball.flags.writeable = False  # as radii are: so the kernel is that of a run
        _, surface, link, limb = measured(pose, seen._replace(radius_m=ball), radius, 0.05)
        expected = by_coal(pose, seen) - radius[:, None] - ball - 0.05
        assert link * 6 + limb == np.argmin(expected)
        assert surface == pytest.approx(expected.min(), abs=1e-10)


def test_obstacles_are_those_of_their_tick() -> None:
    rng = np.random.default_rng(10)
    limbs = [rng.normal(size=(n, 3)) for n in (4, 1, 9)]
    seen = obstacles(volumes(limbs), 0)
    assert seen.known
    for limb, points in enumerate(limbs):
        np.testing.assert_array_equal(seen.vertices_m[seen.offsets[limb] : seen.offsets[limb + 1]], points)
        np.testing.assert_array_equal(seen.boxes_m[limb], [points.min(axis=0), points.max(axis=0)])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_limb_that_is_not_finite_or_empty_is_not_known(bad: float) -> None:
    limbs = [np.zeros((3, 3)), np.full((1, 3), bad)]
    assert not obstacles(volumes(limbs), 0).known
    assert not obstacles(volumes([np.zeros((3, 3)), np.zeros((0, 3))]), 0).known


def test_a_pair_whose_bounds_do_not_meet_counts_with_the_lower_one(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, pose = obstacles(volumes([np.ones((3, 3)), np.full((3, 3), 2.0)]), 0), arm(np.zeros((2, 3)))

    def open_ended(*given: Any) -> tuple[Floats, Floats, Any]:
        low, high, near = distances(*given)
        return low - 0.1, high + 0.1, near

    monkeypatch.setattr(module, "distances", open_ended)
    seen = seen._replace(radius_m=np.zeros(2))
    found = measure.py_func(pose.ends_m, np.zeros(1), seen.vertices_m, seen.offsets, seen.radius_m, 0.0)
    np.testing.assert_allclose(found.pairs.distance_m, np.sqrt([[3.0, 12.0]]) - 0.1, rtol=0, atol=1e-12)
    assert found[1:] == pytest.approx((np.sqrt(3.0) - 0.1, 0, 0))
