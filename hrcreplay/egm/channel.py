"""One way of a link with faults: which datagrams come through, when, and what comes beside them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from hrcreplay.egm.faults import Fault


class Datagram(NamedTuple):
    """A datagram and when it departs, or has arrived [ns]."""

    t_ns: int
    data: bytes


class Channel:
    """Faults of one direction, in the order in which they were given. Draws from its own generator alone."""

    def __init__(self, faults: Iterable[Fault], seed: Sequence[int]) -> None:
        self._faults = tuple(faults)
        self._rng = np.random.default_rng(seed)
        self._dropping = 0
        self._held: Datagram | None = None

    def carry(self, datagram: Datagram, since_s: float) -> list[Datagram]:
        """What becomes of a datagram.

        Args:
            datagram: The one to carry.
            since_s: Time since the first cycle, that of the script [s].

        Returns:
            What departs, each with its own time, not before the datagram's.
        """
        if not self._faults:
            return [datagram]
        out = [datagram]
        beside: list[Datagram] = []
        if self._dropping:
            self._dropping -= 1
            out = []
        for fault in self._faults:
            if lasts(fault, since_s) and self._rng.random() < fault.probability:
                out = self._touch(fault, out, beside, datagram.t_ns, since_s)
        if self._held is not None and out and out[-1] is not self._held:
            out.append(Datagram(out[-1].t_ns, self._held.data))
            self._held = None
        return out + beside

    def _touch(
        self, fault: Fault, out: list[Datagram], beside: list[Datagram], t_ns: int, since_s: float
    ) -> list[Datagram]:
        """The datagrams after one fault; garbage and empty ones go to ``beside``."""
        match fault.kind:
            case "loss":
                return []
            case "burst" if out:
                self._dropping = fault.count - 1
                return []
            case "duplicate":
                return [copy for datagram in out for copy in (datagram, datagram)]
            case "reorder" if out and self._held is None:
                self._held = out[-1]
                return out[:-1]
            case "delay":
                return _later(out, round(fault.delay_s * 1e9))
            case "jitter":
                return _later(out, round(fault.delay_s * 1e9 * self._rng.random()))
            case "stall":
                end_ns = t_ns + round((fault.at_s + fault.duration_s - since_s) * 1e9)
                return [Datagram(max(datagram.t_ns, end_ns), datagram.data) for datagram in out]
            case "garbage":
                beside.append(Datagram(t_ns, self._rng.bytes(int(self._rng.integers(1, 400)))))
            case "empty":
                beside.append(Datagram(t_ns, b""))
        return out


def lasts(fault: Fault, since_s: float) -> bool:
    """Whether a fault is on; one without duration is on for less than a cycle."""
    return fault.at_s <= since_s < fault.at_s + max(fault.duration_s, 0.004032)


def _later(datagrams: list[Datagram], by_ns: int) -> list[Datagram]:
    return [Datagram(datagram.t_ns + by_ns, datagram.data) for datagram in datagrams]
