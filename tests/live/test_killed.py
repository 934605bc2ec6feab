"""Sessions that lose a process to ``kill -9`` or to a bug: the robot is braked, and one line and the record say so."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.errors import SettingsError
from hrcreplay.live import processes
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import APPROACH, FOLLOWING
from hrcreplay.live.record.recorder import SessionLogReader
from hrcreplay.store import run_folder
from tests.facts import facts, tells
from tests.live.flown import MOVING, Flown, Group, brakes_for, leaves_nobody, never_stalls, read_json, told, verified
from tests.live.sessions import kill

#: Session -> part and place of its bug.
BUGS = {
    "recorder": "recorder/hrcreplay.live.record.codec:topic_and_data",
    "screen": "screen/hrcreplay.live.processes:ControlChannel.receive",
    "status": "control/hrcreplay.live.view.status:StatusPublisher._status",
}


def moving(group: Group, *names: str) -> dict[str, Flown]:
    """Sessions whose robots move; two at a time, lest they be short of processors."""
    for name in names:
        # a double that the machine holds up is not to be what stops it
        kept = ("live.keep_recorder=false",) if name == "kept" else ()
        settings = ("live.silent_s=2.0", "live.tracking_rad=6.0", *kept)
        bug = f"{BUGS[name]}@{group.folder / name}.bug" if name in BUGS else ""
        # of a record that breaks off, figures too
        group.prepare(name, "--send", "--repeat", settings=settings, bug=bug, figures=name == "recorder")
    found = {name: group.robot(name) for name in names}
    for one in found.values():
        one.session.until("motion", lambda status: status["phase"] in MOVING and status["tcp_speed"] > 0.0)
    return found


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Flown]]:
    """Sessions whose robot was moving when a process got a kill -9, or a bug struck."""
    with ExitStack() as stack:
        group = Group(tmp_path_factory.mktemp("killed"), stack)
        found = moving(group, "person", "recorder")
        kill(found["person"].helpers["person"])
        (group.folder / "recorder.bug").touch()
        for one in found.values():
            one.end()
        crashed = moving(group, "screen", "status")
        for name, one in crashed.items():
            (group.folder / f"{name}.bug").touch()
            one.end()
        found |= crashed | moving(group, "kept", "dead")
        kill(found["dead"].session.pid)
        kill(found["kept"].helpers["recorder"])
        kept = found["kept"].session.until("a dead recorder", lambda status: not status["recorder"]["alive"])
        assert "recorder dead" not in kept["stops"]
        found["kept"].session.until_phase(*MOVING)
        found["kept"].session.interrupt()
        found["kept"].end()
        yield found


def test_without_the_human_side_it_brakes_and_goes_on_answering(killed: dict[str, Flown]) -> None:
    one = killed["person"]
    assert tells(not_complete(one), "human side", "SIGKILL")
    brakes_for("human side dead", one.folder)
    never_stalls(one)
    verified(one.folder)
    leaves_nobody(one.helpers)


def test_without_the_recorder_it_brakes_and_goes_on_answering(killed: dict[str, Flown]) -> None:
    one = killed["recorder"]
    assert not_complete(one).startswith(
        "recorder: ZeroDivisionError: put there by a test (hrcreplay/live/record/recorder.py:"
    )
    assert json.loads(one.session.out[-1])["reason"] == "recorder dead"
    never_stalls(one)
    assert tells(verified(one.folder), "breaks off", "killed")
    leaves_nobody(one.helpers)


def test_without_the_screen_it_brakes_and_goes_on_answering(killed: dict[str, Flown]) -> None:
    one = killed["screen"]
    assert not_complete(one).startswith(
        "screen: ZeroDivisionError: put there by a test (hrcreplay/live/view/screen.py:"
    )
    brakes_for("screen dead", one.folder)
    never_stalls(one)
    verified(one.folder)
    leaves_nobody(one.helpers)


def test_a_bug_in_control_brakes_and_goes_on_answering(killed: dict[str, Flown]) -> None:
    one = killed["status"]
    assert not_complete(one).startswith(
        "control: ZeroDivisionError: put there by a test (hrcreplay/live/view/status.py:"
    )
    brakes_for("internal error", one.folder)
    never_stalls(one)
    assert tells(verified(one.folder), "control crashed", "ZeroDivisionError")
    leaves_nobody(one.helpers)


def not_complete(one: Flown) -> str:
    """What a session that crashed says of it, everywhere the same."""
    assert one.code == 4
    said, _, where = told(one).removeprefix("hrcreplay: ").rpartition("; braked; ")
    assert tells(where, "not complete", str(one.folder))
    assert not one.session.partial.exists()
    meta = read_json(one.folder / "run.json")
    assert (meta["complete"], meta["reason"], meta["crashes"]) == (False, said, [said])
    assert f"not complete: {said}" in meta["notes"]
    assert processes.read_crashes(one.folder) == [said]
    (kept,) = one.folder.glob("crash_*.txt")
    assert ("Traceback (most recent call last)" in kept.read_text()) == ("ZeroDivisionError" in said)
    with pytest.raises(SettingsError, match=facts(str(one.folder), "broke off")):
        run_folder.read_meta(one.folder)
    return said


def test_it_flies_on_without_the_recorder_where_a_setting_says_so(killed: dict[str, Flown]) -> None:
    one = killed["kept"]
    assert json.loads(one.session.out[-1])["reason"] == "Ctrl-C"
    assert tells(not_complete(one), "recorder", "SIGKILL")
    never_stalls(one)
    verified(one.folder)


def test_without_control_the_robot_stops_by_itself_and_is_echoed_by_the_next_session(
    killed: dict[str, Flown], tmp_path: Path
) -> None:
    one = killed["dead"]
    one.session.end()
    leaves_nobody(one.helpers)
    rows = [
        codec.decode_decision(m)
        for m in SessionLogReader(one.session.partial / "log.mcap").messages()
        if codec.kind(m) == codec.DECISION
    ]
    assert rows[-1].phase in (APPROACH, FOLLOWING)
    assert not one.folder.exists()
    assert tells(verified(one.session.partial), "breaks off", "killed")
    with ExitStack() as stack:
        group = Group(tmp_path, stack)
        group.prepare("next", "--send", port=one.session.port)
        following = Flown(group._sessions["next"], one.twin, {})
        following.session.until_phase(*MOVING)
        time.sleep(0.3)
        following.session.interrupt()
        following.end()
    assert following.code == 4
    assert tells(told(following), "stopped by", "Ctrl-C")
    brakes_for("Ctrl-C", following.folder)
    assert "CommTimeout" in following.report["sessions"]
    cycles = np.genfromtxt(one.twin.folder / "twin_cycles.csv", delimiter=",", names=True)
    told_ns = cycles["t_ns"][cycles["told_seqno"] >= 0]
    before = int(np.argmax(np.diff(told_ns)))  # the last answer of the first session
    between = (cycles["t_ns"] > told_ns[before] + 2e9) & (cycles["t_ns"] < told_ns[before + 1])
    speeds = np.array([cycles[f"planned_rad_per_s_{axis}"] for axis in range(1, 7)])
    assert np.any(speeds[:, cycles["t_ns"] == told_ns[before]])
    assert not np.any(np.abs(speeds[:, between]) > 1e-9)
    assert np.all(np.array(following.report["commanded"]["start_jump_rad"]) < 1e-6)
