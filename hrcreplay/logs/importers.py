"""Importers of skeleton text files: Azure Kinect CSV, Kinect v2 CSV, and KERAAL text files.

Azure Kinect: ``;``, a header row, microseconds, millimetres, one file per camera. Kinect v2: no header, 100-ns ticks,
metres, a tracking state for each of 25 joints, one file per camera. KERAAL: a Kinect v2 and optical targets of one
movement, without time stamps. Times in another unit are recognised by their steps.

Optical targets lie on the skin. The joint centre is the point that stays fixed in both neighbouring segments, by the
symmetrical centre of rotation estimation of Ehrig et al. (2006), A survey of formal methods for determining the centre
of rotation of ball joints, J. Biomech. 39, 2798-2809. A weak term pulls the centre towards both targets: it determines
the position along the axis of a hinge, which the movement does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs.writer import (
    START_NS,
    ImportedSkeleton,
    import_cameras,
    lines,
    numbers,
    skeleton_row,
    time_stamp_ns,
    write_log,
)
from hrcreplay.records import POINTS, Floats

#: K4ABT's joint confidence: none, low, medium, high. 'High' is reserved by the SDK; the maximum in practice is medium.
_AZURE_CONFIDENCE = {0.0: 0.0, 1.0: 0.5, 2.0: 1.0, 3.0: 1.0}

_JOINTS = {
    "pelvis": "PELVIS",
    "chest": "SPINE_CHEST",
    "neck": "NECK",
    "head": "HEAD",
    **{
        f"{point}_{side}": f"{joint}_{name}"
        for side, name in (("l", "LEFT"), ("r", "RIGHT"))
        for point, joint in (
            ("shoulder", "SHOULDER"),
            ("elbow", "ELBOW"),
            ("wrist", "WRIST"),
            ("hand", "HAND"),
            ("hip", "HIP"),
            ("knee", "KNEE"),
            ("ankle", "ANKLE"),
            ("foot", "FOOT"),
        )
    },
}


def import_azure(paths: Mapping[str, Path], out: Path) -> list[str]:
    """Makes a log from Azure Kinect CSV files (.csv or .csv.gz): ``import_cameras``, with its remarks and errors.

    Points stay in each camera's own depth frame (x right, y down, z forward) [m]. Confidence 0, 1, 2, 3 becomes
    0, 0.5, 1, 1. The device's time is the capture time.
    """
    return import_cameras(paths, out, _azure_rows, ";", _AZURE_NS)


_AZURE_NS = 1000  # the SDK counts microseconds


def _azure_rows(path: Path, unit_ns: int) -> Iterator[ImportedSkeleton]:
    stream = lines(path)
    where, header = next(stream)
    columns = header.lstrip("\ufeff").split(";")
    count, joints = _places(where, columns), _joints(where, columns)
    read = partial(_row, width=len(columns), at=count, joints=joints, unit_ns=unit_ns)
    before_ns = 0
    for where, text in stream:
        found = read(where, text, before_ns=before_ns)
        before_ns = found.t_ns
        yield found


def _joints(where: str, columns: list[str]) -> dict[str, int]:
    """Returns, for each body point, the index of its joint among the file's joints."""
    names = [name.removesuffix(" (c)") for name in columns[2::4]]
    missing = [joint for joint in _JOINTS.values() if joint not in names]
    if missing:
        raise LogError(f"{where}: no column '{missing[0]} (c)'; would be right: timestamp;body_idx;PELVIS (c);...")
    return {point: names.index(joint) for point, joint in _JOINTS.items()}


def _places(where: str, columns: list[str]) -> int:
    """Returns the number of joints, from the names of all columns."""
    count = (len(columns) - 2) // 4
    wanted = ["timestamp", "body_idx"]
    for name in columns[2::4]:
        wanted += [f"{name.removesuffix(' (c)')} ({axis})" for axis in "cxyz"]
    for place, (found, right) in enumerate(zip(columns, wanted, strict=False), start=1):
        if found != right:
            raise LogError(f"{where}: column {place}: found {found[:40]!r}; would be right: {right!r}")
    if len(columns) != 2 + 4 * count:
        raise LogError(f"{where}: found {len(columns)} columns; would be right: 2 and 4 for each joint")
    return count


def _row(
    where: str, text: str, before_ns: int, width: int, at: int, joints: dict[str, int], unit_ns: int
) -> ImportedSkeleton:
    fields = text.split(";")
    values = numbers(where, fields, width)
    t_ns = time_stamp_ns(where, fields[0], unit_ns, before_ns)
    table = values[2:].reshape(at, 4)
    confidence = table[:, 0].copy()
    for level in set(confidence.tolist()):
        if level not in _AZURE_CONFIDENCE:
            raise LogError(f"{where}: confidence: found {level:g}; would be right: 0, 1, 2 or 3")
        confidence[table[:, 0] == level] = _AZURE_CONFIDENCE[level]
    return skeleton_row(t_ns, int(values[1]), joints, table[:, 1:] * 1e-3, confidence)


#: Confidence of the tracking states 'not tracked', 'inferred' and 'tracked'.
_KINECT2_CONFIDENCE = np.array([0.0, 0.5, 1.0])

#: Body point -> joint of the Kinect v2. Its SpineShoulder is the middle of the shoulder line; its Neck is higher.
JOINTS = {
    "pelvis": 0,
    "chest": 1,
    "neck": 20,
    "head": 3,
    **{
        f"{point}_{side}": first + step
        for side, arm, leg in (("l", 4, 12), ("r", 8, 16))
        for first, points in ((arm, ("shoulder", "elbow", "wrist", "hand")), (leg, ("hip", "knee", "ankle", "foot")))
        for step, point in enumerate(points)
    },
}

_COUNT = 25


def import_kinect2(paths: Mapping[str, Path], out: Path) -> list[str]:
    """Makes a log from Kinect v2 CSV files (.csv or .csv.gz): ``import_cameras``, with its remarks and errors.

    Points stay in each camera's own frame (x to the sensor's left, y up, z forward) [m]. Tracking states 0, 1, 2
    become confidence 0, 0.5, 1. The sensor's time is the capture time.
    """
    return import_cameras(paths, out, _kinect2_rows, ",", _KINECT2_NS)


_KINECT2_NS = 100  # the sensor counts ticks of 100 ns


def _kinect2_rows(path: Path, unit_ns: int) -> Iterator[ImportedSkeleton]:
    before_ns = 0
    for where, text in lines(path):
        fields = text.removesuffix(",").split(",")
        values = numbers(where, fields, 1 + 4 * _COUNT)
        before_ns = time_stamp_ns(where, fields[0], unit_ns, before_ns)
        table = values[1:].reshape(_COUNT, 4)
        state = table[:, 3]
        wrong = ~np.isin(state, (0, 1, 2))
        if wrong.any():
            raise LogError(f"{where}: tracking state: found {state[wrong][0]:g}; would be right: 0, 1 or 2")
        yield skeleton_row(before_ns, 0, JOINTS, table[:, :3].copy(), _KINECT2_CONFIDENCE[state.astype(int)])


_PULL = 0.04  # skin movement (4 mm) over the usual distance of a target from the centre (0.1 m)
_SWING = 0.05  # rad: minimum relative rotation of two segments for a centre


@dataclass(frozen=True)
class Pivot:
    """A joint centre in the frames of the targets above and below it [m]."""

    above_m: Floats  # (3,)
    below_m: Floats  # (3,)

    def at(self, turn_a: Floats, place_a: Floats, turn_b: Floats, place_b: Floats) -> Floats:
        """Returns the centre (3,) for poses of the targets: the midpoint of both estimates.

        Args:
            turn_a: (3, 3) rotation of the target above the joint.
            place_a: (3,) position of the target above the joint [m].
            turn_b: (3, 3) rotation of the target below the joint.
            place_b: (3,) position of the target below the joint [m].
        """
        return 0.5 * (turn_a @ self.above_m + place_a + turn_b @ self.below_m + place_b)


def rotations(quaternions: Floats) -> Floats:
    """Converts quaternions (n, 4), x y z w, to rotation matrices (n, 3, 3); NaN if one has no finite length."""
    length = np.linalg.norm(quaternions, axis=1)
    known = np.asarray(np.isfinite(length) & (length > 0))  # scipy rejects the others, from unseen targets
    matrices = Rotation.from_quat(np.where(known[:, None], quaternions, (0.0, 0.0, 0.0, 1.0))).as_matrix()
    matrices[~known] = np.nan
    return np.asarray(matrices)


def find_pivot(turns_a: Floats, places_a: Floats, turns_b: Floats, places_b: Floats) -> Pivot | None:
    """Finds the centre about which two targets turn, by least squares over a recording.

    Args:
        turns_a: (n, 3, 3) rotations of the target above, NaN if not seen.
        places_a: (n, 3) [m].
        turns_b: (n, 3, 3) of the target below.
        places_b: (n, 3) [m].

    Returns:
        The pivot, or None if the segments hardly turn relative to each other.
    """
    seen = np.isfinite(places_a).all(axis=1) & np.isfinite(places_b).all(axis=1)
    if seen.sum() < 10:
        return None
    A = np.concatenate([turns_a[seen], -turns_b[seen]], axis=2).reshape(-1, 6)
    y = (places_b[seen] - places_a[seen]).ravel()
    # A hinge turns two of the three directions: the fifth singular value measures the amount of rotation.
    if np.linalg.svd(A, compute_uv=False)[4] < _SWING * np.sqrt(seen.sum()):
        return None
    pull = _PULL * np.sqrt(seen.sum())
    centre = np.linalg.lstsq(np.vstack([A, pull * np.eye(6)]), np.concatenate([y, np.zeros(6)]), rcond=None)[0]
    return Pivot(centre[:3], centre[3:])


#: Number of optical rows per row of the Kinect.
OPTICAL_RATE = 2

_KINECT_JOINTS = 25
_TARGETS = (
    *("forearm_r", "forearm_l", "arm_r", "arm_l", "chest", "thigh_r", "thigh_l", "shoulder_r", "shoulder_l"),
    *("hand_r", "hand_l", "foot_r", "foot_l", "hips", "head", "tibia_r", "tibia_l"),
)

#: Body points at a target itself. It is on the skin, a few centimetres off: confidence 0.5.
_ON_TARGET = {"pelvis": "hips", "head": "head", "hand_l": "hand_l", "hand_r": "hand_r"}

#: Body points about which two segments turn: target above, target below.
_PIVOTS = {
    f"{point}_{side}": (f"{above}_{side}", f"{below}_{side}")
    for side in "lr"
    for point, above, below in (
        ("shoulder", "shoulder", "arm"),
        ("elbow", "arm", "forearm"),
        ("wrist", "forearm", "hand"),
        ("knee", "thigh", "tibia"),
        ("ankle", "tibia", "foot"),
    )
}

_PIVOT_ROWS = 4000  # number of rows of the recording, evenly spaced, from which the pivots are found


def import_keraal(kinect: Path, optical: Path | None, out: Path, rate_hz: float) -> list[str]:
    """Makes a log from the Kinect's text file and, as a second sensor, that of the optical targets.

    Points stay in each sensor's own frame [m]: the Kinect's (x to the sensor's left, y up, z forward), the optical
    system's (z up). The files have no confidence: the Kinect's points get 1. Targets are on the skin, so shoulders,
    elbows, wrists, knees and ankles are the centres about which neighbouring targets turn; if the movement does not
    determine a centre, the point is missing. The neck is the middle of the shoulders.

    Args:
        kinect: 25 joints per row.
        optical: 17 rigid targets per row, at twice the Kinect's rate; or None.
        out: Log to write.
        rate_hz: Frame rate of the Kinect [Hz].

    Returns:
        Remarks for the user.

    Raises:
        LogError: A file cannot be read in this format.
        SettingsError: ``out`` exists or cannot be written, or the rate is not positive.
    """
    if not 0 < rate_hz < np.inf:
        raise SettingsError(f"rate: found {rate_hz:g}; would be right: frames a second of the Kinect, e.g. 30")
    notes = [f"the files hold no times: rows are taken as {rate_hz:g} Hz, without delay"]
    sources = {"kinect": _kinect_rows(kinect, rate_hz)}
    if optical is not None:
        pivots = _pivots(optical)
        sources["optical"] = _optical_rows(optical, OPTICAL_RATE * rate_hz, pivots)
        notes[0] += f", those of the optical targets as {OPTICAL_RATE * rate_hz:g} Hz"
        missing = [name for name in _PIVOTS if name not in pivots]
        if missing:
            notes.append(f"optical: no movement tells where {', '.join(missing)} are: missing")
    write_log(sources, out)
    return notes


def _t_ns(number: int, rate_hz: float) -> int:
    return START_NS + round(number / rate_hz * 1e9)


def _kinect_rows(path: Path, rate_hz: float) -> Iterator[ImportedSkeleton]:
    for number, table in enumerate(_tables(path, _KINECT_JOINTS)):
        points = table[:, :3].copy()
        points[(points == 0).all(axis=1)] = np.nan
        yield skeleton_row(_t_ns(number, rate_hz), 0, JOINTS, points, np.ones(_KINECT_JOINTS))


def _tables(path: Path, count: int) -> Iterator[Floats]:
    """Yields rows of (count, 7): position and quaternion x y z w."""
    for where, text in lines(path):
        yield numbers(where, text.split(), 7 * count).reshape(count, 7)


def _poses(path: Path) -> Iterator[tuple[Floats, Floats]]:
    """Returns rotations (17, 3, 3) and positions (17, 3) [m] of the targets, NaN if one was not seen."""
    for table in _tables(path, len(_TARGETS)):
        lost = (table[:, 3:] == 0).all(axis=1)
        positions = np.where(lost[:, None], np.nan, table[:, :3] * 1e-3)
        yield rotations(np.where(lost[:, None], np.nan, table[:, 3:])), positions


def _pivots(path: Path) -> dict[str, Pivot]:
    count = sum(1 for _ in lines(path))
    step = max(1, count // _PIVOT_ROWS)
    chosen = [pose for number, pose in enumerate(_poses(path)) if number % step == 0]
    turns, positions = (np.stack(part) for part in zip(*chosen, strict=True))
    found = {}
    for name, (above, below) in _PIVOTS.items():
        a, b = _TARGETS.index(above), _TARGETS.index(below)
        pivot = find_pivot(turns[:, a], positions[:, a], turns[:, b], positions[:, b])
        if pivot is not None:
            found[name] = pivot
    return found


def _optical_rows(path: Path, rate_hz: float, pivots: dict[str, Pivot]) -> Iterator[ImportedSkeleton]:
    for number, (turns, positions) in enumerate(_poses(path)):
        points, trust = np.full((len(POINTS), 3), np.nan), np.ones(len(POINTS))
        for name, target in _ON_TARGET.items():
            points[POINTS.index(name)] = positions[_TARGETS.index(target)]
            trust[POINTS.index(name)] = 0.5
        for name, pivot in pivots.items():
            a, b = (_TARGETS.index(target) for target in _PIVOTS[name])
            points[POINTS.index(name)] = pivot.at(turns[a], positions[a], turns[b], positions[b])
        shoulders = points[[POINTS.index("shoulder_l"), POINTS.index("shoulder_r")]]
        points[POINTS.index("neck")] = shoulders.mean(axis=0)
        yield skeleton_row(_t_ns(number, rate_hz), 0, list(range(len(POINTS))), points, trust)


__all__ = ["import_azure", "import_keraal", "import_kinect2"]
