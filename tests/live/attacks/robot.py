"""A robot on loopback that is attacked from its own address, and from others: ``python -m tests.live.attacks.robot``.

Start a session first, with a motion that resumes so that every attack finds it moving:

    hrcreplay live --human LOG --send --repeat --set live.resume=true --set live.resume_s=0.2

The robot is ideal: where it was told to be, there it is a cycle later. Each attack is sent once while it moves. Told
are the greatest step of the answers, as a share of what the axes can go, and whether the robot was brought to rest.
Exit code 1: an answer led further than they can, or a stranger was answered.
"""

from __future__ import annotations

import argparse
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from hrcreplay.egm.codec import ARM_JOINTS, Mci, Motors, Rapid, RobotPacket, decode_correction, encode_robot
from hrcreplay.egm.robot_double.servo import IRB140, PERIOD_NS
from hrcreplay.records import Floats
from tests.live.attacks.forged import KINDS

_CYCLE_S = PERIOD_NS * 1e-9
_SPEED = np.radians(IRB140.speed_deg_per_s)
_HOME = np.radians([0.0, 0.0, 0.0, 0.0, 30.0, 0.0])


@dataclass
class Robot:
    """Calls a port in its cycle, obeys at once, and keeps what it was told."""

    port: int
    q: Floats = field(default_factory=_HOME.copy)
    dq: Floats = field(default_factory=lambda: np.zeros(ARM_JOINTS))
    told: list[tuple[float, Floats]] = field(default_factory=list)
    seqno: int = 0

    def __post_init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self._due_s = time.monotonic()

    def packet(self) -> RobotPacket:
        """What it says now."""
        clock_ns = time.time_ns()
        state = Motors.ON, Mci.RUNNING, Rapid.RUNNING
        return RobotPacket(self.seqno, clock_ns // 1_000_000 % 2**32, clock_ns, self.q, self.q, *state, False, 10.0)

    def send(self, data: bytes) -> None:
        """Sends a datagram to the session."""
        self.socket.sendto(data, ("127.0.0.1", self.port))

    def cycle(self) -> RobotPacket:
        """One cycle: obeys what has come, calls, and waits for the next."""
        with suppress(BlockingIOError, ConnectionError):
            while True:
                answer = decode_correction(self.socket.recv(65536))
                self.q, self.dq = answer.q, answer.dq
                self.told.append((time.monotonic(), answer.q))
        packet = self.packet()
        self.send(encode_robot(packet))
        self.seqno += 1
        self._due_s = max(self._due_s + _CYCLE_S, time.monotonic())
        time.sleep(max(0.0, self._due_s - time.monotonic()))
        return packet

    def go_on(self, seconds: float) -> Iterator[RobotPacket]:
        """Cycles for so long."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            yield self.cycle()


@dataclass(frozen=True)
class Outcome:
    """What an attack did."""

    kind: str
    share: float  #: greatest step of the answers, of what the axes can go; arrivals vary, so twice a cycle is let pass
    moved_rad: float  #: from the attack on until the robot stood, or for as long as was looked
    came_to_rest: bool
    answered: int  #: a second, after it


def attack(robot: Robot, kind: str, patience_s: float) -> Outcome | None:
    """Waits until the robot moves, attacks, and looks on for 0.6 s; None where it never moves."""
    for _ in robot.go_on(patience_s):
        if np.abs(robot.dq).max() > 0.1:
            break
    else:
        return None
    begun, where = len(robot.told), robot.q
    for data in KINDS[kind](robot.packet()):
        robot.send(data)
    for _ in robot.go_on(0.6):
        pass
    told = robot.told[max(0, begun - 1) :]
    shares = [
        float((np.abs(now - before) / _SPEED).max()) / max(2 * _CYCLE_S, now_s - before_s)
        for (before_s, before), (now_s, now) in pairwise(told)
    ]
    moved = max((float(np.abs(q - where).max()) for _, q in told), default=0.0)
    return Outcome(kind, max(shares, default=0.0), moved, not np.any(robot.dq), round(len(told) / 0.6))


def stranger_answered(robot: Robot, address: str) -> bool:
    """Whether somebody else is answered who calls as the robot does, beside it and while it is silent for 80 ms."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((address, 0))
        other.setblocking(False)
        for _ in robot.go_on(0.2):
            other.sendto(encode_robot(robot.packet()), ("127.0.0.1", robot.port))
        for _ in range(20):
            time.sleep(_CYCLE_S)
            other.sendto(encode_robot(robot.packet()), ("127.0.0.1", robot.port))
        for _ in robot.go_on(0.2):
            pass
        with suppress(BlockingIOError, ConnectionError):
            return bool(other.recv(65536))
        return False


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.live.attacks.robot", description=__doc__)
    parser.add_argument("--port", type=int, default=6510)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--patience", type=float, default=20.0, help="longest wait for a motion [s]")
    given = parser.parse_args(arguments)
    bad = 0
    with ExitStack() as stack:
        robot = Robot(given.port)
        stack.callback(robot.socket.close)
        for address in ("127.0.0.1", "127.0.0.2"):
            answered = stranger_answered(robot, address)
            bad += answered
            sys.stdout.write(f"stranger at {address}: {'answered' if answered else 'not answered'}\n")
        for kind in given.kinds:
            found = attack(robot, kind, given.patience)
            if found is None:
                sys.stdout.write(f"{kind}: the robot did not move within {given.patience:g} s\n")
                bad += 1
                continue
            bad += found.share > 1.0
            sys.stdout.write(
                f"{kind}: greatest step {found.share:.2f} of what the axes can go, then {found.moved_rad:.3f} rad, "
                f"{'at rest' if found.came_to_rest else 'moving on'}, {found.answered} answers/s\n"
            )
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
