"""What of the recording is believed."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.audit import metrics as audit_metrics
from hrcreplay.audit import recorded_motion
from hrcreplay.commands import audit
from hrcreplay.evaluation import recorded_person, recording
from hrcreplay.evaluation.recorded_person import SmoothedPeople
from hrcreplay.limits import load_limits
from hrcreplay.logs.writer import LogWriter
from hrcreplay.pipeline.fusion_stage import FusionStage
from hrcreplay.records import BODY, DOF, JOINTS, LIMBS, POINTS, Bools, Floats, Ints, Measurements
from hrcreplay.settings.sections import Fusion
from tests.audit.standing import frames, standing
from tests.human.people import states


def _seen(points: Floats) -> Measurements:
    seen = frames(points)
    return Measurements(
        capture_ns=seen.capture_ns,
        arrival_ns=seen.arrival_ns,
        camera=seen.camera,
        z=np.zeros((len(points), 20)),
        z_std=np.zeros((len(points), 20)),
        points_m=points,
        confidence=seen.confidence,
        cameras=("cam",),
    )


def _eyes() -> FusionStage:
    return FusionStage(
        T_world_camera=np.eye(4)[None],
        clock_offset_ns=np.zeros(1, np.int64),
        filter=Fusion(),
        limits=load_limits("human"),
        person_jump_m=0.8,
        person_memory_s=2.0,
        people="nearest",
    )


def test_a_teleport_is_thrown_out_and_a_squat_is_not() -> None:
    points = standing(4)
    wrist, pelvis = POINTS.index("wrist_l"), POINTS.index("pelvis")
    points[1, wrist] += [0.6, 0.0, 0.3]  # the marker jumps
    points[2, :, 2] -= 0.4  # the whole person goes down, which the model cannot
    points[3, pelvis] += [0.0, 1.0, 0.0]
    best = states(np.zeros((4, DOF)), np.zeros((4, DOF)))
    p = np.zeros((4, DOF))
    p[:, [4, 8]], p[:, [7, 11]] = 0.2, 2.5
    best = replace(best, p=p, t_ns=frames(points).capture_ns)
    believed, counts = recording._select_accepted(_seen(points), SmoothedPeople.of(best), _eyes())
    gone: Bools = np.asarray(np.isfinite(points).all(axis=2) & np.isnan(believed).any(axis=2))
    assert [POINTS[k] for k in np.flatnonzero(gone[1])] == ["wrist_l"]
    assert [POINTS[k] for k in np.flatnonzero(gone[3])] == ["pelvis"]
    assert not gone[[0, 2]].any()
    rejected = {name: count for name, count in counts.items() if "rejected" in name}
    assert rejected == {"audit_rejected_points_cam": 2, "audit_rejected_frames_cam": 2}


def test_a_teleport_is_counted_and_no_escape(tmp_path: Path) -> None:
    """The marker of a wrist is elsewhere in three frames of a still person's sixty."""
    points = standing(60)
    points[30:33, POINTS.index("wrist_l")] += [0.6, 0.0, 0.3]
    with LogWriter(tmp_path / "jump.mcap") as writer:
        writer.camera("cam", np.eye(4))
        writer.frames(frames(points))
    folder = audit.run([tmp_path / "jump.mcap"], out=tmp_path / "run")
    (log,) = json.loads((folder / "audit.json").read_text())["logs"]
    counts = log["cameras"]["cam"]
    # the last frame arrives after the last tick
    assert (counts["frames"], counts["rejected_frames"], counts["rejected_points"]) == (59, 3, 3)
    assert counts["outlier_points"] >= 3
    assert log["escapes"]["sound"] == []
    table = (folder / "report.html").read_text().split("jump: thrown out")[1].split("</table>")[0]
    cells = re.findall(r">\s*([^<\s]+)\s*</t[dh]>", table.split("<tbody>")[-1])
    # the model has neither hands nor legs, nor the camera: 11 points of 59 frames
    assert cells[:6] == ["cam", "59", "649", "0", "3", "3"]


def test_what_has_no_confidence_was_not_seen_and_does_not_jump() -> None:
    """Points of confidence 0 or less than trusted, far off and near, and what hangs from them."""
    points = standing(6)
    seen = _seen(points)
    confidence = seen.confidence.copy()
    hand, wrist = POINTS.index("hand_l"), POINTS.index("wrist_l")
    points[:, hand] = points[:, wrist] + [0.0, 0.0, -0.15]
    confidence[:, hand] = 1.0
    confidence[0, hand] = 0.0  # guessed right
    points[1, hand], confidence[1, hand] = [9.0, 9.0, 9.0], 0.0  # guessed wrong
    confidence[2, hand] = 0.1
    confidence[3, wrist] = 0.0  # what it hangs from was not seen
    points[4, hand] += [0.0, 0.0, -1.0]  # this one jumps
    points[5, [wrist, hand]] += [0.6, 0.0, 0.3]  # and these do together
    best = states(np.zeros((6, DOF)), np.zeros((6, DOF)))
    p = np.zeros((6, DOF))
    p[:, [4, 8]], p[:, [7, 11]] = 0.2, 2.5
    best = replace(best, p=p, t_ns=seen.capture_ns)
    believed, counts = recording._select_accepted(
        replace(_seen(points), confidence=confidence), SmoothedPeople.of(best), _eyes()
    )
    assert np.isnan(believed[:, hand]).all()
    assert np.isfinite(believed[[0, 1, 2, 4], wrist]).all()
    missing = int(np.isnan(points).any(axis=2).sum())
    assert counts == Counter(
        audit_unseen_points_cam=missing + 3,
        audit_doubted_points_cam=2,
        audit_rejected_points_cam=3,
        audit_rejected_frames_cam=2,
    )


def test_shoulders_that_were_not_seen_hold_no_pelvis() -> None:
    """A squatting person's pelvis is believed by its bone to the middle of the shoulders: where these were seen."""
    points = standing(2)
    points[:, :, 2] -= 0.4
    confidence = _seen(points).confidence.copy()
    confidence[1, [POINTS.index("shoulder_l"), POINTS.index("shoulder_r")]] = 0.0
    best = states(np.zeros((2, DOF)), np.zeros((2, DOF)))
    p = np.zeros((2, DOF))
    p[:, [4, 8]], p[:, [7, 11]] = 0.2, 2.5
    best = replace(best, p=p, t_ns=frames(points).capture_ns)
    believed, _ = recording._select_accepted(
        replace(_seen(points), confidence=confidence), SmoothedPeople.of(best), _eyes()
    )
    assert np.isfinite(believed[:, POINTS.index("pelvis"), 0]).tolist() == [True, False]


def test_a_limb_first_moves_when_one_of_its_ends_is_ten_centimetres_away() -> None:
    points = standing(60)
    points[30:, POINTS.index("wrist_r")] += [0.0, 0.0, 0.09]  # not far enough
    points[40:, POINTS.index("wrist_r")] += [0.0, 0.0, 0.02]
    points[:45, POINTS.index("head")] = np.nan
    for beyond, end in (("hand_l", "wrist_l"), ("ankle_l", "pelvis"), ("hip_l", "pelvis")):
        points[:, POINTS.index(beyond)] = points[:, POINTS.index(end)]
    points[55:, POINTS.index("hand_l")] += [0.5, 0.0, 0.0]  # no end of a limb
    points[57, POINTS.index("ankle_l")] += [0.5, 0.0, 0.0]  # nor this
    points[58, POINTS.index("hip_l")] += [0.2, 0.0, 0.0]
    t_ns = 1_000_000_000 + 33_000_000 * np.arange(60)
    best = states(np.zeros((4, DOF)), np.zeros((4, DOF)))
    recorded = recording.Recording(best, t_ns, points, best.t_ns, best.p, recorded_person.CAMERAS, {})
    found = recorded_motion.first_movements_ns(recorded)
    assert {limb: at for limb, at in found.items() if at is not None} == {"LRA": t_ns[40], "LEGS": t_ns[58]}


def test_errors_are_told_in_their_standard_deviations() -> None:
    """Joints that swing, recorded at 100 Hz, and a filter that is off by a known share of what it says."""
    rng = np.random.default_rng(5)
    t_ns = 10_000_000 * np.arange(2001)
    phase, rate = rng.uniform(0.0, 6.0, DOF), rng.uniform(0.5, 3.0, DOF)

    def swing(at_ns: Ints) -> tuple[Floats, Floats]:
        angle = rate * (at_ns * 1e-9)[:, None] + phase
        return 0.3 * np.sin(angle), 0.3 * rate * np.cos(angle)

    at_ns = 4_000_000 * np.arange(20, 4980)
    p, v = swing(at_ns)
    off = rng.normal(size=(2, *p.shape))
    fused = replace(states(p + 0.02 * off[0], v + 0.5 * off[1]), t_ns=at_ns)
    n = len(at_ns)
    unseen = np.zeros((n, len(BODY)))
    unseen[100:200, LIMBS.index("LRA")] = 0.5
    fused = replace(fused, p_std=np.full((n, DOF), 0.02), v_std=np.full((n, DOF), 0.25), unseen_s=unseen)
    gap = (t_ns > 5_000_000_000) & (t_ns < 5_200_000_000)
    joints = swing(t_ns)[0]
    recorded = recording.Recording(fused, t_ns[~gap], standing(1), t_ns[~gap], joints[~gap], recorded_person.TRUTH, {})
    errors = recorded_motion.errors_in_deviations(recorded, np.arange(n))
    inside_gap = (at_ns > 5_030_000_000) & (at_ns < 5_170_000_000)
    assert np.isnan(errors[:, inside_gap]).all()
    lower = [JOINTS.index("ar3"), JOINTS.index("ar4")]
    assert np.isnan(errors[:, 100:200, lower]).all()
    assert np.isfinite(errors[:, 100:200, :6]).all()
    np.testing.assert_allclose(errors[0, :900, :4], off[0, :900, :4], atol=0.01)
    np.testing.assert_allclose(errors[1, :900, :4], 2.0 * off[1, :900, :4], atol=0.01)
    figures = audit_metrics.deviation_figures(errors)
    for joint in JOINTS:
        position, velocity = figures[joint]["position"], figures[joint]["velocity"]
        assert position["rms"] == pytest.approx(1.0, abs=0.05)
        np.testing.assert_allclose(position["within"], [0.683, 0.954, 0.997], atol=0.025)
        assert velocity["rms"] == pytest.approx(2.0, abs=0.1)
        np.testing.assert_allclose(velocity["within"], [0.383, 0.683, 0.866], atol=0.03)
        assert position["ticks"] <= n - inside_gap.sum()
    nobody = audit_metrics.deviation_figures(np.full((2, 3, DOF), np.nan))
    assert nobody["x"]["position"] == {"rms": None, "within": [None, None, None], "ticks": 0}
