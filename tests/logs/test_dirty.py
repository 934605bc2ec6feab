from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.logs.clean import DEFECTS
from hrcreplay.logs.reader import Log, LogOptions, open_log
from hrcreplay.records import CameraFrames
from tests.logs import own
from tests.logs.bags import KINDS, OPENNI, bag, make, marker_array, openni_at, transform, write_openni

BEGIN = own.BEGIN_NS
PERIOD = own.PERIOD_NS
RESOURCES = "ros_bags/rosbag2/rosbag2_py/test/resources"


def opened(tmp_path: Path, table: CameraFrames, **options: Any) -> Log:
    return open_log(own.write(tmp_path / "a.mcap", table), LogOptions(**options))


def changed(table: CameraFrames, **fields: Any) -> CameraFrames:
    names = ("capture_ns", "arrival_ns", "camera", "body", "points_m", "confidence", "cameras")
    return CameraFrames(**({name: getattr(table, name) for name in names} | fields))


# --- frames ---


def test_frames_that_come_twice_are_dropped(tmp_path: Path) -> None:
    log = opened(tmp_path, own.frames(10, cameras=("one",), which=[0, 1, 1, 2, 3, 3, 3, 4]))
    frames = own.read(log)
    np.testing.assert_array_equal(frames.capture_ns, BEGIN + np.arange(5) * PERIOD)
    assert (log.defects["frames_duplicate"], log.defects["frames_out_of_order"]) == (3, 0)
    assert log.defects["frames_one"] == 5


def test_frames_older_than_the_newest_are_dropped(tmp_path: Path) -> None:
    table = own.frames(10, cameras=("one",), which=[0, 1, 4, 2, 3, 5])
    table = changed(table, arrival_ns=BEGIN + np.arange(6) * PERIOD)
    log = opened(tmp_path, table)
    assert own.read(log).capture_ns.tolist() == [BEGIN + k * PERIOD for k in (0, 1, 4, 5)]
    assert (log.defects["frames_duplicate"], log.defects["frames_out_of_order"]) == (0, 2)


def test_order_is_judged_by_camera_and_body(tmp_path: Path) -> None:
    table = own.frames(6)
    capture = np.array([5, 5, 5, 4, 6, 6]) * PERIOD + BEGIN
    body = np.array([1, 1, 2, 2, 1, 2])
    log = opened(tmp_path, changed(table, capture_ns=capture, body=body))
    assert len(own.read(log)) == 6
    assert log.defects["frames_out_of_order"] == 0


def test_points_that_are_no_numbers(tmp_path: Path) -> None:
    table = own.frames(4, cameras=("one",))
    points, confidence = table.points_m.copy(), np.full((4, 20), 0.75)
    points[1, 5, 2] = np.nan
    points[2, 6] = np.inf
    points[3, 7] = np.nan
    confidence[3, 7] = 0.0  # said to be missing
    confidence[3, 8] = 7.0
    confidence[3, 9] = np.nan
    log = opened(tmp_path, changed(table, points_m=points, confidence=confidence))
    frames = own.read(log)
    for row, point in ((1, 5), (2, 6), (3, 7)):
        assert np.isnan(frames.points_m[row, point]).all()
        assert frames.confidence[row, point] == 0.0
    assert frames.confidence[3, 8:10].tolist() == [1.0, 0.0]
    assert np.isnan(frames.points_m).sum() == 9
    assert log.defects["points_not_finite"] == 2


def test_gaps_are_counted_by_camera(tmp_path: Path) -> None:
    which = [k for k in range(200) if not (k % 2 == 0 and (40 <= k < 60 or 100 <= k < 140))]
    log = opened(tmp_path, own.frames(200, which=which), gap_s=0.5)
    own.read(log)
    assert (log.defects["gaps_left"], log.defects["gaps_right"]) == (2, 0)
    log = open_log(tmp_path / "a.mcap", LogOptions(gap_s=1.0))
    own.read(log)
    assert log.defects["gaps_left"] == 1


def test_camera_that_starts_late_and_one_that_dies(tmp_path: Path) -> None:
    which = [k for k in range(300) if (k >= 90 if k % 2 else k < 200)]
    log = opened(tmp_path, own.frames(300, which=which))
    assert log.header.cameras == ("left", "right")
    own.read(log)
    assert "camera right starts 3.03 s after the log" in log.notes
    assert "camera left ends 3.37 s before the log" in log.notes


def test_zero_stamps_of_ros_give_way_to_arrival(tmp_path: Path) -> None:
    with bag(tmp_path / "a.bag", "ros1") as (write, store):
        for i in range(9):
            array = marker_array(store, 0 if i < 6 else BEGIN + i * PERIOD, {1: np.full((32, 3), float(i))})
            write("/body_tracking_data", "visualization_msgs/msg/MarkerArray", BEGIN + i * PERIOD + 1000, array)
    log = open_log(tmp_path / "a.bag")
    frames = own.read(log)
    expected = BEGIN + np.arange(9) * PERIOD + np.array([1000] * 6 + [0] * 3)
    np.testing.assert_array_equal(frames.capture_ns, expected)
    assert log.defects["frames_header_stamp_zero"] == 6
    assert "header stamps are zero: arrival times used" in log.notes


def test_zero_stamps_on_tf(tmp_path: Path) -> None:
    with bag(tmp_path / "a.bag", "ros1") as (write, store):
        for i in range(10):
            for k, joint in enumerate(OPENNI):
                sent = transform(store, 0, "cam", f"{joint}_1", openni_at(joint, i))
                msgtype = "tf2_msgs/msg/TFMessage"
                write("/tf", msgtype, BEGIN + i * PERIOD + k, make(store, msgtype, transforms=[sent]))
    log = open_log(tmp_path / "a.bag")
    frames = own.read(log)
    np.testing.assert_array_equal(frames.capture_ns, BEGIN + np.arange(10) * PERIOD + 14)
    np.testing.assert_array_equal(frames.points_m[:, 3, 1], np.arange(10) / 100)
    assert log.defects["frames_header_stamp_zero"] == 10


def test_broken_messages_are_left_out(tmp_path: Path) -> None:
    with bag(tmp_path / "a", "db3") as (write, store):
        for i in range(10):
            array = marker_array(store, BEGIN + i * PERIOD, {1: np.full((32, 3), 1.0 + i)})
            write("/body_tracking_data", "visualization_msgs/msg/MarkerArray", BEGIN + i * PERIOD, array)
    with sqlite3.connect(tmp_path / "a" / "a.db3") as db:
        db.execute("update messages set data = substr(data, 1, 200) where id = 5")
    log = open_log(tmp_path / "a")
    assert len(own.read(log)) == 9
    assert log.defects["messages_undecodable"] == 1


# --- names ---


def test_every_name_that_is_counted_is_explained(tmp_path: Path) -> None:
    log = opened(tmp_path, own.frames(10))
    own.read(log)
    general = {name.replace("left", "<camera>").replace("right", "<camera>") for name in log.defects}
    assert general <= set(DEFECTS)


def test_all_kinds_of_bags_agree(tmp_path: Path) -> None:
    tables = []
    for kind in KINDS:
        path = tmp_path / (f"{kind}.bag" if kind == "ros1" else kind)
        with bag(path, kind) as (write, store):
            write_openni(write, store, frames=30, start_ns=BEGIN)
        tables.append(own.read(open_log(path)))
    for other in tables[1:]:
        np.testing.assert_array_equal(other.points_m, tables[0].points_m)
        np.testing.assert_array_equal(other.capture_ns, tables[0].capture_ns)
