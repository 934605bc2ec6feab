from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest

from hrcreplay.records import SweptVolumes
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.control_step import PlanSettings, Step
from hrcreplay.robot.control.controllers import ScalingController
from hrcreplay.robot.control.path_controller import rates
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.robot.control.stops import stop_along_path
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import Reference, parse_task
from hrcreplay.settings.sections import Plan
from tests.robot.checker import violation
from tests.robot.distances import by_coal
from tests.robot.people import person, volumes
from tests.robot.plain_rows import approach_rows, link_segment
from tests.robot.swinging import DT_S, PRINTED, STOP_S, base, robot

__all__ = ["robot"]  # the fixture

SETTINGS = PlanSettings(PRINTED, dt_s=DT_S, stop_s=STOP_S)


class PathState(NamedTuple):
    """Progress of the robot along its programmed path, and its share of the programmed speed."""

    s_s: float
    rate: float


@pytest.fixture(scope="module")
def reference(robot: RobotModel) -> Reference:
    places = [{"joints_deg": [40, 20, -10, 0, 60, 0]}, {"joints_deg": [-40, 30, -20, 0, 70, 0], "dwell_s": 0.2}]
    task = {"name": "to and fro", "repeat": True, "speed": 0.6, "acceleration": 0.5, "waypoints": places}
    return plan_programme(parse_task(task), robot)


def step(
    robot: RobotModel, reference: Reference, state: PathState, seen: Obstacles, settings: PlanSettings
) -> tuple[Step, PathState]:
    """One tick from a given state of the path."""
    controller = ScalingController(robot, reference, settings)
    going = stop_along_path(reference.grid, state.s_s, state.rate, robot.ddq_max, settings.dt_s)
    assert going is not None
    controller.stop = going
    made = controller.step(lambda _: seen).step
    return made, PathState(*controller.stop.along[0].tolist())


def run(robot: RobotModel, reference: Reference, people: SweptVolumes) -> Iterator[tuple[PathState, Step]]:
    state = PathState(0.0, 1.0)
    for tick in range(len(people)):
        made, after = step(robot, reference, state, obstacles(people, tick), SETTINGS)
        yield state, made
        state = after


def test_alone_it_runs_the_programme(robot: RobotModel, reference: Reference) -> None:
    nobody = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    state = PathState(0.0, 1.0)
    for tick in range(1000):
        made, state = step(robot, reference, state, nobody, SETTINGS)
        assert made.status == control_step.TRACKING
        assert state.s_s == pytest.approx((tick + 1) * DT_S, abs=1e-9)


def test_it_stays_on_the_path_and_keeps_inequality_2(robot: RobotModel, reference: Reference) -> None:
    people = person(1200, DT_S, (1.5, 0.0), 0.35, seed=1)
    rows = list(run(robot, reference, people))
    points = [reference.sample(state.s_s) for state, _ in rows]
    q = np.array([point.q for point in points])
    dq = np.array([state.rate * point.dq for (state, _), point in zip(rows, points, strict=True)])
    u, status = np.array([made.u for _, made in rows]), np.array([made.status for _, made in rows])
    for (_, made), (after, _), point in zip(rows[:-1], rows[1:], points[1:], strict=True):
        np.testing.assert_array_equal(made.next.q, point.q)
        np.testing.assert_array_equal(made.next.dq, after.rate * point.dq)
    np.testing.assert_allclose(q[:-1] + DT_S * dq[:-1] + DT_S**2 / 2 * u[:-1], q[1:], atol=1e-5)
    assert np.abs(u / robot.ddq_max).max() <= 1.0 + 1e-6
    worst = violation(q, dq, u, status, people, base(), dt_s=DT_S, stop_s=STOP_S)
    assert worst.metres <= 1e-6, worst
    assert np.count_nonzero(status == control_step.LIMITED) > 100


def test_the_rate_is_the_largest_where_people_hold_it(robot: RobotModel, reference: Reference) -> None:
    people = person(600, DT_S, (1.5, 0.0), 0.35, seed=2)
    rows = list(run(robot, reference, people))
    held = 0
    for tick, ((state, made), (after, _)) in enumerate(pairwise(rows)):
        if made.status != control_step.LIMITED:
            continue
        more = after.rate * 1.001 + 1e-9
        now, then = reference.sample(state.s_s), reference.sample(state.s_s + DT_S / 2 * (state.rate + more))
        pose, seen = robot.pose(now.q, state.rate * now.dq), obstacles(people, tick)
        distance, broken = by_coal(pose, seen), False
        for link, segment in enumerate(robot.segments):
            for limb in range(6):
                vertices = seen.vertices_m[seen.offsets[limb] : seen.offsets[limb + 1]]
                clearance = segment.radius_m + seen.radius_m[limb]
                row = approach_rows(
                    link_segment(pose, link), vertices, distance[link, limb], clearance_m=clearance, stop_s=STOP_S
                )
                broken = broken or bool(np.any(row.A @ (more * then.dq) > row.b))
        assert broken
        held += 1
    assert held > 100


@pytest.mark.parametrize("s_s", [0.0, 0.3, 0.7, 1.2])
def test_it_speeds_up_as_fast_as_the_axes_can(robot: RobotModel, reference: Reference, s_s: float) -> None:
    nobody = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    state = PathState(s_s, 0.0)
    for _ in range(200):
        made, state = step(robot, reference, state, nobody, SETTINGS)
        assert made.status == control_step.TRACKING
        if state.rate == 1.0:
            break
        assert np.abs(made.u / robot.ddq_max).max() == pytest.approx(1.0, abs=1e-5)
    assert state.rate == 1.0


def test_without_a_known_person_it_brakes_along_the_path_until_it_stands(
    robot: RobotModel, reference: Reference
) -> None:
    unknown = obstacles(volumes([np.full((1, 3), np.nan)]), 0)
    state, speeds = PathState(0.4, 1.0), []
    for _ in range(300):
        before = state
        made, state = step(robot, reference, state, unknown, SETTINGS)
        assert (made.status, made.reason) == (control_step.BRAKING, control_step.NO_HUMAN)
        speeds.append(state.rate)
        if 0.0 < state.rate < before.rate:  # one axis gives all it has
            assert np.abs(made.u / robot.ddq_max).max() == pytest.approx(1.0, abs=1e-6)
    assert np.all(np.diff(speeds) <= 0.0)
    assert speeds[-1] == 0.0
    assert np.all(made.u == 0.0)
    nobody = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    made, state = step(robot, reference, state, nobody, SETTINGS)
    assert made.status == control_step.TRACKING
    assert state.rate > 0.0


def test_a_tcp_limit_scales_the_speed(robot: RobotModel, reference: Reference) -> None:
    nobody = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    slow, state, fastest = replace(SETTINGS, plan=Plan(tcp_speed_max=0.2)), PathState(0.0, 0.0), 0.0
    for _ in range(400):
        made, state = step(robot, reference, state, nobody, slow)
        fastest = max(fastest, np.abs(robot.pose(*made.next).twist_tcp[:3]).max())
        assert made.status == control_step.TRACKING
    assert fastest == pytest.approx(0.2, rel=1e-2)


def test_rates_bound_a_multiple() -> None:
    towards, low, high = np.array([2.0, -1.0, 0.0]), np.array([-1.0, -3.0, -1.0]), np.array([3.0, 0.5, 1.0])
    assert rates(towards, low, high) == (-0.5, 1.5)
    assert rates(np.zeros(2), -np.ones(2), np.ones(2)) == (-np.inf, np.inf)
