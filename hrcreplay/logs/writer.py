"""Writes a log of our own format: MCAP with the messages of skeleton.proto, complete or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import CompressionType, Writer

from hrcreplay.errors import SettingsError
from hrcreplay.logs import messages
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.records import POINTS, CameraFrames, Floats, Ints

_CHUNK_BYTES = 256 * 1024  # some ten seconds of two cameras: small enough to seek by, large enough to compress


class LogWriter:
    """A log being written; it appears at ``path`` when the ``with`` block ends without an error.

    Frames, truth and joints may come in chunks, each track in order of time. Cameras keep the order in which they are
    declared. The same calls give the same bytes.

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
        )  # the library's version would change the bytes
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        """Finishes the file and puts it in its place, or removes what there is of it after an error."""
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
        self._temporary.chmod(0o666 & ~umask)  # mkstemp's 0600 would hide the log from colleagues
        _refuse_existing(self._path)  # it may have appeared meanwhile
        self._temporary.rename(self._path)

    def camera(self, name: str, T_world_camera: Floats | None = None) -> None:
        """Declares a camera, with its pose (4, 4) in the world where that is known."""
        if name in self._cameras or not name or "/" in name:
            raise SettingsError(f"camera {name!r}: declared twice, empty or with a slash; name each camera once")
        self._cameras.append(name)
        values = [] if T_world_camera is None else np.asarray(T_world_camera, dtype=np.float64).ravel().tolist()
        self._latch(messages.camera_info_topic(name), pb.Camera(camera=name, T_world_camera=values))

    def task(self, task: dict[str, Any]) -> None:
        """Adds the programmed task: a dictionary as a task file gives it."""
        self._latch(messages.TASK, pb.Task(json=json.dumps(task, sort_keys=True)))

    def base(self, T_world_base: Floats) -> None:
        """Adds the pose (4, 4) of the robot's base in the world."""
        self._latch(messages.BASE, pb.Base(T_world_base=np.asarray(T_world_base, dtype=np.float64).ravel().tolist()))

    def frames(self, frames: CameraFrames) -> None:
        """Adds camera frames; cameras not declared yet are declared, of unknown pose."""
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

    def _latch(self, topic: str, message: Any) -> None:
        self._latched.append((topic, message))

    def _release(self, log_ns: int) -> None:
        # What holds for the whole log gets the time of the data around it: a time of its own would stretch the span.
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
    """The id of a protobuf message's schema in a log; registered, and put down in ``known``, at its first use."""
    name = kind.DESCRIPTOR.full_name
    if name not in known:
        files = FileDescriptorSet()
        kind.DESCRIPTOR.file.CopyToProto(files.file.add())
        known[name] = writer.register_schema(name, "protobuf", files.SerializeToString(deterministic=True))
    return known[name]


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise SettingsError(f"{path}: exists already; name another file, or remove it")
