"""The bare echo loop that keeps a core busy, and what it says of a machine that stands."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from itertools import count, cycle

import numpy as np
import pytest
from numpy.typing import NDArray

from hrcreplay.egm import motion_link_pb2 as egm
from hrcreplay.egm.codec import decode_correction
from tests.egm import echo

MS = 1_000_000


def test_it_tells_for_how_long_the_machine_stood_between_two_reads_of_the_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Reads every 0.2 ms; the machine stands for 3 ms and for 5 ms at the end. 0.9 ms are not yet standing."""
    steps_ns = {4: 3 * MS, 6: 9 * MS // 10, 9: 5 * MS}
    now_ns = np.cumsum([steps_ns.get(k, MS // 5) for k in range(40)]).tolist()
    reads = count()
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[next(reads)])
    assert echo.work(6 * MS, iter(())) == [3 * MS, 5 * MS]
    assert next(reads) == 10  # the time was over at the tenth read


def test_it_works_after_each_answer_and_then_answers_the_newest_packet(monkeypatch: pytest.MonkeyPatch) -> None:
    sent, asked_ns, kept = threading.Event(), list[int](), list[NDArray[np.uint8]]()

    def work(for_ns: int, blocks: Iterator[NDArray[np.uint8]]) -> list[int]:
        """As long as it takes until packets have come meanwhile."""
        asked_ns.append(for_ns)
        kept.append(next(blocks))
        sent.wait(5.0)
        return [2 * MS]

    monkeypatch.setattr(echo, "work", work)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot,
    ):
        server.bind(("127.0.0.1", 0))
        robot.settimeout(5.0)
        found = list[echo.Echoed]()
        loop = threading.Thread(target=lambda: found.append(echo.echo(server, 1.0, work_s=0.0015, touch_mb=2)))
        loop.start()
        robot.sendto(packet(1.0), server.getsockname())
        answers = [decode_correction(robot.recv(4096))]
        for degrees in (2.0, 3.0):
            robot.sendto(packet(degrees), server.getsockname())
        sent.set()
        answers.append(decode_correction(robot.recv(4096)))
        loop.join()
    assert [np.degrees(answer.q).round(9).tolist() for answer in answers] == [[1.0] * 6, [3.0] * 6]
    assert found == [echo.Echoed(came=3, answered=2, stood_ns=[2 * MS] * 2)]
    assert asked_ns == [1_500_000] * 2
    starts = [block.__array_interface__["data"][0] for block in kept]
    assert starts[1] - starts[0] == 65536, "one after the other"


def test_it_touches_every_page_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = np.zeros((3, 65536), np.uint8)
    reads = count()
    monkeypatch.setattr(time, "monotonic_ns", lambda: next(reads) * MS)
    blocks = cycle(memory[:, ::4096])
    echo.work(5 * MS, blocks)  # one read before the first block
    assert memory[:, ::4096].tolist() == [[2] * 16, [2] * 16, [1] * 16]
    echo.work(2 * MS, blocks)
    assert memory[:, ::4096].tolist() == [[3] * 16, [2] * 16, [2] * 16]
    assert memory.sum() == 7 * 16, "nothing between"


def packet(degrees: float) -> bytes:
    """A packet of a robot whose joints are all there."""
    feedback = egm.FeedBack(joints=egm.Joints(joints=[degrees] * 6), time=egm.Clock(sec=1, usec=0))
    header = egm.Header(seqno=1, tm=4, mtype=egm.TYPE_DATA)
    return egm.RobotMessage(header=header, feed_back=feedback).SerializeToString()
