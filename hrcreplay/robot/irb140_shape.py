"""The look of the ABB IRB 140, for drawings alone: convex solids around the axes of its published dimensions.

The axes are those of ``irb140``; the widths of castings, drums and motors are estimates of this project that make the
robot recognisable. No distance is measured from these solids: that needs the capsules of the links.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.vectors import dot_n
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.irb140 import AXES

_CORNERS = 32  # of an outline
_REACH_M = AXES[3].offset_m[0]  # from axis 3 to the wrist centre
_UPPER_M = AXES[2].offset_m[2]  # from axis 2 to axis 3
_SHOULDER_M = AXES[1].offset_m[0]  # from axis 1 to axis 2
_HEIGHT_M = AXES[0].offset_m[2]  # of axis 2 above the base


class Solid(NamedTuple):
    """A convex solid that moves with a body of the robot."""

    axes: int  #: number of axes, counted from the base, that move it
    vertices_m: Floats  #: (k, 3) in the frame of the base, with all axes at zero [m]
    triangles: Ints  #: (t, 3) indices of vertices, counterclockwise seen from outside


@cache
def solids() -> tuple[Solid, ...]:
    """Returns all solids: base, turning column, upper arm, elbow, forearm, wrist and flange."""
    starts = np.cumsum([(0.0, 0.0, 0.0), *(axis.offset_m for axis in AXES)], axis=0)
    parts = (_base(), _column(), _upper_arm(), _elbow(), _forearm(), _wrist(), _flange())
    return tuple(
        Solid(axes, *_between(first + starts[axes], second + starts[axes]))
        for axes, loops in enumerate(parts)
        for first, second in loops
    )


_Loops = Iterator[tuple[Floats, Floats]]


def _base() -> _Loops:
    """The foot and the cast base, with its sockets behind; from the floor to the turning column."""
    yield _flat((0.0, 0.0, 0.0), 2, 0.200, 0.170, 0.25), _flat((0.0, 0.0, 0.025), 2, 0.200, 0.170, 0.25)
    yield _flat((-0.02, 0.0, 0.025), 2, 0.165, 0.140, 0.4), _flat((0.0, 0.0, 0.150), 2, 0.135, 0.135, 1.0)
    yield _flat((-0.24, 0.0, 0.080), 0, 0.060, 0.045, 0.3), _flat((-0.10, 0.0, 0.080), 0, 0.085, 0.055, 0.3)


def _column() -> _Loops:
    """What turns about axis 1: a disc, a casting that leans forward, the drum of axis 2 and its motor."""
    low = 0.150 - _HEIGHT_M
    yield _flat((0.0, 0.0, low), 2, 0.140, 0.140, 1.0), _flat((0.0, 0.0, low + 0.035), 2, 0.140, 0.140, 1.0)
    yield (
        _flat((0.0, 0.01, low + 0.035), 2, 0.125, 0.105, 0.6),
        _flat((_SHOULDER_M, 0.01, 0.040), 2, 0.075, 0.065, 0.6),
    )
    yield _drum((_SHOULDER_M, 0.0, 0.0), 0.098, -0.070, 0.085)
    yield _drum((_SHOULDER_M, 0.0, 0.0), 0.060, 0.085, 0.155)
    yield _flat((-0.150, 0.035, -0.070), 0, 0.045, 0.050, 0.6), _flat((-0.02, 0.035, -0.070), 0, 0.050, 0.055, 0.6)


def _upper_arm() -> _Loops:
    """The slender plate beside the column, from axis 2 to axis 3, with its covers."""
    yield _plate(0.090, 0.074, _UPPER_M, -0.130, -0.072)
    yield _drum((0.0, 0.0, 0.0), 0.066, -0.146, -0.130)
    yield _drum((0.0, 0.0, _UPPER_M), 0.054, -0.146, -0.130)


def _elbow() -> _Loops:
    """The drum of axis 3, the housing of the wrist's motors behind it, and the neck of the forearm."""
    yield _drum((0.0, 0.0, 0.0), 0.080, -0.070, 0.080)
    yield _flat((-0.105, 0.0, 0.010), 0, 0.072, 0.072, 0.5), _flat((0.070, 0.0, 0.005), 0, 0.078, 0.080, 0.7)
    for y, z in ((0.036, 0.030), (-0.036, 0.030), (0.0, -0.035)):
        yield _flat((-0.150, y, z), 0, 0.030, 0.030, 1.0), _flat((-0.100, y, z), 0, 0.030, 0.030, 1.0)
    yield _flat((0.070, 0.0, 0.0), 0, 0.072, 0.074, 0.8), _flat((0.170, 0.0, 0.0), 0, 0.056, 0.056, 1.0)


def _forearm() -> _Loops:
    """The tube that turns about axis 4, and the fork that holds the wrist."""
    back = 0.170 - _REACH_M
    yield _flat((back, 0.0, 0.0), 0, 0.054, 0.054, 1.0), _flat((-0.075, 0.0, 0.0), 0, 0.050, 0.046, 0.8)
    for y in (-0.050, 0.034):
        yield (
            _flat((-0.075, y + 0.008, 0.0), 0, 0.008, 0.042, 0.6),
            _flat((0.030, y + 0.008, 0.0), 0, 0.008, 0.034, 0.8),
        )


def _wrist() -> _Loops:
    """The drum of axis 5 between the fork, and its nose."""
    yield _drum((0.0, 0.0, 0.0), 0.038, -0.034, 0.034)
    yield _flat((0.0, 0.0, 0.0), 0, 0.030, 0.034, 0.8), _flat((0.045, 0.0, 0.0), 0, 0.030, 0.030, 1.0)


def _flange() -> _Loops:
    """The disc that carries the tool."""
    yield _flat((-0.020, 0.0, 0.0), 0, 0.028, 0.028, 1.0), _flat((0.0, 0.0, 0.0), 0, 0.031, 0.031, 1.0)


def _flat(centre_m: tuple[float, float, float], axis: int, half_a_m: float, half_b_m: float, power: float) -> Floats:
    """Returns an outline (_CORNERS, 3) across x (axis 0) or z (axis 2): a superellipse; power 1 is an ellipse [m]."""
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    across = [
        half * np.sign(f(angle)) * np.abs(f(angle)) ** power for half, f in ((half_a_m, np.cos), (half_b_m, np.sin))
    ]
    loop = np.tile(np.array(centre_m), (_CORNERS, 1))
    for k, column in zip((1, 2) if axis == 0 else (0, 1), across, strict=True):
        loop[:, k] += column
    return loop


def _drum(centre_m: tuple[float, float, float], radius_m: float, low_m: float, high_m: float) -> tuple[Floats, Floats]:
    """Returns the two outlines of a cylinder along y, from ``low_m`` to ``high_m`` of its centre."""
    return _plate(radius_m, radius_m, 0.0, low_m, high_m, centre_m)


def _plate(
    low_radius_m: float,
    high_radius_m: float,
    length_m: float,
    low_m: float,
    high_m: float,
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[Floats, Floats]:
    """Returns the two outlines of a plate with round ends across y, along z from its centre."""
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False) + np.pi / _CORNERS
    upper = np.sin(angle) > 0.0
    radius = np.where(upper, high_radius_m, low_radius_m)
    across = np.column_stack([radius * np.cos(angle), np.zeros(_CORNERS), radius * np.sin(angle) + length_m * upper])
    first, second = (across + np.array(centre_m) + [0.0, y, 0.0] for y in (low_m, high_m))
    return first, second


def _between(first: Floats, second: Floats) -> tuple[Floats, Ints]:
    """Returns vertices and outward triangles of the solid between two outlines with as many corners."""
    count = len(first)
    here, after = np.arange(count), (np.arange(count) + 1) % count
    sides = np.concatenate(
        [np.column_stack([here, after, after + count]), np.column_stack([here, after + count, here + count])]
    )
    fan = np.column_stack([np.zeros(count - 2, np.int64), here[1:-1], here[2:]])
    triangles = np.concatenate([sides, fan[:, ::-1], fan + count]).astype(np.int64)
    vertices = np.concatenate([first, second])
    a, b, c = ((vertices - vertices.mean(axis=0))[triangles[:, k]] for k in range(3))
    volume = sum(dot_n(row, normal) for row, normal in zip(a, np.cross(b, c), strict=True))
    return vertices, triangles if volume > 0.0 else triangles[:, ::-1]
