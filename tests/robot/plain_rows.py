"""The approach rows of one link and one volume written down, Eq. (12)-(16), as the paper derives them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.records import Floats
from hrcreplay.robot.kinematics import RobotPose


@dataclass(frozen=True, slots=True)
class LinkSegment:
    """The axis of one link at one instant, world frame. Both ends belong to the same body."""

    a_m: Floats  #: (3,) first end [m]
    b_m: Floats  #: (3,) other end [m]
    J_a: Floats  #: (3, nv) position Jacobian of the first end [m/rad]
    J_b: Floats  #: (3, nv) of the other [m/rad]


@dataclass(frozen=True, slots=True)
class Rows:
    """Bounds ``A @ dq_next <= b``."""

    A: Floats  #: (m, nv)
    b: Floats  #: (m,)


def link_segment(pose: RobotPose, link: int) -> LinkSegment:
    """The axis of one link of a pose."""
    return LinkSegment(*pose.ends_m[link], *pose.J_ends[link])


def approach_rows(
    link: LinkSegment, vertices_m: Floats, distance_m: float, *, clearance_m: float, stop_s: float
) -> Rows:
    """Speed rows that keep one link clear of one swept volume, Eq. (12)-(16), corrected.

    Args:
        link: End points in the world [m] and their position Jacobians (3, nv) [m/rad].
        vertices_m: (m, 3) vertices of the swept volume, world frame [m].
        distance_m: Smallest distance between the link's axis and the volume [m].
        clearance_m: Limb radius + link radius + extra clearance [m].
        stop_s: Worst-case braking time T_s [s].

    Returns:
        ``A`` (2m, nv) [m^2 s/rad] and ``b`` (2m,) [m^2] with ``A @ dq_next <= b``.
    """
    rhs_m2 = max(0.0, distance_m - clearance_m) ** 2  # Eq. (10): squared, so m^2
    from_a = vertices_m - link.a_m
    rows_a = from_a @ link.J_a  # Eq. (12), first row
    rows_b = from_a @ link.J_b - (link.b_m - link.a_m) @ link.J_a  # Eq. (12), second row
    A = stop_s * np.vstack([rows_a, rows_b])  # Eq. (66i), corrected: T_s belongs here
    return Rows(A=A, b=np.full(len(A), rhs_m2))
