"""The client side of the EGM link: the state machine of its protocol, without clock and socket, and the UDP server.

The robot numbers its packets. The treatment of a packet depends on how far its number is ahead of the last one:

- older by the robot's clock, and not 0: overtaken on the way, at any age. Not answered.
- 1 to ``LEAP`` ahead, modulo 2**32: the next packet; those in between are lost.
- the same number, clock and stamp: a duplicate. Not answered, as a second answer would wait in the robot's queue and
add delay.
- any packet after a pause: a new session.
- anything else, such as 0: either a restarted robot or another sender with its address. It raises an alarm, and becomes
a new session only after packets that follow it arrive without others.

Joints that the axes cannot have reached since the last packet also raise an alarm and are never used. A packet with an
alarm is answered by the motion under way, which is a stop, and never by an echo.

A session after a pause begins with an echo: the first answer contains the measured joints at speed 0, for any requested
motion. Every answer while the robot may not move is also an echo, since its last target becomes valid again once it may
move. The step from one echo to the next is limited to the motion that the axes can make in the time between; the rest
follows with the next echoes.

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

#: Maximum number of lost packets within a session: 4 s, far more than the allowed silence.
LEAP: Final = 1000

#: Reasons not to answer a datagram. The first two concern the robot, the others the datagram.
REFUSALS: Final = ("radians", "axes", "no packet", "stale", "duplicate")
#: Reasons not to move a robot that is answered.
STOPS: Final = ("motors off", "EGM error", "converged", "program stopped", "not answered yet", "utilization")
#: Signs of another sender with the robot's address.
RESTARTED: Final = "robot restarted"
JUMPED: Final = "joints jump"
OTHER: Final = "another robot"
ALARMS: Final = (RESTARTED, JUMPED, OTHER)
#: All reasons that ``classify`` returns.
REASONS: Final = (*REFUSALS, *STOPS, *ALARMS)

#: Tolerance of measured joints beyond the limits: this share of the speed, and noise [rad].
_FASTER, _NOISE_RAD = 1.1, 0.01
#: Maximum distance of measured joints outside the range of the axes; larger ones are invalid [rad].
_OUTSIDE_RAD = 1.0
#: Maximum number of lost packets during which the axes may have moved.
_MISSED = 25
#: Number of cycles after the last answer at which a packet with an alarm is answered, so that it does not add to the
#: answer to the robot itself.
_APART = 0.75
#: Number of cycles without other packets after which a new session without a pause is accepted.
_ALONE = 1.5
#: Largest difference between the rates of the robot's clock and ours, far beyond that of any quartz.
_DRIFT = 1e-3


@dataclass(frozen=True, slots=True)
class PacketStatus:
    """Classification of a received packet.

    Attributes:
        answer: True: answer it, at once.
        fresh: True: the answer will be an echo of the measured joints; blend from there. True from the first packet of
            a session, or from the first packet with which the robot may move again, until that echo is sent.
        allowed: Motors on, EGM running, program not stopped. For a rejected datagram: the last value.
        reason: Empty, or one of ``REASONS``.
        ended: The robot has converged or left EGM: the session ends. Reported, but not an error.
        lost: Packets missing before this one.
    """

    answer: bool
    fresh: bool
    allowed: bool
    reason: str
    ended: bool
    lost: int


class EgmSession:
    """State of the client side of the link with one robot, over any number of EGM sessions.

    ``counts`` contains the numbers of received packets and sessions, lost packets, and rejections by reason.
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
        cycle_s: float = Live().cycle_s,
    ) -> None:
        """Starts before the first packet.

        Args:
            q_min: (n,) lower limits of commanded joints [rad].
            q_max: (n,) upper limits [rad].
            dq_max: (n,) limit of the speed reference, and top speed of the axes [rad/s].
            utilization_max: The robot cannot follow above this [%].
            utilization_packets: Number of consecutive packets above that limit, because a lost packet causes a short
                peak.
            silence_s: After a longer pause of the robot a new session begins [s].
            cycle_s: The robot's cycle [s].
        """
        self.counts: Counter[str] = Counter()
        self._q_min, self._q_max, self._dq_max = q_min, q_max, dq_max
        self._utilization = (utilization_max, utilization_packets)
        self._silence_ns = round(silence_s * 1e9)
        self._cycle_s = cycle_s
        self._last: RobotPacket | None = None  # last accepted packet
        self._last_ns = self._heard_ns = 0  # when that packet came, and arrival of the last answered one
        self._delay_ns: int | None = None  # smallest difference between an arrival and the robot's clock
        self._rival: RobotPacket | None = None  # packet of a possible new session
        self._rival_ns = 0  # arrival of its first packet
        self._alarm = ""  # reason of an alarm since the last answer
        self._seqno = -1
        self._told: Floats | None = None
        self._told_ns = 0
        self._limits = self._limits_of(q_min, q_max)
        self._due = self._fresh = self._allowed = self._answered = self._ran = False
        self._strained = 0

    def classify(self, packet: RobotPacket | None, t_ns: int) -> PacketStatus:
        """Takes one datagram in order of arrival; None for an invalid one."""
        if packet is None:
            return self._refuse("no packet")
        other = "radians" if packet.clock_ns is None else "axes" if packet.q.shape != self._q_min.shape else ""
        if other and self._live(t_ns):
            return self._doubt(OTHER, packet, t_ns)
        if other:
            self._allowed = False
            return self._refuse(other)
        kind, lost = self._place(packet, t_ns)
        if kind in REFUSALS:
            return self._refuse(kind)
        if kind in ALARMS:
            return self._doubt(kind, packet, t_ns)
        if kind in ("new", "again"):
            self._begin(echo=kind == "new")
        self._last, self._last_ns, self._heard_ns = packet, self._came_ns(packet, t_ns), t_ns
        self._rival, self._due = None, True
        self.counts["packets"] += 1
        self.counts["lost"] += lost
        return self._judge(packet, lost)

    def classify_all(self, packets: Iterable[RobotPacket | None], t_ns: int) -> tuple[PacketStatus, RobotPacket | None]:
        """Takes all datagrams of the queue, in order of arrival; returns one decision, and the packet to answer if any.

        That packet is not always the last datagram, which may be garbage or older than the one before it.
        """
        newest, answered, lost, ended = None, None, 0, False
        heard = PacketStatus(answer=False, fresh=False, allowed=self._allowed, reason="no packet", ended=False, lost=0)
        for packet in packets:
            heard = self.classify(packet, t_ns)
            lost, ended = lost + heard.lost, ended or heard.ended
            if heard.answer:
                newest, answered = packet, heard
        found = answered or heard
        reason = self._alarm or found.reason
        if (lost, ended, reason) != (found.lost, found.ended, found.reason):
            found = replace(found, lost=lost, ended=ended, reason=reason)
        return found, newest

    def reply(self, q: Floats, dq: Floats, t_ns: int) -> Correction:
        """Answers the packet just classified. Returns the sent joints, which may be limited.

        Args:
            q: (n,) target joints [rad]. They are clamped to the limits, and so is a speed that leads out of them; if
                the echo itself was outside, the limits are extended to it.
            dq: (n,) derivative of q [rad/s], clamped to dq_max.
            t_ns: Now.

        Raises:
            ValueError: No packet waits for an answer, or a joint is not finite.
        """
        if not self._due or self._last is None:
            raise ValueError("reply: no packet is waiting for one; one answer each is right")
        finite = all(map(isfinite, (*q.tolist(), *dq.tolist())))
        if q.shape != self._q_min.shape or dq.shape != q.shape or not finite:
            raise ValueError(f"reply: {q} rad, {dq} rad/s; {len(self._q_min)} finite joints each are right")
        if self._fresh or not self._allowed:
            q, dq = self._towards(self._last.q, t_ns), np.zeros(len(q))
            self._limits = self._limits_of(np.minimum(self._q_min, q), np.maximum(self._q_max, q))
            self._fresh = self._fresh and not np.array_equal(q, self._last.q)
        else:
            q, dq = self._held(q, dq)
        self._seqno = (self._seqno + 1) % WRAP
        self._due, self._answered, self._alarm = False, True, ""
        self._told, self._told_ns = q, t_ns
        return Correction(seqno=self._seqno, tm_ms=t_ns // 1_000_000 % WRAP, q=q, dq=dq)

    def _limits_of(self, low: Floats, high: Floats) -> list[tuple[float, float, float]]:
        """Lowest and highest joint [rad] and top speed [rad/s] of each axis, as plain floats.

        With arrays of six numbers the answer leaves 0.02 ms later.
        """
        return list(zip(low.tolist(), high.tolist(), self._dq_max.tolist(), strict=True))

    def _held(self, q: Floats, dq: Floats) -> tuple[Floats, Floats]:
        """Joints and speeds inside the limits; a speed that leads out of the range is 0."""
        wanted = list(zip(q.tolist(), dq.tolist(), self._limits, strict=True))
        held = [
            (
                min(max(at, low), high),
                min(max(v, -most if at > low else 0.0), most if at < high else 0.0),
            )
            for at, v, (low, high, most) in wanted
        ]
        if all(at == to and v == speed for (at, v, _), (to, speed) in zip(wanted, held, strict=True)):
            return q, dq
        return np.array([to for to, _ in held]), np.array([speed for _, speed in held])

    def _place(self, packet: RobotPacket, t_ns: int) -> tuple[str, int]:
        """Returns the relation of the packet to the session, and the number of packets missing before it.

        Returns:
            "new" after a pause, "next", "again" if it confirms its predecessor as a new session, a rejection or an
            alarm.
        """
        if self._last is None:
            outside = np.maximum(self._q_min - packet.q, packet.q - self._q_max)
            return "new" if np.all(outside <= _OUTSIDE_RAD) else JUMPED, 0
        paused = t_ns - self._heard_ns > self._silence_ns
        kind, lost = ("new", 0) if paused else _follows(packet, self._last)
        if kind == "next" and self._hurries(packet, lost, t_ns):
            kind = RESTARTED
        if kind in ("stale", RESTARTED) and self._follows_rival(packet):
            kind = "again" if t_ns - self._rival_ns >= _ALONE * self._cycle_s * 1e9 else RESTARTED
        if kind not in REFUSALS and not self._reaches(packet.q, lost, t_ns):
            kind = JUMPED
        return kind, lost

    def _came_ns(self, packet: RobotPacket, t_ns: int) -> int:
        """When an accepted packet came [ns]; by the robot's clock, as this computer may have read it late.

        The time in which the axes may have moved until the next packet begins there. If it began when a late packet was
        read, the next one, which is in time, would seem to hurry.
        """
        if packet.clock_ns is None:
            return t_ns
        delay_ns = t_ns - packet.clock_ns
        if self._delay_ns is not None:
            delay_ns = min(delay_ns, self._delay_ns + round(_DRIFT * (t_ns - self._heard_ns)))
        self._delay_ns = delay_ns
        return max(packet.clock_ns + delay_ns, t_ns - self._silence_ns)

    def _live(self, t_ns: int) -> bool:
        """Returns True if a robot is being answered."""
        return self._answered and t_ns - self._heard_ns <= self._silence_ns

    def _follows_rival(self, packet: RobotPacket) -> bool:
        """Returns True if the packet continues a possible new session."""
        return self._rival is not None and _follows(packet, self._rival)[0] == "next"

    def _passed_s(self, lost: int, t_ns: int) -> float:
        """Returns the maximum time on the robot's side since the last accepted packet [s]."""
        cycles = 2 + min(lost, _MISSED)  # packets of a queue arrive at once, and arrivals vary
        return (t_ns - self._last_ns) * 1e-9 + cycles * self._cycle_s

    def _reaches(self, q: Floats, lost: int, t_ns: int) -> bool:
        """Returns True if the axes can have reached q (n,) [rad] since then."""
        assert self._last is not None  # noqa: S101 - for the type checker
        passed_s = _FASTER * self._passed_s(lost, t_ns)
        moves = zip(q.tolist(), self._last.q.tolist(), self._dq_max.tolist(), strict=True)
        return all(abs(now - before) <= most * passed_s + _NOISE_RAD for now, before, most in moves)

    def _hurries(self, packet: RobotPacket, lost: int, t_ns: int) -> bool:
        """Returns True if its clock runs ahead; if it were accepted, packets of the robot itself would look old."""
        if packet.clock_ns is None or self._last is None or self._last.clock_ns is None:
            return False
        return (packet.clock_ns - self._last.clock_ns) * 1e-9 > self._passed_s(lost, t_ns)

    def _towards(self, q: Floats, t_ns: int) -> Floats:
        """Returns joints q (n,) [rad], limited to the motion that the axes can make since the last answer."""
        if self._told is None:
            return q
        reach = self._dq_max * max(self._cycle_s, (t_ns - self._told_ns) * 1e-9)
        way = q - self._told
        return np.where(np.abs(way) <= reach, q, self._told + np.clip(way, -reach, reach))

    def _doubt(self, alarm: str, packet: RobotPacket, t_ns: int) -> PacketStatus:
        """Handles a packet that is not accepted: it is answered as if it contained nothing new."""
        self.counts[alarm] += 1
        self._alarm = alarm
        if alarm == RESTARTED:
            self._rival_ns = self._rival_ns if self._follows_rival(packet) else t_ns
            self._rival = packet
        beside = t_ns - self._told_ns < _APART * self._cycle_s * 1e9
        if beside or alarm == OTHER or not self._live(t_ns):
            return PacketStatus(False, fresh=False, allowed=self._allowed, reason=alarm, ended=False, lost=0)
        self._heard_ns, self._due = t_ns, True
        return PacketStatus(True, fresh=False, allowed=self._allowed, reason=alarm, ended=False, lost=0)

    def _begin(self, *, echo: bool) -> None:
        """Resets the session. The counter of the answers continues, so that the robot sees no gap."""
        self.counts["sessions"] += 1
        self._fresh = echo
        self._delay_ns = None
        self._answered = self._ran = False
        self._strained = 0

    def _refuse(self, reason: str) -> PacketStatus:
        """Counts a datagram that is not answered."""
        self.counts[reason] += 1
        return PacketStatus(answer=False, fresh=False, allowed=self._allowed, reason=reason, ended=False, lost=0)

    def _judge(self, packet: RobotPacket, lost: int) -> PacketStatus:
        """Returns True if the robot may be moved."""
        allowed = packet.motors == Motors.ON and packet.mci == Mci.RUNNING and packet.rapid != Rapid.STOPPED
        self._fresh = self._fresh or (allowed and not self._allowed)
        self._allowed = allowed
        self._ran = self._ran or packet.mci == Mci.RUNNING
        most, often = self._utilization
        self._strained = self._strained + 1 if packet.utilization > most else 0
        reason = self._alarm or ("" if allowed else self._standing(packet))
        if not reason and self._strained >= often:
            reason = "utilization"
        ended = packet.converged or (self._ran and packet.mci != Mci.RUNNING)
        return PacketStatus(answer=True, fresh=self._fresh, allowed=allowed, reason=reason, ended=ended, lost=lost)

    def _standing(self, packet: RobotPacket) -> str:
        """Returns the reason not to move the robot. EGM does not run before the first answer; this is not a stop."""
        if packet.motors != Motors.ON:
            return "motors off"
        if packet.mci == Mci.ERROR:
            return "EGM error"
        if packet.converged:
            return "converged"
        if packet.rapid == Rapid.STOPPED or self._answered or self._ran:
            return "program stopped"
        return "not answered yet"


def _follows(packet: RobotPacket, last: RobotPacket) -> tuple[str, int]:
    """Returns the relation of a packet to an earlier one: "next", a rejection or a restart, and the packets missing."""
    if packet.seqno is None or last.seqno is None:
        return "next", 0
    if (packet.clock_ns or 0) < (last.clock_ns or 0) and packet.seqno != 0:
        return "stale", 0
    ahead = (packet.seqno - last.seqno) % WRAP
    if 1 <= ahead <= LEAP:
        return "next", ahead - 1
    same = packet.clock_ns == last.clock_ns
    if ahead == 0 and same and packet.tm_ms == last.tm_ms:
        return "duplicate", 0
    return ("stale" if same and packet.seqno != 0 else RESTARTED), 0


Address = tuple[str, int]

#: Maximum size of a UDP datagram; a robot's message has 0.5 kB and may grow.
_LONGEST: Final = 65536
#: Maximum number of datagrams read at once, as a flood may fill the queue faster than it is emptied.
_DRAIN: Final = 1024


@dataclass(frozen=True, slots=True)
class Received:
    """The datagrams that were in the socket's queue.

    Attributes:
        data: The newest datagram.
        older: Earlier ones of the same sender, in order; none of them is answered.
        sender: Address of the sender.
        t_ns: Monotonic clock right after the first of them was read.
        count: Number of these datagrams.
    """

    data: bytes
    older: tuple[bytes, ...]
    sender: Address
    t_ns: int
    count: int


#: Maximum number of other senders that are stored for reports.
_STRANGERS: Final = 4


class EgmServer:
    """The server's socket, used from one thread. It accepts one address and, within a session, one port.

    A robot whose session has ended by a silence may use another port.

    Attributes:
        port: The port in use, also if 0 was requested.
        robot: The only accepted address.
        strangers: Datagrams of other senders, dropped.
        vanished: Number of answers that could not be sent, because the peer or the network was unavailable.
    """

    def __init__(self, host: str, port: int, timeout_s: float, *, robot: str, silence_s: float) -> None:
        """Opens the port.

        Args:
            host: Local address to listen on; "" for the one on the network of the robot.
            port: UDP port that the robot uses; 0 takes any free one.
            timeout_s: Longest wait of ``newest`` [s].
            robot: IPv4 address of the robot.
            silence_s: After a longer pause of the robot its session is over [s].

        Raises:
            SettingsError: The port cannot be opened, or no network leads to the robot.
        """
        self._timeout_ns, self._silence_ns = round(timeout_s * 1e9), round(silence_s * 1e9)
        self._peer: Address | None = None
        self._heard_ns = 0
        self._seen: list[Address] = []
        self.robot = robot
        self.strangers = self.vanished = 0
        host = host or _own_address(robot)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise SettingsError(
                f"EGM: UDP port {port} of {host} cannot be opened ({error}); a free port of this machine is right"
            ) from None
        self.port: int = self._socket.getsockname()[1]

    def strangers_seen(self) -> list[Address]:
        """The first ignored senders, in order."""
        return self._seen

    def newest(self) -> Received | None:
        """Waits for a datagram, then empties the queue; None if nothing arrives within the time-out."""
        deadline_ns = monotonic_ns() + self._timeout_ns
        while (left_ns := deadline_ns - monotonic_ns()) > 0 and (first := self._take(left_ns)) is not None:
            t_ns = monotonic_ns()
            received = self._choose([first, *self._drain()], t_ns)
            if received is not None:
                return received
        return None

    def waiting(self) -> Received | None:
        """Empties the queue without a wait; None if it has nothing of the robot."""
        lot = self._drain()
        return self._choose(lot, monotonic_ns()) if lot else None

    def answer(self, data: bytes, to: Address) -> None:
        """Sends an answer and ignores errors; a failure shows as silence of the robot."""
        try:
            self._socket.sendto(data, socket.MSG_DONTWAIT, to)
        except OSError:
            self.vanished += 1

    def clear(self) -> None:
        """Discards the datagrams in the queue."""
        while self._drain():
            pass

    def close(self) -> None:
        """Closes the socket."""
        self._socket.close()

    def _take(self, wait_ns: int) -> tuple[bytes, Address] | None:
        """Returns the next datagram within ``wait_ns``, if any. The wait is in the operating system."""
        wait = struct.pack("ll", wait_ns // 1_000_000_000, max(1, wait_ns % 1_000_000_000 // 1000))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, wait)
        return self._receive(0)

    def _drain(self) -> list[tuple[bytes, Address]]:
        """Returns all datagrams in the queue."""
        lot: list[tuple[bytes, Address]] = []
        while len(lot) < _DRAIN and (datagram := self._receive(socket.MSG_DONTWAIT)) is not None:
            lot.append(datagram)
        return lot

    def _receive(self, flags: int) -> tuple[bytes, Address] | None:
        """Returns one datagram, or None. The failure of an earlier answer may be reported here; it is counted."""
        while True:
            try:
                return self._socket.recvfrom(_LONGEST, flags)
            except (BlockingIOError, TimeoutError):
                return None
            except ConnectionError:
                self.vanished += 1

    def _choose(self, lot: list[tuple[bytes, Address]], t_ns: int) -> Received | None:
        """Selects the datagrams of the robot of the session, or of the last caller without a session."""
        calls = [address for _, address in lot if address[0] == self.robot]
        if t_ns - self._heard_ns > self._silence_ns and self._peer not in calls:
            self._peer = None
        sender = self._peer or (calls[-1] if calls else None)
        own = [data for data, address in lot if address == sender]
        self._count_strangers([address for _, address in lot if address != sender])
        if not own or sender is None:
            return None
        self._peer, self._heard_ns = sender, t_ns
        return Received(data=own[-1], older=tuple(own[:-1]), sender=sender, t_ns=t_ns, count=len(own))

    def _count_strangers(self, senders: list[Address]) -> None:
        self.strangers += len(senders)
        for sender in senders:
            if len(self._seen) < _STRANGERS and sender not in self._seen:
                self._seen.append(sender)


def _own_address(robot: str) -> str:
    """Returns the local address on the network of the robot.

    Raises:
        SettingsError: No network leads to the robot.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((robot, 9))  # connect sends nothing over UDP
        except OSError as error:
            raise SettingsError(
                f"live.robot_address: no network leads to {robot} ({error.strerror}); would be right: the address of "
                "the robot's controller, on a network of this machine"
            ) from None
        address: str = probe.getsockname()[0]
        return address
