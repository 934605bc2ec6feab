"""The robot double as a UDP client that keeps its cycle time by absolute deadlines."""

from __future__ import annotations

import gc
import heapq
import itertools
import os
import signal
import socket
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType

from hrcreplay.egm.robot_double.faults import Datagram, Fault
from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.egm.robot_double.twin import TwinCore, TwinSettings
from hrcreplay.egm.robot_double.twin_report import TwinReport, report_of
from hrcreplay.errors import SettingsError

_SO_TIMESTAMPNS = 35  # Linux; the socket module has no name for it
_BUFFER = 65536
_LAST_ANSWERS_NS = 50_000_000  # so long the end waits for answers that are under way
_RANK = 10  # lowest of what matters: never ahead of the guide on its own machine


def run_twin(
    host: str,
    port: int,
    *,
    settings: TwinSettings | None = None,
    faults: Sequence[Fault] = (),
    seed: int = 0,
    duration_s: float | None = None,
    out: Path | None = None,
) -> TwinReport:
    """Plays the robot against a server at ``host:port`` until the time is up, or SIGINT or SIGTERM.

    Args:
        host: Where the robot's guide listens.
        port: Its port.
        settings: Which controller; its clock begins at the present time.
        faults: What goes wrong.
        seed: Of all that is random in the faults.
        duration_s: How long; None is until it is interrupted [s].
        out: Folder for the report and the record, made if need be; None writes nothing.

    Returns:
        What it was told and what it did.

    Raises:
        SettingsError: The host has no address, or the folder cannot be written.
    """
    if duration_s is not None and not duration_s > 0:
        raise SettingsError(f"robot double: duration is {duration_s} s; a positive number would be right")
    if not 0 < port < 65536:
        raise SettingsError(f"robot double: port is {port}; a whole number from 1 to 65535 would be right")
    if out is not None:
        _make_folder(out)
    core = TwinCore(replace(settings or TwinSettings(), epoch_ns=time.time_ns()), faults, seed)
    with _client(host, port) as client, _quiet():
        overruns = _run(core, client, duration_s)
    report = report_of(core, faults, overruns=overruns)
    if out is not None:
        report.write(out)
    return report


def _run(core: TwinCore, client: socket.socket, duration_s: float | None) -> int:
    """Cycles until the end. Returns the cycles that the machine has kept from happening in time."""
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
        pass  # the report is what remains to be done
    for datagram in _arrived(client):
        core.record.add_arrival(datagram, core.session)
    return overruns


def _wait(until_ns: int, late: list[tuple[int, int, bytes]], client: socket.socket) -> None:
    """Sleeps until the deadline, sending what is due on the way."""
    while late and late[0][0] < until_ns:
        due_ns, _number, data = heapq.heappop(late)
        time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
        _send(client, data)
    time.sleep(max(0, until_ns - time.monotonic_ns()) * 1e-9)


def _arrived(client: socket.socket) -> list[Datagram]:
    """What has come in, with the instants at which the kernel had it, which no sleep of ours delays."""
    datagrams: list[Datagram] = []
    to_monotonic_ns = time.monotonic_ns() - time.time_ns()
    while True:
        try:
            data, notes, _flags, _peer = client.recvmsg(_BUFFER, 64)
        except BlockingIOError:
            return datagrams
        except ConnectionError:
            continue  # nobody listens yet
        seconds, nanoseconds = struct.unpack("qq", notes[0][2])
        datagrams.append(Datagram(seconds * 1_000_000_000 + nanoseconds + to_monotonic_ns, data))


def _send(client: socket.socket, data: bytes) -> None:
    with suppress(ConnectionError, BlockingIOError):  # nobody listens, or the buffer is full: a lost packet
        client.send(data)


@contextmanager
def _client(host: str, port: int) -> Iterator[socket.socket]:
    """A non-blocking UDP socket towards the guide, with time stamps of the kernel."""
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
    """No garbage collection in between, and ahead of other processes where that is allowed, as a controller would be.

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
