"""One run of a sweep, as a worker of the cluster makes it."""

from __future__ import annotations

import io
import resource
import time
import traceback
from contextlib import redirect_stderr
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.parquet as pq

from hrcreplay.commands import replay
from hrcreplay.errors import HrcReplayError
from hrcreplay.pipeline.kernel_build import ensure_compiled
from hrcreplay.pipeline.run_config import RunConfig
from hrcreplay.reporting import comparison, sweep_report
from hrcreplay.store import run_folder
from hrcreplay.store.results import ResultsFolder, bring_log, digest
from hrcreplay.version import __version__

#: Folders of the results: the runs, their figures for the table, the people that runs share, and errors.
RUNS, ROWS, FUSED, FAILED = "runs", "rows", "fused", "failed"


@dataclass(frozen=True)
class SweepTask:
    """One log with one setting."""

    name: str  #: of the run, as ``walk/plan.method=qp``
    log: str  #: path or URL
    run_config: RunConfig  #: resolved but for its log
    fused: str | None  #: folder of the run that fused the person, in the results; None: this run fuses
    chunk_ticks: int = 250
    version: str = __version__  #: of the program that asks

    @property
    def folder(self) -> str:
        """Folder of the run in the results."""
        return self.name if self.run_config.command == "fuse" else f"{RUNS}/{self.name}"


@dataclass(frozen=True)
class RunOutcome:
    """The end of a task; ``error`` is empty for a run that is there."""

    name: str
    error: str = ""


def run_task(where: str, task: SweepTask, after: object = None) -> RunOutcome:
    """Makes a run and publishes its folder; a failure is returned and written down, so that other runs go on.

    Args:
        where: Folder of the results, path or URL.
        task: The run.
        after: Result of the task that fuses the person; only its end matters.
    """
    del after
    results = ResultsFolder(where)
    if task.version != __version__:
        return RunOutcome(task.name, f"its worker has hrcreplay {__version__}; would be right: {task.version}")
    if results.meta(task.folder) is not None:  # of a worker that was lost before it could answer
        return RunOutcome(task.name)
    try:
        ensure_compiled()
        with redirect_stderr(io.StringIO()), results.workplace() as scratch:
            folder, row = _make(results, task, scratch)
            if row is not None:  # first, so that every run that is there has its row
                results.write(f"{ROWS}/{task.name}.json", run_folder.to_json(row))
            results.publish(folder, task.folder)
    except HrcReplayError as error:
        return _failed(results, task, str(error), "")
    except Exception as error:
        return _failed(results, task, f"{type(error).__name__}: {error}", traceback.format_exc())
    return RunOutcome(task.name)


def _make(results: ResultsFolder, task: SweepTask, scratch: Path) -> tuple[Path, dict[str, Any] | None]:
    """Makes the run in ``scratch``; returns its folder and its row of the table, if it has a plan."""
    began_s = time.perf_counter()
    log = bring_log(task.log)
    earlier = None
    if task.fused is not None and results.meta(task.fused) is not None:
        earlier = results.bring(task.fused, scratch)
    run_config = replace(task.run_config, log=log, log_sha256=digest(log), earlier=earlier)
    folder = replay.execute(run_config, scratch / "run", chunk_ticks=task.chunk_ticks)
    if run_config.command == "fuse":
        return folder, None
    ticks = pq.read_metadata(folder / "motion.parquet").num_rows
    cost = {
        "seconds": time.perf_counter() - began_s,
        "log_seconds": ticks / run_config.settings.fusion.rate_hz,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "bytes": sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()),
    }
    return folder, {"figures": figures_of(folder, run_config), "cost": cost}


def figures_of(folder: Path, run_config: RunConfig) -> dict[str, Any]:
    """Computes the figures of a run's own method, as in a comparison of methods.

    Args:
        folder: Folder of a run with a plan.
        run_config: The run.
    """
    settings = run_config.settings
    variant = comparison.Variant(settings.plan.method, settings.prediction.method, settings.plan.horizon)
    report = settings.report
    bounds = comparison.Bounds(report.near_m, report.stationary_m_per_s, settings.plan.max_reference_lead_m)
    motion = pq.read_table(folder / "motion.parquet").to_pandas()
    contact, meetings = (_rows_of(folder / f"{name}.parquet", variant.method) for name in ("contact", "severity"))
    return sweep_report.figures(variant, motion, contact, meetings, bounds)


def _rows_of(path: Path, method: str) -> pd.DataFrame | None:
    """Returns the rows of a method in a table; None without the table."""
    return pq.read_table(path, filters=[("method", "=", method)]).to_pandas() if path.exists() else None


def _failed(results: ResultsFolder, task: SweepTask, error: str, trace: str) -> RunOutcome:
    """Writes down why a run failed."""
    results.write(f"{FAILED}/{task.name}.txt", f"{error}\n{trace}")
    return RunOutcome(task.name, error)
