"""Our socket, on loopback. Nothing waits longer than a datagram takes, but where a time-out is the point."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from hrcreplay.egm.link import EgmServer
from hrcreplay.errors import SettingsError
from tests.egm.talks import server
from tests.facts import facts

LONG_S = 5.0


@contextmanager
def robot(link: EgmServer) -> Iterator[socket.socket]:
    """A socket that calls the link."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.settimeout(LONG_S)
        own.connect(("127.0.0.1", link.port))
        yield own


@pytest.fixture
def link() -> Iterator[EgmServer]:
    with closing(server(0, LONG_S)) as made:
        yield made


def test_a_datagram_comes_with_its_sender_and_its_instant(link: EgmServer) -> None:
    with robot(link) as own:
        before = time.monotonic_ns()
        own.send(b"one")
        received = link.newest()
        assert received is not None
        assert (received.data, received.older, received.count) == (b"one", (), 1)
        assert received.sender == own.getsockname()
        assert before <= received.t_ns <= time.monotonic_ns()
        link.answer(b"told", received.sender)
        assert own.recv(100) == b"told"


def test_the_queue_is_emptied_and_kept(link: EgmServer) -> None:
    with robot(link) as own:
        for number in range(50):
            own.send(b"%d" % number)
        received = link.newest()
        assert received is not None
        assert (received.data, received.count) == (b"49", 50)
        assert received.older == tuple(b"%d" % number for number in range(49))
        own.send(b"next")
        received = link.newest()
        assert received is not None
        assert (received.data, received.older) == (b"next", ())


def test_what_waits_is_taken_without_a_wait(link: EgmServer) -> None:
    with robot(link) as own, robot(link) as stranger:
        began = time.monotonic()
        assert link.waiting() is None
        own.send(b"one")
        own.send(b"two")
        received = link.waiting()
        assert received is not None
        assert (received.data, received.older, received.count) == (b"two", (b"one",), 2)
        stranger.send(b"three")
        assert link.waiting() is None
        assert link.strangers == 1
        assert time.monotonic() - began < LONG_S / 2


def test_empty_and_long_datagrams_arrive_whole(link: EgmServer) -> None:
    with robot(link) as own:
        own.send(b"")
        own.send(b"x" * 60_000)
        received = link.newest()
        assert received is not None
        assert (len(received.data), received.older) == (60_000, (b"",))


def test_it_wakes_as_soon_as_a_datagram_comes(link: EgmServer) -> None:
    with robot(link) as own:
        later = threading.Timer(0.05, own.send, [b"late"])
        later.start()
        began = time.monotonic()
        received = link.newest()
        assert received is not None
        assert time.monotonic() - began < LONG_S / 2
        later.join()


def test_silence_is_none() -> None:
    with closing(server(0, 0.02)) as link:
        began = time.monotonic()
        assert link.newest() is None
        assert time.monotonic() - began >= 0.019


def test_a_vanished_peer_stops_nothing(link: EgmServer) -> None:
    with robot(link) as own:
        own.send(b"one")
        received = link.newest()
        assert received is not None
    for _ in range(3):
        link.answer(b"to nobody", received.sender)
    link.answer(b"to nowhere", ("255.255.255.255", 9))  # not permitted without SO_BROADCAST
    assert link.vanished >= 1
    with robot(link) as own:
        link._peer = None
        own.send(b"another")
        received = link.newest()
        assert received is not None
        assert received.data == b"another"


def test_a_stranger_takes_no_answer_and_joins_no_queue(link: EgmServer) -> None:
    with robot(link) as own, robot(link) as stranger:
        own.send(b"one")
        received = link.newest()
        assert received is not None
        link.answer(b"told", received.sender)
        stranger.send(b"a")
        own.send(b"two")
        stranger.send(b"b")
        received = link.newest()
        assert received is not None
        assert (received.data, received.older, received.sender) == (b"two", (), own.getsockname())
        assert link.strangers == 2


def test_another_port_of_the_robot_is_heard_once_its_session_is_over_and_not_before() -> None:
    """Waits of 20 ms that bring nothing are no end of a session that a silence of 0.3 s ends."""
    with closing(server(0, 0.02, silence_s=0.3)) as link, robot(link) as own, robot(link) as stranger:
        own.send(b"one")
        assert link.newest() is not None
        for _ in range(5):
            stranger.send(b"too soon")
            assert link.newest() is None
        assert link.strangers == 5
        assert link.strangers_seen() == [stranger.getsockname()]
        time.sleep(0.3)
        stranger.send(b"now")
        received = link.newest()
        assert received is not None
        assert (received.data, received.sender) == (b"now", stranger.getsockname())


def test_only_the_robot_s_address_is_heard_however_long_it_is_silent() -> None:
    with (
        closing(EgmServer("127.0.0.1", 0, 0.02, robot="127.0.0.2", silence_s=0.05)) as link,
        robot(link) as stranger,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own,
    ):
        stranger.send(b"first")
        assert link.newest() is None
        time.sleep(0.1)
        stranger.send(b"again")
        assert link.newest() is None
        own.bind(("127.0.0.2", 0))
        own.sendto(b"robot", ("127.0.0.1", link.port))
        stranger.send(b"last")
        received = link.newest()
        assert received is not None
        assert (received.data, received.older, received.sender) == (b"robot", (), own.getsockname())
        assert link.strangers == 3
        assert link.strangers_seen() == [stranger.getsockname()]


def test_it_listens_where_the_robot_is_reached_and_nowhere_else() -> None:
    with closing(EgmServer("", 0, 0.1, robot="127.0.0.1", silence_s=0.1)) as link:
        assert link._socket.getsockname() == ("127.0.0.1", link.port)


def test_a_robot_to_which_no_network_leads_is_a_setting_to_mend() -> None:
    with pytest.raises(SettingsError, match=facts("live.robot_address", "255.255.255.255")):
        EgmServer("", 0, 0.1, robot="255.255.255.255", silence_s=0.1)


def test_without_a_robot_yet_the_last_sender_is_heard(link: EgmServer) -> None:
    with robot(link) as first, robot(link) as second:
        first.send(b"scan")
        second.send(b"robot")
        received = link.newest()
        assert received is not None
        assert (received.data, received.older, received.sender) == (b"robot", (), second.getsockname())


def test_a_taken_port_is_a_setting_to_mend(link: EgmServer) -> None:
    with pytest.raises(SettingsError, match=facts(f"UDP port {link.port}", "127.0.0.1", "free port")):
        server(link.port, 0.1)
    with pytest.raises(SettingsError, match=facts("UDP port 70000")):
        server(70_000, 0.1)
    with pytest.raises(SettingsError, match=facts("192.0.2.1")):
        EgmServer("192.0.2.1", 0, 0.1, robot="127.0.0.1", silence_s=0.1)  # nobody's address


def test_a_closed_link_gives_its_port_back() -> None:
    link = server(0, 0.1)
    link.close()
    server(link.port, 0.1).close()
