"""Reuse of an earlier run's stages: the parts that a result depends on, their digests, and what is out of date."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.assembly import LogLike
from hrcreplay.pipeline.progress import print_note
from hrcreplay.pipeline.run_config import TABLES, RunConfig, urdf_digest, versions
from hrcreplay.records import Ints
from hrcreplay.settings.sections import Logs
from hrcreplay.store import run_folder
from hrcreplay.store.columns import missing_columns
from hrcreplay.store.run_folder import RunWriter

#: Parts that the fused person and the volumes depend on; each stage also depends on the stages before it.
_PERSON = ("versions", "log", "ticks", "cameras", "watched", "settings logs", "settings fusion", "limits.tracking")
_VOLUMES = (*_PERSON, "settings prediction", "limits.prediction")
_PROGRAMME = ("base", "objects", "programme", "settings robot", "settings plan")
_JOINT_SETTINGS = tuple(key for key in Logs.model_fields if key.startswith("joint"))
#: Stage -> the parts that its tables, counts and notes depend on. The plan uses the volumes of every tick, so the
#: storage rate is not one of its parts.
PARTS = {
    "fuse": (*_PERSON, "logs.gap_s"),
    "predict": (*_VOLUMES, "prediction.store_hz"),
    "plan": (*_VOLUMES, *_PROGRAMME),
}


def parts_of(run_config: RunConfig, stage: str) -> tuple[str, ...]:
    """Returns the parts that a stage of a run depends on.

    Volumes that are stored with a plan have the horizon that the chosen method requested, so they depend on it.
    """
    planned = "plan" in run_config.stages and run_config.settings.plan.horizon == "adaptive"
    return (*PARTS[stage], *_PROGRAMME) if planned and stage == "predict" else PARTS[stage]


def dependencies(run_config: RunConfig, log: LogLike, ticks_ns: Ints) -> dict[str, str]:
    """Computes the digest of every part that a stage of the run depends on.

    A section of the settings counts as a whole, so that a new setting cannot be forgotten. Some keys count separately:
    a file by its content; the settings of the joints as part of the programme, if there is no task.

    Args:
        run_config: The run.
        log: Log of the run; its cell and task are used where the run has none.
        ticks_ns: (n,) of the run [ns].

    Raises:
        SettingsError: The cell or the URDF cannot be used.
        LogError: The pose of a camera is not known.
    """
    settings = run_config.settings.model_dump(mode="json")
    fusion_stage = assembly.fusion_stage(run_config, log)
    found: dict[str, Any] = {
        "versions": versions(),
        "log": run_config.log_sha256,
        "ticks": [int(ticks_ns[0]), int(ticks_ns[-1]), len(ticks_ns)],
        "cameras": [log.header.cameras, fusion_stage.T_world_camera.tolist(), fusion_stage.clock_offset_ns.tolist()],
        "watched": None
        if run_config.cell is None or run_config.cell.watched is None
        else run_config.cell.watched.model_dump(),
        "settings logs": _without(settings["logs"], *_JOINT_SETTINGS, "gap_s"),
        "logs.gap_s": settings["logs"]["gap_s"],
        "settings fusion": settings["fusion"],
        "limits.tracking": _without(run_config.tracking_limits.plain(), "name"),
        "settings prediction": _without(settings["prediction"], "store_hz"),
        "prediction.store_hz": settings["prediction"]["store_hz"],
        "limits.prediction": _without(run_config.prediction_limits.plain(), "name"),
    }
    if "plan" in run_config.stages:
        base = assembly.known_robot_base(run_config, log)
        found |= {
            "base": None if base is None else base.tolist(),
            "objects": _objects(run_config),
            "programme": _programme(run_config, log, {key: settings["logs"][key] for key in _JOINT_SETTINGS}),
            "settings robot": [_without(settings["robot"], "urdf", "packages"), urdf_digest(run_config.settings)],
            "settings plan": _without(settings["plan"], "task"),
        }
    return {name: _digest(part) for name, part in found.items()}


def person_digest(run_config: RunConfig) -> str:
    """Computes a digest over all that the fused person depends on, except the log: the same for settings that share it.

    The digests of ``stage_digests`` decide whether a stage is reused; this one only groups runs before logs are read.
    """
    settings = run_config.settings.model_dump(mode="json")
    cell = None if run_config.cell is None else run_config.cell.to_dict()
    return _digest(
        [
            _without(settings["logs"], *_JOINT_SETTINGS),
            settings["fusion"],
            _without(run_config.tracking_limits.plain(), "name"),
            None if cell is None else {name: cell.get(name) for name in ("cameras", "watched")},
            [run_config.start_s, run_config.end_s],
        ]
    )


def _programme(run_config: RunConfig, log: LogLike, joint_settings: dict[str, Any]) -> Any:
    """Returns what the programme and the robot as recorded depend on, beside the log."""
    task = run_config.task or log.header.task
    return [task, joint_settings] if task and log.header.joint_topics else task or joint_settings


def _objects(run_config: RunConfig) -> list[Any]:
    """Returns the objects of the cell and what its cameras see, which the notes of a plan depend on."""
    cell = run_config.cell
    if cell is None:
        return []
    return [*(one.to_dict() for one in cell.objects), *(view.model_dump() for view in cell.views.values())]


def stage_digests(run_config: RunConfig, found: Mapping[str, str]) -> dict[str, str]:
    """Computes one digest per stage over all inputs of its result, from those of ``dependencies``."""
    return {stage: _digest([found[name] for name in parts_of(run_config, stage)]) for stage in run_config.stages}


def stale_stages(run_config: RunConfig, found: Mapping[str, str]) -> dict[str, str]:
    """Stage -> reason for which the earlier run's result differs from that of this run.

    A table that is damaged or of an earlier version also invalidates the later stages.
    """
    if run_config.earlier is None:
        return {}
    meta, mine = run_folder.read_meta(run_config.earlier), stage_digests(run_config, found)
    why: dict[str, str] = {}
    damage = None
    for stage in run_config.stages:
        damage = damage or _damage(run_config.earlier, stage, meta["outputs"])
        if meta.get("stages", {}).get(stage) != mine[stage]:
            why[stage] = _difference(parts_of(run_config, stage), found, meta, run_config.earlier)
        elif damage is not None:
            why[stage] = damage
    if "predict" in why and "plan" in run_config.stages and run_config.settings.plan.horizon == "adaptive":
        why.setdefault("plan", "the volumes to store are those that it requests")
    return why


def _difference(parts: tuple[str, ...], found: Mapping[str, str], meta: Mapping[str, Any], earlier: Path) -> str:
    theirs = meta.get("depends_on", {})
    different = [name for name in parts if theirs.get(name) != found[name]]
    if not theirs or not different:  # of a live session, or of an earlier version
        return f"{earlier} does not contain the inputs of its tables"
    return f"{', '.join(different)} {'is' if len(different) == 1 else 'are'} not as in {earlier}"


def _damage(folder: Path, stage: str, outputs: Mapping[str, str]) -> str | None:
    """Returns the reason for which an earlier run's tables of a stage cannot be reused."""
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


def take_over(run_config: RunConfig, parts: Mapping[str, str], writer: RunWriter, *, smooth: bool) -> tuple[str, ...]:
    """Copies the tables of the earlier run's stages that have the same result in this run; returns these stages.

    Args:
        run_config: The run.
        parts: Result of ``dependencies``.
        writer: Run folder.
        smooth: True: the smoothed person is requested too.
    """
    if run_config.earlier is None:
        return ()
    stale = stale_stages(run_config, parts)
    if smooth:
        stale.setdefault("fuse", f"{run_config.earlier} holds no covariances to smooth with")
    reused = tuple(stage for stage in run_config.stages if stage not in stale)
    for stage in run_config.stages:
        names = [name for pattern in TABLES[stage] for name in sorted(p.name for p in run_config.earlier.glob(pattern))]
        if stage in reused:
            for name in names:
                writer.copy(name, run_config.earlier)
            print_note(f"{stage}: taken over from {run_config.earlier}")
        elif names:
            print_note(f"{stage}: {stale[stage]}; computed again")
    return reused
