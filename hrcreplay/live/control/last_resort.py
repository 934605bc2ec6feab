"""The fallback after a crash of the control process: brakes the robot from the last reply until it stands.

Controller, stages, protocol and codec are not used, because any of them may have failed. Numbers are in degrees as they
go over the link.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from google.protobuf.message import DecodeError

from hrcreplay.egm import motion_link_pb2 as messages
from hrcreplay.egm.udp_server import Received
from hrcreplay.live.control import watchdog
from hrcreplay.live.control.loop import FINAL_ANSWERS, Loop
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, MotionRow, Signal
from hrcreplay.robot.control.control_step import BRAKING

#: A robot that says nothing for so many waits of the link has stopped listening; it stops by itself.
_SILENCES = 25

_COUNTER = 2**32


@dataclass
class FallbackBrake:
    """Goes on with the stop that was certified with the last reply, and where that is not known brakes by Eq. (67).

    Positions of Eq. (67) stay within limits; those of the stop do.
    """

    ddq_max: Sequence[float]  #: [deg/s^2]
    q_min: Sequence[float]  #: [deg]
    q_max: Sequence[float]  #: [deg]
    cycle_s: float
    tracking: float  #: a robot further than this from what it was told begins anew where it is [deg]
    q: list[float]  #: told last [deg]
    dq: list[float]  #: told last [deg/s]
    seqno: int  #: of the last reply
    stop: list[tuple[list[float], list[float]]]  #: what is left of it: joints [deg], speeds [deg/s], a row a cycle

    @property
    def at_rest(self) -> bool:
        """Whether the robot has been told to stand."""
        return not any(self.dq)

    def update_position(self, measured: Sequence[float]) -> None:
        """Takes the measured joints [deg]; starts again from them where they are too far from the last reply."""
        if max(abs(m - q) for m, q in zip(measured, self.q, strict=True)) > self.tracking:
            self.q, self.dq, self.stop = list(measured), [0.0] * len(measured), []

    def step(self, tm_ms: int) -> bytes:
        """The reply of one cycle, with our own stamp [ms]."""
        if self.stop:
            self.q, self.dq = self.stop.pop(0)
        else:
            self._brake_each_axis()
        self.seqno = (self.seqno + 1) % _COUNTER
        message = messages.SensorMessage()
        message.header.seqno, message.header.tm = self.seqno, tm_ms % _COUNTER
        message.header.mtype = messages.TYPE_CORRECTION
        message.planned.joints.joints.extend(self.q)
        message.speed_reference.joints.joints.extend(self.dq)
        return bytes(message.SerializeToString())

    def _brake_each_axis(self) -> None:
        for axis, (q, dq) in enumerate(zip(self.q, self.dq, strict=True)):
            slower = math.copysign(max(0.0, abs(dq) - self.ddq_max[axis] * self.cycle_s), dq)
            there = q + 0.5 * self.cycle_s * (dq + slower)
            held = min(max(there, min(self.q_min[axis], q)), max(self.q_max[axis], q))
            self.q[axis], self.dq[axis] = held, slower if held == there else 0.0


def bring_to_rest(loop: Loop, why: str) -> None:
    """Answers the robot until it stands. Does nothing where nothing was sent: then it has not been moved.

    Where not even the link can be read, the replies go at the robot's pace to where its packets last came from.

    Args:
        loop: That crashed.
        why: What the record is to say of it.
    """
    with suppress(Exception):
        if loop.controller.stop != watchdog.FAULT:
            loop.controller.stop = watchdog.FAULT
            loop.controller.stops.append((loop.now_ns(), watchdog.FAULT))
        loop.recorder.send(codec.encode_event(loop.now_ns(), {"what": "crash", "text": why}))
    brake, sender = _brake(loop), loop.sender
    if brake is None or sender is None:
        return
    standing = silences = 0
    received = loop.pending
    while standing < FINAL_ANSWERS and silences < _SILENCES:
        try:
            received = received or loop.link.newest()
        except Exception:  # whatever it is
            time.sleep(brake.cycle_s)
        else:
            if received is None:
                silences += 1
                continue
        sender = received.sender if received is not None else sender
        measured = None if received is None else _measured(received.data)
        if received is None or measured is not None:
            if measured is not None:
                brake.update_position(measured)
            before = list(brake.q), list(brake.dq)
            data = brake.step(loop.now_ns() // 1_000_000)
            with suppress(Exception):
                loop.link.answer(data, sender)
            with suppress(Exception):  # the record is worth less than the stop
                _record(loop, received, measured, before, brake, data)
            standing = standing + 1 if brake.at_rest else 0
        received = None


def _brake(loop: Loop) -> FallbackBrake | None:
    if loop.sent is None:
        return None
    told = messages.SensorMessage.FromString(loop.sent)
    robot, setup = loop.controller.setup.robot, loop.controller.setup
    ddq_max, q_min, q_max = (np.degrees(bound).tolist() for bound in (robot.ddq_max, robot.q_min, robot.q_max))
    q, dq = list(told.planned.joints.joints), list(told.speed_reference.joints.joints)
    tracking = math.degrees(setup.bounds.tracking_rad)
    stop: list[tuple[list[float], list[float]]] = []
    if loop.stop is not None:
        stop = list(zip(np.degrees(loop.stop.q[1:]).tolist(), np.degrees(loop.stop.dq[1:]).tolist(), strict=True))
    return FallbackBrake(ddq_max, q_min, q_max, setup.plan.dt_s, tracking, q, dq, told.header.seqno, stop)


def _measured(data: bytes) -> list[float] | None:
    """Where the robot is [deg]; None of a datagram that does not say it."""
    try:
        joints = list(messages.RobotMessage.FromString(data).feed_back.joints.joints)
    except DecodeError:
        return None
    return joints if len(joints) == 6 and all(map(math.isfinite, joints)) else None


def _record(
    loop: Loop,
    received: Received | None,
    measured: list[float] | None,
    before: tuple[list[float], list[float]],
    brake: FallbackBrake,
    data: bytes,
) -> None:
    """Records a row of the motion; what only the stages know is missing in it."""
    t_ns = loop.now_ns() if received is None else received.t_ns + loop.anchor_ns
    datagrams = () if received is None else (*received.older, received.data)
    for datagram in datagrams:
        loop.recorder.send(codec.encode_robot_packet(t_ns, datagram))
    q, dq = (np.radians(numbers) for numbers in before)
    u = (np.radians(brake.dq) - dq) / brake.cycle_s
    where = np.full(len(q), np.nan) if measured is None else np.radians(measured)
    unknown = np.full(3, np.nan)
    row = MotionRow(where, q, dq, u, unknown, unknown, *[np.nan] * 7)
    phase = codec.HOLDING if brake.at_rest else codec.STOPPING
    answer = Decision(t_ns, 0, data, phase, BRAKING, watchdog.FAULT, -1, -1, row, None)
    loop.recorder.send(codec.encode_decision(answer, Signal.NONE, len(datagrams), 0))
    loop.recorder.send(codec.encode_reply(t_ns, data, sent=True))
