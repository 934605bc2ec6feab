"""The human model of Eq. (37): limits, forward kinematics, the choice between equal shoulder angles, and body capsules.

World: z up, floor at z = 0. Human base: on the floor under the pelvis, x forward, y left.

The shoulder's three axes are a spherical wrist, so (a1, a2, a3) and (a1 + pi, pi - a2, a3 + pi) are the same posture,
here called two forms of it. The *canonical* form has alpha_1 in the half-turn from -20 to 160 degrees, which contains
all of (34a), and the other angles within one turn around the middle of the range in (34). So every posture inside (34)
is its own canonical form. At the ends of the half-turn, with an arm far across the back or steeply raised, the angles
jump although the arm does not. To follow angles through time, use the form ``nearest`` to the previous one.

The capsules around the lines between a body's points are the surface that a robot would touch, not the space that a
person can reach.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hrcreplay.kernels import njit
from hrcreplay.records import BODY, DOF, JOINTS, LENGTHS, LIMBS, POINTS, Floats
from hrcreplay.settings.sections import Prediction

#: First of the four joints of each arm in JOINTS, and the sign s of the kinematics: +1 on the left.
RIGHT_ARM, LEFT_ARM = JOINTS.index("ar1"), JOINTS.index("al1")
#: Index of the pelvis's height in JOINTS.
HEIGHT = JOINTS.index("z")
THETA, RHO = JOINTS.index("theta"), JOINTS.index("rho")
#: Joints alpha_2 and alpha_3 of both arms.
ALPHA_2, ALPHA_3 = (RIGHT_ARM + 1, LEFT_ARM + 1), (RIGHT_ARM + 2, LEFT_ARM + 2)
#: Limbs by their place in LIMBS and BODY.
HD, THX, URA, LRA, ULA, LLA, LEGS = range(len(BODY))

PELVIS, NECK, HEAD = (POINTS.index(name) for name in ("pelvis", "neck", "head"))
#: Rows: right, left. Columns: shoulder, elbow, wrist.
ARM_POINTS = tuple(tuple(POINTS.index(f"{name}_{side}") for name in ("shoulder", "elbow", "wrist")) for side in "rl")
HANDS = np.array([POINTS.index(f"hand_{side}") for side in "rl"])
#: Knees and ankles: without one of them the position of a leg is unknown.
BENDS = np.array([POINTS.index(f"{part}_{side}") for part in ("knee", "ankle") for side in "rl"])
LEG_POINTS = np.array([POINTS.index(f"{part}_{side}") for part in ("hip", "knee", "ankle", "foot") for side in "rl"])
#: Index into LIMBS of the limb whose points determine each joint of JOINTS.
SHOWN_BY = np.array(
    [LIMBS.index(limb) for limb in ("THX",) * 4 + ("URA",) * 2 + ("LRA",) * 2 + ("ULA",) * 2 + ("LLA",) * 2 + ("THX",)]
)
_DEGREE = np.pi / 180.0


@dataclass(frozen=True)
class Departure:
    """Measured bounds on the departure of whole limbs from constant velocity.

    Take the hull of a limb at the tick and at its later positions at constant velocity
    (``human.prediction.velocity_tube``), up to ``rise_m`` higher and ``sink_m`` lower, but arms by 0.06 m at most. Up
    to a horizon, no point of the limb is further from this hull than ``beyond_m``, plus ``swings_s`` times the limb's
    present speed, plus ``residuals`` times its residual, as far as that is noise; the bound is at least the residual.
    """

    horizon_s: Floats  #: (h,) increasing [s]
    beyond_m: Floats  #: (7, h) for each limb of BODY [m]
    residuals: Floats  #: (7, h)
    rise_m: Floats  #: (h,) [m]
    sink_m: Floats  #: (h,) [m]
    swings_s: Floats | None = None  #: (7, h) [m per m/s]; None: the bound does not depend on the speed


@dataclass(frozen=True)
class LimitSet:
    """Bounds on the joints of Eq. (37), as in Table 1, (13,) each, [m, m, rad..., m] and their derivatives.

    The velocity and acceleration bounds of x and y bound v (forward) and v_perp (to the left) in the body frame,
    Eq. (18), (25), (26). Heading has no position bound (+-inf). If ``coupled``, alpha_2 and alpha_3 obey Eq. (34b),
    (34c), and their entries in ``p_min``/``p_max`` only enclose these bounds.
    """

    name: str
    p_min: Floats
    p_max: Floats
    v_min: Floats
    v_max: Floats
    a_min: Floats
    a_max: Floats
    coupled: bool
    departure: Departure | None = None  #: bounds on the limbs for ``sound``; None: only the joints are bounded

    def plain(self) -> dict[str, Any]:
        """Returns the JSON form; an infinite bound is null."""
        found = {name: _plain(value) for name, value in vars(self).items() if name != "departure"}
        if self.departure is not None:
            known = vars(self.departure).items()
            found["departure"] = {name: value.tolist() for name, value in known if value is not None}
        return found

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> LimitSet:
        """Makes a limit set from its JSON form, see ``plain``."""
        found = {name: _bound(name, value) for name, value in plain.items() if name != "departure"}
        if plain.get("departure") is not None:
            found["departure"] = Departure(**{name: np.array(value) for name, value in plain["departure"].items()})
        return cls(**found)


def _plain(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    return [number if abs(number) != np.inf else None for number in value.tolist()]


def _bound(name: str, value: Any) -> Any:
    if not isinstance(value, list):
        return value
    none = -np.inf if name.endswith("_min") else np.inf
    return np.array([none if number is None else number for number in value], dtype=float)


def bounds_of(limits: LimitSet) -> Floats:
    """Returns (6, 13): p_min, p_max, v_min, v_max, a_min, a_max, in the form that the kernels take."""
    return np.stack([limits.p_min, limits.p_max, limits.v_min, limits.v_max, limits.a_min, limits.a_max])


def skeleton(p: Floats, lengths_m: Floats) -> Floats:
    """Forward kinematics: computes the body points of the model.

    Args:
        p: (n, 13) JOINTS [m, m, rad..., m].
        lengths_m: (n, 7) LENGTHS [m].

    Returns:
        (n, 20, 3) POINTS, world [m]; NaN for points outside the model (hands, chest, legs). ``neck`` is the midpoint of
        the shoulder line.

    Raises:
        ValueError: The tables have other numbers of columns; the kernel would read beyond them.
    """
    if p.shape[1:] != (DOF,) or lengths_m.shape[1:] != (len(LENGTHS),):
        raise ValueError(f"found {p.shape} joints and {lengths_m.shape} lengths; (n, {DOF}) and (n, {len(LENGTHS)})")
    points = np.full((len(p), len(POINTS), 3), np.nan)
    _skeleton_rows(np.ascontiguousarray(p), np.ascontiguousarray(lengths_m), points)
    return points


@njit(cache=True)
def _skeleton_rows(p: Floats, lengths: Floats, points: Floats) -> None:
    for i in range(len(p)):
        skeleton_row(p[i], lengths[i], points[i])


@njit(cache=True, inner=True)
def skeleton_row(p: Floats, lengths: Floats, points: Floats) -> None:
    """Writes the model's points of one posture, p (13,) and lengths (7,), into points (20, 3) [m]."""
    R = torso_rotation(p[THETA], p[RHO])
    for k in range(3):
        base = p[k] if k < THETA else p[HEIGHT]
        points[PELVIS, k] = base
        points[NECK, k] = base + R[k, 2] * lengths[0]
        points[HEAD, k] = points[NECK, k] + R[k, 2] * lengths[1]
    for arm in range(2):
        s = 2.0 * arm - 1.0
        shoulder, elbow, wrist = ARM_POINTS[arm]
        first = RIGHT_ARM + 4 * arm
        upper, fore = arm_directions(p[first], p[first + 1], p[first + 2], p[first + 3])
        for k in range(3):
            points[shoulder, k] = points[NECK, k] + R[k, 1] * s * lengths[2]
            along_upper = R[k, 0] * upper[0] + R[k, 1] * s * upper[1] + R[k, 2] * upper[2]
            along_fore = R[k, 0] * fore[0] + R[k, 1] * s * fore[1] + R[k, 2] * fore[2]
            points[elbow, k] = points[shoulder, k] + along_upper * lengths[4 - arm]
            points[wrist, k] = points[elbow, k] + along_fore * lengths[6 - arm]


@njit(cache=True, inner=True)
def torso_rotation(theta: float, rho: float) -> Floats:
    """R_torso = Rz(theta) Ry(rho), (3, 3)."""
    ct, st, cr, sr = np.cos(theta), np.sin(theta), np.cos(rho), np.sin(rho)
    R = np.empty((3, 3))
    R[0], R[1], R[2] = (ct * cr, -st, ct * sr), (st * cr, ct, st * sr), (-sr, 0.0, cr)
    return R


@njit(cache=True, inner=True)
def arm_directions(alpha_1: float, alpha_2: float, alpha_3: float, alpha_4: float) -> tuple[Floats, Floats]:
    """Computes unit vectors shoulder to elbow and elbow to wrist in the torso's frame, for a left arm (s = +1).

    Those of a right arm are their mirror images in y, so both arms share the kernels.

    Args:
        alpha_1: First angle of the shoulder [rad].
        alpha_2: Second angle of the shoulder [rad].
        alpha_3: Third angle of the shoulder [rad].
        alpha_4: Angle of the elbow, pi for a straight arm [rad].
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

    Args:
        low_1: Smallest alpha_1 [rad].
        high_1: Largest alpha_1 [rad].
        low_2: Smallest alpha_2 [rad].
        high_2: Largest alpha_2 [rad].
    """
    lowest, highest = np.inf, -np.inf
    for a1 in (low_1 / _DEGREE, high_1 / _DEGREE):
        for a2 in (low_2 / _DEGREE, high_2 / _DEGREE):
            lowest = min(lowest, -90.0 + 7.0 * a1 / 9.0 - a2 / 9.0 + 2.0 * a1 * a2 / 810.0)
            highest = max(highest, 60.0 + 4.0 * a1 / 9.0 - 5.0 * a2 / 9.0 + 5.0 * a1 * a2 / 810.0)
    return lowest * _DEGREE, highest * _DEGREE


def clamp(p: Floats, limits: LimitSet) -> Floats:
    """Clamps postures ``p`` to the limits by Eq. (62), (n, 13) [m, m, rad..., m]; heading is unchanged.

    If the limits are coupled, alpha_2 is clamped to the bounds of the clamped alpha_1, and alpha_3 to those of both.
    """
    clamped = np.array(p, dtype=np.float64, order="C")
    _clamp_rows(clamped, limits.p_min, limits.p_max, limits.coupled)
    return clamped


@njit(cache=True)
def _clamp_rows(p: Floats, p_min: Floats, p_max: Floats, coupled: bool) -> None:
    low, high = np.empty(DOF), np.empty(DOF)
    for row in p:
        clamp_row(row, p_min, p_max, coupled, low, high)


@njit(cache=True, inner=True)
def clamp_row(p: Floats, p_min: Floats, p_max: Floats, coupled: bool, low: Floats, high: Floats) -> None:
    """Applies Eq. (62) to one posture (13,) in place; writes the applied bounds into low, high (13,).

    Args:
        p: (13,) JOINTS [m, m, rad..., m].
        p_min: (13,) of ``LimitSet`` [m, m, rad..., m].
        p_max: (13,) of ``LimitSet`` [m, m, rad..., m].
        coupled: True: alpha_2 and alpha_3 obey Eq. (34b), (34c).
        low: (13,) receives the lower bounds [m, m, rad..., m].
        high: (13,) receives the upper bounds [m, m, rad..., m].
    """
    for j in range(DOF):
        low[j], high[j] = p_min[j], p_max[j]
        if j == THETA:  # Table 1's +-pi is the wrap of an angle, not a joint limit
            low[j], high[j] = -np.inf, np.inf
        elif coupled and j in ALPHA_2:
            low[j], high[j] = alpha_2_bounds(p[j - 1], p[j - 1])
        elif coupled and j in ALPHA_3:
            low[j], high[j] = alpha_3_bounds(p[j - 2], p[j - 2], p[j - 1], p[j - 1])
        p[j] = max(low[j], min(p[j], high[j]))


#: Middles of the turns of alpha_1, alpha_2, alpha_3 [rad]; (34) spans -9..160, -46..155 and -118..198 degrees.
_MIDDLES = (70.0 * np.pi / 180.0, 90.0 * np.pi / 180.0, 40.0 * np.pi / 180.0)
_ROUNDING = 1e-9


def canonical(p: Floats) -> Floats:
    """Converts both arms of postures (n, 13) to their canonical forms [m, m, rad..., m]."""
    named = np.array(p, dtype=np.float64, order="C")
    _canonical_rows(named)
    return named


def nearest(p: Floats, reference: Floats) -> Floats:
    """Converts each posture to the form nearest to ``reference``, both (n, 13) [m, m, rad..., m].

    Heading takes the nearest turn, each arm the nearer of its two forms. A value that is NaN in either is copied from
    ``p``. Use it before subtracting angles of two sources.
    """
    named = np.array(p, dtype=np.float64, order="C")
    _nearest_rows(named, np.ascontiguousarray(reference))
    return named


@njit(cache=True, inner=True)
def wrap(angle: float) -> float:
    """The angle in (-pi, pi] [rad]."""
    return angle - 2.0 * np.pi * np.ceil((angle - np.pi) / (2.0 * np.pi))


@njit(cache=True, inner=True)
def canonical_arm(arm: Floats, margin: float) -> bool:
    """Converts one arm (4,) in place; returns True if alpha_2 was mirrored, so that its derivatives change sign.

    A form is kept until an angle is out of its half-turn (or turn) by ``margin`` [rad], so that a resting arm does not
    alternate between both forms.
    """
    mirrored = False
    for j in range(3):
        if abs(arm[j] - _MIDDLES[j]) > np.pi + margin:
            arm[j] = _into_turn(arm[j], j)
    if abs(arm[0] - _MIDDLES[0]) > 0.5 * np.pi + margin + _ROUNDING:
        arm[0], arm[1], arm[2] = (
            _into_turn(arm[0] + np.pi, 0),
            _into_turn(np.pi - arm[1], 1),
            _into_turn(arm[2] + np.pi, 2),
        )
        mirrored = True
    return mirrored


@njit(cache=True, inner=True)
def nearest_arm(arm: Floats, reference: Floats, variance: Floats) -> None:
    """Converts one arm (4,) in place to the form nearest to the reference (4,), with joints weighted by 1/variance."""
    for j in range(3):
        arm[j] = reference[j] + wrap(arm[j] - reference[j])
    other = (arm[0] + np.pi, np.pi - arm[1], arm[2] + np.pi)
    ours, theirs = 0.0, 0.0
    for j in range(3):
        if np.isfinite(arm[j]) and variance[j] > 0.0:
            ours += (arm[j] - reference[j]) ** 2 / variance[j]
            theirs += wrap(other[j] - reference[j]) ** 2 / variance[j]
    if theirs < ours:
        for j in range(3):
            arm[j] = reference[j] + wrap(other[j] - reference[j])


@njit(cache=True, inner=True)
def _into_turn(angle: float, j: int) -> float:
    """Wraps the angle to the turn around the middle of the range of joint j of the arm [rad]."""
    return _MIDDLES[j] + wrap(angle - _MIDDLES[j])


@njit(cache=True)
def _canonical_rows(p: Floats) -> None:
    for row in p:
        for first in (RIGHT_ARM, LEFT_ARM):
            canonical_arm(row[first : first + 4], 0.0)


@njit(cache=True)
def _nearest_rows(p: Floats, reference: Floats) -> None:
    equal = np.ones(4)
    for i in range(len(p)):
        if np.isfinite(p[i, 2]) and np.isfinite(reference[i, 2]):
            p[i, 2] = reference[i, 2] + wrap(p[i, 2] - reference[i, 2])
        for first in (RIGHT_ARM, LEFT_ARM):
            arm = p[i, first : first + 4].copy()
            known = reference[i, first : first + 4]
            nearest_arm(arm, known, equal)
            for j in range(4):
                if np.isfinite(arm[j]):
                    p[i, first + j] = arm[j]


#: Thighs and shanks are not in the model of Eq. (37): they exist only if hip, knee and ankle were recorded.
LEG_PARTS = ("THIGH_R", "SHANK_R", "THIGH_L", "SHANK_L")
#: Hands and feet as observed by a camera; a forearm's capsule also extends beyond the wrist.
END_PARTS = ("HAND_R", "HAND_L", "FOOT_R", "FOOT_L")
#: Parts of a recorded body.
PARTS = (*LIMBS, *LEG_PARTS, *END_PARTS)
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
    "HAND_R": ("wrist_r", "hand_r"),
    "HAND_L": ("wrist_l", "hand_l"),
    "FOOT_R": ("ankle_r", "foot_r"),
    "FOOT_L": ("ankle_l", "foot_l"),
}
_FROM, _TO = (np.array([POINTS.index(_ENDS[part][end]) for part in PARTS]) for end in (0, 1))
_FOREARMS = np.array([PARTS.index("LRA"), PARTS.index("LLA")])


def part_axes(points_m: Floats, hand_m: float) -> Floats:
    """Computes the axes of the capsules of a body's parts.

    Args:
        points_m: (n, 20, 3) POINTS, world [m].
        hand_m: Extension of the forearm's capsule beyond the wrist, along the forearm [m].

    Returns:
        (n, 14, 2, 3) ends of the axes of PARTS [m]; NaN if a point is missing.
    """
    axes = np.stack([points_m[:, _FROM], points_m[:, _TO]], axis=2)
    forearm = axes[:, _FOREARMS, 1] - axes[:, _FOREARMS, 0]
    length = np.linalg.norm(forearm, axis=2, keepdims=True)
    axes[:, _FOREARMS, 1] += hand_m * forearm / np.where(length > 0.0, length, np.inf)
    return np.asarray(axes)


def part_radii(prediction: Prediction, leg_m: float) -> Floats:
    """(14,) radii of PARTS: Table 2, for hands that of the lower arm, for thighs, shanks and feet ``leg_m`` [m]."""
    upper, lower = prediction.radius_upper_arm_m, prediction.radius_lower_arm_m
    arms = (upper, lower, upper, lower)
    legs, ends = (leg_m,) * len(LEG_PARTS), (lower, lower, leg_m, leg_m)
    return np.array([prediction.radius_head_m, prediction.radius_thorax_m, *arms, *legs, *ends])
