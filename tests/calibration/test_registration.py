"""Registration against scipy's alignment and known poses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.calibration import registration
from hrcreplay.calibration.registration import Registration, disagreement, kabsch, register, rigid, transform
from hrcreplay.records import MIRROR, POINTS, SkeletonTrack
from tests.realdata import data_path
from tests.reobserve import POSE, Truth, angle_deg, read_azure, reobserve, walker


def test_mirror_exchanges_left_and_right() -> None:
    names = [POINTS[i] for i in MIRROR]
    assert names[POINTS.index("elbow_l")] == "elbow_r"
    assert names[POINTS.index("foot_r")] == "foot_l"
    assert names[:4] == list(POINTS[:4])


def test_kabsch_is_the_alignment_of_scipy() -> None:
    rng = np.random.default_rng(1)
    source, target, weight = rng.normal(size=(30, 3)), rng.normal(size=(30, 3)), rng.random(30)
    T = kabsch(source, target, weight)
    middle_s, middle_t = (np.average(points, axis=0, weights=weight) for points in (source, target))
    best, _ = Rotation.align_vectors(target - middle_t, source - middle_s, weights=weight)
    np.testing.assert_allclose(T[:3, :3], best.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], middle_t - best.as_matrix() @ middle_s, atol=1e-12)


def test_kabsch_never_mirrors() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(20, 3))
    T = kabsch(source, source * [1, 1, -1], np.ones(20))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize(("seed", "offset_s"), [(1, 0.0), (2, 0.137), (3, -0.8), (4, 1.7)])
def test_register_recovers_pose_and_offset(seed: int, offset_s: float) -> None:
    a = walker()
    b = reobserve(a, Truth(POSE, offset_s), seed)
    found = register(a, b)
    assert found is not None
    off = np.linalg.inv(POSE) @ found.T_a_b
    assert angle_deg(off[:3, :3]) < 0.3
    assert np.linalg.norm(found.T_a_b[:3, 3] - POSE[:3, 3]) < 0.010
    assert found.offset_s == pytest.approx(offset_s, abs=0.003)


def test_register_is_exact_without_noise() -> None:
    a = walker()
    b = SkeletonTrack(a.t_ns, (a.points_m - POSE[:3, 3]) @ POSE[:3, :3], a.confidence)
    found = register(a, b)
    assert found is not None
    np.testing.assert_allclose(found.T_a_b, POSE, atol=1e-9)
    assert abs(found.offset_s) < 1e-9


def test_register_is_its_own_inverse() -> None:
    a = walker()
    b = reobserve(a, Truth(POSE, 0.05), 5)
    there, back = register(a, b), register(b, a)
    assert there is not None
    assert back is not None
    np.testing.assert_allclose(there.T_a_b @ back.T_a_b, np.eye(4), atol=4e-3)
    assert there.offset_s == pytest.approx(-back.offset_s, abs=2e-3)


def test_register_works_at_half_the_rate() -> None:
    a = walker()
    b = reobserve(a, Truth(POSE, 0.05), 6).rows(slice(None, None, 2))
    found = register(a, b)
    assert found is not None
    assert angle_deg((np.linalg.inv(POSE) @ found.T_a_b)[:3, :3]) < 0.5
    assert found.offset_s == pytest.approx(0.05, abs=0.005)


def test_register_of_nothing_in_common_is_none() -> None:
    a = walker(5.0)
    blind = SkeletonTrack(a.t_ns, a.points_m, np.zeros_like(a.confidence))
    later = SkeletonTrack(a.t_ns + 60_000_000_000, a.points_m, a.confidence)
    assert register(a, blind) is None
    assert register(a, later) is None
    assert register(a, a.rows(slice(0, 2))) is None


def test_clocks_are_left_alone_where_nobody_moves() -> None:
    rng = np.random.default_rng(8)
    person = walker(10.0)
    still = np.broadcast_to(person.points_m[0], person.points_m.shape)
    a, b = (SkeletonTrack(person.t_ns, still + rng.normal(0, 0.01, still.shape), person.confidence) for _ in range(2))
    found = register(a, b)
    assert found is not None
    assert found.offset_s == 0.0
    np.testing.assert_allclose(found.T_a_b, np.eye(4), atol=5e-3)


def test_register_takes_missing_points() -> None:
    a = walker(8.0)
    points = a.points_m.copy()
    points[:, 12:] = np.nan
    b = SkeletonTrack(a.t_ns, (points - POSE[:3, 3]) @ POSE[:3, :3], a.confidence)
    found = register(a, b)
    assert found is not None
    np.testing.assert_allclose(found.T_a_b, POSE, atol=1e-9)


def test_disagreement_is_that_of_the_interpolated_points() -> None:
    a = walker(4.0)
    t_ns = a.t_ns[:-1] + 10_000_000
    rng = np.random.default_rng(7)
    b = SkeletonTrack(t_ns, walker(4.0).points_m[:-1] + rng.normal(0, 0.02, (len(t_ns), 20, 3)), a.confidence[:-1])
    found = Registration(rigid(np.eye(3), np.array([0.01, 0.0, 0.0])), 0.005)
    rest = disagreement(a, b, found)
    assert rest is not None
    apart = []
    for i, t in enumerate(a.t_ns):
        for k in range(20):
            at = [np.interp(t + 5_000_000, b.t_ns, b.points_m[:, k, d]) for d in range(3)]
            if b.t_ns[0] <= t + 5_000_000 <= b.t_ns[-1]:
                apart.append(np.linalg.norm(a.points_m[i, k] - at - [0.01, 0, 0]))
    assert rest.points == len(apart)
    assert rest.median_m == pytest.approx(np.median(apart), rel=1e-6)
    assert rest.p95_m == pytest.approx(np.percentile(apart, 95), rel=1e-6)
    assert rest.mirrored == 0.0


def test_disagreement_counts_mirrored_frames() -> None:
    a = walker(4.0)
    points = a.points_m.copy()
    points[30:60] = points[30:60][:, list(MIRROR)]
    rest = disagreement(a, SkeletonTrack(a.t_ns, points, a.confidence), Registration(np.eye(4), 0.0))
    assert rest is not None
    assert rest.mirrored == pytest.approx(30 / 120)


@pytest.mark.parametrize("name", ["pymocapviewer/azure_positions", "sevivi_azure_single/walking_positions_3d"])
def test_register_on_real_movement(name: str) -> None:
    a = read_azure(data_path(f"{name}.csv.gz"))
    b = reobserve(a, Truth(POSE, 0.137), 1)
    found = register(a, b)
    assert found is not None
    assert angle_deg((np.linalg.inv(POSE) @ found.T_a_b)[:3, :3]) < 0.5
    assert np.linalg.norm(found.T_a_b[:3, 3] - POSE[:3, 3]) < 0.015
    assert found.offset_s == pytest.approx(0.137, abs=0.005)
    rest = disagreement(a, b, found)
    assert rest is not None
    assert 0.017 < rest.median_m < 0.036  # as real pairs disagree
    np.testing.assert_allclose(transform(np.eye(4), b.points_m), b.points_m)


def test_a_marker_that_jumps_counts_nowhere_in_a_track(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frame by frame beside the same in batches that end within the track."""
    rng, n = np.random.default_rng(4), 200
    points = np.cumsum(rng.normal(scale=0.002, size=(n, len(POINTS), 3)), axis=0)
    far, gone = rng.random((n, len(POINTS))) < 0.05, rng.random((n, len(POINTS))) < 0.1
    points[far] += 0.4
    points[gone] = np.nan
    track = SkeletonTrack(np.arange(n) * 33_000_000, points, np.where(rng.random(gone.shape) < 0.05, 0.0, 0.9))
    monkeypatch.setattr(registration, "_BATCH", 7)
    found = registration._without_jumps(track)
    removed = 0
    for i in range(n):
        near = [min(max(i + k, 0), n - 1) for k in range(-2, 3)]
        for k in range(len(POINTS)):
            seen = [j for j in near if np.isfinite(points[j, k, 0]) and track.confidence[j, k] > 0.0]
            own = points[i, k] if i in seen else np.zeros(3)
            middle = np.median([points[j, k] if j in seen else own for j in near], axis=0)
            counts = i in seen and np.linalg.norm(own - middle) <= 0.15
            removed += i in seen and not counts
            assert found.confidence[i, k] == (track.confidence[i, k] if counts else 0.0)
            np.testing.assert_array_equal(found.points_m[i, k], own)
    assert removed > 20
