"""Feet that are set down where a walking, turning or shuffling body needs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.records import Floats

STEP_S = 0.42  #: a foot is in the air for so long
AHEAD_S = 0.20  #: a foot lands where the body will be this long after the landing
HALF_STANCE_M = 0.095
RELAXED_M = 0.10  #: a foot further than this from its place wants to step
RELAXED_RAD = 0.45
LIFT_M = 0.09


@dataclass(frozen=True)
class Feet:
    """Both feet over time, left before right."""

    ankle_m: Floats  #: (n, 2, 3) height above the sole's plane included
    yaw: Floats  #: (n, 2) [rad]
    swing: Floats  #: (n, 2) 0 on the floor, 1 at the top of a step


@dataclass
class _Foot:
    """One foot while the steps are laid out."""

    side: float
    now: Floats  # (3,) x, y, yaw
    lifted: Floats
    landing: Floats
    lift_s: float = -np.inf

    def progress(self, t_s: float) -> float:
        return min((t_s - self.lift_s) / STEP_S, 1.0)


def feet(t_s: Floats, root_m: Floats, heading: Floats, ankle_height_m: float) -> Feet:
    """Footsteps under a body whose way is known.

    Args:
        t_s: (n,) evenly spaced [s].
        root_m: (n, 2) the body's place on the floor [m].
        heading: (n,) [rad], unwrapped.
        ankle_height_m: Of a standing foot [m].
    """
    rate_hz = 1.0 / (t_s[1] - t_s[0])
    way = np.column_stack([root_m, heading])
    pair = [_Foot(side, home := _place(way[0], side), home, home) for side in (1.0, -1.0)]
    ankle, yaw, swing = np.zeros((len(t_s), 2, 3)), np.zeros((len(t_s), 2)), np.zeros((len(t_s), 2))
    for k, t in enumerate(t_s):
        if all(foot.progress(t) >= 1.0 for foot in pair):
            late = max(pair, key=lambda foot: _wish(way, k, rate_hz, foot))
            if _wish(way, k, rate_hz, late) > 1.0:
                then = min(k + round((STEP_S + AHEAD_S) * rate_hz), len(t_s) - 1)
                late.lifted, late.landing, late.lift_s = late.now, _place(way[then], late.side), t
        for i, foot in enumerate(pair):
            s = foot.progress(t)
            foot.now = foot.lifted + (foot.landing - foot.lifted) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
            swing[k, i] = 16.0 * s**2 * (1.0 - s) ** 2
            ankle[k, i] = foot.now[0], foot.now[1], ankle_height_m + LIFT_M * swing[k, i]
            yaw[k, i] = foot.now[2]
    return Feet(ankle, yaw, swing)


def _place(pose: Floats, side: float) -> Floats:
    """Where a foot stands under a body at (x, y, heading)."""
    x, y, heading = pose
    return np.array([x - side * HALF_STANCE_M * np.sin(heading), y + side * HALF_STANCE_M * np.cos(heading), heading])


def _wish(way: Floats, row: int, rate_hz: float, foot: _Foot) -> float:
    """How badly a foot wants to step; more than 1: now."""
    then = min(row + round(AHEAD_S * rate_hz), len(way) - 1)
    off = foot.now - _place(way[then], foot.side)
    return max(float(np.hypot(off[0], off[1])) / RELAXED_M, abs(float(off[2])) / RELAXED_RAD)
