"""A helper process's end of its socket to the control loop: whole messages, and nobody ever waits for the other."""

from __future__ import annotations

import select
import socket

_LARGEST = 1 << 20  # no message is larger; one that is would be cut, never split


class ControlGoneError(Exception):
    """The control process closed its end, or is dead: the helper has nothing left to do."""


class Channel:
    """SOCK_SEQPACKET socket inherited from the control process; the first byte of a message is its kind."""

    def __init__(self, fd: int) -> None:
        self._socket = socket.socket(fileno=fd)
        self._socket.setblocking(False)
        self.dropped = 0  #: messages that control's full socket did not take

    def send(self, kind: bytes, payload: bytes = b"") -> bool:
        """Sends a message, or drops and counts it where control does not read; tells which.

        Raises:
            ControlGoneError: Nobody is at the other end.
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
        """The next message, None where none comes in time.

        Raises:
            ControlGoneError: Nobody is at the other end.
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
