"""The files to begin with, and the list of settings, are read as what they say they are."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from hrcreplay.calibration.cell import Cell, load_cell
from hrcreplay.commands.templates import write_templates
from hrcreplay.errors import SettingsError
from hrcreplay.robot.model import irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import parse_task
from hrcreplay.settings.listing import as_toml
from hrcreplay.settings.load import Settings, load_settings
from hrcreplay.settings.sections import setting


def test_the_list_of_settings_is_a_settings_file_of_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(as_toml())
    assert load_settings(path) == Settings()
    listed = tomllib.loads(path.read_text())
    for name, section in Settings():
        assert set(listed[name]) == set(type(section).model_fields), name


def test_every_setting_is_listed_with_its_meaning() -> None:
    text = " ".join(as_toml().replace("\n# ", " ").split())
    for _, section in Settings():
        for key, field in type(section).model_fields.items():
            assert field.description, key
            assert " ".join(field.description.split()) in text, key


def test_one_section_is_that_section() -> None:
    assert set(tomllib.loads(as_toml("fusion"))) == {"fusion"}
    with pytest.raises(SettingsError, match="found 'wish'"):
        as_toml("wish")


def test_the_files_to_begin_with_are_read(tmp_path: Path) -> None:
    paths = write_templates(tmp_path / "new")
    assert [path.name for path in paths] == ["cell.toml", "task.toml", "settings.toml"]
    cell, task, settings = paths
    assert load_cell(cell) == Cell()  # so that no robot is moved by a file that nobody has filled in
    path = plan_programme(parse_task(tomllib.loads(task.read_text())), irb140(np.eye(4), stop_s=0.377))
    np.testing.assert_allclose(path.sample(0.0).q, np.radians([0, 0, 0, 0, 90, 0]), atol=1e-9)
    assert load_settings(settings) == Settings()
    with pytest.raises(SettingsError, match="exists already"):
        write_templates(tmp_path / "new")


@pytest.mark.parametrize("name", ["cell.toml", "task.toml", "settings.toml"])
def test_what_stands_in_comments_is_right_too(tmp_path: Path, name: str) -> None:
    """Every line of TOML in a comment, taken out of it, is read."""
    path = {path.name: path for path in write_templates(tmp_path / "new")}[name]
    lines = path.read_text().splitlines()
    bare = [line.removeprefix("# ") if _is_toml(line.removeprefix("# ")) else line for line in lines]
    path.write_text("\n".join(bare) + "\n")
    if name == "cell.toml":
        cell = load_cell(path)
        assert cell.watched is not None
        np.testing.assert_array_equal(cell.T_world_base, np.eye(4))
        assert set(cell.T_world_camera) == {"left"}
    elif name == "settings.toml":
        assert load_settings(path) == Settings()
        table = tomllib.loads(path.read_text())
        assert table["fusion"]["rate_hz"] == setting({}, "fusion", "rate_hz")
        assert isinstance(Settings().live.zenoh, BaseModel)
    else:
        parse_task(tomllib.loads(path.read_text()))


def _is_toml(line: str) -> bool:
    if line.startswith("#") or ("=" not in line and not line.startswith("[")):
        return False
    try:
        tomllib.loads(line)
    except tomllib.TOMLDecodeError:
        return False
    return True
