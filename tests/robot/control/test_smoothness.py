"""The velocity that the robot heads for, and what the next tick takes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.records import Floats
from hrcreplay.robot.control.control_step import PlanSettings, RobotState, observe
from hrcreplay.robot.control.minimiser import Solution, minimise
from hrcreplay.robot.control.qp_controller import QpContext, Target, propose
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.robot.control.stops import stop_axis_by_axis
from hrcreplay.robot.model import RobotModel
from tests.robot.people import cloud, volumes
from tests.robot.swinging import DT_S, HOME, SETTINGS, STOP_S, asked, dense, robot

__all__ = ["robot"]  # the fixture

SMOOTH_S, JERK_S = 0.08, 0.03
SHARE = DT_S / (DT_S + SMOOTH_S)
NOBODY = obstacles(volumes([np.full((1, 3), 50.0)]), 0)


def smooth(**changes: float) -> PlanSettings:
    return replace(SETTINGS, plan=SETTINGS.plan.model_copy(update={"smooth_s": SMOOTH_S, **changes}))


def next_velocity(
    robot: RobotModel,
    state: RobotState,
    u_before: Floats,
    reference: tuple[Floats, Floats],
    around: Obstacles,
    settings: PlanSettings,
) -> Floats:
    """(6,) that is proposed [rad/s]."""
    sight = observe(robot, state, around, 0.0)
    found = propose(QpContext(robot, state, u_before, Target(*reference, HOME), sight, around, STOP_S), settings)
    assert not isinstance(found, int)
    return found[0].stop.dq[0]


def test_far_from_people_a_share_of_the_way_to_the_best_velocity_is_taken(robot: RobotModel) -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        state = RobotState(HOME + 0.2 * rng.normal(size=6), 0.05 * rng.normal(size=6))
        pose = robot.pose(state.q, state.dq)
        reference = pose.T_world_tcp, pose.J_tcp @ (state.dq + 0.01 * rng.normal(size=6))
        task = asked(robot, state, *reference, NOBODY, smooth()).task
        best = np.linalg.solve(task.H, -task.g)
        taken = next_velocity(robot, state, np.zeros(6), reference, NOBODY, smooth())
        np.testing.assert_allclose(taken, state.dq + SHARE * (best - state.dq), atol=1e-9)


def test_near_people_the_rows_hold_for_the_velocity_that_it_heads_for(robot: RobotModel) -> None:
    rng, held = np.random.default_rng(3), 0
    for _ in range(150):
        state = RobotState(HOME + 0.2 * rng.normal(size=6), 0.1 * rng.normal(size=6))
        pose = robot.pose(state.q, state.dq)
        limbs = [cloud(rng, 30, np.full(3, 0.1)) + pose.T_world_tcp[:3, 3] + 0.6 * rng.normal(size=3) for _ in range(4)]
        around = obstacles(volumes(limbs), 0)
        reference = pose.T_world_tcp, pose.J_tcp @ (state.dq + 0.2 * rng.normal(size=6))
        tick = asked(robot, state, *reference, around, smooth())
        expected, feasible = dense(robot, tick)
        mine = minimise(tick.task)
        assert isinstance(mine, Solution) == feasible
        if isinstance(mine, Solution):
            held += mine.held
            taken = next_velocity(robot, state, np.zeros(6), reference, around, smooth())
            np.testing.assert_allclose(taken, state.dq + SHARE * (expected - state.dq), atol=1e-6)
    assert held > 20


@pytest.mark.parametrize("settings", [smooth(), smooth(jerk_s=JERK_S), smooth(smooth_s=0.0, jerk_s=JERK_S)])
def test_a_wild_reference_takes_no_axis_beyond_its_limits(robot: RobotModel, settings: PlanSettings) -> None:
    rng = np.random.default_rng(4)
    state, u = RobotState(HOME, np.zeros(6)), np.zeros(6)
    near = 0
    for tick in range(1500):
        if tick % 100 == 0:
            twist = np.concatenate([rng.uniform(-2.0, 2.0, 3), rng.uniform(-3.0, 3.0, 3)])
        pose = robot.pose(state.q, state.dq)
        dq = next_velocity(robot, state, u, (pose.T_world_tcp, twist), NOBODY, settings)
        u_next = (dq - state.dq) / DT_S
        assert np.all(np.abs(dq) <= robot.dq_max * (1 + 1e-9))
        assert np.all(np.abs(u_next) <= robot.ddq_max * (1 + 1e-9))
        assert np.abs(pose.J_tcp[:3] @ dq + DT_S * pose.dJdq_tcp[:3]).max() <= settings.plan.tcp_speed_max + 1e-6
        q = state.q + 0.5 * DT_S * (state.dq + dq)
        stop = stop_axis_by_axis(q, dq, robot.ddq_max, DT_S)
        assert np.all((robot.q_min - 1e-9 <= stop.q[-1]) & (stop.q[-1] <= robot.q_max + 1e-9))
        near += int(np.any((stop.q[-1] - robot.q_min < 0.1) | (robot.q_max - stop.q[-1] < 0.1)))
        state, u = RobotState(q, dq), u_next
    assert near > 20


def test_the_acceleration_changes_little_by_little(robot: RobotModel) -> None:
    """A reference that jumps now and then, and no limit of the robot in the way."""
    state, u, most = RobotState(HOME, np.zeros(6)), np.zeros(6), DT_S / JERK_S * robot.ddq_max
    full = 0
    for tick in range(600):
        leap = 0.02 * (-1) ** (tick // 150)
        T = robot.pose(HOME, np.zeros(6)).T_world_tcp.copy()
        T[1, 3] += leap
        dq = next_velocity(robot, state, u, (T, np.zeros(6)), NOBODY, smooth(smooth_s=0.0, jerk_s=JERK_S))
        u_next = (dq - state.dq) / DT_S
        assert np.all(np.abs(u_next - u) <= most * (1 + 1e-6))
        full += int(np.any(np.abs(u_next - u) > 0.99 * most))
        state, u = RobotState(state.q + 0.5 * DT_S * (state.dq + dq), dq), u_next
    assert full > 10
