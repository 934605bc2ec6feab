"""The command ``live``: starts the processes of a session, runs its control loop and makes its run folder."""

from __future__ import annotations

import gc
import json
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

from hrcreplay.egm.link import EgmServer
from hrcreplay.egm.step_gate import StepGate
from hrcreplay.errors import HrcReplayError, LiveStopped, LogError, SettingsError
from hrcreplay.live import processes
from hrcreplay.live.control.loop import ENDING, Loop, LoopSettings, bring_to_rest
from hrcreplay.live.control.session_controller import (
    PERSON_DEAD,
    RECORDING_OVER,
    SESSION_OVER,
    SessionController,
    reason_of_signals,
)
from hrcreplay.live.control.setup import build_controller, compile_kernels, live_run_config, start_table
from hrcreplay.live.priority import raise_priority, restore_priority
from hrcreplay.live.processes import HelperProcess
from hrcreplay.live.record import codec, folder
from hrcreplay.live.record.codec import Signal
from hrcreplay.live.record.recorder import free_bytes
from hrcreplay.live.view.status import StatusPublisher
from hrcreplay.settings.load import Settings

#: Longest wait for a packet before the loop does its other work [s].
WAIT_S = 0.02

#: Longest wait until the recording is opened, and until the record is finished [s].
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
    """Runs a complete session.

    Returns:
        The run folder.

    Raises:
        SettingsError: A setting, the cell, the task, the port or the output folder cannot be used.
        LogError: The recording of the person cannot be read.
        LiveStopped: The session ended by a stop reason, or a part of it crashed; after a crash its record is not
            complete.
    """
    partial = folder.make_partial(request.out)
    try:
        with ExitStack() as stack:
            prepared = _prepare(request, partial, stack)
            loop, crashes = _run_processes(request, prepared, partial)
    except _CrashedError:
        raise _broken_off(partial, processes.read_crashes(partial)) from None
    except (HrcReplayError, KeyboardInterrupt, SystemExit):
        if not (partial / folder.LOG).exists():
            shutil.rmtree(partial, ignore_errors=True)  # the folder has no record
        raise
    except Exception as error:  # an internal error
        raise _broken_off(partial, [processes.write_crash(partial, processes.CONTROL, error)]) from None
    done = _finish(partial, crashes)
    _verdict(loop, done, crashes)
    return done


def _finish(partial: Path, crashes: list[str]) -> Path:
    """Makes the run folder of a session that is over."""
    try:
        return folder.finish(partial)
    except KeyboardInterrupt:
        again = f"hrcreplay verify {partial} --finish"
        raise LiveStopped(
            f"interrupted while its run folder was made; the record is complete, so make the folder with: {again}"
        ) from None
    except HrcReplayError:
        if not crashes:
            raise
        raise _broken_off(partial, crashes) from None
    except Exception as error:  # an internal error
        raise _broken_off(partial, [*crashes, processes.write_crash(partial, processes.FOLDER, error)]) from None


def _broken_off(partial: Path, crashes: list[str]) -> LiveStopped:
    """The error for a session without a run folder; also writes the crashes to its partial folder."""
    folder.keep_incomplete(partial, crashes)
    return LiveStopped(f"{crashes[0]}; not complete: what there is of the record, and the traceback, is in {partial}")


class _CrashedError(Exception):
    """A helper crashed before the session began; its crash file has the details."""


@dataclass(frozen=True)
class _Prepared:
    """A session before its processes start."""

    settings: Settings
    start: dict[str, Any]
    controller: SessionController
    link: EgmServer


def _prepare(request: Request, partial: Path, stack: ExitStack) -> _Prepared:
    """Prepares settings, controller and port, checks the space on the disk, and compiles every kernel."""
    run_config, header = live_run_config(request.human, request.config, request.overrides, request.cell)
    port = run_config.settings.live.port if request.port is None else request.port
    start = start_table(run_config, header, sending=request.send)
    controller = build_controller(start)
    unguarded = controller.setup.robot.unguarded_tool
    if unguarded is not None:
        sys.stderr.write(f"hrcreplay: {unguarded}\n")
    live = run_config.settings.live
    link = EgmServer(live.listen_address, port, WAIT_S, robot=live.robot_address, silence_s=live.silent_s)
    stack.enter_context(closing(link))
    _check_disk(partial, live.disk_start_mb)
    compile_kernels(start)
    return _Prepared(run_config.settings, start, controller, link)


def _check_disk(partial: Path, least_mb: float) -> None:
    """Raises if the disk may be too small for the record.

    Raises:
        SettingsError: There is less space than ``least_mb`` [MB].
    """
    free_mb = free_bytes(partial) / 1e6
    if free_mb < least_mb:
        raise SettingsError(
            f"{partial.parent}: {free_mb:.0f} MB are left on its disk; would be right: {least_mb:g} MB "
            "(live.disk_start_mb), or --out on another disk"
        )


def _run_processes(request: Request, prepared: _Prepared, partial: Path) -> tuple[Loop, list[str]]:
    """Starts the processes and runs the loop; returns the finished loop and the descriptions of crashes."""
    settings = prepared.settings
    anchor_ns = time.time_ns() - time.monotonic_ns()
    to_record = ["--path", str(partial / folder.LOG), "--low", str(round(settings.live.disk_low_mb * 1e6))]
    recorder = HelperProcess(processes.RECORDER, "hrcreplay.live.record.recorder", to_record, partial)
    person_arguments = _person_arguments(request, settings, anchor_ns)
    person = HelperProcess(processes.PERSON, "hrcreplay.live.person.source", person_arguments, partial, expected=(2, 3))
    screen = HelperProcess(processes.SCREEN, "hrcreplay.live.view.screen", _screen_arguments(request), partial)
    begun = False
    try:
        _await_person(person, request.human)
        begun, start_ns = True, time.monotonic_ns() + anchor_ns
        parts = prepared.controller, prepared.link, person, recorder
        setup = prepared.controller.setup
        gate = StepGate(setup.robot.dq_max[setup.joint_order], settings.live.cycle_s)
        loop = Loop(*parts, _loop_settings(request, settings), gate, anchor_ns, start_ns, screen)
        recorder.send(codec.encode_event(loop.start_ns, {"what": "start", **prepared.start}))
        crashes = _run_loop(
            loop, prepared.start, partial, real_time=settings.live.real_time, in_3d=bool(request.foxglove)
        )
    finally:
        screen.close(2.0)
        person.close(2.0)
        if recorder.close(PATIENCE_S) is None:
            recorder.crash = processes.write_crash(partial, processes.RECORDER, f"did not finish in {PATIENCE_S:g} s")
        if not begun:
            (partial / folder.LOG).unlink(missing_ok=True)  # the record is empty
    told = [helper.crash for helper in (recorder, person, screen) if helper.crash]  # a full disk has no crash files
    return loop, list(dict.fromkeys([*crashes, *processes.read_crashes(partial), *told]))


def _run_loop(loop: Loop, start: dict[str, Any], partial: Path, *, real_time: bool, in_3d: bool) -> list[str]:
    """Runs the loop without the garbage collector and without waiting for other processes. Returns its crashes."""
    found: list[Exception] = []
    with _signals(loop):
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            for refused in raise_priority() if real_time else ():
                loop.note(f"the system refuses {refused}")
            publisher = StatusPublisher(loop, start, in_3d=in_3d)
            loop.begin()
            while loop.run_cycle():
                publisher.publish()
        except Exception as error:  # on any error, brake the robot first
            found.append(error)
            bring_to_rest(loop, processes.describe_exception(error))
        finally:
            restore_priority()
            gc.enable()
            gc.unfreeze()
        try:
            loop.recorder.send(codec.encode_event(loop.now_ns(), {"what": "end", **outcome(loop)}))
            publisher.publish(last=True)
        except Exception as error:  # report it as a crash
            found.append(error)
    if loop.controller.fault is not None:
        found.insert(0, loop.controller.fault)
    return [processes.write_crash(partial, processes.CONTROL, error) for error in found]


def outcome(loop: Loop) -> dict[str, Any]:
    """Result of a session at its end, as JSON."""
    return {
        "stops": [{"t_ns": t_ns, "reason": reason} for t_ns, reason in loop.controller.stops],
        "reason": _reason(loop),
        "waiting": loop.controller.waiting,
        "answers": loop.answers,
        "looks_skipped": loop.skipped,
        "dropped": loop.recorder.dropped,
        "counts": {name: int(count) for name, count in sorted(_counts(loop).items())},
    }


def _counts(loop: Loop) -> Counter[str]:
    return loop.controller.counts() + Counter({"datagrams of others": loop.link.strangers})


def _reason(loop: Loop) -> str:
    return loop.controller.stop or reason_of_signals(loop.caught | (loop.signals & ENDING))


def _verdict(loop: Loop, done: Path, crashes: list[str]) -> None:
    if crashes:
        braked = "braked; " if loop.controller.stops else ""
        raise LiveStopped(f"{crashes[0]}; {braked}the record, not complete, and the traceback are in {done}")
    reason = _reason(loop)
    if reason and reason not in (SESSION_OVER, RECORDING_OVER):
        at = next((t_ns for t_ns, why in loop.controller.stops if why == reason), None)
        when = "" if at is None else f" after {(at - loop.start_ns) / 1e9:.1f} s"
        last_words = [note.removeprefix("failed ") for note in loop.notes if note.startswith("failed ")]
        why = f" ({last_words[-1]})" if reason == PERSON_DEAD and last_words else ""
        raise LiveStopped(f"stopped by: {reason}{why}{when}; the record is in {done}")


#: Signals of the operating system -> signals of the loop, which end the session.
_MEANING: dict[int, Signal] = {
    signal.SIGINT: Signal.INTERRUPT,
    signal.SIGTERM: Signal.TERMINATE,
    signal.SIGHUP: Signal.HANGUP,
    signal.SIGQUIT: Signal.QUIT,
    signal.SIGTSTP: Signal.SUSPEND,
}
#: Signals without a handler: those that do not end or suspend a process, and those after which it cannot continue.
_LEFT_ALONE = {
    *("SIGCHLD", "SIGCONT", "SIGURG", "SIGWINCH", "SIGPIPE", "SIGXFSZ"),
    *("SIGKILL", "SIGSTOP", "SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGABRT", "SIGTRAP", "SIGSYS"),
}


@contextmanager
def _signals(loop: Loop) -> Iterator[None]:
    """Converts signals of the process to signals of the loop, so that the robot brakes before the process ends."""

    def catch(number: int, _frame: FrameType | None) -> None:
        loop.caught |= _MEANING.get(number, Signal.OTHER)

    before = {
        number: signal.signal(number, catch)
        for number in sorted(signal.valid_signals())
        if getattr(number, "name", "") not in _LEFT_ALONE
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _await_person(person: HelperProcess, human: Path | None) -> None:
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
    if not person.alive:
        raise _CrashedError
    raise kind(f"{human or 'live.zenoh'}: the human side did not get ready within {PATIENCE_S:g} s")


def _loop_settings(request: Request, settings: Settings) -> LoopSettings:
    live, store_hz = settings.live, settings.prediction.store_hz
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
    """Default run folder of a session."""
    name = "zenoh" if human is None else human.stem
    return Path("reports") / name / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-live"
