"""Distances against a solver that knows nothing of triangles, volumes against formulas."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from hrcreplay.geometry import inflated_hull
from hrcreplay.geometry.inflated_hull import InflatedHull, union_volume_m3
from hrcreplay.records import DOF, Floats


def _by_least_squares(point: Floats, vertices: Floats) -> float:
    """Distance from a convex hull: nearest convex combination, its weights' sum held at 1 by a heavy row."""
    heavy = 1e4
    A = np.vstack([(vertices - point).T, np.full(len(vertices), heavy)])
    weights, _ = nnls(A, np.array([0.0, 0.0, 0.0, heavy]))
    return float(np.linalg.norm((vertices - point).T @ (weights / weights.sum())))


SETS: dict[str, Callable[[np.random.Generator], Floats]] = {
    "solid": lambda rng: rng.normal(size=(40, 3)),
    "thin": lambda rng: rng.normal(size=(30, 3)) * [1.0, 0.3, 1e-3],
    "flat": lambda rng: np.column_stack([rng.normal(size=(12, 2)), np.full(12, 0.3)]),
    "line": lambda rng: rng.normal(size=(5, 1)) * np.array([[1.0, 2.0, -1.0]]) + 0.2,
    "point": lambda rng: rng.normal(size=(1, 3)),
    "few": lambda rng: rng.normal(size=(4, 3)),
}


@pytest.mark.parametrize("kind", SETS)
def test_distances_are_those_of_the_nearest_convex_combination(kind: str) -> None:
    rng = np.random.default_rng(7)
    for _ in range(6):
        vertices = SETS[kind](rng)
        points = np.concatenate([1.5 * rng.normal(size=(40, 3)), vertices[:3], vertices.mean(axis=0)[None]])
        if kind == "flat":
            points[:10, 2] = 0.3  # in its plane
        found = InflatedHull.around(vertices, 0.1).distances_m(points)
        expected = [_by_least_squares(point, vertices) for point in points]
        np.testing.assert_allclose(found, expected, atol=2e-6)
        assert (found[40:] < 1e-8).all()


@pytest.mark.parametrize("place_m", [0.0, 1e6, 1e9])
def test_far_from_the_origin_distances_are_as_exact_as_coordinates(place_m: float) -> None:
    """A square in its own plane, tilted: of its two sides none looks clearly towards a point beside it."""
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7])
    square = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 2.0, 0.0], [0.0, 2.0, 0.0]])
    points = np.array([[5.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 0.5], [5.0, 6.0, 0.0], [-1.0, 0.3, 0.0]])
    found = InflatedHull.around(turn.apply(square) + place_m, 0.1).distances_m(turn.apply(points) + place_m)
    np.testing.assert_allclose(found, [3.0, 0.0, 0.5, 5.0, 1.0], atol=1e-9 + 20.0 * float(np.spacing(place_m)))


def test_a_missing_point_has_no_distance() -> None:
    found = InflatedHull.around(np.eye(3), 0.1).distances_m(np.array([[np.nan, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    assert np.isnan(found[0])
    assert found[1] == 0.0


@pytest.mark.parametrize("kind", SETS)
def test_points_are_inside_within_the_radius_of_the_hull_and_only_there(kind: str) -> None:
    """Each by its distance, which a solver that knows nothing of triangles gives above."""
    rng = np.random.default_rng(11)
    for _ in range(20):
        solid = InflatedHull.around(SETS[kind](rng), float(rng.uniform(0.1, 1.5)))
        low, high = solid.vertices_m.min(axis=0) - solid.radius_m, solid.vertices_m.max(axis=0) + solid.radius_m
        samples = inflated_hull._spread(0, 4096) * (high - low) + low
        inside = inflated_hull._inside([solid], low, high, 4096)
        np.testing.assert_array_equal(inside, solid.distances_m(samples) <= solid.radius_m)
        assert 0.0 < inside.mean() < 1.0


def test_the_union_of_solids_apart_is_their_sum() -> None:
    rng = np.random.default_rng(3)
    one = InflatedHull.around(rng.normal(size=(20, 3)) * 0.2, 0.1)
    two = InflatedHull.around(rng.normal(size=(20, 3)) * 0.2 + 1.5, 0.2)
    exact = one.volume_m3() + two.volume_m3()
    found, error = union_volume_m3([one, two], 40_000)
    assert found == pytest.approx(exact, rel=0.01)
    assert error < 0.01 * exact


def test_the_union_of_two_balls_that_meet() -> None:
    """Lens of two unit balls one apart: 5 pi / 12."""
    balls = [InflatedHull.around(np.array([[x, 0.0, 0.0]]), 1.0) for x in (0.0, 1.0)]
    exact = 8.0 / 3.0 * np.pi - 5.0 / 12.0 * np.pi
    errors = []
    for k in range(DOF):
        found, error = union_volume_m3(balls, 1024, 1024 * k)
        errors.append(found - exact)
        assert error < 0.05 * exact
    assert abs(np.mean(errors)) < 0.004 * exact  # calls that go on in the sequence do not share their error
    assert union_volume_m3(balls[:1] * 3, 4096)[0] == union_volume_m3(balls[:1], 4096)[0]


def test_a_ball_and_a_capsule_above_a_height() -> None:
    """A cap of a ball in closed form; a capsule that stands in the floor keeps all but half a ball."""
    ball = InflatedHull.around(np.array([[0.4, -2.0, 0.1]]), 0.3)
    cap = np.pi * 0.2**2 * (3.0 * 0.3 - 0.2) / 3.0
    whole = 4.0 / 3.0 * np.pi * 0.3**3
    assert ball.volume_above_m3(0.0) == pytest.approx(whole - cap, rel=0.005)
    assert ball.volume_above_m3(0.2) == pytest.approx(cap, rel=0.02)
    assert ball.volume_above_m3(-0.2) == ball.volume_m3()
    assert ball.volume_above_m3(0.5) == pytest.approx(0.0, abs=0.01 * whole)
    assert ball.volume_above_m3(5.0) == pytest.approx(0.0, abs=0.01 * whole)
    legs = InflatedHull.around(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.9]]), 0.4)
    half = 2.0 / 3.0 * np.pi * 0.4**3
    assert legs.volume_above_m3(0.0) == pytest.approx(legs.volume_m3() - half, rel=0.003)


def test_a_hull_above_a_height_is_the_share_of_random_points() -> None:
    rng = np.random.default_rng(5)
    for _ in range(DOF):
        solid = InflatedHull.around(rng.normal(size=(12, 3)) * 0.3 + [0.0, 0.0, 0.2], 0.15)
        low, high = solid.vertices_m.min(axis=0) - 0.15, solid.vertices_m.max(axis=0) + 0.15
        points = rng.uniform(low, high, size=(40_000, 3))
        share = ((points[:, 2] >= 0.0) & (solid.distances_m(points) <= 0.15)).mean()
        assert solid.volume_above_m3(0.0) == pytest.approx(share * np.prod(high - low), rel=0.03)
