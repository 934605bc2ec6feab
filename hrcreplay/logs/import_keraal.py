"""KERAAL text files: a Kinect v2 and optical targets of one movement, without time stamps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hrcreplay.errors import SettingsError
from hrcreplay.logs.import_kinect2 import JOINTS
from hrcreplay.logs.pivots import Pivot, find_pivot, rotations
from hrcreplay.logs.rows import START_NS, Row, lines, numbers, row, write_log
from hrcreplay.records import POINTS, Floats

#: Optical rows for one row of the Kinect.
OPTICAL_RATE = 2

_KINECT_JOINTS = 25
_TARGETS = (
    *("forearm_r", "forearm_l", "arm_r", "arm_l", "chest", "thigh_r", "thigh_l", "shoulder_r", "shoulder_l"),
    *("hand_r", "hand_l", "foot_r", "foot_l", "hips", "head", "tibia_r", "tibia_l"),
)

#: Body points that a target itself stands for. It sits on the skin, some centimetres off: half confidence.
_ON_TARGET = {"pelvis": "hips", "head": "head", "hand_l": "hand_l", "hand_r": "hand_r"}

#: Body points in which two segments turn about one another: target above, target below.
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

_PIVOT_ROWS = 4000  # rows of the recording that the pivots are found from, evenly spaced


def import_keraal(kinect: Path, optical: Path | None, out: Path, rate_hz: float) -> list[str]:
    """Makes our log from the Kinect's text file and, as a second sensor, that of the optical targets.

    Points stay in each sensor's own frame [m]: the Kinect's (x to the sensor's left, y up, z forward), the optical
    system's (z up). The files have no confidence: what the Kinect gives counts as 1. Targets sit on the skin, so
    shoulders, elbows, wrists, knees and ankles are the centres about which neighbouring targets turn; where the
    movement does not tell a centre, the point is missing. The neck is the middle of the shoulders.

    Args:
        kinect: 25 joints a row.
        optical: 17 rigid targets a row, at twice the Kinect's rate; or None.
        out: Log to write.
        rate_hz: Frames a second of the Kinect [Hz].

    Returns:
        Remarks for the user.

    Raises:
        LogError: A file that cannot be read as this format.
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


def _kinect_rows(path: Path, rate_hz: float) -> Iterator[Row]:
    for number, table in enumerate(_tables(path, _KINECT_JOINTS)):
        points = table[:, :3].copy()
        points[(points == 0).all(axis=1)] = np.nan
        yield row(_t_ns(number, rate_hz), 0, JOINTS, points, np.ones(_KINECT_JOINTS))


def _tables(path: Path, count: int) -> Iterator[Floats]:
    """Rows of (count, 7): position and quaternion x y z w."""
    for where, text in lines(path):
        yield numbers(where, text.split(), 7 * count).reshape(count, 7)


def _poses(path: Path) -> Iterator[tuple[Floats, Floats]]:
    """Rotations (17, 3, 3) and positions (17, 3) [m] of the targets, NaN where one was not seen."""
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


def _optical_rows(path: Path, rate_hz: float, pivots: dict[str, Pivot]) -> Iterator[Row]:
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
        yield row(_t_ns(number, rate_hz), 0, list(range(len(POINTS))), points, trust)
