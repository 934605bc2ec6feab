"""The standard deviations that are told: those of the filter, scaled by what its innovations say of them.

P of Eq. (49) follows from the sigmas alone, which must do for the liveliest motion and the worst camera. To multiply R
and G by one number leaves every gain, and so the estimate, as it is, and multiplies P: the variance of unit weight of
the calculus of observations. Each joint has its own: the highest of its innovations squared over their variance,
forgotten slowly. At rest it is small; when a joint sets off, the first innovation raises it at once, and it outlasts
the motion.

The innovations of a filter whose model is right are independent of each other (Mehra, IEEE Trans. Automatic Control
15(2), 1970). Of one that lags, and of a camera that stands wrong or whose noise lingers, neighbouring innovations by
the same camera agree, and the estimate is further off than their size tells: of noise that is new in each frame a
filter keeps a small part, of noise that lingers all. So the variances also grow with the correlation of neighbouring
innovations. By how much was fitted on recordings (docs/deviations.md).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.human.fusion.kalman import Filter, Rules

#: Highest square before the first innovations: nothing is known yet, so the variances are about the filter's own.
FIRST_SPREAD = 4.0
#: An innovation this long ago counts 1/e in the correlation [s].
_MEMORY_S = 2.0
#: x and y, heading, lean, the angles of both arms, z.
KIND = np.array([0, 0, 1, 2, 3, 4, 5, 6, 3, 4, 5, 6, 7])
#: Logarithm of the factor on the variances of p, and of v, of each kind beside the spread: where neighbouring
#: innovations do not agree at all, and how much more where they agree fully. ``python -m tests.deviations`` fits them.
FITTED = np.array(
    [
        [
            [-1.65, 2.03],
            [-1.90, 2.19],
            [-1.61, 1.06],
            [-1.69, 2.36],
            [-1.56, 2.17],
            [-1.53, 2.53],
            [-1.70, 2.18],
            [-1.15, 0.80],
        ],
        [
            [-1.64, 2.67],
            [-2.51, 3.36],
            [-1.56, 1.94],
            [-2.30, 3.40],
            [-2.01, 3.41],
            [-2.06, 3.10],
            [-1.90, 2.75],
            [-1.22, 1.56],
        ],
    ]
)


@njit(cache=True)
def forget(filter_: Filter, j: int) -> None:
    """Starts joint j anew: no innovation yet."""
    filter_.innovation[:, j], filter_.squares[j], filter_.products[j] = 0.0, 0.0, 0.0
    filter_.spread[j] = FIRST_SPREAD


@njit(cache=True)
def enter(filter_: Filter, c: int, j: int, innovation: float, now: int, rules: Rules) -> None:
    """Takes an innovation of joint j in; ``row_ns`` still tells of the one before.

    Args:
        filter_: Sums, last innovation and spread of the joint are changed.
        c: Index of the camera.
        j: Index into JOINTS.
        innovation: Over its standard deviation.
        now: The tick [ns].
        rules: Memory of the spread [s].
    """
    age_s = (now - filter_.row_ns[j]) * 1e-9
    kept = np.exp(-age_s / _MEMORY_S)
    filter_.squares[j] = kept * filter_.squares[j] + innovation**2
    filter_.products[j] = kept * filter_.products[j] + innovation * filter_.innovation[c, j]
    filter_.innovation[c, j] = innovation
    filter_.spread[j] = max(np.exp(-age_s / rules.spread_memory_s) * filter_.spread[j], innovation**2)


@njit(cache=True)
def correlation(filter_: Filter, j: int) -> float:
    """Of neighbouring innovations of joint j lately, in [-1, 1]; 0 before there are any."""
    if not 0.0 < filter_.squares[j] < np.inf:
        return 0.0
    return float(max(-1.0, min(filter_.products[j] / filter_.squares[j], 1.0)))


@njit(cache=True)
def factor(filter_: Filter, j: int, a: int, rules: Rules) -> float:
    """On the variance of a joint; at least 1 while it coasts, for nothing is known of a joint that is not seen.

    Args:
        filter_: After the tick.
        j: Index into JOINTS.
        a: 0 for the variance of p, 1 for that of v.
        rules: Bounds on the factor.
    """
    least = 1.0 if filter_.tick_ns[0] - filter_.row_ns[j] > rules.coast_ns else rules.spread_least
    plain, agreeing = FITTED[a, KIND[j]]
    told = filter_.spread[j] * np.exp(plain + agreeing * correlation(filter_, j))
    return float(max(least, min(told, rules.spread_most)))
