"""The simulated controller of one session, computed cycle by cycle without clock or socket, and its record."""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hrcreplay.egm.codec import (
    ARM_JOINTS,
    MOST_JOINTS,
    WRAP,
    BadPacket,
    Correction,
    Mci,
    Motors,
    Rapid,
    RobotPacket,
    decode_correction,
    encode_robot,
    flange_pose,
)
from hrcreplay.egm.robot_double.faults import Datagram, Fault, FaultyChannel, is_active
from hrcreplay.egm.robot_double.servo import IRB140, PERIOD_NS, ServoController, ServoSettings
from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats, Ints

_BLOCK = 4096


def _cycle_row(axes: int) -> np.dtype[Any]:
    """One row per cycle.

    Fields: start; session from 1; sent seqno, -1 none; seqno of the message read, -1 none; number of queued messages;
    states as sent; measured joints; planned joints and speed; reference and its speed, NaN if none; utilization.
    """
    counts = ("t_ns", "session", "seqno", "told_seqno", "queued", "motors", "mci", "rapid")
    joints = ("q_rad", "planned_rad", "planned_rad_per_s", "ref_rad", "ref_rad_per_s")
    return np.dtype(
        [
            *((name, np.int64) for name in counts),
            *((name, np.float64, axes) for name in joints),
            ("utilization", np.float64),
        ]
    )


def _arrival_row(axes: int) -> np.dtype[Any]:
    """One row per arrived message, before the faults of the incoming direction."""
    counts, joints = ("t_ns", "session", "seqno"), ("ref_rad", "ref_rad_per_s")
    return np.dtype([*((name, np.int64) for name in counts), *((name, np.float64, axes) for name in joints)])


class SimulatorRecord:
    """Record of one run of the robot double.

    Attributes:
        departed_ns: Departure times of the packets that require an answer, without duplicates and lost ones [ns].
        garbage: Number of invalid datagrams.
    """

    def __init__(self, axes: int) -> None:
        self._cycles = _Rows(_cycle_row(axes))
        self._arrivals = _Rows(_arrival_row(axes))
        self._unknown = np.full(axes, np.nan)
        self.departed_ns: list[int] = []
        self.garbage = 0

    def add_arrival(self, datagram: Datagram, session: int) -> None:
        """Records a datagram as it arrives."""
        try:
            told = decode_correction(datagram.data)
        except BadPacket:
            self.garbage += 1
            return
        if len(told.q) != len(self._unknown):
            self.garbage += 1
            return
        self._arrivals.append((datagram.t_ns, session, told.seqno, told.q, told.dq))

    def add_cycle(
        self,
        t_ns: int,
        session: int,
        packet: RobotPacket | None,
        servo: ServoController,
        told: Correction | None,
        queued: int,
    ) -> None:
        """Records a cycle after its step.

        Args:
            t_ns: Start of the cycle [ns].
            session: Number of the session, from 1.
            packet: The sent packet; None if nothing was sent.
            servo: State of the controller after the step.
            told: Message read in this cycle; None without one.
            queued: Number of messages left in the queue.
        """
        seqno = -1 if packet is None else packet.seqno
        states = (0, 0, 0) if packet is None else (packet.motors, packet.mci, packet.rapid)
        reference = (
            (self._unknown, self._unknown) if servo.reference is None else (servo.reference.q, servo.reference.dq)
        )
        motion = (servo.measured, servo.q, servo.dq, *reference, servo.utilization)
        self._cycles.append((t_ns, session, seqno, -1 if told is None else told.seqno, queued, *states, *motion))

    def cycles(self) -> NDArray[Any]:
        """One structured row per cycle: t_ns, session, seqno, told_seqno, queued, motors, mci, rapid, q_rad..."""
        return self._cycles.table()

    def arrivals(self) -> NDArray[Any]:
        """One structured row per message: t_ns, session, seqno, ref_rad, ref_rad_per_s."""
        return self._arrivals.table()

    def departures(self) -> Ints:
        """Departure times of the packets that require an answer, ascending, without overtaken ones [ns]."""
        departed_ns = np.array(self.departed_ns, dtype=np.int64)
        next_ns = np.minimum.accumulate(departed_ns[::-1])[::-1][1:]
        return departed_ns[np.append(departed_ns[:-1] <= next_ns, np.ones(len(departed_ns[-1:]), bool))]


def columns(table: NDArray[Any]) -> tuple[list[str], Floats]:
    """Names and values (n, m) of a structured table, fields of several axes as name_1, name_2..."""
    names: list[str] = []
    parts = []
    for name in table.dtype.names or ():
        values = table[name] if table[name].ndim == 2 else table[name][:, None]
        names += [name] if values.shape[1] == 1 else [f"{name}_{axis}" for axis in range(1, values.shape[1] + 1)]
        parts.append(values)
    return names, np.concatenate(parts, axis=1, dtype=np.float64)


class _Rows:
    """Structured rows in blocks, so that a long session never copies its rows."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._full: list[NDArray[Any]] = []
        self._block = np.zeros(_BLOCK, dtype)
        self._used = 0

    def append(self, row: tuple[Any, ...]) -> None:
        if self._used == _BLOCK:
            self._full.append(self._block)
            self._block, self._used = np.zeros(_BLOCK, self._block.dtype), 0  # zeros_like takes milliseconds
        self._block[self._used] = row
        self._used += 1

    def table(self) -> NDArray[Any]:
        return np.concatenate([*self._full, self._block[: self._used]])


#: Capacity of the controller's socket in messages; further ones are lost.
_QUEUE = 1024


@dataclass(frozen=True, slots=True)
class SimulatorSettings:
    """Settings of the simulated controller, and the joints at the start."""

    servo: ServoSettings = field(default_factory=ServoSettings)
    """The session as RAPID sets it up."""
    start_deg: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 30.0, 0.0)
    """Joints at the first cycle [deg]."""
    version: Literal["A", "B", "C"] = "B"
    """Edition of the messages."""
    radians: bool = False
    """Behave as RobotWare below 6.07: joints in radians, no clock."""
    restart_s: float = 1.5
    """Time after the end of a session at which the program starts another; 0: never [s]."""
    epoch_ns: int = 1_700_000_000_000_000_000
    """The controller's clock at the first cycle [ns]."""

    def __post_init__(self) -> None:
        axes = self.servo.axes
        count = len(axes.low_deg)
        if not ARM_JOINTS <= count <= MOST_JOINTS:
            raise SettingsError(f"robot double: {count} axes; {ARM_JOINTS} to {MOST_JOINTS} would be right")
        if len(self.start_deg) != count or not all(
            low <= angle <= high for low, angle, high in zip(axes.low_deg, self.start_deg, axes.high_deg, strict=False)
        ):
            raise SettingsError(f"robot double: start {self.start_deg} deg; {count} joints within range would be right")
        if self.version not in ("A", "B", "C"):
            raise SettingsError(f"robot double: version is {self.version!r}; A, B or C would be right")
        if not 0 <= self.restart_s < math.inf:
            raise SettingsError(f"robot double: restart_s is {self.restart_s}; a finite number from 0 would be right")


class SimulatedRobot:
    """The simulated controller and robot; the same instants, datagrams and seed give the same answers.

    Attributes:
        servo: The motion controller.
        record: Received messages and cycles.
        session: Number of the session, from 1.
        ends: Reason for the end of each session; empty for one that was cut off or still runs.
    """

    def __init__(self, settings: SimulatorSettings, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        self._settings = settings
        self.servo = ServoController(settings.servo, np.radians(settings.start_deg))
        self.record = SimulatorRecord(len(settings.start_deg))
        self.session = 1
        self.ends = [""]
        link = [fault for fault in faults if fault.of_link]
        self._robot_faults = [fault for fault in faults if not fault.of_link]
        self._happened: set[int] = set()
        self._out = FaultyChannel((fault for fault in link if fault.direction != "in"), (seed, 0))
        self._in = FaultyChannel((fault for fault in link if fault.direction != "out"), (seed, 1))
        self._coming: list[tuple[int, int, bytes]] = []
        self._coming_count = 0
        self._queue: deque[bytes] = deque()
        self._seqno = 0
        self._first_ns: int | None = None
        self._last_ns = 0

    def cycle(self, t_ns: int, arrived: Sequence[Datagram]) -> list[Datagram]:
        """Runs one cycle: read the feedback, send it, read one queued message, move.

        Args:
            t_ns: Start of the cycle [ns]. After skipped periods, the robot has moved on.
            arrived: Datagrams since the last cycle, with arrival times.

        Returns:
            The departing datagrams with their times: now, or later by a fault.
        """
        self._catch_up(t_ns)
        since_s = (t_ns - (self._first_ns or 0)) * 1e-9
        active = self._apply_faults(t_ns, since_s)
        self._take_in(t_ns, since_s, arrived)
        packet = None if self._silent(t_ns, active) else self._packet(t_ns, active)
        departing = [] if packet is None else self._send(t_ns, since_s, packet)
        told = self._read()
        self.servo.step(t_ns, told)
        self.ends[-1] = self.servo.error or ("converged" if self.servo.converged else "")
        self.record.add_cycle(t_ns, self.session, packet, self.servo, told, len(self._queue))
        return departing

    def sent_at(self, t_ns: int) -> None:
        """Sets the actual sending time of this cycle's packet; default: the start of the cycle [ns]."""
        if self.record.departed_ns and self.record.departed_ns[-1] == self._last_ns:
            self.record.departed_ns[-1] = t_ns

    def _catch_up(self, t_ns: int) -> None:
        """Moves through skipped cycles, with the last reference."""
        if self._first_ns is None:
            self._first_ns = t_ns
        else:
            for passed_ns in range(self._last_ns + PERIOD_NS, t_ns - PERIOD_NS // 2, PERIOD_NS):
                self.servo.step(passed_ns, None)
        self._last_ns = t_ns

    def _apply_faults(self, t_ns: int, since_s: float) -> dict[str, Fault]:
        """Applies the faults of the robot. Returns the active ones, by kind."""
        active = {}
        for number, fault in enumerate(self._robot_faults):
            if not is_active(fault, since_s):
                continue
            active[fault.kind] = fault
            if number not in self._happened:
                self._happened.add(number)
                if fault.kind == "egm_error":
                    self.servo.fail(t_ns, "EGM error")
                elif fault.kind == "new_session":
                    self._begin()
        self.servo.motors_on = "motors_off" not in active
        self.servo.program_running = "program_stop" not in active
        ended_ns, pause_s = self.servo.ended_ns, self._settings.restart_s
        ready = self.servo.motors_on and self.servo.program_running
        if ready and ended_ns is not None and pause_s and t_ns - ended_ns >= pause_s * 1e9:
            self._begin()
        return active

    def _begin(self) -> None:
        """Starts a new session: counts from 0 and clears the queue."""
        self.servo.begin()
        self._queue.clear()
        self._coming.clear()
        self._seqno = 0
        self.session += 1
        self.ends.append("")

    def _take_in(self, t_ns: int, since_s: float, arrived: Sequence[Datagram]) -> None:
        """Queues the arrived datagrams, after the faults of the incoming direction."""
        for datagram in arrived:
            self.record.add_arrival(datagram, self.session)
            for late in self._in.transmit(datagram, since_s):
                heapq.heappush(self._coming, (late.t_ns, self._coming_count, late.data))
                self._coming_count += 1
        while self._coming and self._coming[0][0] <= t_ns:
            data = heapq.heappop(self._coming)[2]
            if len(self._queue) < _QUEUE:
                self._queue.append(data)

    def _silent(self, t_ns: int, active: dict[str, Fault]) -> bool:
        """Returns True if nothing is sent: by a fault, or after the end of a session whose last states were sent."""
        ended_ns = self.servo.ended_ns
        return "silence" in active or (ended_ns is not None and t_ns - ended_ns > self._settings.servo.ramp_s * 1e9)

    def _packet(self, t_ns: int, active: dict[str, Fault]) -> RobotPacket:
        """Returns the state of the robot in this cycle."""
        servo, since_ns = self.servo, t_ns - (self._first_ns or 0)
        q = servo.measured
        if teleport := active.get("teleport"):
            q = q + math.radians(teleport.angle_deg) * (np.arange(1, len(q) + 1) == teleport.axis)
        if missing := active.get("nan"):
            q = np.where(np.arange(1, len(q) + 1) == missing.axis, np.nan, q)
        running = Rapid.RUNNING if servo.moves else Rapid.STOPPED
        mci = Mci.RUNNING if servo.moves else Mci.STOPPED
        packet = RobotPacket(
            seqno=self._seqno,
            tm_ms=since_ns // 1_000_000 % WRAP,
            clock_ns=self._settings.epoch_ns + since_ns,
            q=q,
            q_planned=servo.q,
            motors=Motors.ON if servo.motors_on else Motors.OFF,
            mci=Mci.ERROR if servo.error else mci,
            rapid=Rapid.UNDEFINED if "rapid_undefined" in active else running,
            converged=servo.converged,
            utilization=servo.utilization,
        )
        self._seqno = (self._seqno + 1) % WRAP
        return packet

    def _send(self, t_ns: int, since_s: float, packet: RobotPacket) -> list[Datagram]:
        """Returns the packet's datagrams after the faults of the outgoing direction."""
        pose = flange_pose(self.servo.measured) if self._settings.servo.axes == IRB140 else None
        data = encode_robot(packet, version=self._settings.version, radians=self._settings.radians, q_cartesian=pose)
        departing = self._out.transmit(Datagram(t_ns, data), since_s)
        owed_ns = [datagram.t_ns for datagram in departing if datagram.data is data]
        if owed_ns and np.isfinite(packet.q).all():  # invalid packets require no answer
            self.record.departed_ns.append(min(owed_ns))
        return departing

    def _read(self) -> Correction | None:
        """Reads the one message of this cycle; an invalid one is ignored."""
        try:
            told = decode_correction(self._queue.popleft()) if self._queue else None
        except BadPacket:
            return None
        return told if told is None or len(told.q) == len(self._settings.start_deg) else None
