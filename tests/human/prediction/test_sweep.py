from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from hrcreplay.human.prediction.sweep import MOST_COPIES, TRIANGLE_RAD, sweep_rot
from hrcreplay.records import Floats

POINT = np.array([[0.4, -0.3, 0.7]])


def turned(points: Floats, axis: int, low: float, high: float) -> Floats:
    swept = np.empty((MOST_COPIES * len(points), 3))
    return swept[: sweep_rot(points, len(points), axis, low, high, swept, TRIANGLE_RAD)]


def test_a_quarter_turn_by_hand() -> None:
    swept = turned(np.array([[1.0, 0.0, 0.0]]), 2, 0.0, np.pi / 2)  # two pieces of 45 degrees
    apex = np.tan(np.pi / 8)
    expected = [[1.0, apex, 0], [apex, 1.0, 0], [1, 0, 0], [0, 1, 0]]
    assert swept == pytest.approx(np.array(expected), abs=1e-15)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("width", [1e-12, 1e-3, 0.6, np.pi / 3, 1.1, np.pi, 4.0, 6.2, 2 * np.pi, 9.0])
def test_every_point_of_the_arc_is_between_the_points(axis: int, width: float) -> None:
    low = -0.8
    swept = turned(POINT, axis, low, low + width)
    along = np.eye(3)[axis]
    arc = np.stack([Rotation.from_rotvec(along * a).apply(POINT[0]) for a in np.linspace(low, low + width, 200)])
    assert swept[:, axis] == pytest.approx(POINT[0, axis], abs=1e-15)
    plane = [k for k in range(3) if k != axis]
    if width < 1e-6:
        assert swept == pytest.approx(np.tile(arc[0], (len(swept), 1)), abs=1e-9)
        return
    flat = ConvexHull(swept[:, plane])
    assert (arc[:, plane] @ flat.equations[:, :2].T + flat.equations[:, 2]).max() <= 1e-14
    radius = np.linalg.norm(POINT[0, plane])
    assert np.linalg.norm(swept[:, plane], axis=1).max() <= radius / np.cos(np.pi / 6) + 1e-12  # 60 degrees at most


def test_what_does_not_move_adds_nothing() -> None:
    assert turned(POINT, 0, 0.3, 0.3) == pytest.approx(Rotation.from_euler("x", 0.3).apply(POINT))
    assert turned(np.array([[0.0, 0.0, 0.7]]), 2, 0.0, 1.0).tolist() == [[0.0, 0.0, 0.7]]
