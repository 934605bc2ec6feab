"""Forward kinematics of a serial chain of revolute axes: poses, Jacobians and their derivatives, as kernels.

The robot's model builds the chain once; these kernels run many times in a tick, also inside other kernels. They compute
in a fixed order of operations, so that the last bits do not depend on the processor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.vectors import Vector, cross, speed_of
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints


class Chain(NamedTuple):
    """Axes that follow one another, each the z axis of its own frame, and points that move with them."""

    frames: Floats  #: (nv, 3, 4) rotation and origin of an axis' frame at zero in the frame before, first the world [m]
    tcp: Floats  #: (3, 4) rotation and origin of the TCP in the frame of the last axis [m]
    points_m: Floats  #: (p, 3) points in the frames of the axes that carry them [m]
    carriers: Ints  #: (p,) index of the axis that carries each point; -1: the point stands, its frame is the world


class Arm(NamedTuple):
    """A robot as numbers for kernels."""

    chain: Chain
    radius_m: Floats  #: (s,) radii of the segments [m]
    axis_reach_m: Floats  #: (nv, s) upper bound of the distance from an axis to a segment's axis [m]
    q_min: Floats  #: (nv,) [rad]
    q_max: Floats  #: (nv,) [rad]
    dq_max: Floats  #: (nv,) [rad/s]
    ddq_max: Floats  #: (nv,) [rad/s^2]


class RobotPose(NamedTuple):
    """Kinematics that the controller needs at one instant, world frame. Rows of twists: linear, then angular."""

    T_world_tcp: Floats  #: (4, 4)
    J_tcp: Floats  #: (6, nv) velocity of the TCP's origin and angular velocity [m/rad, rad/rad]
    dJdq_tcp: Floats  # noqa: N815  #: (6,) acceleration of the TCP at zero joint acceleration [m/s^2, rad/s^2]
    ends_m: Floats  #: (s, 2, 3) ends of the segments [m]
    J_ends: Floats  #: (s, 2, 3, nv) their position Jacobians [m/rad]
    twist_tcp: Floats  #: (6,) velocity of the TCP at the pose's joint velocities [m/s, rad/s]

    @property
    def tcp_speed(self) -> float:
        """Speed of the TCP [m/s]."""
        return speed_of(self.twist_tcp)


@njit(cache=True)
def axis_frames(chain: Chain, q: Floats) -> Floats:
    """(nv, 3, 4) rotations and origins of the axes' frames in the world [m], for joint positions (nv,) [rad]."""
    found = np.empty((len(q), 3, 4))
    for j in range(len(q)):
        c, s, local = math.cos(q[j]), math.sin(q[j]), chain.frames[j]
        for i in range(3):
            x, y, z, at = local[i, 0], local[i, 1], local[i, 2], local[i, 3]
            if j > 0:
                before = found[j - 1, i]
                x, y, z = _row(before, local, 0), _row(before, local, 1), _row(before, local, 2)
                at = _row(before, local, 3) + before[3]
            found[j, i, 0], found[j, i, 1], found[j, i, 2], found[j, i, 3] = c * x + s * y, c * y - s * x, z, at
    return found


@njit(cache=True, inner=True)
def _row(row: Floats, local: Floats, column: int) -> float:
    """An element of the product of a rotation's row and the rotation or origin of a frame."""
    return row[0] * local[0, column] + row[1] * local[1, column] + row[2] * local[2, column]


@njit(cache=True, inner=True)
def segment_ends(chain: Chain, frames: Floats) -> Floats:
    """(s, 2, 3) ends of the segments in the world [m], for the axes' frames."""
    ends = np.empty((len(chain.points_m) // 2, 2, 3))
    for n in range(len(chain.points_m)):
        p, on = chain.points_m[n], chain.carriers[n]
        for i in range(3):
            if on < 0:
                ends[n // 2, n % 2, i] = p[i]
            else:
                R = frames[on, i]
                ends[n // 2, n % 2, i] = R[0] * p[0] + R[1] * p[1] + R[2] * p[2] + R[3]
    return ends


@njit(cache=True)
def ends_at(chain: Chain, q: Floats) -> Floats:
    """(s, 2, 3) ends of the segments in the world [m], for joint positions (nv,) [rad]."""
    return segment_ends(chain, axis_frames(chain, q))


@njit(cache=True, inner=True)
def tcp_jacobian(chain: Chain, frames: Floats) -> tuple[Floats, Floats]:
    """(4, 4) pose of the TCP [m] and its (6, nv) Jacobian [m/rad, rad/rad], for the axes' frames."""
    nv = len(frames)
    T, J = np.zeros((4, 4)), np.empty((6, nv))
    T[3, 3] = 1.0
    for i in range(3):
        for k in range(4):
            T[i, k] = _row(frames[nv - 1, i], chain.tcp, k)
        T[i, 3] += frames[nv - 1, i, 3]
    for j in range(nv):
        moved = _moved(frames[j], T[0, 3], T[1, 3], T[2, 3])
        for i in range(3):
            J[i, j], J[3 + i, j] = moved[i], frames[j, i, 2]
    return T, J


@njit(cache=True, inner=True)
def _moved(frame: Floats, x: float, y: float, z: float) -> Vector:
    """Velocity of a point of the world that turns about an axis at 1 rad/s [m/s]."""
    return cross((frame[0, 2], frame[1, 2], frame[2, 2]), (x - frame[0, 3], y - frame[1, 3], z - frame[2, 3]))


@njit(cache=True)
def pose_at(chain: Chain, q: Floats, dq: Floats) -> RobotPose:
    """Forward kinematics, Jacobians and Jdot dq of Eq. (66b), corrected (docs/paper.md), and Eq. (66c), at one instant.

    Args:
        chain: Axes and points.
        q: (nv,) [rad].
        dq: (nv,) [rad/s].
    """
    frames, nv = axis_frames(chain, q), len(q)
    T, J = tcp_jacobian(chain, frames)
    ends, J_ends = segment_ends(chain, frames), np.zeros((len(chain.points_m) // 2, 2, 3, nv))
    for n in range(len(chain.points_m)):
        p = ends[n // 2, n % 2]
        for j in range(chain.carriers[n] + 1):
            moved = _moved(frames[j], p[0], p[1], p[2])
            for i in range(3):
                J_ends[n // 2, n % 2, i, j] = moved[i]
    twist = np.zeros(6)
    for i in range(6):
        for j in range(nv):
            twist[i] += J[i, j] * dq[j]
    return RobotPose(T, J, _drift(frames, T, twist, dq), ends, J_ends, twist)


@njit(cache=True, inner=True)
def _drift(frames: Floats, T: Floats, twist: Floats, dq: Floats) -> Floats:
    """(6,) Jdot dq of Eq. (66b), (66c): acceleration of the TCP at zero joint acceleration [m/s^2, rad/s^2].

    The direction z of an axis changes by w x z, with the angular velocity w of the axes before it, and its origin moves
    with velocity v. So z x (p - o) changes by (w x z) x (p - o) + z x (v_p - v).
    """
    found = np.zeros(6)
    w, v, before = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for j in range(len(frames)):
        z = (frames[j, 0, 2], frames[j, 1, 2], frames[j, 2, 2])
        o = (frames[j, 0, 3], frames[j, 1, 3], frames[j, 2, 3])
        turned = cross(w, (o[0] - before[0], o[1] - before[1], o[2] - before[2]))
        v = (v[0] + turned[0], v[1] + turned[1], v[2] + turned[2])
        dz = cross(w, z)
        bent = cross(dz, (T[0, 3] - o[0], T[1, 3] - o[1], T[2, 3] - o[2]))
        apart = cross(z, (twist[0] - v[0], twist[1] - v[1], twist[2] - v[2]))
        for i in range(3):
            found[i] += (bent[i] + apart[i]) * dq[j]
            found[3 + i] += dz[i] * dq[j]
        w = (w[0] + z[0] * dq[j], w[1] + z[1] * dq[j], w[2] + z[2] * dq[j])
        before = o
    return found


@njit(cache=True)
def motion_of_links(chain: Chain, q: Floats, dq: Floats) -> tuple[Floats, Floats]:
    """Ends of the segments (n, s, 2, 3) [m] and their twists (n, s, 6) at many instants.

    A twist is the velocity of the link's point at the world's origin, then the angular velocity [m/s, rad/s].

    Args:
        chain: Axes and points.
        q: (n, nv) [rad].
        dq: (n, nv) [rad/s].
    """
    links = len(chain.points_m) // 2
    ends, twists = np.empty((len(q), links, 2, 3)), np.zeros((len(q), links, 6))
    for k in range(len(q)):
        frames = axis_frames(chain, q[k])
        ends[k] = segment_ends(chain, frames)
        for s in range(links):
            for j in range(chain.carriers[2 * s] + 1):
                moved = _moved(frames[j], 0.0, 0.0, 0.0)
                for i in range(3):
                    twists[k, s, i] += moved[i] * dq[k, j]
                    twists[k, s, 3 + i] += frames[j, i, 2] * dq[k, j]
    return ends, twists
