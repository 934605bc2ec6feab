"""Figures of the space that the person could reach: Fig. 5, 7, 8, 9 and 17, and the volume against the horizon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import LogLocator
from scipy.spatial import ConvexHull, QhullError

from hrcreplay.human.model import skeleton
from hrcreplay.records import JOINTS, LENGTHS, LIMBS, OF_PERSON, POINTS, Floats, SweptVolume
from hrcreplay.reporting.figures import drawing
from hrcreplay.reporting.figures.scene import ABOVE, View, bones, bounds_of, draw_solids, view_from, volume_solids
from hrcreplay.reporting.metrics.planning import numeric_column
from hrcreplay.reporting.metrics.series import columns, times
from hrcreplay.reporting.tables import part_name_text
from hrcreplay.store.stored_table import RunTable

#: Maximum age of stored volumes, and of people, at an instant [s].
STALE_S = 0.2
#: Limb -> its volume.
Limbs = Mapping[str, SweptVolume]
#: One instant of Fig. 17: t_ns, and the swept volumes of each method.
Instant = tuple[int, Mapping[str, Limbs]]

METHODS = {"paper": "paper", "positions": "positions", "sound": "sound"}
COLOURS = {"paper": drawing.ORANGE, "positions": drawing.GREEN, "sound": drawing.BLUE}


@dataclass(frozen=True)
class Walk:
    """Floor area that the person can reach after an instant."""

    t_ns: int
    horizon_s: float  #: braking time T_s
    place_m: Floats  #: (2,) position of the pelvis, world
    heading_rad: float
    radius_m: float  #: R, distance at the highest speed
    turn_rad: tuple[float, float]  #: beta^min and beta^max from the heading
    box_m: Floats  #: (2, 2) lower and upper corner of the paper's convex approximation, world
    polygon_m: Floats  #: (k, 2) corners of the area enclosed by ``sound``, in order
    walked_m: Floats  #: (n, 2) positions of the fused person from the instant until the horizon


@dataclass(frozen=True)
class Sweep:
    """A forearm swept by its elbow and then by walking, as in the paper."""

    t_ns: int
    limb: str
    elbow_m: Floats  #: (3,) world
    wrist_m: Floats  #: (3,) where it is
    arc_m: Floats  #: (n, 3) positions of the wrist over the reachable interval of the elbow angle
    apexes_m: Floats  #: (k, 3) corners of the triangles around that arc
    box_m: Floats  #: (2, 2) lower and upper displacement in x and y


@dataclass(frozen=True)
class Growth:
    """The six limbs' volumes added up, at one instant for several horizons."""

    t_ns: int
    horizon_s: Floats  #: (k,)
    volume_m3: Mapping[str, Floats]  #: method -> (k,)


def walking(walk: Walk, t0_ns: int) -> Figure:
    """Fig. 5: draws the circular sectors that a unicycle reaches (dashed), and the convex sets used (solid)."""
    figure = drawing.column_figure(2.7)
    ((ax,),) = drawing.column_panels(figure, bottom_in=0.64)
    beta = np.linspace(*walk.turn_rad, 60) + walk.heading_rad
    arc = walk.place_m + walk.radius_m * np.column_stack([np.cos(beta), np.sin(beta)])
    sector = np.vstack([walk.place_m, arc, walk.place_m])
    (left, back), (right, front) = walk.box_m
    box = np.array([[left, back], [right, back], [right, front], [left, front]])
    low, high = bounds_of([sector, box, walk.polygon_m], 0.04)
    drawing.set_window(ax, low.tolist(), high.tolist())
    for corners, method in ((walk.polygon_m, "sound"), (box, "paper")):
        ax.add_patch(Polygon(corners, facecolor=COLOURS[method], alpha=0.12, lw=0))
        ax.add_patch(Polygon(corners, fill=False, edgecolor=COLOURS[method], lw=1.6))
    ax.plot(*sector.T, color=drawing.INK, lw=1.0, ls=(0, (4, 2)), zorder=3)
    ahead = 0.35 * walk.radius_m * np.array([np.cos(walk.heading_rad), np.sin(walk.heading_rad)])
    ax.annotate(
        "",
        xy=(walk.place_m + ahead).tolist(),
        xytext=walk.place_m.tolist(),
        arrowprops={"arrowstyle": "-|>", "color": drawing.INK, "lw": 1.0, "shrinkA": 0, "shrinkB": 0},
        zorder=5,
    )
    ax.plot(*walk.walked_m.T, color=drawing.VERMILLION, lw=1.6, zorder=4)
    ax.plot(*walk.place_m, "o", color=drawing.INK, ms=3.5, zorder=6)
    ax.set(title=_at(walk.t_ns, t0_ns) + f", T = {walk.horizon_s:.3f} s", xlabel="x [m]", ylabel="y [m]")
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=drawing.INK, ls=(0, (4, 2)), lw=1.0, label="sectors of the unicycle"),
        Line2D([], [], color=drawing.VERMILLION, lw=1.6, label="walked until T"),
        Line2D([], [], color=COLOURS["paper"], lw=1.6, label="convex set of the paper"),
        Line2D([], [], color=COLOURS["sound"], lw=1.6, label="convex set of sound"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=2, bbox_to_anchor=(0.5, 0.01))
    return figure


def sweeps(sweep: Sweep, t0_ns: int) -> Figure:
    """Fig. 7, Fig. 8: draws a forearm displaced by walking, from above, and turned by the elbow, in its plane."""
    figure = drawing.column_figure(2.35)
    (ax, turn), *_ = drawing.column_panels(figure, 1, 2, bottom_in=0.62, gap_in=(0.0, 0.5))
    swept = np.vstack([sweep.elbow_m, sweep.arc_m[[0, -1]], sweep.apexes_m])
    flat = hull_of(ABOVE.flat(swept))
    (left, back), (right, front) = sweep.box_m
    copies = [flat + np.array([dx, dy]) for dx in (left, right) for dy in (back, front)]
    whole = hull_of(np.vstack([flat, *copies]))
    low, high = bounds_of([whole], 0.03)
    drawing.set_window(ax, low.tolist(), high.tolist())
    ax.add_patch(Polygon(whole, facecolor=drawing.SKY, alpha=0.2, lw=0))
    ax.add_patch(Polygon(whole, fill=False, edgecolor=drawing.BLUE, lw=1.5))
    for copy in copies:
        ax.add_patch(Polygon(copy, fill=False, edgecolor=drawing.FAINT, lw=0.7))
    ax.add_patch(Polygon(flat, facecolor=drawing.ORANGE, edgecolor=drawing.ORANGE, alpha=0.7, lw=0.7, zorder=3))
    ax.plot(*ABOVE.flat(np.vstack([sweep.elbow_m, sweep.wrist_m])).T, color=drawing.INK, lw=1.6, zorder=4)
    ax.set(title="(7) walking, from above", xlabel="x [m]", ylabel="y [m]")
    _draw_turn(turn, sweep)
    figure.text(
        *(0.5, 0.2 / 2.35),
        f"{part_name_text(sweep.limb)} {_at(sweep.t_ns, t0_ns).lower()}",
        ha="center",
        va="bottom",
        fontsize=6.5,
    )
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=drawing.INK, lw=1.6, label="forearm"),
        Line2D([], [], color=drawing.FAINT, lw=0.8, label="moved"),
        Line2D([], [], color=drawing.ORANGE, lw=1.2, label="arcs, triangles"),
        Line2D([], [], color=drawing.BLUE, lw=1.5, label="convex hull"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=4, bbox_to_anchor=(0.5, 0.01))
    return figure


def _draw_turn(ax: Axes, sweep: Sweep) -> None:
    """Fig. 8: draws the forearm over the elbow's interval, the arc, its triangles and the hull of all corners."""
    wrists = sweep.arc_m - sweep.elbow_m
    along = wrists[len(wrists) // 2]
    along = along / np.linalg.norm(along)
    aside = wrists[-1] - wrists[0]
    aside = aside - (aside @ along) * along
    plane = np.column_stack([aside / max(float(np.linalg.norm(aside)), 1e-9), along])
    arc, apexes = wrists @ plane, (sweep.apexes_m - sweep.elbow_m) @ plane
    hull = hull_of(np.vstack([np.zeros((1, 2)), arc[[0, -1]], apexes]))
    low, high = bounds_of([hull], 0.02)
    drawing.set_window(ax, low.tolist(), high.tolist())
    ax.add_patch(Polygon(hull, facecolor=drawing.SKY, alpha=0.2, lw=0))
    ax.add_patch(Polygon(hull, fill=False, edgecolor=drawing.BLUE, lw=1.5))
    for k in np.linspace(0, len(arc) - 1, 7).round().astype(int).tolist():
        ax.plot(*np.vstack([np.zeros(2), arc[k]]).T, color=drawing.FAINT, lw=0.7)
    ends = arc[np.linspace(0, len(arc) - 1, len(apexes) + 1).round().astype(int)]
    for first, apex, last in zip(ends[:-1], apexes, ends[1:], strict=True):
        ax.plot(*np.vstack([first, apex, last, first]).T, color=drawing.ORANGE, lw=0.8, zorder=3)
    ax.plot(*arc.T, color=drawing.ORANGE, lw=1.2, zorder=3)
    ax.plot(*np.vstack([np.zeros(2), (sweep.wrist_m - sweep.elbow_m) @ plane]).T, color=drawing.INK, lw=1.6, zorder=4)
    ax.set(title="(8) elbow, in its plane", xlabel="across [m]", ylabel="along [m]")


def hull_of(points: Floats) -> Floats:
    """Returns (k, 2) corners of a flat hull in order; the points themselves if they have no hull."""
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except (QhullError, ValueError):
        return points


def stored_at(occupancy: RunTable, t_ns: int) -> tuple[RunTable, Limbs]:
    """Returns the volumes stored last at or before an instant, else the first: their rows, and the same as Limbs."""
    stored = np.unique(times(occupancy))
    at_ns = stored[max(0, int(np.searchsorted(stored, t_ns, side="right")) - 1)]
    rows = occupancy[times(occupancy) == at_ns]
    limbs = {
        str(limb): SweptVolume(np.asarray(vertices, dtype=float).reshape(-1, 3), float(radius))
        for limb, vertices, radius in zip(rows["limb"], rows["vertices"], rows["radius_m"], strict=True)
    }
    return rows, limbs


def volumes_at(occupancy: RunTable, people: Sequence[RunTable], moment_ns: int, t0_ns: int) -> Figure:
    """Fig. 9: draws the swept volumes that the run used at one instant, from the front of person 1 and from above.

    Args:
        occupancy: Rows of occupancy.parquet, limbs named with their person.
        people: The fused states of each person.
        moment_ns: Approximate instant; the volumes stored last before it are drawn [ns].
        t0_ns: Start of the run [ns].
    """
    rows, limbs = stored_at(occupancy, moment_ns)
    t_ns = int(times(rows)[0])
    heading = skeleton_at(people[0], t_ns)[1]
    figure = drawing.column_figure(2.62)
    (ahead, above), *_ = drawing.column_panels(figure, 1, 2, bottom_in=0.68, gap_in=(0.0, 0.5))
    solids = volume_solids(limbs)
    for ax, view in ((ahead, view_from(heading - 0.7, 0.15)), (above, ABOVE)):
        low, high = bounds_of([solid.outline(view) for solid in solids], 0.03)
        drawing.set_window(ax, low.tolist(), high.tolist())
        draw_solids(ax, solids, view, opacity=0.8, line=0.45)
        for points in skeletons_at(people, t_ns):
            _draw_bones(ax, points, view, np.zeros(2))
    horizon = f", {rows['horizon_s'].iloc[0]:.2f} s ahead" if "horizon_s" in rows else ""
    ahead.set(title=f"{rows['method'].iloc[0]}{horizon}", xlabel="across [m]", ylabel="up [m]")
    above.set(title=f"{_at(t_ns, t0_ns)}, from above", xlabel="x [m]", ylabel="y [m]")
    _limb_legend(figure, limbs)
    return figure


def volumes(instants: Sequence[Instant], state: RunTable, t0_ns: int) -> Figure:
    """Fig. 17: draws the person's swept volumes, one row per method, one column per instant, with one scale.

    Args:
        instants: Instants to draw, in order of time.
        state: The fused person, for the skeleton and the viewpoint.
        t0_ns: Start of the run [ns].
    """
    methods = list(instants[0][1])
    people = [skeleton_at(state, t_ns) for t_ns, _ in instants]
    heading = float(np.nanmean([heading for _, heading in people]))
    view = view_from(heading - 0.9, 0.28)
    centres = [view.flat(points[[POINTS.index("pelvis")]])[0] for points, _ in people]
    outlines = {
        method: [
            solid.outline(view) - centre
            for (_, found), centre in zip(instants, centres, strict=True)
            for solid in volume_solids(found[method])
        ]
        for method in methods
    }
    boxes = [bounds_of(edges, 0.04) for edges in outlines.values()]  # one scale, and the minimum height of each row
    left, right = min(low[0] for low, _ in boxes), max(high[0] for _, high in boxes)
    wide_in = (drawing.COLUMN_IN - 0.22) / len(instants)
    tall_in = [max(0.5, float(high[1] - low[1]) * wide_in / float(right - left)) for low, high in boxes]
    figure = drawing.column_figure(0.68 + sum(tall_in) + 0.06 * (len(methods) - 1))
    grid = drawing.column_panels(
        figure,
        *(len(methods), len(instants)),
        left_in=0.2,
        right_in=0.02,
        top_in=0.34,
        bottom_in=0.34,
        gap_in=(0.06, 0.0),
        heights=tall_in,
    )
    for row, method in enumerate(methods):
        for column, (t_ns, found) in enumerate(instants):
            ax = grid[row][column]
            drawing.set_window(ax, (left, boxes[row][0][1]), (right, boxes[row][1][1]))
            _draw_person(ax, found[method], people[column][0], view, centres[column])
            if row == 0:
                later = (t_ns - instants[0][0]) * 1e-9
                at = f"T = {later:.0f} s\n({(t_ns - t0_ns) * 1e-9:.1f} s)"
                ax.set_title(at if column else at.replace("\n(", "\n(at "), fontweight="normal", loc="center")
            drawing.no_axes(ax)
        grid[row][0].set_ylabel(METHODS.get(method, method), fontweight="bold")
    _scale_bar(grid[-1][-1], float(right) - 0.05, float(boxes[-1][0][1]))
    _limb_legend(figure, {limb for limbs in instants[0][1].values() for limb in limbs})
    return figure


def skeleton_at(state: RunTable, t_ns: int) -> tuple[Floats, float]:
    """Returns (20, 3) points of the fused person at the tick nearest to an instant [m], and the heading [rad]."""
    nearest = int(np.argmin(np.abs(times(state) - t_ns)))
    row = state.iloc[nearest : nearest + 1]
    p = columns(row)
    return skeleton(p, row[list(LENGTHS)].to_numpy(dtype=float))[0], float(p[0, JOINTS.index("theta")])


def skeletons_at(people: Sequence[RunTable], t_ns: int) -> list[Floats]:
    """Returns (20, 3) points of each fused person who is there at an instant [m]: nobody from before or after."""
    there = [state for state in people if np.abs(times(state) - t_ns).min(initial=2**62) <= STALE_S * 1e9]
    return [skeleton_at(state, t_ns)[0] for state in there]


def _draw_person(ax: Axes, limbs: Limbs, points: Floats, view: View, centre: Floats) -> None:
    """Draws half-transparent volumes with the skeleton; ``centre`` is the position of the axes' origin in the view."""
    moved = centre @ np.stack([view.right, view.up])
    draw_solids(ax, volume_solids(limbs, moved), view, opacity=0.8, line=0.45)
    _draw_bones(ax, points, view, centre)


def _draw_bones(ax: Axes, points: Floats, view: View, centre: Floats) -> None:
    pairs = [pair - centre for pair in bones(points, view)]
    ax.add_collection(LineCollection(pairs, colors=drawing.INK, lw=1.0, zorder=4), autolim=False)


def _limb_legend(figure: Figure, drawn: Mapping[str, object] | set[str]) -> None:
    limbs = {name.partition(OF_PERSON)[0] for name in drawn}
    handles = [
        Patch(color=colour, lw=0, label=part_name_text(limb)) for limb, colour in drawing.LIMBS.items() if limb in limbs
    ]
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=4,
        bbox_to_anchor=(0.5, 0.03 / figure.get_figheight()),
        handlelength=1.0,
        columnspacing=0.8,
    )


def _scale_bar(ax: Axes, right: float, low: float) -> None:
    """Draws a scale bar of half a metre at the lower edge of axes, with its label below."""
    ax.plot([right - 0.5, right], [low, low], color=drawing.INK, lw=1.2, solid_capstyle="butt", clip_on=False)
    words: dict[str, Any] = {
        "xytext": (0, -2),
        "textcoords": "offset points",
        "ha": "right",
        "va": "top",
        "fontsize": 6.5,
    }
    ax.annotate("0.5 m", (right, low), annotation_clip=False, **words)


def _at(t_ns: int, t0_ns: int) -> str:
    return f"At {(t_ns - t0_ns) * 1e-9:.1f} s"


def growth(found: Growth, occupancy: RunTable | None, t0_ns: int) -> Figure:
    """Draws the six limbs' volumes against the horizon: by each method at one instant, and as used (dots).

    Args:
        found: Data to draw.
        occupancy: Rows of occupancy.parquet; None: no dots.
        t0_ns: Start of the run [ns].
    """
    figure = drawing.column_figure(2.2)
    ((ax,),) = drawing.column_panels(figure)
    if occupancy is not None and "horizon_s" in occupancy:
        horizon_s, volume_m3 = stored_sums(occupancy)
        some = slice(None, None, max(1, len(horizon_s) // 600))
        ax.plot(horizon_s[some], volume_m3[some], ".", ms=2, mew=0, color=drawing.FAINT, alpha=0.6, label="_")
        ax.plot([], [], ".", ms=4, color=drawing.FAINT, label="stored")
    for method, volume in found.volume_m3.items():
        ax.plot(
            found.horizon_s,
            volume,
            ".-",
            ms=4,
            color=COLOURS.get(method, drawing.INK),
            label=METHODS.get(method, method),
        )
    ax.set(xlim=(0.0, None), yscale="log", xlabel="horizon [s]", ylabel="volume of the six limbs [m\u00b3]")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("")
    ax.set_title(_at(found.t_ns, t0_ns))
    drawing.legend_above(ax)
    return figure


def stored_sums(occupancy: RunTable) -> tuple[Floats, Floats]:
    """Returns (n,) horizon [s] and (n,) total volume of the six limbs [m^3] at every stored instant with all six."""
    sizes = occupancy[["t_ns", "limb", "horizon_s", "volume_m3"]]
    six = sizes[sizes["limb"].isin(LIMBS)]
    by_tick = six.groupby("t_ns", sort=True)
    count = by_tick["volume_m3"].count().to_numpy()
    horizon_s, volume_m3 = (by_tick[name].agg(how) for name, how in (("horizon_s", "first"), ("volume_m3", "sum")))
    whole = count == len(LIMBS)
    return (
        numeric_column(horizon_s.to_frame(), "horizon_s")[whole],
        numeric_column(volume_m3.to_frame(), "volume_m3")[whole],
    )
