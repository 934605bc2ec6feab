"""Reports without figures, which take longer than all else of a short one, for tests that look at none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

from hrcreplay.reporting.figures import catalogue


@contextmanager
def undrawn() -> Iterator[None]:
    """Makes the folder of the figures, and leaves it empty."""
    with mock.patch.object(catalogue, "select_figures", return_value=()):
        yield
