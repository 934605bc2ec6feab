"""The controller's response to position references: a state machine stepped once per cycle, without clock and socket.

Settings have the controller's names and units (degrees); positions, speeds and accelerations are in radians.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, fields

import numpy as np

from hrcreplay.egm.codec import Correction
from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.robot import irb140

#: Time between two packets of a real controller [ns].
PERIOD_NS = 4_032_000
_PERIOD_S = PERIOD_NS * 1e-9
#: Maximum excess of a reference over the range, from the rounding of degrees [rad].
_ROUNDING_RAD = 1e-9


@dataclass(frozen=True, slots=True)
class Axes:
    """Limits of the axes."""

    low_deg: tuple[float, ...]
    """Lower end of the range [deg]."""
    high_deg: tuple[float, ...]
    """Upper end of the range [deg]."""
    speed_deg_per_s: tuple[float, ...]
    """Top speed [deg/s]."""
    acceleration_deg_per_s2: tuple[float, ...]
    """Top acceleration, either way [deg/s^2]."""


#: Range and speed of the product specification. The acceleration is not published; assumed: full speed to rest in 0.15
#: s.
IRB140 = Axes(
    low_deg=tuple(float(axis.range_deg[0]) for axis in irb140.AXES),
    high_deg=tuple(float(axis.range_deg[1]) for axis in irb140.AXES),
    speed_deg_per_s=tuple(float(axis.speed_deg_per_s) for axis in irb140.AXES),
    acceleration_deg_per_s2=tuple(axis.speed_deg_per_s / 0.15 for axis in irb140.AXES),
)


def axes_of(q_min: Floats, q_max: Floats, dq_max: Floats) -> Axes:
    """Makes the axes of any robot, (n,) each [rad, rad/s]; assumed: full speed to rest in 0.15 s."""
    low, high, speed = (tuple(np.degrees(bound).tolist()) for bound in (q_min, q_max, dq_max))
    return Axes(low, high, speed, tuple(of / 0.15 for of in speed))


@dataclass(frozen=True, slots=True)
class ServoSettings:
    """The session settings of RAPID. As delivered: ``max_speed_deviation_deg_per_s`` 1 and ``cond_time_s`` 1."""

    gain: float = 5.0
    """Proportional gain of the position loop, 0 to 20 [1/s]."""
    pos_corr_gain: float = 1.0
    """PosCorrGain, 0 to 1; 0: only the speed reference is followed."""
    filter_hz: float = 20.0
    """Low-pass filter of the speed; 0: off [Hz]."""
    max_speed_deviation_deg_per_s: float = 450.0
    """MaxSpeedDeviation: above it all axes are slowed together [deg/s]."""
    convergence_deg: float = 0.5
    """Distance to its reference at which an axis has converged [deg]."""
    cond_time_s: float = 0.0
    """CondTime: after convergence for this time the session ends; 0: never [s]."""
    comm_timeout_s: float = 1.0
    """CommTimeout: after the first message, a longer silence ends the session with an error [s]."""
    ramp_s: float = 0.5
    """Time in which a program stop or the end of the session brings the robot to rest [s]."""
    lag_cycles: int = 3
    """Delay of the measured joints behind the planned ones, in cycles."""
    axes: Axes = IRB140
    """Range, speed and acceleration of each axis."""

    def __post_init__(self) -> None:
        top = {"gain": 20.0, "pos_corr_gain": 1.0}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Axes):
                continue
            if not 0 <= value <= top.get(field.name, math.inf) or math.isinf(value):
                limit = f"0 to {top[field.name]:g}" if field.name in top else "a finite number from 0"
                raise SettingsError(f"robot double: {field.name} is {value}; {limit} would be right")
        for name in ("max_speed_deviation_deg_per_s", "comm_timeout_s", "ramp_s"):
            if getattr(self, name) == 0:
                raise SettingsError(f"robot double: {name} is 0; a positive number would be right")


class ServoController:
    """The controller in a session: takes at most one reference per cycle and moves the robot by one cycle.

    Attributes:
        motors_on: Set from outside. False: the brakes stop the robot. True again: the last reference is valid again.
        program_running: Set from outside. False: the robot ramps to rest. True again: the last reference is valid
            again.
        error: Error that ended the session; empty without one.
        converged: True: the session ended by convergence.
        ended_ns: Time of the end; None during the session.
        q: Planned joints (nv,) [rad].
        dq: Planned speed (nv,) [rad/s].
        utilization: Requested speed or acceleration relative to the limit; above 100 the robot cannot follow [%].
        reference: The current reference; None before the first of the session.
    """

    def __init__(self, settings: ServoSettings, q: Floats) -> None:
        self.settings = settings
        axes = settings.axes
        self.low, self.high = np.radians(axes.low_deg), np.radians(axes.high_deg)
        self.speed_max, self.acceleration_max = (
            np.radians(axes.speed_deg_per_s),
            np.radians(axes.acceleration_deg_per_s2),
        )
        self._speed_allowed = np.minimum(self.speed_max, math.radians(settings.max_speed_deviation_deg_per_s))
        self._gain_per_s = settings.gain * settings.pos_corr_gain
        self._passed = -math.expm1(-2 * math.pi * settings.filter_hz * _PERIOD_S) if settings.filter_hz else 1.0
        self.motors_on = True
        self.program_running = True
        self.q = np.array(q, dtype=np.float64)
        self.dq = np.zeros_like(self.q)
        self._trail = deque([self.q] * (settings.lag_cycles + 1), maxlen=settings.lag_cycles + 1)
        self.begin()

    def begin(self) -> None:
        """Starts a session; discards the state of the previous one."""
        self.error = ""
        self.converged = False
        self.ended_ns: int | None = None
        self.utilization = 0.0
        self.reference: Correction | None = None
        self._heard_ns: int | None = None
        self._near_since_ns: int | None = None
        self._halted: tuple[int, Floats] | None = None
        self._filtered = self.dq.copy()

    @property
    def measured(self) -> Floats:
        """Measured joints (nv,) [rad]: the planned ones of some cycles ago."""
        return self._trail[0]

    @property
    def moves(self) -> bool:
        """Returns True if references are followed: the session lasts, motors are on and the program runs."""
        return self.ended_ns is None and self.motors_on and self.program_running

    def step(self, t_ns: int, told: Correction | None) -> None:
        """One cycle: take the message, if any, then move until the next cycle.

        Args:
            t_ns: Start of the cycle [ns].
            told: The one message read in this cycle; without one the last is used again.
        """
        if told is not None and self.ended_ns is None:
            self._heard_ns = t_ns
            self.reference = told
        self._watch(t_ns)
        self.dq = self._keep_range(self._follow() if self.moves else self._halt(t_ns))
        self.q = np.clip(self.q + self.dq * _PERIOD_S, self.low, self.high)
        self._trail.append(self.q)

    def fail(self, t_ns: int, why: str) -> None:
        """Ends the session in an error."""
        if self.ended_ns is None:
            self.error, self.ended_ns = why, t_ns

    def _watch(self, t_ns: int) -> None:
        """Ends the session by time-out, by a reference out of range, or by convergence."""
        if self.reference is None or self._heard_ns is None or self.ended_ns is not None:
            return
        target = self.reference.q
        if t_ns - self._heard_ns > self.settings.comm_timeout_s * 1e9:
            self.fail(t_ns, "CommTimeout")
        elif np.any(target < self.low - _ROUNDING_RAD) or np.any(target > self.high + _ROUNDING_RAD):
            self.fail(t_ns, "reference out of range")
        elif not self.moves or np.any(np.abs(target - self.q) > math.radians(self.settings.convergence_deg)):
            self._near_since_ns = None
        elif self._near_since_ns is None:
            self._near_since_ns = t_ns
        elif self.settings.cond_time_s and t_ns - self._near_since_ns >= self.settings.cond_time_s * 1e9:
            self.converged, self.ended_ns = True, t_ns

    def _follow(self) -> Floats:
        """Returns the speed (nv,) [rad/s] of the control law: k (pos_ref - pos) + speed_ref, filtered, then limited."""
        self._halted = None
        raw = np.zeros_like(self.q)
        if self.reference is not None:
            raw = self._gain_per_s * (self.reference.q - self.q) + self.reference.dq
        self._filtered = self._filtered + self._passed * (raw - self._filtered)
        share = float(np.max(np.abs(self._filtered) / self._speed_allowed))
        change = self._filtered / max(1.0, share) - self.dq
        step = self.acceleration_max * _PERIOD_S
        self.utilization = 100.0 * max(share, float(np.max(np.abs(change) / step)))
        return self.dq + np.clip(change, -step, step)

    def _halt(self, t_ns: int) -> Floats:
        """Returns the speed (nv,) [rad/s] on the way to rest: by brakes if the motors are off, else by the ramp."""
        if self._halted is None:
            self._halted = (t_ns, self.dq)
        self.utilization = 0.0
        since_ns, dq = self._halted
        left = max(0.0, 1.0 - ((t_ns - since_ns) * 1e-9 + _PERIOD_S) / self.settings.ramp_s)
        step = self.acceleration_max * _PERIOD_S
        ramped = dq * left if self.motors_on else np.zeros_like(dq)
        self._filtered = self.dq + np.clip(ramped - self.dq, -step, step)
        return self._filtered

    def _keep_range(self, dq: Floats) -> Floats:
        """Limits the speed so that full braking ends within the range of each axis (nv,) [rad/s]."""
        return np.clip(dq, -self._fastest(self.q - self.low), self._fastest(self.high - self.q))

    def _fastest(self, room: Floats) -> Floats:
        """Returns the maximum speed from which the axes stop within a distance, cycle by cycle (nv,) [rad/s]."""
        step = self.acceleration_max * _PERIOD_S  # v T + (v - step) T + ... over n cycles is the distance
        n = np.maximum(1.0, np.ceil(np.sqrt(0.25 + 2 * np.maximum(room, 0.0) / (step * _PERIOD_S)) - 0.5))
        return np.maximum(room, 0.0) / (n * _PERIOD_S) + step * (n - 1) / 2
