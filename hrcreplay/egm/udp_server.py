"""The UDP server that receives the robot's packets and sends the replies.

A blocking socket without a thread, because that has the shortest latency.
"""

from __future__ import annotations

import socket
import struct
from dataclasses import dataclass
from time import monotonic_ns
from typing import Final

from hrcreplay.errors import SettingsError

Address = tuple[str, int]

#: A robot's message has half a kilobyte and may grow; UDP carries no longer one than this.
_LONGEST: Final = 65536
#: A flood may fill the queue faster than it drains: no more of it than this at once.
_DRAIN: Final = 1024


@dataclass(frozen=True, slots=True)
class Received:
    """The datagrams that were in the socket's queue.

    Attributes:
        data: The newest datagram.
        older: Those of the same sender that arrived before it, in order; none of them is answered.
        sender: Where both came from.
        t_ns: Monotonic clock right after the first of them was taken.
        count: How many datagrams those are.
        waited: Whether they were there already when they were asked for: we are late.
    """

    data: bytes
    older: tuple[bytes, ...]
    sender: Address
    t_ns: int
    count: int
    waited: bool


class EgmServer:
    """The server's socket, used from one thread.

    Once a robot has been answered, other senders are not heard until it has been silent for the time-out: two robots
    on one port must not be mixed, nor a stray datagram take the answer of the robot.

    Attributes:
        port: The port in use, also where 0 was asked for.
        strangers: Datagrams of other senders, dropped.
        vanished: Answers that could not be sent, because the peer or the network was gone.
    """

    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        """Open the port.

        Args:
            host: Address of ours to listen on; "" for all.
            port: UDP port the robot calls; 0 takes any free one.
            timeout_s: Longest wait of ``newest`` [s].

        Raises:
            SettingsError: The port cannot be opened.
        """
        self._timeout_ns = round(timeout_s * 1e9)
        self._peer: Address | None = None
        self._heard_ns = 0
        self.strangers = self.vanished = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            where = f"EGM: UDP port {port} of {host or 'this machine'}"
            raise SettingsError(f"{where} cannot be opened ({error}); a free port of this machine is right") from None
        self.port: int = self._socket.getsockname()[1]

    def newest(self) -> Received | None:
        """Wait for a datagram, then empty the queue. None when nothing came within the time-out."""
        deadline_ns = monotonic_ns() + self._timeout_ns
        first = self._receive(socket.MSG_DONTWAIT)
        waited = first is not None
        while (left_ns := deadline_ns - monotonic_ns()) > 0:
            first = first or self._take(left_ns)
            if first is None:
                return None
            t_ns = monotonic_ns()
            received = self._choose([first, *self._drain()], t_ns, waited=waited)
            if received is not None:
                return received
            first, waited = None, False
        return None

    def answer(self, data: bytes, to: Address) -> None:
        """Send, and go on whatever becomes of it: the robot's silence shows what went wrong."""
        self._peer = to
        try:
            self._socket.sendto(data, socket.MSG_DONTWAIT, to)
        except OSError:
            self.vanished += 1

    def clear(self) -> None:
        """Discard the datagrams that are in the queue."""
        while self._drain():
            pass

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _take(self, wait_ns: int) -> tuple[bytes, Address] | None:
        """The next datagram within ``wait_ns``, if there is one. The kernel waits."""
        wait = struct.pack("ll", wait_ns // 1_000_000_000, max(1, wait_ns % 1_000_000_000 // 1000))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, wait)
        return self._receive(0)

    def _drain(self) -> list[tuple[bytes, Address]]:
        """All that is in the queue."""
        lot: list[tuple[bytes, Address]] = []
        while len(lot) < _DRAIN and (datagram := self._receive(socket.MSG_DONTWAIT)) is not None:
            lot.append(datagram)
        return lot

    def _receive(self, flags: int) -> tuple[bytes, Address] | None:
        """One datagram; None where there is none. An earlier answer's failure may be reported here: it is counted."""
        while True:
            try:
                return self._socket.recvfrom(_LONGEST, flags)
            except (BlockingIOError, TimeoutError):
                return None
            except ConnectionError:
                self.vanished += 1

    def _choose(self, lot: list[tuple[bytes, Address]], t_ns: int, *, waited: bool) -> Received | None:
        """Those of the robot we talk to, or of the last sender while we talk to none."""
        silent = t_ns - self._heard_ns >= self._timeout_ns
        if silent and all(address != self._peer for _, address in lot):
            self._peer = None
        sender = self._peer or lot[-1][1]
        own = [data for data, address in lot if address == sender]
        self.strangers += len(lot) - len(own)
        if not own:
            return None
        self._heard_ns = t_ns
        return Received(data=own[-1], older=tuple(own[:-1]), sender=sender, t_ns=t_ns, count=len(own), waited=waited)
