"""The watchdog: every condition that must stop a live robot, with the name of its stop reason."""

from __future__ import annotations

import math

import numpy as np

from hrcreplay.egm.link import PacketStatus
from hrcreplay.live.record.codec import Perception, Signal
from hrcreplay.records import Floats
from hrcreplay.settings.sections import Live

#: What ends a session as it should; every other reason ends it as a stop.
SESSION_OVER, RECORDING_OVER = "session over", "recording of the person over"

INTERRUPTED, TERMINATED = "Ctrl-C", "SIGTERM"
PERSON_DEAD, PERSON_LATE = "human side dead", "human side late"
RECORDER_DEAD, SCREEN_DEAD = "recorder dead", "screen dead"
OVERRUN, SILENT = "tick overrun", "robot silent"
NO_FRAME, UNCERTAIN, NOT_FINITE, TRACKING = "no fresh frame", "state uncertain", "not finite", "tracking error"
FAULT = "internal error"

#: What ends a session whose robot may have been stopped for another reason.
ENDINGS = (SESSION_OVER, RECORDING_OVER, INTERRUPTED, TERMINATED)

#: Robots that are not answered at all.
REFUSED = ("radians", "axes")

#: Reasons by signal, the most important first.
SIGNALS = {
    Signal.INTERRUPT: INTERRUPTED,
    Signal.TERMINATE: TERMINATED,
    Signal.DURATION: SESSION_OVER,
    Signal.PERSON_ENDED: RECORDING_OVER,
    Signal.PERSON_DEAD: PERSON_DEAD,
    Signal.PERSON_LATE: PERSON_LATE,
    Signal.RECORDER_DEAD: RECORDER_DEAD,
    Signal.SCREEN_DEAD: SCREEN_DEAD,
    Signal.OVERRUN: OVERRUN,
}

_BASE = 4  #: x, y, heading and bend: the joints that carry the whole person


def of_signals(signals: Signal) -> str:
    """The reason that the loop itself has found, or none."""
    return next((reason for signal, reason in SIGNALS.items() if signal in signals), "")


def of_robot(packet_status: PacketStatus) -> str:
    """The reason that lies with the robot, or none."""
    if packet_status.reason:
        return packet_status.reason
    return "" if packet_status.allowed else "robot not ready"


def of_person(perception: Perception | None, age_s: float, bounds: Live) -> str:
    """The reason that lies with what is known of the person, or none."""
    if perception is None or not age_s <= bounds.fresh_s:
        return NO_FRAME
    std = perception.states.p_std[0, :_BASE]
    if not math.isfinite(perception.states.p.sum() + perception.states.v.sum()):
        return NOT_FINITE
    sure = max(std[0], std[1]) <= bounds.uncertain_m and max(std[2], std[3]) <= bounds.uncertain_rad
    return "" if sure else UNCERTAIN


def of_tracking(measured: Floats, commanded: Floats, bounds: Live) -> str:
    """The reason that the robot is not where it was told to be, or none; both (6,) [rad]."""
    return "" if np.abs(measured - commanded).max() <= bounds.tracking_rad else TRACKING
