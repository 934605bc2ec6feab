"""The human model of Eq. (37): limits and forward kinematics.

World: z up, floor at z = 0. Human base: on the floor under the pelvis, x forward, y left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from hrcreplay.records import LIMBS, POINTS, Floats

#: First of the four joints of each arm in JOINTS, and s of the kinematics: +1 on the left.
RIGHT_ARM, LEFT_ARM = 4, 8

PELVIS, NECK, HEAD = (POINTS.index(name) for name in ("pelvis", "neck", "head"))
#: Rows: right, left. Columns: shoulder, elbow, wrist.
ARM_POINTS = tuple(tuple(POINTS.index(f"{name}_{side}") for name in ("shoulder", "elbow", "wrist")) for side in "rl")
#: Index into LIMBS of the limb whose points show each joint of JOINTS.
SHOWN_BY = np.array(
    [LIMBS.index(limb) for limb in ("THX",) * 4 + ("URA",) * 2 + ("LRA",) * 2 + ("ULA",) * 2 + ("LLA",) * 2]
)
_DEGREE = np.pi / 180.0


@dataclass(frozen=True)
class LimitSet:
    """Bounds on the joints of Eq. (37), (12,) each, [m, m, rad...] and their derivatives.

    The velocity and acceleration bounds of x and y bound v (forward) and v_perp (to the left) in the body frame,
    Eq. (25), (26). Heading has no position bound (+-inf). Where ``coupled``, alpha_2 and alpha_3 obey (34b), (34c)
    and their own entries in ``p_min``/``p_max`` only enclose them.
    """

    name: str
    p_min: Floats
    p_max: Floats
    v_min: Floats
    v_max: Floats
    a_min: Floats
    a_max: Floats
    coupled: bool


def skeleton(p: Floats, lengths_m: Floats) -> Floats:
    """Forward kinematics: where the model puts the body points.

    Args:
        p: (n, 12) JOINTS [m, m, rad...].
        lengths_m: (n, 8) LENGTHS [m].

    Returns:
        (n, 20, 3) POINTS, world [m]; NaN where the model has no say (hands, chest, legs). ``neck`` is the midpoint
        of the shoulder line.
    """
    points = np.full((len(p), len(POINTS), 3), np.nan)
    _skeleton_rows(np.ascontiguousarray(p), np.ascontiguousarray(lengths_m), points)
    return points


@njit(cache=True)
def _skeleton_rows(p: Floats, lengths: Floats, points: Floats) -> None:
    for i in range(len(p)):
        skeleton_row(p[i], lengths[i], points[i])


@njit(cache=True)
def skeleton_row(p: Floats, lengths: Floats, points: Floats) -> None:
    """Writes the model's points of one posture, p (12,) and lengths (8,), into points (20, 3) [m]."""
    R = torso_rotation(p[2], p[3])
    for k in range(3):
        base = p[k] if k < 2 else lengths[0]
        points[PELVIS, k] = base
        points[NECK, k] = base + R[k, 2] * lengths[1]
        points[HEAD, k] = points[NECK, k] + R[k, 2] * lengths[2]
    for arm in range(2):
        s = 2.0 * arm - 1.0
        shoulder, elbow, wrist = ARM_POINTS[arm]
        first = RIGHT_ARM + 4 * arm
        upper, fore = arm_directions(p[first], p[first + 1], p[first + 2], p[first + 3])
        for k in range(3):
            points[shoulder, k] = points[NECK, k] + R[k, 1] * s * lengths[3]
            along_upper = R[k, 0] * upper[0] + R[k, 1] * s * upper[1] + R[k, 2] * upper[2]
            along_fore = R[k, 0] * fore[0] + R[k, 1] * s * fore[1] + R[k, 2] * fore[2]
            points[elbow, k] = points[shoulder, k] + along_upper * lengths[5 - arm]
            points[wrist, k] = points[elbow, k] + along_fore * lengths[7 - arm]


@njit(cache=True)
def torso_rotation(theta: float, rho: float) -> Floats:
    """R_torso = Rz(theta) Ry(rho), (3, 3)."""
    ct, st, cr, sr = np.cos(theta), np.sin(theta), np.cos(rho), np.sin(rho)
    R = np.empty((3, 3))
    R[0], R[1], R[2] = (ct * cr, -st, ct * sr), (st * cr, ct, st * sr), (-sr, 0.0, cr)
    return R


@njit(cache=True)
def arm_directions(alpha_1: float, alpha_2: float, alpha_3: float, alpha_4: float) -> tuple[Floats, Floats]:
    """Unit vectors shoulder to elbow and elbow to wrist in the torso's frame, of a left arm (s = +1).

    Those of a right arm are their mirror images in y, so the kernels of both arms are one.
    """
    c1, s1, c2, s2 = np.cos(alpha_1), np.sin(alpha_1), np.cos(alpha_2), np.sin(alpha_2)
    c3, s3, c4, s4 = np.cos(alpha_3), np.sin(alpha_3), np.cos(alpha_4), np.sin(alpha_4)
    upper = np.array([s2, s1 * c2, -c1 * c2])  # Rx(alpha_1) Ry(-alpha_2) (0, 0, -1)
    x, y, z = s4 * c3, s4 * s3, c4  # forearm in the upper arm's frame: Rz(alpha_3) Ry(-(pi - alpha_4)) (0, 0, -1)
    turned_z = s2 * x + c2 * z  # Ry(-alpha_2)
    fore = np.array([c2 * x - s2 * z, c1 * y - s1 * turned_z, s1 * y + c1 * turned_z])
    return upper, fore


@njit(cache=True)
def alpha_2_bounds(low_1: float, high_1: float) -> tuple[float, float]:
    """Eq. (34b) over alpha_1 in [low_1, high_1]: the widest bounds of alpha_2 found there [rad]."""
    low = min(low_1 / 3.0, high_1 / 3.0)
    high = max(-low_1 / 6.0, -high_1 / 6.0)
    return -43.0 * _DEGREE + low, 153.0 * _DEGREE + high


@njit(cache=True)
def alpha_3_bounds(low_1: float, high_1: float, low_2: float, high_2: float) -> tuple[float, float]:
    """Eq. (34c) over a box of alpha_1 and alpha_2: the widest bounds of alpha_3 found there [rad].

    The bounds are bilinear, so their extremes are at the box's corners.
    """
    lowest, highest = np.inf, -np.inf
    for a1 in (low_1 / _DEGREE, high_1 / _DEGREE):
        for a2 in (low_2 / _DEGREE, high_2 / _DEGREE):
            lowest = min(lowest, -90.0 + 7.0 * a1 / 9.0 - a2 / 9.0 + 2.0 * a1 * a2 / 810.0)
            highest = max(highest, 60.0 + 4.0 * a1 / 9.0 - 5.0 * a2 / 9.0 + 5.0 * a1 * a2 / 810.0)
    return lowest * _DEGREE, highest * _DEGREE


def clamp(p: Floats, limits: LimitSet) -> Floats:
    """The postures inside the limits that Eq. (62) makes of ``p``, (n, 12) [m, m, rad...]; heading is left alone.

    Where the limits are coupled, alpha_2 is held in the bounds of the clamped alpha_1, and alpha_3 in those of both.
    """
    clamped = np.array(p, dtype=np.float64, order="C")
    _clamp_rows(clamped, limits.p_min, limits.p_max, limits.coupled)
    return clamped


@njit(cache=True)
def _clamp_rows(p: Floats, p_min: Floats, p_max: Floats, coupled: bool) -> None:
    low, high = np.empty(12), np.empty(12)
    for row in p:
        clamp_row(row, p_min, p_max, coupled, low, high)


@njit(cache=True)
def clamp_row(p: Floats, p_min: Floats, p_max: Floats, coupled: bool, low: Floats, high: Floats) -> None:
    """Clamps one posture (12,) in place and writes the bounds that held for it into low, high (12,)."""
    for j in range(12):
        low[j], high[j] = p_min[j], p_max[j]
        if j == 2:  # Table 1's +-pi is a wrap, not a stop
            low[j], high[j] = -np.inf, np.inf
        elif coupled and j in (5, 9):
            low[j], high[j] = alpha_2_bounds(p[j - 1], p[j - 1])
        elif coupled and j in (6, 10):
            low[j], high[j] = alpha_3_bounds(p[j - 2], p[j - 2], p[j - 1], p[j - 1])
        p[j] = max(low[j], min(p[j], high[j]))
