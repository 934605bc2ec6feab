"""What the conversation hears. The expectations are written out, not computed the way the session does."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
import pytest

from hrcreplay.egm.link import JUMPED, OTHER, REASONS, RESTARTED, PacketStatus
from tests.egm.talks import CYCLE_NS, DQ_MAX, Q_MAX, T0_NS, ZERO, packet, session, talk


def test_a_session_begins_once_and_each_packet_is_answered() -> None:
    heard = talk(session(), [0, 1, 2, 3])
    assert heard[0] == PacketStatus(answer=True, fresh=True, allowed=True, reason="", ended=False, lost=0)
    assert heard[1:] == [PacketStatus(answer=True, fresh=False, allowed=True, reason="", ended=False, lost=0)] * 3


@pytest.mark.parametrize(
    ("seqnos", "what"),
    [
        ([500, 501], ["fresh", ""]),
        ([0, 1, 2, 0, 1, 2], ["fresh", "", "", "robot restarted", "robot restarted", ""]),
        ([0, 1, 2, 0, 3], ["fresh", "", "", "robot restarted", ""]),
        ([5000, 5001, 3, 5002], ["fresh", "", "stale", ""]),
        ([10, 11, 11, 12], ["fresh", "", "duplicate", ""]),
        ([10, 12, 11, 13], ["fresh", "lost 1", "stale", ""]),
        ([10, 30, 31], ["fresh", "lost 19", ""]),
        ([10, 1010, 2011, 2012, 2013], ["fresh", "lost 999", "robot restarted", "robot restarted", ""]),
        ([2**32 - 2, 2**32 - 1, 0, 1], ["fresh", "", "", ""]),
        ([2**32 - 2, 1, 2**32 - 1, 2], ["fresh", "lost 2", "stale", ""]),
    ],
)
def test_what_the_robot_s_counter_says(seqnos: list[int], what: list[str]) -> None:
    said = []
    clock = {seqno: step for step, seqno in enumerate(dict.fromkeys(sorted(seqnos, key=lambda n: (n + 2**31) % 2**32)))}
    talking = session()
    for cycle, seqno in enumerate(seqnos):
        step = cycle if 0 in seqnos[:cycle] else clock[seqno]  # where it starts again its clock goes on
        heard = talking.classify(packet(seqno, clock_ns=T0_NS + step * CYCLE_NS), cycle * CYCLE_NS)
        said.append(heard.reason or ("fresh" if heard.fresh else f"lost {heard.lost}" if heard.lost else ""))
        assert heard.answer == (heard.reason in ("", RESTARTED))
        if heard.answer:
            talking.reply(ZERO, ZERO, 0)
    assert said == what


def test_a_robot_started_again_within_its_first_packets_is_no_straggler() -> None:
    talking = session()
    talk(talking, [*range(10)])
    for seqno, reason in ((3, RESTARTED), (4, RESTARTED), (5, "")):  # its 0 to 2 were lost
        heard = talking.classify(packet(seqno, clock_ns=T0_NS + (1000 + seqno) * CYCLE_NS), (seqno + 7) * CYCLE_NS)
        assert (heard.answer, heard.fresh, heard.reason) == (True, False, reason)
        talking.reply(ZERO, ZERO, (seqno + 7) * CYCLE_NS)
    assert talking.counts["sessions"] == 2
    assert talking.classify(packet(10), 13 * CYCLE_NS).reason == "stale"  # of the session before


def test_one_packet_makes_no_new_session() -> None:
    """Whoever sends it from the robot's address: neither an echo nor the robot's own next packet is lost to it."""
    talking = session()
    talk(talking, [40, 41])
    forged = packet(0, clock_ns=T0_NS + 10**15)
    heard = talking.classify(forged, 2 * CYCLE_NS)
    assert (heard.answer, heard.fresh, heard.reason) == (True, False, RESTARTED)
    assert talking.reply(np.full(6, 0.01), ZERO, 2 * CYCLE_NS).q.tolist() == [0.01] * 6
    heard = talking.classify(packet(42), 3 * CYCLE_NS)
    assert (heard.answer, heard.fresh, heard.reason) == (True, False, "")
    assert talking.counts["sessions"] == 1


def test_what_raises_an_alarm_takes_no_answer_from_the_robot() -> None:
    """Right after an answer it gets none, and the next packet that is believed carries the reason."""
    talking = session()
    talk(talking, [40, 41])
    assert not talking.classify(packet(0, clock_ns=T0_NS + 10**15), CYCLE_NS + 1_000_000).answer
    assert talking.classify(packet(42), 2 * CYCLE_NS).reason == RESTARTED
    talking.reply(ZERO, ZERO, 2 * CYCLE_NS)
    assert talking.classify(packet(43), 3 * CYCLE_NS).reason == ""


def test_joints_from_which_the_axes_cannot_have_come_are_not_believed() -> None:
    """0.1 rad in a cycle; after a silence as far as 0.11 s allow, which is not 2 rad either."""
    talking = session(silence_s=0.1)
    talk(talking, [0, 1])
    jumped = packet(2, q=np.full(6, 0.2))
    heard = talking.classify(jumped, 2 * CYCLE_NS)
    assert (heard.answer, heard.reason) == (True, JUMPED)
    assert talking.reply(ZERO, ZERO, 2 * CYCLE_NS).q.tolist() == [0.0] * 6
    later = 2 * CYCLE_NS + 110_000_000
    assert not talking.classify(packet(3, q=np.full(6, 2.1)), later).answer
    heard = talking.classify(packet(4, q=np.full(6, 0.3)), later)
    assert (heard.answer, heard.fresh, heard.reason) == (True, True, JUMPED)
    assert talking.classify(packet(5, q=np.full(6, 0.3)), later + CYCLE_NS).answer


def test_a_robot_that_starts_again_twice_at_zero_is_heard_both_times() -> None:
    talking = session()
    assert talking.classify(packet(0), 0).fresh
    talking.reply(ZERO, ZERO, 0)
    assert talking.classify(packet(0), CYCLE_NS).reason == "duplicate"
    for again in (1, 2):
        heard = talking.classify(packet(0, clock_ns=T0_NS + 9 * again), again * CYCLE_NS)
        assert (heard.answer, heard.reason) == (True, RESTARTED)
        talking.reply(ZERO, ZERO, again * CYCLE_NS)


def test_a_silence_makes_a_new_session_of_the_next_packet() -> None:
    talking = session(silence_s=0.1)
    talk(talking, [0, 1])
    assert not talking.classify(packet(2), CYCLE_NS + 100_000_000).fresh
    talking.reply(ZERO, ZERO, 0)
    assert talking.classify(packet(3), CYCLE_NS + 200_000_001).fresh
    assert talking.counts["sessions"] == 2


def test_a_robot_without_a_counter_is_served() -> None:
    talking = session()
    heard = [talking.classify(packet(None), cycle * CYCLE_NS) for cycle in range(3)]
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
    heard = talking.classify(packet(1, **fields), CYCLE_NS)
    assert (heard.answer, heard.allowed, heard.reason) == (True, allowed, reason)


def test_egm_that_waits_for_its_first_answer_has_not_stopped() -> None:
    talking = session()
    assert talking.classify(packet(0, mci=2), 0).reason == "not answered yet"
    assert talking.classify(packet(1, mci=2), 1).reason == "not answered yet"
    talking.reply(ZERO, ZERO, 1)
    assert talking.classify(packet(2, mci=2), 2).reason == "program stopped"


def test_reasons_are_all_listed() -> None:
    assert {"motors off", "EGM error", "converged", "program stopped", "not answered yet", "radians"} < {*REASONS}
    assert len(set(REASONS)) == len(REASONS)


def test_radians_are_refused_and_change_nothing() -> None:
    talking = session()
    heard = talking.classify(packet(0, clock_ns=None), 0)
    assert (heard.answer, heard.allowed, heard.reason) == (False, False, "radians")
    assert talking.counts["radians"] == 1


@pytest.mark.parametrize("axes", [1, 5, 7, 12])
def test_a_robot_with_other_axes_is_refused_at_its_first_packet(axes: int) -> None:
    heard = session().classify(packet(0, q=np.zeros(axes)), 0)
    assert (heard.answer, heard.allowed, heard.reason) == (False, False, "axes")


@pytest.mark.parametrize("fields", [{"clock_ns": None}, {"q": np.zeros(7)}])
def test_another_robot_beside_ours_takes_no_answer_from_it(fields: dict[str, Any]) -> None:
    """A robot that moves and is not answered goes on with its last reference: one datagram must not lead to that."""
    talking = session()
    talk(talking, [0, 1])
    heard = talking.classify(packet(2, **fields), 2 * CYCLE_NS)
    assert (heard.answer, heard.allowed, heard.reason) == (False, True, OTHER)
    heard = talking.classify(packet(2), 3 * CYCLE_NS)
    assert (heard.answer, heard.reason) == (True, OTHER)
    talking.reply(ZERO, ZERO, 3 * CYCLE_NS)
    assert talking.classify(packet(3), 4 * CYCLE_NS).reason == ""


def test_what_is_no_packet_is_counted_and_changes_nothing() -> None:
    talking = session()
    talk(talking, [0, 1])
    assert talking.classify(None, 2 * CYCLE_NS) == PacketStatus(False, False, True, "no packet", False, 0)
    assert talking.classify(packet(2), 2 * CYCLE_NS) == PacketStatus(True, False, True, "", False, 0)
    assert talking.counts == {"packets": 3, "sessions": 1, "no packet": 1, "lost": 0}


def test_utilization_has_to_last() -> None:
    talking = session(utilization_max=90.0, utilization_packets=3)
    rates = [95.0, 95.0, 20.0, 95.0, inf, 91.0, 95.0, nan, 95.0]
    reasons = [talking.classify(packet(k, utilization=rate), k * CYCLE_NS).reason for k, rate in enumerate(rates)]
    assert reasons == ["", "", "", "", "", "utilization", "utilization", "", ""]


def test_the_end_is_told() -> None:
    talking = session()
    assert not talking.classify(packet(0, mci=2), 0).ended  # has not begun
    talking.reply(ZERO, ZERO, 0)
    assert not talking.classify(packet(1), CYCLE_NS).ended
    assert talking.classify(packet(2, converged=True), 2 * CYCLE_NS) == PacketStatus(True, True, True, "", True, 0)
    assert talking.classify(packet(3, mci=2), 3 * CYCLE_NS).ended
    assert not talking.classify(packet(0, clock_ns=T0_NS + 4 * CYCLE_NS), 4 * CYCLE_NS).ended


@pytest.mark.parametrize("late_cycles", [2, 10, 20])
def test_a_packet_that_was_read_late_accuses_none_of_those_after_it(late_cycles: int) -> None:
    """As when a whole computer stands still: a packet waits in the queue, and the next one is sent after the pause."""
    speed, talking = 0.8 * DQ_MAX, session()
    sent = [*range(30), *range(30 + late_cycles, 60 + late_cycles)]  # cycles of the robot
    read = [*range(29), 29 + late_cycles, *range(30 + late_cycles, 60 + late_cycles)]
    for seqno, (cycle, when) in enumerate(zip(sent, read, strict=True)):
        q = np.minimum(cycle * CYCLE_NS * 1e-9 * speed, Q_MAX)
        t_ns = when * CYCLE_NS + 24_000_000  # its clock is another than ours
        heard = talking.classify(packet(seqno, clock_ns=T0_NS + cycle * CYCLE_NS, q=q), t_ns)
        assert (heard.answer, heard.reason, heard.lost) == (True, "", 0)
        talking.reply(ZERO, ZERO, t_ns)
    ahead = packet(60, clock_ns=T0_NS + (60 + late_cycles + 10) * CYCLE_NS, q=q)
    assert talking.classify(ahead, (60 + late_cycles) * CYCLE_NS + 24_000_000).reason == RESTARTED
    jumps = packet(60, clock_ns=T0_NS + (60 + late_cycles) * CYCLE_NS, q=q - 0.5)
    assert talking.classify(jumps, (60 + late_cycles) * CYCLE_NS + 25_000_000).reason == JUMPED


def test_a_clock_that_drifts_from_ours_is_still_known_after_an_hour() -> None:
    """A tenth of a millisecond in a second, and both senses: no packet is accused, and one that hurries still is."""
    for drift in (-1e-4, 1e-4):
        talking = session()
        for cycle in range(0, 900_000, 20):  # 3600 s, every 20th packet
            clock_ns = T0_NS + round(cycle * CYCLE_NS * (1.0 + drift))
            heard = talking.classify(packet(cycle, clock_ns=clock_ns), cycle * CYCLE_NS)
            assert (heard.answer, heard.reason) == (True, "")
            talking.reply(ZERO, ZERO, cycle * CYCLE_NS)
        ahead = packet(cycle + 1, clock_ns=clock_ns + 10 * CYCLE_NS)
        assert talking.classify(ahead, (cycle + 1) * CYCLE_NS).reason == RESTARTED
