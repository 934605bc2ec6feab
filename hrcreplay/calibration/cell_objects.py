"""The objects of a cell file: boxes, cylinders, capsules, spheres, half-spaces, and convex hulls of meshes.

A mesh is read once, with the cell file. Its hulls take its place, so that a run can be repeated without the file.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from scipy.spatial.transform import Rotation

from hrcreplay.errors import SettingsError
from hrcreplay.geometry.convex_hull import CORNERS
from hrcreplay.records import Floats

_Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e4, le=1e4)]
_Size = Annotated[float, Field(gt=0.0, le=1e3)]
_Three = Annotated[list[_Number], Field(min_length=3, max_length=3)]

#: Sides of the prism around a cylinder.
SIDES = 16
#: Largest number of vertices of a part; hulls with more are enclosed in a coarser polytope.
MOST_VERTICES = CORNERS
#: Largest number of parts of an object, and of objects in a cell.
MOST_PARTS, MOST_OBJECTS = 64, 200

#: Keys that give the shape -> what they are.
_KEYS = {
    "box": ("size_m",),
    "cylinder": ("radius_m", "length_m"),
    "capsule": ("radius_m", "length_m"),
    "sphere": ("radius_m",),
    "half_space": ("normal",),
    "mesh": ("file",),
    "hulls": ("parts_m",),
}
SHAPES = tuple(_KEYS)
_MAY = {"mesh": ("scale", "if_concave")}
_SHAPE_KEYS = ("size_m", "radius_m", "length_m", "normal", "file", "scale", "if_concave", "parts_m")


def _check_turn(rows: list[float]) -> list[float]:
    if not math.dist(rows, (0.0, 0.0, 0.0)) > 1e-6:
        raise ValueError(f"found {rows}; would be right: a direction out of the half-space, such as [0, 0, 1]")
    return rows


class CellObject(BaseModel):
    """An object that stands in the cell."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    name: Annotated[str, Field(min_length=1, max_length=60)]
    """Shown in reports."""
    shape: Literal["box", "cylinder", "capsule", "sphere", "half_space", "mesh", "hulls"]
    """half_space: all behind a plane, such as floor and walls; hulls: parts by their points."""
    size_m: Annotated[list[_Size], Field(min_length=3, max_length=3)] | None = None
    """box: its edges along x, y, z [m]."""
    radius_m: _Size | None = None
    """cylinder, capsule, sphere [m]."""
    length_m: _Size | None = None
    """cylinder: its height along z; capsule: between the centres of its ends [m]."""
    normal: Annotated[_Three, AfterValidator(_check_turn)] | None = None
    """half_space: the direction out of it."""
    file: Annotated[str, Field(min_length=1)] | None = None
    """mesh: STL, OBJ, Collada or glTF, with its axes as they are; a relative path is searched beside the cell file."""
    scale: _Size | None = None
    """mesh: metres per unit of the file; 0.001 for millimetres. None: what a Collada file says, otherwise 1."""
    if_concave: Literal["refuse", "hull", "decompose"] | None = None
    """mesh that is not convex: refuse it, take its convex hull, or decompose it with CoACD."""
    parts_m: (
        Annotated[
            list[Annotated[list[_Three], Field(min_length=1, max_length=MOST_VERTICES)]],
            Field(min_length=1, max_length=MOST_PARTS),
        ]
        | None
    ) = None
    """hulls: points of each convex part [m]."""
    position_m: _Three = [0.0, 0.0, 0.0]
    """Origin of the shape: the middle of box, cylinder, capsule and sphere, a point of the half-space's plane [m]."""
    rpy_deg: _Three = [0.0, 0.0, 0.0]
    """Its orientation, Rz(yaw) Ry(pitch) Rx(roll) [deg]."""
    frame: Literal["world", "base"] = "world"
    """Frame of the pose: the world, or the robot's base."""
    may_approach: list[str] = []
    """Links that may come as near as the programme brings them, no nearer: "tool" for what turns with the last axis."""
    programme_may_touch: bool = False
    """Whether a programme that touches the object is planned all the same; the robot then stops before it."""

    @model_validator(mode="after")
    def _keys_of_the_shape(self) -> CellObject:
        needed = _KEYS[self.shape]
        given = [key for key in _SHAPE_KEYS if getattr(self, key) is not None]
        for key in needed:
            if key not in given:
                raise ValueError(f"no {key}; would be right: {self.shape} with {', '.join(needed)}")
        for key in given:
            if key not in (*needed, *_MAY.get(self.shape, ())):
                raise ValueError(f"found {key}; would be right: {self.shape} with {', '.join(needed)}")
        return self

    def to_dict(self) -> dict[str, Any]:
        """Returns the keys that are given, as in a cell file."""
        return self.model_dump(exclude_defaults=True) | {"name": self.name, "shape": self.shape}

    def parts(self) -> list[tuple[Floats, float]]:
        """Returns the points (m, 3) of each convex part in the shape's own frame and the radius around them [m].

        A half-space has none: how much of it a robot reaches depends on the robot.
        """
        if self.shape == "box" and self.size_m is not None:
            signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
            return [(signs * np.array(self.size_m), 0.0)]
        if self.parts_m is not None:
            return [(np.array(part, dtype=float), 0.0) for part in self.parts_m]
        radius = self.radius_m or 0.0
        half = 0.5 * (self.length_m or 0.0)
        if self.shape == "sphere":
            return [(np.zeros((1, 3)), radius)]
        if self.shape == "capsule":
            return [(np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), radius)]
        if self.shape == "cylinder":
            angles = (np.arange(SIDES) + 0.5) * 2.0 * math.pi / SIDES
            around = radius / math.cos(math.pi / SIDES) * np.column_stack([np.cos(angles), np.sin(angles)])
            return [(np.vstack([np.column_stack([around, np.full(SIDES, z)]) for z in (-half, half)]), 0.0)]
        return []

    def T_frame_object(self) -> Floats:
        """Returns the pose (4, 4) of the shape in its frame [m]."""
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", self.rpy_deg, degrees=True).as_matrix()
        T[:3, 3] = self.position_m
        return T


def read_objects(found: Sequence[CellObject], where: str, folder: Path | None) -> tuple[CellObject, ...]:
    """Reads the meshes that the objects of a cell file name.

    Args:
        found: Objects of the file.
        where: Prefix of error messages.
        folder: Folder in which relative mesh files are searched; None: a mesh cannot be read.

    Raises:
        SettingsError: A name occurs twice, or a mesh cannot be used.
    """
    names = [one.name for one in found]
    for name in names:
        if names.count(name) > 1:
            raise SettingsError(
                f"{where}: object {name}: its name occurs twice; would be right: a name for each object"
            )
    return tuple(
        _with_hulls(one, f"{where}: object {one.name}", folder) if one.shape == "mesh" else one for one in found
    )


def _with_hulls(one: CellObject, at: str, folder: Path | None) -> CellObject:
    """Puts the hulls of a mesh in its place."""
    from hrcreplay.calibration.meshes import read_parts  # slow to load; few cells have meshes

    if folder is None or one.file is None:
        raise SettingsError(f"{at}: file: a mesh can be named in a cell file only; would be right: shape hulls")
    how = one.scale, one.if_concave or "refuse", at
    parts = read_parts(folder / one.file, *how, most_parts=MOST_PARTS, most_vertices=MOST_VERTICES)
    kept = {key: getattr(one, key) for key in ("name", "position_m", "rpy_deg", "frame", "may_approach")}
    points = [part.tolist() for part in parts]
    return CellObject(**kept, shape="hulls", parts_m=points, programme_may_touch=one.programme_may_touch)
