"""The 3-D scene of a run for the Rerun viewer, by rerun-sdk: an .rrd file with a blueprint.

Times are seconds on the report's clock. Each body of a robot hangs on an entity that its axes move, so its shape is
stored once.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.errors import SettingsError
from hrcreplay.geometry.distances import nearest_pair
from hrcreplay.records import LENGTHS, POINTS, Floats
from hrcreplay.reporting.figures.drawing import BONES
from hrcreplay.reporting.metrics.series import thin_stretches
from hrcreplay.reporting.replay_scene import MethodTrack, ReplayScene, at_rate, placements, pose_links, shown_skeletons
from hrcreplay.reporting.scene_messages import surface_mesh, upright_to, whole_surface
from hrcreplay.reporting.tables import part_name_text
from hrcreplay.store.stored_table import RunTable

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ImportError:
    rr = rrb = None  # type: ignore[assignment]

#: Name of the timeline.
TIMELINE = "time"
#: Maximum rate of volumes [Hz], and the time after which one that has no successor is cleared [s].
_VOLUME_HZ, _STALE_S = 5.0, 0.3
_ROBOT, _OTHER, _STOP = (217, 130, 59), (140, 150, 160, 140), (0, 131, 110, 90)
_PERSON, _BONES, _CAMERA = (111, 168, 208), (18, 63, 99), (90, 150, 80)
_VOLUME, _OBJECT, _DISTANCE = (240, 160, 30, 70), (150, 140, 125, 190), (122, 31, 162)
_PROGRAMMED, _DRIVEN = (0, 114, 178), (213, 94, 0)
_PIXELS = (640, 480)
_VIEW_DEPTH_M = 0.35
_PAIRS = np.array([[POINTS.index(a), POINTS.index(b)] for a, b in BONES])


def write_scene(path: Path, scene: ReplayScene, measurements: RunTable | None, name: str) -> None:
    """Writes the scene of a run.

    Args:
        path: File to create.
        scene: The scene.
        measurements: Rows of measurements.parquet: the skeletons of the cameras; None without them.
        name: Id of the recording.

    Raises:
        SettingsError: rerun-sdk is missing.
    """
    if rr is None:
        raise SettingsError("--rerun: rerun-sdk is not installed; install it with: pip install 'hrcreplay[rerun]'")
    recording = rr.RecordingStream("hrcreplay", recording_id=name, send_properties=False)
    recording.set_log_time_enabled(False)  # the clock of this computer says nothing
    recording.set_log_tick_enabled(False)
    recording.save(path, default_blueprint=_blueprint(scene))
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_cell(recording, scene)
    for method, track in scene.methods.items():
        _log_robot(recording, scene, method, track.q, _ROBOT if method == next(iter(scene.methods)) else _OTHER)
        _log_paths(recording, method, track)
        _log_series(recording, scene, method, track)
    plan = next(iter(scene.methods))
    _log_robot(recording, scene, f"{plan}_stop", scene.methods[plan].stop_q, _STOP, capsules=True)
    _log_people(recording, scene)
    _log_volumes(recording, scene)
    _log_distance(recording, scene)
    _log_seen(recording, scene, measurements)
    recording.flush()
    recording.disconnect()


def _blueprint(scene: ReplayScene) -> Any:
    """Returns what the viewer shows first: the plan's robot beside the people, its speeds, distances and status."""
    plan, *others = scene.methods
    hidden = [f"- /world/robot/{name}/**" for name in others] + [f"- /world/paths/{name}/**" for name in others]
    hidden += ["- /world/seen/**"]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/world", contents=["+ /world/**", *hidden], name="scene"),
            rrb.Vertical(
                rrb.TimeSeriesView(origin=f"/plots/{plan}/speed", name="speed of the TCP [m/s]"),
                rrb.TimeSeriesView(origin=f"/plots/{plan}/distance", name="distance from the robot's surface [m]"),
                rrb.TextLogView(origin=f"/status/{plan}", name="status"),
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        collapse_panels=True,
    )


def _at(scene: ReplayScene, rows: Any = slice(None)) -> Any:
    return rr.TimeColumn(TIMELINE, duration=scene.seconds[rows])


def _log_cell(recording: Any, scene: ReplayScene) -> None:
    """Logs what stands still: objects, cameras and the watched area."""
    for k, one in enumerate(scene.objects):
        corners, triangles = whole_surface(one.vertices_m, one.radius_m)
        recording.log(f"world/objects/{_word(one.name)}_{k}", _mesh(corners, triangles, _OBJECT), static=True)
    for sight in scene.cameras:
        place = f"world/cameras/{_word(sight.name)}"
        T, (across, down) = sight.T_world_camera, sight.half_view
        recording.log(place, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
        focal = [0.5 * _PIXELS[0] / across, 0.5 * _PIXELS[1] / down]
        pinhole = rr.Pinhole(
            focal_length=focal,
            resolution=list(_PIXELS),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_VIEW_DEPTH_M,
        )
        recording.log(place, pinhole, static=True)
    if len(scene.watched_m):
        corners = np.column_stack([scene.watched_m, np.zeros(len(scene.watched_m))])
        border = rr.LineStrips3D([np.vstack([corners, corners[:1]])], colors=[_VOLUME[:3]], radii=[0.01])
        recording.log("world/watched", border, static=True)


def _mesh(corners_m: Floats, triangles: Any, colour: tuple[int, ...]) -> Any:
    """Makes a mesh whose triangles have corners of their own, so that its edges are sharp."""
    own = corners_m[np.asarray(triangles).ravel()].reshape(-1, 3, 3)
    across = np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0])
    normals = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    return rr.Mesh3D(
        vertex_positions=own.reshape(-1, 3),
        vertex_normals=np.repeat(normals, 3, axis=0),
        triangle_indices=np.arange(3 * len(own)).reshape(-1, 3),
        albedo_factor=colour,
    )


def _log_robot(
    recording: Any, scene: ReplayScene, name: str, q: Floats, colour: tuple[int, ...], *, capsules: bool = False
) -> None:
    """Logs a robot: its shapes once, and the pose of each of its axes at every instant with known joints.

    Args:
        recording: To log to.
        scene: The scene.
        name: Name of the method.
        q: (n, nv) [rad].
        colour: Red, green, blue and, if not opaque, opacity.
        capsules: True: by its capsules alone, even where it has meshes.
    """
    robot, place = scene.robot, f"world/robot/{_word(name)}"
    meshes = () if capsules else robot.meshes
    for k, mesh in enumerate(meshes):
        shape = _mesh(mesh.vertices_m, mesh.triangles, colour)
        recording.log(f"{place}/axis_{robot.axes_of(mesh)}/mesh_{k}", shape, static=True)
    covered = {mesh.link for mesh in meshes}
    for k, link in enumerate(robot.links):
        if k not in covered:
            shape = _capsules(robot.ends_m[k][None], robot.radius_m[k : k + 1], colour)
            recording.log(f"{place}/axis_{robot.moved_by[k]}/{_word(link)}", shape, static=True)
    known = np.flatnonzero(np.isfinite(q).all(axis=1))
    if not len(known):
        return
    for axis, (turned, at_m) in enumerate(placements(robot, q[known]), start=1):
        columns = rr.Transform3D.columns(translation=at_m, quaternion=turned.as_quat(canonical=True))
        recording.send_columns(f"{place}/axis_{axis}", indexes=[_at(scene, known)], columns=columns)


def _capsules(ends_m: Floats, radius_m: Floats, colour: tuple[int, ...]) -> Any:
    """Makes capsules between two points each, (n, 2, 3) and (n,) [m]."""
    return rr.Capsules3D(**_capsule_fields(ends_m, radius_m), colors=[colour] * len(ends_m))


def _capsule_fields(ends_m: Floats, radius_m: Floats) -> dict[str, Any]:
    along = ends_m[:, 1] - ends_m[:, 0]
    lengths_m = np.linalg.norm(along, axis=1)
    return {
        "lengths": lengths_m,
        "radii": radius_m,
        "translations": ends_m[:, 0],
        "quaternions": upright_to(along, lengths_m),
    }


def _log_paths(recording: Any, method: str, track: MethodTrack) -> None:
    """Logs the programmed and the driven path of the TCP."""
    for name, points_m, colour in (("programmed", track.ref_m, _PROGRAMMED), ("driven", track.tcp_m, _DRIVEN)):
        if stretches := thin_stretches(points_m, 0.005):
            line = rr.LineStrips3D(stretches, colors=[colour], radii=[0.003])
            recording.log(f"world/paths/{_word(method)}/{name}", line, static=True)


def _log_series(recording: Any, scene: ReplayScene, method: str, track: MethodTrack) -> None:
    """Logs the numbers of a method, without instants at which they are not known, and its status where it changes."""
    place = f"plots/{_word(method)}"
    for name, values in (
        ("speed/programmed", track.ref_speed),
        ("speed/driven", track.tcp_speed),
        ("distance/to_volumes", track.distance_m),
        ("distance/to_body", track.body_m),
        ("horizon", track.horizon_s),
    ):
        known = np.flatnonzero(np.isfinite(values))
        if len(known):
            columns = rr.Scalars.columns(scalars=values[known])
            recording.send_columns(f"{place}/{name}", indexes=[_at(scene, known)], columns=columns)
    (statuses, status), (reasons, reason) = track.names["status"], track.names["reason"]
    changes = np.flatnonzero(np.diff(status, prepend=-2) | np.diff(reason, prepend=-2))
    for row in changes.tolist():
        words = [names[index[row]] for names, index in ((statuses, status), (reasons, reason)) if index[row] >= 0]
        recording.set_time(TIMELINE, duration=float(scene.seconds[row]))
        level = "WARN" if words[:1] == ["braking"] else "INFO"
        recording.log(f"status/{_word(method)}", rr.TextLog(": ".join(words) or "no record", level=level))
    recording.reset_time()


def _log_people(recording: Any, scene: ReplayScene) -> None:
    """Logs the recorded body and the fused skeleton of each person."""
    count = len(scene.people)
    owned = np.split(np.arange(len(scene.body_parts)), count)
    for one, parts, pairs in zip(scene.people, owned, np.split(scene.bones, count), strict=True):
        place = f"world/person_{one.replace(' ', '_')}"
        known = np.isfinite(scene.body_m[:, parts]).all(axis=(2, 3))
        if known.any():
            radius_m = np.broadcast_to(scene.body_radius_m[parts], known.shape)
            fields = _capsule_fields(scene.body_m[:, parts][known], radius_m[known])
            columns = rr.Capsules3D.columns(**fields, colors=np.full((known.sum(), 3), _PERSON, np.uint8))
            indexes = [_at(scene)]
            recording.log(
                f"{place}/body", rr.Capsules3D.from_fields(fill_mode=rr.components.FillMode.Solid), static=True
            )
            recording.send_columns(f"{place}/body", indexes=indexes, columns=columns.partition(known.sum(axis=1)))
        for row, strips in _shown_bones(scene.points_m, pairs):
            recording.set_time(TIMELINE, duration=float(scene.seconds[row]))
            recording.log(f"{place}/skeleton", rr.LineStrips3D(list(strips), colors=[_BONES], radii=[0.008]))
    recording.reset_time()


def _shown_bones(points_m: Floats, pairs: Any) -> Iterator[tuple[int, Floats]]:
    """Yields the known lines of a skeleton at every instant; once none after some."""
    before = False
    for row, points in enumerate(points_m):
        lines = points[pairs]
        lines = lines[np.isfinite(lines).all(axis=(1, 2))]
        if len(lines) or before:
            yield row, lines
        before = bool(len(lines))


def _log_volumes(recording: Any, scene: ReplayScene) -> None:
    """Logs each volume at its instant, with its horizon, and clears it when it is stale."""
    stored = scene.volumes.rows(at_rate(scene.volumes.t_ns, _VOLUME_HZ))
    seconds = (stored.t_ns - scene.t0_ns) * 1e-9
    for limb, name in enumerate(stored.limbs):
        place = f"world/volumes/{_word(part_name_text(name))}"
        rows = np.flatnonzero(stored.limb == limb)
        for row, after in zip(rows.tolist(), [*rows[1:].tolist(), None], strict=True):
            hull = stored.vertices_m[stored.offsets[row] : stored.offsets[row + 1]]
            corners, triangles = surface_mesh(hull, float(stored.radius_m[row]))
            recording.set_time(TIMELINE, duration=float(seconds[row]))
            if len(corners):
                horizon = rr.AnyValues(horizon_s=float(stored.horizon_s[row]))
                recording.log(place, _mesh(corners, triangles, _VOLUME), horizon)
            if not len(corners) or after is None or seconds[after] - seconds[row] > _STALE_S:
                recording.set_time(TIMELINE, duration=float(seconds[row]) + (_STALE_S if len(corners) else 0.0))
                recording.log(place, rr.Clear(recursive=False))
    recording.reset_time()


def _log_distance(recording: Any, scene: ReplayScene) -> None:
    """Logs the line from the surface of the plan's robot to the nearest part of a recorded body."""
    if not len(scene.body_parts):
        return
    robot, track = scene.robot, next(iter(scene.methods.values()))
    pair = nearest_pair(pose_links(robot, track.q), robot.radius_m, scene.body_m, scene.body_radius_m)
    known = np.flatnonzero(np.isfinite(pair.distance_m))
    if not len(known):
        return
    apart = pair.at_second_m - pair.at_first_m
    towards = apart / np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-12)
    start = pair.at_first_m + robot.radius_m[pair.first][:, None] * towards
    end = pair.at_second_m - scene.body_radius_m[pair.second][:, None] * towards
    columns = rr.LineStrips3D.columns(strips=np.stack([start, end], axis=1)[known], colors=[_DISTANCE] * len(known))
    recording.send_columns("world/distance", indexes=[_at(scene, known)], columns=columns)


def _log_seen(recording: Any, scene: ReplayScene, measurements: RunTable | None) -> None:
    """Logs the skeletons in each camera's frames, by arrival."""
    if measurements is None or not set(LENGTHS) <= set(measurements.columns):
        return
    for camera in sorted(measurements["camera"].unique()):
        for t_ns, points, number in shown_skeletons(measurements, camera):
            lines = points[_PAIRS]
            lines = lines[np.isfinite(lines).all(axis=(1, 2))]
            recording.set_time(TIMELINE, duration=(t_ns - scene.t0_ns) * 1e-9)
            shape = rr.LineStrips3D(list(lines), colors=[_CAMERA], radii=[0.005])
            recording.log(f"world/seen/{_word(str(camera))}/person_{number}", shape)
    recording.reset_time()


def _word(name: str) -> str:
    """Returns a name as one part of an entity's path."""
    return "".join(letter if letter.isalnum() else "_" for letter in name)
