"""What a person at a terminal sees of a run; a pipe sees nothing."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


def say(text: str) -> None:
    """A line for the user beside the result, on standard error."""
    sys.stderr.write(f"hrcreplay: {text}\n")


class Bar:
    """A bar over the ticks of a run's last stage."""

    def __init__(self, stage: str, ticks: int) -> None:
        self._stage = stage
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:.0f} %"))
        self._bar = Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal)
        self._task: TaskID = self._bar.add_task(stage, total=ticks)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def advance(self, stage: str, ticks: int) -> None:
        """So many ticks of a stage are done."""
        if stage == self._stage:
            self._bar.advance(self._task, ticks)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
