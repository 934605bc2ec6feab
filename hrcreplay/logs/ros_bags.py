"""ROS 1 bags and sqlite3 files of ROS 2 bags as streams of messages, read without ROS.

Messages are decoded by the definitions in the log, else by those of the known releases. ROS 1 bags without a valid
index are read by one pass through their chunks. Layout: http://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import cache, partial
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from rosbags import rosbag1
from rosbags.interfaces import Connection
from rosbags.rosbag1.reader import decompressors
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from hrcreplay.errors import LogError
from hrcreplay.logs.messages import (
    Damage,
    LazyChunk,
    Message,
    MessageStream,
    Topic,
    Undecodable,
    merge_by_arrival,
    note_damaged_chunks,
)
from hrcreplay.logs.unpack import CHUNK_RECORDS, CannotUnpack, unpack, unpack_message

_IDL_RULE = "=" * 80 + "\n"
_ROS1 = (Stores.ROS1_NOETIC,)
_ROS2 = (Stores.LATEST, Stores.ROS2_HUMBLE, Stores.ROS2_GALACTIC, Stores.ROS2_FOXY)  # releases with different messages
_FAILURES = (SerdeError, TypesysError, KeyError, ValueError, AssertionError)


def plain(msgtype: str) -> str:
    """Returns the name of a type without the "msg" in the middle of ROS 2 names."""
    return msgtype.replace("/msg/", "/")


def parser(where: str, msgtype: str, definition: str, form: str, *, cdr: bool) -> Callable[[bytes], Any]:
    """Returns a function from the bytes of a message to its fields.

    Args:
        where: Start of error messages: file and topic.
        msgtype: Name of the type, of ROS 1 or ROS 2.
        definition: Text of the type's definition in the log; "" if missing.
        form: "msg" or "idl".
        cdr: True: the bytes are CDR (ROS 2); False: ROS 1.

    Returns:
        The function. It uses the first definition that fits its first message and raises Undecodable for a message that
        fits none.
    """
    name = _full(msgtype)
    chosen: list[Typestore] = []

    def read(store: Typestore, data: bytes) -> Any:
        return store.deserialize_cdr(data, name) if cdr else store.deserialize_ros1(data, name)

    def parse(data: bytes) -> Any:
        problem = "its type is not defined in the log"
        for store in chosen or _stores(name, definition, form, _ROS2 if cdr else _ROS1):
            try:
                message = read(store, data)
            except _FAILURES as error:
                problem = str(error)
                continue
            if not chosen:
                chosen.append(store)
            return message
        raise Undecodable(f"{where}: a message of type {plain(msgtype)} cannot be decoded: {problem}")

    return parse


def _stores(name: str, definition: str, form: str, releases: tuple[Stores, ...]) -> Iterator[Typestore]:
    if definition:
        store = get_typestore(Stores.EMPTY)
        try:
            store.register(_types(name, definition, form))
            yield store
        except _FAILURES:
            pass  # some recorders store incomplete definitions; a release may contain the type
    for release in releases:
        store = _release(release)
        if name in store.fielddefs:
            yield store


@cache
def _release(release: Stores) -> Typestore:
    """Returns the types of a release, which are slow to build."""
    return get_typestore(release)


def _types(name: str, definition: str, form: str) -> Any:
    if form == "msg":
        return get_types_from_msg(definition, name)
    types: dict[str, Any] = {}
    for part in definition.split(_IDL_RULE) if definition.startswith(_IDL_RULE) else [definition]:
        text = part.partition("\n")[2] if part.startswith("IDL: ") else part
        if text.strip():
            types.update(get_types_from_idl(text))
    return types


def _full(msgtype: str) -> str:
    package, _, rest = msgtype.partition("/")
    return msgtype if "/" in rest else f"{package}/msg/{rest}"


MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_BROKEN_CHUNK = (struct.error, OSError, RuntimeError, ValueError, KeyError, EOFError)

Fields = dict[str, bytes]


@dataclass(frozen=True)
class _BagChunk:
    start_ns: int
    end_ns: int
    offset: int


class RecoveredBag:
    """A ROS 1 bag whose index is missing or broken.

    Raises:
        LogError: It contains no complete message.
    """

    profile = "ros1"

    def __init__(self, path: Path) -> None:
        self._path = path
        damage = Damage()
        damage.notes.append("the bag has no usable index: it was read once more to make one (rosbag reindex mends it)")
        damage.defects["unindexed"] = 1
        self._chunks: list[_BagChunk] = []
        self._damaged: dict[int, str] = {}  # first byte of a chunk that is left out -> reason
        connections: dict[int, tuple[str, Fields]] = {}
        counts: Counter[int] = Counter()
        with path.open("rb") as file:
            whole = self._scan(file, connections, counts)
        if not self._chunks:
            found = f": {note_damaged_chunks(self._damaged)}" if self._damaged else ""
            raise LogError(f"{path}: the log holds no messages that are whole{found}; {_ANEW}")
        if self._damaged:
            damage.defects["chunks_unreadable"] = len(self._damaged)
            damage.notes.append(note_damaged_chunks(self._damaged))
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
        """Yields messages on these topics with start <= arrival < end, in order of arrival."""
        wanted = {number: topic for number, topic in self._topics.items() if topic.name in names}
        with self._path.open("rb") as file:
            for message in merge_by_arrival(
                LazyChunk(chunk.start_ns, partial(self._chunk, file, chunk, wanted))
                for chunk in self._chunks
                if (start_ns is None or chunk.end_ns >= start_ns) and (end_ns is None or chunk.start_ns < end_ns)
            ):
                after_start = start_ns is None or message.arrival_ns >= start_ns
                if after_start and (end_ns is None or message.arrival_ns < end_ns):
                    yield message

    def _scan(self, file: IO[bytes], connections: dict[int, tuple[str, Fields]], counts: Counter[int]) -> bool:
        """Finds chunks and connections; returns True if the file ends with a complete record."""
        file.seek(len(MAGIC))
        offset = file.tell()
        try:
            while (fields := _fields(file)) is not None:
                (length,) = struct.unpack("<L", file.read(4))
                data = file.read(length)
                if fields["op"][0] == _CHUNK:
                    self._add_packed(offset, fields, data, connections, counts, whole=len(data) == length)
                if len(data) < length:
                    return False
                if fields["op"][0] == _CONNECTION:
                    _connect(fields, data, connections)
                offset = file.tell()
        except _BROKEN_CHUNK:
            return False
        return True

    def _add_packed(
        self,
        offset: int,
        fields: Fields,
        data: bytes,
        connections: dict[int, tuple[str, Fields]],
        counts: Counter[int],
        *,
        whole: bool,
    ) -> None:
        """Adds the content of a chunk; a complete chunk that cannot be unpacked is left out."""
        try:
            self._add(offset, unpack(fields["compression"].decode(), data), connections, counts)
        except CannotUnpack as error:
            if whole:
                self._damaged[offset] = str(error)

    def _add(self, offset: int, data: bytes, connections: dict[int, tuple[str, Fields]], counts: Counter[int]) -> None:
        times = []
        for fields, content in _inner(data):
            if fields["op"][0] == _CONNECTION:
                _connect(fields, content, connections)
            elif fields["op"][0] == _MESSAGE:
                times.append(_time_ns(fields))
                counts[_number(fields)] += 1
        if times:
            self._chunks.append(_BagChunk(min(times), max(times), offset))

    def _chunk(self, file: IO[bytes], chunk: _BagChunk, wanted: dict[int, Topic]) -> Iterator[Message]:
        file.seek(chunk.offset)
        header = _fields(file) or {}
        data = file.read(struct.unpack("<L", file.read(4))[0])
        messages = [
            Message(_time_ns(fields), wanted[_number(fields)], content, (chunk.offset << 32) + i)
            for i, (fields, content) in enumerate(_inner(unpack(header["compression"].decode(), data)))
            if fields["op"][0] == _MESSAGE and _number(fields) in wanted
        ]
        messages.sort(key=lambda message: message.arrival_ns)
        yield from messages


def _fields(file: IO[bytes]) -> Fields | None:
    """Reads the header of the next record; None at the end of the file."""
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
    """Yields the complete records of a chunk; the last chunk of a truncated bag may itself be truncated.

    Raises:
        CannotUnpack: There are more than CHUNK_RECORDS.
    """
    file = BytesIO(data)
    count = 0
    try:
        while (fields := _fields(file)) is not None:
            count += 1
            if count > CHUNK_RECORDS:
                raise CannotUnpack(f"holds more than {CHUNK_RECORDS} records, the most that are read of one")
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
    parse = parser(f"{path}: {name}", msgtype, definition, "msg", cdr=False)
    return Topic(name, plain(msgtype), count, parse)


#: Remedy for a chunk that is damaged or too large.
_ANEW = "copy the bag again, or write it anew in small chunks with rosbag decompress"
_NO_INDEX = (rosbag1.ReaderError, AssertionError, struct.error, ValueError, IndexError)
_BROKEN = (*_NO_INDEX, RuntimeError, OSError)


def open_bag(path: Path) -> MessageStream:
    """Opens a ROS 1 bag by its index or, if that is missing or broken, without it.

    Raises:
        LogError: It contains no complete message.
    """
    try:
        return RosStream(path)
    except _NO_INDEX:
        return RecoveredBag(path)


class _LimitedReader(rosbag1.Reader):
    """A reader that unpacks no chunk beyond the limit."""

    def read_chunk(self) -> Any:
        """Reads the next chunk, with a decompressor with a limit."""
        chunk = super().read_chunk()
        method = next(name for name, decompress in decompressors.items() if decompress is chunk.decompressor)
        return chunk._replace(decompressor=partial(unpack, method))


class RosStream:
    """A ROS 1 bag read by the library rosbags."""

    profile = "ros1"

    def __init__(self, path: Path) -> None:
        self._path = path
        self.defects: Counter[str] = Counter()
        self.notes: list[str] = []
        with _LimitedReader(path) as opened:
            connections: list[Connection] = list(opened.connections)
            self.start_ns, self.end_ns = opened.start_time, opened.end_time - 1
        self._topics: dict[tuple[str, str], Topic] = {}
        for c in connections:
            key = (c.topic, c.msgtype)
            count = c.msgcount + (self._topics[key].count if key in self._topics else 0)
            self._topics[key] = Topic(c.topic, plain(c.msgtype), count, _parser(path, c))
        self.topics = tuple(self._topics.values())

    def messages(self, names: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        """Yields messages on these topics with start <= arrival < end, in order of arrival."""
        try:
            with _LimitedReader(self._path) as opened:
                wanted = [c for c in opened.connections if c.topic in names]
                if not wanted:
                    return
                for c, arrival_ns, data in opened.messages(wanted, start_ns, end_ns):
                    yield Message(arrival_ns, self._topics[(c.topic, c.msgtype)], data)
        except CannotUnpack as error:
            raise LogError(f"{self._path}: a chunk of the bag {error}; {_ANEW}") from error
        except _BROKEN as error:
            found = str(error) or type(error).__name__  # errors of struct and zlib have a text, EOFError has none
            raise LogError(f"{self._path}: broken in the middle ({found}); copy it again") from error


def _parser(path: Path, connection: Connection) -> Callable[[bytes], Any]:
    return parser(f"{path}: {connection.topic}", connection.msgtype, connection.msgdef.data, "msg", cdr=False)


#: Maximum number of consecutive unreadable rows; then the search ends.
_SEARCH_ROWS = 1 << 20


class Db3Stream:
    """A single sqlite3 file of a ROS 2 bag; a damaged one is read as far as possible.

    Raises:
        LogError: It is not such a file, or nothing in it can be read.
    """

    profile = "ros2"

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found: list[tuple[int, int, int]] | None = None  # time, row and topic; None: the file is whole
        damage = Damage()
        self.defects, self.notes = damage.defects, damage.notes
        try:
            with closing(_database(path)) as database:
                kinds = database.execute("SELECT id, name, type FROM topics").fetchall()
                definitions = _definitions(database)
        except sqlite3.Error as error:
            raise LogError(f"{path}: cannot be read as a ROS 2 bag ({error}); record or copy it again") from error
        counts: Counter[int] = Counter()
        try:
            self.start_ns, self.end_ns = self._summarize(counts)
        except sqlite3.Error as error:
            self.start_ns, self.end_ns = self._recover(damage, error)
            counts = self._count()
        self._topics: dict[int, Topic] = {}
        for number, name, msgtype in kinds:
            form, text = definitions.get(msgtype, ("msg", ""))
            parse = parser(f"{path}: {name}", msgtype, text, form, cdr=True)
            self._topics[number] = Topic(name, plain(msgtype), counts[number], parse)
        self.topics = tuple(self._topics.values())
        journal = path.with_name(f"{path.name}-wal")
        if journal.exists() and journal.stat().st_size:
            self.notes.append(f"{journal.name} beside the file holds messages not yet in it; they are left out")

    def _summarize(self, counts: Counter[int]) -> tuple[int, int]:
        with closing(_database(self._path)) as database:
            found = dict(database.execute("SELECT topic_id, count(id) FROM messages GROUP BY topic_id"))
            start_ns, end_ns = database.execute("SELECT min(timestamp), max(timestamp) FROM messages").fetchone()
        counts.update(found)
        return start_ns or 0, end_ns or 0

    def _recover(self, damage: Damage, error: sqlite3.Error) -> tuple[int, int]:
        """Finds the readable rows and notes the damage; returns their first and last arrival."""
        with closing(_database(self._path)) as database:
            self._found = sorted(_readable_rows(database))
        if not self._found:
            raise LogError(f"{self._path}: none of its messages can be read ({error}); record or copy it again")
        start_ns, end_ns = self._found[0][0], self._found[-1][0]
        damage.defects["files_damaged"] = 1
        damage.notes.append(f"{self._path.name} is damaged ({error}): {len(self._found)} of its messages can be read")
        if _is_short(self._path):
            damage.ends_at(end_ns, start_ns)
        return start_ns, end_ns

    def _count(self) -> Counter[int]:
        return Counter(topic for _, _, topic in self._found or ())

    def messages(self, names: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        """Yields messages on these topics with start <= arrival < end, in order of arrival."""
        wanted = {number: topic for number, topic in self._topics.items() if topic.name in names}
        span = (-(1 << 63) if start_ns is None else start_ns, (1 << 63) - 1 if end_ns is None else end_ns)
        given: tuple[int, int] | None = None  # time and row of the newest message
        if self._found is None:
            try:
                for arrival_ns, row, number, data in self._whole(wanted, span):
                    yield self._message(arrival_ns, wanted[number], data, row)
                    given = (arrival_ns, row)
            except sqlite3.Error as error:
                self._recover(Damage(self.defects, self.notes), error)
            else:
                return
        found = [at for at in self._found or () if at[2] in wanted and span[0] <= at[0] < span[1]]
        with closing(_database(self._path)) as database:
            for arrival_ns, row, number in found:
                if given is None or (arrival_ns, row) > given:
                    (data,) = database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()
                    yield self._message(arrival_ns, wanted[number], data, row)

    def _whole(self, wanted: Collection[int], span: tuple[int, int]) -> Iterator[tuple[int, int, int, Any]]:
        marks = ",".join("?" for _ in wanted)
        with closing(_database(self._path)) as database:
            yield from database.execute(
                f"SELECT timestamp, id, topic_id, data FROM messages WHERE topic_id IN ({marks}) "  # noqa: S608  marks
                "AND timestamp >= ? AND timestamp < ? ORDER BY timestamp, id",
                (*wanted, *span),
            )

    def _message(self, arrival_ns: int, topic: Topic, data: Any, row: int) -> Message:
        where = f"{self._path}: {topic.name}"
        return Message(arrival_ns, topic, unpack_message(data, where) if isinstance(data, bytes) else b"", row)


def _database(path: Path) -> sqlite3.Connection:
    """Opens a database for reading; also a truncated one, which requires a writable schema."""
    database = sqlite3.connect(f"{path.resolve().as_uri()}?immutable=1", uri=True, check_same_thread=False)
    database.execute("PRAGMA writable_schema = ON")
    database.text_factory = lambda text: text.decode(errors="replace")
    return database


def _definitions(database: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Returns type -> "msg" or "idl" and its definition, if the recorder stored them."""
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    try:
        return {
            msgtype: ("idl" if form == "ros2idl" else "msg", text) for msgtype, form, text in database.execute(query)
        }
    except sqlite3.OperationalError:  # recorders before Iron have no such table
        return {}


def _readable_rows(database: sqlite3.Connection) -> Iterator[tuple[int, int, int]]:
    """Yields time, row and topic of each readable message; searches beyond damage with increasing steps."""
    row, step = 0, 1
    while step <= _SEARCH_ROWS:
        query = "SELECT timestamp, id, topic_id, data FROM messages WHERE id >= ? ORDER BY id"
        try:
            for arrival_ns, at, topic, _ in database.execute(query, (row,)):
                yield arrival_ns, at, topic
                row, step = at + 1, 1
        except sqlite3.Error:
            row, step = row + step, 2 * step
        else:
            return


def _is_short(path: Path) -> bool:
    """Returns True if a database has fewer bytes than its header gives."""
    with path.open("rb") as file:
        head = file.read(32)
    (page,), (pages,) = struct.unpack_from(">H", head, 16), struct.unpack_from(">L", head, 28)
    return path.stat().st_size < pages * (65536 if page == 1 else page)
