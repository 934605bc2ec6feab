"""Joint positions for a pose of the TCP: damped least squares from fixed seeds.

The seeds make it deterministic: the same pose, coming from the same place, has the same answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.geometry.vectors import to_vector
from hrcreplay.records import Floats
from hrcreplay.robot.model import RobotModel

_SEEDS = 16
_ITERATIONS = 80
_TOLERANCE = 1e-9  # of position [m] and orientation [rad]


@dataclass(frozen=True)
class Missed:
    """No joint position was found: how near the best one came."""

    position_m: float
    angle_rad: float


def solve(model: RobotModel, T_world_tcp: Floats, near: Floats) -> Floats | Missed:
    """The joint position within the limits that reaches a pose with the least way, in time, from ``near``.

    Args:
        model: The robot.
        T_world_tcp: (4, 4) pose to reach, world frame [m].
        near: (nv,) where the robot comes from [rad].

    Returns:
        (nv,) [rad], or how near the best attempt came.
    """
    found: list[Floats] = []
    missed = Missed(np.inf, np.inf)
    for seed in (near, *_seeds(model)):
        q, error = descend(model, T_world_tcp, seed)
        if np.abs(error).max() <= _TOLERANCE:
            found.append(_unwind(model, q, near))
        else:
            missed = min(
                missed,
                Missed(float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))),
                key=lambda m: m.position_m + m.angle_rad,
            )
    return min(found, key=lambda q: float(np.abs((q - near) / model.dq_max).max())) if found else missed


def descend(model: RobotModel, T_world_tcp: Floats, seed: Floats) -> tuple[Floats, Floats]:
    """Damped least squares within the limits from one seed.

    Args:
        model: The robot.
        T_world_tcp: (4, 4) pose to reach, world frame [m].
        seed: (nv,) [rad].

    Returns:
        (nv,) where it ended [rad] and the (6,) pose error left there [m, rad].
    """
    q, still = seed, np.zeros(model.nv)
    for _ in range(_ITERATIONS):
        pose = model.pose(q, still)
        q_next, error = _step(q, pose.J_tcp, pose.T_world_tcp, T_world_tcp, model.q_min, model.q_max)
        if np.abs(error).max() <= _TOLERANCE * 1e-2 or np.array_equal(q_next, q):
            break
        q = q_next
    return q, error


def _step(q: Floats, J: Floats, T: Floats, T_goal: Floats, q_min: Floats, q_max: Floats) -> tuple[Floats, Floats]:
    error = np.empty(6)
    error[:3] = T_goal[:3, 3] - T[:3, 3]
    error[3:] = to_vector(T_goal[:3, :3] @ T[:3, :3].T)
    damping = 0.1 * (error @ error) + 1e-12  # vanishes at the solution: Newton's speed there
    dq = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), error)
    return np.minimum(np.maximum(q + dq, q_min), q_max), error


def _seeds(model: RobotModel) -> Floats:
    """(n, nv) joint positions spread evenly over the ranges by the recurrence of the generalised golden ratio."""
    ratio = 2.0
    for _ in range(60):
        ratio = (1 + ratio) ** (1 / (model.nv + 1))
    share = (0.5 + np.outer(np.arange(1, _SEEDS + 1), ratio ** -np.arange(1.0, model.nv + 1))) % 1
    low, high = np.maximum(model.q_min, -np.pi), np.minimum(model.q_max, np.pi)
    return np.where(low < high, low + share * (high - low), model.q_min)


def _unwind(model: RobotModel, q: Floats, near: Floats) -> Floats:
    """The same place with every axis on the turn that is nearest to ``near`` and within its range."""
    turn = 2 * np.pi
    turns = np.round((near - q) / turn)
    fewest = np.ceil((model.q_min - q) / turn)
    most = np.floor((model.q_max - q) / turn)
    return q + turn * np.clip(turns, fewest, most)
