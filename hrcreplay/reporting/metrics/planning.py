"""Metrics of the robot's motion: separation, stops, path deviation, and progress along the programme.

The reference may be ahead of the robot (by plan.max_reference_lead_m, or without bound if it does not wait), so its
time is not the progress of the robot. Progress is measured at the foot point of the TCP on the programmed path: the
nearest point of the next section of the path, which never moves back and never passes the reference. The programmed
time at the foot point is the progress of the robot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from hrcreplay.geometry.polyline import advance_foot
from hrcreplay.records import RECORDED, STATUSES, Bools, Floats, Ints
from hrcreplay.reporting.metrics.series import MetricTable, durations_s, feet_in_turn, step_lengths, times, way_along
from hrcreplay.robot.recorded import UNKNOWN
from hrcreplay.store.stored_table import RunTable, number_columns, rows_where, text_column

#: Shorter distances are rounding [m].
_ROUNDING_M = 1e-9
#: Distance of the TCP from a waypoint within which a dwell of the programme counts as reached [m].
_THERE_M = 1e-3
#: Motion of the TCP after which the foot is computed again; saves time for a waiting robot [m].
_STEP_M = 1e-3


@dataclass(frozen=True)
class Programme:
    """The programmed path up to the last reference, without repeated points of a stationary reference."""

    points_m: Floats  #: (m, 3) world [m]
    way_m: Floats  #: (m,) distance along the path from its first point [m]
    from_s: Floats  #: (m,) programmed time of arrival at a point [s]
    until_s: Floats  #: (m,) programmed time of departure; later if the programme dwells there [s]
    at: Ints  #: (n,) the reference's point at each tick


def programme(ref_m: Floats, programme_s: Floats) -> Programme:
    """Makes the path from references (n, 3) [m] at programmed times (n,) [s]; at least one row, all finite."""
    moved = np.concatenate([[True], step_lengths(ref_m) > _ROUNDING_M])
    first = np.flatnonzero(moved)
    last = np.append(first[1:], len(ref_m)) - 1
    points = ref_m[first]
    return Programme(points, way_along(points), programme_s[first], programme_s[last], np.cumsum(moved) - 1)


def foot(path: Programme, tcp_m: Floats, ahead_m: float) -> tuple[int, float]:
    """Finds the final position of a TCP along the path.

    Args:
        path: The programmed path.
        tcp_m: (n, 3) the TCP at the ticks of ``path.at`` [m].
        ahead_m: Length of the next section of the path that is searched, so that the foot does not jump over a part of
            the programme to a later passage at the same place [m].

    Returns:
        The last passed point of the path, and the fraction of the distance to the next one.
    """
    tcp_m, points_m = np.ascontiguousarray(tcp_m), np.ascontiguousarray(path.points_m)
    return advance_foot(tcp_m, points_m, path.way_m, path.at, ahead_m, _STEP_M)


def reached_s(path: Programme, passed: int, share: float) -> float:
    """Programmed time from the start to a foot [s]; exactly 0 for a robot without progress."""
    if passed + 1 == len(path.way_m):
        made_m, time_s = path.way_m[passed], path.until_s[passed]
    else:
        made_m = path.way_m[passed] + share * (path.way_m[passed + 1] - path.way_m[passed])
        time_s = path.until_s[passed] + share * (path.from_s[passed + 1] - path.until_s[passed])
        near = np.flatnonzero((path.way_m >= made_m) & (path.way_m <= made_m + _THERE_M))
        stands = near[path.until_s[near] > path.from_s[near]]
        time_s = max(time_s, *path.until_s[stands], -np.inf)
    return float(time_s - path.from_s[0]) if made_m > _ROUNDING_M else 0.0


def programme_progress(motion: RunTable, ahead_m: float) -> tuple[float, float] | None:
    """Returns the programmed time that the robot reached, and the available time [s]; None for a stationary programme.

    Args:
        motion: A table of motion.
        ahead_m: As for ``foot``: plan.max_reference_lead_m [m].
    """
    t_ns, programmed, tcp = times(motion), [f"ref_{axis}" for axis in "xyz"], [f"tcp_{axis}" for axis in "xyz"]
    known = np.all([np.isfinite(numeric_column(motion, name)) for name in ("programme_s", *programmed, *tcp)], axis=0)
    if known.sum() < 2:
        return None
    given_s, programme_s = float(t_ns[-1] - t_ns[0]) * 1e-9, numeric_column(motion, "programme_s")[known]
    path = programme(_known_rows(motion, programmed, known), programme_s)
    waited_s = given_s - (programme_s[-1] - programme_s[0])
    if len(path.way_m) == 1 and waited_s < 1e-6:
        return None
    return min(reached_s(path, *foot(path, _known_rows(motion, tcp, known), ahead_m)), given_s), given_s


def _known_rows(motion: RunTable, names: Sequence[str], known: Bools) -> Floats:
    """Returns columns of the rows (n,) that are known; without a copy if all are."""
    rows = number_columns(motion, names)
    return rows if known.all() else rows[known]


#: Figures that the paper prints for its own experiments; its logs were never published.
PAPER = {
    "paper_stationary_share_qp": (0.3006, "1", "stationary share that the paper prints for its QP, on its own data"),
    "paper_stationary_share_scaling": (
        0.8644,
        "1",
        "stationary share that the paper prints for kinematic scaling ([24]-[26]), on its own data",
    ),
    "paper_deviation_m": (0.221, "m", "deviation from the nominal path that the paper prints for its Fig. 13"),
    "paper_fusion_rate_hz": (205.0, "Hz", "rate of fusion and swept volumes that the paper prints for its own PC"),
}


def position_columns(motion: RunTable, what: str) -> Floats:
    """Returns (n, 3) ``ref`` or ``tcp`` positions, world [m]."""
    return number_columns(motion, [f"{what}_{axis}" for axis in "xyz"])


def numeric_column(motion: RunTable, name: str) -> Floats:
    """Returns one column (n,)."""
    return motion[name].to_numpy(dtype=float)


def stationary(motion: RunTable, near_m: float, stationary_m_per_s: float) -> tuple[Bools, Bools]:
    """Marks the near ticks (separation at most ``near_m``), and all ticks at which the robot stands but should move.

    The robot stands if the TCP is slower than ``stationary_m_per_s``. It should move if the reference moves, or if the
    reference waits for the robot: such a reference stands itself at a waypoint.
    """
    near = numeric_column(motion, "distance_m") <= near_m
    stands = numeric_column(motion, "tcp_speed") < stationary_m_per_s
    wanted = numeric_column(motion, "ref_speed") >= stationary_m_per_s
    waits = waited_s(motion) > 0.5 * durations_s(times(motion))
    return near, stands & (wanted | waits)


def is_moving(motion: RunTable, slow_m_per_s: float) -> Bools:
    """(n,) True if the robot moves: its TCP, or any joint at 1 mrad/s, as links can move while the TCP stands."""
    moving = numeric_column(motion, "tcp_speed") >= slow_m_per_s
    for name in motion.columns:
        if name.startswith("dq"):
            moving |= np.abs(numeric_column(motion, name)) >= 1e-3
    return np.asarray(moving)


def deviation_m(motion: RunTable) -> Floats:
    """(n,) distance of the TCP from the programmed path [m]."""
    tcp, found = position_columns(motion, "tcp"), np.full(len(motion), np.nan)
    for rows, feet in feet_in_turn(tcp, position_columns(motion, "ref")):
        found[rows] = np.linalg.norm(tcp[rows] - feet, axis=1)
    return found


def tracking_error_m(motion: RunTable) -> Floats:
    """(n,) distance of the TCP from the reference of the same tick [m]."""
    squares = np.zeros(len(motion))
    for axis in "xyz":
        squares += (numeric_column(motion, f"tcp_{axis}") - numeric_column(motion, f"ref_{axis}")) ** 2
    return np.sqrt(squares, out=squares)


def waited_s(motion: RunTable) -> Floats:
    """(n,) time in each tick during which the reference waited for the robot [s]; 0 after the last tick."""
    waited = durations_s(times(motion))
    waited[:-1] -= np.diff(numeric_column(motion, "programme_s"))
    waited[-1:] = 0.0  # the reference after the last tick is unknown
    return np.clip(waited, 0.0, None)


def cycles(motion: RunTable, *, at_m: float = 0.002, away_m: float = 0.05) -> int:
    """Counts returns of the reference to its first point (within ``at_m``) after being ``away_m`` from it."""
    reference = position_columns(motion, "ref")
    gap = np.linalg.norm(reference - reference[0], axis=1)
    marks = np.where(gap >= away_m, 1, np.where(gap <= at_m, -1, 0))
    marks = marks[marks != 0]
    return int(((marks[1:] == -1) & (marks[:-1] == 1)).sum())


def add_plan(
    metrics: MetricTable,
    motion: RunTable | None,
    baselines: Mapping[str, RunTable],
    *,
    method: str,
    near_m: float,
    stationary_m_per_s: float,
    max_reference_lead_m: float,
    contact: RunTable | None = None,
    recorded: RunTable | None = None,
) -> None:
    """Adds all metrics of the motion and of the baselines, and the paper's own figures.

    Args:
        metrics: Table that the metrics are added to.
        motion: Rows of motion.parquet; None without a plan.
        baselines: Name of each baseline -> rows of its motion.
        method: Method of the plan.
        near_m: The person is near at a separation of at most this [m].
        stationary_m_per_s: A TCP slower than this counts as stationary [m/s].
        max_reference_lead_m: Distance of the TCP at which the reference waits [m].
        contact: Rows of contact.parquet; None without a comparison with the recorded body.
        recorded: Rows of motion_recorded.parquet; None without joints of the robot in the log.
    """
    if motion is None:
        metrics.add("plan_method", None, "name", "method of the plan", reason="not planned")
    else:
        metrics.add("plan_method", method, "name", "method of the plan; baselines ran on the same volumes")
    if recorded is not None:
        _add_recorded(metrics, recorded, contact, near_m, stationary_m_per_s)
    tables = {} if motion is None else {"plan": motion, **{f"baseline_{name}": baselines[name] for name in baselines}}
    for prefix, table in tables.items():
        what = method_text(prefix)
        _add_status(metrics, prefix, table, what, stationary_m_per_s)
        _add_separation(metrics, prefix, table, what, stationary_m_per_s)
        _add_stationary(metrics, prefix, table, what, near_m, stationary_m_per_s)
        _add_path(metrics, prefix, table, what)
        _add_progress(metrics, prefix, table, what, max_reference_lead_m)
        by = method if prefix == "plan" else prefix.removeprefix("baseline_")
        rows = None if contact is None else rows_where(contact, "method", by)
        _add_fastest(metrics, prefix, table, rows, what, near_m)
    for name, (value, unit, meaning) in PAPER.items():
        metrics.add(name, value, unit, meaning)


def method_text(prefix: str) -> str:
    """Describes a method in the meanings of its metrics, by their prefix."""
    if prefix == RECORDED:
        return "the robot as recorded"
    return "the plan" if prefix == "plan" else f"the baseline '{prefix.removeprefix('baseline_')}'"


def _add_recorded(metrics: MetricTable, motion: RunTable, contact: RunTable | None, near_m: float, slow: float) -> None:
    """Adds the metrics of the robot as recorded: of its known ticks only, and their number."""
    what, known = method_text(RECORDED), np.isfinite(numeric_column(motion, "tcp_x"))
    metrics.add("recorded_ticks", len(motion), "1", f"ticks of {what}, known or not")
    metrics.add("recorded_known_ticks", int(known.sum()), "1", f"ticks of {what} at which it is known")
    reasons = text_column(motion, "reason")
    for reason in UNKNOWN[1:]:
        count = int((reasons[~known] == reason).sum())
        metrics.add(
            f"recorded_unknown_ticks_{_slug(reason)}", count, "1", f"ticks of {what} that are not known: {reason}"
        )
    moving = is_moving(motion, slow)
    metrics.add("recorded_moving_ticks", int(moving.sum()), "1", f"ticks of {what} at which it moves")
    distance_m = numeric_column(motion, "distance_m")[moving]
    known_m = distance_m[np.isfinite(distance_m)]
    metrics.add("recorded_separation_moving_ticks", len(known_m), "1", f"of those, ticks with a separation of {what}")
    metrics.add(
        "recorded_contact_moving_ticks",
        int((known_m <= 0.0).sum()) if len(known_m) else None,
        "1",
        f"ticks of {what} at which it moves with a link in a place that the person was predicted to reach before it "
        "could have stopped",
        reason="no separation is known: the person was not, or no joints are recorded, so the time of a stop is not",
    )
    _add_separation(metrics, RECORDED, motion, what, slow)
    rows = None if contact is None else rows_where(contact, "method", RECORDED)
    _add_fastest(metrics, RECORDED, motion, rows, what, near_m)


def _slug(reason: str) -> str:
    """Returns a reason as part of a metric's name."""
    return "_".join("".join(c if c.isalnum() else " " for c in reason.lower()).split())


def _add_status(metrics: MetricTable, prefix: str, motion: RunTable, what: str, slow: float) -> None:
    status = text_column(motion, "status")
    moving = is_moving(motion, slow)
    braking = status == "braking"
    metrics.add(f"{prefix}_ticks", len(motion), "1", f"ticks of {what}")
    for name in STATUSES:
        share = float((status == name).mean()) if len(status) else None
        metrics.add(f"{prefix}_{name}_share", share, "1", f"share of all ticks of {what} with status '{name}'")
    deep = numeric_column(motion, "overlap_m")[status == "retreating"] if "overlap_m" in motion else np.zeros(0)
    metrics.add(
        f"{prefix}_retreating_overlap_max_m",
        float(np.nanmax(deep)) if np.isfinite(deep).any() else None,
        "m",
        f"maximum depth of a link inside a swept volume at the start of a retreating step of {what}: such a step is "
        "certified to bring no point of the link nearer to any point of the volume, not to be clear of it",
        reason="the table of motion does not contain it" if (status == "retreating").any() else "it never retreated",
    )
    reasons = text_column(motion, "reason")
    for reason in sorted(set(reasons[braking])):
        count = int((reasons[braking] == reason).sum())
        slug = _slug(reason) or "unnamed"
        because = f"ticks of {what} that braked because: {reason}"
        metrics.add(f"{prefix}_braking_ticks_{slug}", count, "1", because)
        metrics.add(f"{prefix}_braking_share_{slug}", count / len(motion), "1", f"share of all {because}")
    metrics.add(
        f"{prefix}_moving_ticks",
        int(moving.sum()),
        "1",
        f"ticks of {what} with the robot moving: its TCP at {slow:g} m/s or more, or a joint at 0.001 rad/s",
    )
    metrics.add(
        f"{prefix}_braking_moving_ticks",
        int((braking & moving).sum()),
        "1",
        f"ticks of {what} in braking with the robot still moving: inequality (2) may not hold there",
    )
    overlap = numeric_column(motion, "distance_m") <= 0.0
    metrics.add(
        f"{prefix}_contact_moving_ticks",
        int((overlap & moving).sum()),
        "1",
        f"ticks of {what} with the robot moving while a link touched a swept volume",
    )
    closest = numeric_column(motion, "distance_m")[braking & moving]
    closest = closest[np.isfinite(closest)]
    metrics.add(
        f"{prefix}_braking_moving_separation_min_m",
        float(closest.min()) if len(closest) else None,
        "m",
        f"smallest separation from the swept volumes at such braking ticks of {what}",
        reason="no braking tick with a moving robot and a known separation",
    )


def _add_separation(metrics: MetricTable, prefix: str, motion: RunTable, what: str, slow: float) -> None:
    distance = numeric_column(motion, "distance_m")
    known = np.isfinite(distance)
    reason = "no tick has a separation"
    k = int(np.argmin(np.where(known, distance, np.inf))) if known.any() else None
    name = f"{prefix}_separation"
    metrics.add(
        f"{name}_min_m",
        None if k is None else float(distance[k]),
        "m",
        f"smallest distance, surface to surface, between robot and swept volumes during {what}",
        reason=reason,
    )
    at_s = None if k is None else float((times(motion)[k] - times(motion)[0]) * 1e-9)
    metrics.add(f"{name}_min_at_s", at_s, "s", f"its first instant, from the first tick of {what}", reason=reason)
    for part in ("limb", "link"):
        found = None if k is None or pd.isna(motion[part].iloc[k]) else str(motion[part].iloc[k])
        metrics.add(f"{name}_min_{part}", found, "name", f"the {part} of that pair", reason=reason)
    moving = distance[known & is_moving(motion, slow)]
    metrics.add(
        f"{name}_min_moving_m",
        float(moving.min()) if len(moving) else None,
        "m",
        f"smallest separation at ticks of {what} with the robot moving",
        reason="the robot never moved at a known separation",
    )
    metrics.add(f"{name}_unknown_ticks", int((~known).sum()), "1", f"ticks of {what} without a separation")


def _add_stationary(metrics: MetricTable, prefix: str, motion: RunTable, what: str, near_m: float, slow: float) -> None:
    near, stands = stationary(motion, near_m, slow)
    both = int((near & stands).sum())
    metrics.add(f"{prefix}_near_ticks", int(near.sum()), "1", f"ticks of {what} with a separation <= {near_m:g} m")
    metrics.add(
        f"{prefix}_stationary_ticks",
        both,
        "1",
        f"of those, ticks with the TCP below {slow:g} m/s, and a reference at or over it or waiting",
    )
    metrics.add(
        f"{prefix}_stationary_share",
        both / int(near.sum()) if near.any() else None,
        "1",
        f"stationary ticks / near ticks of {what}: ticks at which its programme stands, as in a dwell, do not count as "
        f"standing; {prefix}_null_speed_share counts them; compare only runs on the same log",
        reason=f"the separation never was <= {near_m:g} m",
    )
    null = int((near & (numeric_column(motion, "tcp_speed") < slow)).sum())
    metrics.add(
        f"{prefix}_null_speed_ticks",
        null,
        "1",
        f"near ticks of {what} with the TCP below {slow:g} m/s; dwells of the programme count too",
    )
    metrics.add(
        f"{prefix}_null_speed_share",
        null / int(near.sum()) if near.any() else None,
        "1",
        f"those / near ticks of {what}: null velocity when near, as the paper counts",
        reason=f"the separation never was <= {near_m:g} m",
    )


def _add_path(metrics: MetricTable, prefix: str, motion: RunTable, what: str) -> None:
    for name, measure, meaning in (
        ("deviation", deviation_m, "distance from the TCP to the nearest point of the programmed path"),
        ("tracking_error", tracking_error_m, "distance from the TCP to the reference of the same tick"),
    ):
        values = measure(motion)
        values = values[np.isfinite(values)]
        for kind, number in (("mean", np.mean), ("p95", _p95), ("max", np.max)):
            value = float(number(values)) if len(values) else None
            metrics.add(f"{prefix}_{name}_{kind}_m", value, "m", f"{kind} over all ticks of {what}: {meaning}")


def _p95(values: Floats) -> float:
    return float(np.quantile(values, 0.95))


def _add_fastest(
    metrics: MetricTable, prefix: str, motion: RunTable, contact: RunTable | None, what: str, near_m: float
) -> None:
    """Adds the maximum speeds: of the TCP, of the TCP near the recorded body, and of the programme."""
    speeds = {
        "tcp_speed_max": (numeric_column(motion, "tcp_speed"), "speed of the TCP"),
        "ref_speed_max": (
            numeric_column(motion, "ref_speed"),
            "programmed speed of the TCP at the reference; that of the whole programme if it was completed",
        ),
    }
    close = np.zeros(0)
    if contact is not None:
        close = numeric_column(contact, "tcp_speed")[numeric_column(contact, "distance_m") <= near_m]
    speeds["tcp_speed_near_body_max"] = (
        close,
        f"speed of the TCP at ticks with a link within {near_m:g} m of the recorded body, surface to surface",
    )
    for name, (speed, meaning) in speeds.items():
        known = speed[np.isfinite(speed)]
        metrics.add(
            f"{prefix}_{name}_m_per_s",
            float(known.max()) if len(known) else None,
            "m/s",
            f"greatest over the ticks of {what}: {meaning}",
            reason="the recorded body was never known to be that near" if name.endswith("body_max") else "no tick",
        )


def _add_progress(metrics: MetricTable, prefix: str, motion: RunTable, what: str, max_reference_lead_m: float) -> None:
    tcp_speed, ref_speed = numeric_column(motion, "tcp_speed"), numeric_column(motion, "ref_speed")
    for name, speed, meaning in (
        ("tcp_speed", tcp_speed, "speed of the TCP"),
        ("ref_speed", ref_speed, "programmed speed of the TCP where the reference is"),
    ):
        known = speed[np.isfinite(speed)]
        mean = float(known.mean()) if len(known) else None
        metrics.add(f"{prefix}_{name}_mean_m_per_s", mean, "m/s", f"mean over all ticks of {what}: {meaning}")
    for name, what_moved in (("tcp", "TCP"), ("ref", "reference")):
        steps = step_lengths(position_columns(motion, name))
        metrics.add(
            f"{prefix}_{name}_travelled_m",
            float(np.nansum(steps)),
            "m",
            f"path that the {what_moved} travelled, {what}",
        )
    count = cycles(motion) if len(motion) else 0
    metrics.add(
        f"{prefix}_cycles",
        count or None,
        "1",
        f"times the reference came back to its first point, {what}",
        reason="the reference never came back to its first point",
    )
    found = programme_progress(motion, max_reference_lead_m)
    reason = "the programme is stationary all the time"
    metrics.add(
        f"{prefix}_time_lost_s",
        None if found is None else found[1] - found[0],
        "s",
        f"delay of {what} behind its programme at the last tick, by the reached position on the path",
        reason=reason,
    )
    metrics.add(
        f"{prefix}_progress_share",
        None if found is None or found[1] <= 0 else found[0] / found[1],
        "1",
        f"pace kept: the programmed time of the robot's own progress over the available time, {what}; 1 is the "
        "programme at full speed, 0 a robot that did not move. The reference, which runs ahead, does not count",
        reason=reason,
    )
