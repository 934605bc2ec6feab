"""Products of small vectors without temporary arrays, for kernels; the rotation vector of a matrix, for every tick."""

from __future__ import annotations

import math

import numpy as np

from hrcreplay.kernels import njit
from hrcreplay.records import Floats

Vector = tuple[float, float, float]


@njit(cache=True, inner=True)
def edge(points: Floats, i: int, j: int) -> Vector:
    """Vector from point i to point j of (n, 3)."""
    return points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]


@njit(cache=True, inner=True)
def cross(u: Vector, v: Vector) -> Vector:
    """Vector product."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit(cache=True, inner=True)
def dot(u: Vector, v: Vector) -> float:
    """Scalar product."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(cache=True, inner=True)
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


@njit(cache=True, inner=True)
def dot3(a: Floats, b: Floats) -> float:
    """Scalar product of 3-vectors in the same order, unrolled: loops over vertices spend most of their time here."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def norm_n(v: Floats) -> float:
    """Euclidean length."""
    return math.sqrt(dot_n(v, v))


@njit(cache=True, inner=True)
def distance(a: Floats, b: Floats) -> float:
    """Distance between two points (3,) [m]."""
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


def speed_of(twist: Floats) -> float:
    """Length of the first three elements of a twist (6,) as ``norm_n`` gives it, without the call of a kernel."""
    x, y, z, *_ = twist.tolist()
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True)
def to_vector(R: Floats) -> Floats:
    """(3,) rotation vector of (3, 3), its length in [0, pi] [rad]; exact near both ends.

    scipy's ``Rotation`` does the same but is many times slower; this runs in every tick of the controller.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2]
    # four times the unit quaternion (w, x, y, z) times one of its elements; the row of the largest is free of
    # cancellation
    rows = (
        (1.0 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1.0 + xx - yy - zz, xy + yx, xz + zx),
        (xz - zx, xy + yx, 1.0 - xx + yy - zz, yz + zy),
        (yx - xy, xz + zx, yz + zy, 1.0 - xx - yy + zz),
    )
    w, x, y, z = rows[0]
    most = w * w + x * x + y * y + z * z
    for row in rows[1:]:
        size = row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3]
        if size > most:
            most, (w, x, y, z) = size, row
    sine = math.copysign(math.sqrt(x * x + y * y + z * z), w)
    turn = 2.0 * math.atan2(abs(sine), abs(w)) / sine if sine != 0.0 else 0.0
    return np.array([x * turn, y * turn, z * turn])


@njit(cache=True)
def turn_between(T_from: Floats, T_to: Floats) -> Floats:
    """(3,) rotation vector that turns the axes of one pose (4, 4) into those of another, world frame [rad]."""
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = T_to[i, 0] * T_from[j, 0] + T_to[i, 1] * T_from[j, 1] + T_to[i, 2] * T_from[j, 2]
    return to_vector(R)
