from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hrcreplay.egm.codec import decode_correction, encode_correction
from hrcreplay.egm.link import Address
from hrcreplay.egm.step_gate import UnsafeCommandError
from hrcreplay.live.control import session_controller
from hrcreplay.live.control.loop import bring_to_rest
from hrcreplay.live.control.setup import build_controller
from hrcreplay.live.control.stages import MotionState, MotionStep
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, TickEvent
from hrcreplay.live.session import outcome
from hrcreplay.live.verify import SessionRecomputation
from hrcreplay.robot.control.controllers import QpController
from tests.facts import tells
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


@pytest.mark.parametrize("look_s", [0.0065, 0.0079])
def test_a_look_of_nearly_two_cycles_misses_no_packet(look_s: float) -> None:
    flight = Flight()
    loop = counted(flight, look_s=look_s).fly(SECONDS)
    assert count(loop, codec.REPLY) == count(loop, codec.ROBOT) == loop.answers > 0.98 * SECONDS / CYCLE_S
    assert count(loop, codec.PERCEPTION) > 0.32 * loop.answers
    assert not flight.controller.stops
    late = [answer.t_ns - before.t_ns for before, answer in pairwise(loop.seen)]
    assert max(late) * 1e-9 < CYCLE_S + 0.6 * look_s, "an answer waits for half a look at most"
    assert loop.seen[-1].row is not None
    assert loop.seen[-1].row.dq.any(), "it moves"


def test_a_packet_during_a_look_is_answered_with_the_look_before() -> None:
    loop = counted(Flight(), look_s=0.0079).fly(SECONDS)
    looks_ns = [codec.clock_ns(message) for message in recorded(loop) if codec.kind(message) == codec.PERCEPTION]
    done = [answer.look_ns for answer in loop.seen if answer.look_ns]
    assert set(done) <= set(looks_ns)
    begun = {answer.t_ns: [t_ns for t_ns in looks_ns if t_ns < answer.t_ns][-1] for answer in loop.seen[5:]}
    assert sum(answer.look_ns < begun[answer.t_ns] for answer in loop.seen[5:]) > 100, "one had begun"


def test_a_look_that_fails_is_recorded_before_the_packet_that_came_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = counted(flight := Flight(), look_s=0.0079).fly(2.0)
    so_far = len(recorded(loop))

    def broken(*_args: object) -> None:
        raise ZeroDivisionError("of the test")

    monkeypatch.setattr(flight.controller.observer, "fuse", broken)
    loop.fly(0.02)
    kinds = [codec.kind(message) for message in recorded(loop)[so_far:]]
    blind = next(k for k, message in enumerate(recorded(loop)[so_far:]) if codec.kind(message) == codec.EVENT)
    assert codec.decode_event(recorded(loop)[so_far + blind])["what"] == "blind"
    first = kinds.index(codec.DECISION)
    assert first < blind, "the packet before the look"
    assert codec.DECISION not in kinds[first + 1 : blind], "no packet during the look"
    assert flight.controller.stops[-1][1] == session_controller.FAULT


@pytest.mark.parametrize("look_s", [0.0045, 0.0065, 0.0079])
def test_a_session_with_late_looks_comes_out_the_same_again(look_s: float) -> None:
    loop = counted(flight := Flight(), look_s=look_s).fly(SECONDS)
    again = SessionRecomputation(build_controller(flight.start))
    assert not any(again.differences_at(message) for message in recorded(loop))
    assert again.ticks == loop.answers


def test_a_step_that_cannot_be_prepared_fails_in_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight().fly(3.0)

    def broken(*_args: object) -> None:
        raise ZeroDivisionError("of the test")

    monkeypatch.setattr(QpController, "step", broken)
    flight.controller._ready = None
    flight.controller.prepare()
    assert flight.controller.fault is None
    flight.fly(0.1)
    assert isinstance(flight.controller.fault, ZeroDivisionError)
    assert [why for _, why in flight.controller.stops] == [session_controller.FAULT]


@pytest.mark.parametrize(("people", "told"), [("all", "all"), ("nearest", "one person")])
def test_another_body_is_told_once(people: str, told: str) -> None:
    second = lambda s: None if s < 1.0 else (2.0, 1.5)  # noqa: E731
    loop = counted(Flight((f"logs.people={people}",), second=second)).fly(1.0)
    assert not loop.notes
    loop.fly(1.0)
    (note,) = loop.notes
    assert tells(note, told)


def test_a_camera_that_is_not_believed_is_told_once() -> None:
    loop = counted(flight := Flight()).fly(1.0)
    assert not loop.notes
    flight.controller.observer.counts.update({"disbelieved_foot_l_kinect": 1})
    loop.fly(0.2)
    flight.controller.observer.counts.update({"disbelieved_foot_l_kinect": 1, "disbelieved_ankle_l_kinect": 1})
    loop.fly(0.2)
    (note,) = loop.notes
    assert note.startswith("camera kinect shows foot_l wrong over time")


def test_a_look_is_taken_after_every_third_answer_at_the_latest() -> None:
    loop = counted(Flight(), work_s=0.0042).fly(1.0)
    assert loop.skipped > 0.4 * loop.answers, "it is always late"
    assert count(loop, codec.PERCEPTION) > 0.33 * loop.answers


@pytest.mark.parametrize("look_s", [0.003, 0.0065])
def test_a_prepared_step_is_not_made_again_in_the_answer(monkeypatch: pytest.MonkeyPatch, look_s: float) -> None:
    flight = Flight()
    loop = counted(flight, look_s=look_s)
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
    assert made[0] <= loop.answers + 10, "but where the phase changes"
    assert sum(within) <= loop.skipped + 10, "nothing is prepared for an answer during a look"
    assert (loop.skipped > 100) == (look_s > CYCLE_S)


def test_a_wrong_answer_of_the_controller_never_leaves_and_the_robot_is_braked() -> None:
    """An answer 0.3 rad off, whoever made it: the gate withholds it, and the fallback goes on from the last one."""
    loop = counted(flight := Flight()).fly(2.0)
    said, sent = flight.controller.answer, []
    leave = loop.link.answer

    def wrong(event: TickEvent) -> Decision:
        answer = said(event)
        assert answer.datagram is not None
        told = decode_correction(answer.datagram)
        return replace(answer, datagram=encode_correction(replace(told, q=told.q + 0.3)))

    def kept(data: bytes, to: Address) -> None:
        sent.append(decode_correction(data))
        leave(data, to)

    assert loop.sent is not None
    before = decode_correction(loop.sent)
    assert np.any(before.dq)  # it moves
    flight.controller.answer = wrong  # type: ignore[method-assign]
    loop.link.answer = kept  # type: ignore[method-assign]
    with pytest.raises(UnsafeCommandError, match=r"\b0\.3\d* rad"):
        loop.fly(0.1)
    assert not sent
    bring_to_rest(loop, "of the test")
    way = np.array([before.q, *(told.q for told in sent)])
    assert np.all(np.abs(np.diff(way, axis=0)) <= flight.robot.dq_max * CYCLE_S * (1 + 1e-6))
    assert not np.any(sent[-1].dq)
