"""Where the recordings by others are; tests on them are skipped, with the reason, where they are absent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(os.environ.get("HRCREPLAY_DATA") or Path(__file__).parents[1].parent / "shared" / "data")


def data_path(name: str) -> Path:
    """The recording of that name, or a skip."""
    path = ROOT / name
    if not path.exists():
        pytest.skip(
            f"recordings of others are not here: {path.name} is neither in $HRCREPLAY_DATA nor beside the project"
        )
    return path
