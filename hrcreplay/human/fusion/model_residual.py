"""Distance of the body's points from the model and ``body_points``, and time since a camera saw them.

A sample of a limb's residual is the largest distance of its measured points from those, of the predicted model at the
frame's capture time, where the delay is compensated. It is taken before the frame is used, so it also holds how far the
filter lags who sets off, from frames that show the limb and all that carries it with enough confidence and without an
outlier. That of the legs is the largest distance from the line between the floor and the fused pelvis of the
hips, knees, ankles and feet that the frame shows, if it shows the pelvis and at least one point below the hips. The
distance from a convex set is convex, so a bone between two points is no further off than the worse of them.

The running quantile is that of all samples so far, each with the weight exp(-age / memory); a limb out of sight does
not age for longer than it takes to be lost, so that what is known of a person outlives an occlusion. Samples are kept
by the millimetre and rounded up. A larger one counts for ``residual_hold_s``, or until one larger still: a movement of
its kind has not been seen before.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.human.fusion.body_points import REACH_M, learn, shift
from hrcreplay.human.fusion.gating import distance
from hrcreplay.human.fusion.kalman import Filter, Rules, delay, extrapolate_back
from hrcreplay.human.model import ARM_POINTS, BENDS, HEAD, HEIGHT, LEFT_ARM, PELVIS, RIGHT_ARM, skeleton_row
from hrcreplay.kernels import njit
from hrcreplay.records import BODY, POINTS, Bools, Floats, Ints

_BIN_M = 0.001
#: Bins of a limb's samples; the last takes all that are larger, far beyond what passes for the same person's arm.
BINS = round(REACH_M / _BIN_M)
#: Fewer samples say nothing of a quantile.
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
_LEGS = BODY.index("LEGS")
_HIPS = np.array([POINTS.index(f"hip_{side}") for side in "rl"])
_BELOW = np.array([POINTS.index(f"{part}_{side}") for part in ("knee", "ankle", "foot") for side in "rl"])


@njit(cache=True)
def observe(filter_: Filter, fresh: Bools, now: int, rules: Rules) -> None:
    """Takes the samples of the cameras' new frames in, and the quantiles of those limbs anew.

    Args:
        filter_: After the tick's prediction, before its update; the residuals' samples and quantiles are changed.
        fresh: (c,) whether the frame held for a camera is new.
        now: The tick [ns].
        rules: Settings of the filter.
    """
    for c in np.flatnonzero(fresh):
        p = extrapolate_back(filter_.estimate.mean, delay(filter_, c, now, rules))
        plain = np.full(filter_.gate.points[0].shape, np.nan)
        skeleton_row(p, filter_.estimate.lengths, plain)
        model = plain.copy()
        shift(filter_, p, model)
        _depart(filter_, c, model, now, rules)
        shown = np.zeros(len(BODY), np.bool_)
        for k in range(len(BODY)):
            has = filter_.gate.valid[c, :2].all() if k == _LEGS else filter_.gate.shows[c, k]
            shown[k] = has and _settled(filter_, k, now, rules)
        for limb in np.flatnonzero(shown[:_LEGS]):
            sample = 0.0
            for k in _ENDS[limb]:
                sample = max(sample, distance(filter_.gate.points[c, k], model[k]))
            _enter(filter_, limb, now, sample, rules)
        if shown[_LEGS]:
            below = _farthest(filter_, c, _BELOW, model[PELVIS], rules)
            if below >= 0.0:
                sample = max(below, _farthest(filter_, c, _HIPS, model[PELVIS], rules))
                _enter(filter_, _LEGS, now, sample, rules)
        learn(filter_, c, now, shown, p, plain, model, rules)
    for limb in np.flatnonzero(filter_.model.sampled_ns == now):
        if filter_.model.samples[limb] >= LEAST:
            larger = (1.0 - rules.residual_quantile) * filter_.model.weight[limb]
            filter_.model.residual[limb] = _exceeded_by(filter_.model.residuals[limb], larger)


@njit(cache=True)
def _depart(filter_: Filter, c: int, model: Floats, now: int, rules: Rules) -> None:
    """Writes how far a camera shows each limb from the model (20, 3) [m], by points that the gates refuse.

    Counts what it, or another camera, has shown there before, and no camera where the model has it.
    """
    filter_.gate.apart[c] = 0.0
    for limb in range(len(_ENDS)):
        for k in _ENDS[limb]:
            since = filter_.gate.refused_ns[c, k]
            if since <= filter_.gate.point_ns[k]:
                continue
            here, shown = filter_.gate.refused_at[c, k], since < now
            for other in range(len(filter_.gate.apart)):
                both = other != c and filter_.gate.refused_ns[other, k] > filter_.gate.point_ns[k]
                shown = shown or (both and distance(filter_.gate.refused_at[other, k], here) <= rules.outlier_m)
            if shown:
                filter_.gate.apart[c, limb] = max(filter_.gate.apart[c, limb], distance(here, model[k]))


@njit(cache=True)
def write_residual(filter_: Filter, now: int, rules: Rules, residual: Floats) -> None:
    """Writes the residual of each limb of BODY that counts at a tick, (7,) [m]; NaN until known.

    It holds what cameras show that the gates still refuse, so that volumes hold both, what the filter has and what the
    cameras saw.

    Args:
        filter_: After ``observe``.
        now: The tick [ns].
        rules: Settings of the filter.
        residual: Receives the quantiles, or what is farther.
    """
    residual[:] = filter_.model.residual
    for limb in range(len(residual)):
        if now - filter_.model.peak_ns[limb] < rules.residual_hold_ns and residual[limb] < filter_.model.peak[limb]:
            residual[limb] = filter_.model.peak[limb]
    for c in range(len(filter_.gate.apart)):
        if now - filter_.gate.capture_ns[c] <= rules.memory_ns:
            for limb in range(filter_.gate.apart.shape[1]):
                if filter_.gate.apart[c, limb] > 0.0:
                    residual[limb] = np.fmax(residual[limb], filter_.gate.apart[c, limb])


@njit(cache=True)
def _farthest(filter_: Filter, c: int, points: Ints, pelvis: Floats, rules: Rules) -> float:
    """Largest distance of some points of the legs from the line below the pelvis (3,) [m]; -1 where none is shown."""
    farthest = -1.0
    for k in points:
        point = filter_.gate.points[c, k]
        if filter_.gate.confidence[c, k] >= rules.confidence_min and distance(point, pelvis) <= REACH_M:
            beyond = point[2] - max(0.0, min(point[2], pelvis[2]))
            off = np.sqrt((point[0] - pelvis[0]) ** 2 + (point[1] - pelvis[1]) ** 2 + beyond**2)
            farthest = max(farthest, off)
    return farthest


@njit(cache=True)
def _settled(filter_: Filter, limb: int, now: int, rules: Rules) -> bool:
    """Return whether no joint that carries the limb is lost or has restarted lately: the filter must find it first."""
    root = 2 if limb == _LEGS else 4
    newest, last = filter_.estimate.acquired_ns[:root].max(), filter_.estimate.row_ns[:root].min()
    newest, last = max(newest, filter_.estimate.acquired_ns[HEIGHT]), min(last, filter_.estimate.row_ns[HEIGHT])
    if 2 <= limb < _LEGS:
        first = _FIRST[limb - 2]
        newest = max(newest, filter_.estimate.acquired_ns[first - first % 4 : first + 2].max())
        for pair in range(first - first % 4, first + 2, 2):  # one of the two is enough, see ``write_unseen_times``
            last = min(last, filter_.estimate.row_ns[pair : pair + 2].max())
    return now - newest > rules.memory_ns and now - last <= rules.memory_ns


@njit(cache=True)
def write_unseen_times(filter_: Filter, seconds: Floats) -> None:
    """Writes how long ago the last valid row of each limb's own joints came, (7,) [s]; of the legs, knees and ankles.

    Head and thorax have been seen when all four joints of the torso have. Of the two joints of a part of an arm one is
    enough: the other goes blind where it does not matter (alpha_3 when the elbow is straight).
    """
    now = filter_.estimate.tick_ns[0]
    seconds[:2] = _since(now, filter_.estimate.row_ns[:4].min())
    for i in range(len(_FIRST)):
        seconds[2 + i] = _since(now, filter_.estimate.row_ns[_FIRST[i] : _FIRST[i] + 2].max())
    seconds[_LEGS] = _since(now, filter_.model.carried_ns[BENDS].min())


@njit(cache=True)
def _since(now: int, then: int) -> float:
    return (now - then) * 1e-9 if then >= 0 else np.inf


@njit(cache=True)
def _enter(filter_: Filter, limb: int, now: int, sample: float, rules: Rules) -> None:
    """Lets the earlier samples of a limb age, and adds one of weight 1; one that is no distance is none."""
    if not sample >= 0.0:
        return
    age = min(now - filter_.model.sampled_ns[limb], rules.memory_ns) * 1e-9
    kept = np.exp(-age / rules.residual_memory_s)
    if sample >= filter_.model.peak[limb] or now - filter_.model.peak_ns[limb] >= rules.residual_hold_ns:
        filter_.model.peak[limb], filter_.model.peak_ns[limb] = sample, now
    filter_.model.residuals[limb] *= kept
    filter_.model.residuals[limb, int(min(sample / _BIN_M, BINS - 1.0))] += 1.0  # inf is no whole number
    filter_.model.weight[limb] = kept * filter_.model.weight[limb] + 1.0
    filter_.model.samples[limb] += 1
    filter_.model.sampled_ns[limb] = now


@njit(cache=True)
def _exceeded_by(weights: Floats, larger: float) -> float:
    """The least upper end of a bin with samples of at most this weight above it [m]."""
    above = 0.0
    bin_ = BINS
    while bin_ > 1 and above + weights[bin_ - 1] <= larger:
        bin_ -= 1
        above += weights[bin_]
    return bin_ * _BIN_M
