"""A recorded joint track as the programmed path."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hrcreplay.errors import LogError
from hrcreplay.records import Floats
from hrcreplay.robot.model import RobotModel, from_urdf
from hrcreplay.robot.path import recorded
from hrcreplay.robot.task import STEP_S
from tests.realdata import data_path
from tests.robot.tasks import robot

__all__ = ["robot"]  # fixtures


def test_a_recorded_track_is_followed(robot: RobotModel) -> None:
    rng = np.random.default_rng(4)
    t = np.sort(rng.uniform(0, 6, 1200))
    amplitude, rate = np.array([0.8, 0.4, 0.5, 1.0, 0.9, 1.5]), np.array([1.0, 1.3, 0.7, 1.1, 0.9, 1.2])
    q = amplitude * np.sin(np.outer(t, rate)) + rng.normal(0, 1e-4, (1200, 6))
    order = rng.permutation(1200)
    t_ns = (t * 1e9).astype(np.int64) + 1_700_000_000_000_000_000
    reference = recorded(t_ns[order], q[order], robot)
    for s in np.linspace(0.2, 5.7, 40):
        point = reference.sample(s)
        at = s + t[0]
        assert_allclose(point.q, amplitude * np.sin(rate * at), atol=2e-3)
        assert_allclose(point.dq, amplitude * rate * np.cos(rate * at), atol=3e-2)
    assert reference.duration_s == pytest.approx(t[-1] - t[0], abs=STEP_S)
    assert not reference.sample(1e9).dq.any()


def test_recorded_rows_without_values_are_left_out(robot: RobotModel) -> None:
    t_ns = np.arange(0, 1_000_000_000, 10_000_000)
    q = np.outer(t_ns * 1e-9, np.ones(6)) * 0.3
    q[40:45, 2] = np.nan
    assert_allclose(recorded(t_ns, q, robot).sample(0.42).q, 0.42 * 0.3, atol=1e-9)


@pytest.mark.parametrize(
    ("q", "message"),
    [
        (np.zeros((50, 7)), "joint track: found 7 joints; irb140 has 6 axes"),
        (np.full((50, 6), np.nan), "joint track: found 0 instants"),
        (np.full((50, 6), 1.0), "joint_3 has position 1.000 rad after 0.000 s; irb140 allows -4.024 to 0.883"),
        (np.outer(np.linspace(0, 2, 50), [1, 0, 0, 0, 0, 0]), "joint_1 has speed 4.* rad/s .* allows -3.491 to 3.491"),
    ],
)
def test_a_track_of_another_robot_is_refused(robot: RobotModel, q: Floats, message: str) -> None:
    with pytest.raises(LogError, match=message):
        recorded(np.arange(50) * 10_000_000, q, robot)


@pytest.mark.parametrize("measurement", [1, 33])
def test_a_real_track_moves_as_its_own_log_says(measurement: int) -> None:
    folder = data_path(f"robot_schunk_6dof/measurement_{measurement}")
    t_ns = np.round(np.loadtxt(folder / "time.csv") * 1e9).astype(np.int64)
    rows = np.loadtxt(folder / "trajectory.csv", delimiter=",")
    parts = ["<robot name='arm'><link name='l0'/>"]
    for i, axis in enumerate("zyyzyz", start=1):
        parts.append(
            f"<link name='l{i}'><collision><geometry><sphere radius='0.1'/></geometry></collision></link>"
            f"<joint name='j{i}' type='continuous'><parent link='l{i - 1}'/><child link='l{i}'/>"
            f"<origin xyz='0 0 0.2'/><axis xyz='0 {int(axis == 'y')} {int(axis == 'z')}'/>"
            "<limit velocity='4' effort='0'/></joint>"
        )
    arm = from_urdf("".join(parts) + "</robot>", np.eye(4), stop_s=0.377)
    reference = recorded(t_ns, rows[:, :6], arm)
    inner = slice(30, -30)
    points = [reference.sample(t) for t in (t_ns[inner] - t_ns[0]) * 1e-9]
    assert np.abs(np.array([p.q for p in points]) - rows[inner, :6]).max() < 5e-3
    assert np.percentile(np.abs(np.array([p.dq for p in points]) - rows[inner, 6:12]), 95) < 0.05
