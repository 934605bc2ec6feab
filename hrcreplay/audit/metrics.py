"""Metrics of an audit with their intervals, by method, limb and joint, for one log or for several together.

They also list the limbs and points that could not be checked, since a coverage applies only to the checked ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hrcreplay.audit.measures import Estimate, Resampling
from hrcreplay.evaluation.containment import Outcome
from hrcreplay.records import BODY, JOINTS, LIMBS, Bools, Floats
from hrcreplay.reporting.metrics.series import Metric, MetricTable, true_runs
from hrcreplay.reporting.tables import PageTable


def never_checked(part: Mapping[str, Any], method: str) -> list[str]:
    """Lists the limbs for which a method was not checked at any tick, and points of other limbs that were never seen.

    Args:
        part: One log of audit.json, or its total.
        method: Method of the volumes.
    """
    limbs = [limb for limb in BODY if not ticks_of(part, method, limb)]
    points = [
        f"{point} of {limb}"
        for limb, counts in part["points"].items()
        if limb not in limbs
        for point, count in counts.items()
        if not count
    ]
    return limbs + points


def partly_checked(part: Mapping[str, Any], method: str) -> list[str]:
    """Lists limbs and points that were checked only at some ticks, each with the number of unchecked ticks."""
    found = []
    for limb, counts in part["points"].items():
        limb_ticks = ticks_of(part, method, limb)
        if 0 < limb_ticks < part["ticks"]:
            found.append(f"{limb} {part['ticks'] - limb_ticks}")
        found += [f"{point} of {limb} {part['ticks'] - n}" for point, n in counts.items() if 0 < n < limb_ticks]
    return found


def ticks_of(part: Mapping[str, Any], method: str, limb: str) -> int:
    """Counts the ticks at which a limb was checked: it was seen to the horizon's end and has a volume."""
    figures = part["methods"][method].get(limb)
    return 0 if figures is None else int(figures["covered_share"]["samples"])


def unchecked_notes(part: Mapping[str, Any], method: str) -> list[str]:
    """Returns remarks on limbs and points that were not checked."""
    told = []
    if gaps := never_checked(part, method):
        told.append(f"not checked at all, so nothing is said of it: {', '.join(gaps)}")
    if gaps := partly_checked(part, method):
        told.append(f"not seen to the horizon's end, so not checked, of {part['ticks']} ticks: {', '.join(gaps)}")
    return told


def checked_scope(part: Mapping[str, Any], method: str) -> str:
    """Describes in a few words the limbs to which a headline applies."""
    missing = [limb for limb in BODY if not ticks_of(part, method, limb)]
    return f"not {', '.join(missing)}" if missing else "LEGS included"


def checked_table(total: Mapping[str, Any], method: str) -> PageTable:
    """Makes one row per limb and per point other than its two ends, with the number of checked ticks."""
    rows = []
    for limb in BODY:
        ticks = ticks_of(total, method, limb)
        why = "not checked" if limb in total["methods"][method] else "not checked: it has no volume"
        rows.append((limb, str(ticks) if ticks else why))
        for point, count in total["points"].get(limb, {}).items():
            rows.append((f"{limb}: {point}", str(count) if ticks and count else "not checked"))
    return PageTable(
        f"What was checked, of {total['ticks']} ticks",
        ("limb, and points beyond its ends", "ticks"),
        tuple(rows),
        "A limb is checked at a tick where its two ends were seen in the last quarter of the horizon, and so is a "
        "point. What a camera reports with confidence 0 was not seen. Unchecked limbs and points have no result.",
    )


def checked_cameras(log: Mapping[str, Any]) -> PageTable:
    """Number of rejected points of each camera."""
    rows = tuple(
        (camera, *("\u2013" if count is None else str(count) for count in counts.values()))
        for camera, counts in log["cameras"].items()
    )
    return PageTable(
        f"{log['log']}: thrown out",
        ("camera", "frames", "not seen", "doubted", "frames with a jump", "points that jump", "outliers in the fusion"),
        rows,
        "No such point is part of the recorded future. Not seen: missing, or of confidence 0. Doubted: the "
        "camera trusts it too little (fusion.confidence_min), or it hangs from such a point, or the person was not "
        "known yet. A point that jumps off the person is rejected with what hangs from it. A dash: the recorded future "
        "is not from cameras. The fusion's own gate works per tick and uses only earlier frames.",
    )


#: Group of limbs -> description of its share.
WHAT = {
    "all": "every limb that was checked, limb radius included, in its own volume",
    "upper": "every limb that was checked, limb radius included, the lower body left out, in its own volume",
}
UNCHECKED = "not checked: not seen to the end of a horizon"
#: Maximum number of ticks without an escape within one escape.
_BREAK = 2


def method_figures(outcomes: Sequence[Outcome], resampling: Resampling) -> dict[str, Any]:
    """Computes coverage, escapes and volumes of one method.

    Args:
        outcomes: One per log, in the order of the resampling.
        resampling: Resampling of all their ticks.

    Returns:
        Figures of whole limbs, and ``points_share`` for their points only: ``all`` (all limbs with volumes by the
        method, each in its own), ``upper`` (the six LIMBS, which have volumes by all methods) and each limb -> name ->
        figure.
    """
    whole = Outcome.join(outcomes)
    escapes, points = whole.escape_m(), whole.escape_m(points_alone=True)
    found: dict[str, Any] = {}
    for part, limbs, union, std in (
        ("all", len(whole.limbs), whole.union_m3, whole.union_std_m3),
        ("upper", len(LIMBS), whole.upper_m3, whole.upper_std_m3),
    ):
        figures = _escape_figures(whole.worst_m(limbs), whole.worst_m(limbs, points_alone=True), resampling)
        figures["union_m3"] = resampling.mean(union).to_dict()
        figures["union_counting_error"] = resampling.mean(_ratio(std, union)).to_dict()["value"]
        figures["sum_m3"] = resampling.mean(whole.volume_m3[:, :limbs].sum(axis=1)).to_dict()
        found[part] = figures
    for i, limb in enumerate(whole.limbs):
        found[limb] = _escape_figures(escapes[:, i], points[:, i], resampling)
        found[limb]["volume_m3"] = resampling.mean(whole.volume_m3[:, i]).to_dict()
    return found


def _escape_figures(escape_m: Floats, points_escape_m: Floats, resampling: Resampling) -> dict[str, Any]:
    deep = np.where(escape_m > 0.0, escape_m, np.nan)
    none = np.zeros(len(escape_m))
    return {
        "covered_share": resampling.share(_hits(escape_m, none)).to_dict(),
        "points_share": resampling.share(_hits(points_escape_m, none)).to_dict(),
        "escape_p50_m": resampling.quantile(deep, 0.5).to_dict(),
        "escape_p95_m": resampling.quantile(deep, 0.95).to_dict(),
        "escape_max_m": _number(np.nanmax(deep)) if np.isfinite(deep).any() else None,
    }


def _ratio(part: Floats, whole: Floats) -> Floats:
    """Computes shares; NaN if the total is 0."""
    return np.asarray(part / np.where(whole > 0.0, whole, np.nan))


def _hits(values: Floats, most: Floats) -> Floats:
    """Returns 1 for a value of at most ``most``, else 0; NaN is kept."""
    return np.where(np.isnan(values), np.nan, (values <= most).astype(float))


def joint_figures(inside: Floats, travel: Floats, resampling: Resampling) -> dict[str, Any]:
    """Computes, per joint, the share of ticks with the recorded future inside the reachable interval, and its motion.

    Args:
        inside: (n, 13) 1 or 0; NaN if the joint was not recorded.
        travel: (13,) range of the joint in the recording, 5th to 95th percentile [m, m, rad..., m].
        resampling: Resampling of the n ticks.
    """
    return {
        joint: {"inside_share": resampling.share(inside[:, j]).to_dict(), "travel": _number(travel[j])}
        for j, joint in enumerate(JOINTS)
    }


def deviation_figures(errors: Floats) -> dict[str, Any]:
    """Computes, per joint, for positions and velocities: root mean square of the errors, and shares within 1, 2, 3.

    Args:
        errors: (2, n, 13) in standard deviations; NaN if unknown.
    """
    found: dict[str, Any] = {joint: {} for joint in JOINTS}
    for name, part in zip(("position", "velocity"), errors, strict=True):
        for j, joint in enumerate(JOINTS):
            known = np.abs(part[np.isfinite(part[:, j]), j])
            within = [float((known <= k).mean()) for k in (1, 2, 3)] if len(known) else [None] * 3
            rms = float(np.sqrt((known**2).mean())) if len(known) else None
            found[joint][name] = {"rms": rms, "within": within, "ticks": len(known)}
    return found


def curve_point(outcomes: Sequence[Outcome], resampling: Resampling) -> dict[str, Any]:
    """Computes coverage of the six LIMBS and volume of their union, for one method and one limit set."""
    whole = Outcome.join(outcomes)
    worst = whole.worst_m(len(LIMBS))
    return {
        "covered_share": resampling.share(_hits(worst, np.zeros(len(worst)))).to_dict(),
        "union_m3": resampling.mean(whole.upper_m3).to_dict(),
    }


def horizon_point(outcomes: Sequence[Outcome], resampling: Resampling) -> dict[str, Any]:
    """Computes coverage of all checked whole limbs and volume of their union, for one method at one horizon."""
    whole = Outcome.join(outcomes)
    worst = whole.worst_m()
    return {
        "covered_share": resampling.share(_hits(worst, np.zeros(len(worst)))).to_dict(),
        "union_m3": resampling.mean(whole.union_m3).to_dict(),
    }


def escapes(outcome: Outcome, start_ns: int) -> list[dict[str, Any]]:
    """Lists all escapes: consecutive ticks whose prediction one limb left, their time and the distance.

    Times are those of the predictions; seconds count from ``start_ns``.
    """
    depth = outcome.escape_m()
    seconds = (outcome.t_ns - start_ns) * 1e-9
    found = []
    for i, limb in enumerate(outcome.limbs):
        for first, last in _joined(depth[:, i] > 0.0):
            part = depth[first:last, i]
            deepest = first + int(np.nanargmax(part))
            found.append(
                {
                    "limb": limb,
                    "from_s": round(float(seconds[first]), 3),
                    "to_s": round(float(seconds[last - 1]), 3),
                    "ticks": int((part > 0.0).sum()),
                    "deepest_m": float(np.nanmax(part)),
                    "deepest_at_s": round(float(seconds[deepest]), 3),
                    "deepest_t_ns": int(outcome.t_ns[deepest]),
                }
            )
    return sorted(found, key=lambda e: (e["from_s"], e["limb"]))


def first_movements(
    outcome: Outcome, moved_ns: Mapping[str, int | None], horizon_s: float, start_ns: int
) -> list[dict[str, Any]]:
    """Finds, for each limb that moved, its first movement and its coverage at that time.

    The volumes predicted up to a horizon before and after are checked. Times count from ``start_ns``.

    Args:
        outcome: Outcome of a method.
        moved_ns: Limb -> time of its first movement [ns].
        horizon_s: Horizon of the volumes [s].
        start_ns: Start of the log [ns].
    """
    depth, found = outcome.escape_m(), []
    for i, limb in enumerate(outcome.limbs):
        at_ns = moved_ns[limb]
        if at_ns is None:
            continue
        near = depth[np.abs(outcome.t_ns - at_ns) <= horizon_s * 1e9, i]
        near = near[np.isfinite(near)]
        found.append(
            {
                "limb": limb,
                "at_s": round((at_ns - start_ns) * 1e-9, 3),
                "ticks": len(near),
                "escaped_ticks": int((near > 0.0).sum()),
                "deepest_m": float(near.max()) if len(near) else None,
            }
        )
    return sorted(found, key=lambda one: (one["at_s"], one["limb"]))


def _joined(escaped: Bools) -> list[tuple[int, int]]:
    """Returns runs of True; runs close together are merged."""
    runs: list[tuple[int, int]] = []
    for first, last in true_runs(escaped).tolist():
        if runs and first - runs[-1][1] <= _BREAK:
            runs[-1] = (runs[-1][0], last)
        else:
            runs.append((first, last))
    return runs


def volume_at(curve: Sequence[Mapping[str, Any]], share: float) -> float | None:
    """Returns the union volume at which a method's curve first reaches a coverage, interpolated; None if never [m^3].

    Args:
        curve: Points of one method, by increasing factor.
        share: The required coverage.
    """
    before: tuple[float, float] | None = None
    for point in curve:
        here = (point["covered_share"]["value"], point["union_m3"]["value"])
        if None in here:
            continue
        if here[0] >= share:
            if before is None or here[0] == before[0]:
                return float(here[1])
            part = (share - before[0]) / (here[0] - before[0])
            return float(np.exp((1 - part) * np.log(before[1]) + part * np.log(here[1])))
        before = here
    return None


def headline_metrics(found: Mapping[str, Any]) -> dict[str, Metric]:
    """Returns the headline figures of all logs together, in the form of metrics.json.

    Args:
        found: The content of audit.json.
    """
    table = MetricTable()
    for method, parts in found["total"]["methods"].items():
        for part, figures in parts.items():
            share = figures["covered_share"]
            what = WHAT.get(part, f"the whole {part} in its volume")
            name = f"audit_{method}_{part}"
            meaning = f"share of ticks with {what} for the whole horizon, by {method}"
            table.add(f"{name}_covered_share", share["value"], "1", meaning, reason=UNCHECKED)
            for end in ("low", "high"):
                table.add(
                    f"{name}_covered_share_{end}", share[end], "1", f"its 95 % interval: {end} end", reason=UNCHECKED
                )
            points = figures["points_share"]["value"]
            meaning = f"{meaning}, for the recorded points alone"
            table.add(f"{name}_points_share", points, "1", meaning, reason=UNCHECKED)
            table.add(f"{name}_ticks", share["samples"], "1", "ticks at which it was checked")
            reason = "no escape" if share["samples"] else UNCHECKED
            table.add(f"{name}_escape_max_m", figures["escape_max_m"], "m", "deepest escape", reason=reason)
            key = "union_m3" if part in WHAT else "volume_m3"
            room = "mean volume of their union" if part in WHAT else "mean volume"
            table.add(f"{name}_{key}", figures[key]["value"], "m^3", room)
    for point in found["total"]["horizons"]:
        until = f"{1000.0 * point['horizon_s']:.0f}ms"
        for method, figures in point["methods"].items():
            name = f"audit_{method}_{until}"
            meaning = f"share of ticks with {WHAT['all']} until {point['horizon_s']:g} s later, by {method}"
            table.add(f"{name}_covered_share", figures["covered_share"]["value"], "1", meaning, reason=UNCHECKED)
            table.add(f"{name}_union_m3", figures["union_m3"]["value"], "m^3", "mean volume of their union")
    table.add("audit_ticks", found["total"]["ticks"], "1", "audited ticks of all logs")
    gaps = never_checked(found["total"], found["method"])
    meaning = "limbs, and points of other limbs, without a result: they were never seen"
    table.add("audit_not_checked", ", ".join(gaps) or "nothing", "", meaning)
    return table.sorted()


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def text_with_interval(figure: Mapping[str, Any] | Estimate, scale: float = 1.0, decimals: int = 1) -> str:
    """Formats a figure with its interval for a table; a dash if missing."""
    plain = figure.to_dict() if isinstance(figure, Estimate) else figure
    if plain["value"] is None:
        return "\u2013"
    value = f"{scale * plain['value']:.{decimals}f}"
    if plain["low"] is None:
        return value
    return f"{value} ({scale * plain['low']:.{decimals}f}\u2013{scale * plain['high']:.{decimals}f})"
