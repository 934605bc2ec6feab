"""Distances where geometry is degenerate: parallel, collinear, coplanar, touching, a point, and all of them nearly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.geometry.distances import distances, farthest_at_most
from hrcreplay.records import Floats
from tests.geometry.exact import exact_distance
from tests.robot.distances import axis_distance

PAIRS = 10_000


def grid(rng: Any) -> Floats:
    return rng.integers(-3, 4, (rng.integers(1, 9), 3)) * 0.25


def line(rng: Any) -> Floats:
    return np.outer(rng.uniform(-1, 1, rng.integers(1, 9)), np.eye(3)[rng.integers(3)]) + rng.integers(-3, 4, 3) * 0.25


def plane(rng: Any) -> Floats:
    points = grid(rng)
    points[:, rng.integers(3)] = 0.3
    return points


def point(rng: Any) -> Floats:
    return np.repeat(rng.normal(size=(1, 3)), rng.integers(1, 6), axis=0)


def twice(rng: Any) -> Floats:
    points = rng.normal(size=(rng.integers(1, 9), 3))
    return np.concatenate([points, points])


def prism(rng: Any) -> Floats:
    """What the lower body is: a ring on the floor, and the same ring higher."""
    turn = np.arange(rng.integers(3, 13)) * 2 * np.pi / 12 + rng.uniform(0, 6)
    ring = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))]) * rng.uniform(0.01, 0.6)
    return np.concatenate([ring, ring + np.array([0, 0, rng.uniform(0.1, 2.0)])]) + rng.normal(size=3)


SHAPES = (grid, line, plane, point, twice, prism)


def segment(rng: Any, vertices: Floats) -> tuple[Floats, Floats]:
    """Upright, a point, from a vertex, along an edge, on the grid or anyhow."""
    a = rng.integers(-6, 7, 3) * 0.25
    ends = (
        (a, a + np.array([0.0, 0.0, rng.uniform(-1, 1)])),
        (a, a),
        (vertices[0], vertices[0] + rng.normal(size=3)),
        (a, a + vertices[-1] - vertices[0]),
        (a, rng.integers(-6, 7, 3) * 0.25),
        (rng.normal(size=3), rng.normal(size=3)),
    )
    return ends[rng.integers(len(ends))]


def degenerate(rng: Any) -> tuple[Floats, Floats, Floats]:
    """Exactly so, or off by 1e-15 to 1e-5 m; in line with the axes of the world or turned."""
    vertices = SHAPES[rng.integers(len(SHAPES))](rng).astype(float)
    a, b = segment(rng, vertices)
    if rng.random() < 0.5:
        turned, moved = Rotation.random(random_state=int(rng.integers(2**31))), rng.normal(size=3)
        vertices, a, b = turned.apply(vertices) + moved, turned.apply(a) + moved, turned.apply(b) + moved
    off = 10.0 ** rng.uniform(-15, -5) * rng.integers(2)
    return a + off * rng.normal(size=3), b + off * rng.normal(size=3), vertices + off * rng.normal(size=vertices.shape)


def anyhow(rng: Any) -> tuple[Floats, Floats, Floats]:
    """Solids of 1 mm to 10 m, near and far."""
    size, away = 10.0 ** rng.uniform(-3.0, 1.0), rng.choice([0.01, 0.3, 1.0])
    vertices = rng.normal(size=(rng.integers(1, 40), 3)) * size + rng.normal(size=3) * away
    return rng.normal(size=3) * 0.4, rng.normal(size=3) * 0.4, vertices


def ours(a: Floats, b: Floats, vertices: Floats) -> tuple[float, float]:
    low, high, _ = distances(np.array([[a, b]]), vertices, np.array([0, len(vertices)]))
    return float(low[0, 0]), float(high[0, 0])


@pytest.mark.parametrize("pairs", [degenerate, anyhow])
def test_both_bounds_are_within_a_nanometre_of_another_implementation(pairs: Any) -> None:
    """coal measures every pair; where it finds nothing or differs, rational arithmetic decides."""
    rng = np.random.default_rng(20)
    asked = 0
    for _ in range(PAIRS):
        a, b, vertices = pairs(rng)
        low, high = ours(a, b, vertices)
        expected = axis_distance(a, b, vertices, [0])
        if not abs(low - expected) <= 1e-10:
            asked += 1
            expected = exact_distance(a, b, vertices)
        assert low == pytest.approx(expected, rel=0, abs=1e-9)
        assert high == pytest.approx(expected, rel=0, abs=1e-9)
    assert asked < PAIRS // 20


def test_the_lower_bound_is_one_in_rational_arithmetic() -> None:
    """To the rounding of coordinates of 10 m, however degenerate the pair is."""
    rng = np.random.default_rng(21)
    for pairs in (degenerate, anyhow):
        for _ in range(100):
            a, b, vertices = pairs(rng)
            vertices = vertices[:12]
            low, high = ours(a, b, vertices)
            exact = exact_distance(a, b, vertices)
            assert exact - 1e-10 <= low <= exact + 1e-14
            assert exact - 1e-14 <= high <= exact + 1e-10


def test_a_link_nearly_parallel_to_an_edge_of_the_lower_body() -> None:
    """A tool that points straight down beside a person, as a replay had it: the bounds did not meet, coal gave up."""
    bottom = np.array([[0.86, 0.32, 0.0], [0.91, 0.35, 0.0], [0.95, 0.52, 0.0], [0.88, 0.61, 0.0]])
    for tilt in 10.0 ** np.arange(-12.0, -5.0, 0.25):
        a = np.array([-0.75, -0.3, 0.937])
        b = a + np.array([tilt, -2 * tilt, -0.1])
        vertices = np.concatenate([bottom, bottom + np.array([0.3 * tilt, tilt, 0.95])])
        low, high = ours(a, b, vertices)
        assert low == pytest.approx(exact_distance(a, b, vertices), rel=0, abs=1e-10)
        assert high - low <= 1e-10


def test_the_farthest_point_has_a_bound_that_is_exact_beyond_what_is_enough() -> None:
    rng = np.random.default_rng(11)
    beyond = 0
    for _ in range(300):
        vertices, points = rng.normal(size=(int(rng.integers(1, 20)), 3)), 2.0 * rng.normal(size=(5, 3))
        points[0, 1] = np.nan  # not seen
        exact = max(exact_distance(p, p, vertices) for p in points[1:])
        for enough_m in (-0.1, 0.3, 1.5):
            bound = farthest_at_most(points, vertices, enough_m)
            assert bound >= exact - 1e-9
            if exact > enough_m:
                beyond += 1
                assert bound == pytest.approx(exact, abs=1e-9)
            else:
                assert bound <= enough_m + 1e-9
    assert 300 < beyond < 900
