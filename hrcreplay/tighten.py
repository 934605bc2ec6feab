"""Fitted limits scaled down until the volumes, not the joints, hold the people of the logs as often as was asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hrcreplay.follow import Window, hold
from hrcreplay.human.fitting import Fit
from hrcreplay.human.model import LimitSet
from hrcreplay.pipeline import Foresight
from hrcreplay.records import Floats

#: Ticks a second whose volumes are held against the recorded future [Hz].
TIGHTEN_HZ = 5.0
#: The smallest factor tried, and how often its interval is halved.
_SMALLEST, _HALVINGS = 0.125, 6


@dataclass(frozen=True)
class Held:
    """One log's person in parts: to fit on, and held back."""

    foresight: Foresight
    training: Window
    held_back: Window


def stayed(foresight: Foresight, future: Window, limits: LimitSet) -> Floats:
    """(n,) whether all limbs stayed in their volumes until the horizon: 1, 0, or NaN where none was recorded."""
    volumes = replace(foresight, limits=limits).volumes(future.states)
    worst = hold(volumes, future, np.zeros(len(future.states), dtype=bool)).worst_m()
    return np.where(np.isfinite(worst), (worst == 0.0).astype(float), np.nan)


def factor(people: Sequence[Held], found: Fit, positions: LimitSet, share: float) -> float:
    """The smallest factor on the fitted bounds with which the volumes hold a share of the training ticks.

    Where even the fitted bounds do not hold so many, for what no bound can mend (a limb that is not where the model
    has it, a joint that keeps the standard bounds), the smallest that holds as many as these.
    """

    def covered(scale: float) -> float:
        limits = scaled(found, scale).onto(positions, positions.name)
        return float(np.nanmean(np.concatenate([stayed(one.foresight, one.training, limits) for one in people])))

    target = min(share, covered(1.0))
    low, high = _SMALLEST, 1.0
    for _ in range(_HALVINGS):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if covered(middle) >= target else (middle, high)
    return high


def scaled(found: Fit, scale: float) -> Fit:
    """The fit with its own bounds scaled; joints that keep the standard ones keep them."""
    by = np.where(found.kept, 1.0, scale)
    return replace(
        found, v_min=by * found.v_min, v_max=by * found.v_max, a_min=by * found.a_min, a_max=by * found.a_max
    )
