"""The 3-D scene of a live session as a Foxglove WebSocket server.

Nothing is computed while no client is connected.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from hrcreplay.errors import SettingsError
from hrcreplay.live.view.status_messages import Scene, SceneNames, Status, unpack
from hrcreplay.records import POINTS, Floats
from hrcreplay.report.drawing import BONES

_WORLD = "world"
_BALL = 24  # directions in which a hull is grown by its radius
_NS = 10**9
_PERSON = (0.10, 0.35, 0.85, 1.0)
_VOLUME = (0.95, 0.55, 0.10, 0.30)
_ROBOT = (0.95, 0.45, 0.05, 1.0)


class FoxgloveStream:
    """Topics /person, /volumes and /robot (foxglove.SceneUpdate) and /status (JSON).

    Raises:
        SettingsError: foxglove-sdk is not installed, or the port is taken.
    """

    def __init__(self, port: int) -> None:
        try:
            import foxglove
            from foxglove import channels, messages
        except ModuleNotFoundError as error:
            raise SettingsError(
                "--foxglove: foxglove-sdk is not installed; would be right: pip install 'hrcreplay[foxglove]'"
            ) from error
        self._make: Any = messages
        self._context = context = foxglove.Context()  # it does not live through its channels
        self._status = foxglove.Channel("/status", message_encoding="json", context=context)
        self._channels = {
            name: channels.SceneUpdateChannel(f"/{name}", context=context) for name in ("person", "volumes", "robot")
        }
        try:
            self._server = foxglove.start_server(name="hrcreplay live", port=port, context=context)
        except (RuntimeError, OSError) as error:
            raise SettingsError(f"--foxglove {port}: {error}; name a port that is free") from error
        self.port = self._server.port
        self._cast = SceneNames(limbs=[], links=[], radii_m=[])

    def cast(self, cast: SceneNames) -> None:
        """Takes what stays the same."""
        self._cast = cast

    def watched(self) -> set[str]:
        """Topics that somebody has subscribed to, without their slash."""
        every: dict[str, Any] = {**self._channels, "status": self._status}
        return {name for name, channel in every.items() if channel.has_sinks()}

    def status(self, status: Status) -> None:
        """Sends a status."""
        if "status" in self.watched():
            self._status.log(json.dumps(status).encode())

    def scene(self, packed: bytes) -> None:
        """Sends what of a scene somebody watches."""
        build = {"person": self._person, "volumes": self._volumes, "robot": self._robot}
        wanted = build.keys() & self.watched()
        if not wanted:
            return
        now = unpack(packed, tuple(self._cast["limbs"]))
        for name in wanted:
            self._channels[name].log(self._make.SceneUpdate(entities=build[name](now)), log_time=now.t_ns)

    def close(self) -> None:
        """Stops serving."""
        self._server.stop()

    def _person(self, now: Scene) -> list[Any]:
        ends = [now.points_m[[POINTS.index(a), POINTS.index(b)]] for a, b in BONES]
        seen = [pair for pair in ends if np.isfinite(pair).all()]
        line = self._make.LinePrimitive(
            type=self._make.LinePrimitiveLineType.LineList,
            thickness=0.02,
            points=self._points(np.reshape(seen, (-1, 3))),
            color=self._colour(_PERSON),
        )
        return [self._entity(now, "person", lines=[line])]

    def _volumes(self, now: Scene) -> list[Any]:
        entities = []
        for i, limb in enumerate(now.volumes.limbs):
            corners, faces = mesh(now.volumes.vertices(0, i), float(now.volumes.radius_m[0, i]))
            triangles = self._make.TriangleListPrimitive(
                points=self._points(corners), indices=faces.ravel().tolist(), color=self._colour(_VOLUME)
            )
            entities.append(self._entity(now, f"volume {limb}", triangles=[triangles]))
        return entities

    def _robot(self, now: Scene) -> list[Any]:
        entities = []
        for link, radius_m, (a, b) in zip(self._cast["links"], self._cast["radii_m"], now.ends_m, strict=True):
            size = 2.0 * radius_m
            balls = [
                self._make.SpherePrimitive(
                    pose=self._pose(end, (0.0, 0.0, 0.0, 1.0)),
                    size=self._make.Vector3(x=size, y=size, z=size),
                    color=self._colour(_ROBOT),
                )
                for end in (a, b)
            ]
            rod = self._make.CylinderPrimitive(
                pose=self._pose((a + b) / 2.0, upright_to(b - a)),
                size=self._make.Vector3(x=size, y=size, z=float(np.linalg.norm(b - a))),
                bottom_scale=1.0,
                top_scale=1.0,
                color=self._colour(_ROBOT),
            )
            entities.append(self._entity(now, f"robot {link}", spheres=balls, cylinders=[rod]))
        return entities

    def _entity(self, now: Scene, name: str, **shapes: Any) -> Any:
        stamp = self._make.Timestamp(now.t_ns // _NS, now.t_ns % _NS)
        return self._make.SceneEntity(timestamp=stamp, frame_id=_WORLD, id=name, **shapes)

    def _points(self, points_m: Floats) -> list[Any]:
        return [self._make.Point3(x=x, y=y, z=z) for x, y, z in points_m.tolist()]

    def _pose(self, position_m: Floats, quaternion: tuple[float, float, float, float]) -> Any:
        x, y, z = position_m.tolist()
        qx, qy, qz, qw = quaternion
        return self._make.Pose(
            position=self._make.Vector3(x=x, y=y, z=z),
            orientation=self._make.Quaternion(x=qx, y=qy, z=qz, w=qw),
        )

    def _colour(self, rgba: tuple[float, float, float, float]) -> Any:
        r, g, b, a = rgba
        return self._make.Color(r=r, g=g, b=b, a=a)


def mesh(vertices_m: Floats, radius_m: float) -> tuple[Floats, np.ndarray[Any, Any]]:
    """Surface of hull + ball: (k, 3) corners [m] and (f, 3) triangles, both empty where there is no volume.

    The ball is a polyhedron around it, so the picture is never smaller than the volume.
    """
    none = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    if not len(vertices_m) or not np.isfinite(vertices_m).all():
        return none
    cloud = (vertices_m[:, None, :] + radius_m * _around_a_ball()).reshape(-1, 3)
    try:
        hull = ConvexHull(cloud)
    except QhullError:  # no radius and flat
        return none
    used, faces = np.unique(hull.simplices, return_inverse=True)
    corners = cloud[used]
    triangles = faces.reshape(hull.simplices.shape).copy()
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    triangles[inward] = triangles[inward][:, ::-1]
    return corners, triangles


@cache
def _around_a_ball() -> Floats:
    """(24, 3) corners of a polyhedron around the unit ball, spread evenly by the golden angle."""
    k = np.arange(_BALL) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * k / _BALL), np.pi * (1.0 + np.sqrt(5.0)) * k
    unit = np.column_stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)])
    return np.asarray(unit / -ConvexHull(unit).equations[:, 3].max())  # the nearest face touches the ball


def upright_to(direction: Floats) -> tuple[float, float, float, float]:
    """The quaternion (x, y, z, w) that turns the z axis into a direction; none at all where that is zero."""
    length = float(np.linalg.norm(direction))
    if length == 0.0:
        return 0.0, 0.0, 0.0, 1.0
    x, y, z = (direction / length).tolist()
    if z < -1.0 + 1e-12:
        return 1.0, 0.0, 0.0, 0.0
    w = np.sqrt(0.5 * (1.0 + z))
    return -y / (2.0 * w), x / (2.0 * w), 0.0, float(w)
