from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hrcreplay.records import Floats
from hrcreplay.robot.control.control_step import RobotState
from hrcreplay.robot.control.qp_controller import RAD_PER_M, cartesian_bounds, joint_bounds
from hrcreplay.robot.control.separation import Separation, obstacles, rows_of_people, worst_rows
from hrcreplay.robot.model import RobotModel, irb140
from tests.robot.distances import by_coal
from tests.robot.people import cloud, volumes
from tests.robot.plain_rows import approach_rows, link_segment

STOP_S, DT_S = 0.377, 0.004


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    T_world_base = np.eye(4)
    T_world_base[:3, 3] = 0.1, -0.2, 0.65
    return irb140(T_world_base, stop_s=STOP_S)


def poses(robot: RobotModel, count: int, seed: int) -> list[tuple[Floats, Floats]]:
    rng = np.random.default_rng(seed)
    return [(rng.uniform(robot.q_min, robot.q_max) * 0.7, rng.normal(size=robot.nv)) for _ in range(count)]


def test_approach_rows_are_the_step_taken(robot: RobotModel) -> None:
    """Left side of Eq. (3) at both ends: half the rate at which the squared distance to a vertex shrinks."""
    rng, h = np.random.default_rng(1), 1e-6
    for q, dq in poses(robot, 20, 2):
        vertices = rng.normal(size=(5, 3))
        before, after = robot.pose(q - h * dq, dq).ends_m, robot.pose(q + h * dq, dq).ends_m
        pose = robot.pose(q, dq)
        for link in range(len(robot.segments)):
            rows = approach_rows(link_segment(pose, link), vertices, 0.7, clearance_m=0.3, stop_s=STOP_S)
            for end in range(2):
                squared = [((vertices - ends[link, end]) ** 2).sum(axis=1) for ends in (before, after)]
                expected = -STOP_S * (squared[1] - squared[0]) / (4 * h)
                np.testing.assert_allclose(rows.A[5 * end : 5 * end + 5] @ dq, expected, atol=1e-7)
            np.testing.assert_allclose(rows.b, 0.16)


def test_no_room_in_contact(robot: RobotModel) -> None:
    link = link_segment(robot.pose(np.zeros(6), np.zeros(6)), 2)
    assert np.all(approach_rows(link, np.ones((3, 3)), 0.2, clearance_m=0.3, stop_s=STOP_S).b == 0.0)


def test_worst_rows_are_the_worst_of_all_rows(robot: RobotModel) -> None:
    rng = np.random.default_rng(3)
    for q, dq in poses(robot, 30, 4):
        pose = robot.pose(q, dq)
        limbs = [cloud(rng, 25, rng.uniform(0.02, 0.3, 3)) + rng.normal(size=3) * 0.5 for _ in range(4)]
        seen = obstacles(volumes(limbs), 0)
        distance = by_coal(pose, seen)
        which, A, values = worst_rows(
            rows_of_people(
                pose,
                seen,
                Separation(distance, np.full_like(distance, 0.1)),
                np.maximum(0.0, distance - 0.1) ** 2,
                STOP_S,
            ),
            dq,
            0.0,
        )
        found = {
            tuple(key[:3]): (key[3], row, value) for key, row, value in zip(which.tolist(), A, values, strict=True)
        }
        for link in range(len(robot.segments)):
            for limb, vertices in enumerate(limbs):
                rows = approach_rows(
                    link_segment(pose, link), vertices, distance[link, limb], clearance_m=0.1, stop_s=STOP_S
                )
                for end in range(2):
                    left = (rows.A @ dq)[25 * end : 25 * end + 25]
                    if left.max() <= rows.b[0]:
                        assert (link, limb, end) not in found
                        continue
                    vertex, row, value = found[link, limb, end]
                    assert vertex == seen.offsets[limb] + left.argmax()
                    np.testing.assert_allclose(row, rows.A[25 * end + left.argmax()], atol=1e-14)
                    assert value == pytest.approx(left.max(), abs=1e-13)


def integrated(state: RobotState, dq_next: Floats) -> RobotState:
    return RobotState(state.q + 0.5 * DT_S * (state.dq + dq_next), dq_next)  # Eq. (68), (69)


def admissible(robot: RobotModel, rng: np.random.Generator) -> RobotState:
    """A state that a robot can get into: reached by driving from rest somewhere towards a limit."""
    q = rng.uniform(robot.q_min, robot.q_max)
    state = RobotState(q, np.zeros(robot.nv))
    return drive(robot, state, rng, 60)[-1]


def drive(robot: RobotModel, state: RobotState, rng: np.random.Generator, ticks: int) -> list[RobotState]:
    """Bang-bang: every axis at one end of its bounds, for a while at a time."""
    states, wish = [state], rng.integers(0, 2, robot.nv)
    for _ in range(ticks):
        wish = np.where(rng.random(robot.nv) < 0.02, 1 - wish, wish)
        low, high = joint_bounds(state.q, state.dq, robot.q_min, robot.q_max, robot.dq_max, robot.ddq_max, DT_S)
        assert np.all(low <= high)
        state = integrated(state, np.where(wish == 1, high, low))
        states.append(state)
    return states


def test_limits_hold_wherever_the_axes_are_driven(robot: RobotModel) -> None:
    rng = np.random.default_rng(5)
    for _ in range(6):
        states = drive(robot, RobotState(rng.uniform(robot.q_min, robot.q_max), np.zeros(6)), rng, 1500)
        q, dq = np.array([s.q for s in states]), np.array([s.dq for s in states])
        assert np.all(q <= robot.q_max + 1e-12)
        assert np.all(q >= robot.q_min - 1e-12)
        assert np.all(np.abs(dq) <= robot.dq_max)
        assert np.all(np.abs(np.diff(dq, axis=0)) <= robot.ddq_max * DT_S * (1 + 1e-12))


def test_axes_reach_their_limits(robot: RobotModel) -> None:
    """The bounds are no tighter than needed: an axis that is driven at a limit comes to rest on it."""
    state = RobotState(np.zeros(6), np.zeros(6))
    for _ in range(3000):
        high = joint_bounds(state.q, state.dq, robot.q_min, robot.q_max, robot.dq_max, robot.ddq_max, DT_S)[1]
        state = integrated(state, high)
    np.testing.assert_allclose(state.q, robot.q_max, atol=1e-9)
    np.testing.assert_allclose(state.dq, 0.0, atol=1e-7)


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 10**6))
def test_the_braking_step_is_always_allowed(seed: int) -> None:
    robot = irb140(np.eye(4), stop_s=STOP_S)
    rng = np.random.default_rng(seed)
    wild = RobotState(rng.uniform(robot.q_min, robot.q_max) * 1.2, rng.normal(size=6) * robot.dq_max)
    state = admissible(robot, rng) if seed % 2 else wild
    low, high = joint_bounds(state.q, state.dq, robot.q_min, robot.q_max, robot.dq_max, robot.ddq_max, DT_S)
    stop = state.dq - np.clip(state.dq, -DT_S * robot.ddq_max, DT_S * robot.ddq_max)  # Eq. (67)
    assert np.all(low <= stop + 1e-12)
    assert np.all(stop <= high + 1e-12)


def test_an_endless_axis_has_no_position_bound() -> None:
    one, end = np.ones(1), np.full(1, np.inf)
    low, high = joint_bounds(1e6 * one, 0.5 * one, -end, end, 2 * one, 5 * one, DT_S)
    np.testing.assert_allclose([low[0], high[0]], [0.48, 0.52])


def test_cartesian_bounds_are_eq_66g_and_66h(robot: RobotModel) -> None:
    rng = np.random.default_rng(7)
    unit = np.array([1, 1, 1, RAD_PER_M, RAD_PER_M, RAD_PER_M])
    for q, dq in poses(robot, 20, 8):
        pose = robot.pose(q, dq)
        J, dJdq = pose.J_tcp, pose.dJdq_tcp
        low, high = cartesian_bounds(J, dJdq, dq, 2.5, 25.0, DT_S)
        for _ in range(50):
            u = rng.normal(size=6) * 30
            speed, acceleration = J @ dq + DT_S * (dJdq + J @ u), dJdq + J @ u
            expected = (np.abs(speed) <= 2.5 * unit) & (np.abs(acceleration) <= 25.0 * unit)
            twist = J @ (dq + DT_S * u)
            np.testing.assert_array_equal((low <= twist) & (twist <= high), expected)


def test_a_turn_of_2_pi_goes_with_2_and_a_half_metres() -> None:
    assert pytest.approx(2 * np.pi) == 2.5 * RAD_PER_M
