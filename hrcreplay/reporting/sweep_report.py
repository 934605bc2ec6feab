"""Results of a sweep: one table, one picture and one page over all runs.

The figures of a run, and their totals over the logs of a setting, are those of a comparison of methods.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hrcreplay.reporting import comparison
from hrcreplay.reporting.figures import drawing
from hrcreplay.reporting.metrics.planning import is_moving, numeric_column
from hrcreplay.reporting.page.report_page import PageFigure, PageSection
from hrcreplay.reporting.summary_text import Answer, Card
from hrcreplay.reporting.tables import NOT_CLAIMED, PageTable, share_text
from hrcreplay.store import run_folder
from hrcreplay.store.results import ResultsFolder

Values = Mapping[str, str]

_SEPARATION = "separation_moving_m"
#: Figures of a run: those of a comparison, and one that a run without contact has, too.
FIELDS = (
    *comparison.FIELDS,
    comparison.Field(_SEPARATION, "min", "m", "smallest separation from the swept volumes while moving"),
)


@dataclass(frozen=True)
class SweepRow:
    """One run of a sweep."""

    log: str  #: name of its log
    setting: int  #: index of its setting
    folder: str  #: in the results
    figures: Mapping[str, Any] | None  #: None: the run is not there
    cost: Mapping[str, float] | None  #: seconds, log_seconds, peak_mb, bytes
    error: str


def write(results: ResultsFolder, rows: Sequence[SweepRow], settings: Sequence[Values]) -> None:
    """Writes sweep.json, sweep.csv, costs.json, the picture and sweep.html.

    Args:
        results: Folder of the results.
        rows: All runs, log by log.
        settings: Values of the grid's keys of each setting.
    """
    totals = [
        total([row.figures for row in rows if row.setting == number and row.figures is not None])
        for number in range(len(settings))
    ]
    front = find_front(rows, totals)
    found = {
        "settings": [dict(values) for values in settings],
        "fields": {field.name: {"unit": field.unit, "meaning": field.meaning} for field in FIELDS},
        "runs": [
            {"log": row.log, "setting": row.setting, "run": row.folder, "error": row.error, "figures": row.figures}
            for row in rows
        ],
        "total": totals,
        "front": front,
    }
    results.write("sweep.json", run_folder.to_json(found))
    results.write("sweep.csv", as_csv(rows, settings, totals))
    results.write("costs.json", run_folder.to_json({row.folder: row.cost for row in rows if row.cost}))
    with drawing.style():
        figure = draw_front(rows, totals, front)
        svg = drawing.svg_bytes(figure)
        figure.set_facecolor("white")
        results.write("sweep.png", drawing.png_bytes(figure))
    results.write("sweep.svg", svg)
    results.write("sweep.html", render(rows, settings, totals, front, svg.decode()))


def cost_text(rows: Sequence[SweepRow]) -> str:
    """Says what the runs cost per hour of log, to plan more of them; empty without a run.

    Args:
        rows: All runs.
    """
    costs = [row.cost for row in rows if row.cost]
    if not costs:
        return ""
    log_s, worker_s, stored = (sum(cost[key] for cost in costs) for key in ("log_seconds", "seconds", "bytes"))
    most_mb = max(cost["peak_mb"] for cost in costs)
    return (
        f"beside the fusion that settings share, an hour of log with one setting costs {worker_s / log_s:.2f} hours of "
        f"a worker and {stored / log_s * 3600 / 1e9:.2f} GB of results; a worker needs at most {most_mb:.0f} MB"
    )


def figures(
    variant: comparison.Variant,
    motion: pd.DataFrame,
    contact: pd.DataFrame | None,
    meetings: pd.DataFrame | None,
    bounds: comparison.Bounds,
) -> dict[str, Any]:
    """Computes the figures of a run: FIELDS; None where one does not apply.

    Args:
        variant: Its method.
        motion: Its table of motion.
        contact: Its rows of contact; None: not computed.
        meetings: Its rows of severity; None: not computed.
        bounds: Bounds from the settings.
    """
    found = comparison.figures(variant, motion, contact, meetings, bounds)
    apart_m = numeric_column(motion, "distance_m")[is_moving(motion, bounds.stationary_m_per_s)]
    known_m = apart_m[np.isfinite(apart_m)]
    return found | {_SEPARATION: float(known_m.min()) if len(known_m) else None}


def total(each: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Computes the totals of a setting over several logs."""
    known_m = [row[_SEPARATION] for row in each if row[_SEPARATION] is not None]
    return comparison.total(each) | {_SEPARATION: min(known_m, default=None)}


def as_csv(rows: Sequence[SweepRow], settings: Sequence[Values], totals: Sequence[Mapping[str, Any]]) -> str:
    """Returns one row per run, then the totals of each setting over all logs.

    Args:
        rows: All runs.
        settings: Values of the grid's keys of each setting.
        totals: Figures of each setting over all logs.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    keys = list(settings[0])
    table.writerow(["log", "setting", *keys, "run", "error", *(field.name for field in FIELDS)])

    def line(log: str, setting: int, run: str, error: str, figures: Mapping[str, Any] | None) -> None:
        values = ["" if figures is None or figures[f.name] is None else figures[f.name] for f in FIELDS]
        table.writerow([log, setting + 1, *settings[setting].values(), run, error, *values])

    for row in rows:
        line(row.log, row.setting, row.folder, row.error, row.figures)
    for number, total in enumerate(totals):
        line(comparison.ALL, number, "", "", total)
    return text.getvalue()


def select_front(points: Sequence[tuple[float, float] | None]) -> list[int]:
    """Indices of the points that no other point beats in one coordinate without losing in the other, by the first.

    Args:
        points: Larger is better in both coordinates; None: unknown.
    """
    known = {i: point for i, point in enumerate(points) if point is not None}
    front = [
        i for i, (x, y) in known.items() if not any(u >= x and v >= y and (u, v) != (x, y) for u, v in known.values())
    ]
    return sorted(front, key=lambda i: known[i])


#: Figure, its factor and its name, against which the pace is drawn; the third replaces the first in runs of plan.
_NEAREST = ("nearest_moving_m", 100.0, "nearest to a person while moving [cm]")
_COVERAGE = ("coverage", 100.0, "ticks held in the volumes [%]")
_APART = (_SEPARATION, 100.0, "nearest to a swept volume while moving [cm]")


def _against(totals: Sequence[Mapping[str, Any]]) -> tuple[tuple[str, float, str], ...]:
    """Returns what the pace is drawn against."""
    known = any(one["nearest_moving_m"] is not None for one in totals)
    return (_NEAREST if known else _APART, _COVERAGE)


def _point(figures: Mapping[str, Any] | None, name: str, factor: float) -> tuple[float, float] | None:
    """Returns the pace [%] and another figure of a run; None if one is unknown."""
    if figures is None or figures["pace"] is None or figures[name] is None:
        return None
    return 100.0 * figures["pace"], factor * figures[name]


def find_front(rows: Sequence[SweepRow], totals: Sequence[Mapping[str, Any]], against: int = 0) -> list[int]:
    """Indices of the settings on the Pareto front of pace and another figure, of those that can be compared.

    Args:
        rows: All runs.
        totals: Figures of each setting over all logs.
        against: 0: distance; 1: coverage.
    """
    lacking, (name, factor, _) = _lacking(rows), _against(totals)[against]
    return select_front([None if n in lacking else _point(total, name, factor) for n, total in enumerate(totals)])


def _lacking(rows: Sequence[SweepRow]) -> list[int]:
    """Indices of the settings that lack a log that others have: it may be the hardest one for all of them."""
    logs = {row.log for row in rows if row.figures is not None}
    return sorted({row.setting for row in rows if row.figures is None and row.log in logs})


def draw_front(rows: Sequence[SweepRow], totals: Sequence[Mapping[str, Any]], front: Sequence[int]) -> Figure:
    """Draws the pace against distance and against coverage: a number per setting, a dot per run, and the fronts.

    Args:
        rows: All runs.
        totals: Figures of each setting over all logs.
        front: Settings on the front of pace and distance.
    """
    figure = drawing.new_figure(3.6)
    (axes,) = drawing.panels(figure, 1, 2, bottom_in=0.5)
    fronts = front, find_front(rows, totals, 1)
    for ax, (name, factor, label), best in zip(axes, _against(totals), fronts, strict=True):
        each = [_point(row.figures, name, factor) for row in rows]
        _draw_one(ax, [_point(total, name, factor) for total in totals], each, best)
        ax.set(xlabel="pace kept, of the programmed [%]", ylabel=label)
    axes[0].set_title("Settings by number; line: the Pareto front; dots: each run")
    return figure


def _draw_one(
    ax: Axes,
    totals: Sequence[tuple[float, float] | None],
    each: Sequence[tuple[float, float] | None],
    front: Sequence[int],
) -> None:
    """Draws one panel."""
    dots = [point for point in each if point is not None]
    if not dots:
        ax.text(0.5, 0.5, "not known in these runs", ha="center", va="center", transform=ax.transAxes)
        return
    ax.plot(*zip(*dots, strict=True), ".", ms=4, color=drawing.FAINT, alpha=0.5)
    path = np.array([point for i in front if (point := totals[i]) is not None]).reshape(-1, 2)
    ax.plot(*path.T, "-", lw=1.2, color=drawing.BLUE, drawstyle="steps-pre")
    for number, point in enumerate(totals):
        if point is not None:
            colour = drawing.BLUE if number in front else drawing.INK
            ax.plot(*point, "o", ms=4, color=colour)
            ax.annotate(str(number + 1), point, (3, 3), textcoords="offset points", color=colour, fontsize=7.5)


#: Maximum number of settings that the answer describes by their values.
_NAMED = 3
#: Heading, figure, factor and decimals of the page's columns.
_COLUMNS = (
    ("pace %", "pace", 100, 1),
    ("nearest moving m", "nearest_moving_m", 1, 3),
    ("nearest to volumes moving m", _SEPARATION, 1, 3),
    ("ticks in contact", "touch_ticks", 1, 0),
    ("moving without certificate", "uncertified_ticks", 1, 0),
    ("stands near %", "standing_share", 100, 1),
    ("held in volumes %", "coverage", 100, 1),
    ("TCP up to m/s", "tcp_speed_max_m_per_s", 1, 2),
    ("off path m", "deviation_max_m", 1, 3),
)


def _cells(figures: Mapping[str, Any] | None) -> tuple[str, ...]:
    cells = []
    for _, name, factor, decimals in _COLUMNS:
        value = None if figures is None else figures[name]
        if value is None:
            cells.append("\u2013")
        else:
            text = share_text(value, decimals).removesuffix(" %") if factor == 100 else f"{value:,.{decimals}f}"
            cells.append(text.replace("-", "\u2212"))
    return tuple(cells)


def render(
    rows: Sequence[SweepRow],
    settings: Sequence[Values],
    totals: Sequence[Mapping[str, Any]],
    front: Sequence[int],
    picture: str,
) -> str:
    """Renders the page of a sweep, with links to the runs.

    Args:
        rows: All runs.
        settings: Values of the grid's keys of each setting.
        totals: Figures of each setting over all logs.
        front: Settings on the front of pace and distance.
        picture: SVG of ``draw_front``.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(
        resources.files("hrcreplay.reporting.page").joinpath("page.html.j2").read_text("utf-8")
    )
    logs, failed = list(dict.fromkeys(row.log for row in rows)), [row for row in rows if row.error]
    there = [row for row in rows if row.figures is not None]
    return template.render(
        title="Sweep",
        subtitle=f"{_count(len(logs), 'log')}, {_count(len(settings), 'setting')}, {len(there)} of {len(rows)} runs",
        verdict=None,
        answers=(_answer(rows, settings, totals, front),),
        cards=(
            Card(str(len(there)), "runs", f"of {len(rows)}"),
            Card(str(len(failed)), "failed", "the table has the reasons"),
        ),
        parts=_parts(rows, settings, totals, picture),
        settings=[],
        inputs=[],
        versions=[],
        stages=[],
        flaws=tuple(f"{row.folder}: {row.error}" for row in failed),
        command="",
        not_claimed=NOT_CLAIMED,
        metrics=[(field.name, field.unit, False, field.meaning) for field in FIELDS],
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _answer(
    rows: Sequence[SweepRow],
    settings: Sequence[Values],
    totals: Sequence[Mapping[str, Any]],
    front: Sequence[int],
) -> Answer:
    """Names the settings on the Pareto front of pace and distance, those with contact, and those not compared."""

    def numbers(some: Sequence[int]) -> str:
        return ", ".join(str(number + 1) for number in some)

    recorded = _against(totals)[0] is _NEAREST
    far = "the recorded people" if recorded else "the predicted volumes"
    words = f"Each of these keeps more pace than any setting whose moving robot stayed further from {far}."
    if recorded:
        ticks, known = (sum(total[name] or 0 for total in totals) for name in ("ticks", "known_ticks"))
        words += (
            f"\nThe recorded people were known at {known:,} of {ticks:,} ticks; contact at the others is not known."
        )
        touched = [number for number, total in enumerate(totals) if total["touch_ticks"]]
        words += f"\nThe moving robot touched somebody with the settings {numbers(touched)}." if touched else ""
    else:
        words += "\nRuns of plan do not compare the robot with the recorded people: contact was not looked at."
    lacking = _lacking(rows)
    words += f"\nNot compared, as they lack a log that others have: settings {numbers(lacking)}." if lacking else ""
    named = [f"{number + 1} ({', '.join(f'{k} = {v}' for k, v in settings[number].items())})" for number in front]
    answer = "; ".join(named[:_NAMED]) + (f"; {numbers(front[_NAMED:])}" if front[_NAMED:] else "")
    return Answer("Which settings give the most pace for the distance?", f"{answer or 'None is known'}.", words)


def _parts(
    rows: Sequence[SweepRow], settings: Sequence[Values], totals: Sequence[Mapping[str, Any]], picture: str
) -> tuple[PageSection, ...]:
    """Makes the sections of the page: picture and totals, and all runs."""
    keys, heads = tuple(settings[0]), tuple(head for head, *_ in _COLUMNS)
    total_rows = tuple(
        (str(number + 1), *values.values(), *_cells(total))
        for number, (values, total) in enumerate(zip(settings, totals, strict=True))
    )
    run_rows = tuple(
        (row.log, Markup('<a href="{}/">{}</a>').format(row.folder, row.setting + 1), *_cells(row.figures), row.error)
        for row in rows
    )
    svg = Markup(picture[picture.index("<svg") :])  # noqa: S704 (our own)
    caption = "Pace kept against the smallest distance from a person, and against coverage, over all logs."
    return (
        PageSection(
            "settings-compared",
            "Settings compared",
            "All logs together: sums of ticks and times, and the worst extremes.",
            (PageFigure("sweep", caption, svg),),
            (PageTable("Settings", ("number", *keys, *heads), total_rows),),
            unfolded=True,
        ),
        PageSection(
            "runs",
            "Runs",
            "One row per log and setting; the number leads to the folder of the run.",
            (),
            (PageTable("Runs", ("log", "setting", *heads, "error"), run_rows),),
        ),
    )
