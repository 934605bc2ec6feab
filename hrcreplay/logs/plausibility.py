"""Checks whether the bodies of a log can be a person: size, left and right, uprightness, limbs never measured.

What is unusual becomes a note. What is certainly no person (a wrong unit) is refused, with what would correct it. All
checks use medians, so that occasional errors of a tracker change nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from hrcreplay.records import POINTS, Bools, Floats

#: The stature of people from a toddler to the tallest [m].
PERSON_M = (0.5, 2.3)
#: Half of the least and twice the largest: no error of a tracker makes a person of that.
_CERTAIN = 2.0
#: Share of a stature that a bone is (Winter, Biomechanics; the trunk as trackers see it, pelvis to neck).
_SHARES = {
    ("pelvis", "neck"): 0.288,
    **{(f"shoulder_{s}", f"elbow_{s}"): 0.186 for s in "lr"},
    **{(f"elbow_{s}", f"wrist_{s}"): 0.146 for s in "lr"},
    **{(f"hip_{s}", f"knee_{s}"): 0.245 for s in "lr"},
    **{(f"knee_{s}", f"ankle_{s}"): 0.246 for s in "lr"},
}
_FROM, _TO = (np.array([POINTS.index(bone[end]) for bone in _SHARES]) for end in (0, 1))
_SHARE = np.array(list(_SHARES.values()))
#: What a body is wrong by where its unit is: factor on metres -> name of the unit that was taken for metres.
_UNITS = {1000.0: "millimetres", 100.0: "centimetres", 1.0 / 0.3048: "feet", 1.0 / 0.0254: "inches"}
#: Points that place the limbs of the model; the volume of a limb without them holds all that its joints allow.
_PLACED_BY = {
    "HD": ("head",),
    "THX": ("pelvis", "shoulder_l", "shoulder_r"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "wrist_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "wrist_l"),
}
_FEW = 10  # rows that say too little for a refusal
_BATCH = 256
_MIRRORED = 0.3  # of the volume that three unit vectors span: feet point out, shoulders turn
_PELVIS_M = (0.0, 1.6)  # above the floor: of who sits on it, of who stands on a step
_UPRIGHT = np.cos(np.radians(60.0))


class BodyShape:
    """Size and handedness of the bodies of one camera, from the points before cleaning."""

    def __init__(self) -> None:
        self._waiting: list[Floats] = []
        self._statures: list[Floats] = []
        self._sides: list[Floats] = []

    def add(self, points: Floats) -> None:
        """Takes a body (20, 3) in the camera's frame, in what was said to be metres."""
        self._waiting.append(points)
        if len(self._waiting) >= _BATCH:
            self._flush()

    def _flush(self) -> None:
        if self._waiting:
            points = np.array(self._waiting)
            self._waiting = []
            there = np.isfinite(points).all(axis=2) & (np.abs(points).max(axis=2) > 0.0)
            points = np.where(there[..., None] & (np.abs(points) < 1e12), points, np.nan)  # so that squares are numbers
            self._statures.append(statures(points))
            self._sides.append(handedness(points))

    @property
    def stature_m(self) -> float:
        """Median of the stature by the bones; NaN where no bone was seen."""
        self._flush()
        return _median(self._statures)

    @property
    def certain(self) -> bool:
        """Whether enough rows show bones for a refusal."""
        self._flush()
        return sum(int(np.isfinite(part).sum()) for part in self._statures) >= _FEW

    @property
    def side(self) -> float:
        """Median of ``handedness``: 1 a person, -1 a mirror image; NaN where no foot was seen."""
        self._flush()
        return _median(self._sides)


def _median(parts: list[Floats]) -> float:
    known = np.concatenate([part[np.isfinite(part)] for part in parts]) if parts else np.empty(0)
    return float(np.median(known)) if len(known) else float("nan")


def statures(points: Floats) -> Floats:
    """(n,) how tall bodies (n, 20, 3) are by the middle one of their bones [m]; NaN where none is seen."""
    lengths = np.linalg.norm(points[:, _TO] - points[:, _FROM], axis=2)
    by_bone = np.where(lengths > 0.0, lengths, np.nan) / _SHARE
    found = np.full(len(points), np.nan)
    some = np.isfinite(by_bone).any(axis=1)
    found[some] = np.nanmedian(by_bone[some], axis=1)
    return found


def handedness(points: Floats) -> Floats:
    """(n,) the volume that forward (ankle to foot), left and up span, of unit vectors: negative in a mirror image."""

    def at(name: str) -> Floats:
        return points[:, POINTS.index(name)]

    up = _unit(at("neck") - at("pelvis"))
    left = _unit(at("shoulder_l") - at("shoulder_r"))
    ahead = _unit(at("foot_l") - at("ankle_l") + at("foot_r") - at("ankle_r"))
    return np.asarray(np.einsum("ni,ni->n", np.cross(ahead, left), up))


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0.0, length, np.nan))


def size_remark(camera: str, stature_m: float, mend: str) -> str | None:
    """A note on a body's size; None where a person may have it. ``mend``: where its unit is set."""
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


def impossible_size(stature_m: float) -> bool:
    """Whether nobody can be of that size."""
    return stature_m > _CERTAIN * PERSON_M[1] or stature_m < PERSON_M[0] / _CERTAIN


def mirror_remark(camera: str, side: float) -> str | None:
    """A note where a camera sees mirror images; None where it does not."""
    if not side < -_MIRRORED:
        return None
    return (
        f"camera {camera}: left and right of the body are exchanged as its feet point (one axis mirrored, or "
        "left-handed coordinates); would be right: x, y, z right-handed, left is the person's own left"
    )


def unmeasured_limbs(seen: Mapping[str, Bools]) -> Iterator[str]:
    """The limbs that no camera ever measured, by the points (20,) that each camera ever gave."""
    ever = np.logical_or.reduce([np.zeros(len(POINTS), dtype=np.bool_), *seen.values()])
    if not ever.any():
        return
    for limb, needed in _PLACED_BY.items():
        lacking = [name for name in needed if not ever[POINTS.index(name)]]
        if lacking:
            yield (
                f"limb {limb} was never measured: no camera gave {' or '.join(lacking)}; its volume holds all that its "
                "joints allow"
            )


class BodyPosture:
    """Uprightness and height above the floor of the bodies of one camera."""

    def __init__(self) -> None:
        self._upright: list[Floats] = []
        self._pelvis: list[Floats] = []

    def add(self, points: Floats) -> None:
        """Takes bodies (n, 20, 3) in the world [m]."""
        pelvis, neck, head, right, left = (
            points[:, POINTS.index(name)] for name in ("pelvis", "neck", "head", "shoulder_r", "shoulder_l")
        )
        top = np.where(np.isfinite(neck), neck, np.where(np.isfinite(head), head, 0.5 * (right + left)))
        self._upright.append(_unit(top - pelvis)[:, 2])
        self._pelvis.append(pelvis[:, 2])

    def remark(self, camera: str) -> str | None:
        """A note on a body that cannot stand on the floor like this; None for a plausible one."""
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
