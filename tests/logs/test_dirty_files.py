from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from rosbags import rosbag1

from hrcreplay.errors import LogError
from hrcreplay.logs.log_files import open_source
from hrcreplay.logs.reader import open_log
from tests.facts import facts, tells
from tests.logs import own
from tests.logs.bags import bag, write_openni
from tests.realdata import data_path

BEGIN = own.BEGIN_NS


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
        assert tells(log.notes, "breaks off", f"{after:.3f} s")


def test_mcap_cut_within_the_header(tmp_path: Path) -> None:
    path = own.write(tmp_path / "a.mcap", own.frames(10))
    for length in (8, 12, 20):
        path.write_bytes(path.read_bytes()[:length])
        with pytest.raises(LogError, match=r"a\.mcap: .*(breaks off|no messages)"):
            open_log(path)


def test_mcap_cut_before_its_first_whole_chunk(tmp_path: Path) -> None:
    path = own.write(tmp_path / "a.mcap", own.frames(1000))
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(LogError, match=facts("a.mcap", "no messages")):
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
    assert tells(log.notes, "no index")
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
    log = open_log(own.write(tmp_path / "a.mcap", table.rows(order)))
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
    assert tells(log.notes, "breaks off")


def test_bag_that_breaks_off_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    with bag(path, "ros1") as (write, store):
        write_openni(write, store, frames=20, start_ns=BEGIN)
    path.write_bytes(path.read_bytes()[:4300])
    with pytest.raises(LogError, match=facts("a.bag", "no messages", "whole")):
        open_log(path)


@pytest.mark.parametrize("form", list(rosbag1.Writer.CompressionFormat))
def test_bag_with_a_damaged_chunk(tmp_path: Path, form: rosbag1.Writer.CompressionFormat) -> None:
    path = tmp_path / "a.bag"
    with bag(path, "ros1", compression=(form,)) as (write, store):
        write_openni(write, store, frames=600, start_ns=BEGIN)
    data = bytearray(path.read_bytes())
    data[5000:6000] = b"\xff" * 1000
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"a\.bag: .*(broken|chunk|no messages)"):
        list(open_log(path).frames())


def test_a_reader_that_fails_without_a_word_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with bag(tmp_path / "a.bag", "ros1") as (write, store):
        write_openni(write, store, frames=4, start_ns=own.BEGIN_NS)
    source = open_source(tmp_path / "a.bag")

    def fail(*_: object) -> None:
        raise OSError

    monkeypatch.setattr("rosbags.rosbag1.Reader.messages", fail)
    with pytest.raises(LogError, match=facts("a.bag", "OSError", "copy it again")):
        list(source.messages(["/tf"]))
