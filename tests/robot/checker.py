"""Whether a motion of the IRB 140 keeps inequality (2). Shares no code with the controller, not even the robot.

The arm's kinematics come straight from its DH table, velocities of points from angular velocities carried outwards
joint by joint; the separation is taken point by point against every vertex.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from hrcreplay.records import Floats, Ints, SweptVolumes

#: d, a [m] and alpha, theta at zero [rad] of each axis.
DH = (
    (0.352, 0.070, -np.pi / 2, 0.0),
    (0.0, 0.360, 0.0, -np.pi / 2),
    (0.0, 0.0, np.pi / 2, np.pi),
    (0.380, 0.0, -np.pi / 2, 0.0),
    (0.0, 0.0, np.pi / 2, 0.0),
    (0.065, 0.0, 0.0, 0.0),
)

#: Radius of the links [m], from the shoulder to the tool.
RADII = (0.219, 0.152, 0.118, 0.077, 0.045)

#: Points on each link that are looked at.
POINTS = 20

BRAKING = 2


@dataclass(frozen=True)
class Violation:
    """The worst of a motion."""

    metres: float  #: left side less right side of inequality (2); not positive where it holds [m]
    tick: int
    link: int
    limb: int


def links(q: Floats, dq: Floats, T_world_base: Floats, tool_m: float) -> tuple[Floats, Floats]:
    """Ends of the five links in the world and their velocities at n ticks, (n, 5, 2, 3) each [m, m/s]."""
    n = len(q)
    R, p = np.tile(T_world_base[:3, :3], (n, 1, 1)), np.tile(T_world_base[:3, 3], (n, 1))
    v, w = np.zeros((n, 3)), np.zeros((n, 3))
    at, moving = [p + 0.352 * R[:, :, 2]], [v]  # on axis 1: does not move
    for i, (d, a, alpha, zero) in enumerate(DH):
        w = w + R[:, :, 2] * dq[:, i, None]
        turned = R @ _about_z(q[:, i] + zero)
        way = R[:, :, 2] * d + turned[:, :, 0] * a
        p, v = p + way, v + np.cross(w, way)
        R = turned @ np.array(
            [[1.0, 0.0, 0.0], [0.0, np.cos(alpha), -np.sin(alpha)], [0.0, np.sin(alpha), np.cos(alpha)]]
        )
        if i in (0, 1, 3, 5):  # axis 2, axis 3, wrist centre, flange
            at.append(p)
            moving.append(v)
    tool = R[:, :, 2] * tool_m
    at.append(p + tool)
    moving.append(v + np.cross(w, tool))
    ends, speeds = np.stack(at, axis=1), np.stack(moving, axis=1)
    return np.stack([ends[:, :-1], ends[:, 1:]], axis=2), np.stack([speeds[:, :-1], speeds[:, 1:]], axis=2)


def _about_z(angle: Floats) -> Floats:
    """(n, 3, 3) rotations about the z-axis by (n,) angles [rad]."""
    R = np.zeros((len(angle), 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = np.cos(angle)
    R[:, 1, 0] = np.sin(angle)
    R[:, 0, 1] = -R[:, 1, 0]
    R[:, 2, 2] = 1.0
    return R


def violation(
    q: Floats,
    dq: Floats,
    u: Floats,
    status: Ints | Floats,
    volumes: SweptVolumes,
    T_world_base: Floats,
    *,
    dt_s: float,
    stop_s: float,
    clearance_m: float = 0.0,
    tool_m: float = 0.10,
) -> Violation:
    """The worst violation of inequality (2) over all ticks that are not braking.

    The links are those of q_k, their velocities those of dq_k + dt u_k, the volumes those of tick k.

    Args:
        q: (n, 6) [rad].
        dq: (n, 6) [rad/s].
        u: (n, 6) [rad/s^2].
        status: (n,) index into ``records.STATUSES``.
        volumes: n ticks.
        T_world_base: (4, 4).
        dt_s: Length of a tick [s].
        stop_s: T_s [s].
        clearance_m: Beyond limb radius + link radius [m].
        tool_m: TCP beyond the flange [m].
    """
    worst = Violation(-np.inf, -1, -1, -1)
    ticks = np.flatnonzero(np.asarray(status) != BRAKING)
    ends, speeds = links(q[ticks], (dq + dt_s * u)[ticks], T_world_base, tool_m)
    share = np.linspace(0.0, 1.0, POINTS)[:, None]
    r_s = (ends[:, :, :1] + share * (ends[:, :, 1:] - ends[:, :, :1])).reshape(len(ticks), -1, 3)
    v_s = (speeds[:, :, :1] + share * (speeds[:, :, 1:] - speeds[:, :, :1])).reshape(len(ticks), -1, 3)
    link_of = np.repeat(np.arange(len(RADII)), POINTS)
    radius_m = np.array(RADII)[link_of] + clearance_m
    for tick, r, v in zip(ticks.tolist(), r_s, v_s, strict=True):
        limbs = [volumes.vertices(tick, limb) for limb in range(len(volumes.limbs))]
        limb_of = np.repeat(np.arange(len(limbs)), [len(limb) for limb in limbs])
        metres, point, vertex = _worst_excess(
            r, v, np.concatenate(limbs), radius_m, volumes.radius_m[tick][limb_of], stop_s
        )
        if metres > worst.metres:
            worst = Violation(metres, tick, int(link_of[point]), int(limb_of[vertex]))
    return worst


@numba.njit
def _worst_excess(
    r: Floats, v: Floats, vertices: Floats, link_m: Floats, limb_m: Floats, stop_s: float
) -> tuple[float, int, int]:
    """The most by which the left side of inequality (2) exceeds the right, each point against each vertex.

    Args:
        r: (p, 3) points of the links [m].
        v: (p, 3) their velocities [m/s].
        vertices: (m, 3) of the limbs [m].
        link_m: (p,) radius of the link, with the clearance [m].
        limb_m: (m,) radius of the limb [m].
        stop_s: T_s [s].

    Returns:
        The excess [m], and the point and the vertex at which it is; -inf where nobody is known (NaN).
    """
    worst, at_point, at_vertex = -np.inf, -1, -1
    for i in range(len(r)):
        for j in range(len(vertices)):
            x, y, z = vertices[j, 0] - r[i, 0], vertices[j, 1] - r[i, 1], vertices[j, 2] - r[i, 2]
            rho = math.sqrt(x * x + y * y + z * z)
            left = stop_s * (v[i, 0] * x + v[i, 1] * y + v[i, 2] * z) / rho
            excess = left - max(0.0, rho - link_m[i] - limb_m[j])
            if excess > worst:
                worst, at_point, at_vertex = excess, i, j
    return worst, at_point, at_vertex
