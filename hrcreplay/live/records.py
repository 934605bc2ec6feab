"""What goes into one tick of a live session, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np

from hrcreplay.egm.codec import AXES
from hrcreplay.records import Floats, HumanStates, SweptVolumes
from hrcreplay.robot.obstacles import Obstacles

#: Where a session is: nobody may move yet, the first answers, on the way to the programme, the programme itself,
#: braking for a reason of the watchdog, standing because of one.
PHASES = ("waiting", "echo", "approach", "following", "stopping", "holding")
WAITING, ECHO, APPROACH, FOLLOWING, STOPPING, HOLDING = range(len(PHASES))


class Signal(IntFlag):
    """What the loop found outside the stages and tells the pilot with an event. Part of the record."""

    NONE = 0
    INTERRUPT = 1  #: Ctrl-C
    TERMINATE = 2  #: SIGTERM
    DURATION = 4  #: the session's time is over
    PERSON_DEAD = 8  #: the human side's process has ended
    PERSON_LATE = 16  #: the human side gave no sign of life for too long
    PERSON_ENDED = 32  #: the recording of the person is over
    RECORDER_DEAD = 64  #: the recorder's process has ended
    OVERRUN = 128  #: the answer before this one came too late
    SCREEN_DEAD = 256  #: the screen's process has crashed


@dataclass(frozen=True, slots=True)
class TickEvent:
    """One wake-up of the control loop by the robot."""

    t_ns: int  #: session clock when the first of the datagrams was taken
    datagrams: tuple[bytes, ...]  #: all that lay in the queue, in order of arrival
    signals: Signal


@dataclass(frozen=True, slots=True)
class MotionRow:
    """What the robot was told in one answer. Angles in rad, positions in the world in m."""

    q_measured: Floats  #: (6,) where it said it was
    q: Floats  #: (6,) commanded position at the tick
    dq: Floats  #: (6,) commanded velocity at the tick
    u: Floats  #: (6,) acceleration applied from the tick on
    ref_m: Floats  #: (3,) programmed TCP position
    tcp_m: Floats  #: (3,) TCP position at ``q``
    rest: Floats  #: (4,) TCP speed, reference's speed [m/s], programmed time [s], separation [m]

    def flat(self) -> Floats:
        """(34,) all numbers one after another."""
        return np.concatenate((self.q_measured, self.q, self.dq, self.u, self.ref_m, self.tcp_m, self.rest))

    @classmethod
    def of(cls, flat: Floats) -> MotionRow:
        """The inverse of ``flat``."""
        return cls(*np.split(flat, np.cumsum(WIDTHS)[:-1]))


#: Of the fields of a MotionRow.
WIDTHS = (AXES, AXES, AXES, AXES, 3, 3, 4)


@dataclass(frozen=True, slots=True)
class Answer:
    """What the pilot decided on an event."""

    t_ns: int  #: of the event
    look_ns: int  #: of the look whose volumes it kept clear of
    datagram: bytes | None  #: reply to the robot; None where none is due
    phase: int  #: index into PHASES
    status: int  #: index into records.STATUSES
    reason: str  #: why it braked: of the controller or of the watchdog; empty where it did not
    limb: int  #: of the nearest pair, index into the volumes' limbs; -1 without one
    link: int  #: of the nearest pair; -1 without one
    row: MotionRow | None  #: None where no reply was due


@dataclass(frozen=True, slots=True)
class Sight:
    """What is known of the person after a look."""

    t_ns: int
    states: HumanStates  #: one row
    volumes: SweptVolumes  #: one row
    around: Obstacles
