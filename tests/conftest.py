"""Runs that several tests share, and how two processes share the tests (``make test`` runs them by pytest-xdist)."""

from __future__ import annotations

import gc
import math
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from hrcreplay.store.run_folder import Run

#: Files of which one process runs all: sessions in real time, never two of these files at once, looks at whole runs of
#: the demo, which that process makes once, and samples of motions, whose kernels it compiles once. These groups and the
#: recordings take longest and come first, so that no process has a long one left when the others are done.
GROUPS = {
    "sessions": ("tests/live/test_killed.py", "tests/live/test_session.py", "tests/live/test_zenoh_session.py"),
    "demo": (
        "tests/commands/test_replay.py",
        "tests/tools/readme/test_readme.py",
        "tests/commands/test_explain.py",
        "tests/pipeline/test_speed_limit.py",
    ),
    "soundness": ("tests/tools/soundness/test_motion.py", "tests/tools/soundness/test_soundness.py"),
    "recordings": ("tests/test_recordings.py",),
}
#: Files and folders of the quick tests (``make check``): those that need no whole run and compile little.
QUICK = (
    *("tests/test_docs.py", "tests/test_docstrings.py", "tests/test_import_law.py", "tests/test_paper.py"),
    *("tests/settings", "tests/limits", "tests/store", "tests/egm", "tests/commands/test_templates.py"),
    *(f"tests/geometry/test_{name}.py" for name in ("hull_reduction", "polygon", "rotation", "visible_front")),
    *(f"tests/human/fusion/test_{name}.py" for name in ("body_points", "fuse", "gating", "inverse_kinematics")),
    *(
        f"tests/human/{name}.py"
        for name in ("test_model", "fusion/test_rts_smoother", "prediction/test_reachable_sets")
    ),
    *(f"tests/robot/control/test_{name}.py" for name in ("separation", "stopping", "stops", "tracking_cost", "border")),
    *(f"tests/robot/test_{name}.py" for name in ("model", "task", "track", "urdf")),
    *(f"tests/logs/test_{name}.py" for name in ("dirty", "importers", "info", "plausibility", "poses", "writer")),
    *(f"tests/reporting/test_{name}.py" for name in ("defect_notes", "golden", "limbs", "summary")),
)
WHOLE_RUNS = {"demo_folder", "demo_with_objects", "printed"}


def group_of(nodeid: str) -> str:
    """Name of the group of a test: one of ``GROUPS``, else its file."""
    file = nodeid.partition("::")[0]
    return next((name for name, files in GROUPS.items() if file in files), file)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds ``--quick``."""
    parser.addoption("--quick", action="store_true", help="only the quick tests, tests/conftest.py QUICK")


def pytest_configure() -> None:
    """Makes the tests alike on slow machines and in the background.

    Lines of progress, one for every 10 s of a command, would come between the lines that tests read. Sessions that
    tests start must hear Ctrl-C: a shell that runs pytest in the background ignores it for all.
    """
    from hrcreplay.pipeline import progress

    progress.EVERY_S = math.inf
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Compiles the kernels after a change of the sources, before the first test hears a command say so."""
    from hrcreplay.pipeline.kernel_build import ensure_compiled

    if "PYTEST_XDIST_WORKER" not in os.environ and not session.config.option.collectonly:
        ensure_compiled()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Hands whole groups to the processes, in the order of the tests.

    ``--dist loadgroup`` would do the same by marks, but pytest-xdist 3.8 does not see them with pytest 9.2.
    """
    from xdist.scheduler import LoadScopeScheduling

    class Scheduler(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(nodeid)

    config.option.loadscopereorder = False
    return Scheduler(config, log)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves out what is not quick, where asked; puts the long groups first where several processes share the tests."""
    if config.getoption("--quick"):
        items[:] = [item for item in items if item.nodeid.startswith(QUICK)]
    for item in items:
        if WHOLE_RUNS & set(getattr(item, "fixturenames", ())) and group_of(item.nodeid) != "demo":
            raise pytest.UsageError(f"{item.nodeid} looks at a whole run of the demo: name its file in GROUPS")
    if "PYTEST_XDIST_WORKER" in os.environ:
        order = {name: number for number, name in enumerate(GROUPS)}
        items.sort(key=lambda item: order.get(group_of(item.nodeid), len(order)))


def pytest_collection_finish(session: pytest.Session) -> None:
    """What has been imported stays: the collector need not look through it again and again."""
    gc.freeze()


@pytest.fixture(scope="session")
def demo_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report on the shipped log alone, as ``hrcreplay report`` makes it by default."""
    from hrcreplay.commands import replay

    out = tmp_path_factory.mktemp("demo") / "run"
    return replay.run("report", replay.demo_log(), out=out)


@pytest.fixture(scope="session")
def demo_with_objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report on the shipped log with the objects of its cell, as ``hrcreplay demo`` makes it."""
    from hrcreplay.commands import replay

    out = tmp_path_factory.mktemp("objects") / "run"
    return replay.run("report", replay.demo_log(), out=out, cell_file=replay.demo_cell())


@pytest.fixture(scope="session")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The plan on the shipped log by the paper's own prediction, with which the robot meets the person at speed."""
    from hrcreplay.commands import replay
    from hrcreplay.store import run_folder

    out = tmp_path_factory.mktemp("printed") / "run"
    return run_folder.read(replay.run("plan", replay.demo_log(), out=out, config=Path("paper"))).of_person(1)


@pytest.fixture(scope="session")
def demo(demo_folder: Path) -> Run:
    """The same report, read."""
    from hrcreplay.store import run_folder

    return run_folder.read(demo_folder).of_person(1)
