"""Signals of the operating system: each that would end or suspend the process brakes the robot first."""

from __future__ import annotations

import os
import signal
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hrcreplay.live import session
from hrcreplay.live.control.loop import ENDING
from hrcreplay.live.control.session_controller import SIGNALS
from hrcreplay.live.record.codec import Signal
from tests.facts import tells
from tests.live.flown import MOVING, Group, brakes_for, never_stalls, stops, told

#: What POSIX and Linux let a process catch and what would end or suspend it if it did not.
DEADLY = (
    *("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGVTALRM", "SIGPROF", "SIGXCPU"),
    *("SIGIO", "SIGPWR", "SIGTSTP", "SIGTTIN", "SIGTTOU", "SIGRTMIN", "SIGRTMAX"),
)


@pytest.mark.parametrize("name", DEADLY)
def test_a_signal_that_would_end_or_suspend_us_is_caught_and_ends_the_session(name: str) -> None:
    number = getattr(signal, name, None)
    if number is None:
        pytest.skip(f"this system has no {name}")
    loop: Any = SimpleNamespace(caught=Signal.NONE)
    before = signal.getsignal(number)
    with session._signals(loop):
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) == before
    assert loop.caught & ENDING
    assert loop.caught in SIGNALS  # it has a reason of its own


def test_a_terminal_that_is_closed_brakes_the_robot(tmp_path: Path) -> None:
    """SIGHUP to the group, as a lost connection sends it; the helpers are in sessions of their own."""
    with ExitStack() as stack:
        group = Group(tmp_path, stack)
        for name in ("SIGHUP", "SIGQUIT"):
            group.prepare(name, "--send", "--repeat", settings=("live.silent_s=2.0", "live.tracking_rad=6.0"))
        flown = {name: group.robot(name) for name in ("SIGHUP", "SIGQUIT")}
        for name, one in flown.items():
            one.session.until("motion", lambda status: status["phase"] in MOVING and status["tcp_speed"] > 0.0)
            one.session.process.send_signal(getattr(signal, name))
        for name, one in flown.items():
            one.end()
            assert one.code == 4
            assert tells(told(one), "stopped by", name)
            assert list(stops(one.folder)) == [name]
            brakes_for(name, one.folder)
            never_stalls(one)
