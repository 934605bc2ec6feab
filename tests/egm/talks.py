"""A conversation with a robot, packet by packet, for the tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hrcreplay.egm.codec import RobotPacket
from hrcreplay.egm.link import EgmServer, EgmSession, PacketStatus

CYCLE_NS = 4_032_000
T0_NS = 1_700_000_000_000_000_000
Q_MAX = np.radians([180.0, 110.0, 50.0, 200.0, 115.0, 400.0])
DQ_MAX = np.radians([200.0, 200.0, 260.0, 360.0, 360.0, 450.0])
ZERO = np.zeros(6)


def session(**settings: Any) -> EgmSession:
    return EgmSession(-Q_MAX, Q_MAX, DQ_MAX, **settings)


def server(port: int, timeout_s: float, *, silence_s: float = 0.1) -> EgmServer:
    """Ours, on loopback."""
    return EgmServer("127.0.0.1", port, timeout_s, robot="127.0.0.1", silence_s=silence_s)


def packet(seqno: int | None, **fields: Any) -> RobotPacket:
    """A robot that may move, at its seqno-th cycle."""
    count = 0 if seqno is None else seqno
    usual = RobotPacket(
        seqno=seqno,
        tm_ms=count * 4 % 2**32,
        clock_ns=T0_NS + count * CYCLE_NS,
        q=np.full(6, 0.1),
        q_planned=None,
        motors=1,
        mci=3,
        rapid=2,
        converged=False,
        utilization=20.0,
    )
    return replace(usual, **fields)


def talk(talking: EgmSession, seqnos: list[int], start: int = 0) -> list[PacketStatus]:
    """Hear and answer a packet a cycle."""
    heard = []
    for cycle, seqno in enumerate(seqnos, start):
        heard.append(talking.classify(packet(seqno), cycle * CYCLE_NS))
        if heard[-1].answer:
            talking.reply(ZERO, ZERO, cycle * CYCLE_NS)
    return heard
