"""Products of small vectors without temporary arrays, for kernels; rotations as matrices, quaternions and vectors."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from hrcreplay.records import Floats

Vector = tuple[float, float, float]


@njit(cache=True)
def edge(points: Floats, i: int, j: int) -> Vector:
    """From point i to point j of (n, 3)."""
    return points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]


@njit(cache=True)
def cross(u: Vector, v: Vector) -> Vector:
    """Vector product."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit(cache=True)
def dot(u: Vector, v: Vector) -> float:
    """Scalar product."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(cache=True)
def norm(u: Vector) -> float:
    """Length."""
    return float(np.sqrt(dot(u, u)))


@njit(cache=True)
def dot_n(a: Floats, b: Floats) -> float:
    """Scalar product of vectors of any length."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@njit(cache=True)
def dot3(a: Floats, b: Floats) -> float:
    """Scalar product in space, in the same order, written out: it is what passes over vertices spend their time on."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def norm_n(v: Floats) -> float:
    """Euclidean length."""
    return math.sqrt(dot_n(v, v))


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
