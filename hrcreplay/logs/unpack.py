"""Decompression within limits: the unpacked size of a message, a chunk or a file is checked before it is in memory."""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from hrcreplay.errors import LogError

#: Maximum unpacked size of a chunk; recorders use a few MB [bytes].
CHUNK_BYTES: Final = 256 << 20
#: Maximum unpacked size of a message [bytes].
MESSAGE_BYTES: Final = 64 << 20
#: Maximum number of records in a chunk; each takes some hundred bytes and microseconds.
CHUNK_RECORDS: Final = 1 << 19
#: Maximum unpacked size of a file relative to its size, in addition to SPARE_BYTES.
FILE_RATIO: Final = 1000
#: See FILE_RATIO [bytes].
SPARE_BYTES: Final = 256 << 20

ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
_BLOCK_BYTES = 1 << 20


class CannotUnpack(ValueError):
    """Data that is compressed by an unknown method, is damaged, or unpacks to more than the limit."""


def unpack(method: str, data: bytes, limit: int = CHUNK_BYTES) -> bytes:
    """Decompresses data.

    Args:
        method: One of METHODS.
        data: Compressed bytes.
        limit: Maximum size of the result [bytes].

    Raises:
        CannotUnpack: The method is unknown, the data is damaged, or the result is larger than the limit.
    """
    if method not in METHODS:
        raise CannotUnpack(f"compressed by {method!r}; known are {', '.join(KNOWN)}")
    try:
        return b"".join(_limited(METHODS[method](data, limit), limit))
    except CannotUnpack:
        raise
    except (zstandard.ZstdError, OSError, RuntimeError, ValueError, EOFError, struct.error) as error:
        raise CannotUnpack(f"holds {method} data that cannot be decompressed: {error}") from error


def _limited(blocks: Iterator[bytes], limit: int) -> Iterator[bytes]:
    found = 0
    for block in blocks:
        found += len(block)
        if found > limit:
            raise CannotUnpack(f"unpacks to more than {_megabytes(limit)}, the most that is read of one")
        yield block


def _megabytes(count: int) -> str:
    return f"{count / (1 << 20):.0f} MB"


def _zstd(data: bytes, limit: int) -> Iterator[bytes]:
    size = zstandard.frame_content_size(data)
    if size > limit:
        raise CannotUnpack(f"unpacks to {_megabytes(size)}; at most {_megabytes(limit)} are read of one")
    if size >= 0:
        yield zstandard.ZstdDecompressor().decompress(data)
        return
    with zstandard.ZstdDecompressor().stream_reader(BytesIO(data)) as reader:
        while block := reader.read(_BLOCK_BYTES):
            yield block


def _piecewise(make: Callable[[], Any]) -> Callable[[bytes, int], Iterator[bytes]]:
    """Yields blocks from a decompressor with the interface of bz2's, one stream after the other."""

    def blocks(data: bytes, _limit: int) -> Iterator[bytes]:
        while data:
            machine = make()
            block = machine.decompress(data, _BLOCK_BYTES)
            yield block
            while not machine.eof:
                if machine.needs_input:
                    raise EOFError("it breaks off")
                block = machine.decompress(b"", _BLOCK_BYTES)
                yield block
            data = machine.unused_data or b""

    return blocks


def _plain(data: bytes, _limit: int) -> Iterator[bytes]:
    yield data


#: Method of compression -> function from data and limit to unpacked blocks.
METHODS: Mapping[str, Callable[[bytes, int], Iterator[bytes]]] = {
    "": _plain,
    "none": _plain,
    "zstd": _zstd,
    "lz4": _piecewise(lz4.frame.LZ4FrameDecompressor),
    "bz2": _piecewise(bz2.BZ2Decompressor),
}

#: The methods that compress.
KNOWN: Final = ("zstd", "lz4", "bz2")


def unpack_message(data: bytes, where: str) -> bytes:
    """Decompresses a message of a ROS 2 bag if it is zstd's; no serialized message begins like zstd data.

    Args:
        data: Message as stored in the file.
        where: Start of error messages.

    Raises:
        LogError: It is damaged, or larger than MESSAGE_BYTES.
    """
    if not data.startswith(ZSTD_MAGIC):
        return data
    try:
        return unpack("zstd", data, MESSAGE_BYTES)
    except CannotUnpack as error:
        raise LogError(f"{where}: a message {error}; record or copy it again") from error


def unpack_file(file: Path, target: Path) -> Path:
    """Writes the content of a zstd file to ``target``; returns ``target``.

    Raises:
        LogError: It is damaged, or unpacks to more than FILE_RATIO times its size and SPARE_BYTES.
    """
    limit = FILE_RATIO * file.stat().st_size + SPARE_BYTES
    try:
        with file.open("rb") as packed, target.open("wb") as unpacked:
            reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            for block in _limited(iter(lambda: reader.read(_BLOCK_BYTES), b""), limit):
                unpacked.write(block)
    except zstandard.ZstdError as error:
        raise LogError(f"{file}: cannot be decompressed ({error}); copy it again") from error
    except CannotUnpack as error:
        target.unlink()
        raise LogError(f"{file}: {error}; if it is right, unpack it with zstd -d") from error
    return target
