"""Tubes around the motion of the limbs at constant fused velocity, as wide as the departures of recorded people.

Worst-case bounds on thirteen joints enclose two to three times the volume that people use. So a limit set may also
bound the departure of whole limbs from constant velocity (``Departure``), fitted on recordings. The tube of a limb is
the hull of its ends at the tick and after the horizon, raised and lowered as people stand up and sit down, with a ball
around it; a person who stops or slows down stays in that hull. Arms are raised and lowered by a few centimetres only:
they move by themselves as far as with a body that rises, and their balls contain both. No motion within the bound
leaves the tube, for any motion of the joints. Where a camera shows a limb away from the fused one, the hull contains
both.

The ball is the sum of where the limb is now (a multiple of its residual) and of where it can go. The latter grows with
the limb's present speed: someone who swings an arm already departs further than someone who stands still.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hrcreplay.human.model import (
    ARM_POINTS,
    BENDS,
    HANDS,
    HEAD,
    LEG_POINTS,
    NECK,
    PELVIS,
    ULA,
    URA,
    LimitSet,
    skeleton_row,
)
from hrcreplay.human.prediction.sound_reach import knees_out
from hrcreplay.kernels import njit
from hrcreplay.records import BODY, LIMBS, POINTS, Bools, Floats, HumanStates

#: Time step of the difference that gives the velocities of the points [s].
_STEP_S = 1e-4
#: Age of the recorded limbs in the fit; a limb seen longer ago gets the additional time to depart [s].
_FRESH_S = 0.1
#: Maximum residual from noise; a larger one is another position that the filter has not accepted yet [m].
NOISE_M = 0.2
#: Longest extrapolation at constant velocity, of trunk and legs, and of arms [s].
_CARRIES_S, _CARRIES_ARMS_S = 0.25, 0.15
#: Speed of a swinging leg relative to the body: each foot rests about half of the time.
_STRIDE = 2.0
#: Age of the frame in which legs are mostly seen: since then they were carried with the pelvis, but one stood still and
#: the other one swung [s].
_LEGS_AGE_S = 0.07
#: Sway of legs, ``HumanStates.legs_sway_m``, that counts at least; that counts at most, as of people who walk, whose
#: legs a tracker throws, or whose sway is not known; and of legs out of sight, as of somebody on one spot [m].
_LEAST_SWAY_M, _MOST_SWAY_M, _HIDDEN_SWAY_M = 0.008, 0.03, 0.018
#: Acceleration with which legs at rest begin to move; large enough for simulated people who get up in 0.6 s
#: (``tests/human/rising.py``) [m/s^2].
LEGS_BEGIN_M_PER_S2 = 5.0
#: How fast the sway of legs may rise while no camera shows them: by that acceleration, over the 25 ms of a sway [m/s].
_SWAY_RISES_M_PER_S = LEGS_BEGIN_M_PER_S2 * 0.025
#: Maximum rise, and sink, of an arm's hull [m].
_ARMS_RISE_M = 0.06
#: Minimum distance of a hand from its wrist that gives a direction [m].
_SHORT_M = 0.02
HEAD_LIMB, THORAX, LEGS = (BODY.index(limb) for limb in ("HD", "THX", "LEGS"))
#: For each limb of BODY the one on which it hangs; all hang on the thorax in the end.
HANGS_ON = np.array([THORAX, THORAX, THORAX, URA, THORAX, ULA, THORAX])
#: For each limb of BODY, True for itself and those of BODY that carry it: an arm on an unseen torso is unknown. For the
#: legs the torso alone, as legs out of sight have a tube, too.
_CARRIED_BY = np.eye(len(BODY), dtype=np.bool_)
_CARRIED_BY[LEGS, LEGS] = False
for _limb, _carrying in enumerate(HANGS_ON):
    _CARRIED_BY[_limb, [_carrying, HANGS_ON[_carrying]]] = True
#: Speed above which the bound on a limb's departure grows no further [m/s].
FASTEST_M_PER_S = 1.0
#: Speeds at which people walk and reach, ISO 13855; of each limb of BODY [m/s].
WALKING_M_PER_S, HAND_M_PER_S = 1.6, 2.0
PEOPLES_SPEEDS = np.array([HAND_M_PER_S if limb in LIMBS[2:] else WALKING_M_PER_S for limb in BODY])
#: Standard deviations of the lengths that count while the residual is unknown.
_LENGTHS_OFF = 2.0
#: Maximum number of points of a tube for the fused limb, and for each camera.
MOST_POINTS = 2 * (len(LEG_POINTS) + 6)
_ARMS = np.array(ARM_POINTS)
#: Ends of each of BODY, repeated where there are fewer than three, and their number; of the legs the pelvis.
_ENDS_OF = np.array(
    [
        (NECK, HEAD, HEAD),
        (PELVIS, ARM_POINTS[0][0], ARM_POINTS[1][0]),
        *((*ARM_POINTS[arm][part : part + 2], ARM_POINTS[arm][part]) for arm in range(2) for part in range(2)),
        (PELVIS, PELVIS, PELVIS),
    ]
)
_ENDS = np.array([2, 3, 2, 2, 2, 2, 1])


class Tubes(NamedTuple):
    """Data of the tubes, one row per tick."""

    points: Floats  #: (n, 20, 3) of ``HumanStates.points_m``
    camera_points: Floats  #: (n, c, 20, 3) of ``HumanStates.camera_points_m``; c = 0 if they are not known
    residual: Floats  #: (n, 7) what ``residuals`` multiplies: residual of each limb of BODY, of LEGS their sway [m]
    usable: Bools  #: (n, 7) True: the limb has a tube
    legs_shown: Bools  #: (n,) True: the positions of both knees and ankles are known
    legs_m: Floats  #: (n,) their distance from the line below the pelvis [m]; NaN: unknown or not used
    legs_new: Bools  #: (n,) True: the person is too new to believe where cameras show the legs
    legs_off_m: Floats  #: (n,) how far the legs of new people may be from their hull; 0 for others [m]
    late_s: Floats  #: (n, 7) time for which it may depart beyond horizon and latency, as it was seen that long ago [s]
    lost_m: Floats  #: (n, 7) how far people go in the time for which their torso has been out of sight [m]


class DepartureTable(NamedTuple):
    """The arrays of ``Departure``, contiguous; one horizon of zeros for a limit set without departures."""

    horizon_s: Floats  #: (h,)
    beyond_m: Floats  #: (7, h)
    residuals: Floats  #: (7, h)
    swings_s: Floats  #: (7, h)
    rise_m: Floats  #: (h,) [m]
    sink_m: Floats  #: (h,) [m]


def departure_table(limits: LimitSet) -> DepartureTable:
    """Makes the table of a limit set."""
    known = limits.departure
    if known is None:
        return DepartureTable(np.ones(1), *np.zeros((3, len(BODY), 1)), *np.zeros((2, 1)))
    swings_s = np.zeros_like(known.beyond_m) if known.swings_s is None else known.swings_s
    arrays = known.horizon_s, known.beyond_m, known.residuals, swings_s, known.rise_m, known.sink_m
    return DepartureTable(*(np.ascontiguousarray(array) for array in arrays))


def tubes(states: HumanStates, bounded: bool, unknown_m: float, memory_s: float) -> Tubes:
    """Makes the tubes of the limbs seen within the filter's memory.

    Args:
        states: The fused person.
        bounded: True: the limit set bounds departures; otherwise no limb has a tube.
        unknown_m: Distance from the model until it is known; NaN: distances from the model are not used [m].
        memory_s: Time for which the filter continues without a measurement [s].
    """
    n, shown = len(states), states.camera_points_m
    if shown is None:
        shown = np.empty((n, 0, len(POINTS), 3))
        shown.setflags(write=False)  # like those of a table; otherwise numba compiles the kernels again
    found = Tubes(
        points=np.ascontiguousarray(states.points_m),
        camera_points=np.ascontiguousarray(shown),
        residual=np.zeros((n, len(BODY))),
        usable=np.zeros((n, len(BODY)), dtype=np.bool_),
        legs_shown=np.empty(n, dtype=np.bool_),
        legs_m=np.full(n, np.nan),
        legs_new=np.zeros(n, dtype=np.bool_),
        legs_off_m=np.zeros(n),
        late_s=np.empty((n, len(BODY))),
        lost_m=np.zeros((n, len(BODY))),
    )
    unseen_s, residual_m = np.ascontiguousarray(states.unseen_s), np.ascontiguousarray(states.residual_m)
    off_m = np.ascontiguousarray(_LENGTHS_OFF * states.lengths_std_m)
    sway_m = np.full(n, np.nan) if states.legs_sway_m is None else np.ascontiguousarray(states.legs_sway_m)
    _tube_rows(unseen_s, residual_m, off_m, sway_m, bounded, unknown_m, memory_s, found)
    return found


@njit(cache=True)
def _tube_rows(
    unseen_s: Floats,
    residual_m: Floats,
    off_m: Floats,
    sway_m: Floats,
    bounded: bool,
    unknown_m: float,
    memory_s: float,
    found: Tubes,
) -> None:
    for i in range(len(unseen_s)):
        displaced = displaced_m(off_m[i])
        lost_s = max(0.0, min(unseen_s[i, THORAX], memory_s) - _FRESH_S)
        found.legs_shown[i] = np.isfinite(found.points[i][BENDS].sum())
        for limb in range(len(BODY)):
            unseen = -np.inf
            for carrying in range(len(BODY)):
                if _CARRIED_BY[limb, carrying]:
                    unseen = np.maximum(unseen, unseen_s[i, carrying])
            found.usable[i, limb] = bounded and unseen <= memory_s
            found.lost_m[i, limb] = PEOPLES_SPEEDS[limb] * lost_s
            if limb == LEGS and found.legs_shown[i]:
                unseen = np.maximum(unseen, unseen_s[i, LEGS])
            found.late_s[i, limb] = np.minimum(np.maximum(unseen - _FRESH_S, 0.0), memory_s)
            if limb < LEGS and not np.isnan(unknown_m):
                own = residual_m[i, limb]
                found.residual[i, limb] = max(unknown_m, displaced[limb]) if np.isnan(own) else own
        found.legs_new[i] = bounded and np.isnan(residual_m[i, THORAX])
        found.residual[i, LEGS] = _HIDDEN_SWAY_M
        if found.legs_shown[i]:
            found.residual[i, LEGS] = _sway_of(sway_m[i] + _SWAY_RISES_M_PER_S * found.late_s[i, LEGS])
        if not np.isnan(unknown_m):
            found.legs_m[i] = residual_m[i, LEGS]
            found.legs_off_m[i] = unknown_m if found.legs_new[i] else 0.0


@njit(cache=True, inner=True)
def _sway_of(shown_m: float) -> float:
    """Sway of legs that cameras show as far as it counts [m]."""
    return max(_LEAST_SWAY_M, min(shown_m, _MOST_SWAY_M)) if np.isfinite(shown_m) else _MOST_SWAY_M


@njit(cache=True, inner=True)
def displaced_m(off: Floats) -> tuple[float, float, float, float, float, float]:
    """Displacement of the far ends of LIMBS by errors (7,) of the lengths up the chain [m]; the own length is apart."""
    shoulder = np.hypot(off[0], off[2])
    return 0.0, 0.0, shoulder, shoulder + off[4], shoulder, shoulder + off[3]


@njit(cache=True, inner=True)
def departs_m(limb: int, reach_s: float, residual_m: float, speed: float, table: DepartureTable) -> float:
    """Largest departure of a limb until ``reach_s`` [m].

    At least the residual, as the limb may already be there.

    Args:
        limb: Index into BODY.
        reach_s: Time since the tick [s].
        residual_m: The limb's residual [m]
        speed: Present speed of the limb [m/s].
        table: The bounds.
    """
    beyond = _until(reach_s, table.horizon_s, table.beyond_m[limb])
    beyond += min(speed, FASTEST_M_PER_S) * _until(reach_s, table.horizon_s, table.swings_s[limb])
    times = _between(reach_s, table.horizon_s, table.residuals[limb])
    return max(residual_m, beyond + times * min(residual_m, NOISE_M) + max(0.0, residual_m - NOISE_M))


@njit(cache=True, inner=True)
def _until(reach_s: float, horizon_s: Floats, most_m: Floats) -> float:
    """A row (h,) of the table at ``reach_s`` [m].

    Linear between the measured horizons, as it grows faster than the horizon; constant before the first; after the last
    with the same slope as before it, as people's speeds are bounded.
    """
    found, last = _between(reach_s, horizon_s, most_m), len(horizon_s) - 1
    if reach_s > horizon_s[last] and last > 0:
        slope = (most_m[last] - most_m[last - 1]) / (horizon_s[last] - horizon_s[last - 1])
        found += max(0.0, slope) * (reach_s - horizon_s[last])
    return found


@njit(cache=True, inner=True)
def _between(reach_s: float, horizon_s: Floats, values: Floats) -> float:
    """A row (h,) of the table at ``reach_s``, linear between the horizons, constant before and after; as np.interp."""
    last = len(horizon_s) - 1
    if np.isnan(reach_s) or reach_s >= horizon_s[last]:
        return reach_s if np.isnan(reach_s) else values[last]
    k = -1
    while reach_s >= horizon_s[k + 1]:
        k += 1
    if k < 0:
        return values[0]
    slope = (values[k + 1] - values[k]) / (horizon_s[k + 1] - horizon_s[k])
    return slope * (reach_s - horizon_s[k]) + values[k]


@njit(cache=True, inner=True)
def velocities(p: Floats, v: Floats, lengths: Floats, found: Floats) -> None:
    """Writes the velocities (20, 3) of the model's points [m/s]; NaN for points outside the model.

    Args:
        p: (13,) posture.
        v: (13,) its velocity.
        lengths: (7,) [m].
        found: (20, 3) receives them.
    """
    later, earlier = np.full(found.shape, np.nan), np.full(found.shape, np.nan)
    skeleton_row(p + _STEP_S * v, lengths, later)
    skeleton_row(p - _STEP_S * v, lengths, earlier)
    found[:] = (later - earlier) / (2.0 * _STEP_S)


@njit(cache=True, inner=True)
def speed_of(limb: int, velocity: Floats) -> float:
    """Speed of the fastest end of a limb; of the legs that of the pelvis [m/s]; ``velocity`` (20, 3) [m/s]."""
    most = 0.0
    for k in _ENDS_OF[limb]:
        most = max(most, np.sqrt((velocity[k] ** 2).sum()))
    return most


def limb_speeds(states: HumanStates) -> Floats:
    """(n, 7) present speeds of the limbs of BODY, up to ``FASTEST_M_PER_S`` [m/s]."""
    found: Floats = np.minimum(motion_of_limbs(states)[1], FASTEST_M_PER_S)
    return found


def motion_of_limbs(states: HumanStates) -> tuple[Floats, Floats]:
    """(n, 20, 3) velocities of the model's points, NaN for other points, and (n, 7) speeds of the limbs [m/s]."""
    velocity, speed = np.empty((len(states), len(POINTS), 3)), np.empty((len(states), len(BODY)))
    _motion_rows(*(np.ascontiguousarray(part) for part in (states.p, states.v, states.lengths_m)), velocity, speed)
    return velocity, speed


@njit(cache=True)
def _motion_rows(p: Floats, v: Floats, lengths: Floats, velocity: Floats, speed: Floats) -> None:
    for i in range(len(p)):
        velocities(p[i], v[i], lengths[i], velocity[i])
        for limb in range(speed.shape[1]):
            speed[i, limb] = speed_of(limb, velocity[i])


@njit(cache=True, inner=True)
def tube(
    limb: int,
    points: Floats,
    shown: Floats,
    velocity: Floats,
    span_s: float,
    reach_s: float,
    hand_m: float,
    legs_new: bool,
    table: DepartureTable,
    swept: Floats,
) -> int:
    """Writes the points whose hull is a limb's tube before the ball, in place of Alg. 2; returns their number.

    The hand lies along the forearm and at its observed position. Of the lower body the pelvis rises and sinks.

    Args:
        limb: Index into BODY.
        points: (20, 3) positions of the body's points [m].
        shown: (c, 20, 3) where each camera shows them, if not there; otherwise NaN [m].
        velocity: (20, 3) of the model's points [m/s].
        span_s: Horizon and latency [s].
        reach_s: Time after the tick until which the limb may depart [s].
        hand_m: Length of the hand beyond the wrist [m].
        legs_new: Whether the legs may be elsewhere than they are shown.
        table: The bounds.
        swept: ((1 + c) MOST_POINTS, 3) receives the points.
    """
    carries_s = _CARRIES_S if limb in (HEAD_LIMB, THORAX, LEGS) else _CARRIES_ARMS_S
    unmeasured_s = max(0.0, span_s - table.horizon_s[-1])  # for these points only the velocity is known
    carries_s = min(span_s, carries_s + unmeasured_s)
    n = _ends(limb, points, shown, velocity, carries_s, hand_m, legs_new, swept)
    rising = n
    if limb == LEGS:
        rising = 2
        for c in range(len(shown)):
            rising += 2 * np.isfinite(shown[c, PELVIS, 0])
    sink_m = _until(reach_s, table.horizon_s, table.sink_m)
    rise_m = _until(reach_s, table.horizon_s, table.rise_m)
    if limb not in (HEAD_LIMB, THORAX, LEGS):
        rise_m, sink_m = min(rise_m, _ARMS_RISE_M), min(sink_m, _ARMS_RISE_M)
    for i in range(rising):
        swept[n + i] = swept[i]
        swept[n + i, 2] -= sink_m
        swept[i, 2] += rise_m
    return n + rising


@njit(cache=True, inner=True)
def _ends(
    limb: int,
    points: Floats,
    shown: Floats,
    velocity: Floats,
    span_s: float,
    hand_m: float,
    legs_new: bool,
    swept: Floats,
) -> int:
    """Writes a limb's ends at the tick and after ``span_s``; returns the number of points; the pelvis's come first."""
    if limb == LEGS:
        return _legs(points, shown, velocity, span_s, legs_new, swept)
    if limb not in (HEAD_LIMB, THORAX) and (limb - 2) % 2 == 1:
        return _lower_arm(limb, points, shown, velocity, span_s, hand_m, swept)
    n = 0
    ends = _ENDS_OF[limb, : _ENDS[limb]]
    for k in ends:
        n = _add(points[k], velocity[k], span_s, swept, n)
    for c in range(len(shown)):
        for k in ends:
            if np.isfinite(shown[c, k, 0]):
                n = _add(shown[c, k], velocity[k], span_s, swept, n)
    return n


@njit(cache=True, inner=True)
def _legs(points: Floats, shown: Floats, velocity: Floats, span_s: float, new: bool, swept: Floats) -> int:
    """Writes the legs; of somebody new also from the line below the pelvis to stretched ahead, as far as that allows.

    In the first second a tracker puts legs that it does not see below the pelvis, and finds them ahead of who sits.
    """
    n = _add(points[PELVIS], velocity[PELVIS], span_s, swept, 0)
    for c in range(len(shown)):
        if np.isfinite(shown[c, PELVIS, 0]):
            n = _add(shown[c, PELVIS], velocity[PELVIS], span_s, swept, n)
    along = _STRIDE * velocity[PELVIS]
    along[2] = 0.0  # feet stay on the floor
    stood = along * (_LEGS_AGE_S / _STRIDE)
    span_s += _LEGS_AGE_S
    for k in LEG_POINTS:
        if np.isfinite(points[k].sum()):
            n = _add(points[k] - stood, along, span_s + _LEGS_AGE_S / _STRIDE, swept, n)
        for c in range(len(shown)):
            if np.isfinite(shown[c, k, 0]):
                n = _add(shown[c, k] - stood, along, span_s + _LEGS_AGE_S / _STRIDE, swept, n)
    below = points[PELVIS].copy()
    below[2] = 0.0
    if new or not np.isfinite(points[BENDS].sum()):  # around the line from the floor to the pelvis
        n = _add(below, along, span_s, swept, n)
    if new:
        ahead = 2.0 * knees_out(points[PELVIS, 2]) * _heading(points)
        n = _add(below + ahead, along, span_s, swept, n)
        n = _add(points[PELVIS] + ahead, along, span_s, swept, n)
    return n


@njit(cache=True, inner=True)
def _heading(points: Floats) -> Floats:
    """(3,) horizontal direction in which a body's shoulders face; 0 if they are one above the other."""
    across = points[ARM_POINTS[1][0]] - points[ARM_POINTS[0][0]]  # to the left
    size = np.sqrt(across[0] ** 2 + across[1] ** 2)
    return np.array([across[1], -across[0], 0.0]) / size if size > 0.0 else np.zeros(3)


@njit(cache=True, inner=True)
def _lower_arm(
    limb: int, points: Floats, shown: Floats, velocity: Floats, span_s: float, hand_m: float, swept: Floats
) -> int:
    """Writes the forearm with its hand; where a camera shows any of it elsewhere, also as that camera shows it."""
    arm = (limb - 2) // 2
    _, elbow, wrist = _ARMS[arm]
    hand = HANDS[arm]
    ends = np.empty((3, 3))
    ends[0], ends[1], ends[2] = points[elbow], points[wrist], points[hand]
    n = _add_arm(ends, velocity[elbow], velocity[wrist], span_s, hand_m, swept, 0)
    for c in range(len(shown)):
        elsewhere = False
        for i, k in enumerate((elbow, wrist, hand)):
            there = np.isfinite(shown[c, k, 0])
            ends[i] = shown[c, k] if there else points[k]
            elsewhere = elsewhere or there
        if elsewhere:
            n = _add_arm(ends, velocity[elbow], velocity[wrist], span_s, hand_m, swept, n)
    return n


@njit(cache=True, inner=True)
def _add_arm(ends: Floats, elbows: Floats, wrists: Floats, span_s: float, hand_m: float, swept: Floats, n: int) -> int:
    """Writes elbow, wrist and hand (3, 3) [m], with the velocities (3,) of elbow and wrist [m/s]."""
    elbow, wrist, hand = ends[0], ends[1], ends[2]
    n = _add(elbow, elbows, span_s, swept, n)
    n = _add(wrist, wrists, span_s, swept, n)
    forearm = wrist - elbow
    length = np.sqrt((forearm**2).sum())
    if length > 0.0 and hand_m > 0.0:
        turning = wrists + (wrists - elbows) * (hand_m / length)
        n = _add(wrist + forearm * (hand_m / length), turning, span_s, swept, n)
        bent = hand - wrist
        size = np.sqrt((bent**2).sum())
        if size > _SHORT_M:
            n = _add(wrist + bent * (hand_m / size), turning, span_s, swept, n)
    return n


@njit(cache=True, inner=True)
def _add(point: Floats, velocity: Floats, span_s: float, swept: Floats, n: int) -> int:
    for i in range(3):
        swept[n, i] = point[i]
        swept[n + 1, i] = point[i] + velocity[i] * span_s
    return n + 2
