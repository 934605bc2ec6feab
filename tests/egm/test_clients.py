"""Two clients that know nothing of us drive the robot double, each in a process of its own."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.egm.robot_double.udp_client import run_simulator
from tests.egm.guide_client import SWAY_DEG

#: The issue asks for 30; the suite has less time.
SECONDS = float(os.environ.get("HRCREPLAY_CLIENT_SECONDS", "2"))


@pytest.mark.parametrize(("library", "odd_steps"), [("abb_robot_client.egm", True), ("ABBRobotEGM", False)])
def test_a_client_of_others_drives_the_double_without_a_gap(library: str, odd_steps: bool) -> None:
    package = library.partition(".")[0]
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed; it comes with the dev extra")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    command = [sys.executable, str(Path(__file__).with_name("guide_client.py")), library, str(port), str(SECONDS)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as client:
        assert client.stdout is not None
        assert client.stdout.readline() == "ready\n"
        report = run_simulator("127.0.0.1", port, duration_s=SECONDS)
        answered = int(client.communicate(timeout=600)[0])  # closes its standard input
    answers, arrivals = report.answers, report.record.arrivals()
    assert answers.garbage == 0
    assert len(arrivals) == answers.packets == answered  # one each, though a busy machine may bring some late
    pause_s = np.diff(arrivals["t_ns"]).max() * 1e-9
    if pause_s < 1.5 * PERIOD_NS * 1e-9:  # each came before the next packet left
        assert (answers.missed, answers.doubled) == (0, 0)
    assert answers.seqno_steps == (answered - 1 if odd_steps else 0)  # one of them counts by twos
    assert report.sessions == [""]
    told, done = (np.degrees(report.record.cycles()[name][:, 0]) for name in ("ref_rad", "planned_rad"))
    assert np.nanmax(told) == pytest.approx(2 * SWAY_DEG, rel=0.02)
    fastest = np.pi * SWAY_DEG / SECONDS
    assert np.nanmax(np.abs(told - done)) < 1.0 + fastest * pause_s
