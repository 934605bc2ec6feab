"""What the conversation answers. The expectations are written out, not computed the way the session does."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hrcreplay.egm.codec import RobotPacket
from hrcreplay.egm.link import JUMPED, OTHER, REASONS, RESTARTED, PacketStatus
from tests.egm.talks import CYCLE_NS, DQ_MAX, Q_MAX, T0_NS, ZERO, packet, session, talk


def test_the_first_answer_is_an_echo_whatever_is_asked() -> None:
    talking = session()
    measured = np.linspace(-0.5, 0.5, 6)
    talking.classify(packet(0, q=measured), 0)
    told = talking.reply(np.ones(6), np.ones(6), 0)
    assert (told.q.tolist(), told.dq.tolist()) == (measured.tolist(), [0.0] * 6)
    talking.classify(packet(1, q=measured), CYCLE_NS)
    told = talking.reply(np.full(6, 0.2), np.full(6, 0.3), CYCLE_NS)
    assert (told.q.tolist(), told.dq.tolist()) == ([0.2] * 6, [0.3] * 6)


def test_the_echo_is_owed_until_it_is_given() -> None:
    talking = session()
    assert talking.classify(packet(0), 0).fresh
    assert talking.classify(packet(1, q=np.full(6, 0.11)), CYCLE_NS).fresh
    assert talking.reply(ZERO, ZERO, CYCLE_NS).q.tolist() == [0.11] * 6


def test_no_echo_leads_further_than_the_axes_go() -> None:
    """A robot that is 0.05 rad behind what it was told, and stopped: 4.032 ms at 200 deg/s are 0.01407 rad."""
    talking = session()
    talking.classify(packet(0, q=ZERO), 0)
    talking.reply(ZERO, ZERO, 0)
    talking.classify(packet(1, q=ZERO), CYCLE_NS)
    talking.reply(np.full(6, 0.05), ZERO, CYCLE_NS)
    told = []
    for cycle in range(2, 7):
        talking.classify(packet(cycle, q=ZERO, motors=2), cycle * CYCLE_NS)
        told.append(float(talking.reply(ZERO, ZERO, cycle * CYCLE_NS).q[0]))
    step = DQ_MAX[0] * CYCLE_NS * 1e-9
    np.testing.assert_allclose(told, [0.05 - step, 0.05 - 2 * step, 0.05 - 3 * step, 0.0, 0.0], atol=1e-12)


def test_the_first_echo_is_owed_until_it_is_where_the_robot_is() -> None:
    """After 0.11 s the first axis can have gone 0.384 rad; the robot says 0.39, which it may have measured."""
    talking = session(silence_s=0.1)
    talk(talking, [0, 1])
    begin_ns, where = CYCLE_NS + 110_000_000, np.array([0.39, 0.0, 0.0, 0.0, 0.0, 0.0])
    fresh = []
    for cycle in range(3):
        fresh.append(talking.classify(packet(cycle + 90, q=where), begin_ns + cycle * CYCLE_NS).fresh)
        told = talking.reply(ZERO, np.ones(6), begin_ns + cycle * CYCLE_NS)
    assert fresh == [True, True, False]
    assert told.dq.tolist() == [1.0] * 6


@pytest.mark.parametrize("state", [{"motors": 2}, {"mci": 2}, {"mci": 1}, {"rapid": 1}])
def test_a_robot_that_may_not_move_hears_where_it_is(state: dict[str, int]) -> None:
    talking = session()
    talk(talking, [0])
    talking.classify(packet(1), CYCLE_NS)
    talking.reply(np.full(6, 0.1), ZERO, CYCLE_NS)
    for seqno, angle in ((2, 0.11), (3, 0.12)):
        talking.classify(packet(seqno, q=np.full(6, angle), **state), seqno * CYCLE_NS)
        told = talking.reply(np.ones(6), np.ones(6), seqno * CYCLE_NS)
        assert (told.q.tolist(), told.dq.tolist()) == ([angle] * 6, [0.0] * 6)
    assert talking.classify(packet(4, q=np.full(6, 0.13)), 4 * CYCLE_NS).fresh
    assert talking.reply(np.ones(6), np.ones(6), 4 * CYCLE_NS).q.tolist() == [0.13] * 6
    assert not talking.classify(packet(5), 5 * CYCLE_NS).fresh


def test_our_counter_steps_by_one_through_everything() -> None:
    talking = session()
    told = []
    for cycle, seqno in enumerate([0, 1, 1, 5, 4, 0, 1, 900, 901]):
        if talking.classify(packet(seqno), cycle * CYCLE_NS).answer:
            told.append(talking.reply(ZERO, ZERO, cycle * CYCLE_NS).seqno)
    assert told == list(range(7))


def test_our_counter_and_stamp_go_round() -> None:
    talking = session()
    talking._seqno = 2**32 - 2
    told = []
    for cycle in range(2):
        talking.classify(packet(cycle), 0)
        told.append(talking.reply(ZERO, ZERO, (2**32 - 1 + cycle) * 1_000_000))
    assert [(one.seqno, one.tm_ms) for one in told] == [(2**32 - 1, 2**32 - 1), (0, 0)]


def test_one_answer_a_packet() -> None:
    talking = session()
    with pytest.raises(ValueError, match="no packet"):
        talking.reply(ZERO, ZERO, 0)
    talk(talking, [0])
    with pytest.raises(ValueError, match="no packet"):
        talking.reply(ZERO, ZERO, 0)


@pytest.mark.parametrize("bad", [np.full(6, nan), np.full(6, inf), np.zeros(5)])
def test_nonsense_is_never_told(bad: Any) -> None:
    talking = session()
    talk(talking, [0])
    for q, dq in ((bad, ZERO), (ZERO, bad)):
        talking.classify(packet(1), CYCLE_NS)
        with pytest.raises(ValueError, match="finite"):
            talking.reply(q, dq, 0)


def test_limits_hold_place_and_speed() -> None:
    talking = session()
    talk(talking, [0])
    talking.classify(packet(1), CYCLE_NS)
    told = talking.reply(
        np.array([9.0, -9.0, 0.0, 0.0, Q_MAX[4], -9.0]), np.array([1.0, -1.0, 99.0, -99.0, 1.0, 1.0]), 0
    )
    assert told.q.tolist() == [Q_MAX[0], -Q_MAX[1], 0.0, 0.0, Q_MAX[4], -Q_MAX[5]]
    assert told.dq.tolist() == [0.0, 0.0, DQ_MAX[2], -DQ_MAX[3], 0.0, 1.0]


def test_a_robot_outside_its_limits_is_not_thrown_back_in() -> None:
    talking = session()
    outside = np.array([0.0, Q_MAX[1] + 0.2, 0.0, 0.0, 0.0, 0.0])
    talking.classify(packet(0, q=outside), 0)
    assert talking.reply(ZERO, ZERO, 0).q.tolist() == outside.tolist()
    talking.classify(packet(1, q=outside), CYCLE_NS)
    assert talking.reply(outside + 0.1, np.full(6, 0.1), 0).q[1] == outside[1]
    later = 10**9  # from inside, the limits are the limits again
    talking.classify(packet(300), later)
    talking.reply(ZERO, ZERO, later)
    talking.classify(packet(301), later + CYCLE_NS)
    assert talking.reply(outside, ZERO, later + CYCLE_NS).q[1] == Q_MAX[1]


def test_a_queue_gets_one_answer_to_its_newest_packet() -> None:
    talking = session()
    talk(talking, [0, 1])
    lot = [packet(3), packet(2), None, packet(5), packet(5), packet(4), None]
    heard, newest = talking.classify_all(lot, 2 * CYCLE_NS)
    assert newest is lot[3]
    assert heard == PacketStatus(answer=True, fresh=False, allowed=True, reason="", ended=False, lost=2)
    assert talking.reply(ZERO, ZERO, 0).seqno == 2
    with pytest.raises(ValueError, match="no packet"):
        talking.reply(ZERO, ZERO, 0)
    assert (talking.counts["no packet"], talking.counts["stale"], talking.counts["duplicate"]) == (2, 2, 1)


def test_a_session_that_began_in_a_queue_is_echoed_from_its_newest_packet() -> None:
    talking = session(silence_s=0.1)
    talk(talking, [700, 701])
    later = 10**9
    lot = [packet(0, clock_ns=T0_NS + later), packet(1, clock_ns=T0_NS + later + CYCLE_NS, q=np.full(6, 0.11))]
    assert [talking.classify(one, later).fresh for one in lot] == [True, True]
    assert talking.reply(ZERO, ZERO, later).q.tolist() == [0.11] * 6


def test_an_alarm_in_a_queue_is_told_with_the_answer_to_the_robot() -> None:
    talking = session()
    talk(talking, [700, 701])
    lot = [packet(0, clock_ns=T0_NS + 10**15), packet(702), packet(703, q=np.full(6, 3.0))]
    heard, newest = talking.classify_all(lot[:2], 2 * CYCLE_NS)
    assert newest is lot[1]
    assert heard.reason == RESTARTED
    talking.reply(ZERO, ZERO, 2 * CYCLE_NS)
    heard, newest = talking.classify_all(lot[2:], 3 * CYCLE_NS)
    assert heard.reason == JUMPED
    assert talking.counts["packets"] == 3
    talking.reply(ZERO, ZERO, 3 * CYCLE_NS)
    after = [packet(704), packet(705, q=np.zeros(7))]  # in either order
    heard, newest = talking.classify_all(after, 4 * CYCLE_NS)
    assert newest is after[0]
    assert (heard.answer, heard.reason) == (True, OTHER)


@pytest.mark.parametrize("lot", [[], [None, None], [replace(packet(0), clock_ns=None)]])
def test_a_queue_without_a_packet_gets_no_answer(lot: list[RobotPacket | None]) -> None:
    heard, newest = session().classify_all(lot, 0)
    assert newest is None
    assert not heard.answer
    assert heard.reason in REASONS


events = st.lists(
    st.one_of(
        st.none(),
        st.builds(
            packet,
            st.one_of(st.integers(0, 40), st.integers(0, 2**32 - 1), st.none()),
            motors=st.integers(0, 2),
            mci=st.integers(0, 3),
            rapid=st.integers(0, 2),
            converged=st.booleans(),
            utilization=st.floats(0, 200),
        ),
    ),
    max_size=40,
)


@settings(max_examples=60)
@given(events, st.lists(st.integers(0, 300_000_000), min_size=40, max_size=40))
def test_whatever_comes_the_same_words_give_the_same_answers(
    lots: list[RobotPacket | None], gaps_ns: list[int]
) -> None:
    def run() -> list[object]:
        talking, t_ns, mine = session(), 0, 0
        said: list[object] = []
        for one, gap_ns in zip(lots, gaps_ns, strict=False):
            t_ns += gap_ns
            heard = talking.classify(one, t_ns)
            said.append(heard)
            assert heard.reason == "" or heard.reason in REASONS
            assert heard.answer or not heard.fresh
            if heard.answer:
                told = talking.reply(np.full(6, 9.0), np.full(6, 9.0), t_ns)
                assert told.seqno == mine
                assert (told.q <= np.maximum(Q_MAX, 0.1)).all()
                if heard.fresh or not heard.allowed:
                    assert not told.dq.any()
                mine += 1
                said.append((told.seqno, told.tm_ms, told.q.tobytes(), told.dq.tobytes()))
        return said

    assert run() == run()
