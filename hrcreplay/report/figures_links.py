"""Figure of the robot: the capsules that stand for its links, beside what the person could reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon

from hrcreplay.records import Floats
from hrcreplay.report import style
from hrcreplay.report.figures_robot import ABOVE
from hrcreplay.report.solids import Solid, View, outline, picture, view_from

_COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.SKY, style.VERMILLION, style.YELLOW)
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
        Solid(ends, float(radius), colours[body])
        for body, ends, radius in zip(pose.bodies, pose.ends_m, pose.radius_m, strict=True)
    ]
    rows = -(-(len(names) + 1) // 4)
    figure = style.new_figure(3.9 + 0.18 * rows)
    axes = style.panels(figure, 1, 2, left_in=0.62, top_in=0.3, bottom_in=0.5 + 0.18 * rows, gap_in=(0.3, 0.62))[0]
    views = (view_from(_beside(pose, base_m), 0.12), ABOVE)
    for ax, view in zip(axes, views, strict=True):
        _draw(ax, view, solids, pose, base_m)
    near = "" if np.isnan(pose.distance_m) else f", {pose.distance_m:.3f} m from the person's volumes"
    axes[0].set(title=f"At {(pose.t_ns - t0_ns) * 1e-9:.1f} s{near}", xlabel="across [m]", ylabel="up [m]")
    axes[1].set(title="From above", xlabel="x [m]", ylabel="y [m]")
    handles = [Patch(color=colours[name], lw=0, label=name) for name in names]
    if pose.volumes:
        handles.append(Patch(facecolor=style.FAINT, alpha=0.3, lw=0, label="swept volumes of the person"))
    figure.legend(handles=handles, loc="lower center", ncols=4, bbox_to_anchor=(0.5, 0.01))
    return figure


def _beside(pose: LinkPose, base_m: Floats) -> float:
    """The azimuth of who sees robot and person side by side [rad]."""
    if not pose.volumes:
        return -0.5 * np.pi
    person = np.mean([vertices.mean(axis=0) for vertices, _ in pose.volumes.values()], axis=0)
    return float(np.arctan2(person[1] - base_m[1], person[0] - base_m[0]) - 0.5 * np.pi)


def _draw(ax: Axes, view: View, solids: list[Solid], pose: LinkPose, base_m: Floats) -> None:
    edges = [outline(solid.vertices_m, solid.radius_m, view) for solid in solids]
    corners = np.vstack([*edges, view.flat(base_m[None])])
    low, high = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
    style.set_window(ax, low.tolist(), high.tolist())
    for limb, (vertices, radius) in pose.volumes.items():
        edge = outline(vertices, radius, view)
        if len(edge):
            colour = style.LIMBS.get(limb, style.FAINT)
            ax.add_patch(Polygon(edge, facecolor=colour, alpha=0.12, lw=0, zorder=0))
            ax.add_patch(Polygon(edge, fill=False, edgecolor=colour, lw=0.7, alpha=0.7, zorder=0))
    image = picture(solids, view, low, high, (high[1] - low[1]) / 420.0)
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    limits = ax.get_xlim(), ax.get_ylim()
    ax.imshow(image, origin="lower", extent=extent, aspect="auto", interpolation="bilinear", zorder=2)
    ax.set(xlim=limits[0], ylim=limits[1])
    for edge in edges:
        if len(edge):
            ax.add_patch(Polygon(edge, fill=False, edgecolor=style.INK, lw=0.5, alpha=0.6, zorder=3))
    ax.plot(*view.flat(base_m[None]).T, "s", color=style.INK, ms=6, zorder=4)
