"""A cell file comes back as it was written, and a wrong one is told where it is wrong."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.calibration.cell import Cell, Residual, Watched, load_cell, pose_from_position, write_cell
from hrcreplay.calibration.registration import rigid
from hrcreplay.errors import SettingsError

T = rigid(Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_matrix(), np.array([1.0, -2.0, 0.5]))
EYE = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
AREA = "corners_m = [[0, 0], [1, 0], [1, 1]]"
CELL = Cell(
    T_world_camera={"left": T, 'a "b".c': np.eye(4)},
    clock_offset_s={"left": 0.0, 'a "b".c': -0.0123},
    T_world_base=np.asarray(np.linalg.inv(T)),
    residuals=(Residual(a="left", b='a "b".c', median_m=0.02, p95_m=0.1, points=1000, mirrored=0.05),),
    watched=Watched(corners_m=[[-1.0, 0.5], [2.0, 0.25], [1.0, 3.0]], margin_m=0.85, clear_s=1.5),
    notes=("up is known to about 8 degrees only",),
)


def test_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    write_cell(CELL, tmp_path / "cell.toml")
    again = load_cell(tmp_path / "cell.toml")
    assert again.to_dict() == CELL.to_dict()
    np.testing.assert_array_equal(again.T_world_camera["left"], T)
    assert again.clock_offset_s == CELL.clock_offset_s
    assert again.residuals == CELL.residuals
    assert again.watched == CELL.watched
    assert again.notes == CELL.notes
    assert tomllib.loads((tmp_path / "cell.toml").read_text()) == CELL.to_dict()


def test_goes_through_json() -> None:
    assert Cell.from_dict(json.loads(json.dumps(CELL.to_dict()))).to_dict() == CELL.to_dict()


def test_empty_cell(tmp_path: Path) -> None:
    write_cell(Cell(), tmp_path / "cell.toml")
    assert load_cell(tmp_path / "cell.toml") == Cell()


def test_base_by_position_and_yaw(tmp_path: Path) -> None:
    (tmp_path / "cell.toml").write_text("T_world_base = { position_m = [1, 2, 0.65], yaw_deg = 90 }\n")
    base = load_cell(tmp_path / "cell.toml").T_world_base
    assert base is not None
    np.testing.assert_allclose(base @ [1, 0, 0, 1], [1, 3, 0.65, 1], atol=1e-12)
    np.testing.assert_allclose(base, pose_from_position(np.array([1, 2, 0.65]), np.pi / 2))


def test_refuses_to_overwrite(tmp_path: Path) -> None:
    (tmp_path / "cell.toml").write_text("mine")
    with pytest.raises(SettingsError, match=r"cell\.toml: exists already"):
        write_cell(CELL, tmp_path / "cell.toml")
    assert (tmp_path / "cell.toml").read_text() == "mine"
    with pytest.raises(SettingsError, match="cannot be written"):
        write_cell(CELL, tmp_path / "none" / "cell.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["cell.toml"]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x", "not TOML"),
        ("cams = 1", r"found 'cams'; would be right: cameras, T_world_base, watched, residuals, notes"),
        ("cameras = 3", "cameras: found 3; would be right: a table"),
        ("[cameras.k]", r"cameras\.k: no T_world_camera; would be right: 4 rows of 4 numbers"),
        (f"[cameras.k]\nT_world_camera = {EYE}\nfov = 1", r"cameras\.k: found 'fov'; would be right: T_world_camera"),
        ("[cameras.k]\nT_world_camera = 7", r"cameras\.k\.T_world_camera: found 7; would be right: 4 rows of 4"),
        ("[cameras.k]\nT_world_camera = [[1,0,0],[0,1,0],[0,0,1]]", r"T_world_camera: found \[\[1, 0, 0\]"),
        (f"[cameras.k]\nT_world_camera = {EYE[:-2]}]]".replace("0,1]]", "0]]"), r"T_world_camera: found \[0, 0, 0\]"),
        (f"[cameras.k]\nT_world_camera = {EYE.replace('0,0,0,1', '0,0,1,1')}", r"last row \[0\.0, 0\.0, 1\.0, 1\.0\]"),
        (f"[cameras.k]\nT_world_camera = {EYE.replace('[1,', '[1.1,')}", "found axes off by 0.21; would be right"),
        (f"[cameras.k]\nT_world_camera = {EYE.replace('[1,', '[-1,')}", "mirror image"),
        (f"[cameras.k]\nT_world_camera = {EYE.replace('[1,', '[nan,')}", "found nan; would be right: a finite number"),
        (f"[cameras.k]\nT_world_camera = {EYE.replace('[1,', '[true,')}", "found True"),
        (f"[cameras.k]\nT_world_camera = {EYE}\nclock_offset_s = 'x'", r"cameras\.k\.clock_offset_s: found 'x'"),
        ("T_world_base = { position_m = [1, 2] }", r"T_world_base\.position_m: found \[1, 2\]; would be right: \[x, y"),
        ("T_world_base = { yaw_deg = 2 }", r"T_world_base\.position_m: found None"),
        ("T_world_base = { position_m = [1, 2, 3], yaw = 2 }", "T_world_base: found 'yaw'; would be right: position_m"),
        ("T_world_base = { position_m = [1, 2, 3], yaw_deg = inf }", r"T_world_base\.yaw_deg: found inf"),
        ("[[residuals]]\na = 'x'", "residuals: found .* would be right: tables with a, b, median_m"),
        ("residuals = 5", "residuals: found 5"),
        (
            "[[residuals]]\na='x'\nb='y'\nmedian_m='far'\np95_m=0.1\npoints=9\nmirrored=0.0",
            "residuals: found .*'far'.* would be right: tables with a, b, median_m",
        ),
        ("watched = 3", "watched: found 3; would be right: a table with corners_m, margin_m, clear_s, speed_m_per_s"),
        ("[watched]", r"watched\.corners_m: found None; would be right: 3 or more corners"),
        ("[watched]\ncorners_m = [[0, 0], [1, 0]]", r"corners_m: found 2 corners; would be right: 3 or more"),
        ("[watched]\ncorners_m = [[0, 0], [1, 1], [1, 0], [0, 1]]", "corners_m: found no convex polygon; would be"),
        ("[watched]\ncorners_m = [[0, 0, 0], [1, 0, 0], [1, 1, 0]]", r"corners_m: found .*would be right: 3 or more"),
        ("[watched]\ncorners_m = [[0, 0], [1, 0], [nan, 1]]", "corners_m: found nan; would be right"),
        (f"[watched]\n{AREA}\nmargin_m = -0.1", r"watched\.margin_m: found -0\.1; would be right: a distance of 0"),
        (f"[watched]\n{AREA}\nclear_s = inf", r"watched\.clear_s: found inf; would be right: a"),
        (f"[watched]\n{AREA}\nspeed_m_per_s = 0", r"watched\.speed_m_per_s: found 0; would be right: a speed above 0"),
        (f"[watched]\n{AREA}\nspeed = 1.6", "watched: found 'speed'; would be right: corners_m, margin_m, clear_s"),
        ("notes = 'x'", "notes: found 'x'; would be right: a list of texts"),
    ],
)
def test_wrong_cell(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "cell.toml").write_text(text)
    with pytest.raises(SettingsError, match=told) as caught:
        load_cell(tmp_path / "cell.toml")
    assert str(caught.value).startswith(str(tmp_path / "cell.toml"))
    assert "\n" not in str(caught.value)


def test_missing_cell(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="cannot be read"):
        load_cell(tmp_path / "none.toml")
