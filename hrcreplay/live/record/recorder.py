"""The recorder process: writes the messages of control, in order, to a log that stays readable after a crash.

From control: the messages of ``codec``. To control: ``K`` once, when the file is open. Ends when control does, after it
has finished the file; when the file cannot be written, ends at once with a line on standard error and exit code 1.
Chunks are closed and handed to the operating system several times a second, so that a kill loses no more than that.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread
from typing import IO, Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.writer import CompressionType, Writer

from hrcreplay.egm import motion_link_pb2 as egm
from hrcreplay.live.record import codec
from hrcreplay.logs import messages as own
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.writer import register_schema

READY = b"K"
FLUSH_S = 0.2
_BATCH_S = 0.05
_CHUNK_BYTES = 1 << 20  # time closes chunks, not size
_NICE = 5  # control and the person come first
_LARGEST = 1 << 22  # of a message

_TYPES = {
    codec.ROBOT_TOPIC: egm.RobotMessage,
    codec.SENT_TOPIC: egm.SensorMessage,
    codec.UNSENT_TOPIC: egm.SensorMessage,
}


class SessionLogWriter:
    """The log of a session under way. Every message carries its number, so that a hole in the record shows."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile=own.PROFILE, library="hrcreplay")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._cameras: frozenset[str] = frozenset()
        self._count = 0

    def add(self, message: bytes) -> None:
        """Writes a message of ``codec``; the first event with cameras also fills the topics of the whole session."""
        t_ns = codec.clock_ns(message)
        topic, data = codec.topic_and_data(message)
        if topic == codec.STRAY_TOPIC:
            self._frame(t_ns, data)
            return
        self._write(topic, t_ns, t_ns, data, _TYPES.get(topic))
        if topic == codec.EVENT_TOPIC and not self._cameras:
            self._latch(t_ns, codec.decode_event(message))

    def flush(self) -> None:
        """Closes the chunk and hands all to the system. Raises OSError."""
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
            capture_ns = max(0, skeleton.capture_ns)  # MCAP has no time before 1970
            self._write(own.skeleton_topic(skeleton.camera), t_ns, capture_ns, data, pb.Skeleton)
        else:
            self._write(codec.STRAY_TOPIC, t_ns, t_ns, data)

    def _latch(self, t_ns: int, start: dict[str, Any]) -> None:
        cameras: dict[str, Any] = start.get("cameras", {})
        self._cameras = frozenset(name for name in cameras if "/" not in name)  # of a topic's name
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


class Inbox:
    """What came from control and is not written yet. A thread empties the socket, so that no disk makes it fill up."""

    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._waiting: deque[bytes] = deque()
        self.ended = Event()
        Thread(target=self._drain, daemon=True).start()

    def _drain(self) -> None:
        buffer = memoryview(bytearray(_LARGEST))
        try:
            while size := self._control.recv_into(buffer):
                self._waiting.append(bytes(buffer[:size]))
        except ConnectionResetError:
            pass  # control was killed
        self.ended.set()

    def take(self) -> list[bytes]:
        """Messages that have come since the last call."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]


def record(control: socket.socket, path: Path) -> None:
    """Writes a new log until control is gone.

    Raises:
        OSError: The file exists or cannot be written; what is written stays.
    """
    inbox = Inbox(control)
    with path.open("xb") as stream:
        writer = SessionLogWriter(stream)
        writer.flush()
        with suppress(BrokenPipeError):  # whoever is gone already may have left messages
            control.send(READY)
        due_s = time.monotonic() + FLUSH_S
        while not inbox.ended.wait(_BATCH_S):
            for message in inbox.take():
                writer.add(message)
            if time.monotonic() >= due_s:
                writer.flush()
                due_s = time.monotonic() + FLUSH_S - _BATCH_S
        for message in inbox.take():
            writer.add(message)
        writer.finish()


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the process."""
    parser = argparse.ArgumentParser(prog="hrcreplay.live.record.recorder")
    parser.add_argument("--fd", type=int, required=True)
    parser.add_argument("--path", type=Path, required=True)
    options = parser.parse_args(arguments)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the record ends when the session does, and not before
    os.nice(_NICE)
    try:
        record(socket.socket(fileno=options.fd), options.path)
    except OSError as error:
        sys.stderr.write(f"hrcreplay: {options.path}: the record cannot be written ({error.strerror})\n")
        sys.stderr.flush()
        os._exit(1)  # the interpreter would try to write the rest once more, and complain


if __name__ == "__main__":
    main()
