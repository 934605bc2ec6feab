"""Reachable sets of ``sound``: intervals of all joints, the area that the pelvis can reach, and the legs below it.

They start from a box of likely states instead of the estimate, and a joint unseen for a long time may have moved since:
the true state of a person is never known exactly and must stay inside.

A polygon encloses all displacements, over all headings, velocities and times.

The displacement at time t along u(phi) is the integral of u . Rz(theta) (v, v_perp). At every instant theta, v and
v_perp are in separate intervals, so the integral is at most that of

    F(tau) = max over theta, v, v_perp in their intervals at tau of u . Rz(theta) (v, v_perp).

Time is divided into pieces, at the corners of the velocity profiles and in between. In a piece theta is taken from its
interval at the end of the piece, which contains all earlier ones. The ends of the velocity intervals are then linear in
tau, and F, the maximum of linear functions of them, is convex: the trapezoidal rule is never below its integral. The
same holds for max(0, F), which bounds the displacement at instants inside the piece.

Neighbouring sides of the polygon meet in its corners. A direction between theirs is a sum of both with weights >= 0,
so no displacement is further along it than the corner: the hull of the corners encloses them, whatever the sides.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hrcreplay.human.model import SHOWN_BY
from hrcreplay.human.prediction.joint_reach import Stops, fastest, interval, rise, saturation_s, stops
from hrcreplay.kernels import njit
from hrcreplay.records import DOF, Floats, HumanStates
from hrcreplay.settings.sections import Prediction

Range = tuple[float, float]


class Likely(NamedTuple):
    """Possible states of people at the tick, one per row: a box around the estimate, and times without observation."""

    p: Floats  #: (n, 13)
    v: Floats  #: (n, 13)
    p_off: Floats  #: (n, 13) largest error of p
    v_off: Floats  #: (n, 13) largest error of v
    unseen_s: Floats  #: (n, 13) time since a joint was seen, 0 within its memory [s]


class SoundMotionLimits(NamedTuple):
    """Bounds on the motions that ``sound`` encloses."""

    bounds: Floats  #: (6, 13) of ``human.model.bounds_of``
    coupled: bool  #: True: Eq. (34b), (34c) hold
    horizon: float  #: horizon and latency [s]
    memory: float  #: time for which the filter continues without a measurement [s]


def start_states(states: HumanStates, prediction: Prediction, memory_s: float) -> Likely:
    """Returns the initial states of ``sound``; a limb unseen for longer than ``memory_s`` [s] may have moved since."""
    unseen = np.where(states.unseen_s > memory_s, states.unseen_s, 0.0)[:, SHOWN_BY]
    off = (prediction.sigmas * states.p_std, prediction.sigmas * states.v_std)
    return Likely(*(np.ascontiguousarray(a) for a in (states.p, states.v, *off, unseen)))


@njit(cache=True, inner=True)
def enclose_row(i: int, at: Likely, within: SoundMotionLimits, low: Floats, high: Floats, corners: Floats) -> None:
    """Writes the intervals (13,) of row i, and the corners (SIDES, 2) of the polygon around the pelvis [m].

    A joint unseen for longer than its memory may since have had any velocity within the bounds; its horizon starts
    when it was last seen. Its estimate has coasted from there, for at most the memory.

    Args:
        i: Row of ``at``.
        at: Possible states of the people.
        within: Bounds on their motions.
        low: (13,) receives the lower ends [m, m, rad..., m]; NaN if the state is NaN.
        high: (13,) receives the upper ends.
        corners: (SIDES, 2) receives the corners, world [m]; NaN if the state is NaN.
    """
    _walk(i, at, within, low, high, corners)
    for j in range(3, DOF):
        limit = stops(j, within.bounds, within.coupled, low, high)
        if at.unseen_s[i, j] == np.inf:
            low[j], high[j] = limit[0], limit[3]
        else:
            low[j], high[j] = _joint(i, j, at, within, limit)


@njit(cache=True, inner=True)
def _joint(i: int, j: int, at: Likely, within: SoundMotionLimits, limit: Stops) -> Range:
    bounds, _, horizon, memory = within
    p, off, unseen = at.p[i, j], at.p_off[i, j], at.unseen_s[i, j]
    if np.isnan(p + off + at.v[i, j] + at.v_off[i, j]):
        return np.nan, np.nan
    if unseen > 0.0:
        drift = memory * max(-bounds[2, j], bounds[3, j])
        span = unseen + horizon
        low, high = p - off - drift + bounds[2, j] * span, p + off + drift + bounds[3, j] * span
        return min(p, max(low, limit[0])), max(p, min(high, limit[3]))
    v, v_off = at.v[i, j], at.v_off[i, j]
    return interval((p - off, p + off), (v - v_off, v + v_off), bounds[2:, j], limit, horizon)


@njit(cache=True, inner=True)
def _walk(i: int, at: Likely, within: SoundMotionLimits, low: Floats, high: Floats, corners: Floats) -> None:
    bounds, _, horizon, memory = within
    p, off, v, v_off = at.p[i, :3], at.p_off[i, :3], at.v[i, :3], at.v_off[i, :3]
    low[:3], high[:3], corners[:] = np.nan, np.nan, np.nan
    span = horizon + at.unseen_s[i, :3].max()
    if not np.isfinite(p.sum() + off.sum() + v.sum() + v_off.sum() + span):
        return
    heading = (p[2] - off[2], p[2] + off[2])
    ahead, left = body_velocity(v, v_off, heading)
    velocity = (ahead, left, (v[2] - v_off[2], v[2] + v_off[2]))
    drift = 0.0
    if span > horizon:
        turn = memory * max(-bounds[2, 2], bounds[3, 2])
        heading = (heading[0] - turn, heading[1] + turn)
        velocity = ((bounds[2, 0], bounds[3, 0]), (bounds[2, 1], bounds[3, 1]), (bounds[2, 2], bounds[3, 2]))
        drift = memory * np.hypot(max(-bounds[2, 0], bounds[3, 0]), max(-bounds[2, 1], bounds[3, 1]))
    far = np.empty(SIDES)
    for side in range(SIDES):
        phi = p[2] + 2.0 * np.pi * side / SIDES
        c, s = np.cos(phi), np.sin(phi)
        far[side] = c * p[0] + s * p[1] + abs(c) * off[0] + abs(s) * off[1] + drift
    walked(heading, velocity, bounds, span, far)
    corners_of(far, p[2], corners)
    for k in range(2):
        low[k], high[k] = corners[:, k].min(), corners[:, k].max()
    low[2], high[2] = turn_heading(heading, velocity[2], bounds, span)


def enclose(at: Likely, within: SoundMotionLimits) -> tuple[Floats, Floats]:
    """Computes the reachable intervals of all rows: lower and upper ends, (n, 13) each [m, m, rad..., m]."""
    low, high = np.empty_like(at.p), np.empty_like(at.p)
    _enclose_rows(at, within, low, high)
    return low, high


@njit(cache=True)
def _enclose_rows(at: Likely, within: SoundMotionLimits, low: Floats, high: Floats) -> None:
    corners = np.empty((SIDES, 2))
    for i in range(len(at.p)):
        enclose_row(i, at, within, low[i], high[i], corners)


#: Number of sides of the polygon; the first one faces ahead.
SIDES = 8
#: Number of equal pieces of the horizon, in addition to the corners of the profiles.
_PIECES = 4


@njit(cache=True, inner=True)
def rotate_range(x: float, y: float, low: float, high: float) -> Range:
    """Range of x cos(phi) + y sin(phi) for phi in [low, high].

    Args:
        x: Coefficient, in the unit of the result.
        y: Coefficient, in the same unit.
        low: Smallest phi [rad].
        high: Largest phi [rad].
    """
    middle, half = 0.5 * (low + high), min(0.5 * (high - low), np.pi)
    c, s = np.cos(middle), np.sin(middle)
    along, across, radius = c * x + s * y, c * y - s * x, np.sqrt(x * x + y * y)
    cos_half, sin_half = np.cos(half), np.sin(half)
    ends = along * cos_half, abs(across) * sin_half
    most = radius if along >= cos_half * radius else ends[0] + ends[1]
    least = -radius if -along >= cos_half * radius else ends[0] - ends[1]
    return least, most


@njit(cache=True, inner=True)
def body_velocity(v: Floats, spread: Floats, heading: Range) -> tuple[Range, Range]:
    """Computes ranges of v and v_perp, Eq. (33), for world velocities in v +- spread (2,) and a range of headings."""
    forward = rotate_range(v[0], v[1], heading[0], heading[1])
    left = rotate_range(v[1], -v[0], heading[0], heading[1])
    cosine = rotate_range(1.0, 0.0, heading[0], heading[1])
    sine = rotate_range(0.0, 1.0, heading[0], heading[1])
    c, s = max(-cosine[0], cosine[1]), max(-sine[0], sine[1])
    ahead, aside = c * spread[0] + s * spread[1], s * spread[0] + c * spread[1]
    return (forward[0] - ahead, forward[1] + ahead), (left[0] - aside, left[1] + aside)


@njit(cache=True, inner=True)
def walked(heading: Range, velocity: tuple[Range, Range, Range], bounds: Floats, horizon: float, far: Floats) -> None:
    """Adds to far (SIDES,) the maximum displacement of the pelvis along each side's direction in [0, horizon] [m].

    Replaces Eq. (20)-(30), whose box does not contain all motions of Eq. (25): docs/paper.md.

    Args:
        heading: Initial headings [rad].
        velocity: Initial v, v_perp and omega [m/s, m/s, rad/s].
        bounds: (6, 13) of ``human.model.bounds_of``.
        horizon: [s].
        far: Receives the sums.
    """
    cuts = _cuts(velocity, bounds, horizon)
    total, largest = np.zeros(SIDES), np.zeros(SIDES)
    middle = 0.5 * (heading[0] + heading[1])
    box = _box(velocity, bounds, 0.0)
    for i in range(len(cuts) - 1):
        step, later = cuts[i + 1] - cuts[i], _box(velocity, bounds, cuts[i + 1])
        turn = _turn(velocity[2], bounds, cuts[i + 1])
        low, high = heading[0] - turn[0] - middle, heading[1] + turn[1] - middle
        for side in range(SIDES):
            phi = 2.0 * np.pi * side / SIDES
            before, after = _farthest(box, phi - high, phi - low), _farthest(later, phi - high, phi - low)
            gain = 0.5 * step * (max(before, 0.0) + max(after, 0.0))
            largest[side] = max(largest[side], total[side] + gain)
            total[side] += 0.5 * step * (before + after)
        box = later
    for side in range(SIDES):
        far[side] += largest[side]


@njit(cache=True, inner=True)
def _turn(omega: Range, bounds: Floats, t: float) -> Range:
    """Largest turn of the heading to the right and to the left at any time until t [rad]."""
    least, most, brake, gain = bounds[2, 2], bounds[3, 2], bounds[4, 2], bounds[5, 2]
    return rise(-omega[0], -least, -brake, -gain, t), rise(omega[1], most, gain, brake, t)


@njit(cache=True, inner=True)
def turn_heading(heading: Range, omega: Range, bounds: Floats, horizon: float) -> Range:
    """Interval of all headings at any time in [0, horizon] [rad].

    Args:
        heading: Initial headings [rad].
        omega: Initial angular velocities [rad/s].
        bounds: (6, 13) of ``human.model.bounds_of``.
        horizon: [s].
    """
    turn = _turn(omega, bounds, horizon)
    return heading[0] - turn[0], heading[1] + turn[1]


@njit(cache=True, inner=True)
def _cuts(velocity: tuple[Range, Range, Range], bounds: Floats, horizon: float) -> Floats:
    cuts = np.empty(_PIECES + 5)
    for i in range(_PIECES + 1):
        cuts[i] = horizon * i / _PIECES
    for k in range(2):
        least, most, brake, gain = bounds[2, k], bounds[3, k], bounds[4, k], bounds[5, k]
        v = velocity[k]
        cuts[_PIECES + 1 + 2 * k] = min(horizon, saturation_s(v[1], most, gain, brake))
        cuts[_PIECES + 2 + 2 * k] = min(horizon, saturation_s(-v[0], -least, -brake, -gain))
    cuts.sort()
    return cuts


@njit(cache=True, inner=True)
def _box(velocity: tuple[Range, Range, Range], bounds: Floats, t: float) -> tuple[Range, Range]:
    """Intervals of v and v_perp at time t."""
    ahead, left = velocity[0], velocity[1]
    return _speeds(ahead, bounds, 0, t), _speeds(left, bounds, 1, t)


@njit(cache=True, inner=True)
def _speeds(v: Range, bounds: Floats, k: int, t: float) -> Range:
    least, most, brake, gain = bounds[2, k], bounds[3, k], bounds[4, k], bounds[5, k]
    return -fastest(-v[0], -least, -brake, -gain, t), fastest(v[1], most, gain, brake, t)


@njit(cache=True, inner=True)
def _farthest(box: tuple[Range, Range], low: float, high: float) -> float:
    """F: maximum of v cos(psi) + v_perp sin(psi) over the box and psi in [low, high]; at a corner, as it is convex."""
    largest = -np.inf
    for v in box[0]:
        for v_perp in box[1]:
            largest = max(largest, rotate_range(v, v_perp, low, high)[1])
    return largest


@njit(cache=True, inner=True)
def corners_of(far: Floats, ahead: float, corners: Floats) -> None:
    """Writes the corners of the polygon into corners (SIDES, 2); ``ahead``: direction of its first side."""
    step = 2.0 * np.pi / SIDES
    for i in range(SIDES):
        after = (i + 1) % SIDES
        a, b = ahead + step * i, ahead + step * (i + 1)
        corners[i, 0] = (far[i] * np.sin(b) - far[after] * np.sin(a)) / np.sin(step)
        corners[i, 1] = (far[after] * np.cos(a) - far[i] * np.cos(b)) / np.sin(step)


#: Distance from the middle of a leg, the place of a camera's points, to the skin: a thigh of 0.5 m girth [m].
THIGH_M = 0.08
#: Length of the thigh, and of the shank with foot: half the pelvis's height of the median man [m].
BONE_M = 0.47
#: Maximum height of the knee of a leg that carries the person: shank upright, on the toes [m].
KNEE_M = 0.55


@njit(cache=True, inner=True)
def knees_out(pelvis_m: float) -> float:
    """Distance of the knees from the line below a pelvis at a height, with the foot below it [m]."""
    return np.sqrt(max(0.0, BONE_M**2 - (0.5 * pelvis_m) ** 2))  # thigh and shank have the same length


@njit(cache=True, inner=True)
def legs_around(corners: Floats, ahead: float, lowest: float, highest: float, radius: float) -> tuple[Floats, int]:
    """Encloses the legs: from the floor to the highest pelvis over its area, out to the knees of the lowest pelvis.

    Args:
        corners: (SIDES, 2) corners of the area of the pelvis [m].
        ahead: Direction of its first side [rad].
        lowest: Minimum height of the pelvis [m].
        highest: Maximum height of the pelvis [m].
        radius: Radius of the ball around the result; it contains the knees of standing people [m].

    Returns:
        (m, 3) points whose hull encloses the legs, and m; one NaN point if the state is NaN.
    """
    if not np.isfinite(corners.sum() + lowest + highest):
        return np.full((1, 3), np.nan), 1
    out = max(0.0, knees_out(lowest) - (radius - THIGH_M)) / np.cos(np.pi / SIDES)
    swept = np.zeros((3 * SIDES, 3))
    for k in range(SIDES):
        middle = ahead + (k + 0.5) * 2.0 * np.pi / SIDES
        swept[k, 0] = corners[k, 0] + out * np.cos(middle)
        swept[k, 1] = corners[k, 1] + out * np.sin(middle)
    swept[SIDES : 2 * SIDES, :2], swept[SIDES : 2 * SIDES, 2] = swept[:SIDES, :2], min(KNEE_M, highest)
    swept[2 * SIDES :, :2], swept[2 * SIDES :, 2] = corners, highest
    return swept, len(swept)
