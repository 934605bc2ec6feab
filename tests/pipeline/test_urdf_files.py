"""Where a URDF's meshes are looked for, and what a run depends on."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.errors import SettingsError
from hrcreplay.live.control.setup import live_run_config, start_table
from hrcreplay.pipeline.assembly import robot as robot_of
from hrcreplay.pipeline.run_config import RunConfig, read_urdf, resolve_without_log, urdf_digest
from hrcreplay.reporting.tables import remarks, robot_table, summary
from hrcreplay.robot.model import from_urdf
from hrcreplay.settings.load import load_settings
from tests.facts import facts, tells
from tests.live.flights import DEMO
from tests.robot.test_model import joint, link, robot_xml


def stl(path: Path, size_m: float) -> Path:
    """A tetrahedron as binary STL: three edges along the axes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    corners = size_m * np.vstack([np.zeros(3), np.eye(3)])
    faces = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
    rows = [struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces]
    path.write_bytes(bytes(80) + struct.pack("<I", len(rows)) + b"".join(rows))
    return path


def urdf(path: Path, mesh: str, shape: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    shape = shape or f"<mesh filename='{mesh}' scale='2 1 1'/>"
    path.write_text(
        robot_xml(link("base", "<mesh filename='none.stl'/>"), link("arm", shape), joint("j", "base", "arm"))
    )
    return path


def run_config(path: Path, *overrides: str) -> RunConfig:
    return resolve_without_log("plan", path, load_settings(None, (f"robot.urdf={path}", *overrides)), None)


def found(path: Path, *overrides: str) -> list[str]:
    files = read_urdf(run_config(path, *overrides).settings.robot)
    assert files is not None
    return [file for _, file in files.meshes]


@pytest.mark.parametrize("unit", ["0.01", "0"])
def test_a_mesh_that_is_not_in_metres_is_refused(tmp_path: Path, unit: str) -> None:
    """pinocchio takes the numbers as metres, so the links would be a hundred times as thick."""
    (tmp_path / "arm.dae").write_text(f"<COLLADA><asset><unit name='own' meter='{unit}'/></asset></COLLADA>")
    with pytest.raises(SettingsError, match=facts("arm.dae", "unit", unit)):
        found(urdf(tmp_path / "robot.urdf", "arm.dae"))


def test_packages_come_from_the_settings_then_beside_the_urdf_then_from_ros(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = urdf(tmp_path / "ws" / "my_arm" / "urdf" / "arm.urdf", "package://my_arm/meshes/arm.stl")
    ros = stl(tmp_path / "ros" / "my_arm" / "meshes" / "arm.stl", 0.1)
    with pytest.raises(SettingsError, match=facts("arm.stl", "'arm'", "robot.packages")):
        found(robot)
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'none'}:{tmp_path / 'ros'}")
    assert found(robot) == [str(ros)]
    beside = stl(tmp_path / "ws" / "my_arm" / "meshes" / "arm.stl", 0.1)
    assert found(robot) == [str(beside)]
    mine = stl(tmp_path / "mine" / "my_arm" / "meshes" / "arm.stl", 0.1)
    for directory in (tmp_path / "mine", tmp_path / "mine" / "my_arm"):  # of packages, or the package's own
        assert found(robot, f'robot.packages=["{directory}"]') == [str(mine)]
    monkeypatch.delenv("ROS_PACKAGE_PATH")
    for name in ("../meshes/arm.stl", str(beside), f"file://{beside}"):
        assert Path(found(urdf(robot, name))[0]).resolve() == beside
    with pytest.raises(SettingsError, match=facts("x.stl", "'arm'")):
        found(urdf(robot, "x.stl"))


def test_a_mesh_is_scaled_and_its_change_makes_the_plan_stale(tmp_path: Path) -> None:
    robot = urdf(tmp_path / "arm.urdf", "arm.stl")
    mesh = stl(tmp_path / "arm.stl", 0.3)
    first = run_config(robot)
    model = robot_of(first, np.eye(4))
    assert model.segments[0].shape_m3 == pytest.approx(0.6 * 0.3 * 0.3 / 6)
    inputs = first.meta()["inputs"]
    assert [Path(file["path"]).name for file in inputs[1:]] == ["arm.urdf", "arm.stl"]
    before = urdf_digest(first.settings)  # among what the plan depends on
    assert before == urdf_digest(run_config(robot).settings)
    stl(mesh, 0.2)
    assert before != urdf_digest(run_config(robot).settings)
    assert robot_of(run_config(robot), np.eye(4)).segments[0].shape_m3 == pytest.approx(0.4 * 0.2 * 0.2 / 6)
    mesh.write_bytes(b"not a mesh")
    with pytest.raises(SettingsError, match=r"mesh of (other|arm) cannot be read"):
        robot_of(run_config(robot), np.eye(4))


def test_meshes_are_not_asked_for_where_links_are_given(tmp_path: Path) -> None:
    robot = urdf(tmp_path / "arm.urdf", "package://nowhere/arm.stl")
    links = 'robot.links=[{name = "a", body = "arm", start_m = [0,0,0], end_m = [0,0,1], radius_m = 0.1}]'
    model = robot_of(run_config(robot, links), np.eye(4))
    assert [segment.name for segment in model.segments] == ["a"]
    assert robot_table(summary(model)).rows == (("a", "1.000", "0.100", "35.60", "\u2013", "\u2013"),)
    assert remarks(model) == ()


def test_what_the_capsules_add_is_told(tmp_path: Path) -> None:
    can = "<cylinder radius='0.1' length='0.2'/>"
    model = robot_of(run_config(urdf(tmp_path / "arm.urdf", "", can), "robot.tool_m=0.3"), np.eye(4))
    told = remarks(model)
    # two half balls of the same radius: 4/3 r on a length of 2 r
    assert tells(told[0], "robot other", "1 axes", "base", "arm", "1 capsules", "67 %")
    assert tells(told[1], "robot other", "TCP", "0.100 m")
    assert robot_table(summary(model)).rows == (("arm", "0.200", "0.100", "10.47", "6.28", "+67 %"),)


def test_other_settings_of_a_urdf_are_refused_for_the_built_in_robot() -> None:
    for override in ('robot.base_frame="x"', 'robot.packages=["/x"]', 'robot.tcp_frame="x"'):
        settings = load_settings(None, (override,))
        with pytest.raises(SettingsError, match=facts("IRB 140", "robot.urdf")):
            robot_of(resolve_without_log("plan", DEMO, settings, None), np.eye(4))


def test_live_drives_six_to_fourteen_axes_and_says_so(tmp_path: Path) -> None:
    path = urdf(tmp_path / "arm.urdf", "", "<sphere radius='0.1'/>")
    opened, header = live_run_config(DEMO, None, (f"robot.urdf={path}",), None)
    with pytest.raises(SettingsError, match=facts("robot.urdf", "other", "1 axes", "6 to 14")):
        start_table(opened, header, sending=True)


def test_a_given_path_is_what_pinocchio_reads(tmp_path: Path) -> None:
    xml = urdf(tmp_path / "arm.urdf", "package://p/a b.stl").read_text()
    mesh = stl(tmp_path / "a b.stl", 0.3)
    model = from_urdf(xml, np.eye(4), stop_s=0.5, meshes={"package://p/a b.stl": str(mesh)})
    assert model.segments[0].body == "arm"
