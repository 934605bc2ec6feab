"""The 3-D scene of a live session as a Foxglove WebSocket server.

Nothing is computed while no client is connected.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import foxglove
import numpy as np
from foxglove import channels, messages
from scipy.spatial import ConvexHull

from hrcreplay.errors import SettingsError
from hrcreplay.geometry.convex_hull import above, hull
from hrcreplay.live.view.status import Scene, SceneNames, Status, unpack
from hrcreplay.records import FLOOR_Z_M, Floats, Ints, of_person
from hrcreplay.reporting.scene_messages import ROBOT, VOLUME, bones, capsule, colour, entity, points

LASTS_S = 1.0  #: time after which a person is no longer shown without a new scene; scenes come every 0.1 s [s]
_BALL = 24  # number of directions in which a hull is extended by its radius


class FoxgloveStream:
    """Topics /person, /volumes and /robot (foxglove.SceneUpdate) and /status (JSON).

    Raises:
        SettingsError: The port is taken.
    """

    def __init__(self, port: int) -> None:
        self._context = context = foxglove.Context()  # keep a reference: its channels do not keep it alive
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
        """Takes the names and radii, which are constant in a session."""
        self._cast = cast

    def watched(self) -> set[str]:
        """Topics with at least one subscriber, without their slash."""
        every: dict[str, Any] = {**self._channels, "status": self._status}
        return {name for name, channel in every.items() if channel.has_sinks()}

    def status(self, status: Status) -> None:
        """Sends a status if a client has subscribed to it."""
        if "status" in self.watched():
            self._status.log(json.dumps(status).encode())

    def scene(self, packed: bytes) -> None:
        """Sends the parts of a scene that clients have subscribed to."""
        build = {"person": self._person, "volumes": self._volumes, "robot": self._robot}
        wanted = build.keys() & self.watched()
        if not wanted:
            return
        now = unpack(packed, tuple(self._cast["limbs"]))
        for name in wanted:
            self._channels[name].log(messages.SceneUpdate(entities=build[name](now)), log_time=now.t_ns)

    def close(self) -> None:
        """Stops serving."""
        self._server.stop()

    def _person(self, now: Scene) -> list[Any]:
        people = zip(now.people.tolist(), now.points_m, strict=True)
        return [
            entity(now.t_ns, "person" if k == 1 else f"person {k}", lasts_s=LASTS_S, lines=[bones(points_m)])
            for k, points_m in people
        ]

    def _volumes(self, now: Scene) -> list[Any]:
        entities, volumes = [], now.occupied.volumes
        for row, number in enumerate(now.occupied.people.tolist()):
            for limb, (vertices_m, radius_m) in volumes.at(row).items():
                corners, faces = mesh(vertices_m, radius_m)
                triangles = messages.TriangleListPrimitive(
                    points=points(corners), indices=faces.ravel().tolist(), color=colour(VOLUME)
                )
                name = f"volume {of_person(limb, number)}"
                entities.append(entity(now.t_ns, name, lasts_s=LASTS_S, triangles=[triangles]))
        return entities

    def _robot(self, now: Scene) -> list[Any]:
        links = zip(self._cast["links"], self._cast["radii_m"], now.ends_m, strict=True)
        return [entity(now.t_ns, f"robot {link}", **capsule(ends, radius_m, ROBOT)) for link, radius_m, ends in links]


def mesh(vertices_m: Floats, radius_m: float) -> tuple[Floats, Ints]:
    """Surface of hull + ball above the floor, in the format of ``hull``; empty if there is no volume.

    A polyhedron around the ball replaces the ball, so the picture is never smaller than the volume.
    """
    if not len(vertices_m) or not np.isfinite(vertices_m).all():
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    corners, faces = hull((vertices_m[:, None, :] + radius_m * _around_a_ball()).reshape(-1, 3))
    return above(corners, faces, FLOOR_Z_M) if corners[:, 2].min() < FLOOR_Z_M else (corners, faces)


@cache
def _around_a_ball() -> Floats:
    """(24, 3) corners of a polyhedron around the unit ball, spread evenly by the golden angle."""
    k = np.arange(_BALL) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * k / _BALL), np.pi * (1.0 + np.sqrt(5.0)) * k
    unit = np.column_stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)])
    return np.asarray(unit / -ConvexHull(unit).equations[:, 3].max())  # the nearest face touches the ball
