"""The pose that the double tells, against the golden points of the specification and the planner's own model."""

from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.egm.codec import ARM_JOINTS, flange_pose
from hrcreplay.robot.model import irb140

#: Axis 2 and 3 [deg], wrist centre x and z [mm].
GOLDEN = (
    (0, 0, 450, 712),
    (0, -90, 70, 1092),
    (0, 50, 314, 421),
    (110, -90, 765, 99),
    (-90, 50, 1, 596),
    (110, -230, 218, 558),
    (-90, -90, -670, 352),
)


def matrix(quaternion: np.ndarray) -> np.ndarray:
    w, v = quaternion[0], quaternion[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


@pytest.mark.parametrize(("second", "third", "x_mm", "z_mm"), GOLDEN)
def test_the_wrist_centre_meets_the_specification(second: float, third: float, x_mm: float, z_mm: float) -> None:
    pose = flange_pose(np.radians([0, second, third, 0, 0, 0]))
    centre = pose[:3] - 0.065 * matrix(pose[3:])[:, 2]
    assert centre * 1000 == pytest.approx([x_mm, 0, z_mm], abs=1.0)


def test_the_flange_is_where_the_planner_has_it() -> None:
    robot = irb140(np.eye(4), stop_s=0.377, tool_m=0.0)
    rng = np.random.default_rng(5)
    for q in rng.uniform(robot.q_min, robot.q_max, (50, ARM_JOINTS)):
        pose, expected = flange_pose(q), robot.pose(q, np.zeros(ARM_JOINTS)).T_world_tcp
        assert pose[:3] == pytest.approx(expected[:3, 3], abs=1e-9)
        assert matrix(pose[3:]) == pytest.approx(expected[:3, :3], abs=1e-9)
        assert pose[3] >= 0
