"""A share of the fuzzer; ``make fuzz`` runs all of it."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest

from hrcreplay.commands import replay
from hrcreplay.logs.reader import open_log
from hrcreplay.records import CameraFrames
from tests.live.sessions import Command
from tests.tools.fuzz.__main__ import main, robot
from tests.tools.fuzz.clip import DEMO, clip, write
from tests.tools.fuzz.spoil import SPOILERS, spoilt
from tests.tools.fuzz.trial import LIVE, trial

#: How many logs go through each command, by what they cost.
SHARE = {"fuse": 100, "audit": 10, "report": 6}
#: Live sessions, beside a robot double.
SESSIONS = 6


@pytest.mark.parametrize("command", SHARE)
def test_no_log_gets_a_traceback(command: str) -> None:
    found = [trial(number, command) for number in range(SHARE[command])]
    assert [str(one) for one in found if one.wrong] == []


def test_no_log_crashes_a_live_session() -> None:
    with robot():
        found = [trial(number, LIVE) for number in range(SESSIONS)]
    assert [str(one) for one in found if one.wrong] == []


def test_a_process_of_its_own_leaves_with_the_same_code(tmp_path: Path) -> None:
    for number in range(2):
        log = write(spoilt(number), tmp_path / f"{number}.mcap")
        with Command("fuse", log, "--out", tmp_path / f"{number}") as command:
            assert command.end() == trial(number, "fuse").code


# --- the fuzzer itself ---


def test_a_seed_is_always_the_same_log(tmp_path: Path) -> None:
    one, two = (write(spoilt(11), tmp_path / f"{i}.mcap").read_bytes() for i in range(2))
    assert one == two != write(spoilt(12), tmp_path / "other.mcap").read_bytes()


def test_everything_is_spoilt_at_some_time() -> None:
    told = {name for number in range(120) for name in spoilt(number).told}
    assert told == {spoiler.__name__ for spoiler in SPOILERS}


def test_a_clip_that_is_left_alone_is_the_demo(tmp_path: Path) -> None:
    log, demo = open_log(write(clip(14.0, 0.5), tmp_path / "clip.mcap")), open_log(DEMO)
    start_ns = demo.header.start_ns + 14_000_000_000
    mine = CameraFrames.join(list(log.frames()))
    yours = CameraFrames.join(list(demo.frames(start_ns, start_ns + 500_000_000)))
    assert len(mine) > 20
    for name in ("arrival_ns", "capture_ns", "camera", "body", "points_m", "confidence"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(yours, name))
    assert log.header.task == demo.header.task
    assert log.header.T_world_base is not None
    np.testing.assert_array_equal(log.header.T_world_base, demo.header.T_world_base)
    np.testing.assert_array_equal(log.header.T_world_camera["kinect"], demo.header.T_world_camera["kinect"])


def bug(*_args: object, **_named: object) -> NoReturn:
    raise ZeroDivisionError("put there by a test")


def leftovers(*_args: object, out: Path, **_named: object) -> NoReturn:
    out.with_name("out.partial").mkdir()
    raise SystemExit(3)


def half(*_args: object, out: Path, **_named: object) -> Path:
    out.mkdir()
    (out / "run.json").write_text('{"complete": false}')
    return out


@pytest.mark.parametrize(
    ("planted", "wrong"),
    [
        (bug, ["exit code 1", "traceback: ZeroDivisionError: put there by a test (cli/app.py:"]),
        (leftovers, ["left behind: ['out.partial']", "no line that says why"]),
        (half, ["a run folder in spite of the error"]),
    ],
)
def test_it_finds_what_was_planted(
    planted: object,
    wrong: list[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(replay, "run", planted)
    found = trial(0, "fuse", keep=tmp_path / "kept")
    assert len(found.wrong) == len(wrong)
    assert all(said.startswith(start) for said, start in zip(found.wrong, wrong, strict=True))
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {"0.mcap", "0-fuse.txt"}
    assert main(["--only", "0", "--live", "0", "--commands", "fuse", "--processes", "1"]) == 1
    assert "1 of 1 went wrong" in capsys.readouterr().out
