"""The space that the person can reach within the horizon, limb by limb: Alg. 2."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numba import njit

from hrcreplay.human.corners import keep_corners
from hrcreplay.human.model import LimitSet
from hrcreplay.human.reach import bounds_of, code_of, reach_row
from hrcreplay.human.surface import Surface, surface
from hrcreplay.human.sweep import MOST_COPIES, sweep_rot
from hrcreplay.human.walk import sweep_walk
from hrcreplay.records import LIMBS, Floats, HumanStates, Ints, SweptVolumes

_X, _Y, _Z = 0, 1, 2
#: A larger set is reduced before the next rotation: below, it costs less to carry all points along.
_WORTH_REDUCING = 50
#: A larger result is reduced once more: walking leaves few points too many unless the person can turn far.
_TOO_MANY = 256


@dataclass(frozen=True)
class Radii:
    """Radii of the balls that give the limbs their thickness, Eq. (41). Defaults: Table 2 [m]."""

    head: float = 0.12
    thorax: float = 0.15
    upper_arm: float = 0.07
    lower_arm: float = 0.07

    def of_limbs(self) -> Floats:
        """(6,) in the order of LIMBS [m]."""
        head, thorax, upper, lower = astuple(self)
        return np.array([head, thorax, upper, lower, upper, lower])


def predict(states: HumanStates, limits: LimitSet, *, horizon_s: float, radii: Radii, method: str) -> SweptVolumes:
    """Swept volumes of all limbs, Alg. 2, from the reachable sets of the joints.

    Args:
        states: The fused person; a row gives the same bits alone and among others.
        limits: Bounds on the joints.
        horizon_s: Braking time T_s of the robot [s].
        radii: Table 2.
        method: One of ``reach.METHODS``.

    Returns:
        Points whose convex hulls are those of Alg. 2: every corner of a hull is among them, and few others. A limb
        whose state or lengths are NaN has one NaN vertex.

    Raises:
        SettingsError: There is no such method.
    """
    vertices, offsets = _predict_rows(
        np.ascontiguousarray(states.p),
        np.ascontiguousarray(states.v),
        np.ascontiguousarray(states.lengths_m),
        bounds_of(limits),
        limits.coupled,
        horizon_s,
        code_of(method),
        surface(),
    )
    radius = np.tile(radii.of_limbs(), (len(states), 1))
    return SweptVolumes(states.t_ns, offsets, vertices, radius, LIMBS, method)


@njit(cache=True)
def _predict_rows(
    p: Floats,
    v: Floats,
    lengths: Floats,
    bounds: Floats,
    coupled: bool,
    horizon: float,
    method: int,
    work: Surface,
) -> tuple[Floats, Ints]:
    limbs = 6
    offsets = np.zeros(len(p) * limbs + 1, np.int64)
    vertices = np.empty((len(p) * 256 + 256, 3))
    low, high = np.empty(12), np.empty(12)
    n = 0
    for i in range(len(p)):
        reach_row(p[i], v[i], bounds, coupled, horizon, method, low, high)
        for limb in range(limbs):
            swept, count = _sweep_limb(limb, low, high, lengths[i], work)
            if n + count > len(vertices):
                roomier = np.empty((2 * (n + count), 3))
                roomier[:n] = vertices[:n]
                vertices = roomier
            vertices[n : n + count] = swept[:count]
            n += count
            offsets[i * limbs + limb + 1] = n
    return vertices[:n].copy(), offsets


@njit(cache=True)
def _sweep_limb(limb: int, low: Floats, high: Floats, lengths: Floats, work: Surface) -> tuple[Floats, int]:
    """Alg. 2 for one limb, given the reachable intervals (12,) and the lengths (8,)."""
    points, chain = _kinematic_chain(limb, low, high, lengths)
    if not np.isfinite(points.sum() + chain.sum() + low[:3].sum() + high[:3].sum()):
        return np.full((1, 3), np.nan), 1
    count, faces = len(points), 0
    for k, step in enumerate(chain):
        swept = np.empty((MOST_COPIES * count, 3))
        count = sweep_rot(points, count, int(step[0]), step[1], step[2], swept)
        points = swept
        for i in range(count):
            for axis in range(3):
                points[i, axis] += step[3 + axis]
        if count > _WORTH_REDUCING or k == len(chain) - 1:
            count, faces = keep_corners(points, count, work)
    swept = np.empty((4 * MOST_COPIES * count, 3))
    count = sweep_walk(points, count, faces, work, low, high, swept)
    if count > _TOO_MANY:
        count, faces = keep_corners(swept, count, work)
    return swept, count


@njit(cache=True)
def _kinematic_chain(limb: int, low: Floats, high: Floats, lengths: Floats) -> tuple[Floats, Floats]:
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
