"""Azure Kinect body-tracking CSV: ``;``, a header row, microseconds, millimetres, one file a camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

from hrcreplay.errors import LogError
from hrcreplay.logs.rows import Row, import_cameras, instant, lines, numbers, row

#: K4ABT's joint confidence: none, low, medium, high. 'High' is reserved by the SDK; medium is the most it gives.
CONFIDENCE = {0.0: 0.0, 1.0: 0.5, 2.0: 1.0, 3.0: 1.0}

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
    """Makes our log from Azure Kinect CSV files (.csv or .csv.gz): ``import_cameras``, with its remarks and errors.

    Points stay in each camera's own depth frame (x right, y down, z forward) [m]. Confidence 0, 1, 2, 3 becomes
    0, 0.5, 1, 1. The device's time is the capture time.
    """
    return import_cameras(paths, out, _rows)


def _rows(path: Path) -> Iterator[Row]:
    stream = lines(path)
    where, header = next(stream)
    columns = header.lstrip("\ufeff").split(";")
    read = partial(_row, width=len(columns), at=_places(where, columns), joints=_joints(where, columns))
    before_ns = 0
    for where, text in stream:
        found = read(where, text, before_ns=before_ns)
        before_ns = found.t_ns
        yield found


def _joints(where: str, columns: list[str]) -> dict[str, int]:
    """Body point -> index of its joint among the file's joints."""
    names = [name.removesuffix(" (c)") for name in columns[2::4]]
    missing = [joint for joint in _JOINTS.values() if joint not in names]
    if missing:
        raise LogError(f"{where}: no column '{missing[0]} (c)'; would be right: timestamp;body_idx;PELVIS (c);...")
    return {point: names.index(joint) for point, joint in _JOINTS.items()}


def _places(where: str, columns: list[str]) -> int:
    """Number of joints, after a look at every column's name."""
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


def _row(where: str, text: str, before_ns: int, width: int, at: int, joints: dict[str, int]) -> Row:
    fields = text.split(";")
    values = numbers(where, fields, width)
    t_ns = instant(where, fields[0], 1000, before_ns)
    table = values[2:].reshape(at, 4)
    confidence = table[:, 0].copy()
    for level in set(confidence.tolist()):
        if level not in CONFIDENCE:
            raise LogError(f"{where}: confidence: found {level:g}; would be right: 0, 1, 2 or 3")
        confidence[table[:, 0] == level] = CONFIDENCE[level]
    return row(t_ns, int(values[1]), joints, table[:, 1:] * 1e-3, confidence)
