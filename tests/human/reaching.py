"""Somebody who stands and reaches, swings an arm, throws or is startled, as fast as people were measured to be.

Arms go from one posture to another with the least jerk, as people's do (Flash and Hogan, J. Neurosci. 5:1688, 1985),
whatever the speed (Atkeson and Hollerbach, J. Neurosci. 5:2318, 1985). Garnett ("Revisiting the OSHA Hand Speed
Constant", Auburn University) measured hands that reach for a press: 95 % of them stay below 2.8 m/s from the upper
buttons of a two-hand control, and below 3.9 m/s from anywhere. These are the peaks here.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.human.model import skeleton
from hrcreplay.records import JOINTS, POINTS, Floats
from tests.human import rising
from tests.human.sightings import LENGTHS_M, NEUTRAL

#: kind -> arms, their flexion and elbow angle before and after [rad], and the peak speed of a wrist [m/s].
KINDS: dict[str, tuple[str, tuple[float, float], tuple[float, float], float]] = {
    "reach": ("r", (0.1, 1.6), (1.4, 2.7), 2.8),
    "swing": ("l", (-0.6, 2.9), (1.6, 2.9), 3.9),
    "throw": ("r", (2.3, 1.0), (0.9, 2.8), 3.9),
    "startle": ("rl", (0.0, 2.2), (0.8, 0.8), 2.8),
}
#: Time for which nothing moves before each [s]; the way back takes so many times as long.
STILL_S, BACK = 1.2, 3.0


def _pose(kind: str, share: Floats) -> Floats:
    """(n, 20, 3) POINTS on the way from the first to the second posture, without legs, world [m]."""
    arms, before, after, _ = KINDS[kind]
    p = np.tile(NEUTRAL, (len(share), 1))
    p[:, JOINTS.index("z")] = rising.STANDING_M
    for side in arms:
        for joint, start, end in zip((2, 4), before, after, strict=True):
            p[:, JOINTS.index(f"a{side}{joint}")] = start + (end - start) * share
    return skeleton(p, np.tile(LENGTHS_M, (len(p), 1)))


def duration_s(kind: str) -> float:
    """Time of the fast way: the peak speed of the wrist falls with it."""
    arms, _, _, peak_m_per_s = KINDS[kind]
    t_s = np.linspace(0.0, 1.0, 1001)
    wrist = _pose(kind, rising.eased(t_s, 1.0))[:, POINTS.index(f"wrist_{arms[0]}")]
    return float(np.linalg.norm(np.diff(wrist, axis=0), axis=1).max() * 1000.0 / peak_m_per_s)


def period_s(kind: str) -> float:
    """Time until it begins again."""
    return 2.0 * STILL_S + (1.0 + BACK) * duration_s(kind)


def body(t_s: Floats, kind: str) -> Floats:
    """(n, 20, 3) POINTS at instants, again and again, world [m]."""
    fast_s = duration_s(kind)
    at_s = t_s % period_s(kind)
    share = rising.eased(at_s - STILL_S, fast_s) - rising.eased(at_s - 2.0 * STILL_S - fast_s, BACK * fast_s)
    points, standing = _pose(kind, share), rising.body(np.full(1, 2.0 * rising.STILL_S), 1.0, "squat")[0]
    still = np.isnan(points).any(axis=(0, 2))
    points[:, still] = standing[still]
    return points
