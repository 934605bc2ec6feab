"""Runs that several tests share, and how two processes share the tests (``make test`` runs them by pytest-xdist).

Nothing of hrcreplay with compiled kernels is imported before ``pytest_configure`` has said where these are kept.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import hrcreplay

if TYPE_CHECKING:
    from hrcreplay.store.run_folder import Run

#: Whole runs of the demo that more than one file looks at: their tests stay in one process, which makes them once.
SHARED = ("demo_folder", "printed")
#: Files whose sessions run in real time, in several processes each: never two of these files at once.
SESSIONS = ("test_killed.py", "test_session.py", "test_zenoh_session.py")


def pytest_configure(config: pytest.Config) -> None:
    """Gives every process but the first compiled kernels of its own, as numba does not lock its files."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0")
    if worker != "gw0":
        os.environ["NUMBA_CACHE_DIR"] = str(_kernels_of(worker))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config, specs: list[Any]) -> None:
    """Lets the other processes begin with the kernels of the first, before any of them runs."""
    for spec in specs:
        folder = _kernels_of(spec.id)
        if spec.id != "gw0" and folder.parent.exists() and not folder.exists():
            shutil.copytree(folder.parent, folder, ignore=shutil.ignore_patterns("gw*"))


def _kernels_of(worker: str) -> Path:
    """Folder of the compiled kernels of a process; hrcreplay itself names that of the first."""
    assert hrcreplay.__version__
    return Path(os.environ["NUMBA_CACHE_DIR"]) / worker


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Names the group of each test, of which one process runs all: those of a shared run, of the sessions, of a file.

    A process takes the next group as soon as it has run its last, so the long groups come first.
    """
    order = {name: number for number, name in enumerate(("sessions", *SHARED))}
    groups = [_group(item) for item in items]
    for item, group in zip(items, groups, strict=True):
        item.add_marker(pytest.mark.xdist_group(group))
    if "PYTEST_XDIST_WORKER" in os.environ:
        places = sorted(range(len(items)), key=lambda i: order.get(groups[i], len(order)))
        items[:] = [items[i] for i in places]


def _group(item: pytest.Item) -> str:
    if item.path.name in SESSIONS:
        return "sessions"
    used = getattr(item, "fixturenames", ())
    return next((name for name in SHARED if name in used), str(item.path.relative_to(item.config.rootpath)))


@pytest.fixture(scope="session")
def demo_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report on the shipped log, every tick's volumes stored."""
    from hrcreplay.run import replay

    out = tmp_path_factory.mktemp("demo") / "run"
    return replay.run("report", replay.demo_log(), out=out, overrides=("occupancy.store_hz=all",))


@pytest.fixture(scope="session")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The plan on the shipped log by the paper's own prediction, with which the robot meets the person at speed."""
    from hrcreplay.run import replay
    from hrcreplay.store import run_folder

    overrides = ("occupancy.store_hz=all", "occupancy.method=paper", "limits.prediction=paper")
    return run_folder.read(
        replay.run("plan", replay.demo_log(), out=tmp_path_factory.mktemp("printed") / "run", overrides=overrides)
    )


@pytest.fixture(scope="session")
def demo(demo_folder: Path) -> Run:
    """The same report, read."""
    from hrcreplay.store import run_folder

    return run_folder.read(demo_folder)
