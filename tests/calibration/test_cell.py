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
from tests.facts import facts

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
    with pytest.raises(SettingsError, match=facts("cell.toml", "exists")):
        write_cell(CELL, tmp_path / "cell.toml")
    assert (tmp_path / "cell.toml").read_text() == "mine"
    with pytest.raises(SettingsError, match=facts("none/cell.toml", "cannot be written")):
        write_cell(CELL, tmp_path / "none" / "cell.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["cell.toml"]


@pytest.mark.parametrize(
    ("text", "tokens"),
    [
        ("x", "not TOML"),
        ("cams = 1", "'cams' | cameras, T_world_base, watched, objects, views, residuals, notes"),
        ("cameras = 3", "cameras | 3 | table"),
        ("[cameras.k]", "cameras.k.T_world_camera | missing | 4 rows of 4"),
        (f"[cameras.k]\nT_world_camera = {EYE}\nfov = 1", "cameras.k | 'fov' | T_world_camera"),
        ("[cameras.k]\nT_world_camera = 7", "cameras.k.T_world_camera | 7 | 4 rows of 4"),
        ("[cameras.k]\nT_world_camera = [[1,0,0],[0,1,0],[0,0,1]]", "cameras.k.T_world_camera | [[1, 0, 0]"),
        (f"[cameras.k]\nT_world_camera = {EYE[:-2]}]]".replace("0,1]]", "0]]"), "cameras.k.T_world_camera | [0, 0, 0]"),
        (f"[cameras.k]\nT_world_camera = {EYE.replace('0,0,0,1', '0,0,1,1')}", "[0.0, 0.0, 1.0, 1.0]"),
        (f"[cameras.k]\nT_world_camera = {EYE.replace('[1,', '[1.1,')}", "0.21"),
        (f"[cameras.k]\nT_world_camera = {EYE.replace('[1,', '[-1,')}", "mirror image"),
        (f"[cameras.k]\nT_world_camera = {EYE.replace('[1,', '[nan,')}", "nan | finite"),
        (f"[cameras.k]\nT_world_camera = {EYE.replace('[1,', '[true,')}", "True"),
        (f"[cameras.k]\nT_world_camera = {EYE}\nclock_offset_s = 'x'", "cameras.k.clock_offset_s | 'x'"),
        ("T_world_base = { position_m = [1, 2] }", "T_world_base.position_m | [1, 2] | [x, y, z]"),
        ("T_world_base = { yaw_deg = 2 }", "T_world_base.position_m | missing | [x, y, z]"),
        ("T_world_base = { position_m = [1, 2, 3], yaw = 2 }", "T_world_base | 'yaw' | position_m"),
        ("T_world_base = { position_m = [1, 2, 3], yaw_deg = inf }", "T_world_base.yaw_deg | inf"),
        ("[[residuals]]\na = 'x'", "residual 1: b | missing"),
        ("residuals = 5", "residuals | 5"),
        (
            "[[residuals]]\na='x'\nb='y'\nmedian_m='far'\np95_m=0.1\npoints=9\nmirrored=0.0",
            "residual 1: median_m | 'far' | number",
        ),
        ("watched = 3", "watched | 3 | table | corners_m, margin_m, clear_s, speed_m_per_s"),
        ("[watched]", "watched.corners_m | missing | 3 or more"),
        ("[watched]\ncorners_m = [[0, 0], [1, 0]]", "watched.corners_m | 2 corners | 3 or more"),
        ("[watched]\ncorners_m = [[0, 0], [1, 1], [1, 0], [0, 1]]", "watched.corners_m | no convex polygon"),
        ("[watched]\ncorners_m = [[0, 0, 0], [1, 0, 0], [1, 1, 0]]", "watched.corners_m | 3 or more"),
        ("[watched]\ncorners_m = [[0, 0], [1, 0], [nan, 1]]", "watched.corners_m | nan"),
        (f"[watched]\n{AREA}\nmargin_m = -0.1", "watched.margin_m | -0.1 | 0"),
        (f"[watched]\n{AREA}\nclear_s = inf", "watched.clear_s | inf"),
        (f"[watched]\n{AREA}\nspeed_m_per_s = 0", "watched.speed_m_per_s | 0 | above 0"),
        (f"[watched]\n{AREA}\nspeed = 1.6", "watched | 'speed' | corners_m, margin_m, clear_s"),
        ("notes = 'x'", "notes | 'x' | list"),
    ],
)
def test_wrong_cell(text: str, tokens: str, tmp_path: Path) -> None:
    (tmp_path / "cell.toml").write_text(text)
    with pytest.raises(SettingsError, match=facts(str(tmp_path / "cell.toml"), *tokens.split(" | "))) as caught:
        load_cell(tmp_path / "cell.toml")
    assert str(caught.value).startswith(str(tmp_path / "cell.toml"))
    assert "\n" not in str(caught.value)


def test_missing_cell(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=facts("none.toml", "cannot be read")):
        load_cell(tmp_path / "none.toml")
