"""The controller of a live session: decides the command of each cycle; its watchdog decides when the robot must stop.

The controller depends only on its events: the same events in the same order give the same bits, so a recorded session
can be computed again. Every condition that must stop a live robot has the name of its stop reason.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hrcreplay.egm.codec import BadPacket, Correction, RobotPacket, decode_robot, encode_correction
from hrcreplay.egm.link import ALARMS, EgmSession, PacketStatus
from hrcreplay.live.control.stages import ControlSetup, MotionState, MotionStep, Observer, brake, follow, start_approach
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, Perception, Signal, TickEvent
from hrcreplay.pipeline.stages import NS
from hrcreplay.records import Floats, HumanStates, MotionRow
from hrcreplay.robot.control.control_step import RobotState, motion_row
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.control.static_obstacles import pair_too_near
from hrcreplay.robot.control.stops import at_rest
from hrcreplay.settings.sections import Live

#: Reasons that end a session normally; every other reason ends it as a stop.
SESSION_OVER, RECORDING_OVER = "session over", "recording of the person over"

INTERRUPTED, TERMINATED, HUNG_UP, QUIT, SUSPENDED = "Ctrl-C", "SIGTERM", "SIGHUP", "SIGQUIT", "Ctrl-Z"
OTHER_SIGNAL = "signal of the system"
DISK_FULL = "disk nearly full"
PERSON_DEAD, PERSON_LATE = "human side dead", "human side late"
RECORDER_DEAD, SCREEN_DEAD = "recorder dead", "screen dead"
OVERRUN, SILENT = "tick overrun", "robot silent"
TOO_NEAR = "too near to an object"
NO_FRAME, UNCERTAIN, NOT_FINITE, TRACKING = "no fresh frame", "state uncertain", "not finite", "tracking error"
FAULT = "internal error"

#: Reasons that end a session, also after the robot has stopped for another reason.
_ENDINGS = (SESSION_OVER, RECORDING_OVER, INTERRUPTED, TERMINATED, HUNG_UP, QUIT, SUSPENDED, OTHER_SIGNAL)

#: Reasons after which the robot never moves again, for all settings.
_FINAL = (PERSON_DEAD, RECORDER_DEAD, SCREEN_DEAD, DISK_FULL, FAULT)

#: Reasons for which a robot is not answered at all.
REFUSED = ("radians", "axes")

#: Reasons by signal, the most important first.
SIGNALS = {
    Signal.INTERRUPT: INTERRUPTED,
    Signal.TERMINATE: TERMINATED,
    Signal.HANGUP: HUNG_UP,
    Signal.QUIT: QUIT,
    Signal.SUSPEND: SUSPENDED,
    Signal.OTHER: OTHER_SIGNAL,
    Signal.DISK: DISK_FULL,
    Signal.DURATION: SESSION_OVER,
    Signal.PERSON_ENDED: RECORDING_OVER,
    Signal.PERSON_DEAD: PERSON_DEAD,
    Signal.PERSON_LATE: PERSON_LATE,
    Signal.RECORDER_DEAD: RECORDER_DEAD,
    Signal.SCREEN_DEAD: SCREEN_DEAD,
    Signal.OVERRUN: OVERRUN,
}


def reason_of_signals(signals: Signal) -> str:
    """The stop reason from the signals of the loop; empty without one."""
    if not signals:
        return ""
    return next((reason for signal, reason in SIGNALS.items() if signal in signals), "")


def reason_of_robot(packet_status: PacketStatus) -> str:
    """The stop reason from the state of the robot; empty without one."""
    if packet_status.reason:
        return packet_status.reason
    return "" if packet_status.allowed else "robot not ready"


def reason_of_person(perception: Perception | None, t_ns: int, fresh_s: float, bounds: Live) -> str:
    """The stop reason from the knowledge of the people; empty without one.

    Every person needs a fresh frame, unless the watched area was known to be without that person as recently.

    Args:
        perception: The last perception update; None before the first.
        t_ns: Present instant [ns, session clock].
        fresh_s: Largest allowed age of a person's newest frame [s].
        bounds: Settings with the bounds of a person's uncertainty.
    """
    if perception is None:
        return NO_FRAME
    states, since_s = perception.states, (t_ns - perception.t_ns) / NS
    fresh = states.frame_age_s + since_s <= fresh_s
    away = states.nobody_s is not None and states.nobody_s + since_s <= fresh_s
    if not (fresh | away).all():
        return NO_FRAME
    followed = fresh & ~states.by_points
    if not math.isfinite(states.p[followed].sum() + states.v[followed].sum()):
        return NOT_FINITE
    limit = (bounds.uncertain_m, bounds.uncertain_m, bounds.uncertain_rad, bounds.uncertain_rad)
    return "" if (states.p_std[followed, : len(limit)] <= limit).all() else UNCERTAIN


def _reason_of_tracking(measured: Floats, commanded: Floats, bounds: Live) -> str:
    """The stop reason from the difference of measured and commanded joints, (n,) each [rad]; empty without one."""
    pairs = zip(measured.tolist(), commanded.tolist(), strict=True)  # plain floats take a third of the time
    return "" if all(abs(m - c) <= bounds.tracking_rad for m, c in pairs) else TRACKING


class _FreshPeople(NamedTuple):
    """What the watchdog says of the people while all their frames are fresh, so that an answer need not compute it."""

    t_ns: int  #: of the perception update
    oldest_s: float  #: age of the oldest of their newest frames then; NaN without a frame [s]
    reason: str  #: empty if the robot may move

    @classmethod
    def of(cls, perception: Perception, setup: ControlSetup) -> _FreshPeople:
        """Computes it at the end of a perception update."""
        oldest_s = float(perception.states.frame_age_s.max(initial=-math.inf))
        return cls(
            perception.t_ns, oldest_s, reason_of_person(perception, perception.t_ns, setup.fresh_s, setup.bounds)
        )

    def is_so(self, t_ns: int, fresh_s: float) -> bool:
        """Return whether all frames are still fresh at an instant not before the update [ns]."""
        return t_ns >= self.t_ns and self.oldest_s + (t_ns - self.t_ns) / NS <= fresh_s


class _ReadyStep(NamedTuple):
    """A step that was computed before its answer, and its row."""

    before: MotionState  #: the motion that it continues
    step: MotionStep
    row: MotionRow  #: with the step's reason

    @classmethod
    def of(cls, before: MotionState, step: MotionStep) -> _ReadyStep:
        """Makes the row of a step."""
        reference, programme_s = (step.reference_m, step.reference_speed), step.after.programme_s
        return cls(before, step, motion_row(before.state, step.step, *reference, programme_s))


#: Obstacles before the first perception update: nothing is known, so the robot stands.
_UNSEEN = Obstacles(np.empty((0, 3)), np.zeros(1, np.int64), np.empty(0), np.empty((0, 2, 3)), known=False)


class SessionController:
    """Answers the robot's packets: waits, approaches, follows its programme, stops and holds.

    Between two answers ``update_perception`` processes the frames of the cameras. The robot moves only while the
    watchdog has no stop reason. A stop reason is kept until the session ends or, with ``resume``, until it has been
    absent for ``resume_s``. A robot at rest always starts with an approach from its position, at approach speed.

    The step of the next answer depends only on the last answer and the last perception update. Therefore ``prepare``
    computes it before the packet arrives, and the answer only decides whether to use it. Without it, the answer
    computes the step itself.

    An answer may come between the two halves of a perception update, ``fuse`` and ``predict``. It uses the volumes of
    the update before, as if the new update had begun after it.
    """

    def __init__(self, setup: ControlSetup, observer: Observer, session: EgmSession) -> None:
        self.setup = setup
        self.observer = observer
        self._session = session
        self._still = np.zeros(setup.robot.nv)
        self._reorders = not np.array_equal(setup.joint_order, np.arange(setup.robot.nv))
        self.perception: Perception | None = None
        self.phase = codec.WAITING
        self.stop = ""  #: reason why the robot was stopped; empty while it may move
        self.stops: list[tuple[int, str]] = []  #: every stop: instant [ns] and reason
        self.waiting = ""  #: reason why the robot does not start
        self.too_near = ""  #: the link and the object, or the other link, at which the robot begins; empty without one
        self.fault: Exception | None = None  #: an error that stopped the robot; raised when the robot is at rest
        self.standing = 0  #: number of answers since the robot is at rest
        self._motion: MotionState | None = None  # None: no robot is connected
        self._ready: _ReadyStep | None = None
        self._fresh: _FreshPeople | None = None
        self._late = False  # whether the last perception update is too old for a certificate
        self._programme_s = 0.0  # programmed time of the last connected robot
        self._heard_ns: int | None = None
        self._clear_ns: int | None = None
        self._behind_ns: int | None = None  # start of an overrun: since then every event has packets of several cycles

    @property
    def connected(self) -> bool:
        """Return whether a robot is being answered."""
        return self._motion is not None

    @property
    def outlook(self) -> str:
        """Condition on which a robot at rest moves again; empty if it moves or if the session ends."""
        if self.phase == codec.WAITING and self.waiting:
            by_hand = "it moves once EGM has ended, the robot was moved away by hand, and EGM has started again"
            return by_hand if self.waiting == TOO_NEAR else "it moves as soon as that is over"
        if self.phase != codec.HOLDING or self.stop in (*_ENDINGS, *_FINAL):
            return ""
        if not self.setup.bounds.resume:
            return "it does not move again in this session; live.resume=true would let it"
        return f"it moves on once that has been over for {self.setup.bounds.resume_s:g} s"

    def counts(self) -> Counter[str]:
        """Counters of the person's frames and the robot's packets so far."""
        return self.observer.counts + Counter({f"robot {what}": n for what, n in self._session.counts.items()})

    def update_perception(self, t_ns: int, skeletons: Sequence[bytes]) -> Perception | None:
        """Updates stages 1 and 2 to ``t_ns`` [ns, session clock]; None if they failed, which stops the robot."""
        return self.predict(t_ns, self.fuse(t_ns, skeletons))

    def fuse(self, t_ns: int, skeletons: Sequence[bytes]) -> HumanStates | None:
        """First half of ``update_perception``; changes no answer unless it fails.

        Returns:
            The fused people; None if fusing them failed, which stops the robot.
        """
        try:
            return self.observer.fuse(t_ns, skeletons)
        except Exception as error:  # on any error the robot still needs answers
            self.fault = self.fault or error
            return None

    def predict(self, t_ns: int, states: HumanStates | None) -> Perception | None:
        """Second half of ``update_perception``, for the result of ``fuse`` at the same instant."""
        self.perception, self._ready, self._fresh, self._late = None, None, None, False
        if states is None:
            return None
        try:
            self.perception = self.observer.predict(t_ns, states, self._horizon_s())
            self._fresh = _FreshPeople.of(self.perception, self.setup)
        except Exception as error:  # on any error the robot still needs answers
            self.fault = self.fault or error
        return self.perception

    def prepare(self) -> None:
        """Computes the step of the next answer in advance; changes no answer."""
        if self._motion is not None:
            with suppress(Exception):  # the answer fails in the same way and reports it
                self._ready = _ReadyStep.of(self._motion, self._step(self._motion))

    def silence(self, t_ns: int, signals: Signal) -> None:
        """Handles a time-out without a packet from the robot."""
        self._check_silence(t_ns)
        why = reason_of_signals(signals)
        if why and not self.stop:
            self._stop(t_ns, why)

    def answer(self, event: TickEvent) -> Decision:
        """The reply to the robot's packets, and its reason."""
        self._check_silence(event.t_ns)  # a packet may end a silence before its time-out is handled
        packets = [self._decoded(data) for data in event.datagrams]
        cycles = {packet.clock_ns for packet in packets if packet is not None}
        self._behind_ns = (self._behind_ns or event.t_ns) if len(cycles) > 1 else None
        packet_status, packet = self._session.classify_all(packets, event.t_ns)
        look_ns = self.perception.t_ns if self.perception is not None else 0
        if packet is None:
            self._refuse(event.t_ns, packet_status)
            return Decision(event.t_ns, look_ns, None, self.phase, np.empty(0), None, self.stop, None)
        measured = packet.q
        self._heard_ns = event.t_ns
        if packet_status.fresh or self._motion is None:
            self._begin_session(measured)
        self._apply_watchdog(event, packet_status, measured)
        before = self._motion
        assert before is not None  # noqa: S101 - for the type checker
        self._look_late(event.t_ns)
        _, result, row = self._next_step(before)
        phase = self.phase
        reply = self._session.reply(result.step.next.q, result.step.next.dq, event.t_ns)
        told = RobotState(reply.q, reply.dq)  # an echo while the robot must not move
        stop = result.after.stop
        if told.q.tolist() != stop.q[0].tolist() or told.dq.tolist() != stop.dq[0].tolist():
            stop = self.setup.stop_from(told)
        self._motion = result.after._replace(state=told, stop=stop)
        self._programme_s = result.after.programme_s
        self._settle()
        if result.after.controller is None:
            row = row._replace(reason=self.stop or self.waiting)
        return Decision(event.t_ns, look_ns, self._encoded(reply), phase, measured, row, "", stop)

    def _decoded(self, data: bytes) -> RobotPacket | None:
        """A packet with its joints in the order of the robot's axes; unchanged if the number of axes differs."""
        try:
            packet = decode_robot(data)
        except BadPacket:
            return None
        order = self.setup.joint_order
        if len(packet.q) != len(order) or not self._reorders:
            return packet
        by_axis = np.empty_like(packet.q)
        by_axis[order] = packet.q
        return replace(packet, q=by_axis)

    def _encoded(self, reply: Correction) -> bytes:
        """A reply with its joints in the order of EGM."""
        if not self._reorders:
            return encode_correction(reply)
        order = self.setup.joint_order
        return encode_correction(replace(reply, q=reply.q[order], dq=reply.dq[order]))

    def _settle(self) -> None:
        """Updates the phase after an answer, depending on whether the robot is at rest."""
        moving = self._motion is not None and any(self._motion.state.dq.tolist())
        self.standing = 0 if moving else self.standing + 1
        if self.phase == codec.ECHO:
            self.phase = codec.HOLDING if self.stop else codec.WAITING
        elif self.phase == codec.STOPPING and not moving:
            self.phase = codec.HOLDING
        elif self.phase == codec.APPROACH and self._motion is not None and self._motion.arrived:
            self.phase = codec.FOLLOWING

    def _refuse(self, t_ns: int, packet_status: PacketStatus) -> None:
        """Handles datagrams without an answer: from a robot that must not move at all or must stop at once."""
        if packet_status.reason in REFUSED and not self.stop:
            self._stop(t_ns, packet_status.reason)
            self._motion, self.phase = None, codec.HOLDING
        elif packet_status.reason in ALARMS and self.phase in (codec.APPROACH, codec.FOLLOWING):
            self._stop(t_ns, packet_status.reason)
        self._check_silence(t_ns)

    def _check_silence(self, t_ns: int) -> None:
        """Resets the motion if the robot was silent for too long; it no longer listens and then starts at rest."""
        if self._heard_ns is None or t_ns - self._heard_ns <= self.setup.bounds.silent_s * 1e9:
            return
        if self.phase in (codec.APPROACH, codec.FOLLOWING, codec.STOPPING):
            self._stop(t_ns, SILENT)
        self._motion, self._heard_ns = None, None
        self.phase = codec.HOLDING if self.stop else codec.WAITING

    def _begin_session(self, measured: Floats) -> None:
        """Starts a new session of the robot from its measured joints, independent of earlier commands."""
        self._motion = MotionState(RobotState(measured, self._still), self._programme_s, at_rest(measured))
        self.phase = codec.ECHO
        static = self.setup.static
        self.too_near = "" if static is None else pair_too_near(self.setup.robot, static, measured)

    def _apply_watchdog(self, event: TickEvent, packet_status: PacketStatus, measured: Floats) -> None:
        """Applies the watchdog's verdict to the phase."""
        why = self._stop_reason(event, packet_status, measured)
        if self.phase in (codec.APPROACH, codec.FOLLOWING):
            if why:
                self._stop(event.t_ns, why)
            return
        if self.phase == codec.HOLDING and self.setup.bounds.resume:
            self._clear_ns = None if why else (self._clear_ns or event.t_ns)
            if self._clear_ns is not None and event.t_ns - self._clear_ns >= self.setup.bounds.resume_s * 1e9:
                self.stop, self.phase = "", codec.WAITING
            elif why and why not in _ENDINGS:
                self.stop = why  # the present reason
        if self.phase == codec.WAITING and self.too_near:
            why = why or TOO_NEAR  # no step from there can be certified
        self.waiting = why if self.phase == codec.WAITING else ""
        if self.phase == codec.WAITING and not why and self._motion is not None:
            self._motion, self.phase = start_approach(self.setup, self._motion), codec.APPROACH

    def _stop_reason(self, event: TickEvent, packet_status: PacketStatus, measured: Floats) -> str:
        """The stop reason of the watchdog; empty without one."""
        if self.fault is not None:
            return FAULT
        why = reason_of_signals(event.signals) or reason_of_robot(packet_status)
        behind_ns = 0 if self._behind_ns is None else event.t_ns - self._behind_ns
        if not why and behind_ns > self.setup.bounds.overrun_s * 1e9:
            why = OVERRUN
        if not why:
            why = self._reason_of_people(event.t_ns)
        if not why and self.setup.sending and self._motion is not None and self.phase != codec.ECHO:
            why = _reason_of_tracking(measured, self._motion.state.q, self.setup.bounds)
        return why

    def _reason_of_people(self, t_ns: int) -> str:
        """The stop reason from the knowledge of the people, which is looked up while their frames are fresh."""
        if self._fresh is not None and self._fresh.is_so(t_ns, self.setup.fresh_s):
            return self._fresh.reason
        return reason_of_person(self.perception, t_ns, self.setup.fresh_s, self.setup.bounds)

    def _stop(self, t_ns: int, why: str) -> None:
        self.stop, self.phase, self._clear_ns = why, codec.STOPPING, None
        self.stops.append((t_ns, why))
        if self._motion is not None:
            self._motion = self._motion._replace(controller=None)

    def _next_step(self, motion: MotionState) -> _ReadyStep:
        """The step of this tick: the precomputed step if it is still valid, otherwise a new one."""
        if self._ready is not None and self._ready.before is motion:
            ready = self._ready
        else:
            try:
                ready = _ReadyStep.of(motion, self._step(motion))
            except Exception as error:  # on any error the robot must brake
                self.fault = self.fault or error
                return self._fallback_stop(motion, FAULT)
        after = ready.step.step.next
        finite = math.isfinite(sum(after.q.tolist()) + sum(after.dq.tolist()))
        return ready if finite else self._fallback_stop(motion, NOT_FINITE)

    def _fallback_stop(self, motion: MotionState, why: str) -> _ReadyStep:
        """The stop of a robot whose step failed; repeated failures while it brakes count as one stop."""
        if not self.stop or self.phase in (codec.APPROACH, codec.FOLLOWING):
            self._stop(self._heard_ns or 0, why)
        return _ReadyStep.of(motion, brake(self.setup, motion, lambda _: _UNSEEN))

    def _step(self, motion: MotionState) -> MotionStep:
        return (brake if motion.controller is None else follow)(self.setup, motion, self._obstacles)

    def _look_late(self, t_ns: int) -> None:
        """Checks whether the volumes are too old for a new certificate; then only the certified stop is allowed."""
        age_s = math.inf if self.perception is None else (t_ns - self.perception.t_ns) * 1e-9
        self._late = self.setup.plan.certified and age_s > self.setup.bounds.perception_max_age_s
        if self._late:
            self._ready = None

    def _horizon_s(self) -> float:
        """Time for which the volumes of the next perception update must be valid [s]."""
        return self.setup.plan.horizon_s(self._motion.stop if self._motion is not None else at_rest(self._still))

    def _obstacles(self, horizon_s: float) -> Obstacles:
        """Swept volumes to keep clear of; unknown if the last perception update is too old.

        For horizon 0 (``ssm``) they are predicted again; for every other horizon they are those of the update.
        """
        if self.perception is None:
            return _UNSEEN
        return self.observer.around(self.perception, horizon_s, believed=not self._late)
