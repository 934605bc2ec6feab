"""Encoding and decoding of EGM datagrams, and the pose of the flange that a controller reports with the joints.

Degrees and millimetres are used only in this module. Each call makes a new protobuf message, as a reused message never
frees its memory (0.5 kB per packet).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from math import isfinite, nan, pi
from typing import Any, Final, Literal

import numpy as np
from google.protobuf.message import DecodeError

from hrcreplay.egm import motion_link_pb2 as messages
from hrcreplay.records import Floats
from hrcreplay.robot import irb140

#: The flange's z axis points outwards along the last axis: a quarter turn about y.
_FLANGE = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)


def flange_pose(q: Floats) -> Floats:
    """Computes the pose of the flange of an IRB 140 in the robot's base.

    Args:
        q: (6,) joints with the controller's zero positions and signs [rad].

    Returns:
        (7,) position [m], then quaternion w, x, y, z with w >= 0.
    """
    x = y = z = 0.0
    turn: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    for axis, angle in zip(irb140.AXES, q.tolist(), strict=True):
        sx, sy, sz = _turned(turn, axis.offset_m)
        x, y, z = x + sx, y + sy, z + sz
        half = [math.cos(angle / 2), 0.0, 0.0, 0.0]
        half[1 + axis.direction.index(1)] = math.sin(angle / 2)
        turn = _product(turn, tuple(half))
    turn = _product(turn, _FLANGE)
    sign = math.copysign(1.0, turn[0])
    return np.array([x, y, z, *(sign * part for part in turn)])


def _product(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
    """Product of two quaternions."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _turned(turn: tuple[float, ...], vector: tuple[float, float, float]) -> tuple[float, ...]:
    """Rotates a vector by a quaternion."""
    w, x, y, z = turn
    return _product(_product(turn, (0.0, *vector)), (w, -x, -y, -z))[1:]


#: Number of joints sent as joints of the arm; further ones, a seventh axis or external axes, are sent as external
#: joints.
ARM_JOINTS: Final = 6
#: Maximum number of joints in a message.
MOST_JOINTS: Final = 14
#: The counters of the link, ``seqno`` and ``tm``, wrap at this value.
WRAP: Final = 2**32

_RAD_PER_DEG: Final = pi / 180.0
_DEG_PER_RAD: Final = 180.0 / pi
_MM_PER_M: Final = 1000.0
_NS_PER_S: Final = 1_000_000_000
_LATEST_NS: Final = 2**63  # range of int64 in a record


class BadPacket(ValueError):
    """A datagram that is not a message of the link; the text gives the reason."""


class Motors(IntEnum):
    """State of the motors."""

    UNDEFINED = 0
    ON = 1
    OFF = 2


class Mci(IntEnum):
    """State of the motion correction interface, the part of the controller that executes EGM."""

    UNDEFINED = 0
    ERROR = 1
    STOPPED = 2
    RUNNING = 3


class Rapid(IntEnum):
    """State of the program on the controller."""

    UNDEFINED = 0
    STOPPED = 1
    RUNNING = 2


@dataclass(frozen=True, slots=True)
class RobotPacket:
    """The feedback of the robot in one cycle.

    Attributes:
        seqno: The robot's counter; None if not sent.
        tm_ms: The robot's own stamp [ms], wraps at 2**32.
        clock_ns: Time of the feedback on the robot's clock; None below RobotWare 6.07, which sends radians.
        q: (n,) measured joints, those of the arm and then the external ones, as many as were sent [rad].
        q_planned: (n,) joints planned by the controller [rad].
        motors: One of ``Motors``.
        mci: One of ``Mci``.
        rapid: One of ``Rapid``.
        converged: True: the controller considers the target reached; this ends a session.
        utilization: Utilisation of the robot's limits [%]; NaN if not sent.
    """

    seqno: int | None
    tm_ms: int | None
    clock_ns: int | None
    q: Floats
    q_planned: Floats | None
    motors: int
    mci: int
    rapid: int
    converged: bool
    utilization: float


@dataclass(frozen=True, slots=True)
class Correction:
    """Reply to the robot: ``q`` (n,) [rad] and the speed reference ``dq`` (n,) [rad/s], external joints last."""

    seqno: int
    tm_ms: int
    q: Floats
    dq: Floats


def _parsed(kind: Any, data: bytes) -> Any:
    """Parses a message of a given type. Raises BadPacket."""
    if not data:
        raise BadPacket("empty datagram")
    try:
        return kind.FromString(data)
    except DecodeError:
        raise BadPacket(f"garbage: {len(data)} bytes that are no message") from None


def decode_robot(data: bytes) -> RobotPacket:
    """Decodes one datagram of the robot, of any edition.

    Without ``feedBack.time`` the joints are read as radians, because RobotWare below 6.07 sends radians.

    Raises:
        BadPacket: The datagram is empty, garbage or of another type, or has no joints or a joint that is not finite.
    """
    message = _parsed(messages.RobotMessage, data)
    header, feedback, planned = message.header, message.feed_back, message.planned
    if header.mtype not in (messages.TYPE_DATA, messages.TYPE_UNDEFINED):
        raise BadPacket(f"message type {header.mtype}: a robot sends {messages.TYPE_DATA}")
    clock_ns = _clock(feedback.time) if feedback.HasField("time") else None
    scale = 1.0 if clock_ns is None else _RAD_PER_DEG
    joints = _all_joints(feedback)
    if not joints:
        raise BadPacket("feedBack: no joints")
    if len(joints) > MOST_JOINTS:
        raise BadPacket(f"feedBack: {len(joints)} joints; at most {MOST_JOINTS} are right")
    return RobotPacket(
        seqno=header.seqno if header.HasField("seqno") else None,
        tm_ms=header.tm if header.HasField("tm") else None,
        clock_ns=clock_ns,
        q=_scaled(joints, scale, "feedBack"),
        q_planned=_scaled(_all_joints(planned), scale, "planned") if planned.HasField("joints") else None,
        motors=message.motor_state.state,
        mci=message.mci_state.state,
        rapid=message.rapid_state.state,
        converged=message.mci_convergence_met,
        utilization=message.utilization_rate if message.HasField("utilization_rate") else nan,
    )


def encode_correction(correction: Correction) -> bytes:
    """Encodes the answer to the robot: joints [deg] and speed reference [deg/s].

    Raises:
        ValueError: There are not 6 to 14 joints, or one is not finite; such an answer must not be sent.
    """
    q, dq = (correction.q * _DEG_PER_RAD).tolist(), (correction.dq * _DEG_PER_RAD).tolist()
    if not ARM_JOINTS <= len(q) <= MOST_JOINTS or len(dq) != len(q) or not all(map(isfinite, q + dq)):
        raise ValueError(
            f"correction {correction.q} rad, {correction.dq} rad/s: {ARM_JOINTS} to {MOST_JOINTS} finite joints each "
            "are right"
        )
    message = messages.SensorMessage()
    header = message.header
    header.seqno = correction.seqno
    header.tm = correction.tm_ms
    header.mtype = messages.TYPE_CORRECTION
    for place, values in ((message.planned, q), (message.speed_reference, dq)):
        _fill_joints(place, values)
    return message.SerializeToString()


def decode_correction(data: bytes) -> Correction:
    """Decodes a reply to the robot; without a speed reference the speed is 0.

    Raises:
        BadPacket: The datagram is empty, garbage or a robot's own message, has not 6 to 14 joints or another number of
            speeds, or a value is not finite.
    """
    message = _parsed(messages.SensorMessage, data)
    header, speed = message.header, message.speed_reference
    if header.mtype == messages.TYPE_DATA:
        raise BadPacket(f"message type {header.mtype}: a guide sends {messages.TYPE_CORRECTION}")
    q = _joints(message.planned, "planned")
    dq = _joints(speed, "speedRef") if speed.HasField("joints") else [0.0] * len(q)
    if len(dq) != len(q):
        raise BadPacket(f"speedRef: {len(dq)} speeds of {len(q)} joints")
    return Correction(
        seqno=header.seqno,
        tm_ms=header.tm,
        q=_scaled(q, _RAD_PER_DEG, "planned"),
        dq=_scaled(dq, _RAD_PER_DEG, "speedRef"),
    )


def encode_robot(
    packet: RobotPacket,
    *,
    version: Literal["A", "B", "C"] = "B",
    radians: bool = False,
    q_cartesian: Floats | None = None,
) -> bytes:
    """Encodes a robot's datagram as in editions A, B and C, without checks, as a double must also send invalid values.

    Args:
        packet: Values to send; None is left out.
        version: A has no utilisation, collision or RAPID data; C adds the second stamp and the torques.
        radians: As RobotWare below 6.07: joints in radians, no clock.
        q_cartesian: (7,) pose of the tool: position [m], then quaternion w, x, y, z.
    """
    message = messages.RobotMessage()
    message.header.mtype = messages.TYPE_DATA
    if packet.seqno is not None:
        message.header.seqno = packet.seqno
    if packet.tm_ms is not None:
        message.header.tm = packet.tm_ms
    message.motor_state.state = packet.motors
    message.mci_state.state = packet.mci
    message.rapid_state.state = packet.rapid
    message.mci_convergence_met = packet.converged
    scale = 1.0 if radians else _DEG_PER_RAD
    _fill_place(message.feed_back, packet.q, scale, q_cartesian)
    if packet.q_planned is not None:
        _fill_place(message.planned, packet.q_planned, scale, q_cartesian)
    if packet.clock_ns is not None and not radians:
        for place in (message.feed_back, message.planned) if packet.q_planned is not None else (message.feed_back,):
            _fill_clock(place, packet.clock_ns, stamp=version == "C")
    _fill_edition(message, packet, version)
    return message.SerializeToString()


def _all_joints(place: Any) -> list[float]:
    """Returns joints of the arm, then external ones, of one part of a message."""
    arm = place.joints.joints[:]
    return arm + place.external_joints.joints[:] if place.HasField("external_joints") else arm


def _joints(place: Any, what: str) -> list[float]:
    """Returns the same for a guide's message: all joints of the arm, and optional external ones."""
    values, arm = _all_joints(place), len(place.joints.joints)
    if arm != ARM_JOINTS or len(values) > MOST_JOINTS:
        raise BadPacket(
            f"{what}: {arm} joints and {len(values) - arm} external ones; {ARM_JOINTS} joints are right, and at most "
            f"{MOST_JOINTS - ARM_JOINTS} external ones"
        )
    return values


def _fill_joints(place: Any, values: list[float]) -> None:
    """Fills the joints of one part of a message; those beyond the arm are external ones."""
    place.joints.joints.extend(values[:ARM_JOINTS])
    if values[ARM_JOINTS:]:
        place.external_joints.joints.extend(values[ARM_JOINTS:])


def _scaled(values: list[float], scale: float, what: str) -> Floats:
    """Returns joints in SI units, read-only."""
    if not all(map(isfinite, values)):
        raise BadPacket(f"{what}: joints {values}; finite numbers are right")
    scaled = np.array(values) * scale
    scaled.flags.writeable = False
    return scaled


def _clock(clock: Any) -> int:
    """Returns the time of the robot's clock in nanoseconds."""
    clock_ns: int = clock.sec * _NS_PER_S + clock.usec * 1000
    if clock_ns >= _LATEST_NS:
        raise BadPacket(f"feedBack: time {clock.sec} s + {clock.usec} us; seconds since 1970 are right")
    return clock_ns


def _fill_place(place: Any, q: Floats, scale: float, cartesian: Floats | None) -> None:
    """Fills joints and pose of the measured or planned state."""
    _fill_joints(place, (q * scale).tolist())
    if cartesian is not None:
        pos, orient = place.cartesian.pos, place.cartesian.orient
        pos.x, pos.y, pos.z = (cartesian[:3] * _MM_PER_M).tolist()
        orient.u0, orient.u1, orient.u2, orient.u3 = cartesian[3:].tolist()


def _fill_clock(place: Any, clock_ns: int, *, stamp: bool) -> None:
    """Fills the clock, and the second stamp of edition C."""
    place.time.sec, remainder_ns = divmod(clock_ns, _NS_PER_S)
    place.time.usec = remainder_ns // 1000
    if stamp:
        place.time_stamp.sec, place.time_stamp.nsec = divmod(clock_ns, _NS_PER_S)


def _fill_edition(message: Any, packet: RobotPacket, version: str) -> None:
    """Fills the fields that only some editions have; with rest values if this robot has none."""
    still = [0.0] * ARM_JOINTS
    if version == "A":
        message.measured_force = messages.MeasuredForceA(force=still).SerializeToString()
        return
    message.measured_force = messages.MeasuredForceB(fc_active=False, force=still).SerializeToString()
    if packet.utilization == packet.utilization:  # NaN is not sent
        message.utilization_rate = packet.utilization
    message.move_index = 1
    message.collision.triggered = False
    message.collision.quota.extend(still)
    message.rapid_from_robot.digital = False
    if version == "C":
        message.torque_reference.joints.extend(still)
