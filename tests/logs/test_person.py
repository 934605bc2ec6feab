"""The person among ghosts and changing ids, table by table or all at once."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from hrcreplay.calibration.registration import rigid
from hrcreplay.logs.cleaning import PersonMemory, select_person
from hrcreplay.records import CameraFrames, Floats

UNKNOWN = np.full((2, 4, 4), np.nan)


def _bodies(*rows: tuple[float, int, int, float], cameras: tuple[str, ...] = ("a", "b")) -> CameraFrames:
    """Rows of (time [s], camera, body id, x of all points [m])."""
    t_ns = np.array([round(row[0] * 1e9) for row in rows], dtype=np.int64)
    points = np.full((len(rows), 20, 3), 1.0)
    points[:, :, 0] = np.array([row[3] for row in rows])[:, None]
    return CameraFrames(
        capture_ns=t_ns,
        arrival_ns=t_ns + 5_000_000,
        camera=np.array([row[1] for row in rows], dtype=np.int64),
        body=np.array([row[2] for row in rows], dtype=np.int64),
        points_m=points,
        confidence=np.ones((len(rows), 20)),
        cameras=cameras,
    )


def _pick(frames: CameraFrames, T: Floats = UNKNOWN, memory: PersonMemory | None = None) -> tuple[Floats, Counter[str]]:
    _, mine, counts = select_person(frames, memory or PersonMemory(), T, 0.8, 2.0)
    return frames.points_m[mine, 0, 0], counts


def test_follows_the_place_not_the_id() -> None:
    xs, counts = _pick(_bodies((0, 0, 1, 0.0), (0, 0, 2, 5.0), (1, 0, 1, 5.1), (1, 0, 2, 0.1), (2, 0, 7, 0.2)))
    np.testing.assert_array_equal(xs, [0.0, 0.1, 0.2])
    assert counts == {"person_bodies_dropped": 2, "person_frames_beside_others": 2, "person_id_switches": 2}


def test_first_person_is_nearest_to_the_camera() -> None:
    xs, _ = _pick(_bodies((0, 0, 1, 4.0), (0, 0, 2, 2.0)))
    np.testing.assert_array_equal(xs, [2.0])
    T = np.stack([rigid(np.eye(3), np.array([10.0, 0.0, 0.0]))] * 2)
    xs, _ = _pick(_bodies((0, 0, 1, -9.0), (0, 0, 2, -2.0)), T)
    np.testing.assert_array_equal(xs, [-2.0])


def test_somebody_far_away_is_somebody_else_until_the_memory_fades() -> None:
    frames = _bodies((0, 0, 1, 0.0), (1, 0, 2, 3.0), (1.9, 0, 2, 3.0), (2.2, 0, 2, 3.0))
    xs, counts = _pick(frames)
    np.testing.assert_array_equal(xs, [0.0, 3.0])
    expected = {"person_bodies_dropped": 2, "person_frames_without": 2, "person_id_switches": 1}
    assert counts == expected | {"person_frames_beside_others": 2}


def test_cameras_with_poses_share_one_memory() -> None:
    T = np.stack([np.eye(4), rigid(np.eye(3), np.array([-3.0, 0.0, 0.0]))])
    frames = _bodies((0, 0, 1, 0.0), (0.1, 1, 1, 0.0), (0.1, 1, 2, 3.1))
    xs, _ = _pick(frames, T)
    np.testing.assert_array_equal(xs, [0.0, 3.1])
    xs, _ = _pick(frames)
    np.testing.assert_array_equal(xs, [0.0, 0.0])


def test_a_camera_without_pose_keeps_its_own_memory() -> None:
    T = np.stack([np.eye(4), np.full((4, 4), np.nan)])
    xs, _ = _pick(_bodies((0, 0, 1, 0.0), (0.1, 1, 1, 9.0), (0.2, 0, 1, 0.1), (0.3, 1, 1, 9.1)), T)
    np.testing.assert_array_equal(xs, [0.0, 9.0, 0.1, 9.1])


def test_bodies_without_points_are_nobody() -> None:
    frames = _bodies((0, 0, 1, np.nan), (0.1, 0, 1, 0.0), (0.2, 0, 1, np.nan))
    xs, counts = _pick(frames)
    np.testing.assert_array_equal(xs, [0.0])
    assert counts["person_frames_without"] == 2
    assert "person_frames_beside_others" not in counts


def test_place_needs_no_torso() -> None:
    frames = _bodies((0, 0, 1, 0.0), (0.1, 0, 1, 0.1), (0.1, 0, 2, 0.9))
    confidence = np.zeros((3, 20))
    confidence[:, 6] = 1.0
    frames = CameraFrames(
        frames.capture_ns, frames.arrival_ns, frames.camera, frames.body, frames.points_m, confidence, frames.cameras
    )
    xs, _ = _pick(frames)
    np.testing.assert_array_equal(xs, [0.0, 0.1])


def test_no_rows() -> None:
    memory, mine, counts = select_person(_bodies((0, 0, 1, 0.0)).rows(slice(0, 0)), PersonMemory(), UNKNOWN, 0.8, 2.0)
    assert memory == PersonMemory()
    assert len(mine) == 0
    assert counts == {}


@pytest.mark.parametrize("seed", range(5))
def test_one_frame_and_many_give_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(120):
        camera = int(rng.integers(2))
        rows += [(k * 0.15, camera, int(rng.integers(4)), float(rng.normal(0, 1.5))) for _ in range(rng.integers(1, 4))]
    frames = _bodies(*rows)
    T = np.stack([np.eye(4), np.full((4, 4), np.nan)])
    memory, mine, counts = select_person(frames, PersonMemory(), T, 0.8, 2.0)
    whole = frames.rows(mine)
    starts = np.flatnonzero(np.diff(frames.capture_ns, prepend=-1))
    pieces, total, carried = [], Counter[str](), PersonMemory()
    for first, last in zip(starts, [*starts[1:], len(frames)], strict=True):
        piece = frames.rows(slice(int(first), int(last)))
        carried, mine, some = select_person(piece, carried, T, 0.8, 2.0)
        pieces.append(piece.rows(mine))
        total.update(some)
    parts = CameraFrames.join(pieces)
    assert carried == memory
    assert total == counts
    for name in ("capture_ns", "camera", "body", "points_m"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
