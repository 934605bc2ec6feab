"""The cell: where robot and cameras stand, and what the robot does."""

from __future__ import annotations

from typing import Any

import numpy as np

from datasets.recipe.curves import unit
from hrcreplay.records import Floats

PEDESTAL_M = 0.65


def _base(x_m: float) -> Floats:
    """(4, 4) T_world_base of an IRB 140 on its pedestal, looking along the world's x."""
    return np.array([[1.0, 0.0, 0.0, x_m], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, PEDESTAL_M], [0.0, 0.0, 0.0, 1.0]])


#: So near that the robot would hit a worker it does not know of.
T_WORLD_BASE = _base(0.20)
#: Where the robot of the tests' log stands.
T_WORLD_BASE_FAR = _base(0.0)


def look_at(eye_m: tuple[float, float, float], target_m: tuple[float, float, float]) -> Floats:
    """(4, 4) T_world_camera of a level depth camera: x right, y down, z forward."""
    forward = unit(np.subtract(target_m, eye_m))
    right = unit(np.cross(forward, (0.0, 0.0, 1.0)))
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T[:3, 3] = eye_m
    return T


#: Behind the robot on either side, so that their optical axes are far from parallel.
T_WORLD_KINECT = look_at((-0.55, -1.35, 1.95), (1.70, -0.20, 0.95))
T_WORLD_XTION = look_at((-0.45, 1.35, 2.10), (1.80, 0.10, 1.00))

_DOWN = [180.0, 0.0, 0.0]


def _waypoint(name: str, place_m: tuple[float, float, float], **how: Any) -> dict[str, Any]:
    return {"name": name, "position_m": list(place_m), "rpy_deg": _DOWN} | how


def _visit(name: str, place_m: tuple[float, float, float], above_m: float) -> list[dict[str, Any]]:
    """Down to a place and up again."""
    x, y, z = place_m
    return [
        _waypoint(f"above the {name}", (x, y, above_m)),
        _waypoint(name, (x, y, z), move="linear", tcp_speed_m_per_s=0.35, dwell_s=0.3),
        _waypoint(f"off the {name}", (x, y, above_m), move="linear", tcp_speed_m_per_s=0.5),
    ]


_PICK_AND_PLACE: dict[str, Any] = {
    "name": "pick and place",
    "repeat": True,
    "speed": 0.6,
    "acceleration": 0.7,
    "tcp_speed_m_per_s": 0.9,
    "tcp_acceleration_m_per_s2": 3.0,
}
#: Metal pieces from a rack on the robot's right into a box on its left. The worker reaches neither of them, but the
#: programmed way from one to the other leads over the bench between them, where his hands are.
TASK = _PICK_AND_PLACE | {
    "waypoints": [*_visit("rack", (0.18, -0.70, 0.28), 0.42), *_visit("box", (0.18, 0.70, 0.28), 0.42)]
}
#: The task of the tests' log: the box is before the robot, and the worker reaches into it.
TASK_FAR = _PICK_AND_PLACE | {
    "waypoints": [*_visit("rack", (0.26, -0.46, 0.22), 0.36), *_visit("box", (0.45, 0.26, 0.26), 0.38)]
}
