"""Figures of the robot: path (Fig. 13), speed (Fig. 14), horizon, status, stationary share, methods compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hrcreplay.records import RECORDED, STATUSES, Bools, Floats
from hrcreplay.reporting.figures import drawing
from hrcreplay.reporting.figures.prediction import Limbs, stored_at
from hrcreplay.reporting.figures.scene import ABOVE, View, bounds_of, draw_outlines, view_from
from hrcreplay.reporting.metrics.planning import numeric_column, position_columns, stationary
from hrcreplay.reporting.metrics.series import Metric, envelope, feet_in_turn, seconds_from, thin_path, times, true_runs
from hrcreplay.reporting.tables import share_text
from hrcreplay.store.stored_table import RunTable, in_parts

SIDE = view_from(-0.5 * np.pi, 0.0)
#: Time before and after the largest deviation in which the path is drawn in bold [s].
_PASS_S = 2.0
#: Motion between two drawn points of a path [m].
_THIN_M = 0.004
#: Minimum deviation [m].
SHORTEST_M = 0.5e-3


@dataclass(frozen=True)
class Deviation:
    """Largest deviation of the TCP from the programmed path."""

    row: int  #: row of motion.parquet
    at_m: Floats  #: (3,) the TCP, world
    foot_m: Floats  #: (3,) the nearest point of the programmed path, world

    @property
    def length_m(self) -> float:
        """Length of the deviation."""
        return float(np.linalg.norm(self.at_m - self.foot_m))


def largest_deviation(motion: RunTable) -> Deviation:
    """Finds the largest distance between the TCP and the programmed path."""
    tcp = position_columns(motion, "tcp")
    worst, worst_m = Deviation(0, tcp[0], np.full(3, np.nan)), -1.0
    for rows, feet in feet_in_turn(tcp, position_columns(motion, "ref")):
        far_m = np.linalg.norm(tcp[rows] - feet, axis=1)
        k = int(np.argmax(far_m))
        if far_m[k] > worst_m:
            worst, worst_m = Deviation(int(rows[k]), tcp[rows[k]], feet[k]), float(far_m[k])
    return worst


def path(
    motion: RunTable,
    occupancy: RunTable | None,
    t0_ns: int,
    T_world_base: Floats | None = None,
    worst: Deviation | None = None,
) -> Figure:
    """Fig. 13a: draws the programmed and the actual TCP path from above and from the side; dots: the largest deviation.

    Also draws the outlines of the swept volumes stored last before that tick.

    Args:
        motion: Rows of motion.parquet.
        occupancy: Rows of occupancy.parquet; None without stored volumes.
        t0_ns: Instant of time zero [ns].
        T_world_base: (4, 4) pose of the robot's base, drawn as a square; None: not drawn.
        worst: The largest deviation, if already known.
    """
    worst = worst or largest_deviation(motion)
    limbs = _limbs_at(occupancy, motion, worst)
    figure = drawing.column_figure(2.45)
    (above, side), *_ = drawing.column_panels(figure, 1, 2, bottom_in=0.62)
    base = np.zeros((0, 3)) if T_world_base is None else T_world_base[None, :3, 3]
    ways = _Ways.of(motion, worst)
    for ax, view in ((above, ABOVE), (side, SIDE)):
        _draw_path(ax, view, ways, limbs, worst)
        low, high = bounds_of(chain(_flat(motion, "ref", view), _flat(motion, "tcp", view), [view.flat(base)]), 0.08)
        drawing.set_window(ax, low.tolist(), high.tolist())
        if T_world_base is not None:
            ax.plot(*view.flat(T_world_base[None, :3, 3]).T, "s", color=drawing.INK, ms=4, zorder=3)
    at = f", at {(int(times(motion)[worst.row]) - t0_ns) * 1e-9:.1f} s" if worst.length_m >= SHORTEST_M else ""
    above.set(title=f"From above{at}", xlabel="x [m]", ylabel="y [m]")
    side.set(title="From the side", xlabel="x [m]", ylabel="z [m]")
    _path_legend(figure, with_limbs=bool(limbs), with_base=T_world_base is not None)
    return figure


def deviation(motion: RunTable, occupancy: RunTable | None, t0_ns: int, worst: Deviation | None = None) -> Figure:
    """Fig. 13b: draws the largest deviation in its vertical plane, so that its length is not distorted.

    Args:
        motion: Rows of motion.parquet.
        occupancy: Rows of occupancy.parquet; None without stored volumes.
        t0_ns: Instant of time zero [ns].
        worst: The largest deviation, if already known.
    """
    worst = worst or largest_deviation(motion)
    limbs = _limbs_at(occupancy, motion, worst)
    figure = drawing.column_figure(2.6)
    ((ax,),) = drawing.column_panels(figure, bottom_in=0.62)
    away = worst.at_m - worst.foot_m
    view = view_from(float(np.arctan2(away[1], away[0]) - 0.5 * np.pi), 0.0)
    ends = view.flat(np.vstack([worst.foot_m, worst.at_m]))
    _draw_path(ax, view, _Ways.of(motion, worst), limbs, worst)
    low, high = bounds_of([ends], 0.4 * worst.length_m + 0.06)
    drawing.set_window(ax, low.tolist(), high.tolist())
    at = f"At {(int(times(motion)[worst.row]) - t0_ns) * 1e-9:.1f} s"
    ax.set(title=at, xlabel="in the vertical plane of the deviation [m]", ylabel="z [m]")
    parts, middle = _flat(motion, "tcp", view), ends.mean(axis=0)
    crowd = np.concatenate([tcp[np.linalg.norm(tcp - middle, axis=1) < worst.length_m] for tcp in parts])
    _label_length(ax, ends, f"{worst.length_m:.3f} m", crowd)
    _path_legend(figure, with_limbs=bool(limbs), with_base=False)
    return figure


def _label_length(ax: Axes, ends: Floats, text: str, crowd: Floats) -> None:
    """Writes a label near the middle of a line, on the side away from most points (n, 2)."""
    along, middle = ends[1] - ends[0], ends.mean(axis=0)
    beside = np.array([along[1], -along[0]]) / max(float(np.linalg.norm(along)), 1e-12)
    if np.nanmean(np.sign((crowd - middle) @ beside)) > 0.0:
        beside = -beside
    ax.annotate(
        text,
        middle,
        xytext=(5 * beside).tolist(),
        textcoords="offset points",
        ha="left" if beside[0] > 0.0 else "right",
        va="center",
        fontweight="bold",
        zorder=8,
    )


def _path_legend(figure: Figure, *, with_limbs: bool, with_base: bool) -> None:
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=drawing.NOMINAL, lw=1.8, label="programmed"),
        Line2D([], [], color=drawing.ACTUAL, lw=1.2, label="actual"),
    ]
    if with_base:
        handles.append(Line2D([], [], ls="", marker="s", ms=4, color=drawing.INK, label="robot base"))
    if with_limbs:
        handles.append(Patch(color=drawing.FAINT, alpha=0.4, label="swept volumes"))
    height = figure.get_figheight()
    figure.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.5, 0.04 / height), ncols=4)


def _limbs_at(occupancy: RunTable | None, motion: RunTable, worst: Deviation) -> Limbs:
    """Returns the volumes stored last before the deviation; none before the first."""
    t_ns = int(times(motion)[worst.row])
    if occupancy is None or not (times(occupancy) <= t_ns).any():
        return {}
    return stored_at(occupancy, t_ns)[1]


@dataclass(frozen=True)
class _Ways:
    """The paths as they are drawn, with few of their points [m]."""

    programmed: Floats  #: (m, 3)
    driven: Floats  #: (k, 3)
    then: Floats  #: (i, 3) driven around the time of the largest deviation

    @classmethod
    def of(cls, motion: RunTable, worst: Deviation) -> _Ways:
        """Thins those of a motion, one after the other: they may be long."""
        programmed = thin_path(position_columns(motion, "ref"), _THIN_M)
        driven = position_columns(motion, "tcp")
        then = np.abs(seconds_from(times(motion), int(times(motion)[worst.row]))) <= _PASS_S
        return cls(programmed, thin_path(driven, _THIN_M), thin_path(driven[then], _THIN_M))


def _flat(motion: RunTable, what: str, view: View) -> Iterator[Floats]:
    """Yields the ``ref`` or ``tcp`` positions (n, 2) in a view, some after the others [m]."""
    for part in in_parts(motion, [f"{what}_{axis}" for axis in "xyz"]):
        yield view.flat(part.to_numpy(dtype=float))


def _draw_path(ax: Axes, view: View, ways: _Ways, limbs: Limbs, worst: Deviation) -> None:
    draw_outlines(ax, limbs, view)
    ax.plot(*view.flat(ways.driven).T, color=drawing.ACTUAL, lw=0.5, alpha=0.35, zorder=4)
    ax.plot(*view.flat(ways.programmed).T, color=drawing.NOMINAL, lw=1.8, zorder=5)
    ax.plot(*view.flat(ways.then).T, color=drawing.ACTUAL, lw=1.0, zorder=6)
    ends = view.flat(np.vstack([worst.foot_m, worst.at_m]))
    ax.plot(*ends.T, color=drawing.INK, lw=0.9, ls=(0, (2, 1)), zorder=7)
    ax.plot(*ends[0], "o", color=drawing.NOMINAL, ms=3.5, zorder=7)
    ax.plot(*ends[1], "o", color=drawing.ACTUAL, ms=3.5, zorder=7)


def speed(motion: RunTable, t0_ns: int, near_m: float) -> Figure:
    """Fig. 14: draws programmed speed; actual speed with braking shaded; separation from the swept volumes."""
    seconds = seconds_from(times(motion), t0_ns)
    figure = drawing.column_figure(3.3)
    rows = drawing.column_panels(figure, 3, share_x=True)
    nominal, actual, separation = (row[0] for row in rows)
    nominal.plot(*envelope(seconds, numeric_column(motion, "ref_speed"), 500), color=drawing.NOMINAL, lw=0.7)
    nominal.set(title="Programmed TCP speed", ylabel="speed [m/s]")
    actual.plot(*envelope(seconds, numeric_column(motion, "tcp_speed"), 500), color=drawing.ACTUAL, lw=0.7)
    actual.set(title="Actual TCP speed", ylabel="speed [m/s]")
    separation.plot(*envelope(seconds, numeric_column(motion, "distance_m"), 500), color=drawing.PURPLE)
    separation.axhline(near_m, color=drawing.INK, lw=0.7, ls=(0, (4, 3)))
    separation.set(title="Separation", ylabel="distance [m]", xlabel="time [s]", ylim=(0, None))
    high = max(_top(motion, "ref_speed"), _top(motion, "tcp_speed")) * 1.08
    nominal.set_ylim(0, high)
    actual.set_ylim(0, high)
    for ax in (actual, separation):
        _shade(ax, seconds, motion, "braking")
    separation.set_xlim(seconds[0], seconds[-1])
    figure.align_ylabels()
    drawing.legend_above(actual, handles=[_BRAKING])
    near = Line2D([], [], color=drawing.INK, lw=0.7, ls=(0, (4, 3)), label=f"near: {near_m:g} m")
    drawing.legend_above(separation, handles=[near])
    return figure


def horizon(motion: RunTable, t0_ns: int, stop_s: float) -> Figure:
    """Draws the horizon of the volumes used at each tick, and the duration of the stop from its velocity.

    Args:
        motion: Rows of motion.parquet.
        t0_ns: Instant of time zero [ns].
        stop_s: Worst-case braking time T_s [s].
    """
    seconds = seconds_from(times(motion), t0_ns)
    figure = drawing.column_figure(1.9)
    ((ax,),) = drawing.column_panels(figure, top_in=0.26)
    ax.plot(*envelope(seconds, numeric_column(motion, "horizon_s"), 500), color=drawing.BLUE, label="horizon")
    ax.plot(*envelope(seconds, numeric_column(motion, "tau_s"), 500), color=drawing.ORANGE, lw=0.7, label="stop time")
    ax.axhline(stop_s, color=drawing.INK, lw=0.7, ls=(0, (4, 3)), label="T\u209b")
    _shade(ax, seconds, motion, "braking")
    ax.set(xlim=(seconds[0], seconds[-1]), xlabel="time [s]", ylabel="from the tick on [s]")
    ax.set_ylim(0, 1.08 * max(stop_s, _top(motion, "horizon_s"), _top(motion, "tau_s")))
    drawing.legend_above(ax, handles=[*ax.get_lines(), _BRAKING])
    return figure


#: Legend entry of the shading by ``_shade``.
_BRAKING = Patch(color=drawing.STATUS["braking"], alpha=0.25, lw=0, label="braking")


def _top(motion: RunTable, name: str) -> float:
    values = numeric_column(motion, name)
    values = values[np.isfinite(values)]
    return max(float(values.max()), 1e-3) if len(values) else 1.0


def _shade(ax: Axes, seconds: Floats, motion: RunTable, status: str) -> None:
    bars = _bars(seconds, (motion["status"] == status).to_numpy(dtype=bool))
    ax.broken_barh(
        bars, (0, 1), transform=ax.get_xaxis_transform(), facecolors=drawing.STATUS[status], alpha=0.2, lw=0, zorder=0
    )


def _bars(seconds: Floats, mask: Bools) -> list[tuple[float, float]]:
    """Returns runs as (start, width) [s]; runs closer than a line's width on paper are merged."""
    bars: list[tuple[float, float]] = []
    resolution = (seconds[-1] - seconds[0]) / 1000.0 if len(seconds) else 0.0
    for first, last in true_runs(mask):
        start, end = float(seconds[first]), float(seconds[min(last, len(seconds) - 1)])
        if bars and start - sum(bars[-1]) < resolution:
            bars[-1] = (bars[-1][0], end - bars[-1][0])
        else:
            bars.append((start, end - start))
    return bars


def status(
    motion: RunTable,
    baselines: Mapping[str, RunTable],
    *,
    method: str,
    t0_ns: int,
    near_m: float,
    slow_m_per_s: float,
) -> Figure:
    """Draws the status of the plan and each baseline over time, and its standstills near the person.

    Args:
        motion: Rows of motion.parquet.
        baselines: Name of each baseline -> rows of its motion.
        method: Method of the plan.
        t0_ns: Instant of time zero [ns].
        near_m: The person is near at a separation of at most this [m].
        slow_m_per_s: A TCP slower than this counts as stationary [m/s].
    """
    tables = {f"plan: {method}": motion, **baselines}
    figure = drawing.column_figure(0.8 + 0.32 * len(tables))
    ((ax,),) = drawing.column_panels(figure, left_in=0.66, top_in=0.4)
    for row, table in enumerate(tables.values()):
        seconds = seconds_from(times(table), t0_ns)
        kind = table["status"].to_numpy()
        for value in STATUSES:  # the most severe status is drawn last and stays visible
            bars = _bars(seconds, kind == value)
            ax.broken_barh(bars, (row - 0.12, 0.44), facecolors=drawing.STATUS[value], lw=0)
        near, stands = stationary(table, near_m, slow_m_per_s)
        ax.broken_barh(_bars(seconds, near), (row - 0.36, 0.16), facecolors=drawing.FAINT, alpha=0.45, lw=0)
        ax.broken_barh(_bars(seconds, near & stands), (row - 0.36, 0.16), facecolors=drawing.INK, lw=0)
    seconds = seconds_from(times(motion), t0_ns)
    ax.set(ylim=(len(tables) - 0.5, -0.55), xlim=(seconds[0], seconds[-1]), xlabel="time [s]")
    ax.set_yticks(range(len(tables)), list(tables))
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=False, axis="y")
    handles = [Patch(color=drawing.STATUS[value], lw=0, label=value) for value in STATUSES]
    handles += [
        Patch(color=drawing.FAINT, alpha=0.45, lw=0, label=f"within {near_m:g} m"),
        Patch(color=drawing.INK, lw=0, label="and standing"),
    ]
    drawing.legend_above(ax, columns=3, handles=handles)
    return figure


def stationary_share(metrics: Mapping[str, Metric]) -> Figure:
    """Draws the stationary share of the plan and its baselines on this log, with the paper's two figures."""
    method = metrics["plan_method"]["value"]
    rows = [(f"this log: {method}", "plan", drawing.BLUE)]
    rows += [
        (f"this log: {name}", f"baseline_{name}", drawing.ORANGE)
        for name in sorted(n.split("_")[1] for n in metrics if n.startswith("baseline_") and n.endswith("_near_ticks"))
    ]
    paper = [
        ("the paper's: qp", "paper_stationary_share_qp"),
        ("the paper's: scaling", "paper_stationary_share_scaling"),
    ]
    count = len(rows) + len(paper)
    figure = drawing.column_figure(0.45 + 0.2 * count)
    ((ax,),) = drawing.column_panels(figure, left_in=1.0, top_in=0.06, right_in=0.95)
    for y, (_, prefix, colour) in enumerate(rows):
        share = metrics[f"{prefix}_stationary_share"]["value"]
        ticks = metrics[f"{prefix}_near_ticks"]["value"]
        text = "never that near" if share is None else f"{share_text(share, 2)} of {ticks} ticks"
        ax.barh(y, 100 * (share or 0.0), height=0.62, color=colour)
        ax.annotate(
            text, (100 * (share or 0.0), y), xytext=(3, 0), textcoords="offset points", va="center", fontsize=6.5
        )
    for y, (_, name) in enumerate(paper, start=len(rows)):
        value = 100 * metrics[name]["value"]
        ax.barh(y, value, height=0.62, facecolor="none", edgecolor=drawing.FAINT, hatch="////", lw=0.8)
        words = f"{value:.2f} %, other data"
        ax.annotate(words, (value, y), xytext=(3, 0), textcoords="offset points", va="center", fontsize=6.5)
    ax.set(xlim=(0, 100), ylim=(count - 0.45, -0.55), xlabel="standing, of the near ticks [%]")
    ax.set_yticks(range(count), [row[0] for row in rows] + [row[0] for row in paper])
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=False, axis="y")
    return figure


#: Method -> colour, and (occupancy, horizon) -> marker.
_COLOURS = {
    "qp": drawing.BLUE,
    "scaling": drawing.ORANGE,
    "shield": drawing.GREEN,
    "ssm": drawing.PURPLE,
    "pfl": drawing.SKY,
    "none": drawing.VERMILLION,
    RECORDED: drawing.INK,
}
_MARKERS = {"sound": "o", "paper": "s", "positions": "D"}


def methods(found: Mapping[str, Any]) -> Figure:
    """Draws safety against productivity: the smallest distance while moving over the pace kept, one point per method.

    Args:
        found: The content of compare.json.
    """
    figure = drawing.new_figure(3.7)
    ((ax,),) = drawing.panels(figure, 1, bottom_in=0.5, top_in=0.3, right_in=2.7)
    several = len(found["logs"]) > 1
    for label, row in found["total"].items():
        of, alone = found["methods"][label], log_rows(found, label) if several else []
        colour, marker = _COLOURS[of["method"]], _MARKERS.get(of.get("occupancy", ""), "X")
        for other in alone:
            ax.plot(*_place(other), ".", ms=5, color=colour, alpha=0.45)
        words = label.replace(":", ", ") + (f": {row['stillness']}" if row["stillness"] else "")
        if row["touch_ticks"]:
            words += f": {row['touch_ticks']:,} ticks in contact,\nup to {row['touch_speed_m_per_s']:.2f} m/s"
        if of["method"] == RECORDED and row["nearest_moving_m"] is not None:  # its programme, so its pace, is not known
            ax.axhline(100.0 * row["nearest_moving_m"], color=colour, lw=1.2, ls=(0, (4, 3)), label=words)
            continue
        if row["pace"] is None or row["nearest_moving_m"] is None:
            if row["stillness"]:  # it has no position in the plot but is listed
                ax.plot([], [], "x", ms=8, color=colour, label=words)
            continue
        face = "white" if of.get("horizon") == "fixed" else colour
        ax.plot(
            *_place(row), marker, ms=8, mfc=face, mec=colour, mew=1.6, alpha=0.9, zorder=3, label=words, clip_on=False
        )
    ax.set_yscale("symlog", linthresh=20.0, linscale=1.5)
    ticks = [-100, -50, -20, -10, 0, 10, 20, 50, 100, 200, 500]
    low, high = min(ax.get_ylim()[0], -12.0), max(ax.get_ylim()[1], 25.0)
    ax.set_yticks([tick for tick in ticks if low <= tick <= high])
    ax.yaxis.set_major_formatter("{x:.0f}")
    ax.minorticks_off()
    ax.set_ylim(low, high)
    ax.set_xlim(0.0, 103.0)
    ax.axhspan(low, 0.0, color=drawing.VERMILLION, alpha=0.08, lw=0)
    ax.text(1.5, 0.97 * low, "in contact while moving", va="bottom", ha="left", color=drawing.VERMILLION, fontsize=8.0)
    ax.legend(loc="upper left", bbox_to_anchor=(1.03, 1.0), labelspacing=0.9)
    ax.set_xlabel("pace kept, of the programmed [%]")
    ax.set_ylabel("nearest to the person while moving [cm]")
    what = f"; {len(found['logs'])} logs, small dots: each" if several else ""
    ax.set_title(f"Safety and pace by method (hollow: fixed horizon{what})")
    return figure


def log_rows(found: Mapping[str, Any], label: str) -> list[Mapping[str, Any]]:
    """Returns the figures of a method on each log that can be plotted."""
    rows = [log["methods"][label] for log in found["logs"] if label in log["methods"]]
    return [row for row in rows if row["pace"] is not None and row["nearest_moving_m"] is not None]


def _place(row: Mapping[str, Any]) -> tuple[float, float]:
    """Returns pace [%] and smallest distance [cm]."""
    return 100.0 * row["pace"], 100.0 * row["nearest_moving_m"]
