"""Metrics of contact with the recorded body, of certificates, of reasons for standing, and the events.

An event is a full stop of a method, or a contact of its moving robot with the recorded body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from hrcreplay.evaluation.contact import deciding_rows
from hrcreplay.evaluation.severity import merged_runs
from hrcreplay.records import ALLOWING_CONTACT, RECORDED, Bools, Floats, Ints
from hrcreplay.reporting.metrics.planning import is_moving, method_text, numeric_column
from hrcreplay.reporting.metrics.series import MetricTable, durations_s, times
from hrcreplay.settings.sections import setting
from hrcreplay.store.run_folder import Run
from hrcreplay.store.stored_table import RunTable, in_parts, rows_where, text_column

#: Source of the recorded person, as in contact.parquet, and in words.
PERSONS = {
    "ground truth": "the ground truth of the log",
    "camera points": "the points of every camera and the smoothed person, of which the nearest counts",
    "smoothed estimate": "the smoothed person",
}
#: Method -> why its contacts are no fault of controller or prediction.
_BLIND = {
    "none": "the programme without reaction uses no volumes",
    **dict.fromkeys(ALLOWING_CONTACT, "the method may touch people"),
}
_NOT_COMPARED = "the run has no table of contact"
#: Limbs that must be known of a recorded person, and the parts of the body that show them.
SHOWN_PARTS = {
    "legs": ("THIGH_R", "SHANK_R", "THIGH_L", "SHANK_L"),
    "arms": ("URA", "LRA", "ULA", "LLA"),
    "head": ("HD",),
    "trunk": ("THX",),
}


def method_prefixes(run: Run) -> dict[str, str]:
    """Method -> prefix of its metrics; the robot as recorded first, then the run's own method, ``none`` last."""
    own = str(setting(run.meta.get("settings", {}), "plan", "method"))
    return {
        **({} if run.recorded is None else {RECORDED: RECORDED}),
        own: "plan",
        **{name: f"baseline_{name}" for name in sorted(run.baselines, key=lambda name: (name == "none", name))},
    }


def motion_of(run: Run, prefix: str) -> RunTable:
    """Returns the table of motion of a method, by the prefix of its metrics."""
    found = {"plan": run.motion, RECORDED: run.recorded}.get(prefix)
    return run.baselines[prefix.removeprefix("baseline_")] if found is None else found


def add_contact(metrics: MetricTable, run: Run, slow_m_per_s: float) -> None:
    """Adds contact of robot and recorded body, and the certificates, for the plan and every baseline.

    Args:
        metrics: Table that the metrics are added to.
        run: The run's tables.
        slow_m_per_s: A TCP slower than this counts as stationary if no joint turns [m/s].
    """
    person = None if run.contact is None or not len(run.contact) else str(run.contact.iloc[0]["person"])
    metrics.add(
        "contact_person",
        person,
        "name",
        "source of the recorded person: the log's ground truth; else the points of every "
        "camera and the fused person smoothed over the whole run; else the latter alone",
        reason=_NOT_COMPARED,
    )
    _add_people(metrics, run)
    if run.motion is None:
        return
    for method, prefix in method_prefixes(run).items():
        what = method_text(prefix)
        motion = motion_of(run, prefix)
        if prefix != RECORDED:
            _add_stops(metrics, prefix, motion, what, slow_m_per_s)
        if run.contact is not None:
            rows = rows_where(run.contact, "method", method)
            _add_touch(metrics, prefix, rows, what)
            _add_nearest(metrics, prefix, rows, what)
            if prefix != RECORDED:
                _add_faults(metrics, prefix, rows, what, motion, blind=_BLIND.get(method, ""))
    if run.contact is not None:
        _add_left(metrics, run.contact)


def _add_people(metrics: MetricTable, run: Run) -> None:
    """Adds the number of people, the limbs of the person that were seen, and the missing part of a recorded robot."""
    frames = run.counts.get("person_frames_beside_others", 0)
    metrics.add(
        "others_frames",
        frames,
        "1",
        "frames with at least one body that is not the person: checked for contact, neither planned for nor predicted",
    )
    metrics.add(
        "programme_gaps_s",
        0.0 if run.meta.get("programme") == "task" else run.counts.get("joint_gaps_ms", 0) * 1e-3,
        "s",
        "of the programme, where that is the recorded robot's motion: a straight line over gaps in its joints",
    )
    for limb, parts in SHOWN_PARTS.items():
        share = None
        if run.body is not None and len(run.body):
            share = float(np.all([_is_whole(run.body, part) for part in parts], axis=0).mean())
        metrics.add(
            f"contact_{limb}_known_share",
            share,
            "1",
            f"share of the time in which the whole {limb} of the recorded person, {' '.join(parts)}, are known",
            reason=_NOT_COMPARED,
        )


def _is_whole(body: RunTable, part: str) -> Bools:
    """(n,) True if both ends of a part are known; a part with one known end is a ball."""
    if f"{part}_0_x" not in body:
        return np.zeros(len(body), dtype=np.bool_)
    first, second = ([numeric_column(body, f"{part}_{end}_{axis}") for axis in "xyz"] for end in (0, 1))
    apart = np.abs(np.subtract(first, second)).sum(axis=0)
    return np.asarray(apart > 0.0)


def _add_stops(metrics: MetricTable, prefix: str, motion: RunTable, what: str, slow: float) -> None:
    """Adds full stops, ticks without a certificate, horizons, and reasons for standing without braking."""
    status, moving = text_column(motion, "status"), is_moving(motion, slow)
    stops = (status == "braking") & moving
    metrics.add(
        f"{prefix}_full_stop_share",
        float(stops.mean()) if len(stops) else None,
        "1",
        f"share of all ticks of {what} in a full stop: braking with the robot still moving",
    )
    count = None
    if "certified" in motion:
        count = int((moving & ~motion["certified"].to_numpy(dtype=bool)).sum())
    metrics.add(
        f"{prefix}_uncertified_moving_ticks",
        count,
        "1",
        f"ticks of {what} with the robot moving without a certificate that its step and the stop after it are clear "
        "of the space that the person was predicted to reach until then",
        reason="the table of motion does not contain it",
    )
    for kind, number in (("median", np.median), ("max", np.max)):
        horizon = numeric_column(motion, "horizon_s") if "horizon_s" in motion else np.zeros(0)
        horizon = horizon[np.isfinite(horizon)]
        metrics.add(
            f"{prefix}_horizon_{kind}_s",
            float(number(horizon)) if len(horizon) else None,
            "s",
            f"{kind} over all ticks of {what}: horizon of the prediction",
            reason="the table of motion does not contain it",
        )
    reasons = text_column(motion, "reason")
    for reason in sorted(set(reasons[status != "braking"]) - {""}):
        slug = "_".join("".join(c if c.isalnum() else " " for c in reason.lower()).split())
        share = float(((reasons == reason) & (status != "braking")).mean())
        metrics.add(
            f"{prefix}_standing_share_{slug}",
            share,
            "1",
            f"share of all ticks of {what} that it stood because: {reason}",
        )


def _add_touch(metrics: MetricTable, prefix: str, rows: RunTable, what: str) -> None:
    """Adds number, duration and speed of the robot's contacts."""
    distance, moving = numeric_column(rows, "distance_m"), rows["moving"].to_numpy(dtype=bool)
    person, other = (numeric_column(rows, f"{who}_m") for who in ("person", "other"))
    known = np.isfinite(distance)
    touch = known & (distance <= 0.0)
    known_ticks = int(np.isfinite(person).sum())
    metrics.add(f"{prefix}_body_known_ticks", known_ticks, "1", f"ticks of {what} at which the person is known")
    for who, apart, of in (("person", person, "the person"), ("other", other, "a body that is not the person")):
        metrics.add(
            f"{prefix}_touch_{who}_ticks",
            int((moving & (apart <= 0.0)).sum()) if known.any() else None,
            "1",
            f"ticks of {what} with a moving link in contact with {of}",
            reason="no body is known at any tick",
        )
    near = other[moving & np.isfinite(other)]
    metrics.add(
        f"{prefix}_other_distance_min_moving_m",
        float(near.min()) if len(near) else None,
        "m",
        f"smallest distance between the surfaces of the moving robot and a body that is not the person, {what}",
        reason="no other body was seen while the robot moved",
    )
    for name, which, state in (("moving", touch & moving, "moving"), ("rest", touch & ~moving, "at rest")):
        metrics.add(
            f"{prefix}_touch_{name}_ticks",
            int(which.sum()) if known.any() else None,
            "1",
            f"ticks of {what} with a link of the robot, {state}, in contact with anybody recorded",
            reason="no body is known at any tick",
        )
    metrics.add(
        f"{prefix}_touch_moving_s",
        float(durations_s(times(rows))[touch & moving].sum()) if known.any() else None,
        "s",
        f"time in which a moving link of {what} was in contact with anybody recorded",
        reason="no body is known at any tick",
    )
    for name, column, of in (("contact", "contact_speed", "the link's surface there"), ("tcp", "tcp_speed", "the TCP")):
        speed = numeric_column(rows, column)[touch & moving]
        metrics.add(
            f"{prefix}_touch_{name}_speed_max_m_per_s",
            float(speed.max()) if len(speed) else None,
            "m/s",
            f"largest speed of {of} at these ticks of {what}",
            reason="no moving link touched the body",
        )


def _add_nearest(metrics: MetricTable, prefix: str, rows: RunTable, what: str) -> None:
    """Adds the smallest distance while moving and at rest, and its link and body part."""
    distance, moving = numeric_column(rows, "distance_m"), rows["moving"].to_numpy(dtype=bool)
    for name, which, state in (("moving", moving, "moving"), ("rest", ~moving, "at rest")):
        k = _least(distance, which)
        stem = f"{prefix}_body_distance_min_{name}"
        reason = f"no tick with the robot {state} and the body known"
        metrics.add(
            f"{stem}_m",
            None if k is None else float(distance[k]),
            "m",
            f"smallest distance between the robot ({state}) and anybody recorded, {what}; negative in overlap",
            reason=reason,
        )
        at_s = None if k is None else float((times(rows)[k] - times(rows)[0]) * 1e-9)
        metrics.add(f"{stem}_at_s", at_s, "s", f"its first instant, from the first tick of {what}", reason=reason)
        for part in ("limb", "link", "source"):
            value = None if k is None else str(rows[part].iloc[k])
            metrics.add(f"{stem}_{part}", value, "name", f"the {part} of that pair", reason=reason)
        if name == "moving":
            for label, column in (("tcp", "tcp_speed"), ("contact", "contact_speed")):
                speed = None if k is None else float(rows[column].iloc[k])
                of = "the TCP" if label == "tcp" else "the link's surface where it is nearest to the body"
                metrics.add(f"{stem}_{label}_speed_m_per_s", speed, "m/s", f"speed of {of} then", reason=reason)


def _least(distance: Floats, which: Bools) -> int | None:
    """Returns the row with the smallest known distance among some; None without one."""
    known = which & np.isfinite(distance)
    return int(np.argmin(np.where(known, distance, np.inf))) if known.any() else None


def retreats(motion: RunTable, t_ns: Ints) -> Bools:
    """Marks the ticks (n,) at which the motion was a retreat, or the stop of one."""
    decided = deciding_rows(motion)[np.searchsorted(times(motion), t_ns)]
    return np.asarray((decided >= 0) & (text_column(motion, "status")[decided] == "retreating"))


def _add_faults(metrics: MetricTable, prefix: str, rows: RunTable, what: str, motion: RunTable, *, blind: str) -> None:
    """Classifies contacts while moving: inside or outside the predicted volumes; ``blind``: why they are neither."""
    touch = (numeric_column(rows, "person_m") <= 0.0) & rows["moving"].to_numpy(dtype=bool)
    outside, retreat = numeric_column(rows, "outside_m")[touch], retreats(motion, times(rows)[touch])
    inside = outside <= 0.0
    for name, which, meaning in (
        (
            "inside",
            inside & ~retreat,
            "inside the volume used to certify the motion: the fault lies with the controller",
        ),
        (
            "retreating",
            inside & retreat,
            "inside a volume that the robot was moving out of: the person approached it",
        ),
        ("outside", outside > 0.0, "outside the volume used to certify the motion: the fault lies with the prediction"),
        ("unpredicted", ~np.isfinite(outside), "without a volume used to certify the motion"),
    ):
        metrics.add(
            f"{prefix}_touch_{name}_ticks",
            None if blind else int(which.sum()),
            "1",
            f"ticks of {what} with a moving link in contact with a part of the person that was {meaning}",
            reason=blind,
        )


def _add_left(metrics: MetricTable, contact: RunTable) -> None:
    """Adds the number of times the person left the volumes before their horizon, and before the braking time."""
    until = {"volumes": ("left", "the tick's horizon"), "volumes_full": ("left_full", "the braking time T_s")}
    for prefix, (column, end) in until.items():
        left = contact[np.isfinite(numeric_column(contact, f"{column}_m"))]
        out = numeric_column(left, f"{column}_m")
        reason = f"at no tick was a limb seen near the end of {end}"
        metrics.add(
            f"{prefix}_checked_ticks",
            len(left) or None,
            "1",
            f"ticks, 25 a second, whose volumes until {end} were compared with the recorded person: those at which a "
            "limb was seen in the last quarter of that time",
            reason=reason,
        )
        metrics.add(
            f"{prefix}_left_ticks",
            int((out > 0.0).sum()) if len(left) else None,
            "1",
            "of those, ticks with a recorded point of a limb, limb radius included, outside the limb's volume",
            reason=reason,
        )
        metrics.add(
            f"{prefix}_held_share",
            float((out <= 0.0).mean()) if len(left) else None,
            "1",
            "share of those ticks at which every limb that was seen stayed entirely inside its volume, as in audit",
            reason=reason,
        )
        never = "no limb left its volume" if len(left) else reason
        metrics.add(
            f"{prefix}_left_max_m",
            float(out.max()) if len(left) and out.max() > 0.0 else None,
            "m",
            "maximum distance of a limb outside",
            reason=never,
        )
        limbs = left[f"{column}_limb"][out > 0.0].astype(str).value_counts()
        found = ", ".join(f"{limb} {limbs[limb]}" for limb in sorted(limbs.index))
        metrics.add(
            f"{prefix}_left_limbs",
            found or None,
            "name",
            "the limb that was furthest outside, and its number of these ticks",
            reason=never,
        )


@dataclass(frozen=True)
class StopEvent:
    """A full stop, or a contact of the moving robot with the body."""

    kind: str  #: "stop" or "touch"
    at_s: float  #: by the report's clock [s]
    moving_s: float  #: duration of braking with the robot still moving, or of moving in contact [s]
    rest_s: float  #: time at rest after a stop, before it moved again [s]
    speed_m_per_s: float  #: speed of the TCP at the start of a stop; maximum speed of a contact
    distance_m: float  #: from the volumes at the start of a stop; minimum from the body in a contact; NaN: unknown [m]
    link: str
    limb: str
    reason: str


def stop_events(motion: RunTable, contact: RunTable | None, t0_ns: int, slow_m_per_s: float) -> tuple[StopEvent, ...]:
    """Returns the events of a method, in order of time.

    Args:
        motion: The method's table.
        contact: Its rows of contact.parquet; None without a comparison.
        t0_ns: Instant of time zero [ns].
        slow_m_per_s: A TCP slower than this counts as stationary if no joint turns [m/s].
    """
    found = _stops(motion, t0_ns, slow_m_per_s)
    if contact is not None and len(contact):
        found += _touches(contact, t0_ns)
    return tuple(sorted(found, key=lambda event: (event.at_s, event.kind)))


def _stops(motion: RunTable, t0_ns: int, slow: float) -> list[StopEvent]:
    t_ns, lasts_s = times(motion), durations_s(times(motion))
    moving = is_moving(motion, slow)
    braking = text_column(motion, "status") == "braking"
    speed, distance = (numeric_column(motion, name) for name in ("tcp_speed", "distance_m"))
    stopping, moves = braking & moving, np.flatnonzero(moving)
    stops = merged_runs(stopping, t_ns)
    names = _names_at(motion, [first for first, _ in stops])
    found = []
    for (first, last), (link, limb, reason) in zip(stops, names, strict=True):
        goes_on = int(np.searchsorted(moves, last))
        again = int(moves[goes_on]) if goes_on < len(moves) else len(t_ns)
        found.append(
            StopEvent(
                kind="stop",
                at_s=float((t_ns[first] - t0_ns) * 1e-9),
                moving_s=float(lasts_s[first:last][stopping[first:last]].sum()),
                rest_s=float(lasts_s[last:again].sum()),
                speed_m_per_s=float(speed[first]),
                distance_m=float(distance[first]),
                link=link,
                limb=limb,
                reason=reason,
            )
        )
    return found


def _touches(contact: RunTable, t0_ns: int) -> list[StopEvent]:
    t_ns, lasts_s = times(contact), durations_s(times(contact))
    distance, speed = (numeric_column(contact, name) for name in ("distance_m", "contact_speed"))
    touching = contact["moving"].to_numpy(dtype=bool) & (distance <= 0.0)
    runs = merged_runs(touching, t_ns)
    nearest = [
        first + int(np.nanargmin(np.where(touching[first:last], distance[first:last], np.inf))) for first, last in runs
    ]
    found = []
    for (first, last), at, (link, limb, _) in zip(runs, nearest, _names_at(contact, nearest), strict=True):
        found.append(
            StopEvent(
                kind="touch",
                at_s=float((t_ns[first] - t0_ns) * 1e-9),
                moving_s=float(lasts_s[first:last][touching[first:last]].sum()),
                rest_s=0.0,
                speed_m_per_s=float(speed[first:last][touching[first:last]].max()),
                distance_m=float(distance[at]),
                link=link,
                limb=limb,
                reason="",
            )
        )
    return found


def _names_at(table: RunTable, rows: Sequence[int]) -> list[tuple[str, ...]]:
    """Returns link, limb and reason in some rows; empty where there is none, or no such column."""
    each = []
    for name in ("link", "limb", "reason"):
        found, first, last = [""] * len(rows), 0, 0
        for part in in_parts(table, [name]) if name in table.columns else ():
            first, last = last, last + len(part)
            for k, row in enumerate(rows):
                if first <= row < last and not pd.isna(value := part[name].iloc[row - first]):
                    found[k] = str(value)
        each.append(found)
    return list(zip(*each, strict=True))
