"""ROS 1 bags without an index, or with a broken one: read by going through their chunks once.

Layout: http://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import bz2
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO

import lz4.frame  # type: ignore[import-untyped]

from hrcreplay.errors import LogError
from hrcreplay.logs import rostypes
from hrcreplay.logs.messages import Damage, Message, Part, Topic, in_order

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_DECOMPRESS: dict[bytes, Callable[[bytes], bytes]] = {
    b"none": bytes,
    b"bz2": bz2.decompress,
    b"lz4": lz4.frame.decompress,
}
_BROKEN = (struct.error, OSError, RuntimeError, ValueError, KeyError, EOFError)

Fields = dict[str, bytes]


@dataclass(frozen=True)
class _Chunk:
    start_ns: int
    end_ns: int
    offset: int


class RecoveredBag:
    """A ROS 1 bag whose index is missing or broken.

    Raises:
        LogError: No whole message is in it.
    """

    profile = "ros1"

    def __init__(self, path: Path) -> None:
        self._path = path
        damage = Damage()
        damage.notes.append("the bag has no usable index: it was read once more to make one (rosbag reindex mends it)")
        damage.defects["unindexed"] = 1
        self._chunks: list[_Chunk] = []
        connections: dict[int, tuple[str, Fields]] = {}
        counts: Counter[int] = Counter()
        with path.open("rb") as file:
            whole = self._scan(file, connections, counts)
        if not self._chunks:
            raise LogError(f"{path}: the log holds no messages that are whole; copy the bag again")
        self.start_ns = min(chunk.start_ns for chunk in self._chunks)
        self.end_ns = max(chunk.end_ns for chunk in self._chunks)
        if not whole:
            damage.ends_at(self.end_ns, self.start_ns)
        self.defects, self.notes = damage.defects, damage.notes
        self._topics = {
            number: _topic(path, name, fields, counts[number]) for number, (name, fields) in sorted(connections.items())
        }
        self.topics = tuple(self._topics.values())

    def messages(self, names: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        """Messages on these topics with start <= arrival < end, in order of arrival."""
        wanted = {number: topic for number, topic in self._topics.items() if topic.name in names}
        with self._path.open("rb") as file:
            for message in in_order(
                Part(chunk.start_ns, partial(self._chunk, file, chunk, wanted))
                for chunk in self._chunks
                if (start_ns is None or chunk.end_ns >= start_ns) and (end_ns is None or chunk.start_ns < end_ns)
            ):
                after_start = start_ns is None or message.arrival_ns >= start_ns
                if after_start and (end_ns is None or message.arrival_ns < end_ns):
                    yield message

    def _scan(self, file: IO[bytes], connections: dict[int, tuple[str, Fields]], counts: Counter[int]) -> bool:
        """Finds chunks and connections; whether the file ends with a whole record."""
        file.seek(len(MAGIC))
        offset = file.tell()
        try:
            while (fields := _fields(file)) is not None:
                (length,) = struct.unpack("<L", file.read(4))
                data = file.read(length)
                if fields["op"][0] == _CHUNK:
                    self._add(offset, _DECOMPRESS[fields["compression"]](data), connections, counts)
                if len(data) < length:
                    return False
                if fields["op"][0] == _CONNECTION:
                    _connect(fields, data, connections)
                offset = file.tell()
        except _BROKEN:
            return False
        return True

    def _add(self, offset: int, data: bytes, connections: dict[int, tuple[str, Fields]], counts: Counter[int]) -> None:
        times = []
        for fields, content in _inner(data):
            if fields["op"][0] == _CONNECTION:
                _connect(fields, content, connections)
            elif fields["op"][0] == _MESSAGE:
                times.append(_time_ns(fields))
                counts[_number(fields)] += 1
        if times:
            self._chunks.append(_Chunk(min(times), max(times), offset))

    def _chunk(self, file: IO[bytes], chunk: _Chunk, wanted: dict[int, Topic]) -> Iterator[Message]:
        file.seek(chunk.offset)
        header = _fields(file) or {}
        data = file.read(struct.unpack("<L", file.read(4))[0])
        messages = [
            Message(_time_ns(fields), wanted[_number(fields)], content)
            for fields, content in _inner(_DECOMPRESS[header["compression"]](data))
            if fields["op"][0] == _MESSAGE and _number(fields) in wanted
        ]
        messages.sort(key=lambda message: message.arrival_ns)
        yield from messages


def _fields(file: IO[bytes]) -> Fields | None:
    """The header of the next record; None at the end of the file."""
    prefix = file.read(4)
    if not prefix:
        return None
    (length,) = struct.unpack("<L", prefix)
    data = file.read(length)
    if len(data) < length:
        raise EOFError
    fields: Fields = {}
    at = 0
    while at < length:
        (size,) = struct.unpack_from("<L", data, at)
        name, _, value = data[at + 4 : at + 4 + size].partition(b"=")
        fields[name.decode()] = value
        at += 4 + size
    return fields


def _inner(data: bytes) -> Iterator[tuple[Fields, bytes]]:
    """Whole records of a chunk; the last chunk of a bag that breaks off may itself break off."""
    file = BytesIO(data)
    try:
        while (fields := _fields(file)) is not None:
            (length,) = struct.unpack("<L", file.read(4))
            content = file.read(length)
            if len(content) < length:
                return
            yield fields, content
    except (struct.error, EOFError):
        return


def _number(fields: Fields) -> int:
    return int.from_bytes(fields["conn"], "little")


def _time_ns(fields: Fields) -> int:
    seconds, nanoseconds = struct.unpack("<LL", fields["time"])
    return int(seconds) * 10**9 + int(nanoseconds)


def _connect(fields: Fields, data: bytes, connections: dict[int, tuple[str, Fields]]) -> None:
    described = _fields(BytesIO(struct.pack("<L", len(data)) + data)) or {}
    connections[_number(fields)] = (fields["topic"].decode(), described)


def _topic(path: Path, name: str, fields: Fields, count: int) -> Topic:
    msgtype = fields["type"].decode()
    definition = fields["message_definition"].decode(errors="replace")
    parse = rostypes.parser(f"{path}: {name}", msgtype, definition, "msg", cdr=False)
    return Topic(name, rostypes.plain(msgtype), count, parse)
