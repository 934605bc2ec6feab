"""Offline driver: log -> stages -> run folder."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

from hrcreplay import pipeline, runs, wiring
from hrcreplay.errors import SettingsError
from hrcreplay.ingest import log_options
from hrcreplay.job import TABLES, Job, resolve
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.pipeline import NS, Sink
from hrcreplay.progress import Bar, say
from hrcreplay.records import HumanStates, Ints
from hrcreplay.report.robot_summary import remarks, summary
from hrcreplay.reporting import write_report
from hrcreplay.robot.model import RobotModel
from hrcreplay.runs import RunWriter, Stopwatch
from hrcreplay.tables import read_states

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
        with Bar(job.stages[-1], len(ticks_ns)) as bar:
            sink = Sink(writer, Stopwatch(time.perf_counter_ns), bar.advance)
            found = run_stages(job, log, ticks_ns, chunk_ticks, sink, smooth=smooth)
        base = wiring.base(job, log)
        if "plan" in job.stages:
            found = _with_robot(found, wiring.robot(job, wiring.standing(job, log)))
        meta = {
            **known,
            **found,
            "T_world_base": None if base is None else base.tolist(),
            "created": f"{began:%Y-%m-%dT%H:%M:%SZ}",
        }
        writer.close_tables()
        if command == "report":
            with sink.watch.stage("report", len(ticks_ns)):
                write_report(job, writer, meta)
        writer.timing.update(sink.watch.summary(1.0 / job.settings.fusion.rate_hz))
        writer.finish(meta)
        return writer.folder


def run_stages(job: Job, log: Log, ticks_ns: Ints, size: int, sink: Sink, *, smooth: bool) -> dict[str, Any]:
    """All stages of the job in one pass; those of an earlier run that would come out the same are taken over.

    Returns:
        ``counts`` and ``notes`` about the data, for run.json.
    """
    reused = _take_over(job, sink.run, smooth=smooth)
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
    if "fuse" in todo:
        return {"counts": _counts(log, sink.counts), "notes": list(log.notes)}
    earlier = runs.read_meta(job.earlier) if job.earlier else {}
    return {"counts": earlier["counts"], "notes": earlier["notes"]}


def _with_robot(found: dict[str, Any], robot: RobotModel) -> dict[str, Any]:
    """What the run tells of its robot, beside what was found; remarks on a robot from a URDF go to the terminal too."""
    notes = [note for note in remarks(robot) if note not in found["notes"]]
    for note in notes:
        say(note)
    return {**found, "notes": [*found["notes"], *notes], "robot": summary(robot)}


def _take_over(job: Job, writer: RunWriter, *, smooth: bool) -> tuple[str, ...]:
    """Copies the tables of the earlier run's stages that would come out the same, and says which those are."""
    if job.earlier is None:
        return ()
    stale = job.stale()
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
    start_ns = first + round((job.start_s or 0.0) * NS)
    end_ns = last if job.end_s is None else min(last, first + round(job.end_s * NS))
    if not first <= start_ns < end_ns:
        raise SettingsError(
            f"--start {job.start_s or 0:g}: nothing of the log is left; it lasts {(last - first) / NS:.1f} s"
        )
    return pipeline.tick_times(start_ns, end_ns, job.settings.fusion.rate_hz)


def _store_every(job: Job) -> float:
    store_hz = job.settings.occupancy.store_hz
    return 1.0 if store_hz == "all" else max(1.0, job.settings.fusion.rate_hz / store_hz)


def _counts(log: Log, found: Counter[str]) -> dict[str, int]:
    return {name: int(count) for name, count in sorted((log.defects + found).items())}


def _folder(job: Job, began: datetime) -> Path:
    return REPORTS / job.log.stem / f"{began:%Y%m%dT%H%M%SZ}-{job.command}"


def demo_log() -> Path:
    """The log that ships with the package; in a checkout, that of datasets/."""
    shipped = Path(str(resources.files("hrcreplay"))) / "data" / "demo.mcap"
    return shipped if shipped.exists() else Path(__file__).parents[1] / "datasets" / "demo.mcap"
