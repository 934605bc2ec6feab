"""Swept volumes that enclose every motion of Eq. (25) within the limits, from every likely state: the method ``sound``.

If the limit set bounds the departure of limbs from constant velocity, a recently seen limb has the tube of
``velocity_tube``. Every other limb is enclosed joint by joint, or in the tube of the limb on which it hangs widened by
its own length, if that is smaller: wherever that limb is, this one starts there. Proof that no motion with the stops of
Eq. (34) leaves the volume of the joints, at any time and from any likely state:

1. States. Each joint's position and velocity are within ``sigmas`` standard deviations of the estimate, for any
   correlation: a box around it. World velocities are turned into the body's frame over all headings of the box.
2. Joints. Heading, torso and arm joints and the pelvis's height stay in the intervals of ``joint_reach`` at all times;
   stops that depend on other joints are taken over the intervals of those.
3. Walking. The pelvis stays in the convex polygon of ``sound_reach`` at all times, at a height of its interval.
4. Limbs. A limb at any instant is a chain of rotations, each by an angle of its interval, then a displacement within
the polygon and the height interval. Sweeping a convex set by all angles of a joint and by all displacements
independently covers all combinations, including the real ones. A swept set is stored as points whose hull contains it:
rotations are linear, so the hull of the swept points contains the swept hull. Arcs lie in triangles with their apexes
outside, and points are only dropped if they are proven to be inside the rest (``sweep``, ``hull_reduction``). If too
many remain, the polytope of ``convex_hull`` replaces them, which contains them all. It may be cut to the ball that no
point of the limb can leave, because the extent along a direction may be any upper bound. 5. Lengths. A limb has its
maximum length: its far end moves outwards along the line through the near one. An error of a length further up the
chain displaces the limb by at most this error, which is added to the radius. 6. Rounding. The steps are exact in real
numbers; in floating point they are off by less than 1e-12 m for people within
   a kilometre of the origin. ``ROUNDING_M`` is added to the radii. It covers rounding only, not motions outside.

The lower body is the line from the floor to the pelvis with its own radius, moving with the pelvis. The radius is that
of standing people, or the recent distance of observed hips, knees and feet (``model_residual``). With a low pelvis the
legs are folded and the knees are further out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.convex_hull import CORNERS, DIRECTIONS, around, reach_turning
from hrcreplay.geometry.hull_reduction import Surface, keep_corners
from hrcreplay.human.model import ARM_POINTS, HEAD, HEIGHT, NECK, ULA, URA, LimitSet, bounds_of, skeleton_row
from hrcreplay.human.prediction.sound_reach import (
    SIDES,
    THIGH_M,
    Likely,
    SoundMotionLimits,
    enclose_row,
    knees_out,
    legs_around,
    start_states,
)
from hrcreplay.human.prediction.sweep import (
    TRIANGLE_RAD,
    append,
    copies,
    kinematic_chain,
    polygon,
    sweep_rot,
    sweep_walk,
)
from hrcreplay.human.prediction.velocity_tube import (
    HANGS_ON,
    HEAD_LIMB,
    LEGS,
    MOST_POINTS,
    THORAX,
    DepartureTable,
    Tubes,
    departs_m,
    departure_table,
    displaced_m,
    motion_of_limbs,
    tube,
    tubes,
)
from hrcreplay.kernels import Held, njit
from hrcreplay.records import DOF, LIMBS, Floats, HumanStates, Ints
from hrcreplay.settings.sections import Prediction

#: Added to every radius: more than the sum of all rounding errors [m].
ROUNDING_M = 1e-9
#: Added to the radius of legs out of sight: departures were fitted to legs that cameras show [m].
HIDDEN_M = 0.09
#: Maximum number of points after a rotation or walking; above it the polytope around them is used.
MOST_COPIED = 2000
#: Number of points above which walking uses triangles of 60 degrees.
MOST_FINE = 700
#: Maximum size of a set that is reduced to its corners, as the time grows with the square.
MOST_REDUCED = 256
#: Largest angle of a triangle around an arc: its apex is then at most 3.6 % of the radius off [rad].
FINE_RAD = np.pi / 6.0
#: Maximum number of corners of the result; above it the polytope around them is used.
MOST_CORNERS = 256
#: Size above which a set is reduced before the next rotation.
_MANY_CORNERS = 40

#: For each of LIMBS the index of its length in LENGTHS.
_LENGTH_OF = np.array([1, 0, 4, 6, 3, 5])


class SoundRules(NamedTuple):
    """Settings and bounds of the volumes."""

    bounds: Floats  #: (6, 13) of ``bounds_of``
    coupled: bool  #: True: Eq. (34b), (34c) hold
    departure: DepartureTable
    bounded: bool  #: True: ``departure`` applies
    limbs_m: Floats  #: (6,) radii of LIMBS, Table 2 [m]
    body_m: Floats  #: (7,) radii of BODY in tubes [m]
    hand_m: float  #: length of the hand beyond the wrist [m]
    legs_m: float  #: radius of the lower body of standing people [m]
    unknown_m: float  #: residual of a limb until it is known; NaN: residuals are not used [m]
    memory_s: float  #: time for which the filter continues without a measurement [s]


def sound_rules(limits: LimitSet, prediction: Prediction, limbs_m: Floats, memory_s: float) -> SoundRules:
    """Collects the settings and bounds of the volumes.

    Args:
        limits: Bounds on the joints and, if given, on the limbs.
        prediction: Margins added to the model.
        limbs_m: (6,) radii of LIMBS, Table 2 [m].
        memory_s: Time for which the filter continues without a measurement [s].
    """
    return SoundRules(
        bounds=bounds_of(limits),
        coupled=limits.coupled,
        departure=departure_table(limits),
        bounded=limits.departure is not None,
        limbs_m=limbs_m,
        body_m=np.append(limbs_m, THIGH_M) + ROUNDING_M,
        hand_m=prediction.hand_m,
        legs_m=prediction.legs_radius_m,
        unknown_m=prediction.residual_unknown_m if prediction.residual else np.nan,
        memory_s=memory_s,
    )


class SoundRows(NamedTuple):
    """The person of some ticks as input of the volumes, one row per tick; it does not depend on the horizon."""

    at: Likely
    tubed: Tubes
    lengths: Floats  #: (n, 7) LENGTHS [m]
    lengths_off: Floats  #: (n, 7) their largest errors [m]
    radii: Floats  #: (n, limbs) radii of volumes from the joints [m]
    velocity: Floats  #: (n, 20, 3) of the model's points [m/s]
    speed: Floats  #: (n, 7) of the limbs of BODY [m/s]


def sound_rows(states: HumanStates, prediction: Prediction, rules: SoundRules, how: Held) -> tuple[SoundRows, Held]:
    """Computes what the volumes of all horizons have in common.

    Args:
        states: The fused person.
        prediction: Margins added to the model.
        rules: From ``sound_rules``, for the same settings.
        how: The rules, and a surface to work with, for the kernel.

    Returns:
        It, and what ``sweep_sound`` takes.
    """
    velocity, speed = motion_of_limbs(states)
    rows = SoundRows(
        at=start_states(states, prediction, rules.memory_s),
        tubed=tubes(states, rules.bounded, rules.unknown_m, rules.memory_s),
        lengths=np.ascontiguousarray(states.lengths_m),
        lengths_off=np.ascontiguousarray(prediction.sigmas * states.lengths_std_m),
        radii=np.empty((len(states), len(LIMBS) + prediction.legs)),
        velocity=velocity,
        speed=speed,
    )
    return rows, _radii_rows(rows, np.ascontiguousarray(states.residual_m), how)


#: Points of each of LIMBS that may have an offset from the model.
_POINTS = np.array(
    [
        (NECK, HEAD),
        (ARM_POINTS[0][0], ARM_POINTS[1][0]),
        *(ARM_POINTS[arm][part : part + 2] for arm in range(2) for part in range(2)),
    ]
)


@njit(cache=True)
def _radii_rows(rows: SoundRows, residual: Floats, how: Held) -> Held:
    """Writes the radii of volumes from the joints: those of the limbs plus the errors of the model.

    These errors are the displacement by an error of a length up the chain, the residual, and the offset of the points
    from the model that the residual refers to. An unknown residual (NaN) is replaced by ``unknown_m``. The lower body
    uses the thorax's. The residual of the legs is the distance of their middles from the line below the pelvis; if its
    sum with a thigh's radius is larger, that sum is the radius. It is never reduced for legs last seen close to the
    line, as a table may hide a later change.

    Returns:
        What ``sweep_sound`` takes.
    """
    rules, work = how.value
    unknown, points, found = rules.unknown_m, rows.tubed.points, rows.radii
    modelled = np.full(points.shape[1:], np.nan)
    for i in range(len(found)):
        skeleton_row(rows.at.p[i], rows.lengths[i], modelled)
        off = rows.lengths_off[i]
        displaced = displaced_m(off)
        for limb in range(found.shape[1]):
            base = rules.legs_m + ROUNDING_M if limb == LEGS else rules.limbs_m[limb] + displaced[limb] + ROUNDING_M
            of = THORAX if limb == LEGS else limb
            further = _beside_m(of, points[i], modelled) + (unknown if np.isnan(residual[i, of]) else residual[i, of])
            found[i, limb] = base if np.isnan(unknown) else base + further
        if len(found[i]) > LEGS and not np.isnan(unknown):  # at least their observed distance
            found[i, LEGS] = np.fmax(found[i, LEGS], residual[i, LEGS] + (THIGH_M + ROUNDING_M))
    return Held((rules, work, rows))


@njit(cache=True, inner=True)
def _beside_m(limb: int, points: Floats, modelled: Floats) -> float:
    """Largest offset of a limb's points from the model [m]."""
    most = -np.inf
    for k in _POINTS[limb]:
        x, y, z = points[k, 0] - modelled[k, 0], points[k, 1] - modelled[k, 1], points[k, 2] - modelled[k, 2]
        most = np.maximum(most, np.sqrt(x * x + y * y + z * z))
    return most


@njit(cache=True)
def sweep_sound(person: Held, first: int, last: int, span_s: Floats) -> tuple[Floats, Ints, Floats]:
    """Computes the swept volumes of all limbs for the rows ``first`` to ``last`` - 1.

    Args:
        person: ``SoundRules``, a surface to work with, and ``SoundRows``.
        first: First row.
        last: Row after the last one.
        span_s: (n,) horizon and latency of each row [s].

    Returns:
        Vertices (m, 3) [m] and the offsets of ``SweptVolumes``, and (n, limbs) radii [m].
    """
    rules, work, rows = person.value
    limbs = rows.radii.shape[1]
    radii = rows.radii[first:last].copy()
    offsets = np.zeros((last - first) * limbs + 1, np.int64)
    vertices = np.empty(((last - first) * limbs * 80 + 80, 3))
    low, high, corners = np.empty(DOF), np.empty(DOF), np.empty((SIDES, 2))
    short = np.empty(((1 + rows.tubed.camera_points.shape[1]) * MOST_POINTS, 3))
    n = 0
    for i in range(first, last):
        if not rows.tubed.usable[i, :limbs].all():
            within = SoundMotionLimits(rules.bounds, rules.coupled, span_s[i - first], rules.memory_s)
            enclose_row(i, rows.at, within, low, high, corners)
        for limb in range(limbs):
            if rows.tubed.usable[i, limb]:
                count, radii[i - first, limb] = _tube(i, limb, rows, span_s[i - first], rules, short)
                vertices = append(vertices, n, short, count)
            else:
                if limb == LEGS:
                    swept, count = legs_around(corners, rows.at.p[i, 2], low[HEIGHT], high[HEIGHT], rules.legs_m)
                else:
                    ends = rows.lengths[i], rows.lengths_off[i]
                    swept, count = _limb(limb, low, high, corners, *ends, rules.hand_m, work)
                    many, radius = _hanging(i, limb, rows, span_s[i - first], rules, short)
                    if _box_m3(short, many, radius) < _box_m3(swept, count, radii[i - first, limb]):
                        swept, count, radii[i - first, limb] = short, many, radius
                vertices = append(vertices, n, swept, count)
            n += count
            offsets[(i - first) * limbs + limb + 1] = n
    return vertices[:n].copy(), offsets, radii


@njit(cache=True, inner=True)
def _tube(i: int, limb: int, rows: SoundRows, span_s: float, rules: SoundRules, swept: Floats) -> tuple[int, float]:
    """Writes the points of a limb's tube; returns their number and the radius, which includes the limb's [m]."""
    tubed, thick = rows.tubed, rules.body_m[limb]
    reach_s = span_s + tubed.late_s[i, limb]
    points, shown, velocity = tubed.points[i], tubed.camera_points[i], rows.velocity[i]
    new = tubed.legs_new[i]
    count = tube(limb, points, shown, velocity, span_s, reach_s, rules.hand_m, new, rules.departure, swept)
    speed = rows.speed[i, limb]
    if limb == LEGS and not tubed.legs_shown[i]:
        speed = 0.0  # their radius was fitted to nobody who walks
        hidden = max(rules.legs_m, knees_out(rows.at.p[i, HEIGHT]) + THIGH_M) + HIDDEN_M + ROUNDING_M
        thick = np.fmax(hidden, tubed.legs_m[i] + rules.body_m[limb])
    if not np.isfinite(swept[:count].sum()):
        swept[0], count = np.nan, 1
    residual, lost = tubed.residual[i, limb], tubed.lost_m[i, limb]
    departs = departs_m(limb, reach_s, residual, speed, rules.departure)
    if limb == LEGS:
        thick += tubed.legs_off_m[i]
        if not tubed.legs_shown[i]:  # below the pelvis, which may be elsewhere
            departs = max(departs, tubed.residual[i, THORAX])
    if lost > 0.0:  # the filter brings an unseen torso to rest, but people walk on
        departs = max(departs, departs_m(limb, span_s, residual, speed, rules.departure) + lost)
    return count, thick + departs


@njit(cache=True, inner=True)
def _hanging(i: int, limb: int, rows: SoundRows, span_s: float, rules: SoundRules, swept: Floats) -> tuple[int, float]:
    """Writes the tube of the nearest limb up the chain that has one; a limb out of sight is within its length of there.

    Returns:
        Number of points, 0 if no limb up the chain has a tube, and the radius, which includes the limb's own [m].
    """
    length, by = rows.tubed.residual[i, limb], limb
    while by != THORAX and not rows.tubed.usable[i, by]:
        k = _LENGTH_OF[by]
        length += rows.lengths[i, k] + rows.lengths_off[i, k]
        by = HANGS_ON[by]
    if not rows.tubed.usable[i, by]:
        return 0, np.nan
    if (limb - 2) % 2 == 1:
        length += rules.hand_m
    count, radius = _tube(i, by, rows, span_s, rules, swept)
    return count, radius - rules.body_m[by] + rules.body_m[limb] + length


@njit(cache=True, inner=True)
def _box_m3(points: Floats, count: int, radius: float) -> float:
    """Volume of the box around the first points with a ball; inf if there are none, or they are not known [m^3]."""
    if count == 0:
        return np.inf
    size = 1.0
    for axis in range(3):
        low, high = points[0, axis], points[0, axis]
        for k in range(1, count):
            low, high = min(low, points[k, axis]), max(high, points[k, axis])
        size *= high - low + 2.0 * radius
    return size if np.isfinite(size) else np.inf


@njit(cache=True, inner=True)
def _limb(
    limb: int, low: Floats, high: Floats, corners: Floats, lengths: Floats, off: Floats, hand: float, work: Surface
) -> tuple[Floats, int]:
    """Returns points around the reachable space of a limb, in place of Alg. 2; a NaN vertex for NaN states."""
    ends, chain = kinematic_chain(limb, low, high, lengths)
    ends = _longest(limb, ends, off, hand)
    if not np.isfinite(ends.sum() + chain.sum() + corners.sum() + low[2] + high[2] + high[HEIGHT]):
        return np.full((1, 3), np.nan), 1
    points, count, faces = _turn_all(ends, chain, high[HEIGHT] - low[HEIGHT], work)
    fine = count * copies(low[2], high[2], FINE_RAD) * SIDES <= MOST_FINE
    widest = FINE_RAD if fine else TRIANGLE_RAD
    room = count * copies(low[2], high[2], widest) * SIDES
    if count <= MOST_REDUCED and room <= MOST_COPIED:
        swept = np.empty((room, 3))
        many = sweep_walk(points, count, faces, work, (low[2], high[2]), polygon(corners), swept, widest)
        if many > MOST_CORNERS:
            many, _ = keep_corners(swept, many, work)
        if many <= MOST_CORNERS:
            return swept, many
    return _walk(points, count, low[2], high[2], corners)


@njit(cache=True, inner=True)
def _turn_all(ends: Floats, chain: Floats, rise: float, work: Surface) -> tuple[Floats, int, int]:
    """Points around what a chain's rotations and a rise of the pelvis make of a limb's ends [m].

    Returns:
        The points, their number, and triangles around them.
    """
    points, count, faces = ends, len(ends), 0
    radius = 0.0  # radius of the ball around the frame's origin that contains the limb
    for end in ends:
        radius = max(radius, np.sqrt(end[0] ** 2 + end[1] ** 2 + end[2] ** 2))
    for k, step in enumerate(chain):
        axis, low, high = int(step[0]), step[1], step[2]
        room = count * copies(low, high, FINE_RAD)
        if room <= MOST_COPIED:
            swept = np.empty((room, 3))
            count = sweep_rot(points, count, axis, low, high, swept, FINE_RAD)
        else:
            swept = np.empty((CORNERS, 3))
            count = _turn(points, count, axis, low, high, radius, swept)
        points = swept
        for i in range(count):
            for j in range(3):
                points[i, j] += step[3 + j]
        if k < len(chain) - 1 and count > _MANY_CORNERS and room <= MOST_REDUCED:
            count, _ = keep_corners(points, count, work)
        radius += np.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    if rise > 0.0:
        points, count = _raised(points, count, rise), 2 * count
    if count <= MOST_REDUCED:
        count, faces = keep_corners(points, count, work)
    return points, count, faces


@njit(cache=True, inner=True)
def _raised(points: Floats, count: int, rise: float) -> Floats:
    """Returns the first ``count`` points and copies raised by ``rise`` [m]: their hull contains all heights between."""
    both = np.empty((2 * count, 3))
    both[:count], both[count:] = points[:count], points[:count]
    both[count:, 2] += rise
    return both


@njit(cache=True, inner=True)
def _longest(limb: int, ends: Floats, off: Floats, hand: float) -> Floats:
    """Returns the limb's end points, moved outwards for lengths with an error of up to ``off`` (7,) [m]."""
    if limb == HEAD_LIMB:
        ends[0, 2] -= off[0]
        ends[1, 2] += off[0] + off[1]
        return ends
    if limb == THORAX:
        if off[0] == 0.0 and off[2] == 0.0:
            return ends
        wide = np.concatenate((ends, ends[1:]))
        for i in range(1, 5):
            wide[i, 1] += off[2] if wide[i, 1] > 0.0 else -off[2]
            wide[i, 2] += off[0] if i > 2 else -off[0]
        return wide
    left = limb >= ULA
    if limb in (URA, ULA):
        ends[1, 2] -= off[3] if left else off[4]
    else:
        ends[1, 2] -= hand + (off[5] if left else off[6])
    return ends


@njit(cache=True, inner=True)
def _turn(points: Floats, count: int, axis: int, low: float, high: float, radius: float, swept: Floats) -> int:
    far = np.full(len(DIRECTIONS), -np.inf)
    reach_turning(points, count, axis, low, high, far)
    for d in range(len(far)):
        far[d] = min(far[d], radius)
    return around(far, swept)


@njit(cache=True, inner=True)
def _walk(points: Floats, count: int, low: float, high: float, corners: Floats) -> tuple[Floats, int]:
    far = np.full(len(DIRECTIONS), -np.inf)
    reach_turning(points, count, 2, low, high, far)
    for d in range(len(far)):
        there = -np.inf
        for k in range(SIDES):
            there = max(there, DIRECTIONS[d, 0] * corners[k, 0] + DIRECTIONS[d, 1] * corners[k, 1])
        far[d] += there
    swept = np.empty((CORNERS, 3))
    return swept, around(far, swept)
