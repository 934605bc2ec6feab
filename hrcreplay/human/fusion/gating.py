"""Gating of camera frames, 4.1.2: by confidence, and by the predicted skeleton.

Pure rejection prevents recovery of a filter that went wrong. So a point that a camera keeps showing in one place, while
no camera shows it near the filter's estimate, is accepted after ``relearn_s``, and its rows restart. Exchanged left and
right sides are not accepted, nor is a marker that jumps away from its bone; if two cameras show it, the residual
includes it (``model_residual``).
"""

from __future__ import annotations

import numpy as np

from hrcreplay.geometry.vectors import distance
from hrcreplay.human.fusion.disbelief import judge
from hrcreplay.human.fusion.inverse_kinematics import DEPENDS, ROWS
from hrcreplay.human.fusion.kalman import NEVER_NS, Filter, Gate, Rules, StateEstimate, delay, extrapolate_back
from hrcreplay.human.model import ARM_POINTS, HEAD, HEIGHT, LEFT_ARM, NECK, PELVIS, RIGHT_ARM, skeleton_row
from hrcreplay.kernels import njit
from hrcreplay.records import DOF, LENGTHS, POINTS, Bools, Floats, Ints

#: An angle with a larger standard deviation is not observed; on a circle it contains no information [rad].
_BLIND_STD = 1.0
#: Points that the model predicts and that are checked in a camera's frame.
_TESTED = np.flatnonzero(DEPENDS.any(axis=0))
_FAR_ENDS = (
    (PELVIS,),
    (HEAD,),
    (ARM_POINTS[0][0], ARM_POINTS[1][0]),
    (ARM_POINTS[1][1],),
    (ARM_POINTS[0][1],),
    (ARM_POINTS[1][2],),
    (ARM_POINTS[0][2],),
)
#: (6, 20) the body points that determine a limb of LIMBS: the inputs of its rows, for any orientation.
_PLACING = DEPENDS[[3, 3, RIGHT_ARM, RIGHT_ARM + 2, LEFT_ARM, LEFT_ARM + 2]]
_PLACING[0, HEAD] = True
#: (7, 20) points whose error changes a length: the far end of its bone, both shoulders for their line.
_ENDS = np.zeros((len(LENGTHS), len(POINTS)), dtype=np.bool_)
for _length, _point in enumerate(_FAR_ENDS):
    _ENDS[_length, list(_point)] = True
#: (20, 20) points at which the bone to a point begins; both shoulders for the neck.
_NEAR_ENDS = np.zeros((len(POINTS), len(POINTS)), dtype=np.bool_)
for _shoulder, _elbow, _wrist in ARM_POINTS:
    _NEAR_ENDS[_elbow, _shoulder] = _NEAR_ENDS[_wrist, _elbow] = True
    _NEAR_ENDS[[PELVIS, HEAD], _shoulder] = True
    _NEAR_ENDS[_shoulder, [points[0] for points in ARM_POINTS]] = True
    _NEAR_ENDS[_shoulder, [_shoulder, PELVIS]] = False, True
#: (20,) the same point on the other side of the body; a point without a counterpart maps to itself.
_OTHER_SIDE = np.array(
    [POINTS.index(p[:-1] + {"l": "r", "r": "l"}[p[-1]] if p[-2] == "_" else p) for p in POINTS], dtype=np.int64
)
_STEP = 1e-5
#: Standard deviation of a length that restarts [m].
_UNKNOWN_M = 0.1


@njit(cache=True, inner=True)
def validate_frame(filter_: Filter, c: int, now: int, rules: Rules, outliers: Ints, disbelieved: Ints) -> None:
    """Selects the valid rows of a new frame, 4.1.2 and Eq. (58), and the limbs that it shows completely.

    Args:
        filter_: Contains the frame. Receives ``valid`` and ``shows`` of the camera, the ticks at which points and
            lengths last agreed, and the variance of a length that restarts.
        c: Index of the camera.
        now: The tick [ns].
        rules: Settings of the filter.
        outliers: (c,) number of a camera's points that disagree with the filter; those of the frame are added.
        disbelieved: (20,) number of frames of this camera in which a point was not believed; this one is added.
    """
    trusted = np.ones(len(filter_.gate.point_ns), dtype=np.bool_)
    believed = np.zeros(len(filter_.gate.point_ns), dtype=np.bool_)
    if filter_.estimate.started[0]:
        gate, estimate = filter_.gate, filter_.estimate
        whole = _whole(estimate, gate.z[c], gate.disbelieved[c], now, rules)
        judge(gate, filter_.model, c, now, whole, rules)
        d = delay(gate.capture_ns[c], now, rules)
        expected, allowed_m = _gates(estimate, gate.points[c], d, rules.outlier_m)
        agreeing, believed = _agreeing(gate, c, now, whole, expected, allowed_m, rules)
        trusted = (agreeing | believed) & whole & ~filter_.gate.disbelieved[c]
        disbelieved += filter_.gate.disbelieved[c]
        outliers[c] += len(trusted) - np.sum(trusted)
    _validate_rows(filter_.gate, c, trusted, rules.confidence_min)
    for row in range(ROWS if believed.any() else 0):
        if filter_.gate.valid[c, row] and (DEPENDS[row] & believed).any():
            filter_.estimate.row_ns[row] = min(
                filter_.estimate.row_ns[row], now - rules.memory_ns - 1
            )  # lost: it restarts
    confidence, points = filter_.gate.confidence[c], filter_.gate.points[c]
    filter_.gate.trusted[c] = False
    for point in _TESTED:
        if trusted[point] and confidence[point] >= rules.confidence_min and np.isfinite(points[point, 0]):
            filter_.gate.point_ns[point], filter_.gate.trusted[c, point] = now, True
    for limb in range(len(_PLACING)):
        product, agrees = 1.0, True
        for k in range(len(trusted)):
            if _PLACING[limb, k]:
                product *= confidence[k]
                agrees = agrees and trusted[k] and np.isfinite(points[k, 0])
        filter_.gate.shows[c, limb] = agrees and product >= rules.confidence_min


@njit(cache=True, inner=True)
def _validate_rows(gate: Gate, c: int, trusted: Bools, confidence_min: float) -> None:
    """Selects the valid rows, Eq. (58), from the trusted points (20,)."""
    confidence, points = gate.confidence[c], gate.points[c]
    for row in range(ROWS):
        product = 1.0
        agrees = np.isfinite(gate.z[c, row])
        for k in range(len(trusted)):
            if DEPENDS[row, k]:
                product *= confidence[k] if np.isfinite(points[k, 0]) else confidence[NECK]
                agrees = agrees and trusted[k]
        blind = 2 <= row < HEIGHT and gate.z_var[c, row] > _BLIND_STD**2
        gate.valid[c, row] = agrees and not blind and product >= confidence_min


@njit(cache=True, inner=True)
def _agreeing(
    gate: Gate, c: int, now: int, whole: Bools, expected: Floats, allowed_m: Floats, rules: Rules
) -> tuple[Bools, Bools]:
    """Returns the points of a frame (20,) near the a-priori skeleton, and those accepted in spite of their distance.

    A lost point agrees with any position. For each other point the start of its rejection is stored. A point that is
    not ``whole`` (20,), although its bone begins near the filter's estimate, is rejected again in each frame: it is not
    on the limb.

    Args:
        gate: Contains the frame; the starts of rejections are changed.
        c: Index of the camera.
        now: The tick [ns].
        whole: (20,) False for points at the end of a bone of wrong length.
        expected: (20, 3) the a-priori skeleton [m].
        allowed_m: (20,) allowed distances from it [m].
        rules: Settings of the filter.
    """
    points = gate.points[c]
    agreeing, believed = np.ones(len(points), dtype=np.bool_), np.zeros(len(points), dtype=np.bool_)
    shown, there = np.zeros(len(points), dtype=np.bool_), np.zeros(len(points), dtype=np.bool_)
    for k in _TESTED:
        lost = now - gate.point_ns[k] > rules.memory_ns
        agreeing[k] = lost or not distance(points[k], expected[k]) > allowed_m[k]  # or missing
        shown[k] = np.isfinite(points[k, 0]) and gate.confidence[c, k] >= rules.confidence_min
        there[k] = shown[k] and distance(points[k], expected[k]) <= allowed_m[k]
    for k in _TESTED:
        if not shown[k]:
            continue
        other = _OTHER_SIDE[k]
        exchanged = other != k and distance(points[other], expected[k]) <= allowed_m[k]
        if agreeing[k] or exchanged:
            gate.refused_ns[c, k] = NEVER_NS
            continue
        torn = not whole[k] and (there & _NEAR_ENDS[k]).any()
        stays = not torn and distance(points[k], gate.refused_at[c, k]) <= rules.outlier_m
        if not stays or gate.refused_ns[c, k] <= gate.point_ns[k]:
            gate.refused_ns[c, k] = now
        gate.refused_at[c, k] = points[k]
        believed[k] = now - gate.refused_ns[c, k] >= rules.relearn_ns
    return agreeing, believed


@njit(cache=True, inner=True)
def _gates(estimate: StateEstimate, points: Floats, d: float, outlier_m: float) -> tuple[Floats, Floats]:
    """Returns the expected points in a camera's frame, (20, 3) [m], and their allowed errors, (20,) [m].

    The allowed error is ``outlier_m`` plus three standard deviations of the prediction towards the point, propagated
    from each joint by the forward kinematics. Deviations across this direction are not added, as exchanged left and
    right sides would pass.
    """
    p, lengths = extrapolate_back(estimate.mean, d), estimate.lengths
    expected, moved = np.empty_like(points), np.empty_like(points)
    skeleton_row(p, lengths, expected)
    towards, variance = np.zeros_like(expected), np.zeros(len(expected))
    for k in _TESTED:
        apart = distance(points[k], expected[k])
        if apart > 0.0:
            towards[k] = (points[k] - expected[k]) / apart
    for j in range(DOF):
        p[j] += _STEP
        skeleton_row(p, lengths, moved)
        p[j] -= _STEP
        for k in _TESTED:
            along = 0.0
            for axis in range(3):
                along += (moved[k, axis] - expected[k, axis]) / _STEP * towards[k, axis]
            variance[k] += along**2 * estimate.cov[j, 0, 0]
    for k in _TESTED:
        if k != PELVIS:
            variance[k] += estimate.lengths_var[0] + estimate.lengths_var[1 if k == HEAD else 2]
            variance[k] += 0.0 if k == HEAD else estimate.lengths_var[3:].sum()
    return expected, outlier_m + 3.0 * np.sqrt(variance)


@njit(cache=True, inner=True)
def _whole(estimate: StateEstimate, z: Floats, disbelieved: Bools, now: int, rules: Rules) -> Bools:
    """Returns the points of a frame (20,) except those at the far end of a bone of wrong length.

    Bone lengths are constant, which distinguishes a jumping marker from a moving limb. A length that no camera has
    confirmed for a long time was learnt wrong: it restarts. Points that are not believed confirm nothing.
    """
    whole = np.ones(len(disbelieved), dtype=np.bool_)
    for k in range(len(estimate.lengths)):
        apart = abs(z[DOF + k] - estimate.lengths[k])
        if not np.isfinite(apart):
            continue
        if estimate.bone_ns[k] >= 0 and now - estimate.bone_ns[k] > rules.bone_memory_ns:
            estimate.lengths_var[k] = _UNKNOWN_M**2
        if apart > rules.bone_m + 3.0 * np.sqrt(estimate.lengths_var[k]):
            whole &= ~_ENDS[k]
        elif not disbelieved.any() or not (_ENDS[k] & disbelieved).any():
            estimate.bone_ns[k] = now
    return whole
