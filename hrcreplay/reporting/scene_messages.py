"""Parts of Foxglove's well-known messages, for the recorded scene and the live one."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from foxglove import messages
from scipy.spatial import ConvexHull

from hrcreplay.geometry.convex_hull import above, hull
from hrcreplay.records import FLOOR_Z_M, POINTS, Floats, Ints
from hrcreplay.reporting.figures.drawing import BONES

Rgba = tuple[float, float, float, float]

#: Frame of all entities.
WORLD = "world"
PERSON: Rgba = (0.10, 0.35, 0.85, 1.0)
VOLUME: Rgba = (0.95, 0.55, 0.10, 0.30)
ROBOT: Rgba = (0.95, 0.45, 0.05, 1.0)
_NS = 10**9
_BALL = 162  # number of directions in which a volume's surface is sampled


def colour(rgba: Rgba) -> Any:
    """Makes a colour."""
    r, g, b, a = rgba
    return messages.Color(r=r, g=g, b=b, a=a)


def points(points_m: Floats) -> list[Any]:
    """Makes (n, 3) points."""
    return [messages.Point3(x=x, y=y, z=z) for x, y, z in points_m.tolist()]


def pose(position_m: Floats, quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)) -> Any:
    """Makes a pose from position (3,) and quaternion (x, y, z, w)."""
    x, y, z = position_m.tolist()
    qx, qy, qz, qw = quaternion
    return messages.Pose(
        position=messages.Vector3(x=x, y=y, z=z), orientation=messages.Quaternion(x=qx, y=qy, z=qz, w=qw)
    )


def timestamp(t_ns: int) -> Any:
    """Makes a time stamp."""
    return messages.Timestamp(t_ns // _NS, t_ns % _NS)


def entity(t_ns: int, name: str, *, frame: str = WORLD, lasts_s: float = 0.0, **shapes: Any) -> Any:
    """Makes an entity of a scene, valid until its next update.

    Args:
        t_ns: Instant [ns].
        name: Name of the entity.
        frame: Frame of its shapes, with which it moves.
        lasts_s: Time after which it is gone without an update; 0: it stays [s].
        **shapes: Lists of primitives.
    """
    return messages.SceneEntity(
        timestamp=timestamp(t_ns),
        frame_id=frame,
        id=name,
        lifetime=messages.Duration(*divmod(round(lasts_s * _NS), _NS)) if lasts_s else None,
        frame_locked=frame != WORLD,
        **shapes,
    )


def lines(ends_m: Floats, thickness_m: float, rgba: Rgba) -> Any:
    """Makes (n, 2, 3) separate lines; those with an unknown end are left out."""
    known = ends_m[np.isfinite(ends_m).all(axis=(1, 2))]
    return messages.LinePrimitive(
        type=messages.LinePrimitiveLineType.LineList,
        thickness=thickness_m,
        points=points(known.reshape(-1, 3)),
        color=colour(rgba),
    )


def bones(points_m: Floats, rgba: Rgba = PERSON) -> Any:
    """Makes the skeleton of (20, 3) POINTS."""
    pairs = [[POINTS.index(a), POINTS.index(b)] for a, b in BONES]
    return lines(points_m[pairs], 0.02, rgba)


def capsule(ends_m: Floats, radius_m: float, rgba: Rgba) -> dict[str, Any]:
    """Makes the primitives of a capsule between two points, (2, 3) [m]."""
    return capsules(ends_m[None], np.array([radius_m]), rgba)


def capsules(ends_m: Floats, radius_m: Floats, rgba: Rgba) -> dict[str, Any]:
    """Makes the primitives of the known ones of some capsules, (n, 2, 3) and (n,) [m]."""
    known = np.isfinite(ends_m).all(axis=(1, 2))
    ends_m, wide_m, one_colour = ends_m[known], (2.0 * radius_m[known]).tolist(), colour(rgba)
    along, level = ends_m[:, 1] - ends_m[:, 0], messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    length_m = np.sqrt([one.dot(one) for one in along])
    balls = [
        messages.SpherePrimitive(
            pose=messages.Pose(position=messages.Vector3(x=x, y=y, z=z), orientation=level),
            size=messages.Vector3(x=size, y=size, z=size),
            color=one_colour,
        )
        for size, ends in zip(wide_m, ends_m.tolist(), strict=True)
        for x, y, z in ends
    ]
    middles = ((ends_m[:, 0] + ends_m[:, 1]) / 2.0).tolist()
    rods = [
        messages.CylinderPrimitive(
            pose=messages.Pose(
                position=messages.Vector3(x=x, y=y, z=z), orientation=messages.Quaternion(x=qx, y=qy, z=qz, w=qw)
            ),
            size=messages.Vector3(x=size, y=size, z=long),
            bottom_scale=1.0,
            top_scale=1.0,
            color=one_colour,
        )
        for size, long, (x, y, z), (qx, qy, qz, qw) in zip(
            wide_m, length_m.tolist(), middles, upright_to(along, length_m).tolist(), strict=True
        )
    ]
    return {"spheres": balls, "cylinders": rods}


def surface(vertices_m: Floats, radius_m: float, rgba: Rgba = VOLUME) -> Any:
    """Makes the surface of hull + ball above the floor, (m, 3) vertices [m]; empty without a volume."""
    corners, triangles = surface_mesh(vertices_m, radius_m)
    return messages.TriangleListPrimitive(
        points=points(np.round(corners, 3)), indices=triangles.ravel().tolist(), color=colour(rgba)
    )


def whole_surface(vertices_m: Floats, radius_m: float) -> tuple[Floats, Ints]:
    """Returns corners (k, 3) [m] and triangles (f, 3), outward, of an object: hull + ball, (m, 3) vertices [m]."""
    if radius_m > 0.0:
        vertices_m = (vertices_m[:, None, :] + radius_m * _around_a_ball()[0]).reshape(-1, 3)
    return hull(vertices_m)


def surface_mesh(vertices_m: Floats, radius_m: float) -> tuple[Floats, Ints]:
    """Returns corners (k, 3) [m] and triangles (f, 3) of hull + ball, (m, 3) vertices [m], above the floor.

    Each corner is the vertex with the largest extent along a direction, plus the ball's radius along it. The corners
    lie on the surface, so between them the drawing may be smaller than the volume, by millimetres.
    """
    if not len(vertices_m) or not np.isfinite(vertices_m).all():
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    directions, triangles = _around_a_ball()
    corners = vertices_m[np.argmax(directions @ vertices_m.T, axis=1)] + radius_m * directions
    return above(corners, triangles, FLOOR_Z_M) if corners[:, 2].min() < FLOOR_Z_M else (corners, triangles)


@cache
def _around_a_ball() -> tuple[Floats, Ints]:
    """Returns (162, 3) unit directions, spread by the golden angle, and (f, 3) triangles between them, outward."""
    k = np.arange(_BALL) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * k / _BALL), np.pi * (1.0 + np.sqrt(5.0)) * k
    unit = np.column_stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)])
    hull = ConvexHull(unit)
    triangles = hull.simplices.astype(np.int64)
    a, b, c = (unit[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    triangles[inward] = triangles[inward][:, ::-1]
    return unit, triangles


def upright_to(directions: Floats, lengths: Floats) -> Floats:
    """Returns the quaternions (n, 4), x y z w, that turn the z axis into directions (n, 3) of some lengths (n,).

    The identity for a direction of length 0.
    """
    found = np.zeros((len(directions), 4))
    found[:, 3] = 1.0
    x, y, z = (directions / np.where(lengths > 0.0, lengths, 1.0)[:, None]).T
    down = (lengths > 0.0) & (z < -1.0 + 1e-12)
    found[down] = 1.0, 0.0, 0.0, 0.0
    turned = (lengths > 0.0) & ~down
    w = np.sqrt(0.5 * (1.0 + z[turned]))
    found[turned, 0], found[turned, 1], found[turned, 3] = -y[turned] / (2.0 * w), x[turned] / (2.0 * w), w
    return found
