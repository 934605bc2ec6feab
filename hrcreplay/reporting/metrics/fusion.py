"""Metrics of the input data, of the limbs that the cameras measured, of the fused state, and of the swept volumes.

The fused state is compared with ground truth. The position of an unmeasured limb is an assumption of the model, so a
reader needs its share of the time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from hrcreplay.records import BODY, JOINTS, LIMBS, Bools, Floats, Ints
from hrcreplay.reporting.metrics.series import (
    ANGLES,
    IS_ANGLE,
    MetricTable,
    central_differences,
    columns,
    difference,
    durations_s,
    interpolate,
    times,
    true_runs,
)
from hrcreplay.reporting.tables import LIMB_NAMES
from hrcreplay.settings.sections import setting
from hrcreplay.store.run_folder import Run
from hrcreplay.store.stored_table import RunTable, number_columns


def cameras(run: Run) -> list[str]:
    """Names of the run's cameras, sorted."""
    found: set[str] = set()
    if run.measurements is not None:
        found |= set(run.measurements["camera"].unique())
    if run.state is not None:
        found |= {name.removeprefix("valid_") for name in run.state.columns if name.startswith("valid_")}
    return sorted(found)


def add_quality(metrics: MetricTable, run: Run, gap_s: float) -> None:
    """Adds frames, rates and gaps of each camera, their use by the filter, and every counter of the reader."""
    _add_span(metrics, run)
    for camera in cameras(run):
        _add_frames(metrics, run.measurements, camera, gap_s)
        _add_validity(metrics, run.state, camera, gap_s)
        _add_heights(metrics, run.bodies, camera)
    add_agreement(metrics, run.agreement)
    if run.state is not None:
        _add_coverage(metrics, run.state, run.known)
        fresh_s = run.meta.get("settings", {}).get("fusion", {}).get("fresh_s")
        _add_known(metrics, run.state, fresh_s)
    _add_watched(metrics, run)
    for name, count in run.counts.items():
        metrics.add(f"count_{name}", int(count), "1", f"data quality counter '{name.replace('_', ' ')}'")


def _add_span(metrics: MetricTable, run: Run) -> None:
    table = run.state if run.state is not None else run.motion
    t_ns = times(table) if table is not None else np.zeros(0, dtype=np.int64)
    reason = "no stage with ticks was run"
    span = (int(t_ns[-1]) - int(t_ns[0])) * 1e-9 if len(t_ns) else None
    metrics.add("span_s", span, "s", "from the first tick to the last", reason=reason)
    metrics.add("ticks", len(t_ns) or None, "1", "ticks of the filter and the controller", reason=reason)


def _add_frames(metrics: MetricTable, measurements: RunTable | None, camera: str, gap_s: float) -> None:
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
    metrics.add(f"{name}_frames", frames, "1", f"frames of {camera} that contain the person", reason=reason)
    metrics.add(f"{name}_rate_hz", rate, "Hz", f"1 / median time between captures of {camera}", reason=reason)
    metrics.add(f"{name}_gaps", gaps, "1", f"times between captures of {camera} over {gap_s:g} s", reason=reason)
    metrics.add(f"{name}_gap_max_s", longest, "s", f"longest time between captures of {camera}", reason=reason)


def _add_validity(metrics: MetricTable, state: RunTable | None, camera: str, gap_s: float) -> None:
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


def _add_heights(metrics: MetricTable, bodies: RunTable | None, camera: str) -> None:
    found = None if bodies is None else bodies[bodies["camera"] == camera]
    texts = {
        "floor_m": "height of the person's lowest foot above the floor z = 0",
        "floor_p95_m": "distance of the person's lowest foot from the floor z = 0, 95th percentile",
        "head_m": "height of the person's head above the floor, upright",
        "bones_m": "sum of the person's bone lengths from floor to head, upright",
    }
    for name, text in texts.items():
        value = None if found is None or found.empty else float(found[name].iloc[0])
        middle = "" if "p95" in name else ", median"
        reason = "no such table, or it was not seen"
        metrics.add(f"camera_{camera}_{name}", value, "m", f"{text}, by {camera}{middle}", reason=reason)


def add_agreement(metrics: MetricTable, agreement: RunTable | None) -> None:
    """Adds the distance between the views of any two cameras, for each limb of BODY at the same instants."""
    for limb in BODY:
        rows = None if agreement is None else agreement[agreement["limb"] == limb]
        for name, text in (("median_m", "median"), ("p95_m", "95th percentile")):
            metrics.add(
                f"cameras_{limb}_apart_{name}",
                None if rows is None or rows.empty else float(rows[name].max()),
                "m",
                f"distance at the same instant between the points of {limb} that two cameras show, {text}; "
                "of the two that differ most",
                reason="no two cameras showed it at the same instant, or no such table",
            )


def seconds_since(state: RunTable, valid: Bools) -> Floats:
    """(n,) time since the last valid tick, 0 at one [s]; infinite before the first."""
    t_ns = times(state)
    last = np.maximum.accumulate(np.where(valid, np.arange(len(valid)), -1))
    return np.where(last < 0, np.inf, (t_ns - t_ns[np.maximum(last, 0)]) * 1e-9)


def _add_coverage(metrics: MetricTable, state: RunTable, finite: Bools) -> None:
    names = [name for name in state.columns if name.startswith("valid_")]
    any_valid: Bools = np.asarray(state[names].to_numpy(dtype=bool).any(axis=1))
    t_ns = times(state)
    runs = true_runs(~any_valid)
    ends = (t_ns + np.round(durations_s(t_ns) * 1e9)).astype(np.int64)
    longest = max(((ends[last - 1] - t_ns[first]) * 1e-9 for first, last in runs), default=0.0)
    metrics.add("ticks_without_camera", int((~any_valid).sum()), "1", "ticks whose update used no camera at all")
    metrics.add(
        "longest_without_camera_s",
        float(longest) if len(t_ns) else None,
        "s",
        "longest stretch of ticks whose updates used no camera at all, including the time before the first frame",
    )
    lost = ~finite
    lost[: int(np.argmax(finite)) if finite.any() else len(lost)] = False
    metrics.add("ticks_before_first_state", int((~finite).sum() - lost.sum()), "1", "ticks before the first full state")
    metrics.add("ticks_state_lost", int(lost.sum()), "1", "ticks after the first full state without a finite one")


def _add_known(metrics: MetricTable, state: RunTable, fresh_s: float | None) -> None:
    """Adds the share of ticks at which the person, and each limb, was known from fresh frames."""
    known = fresh_s is not None and "frame_age_s" in state
    fresh = state["frame_age_s"].to_numpy(dtype=float) <= fresh_s if known else None
    longest = "fusion.fresh_s" if fresh_s is None else f"{fresh_s:g} s"
    reason = "the run does not contain the age of its frames"
    metrics.add(
        "person_known_share",
        None if fresh is None or not len(fresh) else float(fresh.mean()),
        "1",
        f"share of all ticks whose newest frame of the person was captured at most {longest} before",
        reason=reason,
    )
    metrics.add(
        "ticks_person_unknown",
        None if fresh is None else int((~fresh).sum()),
        "1",
        f"ticks whose newest frame of the person was older than {longest}, or that had none",
        reason=reason,
    )
    for limb in BODY:
        limb_name = LIMB_NAMES.get(limb, "legs")
        share = None
        if fresh is not None and len(fresh) and f"unseen_{limb}" in state:
            share = float((fresh & (state[f"unseen_{limb}"].to_numpy(dtype=float) <= fresh_s)).mean())
        metrics.add(
            f"limb_{limb}_known_share",
            share,
            "1",
            f"the same of the {limb_name}: share of all ticks at most {longest} after one that measured it",
            reason=reason,
        )


def _add_watched(metrics: MetricTable, run: Run) -> None:
    """Adds the share of ticks at which the robot relied on the cell's claim of a completely watched area."""
    watched = (run.meta.get("cell") or {}).get("watched")
    fresh_s = run.meta.get("settings", {}).get("fusion", {}).get("fresh_s")
    state, share, refuting = run.state, None, None
    if watched is not None and state is not None and "nobody_s" in state and len(state):
        unseen = ~(state["frame_age_s"].to_numpy(dtype=float) <= fresh_s)
        share = float((unseen & (state["nobody_s"].to_numpy(dtype=float) <= fresh_s)).mean())
        refuting = int(run.counts.get("watched_frames_refuting", 0))
    reason = "the cell names no watched area"
    metrics.add(
        "watched_vacant_share",
        share,
        "1",
        "share of all ticks at which no person was known, and all cameras had just shown the watched area without one",
        reason=reason,
    )
    metrics.add(
        "watched_frames_refuting",
        refuting,
        "1",
        "frames that show a person deeper inside the watched area than people can walk since it was vacant",
        reason=reason,
    )
    speed = None if watched is None else watched["speed_m_per_s"]
    metrics.add("watched_speed_m_per_s", speed, "m/s", "assumed speed of people who walk in", reason=reason)


def add_occupancy(metrics: MetricTable, occupancy: RunTable | None) -> None:
    """Adds the mean swept volume per method and limb, and the sum over all limbs of a tick."""
    if occupancy is None:
        metrics.add("occupancy_ticks", None, "1", "ticks with stored swept volumes", reason="not predicted")
        return
    metrics.add("occupancy_ticks", int(occupancy["t_ns"].nunique()), "1", "ticks with stored swept volumes")
    sizes = occupancy[["t_ns", "limb", "method", "volume_m3"]]
    for method in sorted(set(sizes["method"])):
        rows = sizes[sizes["method"] == method]
        for limb in (*LIMBS, *sorted(set(rows["limb"]) - set(LIMBS))):
            volume = rows.loc[rows["limb"] == limb, "volume_m3"].to_numpy(dtype=float)
            volume = volume[np.isfinite(volume)]
            metrics.add(
                f"occupancy_{method}_{limb}_m3",
                float(volume.mean()) if len(volume) else None,
                "m^3",
                f"mean swept volume of {limb} above the floor, limb radius included, over the stored ticks, '{method}'",
            )
        total = (
            rows[rows["limb"].isin(LIMBS)].groupby("t_ns", sort=True)["volume_m3"].sum(min_count=len(LIMBS)).dropna()
        )
        metrics.add(
            f"occupancy_{method}_sum_m3",
            float(total.mean()) if len(total) else None,
            "m^3",
            f"mean over the stored ticks of the sum of the six limbs' swept volumes (overlaps count twice), '{method}'",
        )


NO_TRUTH = "the log has no ground truth"


@dataclass(frozen=True)
class Errors:
    """Estimate minus truth of one source, one row per tick or frame; NaN if one of the two is missing."""

    t_ns: Ints  #: (n,) instants of the position errors [ns]
    position: Floats  #: (n, 13) [m, m, rad..., m]
    velocity_t_ns: Ints  #: (k,) instants of the velocity errors [ns]
    velocity: Floats  #: (k, 13) [m/s, m/s, rad/s...]


def errors(run: Run, gap_s: float) -> dict[str, Errors]:
    """Computes errors of ``fused`` at the ticks and of each camera at its captures; empty without ground truth.

    The fused state is compared with the truth interpolated at the tick. A camera's raw angles are compared with the
    truth at the capture; their differences between consecutive captures over the time between, with the truth's
    velocity half-way between the two, the instant of the smallest error of a difference. Pairs further apart than
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
            rows = frames_of(run.measurements, camera)
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


def frames_of(measurements: RunTable, camera: str) -> pd.DataFrame:
    """Returns capture times and joints in a camera's frames, in order of capture."""
    mine = measurements[measurements["camera"] == camera]
    return mine[["capture_ns", *JOINTS]].sort_values("capture_ns", kind="stable")


def rmse(error: Floats) -> float | None:
    """Root mean square of the finite entries; None without any."""
    finite = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else None


def median(error: Floats) -> float | None:
    """Median of the absolute finite entries; None without any."""
    finite = np.abs(error[np.isfinite(error)])
    return float(np.median(finite)) if len(finite) else None


def add_fusion(metrics: MetricTable, run: Run, gap_s: float) -> None:
    """Adds RMSE and median error per joint and pooled, and the RMSE ratio of fused state and better camera."""
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
    """Adds the same at comparable ticks: cameras have no errors while they do not see the person, the filter has."""
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


#: The required tables and columns.
LIMB_COLUMNS = {"state": tuple(f"unseen_{limb}" for limb in LIMBS), "measurements": JOINTS}

#: Joints that determine a limb, without those that carry it; a part of an arm counts as seen if one of its two joints
#: is.
_OWN_JOINTS = {
    "HD": JOINTS[:4],
    "THX": JOINTS[:4],
    "URA": ("ar1", "ar2"),
    "LRA": ("ar3", "ar4"),
    "ULA": ("al1", "al2"),
    "LLA": ("al3", "al4"),
}


def unmeasured_shares(unseen_s: Floats, memory_s: float) -> Floats:
    """Computes, per limb, the share of the ticks with the person in view at which it counted as unmeasured.

    Args:
        unseen_s: (n, 6) time since the joints of LIMBS were last measured, as in ``HumanStates``; inf before the first
            time [s].
        memory_s: A limb not measured for longer is lost [s].

    Returns:
        (6,) in [0, 1]; exactly 1 for a limb that was never measured. NaN without a person in view: the person is in
        view if any limb has been measured within the memory.
    """
    lost: Bools = ~(unseen_s <= memory_s)
    in_view = ~lost.all(axis=1)
    if not in_view.any():
        return np.full(unseen_s.shape[1], np.nan)
    return np.asarray(lost[in_view].mean(axis=0), dtype=np.float64)


def add_limbs(metrics: MetricTable, run: Run) -> None:
    """Adds the share of the time at which each limb was not measured, and its joints that never were."""
    names = list(LIMB_COLUMNS["state"])
    shares = np.full(len(LIMBS), np.nan)
    memory_s = float(setting(run.meta.get("settings", {}), "fusion", "memory_s"))
    if run.state is not None and set(names) <= set(run.state.columns):
        shares = unmeasured_shares(number_columns(run.state, names), memory_s)
    never = _never_measured(run.measurements)
    for limb, share in zip(LIMBS, shares.tolist(), strict=True):
        metrics.add(
            f"limb_{limb}_unmeasured_share",
            share,
            "1",
            f"share of the ticks with the person in view at which the {LIMB_NAMES[limb]} had not been measured for "
            f"{memory_s:g} s; 1: never",
            reason="no person came into view, or the run was not fused",
        )
        metrics.add(
            f"limb_{limb}_joints_unmeasured",
            ", ".join(joint for joint in _OWN_JOINTS[limb] if joint in never) or None,
            "name",
            f"joints of the {LIMB_NAMES[limb]} that no frame measured",
            reason="each was measured, or there is no table of measurements",
        )


def _never_measured(measurements: RunTable | None) -> frozenset[str]:
    if measurements is None or not len(measurements):
        return frozenset()
    return frozenset(joint for joint in JOINTS if not np.isfinite(measurements[joint].to_numpy(dtype=float)).any())
