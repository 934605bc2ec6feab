"""A robot inside a volume moves out of it, or stands: against distances of sampled points."""

from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.records import STATUSES, Floats
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.certificate import NO_PLANES, clear
from hrcreplay.robot.control.control_step import PlanSettings, Step
from hrcreplay.robot.control.controllers import QpController
from hrcreplay.robot.control.motion_check import CLEAR, OPENING, REFUSED
from hrcreplay.robot.control.stops import at_rest, stop_straight
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import parse_task
from hrcreplay.settings.sections import Plan
from tests.tools.random_stops import DT_S, RADII_M, TOOL_M, Box, as_obstacles, instants, link_points, random_turn

STATUS = dict(zip(STATUSES, range(len(STATUSES)), strict=True))


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return irb140(np.eye(4), stop_s=0.377, tool_m=TOOL_M)


def inside_of(box: Box, rng: np.random.Generator, count: int) -> Floats:
    """(count, 3) points of the box without its ball, corners among them."""
    anywhere = box.centre_m + rng.uniform(-1.0, 1.0, (count, 3)) * box.half_m @ box.turn.T
    return np.concatenate([box.corners(), anywhere])


def test_what_is_called_opening_brings_no_point_of_the_link_nearer_to_any_of_the_volume(robot: RobotModel) -> None:
    rng, opening, refused = np.random.default_rng(2), 0, 0
    for _ in range(6000):
        q = rng.uniform(np.maximum(robot.q_min, -2.0), np.minimum(robot.q_max, 2.0))
        link = int(rng.integers(2, 5))
        points = link_points(q[None])[0, link]
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        box = Box(np.zeros(3), random_turn(rng), rng.uniform(0.0, 0.15, 3), 0.06)
        box.centre_m = points[rng.integers(len(points))] + normal * rng.uniform(0.0, 0.5)
        depth = RADII_M[link] + box.radius_m - box.distance_m(points).min()
        if not 0.0 < depth < 0.05:
            continue
        dq = -np.linalg.pinv(robot.pose(q, np.zeros(6)).J_ends[link, 1]) @ (normal * rng.uniform(0.0, 0.3))
        dq += rng.normal(0.0, 0.05, 6)
        stop, going = stop_straight(q + DT_S * dq, dq, robot.ddq_max, DT_S), at_rest(q)
        going.dq[0] = dq
        verdict, _ = clear(robot, going, stop, as_obstacles([box]), 0.0, DT_S, NO_PLANES, 0.05)
        assert clear(robot, going, stop, as_obstacles([box]), 0.0, DT_S, NO_PLANES)[0] == REFUSED
        refused += verdict == REFUSED
        if verdict != OPENING:
            assert verdict == REFUSED
            continue
        opening += 1
        targets = inside_of(box, rng, 40)
        for moved in link_points(instants(going, stop)).transpose(1, 0, 2, 3)[[link]]:
            apart = np.linalg.norm(moved[:, :, None] - targets, axis=3)  # (instants, points, targets)
            assert np.diff(apart, axis=0).min() > -1e-5
        speed = np.linalg.norm(np.einsum("eij,j->ei", robot.pose(q, dq).J_ends[link], dq), axis=1)
        assert speed.max() < 0.25 + 0.01
    assert opening > 100
    assert refused > 100


def controller(robot: RobotModel, retreat_m: float) -> QpController:
    waypoints = [{"joints_deg": [0, 30, -20, 0, 60, 0]}, {"joints_deg": [5, 30, -20, 0, 60, 0]}]
    path = plan_programme(parse_task({"name": "small", "repeat": True, "waypoints": waypoints}), robot)
    settings = PlanSettings(Plan(retreat_m=retreat_m), dt_s=DT_S, stop_s=0.377, retreat_m=retreat_m)
    return QpController(robot, path, settings)


def beside(robot: RobotModel, runner: QpController, depth_m: float) -> Box:
    """A slab that the tool is inside of, from the front."""
    tip = link_points(runner.state.q[None])[0, 4]
    return Box(tip[-1] + [0.05 + 0.1 + RADII_M[4] - depth_m, 0.0, 0.0], np.eye(3), np.array([0.1, 0.3, 0.3]), 0.05)


def go(runner: QpController, box: Box, ticks: int) -> list[Step]:
    seen = as_obstacles([box])._replace(horizon_s=np.inf)
    return [runner.step(lambda _: seen).step for _ in range(ticks)]


def test_a_robot_that_is_a_little_inside_moves_out_slowly_and_goes_on(robot: RobotModel) -> None:
    runner = controller(robot, 0.05)
    box = beside(robot, runner, 0.03)
    began = box.distance_m(link_points(runner.state.q[None])[0, 4]).min()
    steps = go(runner, box, 500)
    retreat = [step for step in steps if step.status == STATUS["retreating"]]
    assert len(retreat) > 10
    assert all(step.certified for step in steps)
    assert max(robot.pose(*step.next).tcp_speed for step in retreat) < 0.25 + 0.01
    points = np.array([link_points(step.next.q[None])[0, 4] for step in steps])
    gaps = np.array([box.distance_m(at).min() for at in points]) - RADII_M[4] - box.radius_m
    assert gaps[-1] > 0.0
    assert gaps.min() > began - RADII_M[4] - box.radius_m - 1e-5, "never deeper than it was"
    first_out = next(i for i, gap in enumerate(gaps) if gap > 0.0)
    assert gaps[first_out:].min() > -1e-9, "nor inside again"


@pytest.mark.parametrize(("retreat_m", "depth_m"), [(0.0, 0.03), (0.05, 0.07), (0.05, 0.2)])
def test_deeper_inside_or_without_retreat_the_robot_stands_and_says_why(
    robot: RobotModel, retreat_m: float, depth_m: float
) -> None:
    runner = controller(robot, retreat_m)
    steps = go(runner, beside(robot, runner, depth_m), 100)
    assert not any(step.next.dq.any() for step in steps)
    assert {step.reason for step in steps} == {control_step.INSIDE}
    assert {step.status for step in steps} == {STATUS["limited"]}


def test_a_link_that_begins_clear_is_never_called_opening(robot: RobotModel) -> None:
    q = np.array([0.1, 0.5, -0.3, 0.0, 0.8, 0.0])
    tip = link_points(q[None])[0, 4, -1]
    away = Box(tip + np.array([0.3, 0.0, 0.0]), np.eye(3), np.full(3, 0.05), 0.05)
    assert clear(robot, at_rest(q), at_rest(q), as_obstacles([away]), 0.0, DT_S, NO_PLANES, 0.05)[0] == CLEAR
