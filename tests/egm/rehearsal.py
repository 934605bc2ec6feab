"""The robot double and its guide in one process, in counted time: nothing sleeps, nothing is lost by chance."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable

from hrcreplay.egm.robot_double.faults import Datagram
from hrcreplay.egm.robot_double.robot_simulator import SimulatedRobot
from hrcreplay.egm.robot_double.servo import PERIOD_NS

#: ``guide(t_ns, datagrams) -> answers``: called once a cycle at least, without datagrams where none came.
Guide = Callable[[int, list[bytes]], Iterable[bytes]]


def rehearse(core: SimulatedRobot, guide: Guide, *, cycles: int, begin_ns: int = 0, response_ns: int = 300_000) -> None:
    """Runs so many cycles; what the guide was told and how it answered is in the core's record.

    Args:
        core: The robot's side.
        guide: Ours. Datagrams that arrive at the same instant reach it together, as from a socket that is drained.
        cycles: How many.
        begin_ns: Instant of the first [ns].
        response_ns: How long an answer takes to arrive [ns].
    """
    wire: list[tuple[int, int, bytes]] = []
    sent = 0
    answers: list[Datagram] = []
    for t_ns in range(begin_ns, begin_ns + cycles * PERIOD_NS, PERIOD_NS):
        arrived = [answer for answer in answers if answer.t_ns <= t_ns]
        answers = [answer for answer in answers if answer.t_ns > t_ns]
        for datagram in core.cycle(t_ns, arrived):
            heapq.heappush(wire, (datagram.t_ns, sent, datagram.data))
            sent += 1
        if not wire or wire[0][0] >= t_ns + PERIOD_NS:
            answers += [Datagram(t_ns + response_ns, data) for data in guide(t_ns, [])]
        while wire and wire[0][0] < t_ns + PERIOD_NS:
            at_ns = wire[0][0]
            together = []
            while wire and wire[0][0] == at_ns:
                together.append(heapq.heappop(wire)[2])
            answers += [Datagram(at_ns + response_ns, data) for data in guide(at_ns, together)]
    for answer in answers:
        core.record.add_arrival(answer, core.session)
