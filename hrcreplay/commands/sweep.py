"""The command ``sweep``: every log with every setting, each an ordinary run, on the workers of a Dask cluster.

A run appears in the results when it is whole. So a worker that is killed, or a sweep that is interrupted, loses nothing
that was finished, and the same command runs what is missing. Runs on one log whose settings do not touch the fusion
share the fused person.
"""

from __future__ import annotations

import fcntl
import hashlib
import itertools
import json
import logging
import os
import re
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Unpack

import numpy as np

from hrcreplay.calibration.cell import Cell, load_cell, pose_from_position
from hrcreplay.commands.inputs import parse_numbers
from hrcreplay.commands.replay import REPORTS
from hrcreplay.commands.sweep_worker import FUSED, ROWS, RunOutcome, SweepTask, run_task
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.pipeline import reuse
from hrcreplay.pipeline.kernel_build import ensure_compiled
from hrcreplay.pipeline.planner import METHOD_COST
from hrcreplay.pipeline.progress import ProgressBar, print_note
from hrcreplay.pipeline.run_config import RunConfig, RunOptions, resolve_without_log
from hrcreplay.reporting import sweep_report
from hrcreplay.reporting.sweep_report import SweepRow
from hrcreplay.settings.load import load_settings
from hrcreplay.store import run_folder
from hrcreplay.store.results import WORK, ResultsFolder, is_url
from hrcreplay.version import __version__

COMMANDS = ("report", "plan")
_ANSWER_S = 15  # time for a scheduler to answer
_LONGEST = 120  # characters of the name of a folder
#: Settings of a cluster on this computer: nobody looks at what Dask measures beside the runs, and it takes their time.
_UNWATCHED = {"distributed.worker.profile.enabled": False, "distributed.admin.tick.interval": "1s"}


@dataclass(frozen=True)
class SweepSetting:
    """One combination of the grid."""

    values: Mapping[str, str]  #: setting or ``base`` -> value
    run_config: RunConfig  #: resolved but for its log

    @property
    def name(self) -> str:
        """Name of the folders of its runs; a long one ends in a digest."""
        text = re.sub(r"[^\w.=,+-]", "_", ",".join(f"{key}={value}" for key, value in self.values.items())) or "as-is"
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 11]}-{_digest(text)}"


@dataclass(frozen=True)
class SweepResult:
    """Result of a sweep."""

    where: str  #: folder of the results, path or URL
    failed: Mapping[str, str]  #: run -> error


def run(
    logs: Sequence[str],
    *,
    grid: Sequence[str] = (),
    bases: Sequence[str] = (),
    command: str = "report",
    out: str | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    chunk_ticks: int = 250,
    **options: Unpack[RunOptions],
) -> SweepResult:
    """Runs every log with every setting of a grid, and writes a table, a picture and a page over all.

    Args:
        logs: Paths or URLs.
        grid: ``section.key=a,b,c`` each.
        bases: ``X,Y,Z,YAW`` of the robot base each [m, m, m, deg]; none: as in the cell file or the log.
        command: ``report`` or ``plan``.
        out: Folder of the results, path or URL; None: ``reports/sweep-<digest of the arguments>``.
        scheduler: Address of a Dask scheduler; None: workers on this computer.
        workers: Number of workers on this computer; None: one a processor.
        chunk_ticks: Ticks of a batch; changes no result.
        **options: Settings, cell and span of all runs, as ``run_config.resolve`` takes them.

    Raises:
        SettingsError: A setting, the cell, the cluster or the folder of the results cannot be used.
        LogError: A log is missing.
    """
    if command not in COMMANDS:
        raise SettingsError(f"--command {command}: no command of a sweep; would be right: {' or '.join(COMMANDS)}")
    settings = combine(command, grid, bases, **options)
    if missing := [log for log in logs if not is_url(log) and not Path(log).exists()]:
        raise LogError(f"{missing[0]}: nothing is there; give a log")
    places = [_absolute(log) for log in logs]
    results = ResultsFolder(_absolute(out or str(REPORTS / f"sweep-{_identity(places, settings)}")))
    tasks = make_tasks(places, settings, chunk_ticks)
    with _only_one(results):
        todo = [task for task in tasks if not _is_there(results, task)]
        if len(todo) < len(tasks):
            print_note(f"sweep: {len(tasks) - len(todo)} of {len(tasks)} runs are in {results.where} already")
        failed = _run_all(results, todo, scheduler, workers) if todo else {}
        rows = [_row(results, task, number % len(settings), failed.get(task.name)) for number, task in enumerate(tasks)]
        sweep_report.write(results, rows, [setting.values for setting in settings])
        if costs := sweep_report.cost_text(rows):
            print_note(f"sweep: {costs}")
    return SweepResult(results.where, failed)


def combine(
    command: str,
    grid: Sequence[str],
    bases: Sequence[str],
    *,
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    cell_file: Path | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
) -> list[SweepSetting]:
    """Returns all combinations of a grid, checked; the last key changes first.

    Args:
        command: Command of the runs.
        grid: ``section.key=a,b,c`` each.
        bases: ``X,Y,Z,YAW`` each [m, m, m, deg].
        config: Settings file; may be None.
        overrides: ``section.key=value`` for all runs.
        cell_file: Poses of cameras and robot; may be None.
        start_s: Start of the span [s]; may be None.
        end_s: End of the span [s]; may be None.

    Raises:
        SettingsError: A key, a value, a base or the cell cannot be used.
    """
    axes = [_axis(text) for text in grid]
    if twice := [key for key, count in Counter(key for key, _ in axes).items() if count > 1]:
        raise SettingsError(f"--grid {twice[0]}: given twice; would be right: all its values in one --grid")
    poses = {text: parse_numbers("--base", text, 4) for text in bases}
    cell = None if cell_file is None else load_cell(cell_file)
    found = []
    for values in itertools.product(*(values for _, values in axes)):
        chosen = {key: value for (key, _), value in zip(axes, values, strict=True)}
        settings = load_settings(config, (*overrides, *(f"{key}={value}" for key, value in chosen.items())))
        run_config = resolve_without_log(command, Path("sweep"), settings, None)
        run_config = replace(run_config, start_s=start_s, end_s=end_s, cell=cell)
        found += [SweepSetting(chosen, run_config)] if not poses else []
        for text, (*position, yaw_deg) in poses.items():
            T_world_base = pose_from_position(np.array(position), float(np.radians(yaw_deg)))
            placed = replace(cell or Cell(), T_world_base=T_world_base)
            found.append(SweepSetting(chosen | {"base": text}, replace(run_config, cell=placed)))
    return found


def _axis(text: str) -> tuple[str, list[str]]:
    """Parses ``section.key=a,b,c``; a comma inside brackets or quotes divides no values."""
    key, equals, values = text.partition("=")
    parts = re.findall(r"""(?:[^,\[{"']|\[[^\]]*\]|\{[^}]*\}|"[^"]*"|'[^']*')+""", values)
    if not equals or key.count(".") != 1 or not parts:
        raise SettingsError(f"--grid {text}: not of the form section.key=a,b,c; e.g. --grid plan.method=qp,scaling")
    return key.strip(), list(dict.fromkeys(part.strip() for part in parts))


def make_tasks(logs: Sequence[str], settings: Sequence[SweepSetting], chunk_ticks: int) -> list[SweepTask]:
    """Returns one task per log and setting, log by log.

    Args:
        logs: Paths or URLs.
        settings: Result of ``combine``.
        chunk_ticks: Ticks of a batch.
    """
    stems = [PurePosixPath(log.rstrip("/")).stem for log in logs]
    names = [stem if stems.count(stem) == 1 else f"{stem}-{stems[:i].count(stem) + 1}" for i, stem in enumerate(stems)]
    return [
        SweepTask(f"{name}/{setting.name}", log, setting.run_config, None, chunk_ticks, __version__)
        for name, log in zip(names, logs, strict=True)
        for setting in settings
    ]


def _absolute(place: str) -> str:
    return place if is_url(place) else str(Path(place).absolute())


def _identity(logs: Sequence[str], settings: Sequence[SweepSetting]) -> str:
    """Digest of a sweep's logs and settings, so that the same command finds its results again."""
    return _digest(json.dumps([[*logs], [_record(setting.run_config) for setting in settings]], sort_keys=True))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def _record(run_config: RunConfig) -> dict[str, Any]:
    """The entries of run.json that tell one setting from another, as JSON has them."""
    record = {
        "command": run_config.command,
        "settings": run_config.settings.model_dump(mode="json"),
        "cell": None if run_config.cell is None else run_config.cell.to_dict(),
        "task": run_config.task,
        "span_s": [run_config.start_s, run_config.end_s],
        "limits": {"tracking": run_config.tracking_limits.plain(), "prediction": run_config.prediction_limits.plain()},
    }
    return dict(json.loads(json.dumps(record)))


@contextmanager
def _only_one(results: ResultsFolder) -> Iterator[None]:
    """Locks local results, so that two sweeps do not write the same runs; removes what killed workers left."""
    path = results.path
    if path is None:
        yield
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
        file = (path / ".lock").open("w")
    except OSError as error:
        raise SettingsError(f"{path}: cannot be made ({error.strerror}); name another --out") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise SettingsError(
                f"{path}: another sweep is writing there; wait for it, or name another --out"
            ) from error
        shutil.rmtree(path / WORK, ignore_errors=True)
        try:
            yield
        finally:
            shutil.rmtree(path / WORK, ignore_errors=True)


def _is_there(results: ResultsFolder, task: SweepTask) -> bool:
    """Returns True if the run of a task is complete in the results.

    Raises:
        SettingsError: The run there has other settings or another log, or another version made it.
    """
    meta = results.meta(task.folder)
    if meta is None:
        return False
    where = f"{results.where}/{task.folder}"
    mine = _record(task.run_config)
    if different := [key for key, value in mine.items() if meta.get(key) != value]:
        raise SettingsError(f"{where}: its {different[0]} is not that of this sweep; name another --out, or remove it")
    if meta["versions"]["hrcreplay"] != __version__:
        raise SettingsError(
            f"{where}: made by hrcreplay {meta['versions']['hrcreplay']}, this is {__version__}; name another --out"
        )
    log, made = Path(task.log), None if results.path is None else results.path / task.folder / "run.json"
    changed = made is not None and not is_url(task.log) and log.exists() and log.stat().st_mtime > made.stat().st_mtime
    if changed and run_folder.sha256(log) != meta["inputs"][0]["sha256"]:
        raise SettingsError(f"{where}: made from another {log.name}; name another --out, or remove it")
    return True


def _share_fusion(tasks: Sequence[SweepTask]) -> tuple[list[SweepTask], list[SweepTask]]:
    """Returns the tasks that fuse people for several runs, and all runs, with the names of the fused people."""
    keys = [f"{task.name.partition('/')[0]}/{reuse.person_digest(task.run_config)[:16]}" for task in tasks]
    count, found = Counter(keys), []
    fusing: dict[str, SweepTask] = {}
    for key, task in zip(keys, tasks, strict=True):
        if count[key] < 2:
            found.append(task)
            continue
        name = f"{FUSED}/{key}"
        found.append(replace(task, fused=name))
        fusing.setdefault(name, replace(task, name=name, run_config=replace(task.run_config, command="fuse")))
    return list(fusing.values()), found


def in_order(runs: Sequence[SweepTask]) -> list[SweepTask]:
    """Runs log by log, so that fused people are soon of no use, the long ones first, so that workers end together."""
    logs = list(dict.fromkeys(task.log for task in runs))
    return sorted(runs, key=lambda task: (logs.index(task.log), -METHOD_COST[task.run_config.settings.plan.method]))


def _run_all(
    results: ResultsFolder, tasks: Sequence[SweepTask], scheduler: str | None, workers: int | None
) -> dict[str, str]:
    """Runs all tasks; returns the errors of those that failed."""
    if scheduler is None:
        ensure_compiled()
    fusing, runs = _share_fusion(tasks)
    sharing: dict[str, set[str]] = defaultdict(set)
    failed: dict[str, str] = {}
    with _cluster(scheduler, workers) as client, ProgressBar(f"sweep into {results.where}", len(runs)) as bar:
        from distributed import as_completed

        shared = {one.name: client.submit(run_task, results.where, one, key=_key(results, one)) for one in fusing}
        futures = {}
        for task in in_order(runs):
            after = None if task.fused is None else shared[task.fused]
            futures[client.submit(run_task, results.where, task, after, key=_key(results, task))] = task
            sharing[task.fused or ""].add(task.name)
        try:
            for future in as_completed(list(futures)):
                task = futures[future]
                if outcome := _error_of(future):
                    failed[task.name] = outcome
                    print_note(f"sweep: {task.name} failed: {outcome}")
                bar.advance(bar.part)
                sharing[task.fused or ""].discard(task.name)
                if task.fused is not None and not sharing[task.fused]:
                    results.remove(task.fused)
        except KeyboardInterrupt:
            client.cancel([*futures, *shared.values()], force=True)
            print_note(
                f"sweep: interrupted; what is finished is in {results.where}, and the same command does the rest"
            )
            raise
    return failed


def _key(results: ResultsFolder, task: SweepTask) -> str:
    """Name of a task on the cluster; another call of the sweep makes another one."""
    return f"{task.name}-{os.getpid()}-{_digest(results.where)}"


def _error_of(future: Any) -> str:
    """Returns the error of a finished task; empty if it succeeded."""
    if future.status == "finished":
        outcome: RunOutcome = future.result()
        return outcome.error
    error = future.exception() if future.status == "error" else None
    return f"its worker died again and again, or could not answer ({type(error).__name__}: {error})"


@contextmanager
def _cluster(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """Connects to a scheduler, or starts workers on this computer.

    Raises:
        SettingsError: dask.distributed is not installed, or nothing answers at the address.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise SettingsError(
            "sweep: needs dask.distributed, which is not installed; install hrcreplay with the extra: "
            'pip install "hrcreplay[sweep]"'
        ) from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # a dead worker is no error of the sweep
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_ANSWER_S)
        except (OSError, ValueError) as error:
            raise SettingsError(
                f"--scheduler {scheduler}: no Dask scheduler answers there ({error}); would be right: its address, as "
                "tcp://host:8786"
            ) from error
        with client:
            yield client
        return
    count = workers or os.cpu_count() or 1
    how = {"threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.CRITICAL}
    with dask.config.set(_UNWATCHED), LocalCluster(n_workers=count, **how) as cluster, Client(cluster) as client:
        yield client


def _row(results: ResultsFolder, task: SweepTask, setting: int, error: str | None) -> SweepRow:
    """Returns the row of a run, with its figures if it is there."""
    text = None if error else results.read(f"{ROWS}/{task.name}.json")
    found = json.loads(text) if text else {}
    return SweepRow(
        log=task.name.partition("/")[0],
        setting=setting,
        folder=task.folder,
        figures=found.get("figures"),
        cost=found.get("cost"),
        error=error or "",
    )
