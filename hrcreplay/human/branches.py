"""One posture, two names: which triple (alpha_1, alpha_2, alpha_3) an arm goes by.

The shoulder's three axes are a spherical wrist: (a1, a2, a3) and (a1 + pi, pi - a2, a3 + pi) are the same posture.
The *canonical* name has alpha_1 in the half-turn from -20 to 160 degrees, which holds all of (34a), and the other
angles in the turn around the middle of what (34) allows. So every posture inside (34) has its own angles as canonical
name. At the ends of the half-turn, an arm far across the back or steeply raised, the angles jump although the arm
does not, and whoever follows angles through time takes the name ``nearest`` to where it was.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.human.model import LEFT_ARM, RIGHT_ARM
from hrcreplay.records import Floats

#: Middles of the turns of alpha_1, alpha_2, alpha_3 [rad]; (34) spans -9..160, -46..155 and -118..198 degrees.
_MIDDLES = (70.0 * np.pi / 180.0, 90.0 * np.pi / 180.0, 40.0 * np.pi / 180.0)
_ROUNDING = 1e-9


def canonical(p: Floats) -> Floats:
    """The same postures with both arms by their canonical names, (n, 12) [m, m, rad...]."""
    named = np.array(p, dtype=np.float64, order="C")
    _canonical_rows(named)
    return named


def nearest(p: Floats, reference: Floats) -> Floats:
    """The same postures, each by the name nearest to ``reference``, both (n, 12) [m, m, rad...].

    Heading goes to the nearest turn, each arm to the nearer of its two names. What is NaN in either stays as it is
    in ``p``. Needed wherever angles of two sources are subtracted.
    """
    named = np.array(p, dtype=np.float64, order="C")
    _nearest_rows(named, np.ascontiguousarray(reference))
    return named


@njit(cache=True)
def wrap(angle: float) -> float:
    """The angle in (-pi, pi] [rad]."""
    return angle - 2.0 * np.pi * np.ceil((angle - np.pi) / (2.0 * np.pi))


@njit(cache=True)
def canonical_arm(arm: Floats, margin: float) -> bool:
    """Renames one arm (4,) in place; True where alpha_2 was mirrored, so that its derivatives change sign.

    A name is kept until an angle is out of its half-turn (or turn) by ``margin`` [rad], so that an arm resting where
    the names meet does not flicker.
    """
    mirrored = False
    for j in range(3):
        if abs(arm[j] - _MIDDLES[j]) > np.pi + margin:
            arm[j] = _into_turn(arm[j], j)
    if abs(arm[0] - _MIDDLES[0]) > 0.5 * np.pi + margin + _ROUNDING:
        arm[0], arm[1], arm[2] = (
            _into_turn(arm[0] + np.pi, 0),
            _into_turn(np.pi - arm[1], 1),
            _into_turn(arm[2] + np.pi, 2),
        )
        mirrored = True
    return mirrored


@njit(cache=True)
def nearest_arm(arm: Floats, reference: Floats, variance: Floats) -> None:
    """Renames one arm (4,) in place to the name nearest to the reference (4,), each joint weighed by 1/variance."""
    for j in range(3):
        arm[j] = reference[j] + wrap(arm[j] - reference[j])
    other = (arm[0] + np.pi, np.pi - arm[1], arm[2] + np.pi)
    ours, theirs = 0.0, 0.0
    for j in range(3):
        if np.isfinite(arm[j]) and variance[j] > 0.0:
            ours += (arm[j] - reference[j]) ** 2 / variance[j]
            theirs += wrap(other[j] - reference[j]) ** 2 / variance[j]
    if theirs < ours:
        for j in range(3):
            arm[j] = reference[j] + wrap(other[j] - reference[j])


@njit(cache=True)
def _into_turn(angle: float, j: int) -> float:
    """The angle in the turn around the middle of what joint j of the arm can do [rad]."""
    return _MIDDLES[j] + wrap(angle - _MIDDLES[j])


@njit(cache=True)
def _canonical_rows(p: Floats) -> None:
    for row in p:
        for first in (RIGHT_ARM, LEFT_ARM):
            canonical_arm(row[first : first + 4], 0.0)


@njit(cache=True)
def _nearest_rows(p: Floats, reference: Floats) -> None:
    equal = np.ones(4)
    for i in range(len(p)):
        if np.isfinite(p[i, 2]) and np.isfinite(reference[i, 2]):
            p[i, 2] = reference[i, 2] + wrap(p[i, 2] - reference[i, 2])
        for first in (RIGHT_ARM, LEFT_ARM):
            arm = p[i, first : first + 4].copy()
            known = reference[i, first : first + 4]
            nearest_arm(arm, known, equal)
            for j in range(4):
                if np.isfinite(arm[j]):
                    p[i, first + j] = arm[j]
