"""Distance of the body's points from the model and ``body_points``, and time since a camera saw them.

A sample of a limb's residual is the maximum distance of its measured points from the predicted points, at the frame's
capture time if the delay is compensated. It is taken before the frame is used, so it includes the lag of the filter
behind a person who starts to move. It is taken from frames that show the limb and all limbs that carry it, with enough
confidence and without an outlier. The sample of the legs is the maximum distance of the visible hips, knees, ankles and
feet from the line between the floor and the fused pelvis, if the frame shows the pelvis and at least one point below
the hips. The distance from a convex set is convex, so a bone between two points is never further off than the worse of
them.

The running quantile is that of all samples so far, each with the weight exp(-age / memory); the samples of an unseen
limb stop ageing when the limb is lost, so the quantile survives an occlusion. Samples are rounded up to a millimetre. A
sample above the quantile is used for ``residual_hold_s``, or until a larger one, as no such movement has been seen
before.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.geometry.vectors import distance
from hrcreplay.human.fusion.body_points import REACH_M, distance_shown, learn, shift
from hrcreplay.human.fusion.kalman import (
    SHOWN_NS,
    Filter,
    Gate,
    ModelResidual,
    Rules,
    StateEstimate,
    delay,
    extrapolate_back,
)
from hrcreplay.human.model import ARM_POINTS, BENDS, HEAD, HEIGHT, LEFT_ARM, PELVIS, RIGHT_ARM, skeleton_row
from hrcreplay.kernels import njit
from hrcreplay.records import BODY, POINTS, Bools, Floats, Ints

_BIN_M = 0.001
#: Bins of a limb's samples; the last one contains all larger samples, far beyond those of the same person's arm.
BINS = round(REACH_M / _BIN_M)
#: Number of bins that are compared with 0 at once.
_BLOCK = 64
#: Minimum number of samples for a quantile.
LEAST = 20

(_SHOULDER_R, _ELBOW_R, _WRIST_R), (_SHOULDER_L, _ELBOW_L, _WRIST_L) = ARM_POINTS
#: Points of each of LIMBS, the first repeated where there are fewer. The neck is the middle of the shoulders, so its
#: distance is at most that of the worse shoulder.
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


@njit(cache=True, inner=True)
def observe(filter_: Filter, fresh: Bools, now: int, rules: Rules, outliers: Ints) -> None:
    """Adds the samples of the cameras' new frames and recomputes the quantiles of those limbs.

    Args:
        filter_: After the tick's prediction, before its update; the residuals' samples and quantiles are changed.
        fresh: (c,) True if the stored frame of a camera is new.
        now: The tick [ns].
        rules: Settings of the filter.
        outliers: (c,) number of a camera's points that disagree with the person; those of broken legs are added.
    """
    along = np.empty(3)
    for c in np.flatnonzero(fresh):
        p = extrapolate_back(filter_.estimate.mean, delay(filter_.gate.capture_ns[c], now, rules))
        plain = np.full(filter_.gate.points[0].shape, np.nan)
        skeleton_row(p, filter_.estimate.lengths, plain)
        model = plain.copy()
        shift(filter_.model.offset, p, model)
        _depart(filter_.gate, c, model, now, rules.outlier_m)
        shown = np.zeros(len(BODY), np.bool_)
        for k in range(len(BODY)):
            has = filter_.gate.valid[c, :2].all() if k == _LEGS else filter_.gate.shows[c, k]
            shown[k] = has and _settled(filter_.estimate, k, now, rules.memory_ns)
        for limb in np.flatnonzero(shown[:_LEGS]):
            sample = 0.0
            for k in _ENDS[limb]:
                recent = now - filter_.model.carried_ns[c, k] <= SHOWN_NS
                for i in range(3):
                    along[i] = plain[k, i] + filter_.model.carried[c, k, i] - model[k, i] if recent else 0.0
                sample = max(sample, distance_shown(filter_.gate.points[c, k], model[k], along))
            _enter(filter_.model, limb, now, sample, rules)
        if shown[_LEGS]:
            seen = filter_.gate.confidence[c] >= rules.confidence_min
            counts = seen & ~filter_.gate.disbelieved[c]
            below = _farthest(filter_.gate.points[c], counts, _BELOW, model[PELVIS])
            if below >= 0.0:
                sample = max(below, _farthest(filter_.gate.points[c], counts, _HIPS, model[PELVIS]))
                _enter(filter_.model, _LEGS, now, sample, rules)
        outliers[c] += learn(filter_, c, now, shown, p, plain, model, rules)
    for limb in np.flatnonzero(filter_.model.sampled_ns == now):
        if filter_.model.samples[limb] >= LEAST:
            larger = (1.0 - rules.residual_quantile) * filter_.model.weight[limb]
            filter_.model.residual[limb] = _exceeded_by(filter_.model.residuals[limb], larger)


@njit(cache=True, inner=True)
def _depart(gate: Gate, c: int, model: Floats, now: int, outlier_m: float) -> None:
    """Writes the distance of each limb's rejected points in a camera's frame from the model (20, 3) [m].

    A point counts if this or another camera has shown it there before, and no camera shows it near the model.
    """
    gate.apart[c] = 0.0
    for limb in range(len(_ENDS)):
        for k in _ENDS[limb]:
            since = gate.refused_ns[c, k]
            if since <= gate.point_ns[k]:
                continue
            here, shown = gate.refused_at[c, k], since < now
            for other in range(len(gate.apart)):
                both = other != c and gate.refused_ns[other, k] > gate.point_ns[k]
                shown = shown or (both and distance(gate.refused_at[other, k], here) <= outlier_m)
            if shown:
                gate.apart[c, limb] = max(gate.apart[c, limb], distance(here, model[k]))


@njit(inner=True, inline="always")  # passing the filter on would take longer than this
def write_residual(model: ModelResidual, gate: Gate, now: int, rules: Rules, residual: Floats) -> None:
    """Writes the residual of each limb of BODY used at a tick, (7,) [m]; NaN until known.

    It includes points that the gates still reject, so that volumes contain both the filter's estimate and the camera's
    points.

    Args:
        model: After ``observe``.
        gate: The same.
        now: The tick [ns].
        rules: Settings of the filter.
        residual: Receives the quantiles, or larger distances of rejected points.
    """
    residual[:] = model.residual
    for limb in range(len(residual)):
        if now - model.peak_ns[limb] < rules.residual_hold_ns and residual[limb] < model.peak[limb]:
            residual[limb] = model.peak[limb]
    for c in range(len(gate.apart)):
        if now - gate.capture_ns[c] <= rules.memory_ns:
            for limb in range(gate.apart.shape[1]):
                if gate.apart[c, limb] > 0.0:
                    residual[limb] = np.fmax(residual[limb], gate.apart[c, limb])


@njit(cache=True, inner=True)
def _farthest(points: Floats, counts: Bools, which: Ints, pelvis: Floats) -> float:
    """Returns the maximum distance of leg points from the line below the pelvis (3,) [m]; -1 if none is seen.

    Args:
        points: (20, 3) [m].
        counts: (20,) True for those that a camera shows, and that are believed.
        which: Indices of the leg points.
        pelvis: (3,) [m].
    """
    farthest = -1.0
    for k in which:
        point = points[k]
        if counts[k] and distance(point, pelvis) <= REACH_M:
            beyond = point[2] - max(0.0, min(point[2], pelvis[2]))
            off = np.sqrt((point[0] - pelvis[0]) ** 2 + (point[1] - pelvis[1]) ** 2 + beyond**2)
            farthest = max(farthest, off)
    return farthest


@njit(cache=True, inner=True)
def _settled(estimate: StateEstimate, limb: int, now: int, memory_ns: int) -> bool:
    """Returns True if no joint that carries the limb is lost or has restarted recently."""
    root = 2 if limb == _LEGS else 4
    newest, last = estimate.acquired_ns[:root].max(), estimate.row_ns[:root].min()
    newest, last = max(newest, estimate.acquired_ns[HEIGHT]), min(last, estimate.row_ns[HEIGHT])
    if 2 <= limb < _LEGS:
        first = _FIRST[limb - 2]
        newest = max(newest, estimate.acquired_ns[first - first % 4 : first + 2].max())
        for pair in range(first - first % 4, first + 2, 2):  # one of the two is enough, see ``write_unseen_times``
            last = min(last, estimate.row_ns[pair : pair + 2].max())
    return now - newest > memory_ns and now - last <= memory_ns


@njit(cache=True, inner=True)
def write_unseen_times(now: int, row_ns: Ints, carried_ns: Ints, seconds: Floats) -> None:
    """Writes the time since the last valid row of each limb's own joints; for the legs, knees and ankles.

    Head and thorax count as seen if all four joints of the torso are seen. For the two joints of a part of an arm one
    is enough: the other may be unobservable where it has no effect (alpha_3 with a straight elbow).

    Args:
        now: The tick [ns].
        row_ns: (20,) tick at which each row was last valid.
        carried_ns: (c, 20) capture at which each camera last observed a point.
        seconds: (7,) receives the times [s].
    """
    seconds[:2] = _since(now, row_ns[:4].min())
    for i in range(len(_FIRST)):
        seconds[2 + i] = _since(now, row_ns[_FIRST[i] : _FIRST[i] + 2].max())
    seen = now
    for k in BENDS:
        seen = min(seen, carried_ns[:, k].max())
    seconds[_LEGS] = _since(now, seen)


@njit(cache=True, inner=True)
def _since(now: int, then: int) -> float:
    return (now - then) * 1e-9 if then >= 0 else np.inf


@njit(cache=True, inner=True)
def _enter(model: ModelResidual, limb: int, now: int, sample: float, rules: Rules) -> None:
    """Reduces the weights of a limb's earlier samples and adds one of weight 1; ignores a sample that is not finite."""
    if not sample >= 0.0:
        return
    age = min(now - model.sampled_ns[limb], rules.memory_ns) * 1e-9
    kept = np.exp(-age / rules.residual_memory_s)
    if sample >= model.peak[limb] or now - model.peak_ns[limb] >= rules.residual_hold_ns:
        model.peak[limb], model.peak_ns[limb] = sample, now
    for k in range(_highest(model.residuals[limb])):
        model.residuals[limb, k] *= kept
    model.residuals[limb, int(min(sample / _BIN_M, BINS - 1.0))] += 1.0  # inf cannot be converted to an integer
    model.weight[limb] = kept * model.weight[limb] + 1.0
    model.samples[limb] += 1
    model.sampled_ns[limb] = now


@njit(cache=True, inner=True)
def _exceeded_by(weights: Floats, larger: float) -> float:
    """Returns the smallest upper end of a bin such that the samples above it have at most this weight [m]."""
    above = 0.0
    bin_ = _highest(weights)
    while bin_ > 1 and above + weights[bin_ - 1] <= larger:
        bin_ -= 1
        above += weights[bin_]
    return bin_ * _BIN_M


@njit(cache=True, inner=True)
def _highest(weights: Floats) -> int:
    """Returns a number of bins beyond which all weights are 0; few are looked at one by one, as most are 0."""
    bits = weights.view(np.int64)
    past = BINS
    while past > _BLOCK:
        found = np.int64(0)
        for k in range(past - _BLOCK, past):
            found |= bits[k]
        if found != 0:
            break
        past -= _BLOCK
    return past
