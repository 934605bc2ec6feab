"""The last gate before the socket: nothing is sent that leads further from the last command than the axes can go.

It reads what is about to leave, byte for byte, and knows nothing of how it came about: neither of controller and
session, nor of the fallback that brakes after a crash. It has no clock.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from hrcreplay.egm.codec import decode_correction
from hrcreplay.records import Floats


class UnsafeCommandError(Exception):
    """A command that must not be sent; the text says how far it leads, and how far it may."""


#: Rounding of a position that goes over the link in degrees [rad], and of a duration.
_ROUNDING_RAD: Final = 1e-9
_ROUNDING: Final = 1e-6


class StepGate:
    """Commands go at most as far as the axes can, each from the last one, and all of them over time.

    A command may use the time since the last one, and at least a cycle. As packets may come close to each other, many
    of them could still hurry the robot; so each also takes the time that its step needs from a store, which time fills
    and which holds no more than ``STORE`` cycles.
    """

    #: Cycles that a robot whose packets came late may catch up with.
    STORE: Final = 25

    def __init__(self, dq_max: Floats, cycle_s: float) -> None:
        """Begin before the first command.

        Args:
            dq_max: (n,) what the axes can do [rad/s].
            cycle_s: The robot's cycle [s].
        """
        self._dq_max, self._cycle_s = dq_max, cycle_s
        self._last: tuple[Floats, int] | None = None
        self._store_s = self.STORE * cycle_s

    def check(self, datagram: bytes, measured: Floats | None, t_ns: int) -> None:
        """Lets a command pass that is about to be sent.

        Args:
            datagram: The command.
            measured: (n,) where the robot says it is [rad]: the first command may lead no further than a cycle from
                there. None: it does not say.
            t_ns: Now.

        Raises:
            UnsafeCommandError: It must not be sent. It then counts as not sent.
            BadPacket: It is no command.
        """
        told = decode_correction(datagram)
        last, last_ns = self._last or (measured, t_ns)
        if last is None:
            raise UnsafeCommandError("the first command; where the robot is is not known, so none may be sent")
        if told.q.shape != self._dq_max.shape or last.shape != told.q.shape:
            raise UnsafeCommandError(f"a command of {len(told.q)} joints; {len(self._dq_max)} would be right")
        self._check_speed(told.dq)
        passed_s = max(0.0, (t_ns - last_ns) * 1e-9)
        step = np.maximum(np.abs(told.q - last) - _ROUNDING_RAD, 0.0)
        needs_s = float((step / self._dq_max).max()) / (1.0 + _ROUNDING)
        store_s = max(passed_s, min(self._store_s + passed_s, self.STORE * self._cycle_s))
        if not needs_s <= min(max(passed_s, self._cycle_s), store_s):  # also of a number that is none
            axis = int(np.argmax(step / self._dq_max))
            raise UnsafeCommandError(
                f"a command leads joint {axis + 1} {step[axis]:.4f} rad from the last one after {passed_s:.4f} s; "
                f"at {self._dq_max[axis]:.3f} rad/s it goes no further than "
                f"{self._dq_max[axis] * min(max(passed_s, self._cycle_s), store_s):.4f} rad"
            )
        self._last, self._store_s = (told.q, t_ns), store_s - needs_s

    def _check_speed(self, dq: Floats) -> None:
        over = np.abs(dq) - self._dq_max * (1.0 + _ROUNDING)
        if not np.all(over <= _ROUNDING_RAD):
            axis = int(np.argmax(over))
            raise UnsafeCommandError(
                f"a command asks joint {axis + 1} for {dq[axis]:.4f} rad/s; it can do {self._dq_max[axis]:.3f} rad/s"
            )
