"""The least that keeps a session alive: the newest packet is answered with its own joints and speed zero.

The measure for latency and missed cycles of a machine: ``python -m tests.egm.echo --port 6510 --duration 60``. With
``--work-us`` it also keeps a core as busy as a session does, by reading the clock after each answer. Between two reads
nothing but the machine takes time, so a machine that stands is told from a program that is slow. With ``--touch-mb`` it
also writes to so much memory in turn; a session touches 16 MB.
"""

from __future__ import annotations

import argparse
import gc
import os
import socket
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import cycle
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hrcreplay.egm.codec import WRAP, BadPacket, Correction, decode_robot, encode_correction

_BUFFER = 65536
_PAGE, _BLOCK = 4096, 65536  # of memory

#: A machine that lets a program wait for so long between two reads of the clock has stood.
STOOD_NS = 1_000_000


class Echoed(NamedTuple):
    """What happened in the time of a loop."""

    came: int  #: datagrams
    answered: int  #: datagrams; one that another follows at once is not answered
    stood_ns: list[int]  #: for how long the machine stood, each time


def echo(server: socket.socket, duration_s: float, work_s: float = 0.0, touch_mb: int = 0) -> Echoed:
    """Answers until the time is up.

    Args:
        server: A bound UDP socket, blocking; gets a time-out.
        duration_s: How long [s].
        work_s: How long to read the clock after each answer [s].
        touch_mb: How much memory to write to meanwhile [MiB].
    """
    still = np.zeros(6)
    blocks = cycle(np.zeros((touch_mb << 20) // _BLOCK * _BLOCK, np.uint8).reshape(-1, _BLOCK)[:, ::_PAGE])
    came = seqno = 0
    stood_ns: list[int] = []
    begun_ns = time.monotonic_ns()
    end_ns = begun_ns + round(duration_s * 1e9)
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", 0, 100_000))
    while (now_ns := time.monotonic_ns()) < end_ns:
        try:
            data, peer = server.recvfrom(_BUFFER)
        except BlockingIOError:  # a time-out of the kernel's, beside which one call may do without waiting
            continue
        came += 1
        with suppress(BlockingIOError):
            while True:
                data, peer = server.recvfrom(_BUFFER, socket.MSG_DONTWAIT)
                came += 1
        try:
            q = decode_robot(data).q[:6]
        except BadPacket:
            continue
        tm_ms = (now_ns - begun_ns) // 1_000_000 % WRAP
        server.sendto(encode_correction(Correction(seqno=seqno, tm_ms=tm_ms, q=q, dq=still)), peer)
        seqno += 1
        stood_ns += work(round(work_s * 1e9), blocks)
    return Echoed(came, seqno, stood_ns)


def work(for_ns: int, blocks: Iterator[NDArray[np.uint8]]) -> list[int]:
    """Reads the clock for so long [ns], and writes to a block of memory before each read.

    Returns:
        The times for which the machine stood meanwhile [ns].
    """
    stood_ns = []
    before_ns = time.monotonic_ns()
    end_ns = before_ns + for_ns
    while before_ns < end_ns:
        if (block := next(blocks, None)) is not None:
            block += 1
        now_ns = time.monotonic_ns()
        if now_ns - before_ns > STOOD_NS:
            stood_ns.append(now_ns - before_ns)
        before_ns = now_ns
    return stood_ns


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.egm.echo", description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=6510)
    parser.add_argument("--duration", type=float, default=60.0, help="seconds")
    parser.add_argument("--fifo", type=int, default=0, help="real-time priority, 1 to 99; 0: none")
    parser.add_argument("--work-us", type=float, default=0.0, help="time to read the clock after each answer")
    parser.add_argument("--touch-mb", type=int, default=0, help="memory to write to meanwhile")
    arguments = parser.parse_args()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind((arguments.host, arguments.port))
        if arguments.fifo:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(arguments.fifo))
        gc.freeze()
        gc.disable()
        found = echo(server, arguments.duration, 1e-6 * arguments.work_us, arguments.touch_mb)
    longest_ms = 1e-6 * max(found.stood_ns, default=0)
    sys.stdout.write(f"came {found.came}\nanswered {found.answered}\n")
    if arguments.work_us:
        sys.stdout.write(f"stood {len(found.stood_ns)} times for over 1 ms, at most {longest_ms:.1f} ms\n")


if __name__ == "__main__":
    main()
