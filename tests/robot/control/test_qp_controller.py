from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.records import SweptVolumes
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.control_step import RobotState
from hrcreplay.robot.control.qp_controller import Solution, Unsolved, pose_error, solve, step
from hrcreplay.robot.control.separation import obstacles
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.settings.sections import Plan
from tests.robot.checker import links, violation
from tests.robot.distances import by_coal
from tests.robot.people import person, volumes
from tests.robot.swinging import (
    DT_S,
    HOME,
    SETTINGS,
    STOP_S,
    asked,
    base,
    dense,
    moving,
    random_tick,
    robot,
    run,
    swing,
)

__all__ = ["robot"]  # the fixture


def test_the_solution_is_that_of_another_solver_with_all_rows(robot: RobotModel) -> None:
    rng = np.random.default_rng(1)
    outcomes = []
    for _ in range(400):
        tick = random_tick(robot, rng)
        mine, (expected, feasible) = solve(tick.task), dense(robot, tick)
        assert isinstance(mine, Solution) == feasible
        if isinstance(mine, Solution):
            np.testing.assert_allclose(mine.dq_next, expected, atol=1e-6)
        outcomes.append("stop" if isinstance(mine, Unsolved) else "held" if mine.held else "free")
    counts = {outcome: outcomes.count(outcome) for outcome in ("stop", "held", "free")}
    assert min(counts.values()) >= 50, counts


@pytest.mark.parametrize(("at_m", "seed"), [((1.5, 0.0), 1), ((1.2, 0.0), 2)])
def test_every_tick_of_a_replay_is_that_of_another_solver(
    robot: RobotModel, at_m: tuple[float, float], seed: int
) -> None:
    people = person(600, DT_S, at_m, 0.35, seed=seed)
    for tick, (state, made) in enumerate(run(robot, people)):
        if tick % 3:
            continue
        task = asked(robot, state, *swing(robot, (tick + 1) * DT_S), obstacles(people, tick))
        expected, feasible = dense(robot, task)
        assert (made.status != control_step.BRAKING) == feasible
        if feasible:
            np.testing.assert_allclose(state.dq + DT_S * made.u, expected, atol=1e-6)


@pytest.mark.parametrize(("at_m", "seed"), [((1.5, 0.0), 3), ((1.1, 0.1), 4)])
def test_inequality_2_holds_wherever_the_robot_does_not_brake(
    robot: RobotModel, at_m: tuple[float, float], seed: int
) -> None:
    people = person(700, DT_S, at_m, 0.35, seed=seed)
    states, made = zip(*run(robot, people), strict=True)
    status = np.array([m.status for m in made])
    worst = violation(
        np.array([s.q for s in states]),
        np.array([s.dq for s in states]),
        np.array([m.u for m in made]),
        status,
        people,
        base(),
        dt_s=DT_S,
        stop_s=STOP_S,
    )
    assert worst.metres <= 1e-6, worst
    assert np.count_nonzero(status == control_step.LIMITED) > 100


def test_the_checker_is_no_friend_of_anyone(robot: RobotModel) -> None:
    """It finds what a controller without people does, and its arm is the robot's."""
    people = person(400, DT_S, (1.1, 0.1), 0.35, seed=4)
    nobody = volumes([np.full((1, 3), 50.0)])
    state, rows = RobotState(HOME, np.zeros(6)), []
    for tick in range(400):
        made = step(robot, state, *swing(robot, (tick + 1) * DT_S), obstacles(nobody, 0), SETTINGS)
        rows.append((state.q, state.dq, made.u))
        state = made.next
    q, dq, u = (np.array(column) for column in zip(*rows, strict=True))
    assert violation(q, dq, u, np.zeros(400), people, base(), dt_s=DT_S, stop_s=STOP_S).metres > 0.05
    for q_k, dq_k in zip(q[::50], dq[::50], strict=True):
        ends, speeds = links(q_k[None], dq_k[None], base(), 0.10)
        pose = robot.pose(q_k, dq_k)
        np.testing.assert_allclose(ends[0], pose.ends_m, atol=1e-12)
        np.testing.assert_allclose(speeds[0], pose.J_ends @ dq_k, atol=1e-12)


def test_a_free_robot_follows_its_reference(robot: RobotModel) -> None:
    nobody = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    state = RobotState(HOME + 0.02, np.zeros(6))
    for tick in range(800):
        T, twist = swing(robot, (tick + 1) * DT_S)
        made = step(robot, state, T, twist, nobody, SETTINGS)
        state = made.next
    assert made.status == control_step.TRACKING
    error = pose_error(robot.pose(state.q, state.dq).T_world_tcp, T)
    assert np.abs(error[:3]).max() < 1e-4
    assert np.abs(error[3:]).max() < 1e-4


def test_as_printed_a_position_error_does_not_decay(robot: RobotModel) -> None:
    nobody = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    T = robot.pose(HOME, np.zeros(6)).T_world_tcp.copy()
    T[0, 3] += 0.01
    left = {}
    for gain in (0.0, 5.0):
        state = RobotState(HOME, np.zeros(6))
        for _ in range(500):
            state = step(robot, state, T, np.zeros(6), nobody, replace(SETTINGS, plan=Plan(path_gain_per_s=gain))).next
        left[gain] = T[0, 3] - robot.pose(state.q, state.dq).T_world_tcp[0, 3]
    assert left[0.0] > 0.0099
    assert abs(left[5.0]) < 1e-5


def test_distance_and_pair_are_those_of_all_pairs(robot: RobotModel) -> None:
    people = person(40, DT_S * 20, (1.3, 0.0), 0.4, seed=5)
    for tick, (state, made) in enumerate(run(robot, people)):
        seen = obstacles(people, tick)
        radius = np.array([segment.radius_m for segment in robot.segments])
        surface = by_coal(robot.pose(state.q, state.dq), seen) - (radius[:, None] + seen.radius_m)
        assert made.distance_m == pytest.approx(max(0.0, surface.min()), abs=1e-9)
        assert surface[made.link, made.limb] == pytest.approx(surface.min(), abs=1e-9)


def test_without_limbs_there_is_no_distance(robot: RobotModel) -> None:
    empty = SweptVolumes(
        np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64), np.zeros((0, 3)), np.zeros((1, 0)), (), "paper"
    )
    made = step(robot, moving(robot), *swing(robot, 0.0), obstacles(empty, 0), SETTINGS)
    assert np.isnan(made.distance_m)
    assert (made.link, made.limb) == (-1, -1)
    assert made.status != control_step.BRAKING


def test_the_same_ticks_give_the_same_bits(robot: RobotModel) -> None:
    """Also with another robot object, ticks in another order, and memory that lies elsewhere."""
    people = person(150, DT_S * 4, (1.2, 0.0), 0.35, seed=6)
    first, other, ballast = list(run(robot, people)), irb140(base(), stop_s=STOP_S), []
    for tick in reversed(range(150)):
        ballast.append(np.zeros(tick * 3 + 1))
        state, made = first[tick]
        again = step(other, state, *swing(other, (tick + 1) * DT_S), obstacles(people, tick), SETTINGS)
        assert again.u.tobytes() == made.u.tobytes()
        assert again.distance_m == made.distance_m
        assert (again.status, again.reason) == (made.status, made.reason)
