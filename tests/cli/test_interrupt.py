"""Ctrl-C: not while compiled code calls Python, and never without an end."""

from __future__ import annotations

import signal
import threading
import time
from collections import namedtuple
from types import FrameType
from typing import Any, cast

import pytest

from hrcreplay.cli.commands import interrupt, interruptible
from hrcreplay.errors import EXIT_INTERRUPTED


class _Frame:
    """A function of a module under way, called by others."""

    def __init__(self, *modules: str) -> None:
        self.f_globals = {"__name__": modules[0]}
        self.f_back = _Frame(*modules[1:]) if modules[1:] else None


def frame(*modules: str) -> FrameType:
    """The innermost of frames of these modules."""
    return cast("FrameType", _Frame(*modules))


@pytest.mark.parametrize(
    "modules",
    [
        ("hrcreplay.pipeline.planner", "hrcreplay.cli.app"),
        ("pandas.core.frame", "hrcreplay.reporting.metrics.fusion"),
        ("hrcreplay.kernels", "numba.core.dispatcher", "hrcreplay.cli.app"),
        ("threading",),
    ],
)
def test_an_interrupt_ends_what_is_under_way(modules: tuple[str, ...]) -> None:
    with pytest.raises(KeyboardInterrupt):
        interrupt(signal.SIGINT, frame(*modules))


@pytest.mark.parametrize(
    "modules",
    [
        ("numba.core.serialize", "hrcreplay.robot.control.controllers"),
        ("namedtuple_RobotPose", "hrcreplay.robot.control.controllers"),
        ("weakref", "llvmlite.binding.executionengine", "hrcreplay.pipeline.planner"),
        ("ctypes", "hrcreplay.pipeline.planner"),
    ],
)
def test_in_what_compiled_code_calls_it_comes_again_later(modules: tuple[str, ...]) -> None:
    heard = threading.Event()
    before = signal.signal(signal.SIGINT, lambda *_: heard.set())
    try:
        interrupt(signal.SIGINT, frame(*modules))
        assert heard.wait(10.0)
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_named_tuple_tells_where_it_is_made() -> None:
    """What ``interrupt`` relies on: the constructor's own namespace."""
    made = cast("Any", namedtuple("made", "a"))
    assert made.__new__.__globals__["__name__"] == "namedtuple_made"


def test_a_command_says_that_it_was_interrupted_and_python_hears_ctrl_c_as_before(
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(SystemExit) as ended, interruptible():
            signal.raise_signal(signal.SIGINT)
            time.sleep(10.0)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert ended.value.code == EXIT_INTERRUPTED
    assert capsys.readouterr().err == "hrcreplay: interrupted\n"
