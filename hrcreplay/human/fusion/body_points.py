"""Offsets of the body's points from the model, in the torso's frame, and attachment of hands and legs (docs/paper.md).

People bend sideways, twist and lift their shoulders; the thirteen joints of the model do not. The offsets of shoulders,
head, elbows and wrists from the model are running means. Hands and legs have no joints: they keep their last observed
position relative to the wrist, or to the pelvis over the floor. A hidden foot with a visible ankle keeps its last
observed offset from the ankle, or points ahead, and turns with the body: its error is at most a foot's length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.vectors import distance
from hrcreplay.human.fusion.disbelief import is_broken
from hrcreplay.human.fusion.kalman import SHOWN_NS, Filter, ModelResidual, Rules, StateEstimate
from hrcreplay.human.model import ARM_POINTS, HANDS, HEAD, LEG_POINTS, NECK, PELVIS, skeleton_row, torso_rotation
from hrcreplay.kernels import njit
from hrcreplay.records import BODY, LIMBS, POINTS, Bools, Floats, Ints

#: Maximum distance of a point of a leg from the pelvis: toes of a tall man's straight leg [m].
REACH_M = 1.2
#: Maximum distance of a hand from its wrist [m].
_HAND_M = 0.3
#: Distance of a foot's tip from its ankle, along the body's heading, until a camera has seen it: about a man's [m].
FOOT_M = (0.2, 0.0, -0.06)
#: Distance below which two places of a point are the same but for the noise of a tracker [m].
ALIKE_M = 0.05
#: Least time in which a leg's point covers a way, so that a camera's rate matters little [ns], and the time over which
#: the mean of the ways' squares is taken [s].
_WAY_NS, _SWAY_S = 25_000_000, 0.5
#: Maximum number of observations in the mean length of a leg's bone.
_BONES_MOST = 600

(_SHOULDER_R, _ELBOW_R, _WRIST_R), (_SHOULDER_L, _ELBOW_L, _WRIST_L) = ARM_POINTS
_LEGS = BODY.index("LEGS")
_SHOULDERS = np.array([_SHOULDER_R, _SHOULDER_L])
#: Points with an offset from the model, and the limb of LIMBS that must be visible for each.
_BESIDE = np.array([HEAD, _SHOULDER_R, _SHOULDER_L, _ELBOW_R, _WRIST_R, _ELBOW_L, _WRIST_L])
_OF_LIMB = np.array([LIMBS.index(limb) for limb in ("HD", "THX", "THX", "URA", "LRA", "ULA", "LLA")])
#: Wrists of HANDS, and the limbs that contain them.
_WRISTS = np.array([_WRIST_R, _WRIST_L])
_LOWER_ARMS = np.array([LIMBS.index("LRA"), LIMBS.index("LLA")])
#: Points of the model but the neck, points attached to others, and all points that a camera shows on the body.
_MODELLED = np.array([PELVIS, *_BESIDE])
_ATTACHED = np.concatenate([HANDS, LEG_POINTS])
_SHOWABLE = np.concatenate([_MODELLED, np.array([NECK]), _ATTACHED])
#: Right, left.
_ANKLES, _FEET = (np.array([POINTS.index(f"{part}_{side}") for side in "rl"]) for part in ("ankle", "foot"))


class Carried(NamedTuple):
    """Body points as a camera observed them last, from what they are carried with, and whether its frame is newer."""

    places: Floats  #: (20, 3) [m]
    seen_ns: Ints  #: (20,) capture of that observation
    disbelieved: Bools  #: (20,) True for points that the frame shows wrong
    capture_ns: int  #: of the frame


@njit(cache=True, inner=True)
def shift(offset: Floats, p: Floats, points: Floats) -> None:
    """Adds the recent offsets (20, 3) to the model's points (20, 3) of a posture p (13,) [m]."""
    R = torso_rotation(p[2], p[3])
    for k in _BESIDE:
        for i in range(3):
            for j in range(3):
                points[k, i] += R[i, j] * offset[k, j]
    for i in range(3):
        points[NECK, i] = 0.5 * (points[_SHOULDERS[0], i] + points[_SHOULDERS[1], i])


@njit(cache=True, inner=True)
def learn(
    filter_: Filter, c: int, now: int, shown: Bools, p: Floats, model: Floats, shifted: Floats, rules: Rules
) -> int:
    """Updates the offsets by the points in a camera's frame; returns the number of leg points on bones of wrong length.

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
    gate, residual = filter_.gate, filter_.model
    carried = Carried(residual.carried[c], residual.carried_ns[c], gate.disbelieved[c], gate.capture_ns[c])
    points, seen = gate.points[c], gate.confidence[c] >= rules.confidence_min
    _carry_body(carried, gate.trusted[c], points, model)
    for n, k in enumerate(HANDS):
        if gate.shows[c, _LOWER_ARMS[n]] and seen[k] and distance(points[k], points[_WRISTS[n]]) <= _HAND_M:
            _carry(carried, k, points[k] - shifted[_WRISTS[n]])
    if filter_.gate.valid[c, :2].all():
        return _learn_legs(residual, c, now, carried, points, seen, model[PELVIS], p[2])
    return 0


@njit(cache=True, inner=True)
def _carry_body(carried: Carried, trusted: Bools, points: Floats, model: Floats) -> None:
    """Stores where a camera shows the points of the model, from the model (20, 3); the neck between the shoulders."""
    for k in _MODELLED:
        if trusted[k]:
            _carry(carried, k, points[k] - model[k])
    right, left = _SHOULDER_R, _SHOULDER_L
    if trusted[right] and trusted[left]:
        _carry(carried, NECK, 0.5 * (points[right] + points[left]) - model[NECK])


@njit(cache=True, inner=True)
def _learn_legs(
    residual: ModelResidual,
    c: int,
    now: int,
    carried: Carried,
    points: Floats,
    seen: Bools,
    pelvis: Floats,
    heading: float,
) -> int:
    """Updates the legs below a pelvis by a camera's frame; returns the number of points left out.

    Args:
        residual: Its mean lengths of the legs' bones and its feet are changed.
        c: Index of the camera.
        now: The tick [ns].
        carried: The points that the camera observed; changed.
        points: (20, 3) of its frame [m].
        seen: (20,) True for points with enough confidence.
        pelvis: (3,) [m].
        heading: Of the body [rad].
    """
    near = np.zeros(len(LEG_POINTS), np.bool_)
    for n, k in enumerate(LEG_POINTS):
        near[n] = seen[k] and distance(points[k], pelvis) <= REACH_M
    found = near.sum()
    for side in range(2):
        for bone in range(2):
            _compare_bone(residual, c, now, points, side, bone, near)
    for n, k in enumerate(LEG_POINTS):
        if near[n]:
            from_below = points[k].copy()
            from_below[:2] -= pelvis[:2]
            if not carried.disbelieved[k]:
                _sway(residual, c, n, from_below, carried.capture_ns)
            _carry(carried, k, from_below)
    for side in range(2):
        if near[4 + side] and near[6 + side]:
            residual.foot[side] = _turned(points[_FEET[side]] - points[_ANKLES[side]], -heading)
    return found - near.sum()


@njit(cache=True, inner=True)
def _sway(model: ModelResidual, c: int, n: int, from_below: Floats, capture_ns: int) -> None:
    """Adds the way of a leg's point since the camera showed it before.

    Args:
        model: Its ways are changed.
        c: Index of the camera.
        n: Index into LEG_POINTS.
        from_below: (3,) the point, from below the pelvis [m].
        capture_ns: Of the frame.
    """
    since = capture_ns - model.sway_ns[c, n]
    if since < _WAY_NS:
        return
    if since <= SHOWN_NS:
        share = 1.0 - np.exp(-since * 1e-9 / _SWAY_S)
        model.sway[c, n] += share * (distance(from_below, model.sway_from[c, n]) ** 2 - model.sway[c, n])
    model.sway_from[c, n], model.sway_ns[c, n] = from_below, capture_ns


@njit(inner=True, inline="always")  # passing the filter on would take longer than this
def legs_sway(model: ModelResidual, now: int) -> float:
    """Root mean square of the recent ways of the legs' points that cameras show; NaN if none does [m]."""
    total, count = 0.0, 0
    for c in range(len(model.sway)):
        for n in range(len(LEG_POINTS)):
            if now - model.sway_ns[c, n] <= SHOWN_NS + _WAY_NS:
                total, count = total + model.sway[c, n], count + 1
    return np.sqrt(total / count) if count > 0 else np.nan


@njit(cache=True, inner=True)
def _compare_bone(model: ModelResidual, c: int, now: int, points: Floats, side: int, bone: int, near: Bools) -> None:
    """Compares a thigh (bone 0) or shank (1) with the mean of the camera, and adds it or rules out what is below.

    A bone keeps its length; a skeleton that falls apart before the tracker loses it does not. A new length that stays
    may be another opinion of the same leg: it is not learnt, as the old one may come back, but believed, unless another
    camera shows the leg all the while (``disbelief``).

    Args:
        model: Its mean lengths are changed.
        c: Index of the camera.
        now: The tick [ns].
        points: (20, 3) of the frame [m].
        side: 0: right, 1: left.
        bone: 0: thigh, 1: shank.
        near: (8,) True for the points of LEG_POINTS that count; those below a bone of another length are set to False.
    """
    upper, lower = 2 * bone + side, 2 * bone + 2 + side
    if not (near[upper] and near[lower]):
        return
    own = 2 * bone + side  # each leg for itself: a whole one does not vouch for the other
    if is_broken(points, model.leg_bones[c], model.leg_bones_seen[c], own):
        if now - model.leg_bones_ns[c, own] <= SHOWN_NS:  # later it is no skeleton that falls apart
            near[lower::2] = False
        return
    length = distance(points[LEG_POINTS[upper]], points[LEG_POINTS[lower]])
    seen = min(model.leg_bones_seen[c, own] + 1, _BONES_MOST)
    model.leg_bones[c, own] += (length - model.leg_bones[c, own]) / seen
    model.leg_bones_seen[c, own], model.leg_bones_ns[c, own] = seen, now


@njit(cache=True, inner=True)
def _carry(carried: Carried, k: int, relative: Floats) -> None:
    if carried.capture_ns >= carried.seen_ns[k] and not carried.disbelieved[k]:
        carried.places[k], carried.seen_ns[k] = relative, carried.capture_ns


@njit(cache=True, inner=True)
def distance_shown(point: Floats, start: Floats, along: Floats) -> float:
    """Distance of a point in a camera's frame from where the volumes expect it [m].

    That is the line between the model with the recent offsets and where this camera showed the point before, if the two
    are apart: both are in the volumes (``place``).

    Args:
        point: (3,) in the frame [m].
        start: (3,) of the model with the recent offsets [m].
        along: (3,) from there to where the camera showed it before; 0 if it has not shown it recently [m].
    """
    squares, towards = 0.0, 0.0
    for i in range(3):
        squares += along[i] ** 2
        towards += (point[i] - start[i]) * along[i]
    apart = np.sqrt(squares)
    if apart <= ALIKE_M:
        return distance(point, start)
    share, nearest = max(0.0, min(1.0 - ALIKE_M / apart, towards / apart**2)), np.empty(3)
    for i in range(3):
        nearest[i] = start[i] + share * along[i]
    return distance(point, nearest)


@njit(inner=True, inline="always")  # passing the filter on would take longer than this
def place(estimate: StateEstimate, model: ModelResidual, points: Floats, camera_points: Floats) -> None:
    """Writes the points at the tick; NaN for hands and legs that no camera has observed recently.

    Args:
        estimate: After the tick.
        model: The same.
        points: (20, 3) receives the points, world [m].
        camera_points: (c, 20, 3) receives the recent points of each camera, world [m]; while the torso is seen, only
            those further than ``ALIKE_M`` from ``points``, and but for legs that much nearer to them, so that volumes
            do not jump.
    """
    p = estimate.mean[:, 0].copy()
    skeleton_row(p, estimate.lengths, points)
    base = points.copy()
    shift(model.offset, p, points)
    for n, k in enumerate(HANDS):
        base[k] = points[_WRISTS[n]]
    for k in LEG_POINTS:
        base[k, :2], base[k, 2] = points[PELVIS, :2], 0.0
    now = estimate.tick_ns[0]
    for k in _ATTACHED:
        c = model.carried_ns[:, k].argmax()
        if now - model.carried_ns[c, k] <= SHOWN_NS:
            points[k] = base[k] + model.carried[c, k]
    for side in range(2):
        if np.isnan(points[_FEET[side], 0]):
            points[_FEET[side]] = points[_ANKLES[side]] + _turned(model.foot[side], p[2])
    sees_torso = now - estimate.row_ns[:4].min() <= SHOWN_NS
    for camera in range(len(camera_points)):
        recent = now - model.carried_ns[camera] <= SHOWN_NS
        _place_shown(recent, model.carried[camera], base, points, sees_torso, camera_points[camera])


@njit(cache=True, inner=True)
def _place_shown(
    recent: Bools, carried: Floats, base: Floats, points: Floats, sees_torso: bool, camera_points: Floats
) -> None:
    """Writes the points of a camera.

    Args:
        recent: (20,) True for points that it has shown recently.
        carried: (20, 3) these, from ``base`` [m].
        base: (20, 3) what they are carried with [m].
        points: (20, 3) of the person [m].
        sees_torso: Whether a camera has seen the torso recently.
        camera_points: (20, 3) receives them [m].
    """
    there = np.empty(3)
    for k in _SHOWABLE:
        if not recent[k]:
            continue
        for i in range(3):
            there[i] = base[k, i] + carried[k, i]
        apart = distance(there, points[k])
        if not sees_torso or np.isnan(apart) or (apart > ALIKE_M and k in LEG_POINTS):
            camera_points[k] = there
        elif apart > ALIKE_M:
            for i in range(3):
                camera_points[k, i] = there[i] + (points[k, i] - there[i]) * (ALIKE_M / apart)


@njit(cache=True, inner=True)
def _turned(vector: Floats, theta: float) -> Floats:
    """Rotates a vector (3,) about the vertical."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]])
