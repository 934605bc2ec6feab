"""Scales the reported variances by the filter's normalised innovations and their autocorrelation.

P of Eq. (49) depends only on the sigmas, which must suit the fastest motion and the worst camera. Multiplying R and G
by one factor multiplies P and leaves every gain, and so the estimate, unchanged: the variance of unit weight in
adjustment theory. Each joint has its own factor: the maximum normalised innovation squared (innovation squared over its
variance), which decays exponentially. At rest it is small; when a joint starts to move, the first innovation raises it
at once, and it stays high beyond the end of the motion.

The innovations of a filter whose model is right are white (Mehra, IEEE Trans. Automatic Control 15(2), 1970). Where the
filter lags, a camera is calibrated wrongly or its noise is coloured, successive innovations by the same camera are
correlated, and the error of the estimate is larger than their size indicates: white noise is averaged out, coloured
noise is not. So the variances also grow exponentially with the autocorrelation at lag 1. The growth rate is fitted on
recordings (docs/deviations.md).
"""

from __future__ import annotations

import numpy as np

from hrcreplay.human.fusion.kalman import Rules, StateEstimate
from hrcreplay.kernels import njit
from hrcreplay.records import DOF, Floats

#: Maximum square before the first innovation; the reported variances are then about those of the filter.
FIRST_SPREAD = 4.0
#: Age at which an innovation has weight 1/e in the autocorrelation [s].
_MEMORY_S = 2.0
#: Row of FITTED for each of JOINTS; both arms share their rows.
KIND = np.array([0, 0, 1, 2, 3, 4, 5, 6, 3, 4, 5, 6, 7])
#: For the variances of p and of v: logarithm of the factor without autocorrelation, and its slope over the
#: autocorrelation. Fitted by ``python -m tests.tools.deviations``.
FITTED = np.array(
    [
        [[-1.65, 2.03], [-1.64, 2.67]],  # x, y
        [[-1.90, 2.19], [-2.51, 3.36]],  # theta
        [[-1.61, 1.06], [-1.56, 1.94]],  # rho
        [[-1.69, 2.36], [-2.30, 3.40]],  # alpha_1
        [[-1.56, 2.17], [-2.01, 3.41]],  # alpha_2
        [[-1.53, 2.53], [-2.06, 3.10]],  # alpha_3
        [[-1.70, 2.18], [-1.90, 2.75]],  # alpha_4
        [[-1.15, 0.80], [-1.22, 1.56]],  # z
    ]
)


@njit(cache=True, inner=True)
def reset(estimate: StateEstimate, j: int) -> None:
    """Resets joint j after its acquisition, without an innovation."""
    estimate.innovation[:, j], estimate.squares[j], estimate.products[j] = 0.0, 0.0, 0.0
    estimate.spread[j] = FIRST_SPREAD


@njit(cache=True, inner=True)
def add_innovation(estimate: StateEstimate, c: int, j: int, innovation: float, now: int, memory_s: float) -> None:
    """Adds a normalised innovation of joint j; ``row_ns`` is still the tick of the previous one.

    Args:
        estimate: Sums, last innovation and spread of the joint are changed.
        c: Index of the camera.
        j: Index into JOINTS.
        innovation: Innovation over its standard deviation.
        now: The tick [ns].
        memory_s: Memory of the spread [s].
    """
    age_s = (now - estimate.row_ns[j]) * 1e-9
    kept = np.exp(-age_s / _MEMORY_S)
    estimate.squares[j] = kept * estimate.squares[j] + innovation**2
    estimate.products[j] = kept * estimate.products[j] + innovation * estimate.innovation[c, j]
    estimate.innovation[c, j] = innovation
    estimate.spread[j] = max(np.exp(-age_s / memory_s) * estimate.spread[j], innovation**2)


@njit(cache=True, inner=True)
def autocorrelation(squares: float, products: float) -> float:
    """Autocorrelation of a joint's innovations by the same camera, at lag 1, in [-1, 1]; 0 without innovations.

    Args:
        squares: Running sum of the squares of the innovations.
        products: Running sum of their products with the one before.
    """
    if not 0.0 < squares < np.inf:
        return 0.0
    return float(max(-1.0, min(products / squares, 1.0)))


@njit(inner=True, inline="always")  # passing the filter on would take longer than this
def write_deviations(estimate: StateEstimate, rules: Rules, deviations: Floats) -> None:
    """Writes the reported standard deviations of p and v of each joint, (2, 13) [m or rad, and these per s].

    The factor on a variance is at least 1 while the joint coasts, as there are then no innovations.

    Args:
        estimate: After the tick.
        rules: Bounds on the factor.
        deviations: Receives them.
    """
    for j in range(DOF):
        least = 1.0 if estimate.tick_ns[0] - estimate.row_ns[j] > rules.coast_ns else rules.spread_least
        correlated = autocorrelation(estimate.squares[j], estimate.products[j])
        for a in range(2):
            scale = estimate.spread[j] * np.exp(FITTED[KIND[j], a, 0] + FITTED[KIND[j], a, 1] * correlated)
            factor = max(least, min(scale, rules.spread_most))
            deviations[a, j] = np.sqrt(factor * estimate.cov[j, a, a])
