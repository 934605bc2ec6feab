"""Vectors of three numbers inside the kernels."""

from __future__ import annotations

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
