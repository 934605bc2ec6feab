"""The offline driver: runs the stages of a command on a log and writes the run folder.

Stages of an earlier run are reused where digests show that nothing has changed that their results depend on.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from fnmatch import fnmatch
from importlib import resources
from pathlib import Path
from typing import Any, Unpack

import pyarrow.parquet as pq

from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.records import HumanStates, Ints
from hrcreplay.reporting import tables
from hrcreplay.reporting.story import defect_notes
from hrcreplay.run import build, stages
from hrcreplay.run.build import LogLike
from hrcreplay.run.job import TABLES, Job, JobOptions, resolve, urdf_digest, versions
from hrcreplay.run.notes import notes_of
from hrcreplay.run.stages import NS, ProgressBar, Sink, Told, print_note, told_of_fusion, told_of_plan
from hrcreplay.settings.sections import Logs
from hrcreplay.store import run_folder
from hrcreplay.store.columns import missing_columns, read_states
from hrcreplay.store.run_folder import RunWriter, Stopwatch

REPORTS = Path("reports")


def run(
    command: str,
    source: Path,
    *,
    out: Path | None = None,
    smooth: bool = False,
    chunk_ticks: int = 250,
    **options: Unpack[JobOptions],
) -> Path:
    """Runs the stages up to that of ``command`` on a log or an earlier run.

    Args:
        command: ``fuse``, ``predict``, ``plan`` or ``report``.
        source: A log, or the run folder of an earlier command.
        out: Run folder to make; None: ``reports/<log>/<UTC>-<command>``.
        smooth: Whether to write the smoothed person too (smooth.parquet).
        chunk_ticks: Ticks of a batch; changes no result.
        **options: Settings, cell and span, as ``job.resolve`` takes them.

    Returns:
        The run folder.

    Raises:
        SettingsError: A setting, the cell, the task or the output folder cannot be used.
        LogError: The log cannot be read, or lacks what a stage needs.
    """
    began = datetime.now(UTC)
    job = resolve(command, source, **options)
    known = job.meta()
    with RunWriter(out or _folder(job, began)) as writer:
        log = open_log(job.log, job.settings.logs)
        ticks_ns = span_ticks(job, log)
        parts = dependencies(job, log, ticks_ns)
        reused = take_over(job, parts, writer, smooth=smooth)
        last = [stage for stage in job.stages if stage not in reused][-1:]
        with ProgressBar(last[0] if last else "", len(ticks_ns)) as bar:
            sink = Sink(writer, Stopwatch(time.perf_counter_ns), bar.advance)
            compared = command == "report" and not log.header.has_truth  # then with the smoothed person
            told = run_stages(
                job, log, ticks_ns, chunk_ticks, sink, reused, folder=writer.partial, smooth=smooth or compared
            )
        found = findings(job, told, reused)
        complete(job, log, writer, sink.watch, {**known, **found, **about_run(job, began, parts, smooth=smooth)})
        return writer.folder


def about_run(job: Job, began: datetime, parts: Mapping[str, str], *, smooth: bool) -> dict[str, Any]:
    """Entries of run.json on how a run came to be.

    Args:
        job: What was asked for.
        began: When.
        parts: What ``dependencies`` found.
        smooth: Whether the smoothed person was asked for.
    """
    return {
        "arguments": job.arguments(smooth=smooth),
        "depends_on": parts,
        "stages": stage_digests(job, parts),
        "created": f"{began:%Y-%m-%dT%H:%M:%SZ}",
    }


def complete(job: Job, log: Log, writer: RunWriter, watch: Stopwatch, meta: dict[str, Any]) -> None:
    """Completes a run whose stages have written their tables; with the report where that was asked for.

    Args:
        job: What was asked for.
        log: Log of the job.
        writer: Run folder.
        watch: Times of the stages; takes those of the report.
        meta: What run.json says so far.
    """
    base = build.known_robot_base(job, log)
    writer.close_tables()
    meta |= _about_results(job, log, writer.partial, meta, meta["notes"])
    for line in defect_notes(meta["counts"], meta["notes"]):
        print_note(line)
    meta["T_world_base"] = None if base is None else base.tolist()
    if job.command == "report":
        _report(job, log, writer, watch, meta)
    writer.timing.update(watch.summary(1.0 / job.settings.fusion.rate_hz))
    writer.finish(meta)


def _report(job: Job, log: Log, writer: RunWriter, watch: Stopwatch, meta: dict[str, Any]) -> None:
    """The contact table and the report of a run whose other tables are written."""
    from hrcreplay.run.contact import write_contact  # both are slow to load, and the other commands ask for neither
    from hrcreplay.run.report import write_report

    ticks = pq.read_metadata(writer.partial / "state.parquet").num_rows
    with watch.stage("contact", ticks):
        write_contact(job, log, writer, build.robot_base(job, log))
    with watch.stage("report", ticks):
        write_report(job, writer, meta, log)


def run_stages(
    job: Job,
    log: Log,
    ticks_ns: Ints,
    size: int,
    sink: Sink,
    reused: tuple[str, ...],
    *,
    folder: Path,
    smooth: bool,
) -> dict[str, Told]:
    """All stages of the job in one pass, without those whose tables were taken over.

    Args:
        job: What was asked for.
        log: Log of the job.
        ticks_ns: (n,) ticks of the run, increasing [ns].
        size: Ticks of a batch.
        sink: Where rows, counts and times go.
        reused: Stages whose tables were taken over from an earlier run.
        folder: Where those are.
        smooth: Whether to write the smoothed person too.

    Returns:
        What the stages that read the log found in it.
    """
    todo = [stage for stage in job.stages if stage not in reused]
    states: Iterable[HumanStates]
    if "fuse" in todo:
        stages.write_truth(log, int(ticks_ns[0]), int(ticks_ns[-1]), sink)
        states = stages.fused(log, ticks_ns, size, build.fusion_stage(job, log), sink, smooth=smooth)
    else:
        states = read_states(folder / "state.parquet", size)
    flow: Iterable[Any] = states
    if "plan" in todo:
        chosen = build.planners(job, log, int(ticks_ns[0]))
        robot, path = (getattr(next(iter(chosen.values())).controller, name) for name in ("robot", "reference"))
        sink.notes["plan"].extend(build.programme_notes(job, log, path))
        every = store_every(job) if "predict" in todo else math.inf
        flow = stages.planned(states, build.surroundings(job, robot), chosen, every, sink)
    elif "predict" in todo:
        flow = stages.predicted(states, build.prediction_stage(job), store_every(job), sink)
    if todo:
        for _ in flow:
            pass
    return {"fuse": told_of_fusion(log, sink), "plan": told_of_plan(log, sink)}


def _about_results(job: Job, log: Log, folder: Path, meta: dict[str, Any], told: list[str]) -> dict[str, Any]:
    """Entries of run.json beside the findings of the stages: more remarks, and the robot where there is a plan.

    Args:
        job: What was asked for.
        log: Log of the job.
        folder: Tables of the run.
        meta: What is known of the run so far.
        told: Remarks so far.

    Returns:
        ``notes``, those told before among them, and ``robot``.
    """
    robot = build.robot(job, build.robot_base(job, log)) if "plan" in job.stages else None
    method = job.settings.plan.method
    motions = {} if robot is None or method == "none" else {str(method): folder / "motion.parquet"}
    notes = notes_of(folder, meta, told, motions, robot, job.settings.fusion.rate_hz)
    return {"notes": notes} | ({} if robot is None else {"robot": tables.summary(robot)})


def findings(job: Job, told: Mapping[str, Told], reused: tuple[str, ...] = ()) -> dict[str, Any]:
    """Findings of the stages in the log; of a stage taken over, those of the earlier run.

    Damage to the files that only this run met is told all the same.

    Args:
        job: What was asked for.
        told: What ``run_stages`` returned.
        reused: Stages whose tables were taken over from an earlier run.

    Returns:
        ``counts`` and ``notes`` about the data, for run.json, and ``found_by``: those of each stage that reads the log.
    """
    by_stage: dict[str, Any] = {}
    for stage, (counts, notes) in told.items():
        if stage in reused and job.earlier is not None:
            theirs = run_folder.read_meta(job.earlier)["found_by"][stage]
            counts = Counter[str](theirs["counts"]) | counts
            notes = (*theirs["notes"], *notes)
        if stage in job.stages:
            by_stage[stage] = {"counts": _plain(counts), "notes": list(dict.fromkeys(notes))}
    total = sum((Counter(part["counts"]) for part in by_stage.values()), Counter[str]())
    notes_of_all = [note for part in by_stage.values() for note in part["notes"]]
    return {"counts": _plain(total), "notes": notes_of_all, "found_by": by_stage}


def take_over(job: Job, parts: Mapping[str, str], writer: RunWriter, *, smooth: bool) -> tuple[str, ...]:
    """Copies the tables of the earlier run's stages that would come out the same, and says which those are.

    Args:
        job: What was asked for.
        parts: What ``dependencies`` found.
        writer: Run folder.
        smooth: Whether the smoothed person is asked for, too.
    """
    if job.earlier is None:
        return ()
    stale = stale_stages(job, parts)
    if smooth:
        stale.setdefault("fuse", f"{job.earlier} holds no covariances to smooth with")
    reused = tuple(stage for stage in job.stages if stage not in stale)
    for stage in job.stages:
        names = [name for pattern in TABLES[stage] for name in sorted(p.name for p in job.earlier.glob(pattern))]
        if stage in reused:
            for name in names:
                writer.copy(name, job.earlier)
            print_note(f"{stage}: taken over from {job.earlier}")
        elif names:
            print_note(f"{stage}: {stale[stage]}; computed again")
    return reused


def span_ticks(job: Job, log: Log) -> Ints:
    """(n,) ticks of a job [ns]."""
    first, last = log.header.start_ns, log.header.end_ns
    if first == last:
        raise LogError(f"{job.log}: holds a single instant; would be right: two frames or more")
    start_ns = first + round((job.start_s or 0.0) * NS)
    end_ns = last if job.end_s is None else min(last, first + round(job.end_s * NS))
    if not first <= start_ns < end_ns:
        option = f"--start {job.start_s:g}" if job.start_s is not None else f"--end {job.end_s or 0:g}"
        raise SettingsError(f"{option}: nothing of the log is left; it lasts {(last - first) / NS:.1f} s")
    return stages.tick_times(start_ns, end_ns, job.settings.fusion.rate_hz)


def store_every(job: Job) -> float:
    """Number of ticks for one whose volumes are stored."""
    store_hz = job.settings.occupancy.store_hz
    return 1.0 if store_hz == "all" else max(1.0, job.settings.fusion.rate_hz / store_hz)


def _plain(counts: Counter[str]) -> dict[str, int]:
    return {name: int(count) for name, count in sorted((+counts).items())}


def _folder(job: Job, began: datetime) -> Path:
    return REPORTS / job.log.stem / f"{began:%Y%m%dT%H%M%SZ}-{job.command}"


def demo_log() -> Path:
    """The log that ships with the package; in a checkout, that of datasets/."""
    shipped = Path(str(resources.files("hrcreplay"))) / "data" / "demo.mcap"
    return shipped if shipped.exists() else Path(__file__).parents[2] / "datasets" / "demo.mcap"


#: What the fused person depends on, and the volumes; each stage works on what those before it hand on.
_PERSON = ("versions", "log", "ticks", "cameras", "watched", "settings logs", "settings fusion", "limits.tracking")
_VOLUMES = (*_PERSON, "settings occupancy", "limits.prediction")
_PROGRAMME = ("base", "programme", "settings robot", "settings plan")
_JOINT_SETTINGS = tuple(key for key in Logs.model_fields if key.startswith("joint"))
#: Stage -> the parts that its tables, counts and notes depend on. The plan takes the volumes of every tick: how many
#: of them are stored changes nothing for it.
PARTS = {
    "fuse": (*_PERSON, "logs.gap_s"),
    "predict": (*_VOLUMES, "occupancy.store_hz"),
    "plan": (*_VOLUMES, *_PROGRAMME),
}


def parts_of(job: Job, stage: str) -> tuple[str, ...]:
    """The parts that a stage of a job depends on.

    Volumes that are stored beside a plan reach as far ahead as the chosen robot asked for, so they depend on it.
    """
    planned = "plan" in job.stages and job.settings.plan.horizon == "adaptive"
    return (*PARTS[stage], *_PROGRAMME) if planned and stage == "predict" else PARTS[stage]


def dependencies(job: Job, log: LogLike, ticks_ns: Ints) -> dict[str, str]:
    """Digest of every part that a stage of the job depends on.

    A section of the settings counts whole, so that a new setting cannot be forgotten, but for the keys that stand here
    by themselves: a file counts by its content, what is set of the joints as the programme, for want of a task.

    Args:
        job: What was asked for.
        log: Where the job's cell and task say nothing, the log's own hold.
        ticks_ns: (n,) of the run [ns].

    Raises:
        SettingsError: The cell or the URDF cannot be used.
        LogError: The pose of a camera is not known.
    """
    settings = job.settings.model_dump(mode="json")
    fusion_stage = build.fusion_stage(job, log)
    found: dict[str, Any] = {
        "versions": versions(),
        "log": job.log_sha256,
        "ticks": [int(ticks_ns[0]), int(ticks_ns[-1]), len(ticks_ns)],
        "cameras": [log.header.cameras, fusion_stage.T_world_camera.tolist(), fusion_stage.clock_offset_ns.tolist()],
        "watched": None if job.cell is None or job.cell.watched is None else job.cell.watched.model_dump(),
        "settings logs": _without(settings["logs"], *_JOINT_SETTINGS, "gap_s"),
        "logs.gap_s": settings["logs"]["gap_s"],
        "settings fusion": settings["fusion"],
        "limits.tracking": _without(job.tracking.plain(), "name"),
        "settings occupancy": _without(settings["occupancy"], "store_hz"),
        "occupancy.store_hz": settings["occupancy"]["store_hz"],
        "limits.prediction": _without(job.prediction.plain(), "name"),
    }
    if "plan" in job.stages:
        base = build.known_robot_base(job, log)
        found |= {
            "base": None if base is None else base.tolist(),
            "programme": job.task or log.header.task or {key: settings["logs"][key] for key in _JOINT_SETTINGS},
            "settings robot": [_without(settings["robot"], "urdf", "packages"), urdf_digest(job.settings)],
            "settings plan": _without(settings["plan"], "task"),
        }
    return {name: _digest(part) for name, part in found.items()}


def stage_digests(job: Job, found: Mapping[str, str]) -> dict[str, str]:
    """Digest of all that the result of each stage of the job depends on, from those of ``dependencies``."""
    return {stage: _digest([found[name] for name in parts_of(job, stage)]) for stage in job.stages}


def stale_stages(job: Job, found: Mapping[str, str]) -> dict[str, str]:
    """Stage -> why the earlier run's result is not the one that this job would make.

    A table that is damaged or of an earlier version speaks against the stages after its own, too.
    """
    if job.earlier is None:
        return {}
    meta, mine = run_folder.read_meta(job.earlier), stage_digests(job, found)
    why: dict[str, str] = {}
    damage = None
    for stage in job.stages:
        damage = damage or _damage(job.earlier, stage, meta["outputs"])
        if meta.get("stages", {}).get(stage) != mine[stage]:
            why[stage] = _difference(parts_of(job, stage), found, meta, job.earlier)
        elif damage is not None:
            why[stage] = damage
    if "predict" in why and "plan" in job.stages and job.settings.plan.horizon == "adaptive":
        why.setdefault("plan", "the volumes to store are those that it asks for")
    return why


def _difference(parts: tuple[str, ...], found: Mapping[str, str], meta: Mapping[str, Any], earlier: Path) -> str:
    theirs = meta.get("depends_on", {})
    different = [name for name in parts if theirs.get(name) != found[name]]
    if not theirs or not different:  # of a live session, or of an earlier version
        return f"{earlier} does not say what its tables depend on"
    return f"{', '.join(different)} {'is' if len(different) == 1 else 'are'} not as in {earlier}"


def _damage(folder: Path, stage: str, outputs: Mapping[str, str]) -> str | None:
    """Reason not to take an earlier run's tables of a stage for ours."""
    for name in sorted(name for name in outputs if any(fnmatch(name, pattern) for pattern in TABLES[stage])):
        path = folder / name
        if not path.exists() or run_folder.sha256(path) != outputs[name]:
            return f"{path} is not as its run left it"
        if missing := missing_columns(path):
            return f"{path} is of an earlier version, without {missing[0]}"
    return None


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _without(table: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {name: value for name, value in table.items() if name not in keys}
