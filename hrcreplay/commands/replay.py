"""The offline driver: runs the stages of a command on a log and writes the run folder.

Stages of an earlier run are reused if the digests of their inputs are unchanged.
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from contextlib import ExitStack
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any, Unpack

import pyarrow.parquet as pq

from hrcreplay.commands.notes import notes_of
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.pipeline import assembly, reuse, stages
from hrcreplay.pipeline.kernel_build import ensure_compiled
from hrcreplay.pipeline.methods_elsewhere import MethodsElsewhere, get_loaded
from hrcreplay.pipeline.progress import NO_PROGRESS, Progress, ProgressBar, print_note
from hrcreplay.pipeline.robot_mass import robot_mass
from hrcreplay.pipeline.run_config import RunConfig, RunOptions, resolve
from hrcreplay.pipeline.second_process import MANY, second_process
from hrcreplay.pipeline.seen_bodies import SeenBodies
from hrcreplay.pipeline.stages import Sink, Told, collect_fusion_findings, collect_plan_findings
from hrcreplay.pipeline.stored_volumes import store_every
from hrcreplay.records import RECORDED, HumanStates, Ints
from hrcreplay.reporting import tables
from hrcreplay.reporting.summary_text import defect_notes
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from hrcreplay.store.memory import release_after, release_freed_memory
from hrcreplay.store.run_folder import RunWriter, Stopwatch

REPORTS = Path("reports")


def run(
    command: str,
    source: Path,
    *,
    out: Path | None = None,
    smooth: bool = False,
    chunk_ticks: int = 250,
    **options: Unpack[RunOptions],
) -> Path:
    """Runs the stages up to that of ``command`` on a log or an earlier run.

    Args:
        command: ``fuse``, ``predict``, ``plan`` or ``report``.
        source: A log, or the run folder of an earlier command.
        out: Run folder to make; None: ``reports/<log>/<UTC>-<command>``.
        smooth: True: also write the smoothed person (smooth.parquet).
        chunk_ticks: Ticks of a batch; changes no result.
        **options: Settings, cell and span, as ``run_config.resolve`` takes them.

    Returns:
        The run folder.

    Raises:
        SettingsError: A setting, the cell, the task or the output folder cannot be used.
        LogError: The log cannot be read, or lacks what a stage needs.
    """
    began = datetime.now(UTC)
    run_config = resolve(command, source, **options)
    folder, processes = out or _folder(run_config, began), min(2, os.cpu_count() or 1)
    return execute(run_config, folder, smooth=smooth, chunk_ticks=chunk_ticks, processes=processes)


def execute(
    run_config: RunConfig, folder: Path, *, smooth: bool = False, chunk_ticks: int = 250, processes: int = 1
) -> Path:
    """Runs the stages of a resolved run and writes its folder.

    Args:
        run_config: The run.
        folder: Run folder to make.
        smooth: True: also write the smoothed person (smooth.parquet).
        chunk_ticks: Ticks of a batch; changes no result.
        processes: 2: a second process shares the work of a long run; changes no result.

    Returns:
        The run folder.

    Raises:
        SettingsError: The cell, the task or the output folder cannot be used.
        LogError: The log cannot be read, or lacks what a stage needs.
    """
    began, known = datetime.now(UTC), run_config.meta()
    ensure_compiled()
    with ExitStack() as held:
        writer = held.enter_context(RunWriter(folder))
        bar = held.enter_context(ProgressBar(f"reading {run_config.log.name}"))
        log = open_log(run_config.log, run_config.settings.logs)
        ticks_ns = stages.span_ticks(run_config, log)
        two = processes > 1 and len(ticks_ns) >= MANY and "plan" in run_config.stages
        second = held.enter_context(second_process()) if two else None
        if second is not None:
            second.submit(get_loaded)  # while this process prepares the work of both
        parts = reuse.dependencies(run_config, log, ticks_ns)
        reused = reuse.take_over(run_config, parts, writer, smooth=smooth)
        for stage in [stage for stage in run_config.stages if stage not in reused][-1:]:
            bar.begin(stage, len(ticks_ns))
        seen = SeenBodies(writer.partial) if run_config.command == "report" and "fuse" not in reused else None
        sink = Sink(writer, Stopwatch(time.perf_counter_ns), bar.advance, seen=seen)
        compared = run_config.command == "report" and not log.header.has_truth  # this then includes the smoothed person
        how: Any = {"folder": writer.partial, "smooth": smooth or compared, "second": second}
        told = run_stages(run_config, log, ticks_ns, chunk_ticks, sink, reused, **how)
        found = findings(run_config, told, reused)
        meta = {**known, **found, **describe_run(run_config, began, parts, smooth=smooth)}
        complete(run_config, log, writer, sink.watch, meta, bar, second, seen)
        return writer.folder


def describe_run(run_config: RunConfig, began: datetime, parts: Mapping[str, str], *, smooth: bool) -> dict[str, Any]:
    """Returns the entries of run.json on the origin of a run.

    Args:
        run_config: The run.
        began: Start time.
        parts: Result of ``dependencies``.
        smooth: True: the smoothed person was requested.
    """
    return {
        "arguments": run_config.arguments(smooth=smooth),
        "depends_on": parts,
        "stages": reuse.stage_digests(run_config, parts),
        "created": f"{began:%Y-%m-%dT%H:%M:%SZ}",
    }


def complete(
    run_config: RunConfig,
    log: Log,
    writer: RunWriter,
    watch: Stopwatch,
    meta: dict[str, Any],
    progress: Progress = NO_PROGRESS,
    second: Executor | None = None,
    seen: SeenBodies | None = None,
) -> None:
    """Completes a run whose stages have written their tables; also makes the report if requested.

    Args:
        run_config: The run.
        log: Log of the run.
        writer: Run folder.
        watch: Times of the stages; the times of the report are added.
        meta: Entries of run.json so far.
        progress: Receives the progress.
        second: A second process; None: no such process.
        seen: The bodies that stage 1 saw; None: it was not run, and the log is read again for them.
    """
    base = assembly.known_robot_base(run_config, log)
    if log.header.joint_topics or meta["counts"].get("joint_gaps_ms"):
        meta["programme"] = "task" if run_config.task or log.header.task else "recorded joints"
    writer.close_tables()
    release_freed_memory()
    meta |= _describe_results(run_config, log, writer.partial, meta, meta["notes"])
    for line in defect_notes(meta["counts"], meta["notes"]):
        print_note(line)
    meta["T_world_base"] = None if base is None else base.tolist()
    if run_config.command == "report":
        _report(run_config, log, writer, watch, meta, progress, second, seen)
    writer.timing.update(watch.summary(1.0 / run_config.settings.fusion.rate_hz))
    writer.finish(meta)


def _report(
    run_config: RunConfig,
    log: Log,
    writer: RunWriter,
    watch: Stopwatch,
    meta: dict[str, Any],
    progress: Progress,
    second: Executor | None,
    seen: SeenBodies | None,
) -> None:
    """Writes the contact table and the report of a run whose other tables are written."""
    from hrcreplay.commands.report import write_report
    from hrcreplay.evaluation.judging import (
        write_contact,  # both are slow to load, and the other commands need neither
    )

    ticks = pq.read_metadata(writer.partial / "state.parquet").num_rows
    progress.begin("contact")
    release_freed_memory()
    with watch.stage("contact", ticks):
        write_contact(run_config, log, writer, assembly.robot_base(run_config, log), second, seen)
    release_freed_memory()
    with watch.stage("report", ticks):
        write_report(run_config, writer, meta, log, progress, second)


def run_stages(
    run_config: RunConfig,
    log: Log,
    ticks_ns: Ints,
    size: int,
    sink: Sink,
    reused: tuple[str, ...],
    *,
    folder: Path,
    smooth: bool,
    second: Executor | None = None,
) -> dict[str, Told]:
    """Runs all stages in one pass, except those whose tables were reused.

    Args:
        run_config: The run.
        log: Log of the run.
        ticks_ns: (n,) ticks of the run, increasing [ns].
        size: Ticks of a batch.
        sink: Receives rows, counts and times.
        reused: Stages whose tables were copied from an earlier run.
        folder: Folder of those tables.
        smooth: True: also write the smoothed person.
        second: A second process, which moves the robot by the baselines and stores volumes; None: no such process.

    Returns:
        The findings of the stages that read the log.
    """
    todo, start_ns = [stage for stage in run_config.stages if stage not in reused], int(ticks_ns[0])
    states: Iterable[HumanStates]
    elsewhere: MethodsElsewhere | None = None
    if "fuse" in todo:
        stages.write_truth(log, start_ns, int(ticks_ns[-1]), sink)
        fusion_stage, store = assembly.fusion_stage(run_config, log), second is None or "plan" not in todo
        states = stages.fuse_batches(log, ticks_ns, size, fusion_stage, sink, smooth=smooth, store=store)
    else:
        states = read_states(folder / "state.parquet", size)
    flow: Iterable[Any] = states
    if "plan" in todo:
        robot = assembly.robot(run_config, assembly.robot_base(run_config, log))
        programme = assembly.programme(run_config, log, robot)
        sink.notes["plan"].extend(programme.notes)
        moved = assembly.followers(run_config, programme, start_ns)
        sink.notes["plan"].extend(assembly.scene_notes(run_config, log, moved))
        every = store_every(run_config) if "predict" in todo else math.inf
        others = [name for name, one in moved.items() if not one.chosen and name != RECORDED]
        if second is not None:
            elsewhere = MethodsElsewhere(second, run_config, start_ns, others, folder, fused="fuse" in todo)
            moved = {name: one for name, one in moved.items() if name not in others}
        flow = stages.plan_batches(states, assembly.surroundings(run_config, robot), moved, every, sink, elsewhere)
    elif "predict" in todo:
        every = store_every(run_config)
        flow = stages.predict_batches(states, assembly.prediction_stage(run_config), every, sink)
    if todo:
        for batch, _ in enumerate(flow):
            release_after(batch)
    if elsewhere is not None:
        sink.watch.calls.update(elsewhere.finish())
    return {"fuse": collect_fusion_findings(log, sink), "plan": collect_plan_findings(log, sink)}


def _describe_results(
    run_config: RunConfig, log: Log, folder: Path, meta: dict[str, Any], told: list[str]
) -> dict[str, Any]:
    """Returns further entries of run.json: more remarks and, for a run with a plan, the robot.

    Args:
        run_config: The run.
        log: Log of the run.
        folder: Tables of the run.
        meta: Entries of run.json so far.
        told: Remarks so far.

    Returns:
        ``notes``, including the remarks so far, and ``robot``.
    """
    robot = assembly.robot(run_config, assembly.robot_base(run_config, log)) if "plan" in run_config.stages else None
    method = run_config.settings.plan.method
    motions = {} if robot is None or method == "none" else {str(method): folder / "motion.parquet"}
    notes = notes_of(folder, meta, told, motions, robot, run_config.settings.fusion.rate_hz)
    if robot is None:
        return {"notes": notes}
    mass = robot_mass(run_config.settings.robot, robot).words
    return {"notes": notes, "robot": tables.summary(robot) | {"mass": mass}}


def findings(run_config: RunConfig, told: Mapping[str, Told], reused: tuple[str, ...] = ()) -> dict[str, Any]:
    """Returns the findings of the stages in the log; for a reused stage, those of the earlier run.

    Damaged files that only this run found are included.

    Args:
        run_config: The run.
        told: Result of ``run_stages``.
        reused: Stages whose tables were copied from an earlier run.

    Returns:
        ``counts`` and ``notes`` about the data, for run.json, and ``found_by``: those of each stage that reads the log.
    """
    by_stage: dict[str, Any] = {}
    for stage, (counts, notes) in told.items():
        if stage in reused and run_config.earlier is not None:
            theirs = run_folder.read_meta(run_config.earlier)["found_by"][stage]
            counts = Counter[str](theirs["counts"]) | counts
            notes = (*theirs["notes"], *notes)
        if stage in run_config.stages:
            by_stage[stage] = {"counts": _plain(counts), "notes": list(dict.fromkeys(notes))}
    total = sum((Counter(part["counts"]) for part in by_stage.values()), Counter[str]())
    notes_of_all = [note for part in by_stage.values() for note in part["notes"]]
    return {"counts": _plain(total), "notes": notes_of_all, "found_by": by_stage}


def _plain(counts: Counter[str]) -> dict[str, int]:
    return {name: int(count) for name, count in sorted((+counts).items())}


def _folder(run_config: RunConfig, began: datetime) -> Path:
    return REPORTS / run_config.log.stem / f"{began:%Y%m%dT%H%M%SZ}-{run_config.command}"


def demo_log() -> Path:
    """The log that ships with the package; in a checkout, that of datasets/."""
    return _shipped("demo.mcap")


def demo_cell() -> Path:
    """The cell file of that log: the objects of its scene."""
    return _shipped("demo_cell.toml")


def _shipped(name: str) -> Path:
    """A file that ships with the package; in a checkout, that of datasets/."""
    path = Path(str(resources.files("hrcreplay"))) / "data" / name
    return path if path.exists() else Path(__file__).parents[2] / "datasets" / name
