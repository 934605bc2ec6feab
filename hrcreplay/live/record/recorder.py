"""The recorder process, which writes the messages of control to a session's log, and the reader of such a log.

From control: the messages of ``codec``. To control: ``K`` once, when the file is open; ``L`` once, when the disk has
little space left; ``X`` + the reason in UTF-8, if the file cannot be written. In this case the recorder ends at once
with exit code 1. Otherwise it ends after control has ended and the file is finished.
Chunks are closed and passed to the operating system several times per second, so a kill loses only the messages of a
fraction of a second.

Every byte of a finished file has a checksum, and the messages are numbered. In an unfinished file only the indices have
no checksum, and they follow from the messages. Therefore every change and every gap gives a flaw with its place.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import signal
import socket
import struct
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
import zstandard
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, MessageIndex
from mcap.writer import CompressionType, Writer

from hrcreplay.egm import motion_link_pb2 as egm
from hrcreplay.errors import LogError
from hrcreplay.live.processes import LAST_WORDS, Inbox
from hrcreplay.live.record import codec
from hrcreplay.logs import messages as own
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.writer import register_schema

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<BQQQQI8sQ")  #: the part of a chunk before its data
_ZSTD = struct.pack("<I", 4) + b"zstd"  #: compression of the chunks; also used to find chunks
_ZSTD_AT = _CHUNK.size - 8 - len(_ZSTD)
_FOOTER = struct.Struct("<BQQQI")
_DATA_END = struct.Struct("<BQI")
_UNREADABLE = (McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError, KeyError, MemoryError)


@dataclass
class Flaw:
    """A defect of the file."""

    at_byte: int
    what: str
    after_s: float  #: session time of the last complete message before the flaw [s]
    before_s: float | None  #: session time of the first message after the flaw [s]; None without one

    def __str__(self) -> str:
        """Place and description of the flaw."""
        end = "the end" if self.before_s is None else f"{self.before_s:.3f} s"
        return f"byte {self.at_byte}, between {self.after_s:.3f} s and {end}: {self.what}"


class _CutError(ValueError):
    """The file ends before the chunk does."""


@dataclass
class _McapChunk:
    """Content of a chunk."""

    end: int  #: offset after the chunk
    messages: list[tuple[int, int, int, bytes]]  #: channel, number, log time, content
    index: bytes  #: the index records that must follow the chunk


class SessionLogReader:
    """Reads the log of a live session. ``flaws`` and ``finished`` refer to the latest pass over its messages."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.flaws: list[Flaw] = []  #: flaws found so far, in order
        self.finished = False  #: whether the recorder finished the file
        self._reset()

    def _reset(self) -> None:
        self.flaws, self.finished = [], False
        self._open: list[Flaw] = []  # flaws whose end is not known yet
        self._channels: dict[int, str] = {}
        self._number: int | None = 0  #: of the next message; None after a gap
        self._first_ns = self._last_ns = -1

    def messages(self) -> Iterator[bytes]:
        """The recorded messages of ``codec``, without messages that a flaw has damaged.

        A flaw is added to ``flaws`` before the next message is returned.

        Raises:
            LogError: The file cannot be read, or contains no part of a session.
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
        """The start event of the session.

        Raises:
            LogError: The file cannot be read, or does not begin with the start event.
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
        head: bytes = own.MCAP_MAGIC + builder.end()  # type: ignore[no-untyped-call]
        if data[: len(head)] == head:
            return len(head)
        if data.find(_ZSTD) < 0:
            raise LogError(f"{self.path}: is no log of a live session")
        return self._resume(data, 0, ValueError("the head of the file is not what the recorder writes"))

    def _chunk(self, data: mmap.mmap, offset: int) -> _McapChunk:
        """Reads a chunk and checks it. Raises one of _UNREADABLE."""
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
        """The offset after the indices of a chunk; checks that the indices agree with its messages."""
        end = chunk.end + len(chunk.index)
        found = data[chunk.end : end]
        if found != chunk.index and not chunk.index.startswith(found):  # the last index may be cut short
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
        opcode, length, _, _, crc = _FOOTER.unpack(tail[-_FOOTER.size - len(own.MCAP_MAGIC) : -len(own.MCAP_MAGIC)])
        fine = tail.endswith(own.MCAP_MAGIC) and (opcode, length) == (Opcode.FOOTER, _FOOTER.size - _RECORD.size)
        if not fine or zlib.crc32(tail[: -4 - len(own.MCAP_MAGIC)]) != crc:
            self._flaw(behind, "the index at the end of the file does not agree with its CRC")

    def _resume(self, data: mmap.mmap, offset: int, error: Exception) -> int:
        """The offset of the next chunk after an unreadable part, or of the end of the file."""
        found = data.find(_ZSTD, offset + _ZSTD_AT + 1)
        self.finished = data[-len(own.MCAP_MAGIC) :] == own.MCAP_MAGIC
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
    """Messages of a chunk and their index records; adds the chunk's channels to ``channels``."""
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


READY, LOW = b"K", b"L"
FLUSH_S = 0.2
_BATCH_S = 0.05
_CHUNK_BYTES = 1 << 20  # large, because chunks are closed by time
_NICE = 5  # lower priority than control and the person's process

_TYPES = {
    codec.ROBOT_TOPIC: egm.RobotMessage,
    codec.SENT_TOPIC: egm.SensorMessage,
    codec.UNSENT_TOPIC: egm.SensorMessage,
}


class SessionLogWriter:
    """Writes the log of a running session. Every message has a number, so that a gap in the record is detected."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile=own.PROFILE, library="hrcreplay")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._cameras: frozenset[str] = frozenset()
        self._count = 0

    def add(self, message: bytes) -> None:
        """Writes a message of ``codec``; after the first event with cameras, also cameras, task and base."""
        t_ns = codec.clock_ns(message)
        topic, data = codec.topic_and_data(message)
        if topic == codec.STRAY_TOPIC:
            self._frame(t_ns, data)
            return
        self._write(topic, t_ns, t_ns, data, _TYPES.get(topic))
        if topic == codec.EVENT_TOPIC and not self._cameras:
            self._latch(t_ns, codec.decode_event(message))

    def flush(self) -> None:
        """Closes the chunk and passes all data to the operating system. Raises OSError."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def finish(self) -> None:
        """Writes index and end. Raises OSError."""
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _frame(self, t_ns: int, data: bytes) -> None:
        try:
            skeleton = pb.Skeleton.FromString(data)
        except DecodeError:
            skeleton = pb.Skeleton()
        if skeleton.camera in self._cameras:
            capture_ns = max(0, skeleton.capture_ns)  # MCAP has no times before 1970
            self._write(own.skeleton_topic(skeleton.camera), t_ns, capture_ns, data, pb.Skeleton)
        else:
            self._write(codec.STRAY_TOPIC, t_ns, t_ns, data)

    def _latch(self, t_ns: int, start: dict[str, Any]) -> None:
        cameras: dict[str, Any] = start.get("cameras", {})
        self._cameras = frozenset(name for name in cameras if "/" not in name)  # the name is part of a topic
        latched: list[tuple[str, Any]] = [
            (own.camera_info_topic(name), pb.Camera(camera=name, T_world_camera=_flat(pose)))
            for name, pose in cameras.items()
        ]
        if start.get("task") is not None:
            latched.append((own.TASK, pb.Task(json=json.dumps(start["task"], sort_keys=True))))
        if start.get("T_world_base") is not None:
            latched.append((own.BASE, pb.Base(T_world_base=_flat(start["T_world_base"]))))
        for topic, content in latched:
            self._write(topic, t_ns, t_ns, content.SerializeToString(deterministic=True), type(content))

    def _write(self, topic: str, t_ns: int, publish_ns: int, data: bytes, kind: Any = None) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            encoding = "json" if topic == codec.EVENT_TOPIC else codec.ENCODING if kind is None else "protobuf"
            schema = 0 if kind is None else register_schema(self._writer, self._schemas, kind)
            channel = self._writer.register_channel(topic, encoding, schema)
            self._channels[topic] = channel
        self._writer.add_message(channel, log_time=t_ns, publish_time=publish_ns, data=data, sequence=self._count)
        self._count = (self._count + 1) % (1 << 32)


def _flat(pose: list[list[float]] | None) -> list[float]:
    return [] if pose is None else [float(number) for number in np.asarray(pose, dtype=np.float64).ravel()]


def free_bytes(folder: Path) -> int:
    """Free space for the user on the disk of a folder [bytes]."""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


def record(control: socket.socket, path: Path, low_bytes: int) -> None:
    """Writes a new log until control has ended.

    Args:
        control: Socket to control.
        path: Path of the log.
        low_bytes: If the disk has less space than this, control gets a message [bytes].

    Raises:
        OSError: The file exists or cannot be written; the part that is written is kept.
    """
    inbox = Inbox(control)
    with path.open("xb") as stream:
        writer = SessionLogWriter(stream)
        writer.flush()
        with suppress(BrokenPipeError):  # control may have ended already and left messages
            control.send(READY)
        due_s, told = time.monotonic() + FLUSH_S, False
        while not inbox.ended.wait(_BATCH_S):
            for message in inbox.take():
                writer.add(message)
            if time.monotonic() >= due_s:
                writer.flush()
                if not told and free_bytes(path.parent) < low_bytes:
                    told = bool(control.send(LOW))
                due_s = time.monotonic() + FLUSH_S - _BATCH_S
        for message in inbox.take():
            writer.add(message)
        writer.finish()


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the process."""
    parser = argparse.ArgumentParser(prog="hrcreplay.live.record.recorder")
    parser.add_argument("--fd", type=int, required=True)
    parser.add_argument("--path", type=Path, required=True)
    parser.add_argument("--low", type=int, default=0, help="space on the disk below which control is told [bytes]")
    options = parser.parse_args(arguments)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)  # the recorder must not end before the session
    os.nice(_NICE)
    control = socket.socket(fileno=options.fd)
    try:
        record(control, options.path, options.low)
    except OSError as error:
        with suppress(OSError):
            control.send(LAST_WORDS + f"{options.path}: the record cannot be written ({error.strerror})".encode())
        os._exit(1)  # at a normal exit the interpreter would write the rest again and fail


if __name__ == "__main__":
    main()
