"""The cell file: poses of cameras and robot, clock offsets. World frame: z up, floor at z = 0."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, ValidationError

from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.store.run_folder import write_whole

_TOLERANCE = 1e-6
_STRICT = ConfigDict(extra="forbid", frozen=True, strict=True)
_POSE = "4 rows of 4 numbers, a rotation and a place [m], last row 0 0 0 1"


class Residual(BaseModel):
    """How far two cameras are apart about the same person once calibrated, outliers included."""

    model_config = _STRICT

    a: str
    b: str
    median_m: float
    p95_m: float
    points: int
    """Point pairs it rests on."""
    mirrored: float
    """Share of frames in which the two see left and right exchanged."""


@dataclass(frozen=True)
class Cell:
    """Poses and clocks of one cell."""

    T_world_camera: Mapping[str, Floats] = field(default_factory=dict)  #: camera -> (4, 4)
    clock_offset_s: Mapping[str, float] = field(default_factory=dict)  #: camera's clock minus the reference camera's
    T_world_base: Floats | None = None  #: (4, 4) robot base
    residuals: tuple[Residual, ...] = ()
    notes: tuple[str, ...] = ()  #: what calibrate was not sure of

    def to_dict(self) -> dict[str, Any]:
        """The cell as plain lists, numbers and strings, as a cell file has them."""
        cell: dict[str, Any] = {
            "cameras": {
                name: {"T_world_camera": T.tolist(), "clock_offset_s": float(self.clock_offset_s.get(name, 0.0))}
                for name, T in self.T_world_camera.items()
            }
        }
        if self.T_world_base is not None:
            cell["T_world_base"] = self.T_world_base.tolist()
        if self.residuals:
            cell["residuals"] = [residual.model_dump() for residual in self.residuals]
        if self.notes:
            cell["notes"] = list(self.notes)
        return cell

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "cell") -> Self:
        """The cell that ``to_dict`` gave, or a cell file holds.

        Raises:
            SettingsError: A key or value is not as it should be.
        """
        try:
            file = _CellFile.model_validate(dict(table))
        except ValidationError as error:
            raise SettingsError(_first_problem(error, table, where)) from error
        base = file.T_world_base
        if isinstance(base, _Upright):
            base = pose_from_position(np.array(base.position_m), np.radians(base.yaw_deg)).tolist()
        return cls(
            T_world_camera={name: np.array(camera.T_world_camera) for name, camera in file.cameras.items()},
            clock_offset_s={name: camera.clock_offset_s for name, camera in file.cameras.items()},
            T_world_base=None if base is None else np.array(base),
            residuals=tuple(file.residuals),
            notes=tuple(file.notes),
        )


def load_cell(path: Path) -> Cell:
    """Reads a cell file.

    Raises:
        SettingsError: The file cannot be read, or a key or value is not as it should be.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror}); name a cell file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: not TOML ({error})") from error
    return Cell.from_dict(table, str(path))


def write_cell(cell: Cell, path: Path) -> None:
    """Writes a cell file, whole or not at all.

    Raises:
        SettingsError: The file exists, or its folder cannot be written.
    """
    write_whole(path, _toml(cell))


def pose_from_position(position_m: Floats, yaw_rad: float) -> Floats:
    """T_world_x (4, 4) of something at a place (3,) [m], turned about z by yaw [rad].

    scipy's ``Rotation`` goes by half the angle, and its last bits would reach the cell file.
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
    for residual in table.get("residuals", []):
        text += ["", "[[residuals]]"]
        text += [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in residual.items()]
    return "\n".join(text) + "\n"


def _matrix(rows: list[list[float]]) -> str:
    return "[\n" + "".join(f"  [{', '.join(repr(value) for value in row)}],\n" for row in rows) + "]"


def _check_rows(rows: Any) -> Any:
    """Before the rows themselves, so that a matrix of another size is shown whole."""
    if not isinstance(rows, list) or len(rows) != 4:
        raise ValueError(f"found {rows!r}; would be right: {_POSE}")
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


_Number = Annotated[float, Field(allow_inf_nan=False)]
_Row = Annotated[list[_Number], Field(min_length=4, max_length=4)]
_Pose = Annotated[list[_Row], BeforeValidator(_check_rows), AfterValidator(_check_pose)]


class _Camera(BaseModel):
    model_config = _STRICT
    T_world_camera: _Pose
    clock_offset_s: _Number = 0.0


class _Upright(BaseModel):
    """A base whose z axis is the world's."""

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
    residuals: list[Residual] = []
    notes: list[str] = []


#: What would be right, by the name of the key; for a number, a finite one.
_RIGHT = {
    "cameras": "a table",
    "T_world_camera": _POSE,
    "T_world_base": _POSE,
    "position_m": "[x, y, z] in the world [m]",
    "residuals": f"tables with {', '.join(Residual.model_fields)}",
    "notes": "a list of texts",
}


def _first_problem(error: ValidationError, table: Mapping[str, Any], where: str) -> str:
    problems = error.errors()
    # An unknown key is told first: it may be a missing one with another name.
    problem = next((one for one in problems if one["type"] == "extra_forbidden"), problems[0])
    kind, loc, found = problem["type"], list(problem["loc"]), problem["input"]
    if loc[0] in ("residuals", "notes"):
        kind, loc, found = "value", loc[:1], table[str(loc[0])]
    elif loc[0] == "T_world_base":
        del loc[1]  # the tag
    keys = [str(key) for key in loc if not isinstance(key, int)]
    at = f"{where}: {'.'.join(keys)}"
    right = "a table" if keys[0] == "cameras" and len(keys) == 2 else _RIGHT.get(keys[-1])
    if kind == "extra_forbidden":
        models: dict[str, type[BaseModel]] = {"cameras": _Camera, "T_world_base": _Upright}
        model = models[keys[0]] if len(keys) > 1 else _CellFile
        above = ": ".join([where, *filter(None, [".".join(keys[:-1])])])
        return f"{above}: found {keys[-1]!r}; would be right: {', '.join(model.model_fields)}"
    if kind == "value_error":
        return f"{at}: {problem['ctx']['error']}"
    if kind == "missing" and keys[-1] == "T_world_camera":
        return f"{where}: {'.'.join(keys[:-1])}: no T_world_camera; would be right: {right}"
    if kind in ("float_type", "finite_number"):
        right = "a finite number"
    return f"{at}: found {None if kind == 'missing' else found!r}; would be right: {right}"
