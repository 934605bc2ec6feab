"""Volumes of a body that counts by its points alone, as it has only just been seen and has no filtered state yet.

A limb is the hull of the points that the newest frame shows of it, or of all points of the body if it shows none, with
the limb's radius, a hand's length for the lower arms, and the way that people cover since the frame's capture until the
end of the horizon, at ``SPEED_M_PER_S``. The lower body reaches down to the floor. Limbs that no point shows may be
further out: the volume is only as good as the points, and holds until the filter knows the person.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.human.prediction.sound_reach import THIGH_M
from hrcreplay.records import BODY, FLOOR_Z_M, POINTS, Bools, Floats, HumanStates, SweptVolumes
from hrcreplay.settings.sections import Prediction

#: Speed at which a body's points may move: that of a hand, ISO 13855 [m/s].
SPEED_M_PER_S = 2.0

#: Points of each limb of BODY.
_OF_LIMB = {
    "HD": ("neck", "head"),
    "THX": ("pelvis", "chest", "neck", "shoulder_r", "shoulder_l"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "wrist_r", "hand_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "wrist_l", "hand_l"),
    "LEGS": ("pelvis", *(f"{part}_{side}" for part in ("hip", "knee", "ankle", "foot") for side in "rl")),
}
_ROWS = {limb: np.array([POINTS.index(name) for name in names]) for limb, names in _OF_LIMB.items()}


def count_by_points(states: HumanStates) -> Bools:
    """(n,) True for rows of bodies that count by their points alone."""
    return np.isnan(states.p[:, 0]) & np.isfinite(states.points_m).any(axis=(1, 2))


def around_points(
    volumes: SweptVolumes, states: HumanStates, prediction: Prediction, limbs_m: Floats, horizon_s: float
) -> SweptVolumes:
    """Puts volumes around the points of the bodies that count by them; the other rows stay as they are.

    Args:
        volumes: Volumes of the same rows.
        states: The fused people.
        prediction: Length of a hand, and latency.
        limbs_m: (6,) radii of LIMBS [m].
        horizon_s: Time after each tick until which the volumes hold [s].
    """
    rows = count_by_points(states)
    each = len(volumes.limbs)
    parts = np.split(volumes.vertices_m, volumes.offsets[1:-1])
    radius_m = volumes.radius_m.copy()
    thick_m = np.append(limbs_m, THIGH_M)
    for i in np.flatnonzero(rows).tolist():
        shown = states.points_m[i]
        span_s = float(states.frame_age_s[i]) + horizon_s + prediction.latency_s
        for k, limb in enumerate(volumes.limbs):
            parts[i * each + k] = _points_of(limb, shown)
            hand_m = prediction.hand_m if limb in ("LRA", "LLA") else 0.0
            radius_m[i, k] = thick_m[BODY.index(limb)] + hand_m + SPEED_M_PER_S * span_s
    offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum([len(part) for part in parts])])
    return SweptVolumes(volumes.t_ns, offsets, np.concatenate(parts), radius_m, volumes.limbs, volumes.method)


def _points_of(limb: str, shown_m: Floats) -> Floats:
    """(m, 3) the shown points of a limb, else of the whole body (20, 3), NaN where not shown [m]."""
    known: Bools = np.asarray(np.isfinite(shown_m).all(axis=1))
    own = _ROWS[limb][known[_ROWS[limb]]]
    points = shown_m[own] if len(own) else shown_m[known]
    if limb != "LEGS":
        return np.asarray(points)
    below = points.copy()
    below[:, 2] = FLOOR_Z_M
    return np.concatenate([points, below])
