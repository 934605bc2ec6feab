"""Readers of trackers' own files: JSON of k4abt and of the ZED SDK, OpenPose, skeletons of NTU RGB+D."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.logs.messages import AZURE_JOINTS, KINECT2_JOINTS
from hrcreplay.logs.motion_files import (
    Body,
    ImportMapping,
    Tracks,
    empty_frame,
    nanoseconds,
    rate_of,
    seen,
    stacked,
    times_at,
)
from hrcreplay.logs.writer import lines, numbers
from hrcreplay.records import Floats

_NTU_HZ = 30.0
_NTU_CONFIDENCE = np.array([0.0, 0.5, 1.0])  # not tracked, inferred, tracked
_TRIANGULATION = (
    "found points in the image alone (pose_keypoints_2d); places in space need triangulation with calibrated cameras, "
    "which hrcreplay does not do; would be right: 3-D points, e.g. pose_keypoints_3d, or a depth camera by ros_openpose"
)


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such file; name a recording") from error
    except (OSError, ValueError, RecursionError) as error:
        raise LogError(f"{path}: is no JSON that can be read ({error}); export it again") from error


def _part(content: Any, key: str, where: str) -> Any:
    if not isinstance(content, dict) or key not in content:
        known = ", ".join(list(content)[:8]) if isinstance(content, dict) else type(content).__name__
        raise LogError(f"{where}: has no {key!r}; found {known}")
    return content[key]


def _items(content: Any, key: str, where: str) -> list[Any]:
    found = _part(content, key, where)
    if not isinstance(found, list):
        raise LogError(f"{where}: {key}: found {str(found)[:40]!r}; would be right: a list")
    return found


def _integer(content: Any, key: str, where: str) -> int:
    found = _part(content, key, where)
    if not isinstance(found, int) or abs(found) >= 1 << 62:
        raise LogError(f"{where}: {key}: found {str(found)[:40]!r}; would be right: a whole number")
    return found


def _table(values: Any, width: int, where: str) -> Floats:
    """Returns rows of numbers (k, width). Raises LogError."""
    try:
        table = np.array([[np.nan if v is None else v for v in row] for row in values], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise LogError(f"{where}: found {str(values)[:40]}; would be right: rows of {width} numbers") from error
    if table.ndim != 2 or table.shape[1] != width:
        raise LogError(f"{where}: found {' x '.join(map(str, table.shape))} numbers; would be right: rows of {width}")
    return table


# --- Azure Kinect: JSON of the SDK's offline_processor ---


def read_k4abt(path: Path, _mapping: ImportMapping) -> Tracks:
    """Reads the JSON of k4abt's offline processor [mm]; it holds no confidence."""
    content = _json(path)
    names = tuple(map(str, content.get("joint_names", AZURE_JOINTS))) if isinstance(content, dict) else AZURE_JOINTS
    bodies: list[Body] = []
    for number, frame in enumerate(_items(content, "frames", str(path))):
        where = f"{path}: frame {number + 1}"
        t_ns = int(nanoseconds(np.array([_integer(frame, "timestamp_usec", where)]), 1000, where)[0])
        found = _items(frame, "bodies", where)
        for body in found:
            points = _table(_part(body, "joint_positions", where), 3, where)
            if len(points) != len(names):
                raise LogError(f"{where}: found {len(points)} joints; would be right: {len(names)}, as joint_names")
            points[(points == 0.0).all(axis=1)] = np.nan
            bodies.append(Body(t_ns, _integer(body, "body_id", where), points, seen(points)))
        if not found:
            bodies.append(empty_frame(t_ns, len(names)))
    return stacked(bodies, names, str(path), "mm", "the file holds no confidence: 1 for every point")


# --- ZED: JSON of the SDK's samples ---

_ZED_ORDERS = {18: "zed18", 34: "zed34", 38: "zed38"}


def read_zed(path: Path, _mapping: ImportMapping) -> Tracks:
    """Reads bodies that the ZED SDK's samples write as JSON: keypoints of BODY_18, 34 or 38, times in ns."""
    content = _json(path)
    if not isinstance(content, dict):
        raise LogError(f"{path}: found no table of frames; would be right: the JSON of the SDK's body export")
    bodies: list[Body] = []
    count = 0
    for key, frame in content.items():
        where = f"{path}: frame {key}"
        t_ns = _integer(frame, "timestamp", where)
        found = _items(frame, "body_list", where)
        for body in found:
            points = _table(_part(body, "keypoint", where), 3, where)
            count = count or len(points)
            if len(points) != count or count not in _ZED_ORDERS:
                raise LogError(f"{where}: found {len(points)} keypoints; would be right: 18, 34 or 38 throughout")
            trust = _table([body.get("keypoint_confidence") or [100.0] * count], count, where)[0] / 100.0
            bodies.append(Body(t_ns, _integer(body, "id", where), points, np.where(np.isfinite(trust), trust, 0.0)))
        if not found:
            bodies.append(empty_frame(t_ns, count or 38))
    count = count or 38
    bodies = [body if len(body.points) == count else empty_frame(body.t_ns, count) for body in bodies]
    return stacked(bodies, tuple(map(str, range(count))), str(path), None, order=_ZED_ORDERS[count])


# --- OpenPose ---


def read_openpose(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads 3-D points of OpenPose (BODY_25): a folder with a JSON per frame, or one. Image points are refused."""
    files = sorted(path.glob("*_keypoints.json"), key=_frame_number) if path.is_dir() else [path]
    if not files:
        raise LogError(f"{path}: found no *_keypoints.json; would be right: the folder that OpenPose writes")
    t_ns = times_at(len(files), rate_of(mapping, 1.0 if len(files) == 1 else None, str(path)))
    bodies: list[Body] = []
    for file, t in zip(files, t_ns.tolist(), strict=True):
        people = _items(_json(file), "people", str(file))
        for number, person in enumerate(people):
            flat = person.get("pose_keypoints_3d") if isinstance(person, dict) else None
            if not flat:
                raise LogError(f"{file}: {_TRIANGULATION}")
            table = _table(
                [flat[i : i + 4] for i in range(0, len(flat), 4)] if isinstance(flat, list) else flat, 4, str(file)
            )
            if len(table) != 25:
                raise LogError(f"{file}: found {len(table)} points; would be right: 25 of BODY_25")
            known = table[:, 3] > 0
            points = np.where(known[:, None], table[:, :3], np.nan)
            bodies.append(Body(t, number, points, np.where(known, np.clip(table[:, 3], 0.0, 1.0), 0.0)))
        if not people:
            bodies.append(empty_frame(t, 25))
    return stacked(bodies, tuple(map(str, range(25))), str(path), None)


def _frame_number(path: Path) -> tuple[int, str]:
    found = re.search(r"(\d+)_keypoints\.json$", path.name)
    return (int(found[1]) if found else 0, path.name)


# --- NTU RGB+D ---


def read_ntu(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads a skeleton file of NTU RGB+D: Kinect v2, 30 frames a second, bodies numbered in order of appearance."""
    rows = lines(path)
    count = _whole(rows, path)
    rate_hz = rate_of(mapping, _NTU_HZ, str(path))
    t_ns = times_at(count, rate_hz)
    ids: dict[str, int] = {}
    bodies: list[Body] = []
    for t in t_ns.tolist():
        here = _whole(rows, path)
        for _ in range(here):
            _, text = _next(rows, path)
            number = ids.setdefault(text.split()[0], len(ids))
            if _whole(rows, path) != len(KINECT2_JOINTS):
                raise LogError(f"{path}: found a body without 25 joints; would be right: skeletons of the Kinect v2")
            bodies.append(Body(t, number, *_ntu_joints(rows, path)))
        if not here:
            bodies.append(empty_frame(t, len(KINECT2_JOINTS)))
    return stacked(
        bodies, KINECT2_JOINTS, str(path), "m", f"the file holds no times: frames are taken as {rate_hz:g} Hz"
    )


def _ntu_joints(rows: Iterator[tuple[str, str]], path: Path) -> tuple[Floats, Floats]:
    points, trust = np.empty((len(KINECT2_JOINTS), 3)), np.empty(len(KINECT2_JOINTS))
    for i in range(len(KINECT2_JOINTS)):
        where, text = _next(rows, path)
        values = numbers(where, text.split(), 12)
        if values[11] not in (0.0, 1.0, 2.0):
            raise LogError(f"{where}: tracking state: found {values[11]:g}; would be right: 0, 1 or 2")
        points[i], trust[i] = values[:3], _NTU_CONFIDENCE[int(values[11])]
    return points, trust


def _next(rows: Iterator[tuple[str, str]], path: Path) -> tuple[str, str]:
    row = next(rows, None)
    if row is None:
        raise LogError(f"{path}: ends before its last frame; would be right: the whole file")
    return row


def _whole(rows: Iterator[tuple[str, str]], path: Path) -> int:
    where, text = _next(rows, path)
    if not re.fullmatch(r"[0-9]{1,7}", text):
        raise LogError(f"{where}: found {text[:40]!r}; would be right: a number of frames, bodies or joints")
    return int(text)
