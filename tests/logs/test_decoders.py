from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from hrcreplay.errors import LogError
from hrcreplay.logs import messages
from hrcreplay.logs.reader import open_log
from hrcreplay.records import NOBODY, POINTS, CameraFrames
from hrcreplay.settings.sections import Decoder, Logs
from tests.facts import facts, tells
from tests.logs import own
from tests.logs.bags import (
    KINDS,
    OPENNI,
    bag,
    define,
    header,
    make,
    marker_array,
    openni_at,
    point,
    transform,
    write_openni,
)
from tests.realdata import data_path

BEGIN = own.BEGIN_NS
SARA = {
    "shoulder_l": 0, "elbow_l": 1, "wrist_l": 2, "shoulder_r": 3, "elbow_r": 4, "wrist_r": 5,
    "head": 6, "neck": 8, "pelvis": 9,
}  # fmt: skip


def at(name: str) -> int:
    return POINTS.index(name)


def path_of(tmp_path: Path, kind: str) -> Path:
    return tmp_path / ("session.bag" if kind == "ros1" else "session")


# --- tables ---


def test_tables_name_every_side_right() -> None:
    for table in (messages.AZURE_POINTS, messages.KINECT2_POINTS, messages.OPENNI_POINTS):
        for name, joint in table.items():
            side = {"_l": "left", "_r": "right"}.get(name[-2:])
            assert side is None or side in joint.lower()
            assert {"left": "right", "right": "left"}.get(side or "", "none") not in joint.lower()
    assert [messages.AZURE_JOINTS[i] for i in (0, 5, 12, 26, 31)] == [
        "PELVIS",
        "SHOULDER_LEFT",
        "SHOULDER_RIGHT",
        "HEAD",
        "EAR_RIGHT",
    ]
    assert [messages.KINECT2_JOINTS[i] for i in (0, 4, 8, 20, 24)] == [
        "SpineBase",
        "ShoulderLeft",
        "ShoulderRight",
        "SpineShoulder",
        "ThumbRight",
    ]
    assert len(messages.AZURE_INDEX) == len(messages.KINECT2_INDEX) == len(POINTS)


# --- tf ---


@pytest.mark.parametrize(
    ("kind", "msgtype"), [*((k, "tf2_msgs/msg/TFMessage") for k in KINDS), ("ros1", "tf/msg/tfMessage")]
)
def test_openni_transforms_become_frames(tmp_path: Path, kind: str, msgtype: str) -> None:
    path = path_of(tmp_path, kind)
    with bag(path, kind) as (write, store):
        write_openni(write, store, frames=40, start_ns=BEGIN, msgtype=msgtype)
    log = open_log(path)
    frames = own.read(log)
    assert log.header.kind == ("ros1" if kind == "ros1" else "ros2")
    assert log.header.cameras == ("openni_depth_frame",)
    assert len(frames) == 40
    np.testing.assert_array_equal(frames.capture_ns, BEGIN + np.arange(40) * 33_000_000)
    last = 14 * 200_000 + 5_000_000  # a frame has arrived when its last joint has
    np.testing.assert_array_equal(frames.arrival_ns, BEGIN + np.arange(40) * 33_000_000 + last)
    assert set(frames.body) == {1}
    for name, joint in (("head", "head"), ("chest", "torso"), ("elbow_l", "left_elbow"), ("wrist_r", "right_hand")):
        np.testing.assert_array_equal(frames.points_m[17, at(name)], openni_at(joint, 17))
    hips = (openni_at("left_hip", 17) + openni_at("right_hip", 17)) / 2
    np.testing.assert_array_equal(frames.points_m[17, at("pelvis")], hips)
    assert np.isnan(frames.points_m[17, at("ankle_l")]).all()
    assert frames.confidence[17, at("ankle_l")] == 0.0
    assert frames.confidence[17, at("pelvis")] == 1.0


def test_two_people_and_two_cameras_on_one_tf(tmp_path: Path) -> None:
    with bag(tmp_path / "a.bag", "ros1") as (write, store):
        write_openni(write, store, frames=10, start_ns=BEGIN, parent="/cam_a")
        write_openni(write, store, frames=10, start_ns=BEGIN + 1_000_000, parent="/cam_a", body=2)
        write_openni(write, store, frames=10, start_ns=BEGIN + 5 * 10**9, parent="ns/cam_b", body=1)
    frames = own.read(open_log(tmp_path / "a.bag"))
    assert frames.cameras == ("cam_a", "ns_cam_b")  # also the camera that starts late
    rows = list(zip(frames.camera.tolist(), frames.body.tolist(), strict=True))
    assert {key: rows.count(key) for key in set(rows)} == {(0, 1): 10, (0, 2): 10, (1, 1): 10}
    np.testing.assert_array_equal(np.sort(frames.arrival_ns), frames.arrival_ns)
    of_two = frames.rows(frames.body == 2)
    np.testing.assert_array_equal(of_two.points_m[4, at("neck")], openni_at("neck", 4, body=2))


def test_transforms_of_one_frame_in_one_message(tmp_path: Path) -> None:
    with bag(tmp_path / "a", "mcap") as (write, store):
        for frame in range(5):
            stamp = BEGIN + frame * 33_000_000
            sent = [transform(store, stamp, "cam", f"{joint}_3", openni_at(joint, frame)) for joint in OPENNI]
            robot = [transform(store, stamp, "base_link", "tool0", (1, 2, 3))]
            write(
                "/tf", "tf2_msgs/msg/TFMessage", stamp, make(store, "tf2_msgs/msg/TFMessage", transforms=robot + sent)
            )
    frames = own.read(open_log(tmp_path / "a"))
    np.testing.assert_array_equal(frames.capture_ns, BEGIN + np.arange(5) * 33_000_000)
    np.testing.assert_array_equal(frames.arrival_ns, frames.capture_ns)


def test_person_of_whom_a_joint_is_lost_now_and_then(tmp_path: Path) -> None:
    with bag(tmp_path / "a.bag", "ros1") as (write, store):
        write_openni(write, store, frames=5, start_ns=BEGIN)
        write_openni(write, store, frames=1, start_ns=BEGIN + 5 * 33_000_000, joints=OPENNI[:-1])
        write_openni(write, store, frames=5, start_ns=BEGIN + 6 * 33_000_000)
    frames = own.read(open_log(tmp_path / "a.bag"))
    assert len(frames) == 11
    assert np.isnan(frames.points_m[5, at("foot_r")]).all()
    assert np.isfinite(frames.points_m[6, at("foot_r")]).all()
    # the incomplete frame is known to be over only when the next one begins
    assert frames.arrival_ns[5] == BEGIN + 6 * 33_000_000 + 5_000_000
    assert frames.capture_ns[5] == BEGIN + 5 * 33_000_000


def test_real_tf_without_people_has_no_skeletons() -> None:
    for name in ("example.bag", "example-lz4.bag", "evo_tf_example.bag", "evo_tf_example"):
        with pytest.raises(LogError, match=facts("no skeleton", "/tf")) as caught:
            open_log(data_path(f"ros_bags/{name}"))
        assert caught.value.exit_code == 3


# --- markers ---


@pytest.mark.parametrize("kind", KINDS)
def test_azure_markers_become_frames(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(4)
    people = rng.normal(size=(20, 2, 32, 3))
    path = path_of(tmp_path, kind)
    with bag(path, kind) as (write, store):
        for frame in range(20):
            stamp = BEGIN + frame * 33_000_000
            bodies = {} if frame in (0, 9) else {1: people[frame, 0], 12: people[frame, 1]}
            array = marker_array(store, stamp, bodies)
            write("/left/body_tracking_data", "visualization_msgs/msg/MarkerArray", stamp + 40_000_000, array)
        clearing = marker_array(store, stamp, {1: people[0, 0]}, action=3)
        write("/left/body_tracking_data", "visualization_msgs/msg/MarkerArray", stamp + 50_000_000, clearing)
        other = marker_array(store, stamp, {0: people[0, 0, :3]})
        write("/obstacles", "visualization_msgs/msg/MarkerArray", stamp + 50_000_000, other)
    log = open_log(path)
    frames = own.read(log)
    assert frames.cameras == ("left_body_tracking_data",)  # and not /obstacles
    assert len(frames) == 36
    assert frames.body.tolist() == [1, 12] * 18
    np.testing.assert_array_equal(frames.capture_ns + 40_000_000, frames.arrival_ns)
    for name, joint in (("pelvis", 0), ("neck", 3), ("wrist_l", 7), ("elbow_r", 13), ("foot_r", 25), ("head", 26)):
        np.testing.assert_array_equal(frames.points_m[0, at(name)], people[1, 0, joint])
        np.testing.assert_array_equal(frames.points_m[-1, at(name)], people[19, 1, joint])
    assert (frames.confidence == 1.0).all()
    assert log.defects["gaps_left_body_tracking_data"] == 0  # nobody there is no silence


def test_markers_of_an_old_release_without_definitions(tmp_path: Path) -> None:
    foxy = get_typestore(Stores.ROS2_FOXY)
    positions = np.random.default_rng(5).normal(size=(32, 3))
    with bag(tmp_path / "a", "db3") as (write, store):
        msgtype = "visualization_msgs/msg/MarkerArray"
        write("/body_tracking_data", msgtype, BEGIN, marker_array(store, BEGIN, {1: positions}))
    with sqlite3.connect(tmp_path / "a" / "a.db3") as db:
        data = bytes(foxy.serialize_cdr(marker_array(foxy, BEGIN, {1: positions}), msgtype))
        db.execute("update messages set data = ?", (data,))
        db.execute("update message_definitions set encoded_message_definition = ''")
    frames = own.read(open_log(tmp_path / "a"))
    np.testing.assert_array_equal(frames.points_m[0, at("head")], positions[26])


# --- settings ---


def described(**change: Any) -> Decoder:
    values: dict[str, Any] = {
        "topic": "/SaRA_demo_human_capsules", "camera": "mocap", "points": "positions", "index": SARA,
    }  # fmt: skip
    return Decoder(**(values | change))


@pytest.mark.parametrize(("name", "n"), [("exp_box", 1056), ("exp_appraoching", 1297)])
def test_sara_bags_by_a_described_decoder(name: str, n: int) -> None:
    path = data_path(f"sara_human_robot_bags/{name}.bag")
    log = open_log(path, Logs(decoders=(described(),)))
    frames = own.read(log)
    assert frames.cameras == ("mocap",)
    assert len(frames) + log.defects["frames_repeated"] == n
    assert log.defects["frames_repeated"] <= 1
    assert log.defects["frames_header_stamp_zero"] == n
    assert tells(log.notes, "stamps", "zero", "arrival")
    np.testing.assert_array_equal(frames.capture_ns, frames.arrival_ns)
    assert abs(np.median(np.diff(frames.capture_ns)) - 16.7e6) < 0.2e6
    known = [at(point) for point in SARA]
    assert np.isfinite(frames.points_m[:, known]).all()
    assert np.isnan(np.delete(frames.points_m, known, axis=1)).all()
    assert (frames.confidence[:, known] == 1.0).all()
    upper = np.linalg.norm(frames.points_m[:, at("shoulder_l")] - frames.points_m[:, at("elbow_l")], axis=1)
    assert 0.15 < np.median(upper) < 0.45  # metres
    assert np.median(frames.points_m[:, at("head"), 2] - frames.points_m[:, at("pelvis"), 2]) > 0.3  # z is up


def test_described_decoder_equals_rosbags_reading() -> None:
    path = data_path("sara_human_robot_bags/exp_box.bag")
    frames = own.read(open_log(path, Logs(decoders=(described(),))))
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic == "/SaRA_demo_human_capsules"]
        raw = [(t, reader.deserialize(data, c.msgtype)) for c, t, data in reader.messages(wanted)]
    values = [[[p.x, p.y, p.z] for p in m.positions[:10]] for _, m in raw]  # type: ignore[attr-defined]
    new = [i for i in range(len(raw)) if not i or values[i] != values[i - 1]]
    np.testing.assert_array_equal(frames.arrival_ns, [raw[i][0] for i in new])
    elbow = [values[i][4] for i in new]
    np.testing.assert_array_equal(frames.points_m[:, at("elbow_r")], elbow)


def test_an_empty_array_of_a_described_decoder_shows_nobody(tmp_path: Path) -> None:
    path = path_of(tmp_path, "mcap")
    with bag(path, "mcap") as (write, store):
        define(store, "lab/msg/Person", "std_msgs/Header header\ngeometry_msgs/Point[] joints")
        for frame in range(4):
            joints = [point(store, [1.0, frame, 2.0]), point(store, [1.0, frame, 1.0])] if frame % 2 else []
            person = make(store, "lab/msg/Person", header=header(store, BEGIN + frame * 10**7), joints=joints)
            write("/people", "lab/msg/Person", BEGIN + frame * 10**7 + 1000, person)
    how = Decoder(topic="/people", camera="lidar", points="joints", index={"head": 0, "pelvis": 1})
    log = open_log(path, Logs(decoders=(how,)))
    frames = CameraFrames.join(list(log.frames(nobody=True)))
    assert frames.body.tolist() == [NOBODY, 0, NOBODY, 0]
    np.testing.assert_array_equal(frames.capture_ns, BEGIN + np.arange(4) * 10**7)
    assert CameraFrames.join(list(log.frames())).body.tolist() == [0, 0]


@pytest.mark.parametrize("kind", KINDS)
def test_described_decoder_takes_units_stamp_and_confidence(tmp_path: Path, kind: str) -> None:
    path = path_of(tmp_path, kind)
    with bag(path, kind) as (write, store):
        define(store, "lab/msg/Person", "std_msgs/Header header\ngeometry_msgs/Point[] joints\nfloat32[] score")
        for frame, xyz in enumerate(([100, 200, 300], [np.nan, 0, 0], [1, 2, np.inf])):
            person = make(
                store,
                "lab/msg/Person",
                header=header(store, BEGIN + frame * 10**7),
                joints=[point(store, xyz), point(store, [1000, frame, 0])],
                score=np.array([0.5, 0.25], dtype=np.float32),
            )
            write("/people", "lab/msg/Person", BEGIN + frame * 10**7 + 1000, person)
    decoder = Decoder(
        topic="/people",
        camera="lidar",
        points="joints",
        index={"head": 0, "pelvis": 1, "neck": 5},
        unit="mm",
        confidence="score",
    )
    log = open_log(path, Logs(decoders=(decoder,)))
    frames = own.read(log)
    np.testing.assert_array_equal(frames.capture_ns, BEGIN + np.arange(3) * 10**7)
    np.testing.assert_allclose(frames.points_m[0, at("head")], [0.1, 0.2, 0.3], rtol=1e-15)
    assert np.isnan(frames.points_m[1:, at("head")]).all()
    assert frames.confidence[:, at("head")].tolist() == [0.5, 0.0, 0.0]
    assert frames.confidence[:, at("pelvis")].tolist() == [0.25, 0.25, 0.25]
    assert np.isnan(frames.points_m[:, at("neck")]).all()  # the array is shorter
    assert log.defects["points_not_finite"] == 2
    unstamped = Decoder(topic="/people", camera="lidar", points="joints", index={"head": 0}, stamp=None)
    log = open_log(path, Logs(decoders=(unstamped,)))
    np.testing.assert_array_equal(own.read(log).capture_ns, BEGIN + np.arange(3) * 10**7 + 1000)
    assert log.defects["frames_header_stamp_zero"] == 0


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"points": "positons"}, ("'positons'", "header, positions, velocities")),
        ({"points": "delta_t"}, ("delta_t", "array")),
        ({"points": "header.stamp"}, ("header.stamp", "array")),
        ({"stamp": "header.frame_id"}, ("''", "type time")),
        ({"topic": "/nobody"}, ("/nobody", "/SaRA_demo_robot_capsules")),
    ],
)
def test_wrong_description_is_told(change: dict[str, Any], named: tuple[str, ...]) -> None:
    path = data_path("sara_human_robot_bags/exp_box.bag")
    with pytest.raises(LogError, match=facts(*named)):
        list(open_log(path, Logs(decoders=(described(**change),))).frames())


def test_elements_that_are_no_points(tmp_path: Path) -> None:
    with bag(tmp_path / "a.bag", "ros1") as (write, store):
        write("/js", "sensor_msgs/msg/JointState", BEGIN, make(store, "sensor_msgs/msg/JointState", name=["a", "b"]))
    decoder = Decoder(topic="/js", camera="x", points="name", index={"head": 0})
    with pytest.raises(LogError, match=facts("name", "x, y, z")):
        list(open_log(tmp_path / "a.bag", Logs(decoders=(decoder,))).frames())
