"""Points that a camera shows wrong over time: they lose their weight while another camera shows them, and it is told.

Where two cameras show a point apart, nobody knows which is right, and the volumes contain both. There is evidence if

- more cameras agree on another place than on this one, or
- no other camera shows it here, and it is below the floor or at the end of a bone of wrong length: a bone of the arms
  or the trunk unlike the person's, or one of a leg unlike what this camera showed before.

A camera of which most points are wrong may look at somebody else, or have a wrong pose: that is no evidence against a
limb. Cameras that are wrong alike outvote one that is right, so it is told. The share of the frames with evidence is a
running mean with a memory of ``_MEMORY_S``. Beyond a half, the point is disbelieved: it enters neither the filter nor
the volumes as long as a camera that is believed shows it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hrcreplay.geometry.vectors import distance
from hrcreplay.human.fusion.kalman import SHOWN_NS, Filter, Rules, shows
from hrcreplay.human.model import LEG_POINTS
from hrcreplay.kernels import njit
from hrcreplay.records import FLOOR_Z_M, POINTS, Bools

#: Change of a leg bone's length beyond which the point at its far end is not on the limb, as a share.
_BROKEN = 0.3
#: Age at which a frame has weight 1/e in the share of the frames with evidence [s], and the share that is too much.
_MEMORY_S, _MOST = 2.0, 0.5
#: Two cameras show a point in one place up to the first distance, and in two places beyond the second one; between them
#: is no evidence. The first is what ``logs.camera_checks`` allows for 95 % of a limb's points [m].
_TOGETHER_M, _APART_M = 0.15, 0.30
#: Longest time between the captures of two frames that are compared; a hand at 2 m/s moves by less than ``_APART_M``
#: in it [ns].
_SAME_TIME_NS = 100_000_000
#: Depth below the floor of a point that cannot be there; poses of cameras are wrong by some centimetres [m].
_BELOW_M = 0.10
#: Number of observations after which the length of a leg's bone is known.
_BONES_KNOWN = 20


@njit(cache=True, inner=True)
def judge(filter_: Filter, c: int, now: int, whole: Bools, rules: Rules) -> None:
    """Updates the evidence by a camera's new frame, and which of its points are believed.

    Args:
        filter_: Contains the frame; ``wrong``, ``judged_ns`` and ``disbelieved`` of the camera are changed.
        c: Index of the camera.
        now: The tick [ns].
        whole: (20,) False for points at the end of a bone unlike the person's.
        rules: Settings of the filter.
    """
    gate = filter_.gate
    shown = np.zeros(len(whole), np.bool_)
    for k in range(len(whole)):
        shown[k] = shows(filter_, c, k, rules)
    against = shown & ~whole
    for side in range(2):
        for bone in range(2):
            if is_broken(filter_, c, side, bone):
                against[LEG_POINTS[2 * bone + 2 + side :: 2]] = True
    for k in range(len(whole)):
        if not shown[k]:
            continue
        with_it, elsewhere = _votes(filter_, c, k, rules)
        impossible = against[k] or gate.points[c, k, 2] < FLOOR_Z_M - _BELOW_M
        against[k] = elsewhere > with_it or (with_it == 1 and impossible)
    against &= shown
    if 2 * against.sum() > shown.sum():
        against[:] = False
    kept = np.exp(-min(now - gate.judged_ns[c], rules.memory_ns) * 1e-9 / _MEMORY_S)
    gate.judged_ns[c] = now
    for k in range(len(whole)):
        gate.disbelieved[c, k] = False
        if shown[k]:
            gate.wrong[c, k] = kept * gate.wrong[c, k] + (1.0 - kept) * against[k]
            gate.disbelieved[c, k] = gate.wrong[c, k] > _MOST and _shown_by_another(filter_, c, k, now, rules)


@njit(cache=True, inner=True)
def is_broken(filter_: Filter, c: int, side: int, bone: int) -> bool:
    """Returns True if a camera shows a bone of a leg in a length unlike those before, once they are known.

    Args:
        filter_: Contains the frame, and the mean lengths.
        c: Index of the camera.
        side: 0: right, 1: left.
        bone: 0: thigh, 1: shank.
    """
    upper, lower = LEG_POINTS[2 * bone + side], LEG_POINTS[2 * bone + 2 + side]
    length = distance(filter_.gate.points[c, upper], filter_.gate.points[c, lower])
    seen, mean = filter_.model.leg_bones_seen[c, 2 * bone + side], filter_.model.leg_bones[c, 2 * bone + side]
    return bool(seen >= _BONES_KNOWN and abs(length - mean) > _BROKEN * mean)


@njit(cache=True, inner=True)
def _votes(filter_: Filter, c: int, k: int, rules: Rules) -> tuple[int, int]:
    """Returns how many cameras show a point where camera c does, itself included, and how many agree elsewhere.

    Args:
        filter_: Contains the frames.
        c: Index of the camera.
        k: Index of the point.
        rules: Settings of the filter.
    """
    gate = filter_.gate
    with_it, elsewhere = 1, 0
    for a in range(len(gate.uses)):
        if a == c or not _comparable(filter_, a, c, k, rules):
            continue
        apart = distance(gate.points[a, k], gate.points[c, k])
        if apart <= _TOGETHER_M:
            with_it += 1
        if apart > _APART_M:
            agree = 1
            for b in range(len(gate.uses)):
                if b not in (a, c) and _comparable(filter_, b, c, k, rules):
                    agree += int(distance(gate.points[a, k], gate.points[b, k]) <= _TOGETHER_M)
            elsewhere = max(elsewhere, agree)
    return with_it, elsewhere


@njit(cache=True, inner=True)
def _comparable(filter_: Filter, a: int, c: int, k: int, rules: Rules) -> bool:
    """Returns True if the stored frame of camera a shows a point, at about the time of that of camera c.

    Args:
        filter_: Contains the frames.
        a: Index of the one camera.
        c: Index of the other.
        k: Index of the point.
        rules: Settings of the filter.
    """
    gate = filter_.gate
    together = abs(gate.capture_ns[a] - gate.capture_ns[c]) <= _SAME_TIME_NS
    return gate.uses[a] >= 0 and together and shows(filter_, a, k, rules)


@njit(cache=True, inner=True)
def _shown_by_another(filter_: Filter, c: int, k: int, now: int, rules: Rules) -> bool:
    """Returns True if a camera whose view of a point is believed shows it.

    Args:
        filter_: Contains the frames.
        c: Index of the camera that does not count.
        k: Index of the point.
        now: The tick [ns].
        rules: Settings of the filter.
    """
    gate = filter_.gate
    for a in range(len(gate.uses)):
        fresh = gate.uses[a] >= 0 and now - gate.capture_ns[a] <= SHOWN_NS
        if a != c and fresh and gate.wrong[a, k] <= _MOST and shows(filter_, a, k, rules):
            return True
    return False


def disbelieved(counts: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """Returns each camera with points that were not believed, and in how many frames each of them.

    Args:
        counts: Counts of ``fuse``.
    """
    found: dict[str, dict[str, int]] = {}
    for point in POINTS:
        stem = f"disbelieved_{point}_"
        for name in sorted(counts):
            if name.startswith(stem) and counts[name]:
                found.setdefault(name.removeprefix(stem), {})[point] = counts[name]
    return found
