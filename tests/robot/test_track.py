"""A recorded joint track as the programmed path."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hrcreplay.errors import LogError
from hrcreplay.records import Floats
from hrcreplay.robot.model import RobotModel, from_urdf
from hrcreplay.robot.path import recorded_remarks, smooth_recorded
from hrcreplay.robot.task import STEP_S
from tests.facts import facts
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
    reference = smooth_recorded(t_ns[order], q[order], robot)
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
    assert_allclose(smooth_recorded(t_ns, q, robot).sample(0.42).q, 0.42 * 0.3, atol=1e-9)


@pytest.mark.parametrize(
    ("q", "message"),
    [
        (np.zeros((50, 7)), "joint track | 7 joints | irb140 | 6 axes"),
        (np.full((50, 6), np.nan), "joint track | 0 instants"),
        (np.full((50, 6), 1.0), "joint_3 | position | 1.000 rad | 0.000 s | -4.014 to 0.873"),
        (np.outer(np.linspace(0, 2, 50), [1, 0, 0, 0, 0, 0]), "joint_1 | speed | -3.491 to 3.491"),
    ],
)
def test_a_track_of_another_robot_is_refused(robot: RobotModel, q: Floats, message: str) -> None:
    with pytest.raises(LogError, match=facts(*message.split(" | "))):
        smooth_recorded(np.arange(50) * 10_000_000, q, robot)


def _turned(t_s: Floats, amplitude_rad: float, rate: float) -> Floats:
    """One axis that turns to and fro; the others rest."""
    return np.outer(amplitude_rad * np.sin(rate * t_s), [1.0, 0, 0, 0, 0, 0])


def test_degrees_taken_for_radians_are_named_as_such(robot: RobotModel) -> None:
    t_s = np.arange(0, 6, 0.01)
    degrees = np.degrees(_turned(t_s, 1.3, 1.0))
    with pytest.raises(LogError, match=facts("joint_1", "position", "logs.joints_unit = deg")):
        smooth_recorded((t_s * 1e9).astype(np.int64), degrees, robot)
    spike = _turned(t_s, 1.3, 1.0)
    spike[300, 1] = 60.0
    with pytest.raises(LogError, match=facts("joint_2", "60.000 rad", "3.000 s")) as caught:
        smooth_recorded((t_s * 1e9).astype(np.int64), spike, robot)
    assert "joints_unit" not in str(caught.value), "one wrong row is no unit"


def test_small_degrees_are_told_by_their_speed_and_of_an_endless_axis_by_its_turns() -> None:
    arm = from_urdf(
        "<robot name='arm'><link name='l0'/><link name='l1'><collision><geometry><sphere radius='0.1'/></geometry>"
        "</collision></link><joint name='j' type='continuous'><parent link='l0'/>"
        "<child link='l1'/><origin xyz='0 0 0.2'/><axis xyz='0 0 1'/><limit velocity='2' effort='0'/></joint></robot>",
        np.eye(4),
        stop_s=0.377,
    )
    t_s = np.arange(0, 20, 0.01)
    t_ns = (t_s * 1e9).astype(np.int64)
    with pytest.raises(LogError, match=facts("j", "speed", "logs.joints_unit = deg")):
        smooth_recorded(t_ns, np.degrees(np.sin(0.5 * t_s))[:, None], arm)
    (remark,) = recorded_remarks(smooth_recorded(t_ns, np.degrees(0.025 * t_s)[:, None], arm))
    assert "logs.joints_unit = deg" in remark
    assert "28." in remark
    assert recorded_remarks(smooth_recorded(t_ns, (1.5 * np.sin(0.5 * t_s))[:, None], arm)) == []


def test_what_the_robot_cannot_follow_is_told_with_axis_and_number(robot: RobotModel) -> None:
    """Of a sine of amplitude a and rate w the greatest acceleration is a w^2: of 0.1 and 12 that is 14.4."""
    t_s = np.arange(0, 6, 0.004)
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    assert recorded_remarks(smooth_recorded(t_ns, _turned(t_s, 1.0, 2.0), robot)) == []
    (remark,) = recorded_remarks(smooth_recorded(t_ns, _turned(t_s, 0.1, 12.0), robot))
    assert "joint_1" in remark
    assert "robot.acceleration" in remark
    found = float(re.findall(r"by up to ([\d.]+) rad/s\^2", remark)[0])
    assert 0.85 * 14.4 < found < 14.4, "a mean over a tenth of a second is less than the peak"
    fast = smooth_recorded(t_ns, _turned(t_s, 1.8, 2.0), robot)
    assert any("move faster" in one and "3.6" in one for one in recorded_remarks(fast))


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
    reference = smooth_recorded(t_ns, rows[:, :6], arm)
    inner = slice(30, -30)
    points = [reference.sample(t) for t in (t_ns[inner] - t_ns[0]) * 1e-9]
    assert np.abs(np.array([p.q for p in points]) - rows[inner, :6]).max() < 5e-3
    assert np.percentile(np.abs(np.array([p.dq for p in points]) - rows[inner, 6:12]), 95) < 0.05
