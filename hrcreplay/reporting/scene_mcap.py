"""scene.mcap: a run's 3-D scene with Foxglove's well-known messages, and the robot's URDF with its joints' positions.

The links are attached to the frames of the axes that move them, so each method's robot is drawn once and moved by /tf.
"""

from __future__ import annotations

import heapq
import json
import math
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from foxglove import messages
from mcap.writer import CompressionType, Writer
from scipy.spatial.transform import Rotation

from hrcreplay.geometry.distances import nearest_pair
from hrcreplay.records import LENGTHS, Bools, Floats
from hrcreplay.reporting import scene_messages as parts
from hrcreplay.reporting.metrics.series import thin_stretches
from hrcreplay.reporting.replay_scene import (
    LinkMesh,
    MethodTrack,
    ReplayScene,
    at_rate,
    placements,
    pose_links,
    shown_skeletons,
)
from hrcreplay.reporting.scene_messages import (
    ROBOT,
    WORLD,
    Rgba,
    bones,
    capsule,
    capsules,
    entity,
    lines,
    surface,
    timestamp,
)
from hrcreplay.store.stored_table import RunTable

#: Maximum rate of volumes [Hz].
_VOLUME_HZ = 5.0
_CHUNK_BYTES = 1024 * 1024
_STOP: Rgba = (0.00, 0.51, 0.43, 0.35)
_WATCHED: Rgba = (0.95, 0.55, 0.10, 1.0)
_OBJECT: Rgba = (0.60, 0.55, 0.48, 0.75)
_OTHER: Rgba = (0.45, 0.50, 0.55, 0.35)
_BODY: Rgba = (0.40, 0.63, 0.82, 1.0)
_CAMERA: Rgba = (0.35, 0.60, 0.30, 0.8)
_DISTANCE: Rgba = (0.48, 0.12, 0.64, 1.0)
_PROGRAMMED: Rgba = (0.00, 0.45, 0.70, 1.0)
_DRIVEN: Rgba = (0.84, 0.37, 0.00, 1.0)
_BONE_M = 0.02
#: Steps and thickness of a drawn path [m].
_PATH_M = 0.005
#: Depth of the drawn view of a camera [m].
_VIEW_DEPTH_M = 0.35
#: A message: topic, instant [ns], and content.
Message = tuple[str, int, Any]
#: Numbers of a method over time, for plots. One type for each: Foxglove Studio refuses a choice of types.
_SERIES = ("tcp_speed", "ref_speed", "distance_m", "body_m", "horizon_s")
_SERIES_SCHEMA = {
    "type": "object",
    "properties": {
        **{name: {"type": "number"} for name in _SERIES},
        **{name: {"type": "string"} for name in ("status", "reason", "limb", "link")},
        "certified": {"type": "boolean"},
    },
}


def foxglove_layout() -> str:
    """Returns the layout in which Foxglove shows such a scene."""
    return resources.files("hrcreplay.reporting").joinpath("foxglove-layout.json").read_text("utf-8")


def write_scene(path: Path, scene: ReplayScene, measurements: RunTable | None) -> None:
    """Writes the scene of a run.

    Args:
        path: File to create.
        scene: The scene.
        measurements: Rows of measurements.parquet: the skeletons of the cameras; None without them.
    """
    streams = [_description(scene), _robots(scene), _paths(scene), _watched(scene), _objects(scene), _sights(scene)]
    streams += [_transforms(scene), _joints(scene), _person(scene), _volumes(scene), _distances(scene)]
    streams += [_series(scene, name, track) for name, track in scene.methods.items()]
    streams += _cameras(measurements)
    found = heapq.merge(*streams, key=lambda message: message[1])  # one instant: in the order of the streams
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="", library="hrcreplay")  # the version of the library would change the bytes
        start_ns, urdf = int(scene.t_ns[0]), scene.robot.urdf.encode()
        writer.add_attachment(start_ns, start_ns, "robot.urdf", "application/xml", urdf)
        channels: dict[str, int] = {}
        for topic, t_ns, message in found:
            if topic not in channels:
                channels[topic] = _channel(writer, topic, message)
            data = (
                message
                if isinstance(message, bytes)
                else _cdr(message)
                if isinstance(message, str)
                else message.encode()
            )
            writer.add_message(channels[topic], log_time=t_ns, publish_time=t_ns, data=data)
        writer.finish()  # type: ignore[no-untyped-call]


def _cdr(text: str) -> bytes:
    """Returns a std_msgs/String as ROS 2 writes it."""
    encoded = text.encode() + b"\0"
    return b"\x00\x01\x00\x00" + len(encoded).to_bytes(4, "little") + encoded


def _channel(writer: Writer, topic: str, message: Any) -> int:
    if isinstance(message, str):
        schema = writer.register_schema(name="std_msgs/msg/String", encoding="ros2msg", data=b"string data\n")
        return int(writer.register_channel(topic=topic, message_encoding="cdr", schema_id=schema))
    if isinstance(message, bytes):
        text = json.dumps(_SERIES_SCHEMA, sort_keys=True).encode()
        schema = writer.register_schema(name="hrcreplay.Series", encoding="jsonschema", data=text)
        return int(writer.register_channel(topic=topic, message_encoding="json", schema_id=schema))
    known = type(message).get_schema()
    schema = writer.register_schema(name=known.name, encoding=known.encoding, data=known.data)
    return int(writer.register_channel(topic=topic, message_encoding="protobuf", schema_id=schema))


def _base(scene: ReplayScene, name: str) -> str:
    """Returns the topic of a method; the run's own method has that of the plan."""
    return "/plan" if name == next(iter(scene.methods)) else f"/baseline/{name}"


def _description(scene: ReplayScene) -> Iterator[Message]:
    """Yields the robot's URDF, for Foxglove's layer of that kind."""
    yield "/robot_description", int(scene.t_ns[0]), scene.robot.urdf


def _joints(scene: ReplayScene) -> Iterator[Message]:
    """Yields the positions of the axes of the plan's robot."""
    table = np.round(next(iter(scene.methods.values())).q, 6).tolist()
    for t_ns, row in zip(scene.t_ns.tolist(), table, strict=True):
        joints = [
            messages.JointState(name=name, position=position)
            for name, position in zip(scene.robot.joints, row, strict=True)
            if position == position  # NaN: not known
        ]
        if joints:
            yield "/plan/joints", t_ns, messages.JointStates(timestamp=timestamp(t_ns), joints=joints)


def _mesh_entity(scene: ReplayScene, mesh: LinkMesh, name: str, frame: str, rgba: Rgba) -> Any:
    """Returns the surface of a body of the robot, every triangle with corners of its own, so that edges are sharp."""
    corners = np.round(mesh.vertices_m[mesh.triangles.ravel()], 4)
    shape = messages.TriangleListPrimitive(points=parts.points(corners), color=parts.colour(rgba))
    return entity(int(scene.t_ns[0]), name, frame=frame, triangles=[shape])


def _meshes(scene: ReplayScene, method: str, where: str, rgba: Rgba) -> Any:
    """Returns the meshes of a method's robot, and the capsules of links without one."""
    robot = scene.robot
    covered = {mesh.link for mesh in robot.meshes}
    entities = [
        _mesh_entity(scene, mesh, f"{where[1:]} body {k}", _frame(method, robot.axes_of(mesh), ""), rgba)
        for k, mesh in enumerate(robot.meshes)
    ]
    entities += [
        _capsule_entity(scene, i, f"{where[1:]} {link}", _frame(method, int(robot.moved_by[i]), ""), rgba)
        for i, link in enumerate(robot.links)
        if i not in covered
    ]
    return messages.SceneUpdate(entities=entities)


def _capsule_entity(scene: ReplayScene, link: int, name: str, frame: str, rgba: Rgba) -> Any:
    robot = scene.robot
    shapes = capsule(robot.ends_m[link], float(robot.radius_m[link]), rgba)
    return entity(int(scene.t_ns[0]), name, frame=frame, **shapes)


def _robots(scene: ReplayScene) -> Iterator[Message]:
    """Yields each method's robot by its meshes, its capsules, and the end of the plan's stop, in the axes' frames."""
    t_ns = int(scene.t_ns[0])
    for name in scene.methods:
        topic = _base(scene, name)
        rgba = ROBOT if topic == "/plan" else _OTHER
        yield f"{topic}/robot", t_ns, _meshes(scene, name, f"{topic}/robot", rgba)
        shown = [(f"{topic}/capsules", "", (*rgba[:3], 0.25))]
        if topic == "/plan":
            shown.append((f"{topic}/stop", " stop", _STOP))
        for where, suffix, rgba in shown:
            moved_by = scene.robot.moved_by.tolist()
            entities = [
                _capsule_entity(scene, i, f"{where[1:]} {link}", _frame(name, moved_by[i], suffix), rgba)
                for i, link in enumerate(scene.robot.links)
            ]
            yield where, t_ns, messages.SceneUpdate(entities=entities)


def _paths(scene: ReplayScene) -> Iterator[Message]:
    """Yields the programmed and the driven path of each method's TCP."""
    t_ns = int(scene.t_ns[0])
    for name, track in scene.methods.items():
        entities = []
        for what, points_m, rgba in (("programmed", track.ref_m, _PROGRAMMED), ("driven", track.tcp_m, _DRIVEN)):
            known = thin_stretches(points_m, _PATH_M)
            ways = np.concatenate([np.stack([one[:-1], one[1:]], axis=1) for one in known] or [np.empty((0, 2, 3))])
            if len(ways):
                entities.append(entity(t_ns, f"{what}, {name}", lines=[lines(np.round(ways, 4), _PATH_M, rgba)]))
        if entities:
            yield f"{_base(scene, name)}/path", t_ns, messages.SceneUpdate(entities=entities)


def _frame(method: str, axis: int, suffix: str) -> str:
    return f"{method}{suffix} axis {axis}" if axis else WORLD


def _watched(scene: ReplayScene) -> Iterator[Message]:
    """Yields the border of the watched area on the floor."""
    if len(scene.watched_m):
        t_ns = int(scene.t_ns[0])
        corners = np.column_stack((scene.watched_m, np.zeros(len(scene.watched_m))))
        sides = np.stack((corners, np.roll(corners, -1, axis=0)), axis=1)
        shown = entity(t_ns, "watched area", lines=[lines(sides, 0.02, _WATCHED)])
        yield "/watched", t_ns, messages.SceneUpdate(entities=[shown])


def _objects(scene: ReplayScene) -> Iterator[Message]:
    """Yields the objects of the cell, without half-spaces."""
    if not scene.objects:
        return
    t_ns = int(scene.t_ns[0])
    entities = []
    for i, one in enumerate(scene.objects):
        corners, triangles = parts.whole_surface(one.vertices_m, one.radius_m)
        shape = messages.TriangleListPrimitive(
            points=parts.points(np.round(corners, 4)), indices=triangles.ravel().tolist(), color=parts.colour(_OBJECT)
        )
        entities.append(entity(t_ns, f"object {i} {one.name}", triangles=[shape]))
    yield "/objects", t_ns, messages.SceneUpdate(entities=entities)


def _link_poses(scene: ReplayScene) -> Iterator[tuple[tuple[str, str], Floats]]:
    """Yields parent and name of each link of the URDF, and its pose in its parent: (n, 7), NaN if not known."""
    robot, q = scene.robot, next(iter(scene.methods.values())).q
    known = np.asarray(np.isfinite(q).all(axis=1))
    moved = [(Rotation.identity(len(q)), np.zeros_like(q[:, :3])), *placements(robot, np.where(known[:, None], q, 0.0))]
    poses = {}
    for one in robot.frames:
        (turned, at_m), T = moved[one.axes], robot.T_world_root @ one.T_root_link
        poses[one.name] = turned * Rotation.from_matrix(T[:3, :3]), turned.apply(T[:3, 3]) + at_m
        if one.name == WORLD:  # a link of that name stands on no frame of this scene
            continue
        turn, place_m = poses[one.name]
        if one.parent and one.parent != WORLD:
            back, origin_m = poses[one.parent]
            turn, place_m = back.inv() * turn, back.inv().apply(place_m - origin_m)
        rows = np.column_stack([np.round(place_m, 6), np.round(turn.as_quat(canonical=True), 6)])
        rows[~known] = np.nan
        yield (WORLD if one.parent in ("", WORLD) else one.parent, one.name), rows


def _sights(scene: ReplayScene) -> Iterator[Message]:
    """Yields the cameras, as the edges of the pyramids that they see."""
    if not scene.cameras:
        return
    t_ns = int(scene.t_ns[0])
    entities = []
    for one in scene.cameras:
        tip, *base = np.round(one.corners_m(_VIEW_DEPTH_M), 4)
        edges = [pair for k, corner in enumerate(base) for pair in ((tip, corner), (corner, base[(k + 1) % 4]))]
        entities.append(entity(t_ns, f"camera {one.name}", lines=[lines(np.array(edges), 0.008, _CAMERA)]))
    yield "/cameras", t_ns, messages.SceneUpdate(entities=entities)


def _transforms(scene: ReplayScene) -> Iterator[Message]:
    """Yields the frames of all axes of all methods, and of the links of the plan's URDF, one update per instant."""
    frames: list[tuple[str, str]] = []
    numbers: list[Floats] = []
    plan = next(iter(scene.methods))
    for name, track in scene.methods.items():
        for suffix, q in (("", track.q), (" stop", track.stop_q)) if name == plan else (("", track.q),):
            known = np.asarray(np.isfinite(q).all(axis=1))
            for axis, (turned, at_m) in enumerate(placements(scene.robot, np.where(known[:, None], q, 0.0)), start=1):
                frames.append((WORLD, _frame(name, axis, suffix)))
                rows = np.column_stack([np.round(at_m, 5), np.round(turned.as_quat(canonical=True), 6)])
                rows[~known] = np.nan
                numbers.append(rows)
    for names, rows in _link_poses(scene):
        frames.append(names)
        numbers.append(rows)
    table = np.stack(numbers, axis=1)
    for t_ns, rows in zip(scene.t_ns.tolist(), table, strict=True):
        stamp = timestamp(t_ns)
        yield (
            "/tf",
            t_ns,
            messages.FrameTransforms(
                transforms=[
                    messages.FrameTransform(
                        timestamp=stamp,
                        parent_frame_id=parent,
                        child_frame_id=child,
                        translation=messages.Vector3(x=x, y=y, z=z),
                        rotation=messages.Quaternion(x=qx, y=qy, z=qz, w=qw),
                    )
                    for (parent, child), (x, y, z, qx, qy, qz, qw) in zip(frames, rows.tolist(), strict=True)
                    if x == x  # NaN: the method has no such instant
                ]
            ),
        )


def _person(scene: ReplayScene) -> Iterator[Message]:
    """Yields the fused skeletons, their points, and the recorded bodies as capsules; who has gone is updated once."""
    fields = [
        messages.PackedElementField(name=axis, offset=4 * i, type=messages.PackedElementFieldNumericType.Float32)
        for i, axis in enumerate("xyz")
    ]
    names = ["" if one == "1" else f" {one}" for one in scene.people]
    pairs = np.split(scene.bones, len(names))
    owned = np.split(np.arange(len(scene.body_parts)), len(names))
    shown, body = np.round(scene.points_m, 3), np.round(scene.body_m, 3)
    origin = parts.pose(np.zeros(3))
    drawn, kept = ([_changes(ends_m[:, of_one]) for of_one in each] for ends_m, each in ((shown, pairs), (body, owned)))
    for i, t_ns in enumerate(scene.t_ns.tolist()):
        skeletons = [
            entity(t_ns, f"fused{name}", lines=[lines(shown[i, of_one], _BONE_M, parts.PERSON)])
            for name, of_one, changes in zip(names, pairs, drawn, strict=True)
            if changes[i]
        ]
        yield "/person/fused", t_ns, messages.SceneUpdate(entities=skeletons)
        known = shown[i][np.isfinite(shown[i]).all(axis=1)].astype("<f4")
        cloud = messages.PointCloud(
            timestamp=timestamp(t_ns), frame_id=WORLD, pose=origin, point_stride=12, fields=fields, data=known.tobytes()
        )
        yield "/person/points", t_ns, cloud
        bodies = [
            entity(t_ns, f"recorded{name}", **capsules(body[i, of_one], scene.body_radius_m[of_one], _BODY))
            for name, of_one, changes in zip(names, owned, kept, strict=True)
            if changes[i]
        ]
        yield "/person/recorded", t_ns, messages.SceneUpdate(entities=bodies)


def _changes(ends_m: Floats) -> list[bool]:
    """Instants at which some lines (n, k, 2, 3) are drawn, or no longer are, and the first one."""
    known: Bools = np.asarray(np.isfinite(ends_m).all(axis=(2, 3)))
    there: Bools = np.asarray(known.any(axis=1))
    before = np.concatenate([[True], there[:-1]])
    changes: list[bool] = (there | before).tolist()
    return changes


def _volumes(scene: ReplayScene) -> Iterator[Message]:
    """Yields the stored volumes; without limbs that are not predicted."""
    stored = scene.volumes
    shown = at_rate(stored.t_ns, _VOLUME_HZ)
    each_ns, first = np.unique(stored.t_ns[shown], return_index=True)
    for t_ns, rows in zip(each_ns.tolist(), np.split(shown, first)[1:], strict=True):
        entities = []
        for k in rows.tolist():
            hull = stored.vertices_m[stored.offsets[k] : stored.offsets[k + 1]]
            shape = surface(hull, float(stored.radius_m[k]))
            entities.append(entity(t_ns, f"volume {stored.limbs[stored.limb[k]]}", triangles=[shape]))
        yield "/volumes", t_ns, messages.SceneUpdate(entities=entities)


def _distances(scene: ReplayScene) -> Iterator[Message]:
    """Yields lines from the surface of the plan's robot to the nearest part of the recorded body."""
    if not len(scene.body_parts):
        return
    robot, track = scene.robot, next(iter(scene.methods.values()))
    pair = nearest_pair(pose_links(robot, track.q), robot.radius_m, scene.body_m, scene.body_radius_m)
    apart = pair.at_second_m - pair.at_first_m
    with np.errstate(invalid="ignore"):
        towards = apart / np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-12)
    start = pair.at_first_m + robot.radius_m[pair.first][:, None] * towards
    end = pair.at_second_m - scene.body_radius_m[pair.second][:, None] * towards
    for i, t_ns in enumerate(scene.t_ns.tolist()):
        line = lines(np.round(np.stack([start[i], end[i]])[None], 4), 0.01, _DISTANCE)
        yield "/plan/distance", t_ns, messages.SceneUpdate(entities=[entity(t_ns, "distance", lines=[line])])


def _series(scene: ReplayScene, name: str, track: MethodTrack) -> Iterator[Message]:
    """Yields the numbers of a method as JSON, without those that are unknown."""
    topic = f"{_base(scene, name)}/series"
    table = {key: np.round(getattr(track, key), 4).tolist() for key in _SERIES}
    texts = {kind: [known[i] if i >= 0 else "" for i in index.tolist()] for kind, (known, index) in track.names.items()}
    certified = track.certified.tolist()
    for i, t_ns in enumerate(scene.t_ns.tolist()):
        row: dict[str, Any] = {key: values[i] for key, values in table.items() if math.isfinite(values[i])}
        row |= {kind: words[i] for kind, words in texts.items()}
        if certified[i] >= 0:
            row["certified"] = bool(certified[i])
        yield topic, t_ns, json.dumps(row, sort_keys=True, separators=(",", ":")).encode()


def _cameras(measurements: RunTable | None) -> list[Iterator[Message]]:
    """Yields the skeletons in each camera's frames, by arrival, one stream per camera."""
    if measurements is None or not set(LENGTHS) <= set(measurements.columns):
        return []
    return [_camera(measurements, camera) for camera in sorted(measurements["camera"].unique())]


def _camera(measurements: RunTable, camera: str) -> Iterator[Message]:
    for t_ns, found, number in shown_skeletons(measurements, camera):
        name = f"camera {camera}" if number == 1 else f"camera {camera}, person {number}"
        shown = entity(t_ns, name, lines=[bones(np.round(found, 3), _CAMERA)])
        yield f"/camera/{camera}", t_ns, messages.SceneUpdate(entities=[shown])
