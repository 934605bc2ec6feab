"""The cost of the trajectory generator, Eq. (66a)-(66c)."""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.records import Floats
from hrcreplay.robot.rotation import to_vector

#: Weight on the squared joint velocities, relative to the mean curvature of the cost. It makes the minimiser unique
#: where the paper's cost is flat (a stretched wrist: axes 4 and 6 turn against each other) and is too small to be
#: seen anywhere else.
DAMPING = 1e-6


def pose_error(T_world_tcp: Floats, T_world_ref: Floats) -> Floats:
    """(6,) from the reference to the TCP: way [m], then rotation vector in the world [rad]."""
    turn = to_vector(T_world_tcp[:3, :3] @ T_world_ref[:3, :3].T)
    return np.concatenate([T_world_tcp[:3, 3] - T_world_ref[:3, 3], turn])


@njit(cache=True)
def tracking_cost(
    error: Floats,
    J: Floats,
    dJdq: Floats,
    dq: Floats,
    twist_ref: Floats,
    q_p: tuple[float, float],
    q_v: tuple[float, float],
    path_gain_per_s: float,
    dt_s: float,
) -> tuple[Floats, Floats]:
    """Eq. (66a) as ``w @ H @ w / 2 + g @ w`` (and a constant, and a factor of 2) of the next joint velocity w.

    With the printed weights a position error changes the velocity by dt q_p / q_v of it, that is, it never decays; so
    ``path_gain_per_s`` times the error at this tick is taken off the reference velocity.

    Args:
        error: (6,) `pose_error` of the TCP at the tick and the reference one tick later [m, rad].
        J: (6, nv) Jacobian of the TCP, linear first [m/rad, rad/rad].
        dJdq: (6,) Jdot dq [m/s^2, rad/s^2].
        dq: (nv,) [rad/s].
        twist_ref: (6,) velocity of the reference, linear first [m/s, rad/s].
        q_p: Weights of the errors in position, translation and rotation, Eq. (71).
        q_v: Weights of the errors in velocity, Eq. (72).
        path_gain_per_s: 0 as printed [1/s].
        dt_s: Length of the tick [s].

    Returns:
        ``H`` (nv, nv), positive definite, and ``g`` (nv,).
    """
    nv = len(dq)
    H, g = np.zeros((nv, nv)), np.zeros(nv)
    for i in range(6):
        weight_p, weight_v = (q_p[0], q_v[0]) if i < 3 else (q_p[1], q_v[1])
        speed = 0.0
        for j in range(nv):
            speed += J[i, j] * dq[j]
        wanted = twist_ref[i] - path_gain_per_s * (error[i] + dt_s * twist_ref[i])
        rest_v = dt_s * dJdq[i] - wanted  # Eq. (66c): J w + rest_v
        rest_p = error[i] + 0.5 * dt_s * (speed + dt_s * dJdq[i])  # Eq. (66b): dt/2 J w + rest_p
        curvature = weight_v + 0.25 * dt_s**2 * weight_p
        slope = weight_v * rest_v + 0.5 * dt_s * weight_p * rest_p
        for j in range(nv):
            g[j] += slope * J[i, j]
            for k in range(nv):
                H[j, k] += curvature * J[i, j] * J[i, k]
    mean = 0.0
    for j in range(nv):
        mean += H[j, j] / nv
    for j in range(nv):
        H[j, j] += DAMPING * max(mean, 1e-6)
    return H, g
