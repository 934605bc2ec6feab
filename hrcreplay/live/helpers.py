"""The processes beside the control loop, and the sockets to them. Nothing here waits for any of them."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from hrcreplay.live import crash

#: Module through which every helper starts; see process.py.
ENTRY = "hrcreplay.live.process"

_LARGEST = 1 << 20  #: no message is larger
_BUFFER = 4 << 20  #: of messages under way: seconds of them
_AT_ONCE = 256  #: messages taken at once, so that a flood does not hold up the loop


class Helper:
    """A process of ours, with a socket whose far end it holds."""

    def __init__(
        self, part: str, module: str, arguments: Sequence[str], folder: Path, told: tuple[int, ...] = ()
    ) -> None:
        """Starts ``module --fd N arguments`` in a session of its own: Ctrl-C is for control alone.

        Args:
            part: Which part of the session it is, of crash.py.
            module: Module to run.
            arguments: Of it, beside the socket.
            folder: Where it leaves its traceback if it crashes.
            told: Exit codes beside 0 of a process that has told why it ends: no crash.
        """
        self.part = part
        self._folder = folder
        self._told = (0, *told)
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (near, far):
            _enlarge(end)
        near.setblocking(False)
        self._socket = near
        self.alive = True
        self.dropped = 0  #: messages that it did not take
        with far:
            self.process = subprocess.Popen(  # noqa: S603 - our own modules
                [sys.executable, "-m", ENTRY, str(folder), part, module, "--fd", str(far.fileno()), *arguments],
                pass_fds=(far.fileno(),),
                start_new_session=True,
                stdin=subprocess.DEVNULL,
            )

    def send(self, message: bytes) -> None:
        """Hands a message over, or drops and counts it."""
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
        """What it has said since."""
        for _ in range(_AT_ONCE):
            try:
                message = self._socket.recv(_LARGEST)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                message = b""
            if not message:
                self.alive = False
                return
            yield message

    def notice(self) -> bool:
        """Whether it is still there, for one that never says anything."""
        if self.alive:
            for _ in self.messages():
                pass
        return self.alive

    def crashed(self) -> bool:
        """Whether it has ended as nobody foresaw; no for one that lives, or is about to end."""
        return not self.alive and self.process.poll() not in (None, *self._told)

    def dismiss(self, patience_s: float) -> int | None:
        """Closes the socket, which ends the process; its exit code, None where it had to be killed.

        A process that crashed has left a file in the run folder; of one that could not, this leaves it.
        """
        self._socket.close()
        self.alive = False
        try:
            code = self.process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            return None
        if self.crashed() and not crash.left(self._folder, self.part):
            crash.write(self._folder, self.part, crash.end_of(code))
        return code


def _enlarge(end: socket.socket) -> None:
    """As large a buffer as we are permitted."""
    forced = getattr(socket, "SO_SNDBUFFORCE", 32)
    with contextlib.suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
    with contextlib.suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, forced, _BUFFER)


def take_precedence() -> list[str]:
    """Asks the system to run this process before others and to keep it in memory; returns what was refused."""
    import ctypes

    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    except (OSError, AttributeError):
        refused.append("real-time priority")
    lock_current_and_future = 3
    try:
        if ctypes.CDLL(None, use_errno=True).mlockall(lock_current_and_future):
            refused.append("locked memory")
    except (OSError, AttributeError):
        refused.append("locked memory")
    return refused


def step_back() -> None:
    """Ends what ``take_precedence`` asked for."""
    import ctypes

    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).munlockall()
