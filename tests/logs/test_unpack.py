"""Small files that unpack to gigabytes: they cost neither memory nor time, and are told in one line."""

from __future__ import annotations

import bz2
import gzip
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer
from rosbags import rosbag1

from hrcreplay.errors import LogError
from hrcreplay.logs.log_files import open_source
from hrcreplay.logs.messages import MCAP_MAGIC
from hrcreplay.logs.ros_bags import MAGIC
from hrcreplay.logs.unpack import CHUNK_RECORDS, CannotUnpack, unpack
from tests.bounded import MEMORY_BYTES, assert_one_line, run_bounded
from tests.facts import facts
from tests.logs import own
from tests.logs.bags import bag, write_openni

BEGIN = own.BEGIN_NS
COMPRESS = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress, "": bytes}


def zstd_bomb(count: int, *, sized: bool) -> bytes:
    """So many zeros, with or without their number in the frame's header."""
    block = bytes(1 << 20)
    packer = zstandard.ZstdCompressor(write_content_size=sized).compressobj(size=count if sized else -1)
    return b"".join([*(packer.compress(block) for _ in range(count >> 20)), packer.flush()])


def bomb(method: str, count: int) -> bytes:
    """So many zeros by a method of ROS 1."""
    machine = {"bz2": bz2.BZ2Compressor, "lz4": lz4.frame.LZ4FrameCompressor}[method]()
    begin = machine.begin() if method == "lz4" else b""
    return b"".join([begin, *(machine.compress(bytes(1 << 20)) for _ in range(count >> 20)), machine.flush()])


@pytest.mark.parametrize("method", sorted(COMPRESS))
def test_what_was_packed_is_unpacked(method: str) -> None:
    data = np.random.default_rng(0).bytes(1_500_000) + bytes(3_000_000)
    packed = COMPRESS[method](data)
    assert unpack(method, packed) == data
    assert unpack(method, packed, limit=len(data)) == data
    with pytest.raises(CannotUnpack):
        unpack(method, packed, limit=len(data) - 1)


@pytest.mark.parametrize("method", ["zstd", "lz4", "bz2"])
def test_damaged_data_is_told(method: str) -> None:
    packed = COMPRESS[method](np.random.default_rng(0).bytes(100_000))
    for bad in (packed[:-100], b"\0" * 50, packed[:2]):
        with pytest.raises(CannotUnpack):
            unpack(method, bad)


def mcap_chunk(folder: Path) -> Path:
    """An MCAP file whose one chunk unpacks to 3 GB; the index says 3 GB, too."""
    path = folder / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, enable_crcs=False)
        writer.start()
        channel = writer.register_channel("/a", "cdr", 0)
        writer.add_message(channel, BEGIN, bytes(1000), BEGIN)
        writer.finish()  # type: ignore[no-untyped-call]
    data = path.read_bytes()
    at = data.index(b"zstd")
    size = int.from_bytes(data[at + 4 : at + 12], "little")
    bomb = zstd_bomb(3 << 30, sized=False)
    start = at - 4 - 4 - 8 - 8 - 8 - 8 - 1
    head = data[start + 9 : at - 16] + (3 << 30).to_bytes(8, "little") + bytes(4) + data[at - 4 : at + 4]
    chunk = head + len(bomb).to_bytes(8, "little") + bomb
    path.write_bytes(data[:start] + b"\x06" + len(chunk).to_bytes(8, "little") + chunk)  # and there it breaks off
    assert path.stat().st_size < 400_000 + size
    return path


def bag_file(folder: Path) -> Path:
    """A split that is compressed as a whole."""
    (folder / "bag").mkdir()
    (folder / "bag" / "rec_0.db3.zstd").write_bytes(zstd_bomb(3 << 30, sized=True))
    return folder / "bag"


def message_of_a_bag(folder: Path) -> Path:
    """A bag in which one message is compressed."""
    with bag(folder / "bag", "db3") as (write, store):
        write_openni(write, store, frames=20, start_ns=BEGIN)
    database = sqlite3.connect(folder / "bag" / "bag.db3")
    with database:
        database.execute("update messages set data = ? where id = 40", (zstd_bomb(3 << 30, sized=True),))
    database.close()
    return folder / "bag"


def record(opcode: int, content: bytes) -> bytes:
    """A record of an MCAP file."""
    return bytes([opcode]) + struct.pack("<Q", len(content)) + content


def mcap_chunk_record(content: bytes, size: int) -> bytes:
    """A chunk of zstd data that says to unpack to so many bytes."""
    head = struct.pack("<QQQLL", BEGIN, BEGIN, size, 0, 4) + b"zstd"
    return record(6, head + struct.pack("<Q", len(content)) + content)


HEADER = record(1, bytes(4) + struct.pack("<L", 1) + b"x")
DATA_END = record(15, bytes(4))
FOOTER = record(2, bytes(20)) + MCAP_MAGIC


def summary_of_mcap(folder: Path) -> Path:
    """The footer points to a chunk of 3 GB where the summary should be."""
    chunk = mcap_chunk_record(zstd_bomb(3 << 30, sized=True), 3 << 30)
    data = MCAP_MAGIC + HEADER + DATA_END
    footer = record(2, struct.pack("<QQL", len(data), 0, 0)) + MCAP_MAGIC
    (folder / "a.mcap").write_bytes(data + chunk + footer)
    return folder / "a.mcap"


def header_of_mcap(folder: Path) -> Path:
    """The first record is a chunk of 3 GB."""
    chunk = mcap_chunk_record(zstd_bomb(3 << 30, sized=True), 3 << 30)
    (folder / "a.mcap").write_bytes(MCAP_MAGIC + chunk + DATA_END + FOOTER)
    return folder / "a.mcap"


def message_of_mcap(folder: Path) -> Path:
    """A message that is compressed by itself."""
    with (folder / "a.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema("tf2_msgs/msg/TFMessage", "ros2msg", b"TransformStamped[] transforms")
        channel = writer.register_channel("/tf", "cdr", schema)
        writer.add_message(channel, BEGIN, zstd_bomb(3 << 30, sized=True), BEGIN)
        writer.finish()  # type: ignore[no-untyped-call]
    return folder / "a.mcap"


def end_of_record(data: bytes, at: int) -> tuple[int, int]:
    """Where the header of a ROS 1 bag's record ends, and where its data does."""
    begin = at + 4 + int(struct.unpack_from("<L", data, at)[0])
    return begin, begin + 4 + int(struct.unpack_from("<L", data, begin)[0])


def ros1_bag(folder: Path, method: str, content: bytes, *, indexed: bool) -> Path:
    """A ROS 1 bag, the data of whose first chunk is replaced."""
    path = folder / "a.bag"
    path.unlink(missing_ok=True)
    form = rosbag1.Writer.CompressionFormat[method.upper()]
    with bag(path, "ros1", compression=(form,)) as (write, store):
        write_openni(write, store, frames=20, start_ns=BEGIN)
    data = path.read_bytes()
    _, first = end_of_record(data, len(MAGIC))
    header, end = end_of_record(data, first)
    chunk = data[first:header] + struct.pack("<L", len(content)) + content
    at = data.index(b"index_pos=") + len(b"index_pos=")
    index = int(struct.unpack_from("<Q", data, at)[0]) + len(chunk) - (end - first) if indexed else 0
    rest = data[end:] if indexed else data[first:end]  # behind the bomb a chunk that is right
    path.write_bytes(data[:at] + struct.pack("<Q", index) + data[at + 8 : first] + chunk + rest)
    return path


@pytest.mark.parametrize("method", ["bz2", "lz4"])
def test_a_bomb_in_a_ros1_bag_is_told_in_one_line(method: str, tmp_path: Path) -> None:
    path = ros1_bag(tmp_path, method, bomb(method, 1 << 30), indexed=True)
    assert_one_line(run_bounded("info", path), 3, "a chunk of the bag unpacks to more than 256 MB", "rosbag decompress")


@pytest.mark.parametrize("method", ["bz2", "lz4"])
def test_a_chunk_of_an_unindexed_bag_that_cannot_be_unpacked_is_left_out(method: str, tmp_path: Path) -> None:
    """What comes behind it is read, and the bag does not break off."""
    packed = bomb(method, 260 << 20)
    for content, fact in ((packed, "256 MB"), (b"\xff" * 1000, f"holds {method} data")):
        damage = open_source(ros1_bag(tmp_path, method, content, indexed=False)).damage()
        assert damage.defects == {"unindexed": 1, "chunks_unreadable": 1}
        assert fact in damage.notes[-1]
    path = ros1_bag(tmp_path, method, packed, indexed=False)
    path.write_bytes(path.read_bytes()[:-100])  # the right chunk breaks off
    with pytest.raises(LogError, match=facts("no messages", "256 MB", "rosbag decompress")):
        open_source(path)


def test_a_chunk_of_millions_of_records_is_told(tmp_path: Path) -> None:
    """Some kilobytes that would cost gigabytes as objects: records of no content."""
    count = CHUNK_RECORDS + 1
    packed = zstandard.compress(count * record(128, b""))
    assert len(packed) < 20_000
    (tmp_path / "a.mcap").write_bytes(MCAP_MAGIC + HEADER + mcap_chunk_record(packed, 9 * count) + DATA_END + FOOTER)
    with pytest.raises(LogError, match=facts("a.mcap", f"{CHUNK_RECORDS} records")):
        open_source(tmp_path / "a.mcap")
    fields = struct.pack("<L", 8) + struct.pack("<L", 4) + b"op=\x04" + bytes(4)
    path = ros1_bag(tmp_path, "bz2", bz2.compress(count * fields), indexed=False)
    assert f"more than {CHUNK_RECORDS} records" in open_source(path).damage().notes[-1]


@pytest.mark.parametrize("make", [summary_of_mcap, header_of_mcap])
def test_a_chunk_where_none_belongs_stays_packed(make: Callable[[Path], Path], tmp_path: Path) -> None:
    assert_one_line(
        run_bounded("info", make(tmp_path)), 3, "a.mcap", "MCAP header" if make is header_of_mcap else "no messages"
    )


def test_attachments_are_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        writer.add_attachment(BEGIN, BEGIN, "a.zst", "application/zstd", zstd_bomb(3 << 30, sized=True))
        channel = writer.register_channel("/a", "json", 0)
        writer.add_message(channel, BEGIN, b"{}", BEGIN)
        writer.finish()  # type: ignore[no-untyped-call]
    outcome = run_bounded("info", path)
    assert outcome.code == 0
    assert outcome.memory_bytes < MEMORY_BYTES


@pytest.mark.parametrize("make", [mcap_chunk, bag_file, message_of_a_bag, message_of_mcap])
def test_a_bomb_is_told_in_one_line(make: Callable[[Path], Path], tmp_path: Path) -> None:
    assert_one_line(run_bounded("info", make(tmp_path)), 3, "MB")


def test_a_line_without_an_end_is_told(tmp_path: Path) -> None:
    path = tmp_path / "left.csv.gz"
    with gzip.open(path, "wb", compresslevel=1) as file:
        for _ in range(600):
            file.write(b"0" * (1 << 20))
    assert_one_line(run_bounded("import", "azure", path, "--out", tmp_path / "log.mcap"), 3, "left.csv.gz:1", "MB")


def test_a_yaml_bomb_is_told(tmp_path: Path) -> None:
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)]
    lines += ["rosbag2_bagfile_information:", "  relative_file_paths: *a11"]
    for name, text in {
        "laughs": "\n".join(lines),
        "nested": "a: " + "[" * 100_000,
        "long": "a: 1\n" * 20_000_000,
    }.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "metadata.yaml").write_text(text)
        assert_one_line(run_bounded("info", tmp_path / name), 3, "metadata.yaml")
