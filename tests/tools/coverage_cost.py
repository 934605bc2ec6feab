"""What it costs to hold recorded people: share inside and mean union, for narrower and wider lines than those shipped.

    python -m tests.tools.coverage_cost [--json] [NAME...]

The lines of the limit set `people` times each of some factors, over all recordings of others together; they were in its
fit, so this favours it. Prints a line for each factor: at each horizon the share of ticks in which all recorded
limbs stayed whole in their volumes, and the mean over the recordings of the volume of their union.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from hrcreplay.audit.departure_fit import widen
from hrcreplay.audit.departures import LimbDepartures, departures, union_m3
from hrcreplay.evaluation.containment import select_rows
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import RunOptions, resolve
from hrcreplay.pipeline.stages import span_ns, tick_times
from hrcreplay.pipeline.surroundings import PredictionStage
from tests.tools import bases, partly_seen
from tests.tools.readme.measurements import COST_FACTORS, RECORDINGS


def departed(name: str, tmp: Path) -> tuple[PredictionStage, LimbDepartures]:
    """The departures of a recording, and the stage that they were measured with."""
    path, cell, config = bases.recorded(name, tmp)
    run_config = resolve("audit", path, **RunOptions(cell_file=cell, config=config))
    stage, settings = assembly.prediction_stage(run_config), run_config.settings
    log = open_log(run_config.log, settings.logs)
    ticks_ns = tick_times(*span_ns(run_config, log), settings.fusion.rate_hz)
    recording = partly_seen.read(log, run_config, ticks_ns)
    fresh_s, rate_hz = settings.fusion.fresh_s, settings.fusion.rate_hz
    rows = select_rows(recording.states, int(recording.t_ns[-1]), rate_hz, stage.horizon_s, fresh_s)
    return stage, departures(stage, recording, rows)


def cost(stage: PredictionStage, samples: list[LimbDepartures], factor: float) -> dict[str, list[float]]:
    """Share inside, over all ticks together, and mean union [m^3], at each horizon of the limit set."""
    known = stage.limits.departure
    assert known is not None
    lines = widen(known, np.full(len(known.horizon_s), factor))
    inside = [np.concatenate([sample.inside(lines, k) for sample in samples]) for k in range(len(lines.horizon_s))]
    sizes_m3 = np.mean([union_m3(stage, sample, lines) for sample in samples], axis=0)
    return {"shares": [float(np.nanmean(of)) for of in inside], "union_m3": sizes_m3.tolist()}


def measure(names: list[str]) -> dict[str, dict[str, list[float]]]:
    """Factor -> its cost over some recordings."""
    samples = []
    for name in names:
        with tempfile.TemporaryDirectory() as tmp:
            stage, sample = departed(name, Path(tmp))
        samples.append(sample)
    return {f"{factor:g}": cost(stage, samples, factor) for factor in COST_FACTORS}


def parser() -> argparse.ArgumentParser:
    """The arguments."""
    return bases.parser("coverage_cost", __doc__, "factor by factor")


def main() -> None:
    """Measures and prints."""
    given = parser().parse_args()
    found = measure(given.names or list(RECORDINGS.values()))
    if given.json:
        print(json.dumps(found))  # noqa: T201
        return
    for factor, of in found.items():
        cells = [f"{share:.1%}, {size:.2f} m3" for share, size in zip(of["shares"], of["union_m3"], strict=True)]
        print(f"{factor} | {' | '.join(cells)}")  # noqa: T201


if __name__ == "__main__":
    main()
