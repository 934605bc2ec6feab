"""Sessions whose record finds no room: none begins, the robot is stopped before, or the last line says why."""

from __future__ import annotations

import resource
from contextlib import ExitStack
from pathlib import Path

from hrcreplay.live.record.folder import NO_END
from tests.facts import tells
from tests.live.flights import DEMO
from tests.live.flown import MOVING, Group, never_stalls, read_json, told
from tests.live.sessions import Command, free_port


def test_a_session_without_room_for_its_record_does_not_begin(tmp_path: Path) -> None:
    words = (
        "live",
        "--human",
        DEMO,
        "--port",
        free_port(),
        "--out",
        tmp_path / "run",
        "--set",
        "live.disk_start_mb=1e9",
    )
    with Command(*words) as session:
        assert session.end() == 2
    (line,) = session.err
    assert tells(line, "1e+09 MB", "live.disk_start_mb")
    assert not list(tmp_path.iterdir())


def test_a_disk_that_fills_up_stops_the_robot_and_the_last_line_says_so(tmp_path: Path) -> None:
    """ "low": there is little room left; "full": a write of the recorder fails, by the system's limit on files."""
    with ExitStack() as stack:
        group = Group(tmp_path, stack)
        group.prepare("full", "--send", "--repeat", settings=("live.silent_s=2.0", "live.tracking_rad=6.0"))
        full = group.robot("full")
        full.session.until("motion", lambda status: status["phase"] in MOVING and status["tcp_speed"] > 0.0)
        size = (full.session.partial / "log.mcap").stat().st_size
        resource.prlimit(full.helpers["recorder"], resource.RLIMIT_FSIZE, (size + 100_000, size + 100_000))
        full.end()
        group.prepare("low", "--send", "--repeat", settings=("live.disk_low_mb=1e9", "live.disk_start_mb=0"))
        low = group.robot("low")
        low.end()
    assert (full.code, low.code) == (4, 4)
    why = f"recorder: {full.session.partial / 'log.mcap'}: the record cannot be written (File too large)"
    assert told(full).startswith(f"hrcreplay: {why}; braked; ")
    meta = read_json(full.folder / "run.json")
    assert meta["crashes"] == [why]
    assert NO_END in meta["notes"]
    assert (full.folder / "crash_recorder.txt").read_text().startswith(why)
    never_stalls(full)
    assert tells(told(low), "stopped by", "disk nearly full")
    assert NO_END not in read_json(low.folder / "run.json")["notes"]
