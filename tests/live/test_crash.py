"""A bug in any part of a session: the robot is braked, one line tells of it, and the record is not complete."""

from __future__ import annotations

import json
import os
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.cli import app
from hrcreplay.egm.codec import Correction, decode_correction
from hrcreplay.egm.link import EgmSession, Received
from hrcreplay.errors import LiveStopped
from hrcreplay.live import processes, session
from hrcreplay.live.control import session_controller
from hrcreplay.live.control.loop import FINAL_ANSWERS, FallbackBrake, Loop, bring_to_rest
from hrcreplay.live.control.setup import build_controller
from hrcreplay.live.control.stages import Observer
from hrcreplay.live.record import codec, folder
from hrcreplay.live.verify import SessionRecomputation
from hrcreplay.live.view import status
from hrcreplay.robot.control import controllers, stops
from hrcreplay.robot.control.controllers import QpController
from hrcreplay.robot.control.stops import stop_straight
from tests.facts import facts, tells
from tests.live.counted import Cable, CountedLoop, counted
from tests.live.crashing import BUG, failing
from tests.live.flights import BEGIN_NS, CYCLE_S, DEMO, Flight
from tests.live.sessions import children

#: Where a bug may be; those of the stages the controller catches itself.
PLACES: dict[str, tuple[Any, str]] = {
    "fusion": (Observer, "fuse"),
    "prediction": (Observer, "predict"),
    "controller": (QpController, "step"),
    "compiled tick": (controllers, "decide_held"),
    "packets": (session_controller, "decode_robot"),
    "conversation": (EgmSession, "classify_all"),
    "reply": (EgmSession, "reply"),
    "encoding": (session_controller, "encode_correction"),
    "watchdog": (session_controller, "reason_of_person"),
    "messages of the human side": (Loop, "_receive_skeletons"),
    "record of an answer": (codec, "encode_decision"),
    "record of a packet": (codec, "encode_robot_packet"),
    "record of a look": (codec, "encode_perception"),
    "status": (status.StatusPublisher, "_status"),
    "link": (Cable, "newest"),
    "link during a look": (Cable, "waiting"),
}
MOVING_S = 0.45


class Sent:
    """What went to the robot of a session with a bug."""

    def __init__(self, place: str, at_s: float, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.flight = Flight(overrides=("live.approach_speed=1.0",))
        self.loop: CountedLoop = counted(self.flight, duration_s=10.0)
        self.sent: list[tuple[int, Correction]] = []
        send = self.loop.link.answer
        clock = self.loop.clock

        def sends(data: bytes, to: Any) -> None:
            self.sent.append((clock.t_ns, decode_correction(data)))
            send(data, to)

        def sleeps(seconds: float) -> None:
            clock.t_ns += round(seconds * 1e9)

        monkeypatch.setattr(self.loop.link, "answer", sends)
        monkeypatch.setattr(time, "sleep", sleeps)
        self.before: int | None = None  #: replies before the bug struck

        def fails() -> bool:
            if clock.t_ns < BEGIN_NS + round(at_s * 1e9):
                return False
            self.before = len(self.sent) if self.before is None else self.before
            return True

        owner, name = PLACES[place]
        monkeypatch.setattr(owner, name, failing(getattr(owner, name), fails))
        self.lines = session._run_loop(self.loop, self.flight.start, folder, real_time=False, in_3d=False)

    def after(self) -> list[Correction]:
        """From the last reply before the bug on."""
        assert self.before is not None
        return [reply for _, reply in self.sent[self.before - 1 :]]


@pytest.mark.parametrize("place", PLACES)
def test_a_bug_anywhere_in_control_brakes_a_moving_robot_to_rest(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Sent(place, MOVING_S, tmp_path, monkeypatch)
    robot, replies = found.flight.robot, found.after()
    assert np.abs(replies[0].dq).max() > 3.0, "it was fast"
    stop = stop_straight(replies[0].q, replies[0].dq, robot.ddq_max, CYCLE_S)
    assert len(replies) > stop.ticks
    for row, reply in enumerate(replies):
        np.testing.assert_allclose(reply.q, stop.q[min(row, stop.ticks)], rtol=0, atol=1e-12)
        np.testing.assert_allclose(reply.dq, stop.dq[min(row, stop.ticks)], rtol=0, atol=1e-12)
    assert not any(np.any(reply.dq) for reply in replies[-FINAL_ANSWERS:])
    assert all((two.seqno - one.seqno) % 2**32 == 1 for one, two in pairwise(replies))
    assert [why for _, why in found.flight.controller.stops] == [session_controller.FAULT]
    gaps = np.diff([t_ns for t_ns, _ in found.sent]) * 1e-9
    assert gaps.max() < 3 * CYCLE_S, "it went on being answered"


@pytest.mark.parametrize("place", PLACES)
def test_a_bug_is_one_line_and_a_traceback_in_the_folder(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """In the first tick, before which nothing was sent: the robot is never told to move."""
    found = Sent(place, 0.0, tmp_path, monkeypatch)
    assert found.lines
    assert all(line.startswith("control: ZeroDivisionError: put there by a test (") for line in found.lines)
    assert processes.read_crashes(tmp_path) == found.lines[:1]
    text = (tmp_path / "crash_control.txt").read_text()
    assert text.startswith(f"{found.lines[0]}\n\nTraceback (most recent call last):\n")
    assert text.count("put there\nby a test") >= len(found.lines)
    assert not any(np.any(reply.dq) for _, reply in found.sent)
    assert capfd.readouterr() == ("", "")


def test_the_place_of_a_bug_is_where_it_is_in_our_code() -> None:
    try:
        stops.at_rest({})  # type: ignore[arg-type]
    except KeyError as error:
        said = processes.describe_exception(error)
    lines = Path(stops.__file__).read_text().splitlines()
    number = next(i for i, line in enumerate(lines, 1) if "return Stop(q[None]" in line)
    place = f"hrcreplay/robot/control/stops.py:{number}, in at_rest"
    assert said == f"KeyError: None ({place})"


def test_a_robot_that_is_elsewhere_is_told_to_stay_there() -> None:
    brake = FallbackBrake([360.0] * 6, [-90.0] * 6, [90.0] * 6, 0.004, 10.0, [0.0] * 6, [20.0] * 6, 7, [])
    brake.update_position([9.0] * 6)  # it lags
    assert brake.dq == [20.0] * 6
    brake.update_position([11.0] * 6)
    said = decode_correction(brake.step(0))
    assert brake.at_rest
    assert said.seqno == 8
    np.testing.assert_allclose(said.q, np.radians(11.0))


def test_a_brake_stays_within_the_joints_limits() -> None:
    brake = FallbackBrake([360.0] * 6, [-90.0] * 6, [90.0] * 6, 0.004, 10.0, [89.99] * 5 + [95.0], [20.0] * 6, 0, [])
    said = [decode_correction(brake.step(0)) for _ in range(20)]
    assert brake.at_rest
    np.testing.assert_allclose(np.degrees([reply.q[:5] for reply in said]).max(), 90.0)
    np.testing.assert_allclose(np.degrees([reply.q[5] for reply in said]), 95.0)  # outside: not further


def test_garbage_is_not_answered_and_silence_ends_it() -> None:
    flight = Flight().fly(MOVING_S)
    loop = counted(flight)
    loop.sent, loop.sender = flight.answers[-1].datagram, ("192.0.2.1", 6510)
    lot = [Received(b"\xff", (), loop.sender, 0, 1)]
    told: list[bytes] = []

    class Silent:
        def newest(self) -> Received | None:
            return lot.pop() if lot else None

        def answer(self, data: bytes, _to: Any) -> None:
            told.append(data)

    loop.link = Silent()  # type: ignore[assignment]
    bring_to_rest(loop, "why")
    assert not told


def test_a_session_that_crashed_comes_out_the_same_again_until_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Sent("reply", MOVING_S, tmp_path, monkeypatch)
    monkeypatch.undo()
    messages: list[bytes] = found.loop.recorder.kept  # type: ignore[attr-defined]
    kinds = [codec.kind(message) for message in messages]
    events = [codec.decode_event(message) for message in messages if codec.kind(message) == codec.EVENT]
    assert [event["what"] for event in events] == ["crash", "end"]
    assert events[1]["reason"] == session_controller.FAULT
    again = SessionRecomputation(build_controller(found.flight.start))
    crashed_at = next(i for i, message in enumerate(messages) if b'"crash"' in message)
    assert not any(again.differences_at(message) for message in messages[: crashed_at + 1])
    assert again.crashed.startswith("ZeroDivisionError: put there by a test")
    rows = [codec.decode_decision(m).row for m in messages[crashed_at:] if codec.kind(m) == codec.DECISION]
    assert kinds[crashed_at:].count(codec.REPLY) == len(rows) > 50 + FINAL_ANSWERS
    assert rows[0] is not None
    assert rows[0].dq.any()
    assert rows[-1] is not None
    assert not rows[-1].dq.any()


def test_a_recording_that_cannot_be_read_any_further_is_named() -> None:
    loop = counted(Flight())
    loop.controller.stop = session_controller.PERSON_DEAD
    loop.notes += ["failed log.mcap: no further", "a later remark"]
    with pytest.raises(LiveStopped, match=facts("human side dead", "log.mcap: no further", "run")):
        session._verdict(loop, Path("run"), [])


# --- bugs before and after the flight ---


class Live:
    """`hrcreplay live` in this process, without a robot, for a moment."""

    def __init__(self, out: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
        words = ["live", "--json", "--human", DEMO, "--duration", "0.2", "--port", "0", "--out", out]
        monkeypatch.setattr(sys, "argv", ["hrcreplay", *map(str, words)])
        with pytest.raises(SystemExit) as left:
            app.main()
        self.code = left.value.code
        self.err = capfd.readouterr().err
        self.partial = out.with_name(out.name + ".partial")
        self.files = {path.name for path in self.partial.iterdir()}
        assert not out.exists()
        assert not children(os.getpid())

    def told(self, part: str) -> str:
        """What all of it says, and where that is."""
        (line,) = self.err.splitlines()
        said, _, where = line.removeprefix("hrcreplay: ").partition("; ")
        assert self.code == 4
        assert tells(where, "not complete", str(self.partial))
        assert processes.read_crashes(self.partial) == [said]
        assert said.startswith(f"{part}: ZeroDivisionError: put there by a test (")
        meta = json.loads((self.partial / "run.json").read_text())
        assert meta == {"command": "live", "complete": False, "reason": said, "crashes": [said]}
        return said


def broken(*_args: object, **_named: object) -> None:
    raise ZeroDivisionError("put there by a test")


def test_a_bug_before_the_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(session, "compile_kernels", broken)
    live = Live(tmp_path / "out", monkeypatch, capfd)
    live.told(processes.CONTROL)
    assert live.files == {"run.json", "crash_control.txt"}


def test_a_bug_in_the_human_side_before_the_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(session, "compile_kernels", lambda _start: None)
    monkeypatch.setattr(processes, "ENTRY", "tests.live.crashing")
    monkeypatch.setenv(BUG, f"human side/hrcreplay.live.person.log_playback:Playback.due@{tmp_path}")
    live = Live(tmp_path / "out", monkeypatch, capfd)
    live.told(processes.PERSON)
    assert live.files == {"run.json", "crash_human_side.txt"}


def test_a_bug_in_the_report_leaves_the_record_to_be_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(session, "compile_kernels", lambda _start: None)
    with monkeypatch.context() as within:
        within.setattr(folder, "write_report", broken)
        live = Live(tmp_path / "out", monkeypatch, capfd)
    live.told(processes.FOLDER)
    assert live.files == {"run.json", "crash_run_folder.txt", "log.mcap"}
    monkeypatch.setattr(folder, "write_report", lambda *_: None)
    meta = json.loads((folder.finish(live.partial) / "run.json").read_text())
    assert meta["complete"] is False
