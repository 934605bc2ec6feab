"""Robot and person as convex solids in orthographic projection: the storyboard of Fig. 15, 16, and link capsules."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.path import Path
from scipy.spatial import ConvexHull, QhullError

from hrcreplay.geometry.convex_hull import above, hull, visible_front
from hrcreplay.geometry.small_matrices import apply, multiply
from hrcreplay.records import FLOOR_Z_M, POINTS, Bools, Floats, Ints, SweptVolume
from hrcreplay.reporting.figures import drawing
from hrcreplay.reporting.figures.drawing import figure_in
from hrcreplay.reporting.metrics.series import thin_path
from hrcreplay.robot.control.static_obstacles import StaticHull


@dataclass(frozen=True)
class RenderedHull:
    """A convex hull extended by a ball, and its colour."""

    vertices_m: Floats  #: (m, 3) world [m]
    radius_m: float
    colour: tuple[float, float, float]
    floor_m: float = -math.inf  #: the part below this height is removed [m]

    @cached_property
    def surface(self) -> tuple[Floats, Ints]:
        """The hull with coarse balls around the true ones, in the form of ``hull``; empty if unknown."""
        return self._grown(_around_ball(64 if len(self.vertices_m) <= _FEW else 32))  # mostly inside the polytope

    def outline(self, view: View) -> Floats:
        """(k, 2) outline in a view, exact except for the 36 corners of circles [m]; empty without a hull."""
        if not np.isfinite(self.vertices_m).all():
            return np.zeros((0, 2))
        angle = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
        circle = np.column_stack([np.cos(angle), np.sin(angle)])
        cloud = (view.flat(self.vertices_m)[:, None, :] + self.radius_m * circle).reshape(-1, 2)
        if self.vertices_m[:, 2].min() - self.radius_m < self.floor_m:  # the edge on the floor may be the outermost one
            cloud = view.flat(self._grown(np.concatenate([circle @ [view.right, view.up], _sphere(64)]))[0])
        try:
            return np.asarray(cloud[ConvexHull(cloud).vertices])
        except (QhullError, ValueError):  # flat or empty
            return np.zeros((0, 2))

    def _grown(self, ball: Floats) -> tuple[Floats, Ints]:
        """Returns the hull of the vertices with points of the unit ball (k, 3) around each, above the floor."""
        if not np.isfinite(self.vertices_m).all():
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        corners, faces = hull((self.vertices_m[:, None, :] + self.radius_m * ball).reshape(-1, 3))
        return above(corners, faces, self.floor_m) if corners[:, 2].min() < self.floor_m else (corners, faces)


@dataclass(frozen=True)
class RenderedSolid:
    """A convex solid by its surface, and its colour."""

    surface: tuple[Floats, Ints]  #: (k, 3) corners in the world [m] and (t, 3) outward triangles
    colour: tuple[float, float, float]

    @property
    def vertices_m(self) -> Floats:
        """(k, 3) its corners, world [m]."""
        return self.surface[0]

    def outline(self, view: View) -> Floats:
        """(k, 2) outline in a view [m]; empty without a hull."""
        cloud = view.flat(self.vertices_m)
        try:
            return np.asarray(cloud[ConvexHull(cloud).vertices])
        except (QhullError, ValueError):  # flat, or not known
            return np.zeros((0, 2))


@dataclass(frozen=True)
class View:
    """An orthographic view: right, up and towards the viewer, each (3,) in the world."""

    right: Floats
    up: Floats
    toward: Floats

    def flat(self, points_m: Floats) -> Floats:
        """Projects (n, 3) world points to (n, 2) [m]."""
        return multiply(np.asarray(points_m, dtype=float).reshape(-1, 3), np.column_stack([self.right, self.up]))


def view_from(azimuth_rad: float, elevation_rad: float) -> View:
    """Returns the view of the origin from a direction; z points up on the page."""
    ca, sa, ce, se = (turn(angle) for angle in (azimuth_rad, elevation_rad) for turn in (math.cos, math.sin))
    return View(
        right=np.array([-sa, ca, 0.0]), up=np.array([-se * ca, -se * sa, ce]), toward=np.array([ce * ca, ce * sa, se])
    )


#: From above, x to the right.
ABOVE = View(right=np.array([1.0, 0.0, 0.0]), up=np.array([0.0, 1.0, 0.0]), toward=np.array([0.0, 0.0, 1.0]))

#: Resolution of solids in a figure [dpi].
SOLIDS_DPI = 200
#: Maximum number of vertices of a hull that gets rounder corners.
_FEW = 8


def _sphere(count: int) -> Floats:
    """(count, 3) unit vectors spread evenly, by the golden angle."""
    k = np.arange(count) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.column_stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)])


@lru_cache
def _around_ball(count: int) -> Floats:
    """(count, 3) corners of a polytope around the unit ball."""
    corners = _sphere(count)
    return np.asarray(corners / -ConvexHull(corners).equations[:, 3].max())


def _within(edge: Floats, u: Floats, v: Floats) -> Bools:
    """(len(v), len(u)) True for the points of a grid inside an outline (k, 2)."""
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return np.asarray(Path(edge).contains_points(grid)).reshape(len(v), len(u))


def render_hulls(
    solids: Sequence[RenderedHull | RenderedSolid],
    view: View,
    low: Floats,
    high: Floats,
    pixel_m: float,
    beyond_m: float = 0.0,
) -> Floats:
    """Renders solids that may intersect: each pixel shows the frontmost surface, lit from above.

    A hull with its ball ends at its exact outline.

    Args:
        solids: Hulls with their balls and colours.
        view: The view.
        low: (2,) lower left corner of the picture in the view [m].
        high: (2,) upper right corner [m].
        pixel_m: Edge of a pixel [m].
        beyond_m: Distance by which hulls go beyond their outlines, for a picture that is cut there [m].

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
        corners, faces = solid.surface
        if not len(faces):
            continue
        triangles = multiply(corners, axes)[faces]
        across = np.cross(*(triangles[:, k] - triangles[:, 0] for k in (1, 2)))
        normals = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        low_uv, high_uv = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        rows = slice(*np.searchsorted(v, [low_uv[1], high_uv[1]]))
        columns = slice(*np.searchsorted(u, [low_uv[0], high_uv[0]]))
        depth, light = visible_front(triangles, apply(normals, multiply(sun[None], axes)[0]), u[columns], v[rows])
        ahead = depth > nearest[rows, columns]
        if isinstance(solid, RenderedHull):
            edge = replace(solid, radius_m=solid.radius_m + beyond_m).outline(view)
            ahead &= _within(edge, u[columns], v[rows]) if len(edge) else False
        shade = (0.62 + 0.38 * np.clip(light / np.linalg.norm(sun), 0.0, 1.0))[..., None] * np.asarray(solid.colour)
        nearest[rows, columns][ahead] = depth[ahead]
        image[rows, columns, :3][ahead] = shade[ahead]
        image[rows, columns, 3][ahead] = 1.0
    return image


def draw_solids(
    ax: Axes, solids: Sequence[RenderedHull], view: View, *, opacity: float = 1.0, line: float = 0.7
) -> None:
    """Draws solids in a view, each with a thin outline, on axes whose window is set.

    Args:
        ax: Axes to draw on.
        solids: Hulls with their balls and colours.
        view: The view.
        opacity: Opacity of the surfaces, in [0, 1].
        line: Opacity of the outlines, which also show hidden solids.
    """
    edges = [solid.outline(view) for solid in solids]
    if not any(len(edge) for edge in edges):
        return
    low, high = bounds_of(edges, 0.01)
    window_m, height_in = np.diff(ax.get_ylim())[0], ax.get_position().height * figure_in(ax)[1]
    pixel_m = float(window_m) / (SOLIDS_DPI * height_in)
    image = render_hulls(solids, view, low, high, pixel_m, 2.0 * pixel_m)
    image[..., 3] *= opacity
    limits = ax.get_xlim(), ax.get_ylim()
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    picture = ax.imshow(image, origin="lower", extent=extent, aspect="auto", interpolation="bilinear", zorder=2)
    closed = [Path(np.vstack([edge, edge[:1]]), closed=True) for edge in edges if len(edge)]
    picture.set_clip_path(Path.make_compound_path(*closed), ax.transData)  # a border without steps
    ax.set(xlim=limits[0], ylim=limits[1])
    known = [(edge, solid.colour) for solid, edge in zip(solids, edges, strict=True) if len(edge)]
    polygons = PolyCollection([edge for edge, _ in known], facecolors="none", zorder=3)
    polygons.set(edgecolors=[colour for _, colour in known], linewidths=0.5, alpha=line)
    ax.add_collection(polygons, autolim=False)


def volume_solids(limbs: Mapping[str, SweptVolume], moved_m: Floats | None = None) -> list[RenderedHull]:
    """Returns coloured swept volumes above the floor, in the world [m].

    Args:
        limbs: Volumes to draw.
        moved_m: (3,) position of the drawing's origin in the world; None: the world's origin [m].
    """
    origin = np.zeros(3) if moved_m is None else moved_m
    return [
        RenderedHull(v - origin, r, to_rgb(drawing.limb_colour(limb)), FLOOR_Z_M - float(origin[2]))
        for limb, (v, r) in limbs.items()
    ]


def draw_outlines(ax: Axes, limbs: Mapping[str, SweptVolume], view: View) -> None:
    """Swept volumes in pale colour behind all else."""
    edges = [(solid.colour, solid.outline(view)) for solid in volume_solids(limbs)]
    colours = [colour for colour, edge in edges if len(edge)]
    for look in ({"facecolors": colours, "alpha": 0.15, "linewidths": 0.0}, {"edgecolors": colours, "alpha": 0.8}):
        known = [edge for _, edge in edges if len(edge)]
        polygons = PolyCollection(known, facecolors="none", linewidths=0.5, zorder=0)
        polygons.set(**look)
        ax.add_collection(polygons, autolim=False)


def draw_objects(ax: Axes, objects: Sequence[StaticHull], view: View) -> None:
    """Objects of the cell in pale grey behind all else."""
    if not objects:
        return  # an empty collection would change the bytes of figures without objects
    edges = [RenderedHull(one.vertices_m, one.radius_m, (0.0, 0.0, 0.0)).outline(view) for one in objects]
    polygons = PolyCollection([edge for edge in edges if len(edge)], facecolors=drawing.FAINT, zorder=-1)
    polygons.set(edgecolors=drawing.INK, alpha=0.25, linewidths=0.5)
    ax.add_collection(polygons, autolim=False)


def bounds_of(edges: Iterable[Floats], margin_m: float) -> tuple[Floats, Floats]:
    """Returns the corners (2,) of the box around points (k, 2), with a margin [m]; unknown points are left out."""
    known = (points[np.isfinite(points).all(axis=1)] for points in edges)
    ends = [np.stack([points.min(axis=0), points.max(axis=0)]) for points in known if len(points)]
    if not ends:
        return np.full(2, -margin_m), np.full(2, margin_m)
    corners = np.concatenate(ends)
    return corners.min(axis=0) - margin_m, corners.max(axis=0) + margin_m


def bones(points_m: Floats, view: View) -> list[Floats]:
    """Returns the lines (2, 2) of a (20, 3) skeleton in a view [m]; lines with a missing end are left out."""
    ends = [points_m[[POINTS.index(a), POINTS.index(b)]] for a, b in drawing.BONES]
    return [view.flat(pair) for pair in ends if np.isfinite(pair).all()]


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
    distance_m: float  #: distance between surfaces, NaN if unknown [m]
    bodies: tuple[str, ...]  #: link of each of the s capsules
    ends_m: Floats  #: (s, 2, 3) world [m]
    radius_m: Floats  #: (s,) [m]
    volumes: Mapping[str, SweptVolume]  #: by limb
    objects: Sequence[StaticHull] = ()  #: parts of the objects of the cell, without half-spaces


@dataclass(frozen=True)
class StoryScene:
    """One programmed instant, as the robot passed it alone and near the person."""

    programme_s: float
    t_ns: tuple[int, int]  #: times of passing: alone, near the person
    ends_m: tuple[Floats, Floats]  #: (s, 2, 3) each: capsules of the links, world
    tcp_m: tuple[Floats, Floats]  #: (n, 3) each: path of the TCP until then, world
    people_m: Sequence[Floats]  #: (20, 3) each: the fused people
    volumes: Mapping[str, SweptVolume]  #: of the people, by limb


@dataclass(frozen=True)
class Storyboard:
    """The same part of the programme without and with the person."""

    scenes: Sequence[StoryScene]
    radius_m: Floats  #: (s,) radii of the links' capsules
    base_m: Floats  #: (3,)
    reference_m: Floats  #: (n, 3) programmed path of the TCP in that part
    method: str
    objects: Sequence[StaticHull] = ()  #: parts of the objects of the cell, without half-spaces


def storyboard(story: Storyboard, t0_ns: int) -> Figure:
    """Fig. 15, Fig. 16: draws rows of the same programmed instant, on the left without the person, on the right with.

    Args:
        story: Storyboard to draw.
        t0_ns: Start of the run [ns].
    """
    person = np.mean([v.mean(axis=0) for scene in story.scenes for v, _ in scene.volumes.values()], axis=0)
    view = view_from(_beside(person, story.base_m), 0.2)
    arms = [solid.outline(view) for s in story.scenes for ends in s.ends_m for solid in _robot(ends, story)]
    bodies = [solid.outline(view) for scene in story.scenes for solid in volume_solids(scene.volumes)]
    low, high = bounds_of([*arms, *bodies], 0.02)
    robot_low = bounds_of(arms, 0.02)[0]
    low[1] = max(low[1], min(robot_low[1], float(view.flat(story.base_m[None])[0, 1]) - 0.05))  # legs are not needed
    wide_in = (drawing.COLUMN_IN - 0.1) / 2
    tall_in = wide_in * float(np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.5, 1.2))
    count = len(story.scenes)
    more_in = 0.14 if story.objects else 0.0  # for a second row of the legend
    figure = drawing.column_figure(count * (tall_in + 0.16) + 0.5 + more_in)
    grid = drawing.column_panels(
        figure, count, 2, left_in=0.03, right_in=0.03, top_in=0.34, bottom_in=0.32 + more_in, gap_in=(0.16, 0.04)
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
        *_object_handle(story.objects),
    ]
    columns = 3 if more_in else 5
    place = (0.5, 0.03 / height)
    figure.legend(handles=handles, loc="lower center", ncols=columns, bbox_to_anchor=place, columnspacing=0.8)
    return figure


def _object_handle(objects: Sequence[StaticHull]) -> list[Patch]:
    """Legend of the objects; nothing without them."""
    return [Patch(fc=drawing.FAINT, ec=drawing.INK, alpha=0.4, lw=0.5, label="objects")] if objects else []


def _robot(ends_m: Floats, story: Storyboard) -> list[RenderedHull]:
    """Draws the robot's links, from the ends (s, 2, 3) of their axes [m]."""
    return [RenderedHull(e, float(r), to_rgb(drawing.SKY)) for e, r in zip(ends_m, story.radius_m, strict=True)]


def _draw_scene(ax: Axes, scene: StoryScene, side: int, story: Storyboard, view: View) -> None:
    draw_objects(ax, story.objects, view)
    if side:
        draw_outlines(ax, scene.volumes, view)
        for pair in (pair for points_m in scene.people_m for pair in bones(points_m, view)):
            ax.plot(*pair.T, color=drawing.INK, lw=1.0, zorder=1)
    draw_solids(ax, _robot(scene.ends_m[side], story), view, line=0.4)
    ax.plot(*view.flat(thin_path(story.reference_m, 0.004)).T, color=drawing.NOMINAL, lw=0.9, zorder=4)
    driven = scene.tcp_m[side]
    ax.plot(*view.flat(thin_path(driven, 0.004)).T, color=drawing.ACTUAL, lw=1.1, zorder=5)
    ax.plot(*view.flat(driven[-1:]).T, "o", color=drawing.ACTUAL, ms=2.5, zorder=6)
    base = view.flat(story.base_m[None])
    ax.plot(*base.T, "s", color=drawing.INK, ms=3, zorder=4)


def _beside(person_m: Floats, base_m: Floats) -> float:
    """Returns the azimuth of a view with robot and person side by side [rad]."""
    return float(np.arctan2(person_m[1] - base_m[1], person_m[0] - base_m[0]) - 0.5 * np.pi)


def links(pose: LinkPose, t0_ns: int, T_world_base: Floats) -> Figure:
    """Draws the capsules from the side and from above, with outlines of the swept volumes.

    Args:
        pose: Capsules and volumes to draw.
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
        edges = [solid.outline(view) for solid in solids]
        low, high = bounds_of([*edges, view.flat(base_m[None])], _MARGIN_M)
        drawing.set_window(ax, low.tolist(), high.tolist())
        draw_objects(ax, pose.objects, view)
        draw_outlines(ax, pose.volumes, view)
        draw_solids(ax, solids, view)
        ax.plot(*view.flat(base_m[None]).T, "s", color=drawing.INK, ms=4, zorder=4)
    near = "" if np.isnan(pose.distance_m) else f", {pose.distance_m:.3f} m apart"
    side.set(title=f"At {(pose.t_ns - t0_ns) * 1e-9:.1f} s{near}", xlabel="across [m]", ylabel="up [m]")
    above.set(title="From above", xlabel="x [m]", ylabel="y [m]")
    handles = [Patch(color=colours[name], lw=0, label=name) for name in names]
    if pose.volumes:
        handles.append(Patch(facecolor=drawing.FAINT, alpha=0.3, lw=0, label="swept volumes"))
    handles += _object_handle(pose.objects)
    figure.legend(handles=handles, loc="lower center", ncols=4, bbox_to_anchor=(0.5, 0.03 / figure.get_figheight()))
    return figure
