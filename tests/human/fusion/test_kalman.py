"""The standard deviations that are told, and the bones by which jumps are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.human.fusion.fuse import fuse, start
from hrcreplay.human.fusion.fuse import fuse as fuse_all
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.model import skeleton
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, LENGTHS, POINTS, CameraFrames, Floats, Ints, Measurements
from hrcreplay.settings.sections import Fusion

HUMAN = load_limits("human")
POSE = np.array([0.2, 0.1, 0.3, 0.1, 0.4, 0.6, 0.1, 1.7, 0.4, 0.6, 0.1, 1.7, 0.94])
LENGTHS_M = np.array([0.5, 0.2, 0.18, 0.3, 0.3, 0.26, 0.26])
RATE_HZ, FRAMES_HZ = 250, 50
FREE = Fusion(spread_least=1.0, spread_most=1.0)


def ticks(seconds: float) -> Ints:
    return np.arange(1, round(seconds * RATE_HZ) + 1) * (1_000_000_000 // RATE_HZ)


def frames_of(p: Floats, noise_m: float = 0.0, lengths_m: Floats = LENGTHS_M) -> CameraFrames:
    """One camera at the world's origin, p (n, 13) at FRAMES_HZ."""
    points = skeleton(p, np.tile(lengths_m, (len(p), 1)))
    points = points + np.random.default_rng(4).normal(0.0, 1.0, points.shape) * noise_m
    capture = np.arange(len(p)) * (1_000_000_000 // FRAMES_HZ)
    return CameraFrames(
        capture_ns=capture,
        arrival_ns=capture + 1,
        camera=np.zeros(len(p), np.int64),
        body=np.zeros(len(p), np.int64),
        points_m=points,
        confidence=np.isfinite(points[:, :, 0]).astype(np.float64),
        cameras=("one",),
    )


def measured(frames: CameraFrames, std_m: float = 0.02) -> Measurements:
    return measure(frames, np.eye(4)[None], Fusion(point_std_m=std_m))


def factors(m: Measurements, t: Ints, settings: Fusion | None = None) -> Floats:
    """(n, 13) what the variances of v that are told are, over those of P."""
    _, states, _, trace = fuse(start(("one",)), t, m, settings or Fusion(), HUMAN, traced=True)
    return np.asarray(states.v_std**2 / trace.cov[:, :, 1, 1])


def test_the_estimate_is_the_same_whatever_is_told_of_it() -> None:
    sway = POSE + 0.3 * np.sin(np.arange(150) / 8.0)[:, None] * (np.arange(DOF) >= 4)
    m = measured(frames_of(sway, 0.01))
    told, plain = (fuse_all(start(("one",)), ticks(2.9), m, s, HUMAN)[1] for s in (Fusion(), FREE))
    for name in ("p", "v", "a", "j", "lengths_m", "residual_m"):
        np.testing.assert_array_equal(getattr(told, name), getattr(plain, name))
    assert np.nanmax(np.abs(told.v_std / plain.v_std - 1.0)) > 0.3


def test_noise_as_it_was_said_to_be_leaves_the_deviations_about_as_they_are() -> None:
    m = measured(frames_of(np.tile(POSE, (500, 1)), 0.02))
    late = factors(m, ticks(9.9))[1500:]
    assert 0.5 < np.median(late) < 2.5  # the highest of the last second is above the mean


def test_a_person_at_rest_is_known_well_and_one_who_sets_off_is_not() -> None:
    p = np.tile(POSE, (400, 1))
    swing = np.clip(np.arange(400) / FRAMES_HZ - 6.0, 0.0, 0.4)
    p[:, 9] += 6.0 * swing  # at 6 rad/s from one frame to the next
    factor = factors(measured(frames_of(p)), ticks(7.9))
    at = round(6.0 * RATE_HZ)
    assert (factor[at - 10, 4:] < 0.05).all()
    assert factor[at - 10, 9] == pytest.approx(0.01)
    assert factor[at : at + RATE_HZ // 5, 9].max() > 10.0 * factor[at - 10, 9]
    held = factor[at + RATE_HZ // 5 :, 9]
    assert held[RATE_HZ // 4] > np.exp(-0.3) * held[0]


def test_what_coasts_is_as_uncertain_as_the_filter_says_at_least() -> None:
    frames = frames_of(np.tile(POSE, (300, 1)))
    points = frames.points_m.copy()
    points[200:, POINTS.index("wrist_r")] = np.nan
    factor = factors(measured(replace(frames, points_m=points)), ticks(5.9))
    before, after = round(3.9 * RATE_HZ), round(4.3 * RATE_HZ)
    assert (factor[before, [7, 11]] < 0.05).all()
    assert factor[after, 7] == pytest.approx(1.0)
    assert factor[after, 11] < 0.05


def test_a_marker_that_jumps_off_the_bone_is_no_measurement() -> None:
    frames = frames_of(np.tile(POSE, (400, 1)))
    elbow, wrist = (frames.points_m[:, POINTS.index(f"{name}_l")] for name in ("elbow", "wrist"))
    points = frames.points_m.copy()
    points[100:300, POINTS.index("wrist_l")] = wrist[100:300] + 0.7 * (wrist - elbow)[100:300]  # within 0.2 m
    t = ticks(7.9)
    _, states, counts, _ = fuse_all(start(("one",)), t, measured(replace(frames, points_m=points)), Fusion(), HUMAN)
    assert counts["outlier_points_one"] == 200
    forearm = LENGTHS.index("pi_forearm_l")
    assert states.lengths_m[-1, forearm] == pytest.approx(0.26, abs=2e-3)
    assert states.unseen_s[round(5.9 * RATE_HZ), 5] > 3.8
    assert states.unseen_s[-1, 5] < 0.03


def test_a_length_that_was_learnt_wrong_is_learnt_anew() -> None:
    short = LENGTHS_M.copy()
    short[LENGTHS.index("pi_forearm_l")] = 0.08
    frames, wrong = frames_of(np.tile(POSE, (700, 1))), frames_of(np.tile(POSE, (700, 1)), lengths_m=short)
    points = np.concatenate([wrong.points_m[:100], frames.points_m[100:]])
    _, states, _, _ = fuse_all(
        start(("one",)), ticks(13.9), measured(replace(frames, points_m=points)), Fusion(), HUMAN
    )
    forearm = states.lengths_m[:, LENGTHS.index("pi_forearm_l")]
    assert forearm[round(6.5 * RATE_HZ)] == pytest.approx(0.08, abs=0.02)
    assert forearm[-1] == pytest.approx(0.26, abs=0.02)
