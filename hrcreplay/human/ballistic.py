"""Bounds for volumes rather than for joints: what people's estimated velocities leave to their accelerations."""

from __future__ import annotations

import numpy as np

from hrcreplay.human.fitting import (
    EXCURSIONS,
    LEAST,
    STIR,
    Fit,
    Futures,
    count_excursions,
    least_needed,
    rounded_up,
)
from hrcreplay.human.model import LimitSet

#: Share of the velocities that the bounds hold: what is faster is a marker that jumped.
_FASTEST = 0.999


def ballistic(training: Futures, standard: LimitSet, share: float, horizon_s: float) -> Fit:
    """Bounds of another shape than ``fit``'s: velocities as fast as people are, and accelerations for the rest.

    Where a velocity bound is low, a joint may have any velocity up to it, whatever the estimate says. Under these the
    reach is where the estimated velocity leads, give or take what the accelerations change: with the same share of
    ticks inside, swept volumes are about half as large, since a limb's place rests on many joints.

    Args:
        training: Ticks to fit on.
        standard: Bounds that joints keep whose motion is too little to say.
        share: Of the ticks of each side of each joint that its acceleration bound holds, in (0, 1).
        horizon_s: T_s [s].
    """
    excursions = np.array(
        [count_excursions(training.t_ns, training.moved[:, j] > STIR[j], horizon_s) for j in range(12)]
    )
    kept = excursions < EXCURSIONS
    v, a = np.stack([-standard.v_min, standard.v_max]), np.stack([-standard.a_min, standard.a_max])
    for j in np.flatnonzero(~kept).tolist():
        known = np.isfinite(training.moved[:, j])
        for side, speed, gone in (
            (0, -training.v[known, j], -training.down[known, j]),
            (1, training.v[known, j], training.up[known, j]),
        ):
            fastest = np.quantile(np.concatenate([speed, gone / horizon_s]), _FASTEST)
            needed = np.quantile(least_needed(speed, gone, np.inf, horizon_s), share)
            v[side, j], a[side, j] = rounded_up(np.maximum([fastest, needed], LEAST))
    return Fit(-v[0], v[1], -a[0], a[1], kept, excursions)
