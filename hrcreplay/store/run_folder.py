"""Writing and reading of a run folder.

A folder is written completely or not at all: all files go to ``<folder>.partial`` first, which is renamed after the
last write. Tables are parquet without times or paths, so the same log and settings give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from hrcreplay.errors import SettingsError
from hrcreplay.records import JOINTS, RECORDED, Bools, Floats
from hrcreplay.store.stored_table import RunTable, StoredTable, in_parts

#: The outputs that may differ between two runs on the same log and settings.
NOT_DETERMINISTIC = frozenset({"run.json", "timing.json"})


def sha256(path: Path) -> str:
    """Hex digest of a file; of a folder, the digest of its files' names and digests in sorted order."""
    if path.is_dir():
        digest = hashlib.sha256()
        for part in sorted(p for p in path.rglob("*") if p.is_file()):
            digest.update(f"{part.relative_to(path).as_posix()}\0{sha256(part)}\n".encode())
        return digest.hexdigest()
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def to_json(value: Any) -> str:
    """JSON text with sorted keys; a number that is not finite raises ValueError."""
    return json.dumps(value, indent=2, sort_keys=True, allow_nan=False) + "\n"


#: Columns that a table has only if a row needs another value than this.
OPTIONAL = {"person": 1}


def fill_optional(table: pa.Table, names: Sequence[str]) -> pa.Table:
    """Returns a table with the optional columns that another one with these columns has."""
    for at, name in enumerate(names):
        if name in OPTIONAL and name not in table.column_names:
            table = table.add_column(at, name, [pa.array(np.full(len(table), OPTIONAL[name]))])
    return table


class TableWriter:
    """A parquet file written chunk by chunk, in row groups of a fixed size for any chunk size.

    Arrays that were given must not change: they are converted when a group is full. If an optional column comes only
    with later rows, the earlier ones are written again with it.
    """

    ROWS = 8192

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: pq.ParquetWriter | None = None
        self._names: tuple[str, ...] = ()  #: of the columns of the file
        self._waiting: list[Mapping[str, Any]] = []
        self._count = 0  #: number of waiting rows

    def write(self, columns: Mapping[str, Any]) -> None:
        """Appends rows given as columns: numpy arrays or arrow arrays."""
        self._waiting.append(columns)
        self._count += _rows(columns)
        if self._count >= self.ROWS:
            joined, whole = self._join(), self._count // self.ROWS * self.ROWS
            for first in range(0, whole, self.ROWS):
                self._flush({name: column[first : first + self.ROWS] for name, column in joined.items()})
            self._waiting = [{name: column[whole:] for name, column in joined.items()}]
            self._count -= whole

    def _join(self) -> dict[str, Any]:
        """The waiting rows, with all columns that they or the file have."""
        names = max((self._names, *map(tuple, self._waiting)), key=len)
        if self._writer is not None and len(names) > len(self._names):
            self._widen(names)
        filled = [
            {name: np.full(_rows(part), OPTIONAL[name]) for name in names if name in OPTIONAL} | dict(part)
            for part in self._waiting
        ]
        return {name: _joined([part[name] for part in filled]) for name in names}

    def _widen(self, names: Sequence[str]) -> None:
        """Writes all rows so far again, with the optional columns among ``names``, one group of rows at a time."""
        if self._writer is not None:
            self._writer.close()
        self._writer, narrow = None, self._path.with_suffix(".narrow")
        self._path.rename(narrow)
        with pq.ParquetFile(narrow) as before:
            for group in range(before.num_row_groups):
                table = fill_optional(before.read_row_group(group), names)
                self._flush(dict(zip(table.column_names, table.columns, strict=True)))
        narrow.unlink()

    def _flush(self, columns: Mapping[str, Any]) -> None:
        table = arrow_table(columns)
        if self._writer is None:
            names = [field.name for field in table.schema if pa.types.is_string(field.type)]  # numbers hardly repeat
            self._writer = pq.ParquetWriter(self._path, table.schema, compression="lz4", use_dictionary=names)
            self._names = tuple(table.column_names)
        self._writer.write_table(table.combine_chunks())

    def close(self) -> None:
        """Writes the remaining rows. A table without rows has no file."""
        if self._count or (self._waiting and self._writer is None):
            self._flush(self._join())
        if self._writer is not None:
            self._writer.close()


def _rows(columns: Mapping[str, Any]) -> int:
    """Number of rows."""
    return len(next(iter(columns.values())))


def _joined(parts: Sequence[Any]) -> Any:
    """One column of several parts, of numpy or of arrow."""
    if all(isinstance(part, np.ndarray) for part in parts):
        return np.concatenate(parts)
    return pa.chunked_array([chunk for part in parts for chunk in _chunks(part)])


def _chunks(column: Any) -> list[pa.Array]:
    return column.chunks if isinstance(column, pa.ChunkedArray) else [pa.array(column)]


def arrow_table(columns: Mapping[str, Any]) -> pa.Table:
    """Converts numpy or arrow arrays into an arrow table."""
    return pa.table({name: _one_nan(column) for name, column in columns.items()})


def _one_nan(column: Any) -> Any:
    """Replaces every NaN by the same bit pattern, as the pattern depends on the machine."""
    if isinstance(column, np.ndarray) and column.dtype == np.float64:
        return np.where(np.isnan(column), np.nan, column)
    return column


class Tables(Protocol):
    """Destination of table rows: a run folder or memory."""

    def table(self, name: str, columns: Mapping[str, Any], /) -> None:
        """Appends rows to a table."""


class FolderTables:
    """Writes tables into an existing folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._open: dict[str, TableWriter] = {}

    def table(self, name: str, columns: Mapping[str, Any], /) -> None:
        """Appends rows to ``<name>.parquet``."""
        if name not in self._open:
            self._open[name] = TableWriter(self.folder / f"{name}.parquet")
        self._open[name].write(columns)

    def close_tables(self) -> None:
        """Completes the tables, so that they can be read."""
        for table in self._open.values():
            table.close()
        self._open.clear()


@dataclass
class RunWriter:
    """Creates a run folder. Use as a context manager: a failure removes all written files and new folders.

    Raises:
        SettingsError: The folder exists or cannot be created.
    """

    folder: Path
    timing: dict[str, Any] = field(default_factory=dict)
    _made: list[Path] = field(default_factory=list)  #: folders above that it made, the innermost first

    @cached_property
    def _tables(self) -> FolderTables:
        return FolderTables(self.partial)

    @property
    def partial(self) -> Path:
        """Folder in which the run is written until it is complete."""
        return self.folder.with_name(self.folder.name + ".partial")

    def __enter__(self) -> Self:
        if self.folder.exists():
            raise SettingsError(f"{self.folder}: exists already; name another folder with --out, or remove it")
        if self.partial.exists():
            raise SettingsError(
                f"{self.partial}: left by a run that is under way or was killed; remove it or name another --out"
            )
        above = [path for path in self.partial.parents if not path.exists()]
        try:
            self.partial.mkdir(parents=True)
        except OSError as error:
            raise SettingsError(f"{self.folder}: cannot be made ({error.strerror}); name another --out") from error
        self._made.extend(above)
        self.text("run.json", to_json({"complete": False}))
        return self

    def table(self, name: str, columns: Mapping[str, Any]) -> None:
        """Appends rows to ``<name>.parquet``."""
        self._tables.table(name, columns)

    def close_tables(self) -> None:
        """Completes the tables, so that they can be read from ``partial``."""
        self._tables.close_tables()

    def copy(self, name: str, source: Path) -> None:
        """Copies a file from another run, byte for byte."""
        shutil.copyfile(source / name, self.partial / name)

    def text(self, name: str, text: str) -> None:
        """Writes a text file."""
        path = self.partial / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)

    def finish(self, meta: Mapping[str, Any], *, complete: bool = True) -> None:
        """Writes run.json with the digest of every output and renames the folder.

        Args:
            meta: The other entries of run.json.
            complete: False for a session that was interrupted, even if its record could be completed.
        """
        self.close_tables()
        self.text("timing.json", to_json(self.timing))
        names = sorted(p.relative_to(self.partial).as_posix() for p in self.partial.rglob("*") if p.is_file())
        outputs = {name: sha256(self.partial / name) for name in names if name not in NOT_DETERMINISTIC}
        self.text("run.json", to_json({**meta, "outputs": outputs, "complete": complete}))
        self.partial.rename(self.folder)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close_tables()
        finally:
            if self.partial.exists():
                shutil.rmtree(self.partial)
                for path in self._made:
                    with suppress(OSError):  # another run has written there in the meantime
                        path.rmdir()


@dataclass(frozen=True)
class Run:
    """A run folder's tables; None if the stage was not run."""

    folder: Path
    meta: dict[str, Any]
    state: RunTable | None = None
    measurements: RunTable | None = None
    truth: pd.DataFrame | None = None
    bodies: pd.DataFrame | None = None
    agreement: pd.DataFrame | None = None
    occupancy: RunTable | None = None
    motion: RunTable | None = None
    contact: RunTable | None = None
    severity: pd.DataFrame | None = None
    body: RunTable | None = None
    recorded: RunTable | None = None  #: motion of the robot as recorded
    baselines: Mapping[str, RunTable] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @cached_property
    def people(self) -> tuple[int, ...]:
        """Numbers of the people with a fused state, from 1; (1,) for a run with one person."""
        if self.state is None or "person" not in self.state:
            return (1,)
        return tuple(sorted({1, *self.state["person"][self.state["x"].notna()].tolist()}))

    @cached_property
    def known(self) -> Bools:
        """(n,) True for the rows of ``state`` at which the person is known; () without a state."""
        parts = [] if self.state is None else in_parts(self.state, JOINTS)
        known = [np.isfinite(part.to_numpy(dtype=float)).all(axis=1) for part in parts]
        return np.concatenate([np.zeros(0, dtype=np.bool_), *known])

    @cached_property
    def _alone(self) -> dict[int, Self]:
        return {}

    def of_person(self, number: int) -> Self:
        """The run as if it had tracked one person alone; the motion is that near all people."""
        if number not in self._alone:
            self._alone[number] = self._only(number)
        return self._alone[number]

    def _only(self, number: int) -> Self:
        def rows(table: Any) -> Any:
            if table is None or "person" not in table:
                return table
            return table[table["person"] == number].drop(columns="person").reset_index(drop=True)

        state, measurements, occupancy = map(rows, (self.state, self.measurements, self.occupancy))
        return replace(self, state=state, measurements=measurements, occupancy=occupancy, body=rows(self.body))

    def states(self) -> list[RunTable]:
        """The fused states of each person; none without any."""
        each = [self.of_person(number).state for number in self.people]
        return [state for state in each if state is not None]

    @property
    def T_world_base(self) -> Floats | None:
        """(4, 4) robot base in the world; None if unknown."""
        found = self.meta.get("T_world_base")
        return None if found is None else np.asarray(found, dtype=float)


def is_run(path: Path) -> bool:
    """Returns True if a folder was written by an earlier command."""
    return (path / "run.json").is_file()


def read_meta(folder: Path, *, broken_off: bool = False) -> dict[str, Any]:
    """Reads run.json of a complete run.

    Args:
        folder: Folder of the run.
        broken_off: True: also accept a live session that crashed.

    Raises:
        SettingsError: The folder is not a run folder, or the run did not end.
    """
    try:
        meta: dict[str, Any] = json.loads((folder / "run.json").read_text())
    except (OSError, ValueError) as error:
        raise SettingsError(f"{folder}: no run folder (run.json is missing or broken)") from error
    if not meta.get("complete") and meta.get("crashes"):
        if broken_off:
            return meta
        raise SettingsError(
            f"{folder}: a live session that broke off ({meta['crashes'][0]}); give its log: {folder / 'log.mcap'}"
        )
    if not meta.get("complete"):
        raise SettingsError(f"{folder}: the run did not end (complete is false); run it again")
    return meta


def read_metrics(folder: Path) -> dict[str, dict[str, Any]]:
    """Returns the metrics of a run folder; none if its command computes none."""
    path = folder / "metrics.json"
    return dict(json.loads(path.read_text())) if path.exists() else {}


def read(folder: Path, meta: dict[str, Any] | None = None) -> Run:
    """Opens the tables of a run folder, or of an open run if its ``meta`` is given; small ones are read at once."""
    meta = read_meta(folder) if meta is None else meta
    paths = {path.stem: path for path in sorted(folder.glob("*.parquet"))}

    def stored(name: str) -> StoredTable | None:
        return StoredTable(paths[name]) if name in paths else None

    def whole(name: str) -> pd.DataFrame | None:
        return pq.read_table(paths[name]).to_pandas() if name in paths else None

    motions = {name.removeprefix("motion_"): StoredTable(paths[name]) for name in paths if name.startswith("motion_")}
    return Run(
        folder=folder,
        meta=meta,
        state=stored("state"),
        measurements=stored("measurements"),
        truth=whole("truth"),
        bodies=whole("bodies"),
        agreement=whole("agreement"),
        occupancy=stored("occupancy"),
        motion=stored("motion"),
        contact=stored("contact"),
        severity=whole("severity"),
        body=stored("body"),
        recorded=motions.pop(RECORDED, None),
        baselines=motions,
        counts=meta.get("counts", {}),
        notes=tuple(meta.get("notes", ())),
    )


class Stopwatch:
    """Time spent per stage, for timing.json; the time of a call is divided among its ticks."""

    def __init__(self, clock_ns: Callable[[], int]) -> None:
        self._clock_ns = clock_ns
        self._calls: dict[str, list[tuple[int, int]]] = {}

    @contextmanager
    def stage(self, name: str, ticks: int) -> Iterator[None]:
        """Adds the duration of the block to a stage, for a number of its ticks."""
        start = self._clock_ns()
        yield
        self._calls.setdefault(name, []).append((ticks, self._clock_ns() - start))

    @property
    def calls(self) -> dict[str, list[tuple[int, int]]]:
        """Stage -> ticks and duration [ns] of each call."""
        return self._calls

    def summary(self, period_s: float) -> dict[str, Any]:
        """Summarises each stage: ticks; median, p99, p99.9 and max time a tick [us]; speed relative to real time."""
        out = {}
        for stage, calls in self._calls.items():
            ticks = np.array([n for n, _ in calls if n])
            each_us = np.array([ns / n / 1e3 for n, ns in calls if n])
            if not len(ticks):
                continue
            spread = np.repeat(each_us, ticks)
            total_s = float((ticks * each_us).sum()) / 1e6
            out[stage] = {
                "ticks": int(ticks.sum()),
                "median_us": float(np.median(spread)),
                "p99_us": float(np.quantile(spread, 0.99)),
                "p99_9_us": float(np.quantile(spread, 0.999)),
                "max_us": float(spread.max()),
                "real_time_factor": float(ticks.sum()) * period_s / total_s if total_s else None,
            }
        return out


def write_whole(path: Path, content: str | bytes) -> None:
    """Writes a new file under a temporary name and renames it when it is complete.

    Raises:
        SettingsError: The file exists, or its folder cannot be written.
    """
    if path.exists():
        raise SettingsError(f"{path}: exists already; name another file, or remove it")
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise SettingsError(f"{path}: cannot be written ({error.strerror}); name a folder that can") from error
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content.encode() if isinstance(content, str) else content)
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp's mode 0600 would make the file unreadable for other users
        temporary.rename(path)
    finally:
        temporary.unlink(missing_ok=True)
