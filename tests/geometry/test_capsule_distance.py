"""Distances of capsules against sampled points, a bounded search by scipy, and coal."""

from __future__ import annotations

import coal
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from hrcreplay.geometry.distances import nearest_pair, protrusion_m, segment_distance
from hrcreplay.records import Floats

SHARES = np.linspace(0.0, 1.0, 201)


def sampled(first: Floats, second: Floats) -> float:
    """The smallest distance between 201 points on each segment."""
    a, b = (ends[0] + SHARES[:, None] * (ends[1] - ends[0]) for ends in (first, second))
    return float(np.linalg.norm(a[:, None] - b[None], axis=2).min())


def by_search(first: Floats, second: Floats) -> float:
    """The same by scipy's bounded search over both shares, from several starts."""

    def gap2(x: Floats) -> float:
        apart = first[0] + x[0] * (first[1] - first[0]) - second[0] - x[1] * (second[1] - second[0])
        return float(apart @ apart)

    starts = ((0.1, 0.1), (0.9, 0.1), (0.1, 0.9), (0.9, 0.9))
    return min(float(np.sqrt(minimize(gap2, x, bounds=[(0, 1)] * 2, tol=1e-14).fun)) for x in starts)


def as_capsule(ends: Floats, radius_m: float) -> tuple[coal.Capsule, coal.Transform3s]:
    """A capsule of coal, whose axis is its z."""
    along = ends[1] - ends[0]
    turn, _ = Rotation.align_vectors([along], [[0.0, 0.0, 1.0]])
    return coal.Capsule(radius_m, float(np.linalg.norm(along))), coal.Transform3s(turn.as_matrix(), ends.mean(axis=0))


def random_segments(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Two segments of very different lengths, now and then parallel, crossing, or points."""
    first, second = rng.normal(size=(2, 2, 3))
    kind = rng.integers(6)
    if kind == 0:
        second = first + rng.normal(size=3)
    elif kind == 1:
        second[1] = second[0]
    elif kind == 2:
        second = second * 1e-3
    elif kind == 3:
        second = first.mean(axis=0) + np.outer([-1.0, 1.0], rng.normal(size=3))
    elif kind == 4:
        second = first + 1e-9 * rng.normal(size=(2, 3)) + rng.normal(size=3)
    return first, second


def test_segments_against_samples_and_a_search() -> None:
    rng = np.random.default_rng(1)
    for _ in range(300):
        first, second = random_segments(rng)
        gap, share, other = segment_distance(first, second)
        at = first[0] + share * (first[1] - first[0]), second[0] + other * (second[1] - second[0])
        assert 0.0 <= share <= 1.0
        assert 0.0 <= other <= 1.0
        assert np.linalg.norm(at[0] - at[1]) == pytest.approx(gap, abs=1e-12)
        length = np.linalg.norm(first[1] - first[0]) + np.linalg.norm(second[1] - second[0])
        assert gap - 1e-12 <= sampled(first, second) <= gap + length / 400
        assert gap == pytest.approx(by_search(first, second), abs=2e-6)


def test_capsules_against_coal() -> None:
    rng = np.random.default_rng(2)
    first, second = rng.normal(size=(50, 3, 2, 3)), rng.normal(size=(50, 4, 2, 3))
    second[..., 0] += 1.5
    radii = rng.uniform(0.02, 0.3, 3), rng.uniform(0.02, 0.3, 4)
    found = nearest_pair(first, radii[0], second, radii[1])
    for i in range(50):
        gaps = np.empty((3, 4))
        for a in range(3):
            for b in range(4):
                shapes = as_capsule(first[i, a], radii[0][a]), as_capsule(second[i, b], radii[1][b])
                gaps[a, b] = coal.distance(*shapes[0], *shapes[1], coal.DistanceRequest(), coal.DistanceResult())
        if gaps.min() > 0.0:
            assert found.distance_m[i] == pytest.approx(gaps.min(), abs=1e-6)
            assert gaps[found.first[i], found.second[i]] == pytest.approx(gaps.min(), abs=1e-6)
        else:
            assert found.distance_m[i] <= 1e-6


def test_a_capsule_that_is_not_known_is_not_there() -> None:
    one = np.array([[[[0.0, 0, 0], [1, 0, 0]]]])
    two = np.array([[[[0.5, 0.3, -1], [0.5, 0.3, 1]], [[np.nan, 0, 0], [0, 0, 0]]]])
    found = nearest_pair(one, np.array([0.1]), two, np.array([0.05, 9.0]))
    assert found.distance_m[0] == pytest.approx(0.15)
    assert (found.first[0], found.second[0]) == (0, 0)
    np.testing.assert_allclose(found.at_first_m[0], [0.5, 0, 0])
    np.testing.assert_allclose(found.at_second_m[0], [0.5, 0.3, 0])
    nothing = nearest_pair(one, np.array([0.1]), two[:, 1:], np.array([9.0]))
    assert np.isnan(nothing.distance_m[0])
    assert nothing.first[0] == nothing.second[0] == -1


def test_protrusion_against_sampled_points() -> None:
    """A point of the axis is outside the hull by its largest distance from a plane, or nearer an edge: from below."""
    rng = np.random.default_rng(3)
    for _ in range(40):
        vertices = rng.normal(size=(25, 3)) * 0.3
        axes = rng.normal(size=(6, 2, 3)) * 0.4
        found = protrusion_m(axes, 0.07, vertices, 0.1)
        planes = ConvexHull(vertices).equations
        for axis, out_m in zip(axes, found, strict=True):
            points = axis[0] + SHARES[:, None] * (axis[1] - axis[0])
            beyond = (points @ planes[:, :3].T + planes[:, 3]).max(axis=1).clip(min=0.0)
            assert out_m >= beyond.max() + 0.07 - 0.1 - 1e-9
            search = max(_to_hull(point, vertices) for point in axis)
            assert out_m == pytest.approx(search + 0.07 - 0.1, abs=1e-5)


def _to_hull(point: Floats, vertices: Floats) -> float:
    """Distance of a point from a hull by coal."""
    points = coal.StdVec_Vec3s()
    points.extend(list(vertices))
    hull = coal.Convex.convexHull(points, False, "")
    ball, at = coal.Sphere(1e-9), coal.Transform3s(np.eye(3), point)
    gap = coal.distance(hull, coal.Transform3s.Identity(), ball, at, coal.DistanceRequest(), coal.DistanceResult())
    return max(0.0, float(gap))
