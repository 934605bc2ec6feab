"""Those of the ten ways in which other people's EGM programs fail that need our controller or a robot, in counted time.

The others are in tests/egm/test_pitfalls.py. Each test fails when its handling is taken out.
"""

from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.egm.robot_double.faults import Fault
from hrcreplay.egm.robot_double.robot_simulator import SimulatorSettings
from hrcreplay.egm.robot_double.servo import ServoSettings
from hrcreplay.live.control import session_controller
from hrcreplay.live.control.loop import FINAL_ANSWERS
from hrcreplay.live.record import codec
from hrcreplay.records import Floats
from tests.live.counted import Cable, CountedLoop, counted
from tests.live.flights import CYCLE_S, Flight, steps_keep_the_limits

FAST = ("live.approach_speed=1.0",)
RESUME = (*FAST, "live.resume=true", "live.resume_s=0.2")


def cable(loop: CountedLoop) -> Cable:
    """What the loop is plugged into."""
    assert isinstance(loop.link, Cable)
    return loop.link


def planned(flight: Flight) -> tuple[Floats, Floats]:
    """(n, 6) joints [rad] and speeds [rad/s] of the robot itself."""
    cycles = flight.core.record.cycles()
    return cycles["planned_rad"], cycles["planned_rad_per_s"]


def test_3_a_session_starts_where_the_robot_is_and_blends() -> None:
    """A robot far from its programme: its first target is itself, and it sets out slowly. So in the next session."""
    away = SimulatorSettings(start_deg=(90.0, 40.0, -60.0, 50.0, -40.0, 120.0))
    flight = Flight(overrides=RESUME, twin=away, faults=(Fault("egm_error", 2.0),)).fly(6.0)  # it was moving
    arrivals, cycles = flight.core.record.arrivals(), flight.core.record.cycles()
    assert set(arrivals["session"]) == {1, 2}
    for number in (1, 2):
        first = arrivals[arrivals["session"] == number][0]
        heard = cycles[cycles["t_ns"] <= first["t_ns"]][-1]
        np.testing.assert_allclose(first["ref_rad"], heard["q_rad"], atol=1e-9)
        assert not first["ref_rad_per_s"].any()
        assert arrivals[arrivals["session"] == number]["ref_rad_per_s"].any()  # it did set out
        start = (cycles["t_ns"] >= first["t_ns"]) & (cycles["t_ns"] < first["t_ns"] + 300_000_000)
        pushes = np.abs(np.diff(cycles["planned_rad_per_s"][start], axis=0)).max(axis=0)
        assert np.all(pushes < 0.9 * flight.core.servo.acceleration_max * CYCLE_S)  # nothing to be held back
    steps_keep_the_limits(flight)


def test_5_silence_finds_the_robot_standing() -> None:
    """A robot goes on with the last thing it heard, so the last packets before we leave carry speed 0."""
    flight = Flight(overrides=FAST)
    loop = counted(flight, duration_s=3.0)
    loop.fly(2.9)
    assert np.abs(planned(flight)[1][-1]).max() > 0.2
    loop.fly()
    assert flight.controller.stop == session_controller.SESSION_OVER
    last = flight.core.record.arrivals()[-(FINAL_ANSWERS - 1) :]
    assert not last["ref_rad_per_s"].any()
    cable(loop).pass_by(3.0)
    joints, _ = planned(flight)
    told = flight.core.record.arrivals()["ref_rad"][-1]
    assert flight.core.ends == ["CommTimeout", ""]  # the robot's own way to end it
    np.testing.assert_allclose(joints[-1], told, atol=np.radians(0.05))


def test_7_a_session_that_ends_by_convergence_is_told_and_the_next_one_served() -> None:
    """Nobody is seen, so it does not start; standing still for CondTime, the controller hangs up, and calls again."""
    converging = SimulatorSettings(servo=ServoSettings(cond_time_s=1.0), restart_s=0.5)
    flight = Flight(overrides=FAST, twin=converging, walk=lambda s: None if s < 1.4 else (3.0, 0.0)).fly(2.4)
    assert flight.core.ends == ["converged", ""]
    assert flight.controller.fault is None
    assert not flight.controller.stops
    assert "converged" in {answer.reason for answer in flight.answers if answer.phase == codec.WAITING}
    assert flight.phases()[:4] == ["echo", "waiting", "echo", "approach"]
    steps_keep_the_limits(flight)
    assert np.abs(planned(flight)[1][-250:]).max() > 0.1


def test_7_idling_in_a_stop_ends_a_session_but_not_ours() -> None:
    """Held by a stop, it converges too: motion goes on in the next session, from where the robot stands."""
    converging = SimulatorSettings(servo=ServoSettings(cond_time_s=1.5), restart_s=0.5)
    seen = lambda s: None if 0.4 < s < 2.6 else (3.0, 0.0)  # noqa: E731
    flight = Flight(overrides=RESUME, twin=converging, walk=seen).fly(4.2)
    assert flight.core.ends == ["converged", ""]
    assert [reason for _, reason in flight.controller.stops] == [session_controller.NO_FRAME]
    assert flight.phases().count("echo") == 2
    steps_keep_the_limits(flight)
    assert np.abs(planned(flight)[1][-250:]).max() > 0.1


@pytest.mark.parametrize("gain", [5.0, 20.0])
def test_8_the_robot_follows_without_a_lag_at_the_gains_of_its_controller(gain: float) -> None:
    """Position alone trails by 1 / gain: 200 ms as delivered. With its speed, only the controller's filter is left."""
    servo = ServoSettings(gain=gain, filter_hz=20.0)
    flight = Flight(overrides=FAST, twin=SimulatorSettings(servo=servo)).fly(6.0)
    cycles = flight.core.record.cycles()[-1000:]
    speed = np.abs(cycles["ref_rad_per_s"]).max(axis=0)
    behind = np.abs(cycles["ref_rad"] - cycles["planned_rad"]).max(axis=0)
    assert np.count_nonzero(speed > 0.3) >= 3
    assert np.all(behind[speed > 0.3] / speed[speed > 0.3] < 0.02)
    assert not flight.controller.stops


@pytest.mark.parametrize("turn_s", [0.01, 0.016, 0.025])
def test_10_a_loop_slower_than_the_robot_brakes_by_name_and_builds_no_backlog(turn_s: float) -> None:
    """References for 4 ms every 16 ms, at full speed each, would let the robot run ahead of what we believe."""
    flight = Flight(overrides=FAST)
    loop = counted(flight).fly(1.0)
    assert np.abs(planned(flight)[1][-50:]).max() > 0.2
    loop.work_ns = round(turn_s * 1e9)
    loop.fly(1.5)
    assert [reason for _, reason in flight.controller.stops] == [session_controller.OVERRUN]
    arrivals, cycles = flight.core.record.arrivals(), flight.core.record.cycles()
    assert set(np.diff(arrivals["seqno"])) == {1}
    assert cycles["queued"].max() == 0
    looked_at = np.array([answer.measured for answer in loop.seen if answer.row is not None])[-1]
    age = np.flatnonzero(np.all(np.abs(cycles["q_rad"] - looked_at) < 1e-9, axis=1))
    assert len(cycles) - age[-1] <= 2 + turn_s / CYCLE_S  # the newest packet, not one of a queue
    assert np.abs(cycles["planned_rad_per_s"][-50:]).max() < 0.01
    most = np.abs(cycles["planned_rad"][1:] - np.nan_to_num(cycles["ref_rad"][1:], nan=9.0)).max(axis=1)
    assert np.max(most[most < 8]) < flight.start["settings"]["live"]["tracking_rad"]
