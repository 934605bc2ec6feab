"""Sessions that lose a process to ``kill -9``: control goes on, and the robot brakes where it must."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.live import wire
from hrcreplay.live.records import APPROACH, FOLLOWING
from hrcreplay.live.tape import Tape
from tests.live.flown import MOVING, Flown, Group, brakes_for, leaves_nobody, never_stalls, told, verified
from tests.live.sessions import kill


def moving(group: Group, *names: str) -> dict[str, Flown]:
    """Sessions whose robots move; two at a time, lest they be short of processors."""
    for name in names:
        settings = ("live.keep_recorder=false",) if name == "kept" else ()
        group.prepare(name, "--send", "--repeat", settings=settings)
    found = {name: group.robot(name) for name in names}
    for one in found.values():
        one.session.until("motion", lambda status: status["phase"] in MOVING and status["tcp_speed"] > 0.0)
    return found


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Flown]]:
    """Sessions whose robot was moving when a process got a kill -9."""
    with ExitStack() as stack:
        group = Group(tmp_path_factory.mktemp("killed"), stack)
        found = moving(group, "person", "recorder")
        for name, one in found.items():
            kill(one.helpers[name])
        for one in found.values():
            one.session.until_phase("holding")
            one.session.interrupt()
        for one in found.values():
            one.end()
        found |= moving(group, "kept", "control")
        kill(found["control"].session.pid)
        kill(found["kept"].helpers["recorder"])
        kept = found["kept"].session.until("a dead recorder", lambda status: not status["recorder"]["alive"])
        assert "recorder dead" not in kept["stops"]
        found["kept"].session.until_phase(*MOVING)
        found["kept"].session.interrupt()
        found["kept"].end()
        yield found


def test_without_the_human_side_it_brakes_and_goes_on_answering(killed: dict[str, Flown]) -> None:
    one = killed["person"]
    assert one.code == 4
    assert told(one).startswith("hrcreplay: stopped by: human side dead after ")
    brakes_for("human side dead", one.folder)
    never_stalls(one)
    verified(one.folder)
    leaves_nobody(one.helpers)


def test_without_the_recorder_it_brakes_and_goes_on_answering(killed: dict[str, Flown]) -> None:
    one = killed["recorder"]
    assert one.code == 4
    assert json.loads(one.session.out[-1])["reason"] == "recorder dead"
    assert "the recorder did not finish" in told(one)
    never_stalls(one)
    assert verified(one.folder).endswith("the record breaks off: the session or its recorder was killed")


def test_it_flies_on_without_the_recorder_where_a_setting_says_so(killed: dict[str, Flown]) -> None:
    one = killed["kept"]
    assert json.loads(one.session.out[-1])["reason"] == "Ctrl-C"
    never_stalls(one)
    verified(one.folder)


def test_without_control_the_robot_stops_by_itself_and_is_echoed_by_the_next_session(
    killed: dict[str, Flown], tmp_path: Path
) -> None:
    one = killed["control"]
    one.session.end()
    leaves_nobody(one.helpers)
    rows = [
        wire.read_answer(m) for m in Tape(one.session.partial / "log.mcap").messages() if wire.kind(m) == wire.ANSWER
    ]
    assert rows[-1].phase in (APPROACH, FOLLOWING)
    assert not one.folder.exists()
    assert verified(one.session.partial).endswith("the record breaks off: the session or its recorder was killed")
    with ExitStack() as stack:
        group = Group(tmp_path, stack)
        group.prepare("next", "--send", port=one.session.port, settings=("live.real_time=true",))
        following = Flown(group._sessions["next"], one.twin, {})
        following.session.until_phase(*MOVING)
        time.sleep(0.3)
        following.session.interrupt()
        following.end()
    assert following.code == 4
    assert told(following).startswith("hrcreplay: stopped by: Ctrl-C after ")
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
