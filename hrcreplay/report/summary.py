"""A run in a line for each stage, from the metrics that its page shows."""

from __future__ import annotations

from collections.abc import Mapping

from hrcreplay.report import story
from hrcreplay.report.metrics_quality import cameras
from hrcreplay.report.metrics_table import Metric
from hrcreplay.report.tables import percent, text_of
from hrcreplay.runs import Run

Metrics = Mapping[str, Metric]


def lines(run: Run, metrics: Metrics) -> list[str]:
    """The main figures of each stage that the run holds; of a report also its answers.

    Args:
        run: The run's tables.
        metrics: What :func:`hrcreplay.report.metrics.compute` found.
    """
    found = []
    if run.state is not None:
        found.append(f"fuse: {_fuse(run, metrics)}")
    if run.occupancy is not None:
        found.append(f"predict: {_predict(run, metrics)}")
    if run.motion is not None:
        others = {name: f"baseline_{name}" for name in sorted(run.baselines)}
        plans = {str(metrics["plan_method"]["value"]): "plan", **others}
        found.append("plan: " + "; ".join(f"{name}: {_plan(metrics, prefix)}" for name, prefix in plans.items()))
    if run.meta.get("command") == "report":
        found.append("report: " + " ".join(answer.short for answer in story.answers(run, metrics)))
    return [line.replace("\u202f", ",") for line in found]  # the page's separator is not in every terminal's font


def _fuse(run: Run, metrics: Metrics) -> str:
    ticks = metrics["ticks"]["value"]
    unknown = metrics["ticks_before_first_state"]["value"] + metrics["ticks_state_lost"]["value"]
    frames = ", ".join(f"{name} {text_of(metrics[f'camera_{name}_frames'])}" for name in cameras(run))
    outliers = sum(count for name, count in run.counts.items() if name.startswith("outlier_points_"))
    return (
        f"{text_of(metrics['ticks'])} ticks, person known in {100 * (1 - unknown / ticks):.1f} %; "
        f"frames with the person: {frames}; {outliers:,} outlier points"
    )


def _predict(run: Run, metrics: Metrics) -> str:
    settings = run.meta["settings"]["occupancy"]
    limits = run.meta["limits"]["prediction"]["name"]
    name = f"occupancy_{settings['method']}"
    words = f"{settings['method']}, {limits}: the six limbs {text_of(metrics.get(f'{name}_sum_m3'))}"
    if f"{name}_LEGS_m3" in metrics:
        words += f", lower body {text_of(metrics[f'{name}_LEGS_m3'])}"
    return words + " (means of the stored ticks; overlaps of limbs count twice)"


def _plan(metrics: Metrics, prefix: str) -> str:
    words = [f"{text_of(metrics[f'{prefix}_braking_moving_ticks'])} ticks braking while moving"]
    if metrics[f"{prefix}_stationary_share"]["value"] is not None:
        words.insert(0, f"standing in {percent(metrics[f'{prefix}_stationary_share'])} of the near ticks")
    if metrics[f"{prefix}_progress_share"]["value"] is not None:
        words.insert(0, f"{percent(metrics[f'{prefix}_progress_share'])} of the programmed pace")
    return ", ".join(words)
