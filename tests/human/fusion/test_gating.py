"""What the gates make of points that cameras show elsewhere, and of bones that are too long or too short."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.human.fusion.fuse import fuse, start
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.model import skeleton
from hrcreplay.records import LENGTHS, LIMBS, POINTS, Floats, HumanStates, Measurements
from hrcreplay.settings.sections import Fusion
from tests.human.filtered import WIDE, fused, standing, ticks
from tests.human.fusion import one_camera
from tests.human.fusion.test_model_residual import POINTS_OF
from tests.human.sightings import NEUTRAL, frames_of


def again(m: Measurements, points: Floats) -> Measurements:
    """The same frames with other points."""
    frames = frames_of(points, m.camera, m.capture_ns, 20_000_000)
    return measure(frames, np.tile(np.eye(4), (2, 1, 1)), Fusion(point_std_m=0.01))


def apart_m(states: HumanStates, truth: Floats) -> Floats:
    """(n, 6) how far each limb of the model is from the truth (20, 3), its farthest point [m]."""
    off = np.linalg.norm(skeleton(states.p, states.lengths_m) - truth, axis=2)
    return np.column_stack([off[:, [POINTS.index(name) for name in POINTS_OF[limb]]].max(axis=1) for limb in LIMBS])


@pytest.mark.parametrize("by_m", [(1.0, 0.0, 0.0), (0.0, 0.0, -0.45), (0.3, 0.2, 0.3)])
def test_until_they_are_believed_the_volumes_hold_what_cameras_agree_on(by_m: tuple[float, float, float]) -> None:
    """Everybody jumps at 2 s: from the second camera's first frame on, both places are in the volumes."""
    moved = NEUTRAL.copy()
    moved[[0, 1, 12]] += by_m
    m = Measurements.join([standing(2.0), standing(3.0, moved, start_s=2.0)])
    t = ticks(3.0)
    states = fused(m, t, Fusion())
    agreed_ns = m.arrival_ns[np.flatnonzero((m.capture_ns >= 2_000_000_000) & (m.camera == 1))[0]]
    after = (t >= agreed_ns) & (t < 2_400_000_000)
    apart = apart_m(states.rows(after), skeleton(moved[None], states.lengths_m[-1:])[0])
    assert (apart <= states.residual_m[after][:, : len(LIMBS)] + 5e-3).all()
    assert apart[0].max() > 0.4  # and the filter was not there yet
    assert (apart[t[after] >= 2_160_000_000] < 0.02).all()


def test_an_arm_that_one_camera_loses_is_where_the_other_sees_it() -> None:
    m = standing(3.0)
    points = m.points_m.copy()
    wrong = (m.camera == 1) & (m.capture_ns > 1_000_000_000)
    points[wrong, POINTS.index("wrist_l")] += [0.3, 0.0, 0.2]
    states = fused(again(m, points), ticks(3.0), Fusion(bone_m=1e6))
    np.testing.assert_allclose(states.p[-1], NEUTRAL, atol=5e-3)
    assert (states.residual_m[-1, : len(LIMBS)] < 0.02).all()


@pytest.mark.parametrize("cameras", [(0,), (0, 1)])
def test_left_and_right_exchanged_are_never_believed(cameras: tuple[int, ...]) -> None:
    m = standing(3.0, cameras=cameras)
    points = m.points_m.copy()
    wrong = (m.capture_ns > 1_600_000_000) & (m.capture_ns < 2_000_000_000)
    for name in ("shoulder", "elbow", "wrist"):
        left, right = (POINTS.index(f"{name}_{side}") for side in "lr")
        points[wrong, left], points[wrong, right] = m.points_m[wrong, right], m.points_m[wrong, left]
    t = ticks(3.0)
    states = fused(again(m, points), t, Fusion())
    live = t > 1_500_000_000
    assert np.abs(states.p[live] - NEUTRAL).max() < 0.05
    assert (states.residual_m[live][:, : len(LIMBS)] < 0.02).all()


def test_a_single_frame_is_no_evidence() -> None:
    m = standing(3.0)
    points = m.points_m.copy()
    points[20::7] += [0.6, 0.0, 0.0]
    states = fused(again(m, points), ticks(3.0), Fusion())
    np.testing.assert_allclose(states.p[-1], NEUTRAL, atol=5e-3)
    assert (states.residual_m[-1, : len(LIMBS)] < 0.02).all()


@pytest.mark.parametrize(("point", "limb"), [("pelvis", "THX"), ("head", "HD"), ("wrist_r", "LRA")])
@pytest.mark.parametrize("cameras", [(0,), (0, 1)])
def test_a_marker_that_leaves_its_bone_behind_is_no_evidence_of_one_camera(
    point: str, limb: str, cameras: tuple[int, ...]
) -> None:
    """For 0.4 s a marker hangs far above the person: of one camera alone the residual knows nothing of it."""
    m = standing(3.0, cameras=cameras)
    points = m.points_m.copy()
    t_s = m.capture_ns * 1e-9
    points[(t_s > 1.6) & (t_s < 2.0), POINTS.index(point)] += [0.1, 0.0, 1.3]
    t = ticks(3.0)
    states = fused(again(m, points), t, Fusion())
    meanwhile = (t > 1_700_000_000) & (t < 1_950_000_000)
    told = states.residual_m[meanwhile, LIMBS.index(limb)]
    assert (told > 0.9).all() if len(cameras) == 2 else (told < 0.05).all()
    assert not (states.residual_m[:, len(LIMBS)] > 0.2).any()  # the trunk's widens the legs
    assert (
        np.abs(states.p[(t > 1_500_000_000) & (states.unseen_s[:, : len(LIMBS)] <= 0.1).all(axis=1)] - NEUTRAL).max()
        < 0.05
    )


def test_somebody_of_another_size_elsewhere_is_evidence_even_of_one_camera() -> None:
    """All bones are a third longer from 1.6 s on, 0.8 m to the side: no marker that was torn off."""
    m = standing(2.1, cameras=(0,))
    points, t_s = m.points_m.copy(), m.capture_ns * 1e-9
    pelvis = points[:, [POINTS.index("pelvis")]]
    points[t_s > 1.6] = (pelvis + 1.33 * (points - pelvis) + [0.8, 0.0, 0.0])[t_s > 1.6]
    t = ticks(2.1)
    states = fused(again(m, points), t, Fusion())
    meanwhile = (t > 1_720_000_000) & (t < 2_000_000_000)
    assert (states.residual_m[meanwhile, LIMBS.index("THX")] > 0.75).all()


def test_a_marker_that_jumps_off_the_bone_is_no_measurement() -> None:
    frames = one_camera.frames_of(np.tile(one_camera.POSE, (400, 1)))
    elbow, wrist = (frames.points_m[:, POINTS.index(f"{name}_l")] for name in ("elbow", "wrist"))
    points = frames.points_m.copy()
    points[100:300, POINTS.index("wrist_l")] = wrist[100:300] + 0.7 * (wrist - elbow)[100:300]  # within 0.2 m
    t = one_camera.ticks(7.9)
    _, states, counts, _ = fuse(
        start(("one",)), t, one_camera.measured(replace(frames, points_m=points)), Fusion(), WIDE
    )
    assert counts["outlier_points_one"] == 200
    forearm = LENGTHS.index("pi_forearm_l")
    assert states.lengths_m[-1, forearm] == pytest.approx(0.26, abs=2e-3)
    assert states.unseen_s[round(5.9 * one_camera.RATE_HZ), 5] > 3.8
    assert states.unseen_s[-1, 5] < 0.03


def test_a_length_that_was_learnt_wrong_is_learnt_anew() -> None:
    short = one_camera.LENGTHS_M.copy()
    short[LENGTHS.index("pi_forearm_l")] = 0.08
    frames, wrong = (
        one_camera.frames_of(np.tile(one_camera.POSE, (700, 1))),
        one_camera.frames_of(np.tile(one_camera.POSE, (700, 1)), lengths_m=short),
    )
    points = np.concatenate([wrong.points_m[:100], frames.points_m[100:]])
    _, states, _, _ = fuse(
        start(("one",)), one_camera.ticks(13.9), one_camera.measured(replace(frames, points_m=points)), Fusion(), WIDE
    )
    forearm = states.lengths_m[:, LENGTHS.index("pi_forearm_l")]
    assert forearm[round(6.5 * one_camera.RATE_HZ)] == pytest.approx(0.08, abs=0.02)
    assert forearm[-1] == pytest.approx(0.26, abs=0.02)
