"""Playback of a recording as the source of skeletons: each frame is sent when it is due.

A thread reads ahead, so that no frame is late because of the file.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import Any, NamedTuple

from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.records import CameraFrames
from hrcreplay.settings.sections import Logs

_SEAM_NS = 40_000_000  # between the end of a recording and its repetition: about one frame
_AHEAD = 16  # chunks of at most a second each that wait decoded
_RETRY_NS = 1_000_000  # wait if the reading thread is behind

Outgoing = tuple[bytes, bytes]  #: kind and payload


class Frame(NamedTuple):
    """A body in a frame, in the recording's time."""

    arrival_ns: int
    skeleton: Any  #: hrcreplay.Skeleton


class Opened(NamedTuple):
    """Cameras and span of a recording, known before its first frame."""

    cameras: tuple[str, ...]
    start_ns: int
    end_ns: int


class Note(NamedTuple):
    """A note for the user, sent when the playback reaches its place in the recording."""

    text: str


Item = Opened | Note | list[Frame] | Exception | None  #: None: nothing follows


def playback_items(log: Log, *, repeat: bool) -> Iterator[Item]:
    """Reads a recording: its span, its frames chunk by chunk, and notes; in an endless loop with ``repeat``."""
    header = log.header
    yield Opened(header.cameras, header.start_ns, header.end_ns)
    newest: dict[str, int] = {}  # last capture of each camera in the previous passes
    later_ns = 0
    while True:
        captured = dict(newest)
        for table in log.frames(nobody=True):
            frames = [frame for frame in frames_of(table, later_ns) if _rises(frame, newest)]
            for frame in frames:
                camera = frame.skeleton.camera
                captured[camera] = max(captured.get(camera, frame.skeleton.capture_ns), frame.skeleton.capture_ns)
            yield frames
        if not later_ns:
            yield from (Note(f"recording: {text}") for text in log.notes)
        if not repeat or not captured:
            yield None
            return
        newest = captured
        later_ns += header.end_ns - header.start_ns + _SEAM_NS
        yield Note("recording starts again")


def _rises(frame: Frame, newest: dict[str, int]) -> bool:
    """Return whether a frame is captured after the last frame of the previous passes.

    The first frames of a pass may be captured earlier, because their delays may differ from those of the last frames.
    """
    before = newest.get(frame.skeleton.camera)
    return before is None or frame.skeleton.capture_ns > before


def frames_of(table: CameraFrames, later_ns: int = 0) -> Iterator[Frame]:
    """The rows of a table as messages; arrival and capture are delayed by ``later_ns`` [ns]."""
    points = table.points_m.reshape(len(table), -1)
    for i in range(len(table)):
        skeleton = pb.Skeleton(
            capture_ns=int(table.capture_ns[i]) + later_ns,
            camera=table.cameras[table.camera[i]],
            body=int(table.body[i]),
            points=points[i].tolist(),
            confidence=table.confidence[i].tolist(),
        )
        yield Frame(int(table.arrival_ns[i]) + later_ns, skeleton)


def same_frame(one: Frame, two: Frame) -> bool:
    """Return whether two bodies belong to the same frame; both must still be in the recording's time."""
    return (one.skeleton.camera, one.skeleton.capture_ns) == (two.skeleton.camera, two.skeleton.capture_ns)


def ready_note(cameras: tuple[str, ...]) -> Outgoing:
    """The note that tells control that the source is ready, with the names of its cameras."""
    return b"N", b"ready " + json.dumps({"cameras": list(cameras)}).encode()


class Playback:
    """Returns a recording's messages when they are due. A thread reads ahead; ``due`` never waits for it."""

    def __init__(self, reading: Callable[[], Iterator[Item]]) -> None:
        self._queue: Queue[Item] = Queue(_AHEAD)
        self._waiting: deque[Frame | Note] = deque()
        self._opened: Opened | None = None
        self._shift_ns: int | None = None  # from the recording's time to session time; None before ``go``
        self._end_ns = 0  # in the recording's time
        self._exhausted = self._ended = self._behind = False
        Thread(target=self._read, args=(reading,), name="reading ahead", daemon=True).start()

    def _read(self, reading: Callable[[], Iterator[Item]]) -> None:
        try:
            for item in reading():
                self._queue.put(item)
        except Exception as error:  # ``due`` raises it again
            self._queue.put(error)

    def go(self, start_ns: int) -> None:
        """Starts the playback: the first instant of the recording is ``start_ns`` in session time."""
        if self._opened is None:
            raise RuntimeError("go before ready")
        self._shift_ns = start_ns - self._opened.start_ns

    def due(self, now_ns: int) -> Iterator[Outgoing]:
        """The messages that are due.

        Raises:
            LogError: The recording, or the rest of it, cannot be read.
        """
        if self._opened is None:
            yield from self._open()
        if self._shift_ns is None:
            return
        while self._fill():
            head = self._waiting[0]
            if isinstance(head, Frame) and head.arrival_ns + self._shift_ns > now_ns:
                return
            self._waiting.popleft()
            if isinstance(head, Note):
                yield b"N", head.text.encode()
            else:
                more = self._waiting and isinstance(self._waiting[0], Frame) and same_frame(head, self._waiting[0])
                head.skeleton.capture_ns += self._shift_ns
                yield b"f" if more else b"F", head.skeleton.SerializeToString()
        if not self._exhausted and not self._behind:
            self._behind = True
            yield b"N", b"recording: reading is slower than its pace; frames come late"
        if self._exhausted and not self._ended and now_ns >= self._end_ns + self._shift_ns:
            self._ended = True
            yield b"N", b"recording ended"
            yield b"Z", b""

    def next_ns(self, now_ns: int) -> int | None:
        """Session time at which the next message is due; None before the start and after the end."""
        if self._shift_ns is None or self._ended:
            return None
        if self._waiting:
            head = self._waiting[0]
            return head.arrival_ns + self._shift_ns if isinstance(head, Frame) else now_ns
        return self._end_ns + self._shift_ns if self._exhausted else now_ns + _RETRY_NS

    def _open(self) -> Iterator[Outgoing]:
        try:
            opened = self._take()
        except Empty:
            return
        if isinstance(opened, Opened):
            self._opened = opened
            self._end_ns = opened.end_ns
            yield ready_note(opened.cameras)

    def _fill(self) -> bool:
        """Return whether a message is waiting; if none is, first takes the messages that have been read."""
        while not self._waiting and not self._exhausted:
            try:
                item = self._take()
            except Empty:
                return False
            if isinstance(item, list):
                self._waiting.extend(item)
                self._end_ns = max([self._end_ns, *(frame.arrival_ns for frame in item)])
            elif isinstance(item, Note):
                self._waiting.append(item)
            elif item is None:
                self._exhausted = True
        return bool(self._waiting)

    def _take(self) -> Item:
        item = self._queue.get_nowait()
        if isinstance(item, Exception):
            raise item
        return item


def play(path: Path, options: dict[str, Any], *, repeat: bool) -> Playback:
    """Plays a log of any kind.

    Args:
        path: The log.
        options: The settings' section ``logs``; may be empty.
        repeat: Whether the playback starts again at the end.
    """
    chosen = Logs.model_validate(options)
    return Playback(lambda: playback_items(open_log(path, chosen), repeat=repeat))
