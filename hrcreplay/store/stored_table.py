"""A table of a run folder that is read column by column when asked for, so that a long run needs little memory."""

from __future__ import annotations

import weakref
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Self, overload

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from hrcreplay.records import Bools, Floats, Ints
from hrcreplay.store.memory import release_freed_memory

#: An array of any type.
Anything = np.ndarray[tuple[int, ...], np.dtype[Any]]

#: Number of groups of rows that are read together when only some of their rows are needed.
_GROUPS = 8
#: Memory of the columns of all files that are kept, as most are asked for more than once [bytes].
_KEPT_BYTES = 32_000_000
#: A longer column belongs to a long run: what was freed since the last one is given back, as it would add up [bytes].
_LONG_BYTES = 4_000_000


class StoredTable:
    """Rows and columns of a parquet file. What it has of pandas' DataFrame means the same.

    Asked for a column it returns a Series, for a list of columns a DataFrame, for a mask the rows that are True. Tables
    made from it share its file; the columns of any file that were asked for last are kept in memory, 32 MB of them.
    """

    def __init__(
        self,
        path: Path | _File,
        columns: Sequence[str] | None = None,
        rows: Bools | None = None,
        made: Mapping[str, Anything] | None = None,
    ) -> None:
        """Names a table; of the file only its description is read.

        Args:
            path: The file.
            columns: The columns; None: all of the file.
            rows: (n,) True for the rows of the file that belong to the table; None: all.
            made: Column beside those of the file, or in place of one -> (n,) its values in the rows of the table.
        """
        self._file = path if isinstance(path, _File) else _File.of(path)
        self._made = dict(made or {})
        self._bits = None if rows is None else np.packbits(rows)  # in a long run with visitors each has such tables
        self._length = self._file.length if rows is None else int(np.count_nonzero(rows))
        self.columns = self._file.names if columns is None else tuple(columns)

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __len__(self) -> int:
        return self._length

    @property
    def _rows(self) -> Bools | None:
        """(n,) True for the rows of the file that belong to the table; None: all."""
        if self._bits is None:
            return None
        return np.unpackbits(self._bits, count=self._file.length).view(np.bool_)

    @property
    def empty(self) -> bool:
        """True for a table without rows."""
        return not len(self)

    @overload
    def __getitem__(self, key: str) -> pd.Series[Any]: ...
    @overload
    def __getitem__(self, key: list[str]) -> pd.DataFrame: ...
    @overload
    def __getitem__(self, key: pd.Series[bool] | Bools) -> StoredTable: ...
    def __getitem__(self, key: str | list[str] | pd.Series[bool] | Bools) -> Any:
        """A column, some columns, or the table of some rows.

        Raises:
            KeyError: There is no such column.
        """
        if isinstance(key, str):
            return self._one(key)
        if isinstance(key, list):
            return self._read(key, self._rows)
        return self._where(np.asarray(key, dtype=np.bool_))

    def _one(self, name: str) -> pd.Series[Any]:
        if name in self._made:
            return pd.Series(self._made[name], name=name)
        if name not in self.columns:
            raise KeyError(name)
        return self._file.column(name, self._rows)

    def _where(self, mask: Bools) -> StoredTable:
        rows, mine = mask, self._rows
        if mine is not None:
            rows = np.zeros(len(mine), dtype=np.bool_)
            rows[np.flatnonzero(mine)[mask]] = True
        return StoredTable(self._file, self.columns, rows, {name: values[mask] for name, values in self._made.items()})

    @property
    def iloc(self) -> _Places:
        """Rows by their places; reads the groups of rows that have them."""
        return _Places(self)

    def drop(self, *, columns: str) -> StoredTable:
        """The table without a column."""
        return StoredTable(self._file, [name for name in self.columns if name != columns], self._rows, self._made)

    def reset_index(self, *, drop: bool) -> Self:  # noqa: ARG002 (that of DataFrame)
        """The table itself: its rows are counted from 0."""
        return self

    def assign(self, **made: Any) -> StoredTable:
        """The table with other values in some columns, or with more columns: values of each row, or one for all."""
        values = {name: np.broadcast_to(np.asarray(value), len(self)) for name, value in made.items()}
        columns = tuple(dict.fromkeys([*self.columns, *made]))
        return StoredTable(self._file, columns, self._rows, self._made | values)

    def at(self, places: Ints) -> pd.DataFrame:
        """Some rows, by their places, with all columns.

        Raises:
            IndexError: The places do not ascend, as rows are read in the order of the file.
        """
        if (np.diff(places) <= 0).any():
            raise IndexError("the places of rows must ascend")
        mask = np.zeros(len(self), dtype=np.bool_)
        mask[places] = True
        return self._where(mask)[list(self.columns)]

    def parts(self, names: Sequence[str]) -> Iterator[pd.DataFrame]:
        """Yields some columns of the file, some rows after the others: whole columns of a long run fill memory.

        Raises:
            KeyError: There is no such column.
        """
        if absent := [name for name in names if name not in self.columns or name in self._made]:
            raise KeyError(absent[0])
        for part in self._file.parts(list(names), self._rows):
            yield part.to_pandas(split_blocks=True, self_destruct=True)

    def _read(self, names: list[str], rows: Bools | None) -> pd.DataFrame:
        if absent := [name for name in names if name not in self.columns]:
            raise KeyError(absent[0])
        found = self._file.read([name for name in names if name not in self._made] or [self._file.names[0]], rows)
        for name in names:
            if name in self._made:
                found[name] = self._made[name]
        return found[names]


class _LastColumns:
    """The columns of all files that were asked for last."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[int, str], pd.Series[Any]] = OrderedDict()

    def get(self, file: int, name: str) -> pd.Series[Any] | None:
        """A column, if it is kept; files have numbers."""
        if (file, name) in self._kept:
            self._kept.move_to_end((file, name))
        return self._kept.get((file, name))

    def keep(self, file: int, name: str, column: pd.Series[Any]) -> None:
        """Keeps a column, and fewer of those that were asked for before."""
        self._kept[file, name] = column
        while len(self._kept) > 1 and sum(column.nbytes for column in self._kept.values()) > _KEPT_BYTES:
            self._kept.popitem(last=False)

    def forget(self, file: int) -> None:
        """Removes the columns of a file."""
        for key in [key for key in self._kept if key[0] == file]:
            del self._kept[key]


_LAST = _LastColumns()


#: What tells a file from another one at the same place: its path, inode, size [bytes] and time of change [ns].
_Identity = tuple[Path, int, int, int]


@lru_cache(maxsize=1)
def _description(identity: _Identity) -> pq.FileMetaData:
    """Reads what a file says of its groups of rows. Only the last is kept, as those of an hour's tables take 130 MB."""
    return pq.read_metadata(identity[0])


class _File:
    """A parquet file."""

    _open: ClassVar[weakref.WeakValueDictionary[_Identity, _File]] = weakref.WeakValueDictionary()

    @classmethod
    def of(cls, path: Path) -> _File:
        """The file; tables opened apart share it, and with it the columns that were read."""
        about = path.stat()
        identity = path, about.st_ino, about.st_size, about.st_mtime_ns
        found = cls._open.get(identity)
        if found is None:
            found = cls._open[identity] = cls(identity)
        return found

    def __init__(self, identity: _Identity) -> None:
        self._identity = identity
        weakref.finalize(self, _LAST.forget, id(self))
        about = _description(identity)
        self.names = tuple(about.schema.to_arrow_schema().names)
        self.length = int(about.num_rows)
        counts = [about.row_group(i).num_rows for i in range(about.num_row_groups)]
        self._starts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])

    def _opened(self) -> pq.ParquetFile:
        return pq.ParquetFile(self._identity[0], metadata=_description(self._identity))

    def read(self, names: list[str], rows: Bools | None) -> pd.DataFrame:
        """Some columns, of all rows or of those (n,) that are True."""
        if len(names) == 1 or rows is None:
            return pd.DataFrame({name: self.column(name, rows) for name in names})
        return pa.concat_tables(list(self.parts(names, rows))).to_pandas(split_blocks=True, self_destruct=True)

    def column(self, name: str, rows: Bools | None) -> pd.Series[Any]:
        """A column, of all rows or of those (n,) that are True; kept where it may be asked for again."""
        if rows is None:
            return self._whole(name)
        if 2 * len(self._groups(rows)) > len(self._starts) - 1:
            return self._whole(name)[rows].reset_index(drop=True)
        found = pa.concat_tables(list(self.parts([name], rows)))
        return found.to_pandas(split_blocks=True, self_destruct=True)[name]

    def _groups(self, rows: Bools | None) -> list[int]:
        """The groups of rows that have some of these rows."""
        return [i for i, (a, b) in enumerate(pairwise(self._starts)) if rows is None or rows[a:b].any()]

    def parts(self, names: list[str], rows: Bools | None) -> Iterator[pa.Table]:
        """Yields some columns, of all rows or of those (n,) that are True, of few groups of rows at a time."""
        groups = self._groups(rows)
        with self._opened() as file:
            if not groups:  # columns without rows
                yield file.schema_arrow.empty_table().select(names)
            for k in range(0, len(groups), _GROUPS):
                few = groups[k : k + _GROUPS]
                table = file.read_row_groups(few, columns=names, use_threads=False)
                if rows is not None:
                    kept = np.concatenate([rows[self._starts[i] : self._starts[i + 1]] for i in few])
                    table = table.filter(pa.array(kept))
                yield table

    def _whole(self, name: str) -> pd.Series[Any]:
        """A whole column, kept or read."""
        found = _LAST.get(id(self), name)
        if found is None:
            with self._opened() as file:
                table = file.read(columns=[name], use_threads=False)
            found = table.to_pandas(split_blocks=True, self_destruct=True)[name]
            found.to_numpy().flags.writeable = False  # whoever asks next gets the same numbers
            _LAST.keep(id(self), name, found)
            if found.nbytes > _LONG_BYTES:
                release_freed_memory()
        return found


class _Places:
    """Rows of a table by their places, as ``DataFrame.iloc``."""

    def __init__(self, table: StoredTable) -> None:
        self._table = table

    @overload
    def __getitem__(self, key: int | np.integer[Any]) -> pd.Series[Any]: ...
    @overload
    def __getitem__(self, key: slice | Ints) -> pd.DataFrame: ...
    def __getitem__(self, key: int | np.integer[Any] | slice | Ints) -> Any:
        places = np.arange(len(self._table))[key]
        if isinstance(key, slice) or np.ndim(key):
            return self._table.at(np.asarray(places))
        return self._table.at(np.array([places])).iloc[0]


#: A table of a run: in its folder, or in memory.
RunTable = pd.DataFrame | StoredTable


def in_parts(table: RunTable, names: Sequence[str]) -> Iterator[pd.DataFrame]:
    """Yields some columns of a table, some rows after the others, in order; a table in memory as it is.

    Raises:
        KeyError: There is no such column.
    """
    if isinstance(table, StoredTable):
        yield from table.parts(names)
    else:
        yield table[list(names)]


def rows_where(table: RunTable, name: str, text: str) -> RunTable:
    """Returns the rows of a table with a text in a column, which is read in parts.

    Raises:
        KeyError: There is no such column.
    """
    found = [(part[name] == text).to_numpy(dtype=np.bool_) for part in in_parts(table, [name])]
    return table[np.concatenate(found)]


def number_columns(table: RunTable, names: Sequence[str]) -> Floats:
    """Returns columns of numbers (n, len(names)); read one after the other, as in a table of their own they are twice.

    Raises:
        KeyError: There is no such column.
    """
    found = np.empty((len(table), len(names)), order="F")
    for k, name in enumerate(names):
        found[:, k] = table[name]
    return found


def text_column(table: RunTable, name: str) -> Anything:
    """Returns a column of texts (n,), "" where there is none; equal texts are one object, each is in memory once."""
    index, known = pd.factorize(table[name])
    return np.append(np.asarray(known, dtype=object), "")[index]
