from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import nnls

from hrcreplay.records import Floats
from hrcreplay.robot import separation as module
from hrcreplay.robot.bracket import brackets
from hrcreplay.robot.obstacles import obstacles
from hrcreplay.robot.separation import Separation, axis_distance, separation
from tests.robot.people import cloud, volumes


def nearest_of_hull(vertices: Floats, a: Floats, b: Floats) -> float:
    """Distance from the origin to the hull of all differences of vertices: least squares over convex weights."""
    differences = np.concatenate([vertices - a, vertices - b])
    heavy = 1e3
    weights, _ = nnls(np.vstack([differences.T, np.full(len(differences), heavy)]), np.array([0, 0, 0, heavy]))
    return float(np.linalg.norm(weights / weights.sum() @ differences))


def arm(*segments: Floats) -> Any:
    return SimpleNamespace(ends_m=np.array(segments))


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


def test_brackets_hold_the_distance() -> None:
    rng = np.random.default_rng(8)
    for _ in range(40):
        limbs = [SHAPES[name](rng) + rng.normal(size=3) * 0.6 for name in list(SHAPES)[:6]]
        seen, pose = obstacles(volumes(limbs), 0), arm(*rng.normal(size=(4, 2, 3)) * 0.4)
        low, high, _ = brackets(pose.ends_m, seen.vertices_m, seen.offsets)
        exact = separation(pose, seen)
        assert np.all(low <= exact + 1e-9)
        assert np.all(exact <= high + 1e-9)
        assert np.median(exact - low) < 0.02


def test_the_nearest_pair_is_that_of_all_exact_distances() -> None:
    rng = np.random.default_rng(9)
    for _ in range(60):
        limbs = [cloud(rng, 30, rng.uniform(0.02, 0.3, 3)) + rng.normal(size=3) * 0.7 for _ in range(6)]
        seen, pose = obstacles(volumes(limbs), 0), arm(*rng.normal(size=(5, 2, 3)) * 0.4)
        clearance = rng.uniform(0.1, 0.3, (5, 6))
        surface, link, limb = Separation(pose, seen, clearance).nearest()
        expected = separation(pose, seen) - clearance
        assert link * 6 + limb == np.argmin(expected)
        assert surface == expected.min()


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


def test_a_failure_of_coal_is_a_distance_that_is_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> tuple[float, Floats]:
        raise RuntimeError("GJK did not converge")

    seen, pose = obstacles(volumes([np.ones((3, 3))]), 0), arm(np.zeros((2, 3)))
    monkeypatch.setattr(module, "_gjk", broken)
    pairs = Separation(pose, seen, np.zeros((1, 1)))
    assert np.isnan(pairs.nearest()[0])
    assert pairs.failed
    monkeypatch.setattr(module, "_gjk", lambda *_: (np.nan, np.full(3, np.nan)))
    assert np.isnan(axis_distance(np.zeros(3), np.ones(3), np.ones((3, 3)), [0]))
