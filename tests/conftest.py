from __future__ import annotations

from pathlib import Path

import pytest

from hrcreplay import replay, runs
from hrcreplay.runs import Run


@pytest.fixture(scope="session")
def demo_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report on the shipped log, every tick's volumes stored."""
    out = tmp_path_factory.mktemp("demo") / "run"
    return replay.run("report", replay.demo_log(), out=out, overrides=("occupancy.store_hz=all",))


@pytest.fixture(scope="session")
def demo(demo_folder: Path) -> Run:
    return runs.read(demo_folder)
