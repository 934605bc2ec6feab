"""Splits of a bag that are broken each in a way of its own: the others are read, and what was found is told."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from hrcreplay.errors import LogError
from hrcreplay.logs.log_files import LogFiles, open_source
from hrcreplay.logs.reader import open_log
from tests.facts import facts
from tests.logs import own
from tests.logs.bags import bag, write_openni

BEGIN = own.BEGIN_NS
SPLIT_NS = 7_000_000_000
FRAMES = 200


def split_bag(folder: Path, count: int = 3, kind: str = "db3") -> Path:
    """A bag of splits of 6.6 s each, as a recorder leaves it that was killed: without metadata.yaml."""
    folder.mkdir()
    for number in range(count):
        made = folder.parent / f"made_{number}"
        with bag(made, kind) as (write, store):
            write_openni(write, store, frames=FRAMES, start_ns=BEGIN + number * SPLIT_NS)
        shutil.move(made / f"{made.name}.{kind}", folder / f"rec_{number}.{kind}")
    return folder


def contents(source: LogFiles) -> list[tuple[int, bytes]]:
    return [(message.arrival_ns, message.data) for message in source.messages(["/tf"])]


def test_last_split_that_was_cut_gives_what_it_holds(tmp_path: Path) -> None:
    folder = split_bag(tmp_path / "bag")
    whole = contents(open_source(folder))
    last = folder / "rec_2.db3"
    last.write_bytes(last.read_bytes()[: int(0.6 * last.stat().st_size)])
    source = open_source(folder)
    read = contents(source)
    assert read == whole[: len(read)]  # nothing else, nothing twice, in order
    assert 2 / 3 + 0.1 < len(read) / len(whole) < 1.0
    assert sum(topic.count for topic in source.topics()) == len(read)
    damage = source.damage()
    assert damage.defects["files_damaged"] == 1
    assert damage.defects["truncated_at_ns"] == read[-1][0] == source.end_ns
    assert any(
        "rec_2.db3" in note and f"{len(read) - 2 * FRAMES * 15} of its messages" in note for note in damage.notes
    )


def test_page_lost_in_the_middle_of_a_database(tmp_path: Path) -> None:
    folder = split_bag(tmp_path / "bag", count=1)
    whole = contents(open_source(folder))
    file = folder / "rec_0.db3"
    data = bytearray(file.read_bytes())
    half = len(data) // 2 // 4096 * 4096
    data[half : half + 4096] = b"\xff" * 4096
    file.write_bytes(data)
    source = open_source(folder)
    read = contents(source)
    assert 0.9 * len(whole) < len(read) < len(whole)
    assert set(read) <= set(whole)
    assert [at for at, _ in read] == sorted(at for at, _ in read)
    assert source.damage().defects["files_damaged"] == 1
    assert contents(source) == read  # again, and counted once
    assert source.damage().defects["files_damaged"] == 1


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_split_that_is_no_log_is_left_out(kind: str, tmp_path: Path) -> None:
    folder = split_bag(tmp_path / "bag", kind=kind)
    whole = contents(open_source(folder))
    (folder / f"rec_1.{kind}").write_bytes(np.random.default_rng(1).bytes(30_000))
    source = open_source(folder)
    read = contents(source)
    assert read == [at for at in whole if not BEGIN + SPLIT_NS <= at[0] < BEGIN + 2 * SPLIT_NS]
    assert source.damage().defects["files_unreadable"] == 1
    assert any(f"rec_1.{kind} is left out" in note for note in source.damage().notes)


def test_a_folder_of_nothing_but_broken_files_is_refused(tmp_path: Path) -> None:
    folder = split_bag(tmp_path / "bag", count=2)
    for file in folder.iterdir():
        file.write_bytes(b"\0" * 5000)
    with pytest.raises(LogError, match=facts("rec_0.db3", "known")) as caught:
        open_source(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_compressed_splits_without_metadata(kind: str, tmp_path: Path) -> None:
    folder = split_bag(tmp_path / "bag", kind=kind)
    whole = contents(open_source(folder))
    for file in sorted(folder.iterdir()):
        file.with_name(f"{file.name}.zstd").write_bytes(zstandard.compress(file.read_bytes()))
        file.unlink()
    assert contents(open_source(folder)) == whole
    assert contents(open_source(folder / f"rec_1.{kind}.zstd")) == whole[FRAMES * 15 : 2 * FRAMES * 15]


def test_compressed_messages_without_metadata(tmp_path: Path) -> None:
    folder = split_bag(tmp_path / "bag", count=1)
    whole = contents(open_source(folder))
    database = sqlite3.connect(folder / "rec_0.db3")
    with database:
        for row, data in database.execute("select id, data from messages").fetchall():
            database.execute("update messages set data = ? where id = ?", (zstandard.compress(data), row))
    database.close()
    assert contents(open_source(folder)) == whole


@pytest.mark.parametrize("indexed", [True, False])
def test_compression_that_nobody_knows_is_named(tmp_path: Path, *, indexed: bool) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        channel = writer.register_channel("/a", "cdr", 0)
        for number in range(10):
            writer.add_message(channel, BEGIN + number, b"abcdefgh" * 20, BEGIN + number)
        writer.finish()  # type: ignore[no-untyped-call]
    data = path.read_bytes().replace(b"\x04\0\0\0zstd", b"\x04\0\0\0brtl")
    path.write_bytes(data if indexed else data[:-60])
    with pytest.raises(LogError, match=r"brtl.*zstd, lz4, bz2") as caught:
        open_log(path)
    assert "\n" not in str(caught.value)


def test_many_damaged_chunks_are_one_note(tmp_path: Path) -> None:
    path = own.write(tmp_path / "a.mcap", own.frames(4000))
    blocks = open_source(path).streams[0]._blocks  # type: ignore[attr-defined]
    data = bytearray(path.read_bytes())
    for block in blocks[1:4]:
        data[block.offset + 2000 : block.offset + 2064] = bytes(64)
    path.write_bytes(data)
    log = open_log(path)
    for _ in range(2):
        own.read(log)
        assert log.defects["chunks_unreadable"] == 3
        told = [note for note in log.notes if "chunk" in note]
        assert len(told) == 1
        assert "3 chunks" in told[0]
        assert str(blocks[1].offset) in told[0]


@pytest.mark.parametrize("text", ["message_count: many", "relative_file_paths: [[a, b], c]", "relative_file_paths: 7"])
def test_metadata_of_another_kind_is_refused(text: str, tmp_path: Path) -> None:
    folder = split_bag(tmp_path / "bag", count=1)
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  {text}\n")
    with pytest.raises(LogError, match=facts("metadata.yaml", "ROS 2 bag")):
        open_source(folder)
