"""Swept volumes of the limbs within the horizon: Alg. 2, or under ``sound`` what encloses every motion of Eq. (25)."""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.geometry.hull_reduction import Surface, keep_corners, surface
from hrcreplay.human.model import LimitSet
from hrcreplay.human.prediction.reachable_sets import SOUND, MotionLimits, bounds_of, code_of, never_measured, reach_row
from hrcreplay.human.prediction.sound_volumes import sweep_sound
from hrcreplay.human.prediction.sweep import MOST_COPIES, append, box, kinematic_chain, sweep_rot, sweep_walk
from hrcreplay.records import BODY, DOF, LIMBS, Bools, Floats, HumanStates, Ints, SweptVolumes
from hrcreplay.settings.sections import Occupancy

#: A larger set is reduced before the next rotation: below, it costs less to carry all points along.
_WORTH_REDUCING = 50
#: A larger result is reduced once more: walking leaves few points too many unless the person can turn far.
_TOO_MANY = 256


def limb_radii(occupancy: Occupancy) -> Floats:
    """(6,) radii of the balls that give the limbs their thickness, Eq. (41), Table 2, in the order of LIMBS [m]."""
    upper, lower = occupancy.radius_upper_arm_m, occupancy.radius_lower_arm_m
    return np.array([occupancy.radius_head_m, occupancy.radius_thorax_m, upper, lower, upper, lower])


def limbs_of(occupancy: Occupancy) -> tuple[str, ...]:
    """Limbs that have volumes under these settings."""
    return BODY if code_of(occupancy.method) == SOUND and occupancy.legs else LIMBS


def predict(
    states: HumanStates,
    limits: LimitSet,
    occupancy: Occupancy,
    *,
    horizon_s: float,
    memory_s: float,
) -> SweptVolumes:
    """Swept volumes of all limbs from the reachable sets of the joints: Alg. 2, or what encloses them all (``sound``).

    Args:
        states: The fused person; a row gives the same bits alone and among others.
        limits: Bounds on the joints.
        occupancy: Method, radii of Table 2, and what ``sound`` adds; the printed methods add nothing.
        horizon_s: Braking time T_s of the robot [s].
        memory_s: How long the filter goes on without a measurement [s].

    Returns:
        Points whose convex hulls are those of Alg. 2: every corner of a hull is among them, and few others. For
        ``sound``, points whose hulls enclose all motions; with ``occupancy.legs`` the last limb is ``LEGS``. A limb
        whose state or lengths are NaN has one NaN vertex.

    Raises:
        SettingsError: There is no such method.
    """
    code, radius = code_of(occupancy.method), limb_radii(occupancy)
    if code == SOUND:
        vertices, offsets, radii = sweep_sound(
            states, limits, occupancy, radius, horizon_s + occupancy.latency_s, memory_s
        )
        return SweptVolumes(states.t_ns, offsets, vertices, radii, limbs_of(occupancy), occupancy.method)
    vertices, offsets = _predict_rows(
        np.ascontiguousarray(states.p),
        np.ascontiguousarray(states.v),
        never_measured(states),
        np.ascontiguousarray(states.lengths_m),
        MotionLimits(bounds_of(limits), limits.coupled, horizon_s, code),
        surface(),
    )
    return SweptVolumes(states.t_ns, offsets, vertices, np.tile(radius, (len(states), 1)), LIMBS, occupancy.method)


@njit(cache=True)
def _predict_rows(
    p: Floats, v: Floats, never: Bools, lengths: Floats, within: MotionLimits, work: Surface
) -> tuple[Floats, Ints]:
    limbs = 6
    offsets = np.zeros(len(p) * limbs + 1, np.int64)
    vertices = np.empty((len(p) * 256 + 256, 3))
    low, high = np.empty(DOF), np.empty(DOF)
    n = 0
    for i in range(len(p)):
        reach_row(p[i], v[i], never[i], within, low, high)
        for limb in range(limbs):
            swept, count = _sweep_limb(limb, low, high, lengths[i], work)
            vertices = append(vertices, n, swept, count)
            n += count
            offsets[i * limbs + limb + 1] = n
    return vertices[:n].copy(), offsets


@njit(cache=True)
def _sweep_limb(limb: int, low: Floats, high: Floats, lengths: Floats, work: Surface) -> tuple[Floats, int]:
    """Alg. 2 for one limb, given the reachable intervals (13,) and the lengths (7,)."""
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
