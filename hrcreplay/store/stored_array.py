"""Arrays of which rows are read when they are asked for, as all of a long run would fill the memory."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from hrcreplay.records import Floats, Ints


class Rows(Protocol):
    """An array, or what gives some of its rows when they are asked for."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Its shape; the first axis is that of the rows."""

    def __getitem__(self, rows: slice | Ints, /) -> Floats:
        """Some of the rows."""


@dataclass(frozen=True)
class SomeRows:
    """Some rows of an array as an array of their own."""

    every: Rows
    mine: Ints  #: (n,) the rows

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of these rows, and shape of a row."""
        return len(self.mine), *self.every.shape[1:]

    def __getitem__(self, rows: slice | Ints) -> Floats:
        return self.every[self.mine[rows]]


class StoredArray:
    """An array (n, ...) of numbers in a file of its own; ``array[rows]`` is a copy, as of an array with rows by number.

    It can be sent to another process, which reads the same file.
    """

    def __init__(self, folder: Path, row: tuple[int, ...]) -> None:
        """Starts without rows.

        Args:
            folder: Folder of the file, which is new; who made the folder removes it.
            row: Shape of a row.
        """
        handle, name = tempfile.mkstemp(suffix=".array", dir=folder)
        os.close(handle)
        self._path, self._row, self._count = Path(name), row, 0

    def __len__(self) -> int:
        return self._count

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of rows, and shape of a row."""
        return self._count, *self._row

    def append(self, rows: Floats) -> None:
        """Adds rows.

        Raises:
            ValueError: They have another shape.
        """
        if rows.shape[1:] != self._row:
            raise ValueError(f"rows of shape {rows.shape[1:]}; would be right: {self._row}")
        with self._path.open("ab") as file:
            file.write(np.ascontiguousarray(rows, dtype=np.float64).data)
        self._count += len(rows)

    def __getitem__(self, rows: slice | Ints) -> Floats:
        if not self._count:
            return np.empty(self.shape)[rows]
        return np.array(np.memmap(self._path, np.float64, "r", shape=self.shape)[rows])
