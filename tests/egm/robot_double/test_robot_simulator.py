"""The robot double: what it sends, and how it takes what it is told, at a socket too."""

from __future__ import annotations

import math
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.egm import motion_link_pb2 as messages
from hrcreplay.egm.codec import Correction, Mci, Motors, Rapid, decode_robot, encode_correction
from hrcreplay.egm.robot_double.faults import Datagram
from hrcreplay.egm.robot_double.robot_simulator import SimulatedRobot, SimulatorSettings
from hrcreplay.egm.robot_double.servo import PERIOD_NS, ServoSettings
from hrcreplay.egm.robot_double.udp_client import run_simulator
from hrcreplay.errors import SettingsError
from tests.egm.echo import echo
from tests.egm.rehearsals import HOME, Guide, ramp, ramp_until, rehearsed, still

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
    core = SimulatedRobot(SimulatorSettings())
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
    core = SimulatedRobot(SimulatorSettings())
    good = encode_correction(Correction(1, 0, HOME, np.zeros(6)))
    core.cycle(0, [Datagram(0, b"\xff\xff"), Datagram(0, b""), Datagram(0, good)])
    for cycle in (1, 2):
        core.cycle(cycle * PERIOD_NS, [])
    assert core.record.cycles()["told_seqno"].tolist() == [-1, -1, 1]
    assert core.record.garbage == 2


def test_a_robot_that_was_held_up_has_moved_on_meanwhile() -> None:
    prompt, held = SimulatedRobot(SimulatorSettings()), SimulatedRobot(SimulatorSettings())
    told = [Datagram(0, encode_correction(Correction(1, 0, *ramp(0.0))))]
    for cycle in range(20):
        prompt.cycle(cycle * PERIOD_NS, told if cycle == 0 else [])
    for cycle in (0, 1, 19):
        held.cycle(cycle * PERIOD_NS, told if cycle == 0 else [])
    np.testing.assert_array_equal(prompt.servo.q, held.servo.q)


def test_a_cycle_that_is_a_little_late_is_one_cycle() -> None:
    prompt, shaky = SimulatedRobot(SimulatorSettings()), SimulatedRobot(SimulatorSettings())
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


# At the socket


@pytest.fixture
def server() -> Any:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        yield server


def test_at_a_socket_it_converses_with_the_bare_echo(server: socket.socket, tmp_path: Path) -> None:
    thread = threading.Thread(target=echo, args=(server, 0.8))
    thread.start()
    report = run_simulator("127.0.0.1", server.getsockname()[1], duration_s=0.5, out=tmp_path / "new" / "folder")
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
    report = run_simulator("127.0.0.1", port, duration_s=0.1, out=tmp_path)
    assert len((tmp_path / "twin_arrivals.csv").read_text().splitlines()) == 1
    assert report.answers.answered == 0
    assert report.cycles > 0


def test_sigterm_ends_it_with_its_report(server: socket.socket) -> None:
    port = server.getsockname()[1]
    code = (
        "from hrcreplay.egm.robot_double.udp_client import run_simulator; "
        f"print(run_simulator('127.0.0.1', {port}).answers.packets)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        server.recvfrom(65536)
        os.kill(process.pid, signal.SIGTERM)
        text, _ = process.communicate(timeout=600)
    assert int(text) >= 1
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("call", "text"),
    [
        ({"host": "no such host.invalid", "port": 6510}, "no such address"),
        ({"host": "127.0.0.1", "port": 99999}, r"port .*99999.* 1 to 65535"),
        ({"host": "127.0.0.1", "port": 6510, "duration_s": 0.0}, r"duration .*0\.0 s"),
    ],
)
def test_what_cannot_be_is_refused(call: dict[str, Any], text: str) -> None:
    with pytest.raises(SettingsError, match=text):
        run_simulator(**call)


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
        SimulatorSettings(**settings)
