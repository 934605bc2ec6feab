"""The report of a run: metrics first, then what only reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay import runs, wiring
from hrcreplay.job import Job
from hrcreplay.pipeline import Foresight
from hrcreplay.records import Floats, HumanStates
from hrcreplay.report import figures, metrics, page, tables
from hrcreplay.report.figures_human import Instant
from hrcreplay.report.summary import lines
from hrcreplay.runs import Run, RunWriter
from hrcreplay.tables import read_states


def write_report(job: Job, writer: RunWriter, meta: dict[str, Any]) -> None:
    """Leaves metrics.json, the figures and report.html beside the tables that have just been written."""
    near = _bounds(job.settings.model_dump())
    run = runs.read(writer.partial, meta)
    found = metrics.compute(run, **near)
    writer.text("metrics.json", runs.to_json(found))
    foresight = wiring.foresight(job)
    radii = {name.replace("_", " "): radius for name, radius in asdict(foresight.radii).items()}
    if foresight.method == "sound" and foresight.margins.legs:
        radii["legs, of sound"] = foresight.margins.legs_radius_m
    folder = writer.partial / "figures"
    figures.draw_all(run, folder, found, **near, volumes=_instants(foresight, run))
    shown = [
        tables.limit_table(job.prediction, use="prediction"),
        tables.limit_table(job.tracking, use="tracking"),
        tables.radius_table(radii),
    ]
    writer.text("report.html", page.render(run, found, folder, shown))


def summary(folder: Path) -> list[str]:
    """The main figures of a run, a line a stage."""
    run = runs.read(folder)
    return lines(run, metrics.compute(run, **_bounds(run.meta["settings"])))


def _bounds(settings: Mapping[str, Any]) -> dict[str, float]:
    """What the metrics ask of the settings."""
    return {
        "near_m": settings["report"]["near_m"],
        "stationary_m_per_s": settings["report"]["stationary_m_per_s"],
        "gap_s": settings["logs"]["gap_s"],
    }


def _instants(foresight: Foresight, run: Run) -> list[Instant]:
    """The swept volumes by the paper's two methods and the run's own at the instants that Fig. 17 shows."""
    wanted = figures.instants(run)
    if not len(wanted):
        return []
    states = HumanStates.join(
        [batch.rows(np.isin(batch.t_ns, wanted)) for batch in read_states(run.folder / "state.parquet", 4096)]
    )
    methods = dict.fromkeys(("paper", "positions", foresight.method))
    by_method = {method: foresight.volumes(states, method) for method in methods}

    def hulls(method: str, row: int) -> dict[str, tuple[Floats, float]]:
        volumes = by_method[method]
        return {
            limb: (volumes.vertices(row, i), float(volumes.radius_m[row, i])) for i, limb in enumerate(volumes.limbs)
        }

    return [(int(t), {method: hulls(method, row) for method in by_method}) for row, t in enumerate(states.t_ns)]
