"""Live sessions with two people: the robot keeps clear of both, as a replay does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hrcreplay.live.control import session_controller
from hrcreplay.live.control.setup import build_controller
from hrcreplay.live.record import codec, folder
from hrcreplay.live.record.codec import PHASES
from hrcreplay.live.verify import verify
from hrcreplay.pipeline.person_fuser import PersonFuser
from hrcreplay.records import BODY, CameraFrames, HumanStates, volume_name
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from tests.facts import tells
from tests.live import made
from tests.live.flights import BEGIN_NS, Flight, steps_keep_the_limits
from tests.visits import cell_around

FAST = "live.approach_speed=1.0"


def stands(_s: float) -> tuple[float, float]:
    """Somebody far from the robot, in view."""
    return 2.9, -1.2


def comes(s: float) -> tuple[float, float] | None:
    """Somebody who comes into view after 2 s, walks up to the robot and stays."""
    return None if s < 2.0 else (max(0.75, 3.0 - 1.2 * (s - 2.0)), 0.5)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight((FAST,), stands, second=comes).fly(7.0)


@pytest.fixture(scope="module")
def stored(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The record of that session, with the volumes of the last look."""
    partial = folder.make_partial(tmp_path_factory.mktemp("runs") / "session")
    perception = flight.controller.perception
    assert perception is not None
    start = codec.encode_event(BEGIN_NS - 1, {"what": "start", **flight.start})
    made.record(partial / "log.mcap", [start, *flight.messages, codec.encode_volumes(perception)], chunk=500)
    return folder.finish(partial)


def test_the_robot_keeps_clear_of_whoever_is_nearest(flight: Flight) -> None:
    assert not flight.controller.stops
    assert flight.top_speed(1.0, 2.0) > 0.3
    assert flight.top_speed(6.0, 7.0) < 0.05  # the second person stands at the robot, the first is far away
    names = flight.start["neighbours"], flight.start["limbs"]
    last = volume_name(flight.answers[-1].limb, *names)
    assert last.endswith("of person 2")
    before = {volume_name(a.limb, *names) for a in flight.answers if a.limb >= 0 and a.t_ns < BEGIN_NS + 2 * 10**9}
    assert not {name for name in before if "person" in name}
    certified = [answer.row.certified for answer in flight.answers if answer.row is not None]
    assert all(certified)
    steps_keep_the_limits(flight)


def test_with_the_nearest_only_the_second_person_is_not_seen() -> None:
    flight = Flight((FAST, "logs.people=nearest"), stands, second=comes).fly(6.0)
    assert {len(states) for states in flight.states} == {1}
    assert flight.top_speed(5.0, 6.0) > 0.3
    assert flight.controller.counts()["person_frames_beside_others"]


def test_looks_are_the_replay_tick_by_tick(flight: Flight) -> None:
    observer = build_controller(flight.start).observer
    tables = [observer._frames(t_ns, [data]) for t_ns, data in flight.frames]
    frames = CameraFrames.join([table for table in tables if table is not None])
    live = HumanStates.join(flight.states)
    ticks = np.unique(live.t_ns)
    assert {len(states) for states in flight.states} == {1, 2}
    fuser = PersonFuser(observer._fuser.stage, observer._cameras)
    again = fuser.update(ticks, frames)[0].states
    for name, mine in vars(live).items():
        np.testing.assert_array_equal(mine, getattr(again, name), err_msg=name)


def test_a_body_counts_by_its_points_at_once_and_does_not_stop_the_session(flight: Flight) -> None:
    young = [states for states in flight.states if states.by_points.any()]
    assert 0.2 < (young[-1].t_ns[0] - young[0].t_ns[0]) * 1e-9 < 0.4
    assert young[0].numbers.tolist() == [1, 2]
    assert np.isfinite(young[0].points_m[1]).any()


def test_the_run_folder_has_both_people(flight: Flight, stored: Path) -> None:
    live = HumanStates.join(flight.states)
    (table,) = read_states(stored / "state.parquet", 10**9)
    assert table.person is not None
    for name in ("t_ns", "person", "p", "v", "p_std", "unseen_s", "points_m", "valid"):
        np.testing.assert_array_equal(getattr(table, name), getattr(live, name), err_msg=name)
    motion = pd.read_parquet(stored / "motion.parquet")
    names = flight.start["neighbours"], flight.start["limbs"]
    assert motion["limb"].dropna().tolist() == [volume_name(a.limb, *names) for a in flight.answers if a.limb >= 0]
    occupancy = pd.read_parquet(stored / "occupancy.parquet")
    assert occupancy["person"].tolist() == [1] * len(BODY) + [2] * len(BODY)
    assert occupancy["limb"].tolist() == list(BODY) * 2
    measurements = pd.read_parquet(stored / "measurements.parquet")
    assert set(measurements["person"]) == {1, 2}
    assert len(measurements) == len(flight.frames)
    assert tells(run_folder.read_meta(stored)["notes"], "2 bodies", "person 1", "person 2")


def test_a_session_with_two_people_comes_out_the_same_again(stored: Path) -> None:
    found = verify(stored)
    assert found.identical, found.lines


def test_the_number_of_a_person_is_compared(flight: Flight, tmp_path: Path) -> None:
    partial = folder.make_partial(tmp_path / "session")
    start = codec.encode_event(BEGIN_NS - 1, {"what": "start", **flight.start})
    messages = [start, *flight.messages]
    at = next(
        i for i, m in enumerate(messages) if m[:1] == codec.PERCEPTION and len(codec.decode_perception(m).people) > 1
    )
    spoiled = bytearray(messages[at])
    place = codec._LOOK.size + 8
    assert spoiled[place] == 2
    spoiled[place] = 3
    made.record(partial / "log.mcap", [*messages[:at], bytes(spoiled), *messages[at + 1 :]], chunk=500)
    found = verify(partial)
    assert not found.identical
    assert tells(found.lines, "people", "[1, 3]", "[1, 2]")


def test_somebody_who_is_lost_beside_another_stops_the_session() -> None:
    flight = Flight((FAST,), stands, second=lambda s: None if s > 3.0 else (2.4, 1.0)).fly(5.0)
    assert [reason for _, reason in flight.controller.stops] == [session_controller.NO_FRAME]
    assert flight.top_speed(1.0, 3.0) > 0.3
    assert flight.top_speed(4.5, 5.0) == 0.0
    assert PHASES[flight.answers[-1].phase] == "holding"


def test_in_a_watched_cell_people_come_and_go(tmp_path: Path) -> None:
    cell = cell_around(tmp_path / "cell.toml", 2.5)

    def passes(s: float) -> tuple[float, float] | None:
        place = -1.6 + 1.2 * (s - 4.0)
        return (2.2, place) if s > 4.0 and place < 2.9 else None

    flight = Flight((FAST,), lambda _s: (3.2, -1.0), second=passes, cell=cell).fly(12.0)
    assert not flight.controller.stops
    assert {len(states) for states in flight.states} == {1, 2}
    assert flight.top_speed(10.5, 12.0) > 0.3
