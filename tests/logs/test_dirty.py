from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.logs.cleaning import DEFECTS
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.records import POINTS, CameraFrames
from hrcreplay.settings.sections import Logs
from tests.facts import tells
from tests.logs import own
from tests.logs.bags import KINDS, OPENNI, bag, make, marker_array, openni_at, transform, write_openni

BEGIN = own.BEGIN_NS
PERIOD = own.PERIOD_NS
RESOURCES = "ros_bags/rosbag2/rosbag2_py/test/resources"


def opened(tmp_path: Path, table: CameraFrames, **options: Any) -> Log:
    return open_log(own.write(tmp_path / "a.mcap", table), Logs(**options))


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
    table = changed(table, arrival_ns=BEGIN + np.arange(4, 10) * PERIOD)
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


def test_points_that_no_body_has_are_missing(tmp_path: Path) -> None:
    """'Not tracked' at the origin, places no camera sees, two ends of a bone in one place."""
    table = own.frames(6, cameras=("one",))
    points, confidence = table.points_m.copy(), np.full((6, 20), 0.75)
    at = {name: i for i, name in enumerate(POINTS)}
    points[1] = 0.0
    points[2, [at["elbow_l"], at["wrist_l"], at["hand_l"]]] = 0.0
    confidence[2, at["hand_l"]] = 0.0  # said to be missing
    points[3, at["head"]], points[3, at["knee_r"]] = 1e9, 3e38
    points[4, at["shoulder_l"]] = points[4, at["shoulder_r"]]
    points[5, at["neck"]] = points[5, at["pelvis"]] + 5e-4
    points[5, at["hand_r"]] = points[5, at["wrist_r"]]  # as trackers do that know no hand
    log = opened(tmp_path, changed(table, points_m=points, confidence=confidence))
    frames = own.read(log)
    gone = np.zeros((6, 20), dtype=bool)
    gone[1] = True
    gone[2, [at["elbow_l"], at["wrist_l"], at["hand_l"]]] = True
    gone[3, [at["head"], at["knee_r"]]] = True
    gone[4, [at["shoulder_l"], at["shoulder_r"]]] = True
    gone[5, [at["neck"], at["pelvis"]]] = True
    np.testing.assert_array_equal(np.isnan(frames.points_m).all(axis=2), gone)
    np.testing.assert_array_equal(frames.confidence, np.where(gone, 0.0, np.where(confidence > 0, 0.75, 0.0)))
    np.testing.assert_array_equal(frames.points_m[~gone], points.astype(np.float32)[~gone])
    counted = {name: log.defects[f"points_{name}"] for name in ("at_origin", "too_far", "coincident", "not_finite")}
    assert counted == {"at_origin": 22, "too_far": 2, "coincident": 4, "not_finite": 0}
    origin = f"22 {DEFECTS['points_at_origin']} (19 % of its points)"
    assert f"camera one: {origin}" in log.notes
    assert tells(log.notes, f"2 {DEFECTS['points_too_far']}")


def test_a_camera_that_freezes_is_silent(tmp_path: Path) -> None:
    """Identical points with fresh stamps are no frames; what moves again is."""
    which = [0, 1, 2, *([3] * 40), 4, 5]
    table = own.frames(10, cameras=("one",), which=which)
    captures = BEGIN + np.arange(45) * PERIOD
    log = opened(tmp_path, changed(table, capture_ns=captures, arrival_ns=captures + 5_000_000))
    frames = own.read(log)
    np.testing.assert_array_equal(frames.capture_ns, captures[[0, 1, 2, 3, 43, 44]])
    assert (log.defects["frames_repeated"], log.defects["frames_one"]) == (39, 6)
    (said,) = (note for note in log.notes if "froze" in note)
    assert tells(said, "camera one", "1.30 s", "0.10 s", "39 rows")


@pytest.mark.parametrize("kind", ["frozen", "trembling", "contradicting"])
def test_a_body_that_is_not_shown_anew_is_said_to_be_there(tmp_path: Path, kind: str) -> None:
    """Where frames of nobody are asked for, too: its rows have no point, and the counts are the same."""
    rng = np.random.default_rng(3)
    table = own.frames(10, cameras=("one",), which=[0, 1, 2, *([3] * 40), 4, 5])
    captures, points = BEGIN + np.arange(45) * PERIOD, table.points_m.copy()
    if kind == "trembling":
        points[4:43] += rng.uniform(-1e-4, 1e-4, size=(39, *points.shape[1:]))
    if kind == "contradicting":
        captures[4:43:2] = captures[3:42:2]
        points[3:43] += rng.uniform(-0.1, 0.1, size=(40, *points.shape[1:]))
    log = opened(tmp_path, changed(table, capture_ns=captures, arrival_ns=captures + 5_000_000, points_m=points))
    plain, counts = own.read(log), dict(log.defects)
    everything = CameraFrames.join(list(log.frames(nobody=True)))
    assert dict(log.defects) == counts
    unshown = np.isnan(everything.points_m).all(axis=(1, 2))
    assert unshown.sum() == counts[{"frozen": "frames_repeated"}.get(kind, f"frames_{kind}")]
    assert unshown.sum() > 15
    assert not everything.confidence[unshown].any()
    assert (everything.body == table.body[0]).all()
    assert len(everything) == len(table)
    np.testing.assert_array_equal(everything.points_m[~unshown], plain.points_m)


def test_a_repeated_frame_now_and_then_is_counted_only(tmp_path: Path) -> None:
    table = own.frames(10, cameras=("one",), which=[0, 1, 1, 2, 3])
    captures = BEGIN + np.arange(5) * PERIOD
    log = opened(tmp_path, changed(table, capture_ns=captures, arrival_ns=captures + 5_000_000))
    assert len(own.read(log)) == 4
    assert log.defects["frames_repeated"] == 1
    assert not any("froze" in note for note in log.notes)


def test_bodies_of_nobody_do_not_freeze(tmp_path: Path) -> None:
    table = own.frames(10, cameras=("one",))
    log = opened(tmp_path, changed(table, points_m=np.zeros((10, 20, 3))))
    assert len(own.read(log)) == 10
    assert log.defects["frames_repeated"] == 0


def test_stamps_that_cannot_be_give_way_to_arrival(tmp_path: Path) -> None:
    """Zero, an hour ahead (all that follow would look late), an hour behind."""
    table = own.frames(6, cameras=("one",))
    captures = table.capture_ns.copy()
    captures[1], captures[2], captures[3] = 0, captures[2] + 3600 * 10**9, captures[3] - 3600 * 10**9
    arrivals = table.capture_ns + 40_000_000 * (np.arange(6) == 0) + 5_000_000
    log = opened(tmp_path, changed(table, capture_ns=captures, arrival_ns=np.maximum.accumulate(arrivals)))
    frames = own.read(log)
    assert len(frames) == 6
    np.testing.assert_array_equal(frames.capture_ns[1:4], frames.arrival_ns[1:4])
    np.testing.assert_array_equal(frames.capture_ns[[0, 4, 5]], captures[[0, 4, 5]])
    assert log.defects["frames_stamp_far"] == 3
    (told,) = (note for note in log.notes if "stamp" in note)
    assert all(part in told for part in ("camera one", "3 frames", "over 10 s", "arrival used"))


def test_gaps_are_counted_by_camera(tmp_path: Path) -> None:
    which = [k for k in range(200) if not (k % 2 == 0 and (40 <= k < 60 or 100 <= k < 140))]
    log = opened(tmp_path, own.frames(200, which=which), gap_s=0.5)
    own.read(log)
    assert (log.defects["gaps_left"], log.defects["gaps_right"]) == (2, 0)
    log = open_log(tmp_path / "a.mcap", Logs(gap_s=1.0))
    own.read(log)
    assert log.defects["gaps_left"] == 1


def test_camera_that_starts_late_and_one_that_dies(tmp_path: Path) -> None:
    which = [k for k in range(300) if (k >= 90 if k % 2 else k < 200)]
    log = opened(tmp_path, own.frames(300, which=which))
    assert log.header.cameras == ("left", "right")
    own.read(log)
    assert tells(log.notes, "right", "3.03 s after")
    assert tells(log.notes, "left", "3.37 s before")


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
    assert tells(log.notes, "stamps", "zero", "arrival")


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
