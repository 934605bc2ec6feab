"""Runs the command of a replay again from its run.json, and compares what comes out with what came out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hrcreplay import replay, runs
from hrcreplay.errors import LogError, SettingsError

COMMANDS = ("fuse", "predict", "plan", "report")
_CONTEXT = ("versions", "limits", "task", "cell")  #: of run.json: what else may make a difference


def again(run: Path) -> Iterator[str]:
    """What is not the same when a replay is run again; nothing where all of it is.

    Raises:
        SettingsError: No complete run of a replay.
        LogError: The log of the run is gone.
    """
    meta = runs.read_meta(run)
    if meta["command"] not in COMMANDS:
        raise SettingsError(
            f"{run}: a run of {meta['command']}; those that can be run again are live sessions, {', '.join(COMMANDS)}"
        )
    log, digest = Path(meta["inputs"][0]["path"]), meta["inputs"][0]["sha256"]
    if not log.exists():
        raise LogError(f"{log}: the log of {run} is gone; put it back, or start where its path leads to it")
    if (now := runs.sha256(log)) != digest:
        yield f"{log}: is not the log of this run: SHA-256 recorded {digest}, now {now}"
        return
    with TemporaryDirectory(prefix="hrcreplay-") as temporary:
        # A run folder that says all of itself and holds nothing, so that nothing can be taken over from it.
        plan = Path(temporary) / "plan"
        plan.mkdir()
        (plan / "run.json").write_text(json.dumps({**meta, "stages": {}, "outputs": {}}))
        smooth = "smooth.parquet" in meta["outputs"]
        made = replay.run(meta["command"], plan, out=Path(temporary) / "again", smooth=smooth)
        yield from _compared(run, meta, made)


def _compared(run: Path, meta: dict[str, Any], made: Path) -> Iterator[str]:
    now = runs.read_meta(made)
    recorded, found = meta["outputs"], now["outputs"]
    different = [name for name in sorted({*recorded, *found}) if recorded.get(name) != found.get(name)]
    for name in different:
        if name not in found:
            yield f"{name}: recorded, but not made again"
        elif name not in recorded:
            yield f"{name}: not recorded, but made again"
        else:
            where = _table(run / name, made / name) if name.endswith(".parquet") else None
            yield f"{name}: {where or 'not the same bytes again'}"
    for key in _CONTEXT if different else ():
        yield from _context(key, meta.get(key), now.get(key))


def _context(key: str, recorded: Any, now: Any) -> Iterator[str]:
    if recorded == now:
        return
    if not isinstance(recorded, dict) or not isinstance(now, dict):
        yield f"{key}: not that of the run"
        return
    for name in sorted({*recorded, *now}):
        if recorded.get(name) != now.get(name):
            values = f": recorded {recorded.get(name)}, now {now.get(name)}" if key == "versions" else ""
            yield f"{key} of {name}{values}" if values else f"{key}: {name} is not that of the run"


def _table(recorded: Path, made: Path) -> str | None:
    """The first row, and in it the first column, that differs between two tables."""
    try:
        tables = pq.read_table(recorded), pq.read_table(made)
    except (OSError, pa.ArrowException):
        return None
    names = [table.column_names for table in tables]
    if names[0] != names[1]:
        return f"columns: recorded {len(names[0])}, again {len(names[1])}"
    rows = min(len(table) for table in tables)
    firsts = {name: _row(*(table.column(name)[:rows] for table in tables)) for name in names[0]}
    row = min((found for found in firsts.values() if found is not None), default=None)
    if row is None:
        lengths = [len(table) for table in tables]
        return None if lengths[0] == lengths[1] else f"rows: recorded {lengths[0]}, again {lengths[1]}"
    name = next(name for name, found in firsts.items() if found == row)
    mine, yours = (table.column(name)[row].as_py() for table in tables)
    return f"row {row}, {name}: recorded {mine!r}, again {yours!r}"


def _row(recorded: pa.ChunkedArray, made: pa.ChunkedArray) -> int | None:
    """The first row in which two columns differ by a bit."""
    if recorded.type != made.type:
        return 0
    if pa.types.is_floating(recorded.type):
        mine, yours = (column.to_numpy().view(np.int64) for column in (recorded, made))
        different = np.flatnonzero(mine != yours)
        return int(different[0]) if len(different) else None
    if recorded.equals(made):
        return None
    pairs = zip(recorded.to_pylist(), made.to_pylist(), strict=True)
    return next((i for i, (mine, yours) in enumerate(pairs) if mine != yours), None)
