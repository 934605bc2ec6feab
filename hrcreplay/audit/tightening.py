"""Fitted accelerations scaled until the volumes, not the joints, hold the people of the logs as often as was asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hrcreplay.audit.window import Window, hold
from hrcreplay.human.fitting import Fit
from hrcreplay.human.model import LimitSet
from hrcreplay.pipeline import Foresight
from hrcreplay.records import BODY, Bools, Floats

#: Ticks a second whose volumes are held against the recorded future [Hz].
TIGHTEN_HZ = 12.5
#: Share of the ticks of each side of a joint that its acceleration holds before all are scaled.
BEFORE = 0.9
#: The smallest factor tried: minutes of a few people do not show all that they do. How often its interval is halved.
_SMALLEST, _HALVINGS = 0.6, 4


@dataclass(frozen=True)
class Held:
    """One log's person in parts: to fit on, and held back."""

    foresight: Foresight
    training: Window
    held_back: Window


def unchecked(people: Sequence[Held]) -> list[str]:
    """Limbs, and points of other limbs, that were never seen to a horizon's end, so that nothing is said of them."""
    parts = [part for one in people for part in (one.training, one.held_back)]
    volumes = people[0].foresight.volumes(parts[0].states.rows(slice(0, 0))).limbs
    limbs = [limb for limb in BODY if limb not in volumes or not any(part.checked(limb).any() for part in parts)]
    points = [
        f"{point} of {limb}"
        for limb, names in parts[0].points().items()
        if limb not in limbs
        for point in names
        if not any(part.points()[limb][point] for part in parts)
    ]
    return limbs + points


def stayed(foresight: Foresight, future: Window, limits: LimitSet) -> Floats:
    """(n,) whether all limbs that were seen stayed in their volumes until the horizon: 1, 0, or NaN where none was."""
    volumes = replace(foresight, limits=limits).volumes(future.states)
    worst = hold(volumes, future, np.zeros(len(future.states), dtype=bool)).worst_m()
    return np.where(np.isfinite(worst), (worst == 0.0).astype(float), np.nan)


def factor(people: Sequence[Held], found: Fit, positions: LimitSet, share: float) -> float:
    """The smallest factor on the fitted accelerations with which the volumes hold a share of the training ticks.

    Half of the ticks that may be missed are kept in reserve, for other ticks than those fitted on. Ticks that even the
    fitted accelerations do not hold, for what no bound can mend (a limb that is not where the model has it, a joint
    that keeps the standard bounds), do not count: they would drive the bounds of all others up.
    """

    def held(scale: float) -> Bools:
        limits = scaled(found, scale).onto(positions, positions.name)
        return np.concatenate([stayed(one.foresight, one.training, limits) == 1.0 for one in people])

    best = held(1.0)
    low, high = _SMALLEST, 1.0
    for _ in range(_HALVINGS):
        middle = float(np.sqrt(low * high))
        enough = (held(middle) & best).sum() >= 0.5 * (1.0 + share) * best.sum()
        low, high = (low, middle) if enough else (middle, high)
    return high


def scaled(found: Fit, scale: float) -> Fit:
    """The fit with its own accelerations scaled; joints that keep the standard bounds keep them."""
    by = np.where(found.kept, 1.0, scale)
    return replace(found, a_min=by * found.a_min, a_max=by * found.a_max)
