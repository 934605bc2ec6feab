"""Distances by coal alone, pair by pair."""

from __future__ import annotations

import numpy as np

from hrcreplay.records import Floats
from hrcreplay.robot.control.separation import Obstacles, axis_distance
from hrcreplay.robot.model import RobotPose


def by_coal(pose: RobotPose, seen: Obstacles) -> Floats:
    """(s, l) from the axis of every link to the hull of every limb [m]."""
    hulls = [seen.vertices_m[first:last] for first, last in zip(seen.offsets, seen.offsets[1:], strict=False)]
    return np.array([[axis_distance(a, b, hull, [0]) for hull in hulls] for a, b in pose.ends_m])
