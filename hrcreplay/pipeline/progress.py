"""Messages of a command on standard error, and its progress: a bar on a terminal, otherwise a line every 10 s."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import Protocol, Self

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

from hrcreplay import kernels

#: Time between two lines where no terminal shows a bar [s].
EVERY_S = 10.0
_LOOK_S = 0.5  # time between two looks at kernels under way
_FEW = 1000  # a part of at most as many pieces is told as "12 of 60", a larger one in percent


def print_note(text: str) -> None:
    """Prints a line for the user on standard error, separate from the result on standard output."""
    sys.stderr.write(f"hrcreplay: {text}\n")


class Progress(Protocol):
    """Receives the progress of a command."""

    def begin(self, part: str, total: int = 0, /) -> None:
        """Goes on to the next part of the work, of ``total`` pieces; 0: of unknown size."""

    def advance(self, part: str, count: int = 1, /) -> None:
        """Adds pieces to what is done of a part; ignored while another part is under way."""


class NoProgress:
    """Ignores progress."""

    def begin(self, part: str, total: int = 0, /) -> None:
        """Ignores it."""

    def advance(self, part: str, count: int = 1, /) -> None:
        """Ignores it."""


NO_PROGRESS = NoProgress()


class ProgressBar:
    """The progress of a command, part by part: a bar on a terminal, otherwise a line every few seconds.

    A thread of its own shows it, so a part that takes long is not silent.
    """

    def __init__(self, part: str, total: int = 0, *, every_s: float | None = None) -> None:
        """Prepares the bar.

        Args:
            part: First part of the work.
            total: Its number of pieces, as ``advance`` counts them; 0: unknown.
            every_s: Time between two lines where no terminal shows a bar [s]; None: ``EVERY_S``.
        """
        console = Console(stderr=True)
        columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        self._lines, self._every_s = not console.is_terminal, EVERY_S if every_s is None else every_s
        self._bar = RichProgress(
            *columns, TimeRemainingColumn(), console=console, disable=self._lines, transient=True, refresh_per_second=4
        )
        self._task: TaskID = self._bar.add_task("")
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._show, daemon=True)
        self.begin(part, total)

    def __enter__(self) -> Self:
        self._bar.start()
        self._thread.start()
        return self

    def begin(self, part: str, total: int = 0, /) -> None:
        """Goes on to the next part of the work."""
        self._part, self._total, self._done = part, total, 0
        self._bar.reset(self._task, total=total or None, description=self._text())

    @property
    def part(self) -> str:
        """The part of the work under way."""
        return self._part

    def advance(self, part: str, count: int = 1, /) -> None:
        """Adds pieces to what is done of the part under way."""
        if part == self._part:
            self._done += count
            self._bar.update(self._task, completed=self._done)

    def _text(self) -> str:
        """Describes the state: "plan: 45 %", "figures: 3 of 12"."""
        compiling = kernels.under_way()
        part = f"{self._part} (compiling {compiling}, once)" if compiling else self._part
        if not self._total:
            return part
        done = f"{self._done} of {self._total}" if self._total <= _FEW else f"{100 * self._done / self._total:.0f} %"
        return f"{part}: {done}"

    def _show(self) -> None:
        """Updates the description, and writes the lines where there is no bar."""
        began_s = told_s = time.monotonic()
        while not self._ended.wait(_LOOK_S):
            self._bar.update(self._task, description=self._text())
            now_s = time.monotonic()
            if self._lines and now_s - told_s >= self._every_s:
                told_s = now_s
                print_note(f"{self._text()}, {now_s - began_s:.0f} s")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        self._bar.stop()
