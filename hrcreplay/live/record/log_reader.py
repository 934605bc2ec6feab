"""Reader of a live session's log: the recorded messages in their order, and every flaw of the file.

Every byte of a finished file is under a checksum, and the messages are numbered. Of an unfinished file all but the
indices is, and those follow from the messages. So nothing can change or be missing without a flaw that says where.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, MessageIndex

from hrcreplay.errors import LogError
from hrcreplay.live.record import codec
from hrcreplay.logs import messages as own
from hrcreplay.logs.mcap_stream import MAGIC

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<BQQQQI8sQ")  #: all before the data
_ZSTD = struct.pack("<I", 4) + b"zstd"  #: the compression of our chunks, and what they are found by
_ZSTD_AT = _CHUNK.size - 8 - len(_ZSTD)
_FOOTER = struct.Struct("<BQQQI")
_DATA_END = struct.Struct("<BQI")
_UNREADABLE = (McapError, zstandard.ZstdError, struct.error, ValueError, KeyError, MemoryError)


@dataclass
class Flaw:
    """Something wrong with the file."""

    at_byte: int
    what: str
    after_s: float  #: into the session: of the last message before it that is whole
    before_s: float | None  #: of the first message behind it; None where there is none

    def __str__(self) -> str:
        """Where and what."""
        end = "the end" if self.before_s is None else f"{self.before_s:.3f} s"
        return f"byte {self.at_byte}, between {self.after_s:.3f} s and {end}: {self.what}"


class _CutError(ValueError):
    """The file ends before the chunk does."""


@dataclass
class _McapChunk:
    """What a chunk holds."""

    end: int  #: offset of what follows
    messages: list[tuple[int, int, int, bytes]]  #: channel, number, log time, content
    index: bytes  #: the records that must follow


class SessionLogReader:
    """The log of a live session. ``flaws`` and ``finished`` are about the latest pass over its messages."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.flaws: list[Flaw] = []  #: found so far, in order
        self.finished = False  #: whether the recorder came to its end
        self._reset()

    def _reset(self) -> None:
        self.flaws, self.finished = [], False
        self._open: list[Flaw] = []  # their end is not known yet
        self._channels: dict[int, str] = {}
        self._number: int | None = 0  #: of the next message; None after a gap
        self._first_ns = self._last_ns = -1

    def messages(self) -> Iterator[bytes]:
        """The messages of ``codec`` as they were recorded, without what a flaw spoils.

        A flaw is in ``flaws`` before the message that follows it.

        Raises:
            LogError: The file cannot be read, or has nothing of a session in it.
        """
        self._reset()
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise LogError(f"{self.path}: cannot be read ({error.strerror})") from error
        with file:
            if not file.seek(0, os.SEEK_END):
                raise LogError(f"{self.path}: holds nothing; the session was not recorded")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield from self._read(data)

    @property
    def first_ns(self) -> int:
        """Clock of the first message of the latest pass."""
        return self._first_ns

    def start(self) -> dict[str, Any]:
        """The event that the session started with.

        Raises:
            LogError: The file cannot be read, or does not begin with it.
        """
        message = next(self.messages(), b"")
        if codec.kind(message) == codec.EVENT and "cameras" in (found := codec.decode_event(message)):
            return found
        damage = f" ({self.flaws[0]})" if self.flaws else ""
        raise LogError(f"{self.path}: does not begin with the start of a live session{damage}")

    def _read(self, data: mmap.mmap) -> Iterator[bytes]:
        offset = self._head(data)
        while offset < len(data):
            try:
                opcode = data[offset]
                if opcode == Opcode.DATA_END:
                    self._end(data, offset)
                    return
                if opcode != Opcode.CHUNK:
                    raise ValueError(f"a record of kind {opcode} where a chunk should be")
                chunk = self._chunk(data, offset)
            except _UNREADABLE as error:
                offset = self._resume(data, offset, error)
                continue
            yield from self._messages(chunk, offset)
            offset = self._indices(data, chunk, offset)

    def _head(self, data: mmap.mmap) -> int:
        builder = RecordBuilder()
        Header(own.PROFILE, "hrcreplay").write(builder)
        head: bytes = MAGIC + builder.end()  # type: ignore[no-untyped-call]
        if data[: len(head)] == head:
            return len(head)
        if data.find(_ZSTD) < 0:
            raise LogError(f"{self.path}: is no log of a live session")
        return self._resume(data, 0, ValueError("the head of the file is not what the recorder writes"))

    def _chunk(self, data: mmap.mmap, offset: int) -> _McapChunk:
        """Reads a chunk with all that must hold of it. Raises one of _UNREADABLE."""
        if offset + _CHUNK.size > len(data):
            raise _CutError("the chunk is cut short")
        _, length, start_ns, end_ns, size, crc, compression, packed = _CHUNK.unpack_from(data, offset)
        end = offset + _RECORD.size + length
        if compression != _ZSTD or end != offset + _CHUNK.size + packed:
            raise ValueError("the chunk's lengths contradict each other")
        if end > len(data):
            raise _CutError("the chunk is cut short")
        content = zstandard.decompress(data[offset + _CHUNK.size : end], size)
        if len(content) != size or zlib.crc32(content) != crc:
            raise ValueError("the chunk's content does not agree with its CRC")
        messages, index = _contents(content, self._channels)
        times = [t_ns for _, _, t_ns, _ in messages]
        if (start_ns, end_ns) != (min(times), max(times)):
            raise ValueError("the chunk's span is not that of its messages")
        return _McapChunk(end, messages, index)

    def _messages(self, chunk: _McapChunk, offset: int) -> Iterator[bytes]:
        for channel, number, t_ns, content in chunk.messages:
            self._first_ns = t_ns if self._first_ns < 0 else self._first_ns
            if self._number not in (None, number):
                self._flaw(offset, f"message {self._number} is missing or changed; {number} follows")
            while self._open:
                self._open.pop().before_s = self._seconds(t_ns)
            self._number, self._last_ns = (number + 1) % (1 << 32), t_ns
            message = codec.message_on(self._channels[channel], t_ns, content)
            if message is not None:
                yield message

    def _indices(self, data: mmap.mmap, chunk: _McapChunk, offset: int) -> int:
        """The offset behind the indices of a chunk, which must be those of its messages."""
        end = chunk.end + len(chunk.index)
        found = data[chunk.end : end]
        if found != chunk.index and not chunk.index.startswith(found):  # the last one may be cut short
            self._flaw(chunk.end, f"the index of the chunk at byte {offset} does not agree with it")
        return end

    def _end(self, data: mmap.mmap, offset: int) -> None:
        behind = offset + _DATA_END.size
        _, length, crc = _DATA_END.unpack_from(data, offset)
        with memoryview(data) as view:
            whole = zlib.crc32(view[:offset])
            tail = view[behind:].tobytes()
        if (length, crc) != (4, whole) and not self.flaws:
            self._flaw(offset, "the CRC of all data does not agree with it")
        self.finished = True
        opcode, length, _, _, crc = _FOOTER.unpack(tail[-_FOOTER.size - len(MAGIC) : -len(MAGIC)])
        fine = tail.endswith(MAGIC) and (opcode, length) == (Opcode.FOOTER, _FOOTER.size - _RECORD.size)
        if not fine or zlib.crc32(tail[: -4 - len(MAGIC)]) != crc:
            self._flaw(behind, "the index at the end of the file does not agree with its CRC")

    def _resume(self, data: mmap.mmap, offset: int, error: Exception) -> int:
        """The offset of the next chunk after something unreadable, or of the end."""
        found = data.find(_ZSTD, offset + _ZSTD_AT + 1)
        self.finished = data[-len(MAGIC) :] == MAGIC
        if found >= 0 or self.finished or not isinstance(error, (_CutError, struct.error)):
            self._flaw(offset, str(error))
        self._number = None
        return len(data) if found < 0 else found - _ZSTD_AT

    def _flaw(self, offset: int, what: str) -> None:
        self._open.append(Flaw(offset, what, self._seconds(self._last_ns), None))
        self.flaws.append(self._open[-1])

    def _seconds(self, t_ns: int) -> float:
        return (t_ns - self._first_ns) / 1e9 if self._first_ns >= 0 else 0.0


def _contents(content: bytes, channels: dict[int, str]) -> tuple[list[tuple[int, int, int, bytes]], bytes]:
    """Messages of a chunk and the indices that they need; adds the chunk's channels."""
    messages = []
    indices: dict[int, list[tuple[int, int]]] = {}
    offset = 0
    while offset < len(content):
        opcode, length = _RECORD.unpack_from(content, offset)
        begin, end = offset + _RECORD.size, offset + _RECORD.size + length
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(content[begin:end])))
            channels[channel.id] = channel.topic
        elif opcode == Opcode.MESSAGE:
            number, sequence, t_ns, _ = _MESSAGE.unpack_from(content, begin)
            if number not in channels:
                raise KeyError("a message on a channel that is not known")
            indices.setdefault(number, []).append((t_ns, offset))
            messages.append((number, sequence, t_ns, content[begin + _MESSAGE.size : end]))
        offset = end
    builder = RecordBuilder()
    for number, entries in indices.items():
        MessageIndex(number, entries).write(builder)
    return messages, builder.end()  # type: ignore[no-untyped-call]
