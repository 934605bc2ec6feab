"""The command ``audit``: reads logs, compares people with their predictions and writes the run folder."""

from __future__ import annotations

import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pyarrow as pa

from hrcreplay.audit import page
from hrcreplay.audit.figures import draw_all
from hrcreplay.audit.log_audit import (
    EVERY,
    EVERY_SHORTER,
    LogAudit,
    audit_log,
    compared_methods,
    factors,
    joint_travel,
    methods,
    shorter,
    standstill_s,
)
from hrcreplay.audit.measures import DRAWS, LEVEL, Resampling, block_ticks, resample
from hrcreplay.audit.metrics import (
    checked_scope,
    curve_point,
    deviation_figures,
    escapes,
    first_movements,
    headline_metrics,
    horizon_point,
    joint_figures,
    method_figures,
    unchecked_notes,
)
from hrcreplay.audit.recorded_motion import first_movements_ns
from hrcreplay.errors import SettingsError
from hrcreplay.evaluation.containment import AUDIT_HZ, Outcome
from hrcreplay.evaluation.recorded_person import TRUTH
from hrcreplay.human.prediction import swept_volumes
from hrcreplay.human.prediction.swept_volumes import limb_radii
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.kernel_build import ensure_compiled
from hrcreplay.pipeline.progress import print_note
from hrcreplay.pipeline.run_config import RunConfig, RunOptions, resolve
from hrcreplay.pipeline.surroundings import PredictionStage
from hrcreplay.reporting.tables import percent
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import RunWriter, Stopwatch

#: Columns of escapes.parquet.
_ESCAPES = pa.schema(
    [
        *((name, pa.string()) for name in ("log", "method", "limb")),
        *((name, pa.float64()) for name in ("from_s", "to_s", "deepest_at_s", "deepest_m")),
        *((name, pa.int64()) for name in ("ticks", "deepest_t_ns")),
    ]
)
#: Seed of the bootstrap: an arbitrary but fixed number.
SEED = 3


def run(sources: Sequence[Path], *, out: Path | None = None, **options: Unpack[RunOptions]) -> Path:
    """Audits logs, or the logs of earlier runs with the settings and cells of those runs.

    The total counts every audited tick of every log once, so it is a share of the recorded time and a long log has more
    weight. Its intervals resample each log separately and keep its length: they hold for more recordings of the same
    people at the same work, not for other people.

    Args:
        sources: Logs, or run folders of earlier commands.
        out: Run folder to make; None: ``reports/<log>/<UTC>-audit``.
        **options: Settings, cell and span, as ``run_config.resolve`` takes them.

    Returns:
        The run folder: audit.json, audit.parquet (a row per tick, method and limb), escapes.parquet (a row per escape),
        figures, report.html.

    Raises:
        SettingsError: A setting, a cell or the output folder cannot be used.
        LogError: A log cannot be read, is shorter than the horizon, or shows no person.
    """
    began = datetime.now(UTC)
    run_configs = [resolve("audit", source, **options) for source in sources]
    _check_alike(run_configs)
    ensure_compiled()
    with RunWriter(out or Path("reports") / run_configs[0].log.stem / f"{began:%Y%m%dT%H%M%SZ}-audit") as writer:
        watch = Stopwatch(time.perf_counter_ns)
        audits = [
            audit
            for run_config, name in zip(run_configs, _names(run_configs), strict=True)
            for audit in audit_log(run_config, name, watch)
        ]
        for audit in audits:
            _write_rows(audit, writer)
        found = audit_results(audits)
        for log in found["logs"]:
            for note in log["notes"]:
                print_note(f"{log['log']}: {note}")
        _write_escapes(found, writer)
        writer.close_tables()
        meta = _meta(run_configs, began)
        _write_report(found, meta, writer)
        writer.timing.update(watch.summary(1.0 / AUDIT_HZ))
        writer.finish(meta)
        for line in _summary(found):
            print_note(line)
        return writer.folder


def _write_report(found: dict[str, Any], meta: dict[str, Any], writer: RunWriter) -> None:
    """Writes audit.json, metrics.json, the figures, and the page that shows them."""
    writer.text("audit.json", run_folder.to_json(found))
    folder = writer.partial / "figures"
    draw_all(found, folder)
    metrics = headline_metrics(found)
    writer.text("metrics.json", run_folder.to_json(metrics))
    writer.text("report.html", page.render(found, metrics, meta, folder))


def _summary(found: dict[str, Any]) -> list[str]:
    """Returns the main figures, one line per log."""
    method, lines = found["method"], []
    for log in found["logs"]:
        whole = log["methods"][method]["all"]
        share, room, deepest = whole["covered_share"], whole["union_m3"]["value"], whole["escape_max_m"]
        words = f"audit: {log['log']}: {method}, {log['limits']}: every whole limb that was checked "
        words += f"({checked_scope(log, method)}) inside in {percent(share)} of "
        words += f"{share['samples']:,} ticks (its points alone: {percent(whole['points_share'])})"
        words += "" if room is None else f"; union {room:.1f} m3"
        lines.append(words + ("" if deepest is None else f"; deepest escape {1e3 * deepest:.0f} mm"))
    return lines


def _check_alike(run_configs: Sequence[RunConfig]) -> None:
    """Raises SettingsError for logs whose ticks cannot be counted together."""
    stages = [assembly.prediction_stage(run_config) for run_config in run_configs]
    for what, values in (
        ("prediction.stop_s and latency_s", [standstill_s(one) for one in stages]),
        ("prediction.method", [one.method for one in stages]),
        ("prediction.radius_*", [limb_radii(one.settings).tolist() for one in stages]),
        ("the margins of prediction", [_margins(one) for one in stages]),
    ):
        for run_config, value in zip(run_configs, values, strict=True):
            if value != values[0]:
                raise SettingsError(
                    f"{what}: {run_config.log.name} and {run_configs[0].log.name} differ, and one audit has one "
                    "horizon, method and body; audit them apart, or give one with --set"
                )


def audit_results(audits: Sequence[LogAudit]) -> dict[str, Any]:
    """Returns the content of audit.json."""
    prediction_stage = assembly.prediction_stage(audits[0].run_config)
    horizon_s = standstill_s(prediction_stage)
    lengths = [len(audit.outcomes[methods()[0]]) for audit in audits]
    block = block_ticks(horizon_s, AUDIT_HZ, max(lengths))
    drawn = resample(lengths, block, horizon_s * AUDIT_HZ, SEED)
    edges = np.concatenate([[0], np.cumsum(lengths)])
    logs = []
    for k, audit in enumerate(audits):
        mine = drawn.of(slice(edges[k], edges[k + 1]))
        start_ns = int(audit.recording.states.t_ns[0])
        own, moved_ns = audit.outcomes[prediction_stage.method], first_movements_ns(audit.recording)
        logs.append(
            {
                "log": audit.name,
                "sha256": audit.run_config.log_sha256,
                "recorded_future": audit.recording.source,
                "limits": audit.run_config.prediction_limits.name,
                "ticks": lengths[k],
                "counts": audit.recording.counts,
                "cameras": _cameras(audit),
                "points": audit.points,
                "methods": _methods([audit], mine),
                "joints": _joints([audit], mine),
                "deviations": deviation_figures(audit.errors),
                "curve": _curves([audit]),
                "horizons": _horizons([audit]),
                "first_movements": first_movements(own, moved_ns, horizon_s, start_ns),
                "escapes": {method: escapes(outcome, start_ns) for method, outcome in audit.outcomes.items()},
            }
        )
        logs[-1]["notes"] = [*audit.notes, *unchecked_notes(logs[-1], prediction_stage.method)]
    return {
        "horizon_s": horizon_s,
        "audit_hz": AUDIT_HZ,
        "interval": {"level": LEVEL, "block_ticks": block, "draws": DRAWS, "seed": SEED},
        "method": prediction_stage.method,
        "own_methods": list(swept_volumes.METHODS),
        "logs": logs,
        "total": {
            "ticks": sum(lengths),
            "points": {
                limb: {point: sum(audit.points[limb][point] for audit in audits) for point in points}
                for limb, points in audits[0].points.items()
            },
            "methods": _methods(audits, drawn),
            "joints": _joints(audits, drawn),
            "deviations": deviation_figures(np.concatenate([audit.errors for audit in audits], axis=1)),
            "curve": _curves(audits),
            "horizons": _horizons(audits),
        },
    }


def _margins(prediction_stage: PredictionStage) -> tuple[Any, ...]:
    """Returns the margins that ``sound`` adds to the model."""
    prediction = prediction_stage.settings
    names = ("sigmas", "latency_s", "hand_m", "legs_radius_m", "legs", "residual", "residual_unknown_m")
    return (*(getattr(prediction, name) for name in names), prediction_stage.memory_s)


def _methods(audits: Sequence[LogAudit], drawn: Resampling) -> dict[str, Any]:
    return {method: method_figures([audit.outcomes[method] for audit in audits], drawn) for method in methods()}


def _joints(audits: Sequence[LogAudit], drawn: Resampling) -> dict[str, Any]:
    went = np.max([joint_travel(audit.recording.joints) for audit in audits], axis=0)
    return {
        method: joint_figures(np.concatenate([audit.joints[method] for audit in audits]), went, drawn)
        for method in swept_volumes.METHODS
    }


def _curves(audits: Sequence[LogAudit]) -> dict[str, Any]:
    horizon_s = standstill_s(assembly.prediction_stage(audits[0].run_config))

    def point(method: str, factor: float) -> dict[str, Any]:
        outcomes = [audit.curve[method][factor] for audit in audits]
        rate_hz = AUDIT_HZ if factor == 1.0 else AUDIT_HZ / EVERY
        lengths = [len(outcome) for outcome in outcomes]
        block = block_ticks(horizon_s, rate_hz, max(lengths))
        return {"factor": factor, **curve_point(outcomes, resample(lengths, block, horizon_s * rate_hz, SEED))}

    return {method: [point(method, factor) for factor in factors(method)] for method in swept_volumes.METHODS}


def _horizons(audits: Sequence[LogAudit]) -> list[dict[str, Any]]:
    """Returns the coverage of whole limbs at each horizon; the last one is the horizon of the audit."""
    prediction_stage = assembly.prediction_stage(audits[0].run_config)

    def point(horizon_s: float, rate_hz: float, outcomes: Sequence[Outcome]) -> dict[str, Any]:
        lengths = [len(outcome) for outcome in outcomes]
        block = block_ticks(horizon_s, rate_hz, max(lengths))
        return horizon_point(outcomes, resample(lengths, block, horizon_s * rate_hz, SEED))

    at_fewer = AUDIT_HZ / EVERY_SHORTER
    compared = compared_methods(prediction_stage)
    found: list[dict[str, Any]] = [
        {"horizon_s": h, "methods": {m: point(h, at_fewer, [a.horizons[h][m] for a in audits]) for m in compared}}
        for h in shorter(prediction_stage)
    ]
    own = standstill_s(prediction_stage)
    whole = {m: point(own, AUDIT_HZ, [a.outcomes[m] for a in audits]) for m in compared}
    return [*found, {"horizon_s": own, "methods": whole}]


def _write_rows(audit: LogAudit, writer: RunWriter) -> None:
    """Writes one row per tick, limb and method."""
    for method, outcome in audit.outcomes.items():
        ticks, limbs = len(outcome), len(outcome.limbs)
        escape = outcome.escape_m().ravel()
        points = outcome.escape_m(points_alone=True).ravel()
        seen = np.isfinite(escape)
        writer.table(
            "audit",
            {
                "t_ns": np.repeat(outcome.t_ns, limbs),
                "log": pa.array([audit.name] * (ticks * limbs), type=pa.string()),
                "method": pa.array([method] * (ticks * limbs), type=pa.string()),
                "limb": pa.array(list(outcome.limbs) * ticks, type=pa.string()),
                "covered": pa.array(escape == 0.0, mask=~seen),
                "escape_m": escape,
                "points_covered": pa.array(points == 0.0, mask=~seen),
                "beyond_hull_m": outcome.beyond_m.ravel(),
                "radius_m": outcome.radius_m.ravel(),
                "volume_m3": outcome.volume_m3.ravel(),
            },
        )


def _write_escapes(found: dict[str, Any], writer: RunWriter) -> None:
    """Writes one row per escape: log, method, limb, start, number of ticks, distance."""
    rows = [
        {"log": log["log"], "method": method, **escape}
        for log in found["logs"]
        for method, every in log["escapes"].items()
        for escape in every
    ]
    table = pa.Table.from_pylist(rows, _ESCAPES)
    writer.table("escapes", {name: table[name] for name in table.column_names})


def _cameras(audit: LogAudit) -> dict[str, dict[str, int | None]]:
    """Returns, per camera, the counts of observed and rejected points; None if none was rejected."""
    counts = audit.recording.counts
    names = {
        "frames": "frames",
        "unseen_points": "audit_unseen_points",
        "doubted_points": "audit_doubted_points",
        "rejected_frames": "audit_rejected_frames",
        "rejected_points": "audit_rejected_points",
        "outlier_points": "outlier_points",
    }
    unasked = audit.recording.source == TRUTH
    return {
        camera: {
            key: None if unasked and name.startswith("audit") else counts.get(f"{name}_{camera}", 0)
            for key, name in names.items()
        }
        for camera in audit.recording.states.cameras
    }


def _names(run_configs: Sequence[RunConfig]) -> list[str]:
    """Returns a short name for each log; equal names get numbers."""
    stems = [run_config.log.stem for run_config in run_configs]
    return [s if stems.count(s) == 1 else f"{s} ({stems[:i].count(s) + 1})" for i, s in enumerate(stems)]


def _meta(run_configs: Sequence[RunConfig], began: datetime) -> dict[str, Any]:
    meta = run_configs[0].meta()
    others = [run_config.meta() for run_config in run_configs]
    return {
        **meta,
        "inputs": [part["inputs"][0] for part in others],
        "cells": [part["cell"] for part in others],
        "settings_by_log": [part["settings"] for part in others],
        "created": f"{began:%Y-%m-%dT%H:%M:%SZ}",
    }
