from __future__ import annotations

from pathlib import Path

import pytest

from hrcreplay.run import replay
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import Run


@pytest.fixture(scope="session")
def demo_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report on the shipped log, every tick's volumes stored."""
    out = tmp_path_factory.mktemp("demo") / "run"
    return replay.run("report", replay.demo_log(), out=out, overrides=("occupancy.store_hz=all",))


@pytest.fixture(scope="session")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The plan on the shipped log by the paper's own prediction, with which the robot meets the person at speed."""
    overrides = ("occupancy.store_hz=all", "occupancy.method=paper", "limits.prediction=paper")
    return run_folder.read(
        replay.run("plan", replay.demo_log(), out=tmp_path_factory.mktemp("printed") / "run", overrides=overrides)
    )


@pytest.fixture(scope="session")
def demo(demo_folder: Path) -> Run:
    return run_folder.read(demo_folder)
