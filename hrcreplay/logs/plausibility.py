"""Checks the bodies of a log for plausibility: size, bones, left and right, uprightness, limbs never seen.

Unusual values give a note. Bodies that are certainly not a person (a wrong unit) are rejected, with a remedy. All
checks use medians, so that occasional errors of a tracker have no effect.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from statistics import median

import numpy as np

from hrcreplay.records import POINTS, Bools, Floats

#: Range of the stature of people, from a toddler to the tallest [m].
PERSON_M = (0.5, 2.3)
#: Half of the minimum and twice the maximum: outside this range a tracker's error cannot be the cause.
_CERTAIN = 2.0
#: Length of a bone as a share of the stature (Winter, Biomechanics; the trunk as in trackers, pelvis to neck).
_SHARES = {
    ("pelvis", "neck"): 0.288,
    **{(f"shoulder_{s}", f"elbow_{s}"): 0.186 for s in "lr"},
    **{(f"elbow_{s}", f"wrist_{s}"): 0.146 for s in "lr"},
    **{(f"hip_{s}", f"knee_{s}"): 0.245 for s in "lr"},
    **{(f"knee_{s}", f"ankle_{s}"): 0.246 for s in "lr"},
}
_FROM, _TO = (np.array([POINTS.index(bone[end]) for bone in _SHARES]) for end in (0, 1))
_SHARE = np.array(list(_SHARES.values()))
#: Statures of adults: 5th percentile of women and 95th of men, aged 19 to 65, in the US [m] (City University of Hong
#: Kong, Online Anthropometry, 2.1 Stature: http://personal.cityu.edu.hk/meachan/online%20anthropometry/Chapter2/Ch2-1.htm)
ADULT_M = (1.52, 1.87)
#: Tolerance of bones: those of recorded people, as seen by trackers, deviate from the shares by up to a fifth.
_BONE_MARGIN = 0.25
#: Trackers based on OpenNI use the middle of the hand as the wrist: half of Winter's share of a hand.
_HALF_HAND = 0.054
#: Maximum ratio of left and right of one person; on recordings up to a sixth more than 1.
_UNEQUAL = 1.25
_BONE_NAMES = {
    "pelvis": "trunk (pelvis to neck)",
    "shoulder": "upper arm",
    "elbow": "forearm",
    "hip": "thigh",
    "knee": "shank",
}
#: Factor of a body's size for a wrong unit -> name of the unit that was read as metres.
_UNITS = {1000.0: "millimetres", 100.0: "centimetres", 1.0 / 0.3048: "feet", 1.0 / 0.0254: "inches"}
#: Points that determine the limbs of the model; without them the volume of a limb contains all postures within its
#: joint limits.
_PLACED_BY = {
    "HD": ("head",),
    "THX": ("pelvis", "shoulder_l", "shoulder_r"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "wrist_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "wrist_l"),
}
_FEW = 10  # with fewer rows, nothing is rejected
_BATCH = 256
_MIRRORED = 0.3  # minimum volume spanned by three unit vectors, as feet point outwards and shoulders turn
_BENT_M = 0.05  # minimum distance of a knee from the line between hip and ankle that shows the forward direction
_OFTEN = 0.1  # share of the frames; a tracker sometimes exchanges left and right
_PELVIS_M = (0.0, 1.6)  # height above the floor: sitting on it, standing on a step
_UPRIGHT = np.cos(np.radians(60.0))


class BodyShape:
    """Size, bones and sides of the bodies of one camera, from the points before cleaning."""

    def __init__(self) -> None:
        self._waiting: list[Floats] = []
        self._statures: list[Floats] = []
        self._bones: list[Floats] = []
        self._sides: dict[str, list[Floats]] = {cue: [] for cue in _AHEAD}
        self._twists: list[Floats] = []

    def add(self, points: Floats, confidence: Floats) -> None:
        """Adds a body (20, 3) in the camera's frame, nominally in metres; points of confidence 0 are not seen."""
        self._waiting.append(np.where((confidence > 0)[:, None], points, np.nan))
        if len(self._waiting) >= _BATCH:
            self._flush()

    def _flush(self) -> None:
        if self._waiting:
            points = np.array(self._waiting)
            self._waiting = []
            there = np.isfinite(points).all(axis=2) & (np.abs(points).max(axis=2) > 0.0)
            points = np.where(there[..., None] & (np.abs(points) < 1e12), points, np.nan)  # so that squares are finite
            self._statures.append(statures(points))
            self._bones.append(_heights(points))
            for cue, sides in self._sides.items():
                sides.append(handedness(points, cue))
            self._twists.append(twist(points))

    @property
    def ratio(self) -> float:
        """Ratio of the body's statures by two bones, from medians; 1 if few were seen."""
        self._flush()
        return _ratio(np.concatenate(self._bones)) if self._bones else 1.0

    @property
    def stature_m(self) -> float:
        """Median of the stature from the bones; NaN if no bone was seen."""
        self._flush()
        return _median(self._statures)

    @property
    def certain(self) -> bool:
        """Returns True if enough rows show bones for a rejection."""
        self._flush()
        return sum(int(np.isfinite(part).sum()) for part in self._statures) >= _FEW

    @property
    def bones_m(self) -> dict[tuple[str, str], float]:
        """Median length of every bone of _SHARES [m]; NaN if seen in too few frames."""
        self._flush()
        heights = np.concatenate(self._bones) if self._bones else np.empty((0, len(_SHARES)))
        columns = [column[np.isfinite(column)] for column in heights.T]
        return {
            bone: share * float(np.median(column)) if len(column) >= _FEW else float("nan")
            for (bone, share), column in zip(_SHARES.items(), columns, strict=True)
        }

    @property
    def side_cue(self) -> str | None:
        """Cue for left and right: the most reliable of _AHEAD that was seen; None if none was."""
        self._flush()
        return next((cue for cue, parts in self._sides.items() if len(_finite(parts)) >= _FEW), None)

    def remarks(self, camera: str) -> Iterator[str]:
        """Returns notes on bones that no adult has, and on left and right."""
        if PERSON_M[0] <= self.stature_m <= PERSON_M[1]:  # in another unit every bone is wrong; reported separately
            yield from bone_remarks(camera, self.bones_m)
        if self.side_cue is not None:
            yield from mirror_remarks(camera, _finite(self._sides[self.side_cue]), self.side_cue)
        twists = _finite(self._twists)
        if len(twists) >= _FEW and np.median(twists) < 0.0:
            yield (
                f"camera {camera}: the shoulders' left is the hips' right (median); would be right: left is the "
                "person's own left at arms and legs"
            )


def _finite(parts: list[Floats]) -> Floats:
    return np.concatenate([part[np.isfinite(part)] for part in parts]) if parts else np.empty(0)


def _median(parts: list[Floats]) -> float:
    known = _finite(parts)
    return float(np.median(known)) if len(known) else float("nan")


def statures(points: Floats) -> Floats:
    """(n,) statures of bodies (n, 20, 3) from the median over their bones [m]; NaN if none is seen."""
    by_bone = _heights(points)
    found = np.full(len(points), np.nan)
    some = np.isfinite(by_bone).any(axis=1)
    found[some] = np.nanmedian(by_bone[some], axis=1)
    return found


#: Maximum ratio of a person's statures by two bones; trackers' bodies reach 1.6.
PROPORTION = 2.5
_FEW_BONES = 4


def bone_ratio(points: Floats) -> float:
    """Ratio of the statures of bodies (n, 20, 3) by two bones, from medians; 1 if few are seen."""
    return _ratio(_heights(points))


def _heights(points: Floats) -> Floats:
    """(n, bones) statures of bodies by each bone; NaN if it is not seen."""
    lengths = np.linalg.norm(points[:, _TO] - points[:, _FROM], axis=2)
    return np.asarray(np.where(lengths > 0.0, lengths, np.nan) / _SHARE)


def _ratio(heights: Floats) -> float:
    medians = [np.median(seen) for bone in heights.T if len(seen := bone[np.isfinite(bone)])]
    return float(max(medians) / min(medians)) if len(medians) >= _FEW_BONES else 1.0


def looks_like_person(points: Floats) -> bool:
    """Returns True if bodies (n, 20, 3), in any unit, have the proportions of a person."""
    return bone_ratio(points) <= PROPORTION


def _at(points: Floats, name: str) -> Floats:
    return points[:, POINTS.index(name)]


def _feet(points: Floats) -> Floats:
    """(n, 3) vectors from the ankles to the feet, sum of both sides [m]."""
    left, right = (_at(points, f"foot_{s}") - _at(points, f"ankle_{s}") for s in "lr")
    return left + right


def _knees(points: Floats) -> Floats:
    """(n, 3) vectors from the line between hip and ankle to the knee, sum of both sides [m]; NaN for a straight leg."""
    total = np.zeros((len(points), 3))
    for s in "lr":
        hip, knee, ankle = (_at(points, f"{name}_{s}") for name in ("hip", "knee", "ankle"))
        along = _unit(ankle - hip)
        off = knee - hip - np.einsum("ni,ni->n", knee - hip, along)[:, None] * along
        total += np.where(np.linalg.norm(off, axis=1, keepdims=True) > _BENT_M, off, np.nan)
    return total


#: Cues for a body's front, the most reliable first: name -> (n, 3) forward direction. Elbows are not used: in two of
#: ten recordings they bend backwards most of the time, from the rotation of the upper arm.
_AHEAD: dict[str, Callable[[Floats], Floats]] = {
    "feet point": _feet,
    "knees bend": _knees,
}


def handedness(points: Floats, cue: str = "feet point") -> Floats:
    """(n,) volume spanned by the unit vectors forward, left and up: negative in a mirror image.

    Args:
        points: (n, 20, 3) in any right-handed frame [m].
        cue: Cue for the forward direction: feet or knees.
    """
    up = _unit(_at(points, "neck") - _at(points, "pelvis"))
    left = _unit(_at(points, "shoulder_l") - _at(points, "shoulder_r"))
    return np.asarray(np.einsum("ni,ni->n", np.cross(_unit(_AHEAD[cue](points)), left), up))


def twist(points: Floats) -> Floats:
    """(n,) cosine between left of the shoulders and left of the hips: negative if one of the two is exchanged."""
    shoulders, hips = (_unit(_at(points, f"{name}_l") - _at(points, f"{name}_r")) for name in ("shoulder", "hip"))
    return np.asarray(np.einsum("ni,ni->n", shoulders, hips))


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0.0, length, np.nan))


def size_remark(camera: str, stature_m: float, mend: str) -> str | None:
    """Returns a note on a body's size; None for a plausible one. ``mend``: place of the unit's setting."""
    if np.isnan(stature_m) or PERSON_M[0] <= stature_m <= PERSON_M[1]:
        return None
    text = f"camera {camera}: by its bones the body is {stature_m:.3g} m tall"
    text += f"; a person is {PERSON_M[0]:g} to {PERSON_M[1]:g} m"
    for factor, unit in _UNITS.items():
        if 1.0 <= stature_m / factor <= 2.1:
            return f"{text}: {unit} were taken for metres; {mend}"
    if 1.0 <= stature_m * 1000.0 <= 2.1:
        return f"{text}: metres were taken for millimetres; {mend}"
    return f"{text}; are its points in metres? {mend}"


def proportion_remark(camera: str, ratio: float) -> str | None:
    """Returns a note on bones that do not belong to one person; None for plausible ones."""
    if ratio <= PROPORTION:
        return None
    return (
        f"camera {camera}: the body is {ratio:.1f} times as tall by one bone as by another, where {PROPORTION:g} is "
        "the most that trackers give; are the names or the indices of its joints right, and all joints of one person?"
    )


def impossible_size(stature_m: float) -> bool:
    """Returns True if no person can have that size."""
    return stature_m > _CERTAIN * PERSON_M[1] or stature_m < PERSON_M[0] / _CERTAIN


def mirror_remarks(camera: str, sides: Floats, cue: str) -> Iterator[str]:
    """Returns a note on a camera that sees mirror images, always or often.

    Args:
        camera: Name of the camera.
        sides: (n,) ``handedness`` of its frames.
        cue: Cue for the forward direction.
    """
    often = float((sides < -_MIRRORED).mean())
    always = np.median(sides) < -_MIRRORED
    if always or often > _OFTEN:
        share = "" if always else f" in {100 * often:.0f} % of the frames"
        yield (
            f"camera {camera}: left and right of the body are exchanged as its {cue}{share} (names exchanged, one axis "
            "mirrored, or left-handed coordinates); would be right: x, y, z right-handed, left is the person's own left"
        )


def bone_range_m(bone: tuple[str, str]) -> tuple[float, float]:
    """Returns the range of an adult's bone as seen by trackers: its share of ADULT_M, and a margin [m]."""
    share = _SHARES[bone]
    longest = share + _HALF_HAND if bone[0].startswith("elbow") else share
    return share * ADULT_M[0] * (1.0 - _BONE_MARGIN), longest * ADULT_M[1] * (1.0 + _BONE_MARGIN)


def bone_remarks(camera: str, bones_m: Mapping[tuple[str, str], float]) -> Iterator[str]:
    """Returns a note on bones outside an adult's range, and one on those that differ between left and right."""
    odd = {
        bone: f"{_bone_name(bone)} {length_m:.2f} m (an adult's: {low_m:.2f} to {high_m:.2f})"
        for bone, length_m in bones_m.items()
        for low_m, high_m in [bone_range_m(bone)]
        if length_m < low_m or length_m > high_m
    }
    if odd:
        yield (
            f"camera {camera}: {', '.join(odd.values())} (medians); would be right: points that are the person's "
            "joints, in metres, of an adult"
        )
    unequal = []
    for (start, end), left_m in bones_m.items():
        other = (start.replace("_l", "_r"), end.replace("_l", "_r"))
        right_m = bones_m[other]
        told = (start, end) in odd or other in odd
        if start.endswith("_l") and not told and max(left_m, right_m) > _UNEQUAL * min(left_m, right_m):
            unequal.append(f"{_BONE_NAMES[start[:-2]]} {left_m:.2f} m left, {right_m:.2f} m right")
    if unequal:
        yield (
            f"camera {camera}: {', '.join(unequal)} (medians); would be right: equal within "
            f"{100 * (_UNEQUAL - 1):.0f} %"
        )


def _bone_name(bone: tuple[str, str]) -> str:
    name, _, side = bone[0].partition("_")
    return {"l": "left ", "r": "right "}.get(side, "") + _BONE_NAMES[name]


def unmeasured_limbs(seen: Mapping[str, Bools]) -> Iterator[str]:
    """Returns notes on limbs that no camera ever measured, from the points (20,) that each camera ever provided."""
    ever = np.logical_or.reduce([np.zeros(len(POINTS), dtype=np.bool_), *seen.values()])
    if not ever.any():
        return
    for limb, needed in _PLACED_BY.items():
        lacking = [name for name in needed if not ever[POINTS.index(name)]]
        if lacking:
            yield (
                f"limb {limb} was never measured: no camera gave {' or '.join(lacking)}; its volume contains all "
                "postures within the joint limits"
            )


_JUMP_M = 0.3  # m, minimum jump within _SOON_NS; faster than any person
_SOON_NS = 80_000_000
_BACK = 1.0 / 3.0  # maximum distance from the earlier position, as a share of the jump
_ALTERNATING = 0.1  # share of the rows


class Alternation:
    """Detects rows of a body that alternate between two places, as for two cameras under one name."""

    def __init__(self) -> None:
        self._before: dict[tuple[str, int], tuple[tuple[int, Floats], ...]] = {}  # a body's last two rows
        self._rows: Counter[str] = Counter()
        self._returns: Counter[str] = Counter()
        self._jumps_m: dict[str, list[float]] = defaultdict(list)

    def add(self, camera: str, body: int, t_ns: int, points_m: Floats) -> None:
        """Adds a row.

        Args:
            camera: Camera of the row.
            body: The body's number.
            t_ns: Arrival of the row [ns].
            points_m: (20, 3) in the camera's frame [m].
        """
        self._rows[camera] += 1
        before = self._before.get((camera, body), ())
        self._before[(camera, body)] = (*before[-1:], (t_ns, points_m))
        if len(before) < 2 or t_ns - before[0][0] > 2 * _SOON_NS:
            return
        jump_m = _apart(points_m, before[1][1])
        if not jump_m > _JUMP_M or not _apart(points_m, before[0][1]) < _BACK * jump_m:
            return
        others = [row for (of, other), rows in self._before.items() if of == camera and other != body for row in rows]
        if any(t_ns - at_ns < _SOON_NS and _apart(points_m, at) < _BACK * jump_m for at_ns, at in others):
            return  # two people with numbers exchanged by the tracker
        self._returns[camera] += 1
        self._jumps_m[camera].append(jump_m)

    def remarks(self) -> Iterator[str]:
        """Returns a sentence for each camera with alternating bodies."""
        for camera, count in self._returns.items():
            if count >= _FEW and count > _ALTERNATING * self._rows[camera]:
                jump_m = float(np.median(self._jumps_m[camera]))
                yield (
                    f"camera {camera}: a body is in two places by turns, {jump_m:.2f} m apart ({count} times there and "
                    "back): two cameras under one name; would be right: another frame or topic for each"
                )


def _apart(points_m: Floats, others_m: Floats) -> float:
    """Returns the median distance of the points that both bodies have; NaN if there are none [m]."""
    away = np.linalg.norm(points_m - others_m, axis=1)
    known = away[np.isfinite(away)].tolist()
    return median(known) if known else float("nan")  # of few numbers; numpy's takes ten times as long


class BodyPosture:
    """Uprightness and height above the floor of the bodies of one camera."""

    def __init__(self) -> None:
        self._upright: list[Floats] = []
        self._pelvis: list[Floats] = []

    def add(self, points: Floats) -> None:
        """Adds bodies (n, 20, 3) in the world [m]."""
        pelvis, neck, head, right, left = (
            points[:, POINTS.index(name)] for name in ("pelvis", "neck", "head", "shoulder_r", "shoulder_l")
        )
        top = np.where(np.isfinite(neck), neck, np.where(np.isfinite(head), head, 0.5 * (right + left)))
        self._upright.append(_unit(top - pelvis)[:, 2].copy())  # copies: a view would keep all points of the log
        self._pelvis.append(pelvis[:, 2].copy())

    def remark(self, camera: str) -> str | None:
        """Returns a note on a body that is not upright on the floor; None for a plausible one."""
        up, height_m = _median(self._upright), _median(self._pelvis)
        mend = "would be right: T_world_camera with z up and the floor at z = 0; find it with hrcreplay calibrate"
        if up < -_UPRIGHT:
            return f"camera {camera}: the person stands upside down, head below the pelvis (median); {mend}"
        if up < _UPRIGHT:
            degrees = np.degrees(np.arccos(up))
            return f"camera {camera}: the person's trunk is {degrees:.0f} degrees from upright (median); {mend}"
        if height_m < _PELVIS_M[0] or height_m > _PELVIS_M[1]:
            return f"camera {camera}: the person's pelvis is {height_m:.2f} m above the floor (median); {mend}"
        return None
