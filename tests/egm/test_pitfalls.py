"""The ten ways in which other people's EGM programs fail, each tried on our side of the link.

Each test fails when its handling is taken out of codec, session or link.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.egm.codec import (
    BadPacket,
    Correction,
    RobotPacket,
    decode_correction,
    decode_robot,
    encode_correction,
    encode_robot,
)
from hrcreplay.egm.link import EgmServer, EgmSession, PacketStatus, Received
from hrcreplay.records import Floats
from tests.egm.talks import server

CYCLE_NS = 4_032_000
CYCLE_S = CYCLE_NS / 1e9
T0_NS = 1_700_000_000_000_000_000
Q_MAX = np.radians([180.0, 110.0, 50.0, 200.0, 115.0, 400.0])
DQ_MAX = np.full(6, 3.0)
ZERO = np.zeros(6)
HOME = np.full(6, 0.1)


class Guide:
    """Our side as the control loop drives it, with a plan that is the same whatever happens."""

    def __init__(self, q: Floats = ZERO, dq: Floats = ZERO) -> None:
        self.session = EgmSession(-Q_MAX, Q_MAX, DQ_MAX)
        self.q, self.dq = q, dq
        self.heard: list[PacketStatus] = []

    def answer(self, datagrams: list[bytes], t_ns: int) -> Correction | None:
        """What the robot would read, if anything."""
        heard, packet = self.session.classify_all(map(read, datagrams), t_ns)
        self.heard.append(heard)
        if packet is None:
            return None
        return decode_correction(encode_correction(self.session.reply(self.q, self.dq, t_ns)))

    def serve(self, link: EgmServer) -> Received | None:
        """One turn of the loop."""
        received = link.newest()
        if received is not None:
            told = self.answer([*received.older, received.data], received.t_ns)
            if told is not None:
                link.answer(encode_correction(told), received.sender)
        return received


def read(data: bytes) -> RobotPacket | None:
    try:
        return decode_robot(data)
    except BadPacket:
        return None


def packet(seqno: int, q: Floats = HOME) -> RobotPacket:
    """A robot that may move, in its seqno-th cycle."""
    return RobotPacket(
        seqno=seqno,
        tm_ms=seqno * 4,
        clock_ns=T0_NS + seqno * CYCLE_NS,
        q=q,
        q_planned=q,
        motors=1,
        mci=3,
        rapid=2,
        converged=False,
        utilization=20.0,
    )


def datagram(seqno: int, q: Floats = HOME) -> bytes:
    return encode_robot(packet(seqno, q))


def call(link: EgmServer) -> socket.socket:
    """A robot's socket, with a port of its own."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.settimeout(5.0)
    made.connect(("127.0.0.1", link.port))
    return made


@pytest.fixture
def link() -> Iterator[EgmServer]:
    with closing(server(0, 5.0)) as made:
        yield made


@pytest.fixture
def robot(link: EgmServer) -> Iterator[socket.socket]:
    with call(link) as made:
        yield made


def test_1_radians_of_an_old_controller_are_refused_with_a_reason() -> None:
    """An old controller says 0.5 and means radians: taken for degrees the robot would be somewhere else."""
    guide = Guide()
    old = encode_robot(packet(0, np.full(6, 0.5)), version="A", radians=True)
    assert decode_robot(old).q.tolist() == [0.5] * 6
    assert guide.answer([old], 0) is None
    assert (guide.heard[0].allowed, guide.heard[0].reason) == (False, "radians")


def test_2_a_backlog_gets_one_answer_to_its_newest_packet(link: EgmServer, robot: socket.socket) -> None:
    """A loop that answers one datagram after the other is as late for ever as it once was."""
    guide = Guide()
    robot.send(datagram(0))
    guide.serve(link)
    for seqno in range(1, 60):
        robot.send(datagram(seqno, np.full(6, seqno / 1000)))
    robot.send(datagram(58))  # overtaken
    robot.send(datagram(59, np.full(6, 59 / 1000)))  # twice
    robot.send(b"garbage")
    received = guide.serve(link)
    assert received is not None
    assert received.count == 62
    assert guide.heard[-1].answer
    assert not guide.heard[-1].fresh
    for late in (59, 58):
        robot.send(datagram(late))
        guide.serve(link)
        assert not guide.heard[-1].answer
    link.answer(b"end", received.sender)
    told = [robot.recv(1000) for _ in range(3)]
    assert told[2] == b"end"
    assert [decode_correction(data).seqno for data in told[:2]] == [0, 1]


def test_3_a_session_starts_where_the_robot_is() -> None:
    """A first target of zeros, or of the last session, lets the robot leap."""
    guide = Guide(q=np.full(6, 0.8), dq=np.ones(6))
    for session in range(3):
        where = np.full(6, 0.1 * session)
        for seqno in range(40):
            told = guide.answer([datagram(seqno, where)], (session * 1000 + seqno) * CYCLE_NS)
            assert told is not None
            if seqno == 0:
                assert guide.heard[-1].fresh
                np.testing.assert_allclose(told.q, where, atol=1e-12)
                assert not told.dq.any()


def test_4_a_target_out_of_range_is_neither_sent_nor_sent_again() -> None:
    """The controller drops a session for such a target, and every next one if it is the first thing it hears."""
    guide = Guide(q=np.full(6, 9.0), dq=np.ones(6))
    for cycle, seqno in zip([0, 1, 2, 1000, 1001, 1002], [0, 1, 2, 0, 1, 2], strict=True):
        told = guide.answer([datagram(seqno)], cycle * CYCLE_NS)
        assert told is not None
        assert (np.abs(told.q) <= Q_MAX + 1e-12).all()
        if seqno == 0:
            np.testing.assert_allclose(told.q, HOME, atol=1e-12)
        else:
            np.testing.assert_allclose(told.q, Q_MAX, atol=1e-12)
            assert not told.dq.any()  # a speed out of the range would lead out of it


def test_5_after_a_silence_the_robot_is_answered_from_where_it_has_run_to() -> None:
    """The robot goes on with what it last heard: after a pause it is no longer where we left it."""
    guide = Guide(q=HOME, dq=np.full(6, 0.5))
    for seqno in range(3):
        guide.answer([datagram(seqno)], seqno * CYCLE_NS)
    run_on = HOME + 0.3
    told = guide.answer([datagram(150, run_on)], 150 * CYCLE_NS)
    assert told is not None
    assert guide.heard[-1].fresh
    np.testing.assert_allclose(told.q, run_on, atol=1e-12)
    assert not told.dq.any()


@pytest.mark.parametrize("state", [{"mci": 2}, {"mci": 0}, {"mci": 1}, {"motors": 2}, {"motors": 0}, {"rapid": 1}])
def test_6_every_packet_is_answered_at_once_in_whatever_state(state: dict[str, int]) -> None:
    """A program that waits for RUNNING before it answers waits for ever: EGM runs once it is answered."""
    guide = Guide()
    for seqno in range(5):
        data = encode_robot(replace(packet(seqno), **state))  # type: ignore[arg-type]
        told = guide.answer([data], seqno * CYCLE_NS)
        assert told is not None
        assert told.seqno == seqno
        assert not guide.heard[-1].allowed


def test_7_the_end_of_a_session_is_told_and_the_next_one_served() -> None:
    """Converged, the robot hangs up. That is no failure, and the next call comes from another port."""
    guide = Guide()
    with closing(server(0, 0.2)) as link:
        with call(link) as robot:
            for seqno in range(3):
                robot.send(encode_robot(replace(packet(seqno), converged=seqno == 2)))
                received = guide.serve(link)
        assert received is not None
        assert [heard.ended for heard in guide.heard] == [False, False, True]
        assert guide.heard[-1].reason == ""
        link.answer(b"to nobody", received.sender)
        assert guide.serve(link) is None
        assert guide.serve(link) is None  # silent for longer than a session lasts
        with call(link) as robot:
            robot.send(datagram(0, HOME + 0.2))
            guide.serve(link)
            told = decode_correction(robot.recv(1000))
    assert (guide.heard[-1].fresh, guide.heard[-1].ended) == (True, False)
    np.testing.assert_allclose(told.q, HOME + 0.2, atol=1e-12)


def test_7_a_program_that_stops_is_an_end_too() -> None:
    guide = Guide()
    guide.answer([datagram(0)], 0)
    guide.answer([encode_robot(replace(packet(1), mci=2))], CYCLE_NS)
    assert (guide.heard[-1].ended, guide.heard[-1].reason) == (True, "program stopped")


def test_8_position_goes_with_its_speed_so_the_robot_does_not_lag() -> None:
    """The controller moves at ``k (reference - position) + speed reference``: position alone is 1/k = 0.2 s late."""
    guide = Guide()
    place, speed = HOME.copy(), 0.6
    lag = []
    for cycle in range(400):
        guide.q, guide.dq = HOME + speed * cycle * CYCLE_S, np.full(6, speed)
        told = guide.answer([datagram(cycle, place)], cycle * CYCLE_NS)
        assert told is not None
        lag.append(float((told.q - place).max()) / speed)
        place = place + (5.0 * (told.q - place) + told.dq) * CYCLE_S
    assert abs(lag[-1]) < 0.002


def test_9_rapid_undefined_is_tolerated() -> None:
    """After a restart controllers say UNDEFINED for a program that runs."""
    guide = Guide()
    guide.answer([encode_robot(replace(packet(0), rapid=0))], 0)
    assert (guide.heard[-1].allowed, guide.heard[-1].reason) == (True, "")


@pytest.mark.parametrize("state", [{"motors": 2}, {"mci": 2}, {"rapid": 1}])
def test_9_no_old_target_is_live_when_the_robot_may_move_again(state: dict[str, int]) -> None:
    """While it is stopped or ramps down, the robot is told where it is, and so it is by the first answer after."""
    guide = Guide(q=HOME + 0.14, dq=np.ones(6))
    for seqno in range(30):
        where = HOME - 0.001 * max(0, seqno - 10)  # it is moved by hand, or ramps back
        fields = state if 10 <= seqno < 25 else {}
        data = encode_robot(replace(packet(seqno, where), **fields))  # type: ignore[arg-type]
        told = guide.answer([data], seqno * CYCLE_NS)
        assert told is not None
        if 10 <= seqno <= 25:
            assert not told.dq.any()
            assert guide.heard[-1].fresh == (seqno == 25)
        if 22 <= seqno <= 25:  # it was told 0.14 rad from there, to which the axes need 12 cycles
            np.testing.assert_allclose(told.q, where, atol=1e-12)
        elif (seqno < 10 and seqno > 0) or seqno > 25:
            np.testing.assert_allclose(told.q, HOME + 0.14, atol=1e-12)


def test_10_the_loop_answers_when_called_and_not_at_a_pace_of_its_own(link: EgmServer, robot: socket.socket) -> None:
    """A loop with a pace of 16 to 25 ms leaves three of four packets unanswered; none of its rounds is shorter."""
    rounds, guide = 250, Guide()
    server = threading.Thread(target=lambda: [guide.serve(link) for _ in range(rounds)])
    server.start()
    told, took_s = [], []
    for seqno in range(rounds):
        began = time.monotonic()
        robot.send(datagram(seqno))
        told.append(decode_correction(robot.recv(1000)).seqno)
        took_s.append(time.monotonic() - began)
    server.join()
    assert told == list(range(rounds))
    assert min(took_s) < 0.008
