"""The robot double: what it sends, how it takes what it is told, and what it reports."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.egm import motion_link_pb2 as messages
from hrcreplay.egm.channel import Datagram
from hrcreplay.egm.codec import Correction, Mci, Motors, Rapid, RobotPacket, decode_robot, encode_correction
from hrcreplay.egm.echo import echo
from hrcreplay.egm.faults import KINDS, Fault, random_faults
from hrcreplay.egm.rehearsal import rehearse
from hrcreplay.egm.servo import PERIOD_NS, ServoSettings
from hrcreplay.egm.twin import TwinCore, TwinSettings
from hrcreplay.egm.twin_loop import run_twin
from hrcreplay.egm.twin_report import TwinReport, report_of
from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats

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
) -> TwinCore:
    core = TwinCore(TwinSettings(**settings), faults, seed)
    rehearse(core, guide, cycles=round(seconds / T), response_ns=response_ns)
    return core


def shown(core: TwinCore, *faults: Fault) -> TwinReport:
    return report_of(core, faults)


# What it sends


def test_packets_count_up_with_states_stamps_and_joints() -> None:
    guide = Guide()
    rehearsed(1.0, guide, epoch_ns=1_700_000_000_123_456_000)
    packets = guide.packets()
    assert [packet.seqno for packet in packets] == list(range(248))
    assert [packet.tm_ms for packet in packets[:3]] == [0, 4, 8]
    clocks = [packet.clock_ns for packet in packets]
    assert clocks[:2] == [1_700_000_000_123_456_000, 1_700_000_000_127_488_000]
    assert packets[9].q == pytest.approx(HOME, abs=1e-12)
    assert {(packet.motors, packet.mci, packet.rapid) for packet in packets} == {
        (Motors.ON, Mci.RUNNING, Rapid.RUNNING)
    }


def test_editions_differ_as_they_do() -> None:
    raw = {}
    for version in ("A", "B", "C"):
        guide = Guide()
        rehearsed(0.1, guide, version=version)
        raw[version] = messages.RobotMessage.FromString(guide.heard[-1][1])
    assert [raw[version].HasField("utilization_rate") for version in "ABC"] == [False, True, True]
    assert [raw[version].feed_back.HasField("time_stamp") for version in "ABC"] == [False, False, True]


def test_old_robotware_sends_radians_and_no_clock() -> None:
    guide = Guide()
    rehearsed(0.1, guide, radians=True)
    packet = guide.packets()[-1]
    assert packet.clock_ns is None
    assert packet.q == pytest.approx(HOME, abs=1e-12)
    raw = messages.RobotMessage.FromString(guide.heard[-1][1])
    assert raw.feed_back.joints.joints[4] == pytest.approx(math.radians(30))


# How it takes what it is told


def test_position_with_its_speed_is_followed_within_10_to_20_ms() -> None:
    guide = Guide(ramp)
    rehearsed(3.0, guide)
    (t_ns, data) = guide.heard[-1]
    lag_s = t_ns * 1e-9 - decode_robot(data).q[0] / 0.2
    assert 0.010 < lag_s < 0.020


def test_position_alone_is_followed_200_ms_later() -> None:
    guide = Guide(lambda t: (ramp(t)[0], np.zeros(6)))
    rehearsed(3.0, guide)
    (t_ns, data) = guide.heard[-1]
    lag_s = t_ns * 1e-9 - decode_robot(data).q[0] / 0.2
    assert lag_s == pytest.approx(0.2 + 0.0145, abs=0.005)


def test_one_message_is_read_a_cycle_so_a_second_answer_builds_lag() -> None:
    core = TwinCore(TwinSettings())
    told = [encode_correction(Correction(number, 0, HOME, np.zeros(6))) for number in range(10)]
    core.cycle(0, [])
    core.cycle(PERIOD_NS, [Datagram(PERIOD_NS, data) for data in told])
    for cycle in range(2, 13):
        core.cycle(cycle * PERIOD_NS, [])
    rows = core.record.cycles()
    assert rows["told_seqno"].tolist() == [-1, *range(10), -1, -1]
    assert rows["queued"].tolist()[:4] == [0, 9, 8, 7]
    assert rows["ref_rad"][-1] == pytest.approx(HOME)  # with no message the last is used again


def test_what_is_no_message_takes_the_cycle_and_changes_nothing() -> None:
    core = TwinCore(TwinSettings())
    good = encode_correction(Correction(1, 0, HOME, np.zeros(6)))
    core.cycle(0, [Datagram(0, b"\xff\xff"), Datagram(0, b""), Datagram(0, good)])
    for cycle in (1, 2):
        core.cycle(cycle * PERIOD_NS, [])
    assert core.record.cycles()["told_seqno"].tolist() == [-1, -1, 1]
    assert core.record.garbage == 2


def test_a_robot_that_was_held_up_has_moved_on_meanwhile() -> None:
    prompt, held = TwinCore(TwinSettings()), TwinCore(TwinSettings())
    told = [Datagram(0, encode_correction(Correction(1, 0, *ramp(0.0))))]
    for cycle in range(20):
        prompt.cycle(cycle * PERIOD_NS, told if cycle == 0 else [])
    for cycle in (0, 1, 19):
        held.cycle(cycle * PERIOD_NS, told if cycle == 0 else [])
    np.testing.assert_array_equal(prompt.servo.q, held.servo.q)


def test_a_cycle_that_is_a_little_late_is_one_cycle() -> None:
    prompt, shaky = TwinCore(TwinSettings()), TwinCore(TwinSettings())
    told = [Datagram(0, encode_correction(Correction(1, 0, *ramp(0.0))))]
    for cycle in range(60):
        prompt.cycle(cycle * PERIOD_NS, told if cycle == 0 else [])
        shaky.cycle(cycle * PERIOD_NS + 1_500_000 * (cycle % 2), told if cycle == 0 else [])
    np.testing.assert_array_equal(prompt.servo.q, shaky.servo.q)


def test_silence_of_the_guide_ends_in_the_time_out_then_a_new_session_waits() -> None:
    guide = Guide(ramp_until(1.0, then=lambda _t: None))
    core = rehearsed(6.0, guide)
    rows = core.record.cycles()
    assert core.ends == ["CommTimeout", ""]
    failed = rows["t_ns"][np.flatnonzero(rows["mci"] == Mci.ERROR)] * 1e-9
    assert failed[0] == pytest.approx(2.0, abs=0.02)
    assert failed[-1] == pytest.approx(2.5, abs=0.02)  # the last states are told for the ramp, then it is silent
    assert np.all(rows["seqno"][(rows["t_ns"] > 2.6e9) & (rows["t_ns"] < 3.4e9)] == -1)
    again = rows[rows["session"] == 2]
    assert again["t_ns"][0] * 1e-9 == pytest.approx(3.5, abs=0.02)
    assert again["seqno"][0] == 0
    assert np.all(again["planned_rad_per_s"] == 0.0)
    assert np.all(again["mci"] == Mci.RUNNING)


def test_convergence_is_told_and_ends_the_session() -> None:
    guide = Guide(still)
    core = rehearsed(3.0, guide, servo=ServoSettings(cond_time_s=1.0))
    told = [packet.converged for packet in guide.packets()]
    assert not any(told[:248])
    assert any(told[248:260])
    assert core.ends[0] == "converged"


# Faults


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        ("motors_off", "motors", Motors.OFF),
        ("program_stop", "rapid", Rapid.STOPPED),
        ("rapid_undefined", "rapid", Rapid.UNDEFINED),
    ],
)
def test_states_change_for_the_length_of_the_fault(kind: str, field: str, value: int) -> None:
    guide = Guide()
    rehearsed(2.0, guide, Fault(kind, 0.5, 1.0))
    times = [
        t_ns * 1e-9
        for (t_ns, _), packet in zip(guide.heard, guide.packets(), strict=True)
        if getattr(packet, field) == value
    ]
    assert times[0] == pytest.approx(0.5, abs=T)
    assert times[-1] == pytest.approx(1.5, abs=T)
    assert len(times) == pytest.approx(1.0 / T, abs=1)


def test_motors_that_come_back_make_the_old_target_live() -> None:
    guide = Guide(ramp_until(1.0, then=lambda t: ramp(1.0) if t < 1.01 else None))
    core = rehearsed(4.0, guide, Fault("motors_off", 1.02, 0.5), servo=ServoSettings(comm_timeout_s=9.0))
    rows = core.record.cycles()
    off = rows[rows["motors"] == Motors.OFF]
    assert np.all(off["planned_rad_per_s"][10:] == 0.0)
    assert off["planned_rad"][-1, 0] < 0.21
    assert rows["planned_rad"][-1, 0] == pytest.approx(0.2 + 0.2 / 5, abs=1e-4)


def test_an_egm_error_is_told_and_followed_by_a_new_session() -> None:
    guide = Guide(ramp)
    core = rehearsed(4.0, guide, Fault("egm_error", 1.0, 0.2))
    assert core.ends[0] == "EGM error"
    assert core.session == 2
    rows = core.record.cycles()
    assert np.all(rows["planned_rad_per_s"][(rows["t_ns"] > 1.6e9) & (rows["session"] == 1)] == 0.0)


def test_a_new_session_counts_from_0_and_holds_until_it_is_told() -> None:
    guide = Guide(ramp_until(1.0, then=lambda _t: None))
    core = rehearsed(2.0, guide, Fault("new_session", 1.004, 0.0))
    rows = core.record.cycles()
    again = rows[rows["session"] == 2]
    assert again["seqno"].tolist() == list(range(len(again)))
    assert np.all(np.isnan(again["ref_rad"]))
    assert np.all(np.abs(again["planned_rad_per_s"][50:]) < 1e-9)


def test_a_new_session_forgets_what_was_queued_or_under_way() -> None:
    late = Fault("delay", 0.0, 0.002, direction="in", delay_s=0.05)
    core = TwinCore(TwinSettings(), [late, Fault("new_session", 3.5 * T, 0.0)])
    told = encode_correction(Correction(1, 0, *ramp(1.0)))
    core.cycle(0, [Datagram(0, told)])
    core.cycle(PERIOD_NS, [Datagram(PERIOD_NS, told)] * 9)
    for cycle in range(2, 30):
        core.cycle(cycle * PERIOD_NS, [])
    rows = core.record.cycles()
    assert rows["session"].tolist() == [1] * 4 + [2] * 26
    assert np.flatnonzero(rows["told_seqno"] >= 0).tolist() == [1, 2, 3]


def test_after_an_error_the_program_begins_again_only_with_motors() -> None:
    guide = Guide()
    core = rehearsed(5.0, guide, Fault("egm_error", 0.5, 0.0), Fault("motors_off", 1.0, 3.0))
    rows = core.record.cycles()
    assert rows["t_ns"][rows["session"] == 2][0] * 1e-9 == pytest.approx(4.0, abs=2 * T)


def test_falsified_joints_are_told_while_the_robot_stays_where_it_is() -> None:
    guide = Guide()
    core = rehearsed(2.0, guide, Fault("teleport", 0.5, 0.5, axis=2, angle_deg=-20.0), Fault("nan", 1.5, 0.1, axis=6))
    raw = np.array([list(messages.RobotMessage.FromString(data).feed_back.joints.joints) for _, data in guide.heard])
    shifted = np.flatnonzero(raw[:, 1] < -19.0)
    assert raw[shifted, 1] == pytest.approx(-20.0)
    assert len(shifted) == 124
    assert np.flatnonzero(np.isnan(raw[:, 5])).size == 24
    assert not np.isnan(raw[:, :5]).any()
    assert core.record.cycles()["planned_rad"] == pytest.approx(np.tile(HOME, (496, 1)))


def test_silence_sends_nothing_and_the_robot_moves_on() -> None:
    guide = Guide(ramp)
    core = rehearsed(1.2, guide, Fault("silence", 1.0, 0.1))
    rows = core.record.cycles()
    quiet = rows[rows["seqno"] == -1]
    assert len(quiet) == 24
    assert np.all(quiet["planned_rad_per_s"][:, 0] > 0.1)
    assert np.all(np.diff(rows["seqno"][rows["seqno"] >= 0]) == 1)


def test_a_stall_on_the_way_out_delivers_stale_packets_at_once() -> None:
    guide = Guide()
    core = rehearsed(1.0, guide, Fault("stall", 0.5, 0.1))
    times = [t_ns for t_ns, _ in guide.heard]
    assert times.count(600_000_000) == 24
    answers = shown(core).answers
    assert (answers.missed, answers.doubled) == (0, 0)  # one answer to the newest is all that is owed


def test_faults_on_the_way_in_leave_the_guide_unaware() -> None:
    guide = Guide(ramp)
    core = rehearsed(1.0, guide, Fault("loss", 0.5, 0.2, direction="in"))
    rows = core.record.cycles()
    unheard = rows[(rows["told_seqno"] == -1) & (rows["t_ns"] > 4e6)]
    assert len(unheard) == pytest.approx(50, abs=1)
    assert shown(core).answers.missed == 0
    assert len(guide.heard) == 248


def test_faults_on_the_way_out_leave_the_answers_alone() -> None:
    guide = Guide(ramp)
    core = rehearsed(1.0, guide, Fault("loss", 0.5, 0.2, probability=0.5))
    read = core.record.cycles()["told_seqno"]
    assert len(guide.heard) < 240
    assert np.sum(read >= 0) == guide.count - 1  # the last is still under way


@pytest.mark.parametrize("seed", range(8))
def test_the_same_seed_tells_the_same_and_nothing_brings_it_down(seed: int) -> None:
    faults = random_faults(seed, duration_s=3.0, count=8, after_s=0.2)
    first, second = (rehearsed(3.5, Guide(ramp), *faults, seed=seed) for _ in range(2))
    assert first.record.cycles().tobytes() == second.record.cycles().tobytes()
    assert first.record.arrivals().tobytes() == second.record.arrivals().tobytes()
    shown(first, *faults)


# What it reports


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
    core = TwinCore(TwinSettings())
    core.cycle(0, [])
    core.record.departed_ns += [3_800_000, 4_032_000, 8_064_000]
    for t_ns in (300_000, 4_332_000, 8_364_000):
        core.record.arrived(Datagram(t_ns, encode_correction(Correction(0, 0, *ramp(0.0)))), 1)
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


# At the socket


@pytest.fixture
def server() -> Any:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        yield server


def test_at_a_socket_it_converses_with_the_bare_echo(server: socket.socket, tmp_path: Path) -> None:
    thread = threading.Thread(target=echo, args=(server, 0.8))
    thread.start()
    report = run_twin("127.0.0.1", server.getsockname()[1], duration_s=0.5, out=tmp_path / "new" / "folder")
    thread.join()
    assert report.cycles + report.overruns == pytest.approx(124, abs=1)
    assert report.answers.answered > 0
    assert report.answers.doubled == 0
    assert report.record.cycles()["planned_rad"] == pytest.approx(np.tile(HOME, (report.cycles, 1)))
    assert sorted(path.name for path in (tmp_path / "new" / "folder").iterdir()) == [
        "twin.json",
        "twin_arrivals.csv",
        "twin_cycles.csv",
    ]


def test_with_nobody_there_it_goes_on(server: socket.socket, tmp_path: Path) -> None:
    port = server.getsockname()[1]
    server.close()
    report = run_twin("127.0.0.1", port, duration_s=0.1, out=tmp_path)
    assert len((tmp_path / "twin_arrivals.csv").read_text().splitlines()) == 1
    assert report.answers.answered == 0
    assert report.cycles > 0


def test_sigterm_ends_it_with_its_report(server: socket.socket) -> None:
    port = server.getsockname()[1]
    code = f"from hrcreplay.egm.twin_loop import run_twin; print(run_twin('127.0.0.1', {port}).answers.packets)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        server.recvfrom(65536)
        os.kill(process.pid, signal.SIGTERM)
        text, _ = process.communicate(timeout=10)
    assert int(text) >= 1
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("call", "text"),
    [
        ({"host": "no such host.invalid", "port": 6510}, "no such address"),
        ({"host": "127.0.0.1", "port": 99999}, "port is 99999; a whole number from 1 to 65535"),
        ({"host": "127.0.0.1", "port": 6510, "duration_s": 0.0}, "duration is 0.0 s; a positive number"),
    ],
)
def test_what_cannot_be_is_refused(call: dict[str, Any], text: str) -> None:
    with pytest.raises(SettingsError, match=text):
        run_twin(**call)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"start_deg": (0.0,) * 5}, "6 joints within range"),
        ({"start_deg": (0.0, 0.0, 60.0, 0.0, 0.0, 0.0)}, "6 joints within range"),
        ({"version": "D"}, "A, B or C"),
        ({"restart_s": math.nan}, "restart_s is nan"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(SettingsError, match=text):
        TwinSettings(**settings)


def test_every_kind_of_fault_has_a_test_here_or_with_the_channel() -> None:
    tests = "".join(path.read_text() for path in Path(__file__).parent.glob("test_*.py"))
    assert [kind for kind in KINDS if f'"{kind}"' not in tests] == []
