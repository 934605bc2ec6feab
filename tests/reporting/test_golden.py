"""The wording of page and terminal is frozen once, here: other tests look for numbers and names."""

from __future__ import annotations

import difflib

import pytest

from tests.reporting.reading import GOLDEN, golden_text


def test_the_page_and_the_terminal_read_as_accepted() -> None:
    kept, now = GOLDEN.read_text("utf-8").splitlines(), golden_text().splitlines()
    if kept != now:
        changed = "\n".join(difflib.unified_diff(kept, now, "accepted", "now", lineterm="", n=0))
        pytest.fail(f"{changed}\n\nAccept it with: python -m tests.tools.golden", pytrace=False)
