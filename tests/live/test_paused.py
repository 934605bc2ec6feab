"""Processes of a session that the machine stops for a while (SIGSTOP), each in turn, while the robot moves."""

from __future__ import annotations

import os
import signal
import time
from contextlib import ExitStack
from pathlib import Path

from hrcreplay.live.control.session_controller import NO_FRAME, OVERRUN, PERSON_LATE, SILENT, TRACKING
from tests.live.attacks import checker
from tests.live.flown import MOVING, Group, stops, verified

#: How long, and what a robot may then be stopped by; a pause that nobody notices stops nothing.
PAUSES_S = (0.05, 0.3, 2.0)
REASONS = {"Ctrl-C", NO_FRAME, OVERRUN, PERSON_LATE, SILENT, TRACKING, "robot restarted", "joints jump", "utilization"}


def test_a_process_that_is_stopped_for_a_while_never_makes_the_robot_jump(tmp_path: Path) -> None:
    settings = ("live.silent_s=0.1", "live.tracking_rad=0.2", "live.person_late_s=0.2", "fusion.fresh_s=0.3")
    with ExitStack() as stack:
        group = Group(tmp_path, stack)
        group.prepare("run", "--send", "--repeat", settings=settings)
        one = group.robot("run")
        for name, pid in {"control": one.session.pid, **one.helpers}.items():
            for pause_s in PAUSES_S:
                one.session.until(f"motion before {name}", lambda status: status["phase"] in MOVING)
                os.kill(pid, signal.SIGSTOP)
                time.sleep(pause_s)
                os.kill(pid, signal.SIGCONT)
        one.session.until("motion at last", lambda status: status["phase"] in MOVING)
        one.session.interrupt()
        one.end()
    assert one.code == 4
    assert set(stops(one.folder)) <= REASONS
    assert {PERSON_LATE, NO_FRAME} & set(stops(one.folder))  # of the person's process, stopped for 2 s
    assert checker.greatest(one.folder / "log.mcap").share <= 1.0 + 1e-6
    assert verified(one.folder)
