"""Sessions in counted time: the controller of `hrcreplay live`, the robot double, and a person who is made up."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.egm.codec import Correction, decode_correction
from hrcreplay.egm.link import ALARMS
from hrcreplay.egm.robot_double.faults import Fault
from hrcreplay.egm.robot_double.robot_simulator import SimulatedRobot, SimulatorSettings
from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.human.model import skeleton
from hrcreplay.live.control.session_controller import SessionController
from hrcreplay.live.control.setup import build_controller, live_run_config, start_table
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import PHASES, Decision, Signal, TickEvent
from hrcreplay.logs import skeleton_pb2
from hrcreplay.records import NOBODY, POINTS, Floats, HumanStates, MotionRow
from hrcreplay.robot.model import RobotModel
from tests.egm.rehearsal import rehearse

DEMO = Path(__file__).parents[2] / "datasets" / "demo.mcap"
BEGIN_NS = 1_800_000_000_000_000_000
RESPONSE_NS = 300_000
CYCLE_S = PERIOD_NS * 1e-9
FRAME_NS = 33_000_000
LENGTHS_M = np.array([[0.50, 0.20, 0.18, 0.36, 0.36, 0.29, 0.29]])

#: Where somebody stands over time, from the robot's base [m]; None: no camera sees them.
Walk = Callable[[float], tuple[float, float] | None]


def far_away(_s: float) -> tuple[float, float]:
    """Nobody is near."""
    return 3.0, 0.0


@cache
def start(*overrides: str, cell: Path | None = None) -> dict[str, Any]:
    """The table of a session in the demo's cell."""
    run_config, header = live_run_config(DEMO, None, overrides, cell)
    return start_table(run_config, header, sending=True)


@dataclass
class Flight:
    """A controller beside a robot double, cycle by cycle."""

    overrides: tuple[str, ...] = ()
    walk: Walk = far_away
    faults: tuple[Fault, ...] = ()
    seed: int = 0
    twin: SimulatorSettings = field(default_factory=SimulatorSettings)
    signals: Callable[[float], Signal] = lambda _s: Signal.NONE
    messages: list[bytes] = field(default_factory=list)  #: what the recorder would get
    answers: list[Decision] = field(default_factory=list)
    heard: list[tuple[Decision, tuple[bytes, ...], bool]] = field(
        default_factory=list
    )  #: with what they answer, and whether a packet of it was in doubt
    states: list[HumanStates] = field(default_factory=list)
    frames: list[tuple[int, bytes]] = field(default_factory=list)
    cell: Path | None = None  #: cell file; where it says what is watched, frames show that nobody is there
    silent: Callable[[float], bool] = lambda _s: False  #: whether no camera sends anything
    second: Walk = lambda _s: None  #: another person whom every camera shows, too
    named: Callable[[float], bool] = lambda _s: False  #: whether they name another body, and show no point of it

    def __post_init__(self) -> None:
        self.start = start(*self.overrides, cell=self.cell)
        self._watched = "watched" in (self.start["cell"] or {})
        self.controller: SessionController = build_controller(self.start)
        self.core = SimulatedRobot(self.twin, self.faults, self.seed)
        self._framed_ns = BEGIN_NS
        self._cycles = 0

    @property
    def robot(self) -> RobotModel:
        return self.controller.setup.robot

    def fly(self, seconds: float) -> Flight:
        """Goes on for so long."""
        cycles = round(seconds * 1e9 / PERIOD_NS)
        begin_ns = BEGIN_NS + self._cycles * PERIOD_NS
        rehearse(self.core, self._guide, cycles=cycles, begin_ns=begin_ns, response_ns=RESPONSE_NS)
        self._cycles += cycles
        return self

    def _guide(self, t_ns: int, datagrams: list[bytes]) -> Iterator[bytes]:
        signals = self.signals((t_ns - BEGIN_NS) * 1e-9)
        if datagrams:
            event = TickEvent(t_ns, tuple(datagrams), signals)
            alarms = self._alarms()
            answer = self.controller.answer(event)
            self.answers.append(answer)
            self.heard.append((answer, event.datagrams, self._alarms() > alarms))
            self.messages += [codec.encode_robot_packet(t_ns, datagram) for datagram in datagrams]
            self.messages.append(codec.encode_decision(answer, signals, len(datagrams), 0))
            if answer.datagram is not None:
                self.messages.append(codec.encode_reply(t_ns, answer.datagram, sent=True))
                yield answer.datagram
        else:
            self.controller.silence(t_ns, signals)
            self.messages.append(codec.encode_timeout(t_ns, signals))
        self._update_perception(t_ns + 1)

    def _update_perception(self, t_ns: int) -> None:
        seen = []
        while self._framed_ns <= t_ns:
            seen += self._frames(self._framed_ns)
            self._framed_ns += FRAME_NS
        perception = self.controller.update_perception(t_ns, seen)
        self.frames += [(t_ns, data) for data in seen]
        self.messages += [codec.encode_skeleton(t_ns, data) for data in seen]
        if perception is not None:
            self.states.append(perception.states)
            self.messages.append(codec.encode_perception(perception, len(seen)))

    def _frames(self, t_ns: int) -> list[bytes]:
        t_s = (t_ns - BEGIN_NS) * 1e-9
        there = [(body, walk(t_s)) for body, walk in ((1, self.walk), (2, self.second))]
        shown = [] if self.silent(t_s) else [(body, place_m) for body, place_m in there if place_m is not None]
        cameras = self.start["cameras"]
        found = [self._skeleton(camera, place_m, t_ns, body) for body, place_m in shown for camera in cameras]
        if not shown and self._watched and not self.silent(t_s):
            found += [_without_points(camera, NOBODY, t_ns) for camera in cameras]
        if self.named(t_s):
            found += [_without_points(camera, 2, t_ns) for camera in cameras]
        return found

    def _skeleton(self, camera: str, place_m: tuple[float, float], t_ns: int, body: int = 1) -> bytes:
        base = np.array(self.start["T_world_base"])[:3, 3]
        bend = 0.1 + 0.02 * np.sin(np.pi * 1e-9 * (t_ns - BEGIN_NS))  # nobody stands like a frozen picture
        joints = np.array([[base[0] + place_m[0], base[1] + place_m[1], np.pi, bend, *(0.1, 0.5, 0.0, 1.8) * 2, 0.94]])
        to_camera = np.linalg.inv(np.array(self.start["cameras"][camera]))
        points = skeleton(joints, LENGTHS_M)[0] @ to_camera[:3, :3].T + to_camera[:3, 3]
        message = skeleton_pb2.Skeleton(capture_ns=t_ns, camera=camera, body=body)
        message.points.extend(points.ravel().tolist())
        message.confidence.extend(np.isfinite(points[:, 0]).astype(float).tolist())
        data: bytes = message.SerializeToString()
        return data

    def _alarms(self) -> int:
        """How many packets were in doubt so far, also after the robot was stopped for another reason."""
        counts = self.controller.counts()
        return sum(counts[f"robot {alarm}"] for alarm in ALARMS)

    def said(self) -> list[Correction]:
        """Every reply."""
        return [decode_correction(answer.datagram) for answer in self.answers if answer.datagram is not None]

    def phases(self) -> list[str]:
        """The phases passed through, each once in a row."""
        names = [PHASES[answer.phase] for answer in self.answers]
        return [name for i, name in enumerate(names) if i == 0 or names[i - 1] != name]

    def top_speed(self, begin_s: float, end_s: float) -> float:
        """The greatest commanded axis speed between two instants [rad/s]."""
        rows = [
            answer.row.dq
            for answer in self.answers
            if answer.row is not None and begin_s <= (answer.t_ns - BEGIN_NS) * 1e-9 < end_s
        ]
        return float(np.abs(rows).max())

    def commanded(self) -> tuple[Floats, Floats]:
        """(n, 6) positions [rad] and speed references [rad/s] of all replies."""
        said = self.said()
        return np.array([reply.q for reply in said]), np.array([reply.dq for reply in said])


def _without_points(camera: str, body: int, t_ns: int) -> bytes:
    """A frame that names a body and does not show it; of NOBODY: that shows nobody."""
    points, confidence = [np.nan] * (3 * len(POINTS)), [0.0] * len(POINTS)
    message = skeleton_pb2.Skeleton(capture_ns=t_ns, camera=camera, body=body, points=points, confidence=confidence)
    data: bytes = message.SerializeToString()
    return data


def echoed(one: MotionRow, measured: Floats, two: MotionRow) -> bool:
    """Whether the second of two answers takes a robot that may not move for where it is, or goes towards that."""
    low, high = np.minimum(one.q, measured), np.maximum(one.q, measured)
    return bool(np.all((low <= two.q) & (two.q <= high)) and not np.any(two.dq))


def steps_keep_the_limits(flight: Flight) -> None:
    """What was told: each step within the axes' speeds; while the robot may move, within their accelerations, too."""
    robot = flight.robot
    told = [answer for answer in flight.answers if answer.datagram is not None]
    rows = [(answer.t_ns * 1e-9, answer, answer.row) for answer in told if answer.row is not None]
    said = [decode_correction(answer.datagram) for answer in told if answer.datagram is not None]
    pairs = zip(rows, rows[1:], said, said[1:], strict=False)
    for (before_s, earlier, one), (now_s, later, two), first, second in pairs:
        step_s = max(CYCLE_S, now_s - before_s)
        assert np.all(np.abs(second.q - first.q) <= robot.dq_max * step_s * (1 + 1e-6) + 1e-9)
        if PHASES[later.phase] == "echo" or echoed(one, earlier.measured, two):
            continue
        assert np.all(np.abs(two.dq - one.dq) <= robot.ddq_max * CYCLE_S * (1 + 1e-9))
        assert np.all((two.q >= robot.q_min - 1e-9) & (two.q <= robot.q_max + 1e-9))


def is_a_stop(speeds: Floats, ddq_max: Floats, dt_s: float) -> bool:
    """Whether velocities (n, 6), a row a tick, are what is left of a stop: straight, or that of Eq. (67).

    Of a robot that may not move at all the reply is where it is, at any time: there a stop may break off.
    """
    count = int(np.count_nonzero(np.any(speeds, axis=1)))
    axis = int(np.argmax(np.abs(speeds[0])))
    lost = speeds[0, axis] - speeds[1, axis] if count > 1 else speeds[0, axis]
    ticks = max(count, round(float(speeds[0, axis] / lost)) if lost else 0)
    together = speeds[:1] * np.clip(1.0 - np.arange(len(speeds)) / max(1, ticks), 0.0, 1.0)[:, None]
    alone = np.sign(speeds[:-1]) * np.maximum(np.abs(speeds[:-1]) - ddq_max * dt_s, 0.0)
    stands = ~np.any(speeds[1:], axis=1)
    if np.any(stands[:-1] & ~stands[1:]) or np.any(np.abs(np.diff(speeds, axis=0)[~stands]) > ddq_max * dt_s + 1e-9):
        return False
    return any(
        np.all(stands | np.all(np.abs(speeds[1:] - expected) < 1e-9, axis=1)) for expected in (together[1:], alone)
    )
