"""Skeletons over Zenoh, from a process of their own: our messages and those of ROS 2."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
import trustme

from hrcreplay.errors import SettingsError
from hrcreplay.live.person import source
from hrcreplay.live.person.source import CameraSubscription
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.messages import AZURE_INDEX, OPENNI_JOINTS
from hrcreplay.records import NOBODY, POINTS
from hrcreplay.settings.sections import ZenohKey
from tests.facts import facts, tells
from tests.live import zenoh_publisher
from tests.live.human import Human
from tests.logs.bags import define, header, make, marker_array, point, store_of, transform

NOW_NS = 1_800_000_000_000_000_000
MARKER_KEY = "0/cell/kinect/visualization_msgs::msg::dds_::MarkerArray_/RIHS01_0"


def skeletons(messages: list[tuple[bytes, bytes]]) -> list[Any]:
    return [pb.Skeleton.FromString(payload) for kind, payload in messages if kind in (b"f", b"F")]


def notes(messages: list[tuple[bytes, bytes]]) -> list[str]:
    return [payload.decode() for kind, payload in messages if kind == b"N"]


def spread(at: float) -> Any:
    """(32, 3) places of joints, the first beginning with ``at``: no two of a body are one place."""
    return np.arange(96.0).reshape(32, 3) / 64.0 + at


def markers(stamp_ns: int, bodies: dict[int, Any] | None = None) -> bytes:
    store = store_of("ros2")
    message = marker_array(store, stamp_ns, {1: spread(1.0)} if bodies is None else bodies)
    return bytes(store.serialize_cdr(message, "visualization_msgs/msg/MarkerArray"))


def own(capture_ns: int, **change: Any) -> bytes:
    points = [1.0 + k / 64.0 + capture_ns % 1009 / 1000.0 for k in range(60)]  # nobody is measured twice the same
    values = {"capture_ns": capture_ns, "camera": "x", "body": 2, "points": points, "confidence": [1.0] * 20}
    return pb.Skeleton(**(values | change)).SerializeToString()


# --- payloads ---


def test_the_type_comes_from_the_key_of_rmw_zenoh_and_all_bodies_are_read() -> None:
    stream = CameraSubscription("kinect", ZenohKey(key=MARKER_KEY, payload="cdr"))
    bodies = {3: spread(0.25), 1: spread(2.0)}
    sent = skeletons(list(stream.take(MARKER_KEY, markers(NOW_NS - 40_000_000, bodies), NOW_NS)))
    assert [(s.body, s.points[0], s.camera, s.capture_ns) for s in sent] == [
        (1, 2.0, "kinect", NOW_NS - 40_000_000),
        (3, 0.25, "kinect", NOW_NS - 40_000_000),
    ]


def test_an_array_without_markers_is_a_frame_of_nobody() -> None:
    stream = CameraSubscription("kinect", ZenohKey(key=MARKER_KEY, payload="cdr"))
    sent = [
        list(
            stream.take(MARKER_KEY, markers(NOW_NS + i * 10**8 - 40_000_000, {1: spread(1.0 + i)}), NOW_NS + i * 10**8)
        )
        for i in range(6)
    ]
    sent.append(list(stream.take(MARKER_KEY, markers(0, {}), NOW_NS + 6 * 10**8)))
    *_, last = skeletons([message for messages in sent for message in messages])
    assert (last.body, last.capture_ns) == (NOBODY, NOW_NS + 6 * 10**8 - 40_000_000)
    assert not any(last.confidence)
    assert notes(sent[-1]) == []


def test_the_key_of_the_bridge_needs_a_type() -> None:
    stream = CameraSubscription("kinect", ZenohKey(key="cell/kinect", payload="cdr"))
    (note,) = notes(list(stream.take("cell/kinect", markers(NOW_NS), NOW_NS)))
    assert tells(note, "live.zenoh.keys.kinect", "1 undecodable", "cell/kinect", "type")
    stream = CameraSubscription(
        "kinect", ZenohKey(key="cell/kinect", payload="cdr", type="visualization_msgs/msg/MarkerArray")
    )
    assert len(skeletons(list(stream.take("cell/kinect", markers(NOW_NS), NOW_NS)))) == 1


def test_transforms_of_a_tracker() -> None:
    store = store_of("ros2")
    sent = [
        transform(store, NOW_NS - 10**7, "/cam", f"{joint}_1", (k, 0.0, 2.0))
        for k, joint in enumerate(sorted(OPENNI_JOINTS))
    ]
    data = bytes(store.serialize_cdr(make(store, "tf2_msgs/msg/TFMessage", transforms=sent), "tf2_msgs/msg/TFMessage"))
    stream = CameraSubscription("cam", ZenohKey(key="0/tf/**", payload="cdr"))
    (found,) = skeletons(list(stream.take("0/tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_0", data, NOW_NS)))
    assert found.capture_ns == NOW_NS - 10**7
    assert found.points[3 * POINTS.index("head")] == sorted(OPENNI_JOINTS).index("head")


def test_a_type_with_a_preset_needs_its_definition_alone() -> None:
    store = store_of("ros2")
    define(store, "ros_openpose/msg/BodyPart", "float32 score\ngeometry_msgs/Point32 point")
    define(store, "ros_openpose/msg/Person", "ros_openpose/BodyPart[] bodyParts")
    define(store, "ros_openpose/msg/Frame", "std_msgs/Header header\nros_openpose/Person[] persons")
    parts = [
        make(store, "ros_openpose/msg/BodyPart", score=0.5, point=point(store, (k, 0.0, 2.0), "Point32"))
        for k in range(25)
    ]
    person = make(store, "ros_openpose/msg/Person", bodyParts=parts)
    frame = make(store, "ros_openpose/msg/Frame", header=header(store, NOW_NS - 10**7), persons=[person])
    data = bytes(store.serialize_cdr(frame, "ros_openpose/msg/Frame"))
    parts_of_type = {  # complete, as in an MCAP file
        "": "std_msgs/Header header\nros_openpose/Person[] persons",
        "ros_openpose/Person": "ros_openpose/BodyPart[] bodyParts",
        "ros_openpose/BodyPart": "float32 score\ngeometry_msgs/Point32 point",
        "geometry_msgs/Point32": "float32 x\nfloat32 y\nfloat32 z",
        "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
        "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    }
    definition = "\n".join(f"{'=' * 80}\nMSG: {name}\n{text}" if name else text for name, text in parts_of_type.items())
    key = ZenohKey(key="cell/op", payload="cdr", type="ros_openpose/msg/Frame", definition=definition)
    sent = list(CameraSubscription("cam", key).take("cell/op", data, NOW_NS))
    assert notes(sent) == []
    (found,) = skeletons(sent)
    assert found.capture_ns == NOW_NS - 10**7
    assert found.points[3 * POINTS.index("neck")] == 1.0
    assert found.points[3 * POINTS.index("elbow_l")] == 6.0
    assert found.confidence[POINTS.index("neck")] == 0.5


def test_a_stamp_of_zero_is_the_receipt_and_told_once() -> None:
    stream = CameraSubscription("kinect", ZenohKey(key=MARKER_KEY, payload="cdr"))
    sent = (markers(0, {1: spread(1.0 + i)}) for i in range(2))
    first, second = (list(stream.take(MARKER_KEY, data, NOW_NS + i)) for i, data in enumerate(sent))
    assert [s.capture_ns for s in skeletons(first + second)] == [NOW_NS, NOW_NS + 1]
    (note,) = notes(first)
    assert tells(note, "live.zenoh.keys.kinect", "frames_header_stamp_zero", "arrival")
    assert notes(second) == []
    stream = CameraSubscription("ours", ZenohKey(key="hrc/x"))
    assert skeletons(list(stream.take("hrc/x", own(0), NOW_NS)))[0].capture_ns == NOW_NS


def test_frames_that_come_twice_or_late_are_dropped() -> None:
    stream = CameraSubscription("ours", ZenohKey(key="hrc/x"))
    captures = (10, 10, 9, 11)
    taken = [list(stream.take("hrc/x", own(NOW_NS + c), NOW_NS + 100)) for c in captures]
    assert [len(skeletons(messages)) for messages in taken] == [1, 0, 0, 1]
    assert "frames_duplicate" in notes(taken[1])[0]
    assert "frames_out_of_order" in notes(taken[2])[0]


def test_a_body_whose_track_is_frozen_is_sent_without_a_point() -> None:
    """Control needs to know that the camera says it is there, where the cell says what is watched."""
    stream = CameraSubscription("ours", ZenohKey(key="hrc/x"))
    where = [1.0 + k / 64.0 for k in range(60)]
    (shown,) = skeletons(list(stream.take("hrc/x", own(NOW_NS, points=where), NOW_NS + 100)))
    (named,) = skeletons(list(stream.take("hrc/x", own(NOW_NS + 1000, points=where), NOW_NS + 1100)))
    assert np.isfinite(shown.points).any()
    assert (named.body, named.capture_ns) == (shown.body, NOW_NS + 1000)
    assert np.isnan(named.points).all()
    assert not np.any(named.confidence)


def test_a_capture_in_the_future_does_not_shut_out_those_that_follow() -> None:
    stream = CameraSubscription("ours", ZenohKey(key="hrc/x"))
    ahead = list(stream.take("hrc/x", own(NOW_NS + 3_600 * 10**9), NOW_NS))
    assert skeletons(ahead) == []
    (note,) = notes(ahead)
    assert tells(note, "live.zenoh.keys.ours", "3600.000 s after", "left out", "clocks")
    assert len(skeletons(list(stream.take("hrc/x", own(NOW_NS + 10), NOW_NS + 20)))) == 1


def test_points_that_are_no_numbers_are_missing() -> None:
    stream = CameraSubscription("ours", ZenohKey(key="hrc/x"))
    points = [np.inf, 0.0, 0.0, *[1.0] * 57]
    (sent,) = skeletons(list(stream.take("hrc/x", own(NOW_NS, points=points), NOW_NS)))
    assert np.isnan(sent.points[:3]).all()
    assert sent.confidence[0] == 0.0
    assert sent.confidence[1] == 1.0


def test_what_cannot_be_decoded_is_counted_and_told_at_powers_of_ten() -> None:
    rng = np.random.default_rng(5)
    stream = CameraSubscription("kinect", ZenohKey(key=MARKER_KEY, payload="cdr"))
    whole = markers(NOW_NS)
    told = notes(list(stream.take(MARKER_KEY, whole, NOW_NS - 1)))
    for i in range(300):
        data = bytearray(whole[: rng.integers(0, len(whole))])
        for at in rng.integers(0, max(len(data), 1), size=8 if data else 0):
            data[at] = rng.integers(0, 256)
        told += notes(list(stream.take(MARKER_KEY, bytes(data), NOW_NS + i)))
    undecodable = [text.split(":")[1].split()[0] for text in told if "undecodable" in text]
    assert undecodable == ["1", "10", "100"]
    stream = CameraSubscription("ours", ZenohKey(key="hrc/x"))
    for wrong in (b"", b"\xff", own(NOW_NS, points=[1.0]), own(NOW_NS, confidence=[])):
        assert skeletons(list(stream.take("hrc/x", wrong, NOW_NS))) == []


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(SettingsError, match=facts("eclipse-zenoh", "pip install 'hrcreplay")):
        source.open_session({"keys": {}})


# --- sessions ---


def free_endpoint() -> str:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{taken.getsockname()[1]}"


@contextmanager
def publisher(endpoint: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([sys.executable, "-m", "tests.live.zenoh_publisher", endpoint])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def section(endpoint: str, **keys: Any) -> str:
    return json.dumps({"mode": "peer", "listen": [endpoint], "connect": [], "keys": keys})


def test_a_publisher_is_heard_killed_and_heard_again() -> None:
    pytest.importorskip("zenoh")
    endpoint = free_endpoint()
    keys = {
        "kinect": {"key": "0/cell/kinect/**", "payload": "cdr"},
        "xtion": {"key": zenoh_publisher.OWN},
        "lab": {
            "key": zenoh_publisher.PERSON,
            "payload": "cdr",
            "type": "lab/msg/Person",
            "definition": zenoh_publisher.PERSON_DEFINITION,
            "points": "joints",
            "index": {"head": 0, "pelvis": 1},
            "unit": "mm",
        },
    }
    with Human("--zenoh", section(endpoint, **keys)) as human:
        (told,) = human.until(b"N", text=b"ready")
        assert json.loads(told.removeprefix(b"ready ")) == {"cameras": ["kinect", "xtion", "lab"]}
        human.go(human.now_ns())
        before_ns = human.now_ns()
        with publisher(endpoint):
            human.until(b"F", 30)
        check(human.skeletons())
        assert any("frames_header_stamp_zero" in note and "keys.lab" in note for note in human.notes())
        drain(human)
        seen = len(human.skeletons())
        human.until(b"H", 10)
        assert len(human.skeletons()) == seen  # heartbeats, but no frames
        with publisher(endpoint):
            human.until(b"F", 12)
        sent = human.skeletons()
        check(sent)
        for camera in keys:
            captures = [s.capture_ns for s in sent if s.camera == camera]
            assert captures == sorted(set(captures))
            assert captures[0] > before_ns - 10**9
        assert sum("keys.xtion: 1 undecodable" in note for note in human.notes()) == 1


def drain(human: Human) -> None:
    """Takes what is on its way from a publisher that is gone: until several heartbeats bring no frame."""
    while True:
        before = len(human.skeletons())
        human.until(b"H", 5)
        if len(human.skeletons()) == before:
            return


def check(sent: list[Any]) -> None:
    """Every skeleton is one that the publisher made."""
    by_camera = {camera: [s for s in sent if s.camera == camera] for camera in ("kinect", "xtion", "lab")}
    assert all(by_camera.values())
    where = [POINTS.index(POINTS[i]) for i in sorted(AZURE_INDEX.values())]
    joints = {point: joint for joint, point in AZURE_INDEX.items()}
    for skeleton in by_camera["kinect"]:
        found = np.reshape(skeleton.points, (20, 3))
        i = round(found[0, 0] - zenoh_publisher.markers_m(0)[joints[0]][0])
        np.testing.assert_array_equal(found[where], zenoh_publisher.markers_m(i)[[joints[k] for k in where]])
    for skeleton in by_camera["xtion"]:
        i = round(-skeleton.points[0])
        assert list(skeleton.points) == zenoh_publisher.own_points(i)
        assert skeleton.body == 4
    for skeleton in by_camera["lab"]:
        head = skeleton.points[3 * POINTS.index("head") : 3 * POINTS.index("head") + 3]
        assert head[2] == 1.5
        assert skeleton.confidence[POINTS.index("head")] == 1.0
        assert np.isnan(skeleton.points[3 * POINTS.index("neck")])


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"keys": {"left": {"key": "no//key"}}}, b"failed live.zenoh.keys.left: 'no//key' is no key expression"),
        ({"listen": ["tcp/somewhere"]}, b"failed live.zenoh: no session"),
        ({"mode": "pear"}, b"failed live.zenoh: mode: found 'pear'"),
        ({"secret": "/nowhere"}, b"failed live.zenoh.secret: /nowhere cannot be read"),
        ({"secret": "/dev/null"}, b"failed live.zenoh.secret: /dev/null holds 0 bytes"),
        ({"config": "/nowhere"}, b"failed live.zenoh: config has mode, connect, listen and scouting in it"),
        ({"config": "/nowhere", "listen": []}, b"failed live.zenoh.config: /nowhere cannot be used"),
    ],
)
def test_settings_that_cannot_be_used_are_told(change: dict[str, Any], told: bytes) -> None:
    pytest.importorskip("zenoh")
    settings = {"listen": [free_endpoint()], "keys": {"left": {"key": "a"}}} | change
    with Human("--zenoh", json.dumps(settings)) as human:
        (text,) = human.until(b"N", text=b"failed")
        assert text.startswith(told)
        assert human.process.wait(600.0) == SettingsError.exit_code


def test_it_ends_in_order_while_frames_pour_in() -> None:
    """Threads of Zenoh's that call into an interpreter that is ending would abort the process."""
    pytest.importorskip("zenoh")
    endpoint = free_endpoint()
    with Human("--zenoh", section(endpoint, xtion={"key": "hrc/xtion"})) as human:
        human.until(b"N", text=b"ready")
        human.go(human.now_ns())
        with source.open_session({"connect": [endpoint]}) as cameras:
            over = Event()

            def pour() -> None:
                while not over.is_set():
                    cameras.put("hrc/xtion", own(human.now_ns()))

            pouring = Thread(target=pour)
            pouring.start()
            try:
                human.until(b"F", 50)
                human.socket.close()
                assert human.process.wait(600.0) == 0
            finally:
                over.set()
                pouring.join()


def test_a_configuration_of_zenoh_s_own_is_used(tmp_path: Path) -> None:
    """One that listens at an endpoint: whoever connects to it is heard."""
    pytest.importorskip("zenoh")
    endpoint, heard = free_endpoint(), Event()
    path = tmp_path / "zenoh.json5"
    path.write_text(
        f'{{mode: "peer", listen: {{endpoints: ["{endpoint}"]}}, scouting: {{multicast: {{enabled: false}}}}}}'
    )
    with source.open_session({"config": str(path)}) as ours:
        subscriber = ours.declare_subscriber("a", lambda _sample: heard.set())
        with source.open_session({"connect": [endpoint]}) as theirs:
            for _ in range(600):
                theirs.put("a", b"x")
                if heard.wait(0.1):
                    break
        subscriber.undeclare()
    assert heard.is_set()


def test_with_certificates_of_its_own_authority_no_stranger_is_heard(tmp_path: Path) -> None:
    """Mutual TLS as in docs/live.md: a camera with a certificate, a stranger of another authority, one with none."""
    pytest.importorskip("zenoh")
    endpoint = free_endpoint().replace("tcp/", "tls/").replace("127.0.0.1", "localhost")
    authorities = {name: certificates(tmp_path, name) for name in ("pc", "camera", "stranger")}
    certificates(tmp_path, "camera", authorities["pc"])
    heard: list[bytes] = []
    everything = Event()

    def take(sample: Any) -> None:
        heard.append(sample.payload.to_bytes())
        everything.set()

    with source.open_session({"config": str(configuration(tmp_path, "pc", listen=endpoint))}) as ours:
        subscriber = ours.declare_subscriber("a", take)
        for name in ("stranger", "nobody"):
            with source.open_session({"config": str(configuration(tmp_path, name, connect=endpoint))}) as theirs:
                for _ in range(20):
                    theirs.put("a", name.encode())
                    everything.wait(0.05)
        with source.open_session({"connect": [endpoint.replace("tls/", "tcp/")]}) as theirs:
            for _ in range(20):
                theirs.put("a", b"in the clear")
                everything.wait(0.05)
        assert not heard
        with source.open_session({"config": str(configuration(tmp_path, "camera", connect=endpoint))}) as theirs:
            for _ in range(600):
                theirs.put("a", b"camera")
                if everything.wait(0.1):
                    break
        subscriber.undeclare()
    assert set(heard) == {b"camera"}


def certificates(folder: Path, name: str, authority: trustme.CA | None = None) -> trustme.CA:
    """Writes key and certificate of a computer by an authority, its own where none is given; returns the authority."""
    authority = authority or trustme.CA()
    issued = authority.issue_cert("localhost")
    authority.cert_pem.write_to_path(folder / f"{name}_ca.pem")
    issued.private_key_pem.write_to_path(folder / f"{name}.key")
    (folder / f"{name}.pem").write_bytes(b"".join(part.bytes() for part in issued.cert_chain_pems))
    return authority


def configuration(folder: Path, name: str, **ends: str) -> Path:
    """Zenoh's configuration of a computer; it trusts the PC's authority, and shows its certificate if it has one."""
    tls: dict[str, Any] = {"root_ca_certificate": str(folder / "pc_ca.pem"), "enable_mtls": name != "nobody"}
    for end in ("listen", "connect") if name != "nobody" else ():
        tls |= {f"{end}_certificate": str(folder / f"{name}.pem"), f"{end}_private_key": str(folder / f"{name}.key")}
    config: dict[str, Any] = {end: {"endpoints": [where]} for end, where in ends.items()}
    config |= {"mode": "peer", "scouting": {"multicast": {"enabled": False}}, "transport": {"link": {"tls": tls}}}
    path = folder / f"{name}.json5"
    path.write_text(json.dumps(config))
    return path
