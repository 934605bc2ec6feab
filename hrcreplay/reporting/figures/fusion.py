"""Figures of the person as measured and fused: data quality, joint coordinates (Fig. 18), fusion error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from hrcreplay.records import JOINTS, Bools, Floats, Ints
from hrcreplay.reporting.figures import drawing
from hrcreplay.reporting.metrics.fusion import cameras, errors, frames_of, seconds_since
from hrcreplay.reporting.metrics.series import (
    ANGLES,
    Metric,
    break_at_gaps,
    envelope,
    seconds_from,
    times,
    true_runs,
    wrap,
)
from hrcreplay.store.run_folder import Run
from hrcreplay.store.stored_table import RunTable

LABELS = {
    "x": "x",
    "y": "y",
    "z": "z",
    "theta": "heading \u03b8",
    "rho": "torso \u03c1",
    **{f"a{side}{i}": f"{name} \u03b1{i}" for side, name in (("r", "right"), ("l", "left")) for i in range(1, 5)},
}
#: Number of panels per row in the figure of all joints.
_PANELS = 3


def coordinate(run: Run, t0_ns: int, gap_s: float, joint: str = "x") -> Figure:
    """Fig. 18: draws one coordinate as each camera saw it, as fused and, if the log has it, the truth; and the errors.

    Args:
        run: Tables of the run.
        t0_ns: Instant of time zero [ns].
        gap_s: Time without frames at which a camera's line is interrupted [s].
        joint: Coordinate to draw, one of JOINTS.
    """
    found = errors(run, gap_s)
    unit, factor, error_unit, error_factor = (
        ("deg", 180 / np.pi, "deg", 180 / np.pi) if joint in ANGLES else ("m", 1.0, "mm", 1e3)
    )
    figure = drawing.column_figure(2.9 if found else 1.9)
    heights = [1.5, 1.0] if found else [1.0]
    rows = drawing.column_panels(figure, len(heights), heights=heights, share_x=True)
    ax = rows[0][0]
    for (camera, frames), colour in zip(_frames(run).items(), drawing.CAMERAS * 3, strict=False):
        seconds, values = _seen(run, frames, joint, t0_ns, gap_s)
        ax.plot(*envelope(seconds, factor * values, 500), color=colour, lw=0.6, label=camera)
    if run.state is not None:
        seconds = seconds_from(times(run.state), t0_ns)
        values = factor * run.state[joint].to_numpy(dtype=float)
        ax.plot(*envelope(seconds, values, 500), color=drawing.FUSED, lw=1.2, label="fused")
    if run.truth is not None:
        seconds = seconds_from(times(run.truth), t0_ns)
        values = factor * run.truth[joint].to_numpy(dtype=float)
        ax.plot(*envelope(seconds, values, 500), color=drawing.TRUTH, lw=0.7, ls=(0, (4, 2)), label="truth")
    ax.set(title=f"Coordinate {LABELS[joint]}", ylabel=f"{LABELS[joint]} [{unit}]")
    drawing.legend_above(ax)
    if found:
        below = rows[1][0]
        for source, colour in zip(
            [*cameras(run), "fused"], [*(drawing.CAMERAS * 3)[: len(cameras(run))], drawing.FUSED], strict=True
        ):
            if source in found:
                seconds = seconds_from(found[source].t_ns, t0_ns)
                values = error_factor * found[source].position[:, JOINTS.index(joint)]
                below.plot(
                    *envelope(*break_at_gaps(seconds, values, gap_s), 500),
                    color=colour,
                    lw=0.9 if source == "fused" else 0.5,
                )
        below.set(title="Error against ground truth", ylabel=f"error [{error_unit}]")
    rows[-1][0].set_xlabel("time [s]")
    _span(rows[-1][0], run, t0_ns)
    figure.align_ylabels()
    return figure


def _frames(run: Run) -> dict[str, RunTable]:
    """Returns the frames of each camera, in order of capture."""
    table = run.measurements
    if table is None:
        return {}
    return {camera: frames_of(table, camera) for camera in cameras(run)}


def _seen(run: Run, frames: RunTable, joint: str, t0_ns: int, gap_s: float) -> tuple[Floats, Floats]:
    """Draws a camera's raw values over time [s], interrupted after ``gap_s`` without frames."""
    t_ns = times(frames, "capture_ns")
    values = _beside_fused(run, joint, t_ns, frames[joint].to_numpy(dtype=float))
    return break_at_gaps(seconds_from(t_ns, t0_ns), values, gap_s)


def _span(ax: Axes, run: Run, t0_ns: int) -> None:
    if run.state is not None and len(run.state) > 1:
        ax.set_xlim(0.0, (int(times(run.state)[-1]) - t0_ns) * 1e-9)


def joint_angles(run: Run, t0_ns: int, gap_s: float) -> Figure:
    """Draws all joints: raw camera values (dots), the fused state and the truth."""
    count = -(-len(JOINTS) // _PANELS)
    figure = drawing.column_figure(0.7 + 0.95 * count)
    grid = drawing.column_panels(
        figure, count, _PANELS, share_x=True, gap_in=(0.2, 0.3), top_in=0.36, left_in=0.3, right_in=0.05
    )
    for ax in [ax for row in grid for ax in row][len(JOINTS) :]:
        ax.set_visible(False)
    seen = _frames(run)
    for k, joint in enumerate(JOINTS):
        ax = grid[k // _PANELS][k % _PANELS]
        factor = 180 / np.pi if joint in ANGLES else 1.0
        for frames, colour in zip(seen.values(), drawing.CAMERAS * 3, strict=False):
            seconds, values = _seen(run, frames, joint, t0_ns, gap_s)
            some = slice(None, None, max(1, len(seconds) // 400))
            ax.plot(seconds[some], factor * values[some], ".", ms=2.0, color=colour, alpha=0.8, mew=0, rasterized=True)
        if run.state is not None:
            seconds = seconds_from(times(run.state), t0_ns)
            values = factor * run.state[joint].to_numpy(dtype=float)
            ax.plot(*envelope(seconds, values, 150), color=drawing.FUSED, lw=0.7)
            _limits_of(ax, values)
        if run.truth is not None:
            seconds = seconds_from(times(run.truth), t0_ns)
            values = _beside_fused(run, joint, times(run.truth), run.truth[joint].to_numpy(dtype=float))
            ax.plot(*envelope(seconds, factor * values, 150), color=drawing.TRUTH, lw=0.6, ls=(0, (4, 2)))
        ax.set_title(f"{LABELS[joint]} [{'deg' if joint in ANGLES else 'm'}]", fontweight="normal", pad=1.5)
        ax.tick_params(labelsize=6.0)
        ax.yaxis.set_major_locator(MaxNLocator(4))
    for column in range(_PANELS):
        lowest = grid[-1 if column < len(JOINTS) - (count - 1) * _PANELS else -2][column]
        lowest.set_xlabel("time [s]")
        lowest.tick_params(labelbottom=True)
    _span(grid[-1][0], run, t0_ns)
    handles = [
        Line2D([], [], ls="", marker="o", ms=3, color=c, label=n)
        for n, c in zip(seen, drawing.CAMERAS * 3, strict=False)
    ]
    handles.append(Line2D([], [], color=drawing.FUSED, label="fused"))
    if run.truth is not None:
        handles.append(Line2D([], [], color=drawing.TRUTH, lw=0.7, ls=(0, (4, 2)), label="truth"))
    figure.legend(handles=handles, loc="upper right", ncols=6, bbox_to_anchor=(0.985, 0.997))
    return figure


def _beside_fused(run: Run, joint: str, t_ns: Ints, values: Floats) -> Floats:
    """Moves an angle to the turn of the fused one, which is unwrapped; a length is unchanged."""
    if run.state is None or joint not in ANGLES:
        return values
    fused_ns, fused = times(run.state), run.state[joint].to_numpy(dtype=float)
    known = np.isfinite(fused)
    if not known.any():
        return values
    fused = np.interp(t_ns, fused_ns[known].astype(float), fused[known])
    return np.asarray(fused + wrap(values - fused))


def _limits_of(ax: Axes, values: Floats) -> None:
    """Returns limits around the fused line with a margin; a camera's outliers may lie outside."""
    finite = values[np.isfinite(values)]
    if len(finite):
        room = 0.25 * max(float(np.ptp(finite)), 1e-2)
        ax.set_ylim(float(finite.min()) - room, float(finite.max()) + room)


def fusion_error(metrics: Mapping[str, Metric], names: Sequence[str]) -> Figure:
    """Draws the RMSE per angle and pooled, for each camera's raw angles and the fused state; velocities likewise."""
    figure = drawing.column_figure(2.7)
    rows = drawing.column_panels(figure, 2, bottom_in=0.22, share_x=True)
    sources = [*names, "fused"]
    colours = [*(drawing.CAMERAS * 3)[: len(names)], drawing.FUSED]
    width = 0.8 / len(sources)
    for (ax,), kind, unit in zip(rows, ("", "velocity_"), ("deg", "deg/s"), strict=True):
        for s, (source, colour) in enumerate(zip(sources, colours, strict=True)):
            prefix = "fusion" if source == "fused" else f"camera_{source}"
            found = [metrics[f"{prefix}_{kind}rmse_{joint}"]["value"] for joint in ANGLES]
            found.append(metrics[f"{prefix}_{kind or 'angle_'}rmse"]["value"])
            heights = [np.nan if value is None else np.degrees(value) for value in found]
            at = np.arange(len(heights)) + (s - 0.5 * (len(sources) - 1)) * width
            at[-1] += 0.35
            ax.bar(at, heights, width=0.92 * width, color=colour, label=source)
        ax.set_ylabel(f"RMSE [{unit}]")
        ax.grid(visible=False, axis="x")
        ax.tick_params(axis="x", length=0)
    rows[0][0].set_title("Angles")
    rows[1][0].set_title("Angular velocities (cameras: by differences)")
    short = [LABELS[joint].replace("right", "r").replace("left", "l") for joint in ANGLES]
    short = [name.removeprefix("heading ").removeprefix("torso ") for name in short]
    rows[1][0].set_xticks([*range(len(ANGLES)), len(ANGLES) + 0.35], [*short, "all"])
    figure.align_ylabels()
    drawing.legend_above(rows[0][0])
    return figure


def data_quality(run: Run, t0_ns: int, gap_s: float) -> Figure:
    """Draws, per camera, the times of frames with the person, of frames used by the filter, and of gaps."""
    names = cameras(run)
    figure = drawing.column_figure(0.72 + 0.24 * (len(names) + 1))
    ((ax,),) = drawing.column_panels(figure, left_in=0.62, top_in=0.34)
    end_s = 0.0
    anything: Bools | None = None
    for row, camera in enumerate(names):
        colour = (drawing.CAMERAS * 3)[row]
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
        ax.broken_barh(_tick_bars(seconds, anything), (len(names) - 0.16, 0.32), facecolors=drawing.BLUE, lw=0)
        for start, width in _tick_bars(seconds, ~anything):
            ax.broken_barh([(start, width)], (len(names) - 0.16, 0.32), facecolors=drawing.VERMILLION, lw=0)
            if width > 0.05 * end_s:
                ax.annotate(
                    f"{width:.1f} s", (start + 0.5 * width, len(names) + 0.2), ha="center", va="top", fontsize=6.0
                )
    ax.set(xlim=(0, end_s), ylim=(len(names) + 0.62, -0.5), xlabel="time [s]")
    ax.set_yticks(range(len(names) + 1), [*names, "any camera"])
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=False, axis="y")
    handles = [
        Patch(color=drawing.FAINT, alpha=0.4, lw=0, label="frames with the person"),
        Patch(color=drawing.FAINT, lw=0, label=f"used by the filter within {gap_s:g} s"),
        Patch(color=drawing.VERMILLION, lw=0, label="none used"),
    ]
    drawing.legend_above(ax, columns=2, handles=handles)
    return figure


def _frame_bars(seconds: Floats, gap_s: float) -> list[tuple[float, float]]:
    """Returns runs of frames at most ``gap_s`` apart as (start, width) [s]."""
    if not len(seconds):
        return []
    breaks = np.flatnonzero(np.diff(seconds) > gap_s)
    starts = seconds[np.append(0, breaks + 1)]
    ends = seconds[np.append(breaks, len(seconds) - 1)]
    return [(float(a), float(b - a)) for a, b in zip(starts, ends, strict=True)]


def _tick_bars(seconds: Floats, mask: Bools) -> list[tuple[float, float]]:
    last = len(seconds) - 1
    return [(float(seconds[a]), float(seconds[min(b, last)] - seconds[a])) for a, b in true_runs(mask)]
