"""The least that keeps a session alive: the newest packet is answered with its own joints and speed zero.

The measure for latency and missed cycles of a machine: ``python -m tests.egm.echo --port 6510 --duration 60``.
"""

from __future__ import annotations

import argparse
import gc
import os
import socket
import struct
import sys
import time
from contextlib import suppress

import numpy as np

from hrcreplay.egm.codec import WRAP, BadPacket, Correction, decode_robot, encode_correction

_BUFFER = 65536


def echo(server: socket.socket, duration_s: float) -> tuple[int, int]:
    """Answers until the time is up.

    Args:
        server: A bound UDP socket, blocking; gets a time-out.
        duration_s: How long [s].

    Returns:
        Datagrams that came in, and those that were answered; one that another follows at once is not.
    """
    still = np.zeros(6)
    came = seqno = 0
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
    return came, seqno


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.egm.echo", description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=6510)
    parser.add_argument("--duration", type=float, default=60.0, help="seconds")
    parser.add_argument("--fifo", type=int, default=0, help="real-time priority, 1 to 99; 0: none")
    arguments = parser.parse_args()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind((arguments.host, arguments.port))
        if arguments.fifo:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(arguments.fifo))
        gc.freeze()
        gc.disable()
        came, answered = echo(server, arguments.duration)
    sys.stdout.write(f"came {came}\nanswered {answered}\n")


if __name__ == "__main__":
    main()
