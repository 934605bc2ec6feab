"""Fits the constants of the reported deviations: ``python -m tests.tools.deviations``, with others' recordings.

Writes docs/deviations.md, and says what ``human.fusion.reported_deviations.FITTED`` would be right.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from hrcreplay.audit.recorded_motion import errors_in_deviations
from hrcreplay.evaluation.recorded_person import TRUTH
from hrcreplay.evaluation.recording import fuse_stretches, read_recording
from hrcreplay.human.fusion.fuse import Trace
from hrcreplay.human.fusion.reported_deviations import FITTED, KIND
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly, stages
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.records import JOINTS, Floats
from tests.tools.people import fused

OUT = Path(__file__).parents[2] / "docs/deviations.md"
KINDS = ("x, y", "theta", "rho", "alpha_1", "alpha_2", "alpha_3", "alpha_4", "z")
#: Ticks between two samples; larger errors, in deviations with a factor of the spread alone, are clipped.
_EVERY, _MOST = 5, 20.0
_SIGMAS = (1, 2, 3)


@dataclass(frozen=True)
class Sample:
    """One log: errors of p and v, and what the filter says of them."""

    name: str
    true: bool
    error: Floats  #: (2, n, 13)
    std: Floats  #: (2, n, 13) of the filter alone
    spread: Floats  #: (n, 13)
    autocorrelation: Floats  #: (n, 13)
    bounds: tuple[float, float]  #: least and largest factor on the variance

    def in_deviations(self, fitted: Floats) -> Floats:
        """(2, n, 13) errors over the deviations that these constants, as FITTED, report."""
        offset, slope = (fitted[KIND, :, i].T[:, None] for i in range(2))  # (2, 1, 13)
        log = offset + slope * self.autocorrelation
        return self.error / (self.std * np.sqrt(np.clip(self.spread * np.exp(log), *self.bounds)))


def sample(run: Path) -> Sample:
    """Reads the log of a run folder."""
    run_config = resolve("fit-limits", run)
    log, settings = open_log(run_config.log, run_config.settings.logs), run_config.settings.fusion
    stage, ticks_ns = assembly.fusion_stage(run_config, log), stages.span_ticks(run_config, log)
    recording = read_recording(log, ticks_ns, stage, lambda _: None)
    parts = fuse_stretches(
        open_log(run_config.log, run_config.settings.logs), ticks_ns, stage, Counter(), lambda _: None
    )
    trace = Trace.join([part for *_, part in parts])
    ticks, states = np.arange(0, len(recording.states), _EVERY), recording.states
    reported = np.stack([states.p_std, states.v_std])[:, ticks]
    return Sample(
        run_config.log.name,
        recording.source == TRUTH,
        errors_in_deviations(recording, ticks) * reported,
        np.sqrt(np.stack([trace.cov[ticks, :, a, a] for a in range(2)])),
        trace.spread[ticks],
        trace.autocorrelation[ticks],
        (settings.spread_least, settings.spread_most),
    )


def fit(samples: Sequence[Sample]) -> Floats:
    """(kinds, 2, 2) the most likely constants, errors normal; each log weighs as the root of its ticks."""
    found = np.zeros((len(KINDS), 2, 2))
    for a in range(2):
        for kind in range(len(KINDS)):
            squares, rho, weight = [], [], []
            for of in samples:
                with np.errstate(invalid="ignore", divide="ignore"):
                    square = (of.error[a] / of.std[a])[:, kind == KIND] ** 2
                known = np.isfinite(square) & (of.spread[:, kind == KIND] > 0.0)
                square = np.minimum(square[known] / of.spread[:, kind == KIND][known], _MOST**2)
                squares.append(square)
                rho.append(of.autocorrelation[:, kind == KIND][known])
                weight.append(np.full(len(square), max(1, len(square)) ** -0.5))
            found[kind, a] = _most_likely(*(np.concatenate(part) for part in (squares, rho, weight)))
    return found


def _most_likely(square: Floats, rho: Floats, weight: Floats) -> Floats:
    """(2,) offset and slope of the logarithm of the variance over the autocorrelation ``rho``."""
    X, w = np.column_stack([np.ones(len(square)), rho]), weight / weight.sum()

    def loss(b: Floats) -> tuple[float, Floats]:
        log = X @ b
        over = square * np.exp(-log)
        return float((w * (log + over)).sum()), X.T @ (w * (1.0 - over))

    return np.asarray(minimize(loss, np.zeros(2), jac=True, method="BFGS").x)


def pooled(errors: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Root mean square (2, 13), and share within 1, 2, 3 deviations (3, 2, 13), of some logs; each weighs the same."""
    mean_square = np.nanmean([np.nanmean(z**2, axis=1) for z in errors], axis=0)
    within = [[np.nanmean(np.where(np.isfinite(z), np.abs(z) <= s, np.nan), axis=1) for s in _SIGMAS] for z in errors]
    return np.sqrt(mean_square), np.nanmean(within, axis=0)


def lines(samples: Sequence[Sample]) -> list[str]:
    """The tables."""
    filter_alone = [of.error / of.std for of in samples]
    left_out = [of.in_deviations(fit([other for other in samples if other is not of])) for of in samples]
    reported = [of.in_deviations(FITTED) for of in samples]
    text = [
        "# Accuracy of the reported deviations",
        "",
        "`state.parquet` has a standard deviation for each position and velocity. This page compares them with the",
        "errors, against the truth of simulated logs and against recordings smoothed with later frames. It is",
        "written by `make deviations`, which also fits the constants of",
        "`hrcreplay/human/fusion/reported_deviations.py`; *filter alone* is the covariance of the Kalman filter, *left",
        "out* are constants fitted to the other logs, *reported* those in the code. The ratio of an error",
        "to its deviation has a root mean square (rms) of 1 if the deviation is right, and more if it is too small. Of",
        "normal errors 68, 95 and 99.7 % are within 1, 2 and 3 deviations.",
        "Six of the simulated logs are alike, people who get up, so leaving out one of them is a weak test.",
        "",
    ]
    for true, title in ((True, "Against the truth"), (False, "Against smoothed recordings")):
        which = [i for i, of in enumerate(samples) if of.true == true]
        text += ["", f"## {title}", "", f"{len(which)} logs, each of the same weight.", ""]
        text += [
            "| | position | | | | velocity | | | |",
            "|---|---|---|---|---|---|---|---|---|",
            "| joint | filter alone | left out | reported | within 1, 2, 3 | alone | left out | reported | within |",
        ]
        alone, left, now = (pooled([z[i] for i in which]) for z in (filter_alone, left_out, reported))
        for j, joint in enumerate(JOINTS):
            cells = []
            for a in range(2):
                cells += [f"{of[0][a, j]:.2f}" for of in (alone, left, now)]
                cells.append(", ".join(f"{100.0 * share:.0f}" for share in now[1][:, a, j]) + " %")
            text.append(f"| {joint} | {' | '.join(cells)} |")
    text += ["", "## Each log, its constants left out: rms over all joints that were seen", ""]
    text += ["| log | position: filter alone | left out | velocity: filter alone | left out |", "|---|---|---|---|---|"]
    for of, before, after in zip(samples, filter_alone, left_out, strict=True):
        cells = [f"{np.sqrt(np.nanmean(z[a] ** 2)):.2f}" for a in range(2) for z in (before, after)]
        text.append(f"| {of.name} | {' | '.join(cells)} |")
    return [*text, ""]


def main() -> None:
    """Writes the tables; exit code 5 where the constants are not those that this fit finds."""
    argparse.ArgumentParser(prog="python -m tests.tools.deviations", description=__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        samples = [sample(run) for run in fused(Path(folder)).values()]
    OUT.write_text("\n".join(lines(samples)))
    found = np.round(fit(samples), 2)
    if (found != FITTED).any():
        sys.stdout.write(f"FITTED: would be right: {found.tolist()}\n")
        sys.exit(5)


if __name__ == "__main__":
    main()
