"""Small files that unpack to gigabytes: they cost neither memory nor time, and are told in one line."""

from __future__ import annotations

import bz2
import gzip
import sqlite3
from collections.abc import Callable
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from hrcreplay.logs.unpack import CannotUnpack, unpack
from tests.bounded import assert_one_line, run_bounded
from tests.logs import own
from tests.logs.bags import bag, write_openni

BEGIN = own.BEGIN_NS
COMPRESS = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress, "": bytes}


def zstd_bomb(count: int, *, sized: bool) -> bytes:
    """So many zeros, with or without their number in the frame's header."""
    block = bytes(1 << 20)
    packer = zstandard.ZstdCompressor(write_content_size=sized).compressobj(size=count if sized else -1)
    return b"".join([*(packer.compress(block) for _ in range(count >> 20)), packer.flush()])


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


@pytest.mark.parametrize("make", [mcap_chunk, bag_file, message_of_a_bag])
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
