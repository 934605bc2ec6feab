"""Small products that kernels need without an array in between."""

from __future__ import annotations

import math

from numba import njit

from hrcreplay.records import Floats


@njit(cache=True)
def dot(a: Floats, b: Floats) -> float:
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
def norm(v: Floats) -> float:
    """Euclidean length."""
    return math.sqrt(dot(v, v))
