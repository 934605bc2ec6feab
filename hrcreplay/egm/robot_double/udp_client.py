"""The robot double as a UDP client that keeps its cycle time by absolute deadlines, and the summary of its run.

The summary contains reply times, the commands, and the standstill after faults.
"""

from __future__ import annotations

import gc
import heapq
import itertools
import json
import os
import signal
import socket
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hrcreplay.egm.robot_double.faults import Datagram, Fault, FaultOutcome, fault_outcome
from hrcreplay.egm.robot_double.robot_simulator import SimulatedRobot, SimulatorRecord, SimulatorSettings, columns
from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats, Ints

#: Time to the next packet within which a packet may stay unanswered: a guide that empties its socket answers the newest
#: [ns].
DRAINED_NS = 500_000


@dataclass(frozen=True)
class Answers:
    """Counts and times of the answers to the packets."""

    packets: int
    before_first: int
    """Packets sent before the first message of the guide."""
    answered: int
    missed: int
    """Answered ones of the other packets."""
    doubled: int
    """Messages without a waiting packet."""
    garbage: int
    seqno_steps: int
    """Steps of the guide's counter other than 1 within a session."""
    latency_us: dict[str, float]
    """From a packet's departure to its answer's arrival: p50, p99, p99.9, max [us]; empty without answers."""


@dataclass(frozen=True)
class Commanded:
    """Largest commanded jumps, speeds and accelerations, for each axis."""

    start_jump_rad: list[float]
    """Jump from the measured joints to a session's first reference [rad]."""
    jump_rad: list[float]
    """Jump from one reference to the next [rad]."""
    speed_rad_per_s: list[float]
    """That jump over the cycles between their arrivals [rad/s]."""
    speed_ref_rad_per_s: list[float]
    """Speed reference [rad/s]."""
    acceleration_rad_per_s2: list[float]
    """Change of the speed reference over the cycles between their arrivals [rad/s^2]."""
    speed_limit_rad_per_s: list[float]
    acceleration_limit_rad_per_s2: list[float]


@dataclass(frozen=True)
class SimulatorReport:
    """The report of a run, with the record that it was made from."""

    duration_s: float
    cycles: int
    overruns: int
    """Cycles that were late on this machine."""
    sessions: list[str]
    """Reason for the end of each session; empty for one that was cut off."""
    answers: Answers
    commanded: Commanded
    faults: list[FaultOutcome]
    record: SimulatorRecord

    def as_json(self) -> dict[str, Any]:
        """Returns all except the record, in JSON form."""
        names = ("duration_s", "cycles", "overruns", "sessions")
        parts = {"answers": asdict(self.answers), "commanded": asdict(self.commanded)}
        return (
            {name: getattr(self, name) for name in names} | parts | {"faults": [asdict(seen) for seen in self.faults]}
        )

    def lines(self) -> list[str]:
        """Returns the report as text."""
        answers, told = self.answers, self.commanded
        ends = ", ".join(end or "cut off" for end in self.sessions)
        latency = ", ".join(f"{name} {value:.0f}" for name, value in answers.latency_us.items()) or "none"
        counts = (
            f"packets {answers.packets}, of these {answers.before_first} before the first answer; "
            f"answered {answers.answered}, missed {answers.missed}, doubled {answers.doubled}; "
            f"no message {answers.garbage}, odd steps of seqno {answers.seqno_steps}"
        )
        lines = [
            f"{self.duration_s:.1f} s, {self.cycles} cycles, {self.overruns} overrun; sessions: {ends}",
            counts,
            f"response [us]: {latency}",
            "axis  start [rad]   jump [rad]  speed [rad/s] of   speed ref  acceleration [rad/s^2] of",
        ]
        rows = zip(*asdict(told).values(), strict=True)
        for axis, (start, jump, speed, speed_ref, push, speed_limit, push_limit) in enumerate(rows, start=1):
            lines.append(
                f"{axis:4}  {start:11.6f}  {jump:11.6f}  {speed:10.4f} {speed_limit:7.3f}  {speed_ref:9.4f}"
                f"  {push:19.3f} {push_limit:6.2f}"
            )
        return lines + [seen.line() for seen in self.faults]

    def write(self, folder: Path) -> None:
        """Writes twin.json, twin_cycles.csv and twin_arrivals.csv.

        Raises:
            SettingsError: The folder cannot be written.
        """
        try:
            (folder / "twin.json").write_text(json.dumps(self.as_json(), indent=2) + "\n", encoding="utf-8")
            for name, table in (("cycles", self.record.cycles()), ("arrivals", self.record.arrivals())):
                heads, values = columns(table)
                formats = ["%d" if not np.any(column % 1) else "%.9g" for column in values.T]
                np.savetxt(folder / f"twin_{name}.csv", values, formats, ",", header=",".join(heads), comments="")
        except OSError as error:
            raise SettingsError(f"{folder}: cannot be written ({error.strerror}); name another folder") from error


def report_of(core: SimulatedRobot, faults: Sequence[Fault], *, overruns: int = 0) -> SimulatorReport:
    """Makes the report of a run of the robot double."""
    cycles, arrivals = core.record.cycles(), core.record.arrivals()
    return SimulatorReport(
        duration_s=len(cycles) and float(cycles["t_ns"][-1] - cycles["t_ns"][0] + PERIOD_NS) * 1e-9,
        cycles=len(cycles),
        overruns=overruns,
        sessions=core.ends,
        answers=_answers(core.record.departures(), arrivals, core.record.garbage),
        commanded=_commanded(cycles, arrivals, core.servo.speed_max, core.servo.acceleration_max),
        faults=[fault_outcome(fault, cycles) for fault in faults],
        record=core.record,
    )


def _answers(departed_ns: Ints, arrivals: NDArray[Any], garbage: int) -> Answers:
    """Pairs packets and answers.

    If as many answers as waiting packets arrive between two departures, each packet has one. If fewer arrive, the
    newest packets were answered, as by a guide that has fallen behind. If more arrive, the additional ones are
    duplicates.
    """
    arrived_ns = arrivals["t_ns"]
    windows = np.split(arrived_ns, np.searchsorted(arrived_ns, departed_ns))
    latencies_ns: list[int] = []
    doubled, waiting = len(windows[0]), []
    answered = np.zeros(len(departed_ns), bool)
    for number, window in enumerate(windows[1:]):
        waiting.append(number)
        if len(window):
            waiting = waiting[-len(window) :]
            answered[waiting] = True
            latencies_ns += [int(a - departed_ns[n]) for a, n in zip(window, waiting, strict=False)]
            doubled += max(0, len(window) - len(waiting))
            waiting = []
    before = max(0, int(np.searchsorted(departed_ns, arrived_ns[0])) - 1) if len(arrived_ns) else len(departed_ns)
    alone = np.diff(departed_ns, append=np.inf) > DRAINED_NS
    steps = np.diff(arrivals["seqno"])[np.diff(arrivals["session"]) == 0]
    latency_us = np.array(latencies_ns) * 1e-3
    shares = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
    return Answers(
        packets=len(departed_ns),
        before_first=before,
        answered=int(np.sum(answered)),
        missed=int(np.sum(alone[before:] & ~answered[before:])),
        doubled=doubled,
        garbage=garbage,
        seqno_steps=int(np.sum(steps != 1)),
        latency_us={name: float(np.quantile(latency_us, share)) for name, share in shares.items() if len(latency_us)},
    )


def _commanded(cycles: NDArray[Any], arrivals: NDArray[Any], speed_max: Floats, acceleration_max: Floats) -> Commanded:
    """Computes the maximum jumps, speeds and accelerations of the arrived references, within sessions."""
    session = arrivals["session"]
    same = np.diff(session) == 0
    count = np.maximum(1, np.rint(np.diff(arrivals["t_ns"])[same] / PERIOD_NS))[:, None]
    span_s = count * PERIOD_NS * 1e-9
    jump = np.abs(np.diff(arrivals["ref_rad"], axis=0)[same])
    change = np.abs(np.diff(arrivals["ref_rad_per_s"], axis=0)[same])
    first = arrivals[np.flatnonzero(np.diff(session, prepend=0))]
    answered = cycles[np.maximum(np.searchsorted(cycles["t_ns"], first["t_ns"], side="right") - 1, 0)]
    start = np.abs(first["ref_rad"] - answered["q_rad"])
    return Commanded(
        start_jump_rad=_largest(start),
        jump_rad=_largest(jump),
        speed_rad_per_s=_largest(jump / span_s),
        speed_ref_rad_per_s=_largest(np.abs(arrivals["ref_rad_per_s"])),
        acceleration_rad_per_s2=_largest(change / span_s),
        speed_limit_rad_per_s=speed_max.tolist(),
        acceleration_limit_rad_per_s2=acceleration_max.tolist(),
    )


def _largest(values: Floats) -> list[float]:
    return [float(value) for value in values.max(axis=0, initial=0.0)]


_SO_TIMESTAMPNS = 35  # Linux; the socket module has no name for it
_BUFFER = 65536
_LAST_ANSWERS_NS = 50_000_000  # maximum wait for outstanding answers at the end
_RANK = 10  # lowest real-time priority: never above the guide on the same machine


def run_simulator(
    host: str,
    port: int,
    *,
    settings: SimulatorSettings | None = None,
    faults: Sequence[Fault] = (),
    seed: int = 0,
    duration_s: float | None = None,
    out: Path | None = None,
) -> SimulatorReport:
    """Plays the robot against a server at ``host:port`` until the time is up, or SIGINT or SIGTERM.

    Args:
        host: Address of the robot's guide.
        port: Port of the guide.
        settings: Settings of the controller; its clock begins at the present time.
        faults: Faults to inject.
        seed: Seed of the random faults.
        duration_s: Duration; None: until it is interrupted [s].
        out: Folder for the report and the record, created if needed; None writes nothing.

    Returns:
        The report of the run.

    Raises:
        SettingsError: The host has no address, or the folder cannot be written.
    """
    if duration_s is not None and not duration_s > 0:
        raise SettingsError(f"robot double: duration is {duration_s} s; a positive number would be right")
    if not 0 < port < 65536:
        raise SettingsError(f"robot double: port is {port}; a whole number from 1 to 65535 would be right")
    if out is not None:
        _make_folder(out)
    core = SimulatedRobot(replace(settings or SimulatorSettings(), epoch_ns=time.time_ns()), faults, seed)
    with _client(host, port) as client, _quiet():
        overruns = _run(core, client, duration_s)
    report = report_of(core, faults, overruns=overruns)
    if out is not None:
        report.write(out)
    return report


def _run(core: SimulatedRobot, client: socket.socket, duration_s: float | None) -> int:
    """Runs cycles until the end. Returns the number of late cycles."""
    overruns = 0
    late: list[tuple[int, int, bytes]] = []
    number = itertools.count()
    begun_ns = due_ns = time.monotonic_ns()
    end_ns = None if duration_s is None else begun_ns + round(duration_s * 1e9)
    try:
        while end_ns is None or due_ns < end_ns:
            _wait(due_ns, late, client)
            missed = (time.monotonic_ns() - due_ns) // PERIOD_NS
            overruns += missed
            due_ns += missed * PERIOD_NS
            for datagram in core.cycle(due_ns, _arrived(client)):
                if datagram.t_ns <= due_ns:
                    sent_ns = time.monotonic_ns()
                    _send(client, datagram.data)
                    core.sent_at(sent_ns)
                else:
                    heapq.heappush(late, (datagram.t_ns, next(number), datagram.data))
            due_ns += PERIOD_NS
        _wait(due_ns + _LAST_ANSWERS_NS, late, client)
    except KeyboardInterrupt:
        pass  # only the report remains
    for datagram in _arrived(client):
        core.record.add_arrival(datagram, core.session)
    return overruns


def _wait(until_ns: int, late: list[tuple[int, int, bytes]], client: socket.socket) -> None:
    """Sleeps until the deadline and sends due datagrams meanwhile."""
    while late and late[0][0] < until_ns:
        due_ns, _number, data = heapq.heappop(late)
        time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
        _send(client, data)
    time.sleep(max(0, until_ns - time.monotonic_ns()) * 1e-9)


def _arrived(client: socket.socket) -> list[Datagram]:
    """Returns received packets with the kernel's arrival times, which are independent of the process's sleep."""
    datagrams: list[Datagram] = []
    to_monotonic_ns = time.monotonic_ns() - time.time_ns()
    while True:
        try:
            data, notes, _flags, _peer = client.recvmsg(_BUFFER, 64)
        except BlockingIOError:
            return datagrams
        except ConnectionError:
            continue  # no listener yet
        seconds, nanoseconds = struct.unpack("qq", notes[0][2])
        datagrams.append(Datagram(seconds * 1_000_000_000 + nanoseconds + to_monotonic_ns, data))


def _send(client: socket.socket, data: bytes) -> None:
    with suppress(ConnectionError, BlockingIOError):  # no listener, or the buffer is full: a lost packet
        client.send(data)


@contextmanager
def _client(host: str, port: int) -> Iterator[socket.socket]:
    """Opens a non-blocking UDP socket to the guide, with time stamps of the kernel."""
    try:
        family, kind, protocol, _name, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    except (OSError, UnicodeError) as error:
        raise SettingsError(f"{host}:{port}: no such address ({error}); name the machine of the guide") from error
    with socket.socket(family, kind, protocol) as client:
        client.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        client.setblocking(False)
        try:
            client.connect(address)
        except OSError as error:
            raise SettingsError(f"{host}:{port}: not to be reached ({error.strerror}); name another") from error
        yield client


@contextmanager
def _quiet() -> Iterator[None]:
    """Disables garbage collection and raises the priority if allowed, as for a real controller.

    SIGTERM ends the session as Ctrl-C does.
    """

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, interrupt) if main else None
    policy, rank = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_RANK))
    collects = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if collects:
            gc.enable()
        os.sched_setscheduler(0, policy, rank)
        if main:
            signal.signal(signal.SIGTERM, before)


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"{path}: cannot be made ({error.strerror}); name another folder") from error
