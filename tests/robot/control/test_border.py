"""Walls of a watched area against the half-spaces behind them, at points that the robot can reach."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay

from hrcreplay.geometry.polygon import ConvexPolygon
from hrcreplay.records import Floats
from hrcreplay.robot.control.border import Border
from hrcreplay.robot.control.control_step import RobotState, observe
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.model import RobotModel, irb140
from tests.geometry.test_polygon import corners_of

BASE = np.array([[0.0, 1.0, 0.0, 0.3], [-1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 1.0, 0.4], [0.0, 0.0, 0.0, 1.0]])


def robot_at(T_world_base: Floats = BASE) -> RobotModel:
    """The IRB 140 with a tool."""
    return irb140(T_world_base, stop_s=0.25, tool_m=0.2)


def around(robot: RobotModel, corners: Floats) -> tuple[Border, ConvexPolygon]:
    """The border of an area, moved so that its middle is at the robot's base."""
    polygon = ConvexPolygon.of_corners(corners - corners.mean(axis=0) + robot.T_world_base[:2, 3])
    return Border.around(robot, polygon), polygon


def test_no_end_of_a_link_is_further_from_the_base_than_the_span() -> None:
    robot = robot_at()
    rng = np.random.default_rng(0)
    far = [
        np.linalg.norm(robot.ends_m(rng.uniform(robot.q_min, robot.q_max)) - BASE[:3, 3], axis=2).max()
        for _ in range(2000)
    ]
    assert max(far) <= robot.span_m
    assert robot.span_m < 1.6 * max(far)


@pytest.mark.parametrize("seed", range(10))
def test_a_point_within_reach_is_in_a_wall_where_the_border_has_passed_it(seed: int) -> None:
    robot = robot_at()
    border, polygon = around(robot, 1.5 * corners_of(seed))
    depth_m = 0.8 * float(border.room_m.min())
    assert depth_m > 0.0
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(4000, 3))
    points *= robot.span_m * rng.uniform(0.0, 1.0, (4000, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    points += robot.T_world_base[:3, 3]
    walls = border.walls(depth_m).reshape(-1, 8, 3)
    within = np.zeros(len(points), dtype=bool)
    for wall in walls:
        within |= Delaunay(wall).find_simplex(points, tol=1e-9) >= 0
    behind = polygon.depth_m(points) < depth_m
    near = np.abs(polygon.depth_m(points) - depth_m) < 1e-6
    assert ((within == behind) | near).all()
    assert behind.any()
    assert not behind.all()


def test_the_distance_is_that_from_the_half_space() -> None:
    robot = robot_at()
    border, polygon = around(robot, np.array([[-3.0, -2.5], [3.0, -2.5], [3.0, 2.5], [-3.0, 2.5]]))
    rng = np.random.default_rng(1)
    for depth_m in (0.3, 0.9, 1.4):
        q = rng.uniform(robot.q_min, robot.q_max)
        sight = observe(robot, RobotState(q, np.zeros(6)), border.obstacles(depth_m, 0.4, 7), 0.0)
        radius = np.array([segment.radius_m for segment in robot.segments])
        apart = (polygon.depth_m(robot.ends_m(q)).min(axis=1) - depth_m - radius).min()
        assert sight.distance_m - sight.overlap_m == pytest.approx(apart, abs=1e-6)
        assert 7 <= sight.limb < 7 + 4


def test_a_border_that_has_come_to_the_base_says_nothing() -> None:
    robot = robot_at()
    border, _ = around(robot, np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]]))
    assert border.obstacles(1.9, 0.4, 7).known
    for depth_m in (2.0, 5.0, np.inf, np.nan):
        assert not border.obstacles(depth_m, 0.4, 7).known


def test_walls_stand_behind_the_volumes_of_a_person() -> None:
    robot = robot_at()
    border, _ = around(robot, np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]]))
    limb = np.array([[1.0, 0.0, 1.0], [1.0, 0.1, 1.2]])
    person = Obstacles(limb, np.array([0, 2]), np.array([0.1]), np.array([[limb[0], limb[1]]]), known=True)
    both = border.obstacles(0.5, 0.4, person)
    assert both.first == 0
    assert both.known
    np.testing.assert_array_equal(both.vertices_m[:2], limb)
    np.testing.assert_array_equal(both.vertices_m[2:], border.walls(0.5))
    np.testing.assert_array_equal(both.offsets, [0, 2, 10, 18, 26, 34])
    np.testing.assert_array_equal(both.radius_m, [0.1, 0.0, 0.0, 0.0, 0.0])
    unknown = Obstacles(np.full((1, 3), np.nan), np.array([0, 1]), np.array([0.1]), np.zeros((1, 2, 3)), known=False)
    assert not border.obstacles(0.5, 0.4, unknown).known


def test_a_robot_that_stands_outside_of_its_area_is_never_safe() -> None:
    robot = robot_at()
    polygon = ConvexPolygon.of_corners(np.array([[5.0, 5.0], [9.0, 5.0], [9.0, 9.0], [5.0, 9.0]]))
    assert not Border.around(robot, polygon).obstacles(0.0, 0.4, 7).known
