"""Which rotations carry a limb: from its end points to the human base."""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.records import Floats

_X, _Y, _Z = 0, 1, 2


@njit(cache=True)
def kinematic_chain(limb: int, low: Floats, high: Floats, lengths: Floats) -> tuple[Floats, Floats]:
    """A limb's end points in the frame of its first rotation, and the rotations from there to the human base.

    A row of the chain is: axis, smallest and largest angle [rad], then the origin of its frame in the next (3,) [m].
    What follows is walking. The thorax also spans the shoulder line, whose midpoint is the neck.
    """
    pelvis_height, torso, head, half_shoulder = lengths[0], lengths[1], lengths[2], lengths[3]
    turn_rho = (_Y, low[3], high[3], 0.0, 0.0, pelvis_height)
    if limb == 0:
        points = np.array([[0.0, 0.0, torso], [0.0, 0.0, torso + head]])
        return points, np.array([turn_rho])
    if limb == 1:
        points = np.array([[0.0, 0.0, 0.0], [0.0, -half_shoulder, torso], [0.0, half_shoulder, torso]])
        return points, np.array([turn_rho])
    left = limb >= 4
    side = 1.0 if left else -1.0
    upper, forearm = (lengths[4], lengths[6]) if left else (lengths[5], lengths[7])
    a1 = 8 if left else 4  # first joint of the arm
    a2, a3, a4 = a1 + 1, a1 + 2, a1 + 3
    turn_2 = (_Y, -high[a2], -low[a2], 0.0, 0.0, 0.0)
    turn_1 = (
        _X,
        min(side * low[a1], side * high[a1]),
        max(side * low[a1], side * high[a1]),
        0.0,
        side * half_shoulder,
        torso,
    )
    if limb in (2, 4):
        points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -upper]])
        return points, np.array([turn_2, turn_1, turn_rho])
    turn_4 = (_Y, low[a4] - np.pi, high[a4] - np.pi, 0.0, 0.0, 0.0)
    turn_3 = (_Z, min(side * low[a3], side * high[a3]), max(side * low[a3], side * high[a3]), 0.0, 0.0, -upper)
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -forearm]])
    return points, np.array([turn_4, turn_3, turn_2, turn_1, turn_rho])
