"""The commands of a live session as processes, as a user starts them: control with its helpers, the robot double."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Thread
from types import TracebackType
from typing import Any, Self

from hrcreplay.egm.robot_double.faults import KINDS
from tests.live.crashing import BUG, UNDRAWN
from tests.live.flights import DEMO

PATIENCE_S = 900.0  # only a process that hangs takes so long
#: The processes beside control, and the modules that they run.
HELPERS = {"person": "person.source", "recorder": "record.recorder", "screen": "view.screen"}

#: A machine that also does other work may be late; what a session then does is another test's matter. Sessions side by
#: side before everything else would leave their robots no time.
PATIENT = (
    "live.real_time=false",
    "live.overrun_s=5.0",
    "live.person_late_s=10.0",
    "fusion.fresh_s=10.0",
    "live.uncertain_m=1e3",
    "live.uncertain_rad=1e3",
    "live.silent_s=10.0",
    "live.tracking_rad=10.0",
)


def free_port() -> int:
    """A UDP port that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("", 0))
        return int(taken.getsockname()[1])


def wait_for(what: str, happened: Callable[[], bool], patience_s: float = PATIENCE_S) -> None:
    """Waits for something that must happen."""
    end_s = time.monotonic() + patience_s
    while not happened():
        assert time.monotonic() < end_s, f"waited in vain for: {what}"
        time.sleep(0.01)


def children(pid: int) -> dict[str, int]:
    """The helpers of a control process by their module's name, dead ones left out."""
    found: dict[str, int] = {}
    for number in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        words = Path(f"/proc/{number}/cmdline").read_bytes().split(b"\0")
        found |= {name: int(number) for name, module in HELPERS.items() if f"hrcreplay.live.{module}".encode() in words}
    return found


def alive(pid: int) -> bool:
    """Whether a process runs: neither gone nor a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def every_fault(folder: Path, seconds: float, begin_s: float = 5.0) -> Path:
    """A script of all that can go wrong in so long: one fault after the other, with pauses to go on in between."""
    path = folder / "faults.toml"
    step_s = (seconds - begin_s) / len(KINDS)
    rows = (
        f'[[fault]]\nkind = "{kind}"\nat_s = {begin_s + step_s * i:.3f}\nduration_s = {0.25 * step_s:.3f}\n'
        + ("angle_deg = 30\n" if kind == "teleport" else "")
        for i, kind in enumerate(KINDS)
    )
    path.write_text("".join(rows))
    return path


class Command:
    """A command in a process of its own; its lines are read as they come."""

    def __init__(self, *arguments: object, bug: str = "", figures: bool = True) -> None:
        """With a bug in one place or without figures, as crashing.py has it."""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.live.crashing" if bug or not figures else "hrcreplay", *map(str, arguments)],
            env=os.environ | {BUG: bug, UNDRAWN: "" if figures else "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.out: list[str] = []
        self.err: list[str] = []
        pipes = ((self.process.stdout, self.out), (self.process.stderr, self.err))
        self._readers = [Thread(target=lambda p=p, to=to: to.extend(p), daemon=True) for p, to in pipes]
        for reader in self._readers:
            reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.process.kill()
        self.end()

    def end(self, patience_s: float = PATIENCE_S) -> int:
        """Its exit code, and all its lines read."""
        code = self.process.wait(patience_s)
        for reader in self._readers:
            reader.join(PATIENCE_S)
        return code


class Session(Command):
    """`hrcreplay live` with its status as JSON."""

    def __init__(
        self,
        folder: Path,
        port: int,
        *arguments: object,
        settings: Sequence[str] = PATIENT,
        human: Path | None = DEMO,
        bug: str = "",
        figures: bool = True,
    ) -> None:
        self.folder = folder
        self.port = port
        person = () if human is None else ("--human", human)
        sets = [word for setting in settings for word in ("--set", setting)]
        words = ("live", "--json", "--port", port, "--out", folder, *person, *arguments, *sets)
        super().__init__(*words, bug=bug, figures=figures)

    @property
    def partial(self) -> Path:
        """The folder of a session under way."""
        return self.folder.with_name(self.folder.name + ".partial")

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def status(self) -> dict[str, Any] | None:
        """The latest."""
        return json.loads(self.out[-1]) if self.out and self.out[-1].startswith("{") else None

    def until(self, what: str, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Waits for a status."""

        def happened() -> bool:
            assert self.process.poll() is None, f"waited for: {what}; the session ended: {self.err}"
            return (status := self.status) is not None and holds(status)

        try:
            wait_for(what, happened)
        except AssertionError as error:
            raise AssertionError(f"{error}; at last: {self.status} {self.err}") from error
        status = self.status
        assert status is not None
        return status

    def until_phase(self, *phases: str) -> dict[str, Any]:
        """Waits until the controller is that far."""
        return self.until(" or ".join(phases), lambda status: status["phase"] in phases)

    def interrupt(self) -> None:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)


class Twin(Command):
    """`hrcreplay twin` against a port, with its record."""

    def __init__(self, folder: Path, port: int, *arguments: object) -> None:
        self.folder = folder
        super().__init__("twin", "--port", port, "--out", folder, *arguments)

    def report(self) -> dict[str, Any]:
        """Ends it; what it was told and what it did."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        assert self.end() == 0, self.err
        report: dict[str, Any] = json.loads((self.folder / "twin.json").read_text())
        return report


def kill(pid: int) -> None:
    """``kill -9``."""
    os.kill(pid, signal.SIGKILL)
