"""The speed limit of the TCP in Eq. (66): at the end of the step taken, and never against a stop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.records import Floats
from hrcreplay.robot.control.certificate import NO_PLANES, decide
from hrcreplay.robot.control.control_step import (
    BRAKING,
    PlanSettings,
    Proposal,
    RobotState,
    observe,
)
from hrcreplay.robot.control.minimiser import Solution, minimise
from hrcreplay.robot.control.qp_controller import QpContext, Target, problem, propose
from hrcreplay.robot.control.separation import obstacles
from hrcreplay.robot.control.stops import stop_straight
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.path import approach, smooth_recorded
from hrcreplay.robot.task import Reference, tcp_speed_cap, waits
from hrcreplay.settings.sections import Plan
from tests.robot.checker import links
from tests.robot.people import cloud, volumes
from tests.robot.swinging import DT_S, HOME, STOP_S, base, robot

__all__ = ["robot"]  # the fixture
from tests.robot.tasks import BOX, RACK, plan
from tests.robot.tasks import HOME as HOME_WAYPOINT

SETTINGS = PlanSettings(Plan(), dt_s=DT_S, stop_s=STOP_S, retreat_m=0.03)
NOBODY = obstacles(volumes([np.full((1, 3), 50.0)]), 0)


def speed(q: Floats, dq: Floats) -> float:
    """Of the TCP by the DH table [m/s]."""
    return float(np.linalg.norm(links(q[None], dq[None], base(), 0.10)[1][0, -1, 1]))


def far_ahead(robot: RobotModel, state: RobotState, rng: np.random.Generator, cap: float) -> Target:
    """A reference that the robot would catch up with at 2 m/s or more."""
    T = robot.pose(state.q, state.dq).T_world_tcp.copy()
    away = rng.normal(size=3)
    T[:3, 3] += 0.4 * away / np.linalg.norm(away)
    return Target(T, np.array([*(0.5 * rng.normal(size=3)), 0.0, 0.0, 0.0]), HOME, cap)


def moving(robot: RobotModel, rng: np.random.Generator, tcp_speed: float) -> RobotState:
    """Axes that turn at random so that the TCP has a speed [m/s]."""
    q, dq = HOME + 0.3 * rng.normal(size=6), rng.normal(size=6)
    return RobotState(q, dq * (tcp_speed / speed(q, dq)))


@pytest.mark.parametrize("changes", [{}, {"smooth_s": 0.0}, {"smooth_s": 0.0, "jerk_s": 0.0}])
def test_a_step_from_within_the_limit_ends_within_it(robot: RobotModel, changes: dict[str, float]) -> None:
    settings = replace(SETTINGS, plan=Plan(**changes))
    rng, at_the_limit = np.random.default_rng(5), 0
    for _ in range(200):
        cap = float(rng.uniform(0.05, 0.9))
        state = moving(robot, rng, cap * rng.choice([0.0, 0.5, 0.99, 1.0]))
        people = [cloud(rng, 20, np.full(3, 0.1)) + 0.7 * rng.normal(size=3) for _ in range(2)]
        around = NOBODY if rng.random() < 0.5 else obstacles(volumes(people), 0)
        sight = observe(robot, state, around, 0.0)
        found = propose(
            QpContext(robot, state, np.zeros(6), far_ahead(robot, state, rng, cap), sight, around, STOP_S), settings
        )
        if isinstance(found, int):
            continue
        for stop, _ in found:
            after = speed(stop.q[0], stop.dq[0])
            assert after <= cap * (1 + 1e-9)
            at_the_limit += after > 0.97 * cap
    assert at_the_limit > 40


def test_a_robot_that_is_too_fast_slows_down_to_the_limit(robot: RobotModel) -> None:
    """As at the change to a slower move: with the time constant of the smoothing, and without a jump."""
    rng = np.random.default_rng(6)
    state, cap, u = moving(robot, rng, 0.8), 0.3, np.zeros(6)
    target = far_ahead(robot, state, rng, cap)
    target = target._replace(T_world_tcp=target.T_world_tcp.copy())
    speeds = [speed(state.q, state.dq)]
    for _ in range(120):
        sight = observe(robot, state, NOBODY, 0.0)
        found = propose(QpContext(robot, state, u, target, sight, NOBODY, STOP_S), SETTINGS)
        assert not isinstance(found, int)
        after = RobotState(found[0].stop.q[0], found[0].stop.dq[0])
        assert (np.abs(after.dq - state.dq) <= robot.ddq_max * DT_S * (1 + 1e-9)).all()
        u, state = (after.dq - state.dq) / DT_S, after
        speeds.append(speed(state.q, state.dq))
    times_s = DT_S * np.arange(len(speeds))
    assert (np.array(speeds) <= cap + (speeds[0] - cap) * np.exp(-times_s / 0.1) + 1e-9).all()
    assert speeds[-1] <= cap * 1.01


def test_the_limit_is_never_in_the_way_of_braking(robot: RobotModel) -> None:
    """However fast it is and however low the limit, there is a solution where there is one without a limit."""
    rng, without, settings = np.random.default_rng(7), 0, SETTINGS.without_jerk()
    for _ in range(200):
        state = moving(robot, rng, float(rng.uniform(0.1, 2.0)))
        state = RobotState(state.q, np.clip(state.dq, -robot.dq_max, robot.dq_max))
        sight, target = observe(robot, state, NOBODY, 0.0), far_ahead(robot, state, rng, 1e-3)
        solved = [
            isinstance(
                minimise(problem(QpContext(robot, state, np.zeros(6), goal, sight, NOBODY, STOP_S), settings)), Solution
            )
            for goal in (target, target._replace(tcp_speed_max=np.inf))
        ]
        assert solved[0] == solved[1]
        without += solved[1]
    assert without > 150


def test_the_row_is_there_only_where_there_is_a_limit(robot: RobotModel) -> None:
    state = RobotState(HOME, np.full(6, 0.1))
    sight, T = observe(robot, state, NOBODY, 0.0), robot.pose(HOME, np.zeros(6)).T_world_tcp
    free, bound = (
        problem(
            QpContext(robot, state, np.zeros(6), Target(T, np.zeros(6), HOME, cap), sight, NOBODY, STOP_S), SETTINGS
        ).limits
        for cap in (np.inf, 0.2)
    )
    assert (len(free.J), len(bound.J)) == (6, 7)
    # along the velocity, of length 1 in the linear part: d speed = row @ d dq
    h, away = 1e-6, np.random.default_rng(1).normal(size=6)
    change = speed(HOME, state.dq + h * away) - speed(HOME, state.dq - h * away)
    np.testing.assert_allclose(bound.J[6] @ away, change / (2 * h), rtol=1e-6)


def test_a_certified_stop_goes_on_above_the_limit(robot: RobotModel) -> None:
    """What was certified is executed, bit for bit: no limit has a say in it."""
    rng = np.random.default_rng(8)
    state = moving(robot, rng, 0.8)
    going = stop_straight(state.q, state.dq, robot.ddq_max, DT_S)
    everywhere = NOBODY._replace(known=False)
    taken, _ = decide(robot, going, [Proposal(going, 0)], everywhere, 1.0, NO_PLANES, SETTINGS)
    assert taken.status == BRAKING
    assert taken.certified
    np.testing.assert_array_equal(taken.stop.q, going.q[1:])
    np.testing.assert_array_equal(taken.stop.dq, going.dq[1:])


@pytest.fixture(scope="module")
def path(robot: RobotModel) -> Reference:
    return plan(robot, {**HOME_WAYPOINT, "tcp_speed_m_per_s": 0.6}, RACK | {"move": "joint"}, BOX, cycles=2)


def test_each_move_has_the_limit_that_the_task_gives_it(path: Reference) -> None:
    _, rack_s, box_s = path.waypoints_s
    to_rack, to_box, back = 0.25, 1.0, 0.6
    for cycle_s in (0.0, path.cycle_s):
        for s_s, limit in (
            (0.5 * rack_s, to_rack),
            (rack_s, to_rack),
            (rack_s + 0.29, to_rack),  # of the dwell of 0.3 s
            (rack_s + 0.31, to_box),
            (box_s, to_box),
            (box_s + 0.19, to_box),
        ):
            assert path.tcp_speed_limit(cycle_s + s_s) == limit
    assert path.tcp_speed_limit(0.5 * (box_s + 0.2 + path.cycle_s)) == back
    assert path.tcp_speed_limit(path.duration_s + 1.0) == to_box
    for s_s in np.linspace(0.0, path.duration_s, 500):
        assert np.linalg.norm(path.sample(s_s).twist[:3]) <= path.tcp_speed_limit(s_s) * (1 + 1e-3)


def test_what_a_robot_may_reach(path: Reference) -> None:
    rack_s = path.waypoints_s[1]
    assert tcp_speed_cap(path.grid, 0.5 * rack_s, waits(Plan())) == 0.25
    assert tcp_speed_cap(path.grid, 0.5 * rack_s, waits(Plan(catch_up_speed_m_per_s=0.4))) == 0.4
    assert tcp_speed_cap(path.grid, 0.5 * rack_s, waits(Plan(catch_up_speed_m_per_s=0.1))) == 0.25
    assert tcp_speed_cap(path.grid, 0.5 * rack_s, waits(Plan(catch_up_speed_m_per_s="free"))) == np.inf
    assert tcp_speed_cap(path.grid, 0.5 * rack_s, waits(Plan(reference="time"))) == 1.0  # the robot may be on any move


def test_a_path_without_a_task_has_its_own_greatest_speed(robot: RobotModel) -> None:
    t_s = np.arange(500) * 0.01
    q = HOME + np.outer(0.3 * np.sin(2.0 * t_s), np.arange(1.0, 7.0) / 6)
    path = smooth_recorded(np.round(t_s * 1e9).astype(np.int64), q, robot)
    speeds = [speed(q, dq) for q, dq in zip(path.q, path.dq, strict=True)]
    assert path.tcp_speed_limit(1.0) == path.tcp_speed_limit(3.3) == pytest.approx(max(speeds), rel=1e-9)
    way = approach(robot, HOME, HOME + 0.2, 0.1)
    speeds = [speed(q, dq) for q, dq in zip(way.q, way.dq, strict=True)]
    assert max(speeds) <= way.tcp_speed_limit(0.0) <= 1.1 * max(speeds)  # from a few poses, for a robot waits
