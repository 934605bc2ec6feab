"""Figures of the person: data quality, swept volumes (Fig. 17), joint coordinates (Fig. 18), fusion error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from hrcreplay.human.model import skeleton
from hrcreplay.records import JOINTS, LENGTHS, POINTS, Bools, Floats, Ints
from hrcreplay.report import drawing
from hrcreplay.report.drawing import RenderedHull, View, bones, outline, render_hulls, view_from
from hrcreplay.report.metrics import (
    ANGLES,
    Metric,
    break_at_gaps,
    columns,
    envelope,
    seconds_from,
    times,
    true_runs,
    wrap,
)
from hrcreplay.report.metrics_data import cameras, errors, seconds_since
from hrcreplay.store.run_folder import Run

#: One instant of Fig. 17: t_ns, and per method and limb the swept volume: (m, 3) vertices, world [m], and radius [m].
Instant = tuple[int, Mapping[str, Mapping[str, tuple[Floats, float]]]]

METHODS = {
    "paper": "paper\npositions and velocities",
    "positions": "older method [26]\npositions only",
    "sound": "sound\nall motions of the model",
}

LABELS = {
    "x": "x",
    "y": "y",
    "theta": "heading \u03b8",
    "rho": "torso \u03c1",
    "z": "pelvis height z",
    **{f"a{side}{i}": f"{name} \u03b1{i}" for side, name in (("r", "right"), ("l", "left")) for i in range(1, 5)},
}


def volumes(instants: Sequence[Instant], state: pd.DataFrame, t0_ns: int) -> Figure:
    """Fig. 17: the person's swept volumes, a row a method, a column an instant, all to one scale.

    Args:
        instants: What to draw, in order of time.
        state: The fused person, for the skeleton and the viewpoint.
        t0_ns: Start of the run [ns].
    """
    methods = list(instants[0][1])
    people = [_skeleton_at(state, t_ns) for t_ns, _ in instants]
    heading = float(np.nanmean([heading for _, heading in people]))
    view = view_from(heading - 0.9, 0.28)
    figure = drawing.new_figure(0.55 + 2.35 * len(methods))
    grid = drawing.panels(
        figure, len(methods), len(instants), left_in=0.5, right_in=0.1, top_in=0.34, bottom_in=0.3, gap_in=(0.12, 0.08)
    )
    centres = [view.flat(points[[POINTS.index("pelvis")]])[0] for points, _ in people]
    outlines = [
        {
            method: [outline(vertices, radius, view) - centre for vertices, radius in limbs.values()]
            for method, limbs in found.items()
        }
        for (_, found), centre in zip(instants, centres, strict=True)
    ]
    corners = np.vstack([edge for found in outlines for edges in found.values() for edge in edges])
    low, high = corners.min(axis=0) - 0.03, corners.max(axis=0) + 0.03
    for row, method in enumerate(methods):
        for column, (t_ns, found) in enumerate(instants):
            ax = grid[row][column]
            drawing.set_window(ax, low.tolist(), high.tolist())
            skeleton_m, edges = people[column][0], outlines[column][method]
            _draw_person(ax, found[method], edges, skeleton_m, view, centres[column], (low, high))
            if row == 0:
                later = (t_ns - instants[0][0]) * 1e-9
                ax.set_title(
                    f"T = {later:.0f} s  (at {(t_ns - t0_ns) * 1e-9:.1f} s)", fontweight="normal", loc="center"
                )
            ax.set(xticks=[], yticks=[])
            ax.grid(visible=False)
            ax.spines[:].set_visible(False)
        grid[row][0].set_ylabel(METHODS.get(method, method), fontweight="bold")
    _scale_bar(grid[-1][-1], float(high[0]), float(low[1]))
    drawn = {limb for limbs in instants[0][1].values() for limb in limbs}
    handles = [Patch(color=colour, lw=0, label=limb) for limb, colour in drawing.LIMBS.items() if limb in drawn]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), bbox_to_anchor=(0.5, 0.005))
    return figure


def _skeleton_at(state: pd.DataFrame, t_ns: int) -> tuple[Floats, float]:
    row = state.iloc[[int(np.argmin(np.abs(times(state) - t_ns)))]]
    p = columns(row)
    return skeleton(p, row[list(LENGTHS)].to_numpy(dtype=float))[0], float(p[0, JOINTS.index("theta")])


def _draw_person(
    ax: Axes,
    limbs: Mapping[str, tuple[Floats, float]],
    edges: Sequence[Floats],
    points: Floats,
    view: View,
    centre: Floats,
    window: tuple[Floats, Floats],
) -> None:
    solids = [RenderedHull(vertices, radius, to_rgb(drawing.LIMBS[limb])) for limb, (vertices, radius) in limbs.items()]
    low, high = window
    image = render_hulls(solids, view, low + centre, high + centre, (high[1] - low[1]) / 320.0)
    image[..., 3] *= 0.78
    ax.imshow(image, origin="lower", extent=(low[0], high[0], low[1], high[1]), aspect="auto", interpolation="bilinear")
    drawing.set_window(ax, low.tolist(), high.tolist())
    for solid, edge in zip(solids, edges, strict=True):
        if len(edge):
            ax.add_patch(Polygon(edge, fill=False, edgecolor=solid.colour, lw=0.8, alpha=0.6))
    ax.add_collection(LineCollection([pair - centre for pair in bones(points, view)], colors=drawing.INK, lw=1.6))


def _scale_bar(ax: Axes, right: float, low: float) -> None:
    ax.plot([right - 0.5, right], [low, low], color=drawing.INK, lw=1.4, solid_capstyle="butt")
    ax.annotate("0.5 m", (right - 0.25, low), xytext=(0, 3), textcoords="offset points", ha="center", fontsize=8)


def coordinate(run: Run, t0_ns: int, gap_s: float, joint: str = "x") -> Figure:
    """Fig. 18: one coordinate as each camera saw it, as fused and, where the log has it, as it was; and the errors.

    Args:
        run: Tables of the run.
        t0_ns: Instant of time zero [ns].
        gap_s: A line is broken where a camera was silent for longer [s].
        joint: Coordinate to draw, one of JOINTS.
    """
    found = errors(run, gap_s)
    unit, factor, error_unit, error_factor = (
        ("deg", 180 / np.pi, "deg", 180 / np.pi) if joint in ANGLES else ("m", 1.0, "mm", 1e3)
    )
    figure = drawing.new_figure(4.2 if found else 2.6)
    rows = drawing.panels(figure, 2 if found else 1, heights=[1.5, 1.0] if found else None, share_x=True, top_in=0.34)
    ax = rows[0][0]
    for camera, colour in zip(cameras(run), drawing.CAMERAS * 3, strict=False):
        seconds, values = _seen(run, camera, joint, t0_ns, gap_s)
        ax.plot(*envelope(seconds, factor * values), color=colour, lw=0.9, label=camera)
    if run.state is not None:
        seconds = seconds_from(times(run.state), t0_ns)
        values = factor * run.state[joint].to_numpy(dtype=float)
        ax.plot(*envelope(seconds, values), color=drawing.FUSED, lw=1.6, label="fused")
    if run.truth is not None:
        seconds = seconds_from(times(run.truth), t0_ns)
        values = factor * run.truth[joint].to_numpy(dtype=float)
        ax.plot(*envelope(seconds, values), color=drawing.TRUTH, lw=0.9, ls=(0, (4, 2)), label="truth")
    ax.set(title=f"Coordinate {LABELS[joint]} of the person", ylabel=f"{LABELS[joint]} [{unit}]")
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
                    *envelope(*break_at_gaps(seconds, values, gap_s)),
                    color=colour,
                    lw=1.3 if source == "fused" else 0.7,
                )
        below.set(title="Error against ground truth", ylabel=f"{error_unit}")
    rows[-1][0].set_xlabel("time [s]")
    _span(rows[-1][0], run, t0_ns)
    return figure


def _seen(run: Run, camera: str, joint: str, t0_ns: int, gap_s: float) -> tuple[Floats, Floats]:
    """A camera's raw values over time [s], broken where it was silent for longer than ``gap_s``."""
    if run.measurements is None:
        return np.zeros(0), np.zeros(0)
    rows = run.measurements[run.measurements["camera"] == camera].sort_values("capture_ns", kind="stable")
    seconds = seconds_from(times(rows, "capture_ns"), t0_ns)
    values = _beside_fused(run, joint, times(rows, "capture_ns"), rows[joint].to_numpy(dtype=float))
    return break_at_gaps(seconds, values, gap_s)


def _span(ax: Axes, run: Run, t0_ns: int) -> None:
    if run.state is not None and len(run.state) > 1:
        ax.set_xlim(0.0, (int(times(run.state)[-1]) - t0_ns) * 1e-9)


def joint_angles(run: Run, t0_ns: int, gap_s: float) -> Figure:
    """All thirteen joints: what the cameras saw (dots), the fused state and the truth."""
    figure = drawing.new_figure(6.8)
    columns = (("x", "y", "z", "theta", "rho"), JOINTS[4:8], JOINTS[8:12])
    grid = drawing.panels(figure, 5, 3, share_x=True, gap_in=(0.26, 0.55), top_in=0.5, left_in=0.6)
    seen = cameras(run)
    for ax, joint in ((grid[row][k], joint) for k, joints in enumerate(columns) for row, joint in enumerate(joints)):
        factor = 180 / np.pi if joint in ANGLES else 1.0
        for camera, colour in zip(seen, drawing.CAMERAS * 3, strict=False):
            seconds, values = _seen(run, camera, joint, t0_ns, gap_s)
            some = slice(None, None, max(1, len(seconds) // 900))
            ax.plot(seconds[some], factor * values[some], ".", ms=1.5, color=colour, alpha=0.5, mew=0, rasterized=True)
        if run.state is not None:
            seconds = seconds_from(times(run.state), t0_ns)
            values = factor * run.state[joint].to_numpy(dtype=float)
            ax.plot(*envelope(seconds, values, 350), color=drawing.FUSED, lw=1.0)
            _limits_of(ax, values)
        if run.truth is not None:
            seconds = seconds_from(times(run.truth), t0_ns)
            values = _beside_fused(run, joint, times(run.truth), run.truth[joint].to_numpy(dtype=float))
            ax.plot(*envelope(seconds, factor * values, 350), color=drawing.TRUTH, lw=0.7, ls=(0, (4, 2)))
        ax.set_title(f"{LABELS[joint]} [{'deg' if joint in ANGLES else 'm'}]", fontweight="normal", pad=2.5)
    for k, joints in enumerate(columns):
        bottom = grid[len(joints) - 1][k]
        bottom.set_xlabel("time [s]")
        bottom.tick_params(labelbottom=True)
        for row in grid[len(joints) :]:
            row[k].remove()
    _span(grid[-1][0], run, t0_ns)
    handles = [
        Line2D([], [], ls="", marker="o", ms=3, color=c, label=n)
        for n, c in zip(seen, drawing.CAMERAS * 3, strict=False)
    ]
    handles.append(Line2D([], [], color=drawing.FUSED, label="fused"))
    if run.truth is not None:
        handles.append(Line2D([], [], color=drawing.TRUTH, lw=0.7, ls=(0, (4, 2)), label="truth"))
    figure.legend(handles=handles, loc="upper right", ncols=6, bbox_to_anchor=(0.985, 0.995))
    return figure


def _beside_fused(run: Run, joint: str, t_ns: Ints, values: Floats) -> Floats:
    """An angle in the turn of the fused one, which is unwrapped; a length as it is."""
    if run.state is None or joint not in ANGLES:
        return values
    known = run.state[["t_ns", joint]].dropna()
    if not len(known):
        return values
    fused = np.interp(t_ns, known["t_ns"].to_numpy(dtype=float), known[joint].to_numpy(dtype=float))
    return np.asarray(fused + wrap(values - fused))


def _limits_of(ax: Axes, values: Floats) -> None:
    """The fused line with room around it; a camera's outliers may leave the picture."""
    finite = values[np.isfinite(values)]
    if len(finite):
        room = 0.25 * max(float(np.ptp(finite)), 1e-2)
        ax.set_ylim(float(finite.min()) - room, float(finite.max()) + room)


def fusion_error(metrics: Mapping[str, Metric], names: Sequence[str]) -> Figure:
    """RMSE per angle and pooled, of each camera's raw angles and of the fused state; velocities likewise."""
    figure = drawing.new_figure(3.9)
    rows = drawing.panels(figure, 2, gap_in=(0.34, 0.0), top_in=0.34, bottom_in=0.3, share_x=True)
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
    rows[1][0].set_title("Angular velocities (cameras: differenced)")
    rows[1][0].set_xticks([*range(len(ANGLES)), len(ANGLES) + 0.35], [*(LABELS[joint] for joint in ANGLES), "pooled"])
    drawing.legend_above(rows[0][0])
    return figure


def data_quality(run: Run, t0_ns: int, gap_s: float) -> Figure:
    """Per camera: when its frames held the person, when the filter used them, and its gaps."""
    names = cameras(run)
    figure = drawing.new_figure(0.95 + 0.42 * (len(names) + 1))
    ax = drawing.panels(figure, 1, left_in=1.0, top_in=0.36)[0][0]
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
            if width > 0.02 * end_s:
                ax.annotate(
                    f"{width:.1f} s", (start + 0.5 * width, len(names) + 0.2), ha="center", va="top", fontsize=7.5
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
    drawing.legend_above(ax, handles=handles)
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
    return [(float(seconds[a]), float(seconds[min(b, last)] - seconds[a])) for a, b in true_runs(mask)]
