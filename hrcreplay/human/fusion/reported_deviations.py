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

from hrcreplay.human.fusion.kalman import Filter, Rules
from hrcreplay.kernels import njit

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
def reset(filter_: Filter, j: int) -> None:
    """Resets joint j after its acquisition, without an innovation."""
    filter_.estimate.innovation[:, j], filter_.estimate.squares[j], filter_.estimate.products[j] = 0.0, 0.0, 0.0
    filter_.estimate.spread[j] = FIRST_SPREAD


@njit(cache=True, inner=True)
def add_innovation(filter_: Filter, c: int, j: int, innovation: float, now: int, rules: Rules) -> None:
    """Adds a normalised innovation of joint j; ``row_ns`` is still the tick of the previous one.

    Args:
        filter_: Sums, last innovation and spread of the joint are changed.
        c: Index of the camera.
        j: Index into JOINTS.
        innovation: Innovation over its standard deviation.
        now: The tick [ns].
        rules: Memory of the spread [s].
    """
    age_s = (now - filter_.estimate.row_ns[j]) * 1e-9
    kept = np.exp(-age_s / _MEMORY_S)
    filter_.estimate.squares[j] = kept * filter_.estimate.squares[j] + innovation**2
    filter_.estimate.products[j] = kept * filter_.estimate.products[j] + innovation * filter_.estimate.innovation[c, j]
    filter_.estimate.innovation[c, j] = innovation
    filter_.estimate.spread[j] = max(np.exp(-age_s / rules.spread_memory_s) * filter_.estimate.spread[j], innovation**2)


@njit(cache=True, inner=True)
def autocorrelation(filter_: Filter, j: int) -> float:
    """Autocorrelation of joint j's innovations by the same camera, at lag 1, in [-1, 1]; 0 without innovations."""
    if not 0.0 < filter_.estimate.squares[j] < np.inf:
        return 0.0
    return float(max(-1.0, min(filter_.estimate.products[j] / filter_.estimate.squares[j], 1.0)))


@njit(cache=True, inner=True)
def variance_factor(filter_: Filter, j: int, a: int, rules: Rules) -> float:
    """Factor on the variance of a joint; at least 1 while it coasts, as there are then no innovations.

    Args:
        filter_: After the tick.
        j: Index into JOINTS.
        a: 0 for the variance of p, 1 for that of v.
        rules: Bounds on the factor.
    """
    least = 1.0 if filter_.estimate.tick_ns[0] - filter_.estimate.row_ns[j] > rules.coast_ns else rules.spread_least
    offset, slope = FITTED[KIND[j], a]
    scale = filter_.estimate.spread[j] * np.exp(offset + slope * autocorrelation(filter_, j))
    return float(max(least, min(scale, rules.spread_most)))
