"""What the robot double was told and what it did, as tables that grow."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hrcreplay.egm.channel import Datagram
from hrcreplay.egm.codec import AXES, BadPacket, Correction, RobotPacket, decode_correction
from hrcreplay.egm.servo import Servo
from hrcreplay.records import Floats, Ints

_BLOCK = 4096
_NAN = np.full(AXES, np.nan)

#: A row a cycle: its start; session from 1; seqno sent, -1 none; seqno of the message read, -1 none; messages still
#: queued; states as sent; joints measured; joints and speed planned; reference and its speed, NaN without; utilization.
_CYCLE = np.dtype(
    [
        ("t_ns", np.int64),
        ("session", np.int64),
        ("seqno", np.int64),
        ("told_seqno", np.int64),
        ("queued", np.int64),
        ("motors", np.int64),
        ("mci", np.int64),
        ("rapid", np.int64),
        ("q_rad", np.float64, AXES),
        ("planned_rad", np.float64, AXES),
        ("planned_rad_per_s", np.float64, AXES),
        ("ref_rad", np.float64, AXES),
        ("ref_rad_per_s", np.float64, AXES),
        ("utilization", np.float64),
    ]
)
#: A row a message that arrived, before any fault of the way in.
_ARRIVAL = np.dtype(
    [
        ("t_ns", np.int64),
        ("session", np.int64),
        ("seqno", np.int64),
        ("ref_rad", np.float64, AXES),
        ("ref_rad_per_s", np.float64, AXES),
    ]
)


class TwinRecord:
    """Everything of one run of the double.

    Attributes:
        departed_ns: When the packets left that are owed an answer: duplicates and lost ones are not [ns].
        garbage: Datagrams that were no message.
    """

    def __init__(self) -> None:
        self._cycles = _Rows(_CYCLE)
        self._arrivals = _Rows(_ARRIVAL)
        self.departed_ns: list[int] = []
        self.garbage = 0

    def arrived(self, datagram: Datagram, session: int) -> None:
        """Notes a datagram as it arrives."""
        try:
            told = decode_correction(datagram.data)
        except BadPacket:
            self.garbage += 1
            return
        self._arrivals.append((datagram.t_ns, session, told.seqno, told.q, told.dq))

    def cycled(
        self, t_ns: int, session: int, packet: RobotPacket | None, servo: Servo, told: Correction | None, queued: int
    ) -> None:
        """Notes a cycle after its step."""
        seqno = -1 if packet is None else packet.seqno
        states = (0, 0, 0) if packet is None else (packet.motors, packet.mci, packet.rapid)
        reference = (_NAN, _NAN) if servo.reference is None else (servo.reference.q, servo.reference.dq)
        motion = (servo.measured, servo.q, servo.dq, *reference, servo.utilization)
        self._cycles.append((t_ns, session, seqno, -1 if told is None else told.seqno, queued, *states, *motion))

    def cycles(self) -> NDArray[Any]:
        """A structured row a cycle: t_ns, session, seqno, told_seqno, queued, motors, mci, rapid, q_rad..."""
        return self._cycles.table()

    def arrivals(self) -> NDArray[Any]:
        """A structured row a message: t_ns, session, seqno, ref_rad, ref_rad_per_s."""
        return self._arrivals.table()

    def departures(self) -> Ints:
        """Instants of the packets that are owed an answer, ascending; not of those that a later one overtook [ns]."""
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
    """Structured rows in blocks, so that a long session never copies what it has."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._full: list[NDArray[Any]] = []
        self._block = np.zeros(_BLOCK, dtype)
        self._used = 0

    def append(self, row: tuple[Any, ...]) -> None:
        if self._used == _BLOCK:
            self._full.append(self._block)
            self._block, self._used = np.zeros_like(self._block), 0
        self._block[self._used] = row
        self._used += 1

    def table(self) -> NDArray[Any]:
        return np.concatenate([*self._full, self._block[: self._used]])
