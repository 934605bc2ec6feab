"""Readers of tables: CSV, Parquet and JSON by a mapping; MediaPipe's landmarks are one with a known mapping."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs.decoders import number_of
from hrcreplay.logs.motion_files import TIME_UNITS, ImportMapping, Tracks, in_order, nanoseconds, rate_of, times_at
from hrcreplay.records import Floats, Ints

#: Columns of MediaPipe's landmarks, as scripts write them: one row per landmark.
_MEDIAPIPE = {
    "time": ("timestamp_ms", "timestamp", "time_ms", "time", "frame"),
    "name": ("landmark", "landmark_id", "index", "id"),
    "confidence": ("visibility", "presence", "none"),
}


def read_table(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads a table by its mapping: a row per body and frame, or a row per point (``name``)."""
    table = _load(path, mapping)
    return _long(table, path, mapping) if mapping.name is not None else _wide(table, path, mapping)


def read_mediapipe(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads the landmarks of MediaPipe Pose from a CSV or JSON table with a row per landmark [m]."""
    if mapping.name is None:
        columns = _load(path, mapping).columns
        found = {
            key: next((name for name in names if name in columns or name == "none"), None)
            for key, names in _MEDIAPIPE.items()
        }
        if found["time"] is None or found["name"] is None:
            raise LogError(
                f"{path}: found the columns {', '.join(map(str, columns[:8]))}; would be right: timestamp_ms, "
                "landmark, x, y, z, visibility with a row per landmark, or other columns by --mapping"
            )
        mapping = mapping.model_copy(
            update={
                "name": found["name"],
                "time": None if found["time"] == "frame" else found["time"],
                "time_unit": "ms" if found["time"].endswith("_ms") else mapping.time_unit,
                "columns": "{axis}" if mapping.columns == "{point}_{axis}" else mapping.columns,
                "confidence": None if found["confidence"] == "none" else found["confidence"],
                "unit": mapping.unit or "m",
                "body": mapping.body or next((name for name in ("pose", "person") if name in columns), None),
            }
        )
    return read_table(path, mapping)


def _load(path: Path, mapping: ImportMapping) -> pd.DataFrame:
    ending = path.name.lower().removesuffix(".gz").rpartition(".")[2]
    try:
        if ending == "parquet":
            columns = pq.read_table(path)
            nested = any(pa.types.is_nested(field.type) for field in columns.schema)
            return _flat_table(columns.to_pylist()) if nested else columns.to_pandas()
        if ending in ("json", "jsonl"):
            return _flat_table(_records(path, mapping, by_line=ending == "jsonl"))
        return pd.read_csv(path, sep=mapping.separator, skiprows=mapping.skip, skipinitialspace=True)
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such file; name a recording") from error
    except (
        OSError,
        ValueError,
        TypeError,
        NotImplementedError,
        RecursionError,
    ) as error:  # the parsers' own errors are ValueErrors
        told = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise LogError(f"{path}: cannot be read as a table ({told}); would be right: CSV, Parquet or JSON") from error


def _flat_table(records: list[dict[str, Any]]) -> pd.DataFrame:
    """Returns a table of nested records: tables and lists in them become columns named by their path, as points.0.x."""
    return pd.DataFrame([dict(_flat(record, "")) for record in records])


def _flat(content: Any, path: str) -> Iterator[tuple[str, Any]]:
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else None
    if items is None:
        yield path, content
        return
    for name, part in items:
        yield from _flat(part, f"{path}.{name}" if path else str(name))


def _records(path: Path, mapping: ImportMapping, *, by_line: bool) -> list[Any]:
    text = path.read_text(encoding="utf-8")
    found = [json.loads(line) for line in text.splitlines() if line.strip()] if by_line else json.loads(text)
    for name in (mapping.records or "").split(".") if mapping.records else ():
        if not isinstance(found, dict) or name not in found:
            raise LogError(f"{path}: has no {mapping.records!r}; would be right: the path to the list of records")
        found = found[name]
    if not isinstance(found, list) or not all(isinstance(record, dict) for record in found):
        raise LogError(f"{path}: found no list of records; would be right: their path with records in --mapping")
    return found


def _column(table: pd.DataFrame, name: str, path: Path) -> Floats:
    """Returns a column of numbers (n,)."""
    if name not in table.columns:
        known = ", ".join(map(str, table.columns[:12]))
        raise LogError(f"{path}: has no column {name!r}; found {known}{', ...' if len(table.columns) > 12 else ''}")
    values = pd.to_numeric(table[name], errors="coerce")
    wrong = np.flatnonzero(values.isna() & table[name].notna() & (table[name].astype(str).str.strip() != ""))
    if len(wrong):
        found = str(table[name].iloc[wrong[0]])[:40]
        raise LogError(f"{path}: row {wrong[0] + 1}: {name}: found {found!r}; would be right: a number")
    return values.to_numpy(dtype=np.float64)


def _times(table: pd.DataFrame, path: Path, mapping: ImportMapping) -> Ints | None:
    """Returns the times of the rows [ns]; None if the mapping names no column."""
    if mapping.time is None:
        return None
    given = table.get(mapping.time)
    if given is not None and given.dtype.kind in "iu":  # whole numbers keep all their digits
        return nanoseconds(given.to_numpy(), TIME_UNITS[mapping.time_unit], str(path))
    seconds = _column(table, mapping.time, path)
    if not np.isfinite(seconds).all():
        raise LogError(f"{path}: row {np.flatnonzero(~np.isfinite(seconds))[0] + 1}: {mapping.time}: has no time")
    return nanoseconds(seconds, TIME_UNITS[mapping.time_unit], str(path))


def _bodies(table: pd.DataFrame, path: Path, mapping: ImportMapping) -> Ints:
    if mapping.body is None:
        return np.zeros(len(table), dtype=np.int64)
    if mapping.body not in table.columns:
        raise LogError(
            f"{path}: has no column {mapping.body!r} for the body; found {', '.join(map(str, table.columns[:12]))}"
        )
    return np.array([number_of(value) for value in table[mapping.body]], dtype=np.int64)


def _wide(table: pd.DataFrame, path: Path, mapping: ImportMapping) -> Tracks:
    points = _named_columns(table, path, mapping)
    names = tuple(points)
    xyz = np.stack(
        [np.stack([_column(table, column, path) for column in points[name]], axis=1) for name in names], axis=1
    )
    trust = np.ones(xyz.shape[:2])
    if isinstance(mapping.confidence, str):
        trust = np.stack([_column(table, mapping.confidence.replace("{point}", name), path) for name in names], axis=1)
    elif mapping.confidence is not None:
        trust = np.full(xyz.shape[:2], mapping.confidence)
    t_ns = _times(table, path, mapping)
    if t_ns is None:
        if mapping.body is not None:
            raise SettingsError(f"{path}: several bodies need a column with the time; name it with time in --mapping")
        t_ns = times_at(len(table), rate_of(mapping, None, str(path)))
    trust = _certain(trust, mapping, path)
    return Tracks(in_order(t_ns, str(path)), _bodies(table, path, mapping), names, xyz, trust, mapping.unit)


def _named_columns(table: pd.DataFrame, path: Path, mapping: ImportMapping) -> dict[str, list[str]]:
    """Returns a point's name -> its columns of x, y, z, for the points that have all three."""
    parts = re.split(r"(\{point\}|\{axis\})", mapping.columns)
    axes = "|".join(map(re.escape, mapping.axis_names))
    means = {"{point}": "(?P<point>.+)", "{axis}": f"(?P<axis>{axes})"}
    pattern = re.compile("".join(means.get(part, re.escape(part)) for part in parts))
    found: dict[str, dict[str, str]] = {}
    for column in map(str, table.columns):
        match = pattern.fullmatch(column)
        if match:
            found.setdefault(match["point"], {})[match["axis"]] = column
    points = {
        name: [of_axis[axis] for axis in mapping.axis_names]
        for name, of_axis in found.items()
        if len(of_axis) == len(mapping.axis_names)
    }
    if not points:
        raise LogError(
            f"{path}: found the columns {', '.join(map(str, table.columns[:8]))}, none of which is a point's by "
            f"{mapping.columns!r}; would be right: the pattern of the columns in --mapping"
        )
    return points


def _long(table: pd.DataFrame, path: Path, mapping: ImportMapping) -> Tracks:
    """Reads a row per point. Rows of one time and body are a body; without times, the first name begins a frame."""
    columns = [mapping.columns.replace("{axis}", axis) for axis in mapping.axis_names]
    xyz = np.stack([_column(table, column, path) for column in columns], axis=1)
    trust = np.ones(len(table))
    if isinstance(mapping.confidence, str):
        trust = _column(table, mapping.confidence, path)
    elif mapping.confidence is not None:
        trust = np.full(len(table), mapping.confidence)
    trust = _certain(trust, mapping, path)
    if mapping.name not in table.columns:
        raise LogError(
            f"{path}: has no column {mapping.name!r} for the points; found {', '.join(map(str, table.columns[:12]))}"
        )
    labels = table[mapping.name].astype(str).to_numpy()
    names = tuple(dict.fromkeys(labels))
    body, t_ns = _bodies(table, path, mapping), _times(table, path, mapping)
    if t_ns is None:
        frame = np.cumsum(labels == labels[0]) - 1 if len(labels) else np.zeros(0, dtype=np.int64)
        t_ns = times_at(int(frame.max(initial=0)) + 1, rate_of(mapping, None, str(path)))[frame]
    in_order(t_ns, str(path))
    rows: dict[tuple[int, int], int] = {}
    row = np.array([rows.setdefault(key, len(rows)) for key in zip(t_ns.tolist(), body.tolist(), strict=True)])
    column = np.array([names.index(label) for label in labels])
    points, confidence = np.full((len(rows), len(names), 3), np.nan), np.zeros((len(rows), len(names)))
    points[row, column], confidence[row, column] = xyz, trust
    keys = np.array(list(rows), dtype=np.int64)
    return Tracks(keys[:, 0], keys[:, 1], names, points, confidence, mapping.unit)


def _certain(trust: Floats, mapping: ImportMapping, path: Path) -> Floats:
    found = np.where(np.isfinite(trust), trust, 0.0) / mapping.confidence_max
    if (found > 1.0).any():
        raise LogError(
            f"{path}: found a confidence of {found.max() * mapping.confidence_max:g}; would be right: 0 to 1, or their "
            "greatest value with confidence_max in --mapping"
        )
    return found
