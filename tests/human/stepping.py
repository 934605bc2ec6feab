"""Somebody who stands, takes a few steps to one side of the room, stands, and steps back.

A swinging foot goes from one place to the next with the least jerk, as hands do. The pelvis goes evenly between the
feet, and begins before the first heel is lifted. Half a second for a step of 0.6 m is ordinary walking, 1.2 m/s; the
foot that swings is then almost four times as fast.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.human.model import skeleton
from hrcreplay.records import POINTS, Floats
from tests.human import rising
from tests.human.sightings import LENGTHS_M, NEUTRAL

#: kind -> length of a step [m], and its duration [s].
KINDS: dict[str, tuple[float, float]] = {"walk": (0.6, 0.5), "shuffle": (0.25, 0.4)}
#: Steps on each way, and time for which nothing moves before it [s].
STEPS, STILL_S = 4, 1.5
#: Ankle above the floor, height of a lifted foot, half the width of the hips, how much lower a pelvis walks [m].
_ANKLE_M, _LIFT_M, _HIP_M, _LOWER_M = 0.08, 0.08, 0.09, 0.08


def period_s(kind: str) -> float:
    """Time until it begins again."""
    return 2.0 * (STILL_S + STEPS * KINDS[kind][1])


def _feet(at_s: Floats, kind: str) -> tuple[Floats, Floats]:
    """(n, 2) how far each foot has gone, right first, and how high it is [m]; together at both ends."""
    step_m, step_s = KINDS[kind]
    gone, lifted, places = np.zeros((len(at_s), 2)), np.zeros((len(at_s), 2)), np.zeros(2)
    for number in range(STEPS):
        side, last = number % 2, number == STEPS - 1
        goes_m = places.max() + (0.0 if last else step_m) - places[side]
        share = rising.eased(at_s - number * step_s, step_s)
        gone[:, side] += goes_m * share
        lifted[:, side] += _LIFT_M * 4.0 * share * (1.0 - share)
        places[side] += goes_m
    return gone, lifted


def body(t_s: Floats, kind: str) -> Floats:
    """(n, 20, 3) POINTS at instants, again and again, world [m]."""
    starts_s = STILL_S, STILL_S + 0.5 * period_s(kind)
    (feet, lifted), (back, lifted_back) = (_feet(t_s % period_s(kind) - start_s, kind) for start_s in starts_s)
    around_s = KINDS[kind][1] * np.linspace(-0.5, 0.5, 21)
    there, here = (
        np.mean([_feet(t_s % period_s(kind) - start_s + by_s, kind)[0] for by_s in around_s], axis=(0, 2))
        for start_s in starts_s
    )
    feet, lifted, gone = feet - back, lifted + lifted_back, there - here
    p = np.tile(NEUTRAL, (len(t_s), 1))
    p[:, 12] = rising.STANDING_M - _LOWER_M
    ahead = np.array([np.cos(NEUTRAL[2]), np.sin(NEUTRAL[2]), 0.0])
    left = np.array([-ahead[1], ahead[0], 0.0])
    p[:, :2] = NEUTRAL[:2] + gone[:, None] * ahead[:2]
    points = skeleton(p, np.tile(LENGTHS_M, (len(t_s), 1)))
    points[:, POINTS.index("chest")] = 0.5 * (points[:, POINTS.index("pelvis")] + points[:, POINTS.index("neck")])
    for foot, (side, s) in enumerate((("r", -1.0), ("l", 1.0))):
        hip = points[:, POINTS.index("pelvis")] + s * _HIP_M * left
        ankle = np.append(NEUTRAL[:2], _ANKLE_M) + s * _HIP_M * left + feet[:, foot, None] * ahead
        ankle[:, 2] += lifted[:, foot]
        points[:, POINTS.index(f"hip_{side}")] = hip
        points[:, POINTS.index(f"ankle_{side}")] = ankle
        points[:, POINTS.index(f"foot_{side}")] = ankle + 0.15 * ahead - [0.0, 0.0, 0.06]
        points[:, POINTS.index(f"knee_{side}")] = rising.knee(hip, ankle - [0.0, 0.0, _ANKLE_M], ahead)
    return points
