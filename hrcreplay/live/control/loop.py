"""The control loop: receives a packet, answers it, updates the perception, and hands records to the other processes.

The loop waits for no other process. A perception update that lasts into the next packet delays the answer to it. The
update after that answer is left out, so that the next answer is on time again; the swept volumes are then one cycle
older, which `live.reaction_s` allows for.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from hrcreplay.egm.udp_server import Address, EgmServer, Received
from hrcreplay.live.control.session_controller import SessionController
from hrcreplay.live.control.watchdog import REFUSED
from hrcreplay.live.processes import HelperProcess
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, Signal, TickEvent
from hrcreplay.robot.control.stopping import Stop

_BIN_NS = 5_000
_BINS = 20_000  # up to 0.1 s; the last one holds all that took longer


class DurationHistogram:
    """Histogram of durations in steps of 5 us: quantiles of any number of them in constant memory."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, dtype=np.int64)

    def add(self, duration_ns: int) -> None:
        """Counts a duration [ns]."""
        self._counts[min(max(duration_ns, 0) // _BIN_NS, _BINS - 1)] += 1

    def quantiles_us(self, *shares: float) -> list[float] | None:
        """Upper ends of the steps in which these shares of all lie; None where there is nothing [us]."""
        total = np.cumsum(self._counts)
        if not total[-1]:
            return None
        places = np.searchsorted(total, np.ceil(np.array(shares) * total[-1]))
        return [float((place + 1) * _BIN_NS / 1e3) for place in places]


#: Signals after which the session ends as soon as the robot stands. A process that is gone does not come back.
ENDING = (
    Signal.INTERRUPT
    | Signal.TERMINATE
    | Signal.DURATION
    | Signal.PERSON_ENDED
    | Signal.PERSON_DEAD
    | Signal.RECORDER_DEAD
    | Signal.SCREEN_DEAD
)

#: Answers at speed 0 before we leave: a robot keeps obeying the last one.
FINAL_ANSWERS = 5


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the control loop; see ``settings.sections.Live``."""

    duration_s: float  #: inf: until it is stopped
    sending: bool
    person_late_s: float
    overrun_s: float
    keep_recorder: bool
    store_every_s: float  #: between two perception updates whose volumes are recorded complete


@dataclass
class Loop:
    """The control loop of one session."""

    controller: SessionController
    link: EgmServer
    person: HelperProcess
    recorder: HelperProcess
    settings: LoopSettings
    anchor_ns: int
    start_ns: int
    screen: HelperProcess | None = None
    caught: Signal = Signal.NONE  #: by the handlers of the operating system's signals
    signals: Signal = Signal.NONE  #: of the latest cycle
    notes: list[str] = field(default_factory=list)
    reply_times: DurationHistogram = field(default_factory=DurationHistogram)
    answers: int = 0
    skipped: int = 0  #: perception updates left out
    robot: str | None = None
    last: Decision | None = None
    sent: bytes | None = None  #: the latest reply that went to the robot
    stop: Stop | None = None  #: what goes on after it
    sender: Address | None = None  #: where the robot's packets come from
    pending: Received | None = None  #: what is not answered yet
    stored: bytes | None = None  #: the latest swept volumes that were recorded complete
    _bodies: list[bytes] = field(default_factory=list)
    _beat_ns: int = 0
    _late: bool = False
    _skipped: bool = False
    _ended: bool = False
    _stored_ns: int = 0

    def now_ns(self) -> int:
        """The session's clock: monotonic, beginning at the time of day."""
        return time.monotonic_ns() + self.anchor_ns

    def begin(self) -> None:
        """Starts the human side."""
        self.link.clear()
        self._beat_ns = self.now_ns()
        self.person.send(b"G" + self.start_ns.to_bytes(8, "little"))

    def run_cycle(self) -> bool:
        """Runs one cycle: answers a packet and updates the perception; False when the session is over."""
        received = self.pending = self.link.newest()
        signals = self.signals = self._signals()
        if received is None:
            t_ns = self.now_ns()
            self.controller.silence(t_ns, signals)
            self.recorder.send(codec.encode_timeout(t_ns, signals))
        else:
            self._answer(received, signals)
        self._skipped = received is not None and received.waited and not self._skipped
        if self._skipped:
            self.skipped += 1
            self.controller.prepare()
        else:
            self._update_perception()
        return not self._over(signals)

    def _answer(self, received: Received, signals: Signal) -> None:
        event = TickEvent(received.t_ns + self.anchor_ns, (*received.older, received.data), signals)
        answer = self.controller.answer(event)
        if answer.datagram is not None and self.settings.sending:
            self.link.answer(answer.datagram, received.sender)
            self.sent, self.sender, self.stop = answer.datagram, received.sender, answer.stop
        self.pending = None
        took_ns = self.now_ns() - event.t_ns
        self._late = took_ns > self.settings.overrun_s * 1e9
        self.robot = "{}:{}".format(*received.sender)
        for datagram in event.datagrams:
            self.recorder.send(codec.encode_robot_packet(event.t_ns, datagram))
        self.recorder.send(codec.encode_decision(answer, signals, len(event.datagrams), took_ns // 1000))
        if answer.datagram is not None:
            self.answers += 1
            self.reply_times.add(took_ns)
            self.recorder.send(codec.encode_reply(event.t_ns, answer.datagram, sent=self.settings.sending))
        self.last = answer

    def _update_perception(self) -> None:
        skeletons = self._receive_skeletons()
        t_ns = self.now_ns()
        perception = self.controller.update_perception(t_ns, skeletons)
        for skeleton in skeletons:
            self.recorder.send(codec.encode_skeleton(t_ns, skeleton))
        if perception is None:
            self.recorder.send(codec.encode_event(t_ns, {"what": "blind"}))
            return
        self.recorder.send(codec.encode_perception(perception.states, perception.volumes, len(skeletons)))
        if t_ns - self._stored_ns >= self.settings.store_every_s * 1e9:
            self._stored_ns = t_ns
            self.stored = codec.encode_volumes(perception.volumes, perception.horizon_s)
            self.recorder.send(self.stored)

    def _receive_skeletons(self) -> list[bytes]:
        skeletons = []
        for message in self.person.messages():
            self._beat_ns = self.now_ns()
            kind = message[:1]
            if kind in (b"f", b"F"):
                self._bodies.append(message[1:])
                if kind == b"F":  # the last body of its frame: half a frame could be somebody else's
                    skeletons += self._bodies
                    self._bodies = []
            elif kind == b"N":
                self.note(message[1:].decode(errors="replace"))
            elif kind == b"Z":
                self._ended = True
        return skeletons

    def note(self, text: str) -> None:
        """Keeps a note for the user and records it."""
        self.notes.append(text)
        self.recorder.send(codec.encode_event(self.now_ns(), {"what": "note", "text": text}))

    def _signals(self) -> Signal:
        now_ns, found = self.now_ns(), self.caught
        if now_ns - self.start_ns >= self.settings.duration_s * 1e9:
            found |= Signal.DURATION
        if self._ended:
            found |= Signal.PERSON_ENDED
        elif not self.person.alive:
            found |= Signal.PERSON_DEAD
        elif now_ns - self._beat_ns > self.settings.person_late_s * 1e9:
            found |= Signal.PERSON_LATE
        if self.settings.keep_recorder and not self.recorder.check_alive():
            found |= Signal.RECORDER_DEAD
        if self.screen is not None and self.screen.crashed():
            found |= Signal.SCREEN_DEAD
        if self._late:
            found |= Signal.OVERRUN
        return found

    def _over(self, signals: Signal) -> bool:
        if self.controller.stop in REFUSED:
            return True
        ending = bool(signals & ENDING) or self.controller.fault is not None
        return ending and (self.controller.standing >= FINAL_ANSWERS or not self.controller.connected)
