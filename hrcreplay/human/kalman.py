"""The Kalman filter of one joint: four states p, v, a, j, Eq. (42)-(57)."""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.records import Floats


@njit(cache=True)
def predict(mean: Floats, P: Floats, dt: float, damping: float, sigma: Floats, rest_std: Floats) -> None:
    """Eq. (48), (49) over dt seconds, mean (4,) and P (4, 4) in place.

    With a damping below 1 the derivatives also forget: towards rest, give or take ``rest_std`` (3,).
    """
    F, FP = np.zeros((4, 4)), np.empty((4, 4))
    transition(dt, damping, F)
    mean[:] = _times(F, mean)
    for b in range(4):
        FP[:, b] = _times(F, P[:, b])
    for a in range(4):
        P[a] = _times(F, FP[a])
    noise = process_variance(dt, damping, sigma, rest_std)
    for a in range(4):
        P[a, a] += noise[a]


@njit(cache=True)
def correct(mean: Floats, P: Floats, h: Floats, z: float, R: float) -> None:
    """The Kalman update of one joint by one scalar row."""
    Ph = np.empty(4)
    for a in range(4):
        Ph[a] = dot(P[a], h)
    S = dot(h, Ph) + R
    innovation = z - dot(h, mean)
    for a in range(4):
        mean[a] += Ph[a] / S * innovation
        for b in range(4):
            P[a, b] -= Ph[a] * Ph[b] / S


@njit(cache=True)
def transition(dt: float, damping: float, F: Floats) -> None:
    """F of Eq. (43) for one joint, its derivatives damped."""
    powers = (1.0, dt, dt**2 / 2.0, dt**3 / 6.0)
    for a in range(4):
        for b in range(a, 4):
            F[a, b] = powers[b - a] * (damping if a > 0 else 1.0)


@njit(cache=True)
def process_variance(dt: float, damping: float, sigma: Floats, rest_std: Floats) -> Floats:
    """Diagonal (4,) of G of Eq. (44), corrected, for one joint; with a damping, also of what is forgotten."""
    variance = sigma**2 * np.array([dt**4 / 24.0, dt**3 / 6.0, dt**2 / 2.0, dt])
    variance[1:] += (1.0 - damping**2) * rest_std**2
    return variance


@njit(cache=True)
def ago(mean: Floats, d: float) -> Floats:
    """Where the joints (12,) were d seconds before, by the Taylor polynomial of Eq. (43)."""
    return mean[:, 0] - d * mean[:, 1] + d**2 / 2.0 * mean[:, 2] - d**3 / 6.0 * mean[:, 3]


@njit(cache=True)
def dot(a: Floats, b: Floats) -> float:
    """The scalar product of (4,) and (4,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@njit(cache=True)
def _times(F: Floats, x: Floats) -> Floats:
    """F @ x for the upper triangular F of Eq. (43)."""
    y = np.empty(4)
    for a in range(4):
        total = 0.0
        for b in range(a, 4):
            total += F[a, b] * x[b]
        y[a] = total
    return y
