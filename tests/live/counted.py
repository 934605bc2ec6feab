"""The control loop in counted time: the robot double at the other end of the cable, no process, no clock, no socket."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from hrcreplay.egm.link import Address, Received
from hrcreplay.egm.robot_double.faults import Datagram
from hrcreplay.egm.robot_double.robot_simulator import SimulatedRobot
from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.egm.step_gate import StepGate
from hrcreplay.live.control.loop import Loop, LoopSettings
from hrcreplay.live.record.codec import Decision, Perception, TickEvent
from hrcreplay.records import HumanStates
from tests.live.flights import BEGIN_NS, FRAME_NS, RESPONSE_NS, Flight, far_away

ROBOT: Address = ("192.0.2.1", 6510)


@dataclass
class Clock:
    """The time that has been counted so far."""

    t_ns: int = BEGIN_NS


class Cable:
    """A Link in counted time. The robot goes on while the loop is busy, and its packets queue up."""

    def __init__(self, core: SimulatedRobot, clock: Clock) -> None:
        self._core = core
        self._clock = clock
        self._cycle_ns = clock.t_ns
        self._coming: list[tuple[int, int, bytes]] = []
        self._answers: list[Datagram] = []
        self._count = 0

    def newest(self) -> Received | None:
        """All that has come by now, or the next that comes within 20 ms."""
        deadline_ns = self._clock.t_ns + 20_000_000
        self._run(self._clock.t_ns)
        while not self._coming or self._coming[0][0] > self._clock.t_ns:
            if self._clock.t_ns >= deadline_ns:
                return None
            self._clock.t_ns = min(deadline_ns, max(self._clock.t_ns, self._cycle_ns))
            self._run(self._clock.t_ns)
        lot = []
        while self._coming and self._coming[0][0] <= self._clock.t_ns:
            lot.append(heapq.heappop(self._coming)[2])
        return Received(lot[-1], tuple(lot[:-1]), ROBOT, self._clock.t_ns, len(lot))

    def waiting(self) -> Received | None:
        """All that has come by now."""
        self._run(self._clock.t_ns)
        return self.newest() if self._coming and self._coming[0][0] <= self._clock.t_ns else None

    def _run(self, until_ns: int) -> None:
        while self._cycle_ns <= until_ns:
            t_ns = self._cycle_ns
            arrived = [answer for answer in self._answers if answer.t_ns <= t_ns]
            self._answers = [answer for answer in self._answers if answer.t_ns > t_ns]
            for datagram in self._core.cycle(t_ns, arrived):
                heapq.heappush(self._coming, (datagram.t_ns, self._count, datagram.data))
                self._count += 1
            self._cycle_ns += PERIOD_NS

    def answer(self, data: bytes, to: Address) -> None:
        """It arrives a little later."""
        assert to == ROBOT
        self._answers.append(Datagram(self._clock.t_ns + RESPONSE_NS, data))

    strangers = 0

    def strangers_seen(self) -> list[Address]:
        """There are none."""
        return []

    def clear(self) -> None:
        """Nothing has queued up."""

    def pass_by(self, seconds: float) -> None:
        """Lets the robot go on while nobody is there."""
        self._clock.t_ns += round(seconds * 1e9)
        self._run(self._clock.t_ns)


class Person:
    """A human side that sends a frame of every camera now and then."""

    alive = True

    def __init__(self, flight: Flight, clock: Clock) -> None:
        self._flight = flight
        self._clock = clock
        self._framed_ns = clock.t_ns

    def send(self, message: bytes) -> None:
        """It has begun already."""

    def messages(self) -> Iterator[bytes]:
        """What is due."""
        yield b"H"
        while self._framed_ns <= self._clock.t_ns:
            other = self._flight.second((self._framed_ns - BEGIN_NS) * 1e-9)
            for camera in self._flight.start["cameras"]:
                if other is not None:
                    yield b"f" + self._flight._skeleton(camera, other, self._framed_ns, 2)
                yield b"F" + self._flight._skeleton(camera, far_away(0.0), self._framed_ns)
            self._framed_ns += FRAME_NS


class Recorder:
    """A recorder that never dies."""

    alive = True
    dropped = 0

    def __init__(self) -> None:
        self.kept: list[bytes] = []

    def send(self, message: bytes) -> None:
        """Keeps it."""
        self.kept.append(message)

    def messages(self) -> Iterator[bytes]:
        """It has nothing to say."""
        return iter(())


@dataclass
class CountedLoop(Loop):
    """The loop by a clock that only its waiting and its work move on."""

    clock: Clock = field(default_factory=Clock)
    work_ns: int = 300_000  #: from a packet to its answer
    look_ns: int = 0  #: what a look takes
    seen: list[Decision] = field(default_factory=list)

    def now_ns(self) -> int:
        """The time counted."""
        return self.clock.t_ns

    def fly(self, seconds: float = math.inf) -> CountedLoop:
        """Turns for so long, or until it is over."""
        end_ns = seconds * 1e9 + self.clock.t_ns
        while self.clock.t_ns < end_ns and self.run_cycle():
            pass
        return self


def counted(
    flight: Flight, *, duration_s: float = math.inf, work_s: float = 0.0003, look_s: float = 0.0
) -> CountedLoop:
    """A flight's controller and robot with the loop between them."""
    clock = Clock()
    settings = LoopSettings(
        duration_s, sending=True, person_late_s=9, overrun_s=0.02, keep_recorder=True, store_every_s=9
    )
    parts = Cable(flight.core, clock), Person(flight, clock), Recorder()
    gate = StepGate(flight.robot.dq_max, flight.controller.setup.plan.dt_s)
    loop = CountedLoop(flight.controller, *parts, settings, gate, 0, clock.t_ns, clock=clock)  # type: ignore[arg-type]
    loop.work_ns, loop.look_ns = round(work_s * 1e9), round(look_s * 1e9)
    answer, fuse, predict = flight.controller.answer, flight.controller.fuse, flight.controller.predict

    def works(event: TickEvent) -> Decision:
        clock.t_ns += loop.work_ns
        loop.seen.append(answer(event))
        return loop.seen[-1]

    def fuses(t_ns: int, skeletons: Sequence[bytes]) -> HumanStates | None:
        clock.t_ns += loop.look_ns // 2
        return fuse(t_ns, skeletons)

    def predicts(t_ns: int, states: HumanStates | None) -> Perception | None:
        clock.t_ns += loop.look_ns // 2
        return predict(t_ns, states)

    flight.controller.answer = works  # type: ignore[method-assign]
    flight.controller.fuse = fuses  # type: ignore[method-assign]
    flight.controller.predict = predicts  # type: ignore[method-assign]
    loop.begin()
    return loop
