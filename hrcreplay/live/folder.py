"""The run folder of a live session: a place for its log at the start, and all the rest from that log at the end."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hrcreplay import runs, wiring
from hrcreplay.errors import SettingsError
from hrcreplay.job import Job
from hrcreplay.live import crash
from hrcreplay.live.session_tables import SessionTables
from hrcreplay.live.setup import job_of
from hrcreplay.live.tape import Tape
from hrcreplay.logs.person import PersonMemory
from hrcreplay.logs.reader import open_log
from hrcreplay.reporting import write_report
from hrcreplay.runs import RunWriter
from hrcreplay.tables import measurement_columns
from hrcreplay.wiring import log_options

LOG = "log.mcap"
_PARTIAL = ".partial"


def begin(out: Path) -> Path:
    """Makes the folder that a session's log goes to; it gets its own name from ``finish``.

    Raises:
        SettingsError: The folder exists, or cannot be made.
    """
    return RunWriter(out).__enter__().partial  # and never left: whatever comes of the session, its record stays


def finish(partial: Path) -> Path:
    """Makes the run folder of a session that has ended or was killed.

    Returns:
        The run folder.

    Raises:
        SettingsError: No such session, or the run folder is there already.
        LogError: The record cannot be read, or lacks the session's start.
    """
    if partial.suffix != _PARTIAL or not (partial / LOG).is_file():
        raise SettingsError(f"{partial}: no session to be finished; those end in {_PARTIAL} and hold {LOG}")
    writer = RunWriter(partial.with_name(partial.name.removesuffix(_PARTIAL)))
    if writer.folder.exists():
        raise SettingsError(f"{writer.folder}: exists already; move it away, then finish {partial}")
    tape = Tape(partial / LOG)
    start = tape.start()
    job = job_of(start, writer.folder / LOG, runs.sha256(partial / LOG))
    cameras, links, limbs = (tuple(start[name]) for name in ("cameras", "links", "limbs"))
    tables = SessionTables(writer, cameras, links, limbs, start["method"])
    for message in tape.messages():
        tables.add(message)
    tables.flush()
    _measure(job, writer)
    writer.close_tables()
    crashes = crash.read(partial)
    meta = _meta(job, start, tables, tape, crashes)
    write_report(job, writer, meta)
    writer.timing.update(tables.timing())
    writer.finish(meta, complete=not crashes)
    return writer.folder


def leave(partial: Path, crashes: list[str]) -> None:
    """Leaves of a session that no run folder can be made of its log and its crashes, and says so in run.json."""
    for path in sorted(partial.iterdir()):
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != LOG and not path.name.startswith(crash.PREFIX):
            path.unlink()
    (partial / "run.json").write_text(runs.to_json(_crashed(crashes) | {"command": "live", "complete": False}))


def _crashed(crashes: list[str]) -> dict[str, Any]:
    """What run.json has of crashes."""
    return {"crashes": crashes, "reason": crashes[0]} if crashes else {}


def _measure(job: Job, writer: RunWriter) -> None:
    """The table of measurements: what each frame says by itself."""
    log = open_log(writer.partial / LOG, log_options(job.settings), skeletons=False)
    eyes, memory = wiring.eyes(job, log), PersonMemory()
    for frames in log.frames():
        memory, measured, _ = eyes.measure(frames, memory)
        writer.table("measurements", measurement_columns(measured))


def _meta(job: Job, start: dict[str, Any], tables: SessionTables, tape: Tape, crashes: list[str]) -> dict[str, Any]:
    """run.json of the session."""
    end: dict[str, Any] = next((event for event in tables.events if event.get("what") == "end"), {})
    notes = [str(event["text"]) for event in tables.events if event.get("what") == "note"]
    notes += [f"{LOG}: {flaw}" for flaw in tape.flaws]
    notes += [f"not complete: {line}" for line in crashes]
    if not end and not crashes:
        notes.append("the session was killed: its record has no end")
    counts = {name.replace(" ", "_"): int(count) for name, count in end.get("counts", {}).items()}
    counts |= dict(tables.counts) | {"messages_dropped": int(end.get("dropped", 0))}
    counts |= {"looks_skipped": int(end.get("looks_skipped", 0))}
    return {
        **job.meta(),
        "versions": start["versions"],
        "inputs": [{"path": LOG, "sha256": job.log_sha256}],  # beside it, wherever the folder is moved to
        "stages": {},  # a replay of the log has ticks of its own: it takes nothing over
        "T_world_base": start["T_world_base"],
        "sending": start["sending"],
        "created": f"{datetime.fromtimestamp(tape.first_ns // 10**9, UTC):%Y-%m-%dT%H:%M:%SZ}",
        "stops": end.get("stops", []),
        "reason": end.get("reason"),
        "counts": dict(sorted(counts.items())),
        "notes": notes,
        **_crashed(crashes),
    }
