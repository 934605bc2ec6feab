"""A robot at an angle, a pick and place for it, and a turn to and fro."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import Reference, parse_task

HOME: dict[str, Any] = {"name": "home", "joints_deg": [0, 0, 0, 0, 90, 0]}
ABOVE: dict[str, Any] = {"position_m": [0.45, 0.30, 0.25], "rpy_deg": [180, 0, 30]}
RACK: dict[str, Any] = {
    "name": "rack",
    "position_m": [0.45, 0.30, 0.10],
    "rpy_deg": [180, 0, -20],
    "move": "linear",
    "tcp_speed_m_per_s": 0.25,
    "dwell_s": 0.3,
}
BOX: dict[str, Any] = {"position_m": [0.40, -0.35, 0.15], "quaternion_wxyz": [0, 1, 0, 0], "dwell_s": 0.2}
TO_AND_FRO: dict[str, Any] = {
    "name": "to and fro",
    "repeat": True,
    "speed": 0.6,
    "acceleration": 0.5,
    "waypoints": [{"joints_deg": [40, 20, -10, 0, 60, 0]}, {"joints_deg": [-40, 30, -20, 0, 70, 0]}],
}


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 0.5).as_matrix()
    T[:3, 3] = 1.0, 0.5, 0.65
    return irb140(T, stop_s=0.377)


def plan(robot: RobotModel, *waypoints: dict[str, Any], **task: Any) -> Reference:
    return plan_programme(parse_task({"waypoints": list(waypoints), **task}), robot)


@pytest.fixture(scope="module")
def pick_and_place(robot: RobotModel) -> Reference:
    return plan(robot, HOME, ABOVE, RACK, {**ABOVE, "move": "linear"}, BOX, cycles=2, speed=1.0, acceleration=1.0)
