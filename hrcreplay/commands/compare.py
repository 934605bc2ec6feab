"""The command ``compare``: runs several methods on one recording and one programme, with the same recorded person.

A variant is a method with an occupancy and a horizon. The person is fused and stored once. Each variant then plans
independently, so two processes share the variants and the result does not depend on their distribution. A motion from
an earlier run with the same settings is reused; its metrics are computed again.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Unpack, get_args

import pandas as pd
import pyarrow.parquet as pq

from hrcreplay.commands import replay
from hrcreplay.commands.notes import notes_of
from hrcreplay.errors import SettingsError
from hrcreplay.evaluation.contact import (
    Coverages,
    JudgedMotion,
    Predicted,
    compute_full_coverage,
    compute_own_coverage,
    write_rows,
)
from hrcreplay.evaluation.judging import read_recorded_people
from hrcreplay.evaluation.recorded_person import RecordedPeople
from hrcreplay.evaluation.severity import severity_table
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.pipeline import assembly, reuse, stages
from hrcreplay.pipeline.assembly import Follower, Recorded
from hrcreplay.pipeline.kernel_build import ensure_compiled
from hrcreplay.pipeline.planner import METHOD_COST, Planner
from hrcreplay.pipeline.progress import ProgressBar, print_note
from hrcreplay.pipeline.robot_mass import robot_mass
from hrcreplay.pipeline.run_config import RunConfig, RunOptions, resolve
from hrcreplay.pipeline.second_process import second_process
from hrcreplay.pipeline.stages import Sink, collect_plan_findings
from hrcreplay.pipeline.surroundings import Forecast
from hrcreplay.records import RECORDED, UNGUARDED, Floats, Ints
from hrcreplay.reporting import comparison
from hrcreplay.reporting.comparison import Variant
from hrcreplay.reporting.summary_text import defect_notes
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.recorded import RecordedCapsules
from hrcreplay.robot.task import Reference
from hrcreplay.settings.load import Settings
from hrcreplay.settings.sections import Plan, Prediction
from hrcreplay.store.columns import motion_columns, read_states
from hrcreplay.store.run_folder import FolderTables, RunWriter, Stopwatch
from hrcreplay.store.stored_table import StoredTable

#: The default variants: the programme without reaction; four methods with the sound volumes up to the end of each
#: tick's own stop; qp with sound volumes up to a fixed horizon; and the two methods of the paper with its volumes and
#: its horizon.
PRESET = "none,ssm,shield,scaling,qp,qp:sound:fixed,qp:paper:fixed,scaling:paper:fixed"


@dataclass(frozen=True)
class PlacedProgramme:
    """Programme and base pose of the robot; determined once for all variants."""

    T_world_base: Floats  #: (4, 4)
    path: Reference
    start_s: float  #: programmed time at the first tick [s]
    recorded: Recorded | None  #: the robot as recorded; None: the log has no joints of this robot

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles the programme without the robot; the other process makes the robot again."""
        path = replace(self.path, model=None)  # type: ignore[arg-type]
        return PlacedProgramme, (self.T_world_base, path, self.start_s, self.recorded)


@dataclass(frozen=True)
class VariantTask:
    """One variant on one log."""

    run_config: RunConfig  #: with the settings of the variant
    variant: Variant
    folder: Path  #: contains state.parquet; motion and contact are written here
    people: RecordedPeople
    full: Coverages | None  #: coverage by its volumes until the braking time; depends only on the occupancy
    programme: PlacedProgramme
    ready: bool  #: True: the motion exists already
    size: int  #: ticks of a batch


def run(
    sources: Sequence[Path],
    *,
    methods: str = PRESET,
    out: Path | None = None,
    chunk_ticks: int = 250,
    processes: int = 2,
    **options: Unpack[RunOptions],
) -> Path:
    """Compares methods on logs, or on the logs of earlier runs with the settings and cells of those runs.

    Args:
        sources: Logs, or run folders of earlier commands.
        methods: ``METHOD[:OCCUPANCY[:HORIZON]]``, separated by commas; omitted parts are taken from the settings.
        out: Run folder to make; None: ``reports/<log>/<UTC>-compare``.
        chunk_ticks: Ticks of a batch; changes no result.
        processes: Number of parallel processes, 1 or 2; changes no result.
        **options: Settings, cell and span, as ``run_config.resolve`` takes them.

    Returns:
        The run folder: compare.json, compare.csv, compare.md, figures, and one folder per log with the tables.

    Raises:
        SettingsError: A setting, a method, a cell, the task or the output folder cannot be used.
        LogError: A log cannot be read, or lacks what a stage needs.
    """
    began = datetime.now(UTC)
    run_configs = [resolve("compare", source, **options) for source in sources]
    per_run = [parse(methods, run_config.settings) for run_config in run_configs]
    if any(variants != per_run[0] for variants in per_run):
        raise SettingsError(
            "prediction.method, plan.horizon: the runs given differ, and one table has one of each; name them in "
            "--methods, as qp:sound:adaptive"
        )
    ensure_compiled()
    with RunWriter(out or replay.REPORTS / run_configs[0].log.stem / f"{began:%Y%m%dT%H%M%SZ}-compare") as writer:
        watch = Stopwatch(time.perf_counter_ns)
        logs = [
            _compare_log(run_config, name, per_run[0], writer, watch, chunk_ticks, processes)
            for run_config, name in zip(run_configs, _names(run_configs), strict=True)
        ]
        found = comparison.results(logs)
        for log_name, note in comparison.notes(found):
            print_note(f"{log_name}: {note}" if len(logs) > 1 else note)
        comparison.write(found, writer)
        writer.text("severity.csv", _contacts(writer.partial, logs))
        comparison.print_tables(found)
        writer.timing.update(watch.summary(1.0 / run_configs[0].settings.fusion.rate_hz))
        writer.finish(_meta(run_configs, list(found["methods"]), began))
        return writer.folder


def parse(text: str, settings: Settings) -> tuple[Variant, ...]:
    """Returns the variants that a list of methods names, each once.

    Raises:
        SettingsError: A part of a variant is unknown.
    """
    known = {
        "method": get_args(Plan.model_fields["method"].annotation),
        "occupancy": get_args(Prediction.model_fields["method"].annotation),
        "horizon": get_args(Plan.model_fields["horizon"].annotation),
    }
    found = []
    for word in map(str.strip, text.split(",")):
        parts = word.split(":")
        if len(parts) > len(known) or (parts[0] == "none" and len(parts) > 1):
            why = "none uses no volumes" if parts[0] == "none" else "too many parts"
            raise SettingsError(
                f"--methods {word}: {why}; would be right: METHOD[:OCCUPANCY[:HORIZON]], as in {PRESET}"
            )
        for part, (what, names) in zip(parts, known.items(), strict=False):
            if part not in names:
                raise SettingsError(f"--methods {word}: {part!r} is no {what}; known are {', '.join(names)}")
        default = (settings.plan.method, settings.prediction.method, settings.plan.horizon)
        found.append(Variant(*parts, *default[len(parts) :]))
    return tuple(dict.fromkeys(found))


def _names(run_configs: Sequence[RunConfig]) -> list[str]:
    """Returns a short name for each log; equal names get numbers."""
    stems = [run_config.log.stem for run_config in run_configs]
    return [s if stems.count(s) == 1 else f"{s}-{stems[:i].count(s) + 1}" for i, s in enumerate(stems)]


def variant_run_config(run_config: RunConfig, variant: Variant) -> RunConfig:
    """Returns the run that plans only this variant."""
    settings = run_config.settings
    plan = settings.plan.model_copy(update={"method": variant.method, "baselines": (), "horizon": variant.horizon})
    prediction = settings.prediction.model_copy(update={"method": variant.occupancy})
    return replace(
        run_config, command="plan", settings=settings.model_copy(update={"plan": plan, "prediction": prediction})
    )


def _compare_log(
    run_config: RunConfig,
    name: str,
    variants: Sequence[Variant],
    writer: RunWriter,
    watch: Stopwatch,
    size: int,
    processes: int,
) -> comparison.LogResult:
    """Runs all variants on one log; the tables are in the subfolder ``<name>`` of the run folder.

    Args:
        run_config: The run.
        name: Name of the log.
        variants: Variants to run.
        writer: The run folder.
        watch: Records the times.
        size: Ticks of a batch.
        processes: Number of parallel processes.
    """
    part = RunWriter(writer.partial / name)
    part.partial.mkdir()
    log = open_log(run_config.log, run_config.settings.logs)
    ticks_ns, fusing = stages.span_ticks(run_config, log), replace(run_config, command="fuse")
    reused = reuse.take_over(fusing, reuse.dependencies(fusing, log, ticks_ns), part, smooth=False)
    with ProgressBar(name, len(ticks_ns) * len(variants)) as bar:
        sink = Sink(part, watch, _silent)
        told = replay.run_stages(
            fusing, log, ticks_ns, size, sink, reused, folder=part.partial, smooth=not log.header.has_truth
        )
        part.close_tables()
        people = read_recorded_people(run_config, log, part)
        part.close_tables()
        programme, told_of_programme = _programme(run_config, log, int(ticks_ns[0]))
        sink.notes["plan"].extend(told_of_programme)
        if programme.recorded is not None:
            variants = (_as_recorded(run_config), *variants)
        have = _motions(run_config, log, variants, ticks_ns, part)
        full = _full_coverages(run_config, variants, people, part.partial)
        tasks = [
            VariantTask(
                *(variant_run_config(run_config, variant), variant, part.partial, people, full[variant.occupancy]),
                *(programme, variant in have, size),
            )
            for variant in variants
        ]
        took = _plan_all(tasks, processes, partial(bar.advance, name))
    told |= {"plan": collect_plan_findings(log, sink)}
    notes = _notes(run_config, part.partial, variants, programme, replay.findings(run_config, told, reused))
    writer.timing[f"plan {name}"] = {variant.label: {"seconds": took[variant]} for variant in variants}
    part.partial.rename(part.folder)
    rows = {
        variant: comparison.figures(variant, *tables(part.folder, variant), _report_settings(run_config))
        for variant in variants
    }
    seconds = float(ticks_ns[-1] - ticks_ns[0]) * 1e-9
    mass = robot_mass(run_config.settings.robot, assembly.robot(run_config, programme.T_world_base)).words
    return comparison.LogResult(name, run_config.log_sha256, people.source, seconds, notes, mass, rows)


def _contacts(folder: Path, logs: Sequence[comparison.LogResult]) -> str:
    """Returns all rows of severity of all logs and variants as CSV, an empty cell for what is not known."""
    rows = []
    for log in logs:
        for variant in log.figures:
            severity = pq.read_table(folder / log.name / f"severity_{variant.slug}.parquet").to_pandas()
            severity.insert(0, "log", log.name)
            severity.insert(1, "variant", variant.label)
            rows.append(severity)
    return pd.concat(rows).to_csv(index=False, lineterminator="\n")


def _full_coverages(
    run_config: RunConfig, variants: Sequence[Variant], people: RecordedPeople, folder: Path
) -> dict[str, Coverages]:
    """Computes the coverage of each person by the volumes of each occupancy until the braking time."""
    found: dict[str, Coverages] = {}
    for variant in sorted(variants, key=lambda variant: variant.method in UNGUARDED):
        if variant.occupancy not in found:
            mine = variant_run_config(run_config, variant)
            found[variant.occupancy] = compute_full_coverage(
                mine, people, Predicted(assembly.prediction_stage(mine), folder / "state.parquet")
            )
    return found


def _notes(
    run_config: RunConfig,
    folder: Path,
    variants: Sequence[Variant],
    programme: PlacedProgramme,
    found: Mapping[str, Any],
) -> tuple[str, ...]:
    """Returns remarks on a log and its robot, as in a report, and on methods whose robot starts inside the person.

    Args:
        run_config: The run.
        folder: Tables of the log.
        variants: Variants that were run.
        programme: Base pose of the robot.
        found: Findings of the stages in the log.
    """
    motions = {v.label: folder / f"motion_{v.slug}.parquet" for v in variants if v.method not in UNGUARDED}
    robot = assembly.robot(run_config, programme.T_world_base)
    notes = notes_of(folder, run_config.meta(), found["notes"], motions, robot, run_config.settings.fusion.rate_hz)
    return defect_notes(found["counts"], notes)


def _programme(run_config: RunConfig, log: Log, start_ns: int) -> tuple[PlacedProgramme, tuple[str, ...]]:
    """Returns the programme of a log, and remarks on it."""
    base = assembly.robot_base(run_config, log)
    robot = assembly.robot(run_config, base)
    found = assembly.programme(run_config, log, robot)
    static = assembly.static_scene(run_config, robot, found.path, found.start_s(start_ns))
    notes = (*found.notes, *(() if static is None else static.notes))
    notes = (*notes, *assembly.hidden_area_notes(run_config, log, robot))
    return PlacedProgramme(base, found.path, found.start_s(start_ns), found.recorded), notes


def _as_recorded(run_config: RunConfig) -> Variant:
    """Returns the variant of the robot as recorded, with the volumes of the settings."""
    return Variant(RECORDED, run_config.settings.prediction.method, run_config.settings.plan.horizon)


def _silent(_stage: str, _ticks: int) -> None:
    """Ignores fusion progress."""


def tables(folder: Path, variant: Variant) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Returns motion, contact and severity of a variant."""
    motion, contact, severity = (
        pq.read_table(folder / f"{what}_{variant.slug}.parquet").to_pandas()
        for what in ("motion", "contact", "severity")
    )
    return motion, contact, severity


def _report_settings(run_config: RunConfig) -> comparison.Bounds:
    report, plan = run_config.settings.report, run_config.settings.plan
    return comparison.Bounds(report.near_m, report.stationary_m_per_s, plan.max_reference_lead_m)


def _motions(
    run_config: RunConfig, log: Log, variants: Sequence[Variant], ticks_ns: Ints, part: RunWriter
) -> set[Variant]:
    """Copies the motions of an earlier run with the same settings; returns the variants of these motions.

    Args:
        run_config: The run.
        log: Log of the run.
        variants: Variants to run.
        ticks_ns: (n,) ticks of the run [ns].
        part: Folder of the log.
    """
    if run_config.earlier is None:
        return set()
    theirs = resolve("plan", run_config.earlier)
    ticks = stages.span_ticks(theirs, log)
    if "plan" in reuse.stale_stages(theirs, reuse.dependencies(theirs, log, ticks)):
        return set()
    have, made = set(), _parts(theirs, log, ticks)
    for variant in variants:
        chosen = variant.method == theirs.settings.plan.method
        if not chosen and variant.method not in theirs.settings.plan.baselines:
            continue
        if _parts(variant_run_config(run_config, variant), log, ticks_ns) == made:
            name = "motion.parquet" if chosen else f"motion_{variant.method}.parquet"
            shutil.copyfile(run_config.earlier / name, part.partial / f"motion_{variant.slug}.parquet")
            have.add(variant)
            print_note(f"{variant.label}: taken over from {run_config.earlier}")
    return have


def _parts(run_config: RunConfig, log: Log, ticks_ns: Ints) -> dict[str, str]:
    """Returns the digests of the inputs of a motion other than its method; the other methods of a run do not count."""
    plan = run_config.settings.plan.model_copy(update={"method": "qp", "baselines": ()})
    plain = replace(run_config, command="plan", settings=run_config.settings.model_copy(update={"plan": plan}))
    found = reuse.dependencies(plain, log, ticks_ns)
    return {name: found[name] for name in reuse.PARTS["plan"]}


def _plan_all(tasks: Sequence[VariantTask], processes: int, advance: Callable[[int], None]) -> dict[Variant, float]:
    """Plans all tasks: a second process and this one each take the next open task.

    Args:
        tasks: Tasks to plan.
        processes: 1 or 2.
        advance: Called with the number of ticks done.

    Returns:
        Duration of each task [s].
    """
    order = sorted(tasks, key=lambda task: (task.ready, -METHOD_COST[task.variant.method]))
    if processes < 2 or len(order) < 2:
        return {task.variant: plan(task, advance)[1] for task in order}
    took = {}
    with second_process() as pool:
        futures = [pool.submit(plan, task) for task in order]
        for task, future in zip(order, futures, strict=True):
            if future.cancel():
                took[task.variant] = plan(task, advance)[1]
        for task, future in zip(order, futures, strict=True):
            if not future.cancelled():
                ticks, took[task.variant] = future.result()
                advance(ticks)
    return took


def plan(task: VariantTask, progress: Callable[[int], None] | None = None) -> tuple[int, float]:
    """Writes motion and contact of a variant to its folder; returns the number of ticks and the duration [s].

    Args:
        task: Task to plan.
        progress: Called with the number of ticks of each finished batch; or None.
    """
    began_s, run_config, slug = time.perf_counter(), task.run_config, task.variant.slug
    robot = assembly.robot(run_config, task.programme.T_world_base)
    states, writer = task.folder / "state.parquet", FolderTables(task.folder)
    surroundings = assembly.surroundings(run_config, robot)
    done, most, planner = 0, 1, None if task.ready else _planner(task, robot)
    for batch in read_states(states, task.size):
        if planner is not None:
            forecast = Forecast(surroundings, batch)
            t_ns, most = forecast.t_ns, max(most, int(batch.numbers.max()))
            made = planner.follow(t_ns, forecast, surroundings.names_of(most))
            writer.table(
                f"motion_{slug}", motion_columns(made) | stages.nearest_columns(planner.robot, planner.static, made)
            )
        count = len(batch.ticks()[0])
        done += count
        if progress is not None:
            progress(count)
    writer.close_tables()
    motion = StoredTable(task.folder / f"motion_{slug}.parquet")
    predicted = Predicted(surroundings.prediction, states)
    own = compute_own_coverage(run_config, task.people, predicted, motion)
    full = None if task.variant.method in UNGUARDED else task.full
    recorded = task.programme.recorded if task.variant.method == RECORDED else None
    capsules = recorded if isinstance(recorded, RecordedCapsules) else None
    method, people = task.variant.method, task.people
    judged = JudgedMotion(run_config, robot, method, motion, people, predicted, own, full, capsules)
    meetings = write_rows(judged.rows(), partial(writer.table, f"contact_{slug}"))
    writer.table(f"severity_{slug}", severity_table(run_config, robot, method, motion, meetings, people, capsules))
    writer.close_tables()
    return done, time.perf_counter() - began_s


def _planner(task: VariantTask, robot: RobotModel) -> Follower:
    """Makes the controller of the variant at the start of the programme, or the recorded motion."""
    run_config, programme = task.run_config, task.programme
    if task.variant.method == RECORDED and programme.recorded is not None:
        static = assembly.static_scene(run_config, robot, replace(programme.path, model=robot), programme.start_s)
        return assembly.recorded_motion(run_config, robot, programme.recorded, static)
    settings = assembly.plan_settings(run_config, 1.0 / run_config.settings.fusion.rate_hz, task.variant.method)
    path = replace(programme.path, model=robot)
    static = assembly.static_scene(run_config, robot, path, programme.start_s)
    controller = assembly.make_controller(task.variant.method, robot, path, settings, programme.start_s, static)
    return Planner(controller, chosen=True)


def _meta(run_configs: Sequence[RunConfig], methods: list[str], began: datetime) -> dict[str, Any]:
    others = [run_config.meta() for run_config in run_configs]
    return {
        **others[0],
        "command": "compare",
        "inputs": [part["inputs"][0] for part in others],
        "cells": [part["cell"] for part in others],
        "settings_by_log": [part["settings"] for part in others],
        "methods": methods,
        "created": f"{began:%Y-%m-%dT%H:%M:%SZ}",
    }
