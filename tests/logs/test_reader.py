from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags import rosbag1
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode
from rosbags.typesys.store import Typestore
from ruamel.yaml import YAML

from hrcreplay.errors import LogError
from hrcreplay.logs.log_files import open_source
from hrcreplay.logs.messages import LazyChunk, Message, Topic, merge_by_arrival
from hrcreplay.logs.reader import open_log
from hrcreplay.settings.sections import Logs
from tests.facts import facts, tells
from tests.logs import own
from tests.logs.bags import KINDS, Write, bag, header, make, marker_array, transform, write_openni
from tests.realdata import data_path

BEGIN = own.BEGIN_NS
MCAP = "ros_bags/rosbag2/rosbag2_py/test/resources/mcap"


# --- order ---


@settings(max_examples=200, deadline=None)
@given(st.lists(st.lists(st.integers(0, 30), max_size=8), max_size=8))
def test_any_parts_come_in_order_of_arrival(times: list[list[int]]) -> None:
    topic = Topic("/t", "t", 0, bytes)
    parts = [[Message(t, topic, b"%d" % i) for t in sorted(part)] for i, part in enumerate(times)]
    merged = list(merge_by_arrival(LazyChunk(part[0].arrival_ns if part else 0, partial(iter, part)) for part in parts))
    assert [m.arrival_ns for m in merged] == sorted(t for part in times for t in part)
    assert Counter(m.data for m in merged) == Counter(m.data for part in parts for m in part)


def test_parts_that_do_not_overlap_are_never_open_together() -> None:
    topic = Topic("/t", "t", 0, bytes)
    open_now: set[int] = set()
    most = 0

    def part(number: int) -> Iterator[Message]:
        nonlocal most
        open_now.add(number)
        most = max(most, len(open_now))
        yield from (Message(10 * number + k, topic, b"") for k in range(5))
        open_now.discard(number)

    assert len(list(merge_by_arrival(LazyChunk(10 * n, partial(part, n)) for n in reversed(range(6))))) == 30
    assert most == 1


# --- our own logs ---


def test_chunks_are_at_most_a_second_and_in_order(tmp_path: Path) -> None:
    frames = own.frames(1000)
    chunks = list(open_log(own.write(tmp_path / "a.mcap", frames)).frames())
    assert len(chunks) > 30
    for chunk in chunks:
        assert chunk.arrival_ns[-1] - chunk.arrival_ns[0] < 10**9
        assert chunk.cameras == ("left", "right")
    np.testing.assert_array_equal(np.concatenate([c.arrival_ns for c in chunks]), frames.arrival_ns)
    np.testing.assert_array_equal(np.concatenate([c.points_m for c in chunks]), frames.points_m)


def test_window_is_half_open_in_arrival_time(tmp_path: Path) -> None:
    frames = own.frames(1000)
    log = open_log(own.write(tmp_path / "a.mcap", frames))
    start, end = int(frames.arrival_ns[300]), int(frames.arrival_ns[700])
    np.testing.assert_array_equal(own.read(log, start_ns=start, end_ns=end).arrival_ns, frames.arrival_ns[300:700])
    np.testing.assert_array_equal(own.read(log, start_ns=start).arrival_ns, frames.arrival_ns[300:])
    np.testing.assert_array_equal(own.read(log, end_ns=end).arrival_ns, frames.arrival_ns[:700])
    assert list(log.frames(start_ns=int(frames.arrival_ns[-1]) + 1)) == []


def test_a_window_reads_only_its_chunks(tmp_path: Path) -> None:
    path = own.write(tmp_path / "a.mcap", own.frames(4000))
    source = open_source(path)
    blocks = source.streams[0]._blocks  # type: ignore[attr-defined]
    assert len(blocks) > 4
    data = bytearray(path.read_bytes())
    for block in blocks[1:]:  # unreadable, if anybody looked
        middle = block.offset + block.length // 2
        data[middle : middle + 64] = bytes(64)
    path.write_bytes(data)
    log = open_log(path)
    assert len(own.read(log, end_ns=BEGIN + 10**9)) == 30
    assert log.defects["chunks_unreadable"] == 0


def test_counts_are_of_the_latest_pass(tmp_path: Path) -> None:
    log = open_log(own.write(tmp_path / "a.mcap", own.frames(100)))
    own.read(log)
    own.read(log)
    assert log.defects["frames_left"] == 50
    own.read(log, end_ns=BEGIN + own.PERIOD_NS)
    assert (log.defects["frames_left"], log.defects["frames_right"]) == (1, 0)
    assert list(log.defects) == sorted(log.defects)


# --- ROS ---


def test_split_mcap_folder_is_one_stream() -> None:
    folder = data_path(f"{MCAP}/wbag")
    source = open_source(folder)
    names = [topic.name for topic in source.topics()]
    messages = list(source.messages(names))
    assert [m.arrival_ns for m in messages] == sorted(m.arrival_ns for m in messages)
    with AnyReader([folder]) as reader:
        expected = Counter((c.topic, t, bytes(data)) for c, t, data in reader.messages())
    assert Counter((m.topic.name, m.arrival_ns, m.data) for m in messages) == expected
    assert sum(topic.count for topic in source.topics()) == sum(expected.values()) == 6074
    window = list(source.messages(names, 1500, 2500))
    assert [m.arrival_ns for m in window] == [m.arrival_ns for m in messages if 1500 <= m.arrival_ns < 2500]
    assert messages[0].read().data == "AAA" or messages[0].topic.type == "std_msgs/String"


def test_split_files_that_overlap_are_merged(tmp_path: Path) -> None:
    people = np.random.default_rng(0).normal(size=(60, 32, 3))
    for part, which in (("a", range(0, 60, 2)), ("b", range(1, 60, 2))):
        with bag(tmp_path / part, "mcap") as (write, store):
            for i in which:
                array = marker_array(store, BEGIN + i * 10**7, {1: people[i]})
                write("/body_tracking_data", "visualization_msgs/msg/MarkerArray", BEGIN + i * 10**7, array)
    shutil.move(tmp_path / "b" / "b.mcap", tmp_path / "a" / "b.mcap")
    yaml = YAML()
    metadata = yaml.load(tmp_path / "a" / "metadata.yaml")
    metadata["rosbag2_bagfile_information"]["relative_file_paths"].append("b.mcap")
    metadata["rosbag2_bagfile_information"]["message_count"] = 60
    yaml.dump(metadata, tmp_path / "a" / "metadata.yaml")
    log = open_log(tmp_path / "a")
    np.testing.assert_array_equal(own.read(log).points_m[:, 3], people[:, 26])
    assert tells(log.notes[0], "markers", "confidence", "1")


def test_compressed_bag_gives_the_same_messages() -> None:
    plain, packed = (open_source(data_path(f"ros_bags/example{x}.bag")) for x in ("", "-lz4"))
    names = [topic.name for topic in plain.topics()]
    for one, other in zip(plain.messages(names), packed.messages(names), strict=True):
        assert (one.arrival_ns, one.topic.name, one.data) == (other.arrival_ns, other.topic.name, other.data)


def test_same_recording_as_ros1_and_ros2() -> None:
    one, two = (open_source(data_path(f"ros_bags/evo_tf_example{x}")) for x in (".bag", ""))
    pairs = list(zip(one.messages(["/tf"]), two.messages(["/tf"]), strict=True))
    assert len(pairs) == 517
    for a, b in pairs:
        [ta], [tb] = a.read().transforms, b.read().transforms
        assert (ta.child_frame_id, ta.transform.translation.x) == (tb.child_frame_id, tb.transform.translation.x)


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_zstd_of_ros2(tmp_path: Path, mode: CompressionMode) -> None:
    with bag(tmp_path / "a", "db3", compression=(mode, CompressionFormat.ZSTD)) as (write, store):
        write_openni(write, store, frames=20, start_ns=BEGIN)
    assert len(own.read(open_log(tmp_path / "a"))) == 20


@pytest.mark.parametrize("form", list(rosbag1.Writer.CompressionFormat))
def test_compressions_of_ros1(tmp_path: Path, form: rosbag1.Writer.CompressionFormat) -> None:
    with bag(tmp_path / "a.bag", "ros1", compression=(form,)) as (write, store):
        write_openni(write, store, frames=20, start_ns=BEGIN)
    assert len(own.read(open_log(tmp_path / "a.bag"))) == 20


def test_db3_file_without_its_folder(tmp_path: Path) -> None:
    with bag(tmp_path / "a", "db3") as (write, store):
        write_openni(write, store, frames=20, start_ns=BEGIN)
    shutil.move(tmp_path / "a" / "a.db3", tmp_path / "alone.db3")
    log = open_log(tmp_path / "alone.db3")
    assert log.header.kind == "ros2"
    assert len(own.read(log)) == 20


def test_window_of_a_ros_bag(tmp_path: Path) -> None:
    for kind in KINDS:
        path = tmp_path / kind / ("a.bag" if kind == "ros1" else "a")
        path.parent.mkdir()
        with bag(path, kind) as (write, store):
            write_openni(write, store, frames=90, start_ns=BEGIN)
        log = open_log(path)
        whole = own.read(log)
        part = own.read(log, start_ns=BEGIN + 10**9, end_ns=BEGIN + 2 * 10**9)
        inside = (whole.arrival_ns >= BEGIN + 10**9) & (whole.arrival_ns < BEGIN + 2 * 10**9)
        np.testing.assert_array_equal(part.arrival_ns[2:], whole.arrival_ns[inside][2:])


def test_messages_before_the_clock_do_not_stretch_the_span(tmp_path: Path) -> None:
    with bag(tmp_path / "a.bag", "ros1") as (write, store):
        write("/chatter", "std_msgs/msg/String", 0, make(store, "std_msgs/msg/String", data="hello"))
        write_openni(write, store, frames=20, start_ns=BEGIN)
    header = open_log(tmp_path / "a.bag").header
    assert header.start_ns == BEGIN + 5_000_000
    assert header.end_ns == BEGIN + 5_000_000 + 19 * 33_000_000 + 14 * 200_000


# --- topics ---


def test_topics_can_be_chosen(tmp_path: Path) -> None:
    path = own.write(tmp_path / "a.mcap", own.frames(100))
    log = open_log(path, Logs(topics=("/camera/right/skeleton",)))
    assert log.header.cameras == ("right",)
    assert len(own.read(log)) == 50
    with pytest.raises(LogError, match=facts("a.mcap", "/camera/top/skeleton", "/camera/left/info")):
        open_log(path, Logs(topics=("/camera/top/skeleton",)))


def test_chosen_topic_without_skeletons() -> None:
    with pytest.raises(LogError, match=facts("example.bag", "/rosout (rosgraph_msgs/Log)", "Name a topic")):
        open_log(data_path("ros_bags/example.bag"), Logs(topics=("/rosout",)))


def test_log_without_skeletons_is_refused_with_what_it_has() -> None:
    with pytest.raises(LogError) as caught:
        open_log(data_path("sara_human_robot_bags/exp_box.bag"))
    text = str(caught.value)
    assert tells(text, "no skeleton", "/SaRA_demo_robot_capsules (reachable_occupancy/ReachableOccupancy)")
    assert tells(text, "--topic NAME", "[[logs.decoders]]")


def numbers(write: Write, store: Typestore) -> None:
    """Points as plain numbers."""
    array = make(store, "std_msgs/msg/Float32MultiArray", data=np.zeros(60, dtype=np.float32))
    write("/landmarks", "std_msgs/msg/Float32MultiArray", BEGIN, array)


def few_numbers(write: Write, store: Typestore) -> None:
    """Numbers that are too few for a body."""
    array = make(store, "std_msgs/msg/Float32MultiArray", data=np.zeros(6, dtype=np.float32))
    write("/landmarks", "std_msgs/msg/Float32MultiArray", BEGIN, array)


def frames_of_another_tracker(write: Write, store: Typestore) -> None:
    """Transforms whose names are no body points of openni_tracker."""
    for name in ("SpineMid_1", "Neck_1", "ElbowLeft_1"):
        sent = make(store, "tf2_msgs/msg/TFMessage", transforms=[transform(store, BEGIN, "cam", name, (0, 0, 1))])
        write("/tf", "tf2_msgs/msg/TFMessage", BEGIN, sent)


def one_polygon(write: Write, store: Typestore) -> None:
    """An array of points."""
    polygon = make(store, "geometry_msgs/msg/Polygon", points=[make(store, "geometry_msgs/msg/Point32") for _ in "abc"])
    write("/points", "geometry_msgs/msg/Polygon", BEGIN, polygon)


@pytest.mark.parametrize(
    ("write_bodies", "found", "helps"),
    [
        (numbers, ("/landmarks (std_msgs/Float32MultiArray)", "'data'"), True),
        (few_numbers, ("/landmarks (std_msgs/Float32MultiArray)", "points"), False),
        (frames_of_another_tracker, ("SpineMid_1, Neck_1, ElbowLeft_1", "names"), False),
        (one_polygon, ("'points' (up to 3)",), True),
    ],
)
def test_decoders_are_advised_only_where_they_help(
    write_bodies: Callable[[Write, Typestore], None], found: tuple[str, ...], helps: bool, tmp_path: Path
) -> None:
    with bag(tmp_path / "a", "mcap") as (write, store):
        write_bodies(write, store)
    with pytest.raises(LogError, match=facts("no skeleton", *found)) as caught:
        open_log(tmp_path / "a")
    text = str(caught.value)
    assert "\n" not in text
    assert tells(text, "--topic") == helps
    assert ("hrcreplay.logs.writer.LogWriter" in text) != helps
    log = open_log(tmp_path / "a", skeletons=False)
    assert text.endswith(log.skeletons_remedy)


def test_two_topics_of_one_camera_name(tmp_path: Path) -> None:
    with bag(tmp_path / "a.bag", "ros1") as (write, store):
        for topic in ("/a/body", "/a_body"):
            array = marker_array(store, BEGIN, {1: np.ones((32, 3))})
            write(topic, "visualization_msgs/msg/MarkerArray", BEGIN, array)
    with pytest.raises(LogError, match=facts("/a/body", "/a_body", "'a_body'")):
        open_log(tmp_path / "a.bag")


# --- joints: more in test_joints.py ---


def test_a_topic_of_joint_states_that_is_not_there_is_refused(tmp_path: Path) -> None:
    state = "sensor_msgs/msg/JointState"
    with bag(tmp_path / "a", "mcap") as (write, store):
        write_openni(write, store, frames=20, start_ns=BEGIN)
        sent = make(store, state, header=header(store, BEGIN), name=["a"], position=np.zeros(1))
        write("/robot/joint_states", state, BEGIN, sent)
    assert open_log(tmp_path / "a").header.joint_topics == ("/robot/joint_states",)
    with pytest.raises(LogError, match=facts("no joint states on /tf", "/robot/joint_states")):
        open_log(tmp_path / "a", Logs(joints_topic="/tf"))
