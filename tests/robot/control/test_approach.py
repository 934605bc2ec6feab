from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.testing import assert_allclose

from hrcreplay.records import Floats
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.robot.path import approach
from hrcreplay.robot.task import Grid, place


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return irb140(np.eye(4), stop_s=0.377)


@njit
def _sampled(grid: Grid, t: Floats) -> tuple[Floats, Floats]:
    """What ``Reference.sample`` says of position and acceleration at all times at once, (n, nv) each."""
    q, ddq = np.empty((len(t), grid.q.shape[1])), np.empty((len(t), grid.q.shape[1]))
    for k in range(len(t)):
        q[k], _, ddq[k] = place(grid, t[k])
    return q, ddq


@pytest.mark.parametrize("speed", [0.05, 0.3, 1.0])
def test_an_approach_begins_and_ends_at_rest_and_keeps_its_share_of_the_limits(robot: RobotModel, speed: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        start, goal = rng.uniform(robot.q_min, robot.q_max, (2, robot.nv))
        path = approach(robot, start, goal, speed)
        assert_allclose(path.sample(0.0).q, start, atol=1e-12)
        assert_allclose(path.sample(path.duration_s).q, goal, atol=1e-12)
        t = np.arange(0.0, path.duration_s, 0.001)
        q, ddq = _sampled(path.grid, t)
        for k in rng.integers(len(t), size=100).tolist():
            found = path.sample(t[k])
            np.testing.assert_array_equal([found.q, found.ddq], [q[k], ddq[k]])
        dq = np.gradient(q, t, axis=0)
        assert np.all(np.abs(dq) <= speed * robot.dq_max * 1.001)
        assert np.all(np.abs(ddq) <= speed * robot.ddq_max * 1.01)
        assert_allclose([dq[1], dq[-1]], 0.0, atol=0.05 * speed)
        fastest = max((np.abs(dq) / robot.dq_max).max(), (np.abs(ddq) / robot.ddq_max).max())
        assert fastest > 0.97 * speed  # and no slower than that


def test_an_approach_from_where_the_robot_is_has_a_reference_at_every_time(robot: RobotModel) -> None:
    path = approach(robot, np.zeros(6), np.zeros(6), 0.1)
    assert path.next_waypoint(0.0) == 0.0 or path.next_waypoint(0.0) == path.duration_s
    assert_allclose([path.sample(s).q for s in (0.0, 0.002, 1.0)], 0.0)
