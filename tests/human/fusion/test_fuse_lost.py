"""People who jump, are lost or were never seen, and points that are not theirs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hrcreplay.human.fusion.fuse import fuse, start
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.records import DOF, POINTS, Measurements
from hrcreplay.settings.sections import Fusion
from tests.human.filtered import WIDE, fused, standing, ticks, until
from tests.human.sightings import CAMERAS, NEUTRAL, frames_of, random_measurements


def test_an_outlier_is_kept_out_and_counted() -> None:
    m = standing(2.0)
    points = m.points_m.copy()
    wrist, k = POINTS.index("wrist_l"), int(np.flatnonzero(m.camera == 0)[30])
    points[k, wrist] += [0.5, 0.0, 0.3]
    frames = frames_of(points, m.camera, m.capture_ns, 20_000_000)
    bad = measure(frames, np.tile(np.eye(4), (2, 1, 1)), Fusion(point_std_m=0.01))
    t = ticks(2.0)
    _, states, counts, _ = fuse(start(CAMERAS), t, until(bad, int(t[-1])), Fusion(), WIDE)
    assert counts["outlier_points_left"] == 1
    assert counts["outlier_points_right"] == 0
    after = states.t_ns >= m.arrival_ns[k]
    np.testing.assert_allclose(states.p[after], np.tile(NEUTRAL, (after.sum(), 1)), atol=5e-3)
    assert states.valid[np.flatnonzero(after)[0], 0]  # the rows that do not rest on the wrist were used


def test_swapped_sides_are_outliers() -> None:
    m = standing(2.0)
    points = m.points_m.copy()
    k = int(np.flatnonzero(m.camera == 1)[30])
    for name in ("shoulder", "elbow", "wrist"):
        pair = [POINTS.index(f"{name}_{side}") for side in "lr"]
        points[k, pair] = points[k, pair[::-1]]
    frames = frames_of(points, m.camera, m.capture_ns, 20_000_000)
    bad = measure(frames, np.tile(np.eye(4), (2, 1, 1)), Fusion(point_std_m=0.01))
    states = fused(bad, ticks(2.0), Fusion())
    np.testing.assert_allclose(states.p[-200:], np.tile(NEUTRAL, (200, 1)), atol=5e-3)


def test_a_person_who_jumped_is_believed_after_a_while_and_not_before() -> None:
    moved = NEUTRAL.copy()
    moved[:2] += 1.5
    m = Measurements.join([standing(1.0), standing(3.0, moved, start_s=1.0)])
    t = ticks(3.0)
    _, states, counts, _ = fuse(start(CAMERAS), t, until(m, int(t[-1])), Fusion(relearn_s=0.1), WIDE)
    seconds = t * 1e-9
    before = (seconds > 1.0) & (seconds < 1.1)
    np.testing.assert_allclose(states.p[before][:, :2], np.tile(NEUTRAL[:2], (before.sum(), 1)), atol=0.05)
    assert np.abs(states.p[seconds >= 1.17] - moved).max() <= 5e-3
    assert counts["joints_reacquired"] == DOF


def test_a_person_lost_for_long_comes_to_rest_and_stays_finite() -> None:
    m = random_measurements(100, seed=5, missing=0.0, noise=0.2)
    t = ticks(1.5 + 600.0, rate_hz=50.0)
    states = fused(m, t, Fusion())
    live = states.t_ns >= m.arrival_ns[0]
    for name in ("p", "v", "a", "j", "p_std", "v_std", "lengths_m"):
        assert np.isfinite(getattr(states, name)[live]).all()
    np.testing.assert_allclose(states.v[-1], 0.0, atol=1e-6)
    np.testing.assert_allclose(states.p[-1], states.p[200], atol=1e-6)
    assert (states.p_std[-1] > 2.0 * states.p_std[80]).all()
    assert not states.valid[-1].any()


def test_joints_nobody_has_seen_stand_at_a_neutral_posture_with_a_large_std() -> None:
    m = standing(1.0)
    z, stds = m.z.copy(), m.z_std.copy()
    z[:, 4:8], stds[:, 4:8] = np.nan, np.nan
    states = fused(replace(m, z=z, z_std=stds), ticks(1.0), Fusion())
    live = states.t_ns >= m.arrival_ns[0]
    assert np.isfinite(states.p[live]).all()
    assert (states.p_std[live][:, 4:8] > 0.5).all()
    assert (states.p_std[-1, 8:] < 0.1).all()
