"""The space that the person can reach within the horizon, limb by limb: Alg. 2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from hrcreplay.human import sound
from hrcreplay.human.chain import kinematic_chain
from hrcreplay.human.corners import keep_corners
from hrcreplay.human.margins import STANDARD, Margins
from hrcreplay.human.model import LimitSet
from hrcreplay.human.reach import SOUND, bounds_of, code_of, never_measured, reach_row
from hrcreplay.human.surface import Surface, surface
from hrcreplay.human.sweep import MOST_COPIES, sweep_rot
from hrcreplay.human.walk import box, sweep_walk
from hrcreplay.records import BODY, LIMBS, Bools, Floats, HumanStates, Ints, SweptVolumes

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
        upper, lower = self.upper_arm, self.lower_arm
        return np.array([self.head, self.thorax, upper, lower, upper, lower])


def predict(
    states: HumanStates,
    limits: LimitSet,
    *,
    horizon_s: float,
    radii: Radii,
    method: str,
    margins: Margins = STANDARD,
) -> SweptVolumes:
    """Swept volumes of all limbs from the reachable sets of the joints: Alg. 2, or what encloses them all (``sound``).

    Args:
        states: The fused person; a row gives the same bits alone and among others.
        limits: Bounds on the joints.
        horizon_s: Braking time T_s of the robot [s].
        radii: Table 2.
        method: One of ``reach.METHODS``.
        margins: What ``sound`` adds; the printed methods add nothing.

    Returns:
        Points whose convex hulls are those of Alg. 2: every corner of a hull is among them, and few others. For
        ``sound``, points whose hulls enclose all motions; with ``margins.legs`` the last limb is ``LEGS``. A limb whose
        state or lengths are NaN has one NaN vertex.

    Raises:
        SettingsError: There is no such method.
    """
    code, radius = code_of(method), radii.of_limbs()
    if code == SOUND:
        vertices, offsets = sound.sweep(states, bounds_of(limits), limits.coupled, horizon_s, margins)
        limbs = BODY if margins.legs else LIMBS
        return SweptVolumes(states.t_ns, offsets, vertices, sound.radii(states, radius, margins), limbs, method)
    vertices, offsets = _predict_rows(
        np.ascontiguousarray(states.p),
        np.ascontiguousarray(states.v),
        never_measured(states),
        np.ascontiguousarray(states.lengths_m),
        bounds_of(limits),
        limits.coupled,
        horizon_s,
        code,
        surface(),
    )
    return SweptVolumes(states.t_ns, offsets, vertices, np.tile(radius, (len(states), 1)), LIMBS, method)


@njit(cache=True)
def _predict_rows(
    p: Floats,
    v: Floats,
    never: Bools,
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
        reach_row(p[i], v[i], never[i], bounds, coupled, horizon, method, low, high)
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
    points, chain = kinematic_chain(limb, low, high, lengths)
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
    count = sweep_walk(points, count, faces, work, (low[2], high[2]), box(low, high), swept)
    if count > _TOO_MANY:
        count, faces = keep_corners(swept, count, work)
    return swept, count
