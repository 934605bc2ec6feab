"""Comparison of methods: figures of each, totals over several logs, tables, and one plot of safety and pace.

Terminal, CSV, Markdown and JSON show the same numbers. Numbers that depend only on a motion are the metrics of a
report.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table

from hrcreplay.records import RECORDED, UNGUARDED, Floats
from hrcreplay.reporting import severity
from hrcreplay.reporting.figures import drawing, planning
from hrcreplay.reporting.metrics.contact import PERSONS, add_contact
from hrcreplay.reporting.metrics.planning import PAPER, add_plan, is_moving
from hrcreplay.reporting.metrics.series import Metric, MetricTable, times, true_runs
from hrcreplay.reporting.tables import PageTable, share_text
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import Run, RunWriter

#: A smaller pace is shown as 0.0 %: the robot made no progress.
NO_WAY = 0.0005

#: Name of the row with the total over several logs.
ALL = "all"


@dataclass(frozen=True)
class Variant:
    """A method with its prediction of the person: occupancy and horizon."""

    method: str
    occupancy: str
    horizon: str

    @property
    def label(self) -> str:
        """Label in the form that ``--methods`` takes; ``none`` and ``recorded`` have no volumes."""
        return self.method if self.method in UNGUARDED else f"{self.method}:{self.occupancy}:{self.horizon}"

    @property
    def slug(self) -> str:
        """Part of file names."""
        return self.label.replace(":", "_")


@dataclass(frozen=True)
class Bounds:
    """Settings that the figures need."""

    near_m: float
    stationary_m_per_s: float
    max_reference_lead_m: float


@dataclass(frozen=True)
class LogResult:
    """Results of one log."""

    name: str
    sha256: str
    person: str  #: source of the recorded person, as in contact.parquet
    seconds: float
    notes: tuple[str, ...]
    mass: str  #: source of the robot's mass, in words
    figures: Mapping[Variant, Mapping[str, Any]]


@dataclass(frozen=True)
class Field:
    """A figure: its total over several logs, its unit and its meaning."""

    name: str
    how: str  #: sum, min, max; or "a / b" of two others; or "mean", "rms" by ticks
    unit: str
    meaning: str


FIELDS = (
    Field("ticks", "sum", "1", "ticks"),
    Field("known_ticks", "sum", "1", "ticks at which the person is known"),
    Field("touch_ticks", "sum", "1", "ticks with a moving link in contact with anybody recorded"),
    Field("touch_person_ticks", "sum", "1", "of these, with the person"),
    Field("touch_other_ticks", "sum", "1", "of these, with another body, which the robot did not consider"),
    Field("touch_s", "sum", "s", "the time of these"),
    Field("touch_inside_ticks", "sum", "1", "with the person inside the volumes: the fault lies with the controller"),
    Field("touch_retreating_ticks", "sum", "1", "with the robot moving out of the volumes: the person approached"),
    Field(
        "touch_outside_ticks",
        "sum",
        "1",
        "with the person outside the volumes: the fault lies with the prediction",
    ),
    Field(
        "touch_unpredicted_ticks",
        "sum",
        "1",
        "with the person, by a motion not checked against a volume of that limb",
    ),
    Field("touch_rest_ticks", "sum", "1", "ticks with a link at rest in contact with anybody recorded"),
    Field("touch_speed_m_per_s", "max", "m/s", "largest speed of the touching surface while moving"),
    Field("nearest_moving_m", "min", "m", "smallest distance, surface to surface, while moving; negative in overlap"),
    Field("nearest_rest_m", "min", "m", "the same at rest"),
    Field("moving_ticks", "sum", "1", "ticks with the robot moving"),
    Field("uncertified_ticks", "sum", "1", "of these, ticks without a certificate"),
    Field(
        "still_logs",
        "sum",
        "1",
        "logs on which the robot never moved, or made no progress: no contact is then not a success",
    ),
    Field("tcp_speed_max_m_per_s", "max", "m/s", "greatest speed of the TCP"),
    Field("tcp_speed_near_body_m_per_s", "max", "m/s", "the same within report.near_m of the recorded body"),
    Field("programme_speed_max_m_per_s", "max", "m/s", "maximum programmed speed of the TCP, at the reference"),
    Field("retreating_ticks", "sum", "1", "ticks in retreat: they begin inside a volume"),
    Field("retreating_share", "retreating_ticks / ticks", "1", "retreating ticks / ticks"),
    Field("retreating_overlap_m", "max", "m", "maximum depth of a link inside a volume at these ticks"),
    Field("near_ticks", "sum", "1", "ticks with at most report.near_m between robot and volumes"),
    Field("standing_ticks", "sum", "1", "of these, the robot stands although its programme moves or waits for it"),
    Field("standing_share", "standing_ticks / near_ticks", "1", "standing ticks / near ticks"),
    Field("null_speed_ticks", "sum", "1", "near ticks with a TCP that stands, programmed dwells included"),
    Field("null_speed_share", "null_speed_ticks / near_ticks", "1", "null velocity when near, as the paper defines it"),
    Field("made_s", "sum", "s", "programmed time of the robot's progress"),
    Field("given_s", "sum", "s", "time that it had"),
    Field("pace", "made_s / given_s", "1", "pace kept, of the programmed"),
    Field("cycles", "sum", "1", "times the reference came back to its first point"),
    Field("deviation_mean_m", "mean", "m", "distance of the TCP from the programmed path, mean"),
    Field("deviation_max_m", "max", "m", "the same, largest"),
    Field("braking_events", "sum", "1", "times that a moving robot began to brake"),
    Field("jerk_rms_rad_per_s3", "rms", "rad/s^3", "joint jerk, root mean square over ticks and axes"),
    Field("jerk_max_rad_per_s3", "max", "rad/s^3", "joint jerk, largest"),
    Field(
        "checked_ticks",
        "sum",
        "1",
        "ticks, 25 a second, at which a limb was seen near the end of the tick's horizon",
    ),
    Field("held_ticks", "sum", "1", "of these, every limb that was seen stayed whole inside its volume"),
    Field("coverage", "held_ticks / checked_ticks", "1", "held ticks / checked ticks"),
    Field("left_max_m", "max", "m", "maximum distance by which a limb left its volume"),
    Field("full_checked_ticks", "sum", "1", "the same until the braking time T_s, as in audit: ticks"),
    Field("full_held_ticks", "sum", "1", "of these, every limb that was seen stayed whole inside its volume"),
    Field("full_coverage", "full_held_ticks / full_checked_ticks", "1", "as audit counts it until T_s"),
    Field("contacts", "sum", "1", "contacts of the moving robot with anybody recorded: stretches of ticks"),
    Field("contacts_over", "sum", "1", "of these, with an estimated force above the limit if the part gives way"),
    Field("contacts_over_clamped", "sum", "1", "of these, with an estimated force above the limit if it is clamped"),
    Field("contact_energy_max_j", "max", "J", "largest energy that a contact transfers, estimated"),
    Field(
        "contact_force_share_max",
        "max",
        "1",
        "largest estimated force of a short contact as a share of the body region's limit",
    ),
)
#: What a variant has beside FIELDS: brakings by cause, and the row of severity.parquet of its worst contact.
MORE = ("braking_events_by_cause", "worst_contact")
#: Figures that are metrics of the report -> their names there, after ``plan_`` except for those of the volumes.
_METRICS = {
    "ticks": "plan_ticks",
    "known_ticks": "plan_body_known_ticks",
    "touch_ticks": "plan_touch_moving_ticks",
    "touch_person_ticks": "plan_touch_person_ticks",
    "touch_other_ticks": "plan_touch_other_ticks",
    "touch_s": "plan_touch_moving_s",
    "touch_inside_ticks": "plan_touch_inside_ticks",
    "touch_retreating_ticks": "plan_touch_retreating_ticks",
    "touch_outside_ticks": "plan_touch_outside_ticks",
    "touch_unpredicted_ticks": "plan_touch_unpredicted_ticks",
    "touch_rest_ticks": "plan_touch_rest_ticks",
    "touch_speed_m_per_s": "plan_touch_contact_speed_max_m_per_s",
    "nearest_moving_m": "plan_body_distance_min_moving_m",
    "nearest_rest_m": "plan_body_distance_min_rest_m",
    "moving_ticks": "plan_moving_ticks",
    "uncertified_ticks": "plan_uncertified_moving_ticks",
    "tcp_speed_max_m_per_s": "plan_tcp_speed_max_m_per_s",
    "tcp_speed_near_body_m_per_s": "plan_tcp_speed_near_body_max_m_per_s",
    "programme_speed_max_m_per_s": "plan_ref_speed_max_m_per_s",
    "retreating_overlap_m": "plan_retreating_overlap_max_m",
    "near_ticks": "plan_near_ticks",
    "standing_ticks": "plan_stationary_ticks",
    "null_speed_ticks": "plan_null_speed_ticks",
    "cycles": "plan_cycles",
    "deviation_mean_m": "plan_deviation_mean_m",
    "deviation_max_m": "plan_deviation_max_m",
    "checked_ticks": "volumes_checked_ticks",
    "left_max_m": "volumes_left_max_m",
    "full_checked_ticks": "volumes_full_checked_ticks",
}


#: Figures that need a controller, a programme or a certificate; the robot as recorded has none.
_OF_CONTROLLERS = (
    *("touch_inside_ticks", "touch_retreating_ticks", "touch_outside_ticks", "touch_unpredicted_ticks"),
    *("uncertified_ticks", "retreating_ticks", "retreating_overlap_m", "standing_ticks", "braking_events"),
)


def figures(
    variant: Variant,
    motion: pd.DataFrame,
    contact: pd.DataFrame | None,
    meetings: pd.DataFrame | None,
    bounds: Bounds,
) -> dict[str, Any]:
    """Computes the figures of a variant on one log: FIELDS, MORE; None if inapplicable.

    Args:
        variant: The variant.
        motion: Its table of motion.
        contact: Its rows of contact; None: not computed.
        meetings: Its rows of severity; None: not computed.
        bounds: Bounds from the settings.
    """
    metrics = _metrics(variant, motion, contact, bounds)
    known = {name: key for name, key in _METRICS.items() if contact is not None or key in metrics}
    found = dict.fromkeys(_METRICS) | {name: metrics[key]["value"] for name, key in known.items()}
    given_s, lost_s = float(times(motion)[-1] - times(motion)[0]) * 1e-9, metrics["plan_time_lost_s"]["value"]
    found["given_s"], found["made_s"] = (None, None) if lost_s is None else (given_s, given_s - lost_s)
    found["retreating_ticks"] = int((motion["status"].astype(str) == "retreating").sum())
    pace = None if found["made_s"] is None or not given_s else found["made_s"] / given_s
    found["still_logs"] = int(not found["moving_ticks"] or (pace is not None and pace < NO_WAY))
    causes = braking_events(motion, bounds.stationary_m_per_s)
    found["braking_events"] = sum(causes.values())
    jerk = _jerk(motion)
    # Accelerations are not recorded. The memory layout is kept, as it is the order of the sum.
    jerk = np.asfortranarray(jerk[np.isfinite(jerk).all(axis=1)])
    found["jerk_rms_rad_per_s3"] = float(np.sqrt(np.mean(jerk**2))) if jerk.size else None
    found["jerk_max_rad_per_s3"] = float(np.abs(jerk).max()) if jerk.size else None
    for prefix, until in (("", "volumes"), ("full_", "volumes_full")):
        checked = found[f"{prefix}checked_ticks"]
        left = None if checked is None else metrics[f"{until}_left_ticks"]["value"]
        found[f"{prefix}held_ticks"] = None if checked is None else checked - left
    if variant.method == RECORDED:
        found |= dict.fromkeys(_OF_CONTROLLERS)
    met = dict.fromkeys(severity.FIGURES) if meetings is None else severity.summary(meetings)
    return _add_ratios(found | met) | {"braking_events_by_cause": causes, "worst_contact": met["worst"]}


def _metrics(variant: Variant, motion: pd.DataFrame, contact: pd.DataFrame | None, bounds: Bounds) -> dict[str, Metric]:
    """Computes the metrics of this motion as in a report, without other methods."""
    table = MetricTable()
    settings = {"plan": {"method": variant.method}}
    add_plan(
        table,
        motion,
        {},
        method=variant.method,
        near_m=bounds.near_m,
        stationary_m_per_s=bounds.stationary_m_per_s,
        max_reference_lead_m=bounds.max_reference_lead_m,
        contact=contact,
    )
    run = Run(Path(), {"settings": settings}, motion=motion, contact=contact)
    add_contact(table, run, bounds.stationary_m_per_s)
    return table.sorted()


def braking_events(motion: pd.DataFrame, slow_m_per_s: float) -> dict[str, int]:
    """Counts how often a moving robot began to brake, by the recorded reason at that tick."""
    runs = true_runs((motion["status"].astype(str) == "braking").to_numpy())
    moving, reasons = is_moving(motion, slow_m_per_s), motion["reason"].fillna("").astype(str).to_numpy()
    found: dict[str, int] = {}
    for first in runs[:, 0].tolist():
        if moving[first]:
            found[reasons[first]] = found.get(reasons[first], 0) + 1
    return dict(sorted(found.items()))


def _jerk(motion: pd.DataFrame) -> Floats:
    """(n - 1, nv) change of the joint accelerations from tick to tick [rad/s^3]."""
    axes = [name for name in motion.columns if name[0] == "u" and name[1:].isdigit()]
    u = motion[axes].to_numpy(dtype=float)
    return np.asarray(np.diff(u, axis=0) / (np.diff(times(motion)) * 1e-9)[:, None])


def _add_ratios(found: dict[str, Any]) -> dict[str, Any]:
    """Returns the figures in the order of FIELDS, including the ratios."""
    for field in FIELDS:
        if "/" in field.how:
            above, below = (found[part.strip()] for part in field.how.split("/"))
            found[field.name] = None if above is None or not below else above / below
    return {field.name: found[field.name] for field in FIELDS}


def total(each: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Computes the totals of a variant over several logs: sums of counts and times, and the worst extremes."""
    found: dict[str, Any] = {}
    for field in FIELDS:
        known = [row for row in each if row[field.name] is not None]
        values = [row[field.name] for row in known]
        ticks = sum(row["ticks"] for row in known)
        if "/" in field.how or not values:
            found[field.name] = None
        elif field.how in ("mean", "rms"):
            power = 1 if field.how == "mean" else 2
            found[field.name] = (sum(row["ticks"] * row[field.name] ** power for row in known) / ticks) ** (1 / power)
        else:
            found[field.name] = (
                sum(values) if field.how == "sum" else min(values) if field.how == "min" else max(values)
            )
    causes: dict[str, int] = {}
    for row in each:
        for cause, count in row["braking_events_by_cause"].items():
            causes[cause] = causes.get(cause, 0) + count
    rows = [row["worst_contact"] for row in each if row["worst_contact"] is not None]
    worst = severity.worst(pd.DataFrame(rows).astype(severity.NUMBERS)) if rows else None
    return _add_ratios(found) | {"braking_events_by_cause": dict(sorted(causes.items())), "worst_contact": worst}


def results(logs: Sequence[LogResult]) -> dict[str, Any]:
    """Returns the content of compare.json; the robot as recorded stands first, on the logs that contain it."""
    every = dict.fromkeys(variant for log in logs for variant in log.figures)
    methods = sorted(every, key=lambda variant: variant.method != RECORDED)
    return {
        "methods": {
            variant.label: {"method": variant.method}
            | ({} if variant.method in UNGUARDED else {"occupancy": variant.occupancy, "horizon": variant.horizon})
            for variant in methods
        },
        "fields": {field.name: {"unit": field.unit, "meaning": field.meaning} for field in FIELDS},
        "logs": [
            {
                "log": log.name,
                "sha256": log.sha256,
                "person": log.person,
                "seconds": log.seconds,
                "notes": list(log.notes),
                "robot_mass": log.mass,
                "methods": {variant.label: _select_told(figures, 1) for variant, figures in log.figures.items()},
            }
            for log in logs
        ],
        "total": {
            variant.label: _select_told(total(rows), len(rows))
            for variant in methods
            for rows in [[log.figures[variant] for log in logs if variant in log.figures]]
        },
        "paper": {
            name: {"value": PAPER[f"paper_stationary_share_{name}"][0], "unit": "1", "meaning": _PAPER}
            for name in ("qp", "scaling")
        },
    }


def _select_told(row: Mapping[str, Any], logs: int) -> dict[str, Any]:
    """Returns the figures of a variant with a remark on its standstill; None for a variant that made progress."""
    return {**row, "stillness": stillness(row, logs) or None}


_PAPER = (
    "share of the ticks at most 0.50 m from the volumes at which the paper's robot stood, in experiments whose logs "
    "were never published: to be compared in kind only"
)

#: Heading with its unit, figure, factor and decimals.
_COLUMNS = (
    ("ticks in\ncontact", "touch_ticks", 1, 0),
    ("fastest\nm/s", "touch_speed_m_per_s", 1, 2),
    ("TCP up to\nm/s", "tcp_speed_max_m_per_s", 1, 2),
    ("near body\nm/s", "tcp_speed_near_body_m_per_s", 1, 2),
    ("nearest\nmoving m", "nearest_moving_m", 1, 3),
    ("nearest\nat rest m", "nearest_rest_m", 1, 3),
    ("pace\n%", "pace", 100, 1),
    ("\ncycles", "cycles", 1, 0),
    ("stands\nnear %", "standing_share", 100, 1),
    ("no speed\nnear %", "null_speed_share", 100, 1),
    ("off path\nm", "deviation_max_m", 1, 3),
    ("\nbrakings", "braking_events", 1, 0),
    ("jerk\nrad/s\u00b3", "jerk_rms_rad_per_s3", 1, 0),
    ("held in\nvolumes %", "coverage", 100, 1),
)


def _cell(value: float | None, factor: int, decimals: int) -> str:
    """Formats a figure for readers."""
    if value is None:
        return "\u2013"
    text = share_text(value, decimals).removesuffix(" %") if factor == 100 else f"{factor * value:,.{decimals}f}"
    return text.replace("-", "\u2212")


def stillness(row: Mapping[str, Any], logs: int) -> str:
    """Returns a remark on a method that never moved, or made no progress, with the number of logs; empty if it did.

    Args:
        row: Its figures.
        logs: Number of logs.
    """
    if not row["still_logs"]:
        return ""
    if row["still_logs"] < logs:
        return f"no progress on {row['still_logs']} of {logs} logs"
    return "made no progress" if row["moving_ticks"] else "never moved"


def notes(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns the notes of all logs, each with the log's name."""
    return [(log["log"], note) for log in found["logs"] for note in log["notes"]]


def page_tables(found: Mapping[str, Any]) -> tuple[PageTable, ...]:
    """Returns the tables for terminal and Markdown: the methods side by side, and the reasons for braking."""
    logs = [(log["log"], log["methods"]) for log in found["logs"]]
    if len(logs) > 1:
        logs.append((ALL, found["total"]))
    lead = ("log", "method") if len(logs) > 1 else ("method",)
    rows, brakings = [], []
    causes = sorted({cause for row in found["total"].values() for cause in row["braking_events_by_cause"]})
    for log, methods in logs:
        for label, row in methods.items():
            head = (log, label) if len(logs) > 1 else (label,)
            cells = [_cell(row[name], *how) for _, name, *how in _COLUMNS]
            if row["stillness"]:  # so that it is not read as a success
                cells[0] += f"\n({row['stillness']})"
            rows.append((*head, *cells))
            by_cause = row["braking_events_by_cause"]
            brakings.append((*head, *(f"{by_cause.get(cause, 0):,}" for cause in causes)))
    tables = [PageTable("Methods", (*lead, *(column[0] for column in _COLUMNS)), tuple(rows), _note(found))]
    if causes:
        named = tuple(cause or "unnamed" for cause in causes)
        note = "Times that a moving robot began to brake, by the reason at that tick."
        tables.append(PageTable("Brakings by cause", (*lead, *named), tuple(brakings), note))
    masses = dict.fromkeys(log["robot_mass"] for log in found["logs"])
    met = {
        f"{log}, {label}" if len(logs) > 1 else label: {**row, "worst": row["worst_contact"]}
        for log, methods in logs
        for label, row in methods.items()
    }
    return (*tables, severity.severity_table(met, "; ".join(masses)))


def _note(found: Mapping[str, Any]) -> str:
    """Returns a note on the numbers and those of the paper."""
    persons = sorted({PERSONS.get(log["person"], log["person"]) for log in found["logs"]})
    of_plans = [next(row for method, row in log["methods"].items() if method != RECORDED) for log in found["logs"]]
    known, ticks = (sum(row[name] for row in of_plans) for name in ("known_ticks", "ticks"))
    qp, scaling = (share_text(found["paper"][name]["value"], 2) for name in ("qp", "scaling"))
    outside, other = (
        sum(row[f"touch_{of}_ticks"] or 0 for row in found["total"].values()) for of in ("outside", "other")
    )
    fault = (
        f" At {outside:,} of the ticks in contact the person was outside the volumes that the motion was certified by."
        if outside
        else ""
    )
    if other:
        fault += f" At {other:,} of them it was another body than the person, which the robot did not consider."
    if (ran := found["total"].get(RECORDED)) is not None:
        logs = sum(RECORDED in log["methods"] for log in found["logs"])
        of = f" (on {logs} of {len(found['logs'])} logs)" if logs < len(found["logs"]) else ""
        fault += (
            f" Recorded: the robot as it ran{of}; it and the person are both known at {ran['known_ticks']:,} of "
            f"{ran['ticks']:,} ticks."
        )
    still = [label for label, row in found["total"].items() if row["still_logs"]]
    fault += f" No contact of a robot that makes no way is a success: {', '.join(still)}." if still else ""
    programmed = [row["programme_speed_max_m_per_s"] or 0.0 for row in found["total"].values()]
    return (
        f"The person is {' or '.join(persons)}, known at {known:,} of {ticks:,} ticks. Contact: while the robot "
        f"moves.{fault} The programme's TCP makes up to {max(programmed):.2f} m/s; near body: within report.near_m "
        "of the recorded person. Near: at most report.near_m from the volumes. Stands near: though its programme "
        "moves; no speed near, as the paper counts: programmed dwells, too. The paper's robot stood in "
        f"{scaling} (scaling) and {qp} (QP) of the ticks near people, on its own data: compare in kind only."
    )


def print_tables(found: Mapping[str, Any]) -> None:
    """Prints the tables on standard error, separate from the result on standard output."""
    console = Console(stderr=True, markup=False, emoji=False, highlight=False)
    if not console.is_terminal:
        console.width = 190
    for table in page_tables(found):
        shown = Table(title=table.title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
        for column in table.columns:
            shown.add_column(column, justify="left" if column in ("log", "method") else "right", no_wrap=True)
        for row in table.rows:
            shown.add_row(*row)
        console.print(shown)
        console.print(table.note)


def write(found: Mapping[str, Any], writer: RunWriter) -> None:
    """Writes compare.json, compare.csv, compare.md and the figure."""
    writer.text("compare.json", run_folder.to_json(found))
    writer.text("compare.csv", as_csv(found))
    writer.text("compare.md", as_markdown(found))
    folder = writer.partial / "figures"
    folder.mkdir(exist_ok=True)
    with drawing.style():
        drawing.save(planning.methods(found), folder, "compare")


def as_csv(found: Mapping[str, Any]) -> str:
    """Returns one row per log and method, and the totals over all logs; an empty cell if a figure does not apply."""
    causes = sorted({cause for row in found["total"].values() for cause in row["braking_events_by_cause"]})
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    named = [f"braking_events_{cause.replace(' ', '_') or 'unnamed'}" for cause in causes]
    lead = ["log", "variant", "method", "occupancy", "horizon", "stillness"]
    table.writerow([*lead, *(field.name for field in FIELDS), *named])
    for log, methods in (*((log["log"], log["methods"]) for log in found["logs"]), (ALL, found["total"])):
        for label, row in methods.items():
            of = found["methods"][label]
            values = ["" if row[field.name] is None else row[field.name] for field in FIELDS]
            by_cause = [row["braking_events_by_cause"].get(cause, 0) for cause in causes]
            who = [of["method"], of.get("occupancy", ""), of.get("horizon", ""), row["stillness"] or ""]
            table.writerow([log, label, *who, *values, *by_cause])
    return text.getvalue()


def as_markdown(found: Mapping[str, Any]) -> str:
    """Returns the tables and the notes of the terminal."""
    parts = []
    for table in page_tables(found):
        head = [
            f"## {table.title}",
            "",
            f"| {' | '.join(' '.join(column.split()) for column in table.columns)} |",
            f"|{'---|' * len(table.columns)}",
        ]
        parts.append("\n".join([*head, *(f"| {' | '.join(row)} |".replace("\n", " ") for row in table.rows)]))
        parts[-1] += f"\n\n{table.note}\n"
    several = len(found["logs"]) > 1
    told = [f"- {log}: {note}" if several else f"- {note}" for log, note in notes(found)]
    parts += ["\n".join(["## Notes", "", *told, ""])] if told else []
    return "\n".join(parts)
