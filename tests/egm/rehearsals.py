"""The robot double rehearsed with a guide that answers by a rule, for the tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hrcreplay.egm.codec import Correction, RobotPacket, decode_robot, encode_correction
from hrcreplay.egm.robot_double.faults import Fault
from hrcreplay.egm.robot_double.robot_simulator import SimulatedRobot, SimulatorSettings
from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.egm.robot_double.udp_client import SimulatorReport, report_of
from hrcreplay.records import Floats
from tests.egm.rehearsal import rehearse

T = PERIOD_NS * 1e-9
HOME = np.radians((0.0, 0.0, 0.0, 0.0, 30.0, 0.0))


class Guide:
    """Answers the newest packet of each instant by a rule of the robot's time; keeps what it heard."""

    def __init__(self, rule: Callable[[float], tuple[Floats, Floats] | None] | None = None) -> None:
        self.rule = rule
        self.heard: list[tuple[int, bytes]] = []
        self.count = 0

    def __call__(self, t_ns: int, datagrams: list[bytes]) -> list[bytes]:
        self.heard += [(t_ns, data) for data in datagrams]
        if not datagrams:
            return []
        told = self.rule(t_ns * 1e-9) if self.rule else (HOME, np.zeros(6))
        if told is None:
            return []
        self.count += 1
        return [encode_correction(Correction(self.count, 0, *told))]

    def packets(self) -> list[RobotPacket]:
        return [decode_robot(data) for _, data in self.heard]


def still(_t: float) -> tuple[Floats, Floats]:
    return HOME, np.zeros(6)


def ramp(t: float) -> tuple[Floats, Floats]:
    """Axis 1 at 0.2 rad/s from 0."""
    return HOME + np.eye(6)[0] * 0.2 * t, np.eye(6)[0] * 0.2


def ramp_until(end_s: float, *, then: Callable[[float], tuple[Floats, Floats] | None]) -> Callable[[float], Any]:
    return lambda t: ramp(t) if t < end_s else then(t)


def rehearsed(
    seconds: float, guide: Guide, *faults: Fault, seed: int = 0, response_ns: int = 300_000, **settings: Any
) -> SimulatedRobot:
    core = SimulatedRobot(SimulatorSettings(**settings), faults, seed)
    rehearse(core, guide, cycles=round(seconds / T), response_ns=response_ns)
    return core


def shown(core: SimulatedRobot, *faults: Fault) -> SimulatorReport:
    return report_of(core, faults)
