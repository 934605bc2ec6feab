"""Volumes around the points that cameras show, of bodies whose joints are not known.

A body that has only just been seen counts by its points alone, as it has no filtered state yet. A limb is the hull of
the points that the newest frame shows of it, or of all points of the body if it shows none, with the limb's radius, a
hand's length for the lower arms, and the way that people cover since the frame's capture until the end of the horizon,
at ``HAND_M_PER_S``. The lower body reaches down to the floor. Limbs that no point shows may be further out: the volume
is only as good as the points, and holds until the filter knows the person.

If the torso of a person is out of sight, the filter brings it to rest, and after a while its joints may be anywhere
within their limits, and with them the whole body. But every limb is attached to every other one: it lies within the
bones between them from any point that is still shown, and that point moves no faster than people do. A polytope around
the intersection of these balls, or of them and the volume so far, replaces the latter where it is smaller.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.geometry.convex_hull import CORNERS, DIRECTIONS, around
from hrcreplay.human.prediction.sound_reach import BONE_M, THIGH_M
from hrcreplay.human.prediction.velocity_tube import HAND_M_PER_S, PEOPLES_SPEEDS
from hrcreplay.records import BODY, FLOOR_Z_M, LENGTHS, POINTS, Bools, Floats, HumanStates, Ints, SweptVolumes
from hrcreplay.settings.sections import Prediction

#: Maximum age of a shown point; once the torso is unseen for longer, all points that cameras show are known [s].
SHOWN_S = 0.2
#: Standard deviations of the lengths of bones that count.
_LENGTHS_OFF = 2.0

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
    volumes: SweptVolumes, states: HumanStates, prediction: Prediction, limbs_m: Floats, horizon_s: Floats
) -> SweptVolumes:
    """Puts volumes around the points of the bodies that count by them; the other rows stay as they are.

    Args:
        volumes: Volumes of the same rows.
        states: The fused people.
        prediction: Length of a hand, and latency.
        limbs_m: (6,) radii of LIMBS [m].
        horizon_s: (n,) time after its tick until which each row holds [s].
    """
    rows = count_by_points(states)
    each = len(volumes.limbs)
    parts = np.split(volumes.vertices_m, volumes.offsets[1:-1])
    radius_m = volumes.radius_m.copy()
    thick_m = np.append(limbs_m, THIGH_M)
    for i in np.flatnonzero(rows).tolist():
        shown = states.points_m[i]
        span_s = float(states.frame_age_s[i]) + float(horizon_s[i]) + prediction.latency_s
        for k, limb in enumerate(volumes.limbs):
            parts[i * each + k] = _points_of(limb, shown)
            hand_m = prediction.hand_m if limb in ("LRA", "LLA") else 0.0
            radius_m[i, k] = thick_m[BODY.index(limb)] + hand_m + HAND_M_PER_S * span_s
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


#: Bones between POINTS, and their lengths: one of LENGTHS, or a number [m]; two of LENGTHS stand at a right angle.
_BONES: tuple[tuple[str, str, str | tuple[str, ...] | float], ...] = (
    ("pelvis", "neck", "pi_torso"),
    ("neck", "head", "pi_head"),
    *(("neck", f"shoulder_{side}", "pi_half_shoulder") for side in "rl"),
    *(("pelvis", f"shoulder_{side}", ("pi_torso", "pi_half_shoulder")) for side in "rl"),
    *((f"shoulder_{side}", f"elbow_{side}", f"pi_upper_arm_{side}") for side in "rl"),
    *((f"elbow_{side}", f"wrist_{side}", f"pi_forearm_{side}") for side in "rl"),
    *(("pelvis", f"hip_{side}", 0.5 * BONE_M) for side in "rl"),
    *(
        (f"{upper}_{side}", f"{lower}_{side}", BONE_M)
        for upper, lower in (("hip", "knee"), ("knee", "ankle"))
        for side in "rl"
    ),
    *((f"ankle_{side}", f"foot_{side}", 0.5 * BONE_M) for side in "rl"),
)
_STARTS, _TIPS = (np.array([POINTS.index(bone[end]) for bone in _BONES]) for end in range(2))
_PELVIS, _LEGS = POINTS.index("pelvis"), BODY.index("LEGS")
#: Points of each limb of BODY that its volume must contain; of the legs the pelvis, which they are below.
_CONTAINED = _ROWS | {
    "THX": np.array([POINTS.index(name) for name in ("pelvis", "neck", "shoulder_r", "shoulder_l")]),
    "LRA": _ROWS["LRA"][:2],
    "LLA": _ROWS["LLA"][:2],
    "LEGS": np.array([_PELVIS]),
}


def bound_by_seen(
    volumes: SweptVolumes, states: HumanStates, radii_m: Floats, rows: Ints, prediction: Prediction, horizon_s: Floats
) -> SweptVolumes:
    """Cuts volumes of people whose torso is out of sight to what the points shown of them allow.

    Args:
        volumes: Volumes of the same rows, from the joints or from tubes.
        states: The fused people.
        radii_m: (n, limbs) radii of volumes from the joints [m].
        rows: Rows of such people.
        prediction: Length of a hand, and latency.
        horizon_s: (n,) time after its tick until which each row holds [s].
    """
    each, parts = len(volumes.limbs), np.split(volumes.vertices_m, volumes.offsets[1:-1])
    of_cameras, radius_m = states.camera_points_m, volumes.radius_m.copy()
    if of_cameras is None:
        return volumes
    for i in rows.tolist():
        cameras, seen = np.nonzero(np.isfinite(of_cameras[i]).all(axis=2))
        if not len(seen):
            continue
        span_s = min(float(states.frame_age_s[i]), SHOWN_S) + float(horizon_s[i]) + prediction.latency_s
        apart_m = _along_bones(states.lengths_m[i] + _LENGTHS_OFF * states.lengths_std_m[i])[:, seen]
        for k, limb in enumerate(volumes.limbs):
            own = i * each + k
            hand_m = prediction.hand_m if limb in ("LRA", "LLA") else 0.0
            further_m = hand_m + float(PEOPLES_SPEEDS[BODY.index(limb)]) * span_s
            plain, ball_m, own_ball_m = parts[own], float(radii_m[i, k]), float(radius_m[i, k])
            top_m = plain[:, 2].max() if np.isfinite(plain).all() else np.inf
            extents = [_reach(limb, of_cameras[i][cameras, seen], seen, apart_m, further_m, top_m)]
            if np.isfinite(plain).all():  # inside that volume, too, but for the ball that both have
                more_m = max(0.0, own_ball_m - ball_m)
                extents.append(np.minimum(extents[0], (plain @ DIRECTIONS.T).max(axis=0) + more_m))
            least_m3 = _box_m3(plain, own_ball_m)
            for far in extents:
                found = np.empty((CORNERS, 3))
                found = found[: around(far, found)]
                if (size_m3 := _box_m3(found, ball_m)) < least_m3:
                    parts[own], radius_m[i, k], least_m3 = found, ball_m, size_m3
    offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum([len(part) for part in parts])])
    return SweptVolumes(volumes.t_ns, offsets, np.concatenate(parts), radius_m, volumes.limbs, volumes.method)


def _reach(limb: str, shown: Floats, seen: Ints, apart_m: Floats, further_m: float, top_m: float) -> Floats:
    """(d,) extents along ``DIRECTIONS`` of where a limb may be, before its ball [m].

    Args:
        limb: One of BODY.
        shown: (m, 3) points shown [m].
        seen: (m,) which of POINTS they are.
        apart_m: (20, m) distance of every point from them along the bones [m].
        further_m: What is added to each [m].
        top_m: Maximum height of the pelvis [m].
    """
    along, found = DIRECTIONS @ shown.T, np.full(len(DIRECTIONS), -np.inf)
    for point in _CONTAINED[limb]:
        found = np.maximum(found, (along + apart_m[point]).min(axis=1))
    if limb == BODY[_LEGS]:  # below the pelvis down to the floor, and the legs that are shown
        far_m, flat = apart_m[_PELVIS] + further_m, DIRECTIONS * [1.0, 1.0, 0.0]
        size = np.linalg.norm(flat, axis=1, keepdims=True)
        heights = DIRECTIONS[:, 2:] * [FLOOR_Z_M, min(top_m, float((shown[:, 2] + far_m).min()))]
        found = (flat @ shown.T + size * far_m).min(axis=1) + heights.max(axis=1) - further_m
        legs = np.isin(seen, _ROWS[limb])
        found = np.maximum(found, along[:, legs].max(axis=1, initial=-np.inf))
    return np.asarray(found + further_m)


def _along_bones(lengths_m: Floats) -> Floats:
    """(20, 20) distance between POINTS along the bones, for lengths (7,) [m]; inf for points without one."""
    found = np.full((len(POINTS), len(POINTS)), np.inf)
    np.fill_diagonal(found, 0.0)
    found[_STARTS, _TIPS] = found[_TIPS, _STARTS] = [_length_m(bone, lengths_m) for _, _, bone in _BONES]
    for k in range(len(POINTS)):
        found = np.minimum(found, found[:, k : k + 1] + found[k])
    return found


def _length_m(bone: str | tuple[str, ...] | float, lengths_m: Floats) -> float:
    """Length of one of ``_BONES`` for lengths (7,) [m]."""
    if isinstance(bone, float):
        return bone
    names = (bone,) if isinstance(bone, str) else bone
    return float(np.linalg.norm(lengths_m[[LENGTHS.index(name) for name in names]]))


def _box_m3(points: Floats, radius_m: float) -> float:
    """Volume of the box around some points with a ball [m^3]; inf if they are unknown."""
    size = float(np.prod(np.ptp(points, axis=0) + 2.0 * radius_m))
    return size if np.isfinite(size) else np.inf
