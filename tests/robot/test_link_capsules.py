from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.records import Floats
from hrcreplay.robot.link_capsules import capsule_m3, fit, hull_m3


def outside_m(points: Floats, start: Floats, end: Floats, radius: float) -> float:
    """How far the furthest point is outside a capsule, by trying 2,001 balls along its axis [m]."""
    centres = start + np.linspace(0.0, 1.0, 2001)[:, None] * (end - start)
    return max(float(np.linalg.norm(centres - point, axis=1).min()) for point in points) - radius


def ball(count: int, rng: np.random.Generator) -> Floats:
    points = rng.normal(size=(count, 3))
    return np.asarray(points / np.linalg.norm(points, axis=1)[:, None])


@pytest.mark.parametrize("length", [0.0, 0.05, 0.4])
def test_a_capsules_own_surface_gives_it_back(length: float) -> None:
    rng = np.random.default_rng(1)
    turn = Rotation.from_rotvec([0.4, -1.0, 0.3])
    ends = turn.apply([[0, 0, -length / 2], [0, 0, length / 2]]) + np.array([0.3, -0.2, 0.5])
    points = np.vstack([end + 0.06 * ball(400, rng) for end in ends])
    start, end, radius = fit(points)
    assert outside_m(points, start, end, radius) <= 1e-6
    assert capsule_m3(float(np.linalg.norm(end - start)), radius) <= 1.01 * capsule_m3(length, 0.06)


def test_no_capsule_of_a_dense_search_is_much_smaller() -> None:
    """Clouds without symmetry, against the best of many random axes with the shortest ends for each."""
    rng = np.random.default_rng(2)
    for _ in range(5):
        points = rng.normal(size=(60, 3)) * [0.02, 0.05, 0.15]
        start, end, radius = fit(points)
        assert outside_m(points, start, end, radius) <= 1e-6
        found = capsule_m3(float(np.linalg.norm(end - start)), radius)
        for axis in ball(2000, rng):
            flat = points - np.outer(points @ axis, axis)
            off = np.linalg.norm(flat - (flat.max(axis=0) + flat.min(axis=0)) / 2, axis=1)
            reach, along = np.sqrt(off.max() ** 2 - off**2), points @ axis
            assert found <= 1.02 * capsule_m3(max(0.0, (along - reach).max() - (along + reach).min()), off.max())


@pytest.mark.parametrize(
    "points",
    [
        [[0.1, 0.2, 0.3]],
        [[0.1, 0.2, 0.3], [0.1, 0.2, 0.3]],
        [[0, 0, 0], [0.2, 0.1, 0.0]],
        [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]],
        [[0, 0, 0.1], [0.4, 0, 0.1], [0.4, 0.2, 0.1], [0, 0.2, 0.1], [0.2, 0.1, 0.1]],
    ],
)
def test_points_lines_and_plates_have_a_capsule_too(points: list[list[float]]) -> None:
    cloud = np.array(points, dtype=float)
    start, end, radius = fit(cloud)
    assert outside_m(cloud, start, end, radius) <= 1e-6
    assert 0 < radius <= float(np.linalg.norm(np.ptp(cloud, axis=0))) / 2 + 1.1e-4
    assert hull_m3(cloud) == 0.0


def test_the_same_points_give_the_same_capsule() -> None:
    points = np.random.default_rng(3).normal(size=(500, 3)) * [0.02, 0.05, 0.15]
    first, again = fit(points), fit(points)
    assert first[0].tobytes() + first[1].tobytes() == again[0].tobytes() + again[1].tobytes()
    assert first[2] == again[2]
