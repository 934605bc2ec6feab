"""Arms that people have, from their own URDFs: kinematics, capsules around meshes, and a drive through the demo."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from hrcreplay.commands import replay
from hrcreplay.commands.report import draw_figures, take_still
from hrcreplay.pipeline.run_config import read_urdf
from hrcreplay.records import Floats
from hrcreplay.robot.model import RobotModel, from_urdf
from hrcreplay.settings.sections import Robot
from hrcreplay.store import run_folder
from tests.commands.arms import ARMS, Arm
from tests.facts import tells
from tests.reporting.reading import page_lines

COLLADA = "{http://www.collada.org/2005/11/COLLADASchema}"


def arm_of(arm: Arm) -> tuple[RobotModel, dict[str, str]]:
    files = read_urdf(Robot(urdf=arm.path))
    assert files is not None
    return from_urdf(files.text, np.eye(4), stop_s=0.377, tool_m=arm.tool_m, meshes=dict(files.meshes)), dict(
        files.meshes
    )


def pose_of(element: ET.Element | None) -> Floats:
    """(4, 4) of an <origin>."""
    T = np.eye(4)
    if element is not None:
        T[:3, :3] = Rotation.from_euler("xyz", [float(v) for v in element.get("rpy", "0 0 0").split()]).as_matrix()
        T[:3, 3] = [float(v) for v in element.get("xyz", "0 0 0").split()]
    return T


def forward(urdf: Path, angles: dict[str, float]) -> dict[str, Floats]:
    """(4, 4) of every link in the root's frame, from the URDF alone: joint after joint, those not named at zero."""
    joints = [joint for joint in ET.parse(urdf).getroot().findall("joint") if joint.get("type")]
    children = {joint.find("child").get("link") for joint in joints}  # type: ignore[union-attr]
    root = next(j.find("parent").get("link") for j in joints if j.find("parent").get("link") not in children)  # type: ignore[union-attr]
    frames = {str(root): np.eye(4)}
    while len(frames) <= len(joints):
        for joint in joints:
            parent, child = (str(joint.find(end).get("link")) for end in ("parent", "child"))  # type: ignore[union-attr]
            if parent in frames and child not in frames:
                turn, axis = np.eye(4), joint.find("axis")
                if str(joint.get("name")) in angles:
                    along = [float(v) for v in (axis.get("xyz", "1 0 0") if axis is not None else "1 0 0").split()]
                    vector = angles[str(joint.get("name"))] * np.array(along) / np.linalg.norm(along)
                    turn[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
                frames[child] = frames[parent] @ pose_of(joint.find("origin")) @ turn
    return frames


def mesh_vertices(path: str) -> Floats:
    """(n, 3) of a binary STL or a COLLADA file in metres, read here and not by what hrcreplay reads them with."""
    if path.endswith(".stl"):
        data = Path(path).read_bytes()[84:]
        return np.frombuffer(data, np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")]))["v"].reshape(-1, 3)
    root = ET.parse(path).getroot()
    unit = root.find(f"{COLLADA}asset/{COLLADA}unit")
    scale = 1.0 if unit is None else float(unit.get("meter", "1"))
    geometries = {f"#{one.get('id')}": one for one in root.iter(f"{COLLADA}geometry")}
    found = []
    for node in root.iter(f"{COLLADA}node"):
        matrix = node.find(f"{COLLADA}matrix")
        T = np.eye(4) if matrix is None else np.array([float(v) for v in str(matrix.text).split()]).reshape(4, 4)
        for instance in node.findall(f"{COLLADA}instance_geometry"):
            mesh = geometries[str(instance.get("url"))].find(f"{COLLADA}mesh")
            assert mesh is not None
            source = mesh.find(f"{COLLADA}vertices/{COLLADA}input[@semantic='POSITION']").get("source")[1:]  # type: ignore[union-attr, index]
            array = mesh.find(f"{COLLADA}source[@id='{source}']/{COLLADA}float_array")
            points = np.array([float(v) for v in str(array.text).split()]).reshape(-1, 3)  # type: ignore[union-attr]
            found.append(scale * (points @ T[:3, :3].T + T[:3, 3]))
    return np.vstack(found)


@pytest.mark.parametrize("name", ARMS)
def test_every_vertex_of_a_mesh_is_inside_its_capsule(name: str) -> None:
    robot, meshes = arm_of(ARMS[name])
    links = {str(link.get("name")): link for link in ET.parse(ARMS[name].path).getroot().findall("link")}
    seen = 0
    for segment in robot.segments:
        shapes = links[segment.body].findall("collision")
        shape = shapes[0 if segment.name == segment.body else int(segment.name.rpartition("_")[2]) - 1]
        mesh = shape.find("geometry/mesh")
        if mesh is None:
            continue
        scale = [float(v) for v in mesh.get("scale", "1 1 1").split()]
        T = pose_of(shape.find("origin"))
        points = (scale * mesh_vertices(meshes[str(mesh.get("filename"))])) @ T[:3, :3].T + T[:3, 3]
        a, b = np.array(segment.start_m), np.array(segment.end_m)
        share = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-30), 0.0, 1.0)
        far = np.linalg.norm(points - a - share[:, None] * (b - a), axis=1).max()
        assert far <= segment.radius_m + 1e-9, segment.name
        assert far >= segment.radius_m - 1.1e-4, "no larger than it has to be"
        assert 1.1 * segment.shape_m3 < segment.volume_m3 < 3.0 * segment.shape_m3
        seen += 1
    assert seen >= robot.nv


@pytest.mark.parametrize("name", ARMS)
def test_kinematics_agree_with_the_urdf_joint_after_joint(name: str) -> None:
    arm = ARMS[name]
    robot, _ = arm_of(arm)
    assert robot.tcp_frame == arm.tcp
    assert robot.nv == (7 if name in {"panda", "xarm7"} else 6)
    rng = np.random.default_rng(7)
    tool = np.array([0.0, 0.0, arm.tool_m, 1.0])
    for _ in range(5):
        q = rng.uniform(np.maximum(robot.q_min, -3.0), np.minimum(robot.q_max, 6.0))
        frames = forward(arm.path, dict(zip(robot.joint_names, q, strict=True)))
        pose = robot.pose(q, np.zeros(robot.nv))
        assert_allclose(pose.T_world_tcp[:3, :3], frames[arm.tcp][:3, :3], atol=1e-9)
        assert_allclose(pose.T_world_tcp[:3, 3], (frames[arm.tcp] @ tool)[:3], atol=1e-9)
        for segment, ends in zip(robot.segments, pose.ends_m, strict=True):
            expected = frames[segment.body] @ np.array([[*segment.start_m, 1.0], [*segment.end_m, 1.0]]).T
            assert_allclose(ends, expected[:3].T, atol=1e-9)


@pytest.mark.parametrize("name", ARMS)
def test_it_drives_the_demo_to_the_page(name: str, tmp_path: Path) -> None:
    arm = ARMS[name]
    command = "plan" if name in {"ur3", "xarm7"} else "report"
    overrides = (*arm.overrides(tmp_path), "prediction.method=paper", "limits.prediction=paper")
    if command == "report":  # the scaling beside it is tried with the others
        overrides = (*overrides, "plan.baselines=[]")
    folder = replay.run(command, replay.demo_log(), out=tmp_path / "run", start_s=8.0, end_s=9.0, overrides=overrides)
    run, meta = run_folder.read(folder), json.loads((folder / "run.json").read_text())
    assert run.motion is not None
    assert run.T_world_base is not None
    joints = meta["robot"]["joints"]
    q = run.motion[[f"q{axis}" for axis in range(1, len(joints) + 1)]].to_numpy()
    assert f"q{len(joints) + 1}" not in run.motion
    assert np.ptp(q, axis=0).max() > 0.02, "it moves"
    assert np.isfinite(run.motion["distance_m"][5:]).all(), "the first frames have to arrive"
    if command == "plan":
        assert np.isfinite(run.baselines["scaling"][[f"q{axis}" for axis in range(1, len(joints) + 1)]]).all(axis=None)
    for row in (0, len(q) // 2, -1):
        frame = run.T_world_base @ forward(arm.path, dict(zip(joints, q[row], strict=True)))[arm.tcp]
        tcp = run.motion[["tcp_x", "tcp_y", "tcp_z"]].to_numpy()[row]
        assert_allclose(tcp, (frame @ [0, 0, arm.tool_m, 1])[:3], atol=1e-9)
    assert [Path(file["path"]).name for file in meta["inputs"][:2]] == ["demo.mcap", arm.path.name]
    assert len(meta["inputs"]) >= 2 + 6, "and the meshes of its links"
    assert any("capsules add" in note for note in meta["notes"])
    if command == "report":
        page = (folder / "report.html").read_text()
        assert tells(page_lines(page), "Capsules", run.meta["robot"]["name"])
        assert (folder / "figures" / "robot_links.png").is_file()
        assert "robot_links-" in page


def test_figures_and_stills_of_a_run_need_no_urdf_any_more(tmp_path: Path) -> None:
    """The run folder holds the URDF and the capsules that its meshes gave, so both may go."""
    arm = ARMS["ur5"]
    robots = arm.path.parents[2]
    moved = tmp_path / "share" / "example-robot-data" / "robots"
    shutil.copytree(robots / "ur_description", moved / "ur_description", copy_function=shutil.copyfile)
    overrides = [one for one in arm.overrides(tmp_path) if not one.startswith("robot.urdf")]
    overrides.append(f"robot.urdf={moved / arm.urdf}")
    folder = replay.run("report", replay.demo_log(), out=tmp_path / "run", end_s=11.0, overrides=tuple(overrides))
    shutil.rmtree(tmp_path / "share")
    drawn = [path for key in ("15", "9") for path in draw_figures(folder, key, tmp_path / "figures")]
    assert {path.stem for path in drawn} == {"fig15_storyboard", "fig09_volumes"}, "those that show the robot's links"
    for path in drawn:
        if path.suffix == ".pdf":  # those of a report are PNG and SVG
            continue
        assert path.read_bytes() == (folder / "figures" / path.name).read_bytes(), path.name
    assert take_still(folder, 9.0, tmp_path / "still.png").stat().st_size > 10_000
    recorded = run_folder.read_meta(folder)["urdf"]
    assert recorded["text"] == arm.path.read_text()
    want = {segment.name: segment for segment in arm_of(arm)[0].segments}
    assert [link["name"] for link in recorded["links"]] == list(want)
    for link in recorded["links"]:
        assert_allclose(link["radius_m"], want[link["name"]].radius_m)
        assert_allclose(link["end_m"], want[link["name"]].end_m)
