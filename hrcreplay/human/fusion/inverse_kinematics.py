"""From skeleton points to the joints of Eq. (37): closed-form inverse kinematics and its variances.

Real people differ from the model: they bend sideways, lift shoulders, twist. The angles are computed from frames that
the points span: heading from the shoulder line's projection on the floor, rho from the line pelvis to neck seen from
the side, each arm from its own two bones in the torso's frame. Lengths are distances between points.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.geometry.vectors import Vector, cross, dot, edge, norm
from hrcreplay.human.model import (
    ARM_POINTS,
    HEAD,
    HEIGHT,
    LEFT_ARM,
    NECK,
    PELVIS,
    RIGHT_ARM,
    canonical_arm,
    torso_rotation,
    wrap,
)
from hrcreplay.kernels import njit
from hrcreplay.records import DOF, LENGTHS, POINTS, CameraFrames, Floats, Ints, Measurements
from hrcreplay.settings.sections import Fusion

#: Rows of a measurement: JOINTS, then LENGTHS.
ROWS = DOF + len(LENGTHS)
_SHOULDER_R, _SHOULDER_L = ARM_POINTS[0][0], ARM_POINTS[1][0]
_USED = (PELVIS, NECK, HEAD, *ARM_POINTS[0], *ARM_POINTS[1])
_STEP_M = 1e-6
#: Two points nearer than this coincide: the bone between them has neither length nor direction [m].
LEAST_BONE_M = 1e-3
#: A variance so large that a filter ignores the row [rad^2, m^2].
_UNOBSERVED = 1e6
#: Minimum variance: a sum of squares that rounds to 0 would count as exact [rad^2, m^2].
_LEAST_VARIANCE = 1e-18
_LEAST_CONFIDENCE = 0.05


def _points_of_rows() -> tuple[tuple[int, ...], ...]:
    """Returns the body points from which each joint and each length is computed."""
    shoulders = (_SHOULDER_R, _SHOULDER_L)
    torso = (PELVIS, *shoulders)
    rows = [(PELVIS,), (PELVIS,), shoulders, torso]
    for _, elbow, _ in ARM_POINTS:
        rows += [(*torso, elbow)] * 2 + [(*torso, elbow, elbow + 1), (elbow - 1, elbow, elbow + 1)]
    (_, elbow_r, wrist_r), (_, elbow_l, wrist_l) = ARM_POINTS
    rows += [(PELVIS,), torso, (HEAD, *shoulders), shoulders]
    rows += [(_SHOULDER_L, elbow_l), (_SHOULDER_R, elbow_r), (elbow_l, wrist_l), (elbow_r, wrist_r)]
    return tuple(rows)


#: (20, 20) True if a row (JOINTS, then LENGTHS) is computed from a body point.
DEPENDS = np.zeros((ROWS, len(POINTS)), dtype=np.bool_)
for _row, _points in enumerate(_points_of_rows()):
    DEPENDS[_row, list(_points)] = True


def inverse(points_m: Floats) -> tuple[Floats, Floats]:
    """Computes joint angles and limb lengths of skeletons, the inverse of ``model.skeleton``.

    Args:
        points_m: (n, 20, 3) POINTS, world [m]; NaN where missing. The neck is the middle of the shoulders; the measured
            neck replaces it only if one shoulder is missing, and then no length is computed from it.

    Returns:
        Angles (n, 13) JOINTS [m, m, rad..., m], arms in canonical form (``human.model``), and lengths (n, 7) LENGTHS
        [m]. NaN if a point is missing or the two ends of a bone coincide. At a singular posture the angle that cannot
        be observed is 0.
    """
    rows = np.full((len(points_m), ROWS), np.nan)
    _inverse_rows(np.array(points_m, dtype=np.float64, order="C"), rows)  # a copy: as writable as those of `measure`
    return rows[:, :DOF].copy(), rows[:, DOF:].copy()


def measure(frames: CameraFrames, T_world_camera: Floats, settings: Fusion) -> Measurements:
    """Computes joint angles and limb lengths of camera frames, by closed-form inverse kinematics.

    Args:
        frames: Skeletons in their camera's frame, one body each.
        T_world_camera: (c, 4, 4) pose of each camera in the world.
        settings: Noise of a skeleton point, the same in all directions: (``point_std_m`` + ``point_std_per_m`` * range)
            / confidence, which is carried through the inverse kinematics by its Jacobian, diagonal only,
            Eq. (47). Towards a singular posture it grows without bound (alpha_3 is unobservable for a straight elbow,
            alpha_1 for an arm pointing forward, heading for a vertical shoulder line).
    """
    n = len(frames)
    points = np.empty((n, len(POINTS), 3))
    rows, variances = np.full((n, ROWS), np.nan), np.full((n, ROWS), np.nan)
    noise = np.array([settings.point_std_m, settings.point_std_per_m])
    _measure_rows(
        frames.camera, frames.points_m, frames.confidence, np.array(T_world_camera), noise, points, rows, variances
    )
    return Measurements(
        capture_ns=frames.capture_ns,
        arrival_ns=frames.arrival_ns,
        camera=frames.camera,
        z=rows,
        z_std=np.sqrt(variances),
        points_m=points,
        confidence=frames.confidence,
        cameras=frames.cameras,
    )


@njit(cache=True)
def _inverse_rows(points: Floats, rows: Floats) -> None:
    for i in range(len(points)):
        _direct_row(points[i], rows[i])
        _name_arms(rows[i])


@njit(cache=True)
def _measure_rows(
    camera: Ints,
    points_camera: Floats,
    confidence: Floats,
    T_world_camera: Floats,
    noise: Floats,
    points: Floats,
    rows: Floats,
    variances: Floats,
) -> None:
    point_variance = np.empty(len(POINTS))
    for i in range(len(camera)):
        T = T_world_camera[camera[i]]
        for k in range(len(POINTS)):
            x, y, z = points_camera[i, k]
            for axis in range(3):
                points[i, k, axis] = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * z + T[axis, 3]
            std = noise[0] + noise[1] * np.sqrt(x * x + y * y + z * z)
            point_variance[k] = (std / max(confidence[i, k], _LEAST_CONFIDENCE)) ** 2
        _direct_row(points[i], rows[i])
        _variances_row(points[i], point_variance, variances[i])
        _name_arms(rows[i])
        for row in range(ROWS):
            if np.isnan(rows[i, row]):
                variances[i, row] = np.nan


@njit(cache=True, inner=True)
def _variances_row(points: Floats, point_variance: Floats, variances: Floats) -> None:
    """Eq. (47), variance of every row from the squared Jacobian; to second order it exceeds the range of an angle."""
    J = inverse_jacobian(points)
    for row in range(ROWS):
        variance = 0.0
        for k in range(len(POINTS)):
            squares = J[row, k, 0] ** 2 + J[row, k, 1] ** 2 + J[row, k, 2] ** 2
            if squares > 0.0:
                variance += squares * point_variance[k]
            elif np.isnan(squares):  # with one more step the bone vanishes
                variance = _UNOBSERVED
        if 2 <= row < HEIGHT:
            variance *= 1.0 + 4.0 * variance
        variances[row] = max(_LEAST_VARIANCE, min(variance, _UNOBSERVED))


@njit(cache=True)
def inverse_jacobian(points: Floats) -> Floats:
    """(20, 20, 3) derivative of the joints and lengths by the points (20, 3), central differences.

    [rad/m, m/m]. The arms are in direct form; the derivatives of the other form differ only in sign.
    """
    J = np.zeros((ROWS, len(POINTS), 3))
    moved, above, below = points.copy(), np.empty(ROWS), np.empty(ROWS)
    for k in _USED:
        for axis in range(3):
            at = points[k, axis]
            moved[k, axis] = at + _STEP_M
            _direct_row(moved, above)
            moved[k, axis] = at - _STEP_M
            _direct_row(moved, below)
            moved[k, axis] = at
            for row in range(ROWS):
                change = above[row] - below[row]
                if 2 <= row < HEIGHT:
                    change = wrap(change)
                J[row, k, axis] = change / (2.0 * _STEP_M)
    return J


@njit(cache=True, inner=True)
def _name_arms(rows: Floats) -> None:
    for first in (RIGHT_ARM, LEFT_ARM):
        canonical_arm(rows[first : first + 4], 0.0)


@njit(cache=True, inner=True)
def _direct_row(points: Floats, rows: Floats) -> None:
    """Computes the joints and lengths of one skeleton (20, 3), arms in the form with |alpha_2| <= 90 degrees."""
    pelvis, right, left = _point(points, PELVIS), _point(points, _SHOULDER_R), _point(points, _SHOULDER_L)
    neck, line = _middle(right, left), _from_to(right, left)
    (_, elbow_r, wrist_r), (_, elbow_l, wrist_l) = ARM_POINTS
    rows[HEIGHT] = pelvis[2]
    rows[DOF:] = (
        norm(_bone(_from_to(pelvis, neck))),
        norm(_bone(_from_to(neck, _point(points, HEAD)))),
        0.5 * norm(_bone(line)),
        norm(_bone(edge(points, _SHOULDER_L, elbow_l))),
        norm(_bone(edge(points, _SHOULDER_R, elbow_r))),
        norm(_bone(edge(points, elbow_l, wrist_l))),
        norm(_bone(edge(points, elbow_r, wrist_r))),
    )
    if np.isnan(line[0]):
        neck = _point(points, NECK)
        line = _from_to(right, neck) if np.isnan(left[0]) else _from_to(neck, left)
    line, trunk = _bone(line), _bone(_from_to(pelvis, neck))
    theta = np.arctan2(-line[0], line[1])  # the shoulder line is R_torso (0, 1, 0)
    rho = np.arctan2(trunk[0] * np.cos(theta) + trunk[1] * np.sin(theta), trunk[2])
    rows[0], rows[1], rows[2], rows[3] = pelvis[0], pelvis[1], theta, rho
    R = torso_rotation(theta, rho)
    for arm in range(2):
        shoulder, elbow, wrist = ARM_POINTS[arm]
        s = 2.0 * arm - 1.0
        upper, fore = _bone(edge(points, shoulder, elbow)), _bone(edge(points, elbow, wrist))
        first = RIGHT_ARM + 4 * arm
        _arm_row(_in_torso(R, s, upper), _in_torso(R, s, fore), rows[first : first + 4])
        # independent of the torso's frame, so it holds also without a heading
        rows[first + 3] = _elbow_angle((-upper[0], -upper[1], -upper[2]), fore)


@njit(cache=True, inner=True)
def _bone(ends: Vector) -> Vector:
    """Returns the bone, or NaN if both ends coincide: that bone cannot be observed."""
    if norm(ends) < LEAST_BONE_M:
        return np.nan, np.nan, np.nan
    return ends


@njit(cache=True, inner=True)
def _in_torso(R: Floats, s: float, bone: Vector) -> Vector:
    """Transforms a bone into the torso's frame, mirrored in y for a right arm (s = -1)."""
    x, y, z = bone
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        s * (R[0, 1] * x + R[1, 1] * y + R[2, 1] * z),
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )


@njit(cache=True, inner=True)
def _arm_row(upper: Vector, fore: Vector, arm: Floats) -> None:
    """Computes alpha_1 to alpha_3 of a left arm whose bones point along upper and fore in the torso's frame."""
    across = np.hypot(upper[1], upper[2])
    arm[0] = np.arctan2(upper[1], -upper[2])
    arm[1] = np.arctan2(upper[0], across)
    c1, s1, c2, s2 = np.cos(arm[0]), np.sin(arm[0]), np.cos(arm[1]), np.sin(arm[1])
    lifted = -s1 * fore[1] + c1 * fore[2]  # z after Rx(-alpha_1)
    arm[2] = np.arctan2(c1 * fore[1] + s1 * fore[2], c2 * fore[0] + s2 * lifted)


@njit(cache=True, inner=True)
def _elbow_angle(a: Vector, b: Vector) -> float:
    """Computes the angle at the elbow, pi when straight; unlike an arc cosine, it is exact near both ends."""
    return np.arctan2(norm(cross(a, b)), dot(a, b))


@njit(cache=True, inner=True)
def _point(points: Floats, k: int) -> Vector:
    return points[k, 0], points[k, 1], points[k, 2]


@njit(cache=True, inner=True)
def _from_to(a: Vector, b: Vector) -> Vector:
    return b[0] - a[0], b[1] - a[1], b[2] - a[2]


@njit(cache=True, inner=True)
def _middle(a: Vector, b: Vector) -> Vector:
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])
