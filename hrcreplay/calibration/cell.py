"""The cell: a file of camera and robot poses and clock offsets, and the floor, found from a walking person.

World frame: z up, floor at z = 0. The floor and the upward direction are found for any orientation of the sensor.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag

from hrcreplay.calibration.cell_objects import MOST_OBJECTS, SHAPES, CellObject, read_objects
from hrcreplay.calibration.registration import rigid
from hrcreplay.errors import shown
from hrcreplay.geometry.polygon import ConvexPolygon
from hrcreplay.logs.camera_checks import SOLE_M, SURE
from hrcreplay.records import POINTS, Bools, Floats, SkeletonTrack
from hrcreplay.store.run_folder import write_whole
from hrcreplay.toml_file import read_toml, validate

_TOLERANCE = 1e-6
_STRICT = ConfigDict(extra="forbid", frozen=True, strict=True)
_POSE = "4 rows of 4 finite numbers, a rotation and a place [m], last row 0 0 0 1"
_AREA = "3 or more corners [x, y] of a convex area, one after another around it [m]"

_Number = Annotated[float, Field(allow_inf_nan=False)]


def _check_area(corners: list[list[float]]) -> list[list[float]]:
    try:
        ConvexPolygon.of_corners(np.array(corners, dtype=float).reshape(-1, 2))
    except ValueError as error:
        raise ValueError(f"found {error}; would be right: {_AREA}") from error
    return corners


class Residual(BaseModel):
    """Distance between two calibrated cameras' views of the same person, outliers included."""

    model_config = _STRICT

    a: str
    b: str
    median_m: float
    p95_m: float
    points: int
    """Number of point pairs."""
    mirrored: float
    """Share of frames in which the two cameras disagree on left and right."""


class Watched(BaseModel):
    """Area that the cameras see together: every person with a part of the body in it is seen by one of them."""

    model_config = _STRICT

    corners_m: Annotated[list[Annotated[list[_Number], Field(min_length=2, max_length=2)]], AfterValidator(_check_area)]
    """Corners (x, y) of a convex area on the floor, in order around it; its height is unlimited [m]."""
    margin_m: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    """Maximum depth inside the area of an unseen person, such as an extended arm: 0.85 m in ISO 13855 [m]."""
    clear_s: Annotated[float, Field(ge=0.0, le=3600.0)] = 2.0
    """Time for which a person lost inside may still be there; all cameras must observe for this time before the area
    counts as empty [s]."""
    speed_m_per_s: Annotated[float, Field(gt=0.0, le=100.0)] = 1.6
    """Speed of people who walk in, ISO 13855 [m/s]."""

    @property
    def polygon(self) -> ConvexPolygon:
        """The area on the floor."""
        return ConvexPolygon.of_corners(np.array(self.corners_m))


class SeenBy(BaseModel):
    """What a camera sees: a pyramid along the z axis of its pose."""

    model_config = _STRICT

    fov_deg: Annotated[list[Annotated[float, Field(gt=0.0, lt=180.0)]], Field(min_length=2, max_length=2)]
    """Whole field of view across and down [deg]."""
    range_m: Annotated[float, Field(gt=0.0, le=1000.0)] = 100.0
    """Greatest distance at which it shows people [m]."""


@dataclass(frozen=True)
class Cell:
    """Poses and clocks of one cell, and the area that its cameras watch."""

    T_world_camera: Mapping[str, Floats] = field(default_factory=dict)  #: camera -> (4, 4)
    clock_offset_s: Mapping[str, float] = field(default_factory=dict)  #: camera's clock minus the reference camera's
    T_world_base: Floats | None = None  #: (4, 4) robot base
    watched: Watched | None = None  #: area in which every person is seen by a camera
    objects: tuple[CellObject, ...] = ()  #: what stands in the cell
    views: Mapping[str, SeenBy] = field(default_factory=dict)  #: camera -> what it sees
    residuals: tuple[Residual, ...] = ()
    notes: tuple[str, ...] = ()  #: uncertain results of calibrate

    def to_dict(self) -> dict[str, Any]:
        """Returns the cell as lists, numbers and strings, as in a cell file."""
        cell: dict[str, Any] = {
            "cameras": {
                name: {"T_world_camera": T.tolist(), "clock_offset_s": float(self.clock_offset_s.get(name, 0.0))}
                for name, T in self.T_world_camera.items()
            }
        }
        if self.T_world_base is not None:
            cell["T_world_base"] = self.T_world_base.tolist()
        if self.watched is not None:
            cell["watched"] = self.watched.model_dump()
        if self.objects:
            cell["objects"] = [one.to_dict() for one in self.objects]
        if self.views:
            cell["views"] = {name: view.model_dump() for name, view in self.views.items()}
        if self.residuals:
            cell["residuals"] = [residual.model_dump() for residual in self.residuals]
        if self.notes:
            cell["notes"] = list(self.notes)
        return cell

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "cell", folder: Path | None = None) -> Self:
        """Makes a cell from the result of ``to_dict`` or the content of a cell file.

        Args:
            table: The cell.
            where: Prefix of error messages.
            folder: Folder in which relative files of meshes are searched; None: there are none.

        Raises:
            SettingsError: A key or value is invalid.
        """
        file = validate(_CellFile, dict(table), where, _RIGHT)
        base = file.T_world_base
        if isinstance(base, _Upright):
            base = pose_from_position(np.array(base.position_m), np.radians(base.yaw_deg)).tolist()
        return cls(
            T_world_camera={name: np.array(camera.T_world_camera) for name, camera in file.cameras.items()},
            clock_offset_s={name: camera.clock_offset_s for name, camera in file.cameras.items()},
            T_world_base=None if base is None else np.array(base),
            watched=file.watched,
            objects=read_objects(file.objects, where, folder),
            views=file.views,
            residuals=tuple(file.residuals),
            notes=tuple(file.notes),
        )


def load_cell(path: Path) -> Cell:
    """Reads a cell file.

    Raises:
        SettingsError: The file cannot be read, or a key or value is invalid.
    """
    return Cell.from_dict(read_toml(path, "name a cell file"), str(path), path.parent)


def write_cell(cell: Cell, path: Path) -> None:
    """Writes a cell file, complete or not at all.

    Raises:
        SettingsError: The file exists, or its folder cannot be written.
    """
    write_whole(path, _toml(cell))


def pose_from_position(position_m: Floats, yaw_rad: float) -> Floats:
    """Returns T_world_x (4, 4) for a position (3,) [m] and a rotation about z by yaw [rad].

    scipy's ``Rotation`` uses half the angle; its rounding would change the last bits of the cell file.
    """
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]]
    T[:3, 3] = position_m
    return T


def _toml(cell: Cell) -> str:
    table = cell.to_dict()
    text = [
        "# World: z up, floor at z = 0. Poses are 4 x 4 [m]; T_world_base may also be",
        "# { position_m = [x, y, z], yaw_deg = 0.0 }. clock_offset_s: camera's clock minus the reference camera's [s].",
    ]
    if "notes" in table:
        text += ["", f"notes = {json.dumps(table['notes'], ensure_ascii=False)}"]
    if "T_world_base" in table:
        text += ["", f"T_world_base = {_matrix(table['T_world_base'])}"]
    for name, entry in table["cameras"].items():
        text += ["", f"[cameras.{json.dumps(name, ensure_ascii=False)}]"]
        text += [f"T_world_camera = {_matrix(entry['T_world_camera'])}"]
        text += [f"clock_offset_s = {entry['clock_offset_s']!r}"]
    if "watched" in table:
        text += ["", "[watched]", *(f"{key} = {value!r}" for key, value in table["watched"].items())]
    for name, view in table.get("views", {}).items():
        text += ["", f"[views.{json.dumps(name, ensure_ascii=False)}]"]
        text += [f"{key} = {value!r}" for key, value in view.items()]
    for one in table.get("objects", []):
        text += ["", "[[objects]]"]
        text += [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in one.items()]
    for residual in table.get("residuals", []):
        text += ["", "[[residuals]]"]
        text += [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in residual.items()]
    return "\n".join(text) + "\n"


def _matrix(rows: list[list[float]]) -> str:
    return "[\n" + "".join(f"  [{', '.join(repr(value) for value in row)}],\n" for row in rows) + "]"


def _check_rows(rows: Any) -> Any:
    """Checks the shape before the rows, so that a matrix of another size is shown completely."""
    if not isinstance(rows, list) or len(rows) != 4:
        raise ValueError(f"found {shown(rows)}; would be right: {_POSE}")
    return rows


def _check_pose(rows: list[list[float]]) -> list[list[float]]:
    T = np.array(rows)
    if (T[3] != [0, 0, 0, 1]).any():
        raise ValueError(f"found the last row {T[3].tolist()}; would be right: 0 0 0 1")
    off = float(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max())
    if off > _TOLERANCE:
        raise ValueError(f"found axes off by {off:.2g}; would be right: a rotation, to {_TOLERANCE:g}")
    if np.linalg.det(T[:3, :3]) < 0:
        raise ValueError("found a mirror image (determinant -1); would be right: a rotation")
    return rows


_Row = Annotated[list[_Number], Field(min_length=4, max_length=4)]
_Pose = Annotated[list[_Row], BeforeValidator(_check_rows), AfterValidator(_check_pose)]


class _Camera(BaseModel):
    model_config = _STRICT
    T_world_camera: _Pose
    clock_offset_s: _Number = 0.0


class _Upright(BaseModel):
    """A base with a vertical z axis."""

    model_config = _STRICT
    position_m: Annotated[list[_Number], Field(min_length=3, max_length=3)]
    yaw_deg: _Number = 0.0


_Base = Annotated[
    Annotated[_Upright, Tag("upright")] | Annotated[_Pose, Tag("pose")],
    Discriminator(lambda value: "upright" if isinstance(value, dict) else "pose"),
]


class _CellFile(BaseModel):
    model_config = _STRICT
    cameras: dict[str, _Camera] = {}
    T_world_base: _Base | None = None
    watched: Watched | None = None
    objects: Annotated[list[CellObject], Field(max_length=MOST_OBJECTS)] = []
    views: dict[str, SeenBy] = {}
    residuals: list[Residual] = []
    notes: list[str] = []


#: Description of a valid value by the name of the key.
_RIGHT = {
    "cameras": "a table",
    "T_world_camera": _POSE,
    "T_world_base": _POSE,
    "position_m": "[x, y, z] in the world [m]",
    "watched": f"a table with {', '.join(Watched.model_fields)}",
    "corners_m": _AREA,
    "margin_m": "a distance of 0 or more [m]",
    "clear_s": "a time of 0 or more [s]",
    "speed_m_per_s": "a speed above 0 [m/s]",
    "objects": f"up to {MOST_OBJECTS} tables [[objects]]",
    "views": "a table",
    "fov_deg": "[across, down], whole angles between 0 and 180 [deg]",
    "range_m": "a distance above 0 [m]",
    "shape": f"one of {', '.join(SHAPES)}",
    "name": "a short text",
    "residuals": f"tables with {', '.join(Residual.model_fields)}",
    "notes": "a list of texts",
}


_LEG = ("knee", "ankle", "foot")
_UPRIGHT = 0.9  # ratio of the straight distance from neck to ankles to that along the bones: 0.75 to 0.85 on a chair
_STANDING_STD = np.radians(3.0)  # rad, from sway and errors of the trackers' feet
_TORSO_STD = np.radians(8.0)  # rad, deviation of a sitting person's trunk from upright
_FOOT_STD_M = 0.02
_STEP_M = 0.1  # a tracker repeats its error while a foot rests: each place counts as one measurement
_REST_S = 0.3  # minimum time of a resting foot at a place
_MANY_S = 1.0  # minimum duration of the rows for a result
#: Maximum vertical component of the viewing direction that still gives a direction along the floor: 60 degrees up or
#: down.
LEVEL_VIEW = float(np.sin(np.radians(60)))


@dataclass(frozen=True)
class Floor:
    """A point p of the sensor's frame is ``up @ p + height_m`` above the floor."""

    up: Floats  #: (3,) unit vector in the sensor's frame
    height_m: float  #: height of the sensor's origin above the floor [m]
    tilt_std_rad: float  #: standard deviation of ``up`` [rad]


def up_direction(track: SkeletonTrack) -> tuple[Floats, float] | None:
    """Estimates the upward direction from the person's body.

    Returns:
        Unit vector (3,) in the sensor's frame and its standard deviation [rad]. A standing person keeps the centre of
        mass above the feet, even when bent. If the person never stands upright, the trunk from pelvis to neck is used
        instead. None if neither was seen long enough.
    """
    neck, pelvis = _point(track, "neck"), _point(track, "pelvis")
    neck = np.where(np.isfinite(neck), neck, 0.5 * (_point(track, "shoulder_l") + _point(track, "shoulder_r")))
    knee, ankle, foot = (0.5 * (_point(track, f"{name}_l") + _point(track, f"{name}_r")) for name in _LEG)
    bones = _length(neck - pelvis) + _length(pelvis - knee) + _length(knee - ankle)
    upright = _length(neck - ankle) > _UPRIGHT * bones
    mass = 0.30 * neck + 0.44 * pelvis + 0.20 * knee + 0.06 * ankle
    standing = _unit(mass - 0.5 * (ankle + foot))[upright]
    trunk = _unit(neck - pelvis)
    trunk = trunk[np.isfinite(trunk).all(axis=1)]
    for directions, std in ((standing, _STANDING_STD), (trunk, _TORSO_STD)):
        if len(directions) >= _rows_for(track, _MANY_S):
            return _middle(directions), float(std)
    return None


def find_floor(track: SkeletonTrack, up: Floats | None = None) -> Floor | None:
    """Finds the plane under the feet.

    Resting ankles and feet lie on two parallel planes. The posture gives a prior for their direction, with more weight
    if the person walked on a small part of the floor. Tukey's weights remove raised feet.

    Args:
        track: The person in the sensor's frame [m].
        up: (3,) direction to keep, in the sensor's frame; None to find it.

    Returns:
        The floor, or None if feet or trunk were not seen long enough.
    """
    guess = (up / np.linalg.norm(up), 1e-9) if up is not None else up_direction(track)
    feet_m, is_ankle = _feet(track)
    if guess is None or len(feet_m) < _rows_for(track, _MANY_S) or is_ankle.all():
        return None
    normal, std = guess
    prior = (_FOOT_STD_M / std) ** 2  # prior on the tilt, in units of the residual of one place
    e1, e2 = _across(normal)
    tilt = np.zeros(2)
    heights = feet_m @ normal
    kinds = np.stack([~is_ankle, is_ankle], axis=1).astype(np.float64)
    level = np.array([_low(heights[~is_ankle]), _low(heights[is_ankle])])
    A = np.column_stack([feet_m @ e1, feet_m @ e2, -kinds])
    A[:, :2] -= np.median(A[:, :2], axis=0)  # a rotation about the middle of the walked area does not change the levels
    share = _share(A[:, :2], is_ankle, _rows_for(track, _REST_S))
    for reach_m in np.concatenate([np.geomspace(0.3, 0.06, 12), np.full(20, 0.06)]):
        left = heights + A @ np.concatenate([tilt, level])
        weight = share * np.maximum(0.0, 1.0 - (left / reach_m) ** 2) ** 2
        H = A.T @ (A * weight[:, None]) + np.diag([prior, prior, 1e-9, 1e-9])
        solution = np.linalg.solve(H, -A.T @ (weight * heights) + 1e-9 * np.array([0, 0, *level]))
        tilt, level = solution[:2], solution[2:]
    found = _unit(normal + tilt[0] * e1 + tilt[1] * e2)
    middle = np.array([np.median(feet_m @ e1), np.median(feet_m @ e2)])
    # In the walked area, the plane of the feet is at `level` along the initial direction.
    on_plane = middle[0] * e1 + middle[1] * e2 + level[0] * normal
    tilt_std = _FOOT_STD_M * float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(H)[:2, :2])[-1]))
    return Floor(found, SOLE_M - float(found @ on_plane), tilt_std)


def floor_frame(floor: Floor) -> Floats:
    """Returns T_world_sensor (4, 4) of the world that the sensor defines.

    Its origin is the floor under the sensor, z is up, x is the viewing direction (the sensor's z) along the floor, or
    the sensor's own x if its z axis points up or down by more than 60 degrees, as in a motion capture system.
    """
    view = np.array([0.0, 0.0, 1.0])
    if abs(floor.up @ view) > LEVEL_VIEW:
        view = np.array([1.0, 0.0, 0.0])
    x = _unit(view - (floor.up @ view) * floor.up)
    return rigid(np.stack([x, np.cross(floor.up, x), floor.up]), np.array([0.0, 0.0, floor.height_m]))


def _point(track: SkeletonTrack, name: str) -> Floats:
    i = POINTS.index(name)
    return np.where((track.confidence[:, i] > 0)[:, None], track.points_m[:, i], np.nan)


def _unit(vectors: Floats) -> Floats:
    """Normalises vectors (..., 3); NaN for a zero vector."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0.0, length, np.nan))


def _length(vectors: Floats) -> Floats:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def _rows_for(track: SkeletonTrack, seconds: float) -> float:
    """Returns the number of rows of this track within a duration."""
    return max(1.0, seconds * 1e9 / float(np.median(np.diff(track.t_ns)))) if len(track) > 1 else np.inf


def _middle(directions: Floats) -> Floats:
    """Returns the direction with the minimum sum of angles, so that occasional bending has no influence."""
    middle = _unit(np.median(directions, axis=0))
    for _ in range(30):
        apart = np.linalg.norm(directions - middle, axis=1)
        middle = _unit((directions / np.maximum(apart, 1e-6)[:, None]).sum(axis=0))
    return middle


def _feet(track: SkeletonTrack) -> tuple[Floats, Bools]:
    """Returns (m, 3) ankles and feet of full confidence, and (m,) True for ankles."""
    places, kinds = [], []
    for name in ("ankle_l", "ankle_r", "foot_l", "foot_r"):
        points = _point(track, name)
        sure = (track.confidence[:, POINTS.index(name)] > SURE) & np.isfinite(points).all(axis=1)
        places.append(points[sure])
        kinds.append(np.full(int(sure.sum()), name.startswith("ankle")))
    return np.concatenate(places), np.concatenate(kinds)


def _share(places_m: Floats, is_ankle: Bools, rest: float) -> Floats:
    """Returns (m,) weights so that all points of one kind at one place of the floor count as one."""
    cells = np.column_stack([np.round(places_m / _STEP_M), is_ankle])
    _, which, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(1.0 / np.maximum(count, rest)[which.ravel()])


def _across(normal: Floats) -> tuple[Floats, Floats]:
    """Returns two unit vectors orthogonal to a direction and to each other."""
    e1 = _unit(np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))]))
    return e1, np.asarray(np.cross(normal, e1))


def _low(heights_m: Floats) -> float:
    return float(np.percentile(heights_m, 20)) if len(heights_m) else 0.0
