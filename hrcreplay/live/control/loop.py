"""The control loop: receives a packet, answers it, updates the perception, and hands records to the other processes.

The loop does not wait for other processes. A packet that arrives during a perception update is answered after the half
of the update that is under way, so that even an update of nearly two cycles misses none. The swept volumes are then one
cycle older, which `live.reaction_s` allows for.

After a crash of the control process a fallback brakes the robot from the last reply until it is at rest. It does not
use the controller, the stages, the protocol's state machine or the codec, because any of them may have failed. Its
numbers are in degrees, as on the link.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from hrcreplay.egm import motion_link_pb2 as messages
from hrcreplay.egm.codec import ARM_JOINTS
from hrcreplay.egm.link import Address, EgmServer, Received
from hrcreplay.egm.step_gate import StepGate
from hrcreplay.human.fusion.disbelief import disbelieved
from hrcreplay.live.control.session_controller import FAULT, REFUSED, SessionController
from hrcreplay.live.processes import HelperProcess
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, Perception, Signal, TickEvent
from hrcreplay.live.record.recorder import LOW
from hrcreplay.records import MotionRow
from hrcreplay.robot.control.control_step import BRAKING
from hrcreplay.robot.control.stops import Stop

_BIN_NS = 5_000
_BINS = 20_000  # up to 0.1 s; the last bin counts all longer durations


class DurationHistogram:
    """Histogram of durations in steps of 5 us; it gives quantiles of any number of durations in constant memory."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, dtype=np.int64)

    def add(self, duration_ns: int) -> None:
        """Counts a duration [ns]."""
        self._counts[min(max(duration_ns, 0) // _BIN_NS, _BINS - 1)] += 1

    def quantiles_us(self, *shares: float) -> list[float] | None:
        """Quantiles for the shares, rounded up to the next step; None without durations [us]."""
        total = np.cumsum(self._counts)
        if not total[-1]:
            return None
        places = np.searchsorted(total, np.ceil(np.array(shares) * total[-1]))
        return [float((place + 1) * _BIN_NS / 1e3) for place in places]


#: Signals that end the session as soon as the robot is at rest. A process that has ended is not started again.
ENDING = (
    Signal.INTERRUPT
    | Signal.TERMINATE
    | Signal.HANGUP
    | Signal.QUIT
    | Signal.SUSPEND
    | Signal.OTHER
    | Signal.DISK
    | Signal.DURATION
    | Signal.PERSON_ENDED
    | Signal.PERSON_DEAD
    | Signal.RECORDER_DEAD
    | Signal.SCREEN_DEAD
)

#: Number of answers with speed 0 before the session ends, because a robot keeps following the last answer.
FINAL_ANSWERS = 5


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the control loop; see ``settings.sections.Live``."""

    duration_s: float  #: inf: until the user stops it
    sending: bool
    person_late_s: float
    overrun_s: float
    keep_recorder: bool
    store_every_s: float  #: interval between two perception updates whose volumes are recorded completely


@dataclass
class Loop:
    """The control loop of one session."""

    controller: SessionController
    link: EgmServer
    person: HelperProcess
    recorder: HelperProcess
    settings: LoopSettings
    gate: StepGate
    anchor_ns: int
    start_ns: int
    screen: HelperProcess | None = None
    caught: Signal = Signal.NONE  #: signals of the operating system
    signals: Signal = Signal.NONE  #: signals of the latest cycle
    notes: list[str] = field(default_factory=list)
    reply_times: DurationHistogram = field(default_factory=DurationHistogram)
    answers: int = 0
    skipped: int = 0  #: number of answers during a perception update; their cycles have no update of their own
    robot: str | None = None
    last: Decision | None = None
    sent: bytes | None = None  #: the latest reply that was sent to the robot
    stop: Stop | None = None  #: the stop that continues after it
    sender: Address | None = None  #: source address of the robot's packets
    pending: Received | None = None  #: packets that are not answered yet
    stored: bytes | None = None  #: the latest swept volumes that were recorded completely
    _bodies: list[bytes] = field(default_factory=list)
    _beat_ns: int = 0
    _late: bool = False
    _ended: bool = False
    _stored_ns: int = 0
    _low_disk: bool = False
    _strangers: int = 0  # number of other senders that have been reported
    _place: str = ""  # place that has been reported
    _others: bool = False  # whether another body than the first person has been reported
    _events: int = 0  # number of kinds of events that have been looked at
    _disbelieved: set[str] = field(default_factory=set)  # cameras that have been reported

    def now_ns(self) -> int:
        """The session's clock [ns]: monotonic, and set to Unix time at the start."""
        return time.monotonic_ns() + self.anchor_ns

    def begin(self) -> None:
        """Starts the flow of skeletons."""
        self.link.clear()
        self._beat_ns = self.now_ns()
        self.person.send(b"G" + self.start_ns.to_bytes(8, "little"))

    def run_cycle(self) -> bool:
        """Runs one cycle: answers a packet and updates the perception; returns False when the session is over."""
        received = self.pending = self.link.newest()
        self._tell_strangers()
        signals = self.signals = self._signals()
        if received is None:
            t_ns = self.now_ns()
            self.controller.silence(t_ns, signals)
            self.recorder.send(codec.encode_timeout(t_ns, signals))
        else:
            self._answer(received, signals)
        self._update_perception()
        self.controller.prepare()
        return not self._over(signals)

    def _answer_waiting(self) -> None:
        """Answers a packet that has arrived during a perception update."""
        received = self.pending = self.link.waiting()
        if received is not None:
            self.skipped += 1
            self._answer(received, self._signals())

    def _answer(self, received: Received, signals: Signal) -> None:
        event = TickEvent(received.t_ns + self.anchor_ns, (*received.older, received.data), signals)
        answer = self.controller.answer(event)
        if answer.datagram is not None and self.settings.sending:
            self.send(answer.datagram, received)
            self.sent, self.sender, self.stop = answer.datagram, received.sender, answer.stop
        self.pending = None
        self._tell_place()
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

    def send(self, datagram: bytes, received: Received | None) -> None:
        """Sends a command to the source address of the robot's packets; no other code sends to the robot.

        Raises:
            UnsafeCommandError: The command requires a longer way than the axes can travel.
        """
        measured = None
        if received is not None and self.sent is None:
            axes = self.controller.setup.robot.nv
            told = (_measured(data, axes) for data in (received.data, *reversed(received.older)))
            measured = next((np.radians(joints) for joints in told if joints is not None), None)
        to = self.sender if received is None else received.sender
        if to is not None:
            self.gate.check(datagram, measured, self.now_ns() if received is None else received.t_ns + self.anchor_ns)
            self.link.answer(datagram, to)

    def _update_perception(self) -> None:
        skeletons = self._receive_skeletons()
        t_ns = self.now_ns()
        states = self.controller.fuse(t_ns, skeletons)
        if states is not None:  # otherwise the next answer must stop the robot, so the failure is recorded first
            self._answer_waiting()
        perception = self.controller.predict(t_ns, states)
        for skeleton in skeletons:
            self.recorder.send(codec.encode_skeleton(t_ns, skeleton))
        self._tell_others(perception)
        self._tell_disbelief()
        if perception is None:
            self.recorder.send(codec.encode_event(t_ns, {"what": "blind"}))
            return
        self.recorder.send(codec.encode_perception(perception, len(skeletons)))
        if t_ns - self._stored_ns >= self.settings.store_every_s * 1e9:
            self._stored_ns = t_ns
            self.stored = codec.encode_volumes(perception)
            self.recorder.send(self.stored)
        self._answer_waiting()

    def _receive_skeletons(self) -> list[bytes]:
        skeletons = []
        for message in self.person.messages():
            self._beat_ns = self.now_ns()
            kind = message[:1]
            if kind in (b"f", b"F"):
                self._bodies.append(message[1:])
                if kind == b"F":  # the frame is complete; an incomplete frame could lack the person
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

    def _tell_strangers(self) -> None:
        """Reports other senders to the robot's port: the first few senders, each once."""
        for address, port in self.link.strangers_seen()[self._strangers :]:
            self._strangers += 1
            robot = self.link.robot
            why = f"live.robot_address is {robot}" if address != robot else "another port of the robot is answered"
            self.note(f"datagrams of {address}:{port} are not heard: {why}")

    def _tell_place(self) -> None:
        """Reports each place at which the robot begins too near to an object or to itself."""
        if (near := self.controller.too_near) != self._place:
            self._place = near
            if near:
                self.note(
                    f"the robot begins too near: {near}; would be right: move it away by hand, and start EGM again"
                )

    def _tell_others(self, perception: Perception | None) -> None:
        """Reports once that cameras show another body than the first person, and whether the robot reacts to it."""
        if self._others:
            return
        if perception is not None and len(perception.states) > 1:
            self._others = True
            self.note("cameras show several people: the robot keeps clear of all of them")
        elif self.controller.observer.counts["person_frames_beside_others"]:
            self._others = True
            self.note(
                "cameras show another body than the person: by logs.people = nearest the robot keeps clear of one "
                "person only, the one nearest to the last position"
            )

    def _tell_disbelief(self) -> None:
        """Reports each camera once whose view of some points is not believed."""
        counts = self.controller.observer.counts
        if len(counts) == self._events:  # the first frame of a kind adds its count
            return
        self._events = len(counts)
        for camera, points in disbelieved(counts).items():
            if camera not in self._disbelieved:
                self._disbelieved.add(camera)
                self.note(
                    f"camera {camera} shows {', '.join(points)} wrong over time, and another camera elsewhere: left "
                    "out until they agree; look at what hides it from the camera, and at the camera's pose"
                )

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
        self._low_disk |= any(message == LOW for message in self.recorder.messages())
        if self._low_disk:
            found |= Signal.DISK
        if self.settings.keep_recorder and not self.recorder.alive:
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


#: After this many waits of the link without a packet, the robot no longer listens; it stops by itself.
_SILENCES = 25

_COUNTER = 2**32


@dataclass
class FallbackBrake:
    """Continues the certified stop of the last reply; if that stop is unknown, brakes by Eq. (67).

    Joints are in the order of EGM. Positions by Eq. (67) are clipped to the limits; those of the stop are within them.
    """

    ddq_max: Sequence[float]  #: [deg/s^2]
    q_min: Sequence[float]  #: [deg]
    q_max: Sequence[float]  #: [deg]
    cycle_s: float
    tracking: float  #: if the robot is further than this from the last command, braking starts at its position [deg]
    q: list[float]  #: last command [deg]
    dq: list[float]  #: last command [deg/s]
    seqno: int  #: of the last reply
    stop: list[tuple[list[float], list[float]]]  #: rest of the stop: joints [deg], speeds [deg/s], one row per cycle

    @property
    def at_rest(self) -> bool:
        """Return whether the last command is standstill."""
        return not any(self.dq)

    def update_position(self, measured: Sequence[float]) -> None:
        """Takes the measured joints [deg]; if they are too far from the last reply, starts again from them."""
        if max(abs(m - q) for m, q in zip(measured, self.q, strict=True)) > self.tracking:
            self.q, self.dq, self.stop = list(measured), [0.0] * len(measured), []

    def step(self, tm_ms: int) -> bytes:
        """The reply of one cycle, with the session's time stamp ``tm_ms`` [ms]."""
        if self.stop:
            self.q, self.dq = self.stop.pop(0)
        else:
            self._brake_each_axis()
        self.seqno = (self.seqno + 1) % _COUNTER
        message = messages.SensorMessage()
        message.header.seqno, message.header.tm = self.seqno, tm_ms % _COUNTER
        message.header.mtype = messages.TYPE_CORRECTION
        for place, values in ((message.planned, self.q), (message.speed_reference, self.dq)):
            place.joints.joints.extend(values[:ARM_JOINTS])
            if values[ARM_JOINTS:]:
                place.external_joints.joints.extend(values[ARM_JOINTS:])
        return bytes(message.SerializeToString())

    def _brake_each_axis(self) -> None:
        for axis, (q, dq) in enumerate(zip(self.q, self.dq, strict=True)):
            slower = math.copysign(max(0.0, abs(dq) - self.ddq_max[axis] * self.cycle_s), dq)
            there = q + 0.5 * self.cycle_s * (dq + slower)
            held = min(max(there, min(self.q_min[axis], q)), max(self.q_max[axis], q))
            self.q[axis], self.dq[axis] = held, slower if held == there else 0.0


def bring_to_rest(loop: Loop, why: str) -> None:
    """Answers the robot until it is at rest. Without an earlier reply it does nothing, because the robot has not moved.

    If the link cannot be read, the replies go to the last address of the robot, one per cycle of the robot.

    Args:
        loop: The loop that has crashed.
        why: Reason of the crash, for the record.
    """
    with suppress(Exception):
        if loop.controller.stop != FAULT:
            loop.controller.stop = FAULT
            loop.controller.stops.append((loop.now_ns(), FAULT))
        loop.recorder.send(codec.encode_event(loop.now_ns(), {"what": "crash", "text": why}))
    brake = _brake(loop)
    if brake is None or loop.sender is None:
        return
    standing = silences = 0
    received = loop.pending
    while standing < FINAL_ANSWERS and silences < _SILENCES:
        try:
            received = received or loop.link.newest()
        except Exception:  # any error: the robot must still be braked
            time.sleep(brake.cycle_s)
        else:
            if received is None:
                silences += 1
                continue
        measured = None if received is None else _measured(received.data, len(brake.q))
        if received is None or measured is not None:
            if measured is not None:
                brake.update_position(measured)
            before = list(brake.q), list(brake.dq)
            data, sent = brake.step(loop.now_ns() // 1_000_000), False
            with suppress(Exception):
                loop.send(data, received)
                sent = True
            with suppress(Exception):  # the stop has priority over the record
                _record(loop, received, measured, before, brake, data, sent=sent)
            standing = standing + 1 if brake.at_rest else 0
        received = None


def _brake(loop: Loop) -> FallbackBrake | None:
    if loop.sent is None:
        return None
    told = messages.SensorMessage.FromString(loop.sent)
    setup = loop.controller.setup
    robot, order = setup.robot, setup.joint_order
    ddq_max, q_min, q_max = (np.degrees(bound[order]).tolist() for bound in (robot.ddq_max, robot.q_min, robot.q_max))
    q, dq = _joints(told.planned), _joints(told.speed_reference)
    tracking = math.degrees(setup.bounds.tracking_rad)
    stop: list[tuple[list[float], list[float]]] = []
    if loop.stop is not None:
        rows = (np.degrees(numbers[1:, order]).tolist() for numbers in (loop.stop.q, loop.stop.dq))
        stop = list(zip(*rows, strict=True))
    return FallbackBrake(ddq_max, q_min, q_max, setup.plan.dt_s, tracking, q, dq, told.header.seqno, stop)


def _joints(place: Any) -> list[float]:
    """Joints of one part of a message, external joints last."""
    return [*place.joints.joints, *place.external_joints.joints]


def _measured(data: bytes, axes: int) -> list[float] | None:
    """Joint positions in a datagram of a robot with ``axes`` axes [deg]; None for a datagram without them."""
    try:
        joints = _joints(messages.RobotMessage.FromString(data).feed_back)
    except DecodeError:
        return None
    return joints if len(joints) == axes and all(map(math.isfinite, joints)) else None


def _record(
    loop: Loop,
    received: Received | None,
    measured: list[float] | None,
    before: tuple[list[float], list[float]],
    brake: FallbackBrake,
    data: bytes,
    *,
    sent: bool,
) -> None:
    """Records a row of the motion; the values of the stages are unknown in it."""
    t_ns = loop.now_ns() if received is None else received.t_ns + loop.anchor_ns
    datagrams = () if received is None else (*received.older, received.data)
    for datagram in datagrams:
        loop.recorder.send(codec.encode_robot_packet(t_ns, datagram))
    by_axis = np.argsort(loop.controller.setup.joint_order)
    q, dq, after = (np.radians(numbers)[by_axis] for numbers in (*before, brake.dq))
    u = (after - dq) / brake.cycle_s
    where = np.full(len(q), np.nan) if measured is None else np.radians(measured)[by_axis]
    unknown = np.full(3, np.nan)
    row = MotionRow(
        q=q,
        dq=dq,
        u=u,
        ref_m=unknown,
        tcp_m=unknown,
        tcp_speed=np.nan,
        ref_speed=np.nan,
        programme_s=np.nan,
        distance_m=np.nan,
        overlap_m=np.nan,
        limb=-1,
        link=-1,
        status=BRAKING,
        reason=FAULT,
        horizon_s=np.nan,
        tau_s=np.nan,
        certified=False,
    )
    phase = codec.HOLDING if brake.at_rest else codec.STOPPING
    answer = Decision(t_ns, 0, data, phase, where, row, "", None)
    loop.recorder.send(codec.encode_decision(answer, Signal.NONE, len(datagrams), 0))
    loop.recorder.send(codec.encode_reply(t_ns, data, sent=sent))
