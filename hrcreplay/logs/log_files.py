"""The files of a log: detection of their format, the files as streams of messages, and data other than skeletons.

These data are camera poses, task, robot base, ground truth.
"""

from __future__ import annotations

import gzip
import json
import tempfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from hrcreplay.errors import LogError
from hrcreplay.logs import ros_bags
from hrcreplay.logs.decoders import points_of
from hrcreplay.logs.mcap_stream import McapStream
from hrcreplay.logs.messages import (
    MCAP_MAGIC,
    PROFILE,
    Damage,
    LazyChunk,
    Message,
    MessageStream,
    Topic,
    merge_by_arrival,
)
from hrcreplay.logs.ros_bags import Db3Stream, open_bag
from hrcreplay.logs.unpack import ZSTD_MAGIC, unpack_file
from hrcreplay.records import Floats, Ints, Table

#: Endings of files for ``import`` -> the kinds that may read them.
_IMPORTED = {
    **dict.fromkeys(("csv", "tsv", "txt"), "azure|kinect2|keraal|table|mediapipe|optitrack"),
    **dict.fromkeys(("parquet", "jsonl"), "table"),
    "json": "table|mediapipe|openpose|k4abt|zed",
    "skeleton": "ntu",
    "pkl": "chico|harper",
    **{kind: kind for kind in ("trc", "c3d", "bvh", "mvnx")},
}
_BINARY = ("parquet", "c3d", "pkl")
_SQLITE = b"SQLite format 3\0"
_KNOWN = "known are MCAP files, ROS 1 bags (.bag) and ROS 2 bags (a folder with metadata.yaml, or a .db3 file)"

_IMPORT = ". hrcreplay import {kinds} {path} --out LOG.mcap makes a log of it"


@dataclass
class LogFiles:
    """All files of a log as one stream of messages."""

    path: Path
    kind: str  #: "hrcreplay", "mcap", "ros1" or "ros2"
    streams: list[MessageStream]
    defects: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    folder: Any = None  #: temporary files kept as long as the source

    def damage(self) -> Damage:
        """Known damage of the files so far; reading may find more."""
        found = Damage(Counter(self.defects), list(self.notes))
        several = len(self.streams) > 1
        for number, stream in enumerate(self.streams, start=1):
            last = max(found.defects["truncated_at_ns"], stream.defects["truncated_at_ns"])
            found.defects.update(stream.defects)
            found.defects["truncated_at_ns"] = last  # an instant, not a count: not summed
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
        """Topics of all files, each once, in order of appearance."""
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
        """Yields messages of all files on these topics with start <= arrival < end, in order of arrival."""
        chosen = frozenset(names)
        return merge_by_arrival(
            LazyChunk(stream.start_ns, partial(stream.messages, chosen, start_ns, end_ns))
            for stream in self.streams
            if (start_ns is None or stream.end_ns >= start_ns) and (end_ns is None or stream.start_ns < end_ns)
        )


def open_source(path: Path) -> LogFiles:
    """Opens the log at a path: a file, or the folder of a ROS 2 bag.

    Raises:
        LogError: The path does not exist, is of unknown type, or contains no messages.
    """
    if not path.exists():
        raise LogError(f"{path}: there is no such file or folder; name a log")
    source = _folder(path) if path.is_dir() else _single(path)
    told = source.damage().notes
    source.streams = [stream for stream in source.streams if any(topic.count for topic in stream.topics)]
    if not source.streams:
        raise LogError(f"{path}: the log holds no messages" + "".join(f"; {note}" for note in told))
    return source


def _single(path: Path) -> LogFiles:
    if path.suffix == ".zstd":
        source = LogFiles(path, "ros2", [])
        source.streams = [_file(_unpacked(source, path))]
        return source
    stream = _file(path)
    kind = stream.profile if stream.profile in (PROFILE, "ros1", "ros2") else "mcap"
    return LogFiles(path, kind, [stream])


def _file(path: Path) -> MessageStream:
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    if not head:
        raise LogError(f"{path}: the log holds no messages (0 bytes)")
    if head.startswith(MCAP_MAGIC):
        return McapStream(path)
    if head.startswith(ros_bags.MAGIC):
        return open_bag(path)
    if head.startswith(_SQLITE) and path.suffix == ".db3":
        return Db3Stream(path)
    kinds = _IMPORTED.get(_ending(path))
    text = _IMPORT.format(path=path, kinds=kinds) if kinds and (_ending(path) in _BINARY or _is_text(path)) else ""
    raise LogError(f"{path}: is no log of a known kind; {_KNOWN}{text}")


def _unpacked(source: LogFiles, file: Path) -> Path:
    """Returns a file of the log, decompressed if compressed by zstd."""
    with file.open("rb") as opened:
        if opened.read(4) != ZSTD_MAGIC:
            return file
    source.folder = source.folder or tempfile.TemporaryDirectory(prefix="hrcreplay-")
    return unpack_file(file, Path(source.folder.name) / file.stem)


def _ending(path: Path) -> str:
    return path.name.lower().removesuffix(".gz").rpartition(".")[2]


def _is_text(path: Path) -> bool:
    """Returns True if a file has text at its start, plain or gzipped."""
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            head = file.read(4096)
    except (OSError, EOFError, zlib.error):
        return False
    return bool(head) and all(byte >= 32 or byte in b"\t\r\n" for byte in head)


#: Maximum size of a metadata.yaml; it has a few kB, with one or two lines per file [bytes].
_METADATA_BYTES = 4 << 20
_ENDINGS = ("mcap", "db3", "mcap.zstd", "db3.zstd")


def _folder(path: Path) -> LogFiles:
    """Opens a ROS 2 bag. Its files are opened one by one, so that all of their messages are found."""
    metadata = path / "metadata.yaml"
    source = LogFiles(path, "ros2", [])
    if not metadata.exists():
        files = sorted(p for ending in _ENDINGS for p in path.glob(f"*.{ending}"))
        if not files:
            raise LogError(f"{path}: is a folder without metadata.yaml; {_KNOWN}")
        source.notes.append("metadata.yaml is missing: the files of the folder are read in order of time")
        _open_files(source, files)
        return source
    described = _metadata(metadata)
    files = [path / PurePath(name).name for name in described.files]
    present = [file for file in files if file.exists()]
    _open_files(source, present)
    if len(present) < len(files):
        source.defects["files_missing"] = len(files) - len(present)
        source.notes.append(f"{len(files) - len(present)} of the {len(files)} files in metadata.yaml are not there")
    delivered = sum(topic.count for topic in source.topics())
    if described.messages and not delivered:
        raise LogError(
            f"{path}: metadata.yaml promises {described.messages} messages, but its files ({len(present)}) give none; "
            "copy the folder again, or rebuild it with ros2 bag reindex"
        )
    if delivered < described.messages:
        source.defects["messages_missing"] = described.messages - delivered
        source.notes.append(f"metadata.yaml promises {described.messages} messages, but the files give {delivered}")
    return source


def _open_files(source: LogFiles, files: list[Path]) -> None:
    """Opens the files of a folder; an unreadable one is left out with a note, unless it is the only one."""
    refused: LogError | None = None
    for file in files:
        if not file.stat().st_size:
            source.defects["files_empty"] += 1
            source.notes.append(f"{file.name}: has 0 bytes")
            continue
        try:
            source.streams.append(_file(_unpacked(source, file)))
        except LogError as error:
            refused = refused or error
            source.defects["files_unreadable"] += 1
            source.notes.append(f"{file.name} is left out: {str(error).removeprefix(f'{file}: ')}")
    if refused is not None and not source.streams:
        raise refused


@dataclass(frozen=True)
class _Metadata:
    """Files of a ROS 2 bag, from its metadata."""

    files: tuple[str, ...]
    messages: int


def _metadata(path: Path) -> _Metadata:
    wrong = f"{path}: is not the metadata of a ROS 2 bag; rebuild it with ros2 bag reindex"
    try:
        if path.stat().st_size > _METADATA_BYTES:
            raise LogError(f"{wrong} (it has {path.stat().st_size / 1e6:.0f} MB)")
        found = YAML(typ="safe").load(path.read_text())["rosbag2_bagfile_information"]
        files, count = found.get("relative_file_paths") or (), found.get("message_count") or 0
        if not isinstance(count, int) or not all(isinstance(name, str) for name in files):
            raise LogError(wrong)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    except (YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise LogError(wrong) from error
    return _Metadata(tuple(files), count)


@dataclass(frozen=True)
class Header:
    """Data of a log before its first frame."""

    path: Path
    kind: str  #: "hrcreplay", "mcap", "ros1" or "ros2"
    cameras: tuple[str, ...]
    T_world_camera: dict[str, Floats]  #: (4, 4); only for cameras with extrinsics in the log
    task: dict[str, Any] | None  #: programmed task in the log, structured like a task file
    start_ns: int  #: first arrival of a skeleton, joint state or truth; of any message without these
    end_ns: int  #: last arrival of any message
    T_world_base: Floats | None  #: (4, 4) robot base; None if unknown
    has_truth: bool
    joint_topics: tuple[str, ...]  #: topics of the robot's joint states
    static_poses: bool = False  #: True: the poses are those of /tf_static, in its own world

    def poses_beside(self, T_world_camera: Mapping[str, Floats]) -> tuple[Mapping[str, Floats], Floats | None]:
        """Returns the log's poses of cameras and robot base that count beside a cell's poses of cameras.

        Poses of /tf_static are in a world of their own: beside a cell that places a camera, they do not count.
        """
        if self.static_poses and T_world_camera:
            return {}, None
        return self.T_world_camera, self.T_world_base


@dataclass(frozen=True)
class Truth(Table):
    """Ground truth of the person, from a reference better than the cameras, one row per instant."""

    t_ns: Ints  #: (n,)
    points_m: Floats  #: (n, 20, 3) POINTS in the world [m]


_OWN_TRUTH = "hrcreplay.Truth"
_OWN_CAMERA, _OWN_TASK, _OWN_BASE = "hrcreplay.Camera", "hrcreplay.Task", "hrcreplay.Base"
_CHUNK_NS = 10**9
_RIGID = 1e-2  # tolerance of the axes of a pose: recorded ones may be rounded more than those of a cell file


@dataclass(frozen=True)
class Latched:
    """Values that hold for the whole log: camera poses, task, robot base."""

    cameras: tuple[str, ...]  #: declared cameras, in order
    T_world_camera: dict[str, Floats]
    task: dict[str, Any] | None
    T_world_base: Floats | None


def latched(source: LogFiles) -> Latched:
    """Reads the messages that apply to a whole log of hrcreplay's format. Raises LogError for a damaged one."""
    kinds = (_OWN_CAMERA, _OWN_TASK, _OWN_BASE)
    names = [topic.name for topic in source.topics() if topic.type in kinds]
    cameras: list[str] = []
    poses: dict[str, Floats] = {}
    task = base = None
    for message in source.messages(names) if names else ():
        content, kind = message.read(), message.topic.type
        if kind == _OWN_CAMERA:
            cameras.append(content.camera)
            if content.T_world_camera:
                poses[content.camera] = _pose(content.T_world_camera, message)
        elif kind == _OWN_TASK:
            task = _task(content.json, message)
        else:
            base = _pose(content.T_world_base, message)
    return Latched(tuple(cameras), poses, task, base)


def _task(text: str, message: Message) -> dict[str, Any]:
    try:
        return dict(json.loads(text))
    except (ValueError, TypeError, RecursionError) as error:
        raise LogError(
            f"{message.topic.name}: the task in the log is not JSON ({error}); import the log again"
        ) from error


def _pose(values: Any, message: Message) -> Floats:
    if len(values) != 16:
        raise LogError(f"{message.topic.name}: a pose of {len(values)} numbers; 16 are right")
    pose = np.array(values, dtype=np.float64).reshape(4, 4)
    if not np.isfinite(pose).all():
        raise LogError(f"{message.topic.name}: a pose with {pose[~np.isfinite(pose)][0]}; finite numbers are right")
    R = pose[:3, :3]
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > _RIGID or np.linalg.det(R) < 0.0 or (pose[3] != (0.0, 0.0, 0.0, 1.0)).any():
        what = f"axes off by {off:.2g}" if off > _RIGID else "a mirror image, or a last row that is not 0 0 0 1"
        raise LogError(f"{message.topic.name}: a pose with {what}; a rotation and a place are right")
    pose.flags.writeable = False
    return pose


def truth_topic(source: LogFiles) -> str | None:
    """Returns the topic of the ground truth, if the log has one."""
    return next((topic.name for topic in source.topics() if topic.type == _OWN_TRUTH and topic.count), None)


def truth(source: LogFiles, topic: str) -> Iterator[Truth]:
    """Yields the ground truth in chunks of at most a second."""
    times: list[int] = []
    rows: list[Floats] = []
    for message in source.messages([topic]):
        content = message.read()
        if times and content.t_ns - times[0] >= _CHUNK_NS:
            yield Truth(np.array(times, dtype=np.int64), np.array(rows))
            times, rows = [], []
        times.append(content.t_ns)
        rows.append(points_of(content.points, message.topic.name))
    if times:
        yield Truth(np.array(times, dtype=np.int64), np.array(rows))
