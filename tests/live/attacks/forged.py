"""Datagrams forged from what a robot sends: each kind takes a true packet and gives what comes beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from hrcreplay.egm import motion_link_pb2 as messages
from hrcreplay.egm.codec import RobotPacket, encode_robot

FAR_RAD: Final = float(np.radians(119.0))
_HOUR_NS: Final = 3_600_000_000_000


def _moved(packet: RobotPacket, by_rad: float) -> RobotPacket:
    return replace(packet, q=packet.q + by_rad * np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))


def restarted_far(packet: RobotPacket) -> list[bytes]:
    """A new session of a robot that says it is elsewhere."""
    return [encode_robot(replace(_moved(packet, FAR_RAD), seqno=0))]


def restarted_here(packet: RobotPacket) -> list[bytes]:
    """A new session of a robot that says it is where it is."""
    return [encode_robot(replace(packet, seqno=0))]


def restarted_and_goes_on(packet: RobotPacket) -> list[bytes]:
    """The same, with packets that follow it, and a clock an hour ahead."""
    ahead = (packet.clock_ns or 0) + _HOUR_NS
    return [encode_robot(replace(packet, seqno=n, clock_ns=ahead + n * 4_032_000)) for n in range(3)]


def motors_off_elsewhere(packet: RobotPacket) -> list[bytes]:
    """Motors off and on again, somewhere else each time: what the robot measures is what it is then told."""
    seqno = (packet.seqno or 0) + 1
    parts = [replace(_moved(packet, by), seqno=seqno + n, motors=motors) for n, (by, motors) in enumerate(_OFF_AND_ON)]
    return [encode_robot(part) for part in parts]


_OFF_AND_ON: Final = ((0.5, 2), (1.0, 1), (1.5, 2), (2.0, 1))


def next_one_jumps(packet: RobotPacket) -> list[bytes]:
    """The next packet, 0.15 rad away: less than a tracking error."""
    return [encode_robot(replace(_moved(packet, 0.15), seqno=(packet.seqno or 0) + 1))]


def next_one_of_the_future(packet: RobotPacket) -> list[bytes]:
    """The next packet, whose clock is an hour ahead: those of the robot itself would look overtaken."""
    return [encode_robot(replace(packet, seqno=(packet.seqno or 0) + 1, clock_ns=(packet.clock_ns or 0) + _HOUR_NS))]


def creeping(packet: RobotPacket) -> list[bytes]:
    """Next packets that wander off in steps which the axes could just go."""
    seqno = (packet.seqno or 0) + 1
    return [encode_robot(replace(_moved(packet, 0.012 * (n + 1)), seqno=seqno + n)) for n in range(20)]


def huge(packet: RobotPacket) -> list[bytes]:
    """Joints of 1e300 deg."""
    return [_with_joints(packet, 1e300)]


def not_a_number(packet: RobotPacket) -> list[bytes]:
    """Joints that are no numbers."""
    return [_with_joints(packet, float("nan")), _with_joints(packet, float("inf"))]


def longest(packet: RobotPacket) -> list[bytes]:
    """As long as a datagram can be, a robot's message and garbage."""
    message = messages.RobotMessage.FromString(encode_robot(replace(packet, seqno=0)))
    message.feed_back.external_joints.joints.extend([0.5] * 8100)
    return [message.SerializeToString()[:65_000], b"\xff" * 65_000]


def flood(packet: RobotPacket) -> list[bytes]:
    """Two hundred new sessions at once."""
    return [encode_robot(replace(_moved(packet, 0.01 * n), seqno=0, clock_ns=n + 1)) for n in range(200)]


def of_another_robot(packet: RobotPacket) -> list[bytes]:
    """Seven axes, and radians of an old controller: robots that are not answered at all."""
    seven = replace(packet, seqno=(packet.seqno or 0) + 1, q=np.append(packet.q, 0.0))
    return [encode_robot(seven), encode_robot(packet, version="A", radians=True)]


def _with_joints(packet: RobotPacket, degrees: float) -> bytes:
    message = messages.RobotMessage.FromString(encode_robot(packet))
    message.header.seqno += 1
    del message.feed_back.joints.joints[:]
    message.feed_back.joints.joints.extend([degrees] * 6)
    data: bytes = message.SerializeToString()
    return data


KINDS: dict[str, Callable[[RobotPacket], list[bytes]]] = {
    made.__name__: made
    for made in (
        restarted_far,
        restarted_here,
        restarted_and_goes_on,
        motors_off_elsewhere,
        next_one_jumps,
        next_one_of_the_future,
        creeping,
        huge,
        not_a_number,
        longest,
        flood,
        of_another_robot,
    )
}
