"""The conversation, packet by packet. The expectations are written out, not computed the way the session does."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hrcreplay.egm.codec import RobotPacket
from hrcreplay.egm.session import REASONS, Heard, Session

CYCLE_NS = 4_032_000
T0_NS = 1_700_000_000_000_000_000
Q_MAX = np.radians([180.0, 110.0, 50.0, 200.0, 115.0, 400.0])
DQ_MAX = np.radians([200.0, 200.0, 260.0, 360.0, 360.0, 450.0])
ZERO = np.zeros(6)


def session(**settings: Any) -> Session:
    return Session(-Q_MAX, Q_MAX, DQ_MAX, **settings)


def packet(seqno: int | None, **fields: Any) -> RobotPacket:
    """A robot that may move, at its seqno-th cycle."""
    count = 0 if seqno is None else seqno
    usual = RobotPacket(
        seqno=seqno,
        tm_ms=count * 4 % 2**32,
        clock_ns=T0_NS + count * CYCLE_NS,
        q=np.full(6, 0.1),
        q_planned=None,
        motors=1,
        mci=3,
        rapid=2,
        converged=False,
        utilization=20.0,
    )
    return replace(usual, **fields)


def talk(talking: Session, seqnos: list[int], start: int = 0) -> list[Heard]:
    """Hear and answer a packet a cycle."""
    heard = []
    for cycle, seqno in enumerate(seqnos, start):
        heard.append(talking.hear(packet(seqno), cycle * CYCLE_NS))
        if heard[-1].answer:
            talking.reply(ZERO, ZERO, cycle * CYCLE_NS)
    return heard


def test_a_session_begins_once_and_each_packet_is_answered() -> None:
    heard = talk(session(), [0, 1, 2, 3])
    assert heard[0] == Heard(answer=True, fresh=True, allowed=True, reason="", ended=False, lost=0)
    assert heard[1:] == [Heard(answer=True, fresh=False, allowed=True, reason="", ended=False, lost=0)] * 3


@pytest.mark.parametrize(
    ("seqnos", "what"),
    [
        ([500, 501], ["fresh", ""]),
        ([0, 1, 2, 0, 1], ["fresh", "", "", "fresh", ""]),
        ([5000, 5001, 3, 5002], ["fresh", "", "stale", ""]),
        ([10, 11, 11, 12], ["fresh", "", "duplicate", ""]),
        ([10, 12, 11, 13], ["fresh", "lost 1", "stale", ""]),
        ([10, 30, 31], ["fresh", "lost 19", ""]),
        ([10, 1010, 2011], ["fresh", "lost 999", "fresh"]),
        ([2**32 - 2, 2**32 - 1, 0, 1], ["fresh", "", "", ""]),
        ([2**32 - 2, 1, 2**32 - 1, 2], ["fresh", "lost 2", "stale", ""]),
    ],
)
def test_what_the_robot_s_counter_says(seqnos: list[int], what: list[str]) -> None:
    said = []
    clock = {seqno: step for step, seqno in enumerate(dict.fromkeys(sorted(seqnos, key=lambda n: (n + 2**31) % 2**32)))}
    talking = session()
    for cycle, seqno in enumerate(seqnos):
        heard = talking.hear(packet(seqno, clock_ns=T0_NS + clock[seqno] * CYCLE_NS), cycle * CYCLE_NS)
        said.append(heard.reason or ("fresh" if heard.fresh else f"lost {heard.lost}" if heard.lost else ""))
        assert heard.answer == (heard.reason == "")
        if heard.answer:
            talking.reply(ZERO, ZERO, 0)
    assert said == what


def test_a_robot_started_again_within_its_first_packets_is_no_straggler() -> None:
    talking = session()
    talk(talking, [0, 1, 2, 3, 4])
    later = packet(3, clock_ns=T0_NS + 1000 * CYCLE_NS)  # its 0 to 2 were lost
    assert talking.hear(later, 5 * CYCLE_NS).fresh
    talking.reply(ZERO, ZERO, 5 * CYCLE_NS)
    assert talking.hear(packet(4), 6 * CYCLE_NS).reason == "stale"  # of the session before


def test_a_robot_that_starts_again_twice_at_zero_is_heard_both_times() -> None:
    talking = session()
    assert talking.hear(packet(0), 0).fresh
    talking.reply(ZERO, ZERO, 0)
    assert talking.hear(packet(0), 0).reason == "duplicate"
    assert talking.hear(packet(0, clock_ns=T0_NS + 9), CYCLE_NS).fresh


def test_a_silence_makes_a_new_session_of_the_next_packet() -> None:
    talking = session(silence_s=0.1)
    talk(talking, [0, 1])
    assert not talking.hear(packet(2), CYCLE_NS + 100_000_000).fresh
    talking.reply(ZERO, ZERO, 0)
    assert talking.hear(packet(3), CYCLE_NS + 200_000_001).fresh
    assert talking.counts["sessions"] == 2


def test_a_robot_without_a_counter_is_served() -> None:
    talking = session()
    heard = [talking.hear(packet(None), cycle * CYCLE_NS) for cycle in range(3)]
    assert all(one.answer for one in heard)


@pytest.mark.parametrize(
    ("fields", "allowed", "reason"),
    [
        ({}, True, ""),
        ({"rapid": 0}, True, ""),
        ({"motors": 2}, False, "motors off"),
        ({"motors": 0}, False, "motors off"),
        ({"mci": 1}, False, "EGM error"),
        ({"mci": 2}, False, "program stopped"),
        ({"mci": 0}, False, "program stopped"),
        ({"mci": 2, "rapid": 1, "converged": True}, False, "converged"),
        ({"converged": True}, True, ""),
        ({"rapid": 1}, False, "program stopped"),
        ({"motors": 2, "mci": 1, "rapid": 1}, False, "motors off"),
    ],
)
def test_when_the_robot_may_be_moved(fields: dict[str, Any], allowed: bool, reason: str) -> None:
    talking = session()
    talk(talking, [0])
    heard = talking.hear(packet(1, **fields), CYCLE_NS)
    assert (heard.answer, heard.allowed, heard.reason) == (True, allowed, reason)


def test_egm_that_waits_for_its_first_answer_has_not_stopped() -> None:
    talking = session()
    assert talking.hear(packet(0, mci=2), 0).reason == "not answered yet"
    assert talking.hear(packet(1, mci=2), 1).reason == "not answered yet"
    talking.reply(ZERO, ZERO, 1)
    assert talking.hear(packet(2, mci=2), 2).reason == "program stopped"


def test_reasons_are_all_listed() -> None:
    assert {"motors off", "EGM error", "converged", "program stopped", "not answered yet", "radians"} < {*REASONS}
    assert len(set(REASONS)) == len(REASONS)


def test_radians_are_refused_and_change_nothing() -> None:
    talking = session()
    talk(talking, [0, 1])
    heard = talking.hear(packet(2, clock_ns=None), 2 * CYCLE_NS)
    assert (heard.answer, heard.allowed, heard.reason) == (False, False, "radians")
    assert talking.counts["radians"] == 1


def test_a_robot_with_other_axes_is_refused() -> None:
    heard = session().hear(packet(0, q=np.zeros(7)), 0)
    assert (heard.answer, heard.allowed, heard.reason) == (False, False, "axes")


def test_what_is_no_packet_is_counted_and_changes_nothing() -> None:
    talking = session()
    talk(talking, [0, 1])
    assert talking.hear(None, 2 * CYCLE_NS) == Heard(False, False, True, "no packet", False, 0)
    assert talking.hear(packet(2), 2 * CYCLE_NS) == Heard(True, False, True, "", False, 0)
    assert talking.counts == {"packets": 3, "sessions": 1, "no packet": 1, "lost": 0}


def test_utilization_has_to_last() -> None:
    talking = session(utilization_max=90.0, utilization_packets=3)
    rates = [95.0, 95.0, 20.0, 95.0, inf, 91.0, 95.0, nan, 95.0]
    reasons = [talking.hear(packet(k, utilization=rate), k * CYCLE_NS).reason for k, rate in enumerate(rates)]
    assert reasons == ["", "", "", "", "", "utilization", "utilization", "", ""]


def test_the_end_is_told() -> None:
    talking = session()
    assert not talking.hear(packet(0, mci=2), 0).ended  # has not begun
    talking.reply(ZERO, ZERO, 0)
    assert not talking.hear(packet(1), CYCLE_NS).ended
    assert talking.hear(packet(2, converged=True), 2 * CYCLE_NS) == Heard(True, True, True, "", True, 0)
    assert talking.hear(packet(3, mci=2), 3 * CYCLE_NS).ended
    assert not talking.hear(packet(0), 4 * CYCLE_NS).ended


def test_the_first_answer_is_an_echo_whatever_is_asked() -> None:
    talking = session()
    measured = np.linspace(-0.5, 0.5, 6)
    talking.hear(packet(0, q=measured), 0)
    told = talking.reply(np.ones(6), np.ones(6), 0)
    assert (told.q.tolist(), told.dq.tolist()) == (measured.tolist(), [0.0] * 6)
    talking.hear(packet(1, q=measured), CYCLE_NS)
    told = talking.reply(np.full(6, 0.2), np.full(6, 0.3), CYCLE_NS)
    assert (told.q.tolist(), told.dq.tolist()) == ([0.2] * 6, [0.3] * 6)


def test_the_echo_is_owed_until_it_is_given() -> None:
    talking = session()
    assert talking.hear(packet(0), 0).fresh
    assert talking.hear(packet(1, q=np.full(6, 0.4)), CYCLE_NS).fresh
    assert talking.reply(ZERO, ZERO, CYCLE_NS).q.tolist() == [0.4] * 6


@pytest.mark.parametrize("state", [{"motors": 2}, {"mci": 2}, {"mci": 1}, {"rapid": 1}])
def test_a_robot_that_may_not_move_hears_where_it_is(state: dict[str, int]) -> None:
    talking = session()
    talk(talking, [0, 1])
    for seqno, angle in ((2, 0.3), (3, 0.31)):
        talking.hear(packet(seqno, q=np.full(6, angle), **state), seqno * CYCLE_NS)
        told = talking.reply(np.ones(6), np.ones(6), 0)
        assert (told.q.tolist(), told.dq.tolist()) == ([angle] * 6, [0.0] * 6)
    assert talking.hear(packet(4, q=np.full(6, 0.32)), 4 * CYCLE_NS).fresh
    assert talking.reply(np.ones(6), np.ones(6), 0).q.tolist() == [0.32] * 6
    assert not talking.hear(packet(5), 5 * CYCLE_NS).fresh


def test_our_counter_steps_by_one_through_everything() -> None:
    talking = session()
    told = []
    for cycle, seqno in enumerate([0, 1, 1, 5, 4, 0, 1, 900, 901]):
        if talking.hear(packet(seqno), cycle * CYCLE_NS).answer:
            told.append(talking.reply(ZERO, ZERO, cycle * CYCLE_NS).seqno)
    assert told == list(range(7))


def test_our_counter_and_stamp_go_round() -> None:
    talking = session()
    talking._seqno = 2**32 - 2
    told = []
    for cycle in range(2):
        talking.hear(packet(cycle), 0)
        told.append(talking.reply(ZERO, ZERO, (2**32 - 1 + cycle) * 1_000_000))
    assert [(one.seqno, one.tm_ms) for one in told] == [(2**32 - 1, 2**32 - 1), (0, 0)]


def test_one_answer_a_packet() -> None:
    talking = session()
    with pytest.raises(ValueError, match="no packet is waiting"):
        talking.reply(ZERO, ZERO, 0)
    talk(talking, [0])
    with pytest.raises(ValueError, match="no packet is waiting"):
        talking.reply(ZERO, ZERO, 0)


@pytest.mark.parametrize("bad", [np.full(6, nan), np.full(6, inf), np.zeros(5)])
def test_nonsense_is_never_told(bad: Any) -> None:
    talking = session()
    talk(talking, [0])
    for q, dq in ((bad, ZERO), (ZERO, bad)):
        talking.hear(packet(1), CYCLE_NS)
        with pytest.raises(ValueError, match="finite"):
            talking.reply(q, dq, 0)


def test_limits_hold_place_and_speed() -> None:
    talking = session()
    talk(talking, [0])
    talking.hear(packet(1), CYCLE_NS)
    told = talking.reply(
        np.array([9.0, -9.0, 0.0, 0.0, Q_MAX[4], -9.0]), np.array([1.0, -1.0, 99.0, -99.0, 1.0, 1.0]), 0
    )
    assert told.q.tolist() == [Q_MAX[0], -Q_MAX[1], 0.0, 0.0, Q_MAX[4], -Q_MAX[5]]
    assert told.dq.tolist() == [0.0, 0.0, DQ_MAX[2], -DQ_MAX[3], 0.0, 1.0]


def test_a_robot_outside_its_limits_is_not_thrown_back_in() -> None:
    talking = session()
    outside = np.array([0.0, Q_MAX[1] + 0.2, 0.0, 0.0, 0.0, 0.0])
    talking.hear(packet(0, q=outside), 0)
    assert talking.reply(ZERO, ZERO, 0).q.tolist() == outside.tolist()
    talking.hear(packet(1, q=outside), CYCLE_NS)
    assert talking.reply(outside + 0.1, np.full(6, 0.1), 0).q[1] == outside[1]
    talking.hear(packet(0), 2 * CYCLE_NS)  # from inside, the limits are the limits again
    talking.reply(ZERO, ZERO, 0)
    talking.hear(packet(1), 3 * CYCLE_NS)
    assert talking.reply(outside, ZERO, 0).q[1] == Q_MAX[1]


def test_a_queue_gets_one_answer_to_its_newest_packet() -> None:
    talking = session()
    talk(talking, [0, 1])
    lot = [packet(3), packet(2), None, packet(5), packet(5), packet(4), None]
    heard, newest = talking.hear_all(lot, 2 * CYCLE_NS)
    assert newest is lot[3]
    assert heard == Heard(answer=True, fresh=False, allowed=True, reason="", ended=False, lost=2)
    assert talking.reply(ZERO, ZERO, 0).seqno == 2
    with pytest.raises(ValueError, match="no packet is waiting"):
        talking.reply(ZERO, ZERO, 0)
    assert (talking.counts["no packet"], talking.counts["stale"], talking.counts["duplicate"]) == (2, 2, 1)


def test_a_session_that_began_in_a_queue_is_echoed_from_its_newest_packet() -> None:
    talking = session()
    talk(talking, [700, 701])
    lot = [packet(702), packet(0), packet(1, q=np.full(6, 0.2))]
    assert [talking.hear(one, 2 * CYCLE_NS).fresh for one in lot] == [False, True, True]
    assert talking.reply(ZERO, ZERO, 0).q.tolist() == [0.2] * 6


@pytest.mark.parametrize("lot", [[], [None, None], [replace(packet(0), clock_ns=None)]])
def test_a_queue_without_a_packet_gets_no_answer(lot: list[RobotPacket | None]) -> None:
    heard, newest = session().hear_all(lot, 0)
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
            heard = talking.hear(one, t_ns)
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
