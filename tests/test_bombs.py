"""Small inputs that would cost hours or gigabytes: each is told in one line, and costs next to nothing.

The same limits, asked of the functions that hold them, for all inputs; of the whole command, with its memory, for some.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.calibration.cell import load_cell
from hrcreplay.egm.robot_double.faults import load_faults
from hrcreplay.errors import SettingsError
from hrcreplay.limits import load_limits
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline.run_config import read_urdf
from hrcreplay.robot.model import from_urdf, irb140
from hrcreplay.robot.path import MOVE_S, plan_programme
from hrcreplay.robot.task import CYCLE_S, parse_task
from hrcreplay.robot.urdf import MOST_LINKS
from hrcreplay.settings.load import load_settings
from hrcreplay.settings.sections import Robot
from hrcreplay.toml_file import parse_toml, read_toml
from tests.bounded import assert_one_line, run_bounded
from tests.facts import facts
from tests.logs import own

LOADERS: dict[str, Callable[[Path], object]] = {
    "settings": load_settings,
    "cell": load_cell,
    "limits": load_limits,
    "faults": lambda path: load_faults(path, seed=0, duration_s=1.0),
    "any": lambda path: read_toml(path, "name another"),
}
TOML = {
    "nested": ("nested", "a = " + "[" * 5000 + "]" * 5000),
    "nested tables": ("nested", "a = " + "{b = " * 3000 + "1" + "}" * 3000),
    "long": ("MB", "[logs]\n" + "".join(f"k{i} = {i}\n" for i in range(300_000))),
    "many parts": ("parts", ".".join("a" * 200_000) + " = 1"),
    "many quoted parts": ("parts", " . ".join(['"a"'] * 100_000) + " = 1"),
    "many parts of a table": ("parts", "[" + ".".join("a" * 200_000) + "]"),
}


@pytest.mark.parametrize("name", sorted(TOML))
@pytest.mark.parametrize("loader", sorted(LOADERS))
def test_toml_beyond_the_limits_is_told(loader: str, name: str, tmp_path: Path) -> None:
    fact, text = TOML[name]
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=fact) as told:
        LOADERS[loader](path)
    assert str(path) in str(told.value)
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 500


def test_toml_within_the_limits_is_read() -> None:
    lists = "[" * 50 + "]" * 50
    assert parse_toml(f"a.b.c = 0.5\nd = {lists}\n\n[x]\ny = '{'.' * 1000}'", "here")["a"] == {"b": {"c": 0.5}}
    numbers = ", ".join("0.125" for _ in range(2000))
    assert len(parse_toml(f"a = [{numbers}]", "here")["a"]) == 2000


def test_an_override_beyond_the_limits_is_told() -> None:
    with pytest.raises(SettingsError, match=facts("logs.topics", "nested")):
        load_settings(None, ("logs.topics=" + "[" * 3000,))


@pytest.mark.parametrize(
    "text", ["fusion.rate_hz=1e6", "fusion.rate_hz=inf", "fusion.rate_hz=nan", "live.cycle_s=1e-9", "live.cycle_s=nan"]
)
def test_rates_that_no_computer_holds_are_told(text: str) -> None:
    with pytest.raises(SettingsError, match=text.partition("=")[0]):
        load_settings(None, (text,))


def test_a_long_value_is_shown_cut() -> None:
    with pytest.raises(SettingsError, match=r"logs\.person_jump_m: found 'xxx") as told:
        load_settings(None, (f"logs.person_jump_m={'x' * 100_000}",))
    assert len(str(told.value)) < 500


HOME, AWAY = {"joints_deg": [0, 0, 0, 0, 30, 0]}, {"joints_deg": [20, 0, 0, 0, 30, 0]}
HERE, THERE = ({"position_m": [0.5, y, 0.5], "rpy_deg": [180, 0, 0], "move": "linear"} for y in (0.0, 0.2))


@pytest.mark.parametrize(
    ("facts", "task"),
    [
        (f"waypoint 2: .*speed 1e-09.*{MOVE_S:.0f} s", {"speed": 1e-9, "waypoints": [HOME, AWAY]}),
        (f"waypoint 2: .*speed_m_per_s 1e-07.*{MOVE_S:.0f} s", {"tcp_speed_m_per_s": 1e-7, "waypoints": [HOME, AWAY]}),
        (f"waypoint 2: .*speed_m_per_s 1e-07.*{MOVE_S:.0f} s", {"tcp_speed_m_per_s": 1e-7, "waypoints": [HERE, THERE]}),
        ("waypoint 2: .*1e-300", {"tcp_speed_m_per_s": 1e-300, "waypoints": [HERE, THERE]}),
        ("waypoint 2: .*acceleration 1e-12", {"acceleration": 1e-12, "waypoints": [HOME, AWAY]}),
        ("waypoint 2: .*1e-13", {"tcp_acceleration_m_per_s2": 1e-13, "waypoints": [HERE, THERE]}),
        (f"dwells of 36000 s.*{CYCLE_S:.0f} s", {"waypoints": [HOME | {"dwell_s": 3600}, AWAY] * 10}),
        ("at most 1000 items", {"waypoints": [HOME, AWAY] * 1000}),
    ],
)
def test_endless_tasks_are_told(facts: str, task: dict[str, object]) -> None:
    robot = irb140(np.eye(4), stop_s=0.377)
    with pytest.raises(SettingsError, match=facts) as told:
        plan_programme(parse_task(task), robot)
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 700


def test_slow_tasks_that_end_are_planned() -> None:
    robot = irb140(np.eye(4), stop_s=0.377)
    path = plan_programme(parse_task({"speed": 0.002, "waypoints": [HOME, AWAY]}), robot)
    assert 30.0 < path.duration_s < MOVE_S


def urdf(links: int) -> str:
    """A chain of six axes and then of fixed joints."""
    text = '<robot name="r"><link name="l0"/>'
    for number in range(1, links):
        kind, axis = "revolute" if number <= 6 else "fixed", "0 0 1" if number % 2 else "0 1 0"
        text += (
            f'<link name="l{number}"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>'
            f'<joint name="j{number}" type="{kind}"><parent link="l{number - 1}"/><child link="l{number}"/>'
            f'<origin xyz="0 0 0.1"/><axis xyz="{axis}"/>'
            '<limit lower="-2" upper="2" velocity="2" effort="1"/></joint>'
        )
    return text + "</robot>"


def test_a_urdf_of_thousands_of_links_is_told(tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(urdf(3000))
    with pytest.raises(SettingsError, match=facts("3000 links", f"{MOST_LINKS}")):
        read_urdf(Robot(urdf=path))
    path.write_text(urdf(MOST_LINKS))
    assert read_urdf(Robot(urdf=path)) is not None


@pytest.mark.parametrize(
    ("fact", "text"),
    [
        ("without links", '<robot name="r">' + "<a>" * 100_000 + "</a>" * 100_000 + "</robot>"),
        (
            "not a URDF",
            f'<!DOCTYPE r [<!ENTITY a "{"a" * 5000}">]><robot name="{"&a;" * 100_000}"><link name="l"/></robot>',
        ),
        ("MB", " " * (9 << 20)),
    ],
)
def test_xml_bombs_are_told(fact: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(text)
    with pytest.raises(SettingsError, match=fact):
        read_urdf(Robot(urdf=path))


def test_a_mesh_of_millions_of_triangles_is_told(tmp_path: Path) -> None:
    with (tmp_path / "big.stl").open("wb") as file:
        file.truncate(84 + 50 * 10_000_000)
    sphere, mesh = '<sphere radius="0.1"/>', '<mesh filename="big.stl"/>'
    (tmp_path / "r.urdf").write_text(urdf(8).replace(sphere, mesh, 1))
    with pytest.raises(SettingsError, match=facts("big.stl", "477 MB", "20 MB")):
        read_urdf(Robot(urdf=tmp_path / "r.urdf"))


def zipped(begin: bytes, megabytes: int) -> bytes:
    """A zip file of one Collada file, which unpacks to so many spaces and an end."""
    content = BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as file, file.open("a.dae", "w") as inner:
        inner.write(begin)
        for _ in range(megabytes):
            inner.write(b" " * (1 << 20))
        inner.write(b"</COLLADA>")
    return content.getvalue()


@pytest.mark.parametrize(
    ("name", "begin", "fact"),
    [
        ("a.dae", b"PK\x03\x04", "packed"),
        ("a.stl", b"\x1f\x8b\x08", "packed"),
        ("a.stl.gz", b"\x1f\x8b\x08", "packed"),
        ("a.obj", b"\x28\xb5\x2f\xfd", "packed"),
        ("a.zae", b"PK\x03\x04", "packed"),
        ("a.3mf", b"<model>", "of another format"),
        ("a.blend", b"BLENDER-v280", "of another format"),
        ("a", b"solid", "of another format"),
    ],
)
def test_meshes_that_may_be_packed_are_told(name: str, begin: bytes, fact: str, tmp_path: Path) -> None:
    """The library of meshes unpacks zip and gzip, and looks into files for what they are."""
    (tmp_path / name).write_bytes(begin)
    text = urdf(8).replace('<sphere radius="0.1"/>', f'<mesh filename="{name}"/>', 1)
    (tmp_path / "r.urdf").write_text(text)
    with pytest.raises(SettingsError, match=facts(name, fact, "STL", "Collada", "OBJ", "robot.links")) as told:
        read_urdf(Robot(urdf=tmp_path / "r.urdf"))
    assert "\n" not in str(told.value)


def test_a_mesh_that_cannot_be_read_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(b"no mesh")
    (tmp_path / "r.urdf").write_text(urdf(8).replace('<sphere radius="0.1"/>', '<mesh filename="a.stl"/>', 1))
    files = read_urdf(Robot(urdf=tmp_path / "r.urdf"))
    assert files is not None
    with pytest.raises(SettingsError, match=facts("r", "a.stl", "robot.links")) as told:
        from_urdf(files.text, np.eye(4), stop_s=0.4, meshes=dict(files.meshes))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("what", ["config", "cell", "task", "rate", "speed", "urdf", "mesh"])
def test_the_command_tells_a_bomb_in_one_line(what: str, tmp_path: Path) -> None:
    log = own.write(tmp_path / "a.mcap", own.frames(20), cameras={"left": np.eye(4), "right": np.eye(4)})
    (tmp_path / "nested.toml").write_text(TOML["nested"][1])
    (tmp_path / "long.toml").write_text(TOML["long"][1])
    (tmp_path / "base.toml").write_text("[T_world_base]\nposition_m = [0, 0, 0]\n")
    (tmp_path / "slow.toml").write_text(
        "speed = 1e-9\n[[waypoints]]\njoints_deg = [0,0,0,0,30,0]\n[[waypoints]]\njoints_deg = [9,0,0,0,30,0]\n"
    )
    (tmp_path / "r.urdf").write_text(urdf(3000))
    (tmp_path / "a.dae").write_bytes(zipped(b"<COLLADA>", 1000) if what == "mesh" else b"")
    (tmp_path / "mesh.urdf").write_text(urdf(8).replace('<sphere radius="0.1"/>', '<mesh filename="a.dae"/>', 1))
    commands: dict[str, tuple[list[str | Path], str]] = {
        "config": (["fuse", log, "--config", tmp_path / "nested.toml"], "nested too deep"),
        "cell": (["fuse", log, "--cell", tmp_path / "long.toml"], "MB"),
        "task": (["plan", log, "--set", f"plan.task={tmp_path / 'long.toml'}"], "MB"),
        "rate": (["fuse", log, "--set", "fusion.rate_hz=1e6"], "rate_hz"),
        "speed": (
            ["plan", log, "--cell", tmp_path / "base.toml", "--set", f"plan.task={tmp_path / 'slow.toml'}"],
            "1e-09",
        ),
        "urdf": (["plan", log, "--set", f"robot.urdf={tmp_path / 'r.urdf'}"], "3000 links"),
        "mesh": (["plan", log, "--set", f"robot.urdf={tmp_path / 'mesh.urdf'}"], "a.dae is packed"),
    }
    command, fact = commands[what]
    assert_one_line(run_bounded(*command, "--out", tmp_path / "out"), 2, fact)


def test_a_log_where_nothing_is_a_number_is_told(tmp_path: Path) -> None:
    seen = own.frames(300)
    nothing = replace(seen, points_m=np.full_like(seen.points_m, np.nan))
    log = own.write(tmp_path / "a.mcap", nothing, cameras={"left": np.eye(4), "right": np.eye(4)})
    assert_one_line(run_bounded("fuse", log, "--out", tmp_path / "out"), 3, "nobody was ever seen", "points_not_finite")
    opened = open_log(log)
    assert sum(map(len, opened.frames())) == 300
    assert sum("(100 % of its points)" in note for note in opened.notes) == 2
