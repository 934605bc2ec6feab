"""Stops against what they must be: whole ticks, within the limits, at rest at the end."""

from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.records import Floats
from hrcreplay.robot.control.stops import Stop, at_rest, stop_along_path, stop_axis_by_axis, stop_straight
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import Reference, parse_task

DT_S = 0.004


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return irb140(np.eye(4), stop_s=0.377)


@pytest.fixture(scope="module")
def reference(robot: RobotModel) -> Reference:
    places = [{"joints_deg": [40, 20, -10, 0, 60, 0]}, {"joints_deg": [-40, 30, -20, 0, 70, 0], "dwell_s": 0.2}]
    task = {"name": "to and fro", "repeat": True, "speed": 0.9, "acceleration": 0.5, "waypoints": places}
    return plan_programme(parse_task(task), robot)


def _starts(robot: RobotModel, count: int) -> list[tuple[Floats, Floats]]:
    rng = np.random.default_rng(1)
    return [
        (rng.uniform(-1, 1, 6), rng.uniform(-1, 1, 6) * robot.dq_max * rng.choice([1e-9, 1e-3, 0.1, 1.0]))
        for _ in range(count)
    ]


def _check(stop: Stop, ddq_max: Floats) -> None:
    u = np.diff(stop.dq, axis=0) / DT_S
    np.testing.assert_allclose(stop.q[1:], stop.q[:-1] + DT_S * stop.dq[:-1] + DT_S**2 / 2 * u, rtol=0, atol=1e-15)
    assert np.all(np.abs(u) <= ddq_max * (1 + 1e-9))
    assert not stop.dq[-1].any()
    if stop.ticks:
        assert stop.dq[-2].any(), "no tick too many"


def test_a_straight_stop_is_straight_and_as_short_as_the_slowest_axis_allows(robot: RobotModel) -> None:
    for q, dq in _starts(robot, 200):
        stop = stop_straight(q, dq, robot.ddq_max, DT_S)
        _check(stop, robot.ddq_max)
        slowest_s = (np.abs(dq) / robot.ddq_max).max()
        assert slowest_s <= stop.ticks * DT_S * (1 + 1e-12) < slowest_s + DT_S * (1 + 1e-9)
        np.testing.assert_allclose(stop.q[-1] - q, 0.5 * stop.ticks * DT_S * dq, atol=1e-12)
        ways = (stop.q - q) @ dq / (dq @ dq)
        np.testing.assert_allclose(stop.q - q, np.outer(ways, dq), atol=1e-12)
        assert np.all(np.diff(ways) >= 0.0)


def test_the_stop_of_equation_67_is_that_of_every_axis_by_itself(robot: RobotModel) -> None:
    for q, dq in _starts(robot, 200):
        stop = stop_axis_by_axis(q, dq, robot.ddq_max, DT_S)
        _check(stop, robot.ddq_max)
        for row in range(stop.ticks + 1):
            left = np.sign(dq) * np.maximum(0.0, np.abs(dq) - row * DT_S * robot.ddq_max)
            np.testing.assert_allclose(stop.dq[row], left, atol=1e-12)


def test_what_is_left_of_a_stop_is_the_same_stop(robot: RobotModel) -> None:
    """Bit for bit: what was certified is what is executed."""
    for q, dq in _starts(robot, 20):
        for brake in (stop_straight, stop_axis_by_axis):
            stop = whole = brake(q, dq, robot.ddq_max, DT_S)
            for row in range(whole.ticks + 3):
                at = min(row, whole.ticks)
                np.testing.assert_array_equal(stop.q[0], whole.q[at])
                np.testing.assert_array_equal(stop.dq[0], whole.dq[at])
                assert stop.ticks == whole.ticks - at
                stop = stop.rest()


@pytest.mark.parametrize("rate", [1.0, 0.3, 1e-3, 0.0])
def test_a_stop_along_the_path_stays_on_it_and_uses_what_the_axes_have(
    robot: RobotModel, reference: Reference, rate: float
) -> None:
    for s_s in np.arange(0.0, reference.cycle_s * 1.2, 0.05):
        stop = stop_along_path(reference.grid, float(s_s), rate, robot.ddq_max, DT_S)
        assert stop is not None
        assert not stop.dq[-1].any()
        for row, (at_s, now) in enumerate(stop.along):
            point = reference.sample(float(at_s))
            np.testing.assert_array_equal(stop.q[row], point.q)
            np.testing.assert_array_equal(stop.dq[row], now * point.dq)
        u = np.diff(stop.dq, axis=0) / DT_S / robot.ddq_max
        assert not len(u) or np.abs(u).max() <= 1 + 1e-6
        braking = np.abs(u[:-1]).max(axis=1) if len(u) > 1 else np.ones(1)
        assert np.all(braking > 1 - 1e-5) or rate * np.abs(reference.sample(float(s_s)).dq).max() == 0.0
        np.testing.assert_allclose(
            np.diff(stop.along[:, 0]), DT_S * (stop.along[1:, 1] + stop.along[:-1, 1]) / 2, atol=1e-12
        )


def test_at_rest_there_is_nothing_left() -> None:
    stop = at_rest(np.arange(6.0), np.array([3.0, 0.0]))
    assert stop.ticks == 0
    assert stop.rest() is stop
    np.testing.assert_array_equal(stop.along, [[3.0, 0.0]])


def test_the_stop_of_a_robot_at_rest_is_a_copy_that_can_be_written() -> None:
    """Kernels are compiled for arrays that can be written; a session measures into one that cannot."""
    q = np.array([0.1, -0.2, 0.3, 0.0, 0.5, -0.6])
    q.setflags(write=False)
    stop = at_rest(q)
    assert stop.q.flags.writeable
    assert not np.shares_memory(stop.q, q)
    np.testing.assert_array_equal(stop.q, q[None])
    np.testing.assert_array_equal(stop.dq, np.zeros((1, 6)))
