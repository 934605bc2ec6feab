"""Each attack against the controller in counted time, while the robot moves and while it stands."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from hrcreplay.egm.codec import decode_robot
from hrcreplay.egm.link import ALARMS
from hrcreplay.live.record.codec import PHASES, Decision
from tests.live.attacks.forged import KINDS
from tests.live.flights import BEGIN_NS, CYCLE_S, Flight
from tests.tools.campaign import violations

#: What a forged datagram must do to a moving robot: stop it, or nothing.
STOPS = {
    **dict.fromkeys(("restarted_far", "next_one_jumps", "motors_off_elsewhere", "flood"), ALARMS),
    **dict.fromkeys(("restarted_here", "restarted_and_goes_on"), ALARMS),
    "creeping": (*ALARMS, "tracking error"),
    "huge": ALARMS,
    "next_one_of_the_future": ALARMS,
    "of_another_robot": ALARMS,
}


class Attacked(Flight):
    """A session into which somebody puts datagrams from the robot's own address."""

    kind = "restarted_far"
    at_s: tuple[float, ...] = (2.0,)
    beside = "after"  #: the robot's own packet: "after" by 1 ms, "before" by as much, "queued" with it

    def _guide(self, t_ns: int, datagrams: list[bytes]) -> Iterator[bytes]:
        now_s = (t_ns - BEGIN_NS) * 1e-9
        if not (datagrams and any(at <= now_s < at + CYCLE_S for at in self.at_s)):
            yield from super()._guide(t_ns, datagrams)
            return
        forged = KINDS[self.kind](decode_robot(datagrams[-1]))
        if self.beside == "queued":
            yield from super()._guide(t_ns, [*datagrams, *forged])
            return
        if self.beside == "after":
            yield from super()._guide(t_ns, datagrams)
        for n, data in enumerate(forged):
            yield from super()._guide(t_ns + 1_000_000 + 10 * n, [data])
        if self.beside == "before":
            yield from super()._guide(t_ns + 2_000_000, datagrams)


def attacked(kind: str, beside: str, *at_s: float) -> Attacked:
    flight = Attacked(overrides=("live.approach_speed=1.0",))
    flight.kind, flight.beside, flight.at_s = kind, beside, at_s
    return flight


def follows(answer: Decision) -> bool:
    return PHASES[answer.phase] in ("approach", "following")


@pytest.mark.parametrize("beside", ["after", "before", "queued"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_moving_robot_comes_to_rest_where_it_was_going_and_nowhere_else(kind: str, beside: str) -> None:
    flight = attacked(kind, beside, 1.5).fly(3.0)
    at_ns = BEGIN_NS + 1_500_000_000
    assert any(np.any(answer.row.dq) for answer in flight.answers if answer.row is not None and answer.t_ns < at_ns)
    assert [line for line in violations(flight) if "unanswered" not in line] == []  # of the forged ones
    reasons = {reason for _, reason in flight.controller.stops}
    assert reasons <= set(STOPS.get(kind, ()))
    assert bool(reasons) == (kind in STOPS)
    if reasons:
        assert not any(follows(answer) for answer in flight.answers if answer.t_ns > at_ns + 10_000_000)
    assert all(answer.datagram is not None for answer in flight.answers[-200:])  # the robot itself is


@pytest.mark.parametrize("kind", KINDS)
def test_a_standing_robot_is_not_moved(kind: str) -> None:
    """Ten attacks in a row after a stop: by less than a measured noise altogether."""
    times = (2.0, *np.arange(3.0, 4.0, 0.1).tolist())
    flight = attacked("restarted_far", "after", *times[:1])
    flight.fly(2.9)
    assert flight.controller.stops
    rest = flight.said()[-1].q
    flight.kind, flight.at_s = kind, times
    flight.fly(1.5)
    assert np.abs(np.array([told.q for told in flight.said()[-300:]]) - rest).max() < 0.03
    assert not [line for line in violations(flight) if "withheld" in line or "limits" in line]


def test_one_datagram_resumes_nothing() -> None:
    """The robot's address, number 0, other joints: on the way for two echoes, and off again, before."""
    flight = attacked("restarted_far", "after", 1.5).fly(4.0)
    assert flight.phases().count("approach") == 1
    assert flight.phases()[-1] == "holding"
    assert flight.phases().count("echo") == 1
