"""How uncertain the fused state truly is: the variances that the filter tells, times what innovations say of them.

P of Eq. (49) follows from the sigmas alone, which must do for the liveliest motion and the worst camera. To multiply
R and G by one number leaves every gain, and so the estimate, as it is, and multiplies P: the variance of unit weight of
the calculus of observations. Each joint has its own, from its innovations squared over their variance: the mean of the
last few, held at its highest and forgotten slowly. At rest it is small; when a joint sets off, the first innovations
raise it at once, and it outlasts the motion.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.human.filter import Filter, Rules

#: Weight of the newest innovation in the running mean.
_NEWEST = 0.25


@njit(cache=True)
def enter(filter_: Filter, j: int, squared: float, now: int, rules: Rules) -> None:
    """Takes an innovation of joint j in, squared over its variance; ``row_ns`` still tells of the one before."""
    filter_.surprise[j] += _NEWEST * (squared - filter_.surprise[j])
    kept = np.exp(-(now - filter_.row_ns[j]) * 1e-9 / rules.spread_memory_s)
    filter_.spread[j] = max(kept * filter_.spread[j], filter_.surprise[j])


@njit(cache=True)
def factor(filter_: Filter, j: int, rules: Rules) -> float:
    """On the variances of joint j; at least 1 while it coasts, for nothing is known of a joint that is not seen."""
    least = 1.0 if filter_.tick_ns[0] - filter_.row_ns[j] > rules.coast_ns else rules.spread_least
    return max(least, min(filter_.spread[j], rules.spread_most))
