"""scene.mcap as a reader that knows only Foxglove's schemas finds it."""

from __future__ import annotations

import dataclasses
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import hrcreplay
from hrcreplay.reporting.replay_scene import CameraSight, ReplayScene, pose_links
from hrcreplay.reporting.scene_mcap import write_scene
from hrcreplay.reporting.scene_messages import surface, surface_mesh
from hrcreplay.robot.control.static_obstacles import StaticHull
from tests.reporting.moving import moving_run, moving_scene, robot

LAYOUT = Path(hrcreplay.__file__).parent / "reporting" / "foxglove-layout.json"


@pytest.fixture(scope="module")
def scene() -> ReplayScene:
    return moving_scene(moving_run(4.0))


@pytest.fixture(scope="module")
def file(scene: ReplayScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "scene.mcap"
    write_scene(path, scene, moving_run(4.0).measurements)
    return path


@pytest.fixture(scope="module")
def topics(file: Path) -> dict[str, list[tuple[int, Any]]]:
    """Topic -> instants and messages."""
    return _topics(file)


def _topics(file: Path) -> dict[str, list[tuple[int, Any]]]:
    found = defaultdict(list)
    kinds: dict[int, Any] = {}
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if schema.encoding == "ros2msg":
                found[channel.topic].append((message.log_time, message.data))
                continue
            if schema.encoding == "jsonschema":
                found[channel.topic].append((message.log_time, json.loads(message.data)))
                continue
            if schema.id not in kinds:
                pool = descriptor_pool.DescriptorPool()
                for part in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(part)
                kinds[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            found[channel.topic].append((message.log_time, kinds[schema.id].FromString(message.data)))
    return dict(found)


def test_every_topic_has_its_instants(topics: dict[str, list[tuple[int, Any]]], scene: ReplayScene) -> None:
    each = scene.t_ns.tolist()
    for topic in ("/tf", "/person/fused", "/person/points", "/person/recorded", "/plan/distance", "/plan/series"):
        assert [t_ns for t_ns, _ in topics[topic]] == each, topic
    assert {"/baseline/scaling/robot", "/baseline/scaling/series", "/camera/kinect", "/camera/xtion"} <= topics.keys()
    stored = [t_ns for t_ns, _ in topics["/volumes"]]
    assert np.diff(stored).min() >= 160_000_000
    assert len(stored) == pytest.approx(3.5 * 5, abs=1)


def test_the_links_hang_on_frames_that_bring_them_where_they_are(
    topics: dict[str, list[tuple[int, Any]]], scene: ReplayScene
) -> None:
    row = 57
    frames = {
        one.child_frame_id: (
            Rotation.from_quat([one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w]),
            np.array([one.translation.x, one.translation.y, one.translation.z]),
        )
        for one in topics["/tf"][row][1].transforms
    }
    for topic, q in (
        ("/plan/capsules", scene.methods["qp"].q),
        ("/plan/stop", scene.methods["qp"].stop_q),
        ("/baseline/scaling/capsules", scene.methods["scaling"].q),
    ):
        want = robot(moving_run(2.0)).ends_m(q[row])
        for i, shown in enumerate(topics[topic][0][1].entities):
            turned, at_m = frames[shown.frame_id]
            assert shown.frame_locked
            for ball, end in zip(shown.spheres, want[i], strict=True):
                centre = np.array([ball.pose.position.x, ball.pose.position.y, ball.pose.position.z])
                np.testing.assert_allclose(turned.apply(centre) + at_m, end, atol=2e-5)
                assert ball.size.x == 2 * scene.robot.radius_m[i]


def test_many_poses_at_once_are_those_of_the_robot(scene: ReplayScene) -> None:
    q = scene.methods["qp"].q
    model = robot(moving_run(2.0))
    np.testing.assert_allclose(pose_links(scene.robot, q[::17]), [model.ends_m(row) for row in q[::17]], atol=1e-12)


def test_the_distance_is_drawn_as_long_as_it_is(topics: dict[str, list[tuple[int, Any]]], scene: ReplayScene) -> None:
    row = 33
    (line,) = topics["/plan/distance"][row][1].entities[0].lines
    start, end = (np.array([point.x, point.y, point.z]) for point in line.points)
    links, share = robot(moving_run(2.0)).ends_m(scene.methods["qp"].q[row]), np.linspace(0.0, 1.0, 201)[:, None]
    apart = min(
        float(np.linalg.norm((a + share * (b - a))[:, None] - (c + share * (d - c))[None], axis=2).min()) - r - s
        for (a, b), r in zip(links, scene.robot.radius_m, strict=True)
        for (c, d), s in zip(scene.body_m[row], scene.body_radius_m, strict=True)
    )
    assert np.linalg.norm(end - start) == pytest.approx(abs(apart), abs=2e-3)


def test_numbers_over_time_are_those_of_the_record(
    topics: dict[str, list[tuple[int, Any]]], scene: ReplayScene
) -> None:
    track = scene.methods["scaling"]
    rows = [row for _, row in topics["/baseline/scaling/series"]]
    assert "distance_m" not in rows[5]  # nobody is known yet
    np.testing.assert_allclose([row["tcp_speed"] for row in rows], track.tcp_speed, atol=0.51e-4)
    known, index = track.names["status"]
    assert [row["status"] for row in rows] == [known[i] for i in index.tolist()]
    assert all(row["certified"] is True for row in rows)


def test_each_number_over_time_has_the_one_type_of_its_schema(
    file: Path, topics: dict[str, list[tuple[int, Any]]]
) -> None:
    """Foxglove Studio refuses a whole topic if a type is not a single word: its plots are empty."""
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    (text,) = {one.data for one in summary.schemas.values() if one.encoding == "jsonschema"}
    types = {name: field["type"] for name, field in json.loads(text)["properties"].items()}
    python = {"number": (int, float), "string": (str,), "boolean": (bool,)}
    rows = [row for topic, found in topics.items() if topic.endswith("/series") for _, row in found]
    assert {name for row in rows for name in row} == types.keys()
    for row in rows:
        for name, value in row.items():
            assert type(value) in python[types[name]], (name, value)
            assert types[name] != "number" or np.isfinite(value), name  # JSON has no NaN


def test_the_paths_are_those_of_the_tool(topics: dict[str, list[tuple[int, Any]]], scene: ReplayScene) -> None:
    """Programmed and driven, of every method, as connected lines that leave the path by at most a step."""
    for k, (name, track) in enumerate(scene.methods.items()):
        ((t_ns, update),) = topics["/plan/path" if k == 0 else f"/baseline/{name}/path"]
        assert t_ns == scene.t_ns[0]
        assert [one.id for one in update.entities] == [f"programmed, {name}", f"driven, {name}"]
        for one, path_m in zip(update.entities, (track.ref_m, track.tcp_m), strict=True):
            corners = np.array([[p.x, p.y, p.z] for p in one.lines[0].points]).reshape(-1, 2, 3)
            np.testing.assert_array_equal(corners[1:, 0], corners[:-1, 1])
            known = path_m[np.isfinite(path_m).all(axis=1)]
            np.testing.assert_allclose(corners[[0, -1], [0, 1]], known[[0, -1]], atol=1e-4)
            off_m = [np.linalg.norm(corners.reshape(-1, 3) - point, axis=1).min() for point in known]
            assert max(off_m) < 0.006


def test_a_volume_is_drawn_on_hull_and_ball(topics: dict[str, list[tuple[int, Any]]], scene: ReplayScene) -> None:
    t_ns, update = topics["/volumes"][3]
    stored = np.flatnonzero(scene.volumes.t_ns == t_ns)
    assert len(update.entities) == len(stored) == 6
    for k, entity in zip(stored.tolist(), update.entities, strict=True):
        vertices = scene.volumes.vertices_m[scene.volumes.offsets[k] : scene.volumes.offsets[k + 1]]
        corners = np.array([[point.x, point.y, point.z] for point in entity.triangles[0].points])
        radius_m = scene.volumes.radius_m[k]
        whole = ConvexHull((vertices[:, None] + radius_m * ball()).reshape(-1, 3))
        assert (
            corners @ whole.equations[:, :3].T + whole.equations[:, 3]
        ).max() < 0.02 * radius_m + 1e-3  # not outside
        assert ConvexHull(corners).volume > 0.93 * whole.volume
        faces = corners[np.reshape(entity.triangles[0].indices, (-1, 3))]
        closed = np.einsum("ij,ij->i", faces[:, 0], np.cross(faces[:, 1], faces[:, 2])).sum() / 6.0
        assert closed == pytest.approx(ConvexHull(corners).volume, rel=0.05)  # closed, and its faces look outward


def test_a_volume_is_drawn_down_to_the_floor() -> None:
    """Legs reach their radius beyond the line from floor to pelvis; below the floor nothing is drawn."""
    legs, radius_m = np.array([[0.2, 0.1, 0.0], [0.4, 0.1, 0.9]]), 0.4
    corners, triangles = surface_mesh(legs, radius_m)
    assert corners[:, 2].min() == 0.0
    assert corners[:, 2].max() == pytest.approx(1.3, abs=0.01)
    on_floor = corners[corners[:, 2] == 0.0]
    assert on_floor[:, 0].min() == pytest.approx(0.2 - radius_m, abs=0.02)
    faces = corners[triangles]
    closed = np.einsum("ij,ij->i", faces[:, 0], np.cross(faces[:, 1], faces[:, 2])).sum() / 6.0
    asked = np.random.default_rng(4).uniform([-0.3, -0.4, 0.0], [0.9, 0.6, 1.4], size=(200_000, 3))
    along = np.clip((asked - legs[0]) @ (legs[1] - legs[0]) / np.dot(legs[1] - legs[0], legs[1] - legs[0]), 0.0, 1.0)
    inside = np.linalg.norm(asked - legs[0] - along[:, None] * (legs[1] - legs[0]), axis=1) <= radius_m
    assert closed == pytest.approx(inside.mean() * 1.2 * 1.0 * 1.4, rel=0.05)
    assert len(surface_mesh(legs - [0.0, 0.0, 5.0], radius_m)[0]) == 0


def ball() -> np.ndarray:
    """Directions all around, not those of the picture."""
    unit = np.random.default_rng(3).normal(size=(1000, 3))
    return np.asarray(unit / np.linalg.norm(unit, axis=1, keepdims=True))


def test_a_limb_that_is_not_known_has_no_surface() -> None:
    assert surface(np.full((1, 3), np.nan), 0.2).encode() == surface(np.zeros((0, 3)), 0.2).encode()
    assert len(surface(np.full((1, 3), np.nan), 0.2).encode()) < 64


def test_the_same_scene_gives_the_same_bytes(file: Path, scene: ReplayScene, tmp_path: Path) -> None:
    write_scene(tmp_path / "again.mcap", scene, moving_run(4.0).measurements)
    assert (tmp_path / "again.mcap").read_bytes() == file.read_bytes()


def test_the_layout_shows_topics_that_there_are(topics: dict[str, list[tuple[int, Any]]]) -> None:
    layout = json.loads(LAYOUT.read_text())
    shown = layout["configById"]["3D!scene"]["topics"]
    assert set(shown) - {"/objects", "/cameras", "/watched"} <= topics.keys()  # these only where a cell has them
    transforms = layout["configById"]["3D!scene"]["scene"]["transforms"]  # else axes, and lines to their parents
    assert (transforms["axisScale"], transforms["lineWidth"]) == (0, 0)
    layer = layout["configById"]["3D!scene"]["layers"]["robot"]
    assert {layer["topic"], layer["jointStatesTopic"]} <= topics.keys()
    assert "base" in [one.child_frame_id for one in topics["/tf"][0][1].transforms]
    paths = [path["value"] for panel in layout["configById"].values() for path in panel.get("paths", ())]
    assert len(paths) > 4
    told = {name for _, row in topics["/plan/series"] for name in row}
    assert {path.partition(".")[0] for path in paths} == {"/plan/series"}
    assert {path.partition(".")[2] for path in paths} <= told


def test_objects_are_closed_surfaces_around_their_hulls(scene: ReplayScene, tmp_path: Path) -> None:
    corners = np.array([[x, y, z] for x in (0.4, 1.0) for y in (-0.5, 0.5) for z in (0.70, 0.74)])
    pipe = np.array([[0.0, 1.0, 0.2], [0.0, 1.0, 1.2]])
    objects = (StaticHull("table", corners, 0.0), StaticHull("pipe", pipe, 0.1))
    write_scene(tmp_path / "scene.mcap", dataclasses.replace(scene, objects=objects), None)
    found = _topics(tmp_path / "scene.mcap")
    ((t_ns, update),) = found["/objects"]
    assert t_ns == scene.t_ns[0]
    assert [entity.id for entity in update.entities] == ["object 0 table", "object 1 pipe"]
    for entity, least, most in zip(update.entities, (0.024, 0.0328), (0.0241, 0.0357), strict=True):
        (shape,) = entity.triangles
        points = np.array([[p.x, p.y, p.z] for p in shape.points])
        a, b, c = points[np.array(shape.indices).reshape(-1, 3).T]
        volume = float((np.cross(a, b) * c).sum()) / 6.0
        assert least <= volume + 1e-9 <= most
    assert "/objects" not in _topics_of_scene(scene, tmp_path / "other.mcap")


def _topics_of_scene(scene: ReplayScene, path: Path) -> dict[str, list[tuple[int, Any]]]:
    write_scene(path, scene, None)
    return _topics(path)


def test_the_urdf_is_attached_and_told_with_the_positions_of_its_joints(
    file: Path, topics: dict[str, list[tuple[int, Any]]], scene: ReplayScene, tmp_path: Path
) -> None:
    """pinocchio makes a robot of the attachment, and the joint states bring its links to where the tables have them."""
    with file.open("rb") as stream:
        (attached,) = make_reader(stream).iter_attachments()
    assert (attached.name, attached.media_type) == ("robot.urdf", "application/xml")
    ((_, told),) = topics["/robot_description"]
    length = int.from_bytes(told[4:8], "little")
    assert told[8 : 8 + length - 1] == attached.data
    (tmp_path / "robot.urdf").write_bytes(attached.data)
    model = pin.buildModelFromUrdf(str(tmp_path / "robot.urdf"))
    shapes = pin.buildGeomFromUrdf(model, str(tmp_path / "robot.urdf"), pin.GeometryType.VISUAL)
    assert len(shapes.geometryObjects) == 3 * len(scene.robot.links)  # a cylinder and two balls of each capsule
    row = 57
    t_ns, states = topics["/plan/joints"][row]
    assert t_ns == scene.t_ns[row]
    q = np.zeros(model.nq)
    for joint in states.joints:
        q[model.joints[model.getJointId(joint.name)].idx_q] = joint.position
    np.testing.assert_allclose(q, scene.methods["qp"].q[row], atol=1e-6)
    data, placed = model.createData(), shapes.createData()
    pin.updateGeometryPlacements(model, data, shapes, placed, q)
    frames = {one.child_frame_id: one for one in topics["/tf"][row][1].transforms}
    root, last = frames["base"].translation, ""
    T = np.eye(4)
    for name in ("base", *(f"link_{axis}" for axis in range(1, 7)), "flange"):  # the frames are a tree as the URDF's
        one = frames[name]
        assert one.parent_frame_id == ("world" if name == "base" else last)
        step, last = np.eye(4), name
        turn = [one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w]
        step[:3, :3] = Rotation.from_quat(turn).as_matrix()
        step[:3, 3] = one.translation.x, one.translation.y, one.translation.z
        T = T @ step
    pin.updateFramePlacements(model, data)
    flange = data.oMf[model.getFrameId("flange")]
    np.testing.assert_allclose(T[:3, 3], flange.translation + np.array([root.x, root.y, root.z]), atol=2e-5)
    np.testing.assert_allclose(T[:3, :3], flange.rotation, atol=2e-5)
    balls = [k for k, one in enumerate(shapes.geometryObjects) if type(one.geometry).__name__ == "Sphere"]
    centres = np.array([placed.oMg[k].translation for k in balls]) + np.array([root.x, root.y, root.z])
    want = robot(moving_run(2.0)).ends_m(scene.methods["qp"].q[row]).reshape(-1, 3)
    for end in want:
        assert np.linalg.norm(centres - end, axis=1).min() < 1e-5


def test_the_robot_is_shown_by_its_meshes_in_the_frames_of_its_axes(
    topics: dict[str, list[tuple[int, Any]]], scene: ReplayScene
) -> None:
    ((_, update),) = topics["/plan/robot"]
    bodies = [one for one in update.entities if one.triangles]
    assert [one.frame_id for one in bodies] == ["world", *(f"qp axis {axis}" for axis in range(1, 7))]
    for body, mesh in zip(bodies, scene.robot.meshes, strict=True):
        corners = np.array([[p.x, p.y, p.z] for p in body.triangles[0].points]).reshape(-1, 3, 3)
        np.testing.assert_allclose(corners, mesh.vertices_m[mesh.triangles], atol=0.51e-4)
    assert [one.id for one in update.entities if not one.triangles] == [
        "plan/robot tool"
    ]  # a capsule: no mesh shows it


def test_the_recorded_body_is_shown_by_its_capsules(
    topics: dict[str, list[tuple[int, Any]]], scene: ReplayScene
) -> None:
    row = 33
    (body,) = topics["/person/recorded"][row][1].entities
    centres = np.array([[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in body.spheres])
    np.testing.assert_allclose(centres, scene.body_m[row].reshape(-1, 3), atol=0.51e-3)
    np.testing.assert_allclose([one.size.x for one in body.spheres], np.repeat(2.0 * scene.body_radius_m, 2))
    lengths = np.linalg.norm(scene.body_m[row, :, 1] - scene.body_m[row, :, 0], axis=1)
    np.testing.assert_allclose([one.size.z for one in body.cylinders], lengths, atol=2e-3)


def test_cameras_are_shown_by_what_they_see(scene: ReplayScene, tmp_path: Path) -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [-100.0, 0.0, 30.0], degrees=True).as_matrix()
    T[:3, 3] = 2.0, -1.0, 1.4
    sight = CameraSight("kinect", T, (float(np.tan(0.5)), float(np.tan(0.4))), True)
    found = _topics_of_scene(dataclasses.replace(scene, cameras=(sight,)), tmp_path / "seen.mcap")
    ((_, update),) = found["/cameras"]
    points = np.array([[p.x, p.y, p.z] for p in update.entities[0].lines[0].points])
    in_camera = (points - T[:3, 3]) @ T[:3, :3]
    depth = in_camera[:, 2].max()
    far = in_camera[in_camera[:, 2] > 0.5 * depth]
    np.testing.assert_allclose(np.abs(far[:, 0] / far[:, 2]), np.tan(0.5), atol=2e-3)
    np.testing.assert_allclose(np.abs(far[:, 1] / far[:, 2]), np.tan(0.4), atol=2e-3)
    assert len(points) == 16
