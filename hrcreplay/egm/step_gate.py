"""The last check before the socket: blocks every command that is further from the last one than the axes can move.

It decodes the datagram to be sent and is independent of its source: of controller and session, and of the fallback that
brakes after a crash. It has no clock.
"""

from __future__ import annotations

from math import isfinite
from typing import Final

from hrcreplay.egm.codec import decode_correction
from hrcreplay.records import Floats


class UnsafeCommandError(Exception):
    """A command that must not be sent; the text gives its step and the allowed one."""


#: Rounding of a position in degrees on the link [rad], and of a duration.
_ROUNDING_RAD: Final = 1e-9
_ROUNDING: Final = 1e-6


class StepGate:
    """Limits commands to the motion of the axes, both from one to the next and over time.

    A command may use the time since the last one, and at least a cycle. With packets in quick succession this alone
    would allow too high a speed. So the time that a step needs is also taken from a store, which is refilled by the
    elapsed time and holds at most ``STORE`` cycles.
    """

    #: Number of cycles that a robot may catch up after late packets.
    STORE: Final = 25

    def __init__(self, dq_max: Floats, cycle_s: float) -> None:
        """Starts before the first command.

        Args:
            dq_max: (n,) top speeds of the axes [rad/s].
            cycle_s: The robot's cycle [s].
        """
        self._dq_max, self._cycle_s = dq_max.tolist(), cycle_s
        self._last: tuple[list[float], int] | None = None
        self._store_s = self.STORE * cycle_s

    def check(self, datagram: bytes, measured: Floats | None, t_ns: int) -> None:
        """Checks a command before it is sent.

        Args:
            datagram: The command.
            measured: (n,) measured joints [rad]; the first command must be within the motion of a cycle from there.
                None: not known.
            t_ns: Now.

        Raises:
            UnsafeCommandError: The command must not be sent. It then counts as not sent.
            BadPacket: The datagram is not a command.
        """
        told = decode_correction(datagram)
        q, axes = told.q.tolist(), len(self._dq_max)  # plain floats: arrays of six elements take 0.1 ms per tick
        last, last_ns = self._last or (None if measured is None else measured.tolist(), t_ns)
        if last is None:
            raise UnsafeCommandError("the first command; the robot's position is unknown, so none may be sent")
        if len(q) != axes or len(last) != axes:
            raise UnsafeCommandError(f"a command of {len(q)} joints; {axes} would be right")
        if not all(map(isfinite, last)):
            raise UnsafeCommandError("the first command; the robot reports a joint that is not a number")
        self._check_speed(told.dq.tolist())
        passed_s = max(0.0, (t_ns - last_ns) * 1e-9)
        takes_s = [
            max(abs(to - at) - _ROUNDING_RAD, 0.0) / most for to, at, most in zip(q, last, self._dq_max, strict=True)
        ]
        needs_s = max(takes_s) / (1.0 + _ROUNDING)
        store_s = max(passed_s, min(self._store_s + passed_s, self.STORE * self._cycle_s))
        allowed_s = min(max(passed_s, self._cycle_s), store_s)
        if not needs_s <= allowed_s:
            axis = takes_s.index(max(takes_s))
            raise UnsafeCommandError(
                f"a command leads joint {axis + 1} {takes_s[axis] * self._dq_max[axis]:.4f} rad from the last one "
                f"after {passed_s:.4f} s; at {self._dq_max[axis]:.3f} rad/s it goes no further than "
                f"{self._dq_max[axis] * allowed_s:.4f} rad"
            )
        self._last, self._store_s = (q, t_ns), store_s - needs_s

    def _check_speed(self, dq: list[float]) -> None:
        for axis, (speed, most) in enumerate(zip(dq, self._dq_max, strict=True), start=1):
            if not abs(speed) - most * (1.0 + _ROUNDING) <= _ROUNDING_RAD:
                raise UnsafeCommandError(
                    f"a command asks joint {axis} for {speed:.4f} rad/s; it can do {most:.3f} rad/s"
                )
