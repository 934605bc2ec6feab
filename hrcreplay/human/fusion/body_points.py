"""Offsets of the body's points from the model, in the torso's frame, and attachment of hands and legs (docs/paper.md).

People bend sideways, twist and lift their shoulders; the thirteen joints of the model do not. The offsets of shoulders,
head, elbows and wrists from the model are running means. Hands and legs have no joints: they keep their last observed
position relative to the wrist, or to the pelvis over the floor. A hidden foot with a visible ankle keeps its last
observed offset from the ankle, or points ahead, and turns with the body: its error is at most a foot's length.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.human.fusion.gating import distance
from hrcreplay.human.fusion.kalman import Filter, Rules
from hrcreplay.human.model import ARM_POINTS, HANDS, HEAD, LEG_POINTS, NECK, PELVIS, skeleton_row, torso_rotation
from hrcreplay.kernels import njit
from hrcreplay.records import BODY, LIMBS, POINTS, Bools, Floats

#: Maximum distance of a point of a leg from the pelvis: toes of a tall man's straight leg [m].
REACH_M = 1.2
#: Maximum distance of a hand from its wrist [m].
_HAND_M = 0.3
#: Distance of a foot's tip from its ankle, along the body's heading, until a camera has seen it: about a man's [m].
FOOT_M = (0.2, 0.0, -0.06)
#: Maximum age of the observation of a hand or a leg, a few frames of any camera; an older one is unknown [ns].
_SHOWN_NS = 200_000_000

(_SHOULDER_R, _ELBOW_R, _WRIST_R), (_SHOULDER_L, _ELBOW_L, _WRIST_L) = ARM_POINTS
_LEGS = BODY.index("LEGS")
_SHOULDERS = np.array([_SHOULDER_R, _SHOULDER_L])
#: Points with an offset from the model, and the limb of LIMBS that must be visible for each.
_BESIDE = np.array([HEAD, _SHOULDER_R, _SHOULDER_L, _ELBOW_R, _WRIST_R, _ELBOW_L, _WRIST_L])
_OF_LIMB = np.array([LIMBS.index(limb) for limb in ("HD", "THX", "THX", "URA", "LRA", "ULA", "LLA")])
#: Wrists of HANDS, and the limbs that contain them.
_WRISTS = np.array([_WRIST_R, _WRIST_L])
_LOWER_ARMS = np.array([LIMBS.index("LRA"), LIMBS.index("LLA")])
#: Right, left.
_ANKLES, _FEET = (np.array([POINTS.index(f"{part}_{side}") for side in "rl"]) for part in ("ankle", "foot"))


@njit(cache=True, inner=True)
def shift(filter_: Filter, p: Floats, points: Floats) -> None:
    """Adds the recent offsets to the model's points (20, 3) of a posture p (13,) [m]."""
    R = torso_rotation(p[2], p[3])
    for k in _BESIDE:
        for i in range(3):
            for j in range(3):
                points[k, i] += R[i, j] * filter_.model.offset[k, j]
    for i in range(3):
        points[NECK, i] = 0.5 * (points[_SHOULDERS[0], i] + points[_SHOULDERS[1], i])


@njit(cache=True, inner=True)
def learn(
    filter_: Filter, c: int, now: int, shown: Bools, p: Floats, model: Floats, shifted: Floats, rules: Rules
) -> None:
    """Updates the offsets by the points in a camera's frame.

    Args:
        filter_: Contains the frame; its offsets and observed positions are changed.
        c: Index of the camera.
        now: The tick [ns].
        shown: (7,) the limbs of BODY in the frame, for a person that the filter has found.
        p: (13,) the posture at the capture time.
        model: (20, 3) the model's points there [m].
        shifted: (20, 3) the model's points with the recent offsets [m].
        rules: Settings of the filter.
    """
    R = torso_rotation(p[2], p[3])
    for n, k in enumerate(_BESIDE):
        if not shown[_OF_LIMB[n]]:
            continue
        age = min(now - filter_.model.offset_ns[k], rules.memory_ns) * 1e-9  # a point unseen for longer is lost anyway
        weight = np.exp(-age / rules.offset_memory_s) * filter_.model.offset_weight[k] + 1.0
        for j in range(3):
            beside = 0.0
            for i in range(3):
                beside += R[i, j] * (filter_.gate.points[c, k, i] - model[k, i])
            filter_.model.offset[k, j] += (beside - filter_.model.offset[k, j]) / weight
        filter_.model.offset_weight[k], filter_.model.offset_ns[k] = weight, now
    for n, k in enumerate(HANDS):
        if shown[_LOWER_ARMS[n]] and _near(filter_, c, k, filter_.gate.points[c, _WRISTS[n]], _HAND_M, rules):
            _carry(filter_, c, k, filter_.gate.points[c, k] - shifted[_WRISTS[n]])
    if shown[_LEGS]:
        _learn_legs(filter_, c, model[PELVIS], p[2], rules)


@njit(cache=True, inner=True)
def _learn_legs(filter_: Filter, c: int, pelvis: Floats, heading: float, rules: Rules) -> None:
    """Updates the legs below a pelvis (3,) by a camera's frame [m]."""
    for k in LEG_POINTS:
        if _near(filter_, c, k, pelvis, REACH_M, rules):
            from_below = filter_.gate.points[c, k].copy()
            from_below[:2] -= pelvis[:2]
            _carry(filter_, c, k, from_below)
    for side in range(2):
        ankle, foot = _ANKLES[side], _FEET[side]
        if _near(filter_, c, ankle, pelvis, REACH_M, rules) and _near(filter_, c, foot, pelvis, REACH_M, rules):
            filter_.model.foot[side] = _turned(filter_.gate.points[c, foot] - filter_.gate.points[c, ankle], -heading)


@njit(cache=True, inner=True)
def _near(filter_: Filter, c: int, k: int, place: Floats, most: float, rules: Rules) -> bool:
    """Returns True if a camera shows a point with enough confidence within ``most`` [m] of a place."""
    shown = filter_.gate.confidence[c, k] >= rules.confidence_min
    return bool(shown and distance(filter_.gate.points[c, k], place) <= most)


@njit(cache=True, inner=True)
def _carry(filter_: Filter, c: int, k: int, relative: Floats) -> None:
    if filter_.gate.capture_ns[c] >= filter_.model.carried_ns[k]:
        filter_.model.carried[k], filter_.model.carried_ns[k] = relative, filter_.gate.capture_ns[c]


@njit(cache=True, inner=True)
def place(filter_: Filter, p: Floats, points: Floats) -> None:
    """Writes the points at the tick; NaN for hands and legs that no camera has observed recently.

    Args:
        filter_: After the tick.
        p: (13,) the posture [m, m, rad..., m].
        points: (20, 3) receives the points, world [m].
    """
    skeleton_row(p, filter_.estimate.lengths, points)
    shift(filter_, p, points)
    now = filter_.estimate.tick_ns[0]
    for n, k in enumerate(HANDS):
        if now - filter_.model.carried_ns[k] <= _SHOWN_NS:
            points[k] = points[_WRISTS[n]] + filter_.model.carried[k]
    for k in LEG_POINTS:
        if now - filter_.model.carried_ns[k] <= _SHOWN_NS:
            points[k] = filter_.model.carried[k]
            points[k, :2] += points[PELVIS, :2]
    for side in range(2):
        if np.isnan(points[_FEET[side], 0]):
            points[_FEET[side]] = points[_ANKLES[side]] + _turned(filter_.model.foot[side], p[2])


@njit(cache=True, inner=True)
def _turned(vector: Floats, theta: float) -> Floats:
    """Rotates a vector (3,) about the vertical."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]])
