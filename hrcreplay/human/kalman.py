"""The Kalman filter of one joint: four states p, v, a, j, Eq. (42)-(57)."""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.records import Floats


@njit(cache=True)
def predict(mean: Floats, P: Floats, dt: float, damping: float, sigma: Floats, rest_std: Floats) -> None:
    """Eq. (48), (49) over dt seconds, mean (4,) and P (4, 4) in place.

    F is upper triangular, so that each row is done before the rows it needs change. With a damping below 1 the
    derivatives also forget: towards rest, give or take ``rest_std`` (3,).
    """
    taylor = (1.0, dt, dt**2 / 2.0, dt**3 / 6.0)  # F of Eq. (43)
    for a in range(4):
        kept = damping if a > 0 else 1.0
        mean[a] = kept * _ahead(taylor, mean, a)
        for b in range(4):
            P[a, b] = kept * _ahead(taylor, P[:, b], a)
    for a in range(4):
        for b in range(a, 4):
            P[a, b] = (damping if b > 0 else 1.0) * _ahead(taylor, P[a], b)
            P[b, a] = P[a, b]
    for a in range(4):
        P[a, a] += process_variance(a, dt, damping, sigma, rest_std)


@njit(cache=True)
def _ahead(taylor: tuple[float, float, float, float], x: Floats, a: int) -> float:
    """Row a of F times x (4,)."""
    total = x[a]
    for k in range(a + 1, 4):
        total += taylor[k - a] * x[k]
    return total


@njit(cache=True)
def correct(mean: Floats, P: Floats, h: Floats, z: float, R: float) -> float:
    """The Kalman update of one joint by one scalar row; returns the innovation squared over its variance.

    A row whose innovation has no variance, or none that a number can hold, tells nothing: it changes nothing.
    """
    Ph = np.empty(4)
    for a in range(4):
        Ph[a] = dot(P[a], h)
    S = dot(h, Ph) + R
    innovation = z - dot(h, mean)
    if not (0.0 < S < np.inf and np.isfinite(innovation)):
        return 0.0
    for a in range(4):
        mean[a] += Ph[a] / S * innovation
        for b in range(4):
            P[a, b] -= Ph[a] * Ph[b] / S
    return innovation**2 / S


@njit(cache=True)
def process_variance(a: int, dt: float, damping: float, sigma: Floats, rest_std: Floats) -> float:
    """Entry a of the diagonal of G of Eq. (44), corrected; with a damping, also of what is forgotten."""
    remainder = (dt**4 / 24.0, dt**3 / 6.0, dt**2 / 2.0, dt)
    forgotten = (1.0 - damping**2) * rest_std[a - 1] ** 2 if a > 0 else 0.0
    return sigma[a] ** 2 * remainder[a] + forgotten


@njit(cache=True)
def ago(mean: Floats, d: float) -> Floats:
    """Where the joints (12,) were d seconds before, by the Taylor polynomial of Eq. (43)."""
    return mean[:, 0] - d * mean[:, 1] + d**2 / 2.0 * mean[:, 2] - d**3 / 6.0 * mean[:, 3]


@njit(cache=True)
def dot(a: Floats, b: Floats) -> float:
    """The scalar product of (4,) and (4,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
