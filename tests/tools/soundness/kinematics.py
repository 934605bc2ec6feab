"""Where the human model puts the ends of the limbs: one point at a time, turned from the limb to the world."""

from __future__ import annotations

import math

from hrcreplay.records import Floats
from tests.tools.soundness.compiled import kernel

#: Points of the body; a tip is the wrist, or beyond it the hand's end; ``floor`` is below the pelvis.
POINTS = ("neck", "head", "pelvis", "shoulder_r", "elbow_r", "tip_r", "shoulder_l", "elbow_l", "tip_l", "floor")

#: Corners of each limb. What is between them lies in every convex set that holds them.
CORNERS = {
    "HD": ("neck", "head"),
    "THX": ("pelvis", "shoulder_r", "shoulder_l"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "tip_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "tip_l"),
    "LEGS": ("pelvis", "floor"),
}

Point = tuple[float, float, float]


@kernel
def body(q: Floats, lengths: Floats, hand: float, points: Floats) -> None:
    """Writes POINTS (10, 3), world [m].

    Args:
        q: (13,) JOINTS [m, m, rad...].
        lengths: (7,) LENGTHS [m].
        hand: Length of the hand, in line with the forearm [m].
        points: Receives the result.
    """
    rho, theta = turn(q[3]), turn(q[2])
    torso, half_shoulder = lengths[0], lengths[2]
    _put(points, 0, to_world((0.0, 0.0, torso), rho, theta, q))
    _put(points, 1, to_world((0.0, 0.0, torso + lengths[1]), rho, theta, q))
    _put(points, 2, (q[0], q[1], q[12]))
    _put(points, 9, (q[0], q[1], 0.0))
    for arm in range(2):  # right, left
        s = 1.0 if arm else -1.0
        upper, forearm = lengths[4 - arm], lengths[6 - arm]
        j = 4 + 4 * arm
        flexion, abduction = turn(-q[j + 1]), turn(s * q[j])
        shoulder = (0.0, s * half_shoulder, torso)
        elbow = add(shoulder, about_x(about_y((0.0, 0.0, -upper), flexion), abduction))
        tip = about_z(about_y((0.0, 0.0, -forearm - hand), turn(q[j + 3] - math.pi)), turn(s * q[j + 2]))
        tip = add((0.0, 0.0, -upper), tip)
        tip = add(shoulder, about_x(about_y(tip, flexion), abduction))
        _put(points, 3 + 3 * arm, to_world(shoulder, rho, theta, q))
        _put(points, 4 + 3 * arm, to_world(elbow, rho, theta, q))
        _put(points, 5 + 3 * arm, to_world(tip, rho, theta, q))


@kernel
def turn(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)


@kernel
def about_x(p: Point, by: tuple[float, float]) -> Point:
    return p[0], by[0] * p[1] - by[1] * p[2], by[1] * p[1] + by[0] * p[2]


@kernel
def about_y(p: Point, by: tuple[float, float]) -> Point:
    return by[0] * p[0] + by[1] * p[2], p[1], by[0] * p[2] - by[1] * p[0]


@kernel
def about_z(p: Point, by: tuple[float, float]) -> Point:
    return by[0] * p[0] - by[1] * p[1], by[1] * p[0] + by[0] * p[1], p[2]


@kernel
def add(a: Point, b: Point) -> Point:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@kernel
def to_world(p: Point, rho: tuple[float, float], theta: tuple[float, float], q: Floats) -> Point:
    """From the torso's frame, whose origin is the pelvis."""
    return add((q[0], q[1], q[12]), about_z(about_y(p, rho), theta))


@kernel
def _put(points: Floats, row: int, p: Point) -> None:
    points[row, 0], points[row, 1], points[row, 2] = p
