"""The floor under a walker, found whatever the sensor's axes are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.calibration.cell import find_floor, floor_frame, up_direction
from hrcreplay.calibration.registration import rigid, transform
from hrcreplay.records import POINTS, Floats, SkeletonTrack
from tests.reobserve import angle_deg, walker

OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x right, y down, z ahead
KINECT2 = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # x left, y up, z ahead


def _seen(T_world_sensor: Floats, seed: int = 0) -> SkeletonTrack:
    person = walker()
    noise = np.random.default_rng(seed).normal(0, 0.01, person.points_m.shape)
    T_sensor_world = np.asarray(np.linalg.inv(T_world_sensor))
    return SkeletonTrack(person.t_ns, transform(T_sensor_world, person.points_m + noise), person.confidence)


@pytest.mark.parametrize("axes", [OPTICAL, KINECT2, np.eye(3)], ids=["y down", "y up", "z up"])
def test_floor_of_a_walker(axes: Floats) -> None:
    tilt = Rotation.from_euler("xyz", [7.0, 12.0, 30.0], degrees=True).as_matrix()
    T = rigid(tilt @ axes, np.array([-3.0, 0.4, 1.7]))
    floor = find_floor(_seen(T))
    assert floor is not None
    true_up = T[:3, :3].T @ [0, 0, 1]
    assert np.degrees(np.arccos(floor.up @ true_up)) < 0.6
    assert floor.height_m == pytest.approx(1.7, abs=0.03)
    assert np.degrees(floor.tilt_std_rad) < 3.0


def test_given_up_is_kept() -> None:
    T = rigid(OPTICAL, np.array([-3.0, 0.0, 1.5]))
    floor = find_floor(_seen(T), up=np.array([0.0, -2.0, 0.0]))
    assert floor is not None
    np.testing.assert_allclose(floor.up, [0, -1, 0], atol=1e-9)
    assert floor.height_m == pytest.approx(1.5, abs=0.01)


def test_sitting_person_gives_up_by_the_trunk() -> None:
    person = walker()
    points = person.points_m.copy()
    for name in ("knee_l", "knee_r", "ankle_l", "ankle_r", "foot_l", "foot_r"):
        points[:, POINTS.index(name)] = np.nan
    points[::2, POINTS.index("neck")] = np.nan  # the middle of the shoulders stands in
    up = up_direction(SkeletonTrack(person.t_ns, points, person.confidence))
    assert up is not None
    np.testing.assert_allclose(up[0], [0, 0, 1], atol=1e-9)
    assert np.degrees(up[1]) == pytest.approx(8.0)


def test_bending_person_keeps_the_balance() -> None:
    person = walker()
    points = person.points_m.copy()
    lean = Rotation.from_euler("y", 35.0, degrees=True).as_matrix()
    pelvis = points[:, :1]
    points[:, :12] = (points[:, :12] - pelvis) @ lean.T + pelvis - [0.12, 0, 0]
    points[:, [12, 16]] -= [0.12, 0, 0]
    up = up_direction(SkeletonTrack(person.t_ns, points, person.confidence))
    assert up is not None
    assert np.degrees(np.arccos(up[0][2])) < 5.0  # the trunk leans by 35


def test_no_feet_no_floor() -> None:
    person = walker()
    confidence = person.confidence.copy()
    confidence[:, [POINTS.index(name) for name in ("ankle_l", "ankle_r", "foot_l", "foot_r")]] = 0.5
    assert find_floor(SkeletonTrack(person.t_ns, person.points_m, confidence)) is None


@pytest.mark.parametrize("axes", [OPTICAL, KINECT2], ids=["y down", "y up"])
def test_floor_frame_looks_along_x(axes: Floats) -> None:
    T = rigid(Rotation.from_euler("y", 20.0, degrees=True).as_matrix() @ axes, np.array([0.0, 0.0, 1.7]))
    floor = find_floor(_seen(T))
    assert floor is not None
    T_world_sensor = floor_frame(floor)
    assert angle_deg(T_world_sensor[:3, :3] @ T[:3, :3].T) < 0.6
    np.testing.assert_allclose(T_world_sensor[:3, 3], [0, 0, 1.7], atol=0.03)


def test_floor_frame_of_a_motion_capture_room_keeps_its_axes() -> None:
    floor = find_floor(_seen(np.eye(4)), up=np.array([0.0, 0.0, 1.0]))
    assert floor is not None
    np.testing.assert_allclose(floor_frame(floor)[:3, :3], np.eye(3), atol=1e-9)
