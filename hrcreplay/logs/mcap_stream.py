"""MCAP files, of our own format, ROS 1 or ROS 2, as streams of messages; also without an index, or truncated."""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import Channel, Chunk, ChunkIndex, Footer, McapRecord, Schema, Statistics
from mcap.records import Header as McapHeader
from mcap.records import Message as McapMessage
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from hrcreplay.errors import LogError
from hrcreplay.logs import ros_bags
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.capsules_pb2 import RobotCapsules
from hrcreplay.logs.messages import (
    MCAP_MAGIC,
    Damage,
    LazyChunk,
    Message,
    Topic,
    Undecodable,
    merge_by_arrival,
    note_damaged_chunks,
)
from hrcreplay.logs.unpack import CHUNK_BYTES, CHUNK_RECORDS, KNOWN, METHODS, CannotUnpack, unpack, unpack_message

_RUN_BYTES = 1 << 20
_OURS = {
    kind.DESCRIPTOR.full_name: kind
    for kind in (pb.Skeleton, pb.Camera, pb.Task, pb.Base, pb.Truth, pb.JointState, RobotCapsules)
}
_BROKEN = (McapError, CRCValidationError, struct.error, RuntimeError, ValueError)


@dataclass(frozen=True)
class _Block:
    """A chunk, or a run of messages outside of chunks."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    channels: frozenset[int] | None  #: channels with messages in it; None: unknown


@dataclass
class _Index:
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    blocks: list[_Block] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)  #: compression methods of chunks with an unknown compression
    damaged: dict[int, str] = field(default_factory=dict)  #: first byte of a damaged chunk -> its defect

    def add(self, records: list[McapRecord], offset: int, length: int) -> None:
        """Adds the content of a block."""
        times, used = [], set()
        for record in records:
            if isinstance(record, Schema):
                self.schemas[record.id] = record
            elif isinstance(record, Channel):
                self.channels[record.id] = record
            elif isinstance(record, McapMessage):
                times.append(record.log_time)
                used.add(record.channel_id)
                self.counts[record.channel_id] += 1
        if times:
            self.blocks.append(_Block(min(times), max(times), offset, length, frozenset(used)))


class McapStream:
    """One MCAP file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        damage = Damage()
        with path.open("rb") as file:
            self.profile = _profile(file, path)
            index = _summary(file) or _scan(file, path.stat().st_size, damage)
        if index.foreign and len(index.foreign) >= len(index.blocks):
            raise LogError(
                f"{path}: its chunks are compressed by {', '.join(sorted(set(index.foreign)))!r}; known are "
                f"{', '.join(KNOWN)}; write the file again with one of them"
            )
        self._blocks = index.blocks
        self.start_ns = min((b.start_ns for b in index.blocks), default=0)
        self.end_ns = max((b.end_ns for b in index.blocks), default=0)
        self.defects, self.notes = damage.defects, damage.notes
        self._described = len(self.notes)  # after these, one note on all damaged chunks
        self._damaged: dict[int, str] = {}  # as in the index; each chunk is counted once
        for offset, error in index.damaged.items():
            self._leave_out(offset, error)
        self._cdr = frozenset(n for n, channel in index.channels.items() if channel.message_encoding == "cdr")
        self._topics = {
            number: Topic(
                channel.topic,
                _type(index.schemas.get(channel.schema_id)),
                index.counts[number],
                _parser(path, channel, index.schemas.get(channel.schema_id)),
            )
            for number, channel in sorted(index.channels.items())
        }
        self.topics = tuple(self._topics.values())

    def messages(self, names: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        """Yields messages on these topics with start <= arrival < end, in order of arrival."""
        wanted = {number: topic for number, topic in self._topics.items() if topic.name in names}
        with self._path.open("rb") as file:
            parts = [
                LazyChunk(block.start_ns, partial(self._block, file, block, wanted, start_ns, end_ns))
                for block in self._blocks
                if (start_ns is None or block.end_ns >= start_ns)
                and (end_ns is None or block.start_ns < end_ns)
                and (block.channels is None or not block.channels.isdisjoint(wanted))
            ]
            yield from merge_by_arrival(parts)

    def _block(
        self, file: IO[bytes], block: _Block, wanted: dict[int, Topic], start_ns: int | None, end_ns: int | None
    ) -> Iterator[Message]:
        try:
            records = _records(file, block.offset, block.length)
        except _BROKEN as error:
            self._leave_out(block.offset, str(error))
            return
        messages = [
            Message(
                record.log_time, wanted[record.channel_id], self._unpacked(record, wanted), (block.offset << 32) + i
            )
            for i, record in enumerate(records)
            if isinstance(record, McapMessage)
            and record.channel_id in wanted
            and (start_ns is None or record.log_time >= start_ns)
            and (end_ns is None or record.log_time < end_ns)
        ]
        messages.sort(key=lambda message: message.arrival_ns)
        yield from messages

    def _leave_out(self, offset: int, error: str) -> None:
        if offset not in self._damaged:
            self._damaged[offset] = error
            self.defects["chunks_unreadable"] += 1
            self.notes[self._described :] = [note_damaged_chunks(self._damaged)]

    def _unpacked(self, record: McapMessage, wanted: dict[int, Topic]) -> bytes:
        if record.channel_id not in self._cdr:
            return record.data
        return unpack_message(record.data, f"{self._path}: {wanted[record.channel_id].name}")


def _profile(file: IO[bytes], path: Path) -> str:
    try:
        header = next(StreamReader(file, emit_chunks=True, record_size_limit=CHUNK_BYTES).records)
    except _BROKEN as error:
        raise LogError(f"{path}: breaks off within the MCAP header; record or copy it again") from error
    if not isinstance(header, McapHeader):
        raise LogError(f"{path}: does not begin with an MCAP header; record or copy it again")
    return header.profile


def _summary(file: IO[bytes]) -> _Index | None:
    """Reads the summary at the end of the file; None if it is missing or too short."""
    try:
        records = _summary_records(file)
    except (*_BROKEN, OSError, StopIteration):
        return None
    statistics = next((record for record in records if isinstance(record, Statistics)), None)
    channels = {record.id: record for record in records if isinstance(record, Channel)}
    chunks = [record for record in records if isinstance(record, ChunkIndex)]
    if statistics is None or len(channels) < statistics.channel_count:
        return None
    if not chunks and statistics.message_count:
        return None
    blocks = [
        _Block(
            chunk.message_start_time,
            chunk.message_end_time,
            chunk.chunk_start_offset,
            chunk.chunk_length,
            frozenset(chunk.message_index_offsets) or None,
        )
        for chunk in chunks
    ]
    foreign = [chunk.compression for chunk in chunks if chunk.compression not in METHODS]
    schemas = {record.id: record for record in records if isinstance(record, Schema)}
    return _Index(schemas, channels, Counter(statistics.channel_message_counts), blocks, foreign)


def _summary_records(file: IO[bytes]) -> list[McapRecord]:
    """Returns the records at the end of a file to which its footer points; chunks stay packed."""

    def records() -> Iterator[McapRecord]:
        return StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=CHUNK_BYTES).records

    file.seek(-(FOOTER_SIZE + len(MCAP_MAGIC)), os.SEEK_END)
    footer = next(records())
    if not isinstance(footer, Footer) or not footer.summary_start:
        return []
    file.seek(footer.summary_start)
    return list(records())


def _scan(file: IO[bytes], size: int, damage: Damage) -> _Index:
    """Reads the file once to find its complete records."""
    index = _Index()
    run: list[tuple[int, int]] = []  # schemas, channels and messages outside of chunks, adjacent

    def close_run() -> None:
        if run:
            (offset, _), (_, end) = run[0], run[-1]
            run.clear()
            index.add(_records(file, offset, end - offset), offset, end - offset)

    whole = False
    for opcode, offset, end in _walk(file, size):
        if opcode == Opcode.CHUNK:
            close_run()
            _add_chunk(index, file, offset, end - offset)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            run.append((offset, end))
            if end - run[0][0] > _RUN_BYTES:
                close_run()
        else:
            close_run()
        whole = whole or opcode == Opcode.DATA_END
    close_run()
    if whole:
        damage.notes.append("the file has no index: it was read once more to make one")
    elif index.blocks:
        damage.ends_at(max(b.end_ns for b in index.blocks), min(b.start_ns for b in index.blocks))
    return index


def _add_chunk(index: _Index, file: IO[bytes], offset: int, length: int) -> None:
    """Adds the content of a chunk to the index, or the reason for which it cannot be read."""
    try:
        index.add(_records(file, offset, length), offset, length)
    except _UnknownCompression as error:
        index.foreign.append(error.method)
        index.damaged[offset] = str(error)
    except _BROKEN as error:
        index.damaged[offset] = str(error)


def _walk(file: IO[bytes], size: int) -> Iterator[tuple[int, int, int]]:
    """Yields opcode, start and end of every complete record up to the end of the data."""
    offset = len(MCAP_MAGIC)
    while offset + 9 <= size:
        file.seek(offset)
        opcode, length = struct.unpack("<BQ", file.read(9))
        end = offset + 9 + length
        if opcode == 0 or end > size:
            return
        yield opcode, offset, end
        if opcode == Opcode.DATA_END:
            return
        offset = end


class _UnknownCompression(CannotUnpack):
    """A chunk is compressed by an unknown method."""

    def __init__(self, method: str) -> None:
        super().__init__(f"compressed by {method!r}")
        self.method = method


def _records(file: IO[bytes], offset: int, length: int) -> list[McapRecord]:
    if length > CHUNK_BYTES:
        raise CannotUnpack(f"of {length / 1e6:.0f} MB; at most {CHUNK_BYTES / 1e6:.0f} MB are read of one")
    file.seek(offset)
    data = file.read(length)
    if data[:1] == bytes([Opcode.CHUNK]):
        return _unpacked_records(Chunk.read(ReadDataStream(BytesIO(data[9:]))))
    found: list[McapRecord] = []
    try:
        for record in StreamReader(BytesIO(data), skip_magic=True).records:
            found.append(record)  # noqa: PERF402 - what came before the end is kept
    except EndOfFile:
        pass  # the only possible end of a section from the middle of a file
    return found


def _unpacked_records(chunk: Chunk) -> list[McapRecord]:
    if chunk.compression not in METHODS:
        raise _UnknownCompression(chunk.compression)
    data = unpack(chunk.compression, chunk.data)
    _check_count(data)
    return breakup_chunk(replace(chunk, compression="", data=data), validate_crc=True)


def _check_count(data: bytes) -> None:
    """Rejects a chunk of more than CHUNK_RECORDS records, which need far more memory as objects than as bytes."""
    at = count = 0
    while at + 9 <= len(data):
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        count += 1
        if count > CHUNK_RECORDS:
            raise CannotUnpack(f"holds more than {CHUNK_RECORDS} records, the most that are read of one")


def _type(schema: Schema | None) -> str:
    return ros_bags.plain(schema.name) if schema else "unknown"


def _parser(path: Path, channel: Channel, schema: Schema | None) -> Callable[[bytes], Any]:
    where = f"{path}: {channel.topic}"
    if schema and channel.message_encoding == "protobuf" and schema.name in _OURS:
        return partial(_ours, where, _OURS[schema.name])
    if schema and channel.message_encoding in ("cdr", "ros1"):
        form = "idl" if schema.encoding == "ros2idl" else "msg"
        definition = schema.data.decode(errors="replace")
        return ros_bags.parser(where, schema.name, definition, form, cdr=channel.message_encoding == "cdr")
    return partial(_unknown, where, channel.message_encoding)


def _ours(where: str, kind: Any, data: bytes) -> Any:
    try:
        return kind.FromString(data)
    except DecodeError as error:
        raise Undecodable(f"{where}: a message cannot be decoded: {error}") from error


def _unknown(where: str, encoding: str, _data: bytes) -> Any:
    raise Undecodable(f"{where}: messages in encoding {encoding!r} cannot be decoded; known are cdr, ros1 and our own")
