"""Whether a motion of the IRB 140 keeps inequality (2). Shares no code with the controller, not even the robot.

The arm's kinematics come straight from its DH table, velocities of points from angular velocities carried outwards
joint by joint; the separation is taken point by point against every vertex.
"""

from __future__ import annotations

from dataclasses import dataclass

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
    """Ends of the five links in the world and their velocities, (5, 2, 3) each [m, m/s]."""
    R, p = T_world_base[:3, :3].copy(), T_world_base[:3, 3].copy()
    v, w = np.zeros(3), np.zeros(3)
    first = p + R @ np.array([0.0, 0.0, 0.352])  # on axis 1: does not move
    at, moving = [first], [np.zeros(3)]
    for i, (d, a, alpha, zero) in enumerate(DH):
        w = w + R[:, 2] * dq[i]
        theta = q[i] + zero
        turned = R @ np.array(
            [[np.cos(theta), -np.sin(theta), 0.0], [np.sin(theta), np.cos(theta), 0.0], [0.0, 0.0, 1.0]]
        )
        way = R[:, 2] * d + turned[:, 0] * a
        p, v = p + way, v + np.cross(w, way)
        R = turned @ np.array(
            [[1.0, 0.0, 0.0], [0.0, np.cos(alpha), -np.sin(alpha)], [0.0, np.sin(alpha), np.cos(alpha)]]
        )
        if i in (0, 1, 3, 5):  # axis 2, axis 3, wrist centre, flange
            at.append(p)
            moving.append(v)
    tool = R[:, 2] * tool_m
    at.append(p + tool)
    moving.append(v + np.cross(w, tool))
    ends = np.array([[at[i], at[i + 1]] for i in range(5)])
    speeds = np.array([[moving[i], moving[i + 1]] for i in range(5)])
    return ends, speeds


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
    share = np.linspace(0.0, 1.0, POINTS)[:, None]
    for tick in np.flatnonzero(np.asarray(status) != BRAKING):
        ends, speeds = links(q[tick], dq[tick] + dt_s * u[tick], T_world_base, tool_m)
        limbs = [volumes.vertices(int(tick), limb) for limb in range(len(volumes.limbs))]
        vertices = np.concatenate(limbs)
        limb_of = np.repeat(np.arange(len(limbs)), [len(limb) for limb in limbs])
        for link in range(5):
            r_s = ends[link, 0] + share * (ends[link, 1] - ends[link, 0])
            v_s = speeds[link, 0] + share * (speeds[link, 1] - speeds[link, 0])
            delta = RADII[link] + volumes.radius_m[tick, limb_of] + clearance_m
            way = vertices[None] - r_s[:, None]
            rho = np.linalg.norm(way, axis=2)
            left = stop_s * np.einsum("pi,pmi->pm", v_s, way) / rho
            excess = left - np.maximum(0.0, rho - delta)
            if excess.max() > worst.metres:
                where = int(excess.max(axis=0).argmax())
                worst = Violation(float(excess.max()), int(tick), link, int(limb_of[where]))
    return worst
