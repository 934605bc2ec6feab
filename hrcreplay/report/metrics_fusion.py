"""Errors of the cameras and of the fused state against ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.records import JOINTS, Floats, Ints
from hrcreplay.report.metrics_quality import cameras, seconds_since
from hrcreplay.report.metrics_table import MetricTable
from hrcreplay.report.series import (
    ANGLES,
    IS_ANGLE,
    central_differences,
    columns,
    difference,
    interpolate,
    times,
)
from hrcreplay.runs import Run

NO_TRUTH = "the log has no ground truth"


@dataclass(frozen=True)
class Errors:
    """Estimate minus truth of one source, a row a tick or a frame; NaN where one of the two is missing."""

    t_ns: Ints  #: (n,) when the position errors hold [ns]
    position: Floats  #: (n, 12) [m, m, rad...]
    velocity_t_ns: Ints  #: (k,) when the velocity errors hold [ns]
    velocity: Floats  #: (k, 12) [m/s, m/s, rad/s...]


def errors(run: Run, gap_s: float) -> dict[str, Errors]:
    """Errors of ``fused`` at the ticks and of each camera at its captures; empty without ground truth.

    The fused state is compared with the truth interpolated at the tick. A camera's raw angles are compared with the
    truth at the capture; their differences between consecutive captures over the time between, with the truth's
    velocity half-way between the two, which is the kindest instant for a difference. Pairs further apart than
    ``gap_s`` are left out. The truth's velocity is its central difference.
    """
    if run.truth is None or len(run.truth) < 3:
        return {}
    truth_ns, truth = times(run.truth), columns(run.truth)
    rate = central_differences(truth_ns, truth)
    found: dict[str, Errors] = {}
    if run.state is not None:
        t_ns = times(run.state)
        found["fused"] = Errors(
            t_ns,
            difference(columns(run.state), interpolate(truth_ns, truth, t_ns, angles=True)),
            t_ns,
            columns(run.state, "_vel") - interpolate(truth_ns, rate, t_ns, angles=False),
        )
    if run.measurements is not None:
        for camera in cameras(run):
            rows = run.measurements[run.measurements["camera"] == camera].sort_values("capture_ns", kind="stable")
            at_ns, raw = times(rows, "capture_ns"), columns(rows)
            step_ns = np.diff(at_ns)
            kept = (step_ns > 0) & (step_ns * 1e-9 <= gap_s)
            middle_ns = (at_ns[:-1] + step_ns // 2)[kept]
            raw_rate = difference(raw[1:], raw[:-1])[kept] / (step_ns[kept] * 1e-9)[:, None]
            found[camera] = Errors(
                at_ns,
                difference(raw, interpolate(truth_ns, truth, at_ns, angles=True)),
                middle_ns,
                raw_rate - interpolate(truth_ns, rate, middle_ns, angles=False),
            )
    return found


def rmse(error: Floats) -> float | None:
    """Root mean square of the finite entries; None without any."""
    finite = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else None


def median(error: Floats) -> float | None:
    """Median of the absolute finite entries; None without any."""
    finite = np.abs(error[np.isfinite(error)])
    return float(np.median(finite)) if len(finite) else None


def add_fusion(metrics: MetricTable, run: Run, gap_s: float) -> None:
    """RMSE and median error per joint and pooled, and the fused state's share of the better camera's RMSE."""
    found = errors(run, gap_s)
    sources = ["fused", *cameras(run)]
    for source in sources:
        _add_source(metrics, source, found.get(source), "no such rows" if found else NO_TRUTH)
    for kind, unit in (("angle", "rad"), ("velocity", "rad/s")):
        _add_ratio(metrics, found, kind, unit)
        _add_seen(metrics, run, found, kind, unit, gap_s)


def _add_source(metrics: MetricTable, source: str, error: Errors | None, reason: str) -> None:
    fused = source == "fused"
    name = "fusion" if fused else f"camera_{source}"
    if fused:
        what = {"": "fused {} at the tick", "velocity_": "fused velocity of {} at the tick"}
    else:
        what = {
            "": f"raw {{}} of {source} at the capture",
            "velocity_": f"raw {{}} of {source} differenced between consecutive captures, half-way between them",
        }
    for kind, text in what.items():
        values = None if error is None else (error.velocity if kind else error.position)
        per_s = "/s" if kind else ""
        for joint in JOINTS:
            column = None if values is None else values[:, JOINTS.index(joint)]
            unit = ("rad" if joint in ANGLES else "m") + per_s
            meaning = f"RMSE of the {text.format(joint)} against ground truth, samples that both have"
            metrics.add(
                f"{name}_{kind}rmse_{joint}", None if column is None else rmse(column), unit, meaning, reason=reason
            )
        pooled = None if values is None else values[:, IS_ANGLE]
        label = f"{name}_{kind or 'angle_'}"
        scope = f"the {text.format('angles')} against ground truth, pooled over all samples of the 10 angles"
        metrics.add(
            f"{label}rmse", None if pooled is None else rmse(pooled), f"rad{per_s}", f"RMSE of {scope}", reason=reason
        )
        metrics.add(
            f"{label}median",
            None if pooled is None else median(pooled),
            f"rad{per_s}",
            f"median absolute error of {scope}",
            reason=reason,
        )


def _add_ratio(metrics: MetricTable, found: dict[str, Errors], kind: str, unit: str) -> None:
    pooled = {
        source: value
        for source, error in found.items()
        if (value := rmse((error.position if kind == "angle" else error.velocity)[:, IS_ANGLE])) is not None
    }
    fused = pooled.pop("fused", None)
    reason = "needs a fused state, a camera and ground truth"
    better = min(sorted(pooled), key=lambda name: pooled[name]) if pooled else None
    raw = "raw angles" if kind == "angle" else "differenced raw angles"
    metrics.add(
        f"fusion_{kind}_better_camera", better, "name", f"camera with the smaller pooled RMSE of {raw}", reason=reason
    )
    ratio = fused / pooled[better] if fused is not None and better is not None and pooled[better] > 0 else None
    metrics.add(
        f"fusion_{kind}_rmse_ratio",
        ratio,
        "1",
        f"pooled RMSE [{unit}] of the fused state over all ticks / that of the better camera's {raw} over its frames",
        reason=reason,
    )


def _add_seen(metrics: MetricTable, run: Run, found: dict[str, Errors], kind: str, unit: str, gap_s: float) -> None:
    """The same where cameras can be compared: they have no errors while they do not see the person, the filter has."""
    value = None
    if run.state is not None and "fused" in found:
        names = [name for name in run.state.columns if name.startswith("valid_")]
        valid = np.asarray(run.state[names].to_numpy(dtype=bool).any(axis=1))
        seen = seconds_since(run.state, valid) <= gap_s
        error = found["fused"].position if kind == "angle" else found["fused"].velocity
        value = rmse(error[seen][:, IS_ANGLE])
    what = "angles" if kind == "angle" else "angular velocities"
    metrics.add(
        f"fusion_seen_{kind}_rmse",
        value,
        unit,
        f"RMSE of the fused {what}, the 10 angles pooled, at ticks at most {gap_s:g} s after one that used a camera",
        reason="needs a fused state and ground truth",
    )
