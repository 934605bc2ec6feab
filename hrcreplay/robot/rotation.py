"""Rotations as matrices, quaternions and rotation vectors."""

from __future__ import annotations

import math

import numpy as np

from hrcreplay.records import Floats


def from_rpy(rpy: Floats) -> Floats:
    """(3, 3) of roll, pitch, yaw about fixed axes, as URDF has them: Rz(yaw) Ry(pitch) Rx(roll) [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def from_quaternion(wxyz: Floats) -> Floats:
    """(3, 3) of a quaternion of any length, scalar first."""
    w, x, y, z = wxyz / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def from_vector(vector: Floats) -> Floats:
    """(3, 3) that turns about the vector by its length [rad]."""
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0 else vector
    return from_quaternion(np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis)]))


def to_vector(R: Floats) -> Floats:
    """(3,) rotation vector of (3, 3), its length in [0, pi] [rad]; exact near both ends."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    # four times the unit quaternion (w, x, y, z) times one of its elements: the row of the largest has no cancellation
    w, x, y, z = max(
        (
            (1 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
            (zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx),
            (xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy),
            (yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz),
        ),
        key=lambda row: sum(v * v for v in row),
    )
    sine = math.copysign(math.sqrt(x * x + y * y + z * z), w)
    return np.array([x, y, z]) * (2 * math.atan2(abs(sine), abs(w)) / sine if sine else 0.0)
