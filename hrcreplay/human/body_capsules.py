"""The body as capsules around the lines between its points: what a robot would touch, not what a person can reach."""

from __future__ import annotations

import numpy as np

from hrcreplay.records import LIMBS, POINTS, Floats, Ints
from hrcreplay.settings.sections import Occupancy

#: Thighs and shanks, of which the model of Eq. (37) knows nothing: there only where hip, knee and ankle were recorded.
LEG_PARTS = ("THIGH_R", "SHANK_R", "THIGH_L", "SHANK_L")
#: Parts of a recorded body.
PARTS = (*LIMBS, *LEG_PARTS)
_ENDS = {
    "HD": ("neck", "head"),
    "THX": ("pelvis", "neck"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "wrist_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "wrist_l"),
    "THIGH_R": ("hip_r", "knee_r"),
    "SHANK_R": ("knee_r", "ankle_r"),
    "THIGH_L": ("hip_l", "knee_l"),
    "SHANK_L": ("knee_l", "ankle_l"),
}
_FROM, _TO = (np.array([POINTS.index(_ENDS[part][end]) for part in PARTS]) for end in (0, 1))
_FOREARMS = np.array([PARTS.index("LRA"), PARTS.index("LLA")])


def part_axes(points_m: Floats, hand_m: float) -> Floats:
    """Axes of the capsules of a body's parts.

    Args:
        points_m: (n, 20, 3) POINTS, world [m].
        hand_m: The forearm's capsule goes on beyond the wrist by so much, along the forearm [m].

    Returns:
        (n, 10, 2, 3) ends of the axes of PARTS [m]; NaN where a point is missing.
    """
    axes = np.stack([points_m[:, _FROM], points_m[:, _TO]], axis=2)
    forearm = axes[:, _FOREARMS, 1] - axes[:, _FOREARMS, 0]
    length = np.linalg.norm(forearm, axis=2, keepdims=True)
    axes[:, _FOREARMS, 1] += hand_m * forearm / np.where(length > 0.0, length, np.inf)
    return np.asarray(axes)


def part_radii(occupancy: Occupancy, leg_m: float) -> Floats:
    """(10,) radii of PARTS: Table 2, which has no legs, and ``leg_m`` for thighs and shanks [m]."""
    upper, lower = occupancy.radius_upper_arm_m, occupancy.radius_lower_arm_m
    arms = (upper, lower, upper, lower)
    return np.array([occupancy.radius_head_m, occupancy.radius_thorax_m, *arms, *(leg_m,) * len(LEG_PARTS)])


def at_instants(t_ns: Ints, points_m: Floats, at_ns: Ints, gap_s: float) -> Floats:
    """Body points between the two samples around each instant, linear.

    Args:
        t_ns: (n,) instants of the samples, increasing [ns].
        points_m: (n, 20, 3) samples, world [m].
        at_ns: (m,) instants asked for [ns].
        gap_s: Between samples further apart nothing is known [s].

    Returns:
        (m, 20, 3); NaN outside the samples, in a gap, and where one of the two samples lacks the point. An instant
        that meets a sample gets that sample.
    """
    found = np.full((len(at_ns), *points_m.shape[1:]), np.nan)
    if not len(t_ns):
        return found
    right = np.searchsorted(t_ns, at_ns, side="left")
    inside = (at_ns >= t_ns[0]) & (at_ns <= t_ns[-1])
    right = np.clip(right, 0, len(t_ns) - 1)
    met = inside & (t_ns[right] == at_ns)
    found[met] = points_m[right[met]]
    left = np.maximum(right - 1, 0)
    step_ns = t_ns[right] - t_ns[left]
    between = inside & ~met & (step_ns > 0) & (step_ns * 1e-9 <= gap_s)
    share = ((at_ns - t_ns[left])[between] / step_ns[between])[:, None, None]
    found[between] = (1.0 - share) * points_m[left[between]] + share * points_m[right[between]]
    return found
