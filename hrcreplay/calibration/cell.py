"""The cell file: poses of cameras and robot, clock offsets. World frame: z up, floor at z = 0."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.store.run_folder import write_whole

_TOLERANCE = 1e-6
_KEYS = ("cameras", "T_world_base", "residuals", "notes")
_POSE = "4 rows of 4 numbers, a rotation and a place [m], last row 0 0 0 1"


@dataclass(frozen=True)
class Residual:
    """How far two cameras are apart about the same person once calibrated, outliers included."""

    a: str
    b: str
    median_m: float
    p95_m: float
    points: int  #: point pairs it rests on
    mirrored: float  #: share of frames in which the two see left and right exchanged


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
            cell["residuals"] = [asdict(residual) for residual in self.residuals]
        if self.notes:
            cell["notes"] = list(self.notes)
        return cell

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "cell") -> Self:
        """The cell that ``to_dict`` gave, or a cell file holds.

        Raises:
            SettingsError: A key or value is not as it should be.
        """
        _known(table, _KEYS, where)
        cameras = _table(table.get("cameras", {}), f"{where}: cameras")
        poses, offsets = {}, {}
        for name, entry in cameras.items():
            place = f"{where}: cameras.{name}"
            _known(_table(entry, place), ("T_world_camera", "clock_offset_s"), place)
            if "T_world_camera" not in entry:
                raise SettingsError(f"{place}: no T_world_camera; would be right: {_POSE}")
            poses[name] = _pose(entry["T_world_camera"], f"{place}.T_world_camera")
            offsets[name] = _number(entry.get("clock_offset_s", 0.0), f"{place}.clock_offset_s")
        base = table.get("T_world_base")
        return cls(
            T_world_camera=poses,
            clock_offset_s=offsets,
            T_world_base=None if base is None else _base(base, f"{where}: T_world_base"),
            residuals=_residuals(table.get("residuals", []), f"{where}: residuals"),
            notes=_notes(table.get("notes", []), f"{where}: notes"),
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
    """T_world_x (4, 4) of something at a place (3,) [m], turned about z by yaw [rad]."""
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


def _known(table: Mapping[str, Any], keys: tuple[str, ...], where: str) -> None:
    unknown = [key for key in table if key not in keys]
    if unknown:
        raise SettingsError(f"{where}: found {unknown[0]!r}; would be right: {', '.join(keys)}")


def _table(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise SettingsError(f"{where}: found {value!r}; would be right: a table")
    return value


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise SettingsError(f"{where}: found {value!r}; would be right: a finite number")
    return float(value)


def _numbers(value: Any, count: int, where: str, right: str) -> list[float]:
    if not isinstance(value, list) or len(value) != count:
        raise SettingsError(f"{where}: found {value!r}; would be right: {right}")
    return [_number(item, where) for item in value]


def _pose(value: Any, where: str) -> Floats:
    if not isinstance(value, list) or len(value) != 4:
        raise SettingsError(f"{where}: found {value!r}; would be right: {_POSE}")
    T = np.array([_numbers(row, 4, where, _POSE) for row in value])
    if (T[3] != [0, 0, 0, 1]).any():
        raise SettingsError(f"{where}: found the last row {T[3].tolist()}; would be right: 0 0 0 1")
    off = float(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max())
    if off > _TOLERANCE:
        raise SettingsError(f"{where}: found axes off by {off:.2g}; would be right: a rotation, to {_TOLERANCE:g}")
    if np.linalg.det(T[:3, :3]) < 0:
        raise SettingsError(f"{where}: found a mirror image (determinant -1); would be right: a rotation")
    return T


def _base(value: Any, where: str) -> Floats:
    if not isinstance(value, dict):
        return _pose(value, where)
    _known(value, ("position_m", "yaw_deg"), where)
    position = _numbers(value.get("position_m"), 3, f"{where}.position_m", "[x, y, z] in the world [m]")
    return pose_from_position(np.array(position), np.radians(_number(value.get("yaw_deg", 0.0), f"{where}.yaw_deg")))


def _residuals(value: Any, where: str) -> tuple[Residual, ...]:
    try:
        return tuple(Residual(**entry) for entry in value)
    except TypeError as error:
        right = ", ".join(Residual.__dataclass_fields__)
        raise SettingsError(f"{where}: found {value!r}; would be right: tables with {right}") from error


def _notes(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(note, str) for note in value):
        raise SettingsError(f"{where}: found {value!r}; would be right: a list of texts")
    return tuple(value)
