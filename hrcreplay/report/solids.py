"""Swept volumes as a viewer sees them: convex hulls grown by the limb's radius, in orthographic projection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from hrcreplay.records import POINTS, Floats

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
class Solid:
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


def picture(solids: Sequence[Solid], view: View, low: Floats, high: Floats, pixel_m: float) -> Floats:
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
        depth, light = _front(normals, hull.equations[:, 3], u[None, columns], v[rows, None])
        ahead = depth > nearest[rows, columns]
        shade = (0.62 + 0.38 * np.clip(light / np.linalg.norm(sun), 0.0, 1.0))[..., None] * np.asarray(solid.colour)
        nearest[rows, columns][ahead] = depth[ahead]
        image[rows, columns, :3][ahead] = shade[ahead]
        image[rows, columns, 3][ahead] = 1.0
    return image


def _cloud(vertices_m: Floats, radius_m: float) -> Floats:
    return (np.asarray(vertices_m)[:, None, :] + radius_m * _sphere()).reshape(-1, 3)


def _hull(points: Floats) -> ConvexHull | None:
    try:
        return ConvexHull(points)
    except (QhullError, ValueError):  # NaN, or flat
        return None


def _front(normals: Floats, offsets: Floats, u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Depth of the front of a convex solid at pixels, -inf beside it, and the light on the face there.

    A pixel's ray is inside between the last of the planes that face away and the first of those that face the viewer.
    """
    front = np.full(np.broadcast_shapes(u.shape, v.shape), np.inf)
    back = np.full(front.shape, -np.inf)
    light = np.zeros(front.shape)
    for (nu, nv, nt, lit), offset in zip(normals, offsets, strict=True):
        if abs(nt) < 1e-9:
            continue
        depth = (-offset / nt - (nu / nt) * u) - (nv / nt) * v
        if nt > 0:
            nearer = depth < front
            np.copyto(front, depth, where=nearer)
            np.copyto(light, lit, where=nearer)
        else:
            np.maximum(back, depth, out=back)
    return np.where(front >= back, front, -np.inf), light


def bones(points_m: Floats, view: View) -> list[Floats]:
    """Each (2, 2): the lines of a (20, 3) skeleton in a view [m]; those with a missing end are left out."""
    ends = [points_m[[POINTS.index(a), POINTS.index(b)]] for a, b in BONES]
    return [view.flat(pair) for pair in ends if np.isfinite(pair).all()]
