"""Reports without figures, which take longer than all else of a short one, for tests that look at none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

from hrcreplay.report import figures


def _draw_none(_run: object, folder: Path, *_: object, **__: object) -> tuple[str, ...]:
    folder.mkdir()
    return ()


@contextmanager
def undrawn() -> Iterator[None]:
    """Makes the folder of the figures, and leaves it empty."""
    with mock.patch.object(figures, "draw_all", _draw_none):
        yield
