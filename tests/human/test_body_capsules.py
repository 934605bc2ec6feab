"""The recorded body as capsules, and between samples."""

from __future__ import annotations

import numpy as np

from hrcreplay.evaluation.recorded_person import at_instants
from hrcreplay.human.model import PARTS, part_axes, part_radii, skeleton
from hrcreplay.records import JOINTS, POINTS
from hrcreplay.settings.sections import Prediction

LENGTHS_M = np.array([[0.52, 0.22, 0.19, 0.30, 0.30, 0.27, 0.26]])


def test_the_hand_prolongs_the_forearm() -> None:
    p = np.zeros((1, len(JOINTS)))
    p[:, 12] = 0.95
    p[:, 4:12] = (0.4, 0.3, 0.2, 1.9) * 2
    points = skeleton(p, LENGTHS_M)
    axes = part_axes(points, 0.19)[0]
    for part, side, length in (("LRA", "r", 0.26), ("LLA", "l", 0.27)):
        elbow, wrist = (points[0, POINTS.index(f"{name}_{side}")] for name in ("elbow", "wrist"))
        start, end = axes[PARTS.index(part)]
        np.testing.assert_array_equal(start, elbow)
        np.testing.assert_allclose(end, elbow + (wrist - elbow) * (length + 0.19) / length)
    np.testing.assert_allclose(np.linalg.norm(axes[PARTS.index("THX"), 1] - axes[PARTS.index("THX"), 0]), 0.52)
    assert np.isnan(axes[PARTS.index("THIGH_R") :]).any(axis=(1, 2)).all()  # the model has no legs, hands or feet
    assert np.isfinite(axes[: PARTS.index("THIGH_R")]).all()


def test_radii_are_those_of_table_2() -> None:
    found = dict(zip(PARTS, part_radii(Prediction(), 0.08), strict=True))
    assert found == {
        "HD": 0.12,
        "THX": 0.15,
        "URA": 0.07,
        "LRA": 0.07,
        "ULA": 0.07,
        "LLA": 0.07,
        **dict.fromkeys(("THIGH_R", "SHANK_R", "THIGH_L", "SHANK_L", "FOOT_R", "FOOT_L"), 0.08),
        **dict.fromkeys(("HAND_R", "HAND_L"), 0.07),
    }


def test_between_samples() -> None:
    t_ns = np.array([0, 10, 20, 200, 210], dtype=np.int64) * 10**6
    points = np.arange(5.0)[:, None, None] * np.ones((5, len(POINTS), 3))
    points[1, 3] = np.nan
    at_ns = np.array([-1, 0, 5, 10, 15, 20, 21, 110, 200, 204, 210, 211], dtype=np.int64) * 10**6
    found = at_instants(t_ns, points, at_ns, 0.1)
    nan = np.nan
    np.testing.assert_allclose(found[:, 0, 0], [nan, 0, 0.5, 1, 1.5, 2, nan, nan, 3, 3.4, 4, nan])
    np.testing.assert_allclose(found[:, 3, 0], [nan, 0, nan, nan, nan, 2, nan, nan, 3, 3.4, 4, nan])
    assert np.isnan(at_instants(t_ns[:0], points[:0], at_ns, 0.1)).all()
    held = at_instants(t_ns, points, at_ns, 0.1, hold_s=0.006)  # 6 ms around a sample, where nothing is between two
    np.testing.assert_allclose(held[:, 0, 0], [0, 0, 0.5, 1, 1.5, 2, 2, nan, 3, 3.4, 4, 4])
    np.testing.assert_allclose(held[:, 3, 0], [0, 0, 0, nan, 2, 2, 2, nan, 3, 3.4, 4, 4])
