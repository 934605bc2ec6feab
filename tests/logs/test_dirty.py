from __future__ import annotations

import io
import shutil
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from ruamel.yaml import YAML

from hrcreplay.errors import LogError
from hrcreplay.logs.clean import DEFECTS
from hrcreplay.logs.reader import Log, LogOptions, open_log
from hrcreplay.logs.source import open_source
from hrcreplay.records import CameraFrames
from tests.logs import own
from tests.logs.bags import KINDS, OPENNI, bag, make, marker_array, openni_at, transform, write_openni
from tests.realdata import data_path

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
            array = marker_array(store, BEGIN + i * PERIOD, {1: np.ones((32, 3))})
            write("/body_tracking_data", "visualization_msgs/msg/MarkerArray", BEGIN + i * PERIOD, array)
    with sqlite3.connect(tmp_path / "a" / "a.db3") as db:
        db.execute("update messages set data = substr(data, 1, 200) where id = 5")
    log = open_log(tmp_path / "a")
    assert len(own.read(log)) == 9
    assert log.defects["messages_undecodable"] == 1


# --- MCAP files ---


@pytest.mark.parametrize("share", [0.35, 0.6, 0.9, 0.9999])
def test_truncated_mcap_gives_what_is_whole(tmp_path: Path, share: float) -> None:
    table = own.frames(4000)
    path = own.write(tmp_path / "a.mcap", table, cameras={"left": np.eye(4)})
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    log = open_log(path)
    frames = own.read(log)
    n = len(frames)
    assert 0.25 * share * 4000 < n <= 4000
    np.testing.assert_array_equal(frames.points_m, table.points_m[:n])
    assert log.header.cameras == ("left", "right")
    assert set(log.header.T_world_camera) == {"left"}
    assert log.header.end_ns == table.arrival_ns[n - 1]
    if share < 0.99:
        assert log.defects["truncated_at_ns"] == table.arrival_ns[n - 1]
        after = (table.arrival_ns[n - 1] - table.arrival_ns[0]) / 1e9
        assert f"the file breaks off {after:.3f} s after its first message" in log.notes


def test_mcap_cut_within_the_header(tmp_path: Path) -> None:
    path = own.write(tmp_path / "a.mcap", own.frames(10))
    for length in (8, 12, 20):
        path.write_bytes(path.read_bytes()[:length])
        with pytest.raises(LogError, match=r"a\.mcap: (breaks off within the MCAP header|the log holds no messages)"):
            open_log(path)


def test_mcap_cut_before_its_first_whole_chunk(tmp_path: Path) -> None:
    path = own.write(tmp_path / "a.mcap", own.frames(1000))
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(LogError, match="the log holds no messages"):
        open_log(path)


def test_preallocated_zeros_after_a_power_cut(tmp_path: Path) -> None:
    path = own.write(tmp_path / "a.mcap", own.frames(4000))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(len(data) // 2))
    log = open_log(path)
    assert 1000 < len(own.read(log)) < 2500
    assert log.defects["truncated_at_ns"] + log.defects["chunks_unreadable"] > 0


@pytest.mark.parametrize("chunked", [True, False])
def test_mcap_without_index(tmp_path: Path, *, chunked: bool) -> None:
    table = own.frames(3000)
    whole = own.write(tmp_path / "whole.mcap", table)
    path = tmp_path / "bare.mcap"
    source = open_source(whole)
    with path.open("wb") as file:
        writer = Writer(
            file, chunk_size=100_000, compression=CompressionType.LZ4, index_types=IndexType.NONE,
            repeat_channels=False, repeat_schemas=False, use_chunking=chunked, use_statistics=False,
            use_summary_offsets=False,
        )  # fmt: skip
        writer.start(profile="hrcreplay")
        schema = writer.register_schema("hrcreplay.Skeleton", "protobuf", b"")
        channels = {
            name: writer.register_channel(f"/camera/{name}/skeleton", "protobuf", schema) for name in table.cameras
        }
        for message in source.messages([f"/camera/{name}/skeleton" for name in table.cameras]):
            channel = channels[message.topic.name.split("/")[2]]
            writer.add_message(channel, message.arrival_ns, message.data, message.arrival_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    log = open_log(path)
    np.testing.assert_array_equal(own.read(log).points_m, table.points_m)
    assert "the file has no index: it was read once more to make one" in log.notes
    window = own.read(log, start_ns=int(table.arrival_ns[1000]), end_ns=int(table.arrival_ns[2000]))
    np.testing.assert_array_equal(window.arrival_ns, table.arrival_ns[1000:2000])


@pytest.mark.parametrize("indexed", [True, False])
def test_damaged_chunk_is_left_out(tmp_path: Path, *, indexed: bool) -> None:
    table = own.frames(4000)
    path = own.write(tmp_path / "a.mcap", table)
    block = open_source(path).streams[0]._blocks[2]  # type: ignore[attr-defined]
    data = bytearray(path.read_bytes())
    data[block.offset + 2000 : block.offset + 2064] = bytes(64)
    path.write_bytes(data if indexed else data[:-40])
    log = open_log(path)
    for _ in range(2):  # counted once, however often it is read
        frames = own.read(log)
        assert log.defects["chunks_unreadable"] == 1
    outside = (table.arrival_ns < block.start_ns) | (table.arrival_ns > block.end_ns)
    np.testing.assert_array_equal(frames.arrival_ns, table.arrival_ns[outside])


def test_messages_of_mcap_in_any_order(tmp_path: Path) -> None:
    table = own.frames(2000, cameras=("one",))
    order = np.random.default_rng(0).permutation(2000)
    log = opened(tmp_path, table.rows(order))
    np.testing.assert_array_equal(own.read(log).arrival_ns, table.arrival_ns)


# --- ROS 1 bags ---


def without_index(path: Path) -> None:
    """What a recorder that was killed leaves: no index position, no index at the end."""
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    (position,) = struct.unpack_from("<Q", data, at)
    data[at : at + 8] = bytes(8)
    path.write_bytes(data[:position])


def test_bag_without_index_is_read_all_the_same(tmp_path: Path) -> None:
    original = data_path("ros_bags/example-lz4.bag")
    path = tmp_path / "example.bag"
    shutil.copy(original, path)
    without_index(path)
    one, other = open_source(original), open_source(path)
    names = [topic.name for topic in one.topics()]
    assert {(t.name, t.type, t.count) for t in other.topics()} == {(t.name, t.type, t.count) for t in one.topics()}
    assert (other.start_ns, other.end_ns) == (one.start_ns, one.end_ns)
    pairs = list(zip(one.messages(names), other.messages(names), strict=True))
    assert [a.arrival_ns for a, _ in pairs] == [b.arrival_ns for _, b in pairs]
    assert {(a.arrival_ns, a.topic.name, a.data) for a, _ in pairs} == {
        (b.arrival_ns, b.topic.name, b.data) for _, b in pairs
    }
    middle = one.start_ns + 10**10
    assert sum(1 for _ in one.messages(names, middle)) == sum(1 for _ in other.messages(names, middle))
    assert other.damage().defects["unindexed"] == 1
    assert "rosbag reindex" in other.damage().notes[0]


@pytest.mark.parametrize("index", ["kept", "cut"])
def test_bag_that_breaks_off(tmp_path: Path, index: str) -> None:
    path = tmp_path / "a.bag"
    with bag(path, "ros1") as (write, store):
        write_openni(write, store, frames=600, start_ns=BEGIN)
    if index == "cut":
        without_index(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * 0.5)])
    log = open_log(path)
    frames = own.read(log)
    assert 250 < len(frames) < 350
    np.testing.assert_array_equal(frames.capture_ns, BEGIN + np.arange(len(frames)) * 33_000_000)
    assert log.defects["unindexed"] == 1
    assert abs(log.defects["truncated_at_ns"] - frames.arrival_ns[-1]) < 40_000_000
    assert any(note.startswith("the file breaks off ") for note in log.notes)


def test_bag_that_breaks_off_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    with bag(path, "ros1") as (write, store):
        write_openni(write, store, frames=20, start_ns=BEGIN)
    path.write_bytes(path.read_bytes()[:4300])
    with pytest.raises(LogError, match="the log holds no messages that are whole"):
        open_log(path)


# --- what is no log, or an empty one ---


@pytest.mark.parametrize(
    "name", ["ros_bags/empty-file.bag", "ros_bags/no-messages.bag", "ros_bags/rosbag2/ros2bag/test/resources/empty_bag"]
)
def test_empty_logs(name: str) -> None:
    with pytest.raises(LogError, match="the log holds no messages"):
        open_log(data_path(name))


def test_empty_mcap(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    writer = Writer(buffer)
    writer.start()
    writer.finish()  # type: ignore[no-untyped-call]
    (tmp_path / "a.mcap").write_bytes(buffer.getvalue())
    with pytest.raises(LogError, match="the log holds no messages"):
        open_log(tmp_path / "a.mcap")


def test_paths_that_are_no_log(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "image.bag").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "folder").mkdir()
    (tmp_path / "wrong").mkdir()
    (tmp_path / "wrong" / "metadata.yaml").write_text("a: [")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "metadata.yaml").write_text("a: 1")
    for name, message in {
        "none.mcap": "there is no such file or folder; name a log",
        "notes.txt": "is no log of a known kind; known are MCAP files",
        "image.bag": "is no log of a known kind",
        "folder": "is a folder without metadata.yaml; known are MCAP",
        "wrong": "is not the metadata of a ROS 2 bag",
        "other": "is not the metadata of a ROS 2 bag",
    }.items():
        with pytest.raises(LogError, match=message) as caught:
            open_log(tmp_path / name)
        assert "\n" not in str(caught.value)
        assert str(tmp_path / name) in str(caught.value)


# --- ROS 2 folders that promise more than they hold ---


def promise(folder: Path, n: int) -> None:
    yaml = YAML()
    metadata = yaml.load(folder / "metadata.yaml")
    metadata["rosbag2_bagfile_information"]["message_count"] = n
    yaml.dump(metadata, folder / "metadata.yaml")


def test_messages_that_rosbags_loses_in_silence_are_read() -> None:
    source = open_source(data_path(f"{RESOURCES}/sqlite3/talker"))
    assert {t.name: t.count for t in source.topics()} == {"/topic": 10, "/rosout": 10, "/parameter_events": 0}
    assert len(list(source.messages(["/topic", "/rosout"]))) == 20
    texts = [message.read().data for message in source.messages(["/topic"])]
    assert texts == [f"Hello, world! {k}" for k in range(10)]


def test_promise_of_messages_where_none_are(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    shutil.copytree(data_path(f"{RESOURCES}/sqlite3/talker"), folder)
    folder.chmod(0o755)
    for file in folder.iterdir():
        file.chmod(0o644)
    database = sqlite3.connect(folder / "talker.db3")
    with database:
        database.execute("update messages set topic_id = 99")  # they are there, but belong to nothing
    assert (
        "talker.db3-wal beside the file holds messages not yet in it; they are left out"
        in open_source(folder).damage().notes
    )
    database.close()
    with pytest.raises(LogError, match=r"metadata\.yaml promises 20 messages, but its files \(1\) give none"):
        open_log(folder)


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_promise_of_more_messages_than_there_are(tmp_path: Path, kind: str) -> None:
    with bag(tmp_path / "a", kind) as (write, store):
        write_openni(write, store, frames=20, start_ns=BEGIN)
    promise(tmp_path / "a", 320)
    log = open_log(tmp_path / "a")
    assert log.defects["messages_missing"] == 20
    assert "metadata.yaml promises 320 messages, but the files give 300" in log.notes


def test_split_with_a_file_missing_and_one_broken(tmp_path: Path) -> None:
    folder = tmp_path / "wbag"
    shutil.copytree(data_path(f"{RESOURCES}/mcap/wbag"), folder)
    folder.chmod(0o755)
    (folder / "wbag_2.mcap").unlink()
    last = folder / "wbag_4.mcap"
    last.chmod(0o644)
    last.write_bytes(b"")
    source = open_source(folder)
    damage = source.damage()
    assert damage.defects == {"files_missing": 1, "files_empty": 1, "messages_missing": 1240 + 1108}
    assert "1 of the 5 files in metadata.yaml are not there" in damage.notes
    assert "wbag_4.mcap: has 0 bytes" in damage.notes
    assert source.end_ns == 2623


def test_recorder_killed_before_it_wrote_metadata(tmp_path: Path) -> None:
    for kind in ("db3", "mcap"):
        with bag(tmp_path / kind, kind) as (write, store):
            write_openni(write, store, frames=20, start_ns=BEGIN)
        (tmp_path / kind / "metadata.yaml").unlink()
        log = open_log(tmp_path / kind)
        assert len(own.read(log)) == 20
        assert log.notes[0] == "metadata.yaml is missing: the files of the folder are read in order of time"


def test_truncated_ros2_mcap(tmp_path: Path) -> None:
    with bag(tmp_path / "a", "mcap") as (write, store):
        write_openni(write, store, frames=2000, start_ns=BEGIN)
    path = tmp_path / "a" / "a.mcap"
    data = path.read_bytes()
    path.write_bytes(data[: int(0.7 * len(data))])
    log = open_log(tmp_path / "a")
    frames = own.read(log)
    assert 200 < len(frames) < 2000
    assert log.defects["messages_missing"] > 0
    assert log.defects["truncated_at_ns"] == log.header.end_ns


def test_database_that_is_broken(tmp_path: Path) -> None:
    with bag(tmp_path / "a", "db3") as (write, store):
        write_openni(write, store, frames=200, start_ns=BEGIN)
    path = tmp_path / "a" / "a.db3"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(LogError, match=r"a\.db3: "):
        list(open_log(tmp_path / "a").frames())


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
