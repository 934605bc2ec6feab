"""What the robot double reports."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.egm.codec import Correction, encode_correction
from hrcreplay.egm.robot_double.faults import Datagram, Fault
from hrcreplay.egm.robot_double.robot_simulator import SimulatedRobot, SimulatorSettings
from hrcreplay.records import Floats
from tests.egm.rehearsals import HOME, Guide, T, ramp, ramp_until, rehearsed, shown, still


def test_nobody_owes_an_answer_to_joints_that_are_no_numbers() -> None:
    class Careful(Guide):
        def __call__(self, t_ns: int, datagrams: list[bytes]) -> list[bytes]:
            return super().__call__(t_ns, [data for data in datagrams if b"\xf8\x7f" not in data])

    core = rehearsed(1.0, Careful(), Fault("nan", 0.5, 0.1, axis=4))
    answers = shown(core).answers
    assert (answers.packets, answers.missed) == (248 - 24, 0)


def test_answers_are_paired_with_packets() -> None:
    response = Guide()
    core = rehearsed(1.0, response, response_ns=700_000)
    answers = shown(core).answers
    assert (answers.packets, answers.answered, answers.missed, answers.doubled) == (248, 248, 0, 0)
    assert answers.latency_us["p50"] == answers.latency_us["max"] == pytest.approx(700.0)
    assert answers.seqno_steps == 0


def test_missed_and_doubled_answers_and_odd_steps_are_counted() -> None:
    class Sloppy(Guide):
        def __call__(self, t_ns: int, datagrams: list[bytes]) -> list[bytes]:
            answers = super().__call__(t_ns, datagrams)
            if self.count in (50, 51, 70):
                return []
            return answers * 2 if self.count in (100, 120, 121) else answers

    answers = shown(rehearsed(1.0, Sloppy())).answers
    assert (answers.missed, answers.doubled) == (3, 3)
    assert answers.seqno_steps == 2 + 3  # two gaps, three repeats
    assert answers.answered == 245


def test_an_answer_that_comes_after_the_next_packet_is_late_not_missed() -> None:
    class Slow(Guide):
        waiting: list[bytes]

        def __call__(self, t_ns: int, datagrams: list[bytes]) -> list[bytes]:
            answers = super().__call__(t_ns, datagrams)
            if self.count == 50:
                self.waiting = answers
                return []
            return self.waiting + answers if self.count == 51 else answers

    answers = shown(rehearsed(1.0, Slow())).answers
    assert (answers.missed, answers.doubled, answers.seqno_steps) == (0, 0, 0)
    assert answers.latency_us["max"] == pytest.approx(4332.0)


def test_of_packets_that_come_at_once_the_newest_is_owed_an_answer() -> None:
    core = SimulatedRobot(SimulatorSettings())
    core.cycle(0, [])
    core.record.departed_ns += [3_800_000, 4_032_000, 8_064_000]
    for t_ns in (300_000, 4_332_000, 8_364_000):
        core.record.add_arrival(Datagram(t_ns, encode_correction(Correction(0, 0, *ramp(0.0)))), 1)
    answers = shown(core).answers
    assert (answers.answered, answers.missed, answers.doubled) == (3, 0, 0)
    assert answers.latency_us["max"] == pytest.approx(300.0)


def test_packets_before_the_first_answer_are_nobodys_fault() -> None:
    answers = shown(rehearsed(1.0, Guide(lambda t: still(t) if t > 0.5 else None))).answers
    assert answers.before_first == 125
    assert answers.missed == 0


def test_what_was_commanded_is_measured_for_each_axis() -> None:
    def rule(t: float) -> tuple[Floats, Floats]:
        q, dq = HOME.copy(), np.zeros(6)
        q[0] = 0.01 + 0.3 * t
        dq[0] = 0.3
        q[2] += 0.05 if t > 0.5 else 0.0
        dq[3] = 0.02 if t > 0.7 else 0.0
        return q, dq

    commanded = shown(rehearsed(1.0, Guide(rule))).commanded
    assert commanded.start_jump_rad == pytest.approx([0.01, 0, 0, 0, 0, 0])
    assert commanded.jump_rad == pytest.approx([0.3 * T, 0, 0.05, 0, 0, 0])
    assert commanded.speed_rad_per_s == pytest.approx([0.3, 0, 0.05 / T, 0, 0, 0])
    assert commanded.speed_ref_rad_per_s == pytest.approx([0.3, 0, 0, 0.02, 0, 0])
    assert commanded.acceleration_rad_per_s2 == pytest.approx([0, 0, 0, 0.02 / T, 0, 0])
    assert commanded.speed_limit_rad_per_s[0] == pytest.approx(math.radians(200))


def test_standstill_is_timed_from_the_fault_and_from_the_last_motion() -> None:
    stop = ramp(1.5)[0]
    guide = Guide(ramp_until(1.5, then=lambda _t: (stop, np.zeros(6))))
    fault = Fault("loss", 1.2, 0.1, probability=0.1)
    (seen,) = shown(rehearsed(3.0, guide, fault), fault).faults
    assert seen.told_rest_s == pytest.approx(0.3, abs=2 * T)
    assert seen.robot_rest_s is not None
    assert 0.3 < seen.robot_rest_s < 0.36  # the filter: 8 ms a factor of e
    assert seen.coast_s == pytest.approx(seen.robot_rest_s - 0.3, abs=3 * T)


def test_a_robot_that_never_rests_after_a_fault_says_so() -> None:
    fault = Fault("loss", 1.0, 0.1, probability=0.1)
    (seen,) = shown(rehearsed(2.0, Guide(ramp), fault), fault).faults
    assert (seen.told_rest_s, seen.robot_rest_s, seen.coast_s) == (None, None, None)


def test_the_report_is_a_table_and_files(tmp_path: Path) -> None:
    fault = Fault("motors_off", 0.5, 0.1)
    report = shown(rehearsed(1.0, Guide(ramp), fault), fault)
    report.write(tmp_path)
    data = json.loads((tmp_path / "twin.json").read_text())
    assert data["answers"]["missed"] == 0
    assert data["faults"][0]["fault"]["kind"] == "motors_off"
    rows = np.genfromtxt(tmp_path / "twin_cycles.csv", delimiter=",", names=True)
    assert rows["planned_rad_1"] == pytest.approx(report.record.cycles()["planned_rad"][:, 0], rel=1e-8)
    assert len(np.genfromtxt(tmp_path / "twin_arrivals.csv", delimiter=",", names=True)) == 248
    text = "\n".join(report.lines())
    assert "motors_off" in text
    assert "axis" in text
