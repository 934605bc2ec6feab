"""Whole sessions as a user runs them: real processes on loopback. What they decide is tried in counted time as well."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.cli import app
from hrcreplay.live.record import codec
from hrcreplay.live.record.recorder import SessionLogReader
from hrcreplay.logs.reader import open_log
from hrcreplay.logs.writer import LogWriter
from tests.facts import tells
from tests.live.flights import DEMO, start
from tests.live.flown import (
    FILES,
    MOVING,
    Flown,
    Group,
    brakes_for,
    leaves_nobody,
    never_stalls,
    read_json,
    stops,
    told,
    verified,
)
from tests.live.sessions import children, every_fault


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Flown]]:
    """One session that is fine, one in shadow mode, and one that had every fault of link and robot when SIGTERM ended
    it."""
    with ExitStack() as stack:
        group = Group(tmp_path_factory.mktemp("flown"), stack)
        group.prepare("fine", "--send", "--duration", 12, settings=("prediction.method=sound",), figures=True)
        group.prepare("shadow", "--duration", 12)
        found = {name: group.robot(name) for name in ("shadow", "fine")}
        for one in found.values():
            one.end()
        pulled_up = ("live.silent_s=0.1", "live.tracking_rad=0.2")
        group.prepare("faults", "--send", "--repeat", settings=pulled_up, figures=True)
        script = every_fault(group.folder, 9.5, begin_s=1.0)
        found["faults"] = group.robot("faults", "--faults", script, "--seed", 3)
        faults = found["faults"].session
        begun_s = faults.until("an answer", lambda status: status["rate_hz"] > 0)["t_s"]
        faults.until("motion again", lambda status: status["t_s"] > begun_s + 10.0 and status["phase"] in MOVING)
        faults.process.send_signal(signal.SIGTERM)
        found["faults"].end()
        yield found


def test_a_session_ends_with_its_time_and_a_whole_folder(flown: dict[str, Flown]) -> None:
    fine = flown["fine"]
    assert (fine.code, fine.session.err) == (0, [])
    assert fine.session.out[-1] == f"{fine.folder}\n"
    assert {path.name for path in fine.folder.iterdir()} >= FILES
    assert not fine.session.partial.exists()
    assert "session over" in stops(fine.folder)
    brakes_for("session over", fine.folder)
    never_stalls(fine)
    assert fine.report["answers"]["answered"]
    leaves_nobody(fine.helpers)


@pytest.mark.parametrize("name", ["fine", "shadow", "faults"])
def test_what_was_recorded_comes_out_again_bit_for_bit(flown: dict[str, Flown], name: str) -> None:
    assert verified(flown[name].folder).endswith("looks")  # and not "breaks off"


def test_faults_of_link_and_robot_stop_it_but_not_the_session(flown: dict[str, Flown]) -> None:
    faults = flown["faults"]
    assert faults.code == 4
    assert tells(told(faults), "stopped by", "SIGTERM")
    brakes_for("SIGTERM", faults.folder)
    robots = {"motors off", "program stopped", "EGM error", "tracking error", "robot silent"}
    assert len(robots & set(stops(faults.folder))) >= 2  # which of them find it moving, the machine's pace decides
    counts = read_json(faults.folder / "run.json")["counts"]
    for name in ("robot_no_packet", "robot_duplicate", "robot_stale", "robot_lost"):
        assert counts[name] > 0, name
    assert counts["robot_sessions"] >= 3


def test_shadow_mode_sends_nothing_and_records_all(flown: dict[str, Flown]) -> None:
    shadow = flown["shadow"]
    assert shadow.code == 0
    assert shadow.report["answers"]["answered"] == 0
    assert shadow.report["answers"]["packets"]
    assert shadow.report["sessions"] == [""]
    replies = [
        codec.decode_reply(m)
        for m in SessionLogReader(shadow.folder / "log.mcap").messages()
        if codec.kind(m) == codec.REPLY
    ]
    assert replies
    assert not any(sent for sent, _ in replies)


def test_a_flipped_bit_is_found_and_named(
    flown: dict[str, Flown], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(flown["fine"].folder, run := tmp_path / "run")
    data = bytearray((run / "log.mcap").read_bytes())
    data[len(data) // 2] ^= 0b100
    (run / "log.mcap").write_bytes(data)
    monkeypatch.setattr(sys, "argv", ["hrcreplay", "verify", str(run)])
    with pytest.raises(SystemExit) as left:
        app.main()
    assert left.value.code == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"{run}/log.mcap: byte ")
    assert " s and " in lines[0]
    assert tells(lines[1:], f"{run}/log.mcap", "left")
    assert lines[-1].startswith("identical until then: ")


# --- what never begins ---


def busy_port(_folder: Path) -> tuple[list[object], int, str]:
    taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    taken.bind(("", 0))
    busy_port.socket = taken  # type: ignore[attr-defined] # as long as the module
    return ["--human", DEMO, "--port", taken.getsockname()[1]], 2, "cannot be opened"


def folder_exists(folder: Path) -> tuple[list[object], int, str]:
    (folder / "out").mkdir()
    return ["--human", DEMO], 2, "exists already"


def no_task(folder: Path) -> tuple[list[object], int, str]:
    table = start()
    with LogWriter(folder / "log.mcap") as writer:
        for name, pose in table["cameras"].items():
            writer.camera(name, np.array(pose))
        writer.frames(next(open_log(DEMO).frames()))
        writer.base(np.array(table["T_world_base"]))
    return ["--human", folder / "log.mcap"], 2, "no task"


def no_log(folder: Path) -> tuple[list[object], int, str]:
    return ["--human", folder / "nowhere.mcap"], 3, "nowhere.mcap"


def no_recording(folder: Path) -> tuple[list[object], int, str]:
    (folder / "log.mcap").write_bytes(b"this is no log")
    return ["--human", folder / "log.mcap"], 3, "log.mcap"


@pytest.mark.parametrize("wrong", [busy_port, folder_exists, no_task, no_log, no_recording])
def test_what_cannot_begin_is_one_line_and_leaves_nothing(
    wrong: Callable[[Path], tuple[list[object], int, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments, code, text = wrong(tmp_path)
    before = Counter(path.name for path in tmp_path.iterdir())
    port = [] if "--port" in arguments else ["--port", 0]
    words = ["live", *arguments, *port, "--out", tmp_path / "out", "--send"]
    monkeypatch.setattr(sys, "argv", ["hrcreplay", *map(str, words)])
    with pytest.raises(SystemExit) as left:
        app.main()
    out, err = capsys.readouterr()
    assert (left.value.code, out) == (code, "")
    assert err.count("\n") == 1
    assert text in err
    assert not children(os.getpid())
    assert Counter(path.name for path in tmp_path.iterdir()) == before
