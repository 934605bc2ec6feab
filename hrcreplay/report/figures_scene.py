"""Figures of robot and person together: the storyboard of Fig. 15 and 16, and the capsules of the robot's links."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hrcreplay.records import Floats
from hrcreplay.report import drawing
from hrcreplay.report.figures_prediction import ABOVE
from hrcreplay.report.metrics import thin_path
from hrcreplay.report.projection import (
    RenderedHull,
    View,
    bones,
    bounds_of,
    draw_outlines,
    draw_solids,
    outline,
    view_from,
)

_COLOURS = (
    drawing.BLUE,
    drawing.ORANGE,
    drawing.GREEN,
    drawing.PURPLE,
    drawing.SKY,
    drawing.VERMILLION,
    drawing.YELLOW,
)
_MARGIN_M = 0.08


@dataclass(frozen=True)
class LinkPose:
    """The robot's capsules at one tick, and the swept volumes of that tick."""

    t_ns: int
    distance_m: float  #: surface to surface, NaN where it is not known [m]
    bodies: tuple[str, ...]  #: link that each of the s capsules belongs to
    ends_m: Floats  #: (s, 2, 3) world [m]
    radius_m: Floats  #: (s,) [m]
    volumes: Mapping[str, tuple[Floats, float]]  #: limb -> (m, 3) vertices, world, and radius [m]


@dataclass(frozen=True)
class StoryScene:
    """One programmed instant, as the robot passed it alone and beside the person."""

    programme_s: float
    t_ns: tuple[int, int]  #: when it did: alone, beside the person
    ends_m: tuple[Floats, Floats]  #: (s, 2, 3) each: capsules of the links, world
    tcp_m: tuple[Floats, Floats]  #: (n, 3) each: way of the TCP until then, world
    points_m: Floats  #: (20, 3) the fused person
    volumes: Mapping[str, tuple[Floats, float]]  #: limb -> (m, 3) vertices, world, and radius; of the person


@dataclass(frozen=True)
class Storyboard:
    """The same stretch of the programme without and with the person."""

    scenes: Sequence[StoryScene]
    radius_m: Floats  #: (s,) of the links' capsules
    base_m: Floats  #: (3,)
    reference_m: Floats  #: (n, 3) programmed way of the TCP over that stretch
    method: str


def storyboard(story: Storyboard, t0_ns: int) -> Figure:
    """Fig. 15, Fig. 16: rows of the same programmed instant, on the left without the person, on the right with.

    Args:
        story: What to draw.
        t0_ns: Start of the run [ns].
    """
    person = np.mean([v.mean(axis=0) for scene in story.scenes for v, _ in scene.volumes.values()], axis=0)
    view = view_from(_beside(person, story.base_m), 0.2)
    arms = [outline(p, r, view) for s in story.scenes for e in s.ends_m for p, r in zip(e, story.radius_m, strict=True)]
    bodies = [outline(v, r, view) for scene in story.scenes for v, r in scene.volumes.values()]
    low, high = bounds_of([*arms, *bodies], 0.02)
    robot_low = bounds_of(arms, 0.02)[0]
    low[1] = max(low[1], min(robot_low[1], float(view.flat(story.base_m[None])[0, 1]) - 0.05))  # legs say nothing here
    wide_in = (drawing.COLUMN_IN - 0.1) / 2
    tall_in = wide_in * float(np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.5, 1.2))
    count = len(story.scenes)
    figure = drawing.column_figure(count * (tall_in + 0.16) + 0.5)
    grid = drawing.column_panels(
        figure, count, 2, left_in=0.03, right_in=0.03, top_in=0.34, bottom_in=0.32, gap_in=(0.16, 0.04)
    )
    for row, scene in enumerate(story.scenes):
        for ax, side in zip(grid[row], (0, 1), strict=True):
            drawing.set_window(ax, low.tolist(), high.tolist())
            _draw_scene(ax, scene, side, story, view)
            clock = f"at {(scene.t_ns[side] - t0_ns) * 1e-9:.1f} s"
            words = clock if side else f"programme {scene.programme_s:.1f} s, {clock}"
            ax.set_title(words, fontweight="normal", pad=2.0)
            drawing.no_axes(ax)
    height = figure.get_figheight()
    for x, words in (
        (0.03, "(15) without the person"),
        (0.03 + wide_in + 0.04, f"(16) with the person: {story.method}"),
    ):
        figure.text(x / drawing.COLUMN_IN, 1 - 0.04 / height, words, va="top", fontweight="bold")
    handles: list[Line2D | Patch] = [
        Patch(color=drawing.SKY, lw=0, label="robot"),
        Line2D([], [], color=drawing.NOMINAL, label="programmed"),
        Line2D([], [], color=drawing.ACTUAL, label="driven"),
        Line2D([], [], color=drawing.INK, lw=1.0, label="person"),
        Patch(color=drawing.FAINT, alpha=0.35, lw=0, label="swept volumes"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=5, bbox_to_anchor=(0.5, 0.03 / height), columnspacing=0.8)
    return figure


def _draw_scene(ax: Axes, scene: StoryScene, side: int, story: Storyboard, view: View) -> None:
    if side:
        draw_outlines(ax, scene.volumes, view)
        for pair in bones(scene.points_m, view):
            ax.plot(*pair.T, color=drawing.INK, lw=1.0, zorder=1)
    links = zip(scene.ends_m[side], story.radius_m, strict=True)
    draw_solids(ax, [RenderedHull(e, float(r), to_rgb(drawing.SKY)) for e, r in links], view, line=0.4)
    ax.plot(*view.flat(thin_path(story.reference_m, 0.004)).T, color=drawing.NOMINAL, lw=0.9, zorder=4)
    driven = scene.tcp_m[side]
    ax.plot(*view.flat(thin_path(driven, 0.004)).T, color=drawing.ACTUAL, lw=1.1, zorder=5)
    ax.plot(*view.flat(driven[-1:]).T, "o", color=drawing.ACTUAL, ms=2.5, zorder=6)
    base = view.flat(story.base_m[None])
    ax.plot(*base.T, "s", color=drawing.INK, ms=3, zorder=4)


def _beside(person_m: Floats, base_m: Floats) -> float:
    """The azimuth of who sees robot and person side by side [rad]."""
    return float(np.arctan2(person_m[1] - base_m[1], person_m[0] - base_m[0]) - 0.5 * np.pi)


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
    figure = drawing.column_figure(2.2 + 0.14 * rows)
    (side, above), *_ = drawing.column_panels(figure, 1, 2, bottom_in=0.42 + 0.14 * rows)
    azimuth = -0.5 * np.pi
    if pose.volumes:
        azimuth = _beside(np.mean([vertices.mean(axis=0) for vertices, _ in pose.volumes.values()], axis=0), base_m)
    for ax, view in ((side, view_from(azimuth, 0.12)), (above, ABOVE)):
        edges = [outline(solid.vertices_m, solid.radius_m, view) for solid in solids]
        low, high = bounds_of([*edges, view.flat(base_m[None])], _MARGIN_M)
        drawing.set_window(ax, low.tolist(), high.tolist())
        draw_outlines(ax, pose.volumes, view)
        draw_solids(ax, solids, view)
        ax.plot(*view.flat(base_m[None]).T, "s", color=drawing.INK, ms=4, zorder=4)
    near = "" if np.isnan(pose.distance_m) else f", {pose.distance_m:.3f} m apart"
    side.set(title=f"At {(pose.t_ns - t0_ns) * 1e-9:.1f} s{near}", xlabel="across [m]", ylabel="up [m]")
    above.set(title="From above", xlabel="x [m]", ylabel="y [m]")
    handles = [Patch(color=colours[name], lw=0, label=name) for name in names]
    if pose.volumes:
        handles.append(Patch(facecolor=drawing.FAINT, alpha=0.3, lw=0, label="swept volumes"))
    figure.legend(handles=handles, loc="lower center", ncols=4, bbox_to_anchor=(0.5, 0.03 / figure.get_figheight()))
    return figure
