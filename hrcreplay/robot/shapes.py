"""Capsules around the collision shapes of a URDF's links.

Shapes are read here and not by pinocchio's geometry model: its parser knows no <capsule>, and a shape that it cannot
read is left out with a line on the terminal and no error. It reads the meshes (see ``model``).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np

from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.robot import capsule
from hrcreplay.robot.rotation import from_rpy
from hrcreplay.robot.segments import Segment

KINDS = ("box", "capsule", "cylinder", "mesh", "sphere")


@dataclass(frozen=True)
class Shape:
    """One collision shape of a link."""

    name: str  #: of the link; numbered where the link has several
    link: str
    collision: ET.Element
    geometry: ET.Element  #: <box>, <capsule>, <cylinder>, <mesh> or <sphere>

    @property
    def mesh(self) -> str | None:
        """The file that a mesh names."""
        return self.geometry.get("filename", "") if self.geometry.tag == "mesh" else None


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


def capsules(found: Sequence[Shape], vertices_m: Mapping[str, Floats]) -> tuple[Segment, ...]:
    """A capsule around every shape, named after it.

    Args:
        found: Collision shapes.
        vertices_m: Name of each mesh among them -> (n, 3) its vertices in the link's frame [m].

    Raises:
        SettingsError: There is none, or one of a kind that URDF does not have, or one without a size.
    """
    if not found:
        raise SettingsError("robot: no moving link of the URDF has a collision shape; give its capsules in robot.links")
    return tuple(
        _around(shape, vertices_m[shape.name]) if shape.mesh is not None else _primitive(shape) for shape in found
    )


def _around(shape: Shape, points_m: Floats) -> Segment:
    """The capsule around the convex hull of points in the link's frame."""
    if not len(points_m) or not np.isfinite(points_m).all():
        raise SettingsError(f"robot: the {shape.geometry.tag} of link {shape.link!r} has no size; check its vertices")
    start, end, radius = capsule.fit(points_m)
    return _segment(shape, start, end, radius, capsule.hull_m3(points_m))


def _primitive(shape: Shape) -> Segment:
    kind, half = shape.geometry.tag, np.zeros(3)
    if kind not in KINDS:
        raise SettingsError(
            f"robot: the collision shape of link {shape.link!r} is {kind}; capsules are derived from "
            f"{', '.join(KINDS)}, so give robot.links"
        )
    if kind == "box":
        sides = _floats(shape.geometry.get("size"))
        if not (np.isfinite(sides).all() and (sides > 0).all()):
            raise _no_size(shape)
        corners = itertools.product(*zip(-sides / 2, sides / 2, strict=True))
        return _around(shape, _placed(shape, np.array(list(corners))))
    radius = _measure(shape.geometry, "radius")
    half[2] = 0.0 if kind == "sphere" else _measure(shape.geometry, "length") / 2
    if not (math.isfinite(radius) and radius > 0 and 0 <= half[2] < math.inf):
        raise _no_size(shape)
    inside = math.pi * radius**2 * 2 * half[2] if kind == "cylinder" else capsule.capsule_m3(2 * half[2], radius)
    start, end = _placed(shape, np.array([-half, half]))
    return _segment(shape, start, end, radius, inside)


def _no_size(shape: Shape) -> SettingsError:
    return SettingsError(
        f"robot: the {shape.geometry.tag} of link {shape.link!r} has no size; give its measures in metres"
    )


def _segment(shape: Shape, start: Floats, end: Floats, radius: float, inside_m3: float) -> Segment:
    ends = [(float(x), float(y), float(z)) for x, y, z in (start, end)]
    return Segment(shape.name, shape.link, ends[0], ends[1], radius, inside_m3)


def _placed(shape: Shape, points: Floats) -> Floats:
    """(n, 3) points of the shape in the link's frame [m]."""
    origin = shape.collision.find("origin")
    turn = from_rpy(_floats(None if origin is None else origin.get("rpy")))
    return np.asarray(points @ turn.T + _floats(None if origin is None else origin.get("xyz")))


def _measure(geometry: ET.Element, key: str) -> float:
    try:
        return float(geometry.get(key, "nan"))
    except ValueError:
        return math.nan


def _floats(text: str | None) -> Floats:
    try:
        values = np.array([float(part) for part in text.split()] if text else [0.0, 0.0, 0.0])
    except ValueError as error:
        raise SettingsError(f"robot: {text!r} are no numbers; three are needed") from error
    if values.shape != (3,):
        raise SettingsError(f"robot: {text!r} are {len(values)} numbers; three are needed")
    return values
