"""The files of a log: detection of their format, and the files as streams of messages."""

from __future__ import annotations

import gzip
import tempfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePath
from typing import Any

import zstandard
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from hrcreplay.errors import LogError
from hrcreplay.logs import mcap_stream, ros_bags
from hrcreplay.logs.mcap_stream import McapStream
from hrcreplay.logs.messages import PROFILE, Damage, LazyChunk, Message, MessageStream, Topic, merge_by_arrival
from hrcreplay.logs.ros_bags import open_bag, open_db3

_SQLITE = b"SQLite format 3\0"
_KNOWN = "known are MCAP files, ROS 1 bags (.bag) and ROS 2 bags (a folder with metadata.yaml, or a .db3 file)"

_IMPORT = ". It is text: hrcreplay import azure|kinect2|keraal {path} --out LOG.mcap makes a log of a tracker's CSV"


@dataclass
class LogFiles:
    """All files of a log as one stream of messages."""

    path: Path
    kind: str  #: "hrcreplay", "mcap", "ros1" or "ros2"
    streams: list[MessageStream]
    defects: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    folder: Any = None  #: temporary files that live as long as the source

    def damage(self) -> Damage:
        """What is known to be wrong with the files so far; reading may find more."""
        found = Damage(Counter(self.defects), list(self.notes))
        several = len(self.streams) > 1
        for number, stream in enumerate(self.streams, start=1):
            last = max(found.defects["truncated_at_ns"], stream.defects["truncated_at_ns"])
            found.defects.update(stream.defects)
            found.defects["truncated_at_ns"] = last  # an instant, not a count: never summed
            found.notes.extend(f"file {number}: {note}" if several else note for note in stream.notes)
        found.defects = +found.defects
        return found

    @property
    def start_ns(self) -> int:
        """First arrival."""
        return min(stream.start_ns for stream in self.streams)

    @property
    def end_ns(self) -> int:
        """Last arrival."""
        return max(stream.end_ns for stream in self.streams)

    def topics(self) -> list[Topic]:
        """Topics of all files, each once, in the order in which they are met."""
        met: dict[tuple[str, str], Topic] = {}
        for stream in self.streams:
            for topic in stream.topics:
                key = (topic.name, topic.type)
                count = topic.count + (met[key].count if key in met else 0)
                met[key] = Topic(topic.name, topic.type, count, topic.parse)
        return list(met.values())

    def messages(
        self, names: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """Messages of all files on these topics with start <= arrival < end, in order of arrival."""
        chosen = frozenset(names)
        return merge_by_arrival(
            LazyChunk(stream.start_ns, partial(stream.messages, chosen, start_ns, end_ns))
            for stream in self.streams
            if (start_ns is None or stream.end_ns >= start_ns) and (end_ns is None or stream.start_ns < end_ns)
        )


def open_source(path: Path) -> LogFiles:
    """The log at a path: a file, or the folder of a ROS 2 bag.

    Raises:
        LogError: Nothing is there, it is of no known kind, or it holds no messages.
    """
    if not path.exists():
        raise LogError(f"{path}: there is no such file or folder; name a log")
    source = _folder(path) if path.is_dir() else _single(path)
    source.streams = [stream for stream in source.streams if any(topic.count for topic in stream.topics)]
    if not source.streams:
        raise LogError(f"{path}: the log holds no messages")
    return source


def _single(path: Path) -> LogFiles:
    stream = _file(path)
    kind = stream.profile if stream.profile in (PROFILE, "ros1", "ros2") else "mcap"
    return LogFiles(path, kind, [stream])


def _file(path: Path, *, zstd_messages: bool = False) -> MessageStream:
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    if not head:
        raise LogError(f"{path}: the log holds no messages (0 bytes)")
    if head.startswith(mcap_stream.MAGIC):
        return McapStream(path)
    if head.startswith(ros_bags.MAGIC):
        return open_bag(path)
    if head.startswith(_SQLITE) and path.suffix == ".db3":
        return open_db3(path, zstd_messages=zstd_messages)
    text = _IMPORT.format(path=path) if _is_text(path) else ""
    raise LogError(f"{path}: is no log of a known kind; {_KNOWN}{text}")


def _is_text(path: Path) -> bool:
    """Whether a file begins with lines of text, plain or gzipped."""
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            head = file.read(4096)
    except (OSError, EOFError, zlib.error):
        return False
    return path.suffix.lower() != ".bag" and bool(head) and all(byte >= 32 or byte in b"\t\r\n" for byte in head)


def _folder(path: Path) -> LogFiles:
    """A ROS 2 bag. Its files are opened one by one, so that their messages are all there are."""
    metadata = path / "metadata.yaml"
    if not metadata.exists():
        files = sorted(p for suffix in ("mcap", "db3") for p in path.glob(f"*.{suffix}"))
        if not files:
            raise LogError(f"{path}: is a folder without metadata.yaml; {_KNOWN}")
        source = _together(path, files)
        source.notes.insert(0, "metadata.yaml is missing: the files of the folder are read in order of time")
        return source
    described = _metadata(metadata)
    files = [path / PurePath(name).name for name in described.get("relative_file_paths") or ()]
    present = [file for file in files if file.exists()]
    promised = int(described.get("message_count") or 0)
    mode = str(described.get("compression_mode") or "").lower()
    temporary = None
    if mode == "file":
        temporary = tempfile.TemporaryDirectory(prefix="hrcreplay-")
        present = [_unpacked(file, Path(temporary.name)) for file in present]
    source = _together(path, present, zstd_messages=mode == "message")
    source.folder = temporary
    if len(present) < len(files):
        source.defects["files_missing"] = len(files) - len(present)
        source.notes.append(f"{len(files) - len(present)} of the {len(files)} files in metadata.yaml are not there")
    delivered = sum(topic.count for topic in source.topics())
    if promised and not delivered:
        raise LogError(
            f"{path}: metadata.yaml promises {promised} messages, but its files ({len(present)}) give none; "
            "copy the folder again, or rebuild it with ros2 bag reindex"
        )
    if delivered < promised:
        source.defects["messages_missing"] = promised - delivered
        source.notes.append(f"metadata.yaml promises {promised} messages, but the files give {delivered}")
    return source


def _together(path: Path, files: list[Path], *, zstd_messages: bool = False) -> LogFiles:
    source = LogFiles(path, "ros2", [])
    for file in files:
        if not file.stat().st_size:
            source.defects["files_empty"] += 1
            source.notes.append(f"{file.name}: has 0 bytes")
            continue
        source.streams.append(_file(file, zstd_messages=zstd_messages))
    return source


def _metadata(path: Path) -> dict[str, Any]:
    try:
        return dict(YAML(typ="safe").load(path.read_text())["rosbag2_bagfile_information"])
    except (YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise LogError(f"{path}: is not the metadata of a ROS 2 bag; rebuild it with ros2 bag reindex") from error


def _unpacked(file: Path, folder: Path) -> Path:
    target = folder / file.stem
    with file.open("rb") as packed, target.open("wb") as unpacked:
        try:
            zstandard.ZstdDecompressor().copy_stream(packed, unpacked)
        except zstandard.ZstdError as error:
            raise LogError(f"{file}: cannot be decompressed ({error}); copy it again") from error
    return target
