"""ROS 1 bags and the sqlite3 files of ROS 2 bags, through rosbags."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection, MessageDefinitionFormat
from zstandard import ZstdDecompressor, ZstdError

from hrcreplay.errors import LogError
from hrcreplay.logs import rostypes
from hrcreplay.logs.bag_recovery import RecoveredBag
from hrcreplay.logs.messages import Message, Stream, Topic

_NO_INDEX = (rosbag1.ReaderError, AssertionError, struct.error, ValueError, IndexError)
_BROKEN = (*_NO_INDEX, rosbag2.ReaderError, ZstdError, RuntimeError, OSError)  # the last two: lz4's, bz2's


def open_bag(path: Path) -> Stream:
    """A ROS 1 bag, by its index or, where that is missing or broken, without it.

    Raises:
        LogError: It holds no whole message.
    """
    try:
        return RosStream(path, rosbag1.Reader, cdr=False)
    except _NO_INDEX:
        return RecoveredBag(path)


def open_db3(path: Path, *, zstd_messages: bool = False) -> Stream:
    """A sqlite3 file of a ROS 2 bag, by itself; ``zstd_messages`` where each message is compressed.

    Raises:
        LogError: It is no such file.
    """
    try:
        stream = RosStream(path, rosbag2.Reader, cdr=True, zstd_messages=zstd_messages)
    except rosbag2.ReaderError as error:
        raise LogError(f"{path}: cannot be read as a ROS 2 bag ({error}); record or copy it again") from error
    journal = path.with_name(f"{path.name}-wal")
    if journal.exists() and journal.stat().st_size:
        stream.notes.append(f"{journal.name} beside the file holds messages not yet in it; they are left out")
    return stream


class RosStream:
    """A file that rosbags reads."""

    def __init__(self, path: Path, reader: Callable[[Path], Any], *, cdr: bool, zstd_messages: bool = False) -> None:
        self._path = path
        self._reader = reader
        self._unpack: Callable[[bytes], bytes] = ZstdDecompressor().decompress if zstd_messages else bytes
        self.profile = "ros2" if cdr else "ros1"
        self.defects: Counter[str] = Counter()
        self.notes: list[str] = []
        with reader(path) as opened:
            connections: list[Connection] = list(opened.connections)
            self.start_ns, self.end_ns = opened.start_time, opened.end_time - 1
        self._topics: dict[tuple[str, str], Topic] = {}
        for c in connections:
            key = (c.topic, c.msgtype)
            count = c.msgcount + (self._topics[key].count if key in self._topics else 0)
            self._topics[key] = Topic(c.topic, rostypes.plain(c.msgtype), count, _parser(path, c, cdr=cdr))
        self.topics = tuple(self._topics.values())

    def messages(self, names: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        """Messages on these topics with start <= arrival < end, in order of arrival."""
        try:
            with self._reader(self._path) as opened:
                wanted = [c for c in opened.connections if c.topic in names]
                if not wanted:
                    return
                for c, arrival_ns, data in opened.messages(wanted, start_ns, end_ns):
                    yield Message(arrival_ns, self._topics[(c.topic, c.msgtype)], self._unpack(data))
        except _BROKEN as error:
            found = str(error) or type(error).__name__  # struct and zlib say what they found, EOFError does not
            raise LogError(f"{self._path}: broken in the middle ({found}); copy it again") from error


def _parser(path: Path, connection: Connection, *, cdr: bool) -> Callable[[bytes], Any]:
    form = "idl" if connection.msgdef.format == MessageDefinitionFormat.IDL else "msg"
    return rostypes.parser(f"{path}: {connection.topic}", connection.msgtype, connection.msgdef.data, form, cdr=cdr)
