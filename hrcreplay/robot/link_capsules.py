"""Link segments: small capsules that enclose the links of a robot, fitted to the collision shapes of its URDF."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from hrcreplay.errors import SettingsError
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class MeshSurface:
    """The triangles of a collision mesh, for drawing only; all computations use the capsule around them."""

    vertices_m: Floats  #: (k, 3) in the frame of the segment's body [m]
    triangles: Ints  #: (t, 3) indices of vertices


@dataclass(frozen=True)
class Segment:
    """A capsule around one link, with the axis of Eq. (4). Both ends are on one body, as Eq. (5) requires.

    ``LinkSettings`` is the same capsule in the settings; this class adds the collision shape it is fitted to.
    """

    name: str
    body: str  #: URDF link or joint whose frame the ends are given in
    start_m: Vector  #: first end in the body's frame [m]
    end_m: Vector  #: second end in the body's frame [m]
    radius_m: float
    shape_m3: float = math.nan  #: volume of the enclosed collision shape's convex hull; NaN for a given capsule [m^3]
    surface: MeshSurface | None = field(default=None, compare=False, repr=False)  #: the mesh it is fitted to

    @property
    def volume_m3(self) -> float:
        """Volume of the capsule [m^3]."""
        return capsule_m3(math.dist(self.start_m, self.end_m), self.radius_m)


#: Ends are rounded to 0.1 mm and the radius is rounded up to 0.1 mm: rounding errors of the search rarely change them.
_DECIMALS = 4


def fit(points_m: Floats) -> tuple[Floats, Floats, float]:
    """Fits a capsule of small volume that encloses the points.

    Runs Nelder and Mead's simplex search over direction and position of the axis and over the radius, once from each
    principal axis of the points. The ends are then placed as near to each other as the points allow. At last the
    radius is set so that it encloses every point.

    Args:
        points_m: (n, 3) [m].

    Returns:
        Both ends (3,) and the radius [m].
    """
    corners, centre = _corners(points_m), np.asarray(points_m).mean(axis=0)
    axes = np.linalg.eigh((corners - centre).T @ (corners - centre))[1].T
    size = float(np.linalg.norm(np.ptp(corners, axis=0))) or 1.0
    shapes = [(corners, centre, np.roll(axes, -first, axis=0), size) for first in range(3)]
    simplex = 0.15 * np.vstack([np.zeros(5), np.eye(5)])
    coarse = [_search(shape, simplex, 200) for shape in shapes]
    best = min(range(3), key=lambda i: float(coarse[i].fun))
    fine = _search(shapes[best], coarse[best].x + 0.3 * simplex, 400)  # the first simplex may have degenerated
    line, low, high, _ = _on_axis(fine.x, *shapes[best])
    start, end = line[0] + low * line[1], line[0] + high * line[1]
    start, end = np.round(start, _DECIMALS), np.round(end, _DECIMALS)
    steps = math.floor(float(distance_m(corners, start, end).max()) * 10**_DECIMALS) + 1
    return start, end, steps / 10**_DECIMALS


def distance_m(points_m: Floats, start_m: Floats, end_m: Floats) -> Floats:
    """(n,) distance of (n, 3) points from a segment [m]."""
    along = end_m - start_m
    share = np.clip((points_m - start_m) @ along / max(float(along @ along), 1e-300), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points_m - start_m - share[:, None] * along, axis=1))


def capsule_m3(length_m: float, radius_m: float) -> float:
    """Volume of a capsule whose axis is ``length_m`` long [m^3]."""
    return math.pi * radius_m**2 * (length_m + 4.0 / 3.0 * radius_m)


def hull_m3(points_m: Floats) -> float:
    """Volume of the convex hull of (n, 3) points; 0 where they lie in a plane [m^3]."""
    try:
        return float(ConvexHull(points_m).volume)
    except (QhullError, ValueError):
        return 0.0


def _corners(points_m: Floats) -> Floats:
    """Vertices of the convex hull, or the points themselves if they lie in a plane. Enclosing them encloses all."""
    points = np.unique(points_m, axis=0)
    try:
        return points[np.sort(ConvexHull(points).vertices)]
    except (QhullError, ValueError):
        return points


def _search(shape: tuple[Floats, Floats, Floats, float], simplex: Floats, iterations: int) -> Any:
    from scipy.optimize import minimize  # the import takes 0.5 s; live helper processes do not need it

    options = {"initial_simplex": simplex, "xatol": 1e-5, "fatol": 0.0, "maxiter": iterations, "maxfev": 2 * iterations}
    return minimize(_volume, simplex[0], shape, "Nelder-Mead", options=options)


def _volume(x: Floats, corners: Floats, centre: Floats, frame: Floats, size: float) -> float:
    """Volume divided by the cube of the points' size, so that the search stops alike for large and small shapes."""
    _, low, high, radius = _on_axis(x, corners, centre, frame, size)
    return capsule_m3(high - low, radius) / size**3


@njit(cache=True)
def _on_axis(
    x: Floats, corners: Floats, centre: Floats, frame: Floats, size: float
) -> tuple[Floats, float, float, float]:
    """The shortest capsule on one axis: direction x[0:2], position x[2:4], smallest radius if x[4] is zero.

    Returns:
        Origin and direction of the axis (2, 3), positions of the capsule's two ends along it, and the radius.
    """
    line = np.empty((2, 3))
    line[0] = centre + size * (x[2] * frame[1] + x[3] * frame[2])
    line[1] = frame[0] + x[0] * frame[1] + x[1] * frame[2]
    line[1] /= math.sqrt((line[1] * line[1]).sum())
    count = len(corners)
    along, off2 = np.empty(count), np.empty(count)
    (ox, oy, oz), (ax, ay, az) = line
    for i in range(count):
        dx, dy, dz = corners[i, 0] - ox, corners[i, 1] - oy, corners[i, 2] - oz
        along[i] = dx * ax + dy * ay + dz * az
        off2[i] = max(dx * dx + dy * dy + dz * dz - along[i] * along[i], 0.0)
    radius2 = off2.max() * (1.0 + x[4] * x[4])
    low, high = math.inf, -math.inf
    for i in range(count):
        half = math.sqrt(radius2 - off2[i])  # a ball centred within this distance of the corner's foot encloses it
        low, high = min(low, along[i] + half), max(high, along[i] - half)
    if low > high:  # one ball is enough
        low = high = 0.5 * (low + high)
    return line, low, high, math.sqrt(radius2)


KINDS = ("box", "capsule", "cylinder", "mesh", "sphere")


@dataclass(frozen=True)
class Shape:
    """One collision shape of a link in the URDF."""

    name: str  #: name of the link, with a number if the link has several shapes
    link: str
    collision: ET.Element
    geometry: ET.Element  #: <box>, <capsule>, <cylinder>, <mesh> or <sphere>

    @property
    def kind(self) -> str:
        """One of KINDS, or the unknown tag that the URDF contains."""
        return self.geometry.tag

    @property
    def mesh(self) -> str | None:
        """File name of a mesh; None for other shapes."""
        return self.geometry.get("filename", "") if self.kind == "mesh" else None


@dataclass(frozen=True)
class Extent:
    """Extent of a collision shape in the link's frame.

    For a box or a mesh, the convex hull of the points. For a capsule, a cylinder or a sphere, the radius around the
    axis between two points.
    """

    points_m: Floats  #: (n, 3) corners or vertices, or (2, 3) ends of the axis [m]
    radius_m: float  #: 0 for box and mesh [m]
    triangles: Ints | None = None  #: (t, 3) indices of the vertices of a mesh; None for other shapes


def shapes(links: Sequence[ET.Element]) -> tuple[Shape, ...]:
    """The collision shapes of links."""
    found = []
    for link in links:
        name = str(link.get("name"))
        collisions = link.findall("collision")
        for number, collision in enumerate(collisions, start=1):
            holder = collision.find("geometry")
            geometry = next(iter(holder), None) if holder is not None else None
            shape = ET.Element("nothing") if geometry is None else geometry
            found.append(Shape(name if len(collisions) == 1 else f"{name}_{number}", name, collision, shape))
    return tuple(found)


def capsules(found: Sequence[Shape], extents: Mapping[str, Extent]) -> tuple[Segment, ...]:
    """Fits a capsule around every shape and gives it the name of the shape.

    Args:
        found: Collision shapes.
        extents: Name of each shape -> its extent.

    Raises:
        SettingsError: There is no shape, or a shape has no size.
    """
    if not found:
        raise SettingsError("robot: no moving link of the URDF has a collision shape; give its capsules in robot.links")
    return tuple(_around(shape, extents[shape.name]) for shape in found)


def _around(shape: Shape, extent: Extent) -> Segment:
    points_m, radius_m = extent.points_m, extent.radius_m
    if not len(points_m) or not np.isfinite(points_m).all():
        raise SettingsError(f"robot: the {shape.kind} of link {shape.link!r} has no size; check its vertices")
    if shape.kind in ("box", "mesh"):
        start, end, radius_m = fit(points_m)
        inside_m3 = hull_m3(points_m)
    else:
        start, end = points_m
        length_m = math.dist(start, end)
        inside_m3 = math.pi * radius_m**2 * length_m if shape.kind == "cylinder" else capsule_m3(length_m, radius_m)
    ends = [(float(x), float(y), float(z)) for x, y, z in (start, end)]
    surface = None if extent.triangles is None else MeshSurface(points_m, extent.triangles)
    return Segment(shape.name, shape.link, ends[0], ends[1], radius_m, inside_m3, surface)
