"""Offline driver: log -> stages -> run folder."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from hrcreplay import pipeline, reuse, runs, wiring
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.job import TABLES, Job, resolve
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.pipeline import NS, Sink
from hrcreplay.progress import Bar, say
from hrcreplay.records import HumanStates, Ints
from hrcreplay.report import limbs, robot_summary
from hrcreplay.report.flaws import flaws
from hrcreplay.reporting import write_report
from hrcreplay.runs import Run, RunWriter, Stopwatch
from hrcreplay.tables import read_states
from hrcreplay.wiring import log_options

REPORTS = Path("reports")


def run(
    command: str,
    source: Path,
    *,
    out: Path | None = None,
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    cell_file: Path | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    smooth: bool = False,
    chunk_ticks: int = 250,
) -> Path:
    """Runs the stages up to that of ``command`` on a log or an earlier run.

    Returns:
        The run folder.

    Raises:
        SettingsError: A setting, the cell, the task or the output folder cannot be used.
        LogError: The log cannot be read, or lacks what a stage needs.
    """
    began = datetime.now(UTC)
    job = resolve(
        command, source, config=config, overrides=overrides, cell_file=cell_file, start_s=start_s, end_s=end_s
    )
    known = job.meta()
    with RunWriter(out or _folder(job, began)) as writer:
        log = open_log(job.log, log_options(job.settings))
        ticks_ns = _ticks(job, log)
        parts = reuse.parts(job, log, ticks_ns)
        reused = _take_over(job, parts, writer, smooth=smooth)
        last = [stage for stage in job.stages if stage not in reused][-1:]
        with Bar(last[0] if last else "", len(ticks_ns)) as bar:
            sink = Sink(writer, Stopwatch(time.perf_counter_ns), bar.advance)
            found = run_stages(job, log, ticks_ns, chunk_ticks, sink, reused, smooth=smooth)
        base = wiring.base(job, log)
        writer.close_tables()
        notes = [*found["notes"], *_unmeasured(writer.partial, known, found["notes"])]
        if "plan" in job.stages:
            robot = wiring.robot(job, wiring.standing(job, log))
            notes += robot_summary.remarks(robot)
            found["robot"] = robot_summary.summary(robot)
        found["notes"] = list(dict.fromkeys(notes))
        for line in flaws(found["counts"], found["notes"]):
            say(line)
        meta = {
            **known,
            **found,
            "arguments": job.arguments(smooth=smooth),
            "depends_on": parts,
            "stages": reuse.stages(job, parts),
            "T_world_base": None if base is None else base.tolist(),
            "created": f"{began:%Y-%m-%dT%H:%M:%SZ}",
        }
        if command == "report":
            with sink.watch.stage("report", len(ticks_ns)):
                write_report(job, writer, meta)
        writer.timing.update(sink.watch.summary(1.0 / job.settings.fusion.rate_hz))
        writer.finish(meta)
        return writer.folder


def run_stages(
    job: Job, log: Log, ticks_ns: Ints, size: int, sink: Sink, reused: tuple[str, ...], *, smooth: bool
) -> dict[str, Any]:
    """All stages of the job in one pass, without those whose tables were taken over.

    Returns:
        ``counts`` and ``notes`` about the data, for run.json, and ``found_by``: those of each stage that reads the log.
    """
    todo = [stage for stage in job.stages if stage not in reused]
    states: Iterable[HumanStates]
    if "fuse" in todo:
        pipeline.write_truth(log, int(ticks_ns[0]), int(ticks_ns[-1]), sink)
        states = pipeline.fused(log, ticks_ns, size, wiring.eyes(job, log), sink, smooth=smooth)
    else:
        states = read_states(sink.run.partial / "state.parquet", size)
    flow: Iterable[Any] = states
    if "predict" in todo or "plan" in todo:
        people = pipeline.predicted(states, wiring.foresight(job), _store_every(job), sink, keep="predict" in todo)
        flow = people
        if "plan" in todo:
            flow = pipeline.planned(people, wiring.planners(job, log, int(ticks_ns[0])), sink)
    if todo:
        for _ in flow:
            pass
    return _findings(job, log, sink, reused)


def _unmeasured(folder: Path, meta: dict[str, Any], told: list[str]) -> list[str]:
    """Remarks on limbs that were not measured, from the tables of the first stage."""

    def table(name: str) -> Any:
        path = folder / f"{name}.parquet"
        return pq.read_table(path, columns=list(limbs.COLUMNS[name])).to_pandas() if path.exists() else None

    return limbs.remarks(Run(folder, meta, state=table("state"), measurements=table("measurements")), told)


def _findings(job: Job, log: Log, sink: Sink, reused: tuple[str, ...]) -> dict[str, Any]:
    """What the stages found in the log; of a stage taken over, what the earlier run found.

    Damage to the files that only this run met is told all the same.
    """
    joints = log.joint_defects
    found: dict[str, tuple[Counter[str], list[str]]] = {
        "fuse": (log.defects - joints + sink.counts, [*log.notes, *sink.notes["fuse"]]),
        "plan": (joints, sink.notes["plan"]),
    }
    by_stage: dict[str, Any] = {}
    for stage, (counts, notes) in found.items():
        if stage in reused and job.earlier is not None:
            theirs = runs.read_meta(job.earlier)["found_by"][stage]
            counts = Counter[str](theirs["counts"]) | counts
            notes = [*theirs["notes"], *notes]
        if stage in job.stages:
            by_stage[stage] = {"counts": _plain(counts), "notes": list(dict.fromkeys(notes))}
    total = sum((Counter(part["counts"]) for part in by_stage.values()), Counter[str]())
    told = [note for part in by_stage.values() for note in part["notes"]]
    return {"counts": _plain(total), "notes": told, "found_by": by_stage}


def _take_over(job: Job, parts: Mapping[str, str], writer: RunWriter, *, smooth: bool) -> tuple[str, ...]:
    """Copies the tables of the earlier run's stages that would come out the same, and says which those are."""
    if job.earlier is None:
        return ()
    stale = reuse.stale(job, parts)
    if smooth:
        stale.setdefault("fuse", f"{job.earlier} holds no covariances to smooth with")
    reused = tuple(stage for stage in job.stages if stage not in stale)
    for stage in job.stages:
        names = [name for pattern in TABLES[stage] for name in sorted(p.name for p in job.earlier.glob(pattern))]
        if stage in reused:
            for name in names:
                writer.copy(name, job.earlier)
            say(f"{stage}: taken over from {job.earlier}")
        elif names:
            say(f"{stage}: {stale[stage]}; computed again")
    return reused


def _ticks(job: Job, log: Log) -> Ints:
    first, last = log.header.start_ns, log.header.end_ns
    if first == last:
        raise LogError(f"{job.log}: holds a single instant; would be right: two frames or more")
    start_ns = first + round((job.start_s or 0.0) * NS)
    end_ns = last if job.end_s is None else min(last, first + round(job.end_s * NS))
    if not first <= start_ns < end_ns:
        option = f"--start {job.start_s:g}" if job.start_s is not None else f"--end {job.end_s or 0:g}"
        raise SettingsError(f"{option}: nothing of the log is left; it lasts {(last - first) / NS:.1f} s")
    return pipeline.tick_times(start_ns, end_ns, job.settings.fusion.rate_hz)


def _store_every(job: Job) -> float:
    store_hz = job.settings.occupancy.store_hz
    return 1.0 if store_hz == "all" else max(1.0, job.settings.fusion.rate_hz / store_hz)


def _plain(counts: Counter[str]) -> dict[str, int]:
    return {name: int(count) for name, count in sorted((+counts).items())}


def _folder(job: Job, began: datetime) -> Path:
    return REPORTS / job.log.stem / f"{began:%Y%m%dT%H%M%SZ}-{job.command}"


def demo_log() -> Path:
    """The log that ships with the package; in a checkout, that of datasets/."""
    shipped = Path(str(resources.files("hrcreplay"))) / "data" / "demo.mcap"
    return shipped if shipped.exists() else Path(__file__).parents[1] / "datasets" / "demo.mcap"
