"""The figure of the data that went in."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from hrcreplay.records import Bools, Floats
from hrcreplay.report import style
from hrcreplay.report.metrics_quality import cameras, seconds_since
from hrcreplay.report.series import seconds_from, stretches, times
from hrcreplay.runs import Run


def data_quality(run: Run, t0_ns: int, gap_s: float) -> Figure:
    """Per camera: when its frames held the person, when the filter used them, and its gaps."""
    names = cameras(run)
    figure = style.new_figure(0.95 + 0.42 * (len(names) + 1))
    ax = style.panels(figure, 1, left_in=1.0, top_in=0.36)[0][0]
    end_s = 0.0
    anything: Bools | None = None
    for row, camera in enumerate(names):
        colour = (style.CAMERAS * 3)[row]
        if run.measurements is not None:
            seen = np.sort(times(run.measurements[run.measurements["camera"] == camera], "capture_ns"))
            seconds = seconds_from(seen, t0_ns)
            end_s = max(end_s, float(seconds[-1]) if len(seconds) else 0.0)
            ax.broken_barh(_frame_bars(seconds, gap_s), (row - 0.32, 0.64), facecolors=colour, alpha=0.3, lw=0)
        if run.state is not None and f"valid_{camera}" in run.state:
            valid = run.state[f"valid_{camera}"].to_numpy(dtype=bool)
            recent = seconds_since(run.state, valid) <= gap_s
            anything = recent if anything is None else anything | recent
            seconds = seconds_from(times(run.state), t0_ns)
            end_s = max(end_s, float(seconds[-1]))
            ax.broken_barh(_tick_bars(seconds, recent), (row - 0.16, 0.32), facecolors=colour, lw=0)
    if anything is not None and run.state is not None:
        seconds = seconds_from(times(run.state), t0_ns)
        ax.broken_barh(_tick_bars(seconds, anything), (len(names) - 0.16, 0.32), facecolors=style.BLUE, lw=0)
        for start, width in _tick_bars(seconds, ~anything):
            ax.broken_barh([(start, width)], (len(names) - 0.16, 0.32), facecolors=style.VERMILLION, lw=0)
            if width > 0.02 * end_s:
                ax.annotate(
                    f"{width:.1f} s", (start + 0.5 * width, len(names) + 0.2), ha="center", va="top", fontsize=7.5
                )
    ax.set(xlim=(0, end_s), ylim=(len(names) + 0.62, -0.5), xlabel="time [s]")
    ax.set_yticks(range(len(names) + 1), [*names, "any camera"])
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=False, axis="y")
    handles = [
        Patch(color=style.FAINT, alpha=0.4, lw=0, label="frames with the person"),
        Patch(color=style.FAINT, lw=0, label=f"used by the filter within {gap_s:g} s"),
        Patch(color=style.VERMILLION, lw=0, label="none used"),
    ]
    style.legend_above(ax, handles=handles)
    return figure


def _frame_bars(seconds: Floats, gap_s: float) -> list[tuple[float, float]]:
    """Stretches of frames no further apart than ``gap_s`` as (start, width) [s]."""
    if not len(seconds):
        return []
    breaks = np.flatnonzero(np.diff(seconds) > gap_s)
    starts = seconds[np.append(0, breaks + 1)]
    ends = seconds[np.append(breaks, len(seconds) - 1)]
    return [(float(a), float(b - a)) for a, b in zip(starts, ends, strict=True)]


def _tick_bars(seconds: Floats, mask: Bools) -> list[tuple[float, float]]:
    last = len(seconds) - 1
    return [(float(seconds[a]), float(seconds[min(b, last)] - seconds[a])) for a, b in stretches(mask)]
