"""Somebody who squats or sits, gets up, and goes down again: a whole body with legs, seen by two cameras."""

from __future__ import annotations

import numpy as np

from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.model import skeleton
from hrcreplay.records import POINTS, Floats, Ints, Measurements
from hrcreplay.settings.sections import Fusion
from tests.human.sightings import CAMERAS, LENGTHS_M, NEUTRAL, frames_of

#: Pelvis standing, and how far it goes down [m].
STANDING_M, DOWN_M = 0.94, 0.45
#: Thigh, and shank with foot [m].
BONES_M = (0.45, 0.49)
#: How long nothing moves before, between and after [s].
STILL_S = 2.0
#: How far the trunk leans forward on the way: the quicker, the less [rad/s].
_LEAN_RAD_PER_S = 0.33
_BACK_M = {"squat": 0.0, "chair": 0.25}
_HIP_M = 0.09


def eased(t_s: Floats, duration_s: float) -> Floats:
    """From 0 to 1 with the least jerk."""
    s = np.clip(t_s / duration_s, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


def body(t_s: Floats, duration_s: float, kind: str) -> Floats:
    """(n, 20, 3) POINTS at instants: down, up after STILL_S, down again after as long, world [m].

    Args:
        t_s: (n,) instants [s].
        duration_s: How long to get up, and to go down [s].
        kind: ``squat`` (pelvis above the feet) or ``chair`` (behind them).
    """
    up = eased(t_s - STILL_S, duration_s) - eased(t_s - 2.0 * STILL_S - duration_s, duration_s)
    p = np.tile(NEUTRAL, (len(t_s), 1))
    p[:, 12] = STANDING_M - DOWN_M * (1.0 - up)
    p[:, 3] = 0.1 + _LEAN_RAD_PER_S * duration_s * 4.0 * up * (1.0 - up)  # forward on the way, upright at both ends
    back = _BACK_M[kind] * (1.0 - up)
    ahead = np.array([np.cos(NEUTRAL[2]), np.sin(NEUTRAL[2]), 0.0])
    p[:, :2] = NEUTRAL[:2] - back[:, None] * ahead[:2]
    points = skeleton(p, np.tile(LENGTHS_M, (len(t_s), 1)))
    points[:, POINTS.index("chest")] = 0.5 * (points[:, POINTS.index("pelvis")] + points[:, POINTS.index("neck")])
    left = np.array([-ahead[1], ahead[0], 0.0])
    for side, s in (("l", 1.0), ("r", -1.0)):
        hip = points[:, POINTS.index("pelvis")] + s * _HIP_M * left
        ankle = np.append(NEUTRAL[:2], 0.0) + s * _HIP_M * left
        points[:, POINTS.index(f"hip_{side}")] = hip
        points[:, POINTS.index(f"ankle_{side}")] = ankle
        points[:, POINTS.index(f"foot_{side}")] = ankle + 0.15 * ahead
        points[:, POINTS.index(f"knee_{side}")] = knee(hip, ankle, ahead)
    return points


def knee(hip: Floats, ankle: Floats, ahead: Floats) -> Floats:
    """Where thigh and shank meet, in front (n, 3) [m]."""
    thigh, shank = BONES_M
    line = ankle - hip
    length = np.minimum(np.linalg.norm(line, axis=1), thigh + shank)
    along = (thigh**2 - shank**2 + length**2) / (2.0 * length)
    off = np.sqrt(np.maximum(0.0, thigh**2 - along**2))
    unit = line / np.linalg.norm(line, axis=1)[:, None]
    front = ahead - (unit @ ahead)[:, None] * unit
    return np.asarray(hip + along[:, None] * unit + off[:, None] * front / np.linalg.norm(front, axis=1)[:, None])


def seen(
    duration_s: float, kind: str, seed: int, noise_m: float = 0.005, cameras: tuple[str, ...] = CAMERAS
) -> tuple[Measurements, float]:
    """What cameras of 30 Hz, 20 ms late, see of it, and how long it takes [s]."""
    end_s = 3.0 * STILL_S + 2.0 * duration_s
    instants = np.arange(0.0, end_s, 1.0 / 30.0)
    n = len(cameras)
    capture: Ints = np.concatenate([np.round((instants + 0.013 * c) * 1e9).astype(np.int64) for c in range(n)])
    camera = np.repeat(np.arange(n), len(instants))
    order = np.argsort(capture, kind="stable")
    points = body(np.asarray(capture[order] * 1e-9, dtype=np.float64), duration_s, kind)
    points += np.random.default_rng(seed).normal(0.0, noise_m, points.shape)
    frames = frames_of(points, camera[order], capture[order], 20_000_000, cameras)
    return measure(frames, np.tile(np.eye(4), (n, 1, 1)), Fusion()), end_s
