"""Writes a log of hrcreplay's own format: MCAP with the messages of skeleton.proto, complete or not at all.

Also helps the importers: numbers from text lines with their positions, and rows of several cameras merged into a log.
"""

from __future__ import annotations

import gzip
import heapq
import itertools
import json
import os
import statistics
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from decimal import Decimal
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple, Self

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import CompressionType, Writer

from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs import messages
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.capsules_pb2 import Capsule, Point, RobotCapsules
from hrcreplay.records import POINTS, CameraFrames, Floats, Ints

_CHUNK_BYTES = 256 * 1024  # about ten seconds of two cameras: small enough for seeking, large enough for compression


class Capsules(NamedTuple):
    """Capsules of a recorded robot's links."""

    t_ns: Ints  #: (n,) instants
    ends_m: Floats  #: (n, s, 2, 3) both ends of their axes, in the frame of the base [m]
    radius_m: float  #: of all of them [m]


def _named_axes(ends: list[list[list[float]]]) -> Iterator[list[dict[str, float]]]:
    """Both ends of each capsule, by the names of the axes."""
    for both in ends:
        yield [dict(zip("xyz", end, strict=True)) for end in both]


class LogWriter:
    """A log being written; it appears at ``path`` when the ``with`` block ends without an error.

    Frames, truth and joints may be added in chunks, each track in order of time. Cameras keep the order in which they
    are declared. The same calls give the same bytes.

    Raises:
        SettingsError: The file exists, or its folder cannot be written.
    """

    def __init__(self, path: Path) -> None:
        _refuse_existing(path)
        self._path = path
        self._cameras: list[str] = []
        self._latched: list[tuple[str, Any]] = []
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._last_ns = 0

    def __enter__(self) -> Self:
        """Opens a temporary file beside the target."""
        try:
            handle, name = tempfile.mkstemp(prefix=f".{self._path.name}.", dir=self._path.parent)
        except OSError as error:
            raise SettingsError(
                f"{self._path}: cannot be written ({error.strerror}); name a folder that can"
            ) from error
        self._temporary = Path(name)
        self._file: IO[bytes] = os.fdopen(handle, "wb")
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(
            profile=messages.PROFILE, library="hrcreplay"
        )  # the version of the library would change the bytes
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        """Finishes the file and moves it to its path, or removes it after an error."""
        try:
            if kind is None:
                self._release(self._last_ns)
                self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
            if kind is None:
                self._publish()
        finally:
            self._temporary.unlink(missing_ok=True)

    def _publish(self) -> None:
        umask = os.umask(0)
        os.umask(umask)
        self._temporary.chmod(0o666 & ~umask)  # mkstemp's mode 0600 would make the log unreadable for other users
        _refuse_existing(self._path)  # the target may have been created meanwhile
        self._temporary.rename(self._path)

    def camera(self, name: str, T_world_camera: Floats | None = None) -> None:
        """Declares a camera, with its pose (4, 4) in the world if known."""
        if name in self._cameras or not name or "/" in name:
            raise SettingsError(f"camera {name!r}: declared twice, empty or with a slash; name each camera once")
        self._cameras.append(name)
        values = [] if T_world_camera is None else np.asarray(T_world_camera, dtype=np.float64).ravel().tolist()
        self._latch(messages.camera_info_topic(name), pb.Camera(camera=name, T_world_camera=values))

    def task(self, task: dict[str, Any]) -> None:
        """Adds the programmed task: a dictionary with the content of a task file."""
        self._latch(messages.TASK, pb.Task(json=json.dumps(task, sort_keys=True)))

    def base(self, T_world_base: Floats) -> None:
        """Adds the pose (4, 4) of the robot's base in the world."""
        self._latch(messages.BASE, pb.Base(T_world_base=np.asarray(T_world_base, dtype=np.float64).ravel().tolist()))

    def frames(self, frames: CameraFrames) -> None:
        """Adds camera frames; undeclared cameras are declared with unknown pose."""
        for name in frames.cameras:
            if name not in self._cameras:
                self.camera(name)
        points = frames.points_m.reshape(len(frames), 3 * len(POINTS))
        for i in range(len(frames)):
            name = frames.cameras[frames.camera[i]]
            capture_ns = int(frames.capture_ns[i])
            message = pb.Skeleton(
                capture_ns=capture_ns,
                camera=name,
                body=int(frames.body[i]),
                points=points[i].tolist(),
                confidence=frames.confidence[i].tolist(),
            )
            self._write(messages.skeleton_topic(name), message, int(frames.arrival_ns[i]), capture_ns)

    def truth(self, t_ns: Ints, points_m: Floats) -> None:
        """Adds the true person: (n,) instants and (n, 20, 3) POINTS in the world [m]."""
        for t, points in zip(t_ns.tolist(), points_m.reshape(len(t_ns), 3 * len(POINTS)).tolist(), strict=True):
            self._write(messages.TRUTH, pb.Truth(t_ns=t, points=points), t, t)

    def joints(self, names: Sequence[str], t_ns: Ints, q: Floats) -> None:
        """Adds the robot's joints: (n,) instants and (n, nv) positions [rad]."""
        for t, row in zip(t_ns.tolist(), q.tolist(), strict=True):
            self._write(messages.JOINTS, pb.JointState(t_ns=t, names=names, q=row), t, t)

    def capsules(self, capsules: Capsules) -> None:
        """Adds the capsules of the robot's links, in the frame of its base."""
        for t, ends in zip(capsules.t_ns.tolist(), capsules.ends_m.tolist(), strict=True):
            row = [Capsule(p1=Point(**a), p2=Point(**b), r=capsules.radius_m) for a, b in _named_axes(ends)]
            self._write(messages.CAPSULES, RobotCapsules(t_ns=t, capsules=row), t, t)

    def _latch(self, topic: str, message: Any) -> None:
        self._latched.append((topic, message))

    def _release(self, log_ns: int) -> None:
        # Data that apply to the whole log get the time of nearby data, as another time would extend the span.
        latched, self._latched = self._latched, []
        for topic, message in latched:
            self._add(topic, message, log_ns, log_ns)

    def _write(self, topic: str, message: Any, log_ns: int, publish_ns: int) -> None:
        if self._latched:
            self._release(log_ns)
        self._last_ns = log_ns
        self._add(topic, message, log_ns, publish_ns)

    def _add(self, topic: str, message: Any, log_ns: int, publish_ns: int) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            schema = register_schema(self._writer, self._schemas, type(message))
            channel = self._writer.register_channel(topic, "protobuf", schema)
            self._channels[topic] = channel
        data = message.SerializeToString(deterministic=True)
        self._writer.add_message(channel, log_time=log_ns, publish_time=publish_ns, data=data)


def register_schema(writer: Writer, known: dict[str, int], kind: Any) -> int:
    """Returns the id of a protobuf message's schema in a log; registers it in ``known`` at its first use."""
    name = kind.DESCRIPTOR.full_name
    if name not in known:
        files = FileDescriptorSet()
        kind.DESCRIPTOR.file.CopyToProto(files.file.add())
        known[name] = writer.register_schema(name, "protobuf", files.SerializeToString(deterministic=True))
    return known[name]


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise SettingsError(f"{path}: exists already; name another file, or remove it")


#: First stamp for files without stamps. Not 0, as a stamp of zero means 'no stamp' in other logs.
START_NS = 1_000_000_000

#: Note on every format imported here: none contains the arrival time of a frame at a computer.
ARRIVAL_NOTE = "the files hold capture times only: arrival is taken as capture, as if there were no delay"

_CHUNK = 256  # number of rows written at once


class ImportedSkeleton(NamedTuple):
    """One body in one frame."""

    t_ns: int
    body: int
    points_m: Floats  # (20, 3) [m]
    confidence: Floats  # (20,)


#: Maximum length of a row; a tracker's row has a few kB [bytes].
_LINE_CHARACTERS = 1 << 20


def lines(path: Path, *, strip: bool = True) -> Iterator[tuple[str, str]]:
    """Yields lines of a text file, plain or gzipped, each with its position ``file:line``. Blank lines are skipped.

    Args:
        path: The file.
        strip: False: keep the blanks at both ends of a line, which are empty columns.

    Raises:
        LogError: The file is missing, is not text, or is empty.
    """
    number = 0
    try:
        with _open(path) as stream:
            for number, text in enumerate(iter(lambda: stream.readline(_LINE_CHARACTERS), ""), start=1):
                if len(text) == _LINE_CHARACTERS:
                    raise LogError(f"{path}:{number}: a line of over 1 MB; would be right: one row a frame")
                if text.strip():
                    yield f"{path}:{number}", text.strip() if strip else text.rstrip("\r\n")
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such file; name a recording") from error
    except UnicodeDecodeError as error:
        raise LogError(f"{path}:{number + 1}: not text; would be right: a text file, plain or .gz") from error
    except (OSError, EOFError) as error:
        raise LogError(f"{path}: cannot be read ({error}); would be right: a text file, plain or .gz") from error
    if number == 0:
        raise LogError(f"{path}: empty; would be right: one row a frame")


def _open(path: Path) -> IO[str]:
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding="utf-8")
    return path.open(encoding="utf-8")


def numbers(where: str, fields: list[str], count: int) -> Floats:
    """Converts the fields to numbers; ``nan`` means missing.

    Raises:
        LogError: The number of fields is wrong, or one is not a number.
    """
    if len(fields) != count:
        raise LogError(f"{where}: found {len(fields)} columns; would be right: {count}")
    try:
        return np.array(fields, dtype=np.float64)
    except ValueError:
        place = next(i for i, field in enumerate(fields) if not _is_number(field))
        raise LogError(f"{where}: column {place + 1}: found {fields[place]!r}; would be right: a number") from None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


#: Units of time stamps by their length [ns].
_UNITS: Mapping[int, str] = {1: "ns", 1000: "us", 10**6: "ms", 10**9: "s"}
_OWN_FRAME_NS = (4_000_000, 250_000_000)  # time between frames in the format's own unit: 4 to 250 Hz
_FRAME_NS = (15_000_000, 150_000_000)  # in another unit: 7 to 67 Hz
_ANY_FRAME_NS = (1_000_000, 10_000_000_000)  # in the own unit, where no other fits
_STAMPS = 400  # number of stamps used to find the unit
_FEW_STEPS = 5  # with fewer stamps, the unit is not determined


def time_unit_ns(path: Path, stamps: Iterable[str], own_ns: int) -> int:
    """Determines the unit of time of a file from the usual step between frames [ns].

    The format's own unit has priority if the step in it is plausible for a camera.

    Args:
        path: File, for messages.
        stamps: First time stamps of the file.
        own_ns: The format's own unit [ns].

    Raises:
        LogError: No unit gives plausible steps for a camera.
    """
    times = sorted({float(text) for text in stamps if _is_number(text)})
    steps = [after - before for before, after in itertools.pairwise(times)]
    if len(steps) < _FEW_STEPS:
        return own_ns
    step = statistics.median(steps)
    candidates = [(own_ns, _OWN_FRAME_NS), *((unit, _FRAME_NS) for unit in _UNITS), (own_ns, _ANY_FRAME_NS)]
    for unit, (least_ns, most_ns) in candidates:
        if least_ns <= step * unit <= most_ns:
            return unit
    raise LogError(
        f"{path}: time: found steps of {step:g} (median); would be right: {_unit_name(own_ns)}, or one of "
        f"{', '.join(_UNITS.values())} in which frames follow one another in {_FRAME_NS[0] / 1e9:g} to "
        f"{_FRAME_NS[1] / 1e9:g} s"
    )


def time_unit_note(camera: str, unit_ns: int, own_ns: int) -> str | None:
    """Returns a remark on times in another unit than the format's own."""
    if unit_ns == own_ns:
        return None
    taken, usual = _unit_name(unit_ns), _unit_name(own_ns)
    return f"camera {camera}: its times are taken as {taken}, by their steps, and not as {usual}"


def _unit_name(unit_ns: int) -> str:
    return _UNITS.get(unit_ns, f"{unit_ns} ns")


def time_stamp_ns(where: str, text: str, unit_ns: int, before_ns: int) -> int:
    """Reads a time stamp [ns], not negative and not before ``before_ns``.

    Args:
        where: ``file:line`` for messages.
        text: Time stamp in the file.
        unit_ns: Length of its unit [ns].
        before_ns: Time stamp of the previous row [ns].

    Raises:
        LogError: The text is not a number or, in units below a millisecond, not an integer; or the time is negative or
            goes backwards.
    """
    try:
        t_ns = int(Decimal(text) * unit_ns) if unit_ns >= 10**6 else int(text) * unit_ns
    except (ValueError, ArithmeticError):
        raise LogError(f"{where}: time: found {text!r}; would be right: a whole number") from None
    if t_ns < 0:
        raise LogError(f"{where}: time: found {text!r}; would be right: 0 or later")
    if t_ns < before_ns:
        raise LogError(f"{where}: time goes back by {(before_ns - t_ns) * 1e-9:g} s; would be right: rows in order")
    return t_ns


def skeleton_row(
    t_ns: int, body: int, found: Mapping[str, int] | list[int], points_m: Floats, confidence: Floats
) -> ImportedSkeleton:
    """Makes a row in the order of POINTS from a sensor's own joints; ``found`` gives their indices.

    Args:
        t_ns: Time of the frame [ns].
        body: Identity of the body.
        found: Index of the sensor's joint for each of POINTS, by name or in the order of POINTS.
        points_m: (k, 3) the sensor's joints [m].
        confidence: (k,) of the joints, in [0, 1].
    """
    index = [found[name] for name in POINTS] if isinstance(found, Mapping) else found
    points, trust = points_m[index], confidence[index]
    missing = ~np.isfinite(points).all(axis=1)
    points[missing], trust[missing] = np.nan, 0.0
    return ImportedSkeleton(t_ns, body, points, trust)


def write_log(
    sources: Mapping[str, Iterator[ImportedSkeleton]], out: Path, robot: Capsules | None = None
) -> dict[str, tuple[int, int]]:
    """Writes the rows of all cameras, merged by time, as a log; no file is left if a source fails.

    Args:
        sources: Camera -> its rows.
        out: Log to write.
        robot: Robot that was recorded, too.

    Returns:
        Camera -> first and last time [ns].

    Raises:
        SettingsError: ``out`` exists or cannot be written.
        LogError: A source cannot be read or has no row.
    """
    spans: dict[str, tuple[int, int]] = {}
    cameras = tuple(sources)
    with ExitStack() as stack:
        log = stack.enter_context(LogWriter(out))
        for name in cameras:
            log.camera(name, None)
        streams = [_numbered(i, stream) for i, stream in enumerate(sources.values())]
        merged = heapq.merge(*streams, key=lambda pair: (pair[1].t_ns, pair[0]))
        for batch in _batches(merged):
            log.frames(_frames(batch, cameras))
            for i, item in batch:
                spans[cameras[i]] = (spans.get(cameras[i], (item.t_ns, 0))[0], item.t_ns)
        empty = [name for name in cameras if name not in spans]
        if empty:
            raise LogError(f"camera {empty[0]}: no row with a body; would be right: one row a body a frame")
        if robot is not None:
            log.capsules(robot)
    return spans


def import_cameras(
    paths: Mapping[str, Path],
    out: Path,
    read: Callable[[Path, int], Iterator[ImportedSkeleton]],
    separator: str,
    own_ns: int,
) -> list[str]:
    """Makes a log from one file per camera with capture times.

    Args:
        paths: Camera -> file.
        out: Log to write.
        read: Function that yields the rows of a file, given the length of its time unit [ns].
        separator: Separator of the columns; time is the first.
        own_ns: The format's unit of time [ns].

    Returns:
        Remarks for the user.

    Raises:
        LogError: A file cannot be read in its format.
        SettingsError: ``out`` exists or cannot be written.
    """
    units = {name: time_unit_ns(path, _first_column(path, separator), own_ns) for name, path in paths.items()}
    spans = write_log({name: read(path, units[name]) for name, path in paths.items()}, out)
    told = [note for name, unit in units.items() if (note := time_unit_note(name, unit, own_ns)) is not None]
    return [ARRIVAL_NOTE, *told, *overlap_notes(spans)]


def _first_column(path: Path, separator: str) -> Iterator[str]:
    """Returns the first column of the first rows."""
    for _, text in itertools.islice(lines(path), _STAMPS):
        yield text.partition(separator)[0]


def overlap_notes(spans: Mapping[str, tuple[int, int]]) -> list[str]:
    """Returns a note for every camera whose times lie completely outside the first one's."""
    names = list(spans)
    start, end = spans[names[0]]
    return [
        f"camera {name}: its times do not overlap those of {names[0]}; are the clocks those of one session?"
        for name in names[1:]
        if spans[name][0] > end or spans[name][1] < start
    ]


def _numbered(index: int, stream: Iterator[ImportedSkeleton]) -> Iterator[tuple[int, ImportedSkeleton]]:
    return ((index, item) for item in stream)


def _batches(merged: Iterable[tuple[int, ImportedSkeleton]]) -> Iterator[list[tuple[int, ImportedSkeleton]]]:
    batch: list[tuple[int, ImportedSkeleton]] = []
    for pair in merged:
        # The bodies of one frame stay together.
        if len(batch) >= _CHUNK and pair[1].t_ns != batch[-1][1].t_ns:
            yield batch
            batch = []
        batch.append(pair)
    if batch:
        yield batch


def _frames(batch: list[tuple[int, ImportedSkeleton]], cameras: tuple[str, ...]) -> CameraFrames:
    t_ns = np.array([item.t_ns for _, item in batch], dtype=np.int64)
    return CameraFrames(
        capture_ns=t_ns,
        arrival_ns=t_ns,
        camera=np.array([i for i, _ in batch], dtype=np.int64),
        body=np.array([item.body for _, item in batch], dtype=np.int64),
        points_m=np.stack([item.points_m for _, item in batch]),
        confidence=np.stack([item.confidence for _, item in batch]),
        cameras=cameras,
    )
