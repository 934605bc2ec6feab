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
from hrcreplay.human.fusion.kalman import SHOWN_NS, Gate, ModelResidual, Rules
from hrcreplay.human.model import LEG_POINTS
from hrcreplay.kernels import njit
from hrcreplay.records import FLOOR_Z_M, POINTS, Bools, Floats, Ints

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
def judge(gate: Gate, model: ModelResidual, c: int, now: int, whole: Bools, rules: Rules) -> None:
    """Updates the evidence by a camera's new frame, and which of its points are believed.

    Args:
        gate: Contains the frame; ``wrong``, ``judged_ns`` and ``disbelieved`` of the camera are changed.
        model: Contains the lengths of the legs' bones.
        c: Index of the camera.
        now: The tick [ns].
        whole: (20,) False for points at the end of a bone unlike the person's.
        rules: Settings of the filter.
    """
    shown = _find_shown(gate.points, gate.confidence, gate.uses, rules.confidence_min)
    at_once, believed = shown.copy(), shown & (gate.wrong <= _MOST)
    for a in range(len(shown)):
        at_once[a] &= abs(gate.capture_ns[a] - gate.capture_ns[c]) <= _SAME_TIME_NS
        believed[a] &= a != c and now - gate.capture_ns[a] <= SHOWN_NS
    against = ~whole
    for leg in range(4):
        if is_broken(gate.points[c], model.leg_bones[c], model.leg_bones_seen[c], leg):
            against[LEG_POINTS[leg + 2 :: 2]] = True
    for k in range(len(whole)):
        impossible = against[k] or gate.points[c, k, 2] < FLOOR_Z_M - _BELOW_M
        if impossible or len(shown) > 2:  # one other camera cannot outvote it
            with_it, elsewhere = _votes(gate.points, at_once, c, k)
            against[k] = elsewhere > with_it or (with_it == 1 and impossible)
    against &= shown[c]
    if 2 * against.sum() > shown[c].sum():
        against[:] = False
    kept = np.exp(-min(now - gate.judged_ns[c], rules.memory_ns) * 1e-9 / _MEMORY_S)
    gate.judged_ns[c] = now
    for k in range(len(whole)):
        if shown[c, k]:
            gate.wrong[c, k] = kept * gate.wrong[c, k] + (1.0 - kept) * against[k]
        gate.disbelieved[c, k] = shown[c, k] and gate.wrong[c, k] > _MOST and believed[:, k].any()


@njit(cache=True, inner=True)
def _find_shown(points: Floats, confidence: Floats, uses: Ints, least: float) -> Bools:
    """(c, 20) True for points that the stored frames of the cameras show with enough confidence.

    Args:
        points: (c, 20, 3) [m].
        confidence: (c, 20).
        uses: (c,) negative without a frame.
        least: Minimum confidence.
    """
    shown = np.zeros(confidence.shape, np.bool_)
    for a in range(len(shown)):
        for k in range(confidence.shape[1]):
            shown[a, k] = uses[a] >= 0 and confidence[a, k] >= least and np.isfinite(points[a, k, 0])
    return shown


@njit(cache=True, inner=True)
def is_broken(points: Floats, means: Floats, seen: Ints, bone: int) -> bool:
    """Returns True if a camera shows a bone of a leg in a length unlike those before, once they are known.

    Args:
        points: (20, 3) of its frame [m].
        means: (4,) mean lengths of the thighs, then shanks, right and left [m].
        seen: (4,) number of observations in these.
        bone: Index of the bone.
    """
    length = distance(points[LEG_POINTS[bone]], points[LEG_POINTS[bone + 2]])
    return bool(seen[bone] >= _BONES_KNOWN and abs(length - means[bone]) > _BROKEN * means[bone])


@njit(cache=True, inner=True)
def _votes(points: Floats, shown: Bools, c: int, k: int) -> tuple[int, int]:
    """Returns how many cameras show a point where camera c does, itself included, and how many agree elsewhere.

    Args:
        points: (c, 20, 3) of each camera [m].
        shown: (c, 20) True for those that are shown at about the time of camera c.
        c: Index of the camera.
        k: Index of the point.
    """
    with_it, elsewhere = 1, 0
    for a in range(len(points)):
        if a == c or not shown[a, k]:
            continue
        apart = distance(points[a, k], points[c, k])
        if apart <= _TOGETHER_M:
            with_it += 1
        if apart > _APART_M:
            agree = 1
            for b in range(len(points)):
                if b not in (a, c) and shown[b, k]:
                    agree += int(distance(points[a, k], points[b, k]) <= _TOGETHER_M)
            elsewhere = max(elsewhere, agree)
    return with_it, elsewhere


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
