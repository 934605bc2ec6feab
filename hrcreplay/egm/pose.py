"""Where the flange is: the pose that a controller tells beside the joints."""

from __future__ import annotations

import math

import numpy as np

from hrcreplay.records import Floats

#: The IRB 140, an axis a row: what lies before it [m], and the direction it turns about; both at zero, x forward, z up.
_BEFORE_M = ((0, 0, 0.352), (0.070, 0, 0), (0, 0, 0.360), (0.380, 0, 0), (0, 0, 0), (0.065, 0, 0))
_ABOUT = (2, 1, 1, 0, 1, 0)
#: The flange's z points out of it, along the last axis: a quarter turn about y.
_FLANGE = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)


def flange_pose(q: Floats) -> Floats:
    """Pose of the flange in the robot's base.

    Args:
        q: (6,) joints by the controller's zero and signs [rad].

    Returns:
        (7,) position [m], then quaternion w, x, y, z with w >= 0.
    """
    x = y = z = 0.0
    turn: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    for (dx, dy, dz), about, angle in zip(_BEFORE_M, _ABOUT, q.tolist(), strict=True):
        sx, sy, sz = _turned(turn, (dx, dy, dz))
        x, y, z = x + sx, y + sy, z + sz
        half = [math.cos(angle / 2), 0.0, 0.0, 0.0]
        half[1 + about] = math.sin(angle / 2)
        turn = _product(turn, tuple(half))
    turn = _product(turn, _FLANGE)
    sign = math.copysign(1.0, turn[0])
    return np.array([x, y, z, *(sign * part for part in turn)])


def _product(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
    """Of two quaternions."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _turned(turn: tuple[float, ...], vector: tuple[float, float, float]) -> tuple[float, ...]:
    """A vector, turned by a quaternion."""
    w, x, y, z = turn
    return _product(_product(turn, (0.0, *vector)), (w, -x, -y, -z))[1:]
