from __future__ import annotations

import pytest

from hrcreplay.live.control import session_controller
from hrcreplay.live.control.setup import build_controller
from hrcreplay.live.control.stages import MotionState, MotionStep
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, TickEvent
from hrcreplay.live.session import outcome
from hrcreplay.live.verify import SessionRecomputation
from hrcreplay.run.followers import QpFollower
from tests.live.counted import CountedLoop, counted
from tests.live.flights import CYCLE_S, Flight

SECONDS = 4.0


def recorded(loop: CountedLoop) -> list[bytes]:
    """What the recorder was told."""
    messages: list[bytes] = loop.recorder.kept  # type: ignore[attr-defined]
    return messages


def count(loop: CountedLoop, kind: bytes) -> int:
    return sum(codec.kind(message) == kind for message in recorded(loop))


@pytest.mark.parametrize("look_s", [0.0041, 0.0045, 0.0049])
def test_looks_that_do_not_fit_are_left_out_and_packets_are_not(look_s: float) -> None:
    flight = Flight()
    loop = counted(flight, look_s=look_s).fly(SECONDS)
    assert count(loop, codec.REPLY) == count(loop, codec.ROBOT) == loop.answers > 0.98 * SECONDS / CYCLE_S
    assert outcome(loop)["looks_skipped"] == loop.skipped > 100
    assert not flight.controller.stops
    assert loop.seen[-1].row is not None
    assert loop.seen[-1].row.dq.any(), "it moves"
    ages = [answer.t_ns - answer.look_ns for answer in loop.seen if answer.look_ns]
    assert max(ages) * 1e-9 < 2 * CYCLE_S + look_s, "two looks in a row were left out"


def test_looks_that_fit_are_all_taken() -> None:
    loop = counted(Flight(), look_s=0.003).fly(SECONDS)
    assert loop.skipped <= 1, "the first packet was there before the loop"
    assert count(loop, codec.PERCEPTION) >= loop.answers - 1


def test_a_session_with_looks_left_out_comes_out_the_same_again() -> None:
    loop = counted(flight := Flight(), look_s=0.0045).fly(SECONDS)
    again = SessionRecomputation(build_controller(flight.start))
    assert not any(again.differences_at(message) for message in recorded(loop))
    assert again.ticks == loop.answers


def test_a_step_that_cannot_be_prepared_fails_in_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight().fly(3.0)

    def broken(*_args: object) -> None:
        raise ZeroDivisionError("of the test")

    monkeypatch.setattr(QpFollower, "step", broken)
    flight.controller._ready = None
    flight.controller.prepare()
    assert flight.controller.fault is None
    flight.fly(0.1)
    assert isinstance(flight.controller.fault, ZeroDivisionError)
    assert [why for _, why in flight.controller.stops] == [session_controller.FAULT]


def test_no_two_looks_in_a_row_are_left_out() -> None:
    loop = counted(Flight(), work_s=0.0042).fly(1.0)
    assert loop.skipped > 0.4 * loop.answers, "it is always late"
    assert count(loop, codec.PERCEPTION) > 0.4 * loop.answers


def test_a_prepared_step_is_not_made_again_in_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight()
    loop = counted(flight, work_s=0.0042)
    step, answer, made, within = flight.controller._step, flight.controller.answer, [0], [0]

    def counting(course: MotionState) -> MotionStep:
        made[0] += 1
        return step(course)

    def watching(event: TickEvent) -> Decision:
        before = made[0]
        said = answer(event)
        within.append(made[0] - before)
        return said

    monkeypatch.setattr(flight.controller, "_step", counting)
    monkeypatch.setattr(flight.controller, "answer", watching)
    loop.fly(2.0)
    assert loop.skipped > 100
    assert sum(within) < 10, "but where the phase changes"
