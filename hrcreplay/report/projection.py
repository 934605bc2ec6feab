"""Convex solids, people's swept volumes among them, in orthographic projection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from scipy.spatial import ConvexHull, QhullError

from hrcreplay.geometry.convex_hull import visible_front
from hrcreplay.records import POINTS, Floats
from hrcreplay.report import drawing
from hrcreplay.report.drawing import figure_in


@dataclass(frozen=True)
class RenderedHull:
    """A convex hull grown by a ball, and the colour to paint it in."""

    vertices_m: Floats  #: (m, 3) world [m]
    radius_m: float
    colour: tuple[float, float, float]

    @cached_property
    def hull(self) -> ConvexHull | None:
        """The hull with balls of few corners; None where there is none."""
        balls = _sphere(64 if len(self.vertices_m) <= _FEW else 32)  # a polytope hides most of each ball
        return _hull((np.asarray(self.vertices_m)[:, None, :] + self.radius_m * balls).reshape(-1, 3))


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


#: Dots an inch of solids in a figure.
SOLIDS_DPI = 200
#: A hull of no more vertices gets rounder corners.
_FEW = 8


def _sphere(count: int) -> Floats:
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
    axes = np.column_stack([view.right, view.up, view.toward])
    for solid in solids:
        hull = solid.hull
        if hull is None:
            continue
        triangles = (hull.points @ axes)[hull.simplices]
        inward = np.einsum(
            "ij,ij->i", np.cross(*(triangles[:, k] - triangles[:, 0] for k in (1, 2))), hull.equations[:, :3] @ axes
        )
        triangles[inward < 0.0] = triangles[inward < 0.0][:, ::-1]  # qhull's corners are in no order
        low_uv, high_uv = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        rows = slice(*np.searchsorted(v, [low_uv[1], high_uv[1]]))
        columns = slice(*np.searchsorted(u, [low_uv[0], high_uv[0]]))
        depth, light = visible_front(triangles, hull.equations[:, :3] @ sun, u[columns], v[rows])
        ahead = depth > nearest[rows, columns]
        shade = (0.62 + 0.38 * np.clip(light / np.linalg.norm(sun), 0.0, 1.0))[..., None] * np.asarray(solid.colour)
        nearest[rows, columns][ahead] = depth[ahead]
        image[rows, columns, :3][ahead] = shade[ahead]
        image[rows, columns, 3][ahead] = 1.0
    return image


def draw_solids(
    ax: Axes, solids: Sequence[RenderedHull], view: View, *, opacity: float = 1.0, line: float = 0.7
) -> None:
    """Draws solids as a viewer sees them, each with a thin line around it, on axes whose window is set.

    Args:
        ax: To draw on.
        solids: Hulls with their balls and colours.
        view: From where.
        opacity: Of what is seen, in [0, 1].
        line: Opacity of the lines, which also show what is hidden.
    """
    edges = [outline(solid.vertices_m, solid.radius_m, view) for solid in solids]
    if not any(len(edge) for edge in edges):
        return
    low, high = bounds_of(edges, 0.01)
    window_m, height_in = np.diff(ax.get_ylim())[0], ax.get_position().height * figure_in(ax)[1]
    image = render_hulls(solids, view, low, high, float(window_m) / (SOLIDS_DPI * height_in))
    image[..., 3] *= opacity
    limits = ax.get_xlim(), ax.get_ylim()
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    ax.imshow(image, origin="lower", extent=extent, aspect="auto", interpolation="bilinear", zorder=2)
    ax.set(xlim=limits[0], ylim=limits[1])
    known = [(edge, solid.colour) for solid, edge in zip(solids, edges, strict=True) if len(edge)]
    polygons = PolyCollection([edge for edge, _ in known], facecolors="none", zorder=3)
    polygons.set(edgecolors=[colour for _, colour in known], linewidths=0.5, alpha=line)
    ax.add_collection(polygons, autolim=False)


def draw_outlines(ax: Axes, limbs: Mapping[str, tuple[Floats, float]], view: View) -> None:
    """Swept volumes in pale colour behind all else: limb -> (m, 3) vertices, world, and radius [m]."""
    edges = {limb: outline(vertices, radius, view) for limb, (vertices, radius) in limbs.items()}
    known = {limb: edge for limb, edge in edges.items() if len(edge)}
    colours = [drawing.LIMBS.get(limb, drawing.FAINT) for limb in known]
    for look in ({"facecolors": colours, "alpha": 0.15, "linewidths": 0.0}, {"edgecolors": colours, "alpha": 0.8}):
        polygons = PolyCollection(list(known.values()), facecolors="none", linewidths=0.5, zorder=0)
        polygons.set(**look)
        ax.add_collection(polygons, autolim=False)


def bounds_of(edges: Sequence[Floats], margin_m: float) -> tuple[Floats, Floats]:
    """Corners (2,) of the box around flat points (k, 2), with a margin [m]; those that are not known are left out."""
    corners = np.vstack([np.zeros((0, 2)), *edges])
    corners = corners[np.isfinite(corners).all(axis=1)]
    if not len(corners):
        return np.full(2, -margin_m), np.full(2, margin_m)
    return corners.min(axis=0) - margin_m, corners.max(axis=0) + margin_m


def _hull(points: Floats) -> ConvexHull | None:
    try:
        return ConvexHull(points)
    except (QhullError, ValueError):  # NaN, or flat
        return None


def bones(points_m: Floats, view: View) -> list[Floats]:
    """Each (2, 2): the lines of a (20, 3) skeleton in a view [m]; those with a missing end are left out."""
    ends = [points_m[[POINTS.index(a), POINTS.index(b)]] for a, b in drawing.BONES]
    return [view.flat(pair) for pair in ends if np.isfinite(pair).all()]
