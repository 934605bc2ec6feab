"""Checks of the person in the world, camera by camera and pair by pair: floor, height, disagreement of two cameras.

``info``, ``calibrate`` and a run use the same figures; each figure out of its bounds gives one line.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hrcreplay.logs.plausibility import BodyPosture
from hrcreplay.records import BODY, MIRROR, POINTS, Bools, Floats, Ints, SkeletonTrack, find_neighbours

#: The end points of a limb: each point belongs to one limb, so each is compared once.
LIMB_POINTS = {
    "HD": ("head",),
    "THX": ("pelvis", "chest", "neck", "shoulder_l", "shoulder_r"),
    **{f"U{s}A": (f"elbow_{s.lower()}",) for s in "RL"},
    **{f"L{s}A": (f"wrist_{s.lower()}", f"hand_{s.lower()}") for s in "RL"},
    "LEGS": tuple(f"{joint}_{s}" for s in "lr" for joint in ("hip", "knee", "ankle", "foot")),
}
#: Names of BODY for readers.
LIMB_NAMES = {
    "HD": "head",
    "THX": "trunk",
    "URA": "right upper arm",
    "LRA": "right lower arm",
    "ULA": "left upper arm",
    "LLA": "left lower arm",
    "LEGS": "legs",
}
#: Maximum difference between two cameras, 95th percentile; a larger one is reported [m].
APART_M = 0.15
#: Maximum distance of feet from the floor; a larger one is reported. Trackers have errors of 2 cm (median) on
#: recordings [m].
FLOOR_M = 0.05
#: Height of a foot point above the floor: Winter's foot with a shoe sole [m].
SOLE_M = 0.03
#: Height of an ankle above the floor, by Winter's share, with a sole [m].
_ANKLE_M = 0.08
#: The same by trackers: up to 18 cm by Azure Kinects [m].
_ANKLE_SEEN_M, _ANKLE_ERROR_M = 0.13, 0.10
#: Maximum difference between the head's height and the sum of the bones; up to 7 cm on recordings [m].
_HEIGHT_M = 0.15
#: Feet of at most this confidence are guesses of the tracker and are not used for floor and height.
SURE = 0.5
_MIRRORED = 0.2  # share of the frames; a tracker sometimes exchanges left and right
_FEW = 10  # fewer frames are not judged
_FEW_PAIRS = 100  # minimum number of points for a 95th percentile, with at least five beyond it
_GAP_NS = 100_000_000  # no interpolation across longer gaps
_SCALE_M = 0.05  # m, usual difference of two cameras at one point
_UPRIGHT = 0.95  # ratio of the straight distance from neck to ankles to that along the bones
_WAIT_NS = 60 * 10**9  # maximum delay of frames that arrive out of order of capture


@dataclass(frozen=True)
class LimbAgreement:
    """Distance between two cameras' views of a limb at the same instant."""

    a: str
    b: str
    limb: str
    median_m: float
    p95_m: float
    pairs: int  #: number of pairs of points
    mirrored: float  #: share of all frames of the two in which they disagree on left and right of the body


@dataclass(frozen=True)
class BodyInWorld:
    """Height of a camera's person above the floor z = 0; NaN if not seen."""

    camera: str
    frames: int
    floor_m: float  #: the lowest foot above the floor, median [m]
    floor_p95_m: float  #: its distance from the floor, 95th percentile [m]
    by_ankles: bool  #: True: no foot was ever seen, and the ankles are used
    head_m: float  #: height of the head above the floor while standing upright, median [m]
    bones_m: float  #: sum of the bones from floor to head, in the same frames, median [m]


def interpolate(track: SkeletonTrack, t_ns: Ints) -> Floats:
    """Interpolates (n, 20, 3) points of a track linearly; NaN across gaps and if a neighbour is missing."""
    if not len(track):
        return np.full((len(t_ns), len(POINTS), 3), np.nan)
    before, after, share, known = find_neighbours(track.t_ns, t_ns, _GAP_NS * 1e-9)
    share = share[:, None, None]
    points = (1 - share) * track.points_m[before] + share * track.points_m[after]
    seen = (track.confidence[before] > 0) & (track.confidence[after] > 0) & known[:, None]
    return np.where(seen[..., None], points, np.nan)


def find_mirrored(points_a: Floats, points_b: Floats, weight: Floats, scale_m: float) -> Bools:
    """(n,) True for frames that agree far better with left and right of b exchanged.

    Args:
        points_a: (n, 20, 3) [m].
        points_b: (n, 20, 3) in the same frame, at the same instants [m].
        weight: (n, 20), 0 for a missing point.
        scale_m: Usual difference of a point [m].
    """

    def cost(other: Floats, w: Floats) -> Floats:
        squares = np.sum((points_a - other) ** 2, axis=2) / scale_m**2
        squares = np.where(w > 0, squares, 0.0)
        return np.asarray((w * np.log1p(squares)).sum(axis=1) / np.maximum(w.sum(axis=1), 1e-12))

    mirror = list(MIRROR)
    direct, exchanged = cost(points_b, weight), cost(points_b[:, mirror], weight * weight[:, mirror])
    return np.asarray(exchanged < 0.5 * direct)


@dataclass
class _CameraPair:
    """Views of two cameras at the same instants so far."""

    apart_m: list[NDArray[np.float32]] = field(default_factory=list)  #: (n, 20), NaN for a point that one of them lacks
    mirrored: list[Bools] = field(default_factory=list)

    def add(self, a: SkeletonTrack, b: SkeletonTrack) -> None:
        there = interpolate(b, a.t_ns)
        apart_m = np.linalg.norm(np.where((a.confidence > 0)[..., None], a.points_m, np.nan) - there, axis=2)
        seen = np.isfinite(apart_m)
        both = seen.any(axis=1)
        self.apart_m.append(apart_m[both].astype(np.float32))
        self.mirrored.append(find_mirrored(a.points_m, there, seen.astype(np.float64), _SCALE_M)[both])

    def agreements(self, a: str, b: str) -> Iterator[LimbAgreement]:
        apart_m, mirrored = np.concatenate(self.apart_m), np.concatenate(self.mirrored)
        for limb in BODY:
            found = apart_m[:, [POINTS.index(name) for name in LIMB_POINTS[limb]]]
            found = found[np.isfinite(found)]
            if len(found):
                median_m, p95_m = np.percentile(found.astype(np.float64), [50, 95]).tolist()
                yield LimbAgreement(a, b, limb, median_m, p95_m, len(found), float(mirrored.mean()))


class _BodyHeights:
    """Heights of one camera's person so far."""

    def __init__(self) -> None:
        self.posture = BodyPosture()
        self._rows: list[Floats] = []  #: (n, 4): lowest foot, lowest ankle, head, sum of the bones [m]

    def add(self, points_m: Floats, confidence: Floats) -> None:
        """Adds the person (n, 20, 3) in the world [m], and the confidences of the points (n, 20)."""
        self.posture.add(np.where((confidence > 0)[..., None], points_m, np.nan))
        points_m = np.where((confidence > SURE)[..., None], points_m, np.nan)
        foot, ankle = (np.fmin(*(_at(points_m, f"{name}_{s}")[:, 2] for s in "lr")) for name in ("foot", "ankle"))
        self._rows.append(np.column_stack([foot, ankle, *_standing_heights(points_m)]))

    def figures(self, camera: str) -> BodyInWorld:
        rows = np.concatenate(self._rows) if self._rows else np.empty((0, 4))
        foot, ankle, head, bones = (column[np.isfinite(column)] for column in rows.T)
        by_ankles = len(foot) < _FEW <= len(ankle)
        above = ankle - _ANKLE_SEEN_M if by_ankles else foot - SOLE_M
        return BodyInWorld(
            camera=camera,
            frames=len(rows),
            floor_m=_percentile(above, 50),
            floor_p95_m=_percentile(np.abs(above), 95),
            by_ankles=by_ankles,
            head_m=_percentile(head, 50),
            bones_m=_percentile(bones, 50),
        )


class CameraChecks:
    """Collects the person of every camera in the world, frame by frame; a whole log needs little memory."""

    def __init__(self, cameras: Sequence[str]) -> None:
        self._cameras = tuple(cameras)
        self._bodies = [_BodyHeights() for _ in cameras]
        self._pairs = {pair: _CameraPair() for pair in combinations(range(len(cameras)), 2)}
        self._waiting: list[list[SkeletonTrack]] = [[] for _ in cameras]
        self._newest_ns = self._compared_ns = np.iinfo(np.int64).min

    def add(self, camera: Ints, track: SkeletonTrack) -> None:
        """Adds frames of any cameras.

        Args:
            camera: (n,) index of each frame's camera.
            track: Track of the person, in the world, on one clock; ``t_ns`` in any order within a minute.
        """
        for c, body in enumerate(self._bodies):
            mine = camera == c
            body.add(track.points_m[mine], track.confidence[mine])
            self._waiting[c].append(track.rows(mine))
        if len(track):
            self._newest_ns = max(self._newest_ns, int(track.t_ns.max()))
            first_ns = min(int(part.t_ns.min()) for parts in self._waiting for part in parts if len(part))
            if self._newest_ns - first_ns > 3 * _WAIT_NS:
                self._compare(self._newest_ns - _WAIT_NS)

    def _compare(self, until_ns: int) -> None:
        """Compares the frames before an instant that were not compared yet; keeps those that may still be needed."""
        tracks = [_in_order(parts) for parts in self._waiting]
        for (i, j), pair in self._pairs.items():
            due = (tracks[i].t_ns >= self._compared_ns) & (tracks[i].t_ns < until_ns)
            pair.add(tracks[i].rows(due), tracks[j])
        self._waiting = [[track.rows(track.t_ns >= until_ns - _GAP_NS)] for track in tracks]
        self._compared_ns = until_ns

    def figures(self) -> tuple[tuple[BodyInWorld, ...], tuple[LimbAgreement, ...]]:
        """Returns the figures of every camera's person, and of every pair of cameras limb by limb; call it last."""
        if self._newest_ns >= self._compared_ns and any(len(part) for parts in self._waiting for part in parts):
            self._compare(self._newest_ns + 1)
        bodies = (body.figures(name) for name, body in zip(self._cameras, self._bodies, strict=True))
        pairs = [
            agreement
            for (i, j), pair in self._pairs.items()
            if pair.apart_m
            for agreement in pair.agreements(self._cameras[i], self._cameras[j])
        ]
        return tuple(bodies), tuple(pairs)

    def remarks(self) -> Iterator[str]:
        """Returns one line for each implausible camera, and for each pair that disagrees."""
        bodies, agreements = self.figures()
        for body, seen in zip(bodies, self._bodies, strict=True):
            posture = seen.posture.remark(body.camera)
            yield from [posture] if posture is not None else height_remarks(body)
        yield from pair_remarks(agreements)


def height_remarks(body: BodyInWorld) -> Iterator[str]:
    """Returns remarks on a wrong floor under a camera's person, or a wrong height of the head."""
    found, bound_m = ("ankle", _ANKLE_ERROR_M) if body.by_ankles else ("foot", FLOOR_M)
    if abs(body.floor_m) > bound_m:
        side = "above" if body.floor_m > 0 else "below"
        yield (
            f"camera {body.camera}: the person's lowest {found} is {100 * abs(body.floor_m):.0f} cm {side} where it "
            f"stands on a floor at z = 0 (median); would be right: at most {100 * bound_m:.0f} cm, by the pose of the "
            "camera or the floor of the cell; find both with hrcreplay calibrate"
        )
    if abs(body.head_m - body.bones_m) > _HEIGHT_M:
        yield (
            f"camera {body.camera}: standing upright the person's head is {body.head_m:.2f} m above the floor, where "
            f"the bones from floor to head add up to {body.bones_m:.2f} m (medians); would be right: within "
            f"{_HEIGHT_M:g} m; look at the bones, and at the pose of the camera"
        )


def pair_remarks(agreements: Sequence[LimbAgreement]) -> Iterator[str]:
    """Reports limbs that two cameras show too far apart, and pairs with exchanged left and right."""
    for a, b in dict.fromkeys((found.a, found.b) for found in agreements):
        limbs = [found for found in agreements if (found.a, found.b) == (a, b) and found.pairs >= _FEW]
        far = [f"{LIMB_NAMES[found.limb]} {found.p95_m:.2f} m" for found in limbs if _is_far(found)]
        if limbs and limbs[0].mirrored > _MIRRORED:
            yield (
                f"cameras {a} and {b}: one shows left and right of the body exchanged against the other in "
                f"{100 * limbs[0].mirrored:.0f} % of the frames; would be right: left is the person's own left in both"
            )
        if far:
            yield (
                f"cameras {a} and {b} show a limb apart at the same instant: {', '.join(far)} (95th percentile); would "
                f"be right: at most {APART_M:g} m; look at their poses, their clocks, and whether both see the person"
            )


def _is_far(found: LimbAgreement) -> bool:
    """Returns True if a limb is reported; with few points the median is used in place of the percentile."""
    return (found.p95_m if found.pairs >= _FEW_PAIRS else found.median_m) > APART_M


def agreement_lines(agreements: Sequence[LimbAgreement]) -> list[str]:
    """Returns every pair and limb as plain text, one line each."""
    return [
        f"{found.a} - {found.b}, {LIMB_NAMES[found.limb]}: apart by {1e3 * found.median_m:.0f} mm (median), "
        f"{1e3 * found.p95_m:.0f} mm (p95) at {found.pairs} points"
        for found in agreements
    ]


def body_line(body: BodyInWorld) -> str:
    """Returns the heights of a camera's person as plain text."""
    point = "ankle" if body.by_ankles else "foot"
    floor = (
        "no foot surely seen, so nothing is known of the floor"
        if np.isnan(body.floor_m)
        else f"lowest {point} {100 * body.floor_m:+.1f} cm from the floor (median), within "
        f"{100 * body.floor_p95_m:.1f} cm (p95)"
    )
    tall = (
        "never surely seen standing, so the height is not measured"
        if np.isnan(body.head_m)
        else f"standing, head {body.head_m:.2f} m above the floor, {body.bones_m:.2f} m by the sum of the bones"
    )
    return f"{body.camera}: {floor}; {tall}"


def _at(points_m: Floats, name: str) -> Floats:
    return points_m[:, POINTS.index(name)]


def _standing_heights(points_m: Floats) -> tuple[Floats, Floats]:
    """(n,) height of the head above z = 0, and sum of the bones from floor to head [m]; NaN unless upright."""
    head, neck, pelvis = (_at(points_m, name) for name in ("head", "neck", "pelvis"))
    neck = np.where(np.isfinite(neck), neck, 0.5 * (_at(points_m, "shoulder_l") + _at(points_m, "shoulder_r")))
    knee, ankle, foot = (
        0.5 * (_at(points_m, f"{name}_l") + _at(points_m, f"{name}_r")) for name in ("knee", "ankle", "foot")
    )
    trunk, thigh, shank = (np.linalg.norm(v, axis=1) for v in (neck - pelvis, pelvis - knee, knee - ankle))
    below = np.where(np.isfinite(foot[:, 2]), ankle[:, 2] - foot[:, 2] + SOLE_M, _ANKLE_M)
    straight = np.linalg.norm(neck - ankle, axis=1) > _UPRIGHT * (trunk + thigh + shank)
    bones_m = below + shank + thigh + trunk + np.linalg.norm(head - neck, axis=1)
    known = straight & np.isfinite(head[:, 2]) & np.isfinite(bones_m)
    return np.where(known, head[:, 2], np.nan), np.where(known, bones_m, np.nan)


def _percentile(values: Floats, share: float) -> float:
    """Returns a percentile; NaN for too few values."""
    return float(np.percentile(values, share)) if len(values) >= _FEW else float("nan")


def _in_order(parts: Sequence[SkeletonTrack]) -> SkeletonTrack:
    """Returns one track in order of capture, without repeated instants."""
    track = SkeletonTrack.join(parts)
    _, first = np.unique(track.t_ns, return_index=True)
    return track.rows(first.astype(np.int64))
