"""Shared drawing functions: figure style and export, and swept volumes in orthographic projection.

The colours can be told apart by readers with colour vision deficiency.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image
from scipy.spatial import ConvexHull, QhullError

from hrcreplay.geometry.visible_front import visible_front
from hrcreplay.records import POINTS, Floats

# Okabe and Ito's palette.
ORANGE, SKY, GREEN, YELLOW = "#E69F00", "#56B4E9", "#009E73", "#F0E442"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"

#: Text and axes; the page replaces these two by its own ink where it is dark.
INK, FAINT = "#25313c", "#8b98a5"
GRID = "#dfe5ea"

NOMINAL, ACTUAL, FUSED, TRUTH = BLUE, VERMILLION, BLUE, INK
CAMERAS = (ORANGE, GREEN, PURPLE, SKY)
STATUS = {"tracking": SKY, "limited": ORANGE, "braking": VERMILLION, "retreating": PURPLE}
LIMBS = {"HD": PURPLE, "THX": "#9aa5b1", "URA": BLUE, "LRA": SKY, "ULA": GREEN, "LLA": ORANGE, "LEGS": YELLOW}

STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 5.0,
    "axes.labelsize": 8.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.4,
    "legend.borderaxespad": 0.0,
    "lines.linewidth": 1.1,
    "lines.solid_capstyle": "round",
    "lines.solid_joinstyle": "round",
    "hatch.linewidth": 0.6,
    "path.simplify_threshold": 0.3,
    "axes.titley": 1.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "hrcreplay",
    "svg.image_inline": True,
}

#: What differs in one column of a two-column paper.
COLUMN_STYLE: dict[str, Any] = STYLE | {
    "font.size": 7.0,
    "axes.titlesize": 7.0,
    "axes.titlepad": 3.0,
    "axes.labelsize": 7.0,
    "axes.labelpad": 2.0,
    "axes.linewidth": 0.6,
    "grid.linewidth": 0.4,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "xtick.major.size": 2.0,
    "ytick.major.size": 2.0,
    "xtick.major.pad": 2.0,
    "ytick.major.pad": 2.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 6.5,
    "legend.handlelength": 1.4,
    "legend.handletextpad": 0.5,
    "legend.columnspacing": 1.0,
    "legend.labelspacing": 0.3,
    "lines.linewidth": 0.9,
}

DPI = 150
WIDTH_IN = 8.4
#: One column of a two-column paper, and its dots an inch.
COLUMN_IN = 3.5
COLUMN_DPI = 300


def style(*, column: bool = False) -> Any:
    """Context in which figures are made and saved, of the page's width or of a paper's column."""
    return mpl.rc_context(cast("Any", COLUMN_STYLE if column else STYLE))


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """An empty figure of the page's width."""
    return Figure(figsize=(width_in, height_in))


def column_figure(height_in: float) -> Figure:
    """An empty figure of one column of a two-column paper."""
    return Figure(figsize=(COLUMN_IN, height_in))


def panels(
    figure: Figure,
    rows: int,
    columns: int = 1,
    *,
    left_in: float = 0.72,
    right_in: float = 0.14,
    top_in: float = 0.32,
    bottom_in: float = 0.46,
    gap_in: tuple[float, float] = (0.32, 0.5),
    heights: Sequence[float] | None = None,
    widths: Sequence[float] | None = None,
    share_x: bool = False,
) -> list[list[Axes]]:
    """A grid of axes with margins in inches, which unlike a layout engine costs no second drawing.

    Args:
        figure: To draw on.
        rows: Rows of axes.
        columns: Columns of axes.
        left_in: Margin for the labels of the first column [in].
        right_in: Margin [in].
        top_in: Margin for titles and legend [in].
        bottom_in: Margin for the labels of the last row [in].
        gap_in: Between rows and between columns [in].
        heights: Ratios of the rows' heights.
        widths: Ratios of the columns' widths.
        share_x: One abscissa, labelled in the last row only.
    """
    width, height = figure.get_size_inches()
    inner_w = (width - left_in - right_in - (columns - 1) * gap_in[1]) / columns
    inner_h = (height - top_in - bottom_in - (rows - 1) * gap_in[0]) / rows
    axes = figure.subplots(
        rows,
        columns,
        squeeze=False,
        sharex=share_x,
        gridspec_kw={
            "left": left_in / width,
            "right": 1.0 - right_in / width,
            "top": 1.0 - top_in / height,
            "bottom": bottom_in / height,
            "hspace": gap_in[0] / inner_h if rows > 1 else 0.0,
            "wspace": gap_in[1] / inner_w if columns > 1 else 0.0,
            "height_ratios": heights,
            "width_ratios": widths,
        },
    )
    return [list(row) for row in axes]


def set_window(ax: Axes, low: Sequence[float], high: Sequence[float]) -> None:
    """Limits that show at least the box from ``low`` to ``high`` with one scale for both axes."""
    figure_in = ax.get_figure(root=True).get_size_inches()  # type: ignore[union-attr]
    box = ax.get_position()
    size_in = (box.width * figure_in[0], box.height * figure_in[1])
    scale = max((high[k] - low[k]) / size_in[k] for k in range(2))
    middle = [0.5 * (low[k] + high[k]) for k in range(2)]
    ax.set_xlim(middle[0] - 0.5 * scale * size_in[0], middle[0] + 0.5 * scale * size_in[0])
    ax.set_ylim(middle[1] - 0.5 * scale * size_in[1], middle[1] + 0.5 * scale * size_in[1])


def column_panels(figure: Figure, rows: int = 1, columns: int = 1, **margins: Any) -> list[list[Axes]]:
    """``panels`` with the margins of a column; those given have priority."""
    usual: dict[str, Any] = {
        "left_in": 0.42,
        "right_in": 0.07,
        "top_in": 0.2,
        "bottom_in": 0.34,
        "gap_in": (0.24, 0.42),
    }
    return panels(figure, rows, columns, **(usual | margins))


def no_axes(ax: Axes) -> None:
    """Takes ticks, grid and frame away."""
    ax.set(xticks=[], yticks=[])
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)


def legend_above(axes: Axes, columns: int = 6, handles: Sequence[Any] | None = None) -> None:
    """A legend in one row at the upper right, outside the data."""
    given = {} if handles is None else {"handles": list(handles)}
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.015), ncols=columns, **given)


def png_bytes(figure: Figure, dpi: int = DPI) -> bytes:
    """The figure as PNG on white with a palette of 256 colours; the same figure gives the same bytes."""
    figure.set_dpi(dpi)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    stream = io.BytesIO()
    image.quantize(256, dither=Image.Dither.NONE).save(stream, "png", dpi=(dpi, dpi))
    return stream.getvalue()


def svg_bytes(figure: Figure, dpi: int = DPI) -> bytes:
    """The figure as SVG without a background; the same figure gives the same bytes."""
    stream = io.BytesIO()
    figure.set_dpi(dpi)  # of what is drawn as pixels inside the SVG
    canvas: Any = FigureCanvasSVG(figure)
    canvas.print_svg(stream, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return stream.getvalue()


def save(figure: Figure, folder: Path, name: str, dpi: int = DPI) -> None:
    """Writes ``name.svg`` and ``name.png``."""
    (folder / f"{name}.svg").write_bytes(svg_bytes(figure, dpi))
    figure.set_facecolor("white")
    (folder / f"{name}.png").write_bytes(png_bytes(figure, dpi))


#: Lines of the drawn skeleton.
BONES = (
    ("pelvis", "neck"),
    ("neck", "head"),
    ("shoulder_l", "shoulder_r"),
    ("shoulder_l", "elbow_l"),
    ("elbow_l", "wrist_l"),
    ("shoulder_r", "elbow_r"),
    ("elbow_r", "wrist_r"),
)


@dataclass(frozen=True)
class RenderedHull:
    """A convex hull grown by a ball, and the colour to paint it in."""

    vertices_m: Floats  #: (m, 3) world [m]
    radius_m: float
    colour: tuple[float, float, float]


@dataclass(frozen=True)
class View:
    """An orthographic view: right, up and towards the viewer, each (3,) in the world."""

    right: Floats
    up: Floats
    toward: Floats

    def flat(self, points_m: Floats) -> Floats:
        """(n, 2) of (n, 3) world points [m]."""
        return np.asarray(points_m @ np.column_stack([self.right, self.up]))


def view_from(azimuth_rad: float, elevation_rad: float) -> View:
    """The view of someone who looks at the origin from there; z stays up on the page."""
    ca, sa, ce, se = np.cos(azimuth_rad), np.sin(azimuth_rad), np.cos(elevation_rad), np.sin(elevation_rad)
    return View(
        right=np.array([-sa, ca, 0.0]), up=np.array([-se * ca, -se * sa, ce]), toward=np.array([ce * ca, ce * sa, se])
    )


def _sphere(count: int = 64) -> Floats:
    """(count, 3) unit vectors spread evenly, by the golden angle."""
    k = np.arange(count) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.column_stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)])


def outline(vertices_m: Floats, radius_m: float, view: View) -> Floats:
    """(k, 2) the outline of hull + ball in a view, exact but for the circle's 36 corners [m]; empty without a hull."""
    if not np.isfinite(vertices_m).all():
        return np.zeros((0, 2))
    angle = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    circle = radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    flat = view.flat(vertices_m)
    cloud = (flat[:, None, :] + circle).reshape(-1, 2)
    hull = _hull(cloud)
    return np.zeros((0, 2)) if hull is None else np.asarray(cloud[hull.vertices])


def render_hulls(solids: Sequence[RenderedHull], view: View, low: Floats, high: Floats, pixel_m: float) -> Floats:
    """What a viewer sees of solids that may intersect: each pixel shows the frontmost surface, lit from above.

    Args:
        solids: Hulls with their balls and colours.
        view: From where.
        low: (2,) lower left corner of the picture in the view [m].
        high: (2,) upper right corner [m].
        pixel_m: Edge of a pixel [m].

    Returns:
        (rows, columns, 4) colours and opacity in [0, 1], the first row at the bottom.
    """
    u = np.arange(low[0] + 0.5 * pixel_m, high[0], pixel_m)
    v = np.arange(low[1] + 0.5 * pixel_m, high[1], pixel_m)
    image = np.zeros((len(v), len(u), 4))
    nearest = np.full((len(v), len(u)), -np.inf)
    sun = view.toward + 0.9 * view.up - 0.6 * view.right
    for solid in solids:
        hull = _hull(_cloud(solid.vertices_m, solid.radius_m))
        if hull is None:
            continue
        normals = hull.equations @ np.vstack(
            [np.column_stack([view.right, view.up, view.toward, sun]), np.zeros((1, 4))]
        )
        flat = view.flat(hull.points[hull.vertices])
        rows = slice(*np.searchsorted(v, [flat[:, 1].min(), flat[:, 1].max()]))
        columns = slice(*np.searchsorted(u, [flat[:, 0].min(), flat[:, 0].max()]))
        depth, light = visible_front(normals, hull.equations[:, 3].copy(), u[columns], v[rows])
        ahead = depth > nearest[rows, columns]
        shade = (0.62 + 0.38 * np.clip(light / np.linalg.norm(sun), 0.0, 1.0))[..., None] * np.asarray(solid.colour)
        nearest[rows, columns][ahead] = depth[ahead]
        image[rows, columns, :3][ahead] = shade[ahead]
        image[rows, columns, 3][ahead] = 1.0
    return image


def draw_solids(
    ax: Axes,
    solids: Sequence[RenderedHull],
    view: View,
    low: Floats,
    high: Floats,
    *,
    pixels: int,
    opacity: float = 1.0,
) -> None:
    """Draws solids as a viewer sees them, each with a thin line around it.

    Args:
        ax: To draw on.
        solids: Hulls with their balls and colours.
        view: From where.
        low: (2,) lower left corner of the picture in the axes, which need not be their window [m].
        high: (2,) upper right corner [m].
        pixels: Height of the picture.
        opacity: In [0, 1].
    """
    image = render_hulls(solids, view, low, high, float(high[1] - low[1]) / pixels)
    image[..., 3] *= opacity
    limits = ax.get_xlim(), ax.get_ylim()
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    ax.imshow(image, origin="lower", extent=extent, aspect="auto", interpolation="bilinear", zorder=2)
    ax.set(xlim=limits[0], ylim=limits[1])
    for solid in solids:
        edge = outline(solid.vertices_m, solid.radius_m, view)
        if len(edge):
            ax.add_patch(Polygon(edge, fill=False, edgecolor=solid.colour, lw=0.5, alpha=0.7, zorder=3))


def draw_outlines(ax: Axes, limbs: Mapping[str, tuple[Floats, float]], view: View) -> None:
    """Swept volumes in pale colour behind all else: limb -> (m, 3) vertices, world, and radius [m]."""
    for limb, (vertices, radius) in limbs.items():
        edge = outline(vertices, radius, view)
        if len(edge):
            colour = LIMBS.get(limb, FAINT)
            ax.add_patch(Polygon(edge, facecolor=colour, alpha=0.15, lw=0, zorder=0))
            ax.add_patch(Polygon(edge, fill=False, edgecolor=colour, lw=0.5, alpha=0.8, zorder=0))


def bounds_of(edges: Sequence[Floats], margin_m: float) -> tuple[Floats, Floats]:
    """Corners (2,) of the box around flat points (k, 2), with a margin [m]; those that are not known are left out."""
    corners = np.vstack([np.zeros((0, 2)), *edges])
    corners = corners[np.isfinite(corners).all(axis=1)]
    return corners.min(axis=0) - margin_m, corners.max(axis=0) + margin_m


def _cloud(vertices_m: Floats, radius_m: float) -> Floats:
    return (np.asarray(vertices_m)[:, None, :] + radius_m * _sphere()).reshape(-1, 3)


def _hull(points: Floats) -> ConvexHull | None:
    try:
        return ConvexHull(points)
    except (QhullError, ValueError):  # NaN, or flat
        return None


def bones(points_m: Floats, view: View) -> list[Floats]:
    """Each (2, 2): the lines of a (20, 3) skeleton in a view [m]; those with a missing end are left out."""
    ends = [points_m[[POINTS.index(a), POINTS.index(b)]] for a, b in BONES]
    return [view.flat(pair) for pair in ends if np.isfinite(pair).all()]
