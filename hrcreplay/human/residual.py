"""How far people are from their model, limb by limb, and for how long a limb has not been seen.

People bend sideways, twist and lift their shoulders; twelve joints do not (ERRATA, 'The human model'). A sample of a
limb's residual is the largest distance of its measured points from those of the fused model at the frame's capture
time, where the delay is compensated. It is taken after the tick's update and saturation, so it is about the state that
is handed on, from frames that show the limb and all that carries it with enough confidence and without an outlier.

The samples of a short stretch of time count once, by the largest: a quantile over stretches depends neither on how many
cameras there are nor on which of them comes first. The ring holds the last ``SLOTS`` stretches in which the limb was
seen; a limb out of sight forgets nothing.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.human.filter import Filter, Rules, delay
from hrcreplay.human.kalman import ago
from hrcreplay.human.model import ARM_POINTS, HEAD, LEFT_ARM, PELVIS, RIGHT_ARM, skeleton_row
from hrcreplay.human.validity import distance
from hrcreplay.records import Bools, Floats

#: Stretches in the ring of a limb.
SLOTS = 256
#: Fewer stretches say nothing of a quantile.
LEAST = 20

(_SHOULDER_R, _ELBOW_R, _WRIST_R), (_SHOULDER_L, _ELBOW_L, _WRIST_L) = ARM_POINTS
#: Points of each of LIMBS, the first repeated where there are fewer. The neck, the middle of the shoulders, is never
#: further off than the worse of them.
_ENDS = np.array(
    [
        [HEAD, HEAD, HEAD],
        [PELVIS, _SHOULDER_R, _SHOULDER_L],
        [_SHOULDER_R, _ELBOW_R, _ELBOW_R],
        [_ELBOW_R, _WRIST_R, _WRIST_R],
        [_SHOULDER_L, _ELBOW_L, _ELBOW_L],
        [_ELBOW_L, _WRIST_L, _WRIST_L],
    ]
)
#: First of the two joints of each arm's limb.
_FIRST = np.array([RIGHT_ARM, RIGHT_ARM + 2, LEFT_ARM, LEFT_ARM + 2])


@njit(cache=True)
def observe(filter_: Filter, fresh: Bools, now: int, rules: Rules) -> None:
    """Takes the samples of the new frames into the rings, and the quantiles anew where a ring changed."""
    changed = np.zeros(len(_ENDS), dtype=np.bool_)
    model = np.empty_like(filter_.points[0])
    for c in np.flatnonzero(fresh):
        skeleton_row(ago(filter_.mean, delay(filter_, c, now, rules)), filter_.lengths, model)
        for limb in np.flatnonzero(filter_.shows[c]):
            sample = 0.0
            for k in _ENDS[limb]:
                sample = max(sample, distance(filter_.points[c, k], model[k]))
            changed[limb] |= _enter(filter_, limb, now, sample, rules)
    for limb in np.flatnonzero(changed):
        if filter_.opened[limb] >= LEAST:
            known = filter_.slots[limb, : min(filter_.opened[limb], SLOTS)]
            filter_.residual[limb] = _quantile(known, rules.residual_quantile)


@njit(cache=True)
def unseen(filter_: Filter, seconds: Floats) -> None:
    """Writes how long ago the last valid row of each limb's own joints came, (6,) [s].

    Head and thorax have been seen when all four joints of the torso have. Of the two joints of a part of an arm one is
    enough: the other goes blind where it does not matter (alpha_3 when the elbow is straight).
    """
    now = filter_.tick_ns[0]
    seconds[:2] = _since(now, filter_.row_ns[:4].min())
    for i in range(len(_FIRST)):
        seconds[2 + i] = _since(now, filter_.row_ns[_FIRST[i] : _FIRST[i] + 2].max())


@njit(cache=True)
def _since(now: int, then: int) -> float:
    return (now - then) * 1e-9 if then >= 0 else np.inf


@njit(cache=True)
def _enter(filter_: Filter, limb: int, now: int, sample: float, rules: Rules) -> bool:
    """Puts a sample into the current stretch, or a new one where that is over; whether the ring changed."""
    ring = filter_.slots[limb]
    if now - filter_.opened_ns[limb] >= rules.slot_ns:
        ring[filter_.opened[limb] % SLOTS] = sample
        filter_.opened[limb] += 1
        filter_.opened_ns[limb] = now
        return True
    current = (filter_.opened[limb] - 1) % SLOTS
    if sample <= ring[current]:
        return False
    ring[current] = sample
    return True


@njit(cache=True)
def _quantile(samples: Floats, share: float) -> float:
    """The least sample that at least this share of the samples does not exceed."""
    rank = max(1, int(np.ceil(share * len(samples))))
    return np.partition(samples, rank - 1)[rank - 1]
