from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation, Slerp

from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.robot.model import RobotModel, from_urdf
from hrcreplay.robot.task import STEP_S, Missed, Reference, solve
from tests.facts import facts
from tests.robot.tasks import ABOVE, BOX, HOME, RACK, pick_and_place, plan, robot

__all__ = ["pick_and_place", "robot"]  # fixtures


def columns(reference: Reference, step_s: float) -> tuple[Floats, Floats, Floats, Floats]:
    times = np.arange(0, reference.duration_s + 0.1, step_s)
    points = [reference.sample(t) for t in times]
    return (
        times,
        np.array([p.q for p in points]),
        np.array([p.dq for p in points]),
        np.array([p.T_world_tcp[:3, 3] for p in points]),
    )


def test_limits_hold_for_differences_of_samples(robot: RobotModel, pick_and_place: Reference) -> None:
    for step_s in (STEP_S, 0.0017):  # on the grid and across it
        _, q, dq, _ = columns(pick_and_place, step_s)
        assert ((q >= robot.q_min) & (q <= robot.q_max)).all()
        speed, acceleration = np.diff(q, axis=0) / step_s, np.diff(dq, axis=0) / step_s
        assert (np.abs(speed) <= robot.dq_max * 1.001).all()
        assert (np.abs(acceleration) <= robot.ddq_max * 1.001).all()
        assert_allclose(speed, (dq[1:] + dq[:-1]) / 2, atol=2e-3)  # trapezium rule: no jump anywhere
        assert (np.abs(acceleration) / robot.ddq_max).max() > 0.9  # and the limits are used


def test_shares_of_speed_and_acceleration_are_kept(robot: RobotModel) -> None:
    fast = {"tcp_speed_m_per_s": 5.0}
    far = {"joints_deg": [150, 40, 0, 90, -60, 100]}
    reference = plan(robot, HOME, far, speed=0.4, acceleration=0.7, **fast)
    _, q, dq, _ = columns(reference, STEP_S)
    assert (np.abs(dq) / robot.dq_max).max() == pytest.approx(0.4, rel=0.01)
    assert (np.abs(np.diff(dq, axis=0)) / STEP_S / robot.ddq_max).max() == pytest.approx(0.7, rel=0.03)
    way = (q - q[0]) / (q[-1] - q[0]).clip(1e-9)
    moving = np.flatnonzero(q[-1] - q[0] > 1e-3)
    assert_allclose(way[:, moving], way[:, moving[:1]].repeat(len(moving), axis=1), atol=1e-9)  # all arrive together


def test_tcp_speeds_are_kept(robot: RobotModel, pick_and_place: Reference) -> None:
    times = np.arange(0, pick_and_place.duration_s, STEP_S)
    twist = np.array([pick_and_place.sample(t).twist for t in times])
    speed, turn = np.linalg.norm(twist[:, :3], axis=1), np.linalg.norm(twist[:, 3:], axis=1)
    assert speed.max() == pytest.approx(1.0, rel=0.01)  # the task's
    start, end = pick_and_place.waypoints_s[1:3]
    down = (times > start) & (times < end)
    assert speed[down].max() < 0.25  # this one turns by more than it travels
    assert turn[down].max() == pytest.approx(0.25 * 2 * np.pi / 2.5, rel=0.01)
    straight = plan(robot, ABOVE, {**RACK, "rpy_deg": ABOVE["rpy_deg"]})
    fastest = max(np.linalg.norm(straight.sample(t).twist[:3]) for t in np.arange(0, straight.duration_s, STEP_S))
    assert fastest == pytest.approx(0.25, rel=0.01)


def test_twist_and_acceleration_are_derivatives(pick_and_place: Reference) -> None:
    h = 1e-6
    for t in np.random.default_rng(1).uniform(0.01, pick_and_place.duration_s - 0.01, 60):
        before, at, after = (pick_and_place.sample(t + k * h) for k in (-1, 0, 1))
        assert_allclose(at.dq, (after.q - before.q) / (2 * h), atol=1e-7)
        assert_allclose(at.ddq, (after.dq - before.dq) / (2 * h), atol=1e-3 + 2e-6 * 400)
        change = (after.T_world_tcp - before.T_world_tcp) / (2 * h)
        spin = change[:3, :3] @ at.T_world_tcp[:3, :3].T
        assert_allclose(at.twist, [*change[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-7)


def test_waypoints_are_reached_at_rest_and_stood_at(robot: RobotModel, pick_and_place: Reference) -> None:
    T_base = robot.T_world_base
    goals: list[dict[str, Any] | None] = [None, ABOVE, RACK, ABOVE, BOX]
    assert len(pick_and_place.waypoints_s) == 5
    for arrival, goal in zip(pick_and_place.waypoints_s, goals, strict=True):
        point = pick_and_place.sample(arrival)
        assert_allclose(point.dq, 0, atol=1e-12)
        if goal is None:
            assert_allclose(point.q, np.radians(HOME["joints_deg"]))
            continue
        assert_allclose(point.T_world_tcp[:3, 3], (T_base @ [*goal["position_m"], 1])[:3], atol=1e-8)
        turn = (
            Rotation.from_euler("xyz", goal["rpy_deg"], degrees=True)
            if "rpy_deg" in goal
            else Rotation.from_quat(goal["quaternion_wxyz"], scalar_first=True)
        )
        assert_allclose(point.T_world_tcp[:3, :3], T_base[:3, :3] @ turn.as_matrix(), atol=1e-8)
        for wait in np.linspace(0, goal.get("dwell_s", 0.0), 5):
            assert_allclose(pick_and_place.sample(arrival + wait - 1e-9).q, point.q, atol=1e-9)


def test_a_linear_move_is_straight_and_turns_evenly(pick_and_place: Reference) -> None:
    start, end = pick_and_place.waypoints_s[1:3]
    a, b = (pick_and_place.sample(t).T_world_tcp for t in (start, end))
    way = b[:3, 3] - a[:3, 3]
    turn = Slerp([0, 1], Rotation.from_matrix([a[:3, :3], b[:3, :3]]))
    for t in np.linspace(start, end, 97):
        T = pick_and_place.sample(t).T_world_tcp
        share = (T[:3, 3] - a[:3, 3]) @ way / (way @ way)
        assert np.linalg.norm(T[:3, 3] - a[:3, 3] - share * way) < 1e-6
        assert_allclose(T[:3, :3], turn([min(max(share, 0.0), 1.0)]).as_matrix()[0], atol=1e-5)


def test_cycles_close_and_the_end_stands(pick_and_place: Reference) -> None:
    reference = pick_and_place
    assert_allclose(reference.sample(reference.cycle_s).q, reference.q0, atol=1e-12)
    for t in (0.3, 1.7, 2.9):
        assert_allclose(reference.sample(t + reference.cycle_s).q, reference.sample(t).q, atol=1e-12)
    assert reference.cycle_s < reference.duration_s < 2 * reference.cycle_s  # no way back after the last
    for beyond in (0.0, 1e-3, 100.0):
        last = reference.sample(reference.duration_s + beyond)
        assert_allclose(last.q, reference.sample(reference.waypoints_s[4]).q, atol=1e-12)
        assert not last.twist.any()
    assert_allclose(reference.sample(-1.0).q, reference.q0)


def test_a_repeated_task_never_ends(robot: RobotModel) -> None:
    reference = plan(robot, HOME, ABOVE, repeat=True)
    assert reference.duration_s == np.inf
    assert_allclose(reference.sample(1000 * reference.cycle_s + 0.5).q, reference.sample(0.5).q, atol=1e-9)


def test_one_cycle_needs_no_way_back(robot: RobotModel) -> None:
    reference = plan(robot, HOME, ABOVE)
    assert reference.duration_s == reference.cycle_s == pytest.approx((len(reference.q) - 1) * STEP_S)


def test_the_same_task_gives_the_same_bits(robot: RobotModel, pick_and_place: Reference) -> None:
    again = plan(robot, HOME, ABOVE, RACK, {**ABOVE, "move": "linear"}, BOX, cycles=2, speed=1.0, acceleration=1.0)
    assert again.q.tobytes() == pick_and_place.q.tobytes()
    assert again.dq.tobytes() == pick_and_place.dq.tobytes()


def test_inverse_kinematics_returns_to_the_pose(robot: RobotModel) -> None:
    rng = np.random.default_rng(3)
    near = np.radians(HOME["joints_deg"])
    for _ in range(25):
        q = rng.uniform(robot.q_min, robot.q_max)
        T = robot.pose(q, np.zeros(6)).T_world_tcp
        found = solve(robot, T, near)
        assert not isinstance(found, Missed)
        assert_allclose(robot.pose(found, np.zeros(6)).T_world_tcp, T, atol=1e-8)
        assert ((found >= robot.q_min) & (found <= robot.q_max)).all()
        assert np.abs(found - near).max() <= np.abs(q - near).max() * robot.dq_max.max() / robot.dq_max.min() + 1e-9
        same = solve(robot, T, q)
        assert not isinstance(same, Missed)
        assert_allclose(same, q, atol=1e-6)  # where it is already


def test_a_seven_axis_arm_follows_lines_too() -> None:
    axes = "zyzyzyz"
    lengths = (0.3, 0.0, 0.4, 0.0, 0.4, 0.0, 0.1)
    parts = ["<robot name='seven'><link name='l0'/>"]
    for i, (axis, length) in enumerate(zip(axes, lengths, strict=True), start=1):
        parts.append(
            f"<link name='l{i}'><collision><geometry><sphere radius='0.1'/></geometry></collision></link>"
            f"<joint name='j{i}' type='revolute'><parent link='l{i - 1}'/><child link='l{i}'/>"
            f"<origin xyz='0 0 {length}'/><axis xyz='{int(axis == 'x')} {int(axis == 'y')} {int(axis == 'z')}'/>"
            "<limit lower='-2.9' upper='2.9' velocity='2' effort='0'/></joint>"
        )
    seven = from_urdf("".join(parts) + "</robot>", np.eye(4), stop_s=0.4)
    bent = {"joints_deg": [0, 30, 0, 60, 0, 60, 0]}
    T = seven.pose(np.radians(bent["joints_deg"]), np.zeros(7)).T_world_tcp
    xyzw = Rotation.from_matrix(T[:3, :3]).as_quat()
    goal = [float(v) for v in T[:3, 3] + [0.05, 0.2, -0.1]]
    reference = plan(seven, bent, {"position_m": goal, "quaternion_wxyz": [xyzw[3], *xyzw[:3]], "move": "linear"})
    assert_allclose(reference.sample(np.inf).T_world_tcp[:3, 3], goal, atol=1e-8)


TURNED: dict[str, Any] = {"joints_deg": [0, 0, 0, 180, -90, 180]}  # the TCP of HOME by another posture


@pytest.mark.parametrize("sideways_deg", [0.0, 0.01, 1.0])
def test_a_line_through_a_singular_posture_is_refused(robot: RobotModel, sideways_deg: float) -> None:
    almost = {"joints_deg": [0, 0, 0, 3, 10, 0]}  # axes 4 and 6 nearly in line; the turn takes axis 5 through zero
    T = np.linalg.inv(robot.T_world_base) @ robot.pose(np.radians(almost["joints_deg"]), np.zeros(6)).T_world_tcp
    turned = Rotation.from_euler("zy", [sideways_deg, -20], degrees=True) * Rotation.from_matrix(T[:3, :3])
    quaternion = turned.as_quat(scalar_first=True).tolist()
    with pytest.raises(SettingsError, match=facts("waypoint 2", "singular", 'move = "joint"')):
        plan(robot, almost, {"position_m": T[:3, 3].tolist(), "quaternion_wxyz": quaternion, "move": "linear"})


@pytest.mark.parametrize(
    ("waypoints", "message"),
    [
        (({"joints_deg": [0, 0]}, ABOVE), "waypoint 1 | 2 joints | irb140 | 6 axes"),
        (
            ({"joints_deg": [0, 0, 60, 0, 0, 0]}, ABOVE),
            "waypoint 1 | axis 3 | 60.0 deg | -230.0 to 50.0 deg",
        ),
        (
            (HOME, {**ABOVE, "position_m": [2.0, 0.0, 0.352]}),
            "waypoint 2 | 2.000 m | 0.975 m",
        ),
        ((HOME, {**RACK, "position_m": [0.0, 2.0, 0.352]}), "waypoint 2 | rack | 2.000 m"),
        (
            (HOME, {**ABOVE, "position_m": [0.05, 0, 0.30]}),
            "waypoint 2 | limits",
        ),
        (
            (HOME, {**ABOVE, "position_m": [-0.6, 0.0, 0.5], "move": "linear"}),
            "waypoint 2 | straight line | range",
        ),
        ((HOME, {**TURNED, "move": "linear"}, ABOVE), "waypoint 2 | straight line | axis"),
        ((HOME, HOME), "task | every waypoint"),
    ],
)
def test_what_cannot_be_driven_is_named(robot: RobotModel, waypoints: tuple[dict[str, Any], ...], message: str) -> None:
    with pytest.raises(SettingsError, match=facts(*message.split(" | "))):
        plan(robot, *waypoints)
