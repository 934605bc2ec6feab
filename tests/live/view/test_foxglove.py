"""The scene of a live session as Foxglove gets it."""

from __future__ import annotations

import base64
import json
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from scipy.spatial import ConvexHull

from hrcreplay.errors import SettingsError
from hrcreplay.live.record import codec
from hrcreplay.live.view.foxglove import FoxgloveStream, mesh
from hrcreplay.live.view.status import Scene, SceneNames, pack, unpack
from hrcreplay.records import POINTS, SweptVolumes
from hrcreplay.reporting.scene_messages import upright_to
from tests.facts import facts
from tests.live.statuses import status

# --- scene ---


def scene(t_ns: int = 1_800_000_000_123_456_789) -> Scene:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(2, 20, 3))
    points[:, POINTS.index("hand_l")] = np.nan
    offsets = np.array([0, 8, 9, 17, 18], dtype=np.int64)
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    volumes = SweptVolumes(
        np.array([t_ns, t_ns]),
        offsets,
        np.vstack([corners, np.full((1, 3), np.nan), corners + 3.0, np.full((1, 3), np.nan)]),
        np.array([[0.1, 0.2], [0.3, 0.4]]),
        ("HD", "THX"),
        "",
    )
    occupied = codec.RecordedVolumes(volumes, np.array([1, 3]), 0.1)
    return Scene(t_ns, np.array([1, 3]), points, rng.normal(size=(3, 2, 3)), occupied)


def packed(now: Scene) -> bytes:
    states = SimpleNamespace(numbers=now.occupied.people)
    look = codec.Perception(now.t_ns, states, now.occupied.volumes, (), now.occupied.horizon_s)  # type: ignore[arg-type]
    return pack(now.t_ns, now.people, now.points_m, now.ends_m, codec.encode_volumes(look))


def test_a_scene_comes_out_as_it_went_in() -> None:
    sent = scene()
    found = unpack(packed(sent), ("HD", "THX"))
    assert found.t_ns == sent.t_ns
    np.testing.assert_array_equal(found.points_m, sent.points_m)
    np.testing.assert_array_equal(found.ends_m, sent.ends_m)
    np.testing.assert_array_equal(found.people, sent.people)
    np.testing.assert_array_equal(found.occupied.people, sent.occupied.people)
    mine, yours = found.occupied.volumes, sent.occupied.volumes
    for row, limb in ((0, 0), (0, 1), (1, 0), (1, 1)):
        np.testing.assert_array_equal(mine.vertices(row, limb), yours.vertices(row, limb))
    np.testing.assert_array_equal(mine.radius_m, yours.radius_m)


def test_a_mesh_holds_the_grown_hull_and_looks_outward() -> None:
    rng = np.random.default_rng(7)
    vertices = rng.normal(size=(30, 3)) + np.array([0.0, 0.0, 5.0])
    corners, faces = mesh(vertices, 0.1)
    a, b, c = (corners[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", normal, a - vertices.mean(axis=0)) > 0).all()
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0  # divergence theorem: closed and outward
    assert volume == pytest.approx(ConvexHull(corners).volume)
    unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    room = np.einsum("ij,ij->i", unit, a) - (vertices @ unit.T).max(axis=0)  # of each face beyond the vertices
    assert (room > 0.1 - 1e-12).all()
    assert (room < 0.1 * 1.4).all()


def test_a_mesh_ends_at_the_floor() -> None:
    corners, faces = mesh(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.9]]), 0.4)
    a, b, c = (corners[faces[:, k]] for k in range(3))
    assert corners[:, 2].min() == 0.0
    exact = np.pi * 0.4**2 * 0.9 + 2.0 / 3.0 * np.pi * 0.4**3
    assert exact < np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0 < 1.4 * exact
    assert len(mesh(np.array([[0.0, 0.0, -2.0]]), 0.4)[0]) == 0


@pytest.mark.parametrize("vertices", [np.full((1, 3), np.nan), np.zeros((0, 3))])
def test_a_limb_that_is_not_known_has_no_mesh(vertices: Any) -> None:
    corners, faces = mesh(vertices, 0.1)
    assert len(corners) == len(faces) == 0


def test_the_quaternions_turn_z_into_the_directions() -> None:
    directions = np.array([(0, 0, 2.0), (0, 0, -1.0), (1.0, 0, 0), (0.3, -2.0, 0.7), (0, 0, 0)])
    lengths = np.linalg.norm(directions, axis=1)
    found = upright_to(directions, lengths)
    x, y, z, w = found[:4].T
    turned = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    np.testing.assert_allclose(np.transpose(turned), directions[:4] / lengths[:4, None], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    assert found[4].tolist() == [0.0, 0.0, 0.0, 1.0]


# --- Foxglove, by a client written after the protocol's description ---


class Viewer:
    """A WebSocket client that subscribes to topics."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), 60.0)
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        self._stream = self._socket.makefile("rb")
        assert b"101" in self._stream.readline()
        while self._stream.readline().strip():
            pass
        self.channels: dict[str, Any] = {}

    def close(self) -> None:
        self._stream.close()
        self._socket.close()

    def frames(self) -> Iterator[tuple[int, bytes]]:
        while True:
            first, size = self._stream.read(2)
            if size >= 126:
                size = int.from_bytes(self._stream.read(2 if size == 126 else 8), "big")
            yield first & 15, self._stream.read(size)

    def subscribe(self, *topics: str) -> None:
        for kind, data in self.frames():
            if kind == 1:
                told = json.loads(data)
                self.channels |= {c["topic"]: c for c in told.get("channels", ())}
            if set(topics) <= self.channels.keys():
                break
        wanted = [{"id": i, "channelId": self.channels[topic]["id"]} for i, topic in enumerate(topics)]
        text = json.dumps({"op": "subscribe", "subscriptions": wanted}).encode()
        self._socket.sendall(bytes([0x81, 0x80 | 126]) + struct.pack(">H", len(text)) + bytes(4) + text)

    def message(self) -> tuple[int, int, bytes]:
        """Number of the subscription, log time, payload."""
        for kind, data in self.frames():
            if kind == 2 and data[0] == 1:
                number, t_ns = struct.unpack_from("<IQ", data, 1)
                return number, t_ns, data[13:]
        raise AssertionError

    def read(self, topic: str, payload: bytes) -> Any:
        files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(self.channels[topic]["schema"]))
        pool = descriptor_pool.DescriptorPool()
        for file in files.file:
            pool.Add(file)
        kind = pool.FindMessageTypeByName(self.channels[topic]["schemaName"])
        return message_factory.GetMessageClass(kind).FromString(payload)


@contextmanager
def watched(*topics: str) -> Iterator[tuple[FoxgloveStream, Viewer]]:
    stream = FoxgloveStream(0)
    stream.cast(SceneNames(limbs=["HD", "THX"], links=["upper", "fore", "hand"], radii_m=[0.1, 0.2, 0.3]))
    viewer = Viewer(stream.port)
    try:
        viewer.subscribe(*topics)
        yield stream, viewer
    finally:
        viewer.close()
        stream.close()


def wait_for(stream: FoxgloveStream, name: str) -> None:
    """Until the server knows of the subscription."""
    for _ in range(10_000):
        if name in stream.watched():
            return
        time.sleep(0.001)
    raise AssertionError(name)


def test_foxglove_gets_person_volumes_and_robot() -> None:
    with watched("/person", "/volumes", "/robot") as (stream, viewer):
        for name in ("person", "volumes", "robot"):
            wait_for(stream, name)
        sent = scene()
        stream.scene(packed(sent))
        found = {}
        for _ in range(3):
            number, t_ns, payload = viewer.message()
            assert t_ns == sent.t_ns
            topic = ("/person", "/volumes", "/robot")[number]
            found[topic] = viewer.read(topic, payload).entities
        assert [entity.id for entity in found["/person"]] == ["person", "person 3"]
        person, other = found["/person"]
        assert (person.frame_id, person.timestamp.seconds, person.timestamp.nanos) == (
            "world", 1_800_000_000, 123_456_789,
        )  # fmt: skip
        neck = person.lines[0].points[1]
        np.testing.assert_array_equal([neck.x, neck.y, neck.z], sent.points_m[0, POINTS.index("neck")])
        neck = other.lines[0].points[1]
        np.testing.assert_array_equal([neck.x, neck.y, neck.z], sent.points_m[1, POINTS.index("neck")])
        assert {entity.lifetime.seconds for entity in (*found["/person"], *found["/volumes"])} == {1}
        names = ["volume HD", "volume THX", "volume HD of person 3", "volume THX of person 3"]
        assert [entity.id for entity in found["/volumes"]] == names
        for row, radius_m in ((0, 0.1), (1, 0.3)):
            corners, _ = mesh(sent.occupied.volumes.vertices(row, 0), radius_m)
            shown = found["/volumes"][2 * row].triangles[0]
            np.testing.assert_array_equal([[p.x, p.y, p.z] for p in shown.points], corners)
        corners, faces = mesh(sent.occupied.volumes.vertices(0, 0), 0.1)
        head = found["/volumes"][0].triangles[0]
        np.testing.assert_array_equal([[p.x, p.y, p.z] for p in head.points], corners)
        np.testing.assert_array_equal(head.indices, faces.ravel())
        assert not found["/volumes"][1].triangles[0].points  # not known
        assert [entity.id for entity in found["/robot"]] == ["robot upper", "robot fore", "robot hand"]
        ball, rod = found["/robot"][1].spheres[0], found["/robot"][1].cylinders[0]
        assert (ball.pose.position.x, ball.size.x, rod.size.x) == (sent.ends_m[1, 0, 0], 0.4, 0.4)
        assert rod.size.z == pytest.approx(np.linalg.norm(sent.ends_m[1, 1] - sent.ends_m[1, 0]))


def test_foxglove_gets_the_status() -> None:
    with watched("/status") as (stream, viewer):
        wait_for(stream, "status")
        stream.status(status())
        assert json.loads(viewer.message()[2]) == status()


def test_a_taken_port_is_told() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(SettingsError, match=facts(f"--foxglove {taken.getsockname()[1]}", "free")):
            FoxgloveStream(taken.getsockname()[1])
