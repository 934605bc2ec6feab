"""The controller's motion, held against closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hrcreplay.egm.codec import Correction
from hrcreplay.egm.robot_double.servo import IRB140, PERIOD_NS, Axes, ServoController, ServoSettings
from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from tests.facts import facts, tells

T = PERIOD_NS * 1e-9
FAST = Axes(IRB140.low_deg, IRB140.high_deg, IRB140.speed_deg_per_s, (1e6,) * 6)


def told(q: float | Floats, dq: float | Floats = 0.0) -> Correction:
    return Correction(0, 0, np.broadcast_to(q, 6) * np.ones(6), np.broadcast_to(dq, 6) * np.ones(6))


def drive(
    servo: ServoController, reference: Callable[[float], Correction | None], seconds: float, begin_s: float = 0.0
) -> Floats:
    """Steps through the time; planned joints before each step (n, 6)."""
    places = []
    for cycle in range(round(begin_s / T), round((begin_s + seconds) / T)):
        places.append(servo.q)
        servo.step(cycle * PERIOD_NS, reference(cycle * T))
    return np.array(places)


def at_rest(**settings: Any) -> ServoController:
    return ServoController(ServoSettings(**settings), np.zeros(6))


@pytest.mark.parametrize(("gain", "share"), [(5.0, 1.0), (10.0, 1.0), (10.0, 0.5)])
def test_position_alone_lags_by_one_over_the_gain(gain: float, share: float) -> None:
    servo = at_rest(gain=gain, pos_corr_gain=share)
    places = drive(servo, lambda t: told(0.1 * t), 5.0)
    lag_s = np.arange(len(places))[-100:] * T - places[-100:, 0] / 0.1
    assert lag_s == pytest.approx(1 / (gain * share), rel=1e-6)


def test_the_speed_reference_removes_that_lag() -> None:
    servo = at_rest()
    places = drive(servo, lambda t: told(0.1 * t, 0.1), 5.0)
    assert places[-1, 0] == pytest.approx(0.1 * (len(places) - 1) * T, abs=1e-9)


def test_a_filter_of_first_order_smooths_the_speed() -> None:
    servo = at_rest(pos_corr_gain=0.0, axes=FAST)
    speeds = [0.0]
    for cycle in range(50):
        servo.step(cycle * PERIOD_NS, told(0.0, 0.2))
        speeds.append(float(servo.dq[0]))
    expected = 0.2 * (1 - np.exp(-2 * math.pi * 20 * T * np.arange(51)))
    np.testing.assert_allclose(speeds, expected, rtol=1e-12)


def test_without_a_filter_the_speed_is_there_at_once() -> None:
    servo = at_rest(filter_hz=0.0, axes=FAST)
    servo.step(0, told(0.0, 0.2))
    assert servo.dq == pytest.approx(0.2)


def test_leaving_with_a_speed_reference_drives_past_the_target_by_speed_over_gain() -> None:
    servo = at_rest(comm_timeout_s=60.0)
    servo.step(0, told(0.2, math.radians(90)))
    drive(servo, lambda _t: None, 5.0, T)
    assert np.degrees(servo.q - 0.2) == pytest.approx(18.0, abs=1e-6)


def test_the_time_out_ends_the_session_and_ramps_to_rest() -> None:
    servo = at_rest(pos_corr_gain=0.0, comm_timeout_s=1.0, ramp_s=0.5)
    servo.step(0, told(0.0, 0.4))
    drive(servo, lambda _t: None, 1.0, T)
    assert servo.ended_ns is None
    assert servo.dq == pytest.approx(0.4)
    before = servo.q
    drive(servo, lambda _t: None, 1.0, 249 * T)
    assert servo.error == "CommTimeout"
    assert servo.ended_ns == 249 * PERIOD_NS  # the first cycle later than 1 s: 248 periods are 0.99994 s
    assert servo.dq == pytest.approx(0.0)
    assert servo.q - before == pytest.approx(0.4 * 0.5 / 2, abs=0.4 * 2 * T)  # a triangle of speed


def test_time_runs_out_only_after_a_first_message() -> None:
    servo = at_rest()
    drive(servo, lambda _t: None, 3.0)
    assert servo.ended_ns is None


def test_the_last_reference_is_used_again() -> None:
    servo = at_rest(comm_timeout_s=5.0)
    servo.step(0, told(0.3))
    drive(servo, lambda _t: None, 4.0, T)
    assert servo.q == pytest.approx(0.3, abs=1e-6)


def test_the_speed_deviation_slows_all_axes_together() -> None:
    servo = at_rest(max_speed_deviation_deg_per_s=10.0, filter_hz=0.0, axes=FAST)
    servo.step(0, told(np.array([0.1, 0.2, -0.3, 0.0, 0.05, 1.0])))
    assert np.degrees(servo.dq) == pytest.approx(np.array([1.0, 2.0, -3.0, 0.0, 0.5, 10.0]))
    assert servo.utilization > 100


def test_as_delivered_the_robot_crawls() -> None:
    servo = at_rest(max_speed_deviation_deg_per_s=1.0)
    drive(servo, lambda _t: told(0.5), 2.0)
    assert np.degrees(servo.q) == pytest.approx(2.0, abs=0.03)


def test_axes_keep_their_speed_acceleration_and_range() -> None:
    servo = at_rest(gain=20.0)
    rng = np.random.default_rng(3)
    low, high, top, push = servo.low, servo.high, servo.speed_max, servo.acceleration_max
    before, place = servo.dq, servo.q
    for cycle in range(4000):
        wild = Correction(0, 0, rng.choice([low, high]), rng.uniform(-20, 20, 6)) if cycle % 40 == 0 else None
        servo.step(cycle * PERIOD_NS, wild)
        assert np.all(np.abs(servo.dq) <= top * (1 + 1e-12))
        assert np.all(np.abs(servo.dq - before) <= push * T * (1 + 1e-9))
        assert np.all((servo.q >= low) & (servo.q <= high))
        assert servo.q - place == pytest.approx(servo.dq * T, abs=1e-12)  # nothing but its speed moves it
        before, place = servo.dq, servo.q
    assert not servo.error


def test_a_reference_out_of_range_is_an_error() -> None:
    servo = at_rest()
    drive(servo, lambda t: told(np.radians([0, 0, 0, 0, 115.0 if t == 0 else 115.1, 0])), 2 * T)
    assert tells(servo.error, "reference", "range")
    assert servo.ended_ns == PERIOD_NS


def test_convergence_ends_the_session_after_its_time() -> None:
    servo = at_rest(cond_time_s=1.0)
    drive(servo, lambda _t: told(0.2), 3.0)
    near_s = math.log(math.radians(0.5) / 0.2) / -5.0  # when 0.2 exp(-5 t) is half a degree
    assert servo.converged
    assert servo.ended_ns is not None
    assert servo.ended_ns * 1e-9 == pytest.approx(near_s + 1.0, abs=0.05)  # the filter delays it a little
    assert not servo.error


def test_convergence_counts_from_the_last_arrival() -> None:
    servo = at_rest(cond_time_s=1.0)
    drive(servo, lambda t: told(0.1 if 0.8 < t < 1.2 else 0.0), 2.5)
    assert servo.ended_ns is None
    drive(servo, lambda _t: told(0.0), 1.5, 2.5)
    assert servo.converged


def test_convergence_is_off_unless_it_has_a_time() -> None:
    servo = at_rest()
    drive(servo, lambda _t: told(0.0), 5.0)
    assert servo.ended_ns is None


def test_a_program_stop_ramps_to_rest_and_a_start_makes_the_old_target_live() -> None:
    servo = at_rest(comm_timeout_s=60.0)
    drive(servo, lambda t: told(0.2 * t, 0.2), 1.0)
    speed = servo.dq[0]
    servo.program_running = False
    servo.step(round(1.0 / T) * PERIOD_NS, None)
    assert servo.dq[0] == pytest.approx(speed * (1 - T / 0.5))
    drive(servo, lambda _t: None, 0.6, 1.0 + 1.5 * T)
    assert servo.dq == pytest.approx(0.0)
    servo.program_running = True
    drive(servo, lambda _t: None, 5.0, 1.7)
    assert servo.reference is not None
    assert servo.q == pytest.approx(servo.reference.q + 0.2 / 5.0, abs=1e-6)


def test_without_motors_the_brakes_stop_at_the_axes_limit() -> None:
    servo = at_rest()
    drive(servo, lambda t: told(0.5 * t, 0.5), 1.0)
    servo.motors_on = False
    cycles = math.ceil(0.5 / (servo.acceleration_max[0] * T))
    drive(servo, lambda _t: None, cycles * T, 1.0)
    assert servo.dq == pytest.approx(0.0)


def test_measured_joints_trail_the_planned_ones() -> None:
    servo = at_rest(lag_cycles=3)
    places = drive(servo, lambda t: told(0.1 * t, 0.1), 1.0)
    assert servo.measured == pytest.approx(places[-3])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gain", 21.0),
        ("gain", math.nan),
        ("pos_corr_gain", 1.5),
        ("ramp_s", 0.0),
        ("filter_hz", -1.0),
        ("comm_timeout_s", math.inf),
    ],
)
def test_settings_that_cannot_be_are_refused(name: str, value: float) -> None:
    with pytest.raises(SettingsError, match=facts("robot double", name, f"{value or 0}")):
        ServoSettings(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("speed_deg_per_s", "ramp_s", "way_deg"),
    [(200.0, 0.5, 61.0), (200.0, 0.1, 39.0), (90.0, 0.5, 19.7), (90.0, 0.1, 13.0), (20.0, 0.5, 4.4), (20.0, 0.1, 2.9)],
)
def test_how_far_a_robot_goes_without_us(speed_deg_per_s: float, ramp_s: float, way_deg: float) -> None:
    """The table of docs/live.md: the guide dies while the first axis moves steadily."""
    servo = ServoController(ServoSettings(comm_timeout_s=0.2, ramp_s=ramp_s), np.radians([-120.0, 0, 0, 0, 30.0, 0]))
    speed = np.radians([speed_deg_per_s, 0, 0, 0, 0, 0])
    told, t_ns = servo.q, 0
    for _ in range(200):
        told = told + speed * PERIOD_NS * 1e-9
        servo.step(t_ns, Correction(0, 0, told, speed))
        t_ns += PERIOD_NS
    begun = servo.q[0]
    while servo.ended_ns is None or np.any(servo.dq):
        servo.step(t_ns, None)
        t_ns += PERIOD_NS
    assert np.degrees(servo.q[0] - begun) == pytest.approx(way_deg, abs=0.05)
