"""The demo log is what its recipe makes, and what its README says it is."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from datasets import make_demo
from datasets.recipe import cameras, scene, worker
from datasets.recipe.sensors import Sensor
from hrcreplay.human.fusion.inverse_kinematics import inverse
from hrcreplay.human.model import HEIGHT, nearest, skeleton
from hrcreplay.records import POINTS, CameraFrames, Floats
from hrcreplay.robot.model import irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import parse_task

SHIPPED = Path(__file__).parents[1] / "datasets" / "demo.mcap"
AT = {name: index for index, name in enumerate(POINTS)}
HAND_M = 0.19  #: a hand reaches this far beyond its wrist


@pytest.fixture(scope="module")
def truth() -> tuple[Floats, Floats]:
    return worker.simulate(make_demo.SEED)


@pytest.fixture(scope="module")
def frames(truth: tuple[Floats, Floats]) -> CameraFrames:
    return cameras.record(*truth, 0, make_demo.SEED)


def of(frames: CameraFrames, camera: int, truth: tuple[Floats, Floats]) -> tuple[CameraFrames, Floats, Floats]:
    """The worker's frames of one camera, in the world, and the truth at their captures."""
    rows = frames.rows((frames.camera == camera) & (frames.body != 2))
    T = cameras.SENSORS[camera].T_world_camera
    t_s = rows.capture_ns * 1e-9
    return rows, rows.points_m @ T[:3, :3].T + T[:3, 3], cameras.between(np.asarray(t_s, dtype=np.float64), *truth)


def test_the_shipped_log_is_what_the_recipe_makes(tmp_path: Path) -> None:
    made = tmp_path / "made.mcap"
    make_demo.make(made)
    assert hashlib.sha256(made.read_bytes()).hexdigest() == hashlib.sha256(SHIPPED.read_bytes()).hexdigest()
    assert made.stat().st_size < 5_000_000


def test_the_log_of_the_tests_is_the_same_session_beside_a_robot_further_away_with_a_task_of_its_own(
    tmp_path: Path,
) -> None:
    made = tmp_path / "far.mcap"
    make_demo.make(made, scene.T_WORLD_BASE_FAR, scene.TASK_FAR)
    far = Path(__file__).parent / "data" / "demo_far.mcap"
    assert hashlib.sha256(made.read_bytes()).hexdigest() == hashlib.sha256(far.read_bytes()).hexdigest()


def test_span_and_late_start(truth: tuple[Floats, Floats], frames: CameraFrames) -> None:
    t_s, points_m = truth
    assert t_s[0] == 0.0
    assert t_s[-1] == 60.0
    assert np.isfinite(points_m).all()
    first_s = [float(frames.capture_ns[frames.camera == c].min()) * 1e-9 for c in (0, 1)]
    last_s = [float(frames.capture_ns[frames.camera == c].max()) * 1e-9 for c in (0, 1)]
    assert 4.5 < first_s[0] < 6.5  # the kinect comes late
    assert first_s[1] < 0.5
    assert max(last_s) > 59.5  # somebody sees the worker leave


def test_the_worker_is_as_far_from_the_model_as_real_people(truth: tuple[Floats, Floats]) -> None:
    true_m = truth[1][::4]
    angles, lengths_m = inverse(true_m)
    angles[:, HEIGHT] = np.median(angles[:, HEIGHT])
    constant_m = np.tile(np.median(lengths_m, axis=0), (len(angles), 1))
    off_m = np.linalg.norm(skeleton(angles, constant_m) - true_m, axis=2)
    names = ("head", "shoulder_l", "shoulder_r", "elbow_l", "elbow_r")
    pooled = off_m[:, [AT[name] for name in names]]
    assert 0.040 <= np.median(pooled) <= 0.050
    assert 0.085 <= np.percentile(pooled, 95) <= 0.100
    for name in names:
        assert 0.035 <= np.median(off_m[:, AT[name]]) <= 0.055, name


def test_bones_keep_their_length_and_standing_feet_their_place(truth: tuple[Floats, Floats]) -> None:
    t_s, points_m = truth
    for upper, lower, length_m in (
        ("shoulder", "elbow", worker.UPPER_ARM_M),
        ("elbow", "wrist", worker.FOREARM_M),
        ("wrist", "hand", worker.HAND_M),
        ("hip", "knee", worker.THIGH_M),
        ("knee", "ankle", worker.SHANK_M),
    ):
        for side in "lr":
            bone = points_m[:, AT[f"{upper}_{side}"]] - points_m[:, AT[f"{lower}_{side}"]]
            np.testing.assert_allclose(np.linalg.norm(bone, axis=1), length_m, atol=1e-9)
    ankles = points_m[:, [AT["ankle_l"], AT["ankle_r"]]]
    assert ankles[..., 2].min() > 0.07
    assert ankles[..., 2].max() < 0.25
    slowest = np.linalg.norm(np.gradient(ankles, t_s, axis=0), axis=2).min(axis=1)
    assert np.percentile(slowest, 95) < 0.1  # one foot stands while the other steps


def test_reaches_are_as_fast_as_real_ones(truth: tuple[Floats, Floats]) -> None:
    t_s, points_m = truth
    speed = np.linalg.norm(np.gradient(points_m, t_s, axis=0), axis=2)
    reaching = (t_s > 8.0) & (t_s < 50.0)
    for hand in ("hand_l", "hand_r"):
        assert 1.0 < speed[reaching, AT[hand]].max() < 2.0
    assert 0.7 < speed[:, AT["pelvis"]].max() < 1.4
    acceleration = np.gradient(np.gradient(points_m[:, AT["hand_r"]], t_s, axis=0), t_s, axis=0)
    assert np.linalg.norm(acceleration, axis=1).max() < 25.0
    rate = np.abs(np.gradient(np.unwrap(inverse(points_m)[0], axis=0), t_s, axis=0))
    for elbow in (7, 11):
        assert rate[:, elbow].max() > 2.0 * 0.3 * np.pi  # Table 1 allows 0.3 pi rad/s


def test_clocks_and_confidences(frames: CameraFrames) -> None:
    assert np.all(np.diff(frames.arrival_ns) >= 0)
    late_s = (frames.arrival_ns - frames.capture_ns) * 1e-9
    assert 0.025 < late_s.min() < late_s.max() < 0.090
    for camera in (0, 1):
        assert np.all(np.diff(frames.capture_ns[(frames.camera == camera) & (frames.body != 2)]) > 0)
    assert set(np.unique(frames.confidence)) == {0.0, 0.5, 1.0}
    np.testing.assert_array_equal(np.isnan(frames.points_m).any(axis=2), frames.confidence == 0.0)
    assert sorted(np.unique(frames.body)) == [1, 2, 4]


@pytest.mark.parametrize("sensor", cameras.SENSORS, ids=lambda sensor: sensor.name)
def test_sensors_are_as_noisy_as_real_ones(sensor: Sensor, truth: tuple[Floats, Floats], frames: CameraFrames) -> None:
    rows, seen_m, true_m = of(frames, cameras.SENSORS.index(sensor), truth)
    true, raw = inverse(true_m)[0], inverse(seen_m)[0]
    off = (nearest(raw, true) - true)[:, 4:]
    assert 0.10 < np.sqrt(np.nanmean(off**2)) < 0.25
    error_m = np.linalg.norm(seen_m - true_m, axis=2)
    depth_m = rows.points_m[:, AT["pelvis"], 2]
    near, far = (np.nanmedian(error_m[which][:, AT["shoulder_r"]]) for which in (depth_m < 2.5, depth_m > 3.0))
    assert far > 1.3 * near
    sure_and_wrong = (error_m > 0.25) & (rows.confidence == 1.0)
    assert 10 < np.any(sure_and_wrong, axis=1).sum() < 0.1 * len(rows)
    hidden = rows.confidence[:, AT["elbow_l"] : AT["hand_r"] + 1] == 0.5
    assert 0.02 < hidden.mean() < 0.25


def test_a_robot_that_knows_of_nobody_hits_the_worker_often_and_at_speed(truth: tuple[Floats, Floats]) -> None:
    model = irb140(scene.T_WORLD_BASE, stop_s=0.377)
    reference = plan_programme(parse_task(scene.TASK), model)
    points = [reference.sample(s) for s in np.arange(0.0, reference.cycle_s, 0.08)]
    ends_m = np.array([model.pose(point.q, np.zeros(6)).ends_m for point in points])
    speed = np.array([np.linalg.norm(point.twist[:3]) for point in points])
    radii_m = [segment.radius_m for segment in model.segments]
    t_s, points_m = truth[0][::50], truth[1][::50]
    gap_m = np.full((len(t_s), len(ends_m)), np.inf)
    for start_m, end_m, radius_m in body(points_m):
        for link, link_radius_m in enumerate(radii_m):
            apart_m = apart(start_m, end_m, ends_m[:, link, 0], ends_m[:, link, 1])
            gap_m = np.minimum(gap_m, apart_m - radius_m - link_radius_m)
    at = (t_s % reference.cycle_s / 0.08).astype(int) % len(ends_m)
    nominal = gap_m[np.arange(len(t_s)), at]
    middle = (t_s > 8.0) & (t_s < 50.0)
    touched = middle & (nominal <= 0.0)
    assert 0.08 < np.mean(nominal[middle] <= 0.0) < 0.2
    assert len(np.flatnonzero(np.diff(touched.astype(int)) == 1)) >= 4, "not one long touch"
    assert speed[at[touched]].max() > 0.8
    assert np.mean(nominal[middle] <= 0.5) > 0.6
    low = np.array([model.pose(point.q, np.zeros(6)).T_world_tcp[2, 3] for point in points]) < scene.PEDESTAL_M + 0.3
    assert low.sum() > 10  # in the rack and in the box
    assert gap_m[:, low].min() > 0.1, "nobody reaches what the robot takes and where it puts it"
    assert (gap_m[middle] <= 0.0).mean(axis=0).max() > 0.4, "but the worker's hands are often on the way between"


def body(points_m: Floats) -> list[tuple[Floats, Floats, float]]:
    """Limbs as (n, 3) start, (n, 3) end with the hand, and radius of Table 2."""
    limbs = []
    for start, end, radius_m in (("neck", "head", 0.12), ("pelvis", "neck", 0.15)):
        limbs.append((points_m[:, AT[start]], points_m[:, AT[end]], radius_m))
    for side in "lr":
        shoulder, elbow, wrist = (points_m[:, AT[f"{name}_{side}"]] for name in ("shoulder", "elbow", "wrist"))
        limbs.append((shoulder, elbow, 0.07))
        limbs.append((elbow, wrist + HAND_M / worker.FOREARM_M * (wrist - elbow), 0.07))
    return limbs


def apart(a_m: Floats, b_m: Floats, c_m: Floats, d_m: Floats) -> Floats:
    """(n, k) distances of n segments a-b to k segments c-d, a-b in 15 samples."""
    along = (d_m - c_m)[None]
    best = np.full((len(a_m), len(c_m)), np.inf)
    for share in np.linspace(0.0, 1.0, 15):
        point = (a_m + share * (b_m - a_m))[:, None]
        foot = np.clip(np.sum((point - c_m) * along, axis=2) / np.sum(along**2, axis=2), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(point - c_m - foot[..., None] * along, axis=2))
    return best
