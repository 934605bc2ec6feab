"""The human side's process as control starts it, for the tests."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from types import TracebackType
from typing import Any, Self

from hrcreplay.logs import skeleton_pb2 as pb

PATIENCE_S = 600.0  # only a process that hangs takes so long


class Human:
    """A running human side. ``until`` reads its messages."""

    def __init__(self, *arguments: str) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.anchor_ns = time.time_ns() - time.monotonic_ns()
        with theirs:
            command = [sys.executable, "-m", "hrcreplay.live.person.source", "--fd", str(theirs.fileno())]
            self.process = subprocess.Popen(
                [*command, "--anchor", str(self.anchor_ns), *arguments],
                pass_fds=(theirs.fileno(),),
                start_new_session=True,
            )
        ours.settimeout(PATIENCE_S)
        self.socket = ours
        self.heard: list[tuple[int, bytes]] = []  #: arrival and message

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.socket.close()
        try:
            self.process.wait(PATIENCE_S)
        finally:
            self.process.kill()

    def now_ns(self) -> int:
        """Session time."""
        return time.monotonic_ns() + self.anchor_ns

    def until(self, kind: bytes, count: int = 1, text: bytes = b"") -> list[bytes]:
        """The next ``count`` payloads of a kind that begin with ``text``; all else is in ``heard``."""
        found: list[bytes] = []
        end = time.monotonic() + PATIENCE_S
        while len(found) < count and time.monotonic() < end:
            message = self.socket.recv(1 << 20)
            assert message, f"the process ended: {self.process.wait(PATIENCE_S)}"
            self.heard.append((self.now_ns(), message))
            if message[:1] == kind and message[1:].startswith(text):
                found.append(message[1:])
        assert len(found) == count
        return found

    def go(self, start_ns: int) -> None:
        """Starts the session."""
        self.socket.send(b"G" + start_ns.to_bytes(8, "little"))

    def notes(self) -> list[str]:
        """All notes so far."""
        return [message[1:].decode() for _, message in self.heard if message[:1] == b"N"]

    def skeletons(self) -> list[Any]:
        """All skeletons so far."""
        return [pb.Skeleton.FromString(message[1:]) for _, message in self.heard if message[:1] in b"fF"]
