"""Rotations as matrices, quaternions and rotation vectors."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

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


@njit(cache=True)
def to_vector(R: Floats) -> Floats:
    """(3,) rotation vector of (3, 3), its length in [0, pi] [rad]; exact near both ends."""
    squares = np.array([R[0, 0] + R[1, 1] + R[2, 2], R[0, 0], R[1, 1], R[2, 2]])
    largest = int(np.argmax(squares))
    if largest == 0:
        q = np.array([1 + squares[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = 1 + R[i, i] - R[j, j] - R[k, k]
        q[1 + j] = R[i, j] + R[j, i]
        q[1 + k] = R[i, k] + R[k, i]
    if q[0] < 0:
        q = -q
    sine = math.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    if sine == 0:
        return np.zeros(3)
    return 2 * math.atan2(sine, q[0]) / sine * q[1:]
