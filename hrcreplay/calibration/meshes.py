"""Meshes of objects: read by coal, and turned into convex parts of few points that enclose them."""

from __future__ import annotations

import math
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import coal
import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection

from hrcreplay.errors import SettingsError
from hrcreplay.geometry.convex_hull import CORNERS, DIRECTIONS, around, hull
from hrcreplay.records import Floats, Ints

#: File endings of meshes.
KINDS = (".stl", ".obj", ".dae", ".gltf", ".glb")
#: Largest mesh [bytes].
MOST_BYTES = 20 << 20
#: First bytes of packed files, which the library would unpack without a limit: zip, gzip, zstd.
_PACKED = (b"PK", b"\x1f\x8b", b"\x28\xb5\x2f\xfd")
#: The part of a Collada file in which its unit stands [bytes], and the unit.
_HEAD_BYTES = 1 << 16
_UNIT = re.compile(rb"<unit\b[^>]*?\bmeter\s*=\s*[\"']([^\"']*)[\"']")
#: A mesh is convex if its volume is at least this share of its hull's.
CONVEX = 0.99
#: Largest concavity of the parts of a decomposition: that of CoACD, relative to the size of the mesh.
_CONCAVITY = 0.05
#: Largest distance of a vertex from all parts of a decomposition, relative to the size of the mesh.
_MISSED = 2e-3


def unit_m(path: Path) -> float:
    """Length of a unit of a mesh [m]: what a Collada file says, which libraries do not apply; otherwise 1.

    Raises:
        ValueError: The file gives no length.
    """
    if path.suffix.lower() != ".dae":
        return 1.0
    with path.open("rb") as file:
        said = _UNIT.search(file.read(_HEAD_BYTES))
    length = 1.0 if said is None else float(said[1])
    if not (math.isfinite(length) and length > 0.0):
        raise ValueError(f"its unit is {length} m")
    return length


def read_parts(
    path: Path, scale: float | None, if_concave: str, at: str, *, most_parts: int, most_vertices: int
) -> list[Floats]:
    """Reads a mesh as convex parts, each of few points (m, 3) that enclose it [m].

    Args:
        path: STL, OBJ, Collada or glTF. The axes are those of the file.
        scale: Metres per unit of the file; None: as the file says, see ``unit_m``.
        if_concave: ``refuse``, ``hull`` or ``decompose``.
        at: Prefix of error messages.
        most_parts: Largest number of parts.
        most_vertices: Largest number of points of a part.

    Raises:
        SettingsError: The file cannot be read, or the mesh is not convex and that is refused.
    """
    vertices, triangles, own_m = _read(path, at)
    scale = own_m if scale is None else scale
    corners, faces = hull(vertices)
    if not len(faces):
        raise SettingsError(f"{at}: file: {path} is flat; would be right: a mesh with a volume")
    share = _volume(vertices, triangles) / _volume(corners, faces)
    if share >= CONVEX or if_concave == "hull":
        return [_few(scale * corners, most_vertices)]
    if if_concave == "refuse":
        raise SettingsError(
            f"{at}: file: {path} is not convex: its volume is {share:.0%} of its convex hull's; would be right: "
            'if_concave = "decompose" (with CoACD), if_concave = "hull" for the whole hull, or a closed convex mesh'
        )
    parts = _decompose(vertices, triangles, at, most_parts)
    if len(parts) > most_parts:
        raise SettingsError(
            f"{at}: file: {path} has {len(parts)} convex parts; would be right: at most {most_parts}, so simplify it"
        )
    return [_few(scale * hull(part)[0], most_vertices) for part in parts]


def _read(path: Path, at: str) -> tuple[Floats, Ints, float]:
    """Vertices (n, 3) in units of the file, triangles (t, 3) of a mesh, and the unit [m]."""
    if path.suffix.lower() not in KINDS or not path.is_file():
        found = "is not a file" if not path.is_file() else "is of another format"
        raise SettingsError(f"{at}: file: {path} {found}; would be right: a mesh, {', '.join(KINDS)}")
    if path.stat().st_size > MOST_BYTES:
        raise SettingsError(
            f"{at}: file: {path} has {path.stat().st_size >> 20} MB; would be right: at most {MOST_BYTES >> 20}"
        )
    with path.open("rb") as file:
        if file.read(4).startswith(_PACKED):
            raise SettingsError(f"{at}: file: {path} is packed; would be right: unpacked")
    try:
        mesh: Any = coal.MeshLoader().load(str(path), np.ones(3))
        triangles = np.array([[mesh.tri_indices(i)[k] for k in range(3)] for i in range(mesh.num_tris)], dtype=np.int64)
        vertices = np.array(mesh.vertices(), dtype=float).reshape(-1, 3)
        own_m = unit_m(path)
    except (RuntimeError, ValueError) as error:
        raise SettingsError(f"{at}: file: {path} cannot be read as a mesh ({error})") from error
    if not len(vertices) or not np.isfinite(vertices).all():
        raise SettingsError(f"{at}: file: {path} holds no finite vertices; would be right: a mesh with a volume")
    return vertices, triangles.reshape(-1, 3), own_m


def _volume(vertices: Floats, triangles: Ints) -> float:
    """Volume inside a closed surface, from the middle of its vertices."""
    a, b, c = ((vertices - vertices.mean(axis=0))[triangles[:, k]] for k in range(3))
    return abs(float((np.cross(a, b) * c).sum()) / 6.0)


def _few(corners: Floats, most: int) -> Floats:
    """The corners, or those of a polytope that encloses them if they are more than ``most``, which it never exceeds."""
    if len(corners) <= most:
        return corners
    points = np.empty((CORNERS, 3))
    return hull(points[: around((corners @ DIRECTIONS.T).max(axis=0), points)])[0]


def _decompose(vertices: Floats, triangles: Ints, at: str, most_parts: int) -> list[Floats]:
    """Points of the convex parts of a mesh, by CoACD."""
    try:
        coacd = import_module("coacd")
    except ImportError as error:
        raise SettingsError(
            f'{at}: if_concave = "decompose" needs CoACD; would be right: pip install "hrcreplay[meshes]"'
        ) from error
    if hasattr(coacd, "set_log_level"):
        coacd.set_log_level("error")
    parts = coacd.run_coacd(coacd.Mesh(vertices, triangles), threshold=_CONCAVITY, max_convex_hull=most_parts, seed=0)
    found = [np.asarray(points, dtype=float) for points, _ in parts]
    outside = _outside(vertices, found)
    if outside > _MISSED * float(np.ptp(vertices, axis=0).max()):
        raise SettingsError(
            f"{at}: file: the parts of its decomposition miss {outside:.3g} of it, in its units; would be right: "
            'if_concave = "hull", or a mesh of convex parts in files of their own'
        )
    return [_grow(part, outside) for part in found] if outside > 0.0 else found


def _grow(part: Floats, by: float) -> Floats:
    """Corners of a convex part whose faces have moved outwards."""
    planes = ConvexHull(part).equations
    planes[:, 3] -= by
    return np.asarray(HalfspaceIntersection(planes, part.mean(axis=0)).intersections)


def _outside(vertices: Floats, parts: list[Floats]) -> float:
    """How far a vertex lies outside all convex parts at most."""
    least = np.full(len(vertices), np.inf)
    for part in parts:
        planes = ConvexHull(part).equations
        least = np.minimum(least, (vertices @ planes[:, :3].T + planes[:, 3]).max(axis=1))
    return float(least.max())
