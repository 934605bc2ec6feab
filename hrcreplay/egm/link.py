"""Our side of the EGM link: the state machine of its protocol, which has no clock and no socket, and the UDP server.

The robot numbers its packets. How a packet is treated follows from its number, ``ahead`` of the last:

- older by the robot's clock, and not 0: overtaken on the way, however long ago. Not answered.
- 1 to ``LEAP`` ahead, modulo 2**32: the next one; those between are lost.
- the same number, clock and stamp: a duplicate. Not answered, for a second answer waits in the robot's queue and adds
  delay.
- anything else, as 0, and any packet after a pause: a new session.

A session begins with an echo: the first answer is what the robot measured, at speed 0, whatever is asked for. So is
every answer while the robot may not move, since the last target is valid again as soon as it may.

The server is a blocking socket without a thread, because that has the shortest latency.
"""

from __future__ import annotations

import socket
import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import isfinite
from time import monotonic_ns
from typing import Final

import numpy as np

from hrcreplay.egm.codec import WRAP, Correction, Mci, Motors, Rapid, RobotPacket
from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.settings.sections import Live

#: Lost packets that a session survives: 4 s of them, far more than a silence allows.
LEAP: Final = 1000

#: Why a datagram is not answered. The first two refuse the robot, the others the datagram.
REFUSALS: Final = ("radians", "axes", "no packet", "stale", "duplicate")
#: Why an answered robot must not be moved.
STOPS: Final = ("motors off", "EGM error", "converged", "program stopped", "not answered yet", "utilization")
#: Every reason that ``classify`` gives.
REASONS: Final = (*REFUSALS, *STOPS)


@dataclass(frozen=True, slots=True)
class PacketStatus:
    """How a packet is to be treated.

    Attributes:
        answer: It is to be answered, at once.
        fresh: The answer will be an echo of the measured joints; blend from there. True from the first packet of a
            session, or from the first on which the robot may move again, until that echo is given.
        allowed: Motors on, EGM running, program not stopped. Of a datagram that is refused: what held before.
        reason: Empty, or one of ``REASONS``.
        ended: The robot has converged or left EGM: the session is over or about to be. To report, no failure.
        lost: Packets missing before this one.
    """

    answer: bool
    fresh: bool
    allowed: bool
    reason: str
    ended: bool
    lost: int


class EgmSession:
    """State of our side of the link with one robot, over any number of EGM sessions.

    ``counts`` has the packets and sessions received, those lost, and each refusal by its reason.
    """

    def __init__(
        self,
        q_min: Floats,
        q_max: Floats,
        dq_max: Floats,
        *,
        utilization_max: float = Live().utilization_max,
        utilization_packets: int = 5,
        silence_s: float = Live().silent_s,
    ) -> None:
        """Begin before the first packet.

        Args:
            q_min: (6,) smallest joints that are ever commanded [rad].
            q_max: (6,) largest ones [rad].
            dq_max: (6,) largest speed reference [rad/s].
            utilization_max: The robot cannot follow above this [%].
            utilization_packets: It must say so this often in a row, because a lost packet lets it flare up.
            silence_s: After a longer pause of the robot the session is a new one [s].
        """
        self.counts: Counter[str] = Counter()
        self._q_min, self._q_max, self._dq_max = q_min, q_max, dq_max
        self._utilization = (utilization_max, utilization_packets)
        self._silence_ns = round(silence_s * 1e9)
        self._last: RobotPacket | None = None
        self._last_ns = 0
        self._seqno = -1
        self._low, self._high = q_min, q_max
        self._due = self._fresh = self._allowed = self._answered = self._ran = False
        self._strained = 0

    def classify(self, packet: RobotPacket | None, t_ns: int) -> PacketStatus:
        """Take one datagram in order of arrival; None stands for one that is no packet."""
        if packet is None:
            return self._refuse("no packet")
        if packet.clock_ns is None:
            self._allowed = False
            return self._refuse("radians")
        if packet.q.shape != self._q_min.shape:
            self._allowed = False
            return self._refuse("axes")
        kind, lost = self._place(packet, t_ns)
        if kind in REFUSALS:
            return self._refuse(kind)
        if kind == "new":
            self._begin()
        self._last, self._last_ns, self._due = packet, t_ns, True
        self.counts["packets"] += 1
        self.counts["lost"] += lost
        return self._judge(packet, lost)

    def classify_all(self, packets: Iterable[RobotPacket | None], t_ns: int) -> tuple[PacketStatus, RobotPacket | None]:
        """Take a queue that built up, in order of arrival: one decision, and the packet to answer if there is one.

        The last datagram need not be that packet: it may be garbage, or overtaken by one before it.
        """
        newest, answered, lost, ended = None, None, 0, False
        heard = PacketStatus(answer=False, fresh=False, allowed=self._allowed, reason="no packet", ended=False, lost=0)
        for packet in packets:
            heard = self.classify(packet, t_ns)
            lost, ended = lost + heard.lost, ended or heard.ended
            if heard.answer:
                newest, answered = packet, heard
        return replace(answered or heard, lost=lost, ended=ended), newest

    def reply(self, q: Floats, dq: Floats, t_ns: int) -> Correction:
        """Answer the packet just classified. Returns what the robot is told, which may be less than what was asked for.

        Args:
            q: (6,) joints to be at [rad]. Held inside the limits, and a speed that leads out of them with it; where
                the echo itself was outside, the limits reach as far as it.
            dq: (6,) derivative of q [rad/s]. Held inside dq_max.
            t_ns: Now.

        Raises:
            ValueError: Nothing is due, or a joint is no finite number.
        """
        if not self._due or self._last is None:
            raise ValueError("reply: no packet is waiting for one; one answer each is right")
        finite = all(map(isfinite, (*q.tolist(), *dq.tolist())))
        if q.shape != self._q_min.shape or dq.shape != q.shape or not finite:
            raise ValueError(f"reply: {q} rad, {dq} rad/s; {len(self._q_min)} finite joints each are right")
        if self._fresh or not self._allowed:
            q, dq = self._last.q, np.zeros(len(q))
            self._low, self._high = np.minimum(self._q_min, q), np.maximum(self._q_max, q)
        else:
            dq = np.minimum(
                np.maximum(dq, np.where(q > self._low, -self._dq_max, 0.0)), np.where(q < self._high, self._dq_max, 0.0)
            )
            q = np.minimum(np.maximum(q, self._low), self._high)
        self._seqno = (self._seqno + 1) % WRAP
        self._due = self._fresh = False
        self._answered = True
        return Correction(seqno=self._seqno, tm_ms=t_ns // 1_000_000 % WRAP, q=q, dq=dq)

    def _place(self, packet: RobotPacket, t_ns: int) -> tuple[str, int]:
        """What the packet is to the conversation, "new", "next" or a refusal, and how many are missing before it."""
        last = self._last
        if last is None or t_ns - self._last_ns > self._silence_ns:
            return "new", 0
        if packet.seqno is None or last.seqno is None:
            return "next", 0
        older = (packet.clock_ns or 0) < (last.clock_ns or 0)
        if older and packet.seqno != 0:
            return "stale", 0
        ahead = (packet.seqno - last.seqno) % WRAP
        if 1 <= ahead <= LEAP:
            return "next", ahead - 1
        same = packet.clock_ns == last.clock_ns
        if ahead == 0 and same and packet.tm_ms == last.tm_ms:
            return "duplicate", 0
        return ("stale" if same and packet.seqno != 0 else "new"), 0

    def _begin(self) -> None:
        """Forget the last session. Our own counter goes on: the robot sees no gap that is none."""
        self.counts["sessions"] += 1
        self._fresh = True
        self._answered = self._ran = False
        self._strained = 0

    def _refuse(self, reason: str) -> PacketStatus:
        """Count a datagram that is not answered."""
        self.counts[reason] += 1
        return PacketStatus(answer=False, fresh=False, allowed=self._allowed, reason=reason, ended=False, lost=0)

    def _judge(self, packet: RobotPacket, lost: int) -> PacketStatus:
        """Whether the robot may be moved."""
        allowed = packet.motors == Motors.ON and packet.mci == Mci.RUNNING and packet.rapid != Rapid.STOPPED
        self._fresh = self._fresh or (allowed and not self._allowed)
        self._allowed = allowed
        self._ran = self._ran or packet.mci == Mci.RUNNING
        most, often = self._utilization
        self._strained = self._strained + 1 if packet.utilization > most else 0
        reason = "" if allowed else self._standing(packet)
        if allowed and self._strained >= often:
            reason = "utilization"
        ended = packet.converged or (self._ran and packet.mci != Mci.RUNNING)
        return PacketStatus(answer=True, fresh=self._fresh, allowed=allowed, reason=reason, ended=ended, lost=lost)

    def _standing(self, packet: RobotPacket) -> str:
        """Why the robot may not move. EGM does not run before the first answer: that is no stop."""
        if packet.motors != Motors.ON:
            return "motors off"
        if packet.mci == Mci.ERROR:
            return "EGM error"
        if packet.converged:
            return "converged"
        if packet.rapid == Rapid.STOPPED or self._answered or self._ran:
            return "program stopped"
        return "not answered yet"


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
