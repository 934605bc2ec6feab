"""`hrcreplay live`: the processes of a session, its loop, and what it leaves behind."""

from __future__ import annotations

import gc
import json
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

from hrcreplay.config import Settings
from hrcreplay.egm.link import Link
from hrcreplay.errors import LiveStopped, LogError, SettingsError
from hrcreplay.live import folder, watch, wire
from hrcreplay.live.helpers import Helper, step_back, take_precedence
from hrcreplay.live.loop import Loop, LoopSettings
from hrcreplay.live.pilot import Pilot
from hrcreplay.live.records import Signal
from hrcreplay.live.setup import build, live_job, start_table
from hrcreplay.live.telling import Teller
from hrcreplay.live.warming import warm

#: Longest wait for a packet before the loop looks after everything else [s].
WAIT_S = 0.02

#: Longest wait for the recording to be opened, and for the record to be finished [s].
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Request:
    """The command line of `hrcreplay live`."""

    human: Path | None  #: recording of the person; None: Zenoh
    repeat: bool
    port: int | None
    duration_s: float
    out: Path
    send: bool
    json_lines: bool
    foxglove: int | None
    config: Path | None
    overrides: tuple[str, ...]
    cell: Path | None


def run(request: Request) -> Path:
    """A whole session.

    Returns:
        The run folder.

    Raises:
        SettingsError: A setting, the cell, the task, the port or the output folder cannot be used.
        LogError: The recording of the person cannot be read.
        LiveStopped: The session ended by a stop reason; its record is complete all the same.
    """
    job, header = live_job(request.human, request.config, request.overrides, request.cell)
    live = job.settings.live
    start = start_table(job, header, sending=request.send)
    pilot = build(start)
    with closing(Link("", live.port if request.port is None else request.port, WAIT_S)) as link:
        warm(start)
        partial = folder.begin(request.out)
        loop, finished = _conduct(request, job.settings, start, pilot, link, partial)
    try:
        done = folder.finish(partial)
    except KeyboardInterrupt:
        again = f"hrcreplay verify {partial} --finish"
        raise LiveStopped(
            f"interrupted while its run folder was made; the record is whole, go on with: {again}"
        ) from None
    if pilot.fault is not None:
        raise pilot.fault
    _verdict(loop, done, finished)
    return done


def _conduct(
    request: Request, settings: Settings, start: dict[str, Any], pilot: Pilot, link: Link, partial: Path
) -> tuple[Loop, int | None]:
    """The loop with the processes around it; the loop, which is over, and the recorder's exit code."""
    anchor_ns = time.time_ns() - time.monotonic_ns()
    recorder = Helper("hrcreplay.live.recorder", ["--path", str(partial / "log.mcap")])
    person = Helper("hrcreplay.live.person", _person_arguments(request, settings, anchor_ns))
    screen = Helper("hrcreplay.live.screen", _screen_arguments(request))
    begun = False
    try:
        _await_person(person, request.human)
        begun, start_ns = True, time.monotonic_ns() + anchor_ns
        loop = Loop(pilot, link, person, recorder, _loop_settings(request, settings), anchor_ns, start_ns)
        recorder.send(wire.event(loop.start_ns, {"what": "start", **start}))
        teller = Teller(loop, screen, start, in_3d=request.foxglove is not None)
        _fly(loop, teller, real_time=settings.live.real_time)
    finally:
        screen.dismiss(2.0)
        person.dismiss(2.0)
        finished = recorder.dismiss(PATIENCE_S)
        if not begun:
            shutil.rmtree(partial, ignore_errors=True)  # there is nothing in it
    return loop, finished


def _fly(loop: Loop, teller: Teller, *, real_time: bool) -> None:
    """The loop, alone with the robot: no garbage collector, no waiting for anybody."""
    with _signals(loop):
        gc.collect()
        gc.freeze()
        gc.disable()
        for refused in take_precedence() if real_time else ():
            loop.note(f"the system refuses {refused}")
        loop.begin()
        try:
            while loop.turn():
                teller.tell()
        finally:
            step_back()
            gc.enable()
            gc.unfreeze()
        loop.recorder.send(wire.event(loop.now_ns(), {"what": "end", **outcome(loop)}))
        teller.tell(last=True)


def outcome(loop: Loop) -> dict[str, Any]:
    """What there is to say of a session at its end, as JSON."""
    return {
        "stops": [{"t_ns": t_ns, "reason": reason} for t_ns, reason in loop.pilot.stops],
        "reason": _reason(loop),
        "waiting": loop.pilot.waiting,
        "answers": loop.answers,
        "looks_skipped": loop.skipped,
        "dropped": loop.recorder.dropped,
        "counts": {name: int(count) for name, count in sorted(loop.pilot.counts().items())},
    }


def _reason(loop: Loop) -> str:
    return loop.pilot.stop or watch.of_signals(loop.caught)


def _verdict(loop: Loop, done: Path, finished: int | None) -> None:
    if finished != 0:
        raise LiveStopped(f"{done}: the recorder did not finish (exit code {finished}); the log may lack its end")
    reason = _reason(loop)
    if reason and reason not in (watch.SESSION_OVER, watch.RECORDING_OVER):
        at = next((t_ns for t_ns, why in loop.pilot.stops if why == reason), None)
        when = "" if at is None else f" after {(at - loop.start_ns) / 1e9:.1f} s"
        raise LiveStopped(f"stopped by: {reason}{when}; the record is in {done}")


@contextmanager
def _signals(loop: Loop) -> Iterator[None]:
    """Ctrl-C and SIGTERM become signals of the loop: the robot brakes before anything ends."""
    meaning = {signal.SIGINT: Signal.INTERRUPT, signal.SIGTERM: Signal.TERMINATE}

    def catch(number: int, _frame: FrameType | None) -> None:
        loop.caught |= meaning[signal.Signals(number)]

    before = {number: signal.signal(number, catch) for number in meaning}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _await_person(person: Helper, human: Path | None) -> None:
    """Waits until the human side is ready.

    Raises:
        LogError: The recording cannot be read.
        SettingsError: Zenoh cannot be opened.
    """
    kind = SettingsError if human is None else LogError
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline and person.alive:
        for message in person.messages():
            text = message[1:].decode(errors="replace")
            if message[:1] == b"N" and text.startswith("failed "):
                raise kind(text.removeprefix("failed "))
            if message[:1] == b"N" and text.startswith("ready"):
                return
        time.sleep(0.01)
    raise kind(f"{human or 'live.zenoh'}: the human side did not get ready; see what it said above")


def _loop_settings(request: Request, settings: Settings) -> LoopSettings:
    live, store_hz = settings.live, settings.occupancy.store_hz
    return LoopSettings(
        duration_s=request.duration_s,
        sending=request.send,
        person_late_s=live.person_late_s,
        overrun_s=live.overrun_s,
        keep_recorder=live.keep_recorder,
        store_every_s=0.0 if store_hz == "all" else 1.0 / store_hz,
    )


def _person_arguments(request: Request, settings: Settings, anchor_ns: int) -> list[str]:
    table = settings.model_dump(mode="json")
    common = ["--anchor", str(anchor_ns), "--options", json.dumps(table["logs"])]
    if request.human is None:
        return [*common, "--zenoh", json.dumps(table["live"]["zenoh"])]
    return [*common, "--log", str(request.human), *(["--repeat"] if request.repeat else [])]


def _screen_arguments(request: Request) -> list[str]:
    arguments = ["--json"] if request.json_lines else []
    return arguments + ([] if request.foxglove is None else ["--foxglove", str(request.foxglove)])


def default_out(human: Path | None) -> Path:
    """Where a session is left when nobody says where."""
    name = "zenoh" if human is None else human.stem
    return Path("reports") / name / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-live"
