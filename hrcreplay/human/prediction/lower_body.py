"""Where the lower body may be, of which the model only knows the pelvis."""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.human.prediction.walking_reach import SIDES
from hrcreplay.records import Floats

#: From the middle of a leg, where cameras put its points, to the skin: a thigh 0.5 m around [m].
THIGH_M = 0.08
#: Length of thigh and of shank with foot: two of them are the pelvis's height of the median man [m].
BONE_M = 0.47
#: How high a knee gets whose foot carries a person: with a shank upright on the toes [m].
KNEE_M = 0.55


@njit(cache=True)
def legs_around(corners: Floats, ahead: float, lowest: float, highest: float, radius: float) -> tuple[Floats, int]:
    """From the floor to the highest pelvis, wherever it walks; below, as far out as the lowest pelvis puts the knees.

    Args:
        corners: (SIDES, 2) where the pelvis walks [m].
        ahead: Direction of its first side [rad].
        lowest: Pelvis's height [m].
        highest: The same [m].
        radius: Of the ball around the result; it holds knees of people who stand [m].

    Returns:
        (m, 3) points whose hull is that, and m; one NaN where the state is.
    """
    if not np.isfinite(corners.sum() + lowest + highest):
        return np.full((1, 3), np.nan), 1
    bent = np.sqrt(max(0.0, BONE_M**2 - (0.5 * lowest) ** 2))  # foot under the pelvis, thigh and shank of one length
    out = max(0.0, bent - (radius - THIGH_M)) / np.cos(np.pi / SIDES)
    swept = np.zeros((3 * SIDES, 3))
    for k in range(SIDES):
        middle = ahead + (k + 0.5) * 2.0 * np.pi / SIDES
        swept[k, 0] = corners[k, 0] + out * np.cos(middle)
        swept[k, 1] = corners[k, 1] + out * np.sin(middle)
    swept[SIDES : 2 * SIDES, :2], swept[SIDES : 2 * SIDES, 2] = swept[:SIDES, :2], min(KNEE_M, highest)
    swept[2 * SIDES :, :2], swept[2 * SIDES :, 2] = corners, highest
    return swept, len(swept)
