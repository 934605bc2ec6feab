"""Live sessions in a cell that says what its cameras watch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.human.fusion import vacancy
from hrcreplay.live.control import session_controller
from hrcreplay.live.control.setup import build_controller
from hrcreplay.live.record import codec, folder
from hrcreplay.live.record.codec import PHASES
from hrcreplay.live.verify import verify
from hrcreplay.logs.cleaning import PersonMemory
from hrcreplay.records import BORDER, CameraFrames, HumanStates
from tests.facts import tells
from tests.live import made
from tests.live.flights import BEGIN_NS, Flight, steps_keep_the_limits
from tests.reporting.reading import page_lines
from tests.visits import cell_around

FAST = "live.approach_speed=1.0"
HALF_M = 2.5


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return cell_around(tmp_path_factory.mktemp("cell") / "cell.toml", HALF_M)


def test_nobody_is_needed_where_nobody_can_be(cell: Path) -> None:
    flight = Flight((FAST,), lambda _s: None, cell=cell).fly(8.0)
    assert flight.phases()[-1] == "following"
    assert not flight.controller.stops
    assert flight.top_speed(0.0, 2.0) == 0.0  # watched.clear_s
    assert flight.top_speed(2.0, 8.0) > 0.3
    assert {answer.row.certified for answer in flight.answers if answer.row is not None} == {True}
    assert {flight.start["neighbours"][answer.limb] for answer in flight.answers if answer.limb >= 0} == {BORDER}
    steps_keep_the_limits(flight)


def test_frames_without_people_say_nothing_where_the_cell_does_not() -> None:
    flight = Flight((FAST,), lambda _s: None).fly(4.0)
    assert flight.phases()[-1] == "waiting"
    assert flight.controller.waiting == session_controller.NO_FRAME


def test_somebody_who_walks_in_and_out_holds_the_robot_up_and_no_more(cell: Path) -> None:
    def walk(s: float) -> tuple[float, float] | None:
        x_m = max(0.6, HALF_M + 0.5 - 1.6 * (s - 4.0)) if s < 7.0 else 0.6 + 1.0 * (s - 7.0)
        return None if s < 4.0 or x_m > HALF_M + 0.5 else (x_m, 0.0)

    flight = Flight((FAST,), walk, cell=cell).fly(13.0)
    assert not flight.controller.stops
    assert flight.top_speed(2.0, 4.0) > 0.3
    assert flight.top_speed(6.0, 7.0) < 1e-3
    assert flight.top_speed(11.0, 13.0) > 0.3
    assert {answer.row.certified for answer in flight.answers if answer.row is not None} == {True}
    steps_keep_the_limits(flight)


def test_cameras_that_fall_silent_stop_the_session(cell: Path) -> None:
    flight = Flight((FAST,), lambda _s: None, cell=cell, silent=lambda s: s > 4.0).fly(6.0)
    assert [reason for _, reason in flight.controller.stops] == [session_controller.NO_FRAME]
    assert flight.top_speed(2.0, 4.0) > 0.3
    assert flight.top_speed(5.0, 6.0) == 0.0
    assert PHASES[flight.answers[-1].phase] == "holding"


def test_somebody_lost_in_the_middle_stops_the_session(cell: Path) -> None:
    flight = Flight((FAST,), lambda s: None if s > 4.0 else (1.6, 1.2), cell=cell).fly(7.5)
    assert [reason for _, reason in flight.controller.stops] == [session_controller.NO_FRAME]
    assert flight.top_speed(5.0, 7.5) == 0.0


def test_a_body_that_is_named_and_not_shown_keeps_the_area_from_being_vacant(cell: Path) -> None:
    flight = Flight((FAST,), lambda _s: None, cell=cell, named=lambda s: s > 4.0).fly(7.5)
    assert flight.phases()[-1] == "holding"
    assert flight.top_speed(2.0, 4.0) > 0.3
    assert flight.top_speed(5.5, 7.5) == 0.0


def test_without_a_word_of_the_cell_a_body_without_a_point_is_as_if_it_was_not_sent() -> None:
    plain, named = (
        Flight((FAST,), lambda _s: (1.6, 1.2), named=when).fly(3.0) for when in (lambda _s: False, lambda _s: True)
    )
    assert [answer.datagram for answer in plain.answers] == [answer.datagram for answer in named.answers]
    assert plain.controller.counts() == named.controller.counts()


def test_with_resume_the_robot_goes_on_once_the_area_is_vacant(cell: Path) -> None:
    settings = (FAST, "live.resume=true", "live.resume_s=0.5")
    flight = Flight(settings, lambda s: None if s > 4.0 else (1.6, 1.2), cell=cell).fly(9.0)
    assert [reason for _, reason in flight.controller.stops] == [session_controller.NO_FRAME]
    assert flight.top_speed(5.0, 6.0) == 0.0
    assert flight.top_speed(7.0, 9.0) > 0.1


def test_looks_at_the_area_are_the_replay_tick_by_tick(cell: Path) -> None:
    def walk(s: float) -> tuple[float, float] | None:
        return None if s < 3.0 or s > 5.0 else (3.2 - 1.6 * (s - 3.0), 0.2)

    flight = Flight((FAST,), walk, cell=cell).fly(8.0)
    observer = build_controller(flight.start).observer
    fusion_stage = observer._fuser.stage
    assert fusion_stage.watched is not None
    tables = [observer._frames(t_ns, [data]) for t_ns, data in flight.frames]
    frames = CameraFrames.join([table for table in tables if table is not None])
    _, seen = fusion_stage.measure(frames, PersonMemory())
    live = HumanStates.join(flight.states)
    blank = replace(live, nobody_s=None, nobody_else_s=None)
    _, again, counts = vacancy.watch(vacancy.start(2), blank, seen.everybody, seen.person, fusion_stage.watched)
    assert live.nobody_s is not None
    assert again.nobody_s is not None
    assert len(np.unique(np.isfinite(live.nobody_s))) == 2
    np.testing.assert_array_equal(live.nobody_s, again.nobody_s)
    assert live.nobody_else_s is not None
    assert again.nobody_else_s is not None
    np.testing.assert_array_equal(live.nobody_else_s, again.nobody_else_s)
    assert counts["watched_frames_refuting"] == flight.controller.counts()["watched_frames_refuting"]


@pytest.mark.parametrize("method", ["qp", "ssm"])
def test_a_session_in_a_watched_cell_comes_out_the_same_again(cell: Path, tmp_path: Path, method: str) -> None:
    def walk(s: float) -> tuple[float, float] | None:
        return None if s < 3.0 else (max(1.2, 3.2 - 1.2 * (s - 3.0)), 0.2)

    flight = Flight((FAST, f"plan.method={method}"), walk, cell=cell).fly(5.0)
    assert flight.top_speed(2.0, 4.0) > 0.2
    partial = folder.make_partial(tmp_path / "session")
    end = {"what": "end", "reason": "Ctrl-C", "counts": {}, "dropped": 0, "looks_skipped": 0, "stops": []}
    start = codec.encode_event(BEGIN_NS - 1, {"what": "start", **flight.start})
    messages = [start, *flight.messages, codec.encode_event(BEGIN_NS + 10**10, end)]
    made.record(partial / "log.mcap", messages, chunk=500)
    run = folder.finish(partial)
    assert verify(run).identical
    page = (run / "report.html").read_text()
    assert tells(page_lines(page), "cell", "cameras", "everybody")
