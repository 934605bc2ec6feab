"""Metrics of the data that went in, and of the volumes that came out of it."""

from __future__ import annotations

import numpy as np
import pandas as pd

from hrcreplay.records import LIMBS, Bools, Floats
from hrcreplay.report.metrics_table import MetricTable
from hrcreplay.report.series import columns, durations_s, stretches, times
from hrcreplay.runs import Run


def cameras(run: Run) -> list[str]:
    """Names of the run's cameras, sorted."""
    found: set[str] = set()
    if run.measurements is not None:
        found |= set(run.measurements["camera"].astype(str))
    if run.state is not None:
        found |= {name.removeprefix("valid_") for name in run.state.columns if name.startswith("valid_")}
    return sorted(found)


def add_quality(metrics: MetricTable, run: Run, gap_s: float) -> None:
    """Frames, rates and gaps of each camera, what the filter could use of them, and every counter of the reader."""
    _add_span(metrics, run)
    for camera in cameras(run):
        _add_frames(metrics, run.measurements, camera, gap_s)
        _add_validity(metrics, run.state, camera, gap_s)
    if run.state is not None:
        _add_coverage(metrics, run.state)
    for name, count in run.counts.items():
        metrics.add(f"count_{name}", int(count), "1", f"data quality counter '{name.replace('_', ' ')}'")


def _add_span(metrics: MetricTable, run: Run) -> None:
    table = run.state if run.state is not None else run.motion
    t_ns = times(table) if table is not None else np.zeros(0, dtype=np.int64)
    reason = "no stage with ticks was run"
    span = (int(t_ns[-1]) - int(t_ns[0])) * 1e-9 if len(t_ns) else None
    metrics.add("span_s", span, "s", "from the first tick to the last", reason=reason)
    metrics.add("ticks", len(t_ns) or None, "1", "ticks of the filter and the controller", reason=reason)


def _add_frames(metrics: MetricTable, measurements: pd.DataFrame | None, camera: str, gap_s: float) -> None:
    reason = "the run has no table of measurements"
    frames = rate = gaps = longest = None
    if measurements is not None:
        capture = np.sort(times(measurements[measurements["camera"] == camera], "capture_ns"))
        steps = np.diff(capture) * 1e-9
        frames = len(capture)
        rate = 1.0 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else None
        gaps = int((steps > gap_s).sum())
        longest = float(steps.max()) if len(steps) else None
        reason = "fewer than two frames"
    name = f"camera_{camera}"
    metrics.add(f"{name}_frames", frames, "1", f"frames of {camera} that hold the person", reason=reason)
    metrics.add(f"{name}_rate_hz", rate, "Hz", f"1 / median time between captures of {camera}", reason=reason)
    metrics.add(f"{name}_gaps", gaps, "1", f"times between captures of {camera} over {gap_s:g} s", reason=reason)
    metrics.add(f"{name}_gap_max_s", longest, "s", f"longest time between captures of {camera}", reason=reason)


def _add_validity(metrics: MetricTable, state: pd.DataFrame | None, camera: str, gap_s: float) -> None:
    used = recent = None
    if state is not None and f"valid_{camera}" in state:
        valid = state[f"valid_{camera}"].to_numpy(dtype=bool)
        used = float(valid.mean()) if len(valid) else None
        recent = float((seconds_since(state, valid) <= gap_s).mean()) if len(valid) else None
    metrics.add(
        f"camera_{camera}_valid_share",
        used,
        "1",
        f"share of ticks whose update used a row of {camera}; a camera slower than the filter cannot reach 1",
        reason="not fused",
    )
    metrics.add(
        f"camera_{camera}_available_share",
        recent,
        "1",
        f"share of ticks at most {gap_s:g} s after a tick whose update used a row of {camera}",
        reason="not fused",
    )


def seconds_since(state: pd.DataFrame, valid: Bools) -> Floats:
    """(n,) time since the last valid tick, 0 at one [s]; infinite before the first."""
    t_ns = times(state)
    last = np.maximum.accumulate(np.where(valid, np.arange(len(valid)), -1))
    return np.where(last < 0, np.inf, (t_ns - t_ns[np.maximum(last, 0)]) * 1e-9)


def _add_coverage(metrics: MetricTable, state: pd.DataFrame) -> None:
    names = [name for name in state.columns if name.startswith("valid_")]
    any_valid: Bools = np.asarray(state[names].to_numpy(dtype=bool).any(axis=1))
    t_ns = times(state)
    runs = stretches(~any_valid)
    ends = (t_ns + np.round(durations_s(t_ns) * 1e9)).astype(np.int64)
    longest = max(((ends[last - 1] - t_ns[first]) * 1e-9 for first, last in runs), default=0.0)
    metrics.add("ticks_without_camera", int((~any_valid).sum()), "1", "ticks whose update used no camera at all")
    metrics.add(
        "longest_without_camera_s",
        float(longest) if len(t_ns) else None,
        "s",
        "longest stretch of ticks whose updates used no camera at all, the time before the first frame included",
    )
    p = columns(state)
    finite: Bools = np.asarray(np.isfinite(p).all(axis=1))
    lost = ~finite
    lost[: int(np.argmax(finite)) if finite.any() else len(lost)] = False
    metrics.add("ticks_before_first_state", int((~finite).sum() - lost.sum()), "1", "ticks before the first full state")
    metrics.add("ticks_state_lost", int(lost.sum()), "1", "ticks after the first full state without a finite one")


def add_occupancy(metrics: MetricTable, occupancy: pd.DataFrame | None) -> None:
    """Mean swept volume per method and limb, and of all limbs of a tick together."""
    if occupancy is None:
        metrics.add("occupancy_ticks", None, "1", "ticks with stored swept volumes", reason="not predicted")
        return
    metrics.add("occupancy_ticks", int(occupancy["t_ns"].nunique()), "1", "ticks with stored swept volumes")
    for method, rows in occupancy.groupby("method", sort=True):
        for limb in (*LIMBS, *sorted(set(rows["limb"]) - set(LIMBS))):
            volume = rows.loc[rows["limb"] == limb, "volume_m3"].to_numpy(dtype=float)
            volume = volume[np.isfinite(volume)]
            metrics.add(
                f"occupancy_{method}_{limb}_m3",
                float(volume.mean()) if len(volume) else None,
                "m^3",
                f"mean swept volume of {limb} over the stored ticks, method '{method}', limb radius included",
            )
        total = (
            rows[rows["limb"].isin(LIMBS)].groupby("t_ns", sort=True)["volume_m3"].sum(min_count=len(LIMBS)).dropna()
        )
        metrics.add(
            f"occupancy_{method}_sum_m3",
            float(total.mean()) if len(total) else None,
            "m^3",
            f"mean over the stored ticks of the six limbs' swept volumes added up (overlaps count twice), '{method}'",
        )
