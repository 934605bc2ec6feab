"""Swept volumes by three methods from the literature, implemented from their definitions, for comparison.

All methods get the same input, the fused posture and its velocity, and give the limbs the same thickness.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.errors import SettingsError
from hrcreplay.human.model import ARM_POINTS, HEAD, NECK, PELVIS, skeleton
from hrcreplay.records import LIMBS, Floats, HumanStates, SweptVolumes

BASELINES = ("constant_velocity", "v2_a50", "iso_13855")

#: Bounds of ``v2_a50`` on a point of the body [m/s], [m/s^2].
_SPEED, _ACCELERATION = 2.0, 50.0
#: Approach speeds of ISO 13855 per limb: of walking for the body, of the upper limbs for the arms [m/s].
_APPROACH = np.array([1.6, 1.6, 2.0, 2.0, 2.0, 2.0])
#: Time step of the difference that gives the ends' velocities [s].
_STEP_S = 1e-4


def predict(states: HumanStates, *, horizon_s: float, radii_m: Floats, hand_m: float, method: str) -> SweptVolumes:
    """Computes the swept volumes of a baseline: the hull of the points that each limb's ends can reach.

    ``constant_velocity``: the limb now and after the horizon, with its ends at constant velocity. ``v2_a50``: every
    motion of the ends with speeds up to 2 m/s and accelerations up to 50 m/s^2 from their present velocity, as in
    capsule-based reachability analysis: the velocity is in a ball of radius a t around the present one, and in a ball
    of radius v around 0; up to t' = v/a the first is the smaller, then the second. So an end is within a t'^2 / 2 + v
    (T_s - t') of its position at constant velocity at t'. A faster present velocity counts as 2 m/s. ``iso_13855``: a
    ball of 1.6 m/s times the horizon around head and thorax, of 2.0 m/s around the arms.

    Args:
        states: The fused person.
        horizon_s: Braking time T_s of the robot [s].
        radii_m: (6,) radii of LIMBS, Table 2 [m].
        hand_m: Length of the lower arm beyond the wrist [m].
        method: One of PEERS.

    Returns:
        Volumes of LIMBS; a limb of a person who is not known yet has NaN vertices.

    Raises:
        SettingsError: The method is unknown.
    """
    if method not in BASELINES:
        raise SettingsError(f"peer: found {method!r}; choose one of {', '.join(BASELINES)}")
    now = ends(states.p, states.lengths_m, hand_m)
    grown = np.zeros(len(LIMBS))
    if method == "iso_13855":
        sets = now
        grown = _APPROACH * horizon_s
    else:
        velocities = _velocities(states, hand_m)
        if method == "constant_velocity":
            sets = [np.concatenate([p, p + v * horizon_s], axis=1) for p, v in zip(now, velocities, strict=True)]
        else:
            sets, reach_m = _accelerated(now, velocities, horizon_s)
            grown += reach_m
    counts = np.tile([part.shape[1] for part in sets], len(states))
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    vertices = np.concatenate(sets, axis=1).reshape(-1, 3)
    radius = np.tile(radii_m + grown, (len(states), 1))
    return SweptVolumes(states.t_ns, offsets, vertices, radius, LIMBS, method)


def ends(p: Floats, lengths_m: Floats, hand_m: float) -> list[Floats]:
    """Returns, per limb of LIMBS, the points (n, 2 or 3, 3) whose hull is its axis, world [m].

    Head: neck, head. Thorax: pelvis, shoulders. Upper arm: shoulder, elbow. Lower arm: elbow, tip of the hand.

    Args:
        p: (n, 13) JOINTS [m, m, rad..., m].
        lengths_m: (n, 7) LENGTHS [m].
        hand_m: Length of the hand in the forearm's direction [m].
    """
    points = skeleton(p, lengths_m)
    found = [points[:, (NECK, HEAD)], points[:, (PELVIS, ARM_POINTS[0][0], ARM_POINTS[1][0])]]
    for shoulder, elbow, wrist in ARM_POINTS:
        forearm = points[:, wrist] - points[:, elbow]
        length = np.linalg.norm(forearm, axis=1, keepdims=True)
        tip = points[:, wrist] + hand_m * forearm / np.where(length > 0.0, length, np.nan)  # no forearm, no direction
        found += [points[:, (shoulder, elbow)], np.stack([points[:, elbow], tip], axis=1)]
    return found


def _velocities(states: HumanStates, hand_m: float) -> list[Floats]:
    """Computes the velocities of the ``ends`` [m/s]."""
    later = ends(states.p + _STEP_S * states.v, states.lengths_m, hand_m)
    earlier = ends(states.p - _STEP_S * states.v, states.lengths_m, hand_m)
    return [(b - a) / (2.0 * _STEP_S) for a, b in zip(earlier, later, strict=True)]


def _accelerated(now: list[Floats], velocities: list[Floats], horizon_s: float) -> tuple[list[Floats], float]:
    """Returns centres and radius of the balls that contain all points that the ends can reach up to the horizon.

    The ball at the horizon contains those of all earlier times, unless the horizon is so short that the present
    position is outside; then both are centres.
    """
    turn_s = min(horizon_s, _SPEED / _ACCELERATION)
    reach_m = 0.5 * _ACCELERATION * turn_s**2 + _SPEED * (horizon_s - turn_s)
    sets = []
    for p, v in zip(now, velocities, strict=True):
        speed = np.linalg.norm(v, axis=2, keepdims=True)
        moved = p + v * np.minimum(1.0, _SPEED / np.maximum(speed, 1e-12)) * turn_s
        sets.append(moved if _SPEED * turn_s <= reach_m else np.concatenate([p, moved], axis=1))
    return sets, reach_m
