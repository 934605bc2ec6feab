"""Differences between the recorded results of a run and the results when it is computed again.

Two processors round differently, so the last bits of a number may differ. A decision, a count or a name must never
differ. A number may differ by TOLERANCE, but only if another machine recorded the run.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from google.protobuf.message import DecodeError, Message

from hrcreplay.records import Bools, Floats

#: Largest difference of a number between two machines, in its SI unit; for numbers above 1, as a share of the number.
TOLERANCE = 1e-9
#: An acceleration is compared by the change of velocity that it causes within a tick of this length [s].
_TICK_S = 0.004
#: Columns of a table that are decisions: no bit may differ.
_DECIDING = ("certified", "horizon_s")


@dataclass(frozen=True, slots=True)
class Difference:
    """One quantity that differs."""

    text: str  #: place, and both values
    size: float  #: size of the difference, in the unit of TOLERANCE; inf if no difference is allowed

    @property
    def tolerable(self) -> bool:
        """Return whether another processor alone can explain the difference."""
        return self.size <= TOLERANCE

    def at(self, where: str) -> Difference:
        """The difference with ``where`` before its text."""
        return replace(self, text=f"{where}{self.text}")


def differing(name: str, recorded: Any, again: Any) -> Difference:
    """The difference of two values that must be equal."""
    return Difference(f"{name}: recorded {recorded!r}, again {again!r}", math.inf)


def decisions_differing(names: Sequence[str], recorded: Sequence[Any], again: Sequence[Any]) -> list[Difference]:
    """Differences between values that must be equal."""
    if len(recorded) != len(again):
        return [_counts_differing(names, len(recorded), len(again))]
    pairs = zip(names, recorded, again, strict=True)
    return [differing(name, mine, yours) for name, mine, yours in pairs if mine != yours]


def numbers_differing(names: Sequence[str], recorded: Floats, again: Floats) -> list[Difference]:
    """Numbers that differ in any bit; all NaN are equal. ``names`` are column names."""
    if len(recorded) != len(again):
        return [_counts_differing(names, len(recorded), len(again))]
    different = np.flatnonzero(_bits_differ(recorded, again)).tolist()
    return [_apart(names[i], float(recorded[i]), float(again[i])) for i in different]


def _counts_differing(names: Sequence[str], recorded: int, again: int) -> Difference:
    return differing(f"how many of {names[0]} ... there are" if names else "numbers", recorded, again)


def _bits_differ(recorded: Floats, again: Floats) -> Bools:
    """Marks the elements of two arrays that differ in any bit; all NaN are equal."""
    mine, yours = (np.ascontiguousarray(values, dtype=np.float64) for values in (recorded, again))
    return np.asarray((mine.view(np.int64) != yours.view(np.int64)) & ~(np.isnan(mine) & np.isnan(yours)))


def _apart(name: str, recorded: float, again: float, *, column: str | None = None) -> Difference:
    size = float(_sizes(column or name, np.array([recorded]), np.array([again]))[0])
    apart = f", {abs(recorded - again):.1e} apart" if math.isfinite(recorded - again) else ""
    return Difference(f"{name}: recorded {recorded!r}, again {again!r}{apart}", size)


def _sizes(name: str, recorded: Floats, again: Floats) -> Floats:
    """Sizes of the differences, in the unit of TOLERANCE; inf for decisions, and for NaN against a number."""
    if name in _DECIDING:
        return np.where(_bits_differ(recorded, again), np.inf, 0.0)
    unit = _TICK_S if name[:1] == "u" and name[1:].isdigit() else 1.0
    with np.errstate(invalid="ignore"):
        size = unit * np.abs(recorded - again) / np.maximum(1.0, unit * np.maximum(np.abs(recorded), np.abs(again)))
    return np.where(_bits_differ(recorded, again), np.where(np.isfinite(size), size, np.inf), 0.0)


def messages_differing(kind: Callable[[], Message], recorded: bytes, again: bytes) -> list[Difference]:
    """Fields of two protobuf messages that differ; the whole message if fields cannot be compared."""
    if recorded == again:
        return []
    whole = differing("reply", f"{len(recorded)} bytes", f"{len(again)} bytes, others")
    try:
        mine, yours = kind(), kind()
        mine.ParseFromString(recorded)
        yours.ParseFromString(again)
    except DecodeError:
        return [whole]
    if mine.SerializeToString() != recorded or yours.SerializeToString() != again:
        return [whole]  # fields in another order, or unknown fields
    return _fields_differing("reply", _plain(mine), _plain(yours)) or [whole]


def _plain(message: Message) -> dict[str, Any]:
    """Fields that are set in a message, by name."""
    found: dict[str, Any] = {}
    for field, value in message.ListFields():
        parts = [
            _plain(part) if isinstance(part, Message) else part for part in (value if field.is_repeated else [value])
        ]
        found[field.name] = parts if field.is_repeated else parts[0]
    return found


def _fields_differing(where: str, recorded: Any, again: Any) -> list[Difference]:
    """Leaves of two nested structures, like those of JSON, that differ."""
    if isinstance(recorded, dict) and isinstance(again, dict) and recorded.keys() == again.keys():
        return [found for key in recorded for found in _fields_differing(f"{where}.{key}", recorded[key], again[key])]
    if isinstance(recorded, list) and isinstance(again, list) and len(recorded) == len(again):
        pairs = enumerate(zip(recorded, again, strict=True))
        return [found for i, (mine, yours) in pairs for found in _fields_differing(f"{where}[{i}]", mine, yours)]
    if isinstance(recorded, float) and isinstance(again, float):
        return numbers_differing([where], np.array([recorded]), np.array([again]))
    same = type(recorded) is type(again) and recorded == again
    return [] if same else [differing(where, recorded, again)]


def json_differing(recorded: Path, again: Path) -> list[Difference]:
    """Leaves of two JSON files that differ."""
    try:
        mine, yours = (json.loads(path.read_text()) for path in (recorded, again))
    except ValueError:
        return [Difference("is no JSON", math.inf)]
    return _fields_differing("", mine, yours)


def tables_differing(recorded: Path, again: Path) -> list[Difference]:
    """Differences of two parquet files, sorted by row: the first and the worst difference of each column."""
    try:
        tables = pq.read_table(recorded), pq.read_table(again)
    except (OSError, pa.ArrowException):
        return [Difference("cannot be read", math.inf)]
    names = [table.column_names for table in tables]
    if names[0] != names[1]:
        return [differing("columns", len(names[0]), len(names[1]))]
    rows = min(len(table) for table in tables)
    found = [
        (row, difference)
        for name in names[0]
        for row, difference in _column_differing(name, *(table.column(name)[:rows] for table in tables))
    ]
    if len(tables[0]) != len(tables[1]):
        found.append((rows, differing("rows", len(tables[0]), len(tables[1]))))
    return [difference for _, difference in sorted(found, key=lambda one: one[0])]


def _column_differing(name: str, recorded: pa.ChunkedArray, again: pa.ChunkedArray) -> Iterator[tuple[int, Difference]]:
    """Rows and differences of two columns: the first one and, for numbers, the worst one; none if they are equal."""
    if recorded.type != again.type:
        yield 0, differing(f"type of {name}", str(recorded.type), str(again.type))
        return
    mine, yours = recorded.combine_chunks(), again.combine_chunks()
    rows = np.arange(len(mine))
    if pa.types.is_list(mine.type):
        lengths = [part.value_lengths().fill_null(-1).to_numpy(zero_copy_only=False) for part in (mine, yours)]
        uneven = np.flatnonzero(lengths[0] != lengths[1])
        if len(uneven):
            row = int(uneven[0])
            yield row, differing(f"row {row}, length of {name}", int(lengths[0][row]), int(lengths[1][row]))
            return
        rows, mine, yours = np.repeat(rows, np.maximum(lengths[0], 0)), mine.flatten(), yours.flatten()
    if pa.types.is_floating(mine.type):
        numbers = [part.to_numpy(zero_copy_only=False) for part in (mine, yours)]
        different = np.flatnonzero(_bits_differ(*numbers))
        if len(different):
            for i in dict.fromkeys((int(different[0]), int(np.argmax(_sizes(name, *numbers))))):
                yield int(rows[i]), _apart(f"row {rows[i]}, {name}", *(float(part[i]) for part in numbers), column=name)
    elif not mine.equals(yours):
        pairs = enumerate(zip(mine.to_pylist(), yours.to_pylist(), strict=True))
        i, one, other = next((i, one, other) for i, (one, other) in pairs if one != other)
        yield int(rows[i]), differing(f"row {rows[i]}, {name}", one, other)


def worst(found: Sequence[Difference]) -> Difference:
    """The first difference that is not tolerable, otherwise the largest difference."""
    first = next((one for one in found if not one.tolerable), None)
    return first or max(found, key=lambda one: one.size)
