"""The helper processes of a live session: their start, their sockets, and their crash files.

Messages between control and a helper are never split, and neither side waits for the other. A message that the other
side does not receive is dropped and counted. Each helper runs as
``python -m hrcreplay.live.processes FOLDER PART MODULE arguments``.

An exception that ends a part of the session is written with its traceback to the run folder and not shown on the
user's terminal. Control detects that the process has ended, brakes the robot and reports the crash. The first line of
``crash_<part>.txt`` names the part, the exception and its place; the user's message and run.json contain the same line.
A crash may also be a process that ended without an exception.
"""

from __future__ import annotations

import os
import runpy
import select
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from signal import Signals
from typing import NoReturn

import hrcreplay

#: The parts of a session. The first three processes are helpers of control.
PERSON, RECORDER, SCREEN, CONTROL, FOLDER = "human side", "recorder", "screen", "control", "run folder"

#: Prefix of the names of crash files.
PREFIX = "crash_"

_PACKAGE = Path(hrcreplay.__file__).parent


def describe_exception(error: BaseException) -> str:
    """An exception in one line: its type, its message, and its place in the code of hrcreplay."""
    message = " ".join(str(error).split())
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if Path(frame.filename).is_relative_to(_PACKAGE)]
    name = type(error).__name__ + (f": {message}" if message else "")
    for frame in (ours or frames)[-1:]:
        path = Path(frame.filename)
        where = path.relative_to(_PACKAGE.parent).as_posix() if ours else path.name
        return f"{name} ({where}:{frame.lineno}, in {frame.name})"
    return name


def describe_exit(code: int) -> str:
    """Describes the end of a process without a crash file: its signal or its exit code."""
    if code >= 0:
        return f"ended with exit code {code}"
    with suppress(ValueError):
        return f"killed by {Signals(-code).name}"
    return f"killed by signal {-code}"


def write_crash(folder: Path, part: str, error: BaseException | str) -> str:
    """Writes a crash to the crash file of a part, after earlier crashes of the same part.

    Returns:
        Description of the crash in one line, as in ``read_crashes``.
    """
    said = f"{part}: {error if isinstance(error, str) else describe_exception(error)}"
    trace = "" if isinstance(error, str) else "".join(traceback.format_exception(error))
    try:
        with _file(folder, part).open("a") as file:
            file.write(f"{said}\n\n{trace}")
    except OSError:
        with suppress(OSError):  # a full disk leaves an empty file
            if not _file(folder, part).stat().st_size:
                _file(folder, part).unlink()
        sys.stderr.write(f"{said}\n{trace}")  # the only place left
        sys.stderr.flush()
    return said


def read_crashes(folder: Path) -> list[str]:
    """Describes the crashes in a session's folder, one line per part."""
    lines = []
    for path in sorted(folder.glob(f"{PREFIX}*.txt")):
        text = path.read_text(errors="replace").splitlines()
        lines.append(text[0] if text else path.name)
    return lines


def has_crash_file(folder: Path, part: str) -> bool:
    """Return whether a part has a crash file."""
    return _file(folder, part).exists()


def _file(folder: Path, part: str) -> Path:
    return folder / f"{PREFIX}{part.replace(' ', '_')}.txt"


_LARGEST = 1 << 20  #: largest size of a message [bytes]; a larger message would be cut off
_LARGEST_RECORD = 1 << 22  #: largest size of a message to the recorder [bytes]


#: First byte of the last message of a helper that has failed; the reason in UTF-8 follows.
LAST_WORDS = b"X"


class ControlGoneError(Exception):
    """The control process has closed its end or has died; the helper must end."""


class ControlChannel:
    """SOCK_SEQPACKET socket inherited from the control process; the first byte of a message is its kind."""

    def __init__(self, fd: int) -> None:
        self._socket = socket.socket(fileno=fd)
        self._socket.setblocking(False)
        self.dropped = 0  #: number of messages that were dropped because control's socket was full

    def send(self, kind: bytes, payload: bytes = b"") -> bool:
        """Sends a message; if control does not read, drops and counts it and returns False.

        Raises:
            ControlGoneError: Control has ended.
        """
        try:
            self._socket.send(kind + payload)
        except (BlockingIOError, InterruptedError):
            self.dropped += 1
            return False
        except (BrokenPipeError, ConnectionResetError) as error:
            raise ControlGoneError from error
        return True

    def receive(self, timeout_s: float) -> bytes | None:
        """The next message; None if no message comes in time.

        Raises:
            ControlGoneError: Control has ended.
        """
        readable, _, _ = select.select([self._socket], [], [], max(0.0, timeout_s))  # unlike poll, finer than 1 ms
        if not readable:
            return None
        try:
            data = self._socket.recv(_LARGEST)
        except BlockingIOError:
            return None
        except ConnectionResetError as error:
            raise ControlGoneError from error
        if not data:
            raise ControlGoneError
        return data


#: Time between two looks into the socket [s]. While the thread sleeps, control need not wake it with each message.
_PAUSE_S = 0.005


class Inbox:
    """Messages from control that are not written yet; a thread empties the socket even if the disk is slow."""

    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._waiting: deque[bytes] = deque()
        self.ended = threading.Event()
        threading.Thread(target=self._drain, daemon=True).start()

    def _drain(self) -> None:
        buffer = memoryview(bytearray(_LARGEST_RECORD))
        try:
            while size := self._control.recv_into(buffer):
                while size:
                    self._waiting.append(bytes(buffer[:size]))
                    size = self._at_once(buffer)
                time.sleep(_PAUSE_S)
        except ConnectionResetError:
            pass  # control was killed
        self.ended.set()

    def _at_once(self, buffer: memoryview) -> int:
        """Size of the next message, which is then in the buffer; 0 if none has come yet, or if control has ended."""
        try:
            return self._control.recv_into(buffer, 0, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return 0

    def take(self) -> list[bytes]:
        """Messages that have arrived since the last call."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]


#: Module through which every helper starts; see ``main``.
ENTRY = "hrcreplay.live.processes"

_BUFFER = 4 << 20  #: socket buffer [bytes], for some seconds of messages
_AT_ONCE = 256  #: largest number of messages read at once, so that many messages do not delay the loop


class HelperProcess:
    """A helper process and control's end of the socket to it."""

    def __init__(
        self, part: str, module: str, arguments: Sequence[str], folder: Path, expected: tuple[int, ...] = ()
    ) -> None:
        """Starts ``module --fd N arguments`` in a separate process session, so that only control gets Ctrl-C.

        Args:
            part: Part of the live session: PERSON, RECORDER or SCREEN.
            module: Module to run.
            arguments: Arguments of the module, without the socket.
            folder: Folder for its crash file.
            expected: Exit codes besides 0 that are no crash, because the process has reported its reason.
        """
        self.part = part
        self._folder = folder
        self._told = (0, *expected)
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (near, far):
            _enlarge(end)
        near.setblocking(False)
        self._socket = near
        self._buffer = memoryview(bytearray(_LARGEST))  # kept, since a new one for each message takes time
        self.alive = True
        self.dropped = 0  #: number of messages that were dropped
        self.last_words = ""  #: the reason for its end, if it has sent one
        self.crash = ""  #: description of its crash, after ``close``
        with far:
            self.process = subprocess.Popen(  # noqa: S603 - our own modules
                [sys.executable, "-m", ENTRY, str(folder), part, module, "--fd", str(far.fileno()), *arguments],
                pass_fds=(far.fileno(),),
                start_new_session=True,
                stdin=subprocess.DEVNULL,
            )

    def send(self, message: bytes) -> None:
        """Sends a message, or drops and counts it."""
        if not self.alive:
            self.dropped += 1
            return
        try:
            self._socket.send(message)
        except (BlockingIOError, InterruptedError):
            self.dropped += 1
        except OSError as error:
            self.dropped += 1
            if isinstance(error, ConnectionError):
                self.alive = False

    def messages(self) -> Iterator[bytes]:
        """Messages that have arrived since the last call."""
        for _ in range(_AT_ONCE):
            try:
                size = self._socket.recv_into(self._buffer)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                size = 0
            message = bytes(self._buffer[:size])
            if not message:
                self.alive = False
                return
            if message[:1] == LAST_WORDS:
                self.last_words = message[1:].decode(errors="replace")
            else:
                yield message

    def crashed(self) -> bool:
        """Return whether it has ended with an unexpected exit code; False while it runs or is ending."""
        return not self.alive and self.process.poll() not in (None, *self._told)

    def close(self, patience_s: float) -> int | None:
        """Closes the socket, which ends the process; returns its exit code, None if it had to be killed.

        If the process crashed and could not write a crash file, this method writes it.
        """
        for _ in self.messages():
            pass  # the last message may contain the reason
        self._socket.close()
        self.alive = False
        try:
            code = self.process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            return None
        if self.crashed() and not has_crash_file(self._folder, self.part):
            self.crash = write_crash(self._folder, self.part, self.last_words or describe_exit(code))
        return code


def _enlarge(end: socket.socket) -> None:
    """Sets the send buffer to the largest size that the system permits."""
    forced = getattr(socket, "SO_SNDBUFFORCE", 32)
    with suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
    with suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, forced, _BUFFER)


#: Exit code of a process that crashed; in sysexits.h it means an internal error.
CRASHED = 70


def main() -> None:
    """Runs a module as ``python -m`` does."""
    folder, part, module, *arguments = sys.argv[1:]

    def die(error: BaseException) -> NoReturn:
        write_crash(Path(folder), part, error)
        os._exit(CRASHED)  # other threads may wait for the failed thread forever

    threading.excepthook = lambda raised: die(raised.exc_value or SystemError("a thread ended without a reason"))
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except Exception as error:  # write every crash to its file
        die(error)


if __name__ == "__main__":
    main()
