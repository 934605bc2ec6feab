"""Which stages of an earlier run come out the same, by digests of all that the result of each stage depends on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from hrcreplay import runs, wiring
from hrcreplay.job import TABLES, Job, plain_limits, urdf_digest, versions
from hrcreplay.records import Ints
from hrcreplay.tables import lacks
from hrcreplay.wiring import Source

#: What the fused person depends on, and the volumes; each stage works on what those before it hand on.
_PERSON = ("versions", "log", "ticks", "cameras", "settings logs", "settings fusion", "limits.tracking")
_VOLUMES = (*_PERSON, "settings occupancy", "limits.prediction")
#: Stage -> the parts that its tables, counts and notes depend on. The plan takes the volumes of every tick: how many
#: of them are stored changes nothing for it.
PARTS = {
    "fuse": (*_PERSON, "logs.gap_s"),
    "predict": (*_VOLUMES, "occupancy.store_hz"),
    "plan": (*_VOLUMES, "base", "programme", "settings robot", "settings plan"),
}


def parts(job: Job, log: Source, ticks_ns: Ints) -> dict[str, str]:
    """Digest of every part that a stage of the job depends on.

    A section of the settings counts whole, so that a new setting cannot be forgotten, but for the keys that stand here
    by themselves: a file counts by its content, ``joints_topic`` as the programme, for want of a task.

    Args:
        job: What was asked for.
        log: Where the job's cell and task say nothing, the log's own hold.
        ticks_ns: (n,) of the run [ns].

    Raises:
        SettingsError: The cell or the URDF cannot be used.
        LogError: The pose of a camera is not known.
    """
    settings = job.settings.model_dump(mode="json")
    eyes = wiring.eyes(job, log)
    found: dict[str, Any] = {
        "versions": versions(),
        "log": job.log_sha256,
        "ticks": [int(ticks_ns[0]), int(ticks_ns[-1]), len(ticks_ns)],
        "cameras": [log.header.cameras, eyes.T_world_camera.tolist(), eyes.clock_offset_ns.tolist()],
        "settings logs": _without(settings["logs"], "joints_topic", "gap_s"),
        "logs.gap_s": settings["logs"]["gap_s"],
        "settings fusion": settings["fusion"],
        "limits.tracking": _without(plain_limits(job.tracking), "name"),
        "settings occupancy": _without(settings["occupancy"], "store_hz"),
        "occupancy.store_hz": settings["occupancy"]["store_hz"],
        "limits.prediction": _without(plain_limits(job.prediction), "name"),
    }
    if "plan" in job.stages:
        base = wiring.base(job, log)
        found |= {
            "base": None if base is None else base.tolist(),
            "programme": job.task or log.header.task or {"joints_topic": settings["logs"]["joints_topic"]},
            "settings robot": [_without(settings["robot"], "urdf", "packages"), urdf_digest(job.settings)],
            "settings plan": _without(settings["plan"], "task"),
        }
    return {name: _digest(part) for name, part in found.items()}


def stages(job: Job, found: Mapping[str, str]) -> dict[str, str]:
    """Digest of all that the result of each stage of the job depends on, from those of ``parts``."""
    return {stage: _digest([found[name] for name in PARTS[stage]]) for stage in job.stages}


def stale(job: Job, found: Mapping[str, str]) -> dict[str, str]:
    """Stage -> why the earlier run's result is not the one that this job would make.

    A table that is damaged or of an earlier version speaks against the stages after its own, too.
    """
    if job.earlier is None:
        return {}
    meta, mine = runs.read_meta(job.earlier), stages(job, found)
    why: dict[str, str] = {}
    damage = None
    for stage in job.stages:
        damage = damage or _damage(job.earlier, stage, meta["outputs"])
        if meta.get("stages", {}).get(stage) != mine[stage]:
            why[stage] = _difference(stage, found, meta, job.earlier)
        elif damage is not None:
            why[stage] = damage
    return why


def _difference(stage: str, found: Mapping[str, str], meta: Mapping[str, Any], earlier: Path) -> str:
    theirs = meta.get("depends_on", {})
    different = [name for name in PARTS[stage] if theirs.get(name) != found[name]]
    if not theirs or not different:  # of a live session, or of an earlier version
        return f"{earlier} does not say what its tables depend on"
    return f"{', '.join(different)} {'is' if len(different) == 1 else 'are'} not as in {earlier}"


def _damage(folder: Path, stage: str, outputs: Mapping[str, str]) -> str | None:
    """What keeps an earlier run's tables of a stage from being taken for ours."""
    for name in sorted(name for name in outputs if any(fnmatch(name, pattern) for pattern in TABLES[stage])):
        path = folder / name
        if not path.exists() or runs.sha256(path) != outputs[name]:
            return f"{path} is not as its run left it"
        if missing := lacks(path):
            return f"{path} is of an earlier version, without {missing[0]}"
    return None


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _without(table: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {name: value for name, value in table.items() if name not in keys}
