"""The arrays that the kernels of the fusion share."""

from __future__ import annotations

from typing import NamedTuple

from numba import njit

from hrcreplay.records import Bools, Floats, Ints


class Filter(NamedTuple):
    """All that one tick hands to the next."""

    tick_ns: Ints  #: (1,) the last tick
    started: Bools  #: (1,) whether there is a person
    mean: Floats  #: (12, 4) p, v, a, j
    cov: Floats  #: (12, 4, 4)
    lengths: Floats  #: (8,)
    lengths_var: Floats  #: (8,)
    row_ns: Ints  #: (20,) tick at which a row (12 angles, 8 lengths) was last valid
    acquired_ns: Ints  #: (20,) tick at which a row started anew
    point_ns: Ints  #: (20,) tick at which a body point last agreed with the filter
    bone_ns: Ints  #: (8,) tick at which a camera last saw a length that agreed with the filter
    capture_ns: Ints  #: (c,) of the frame held for each camera
    uses: Ints  #: (c,) ticks that frame was used in; -1 without one
    z: Floats  #: (c, 20) its rows
    z_var: Floats  #: (c, 20) sigma_z^2
    points: Floats  #: (c, 20, 3)
    confidence: Floats  #: (c, 20)
    valid: Bools  #: (c, 20) which of its rows are used
    shows: Bools  #: (c, 6) which limbs it shows with all that carries them
    residuals: Floats  #: (7, BINS) weights of the residuals of each limb of BODY by their size
    weight: Floats  #: (7,) of all of them
    samples: Ints  #: (7,) residuals so far
    sampled_ns: Ints  #: (7,) tick of the last
    residual: Floats  #: (7,) their quantile [m]
    surprise: Floats  #: (12,) running mean of each joint's innovations squared over their variance
    spread: Floats  #: (12,) highest of it lately: the factor on the variances that are told


class Frames(NamedTuple):
    """Frames in order of arrival."""

    capture_ns: Ints
    arrival_ns: Ints
    camera: Ints
    z: Floats
    z_var: Floats
    points: Floats
    confidence: Floats


class Rules(NamedTuple):
    """Settings and limits as the kernels need them."""

    sigma: Floats  #: (12, 4) of Eq. (44)
    reuse: bool
    compensate: bool
    delay_max_s: float
    confidence_min: float
    outlier_m: float
    bone_m: float
    memory_ns: int
    bone_memory_ns: int
    coast_ns: int
    residual_quantile: float
    residual_memory_s: float
    spread_memory_s: float
    spread_least: float
    spread_most: float
    rest_s: float
    rest_std: Floats  #: (12, 3) of v, a, j of a joint nobody has seen for long
    p_min: Floats
    p_max: Floats
    v_min: Floats
    v_max: Floats
    a_min: Floats
    a_max: Floats
    coupled: bool


class Track(NamedTuple):
    """What the ticks leave behind; rows before the start stay as they are."""

    motion: Floats  #: (6, n, 12) p, v, a, j, and the deviations of p and v with the factor of ``spread``
    lengths: Floats  #: (2, n, 8) and their deviations
    valid: Bools  #: (n, c)
    residual: Floats  #: (n, 7)
    unseen: Floats  #: (n, 6)
    cov: Floats  #: (n or 0, 12, 4, 4)
    damping: Floats  #: (n or 0, 12) of the derivatives, on the way to the tick
    outliers: Ints  #: (c,)
    superseded: Ints  #: (c,)
    reacquired: Ints  #: (1,)
    saturated: Ints  #: (1,)


@njit(cache=True)
def delay(filter_: Filter, c: int, now: int, rules: Rules) -> float:
    """Age of the frame held for a camera [s]; 0 where delays are ignored."""
    if not rules.compensate:
        return 0.0
    return max(0.0, min((now - filter_.capture_ns[c]) * 1e-9, rules.delay_max_s))
