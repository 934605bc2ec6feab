"""Figures of an audit: coverage against volume by method, coverage by limb, and coverage by joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from hrcreplay.records import JOINTS, LIMBS, Floats
from hrcreplay.reporting.figures import drawing
from hrcreplay.reporting.figures.fusion import LABELS

#: Method -> its name on the page.
METHODS = {
    "paper": "paper",
    "sound": "sound",
    "positions": "positions [26]",
    "constant_velocity": "constant velocity",
    "v2_a50": "v \u2264 2 m/s, a \u2264 50 m/s\u00b2",
    "iso_13855": "ISO 13855",
}
COLOURS = {
    "paper": drawing.BLUE,
    "sound": drawing.GREEN,
    "positions": drawing.ORANGE,
    "constant_velocity": drawing.PURPLE,
    "v2_a50": drawing.VERMILLION,
    "iso_13855": drawing.SKY,
}
NAMES = ("audit_coverage", "audit_limbs", "audit_joints")

#: Coverage is drawn on a logarithmic axis of the missed share plus 0.1 %, so that 99 % and 99.9 % are distinct.
_SPARE = 0.001
_TICKS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 1.0)


def draw_all(found: Mapping[str, Any], folder: Path) -> None:
    """Writes every figure of audit.json's content as SVG and PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    with drawing.style():
        for name, figure in zip(NAMES, (trade_off(found), limbs(found), joints(found)), strict=True):
            drawing.save(figure, folder, name)


def in_order(methods: Mapping[str, Any]) -> list[str]:
    """Returns the methods in the order of the figures."""
    return [method for method in METHODS if method in methods] + sorted(set(methods) - set(METHODS))


def trade_off(found: Mapping[str, Any]) -> Figure:
    """Draws coverage against volume: all methods, and hrcreplay's methods with scaled rates of their limits."""
    figure = drawing.new_figure(4.3)
    ax = drawing.panels(figure, 1, top_in=0.62, left_in=0.8, bottom_in=0.5)[0][0]
    total = found["total"]
    for method in in_order(total["methods"]):
        colour = COLOURS.get(method, drawing.INK)
        if len(found["logs"]) > 1:
            each = [log["methods"][method]["upper"] for log in found["logs"]]
            _scatter(ax, each, colour)
        curve = total["curve"].get(method)
        if curve:
            _curve(ax, curve, colour)
        _cross(ax, total["methods"][method]["upper"], colour, METHODS.get(method, method), curve is not None)
    _coverage_axis(ax, "y")
    _volume_axis(ax, "x")
    ax.set(xlabel="volume of the union without the lower body, mean [m\u00b3]", ylabel="ticks with every limb covered")
    ax.set_title("Coverage against volume")
    figure.legend(*_unique(ax), loc="upper right", ncols=3, bbox_to_anchor=(0.985, 0.995))
    return figure


def _drawn(figures: Mapping[str, Any]) -> bool:
    """Returns True if a method can be drawn; a volume of 0 has no place on a logarithmic axis."""
    return bool(figures["union_m3"]["value"]) and figures["covered_share"]["value"] is not None


def _volume_axis(ax: Axes, which: str) -> None:
    """Makes a logarithmic axis, also if nothing was drawn on it."""
    axis = ax.yaxis if which == "y" else ax.xaxis
    high = (ax.dataLim.intervaly if which == "y" else ax.dataLim.intervalx)[1]
    if not 0.0 < high < np.inf:
        (ax.set_ylim if which == "y" else ax.set_xlim)(0.1, 10.0)
    (ax.set_yscale if which == "y" else ax.set_xscale)("log")
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))


def _scatter(ax: Axes, each: Sequence[Mapping[str, Any]], colour: str) -> None:
    """Draws one faint dot per log."""
    pairs = [(p["union_m3"]["value"], p["covered_share"]["value"]) for p in each if _drawn(p)]
    known = np.array(pairs, dtype=float).reshape(-1, 2)
    ax.plot(known[:, 0], known[:, 1], ".", ms=5, color=colour, alpha=0.35, mew=0, clip_on=False)


def _curve(ax: Axes, curve: Sequence[Mapping[str, Any]], colour: str) -> None:
    known = [p for p in curve if _drawn(p)]
    x = [p["union_m3"]["value"] for p in known]
    y = [p["covered_share"]["value"] for p in known]
    ax.plot(x, y, "-", color=colour, lw=1.2, alpha=0.8)
    ax.plot(x, y, "o", color=colour, ms=2.6, clip_on=False)
    for point, a, b in zip(known, x, y, strict=True):
        if point["factor"] != 1.0:
            ax.annotate(
                f"\u00d7{point['factor']:g}",
                (a, b),
                xytext=(-4, 3),
                textcoords="offset points",
                ha="right",
                fontsize=7,
                color=colour,
            )


def _cross(ax: Axes, figures: Mapping[str, Any], colour: str, label: str, ours: bool) -> None:
    """Draws a method with both intervals."""
    x, y = figures["union_m3"], figures["covered_share"]
    if not _drawn(figures):
        return
    ax.errorbar(
        x["value"],
        y["value"],
        xerr=_arms(x),
        yerr=_arms(y),
        fmt="D" if ours else "s",
        ms=6,
        color=colour,
        mec="white",
        mew=0.8,
        elinewidth=1.2,
        clip_on=False,
        label=label,
        zorder=3,
    )


def _arms(*figures: Mapping[str, Any]) -> Floats:
    """(2, n) lengths of the error bars."""
    ends = [
        (f["value"] - (f["low"] or 0.0), f["high"] - f["value"]) if f["high"] is not None else (0, 0) for f in figures
    ]
    return np.array(ends, dtype=float).T


def _coverage_axis(ax: Axes, which: str) -> None:
    def forward(share: Any) -> Any:
        return -np.log10(np.maximum(1.0 - np.asarray(share, dtype=float), 0.0) + _SPARE)

    def inverse(height: Any) -> Any:
        return 1.0 + _SPARE - 10.0 ** -np.asarray(height, dtype=float)

    axis = ax.yaxis if which == "y" else ax.xaxis
    (ax.set_yscale if which == "y" else ax.set_xscale)("function", functions=(forward, inverse))
    axis.set_major_locator(FixedLocator(_TICKS))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:g} %"))
    (ax.set_ylim if which == "y" else ax.set_xlim)(0.0, 1.0001)


def _unique(ax: Axes) -> tuple[list[Any], list[str]]:
    handles, labels = ax.get_legend_handles_labels()
    return list(handles), list(labels)


def limbs(found: Mapping[str, Any]) -> Figure:
    """Draws coverage and volume of each limb, by method."""
    figure = drawing.new_figure(4.6)
    rows = drawing.panels(figure, 2, top_in=0.66, left_in=0.8, share_x=True, gap_in=(0.36, 0.0))
    methods = found["total"]["methods"]
    shown = in_order(methods)
    names = [*LIMBS, "LEGS"] if any("LEGS" in methods[m] for m in shown) else list(LIMBS)
    for k, method in enumerate(shown):
        at = [i for i, limb in enumerate(names) if limb in methods[method]]
        x = np.array(at) + 0.8 * ((k + 0.5) / len(shown) - 0.5)
        for (ax,), key in zip(rows, ("covered_share", "volume_m3"), strict=True):
            figures = [methods[method][names[i]][key] for i in at]
            known = [i for i, f in enumerate(figures) if f["value"] is not None and (f["value"] or ax is rows[0][0])]
            ax.errorbar(
                x[known],
                [figures[i]["value"] for i in known],
                yerr=_arms(*(figures[i] for i in known)) if known else None,
                fmt="o",
                ms=3.6,
                color=COLOURS.get(method, drawing.INK),
                elinewidth=1.1,
                clip_on=False,
                label=METHODS.get(method, method),
            )
    above, below = rows[0][0], rows[1][0]
    _coverage_axis(above, "y")
    above.set_title("Ticks with the limb in its own volume")
    _volume_axis(below, "y")
    below.set_title("Volume, mean [m\u00b3]")
    below.set_xticks(range(len(names)), names)
    below.set_xlim(-0.6, len(names) - 0.4)
    for ax in (above, below):
        ax.grid(visible=False, axis="x")
        ax.tick_params(axis="x", length=0)
    figure.legend(*_unique(above), loc="upper right", ncols=6, bbox_to_anchor=(0.985, 0.995), columnspacing=1.0)
    return figure


def joints(found: Mapping[str, Any]) -> Figure:
    """Draws, per joint, the share of ticks with the recorded future inside the reachable interval."""
    figure = drawing.new_figure(2.6)
    ax = drawing.panels(figure, 1, top_in=0.5, left_in=0.8, bottom_in=0.34)[0][0]
    tables = found["total"]["joints"]
    shown = in_order(tables)
    for k, method in enumerate(shown):
        figures = [tables[method][joint]["inside_share"] for joint in JOINTS]
        known = [j for j, f in enumerate(figures) if f["value"] is not None]
        x = np.array(known) + 0.6 * ((k + 0.5) / len(shown) - 0.5)
        values = [figures[j]["value"] for j in known]
        arms = _arms(*(figures[j] for j in known)) if known else None
        colour = COLOURS.get(method, drawing.INK)
        ax.errorbar(
            x,
            values,
            yerr=arms,
            fmt="o",
            ms=3.6,
            color=colour,
            elinewidth=1.1,
            clip_on=False,
            label=METHODS.get(method, method),
        )
    _coverage_axis(ax, "y")
    ax.set_xticks(range(len(JOINTS)), [LABELS[joint].replace(" ", "\n", 1) for joint in JOINTS])
    ax.set_title("Ticks with the joint in its reachable interval")
    ax.grid(visible=False, axis="x")
    ax.tick_params(axis="x", length=0)
    figure.legend(*_unique(ax), loc="upper right", ncols=3, bbox_to_anchor=(0.985, 0.99))
    return figure
