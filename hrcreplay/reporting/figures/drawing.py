"""Shared drawing functions: figure style, panels and export.

The colours are distinguishable for readers with colour vision deficiency.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image

from hrcreplay.records import OF_PERSON, Floats

# Okabe and Ito's palette.
ORANGE, SKY, GREEN, YELLOW = "#E69F00", "#56B4E9", "#009E73", "#F0E442"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"

#: Colours of text and axes; the page replaces both in its dark mode.
INK, FAINT = "#25313c", "#8b98a5"
GRID = "#dfe5ea"

NOMINAL, ACTUAL, FUSED, TRUTH = BLUE, VERMILLION, BLUE, INK
CAMERAS = (ORANGE, GREEN, PURPLE, SKY)
STATUS = {"tracking": SKY, "limited": ORANGE, "braking": VERMILLION, "retreating": PURPLE}
LIMBS = {"HD": PURPLE, "THX": "#9aa5b1", "URA": BLUE, "LRA": SKY, "ULA": GREEN, "LLA": ORANGE, "LEGS": YELLOW}


def limb_colour(name: str) -> str:
    """Returns the colour of a limb of any person."""
    return LIMBS.get(name.partition(OF_PERSON)[0], FAINT)


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
    "pdf.fonttype": 42,
}

#: Settings that differ in one column of a two-column paper.
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
#: Width of one column of a two-column paper, and its resolution [dpi].
COLUMN_IN = 3.5
COLUMN_DPI = 300


def style(*, column: bool = False) -> Any:
    """Returns a context in which figures are made and saved, for the page's width or a paper's column."""
    return mpl.rc_context(cast("Any", COLUMN_STYLE if column else STYLE))


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """Makes an empty figure of the page's width."""
    return Figure(figsize=(width_in, height_in))


def column_figure(height_in: float) -> Figure:
    """Makes an empty figure of one column of a two-column paper."""
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
    """Makes a grid of axes with margins in inches; unlike with a layout engine, no second drawing is needed.

    Args:
        figure: Figure to draw on.
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
    """Sets limits that show at least the box from ``low`` to ``high`` with one scale for both axes."""
    size = figure_in(ax)
    box = ax.get_position()
    size_in = (box.width * size[0], box.height * size[1])
    scale = max((high[k] - low[k]) / size_in[k] for k in range(2))
    middle = [0.5 * (low[k] + high[k]) for k in range(2)]
    ax.set_xlim(middle[0] - 0.5 * scale * size_in[0], middle[0] + 0.5 * scale * size_in[0])
    ax.set_ylim(middle[1] - 0.5 * scale * size_in[1], middle[1] + 0.5 * scale * size_in[1])


def figure_in(ax: Axes) -> Floats:
    """(2,) width and height of an axes' figure [in]."""
    return np.asarray(ax.get_figure(root=True).get_size_inches())  # type: ignore[union-attr]


def column_panels(figure: Figure, rows: int = 1, columns: int = 1, **margins: Any) -> list[list[Axes]]:
    """``panels`` with the margins of a column.

    Args:
        figure: Figure to draw on.
        rows: Rows of axes.
        columns: Columns of axes.
        margins: Other arguments of ``panels``; they have priority.
    """
    usual: dict[str, Any] = {
        "left_in": 0.48,
        "right_in": 0.14,
        "top_in": 0.2,
        "bottom_in": 0.34,
        "gap_in": (0.24, 0.5),
    }
    grid = panels(figure, rows, columns, **(usual | margins))
    for ax in grid[-1] if columns > 1 else ():
        ax.xaxis.set_major_locator(MaxNLocator(3))
    return grid


def no_axes(ax: Axes) -> None:
    """Removes ticks, grid and frame."""
    ax.set(xticks=[], yticks=[])
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)


def legend_above(axes: Axes, columns: int = 6, handles: Sequence[Any] | None = None) -> None:
    """Adds a legend in one row at the upper right, outside the data."""
    given = {} if handles is None else {"handles": list(handles)}
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.015), ncols=columns, **given)


def png_bytes(figure: Figure, dpi: int = DPI) -> bytes:
    """Returns the figure as PNG on white; the same figure gives the same bytes."""
    figure.set_dpi(dpi)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    stream = io.BytesIO()
    image.save(stream, "png", dpi=(dpi, dpi), compress_level=4)  # a palette takes more time and loses pale colours
    return stream.getvalue()


def svg_bytes(figure: Figure, dpi: int = DPI) -> bytes:
    """Returns the figure as SVG without a background; the same figure gives the same bytes."""
    stream = io.BytesIO()
    figure.set_dpi(dpi)  # resolution of bitmaps inside the SVG
    canvas: Any = FigureCanvasSVG(figure)
    canvas.print_svg(stream, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return stream.getvalue()


def pdf_bytes(figure: Figure, dpi: int = DPI) -> bytes:
    """Returns the figure as PDF with text that can be searched; the same figure gives the same bytes."""
    stream = io.BytesIO()
    figure.set_dpi(dpi)  # resolution of bitmaps inside the PDF
    canvas: Any = FigureCanvasPdf(figure)
    canvas.print_pdf(stream, metadata={"CreationDate": None, "Creator": None, "Producer": None})
    return stream.getvalue()


def save(figure: Figure, folder: Path, name: str, dpi: int = DPI, *, pdf: bool = False) -> None:
    """Writes ``name.svg`` and ``name.png``, and ``name.pdf`` if asked to.

    Args:
        figure: Figure to write.
        folder: Folder for the files.
        name: Name of the files.
        dpi: Resolution of the PNG, and of bitmaps in the others.
        pdf: True: also as PDF, which takes as long as the two others.
    """
    (folder / f"{name}.svg").write_bytes(svg_bytes(figure, dpi))
    if pdf:
        (folder / f"{name}.pdf").write_bytes(pdf_bytes(figure, dpi))
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
