"""Figures of the robot: path (Fig. 13), speed (Fig. 14), status, stationary share, link capsules."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from hrcreplay.records import STATUSES, Floats
from hrcreplay.report import drawing
from hrcreplay.report.drawing import RenderedHull, View, outline, render_hulls, view_from
from hrcreplay.report.metrics import Metric, envelope, path_feet, seconds_from, thin_path, times, true_runs
from hrcreplay.report.metrics_plan import numeric_column, position_columns, stationary

ABOVE = View(right=np.array([1.0, 0.0, 0.0]), up=np.array([0.0, 1.0, 0.0]), toward=np.array([0.0, 0.0, 1.0]))
SIDE = view_from(-0.5 * np.pi, 0.0)
#: A deviation below this is none [m].
_SHORTEST_M = 0.5e-3


def path(
    motion: pd.DataFrame, occupancy: pd.DataFrame | None, t0_ns: int, T_world_base: Floats | None = None
) -> Figure:
    """Fig. 13: programmed and actual TCP path from above and from the side, and the largest deviation in detail.

    The detail looks at the vertical plane that holds the deviation, so its length is seen undistorted. The swept
    volumes are those stored last before that tick, in outline.

    Args:
        motion: Rows of motion.parquet.
        occupancy: Rows of occupancy.parquet; None without stored volumes.
        t0_ns: Instant of time zero [ns].
        T_world_base: (4, 4) pose of the robot's base, drawn as a square; None: not drawn.
    """
    reference, tcp = position_columns(motion, "ref"), position_columns(motion, "tcp")
    feet = path_feet(tcp, reference)
    far = np.linalg.norm(tcp - feet, axis=1)
    worst = int(np.argmax(np.where(np.isfinite(far), far, -1.0)))
    t_ns = times(motion)
    limbs = _limbs_at(occupancy, int(t_ns[worst]))
    figure = drawing.new_figure(3.6)
    axes = drawing.panels(figure, 1, 3, left_in=0.62, top_in=0.62, gap_in=(0.3, 0.62))[0]
    everything = np.vstack([reference, tcp])
    if T_world_base is not None:
        everything = np.vstack([everything, T_world_base[:3, 3]])
        for ax, view in zip(axes[:2], (ABOVE, SIDE), strict=True):
            ax.plot(*view.flat(T_world_base[None, :3, 3]).T, "s", color=drawing.INK, ms=6, zorder=3)
    _draw_path(axes[0], ABOVE, reference, tcp, limbs, everything, 0.15)
    axes[0].set(title="From above", xlabel="x [m]", ylabel="y [m]")
    _draw_path(axes[1], SIDE, reference, tcp, limbs, everything, 0.15)
    axes[1].set(title="From the side", xlabel="x [m]", ylabel="z [m]")
    detail = _plane_of(tcp[worst] - feet[worst])
    _draw_path(axes[2], detail, reference, tcp, limbs, np.vstack([tcp[worst], feet[worst]]), 0.75 * far[worst] + 0.12)
    left = far[worst] >= _SHORTEST_M
    title = f"Largest deviation, at {(t_ns[worst] - t0_ns) * 1e-9:.1f} s" if left else "No deviation"
    axes[2].set(title=title, xlabel="in its vertical plane [m]", ylabel="z [m]")
    for ax, view in zip(axes, (ABOVE, SIDE, detail), strict=True):
        ends = view.flat(np.vstack([feet[worst], tcp[worst]]))
        ax.plot(*ends.T, color=drawing.INK, lw=1.0, zorder=6)
        ax.plot(*ends[0], "o", color=drawing.NOMINAL, ms=4.5, zorder=7)
        ax.plot(*ends[1], "o", color=drawing.ACTUAL, ms=4.5, zorder=7)
    if left:
        _label_length(axes[2], detail.flat(np.vstack([feet[worst], tcp[worst]])), f"{far[worst]:.3f} m")
    _path_legend(figure, with_limbs=bool(limbs), with_base=T_world_base is not None)
    return figure


def _label_length(ax: Axes, ends: Floats, text: str) -> None:
    """Writes beside the middle of a line, to its right."""
    along = ends[1] - ends[0]
    beside = np.array([along[1], -along[0]]) / max(float(np.linalg.norm(along)), 1e-12)
    beside = beside if beside[0] >= 0 else -beside
    ax.annotate(
        text,
        ends.mean(axis=0),
        xytext=(9 * beside + [0, -3]).tolist(),
        textcoords="offset points",
        fontweight="bold",
        zorder=8,
    )


def _path_legend(figure: Figure, *, with_limbs: bool, with_base: bool) -> None:
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=drawing.NOMINAL, lw=1.4, label="programmed"),
        Line2D([], [], color=drawing.ACTUAL, lw=1.2, label="actual"),
    ]
    if with_base:
        handles.append(Line2D([], [], ls="", marker="s", ms=5, color=drawing.INK, label="robot base"))
    if with_limbs:
        handles.append(Patch(color=drawing.FAINT, alpha=0.4, label="swept volumes of the person at that tick"))
    width, height = figure.get_size_inches()
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.62 / width, 1 - 0.06 / height), ncols=4)


def _plane_of(vector: Floats) -> View:
    """The horizontal look at the vertical plane that holds a (3,) vector."""
    azimuth = np.arctan2(vector[1], vector[0]) - 0.5 * np.pi
    return view_from(float(azimuth), 0.0)


def _limbs_at(occupancy: pd.DataFrame | None, t_ns: int) -> list[tuple[str, Floats, float]]:
    if occupancy is None:
        return []
    stored = np.unique(times(occupancy))
    before = stored[stored <= t_ns]
    if not len(before):
        return []
    rows = occupancy[occupancy["t_ns"] == before[-1]]
    return [
        (str(limb), np.asarray(vertices, dtype=float).reshape(-1, 3), float(radius))
        for limb, vertices, radius in zip(rows["limb"], rows["vertices"], rows["radius_m"], strict=True)
    ]


def _draw_path(
    ax: Axes,
    view: View,
    reference: Floats,
    tcp: Floats,
    limbs: list[tuple[str, Floats, float]],
    shown: Floats,
    margin_m: float,
) -> None:
    for limb, vertices, radius in limbs:
        edge = outline(vertices, radius, view)
        if len(edge):
            colour = drawing.LIMBS.get(limb, drawing.FAINT)
            ax.add_patch(Polygon(edge, facecolor=colour, alpha=0.22, lw=0))
            ax.add_patch(Polygon(edge, fill=False, edgecolor=colour, lw=0.7, alpha=0.8))
    ax.plot(*view.flat(thin_path(tcp, 0.004)).T, color=drawing.ACTUAL, lw=0.9, alpha=0.85, zorder=4)
    ax.plot(*view.flat(thin_path(reference, 0.004)).T, color=drawing.NOMINAL, lw=1.3, zorder=5)
    flat = view.flat(shown[np.isfinite(shown).all(axis=1)])
    drawing.set_window(ax, (flat.min(axis=0) - margin_m).tolist(), (flat.max(axis=0) + margin_m).tolist())


def speed(motion: pd.DataFrame, t0_ns: int, near_m: float) -> Figure:
    """Fig. 14: programmed speed; actual speed with braking shaded; separation from the swept volumes."""
    seconds = seconds_from(times(motion), t0_ns)
    figure = drawing.new_figure(4.6)
    rows = drawing.panels(figure, 3, heights=[1.0, 1.0, 1.0], gap_in=(0.34, 0.0), share_x=True, top_in=0.26)
    nominal, actual, separation = (row[0] for row in rows)
    nominal.plot(*envelope(seconds, numeric_column(motion, "ref_speed")), color=drawing.NOMINAL, lw=0.9)
    nominal.set(title="Programmed TCP speed", ylabel="m/s")
    actual.plot(*envelope(seconds, numeric_column(motion, "tcp_speed")), color=drawing.ACTUAL, lw=0.9)
    actual.set(title="Actual TCP speed", ylabel="m/s")
    separation.plot(*envelope(seconds, numeric_column(motion, "distance_m")), color=drawing.PURPLE, lw=1.0)
    separation.axhline(near_m, color=drawing.INK, lw=0.8, ls=(0, (4, 3)))
    separation.set(title="Separation from the swept volumes", ylabel="m", xlabel="time [s]", ylim=(0, None))
    high = max(_top(motion, "ref_speed"), _top(motion, "tcp_speed")) * 1.08
    nominal.set_ylim(0, high)
    actual.set_ylim(0, high)
    for ax in (actual, separation):
        _shade(ax, seconds, motion, "braking")
    separation.set_xlim(seconds[0], seconds[-1])
    drawing.legend_above(actual, handles=[Patch(color=drawing.STATUS["braking"], alpha=0.25, lw=0, label="braking")])
    near = Line2D([], [], color=drawing.INK, lw=0.8, ls=(0, (4, 3)), label=f"near: {near_m:g} m")
    drawing.legend_above(separation, handles=[near])
    return figure


def _top(motion: pd.DataFrame, name: str) -> float:
    values = numeric_column(motion, name)
    values = values[np.isfinite(values)]
    return max(float(values.max()), 1e-3) if len(values) else 1.0


def _shade(ax: Axes, seconds: Floats, motion: pd.DataFrame, status: str) -> None:
    bars = _bars(seconds, (motion["status"] == status).to_numpy(dtype=bool))
    ax.broken_barh(
        bars, (0, 1), transform=ax.get_xaxis_transform(), facecolors=drawing.STATUS[status], alpha=0.2, lw=0, zorder=0
    )


def _bars(seconds: Floats, mask: np.ndarray) -> list[tuple[float, float]]:
    """Stretches as (start, width) [s]; neighbours closer than a line's width on paper are one bar."""
    bars: list[tuple[float, float]] = []
    resolution = (seconds[-1] - seconds[0]) / 1500.0 if len(seconds) else 0.0
    for first, last in true_runs(mask):
        start, end = float(seconds[first]), float(seconds[min(last, len(seconds) - 1)])
        if bars and start - sum(bars[-1]) < resolution:
            bars[-1] = (bars[-1][0], end - bars[-1][0])
        else:
            bars.append((start, end - start))
    return bars


def status(
    motion: pd.DataFrame,
    baselines: Mapping[str, pd.DataFrame],
    *,
    method: str,
    t0_ns: int,
    near_m: float,
    slow_m_per_s: float,
) -> Figure:
    """What the plan and each baseline did over time, and when each stood near the person though it should move.

    Args:
        motion: Rows of motion.parquet.
        baselines: Name of each baseline -> rows of its motion.
        method: Method of the plan.
        t0_ns: Instant of time zero [ns].
        near_m: The person is near at a separation of at most this [m].
        slow_m_per_s: The robot stands where its TCP is slower than this [m/s].
    """
    tables = {f"plan: {method}": motion, **baselines}
    figure = drawing.new_figure(0.95 + 0.62 * len(tables))
    ax = drawing.panels(figure, 1, left_in=0.9, top_in=0.36)[0][0]
    for row, table in enumerate(tables.values()):
        seconds = seconds_from(times(table), t0_ns)
        kind = table["status"].to_numpy()
        for value in STATUSES:  # the gravest is drawn last and stays visible
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
    drawing.legend_above(ax, handles=handles)
    return figure


def stationary_share(metrics: Mapping[str, Metric]) -> Figure:
    """Stationary share of the plan and its baselines on this log, with the paper's two figures beside them."""
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
    figure = drawing.new_figure(0.7 + 0.36 * count)
    ax = drawing.panels(figure, 1, left_in=1.55, top_in=0.12, right_in=1.6)[0][0]
    for y, (_, prefix, colour) in enumerate(rows):
        share = metrics[f"{prefix}_stationary_share"]["value"]
        ticks = metrics[f"{prefix}_near_ticks"]["value"]
        text = "never that near" if share is None else f"{100 * share:.2f} % of {ticks} ticks"
        ax.barh(y, 100 * (share or 0.0), height=0.62, color=colour)
        ax.annotate(text, (100 * (share or 0.0), y), xytext=(5, 0), textcoords="offset points", va="center")
    for y, (_, name) in enumerate(paper, start=len(rows)):
        value = 100 * metrics[name]["value"]
        ax.barh(y, value, height=0.62, facecolor="none", edgecolor=drawing.FAINT, hatch="////", lw=0.8)
        ax.annotate(f"{value:.2f} %, other data", (value, y), xytext=(5, 0), textcoords="offset points", va="center")
    ax.set(xlim=(0, 100), ylim=(count - 0.45, -0.55), xlabel="stationary share of the near ticks [%]")
    ax.set_yticks(range(count), [row[0] for row in rows] + [row[0] for row in paper])
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=False, axis="y")
    return figure


_COLOURS = (
    drawing.BLUE,
    drawing.ORANGE,
    drawing.GREEN,
    drawing.PURPLE,
    drawing.SKY,
    drawing.VERMILLION,
    drawing.YELLOW,
)
_MARGIN_M = 0.12


@dataclass(frozen=True)
class LinkPose:
    """The robot's capsules at one tick, and the swept volumes of that tick."""

    t_ns: int
    distance_m: float  #: surface to surface, NaN where it is not known [m]
    bodies: tuple[str, ...]  #: link that each of the s capsules belongs to
    ends_m: Floats  #: (s, 2, 3) world [m]
    radius_m: Floats  #: (s,) [m]
    volumes: Mapping[str, tuple[Floats, float]]  #: limb -> (m, 3) vertices, world, and radius [m]


def links(pose: LinkPose, t0_ns: int, T_world_base: Floats) -> Figure:
    """The capsules from the side, with the person to one hand, and from above; the swept volumes in outline.

    Args:
        pose: What to draw.
        t0_ns: Start of the run [ns].
        T_world_base: (4, 4) robot base in the world [m].
    """
    base_m = T_world_base[:3, 3]
    names = list(dict.fromkeys(pose.bodies))
    colours = {name: to_rgb(_COLOURS[i % len(_COLOURS)]) for i, name in enumerate(names)}
    solids = [
        RenderedHull(ends, float(radius), colours[body])
        for body, ends, radius in zip(pose.bodies, pose.ends_m, pose.radius_m, strict=True)
    ]
    rows = -(-(len(names) + 1) // 4)
    figure = drawing.new_figure(3.9 + 0.18 * rows)
    axes = drawing.panels(figure, 1, 2, left_in=0.62, top_in=0.3, bottom_in=0.5 + 0.18 * rows, gap_in=(0.3, 0.62))[0]
    views = (view_from(_beside(pose, base_m), 0.12), ABOVE)
    for ax, view in zip(axes, views, strict=True):
        _draw(ax, view, solids, pose, base_m)
    near = "" if np.isnan(pose.distance_m) else f", {pose.distance_m:.3f} m from the person's volumes"
    axes[0].set(title=f"At {(pose.t_ns - t0_ns) * 1e-9:.1f} s{near}", xlabel="across [m]", ylabel="up [m]")
    axes[1].set(title="From above", xlabel="x [m]", ylabel="y [m]")
    handles = [Patch(color=colours[name], lw=0, label=name) for name in names]
    if pose.volumes:
        handles.append(Patch(facecolor=drawing.FAINT, alpha=0.3, lw=0, label="swept volumes of the person"))
    figure.legend(handles=handles, loc="lower center", ncols=4, bbox_to_anchor=(0.5, 0.01))
    return figure


def _beside(pose: LinkPose, base_m: Floats) -> float:
    """The azimuth of who sees robot and person side by side [rad]."""
    if not pose.volumes:
        return -0.5 * np.pi
    person = np.mean([vertices.mean(axis=0) for vertices, _ in pose.volumes.values()], axis=0)
    return float(np.arctan2(person[1] - base_m[1], person[0] - base_m[0]) - 0.5 * np.pi)


def _draw(ax: Axes, view: View, solids: list[RenderedHull], pose: LinkPose, base_m: Floats) -> None:
    edges = [outline(solid.vertices_m, solid.radius_m, view) for solid in solids]
    corners = np.vstack([*edges, view.flat(base_m[None])])
    low, high = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
    drawing.set_window(ax, low.tolist(), high.tolist())
    for limb, (vertices, radius) in pose.volumes.items():
        edge = outline(vertices, radius, view)
        if len(edge):
            colour = drawing.LIMBS.get(limb, drawing.FAINT)
            ax.add_patch(Polygon(edge, facecolor=colour, alpha=0.12, lw=0, zorder=0))
            ax.add_patch(Polygon(edge, fill=False, edgecolor=colour, lw=0.7, alpha=0.7, zorder=0))
    image = render_hulls(solids, view, low, high, (high[1] - low[1]) / 420.0)
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    limits = ax.get_xlim(), ax.get_ylim()
    ax.imshow(image, origin="lower", extent=extent, aspect="auto", interpolation="bilinear", zorder=2)
    ax.set(xlim=limits[0], ylim=limits[1])
    for edge in edges:
        if len(edge):
            ax.add_patch(Polygon(edge, fill=False, edgecolor=drawing.INK, lw=0.5, alpha=0.6, zorder=3))
    ax.plot(*view.flat(base_m[None]).T, "s", color=drawing.INK, ms=6, zorder=4)
