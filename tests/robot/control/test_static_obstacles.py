"""Rows, certificate and distances of objects and of the robot's own links, against what is written differently."""

from __future__ import annotations

import coal
import daqp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import Delaunay

from hrcreplay.records import Floats
from hrcreplay.robot.control.active_constraints import explain_refusal, find_holding_rows, name_planes
from hrcreplay.robot.control.certificate import NO_PLANES, clear
from hrcreplay.robot.control.control_step import (
    PlanSettings,
    Proposal,
    RobotState,
    observe,
)
from hrcreplay.robot.control.minimiser import Solution, minimise
from hrcreplay.robot.control.motion_check import CLEAR, REFUSED
from hrcreplay.robot.control.qp_controller import QpContext, Target, problem, static_ahead_s
from hrcreplay.robot.control.row_search import SLACK
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.control.static_obstacles import (
    ROWS_KEEP_M,
    StaticHull,
    StaticObstacles,
    half_space,
    link_radii,
    nearest,
    plane_rows,
    static_obstacles,
)
from hrcreplay.robot.control.stops import at_rest, stop_straight
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.settings.load import load_settings
from tests.robot.distances import axis_distance
from tests.tools.random_stops import DT_S, PAIRS, TOOL_M, Box, as_obstacles, as_static, random_boxes, run

AHEAD_S = 0.15


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return irb140(np.eye(4), stop_s=0.377, tool_m=TOOL_M)


def postures(robot: RobotModel, count: int, seed: int) -> list[tuple[Floats, Floats]]:
    rng = np.random.default_rng(seed)
    low, high = np.maximum(robot.q_min, -np.pi), np.minimum(robot.q_max, np.pi)
    return [(rng.uniform(low, high), rng.normal(size=6)) for _ in range(count)]


def floor(robot: RobotModel, height_m: float, clearance_m: float = 0.0, first: int = 0) -> StaticObstacles:
    hull = StaticHull("floor", half_space(robot, np.array([5.0, 2.0, height_m]), np.array([0.0, 0.0, 1.0])), 0.0)
    keep_m = np.where(np.arange(5)[:, None] >= first, link_radii(robot)[:, None] + clearance_m, -np.inf)
    return static_obstacles(robot, [hull], keep_m, keep_m > 0.0, np.empty((0, 2), np.int64), np.empty(0))


def test_the_box_of_a_half_space_holds_what_the_robot_reaches_behind_its_plane() -> None:
    T = np.eye(4)
    T[:3, 3] = 0.3, -0.2, 0.65
    robot, rng = irb140(T, stop_s=0.3), np.random.default_rng(3)
    for _ in range(20):
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        point = T[:3, 3] + rng.normal(size=3)
        box = Delaunay(half_space(robot, point, normal))
        reached = rng.normal(size=(3000, 3))
        reached *= robot.span_m * rng.random((3000, 1)) ** (1 / 3) / np.linalg.norm(reached, axis=1, keepdims=True)
        reached += T[:3, 3]
        behind = (reached - point) @ normal
        inside = box.find_simplex(reached, tol=1e-9) >= 0
        sure = np.abs(behind) > 1e-6
        np.testing.assert_array_equal(inside[sure], behind[sure] < 0.0)


def test_rows_beside_a_floor_are_the_speed_of_the_ends_towards_it(robot: RobotModel) -> None:
    h, clearance_m = 1e-6, 0.01
    for q, dq in postures(robot, 20, 1):
        pose = robot.pose(q, dq)
        low = float((pose.ends_m[:, :, 2].min(axis=1) - link_radii(robot)).min())
        static = floor(robot, low - 0.05, clearance_m)
        which, (A, high) = plane_rows(static.shapes, pose.ends_m, pose.J_ends, AHEAD_S)
        assert len(which)
        sinks = -(robot.ends_m(q + h * dq) - robot.ends_m(q - h * dq))[:, :, 2] / (2 * h)
        gap = pose.ends_m[:, :, 2] - (low - 0.05) - link_radii(robot)[:, None] - clearance_m - ROWS_KEEP_M
        for (link, end, _, _), row, bound in zip(which.tolist(), A, high, strict=True):
            assert row @ dq == pytest.approx(sinks[link, end], abs=1e-6)
            assert bound == pytest.approx(gap[link, end] / AHEAD_S, abs=1e-6)


def _nearest_points(one: Floats, two: Floats) -> tuple[Floats, Floats]:
    """Nearest points of two segments by a general minimiser."""

    def apart(x: Floats) -> float:
        return float(((one[0] + x[0] * (one[1] - one[0]) - two[0] - x[1] * (two[1] - two[0])) ** 2).sum())

    tries = [minimize(apart, start, bounds=[(0, 1), (0, 1)], tol=1e-14) for start in ((0.1, 0.1), (0.9, 0.1), (0.5, 1))]
    x = min(tries, key=lambda found: float(found.fun)).x
    return one[0] + x[0] * (one[1] - one[0]), two[0] + x[1] * (two[1] - two[0])


def test_rows_of_two_links_are_the_speed_of_one_towards_the_other(robot: RobotModel) -> None:
    h = 1e-6
    for q, dq in postures(robot, 10, 2):
        pose, static = robot.pose(q, dq), as_static(robot, [])
        which, (A, high) = plane_rows(static.shapes, pose.ends_m, pose.J_ends, AHEAD_S)
        before, after = robot.ends_m(q - h * dq), robot.ends_m(q + h * dq)
        for (one, e, hull, other), row, bound in zip(which.tolist(), A, high, strict=True):
            two, f = divmod(other, 2)
            assert hull == -1
            a, b = _nearest_points(pose.ends_m[one], pose.ends_m[two])
            normal = (b - a) / np.linalg.norm(b - a)
            gap = [normal @ (ends[two, f] - ends[one, e]) for ends in (before, pose.ends_m, after)]
            assert row @ dq == pytest.approx(-(gap[2] - gap[0]) / (2 * h), abs=2e-3)
            keep_m = link_radii(robot)[[one, two]].sum() + ROWS_KEEP_M
            assert bound == pytest.approx(max(0.0, gap[1] - keep_m) / AHEAD_S, abs=5e-3)
        assert len(which) % 4 == 0


def test_no_certified_stop_ever_enters_an_object_or_another_link() -> None:
    found = run(6_000, seed=11, objects=True)
    assert found.entered == 0, found
    assert found.deepest_m > -0.002, "stops near objects and links are among them"


def test_a_robot_in_an_object_or_in_itself_is_refused(robot: RobotModel) -> None:
    q = np.zeros(6)
    far = Box(np.array([5.0, 0.0, 0.0]), np.eye(3), np.zeros(3), 0.1)
    at_tcp = Box(robot.pose(q, q).T_world_tcp[:3, 3], np.eye(3), np.full(3, 0.05), 0.0)
    folded = np.array([0.0, -1.2, 0.6, 0.0, 1.0, 0.0])
    for posture, boxes, expected in (
        (q, [far], CLEAR),
        (q, [far, at_tcp], REFUSED),
        (folded, [far], REFUSED if _overlaps_itself(robot, folded) else CLEAR),
    ):
        stop = at_rest(posture)
        static = as_static(robot, boxes)
        assert clear(robot, stop, stop, as_obstacles([far]), 0.0, DT_S, NO_PLANES, static=static)[0] == expected
    assert _overlaps_itself(robot, folded), "the case is one"


def _overlaps_itself(robot: RobotModel, q: Floats) -> bool:
    ends, radius = robot.ends_m(q), link_radii(robot)
    for one, two in PAIRS.tolist():
        a, b = _nearest_points(ends[one], ends[two])
        if np.linalg.norm(b - a) < radius[[one, two]].sum():
            return True
    return False


def test_the_nearest_object_and_pair_of_links_are_those_of_coal(robot: RobotModel) -> None:
    rng = np.random.default_rng(5)
    q = np.array([posture for posture, _ in postures(robot, 30, 4)])
    boxes = [box for _ in range(3) for box in random_boxes(rng, robot.ends_m(q[0]).reshape(-1, 3))]
    static = as_static(robot, boxes)
    found = nearest(robot, static, q)
    radius = link_radii(robot)
    for i, posture in enumerate(q):
        ends = robot.ends_m(posture)
        apart = np.array(
            [
                [axis_distance(a, b, box.corners(), [0]) - r - box.radius_m for box in boxes]
                for (a, b), r in zip(ends, radius, strict=True)
            ]
        )
        assert found.object_m[i] == pytest.approx(apart.min(), abs=1e-6)
        assert apart[found.object_link[i], found.object[i]] == pytest.approx(apart.min(), abs=1e-6)
        pairs = [_capsules(ends[one], ends[two]) - radius[[one, two]].sum() for one, two in PAIRS.tolist()]
        assert found.links_m[i] == pytest.approx(min(pairs), abs=1e-6)
        assert found.links[i].tolist() == PAIRS[int(np.argmin(pairs))].tolist()


def _capsules(one: Floats, two: Floats) -> float:
    a, b = _nearest_points(one, two)
    return float(np.linalg.norm(b - a))


def test_an_unchecked_pair_is_neither_certified_nor_bounded(robot: RobotModel) -> None:
    q = np.zeros(6)
    box = Box(robot.pose(q, q).T_world_tcp[:3, 3], np.eye(3), np.full(3, 0.01), 0.0)
    hull = StaticHull("box", box.corners(), 0.0)
    full_m = link_radii(robot)[:, None]
    none = np.empty((0, 2), np.int64), np.empty(0)
    checked = static_obstacles(robot, [hull], full_m, np.ones((5, 1), bool), *none)
    keep_m = np.where(np.arange(5)[:, None] < 3, full_m, -np.inf)
    unchecked = static_obstacles(robot, [hull], keep_m, keep_m > 0.0, *none)
    stop, far = at_rest(q), as_obstacles([Box(np.array([5.0, 0.0, 0.0]), np.eye(3), np.zeros(3), 0.1)])
    assert clear(robot, stop, stop, far, 0.0, DT_S, NO_PLANES, static=checked)[0] == REFUSED
    assert clear(robot, stop, stop, far, 0.0, DT_S, NO_PLANES, static=unchecked)[0] == CLEAR
    pose = robot.pose(q, q)
    which, _ = plane_rows(unchecked.shapes, pose.ends_m, pose.J_ends, AHEAD_S)
    assert set(which[:, 0].tolist()) <= {0, 1, 2}


def test_coal_agrees_on_the_capsule_and_box_of_the_tool(robot: RobotModel) -> None:
    """The tool of objects_overlaps measures what `nearest` says, with coal's own capsules and boxes."""
    q = np.array([[0.3, 0.5, -0.4, 0.2, 0.9, 0.1]])
    box = Box(np.array([0.55, 0.1, 0.05]), np.eye(3), np.array([0.3, 0.2, 0.05]), 0.0)
    (low,) = nearest(robot, as_static(robot, [box]), q).object_m.tolist()
    shape = coal.CollisionObject(coal.Box(*(2.0 * box.half_m)), coal.Transform3s(np.eye(3), box.centre_m))
    least = np.inf
    for (a, b), radius in zip(robot.ends_m(q[0]), link_radii(robot), strict=True):
        z = (b - a) / np.linalg.norm(b - a)
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
        x /= np.linalg.norm(x)
        pose = coal.Transform3s(np.column_stack([x, np.cross(z, x), z]), 0.5 * (a + b))
        capsule = coal.CollisionObject(coal.Capsule(radius, np.linalg.norm(b - a)), pose)
        least = min(least, coal.distance(capsule, shape, coal.DistanceRequest(), coal.DistanceResult()))
    assert low == pytest.approx(least, abs=1e-6)


def _nobody() -> Obstacles:
    return as_obstacles([Box(np.array([9.0, 0.0, 0.0]), np.eye(3), np.zeros(3), 0.1)])


def _task(
    robot: RobotModel, static: StaticObstacles, q: Floats, dq: Floats, rows: str
) -> tuple[QpContext, PlanSettings]:
    """A robot whose reference pulls its TCP down and sideways."""
    plan = load_settings(None).plan.model_copy(update={"rows": rows, "jerk_s": 0.0})
    settings, sight = PlanSettings(plan, dt_s=DT_S, stop_s=0.377), observe(robot, RobotState(q, dq), _nobody(), 0.0)
    T = sight.pose.T_world_tcp.copy()
    T[:3, 3] += [0.05, 0.1, -0.2]
    target = Target(T, np.array([0.0, 0.2, -0.4, 0.0, 0.0, 0.0]), q)
    return QpContext(robot, RobotState(q, dq), np.zeros(6), target, sight, _nobody(), 0.1, static), settings


@pytest.mark.parametrize("rows", ["hard", "soft"])
def test_the_minimiser_keeps_the_rows_of_planes_as_another_solver_does(robot: RobotModel, rows: str) -> None:
    q = np.array([0.2, 0.6, -0.3, 0.1, 1.0, 0.0])
    pose = robot.pose(q, np.zeros(6))
    low = float((pose.ends_m[:, :, 2].min(axis=1) - link_radii(robot))[2:].min())
    held = 0
    for gap_m in (0.004, 0.01, 0.03, 0.3):
        static = floor(robot, low - gap_m, first=2)
        context, settings = _task(robot, static, q, np.zeros(6), rows)
        task = problem(context, settings)
        found = minimise(task)
        assert isinstance(found, Solution)
        _, (A, high) = plane_rows(static.shapes, pose.ends_m, pose.J_ends, static_ahead_s(0.1, settings.plan.smooth_s))
        H, g = task.H, task.g
        limits = np.vstack([np.eye(6), task.limits.J]), np.append(task.limits.high, task.limits.J_high)
        below = np.append(task.limits.low, task.limits.J_low)
        if rows == "soft":
            H = np.block([[H, np.zeros((6, 1))], [np.zeros((1, 6)), np.array([[SLACK]])]])
            g = np.append(g, 0.0)
            limits = np.column_stack([limits[0], np.zeros(len(limits[0]))]), limits[1]
            A = np.column_stack([A, -np.ones(len(A))])
        whole = np.ascontiguousarray(np.vstack([limits[0], A]))
        upper, lower = np.append(limits[1], high), np.append(below, np.full(len(A), -1e30))
        x, _, flag, _ = daqp.solve(H.copy(), g.copy(), whole, upper, lower, np.zeros(len(upper), dtype=np.intc))
        assert flag == 1
        np.testing.assert_allclose(found.dq_next, x[:6], atol=2e-6)
        assert found.held == (gap_m < 0.1)
        held += found.held
    assert held == 3


def test_why_names_the_object_that_holds_the_robot(robot: RobotModel) -> None:
    q = np.array([0.2, 0.6, -0.3, 0.1, 1.0, 0.0])
    ends = robot.ends_m(q)
    low = float((ends[:, :, 2].min(axis=1) - link_radii(robot))[2:].min())
    static = floor(robot, low - 0.01, first=2)
    context, settings = _task(robot, static, q, np.zeros(6), "soft")
    task = problem(context, settings)
    solved = minimise(task)
    assert isinstance(solved, Solution)
    pose = context.sight.pose
    which, _ = plane_rows(static.shapes, pose.ends_m, pose.J_ends, 1.0)
    found = name_planes(find_holding_rows(task, solved), which, static)
    (row,) = found["binding"]
    link, end = divmod(int(np.argmin((ends[:, :, 2] - link_radii(robot)[:, None])[2:])) + 4, 2)
    assert (row["kind"], row["object"], row["link"], row["end"]) == ("object", "floor", link, end)
    assert row["multiplier"] > 0.0
    stop = stop_straight(q, np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.0]), robot.ddq_max, DT_S)
    told = explain_refusal(robot, at_rest(q), Proposal(stop, 0), _nobody(), 1.0, settings, static)
    assert told["object"] == "floor"
    assert robot.segments[told["link"]].name in {"wrist", "tool", "forearm"}
    assert told["gap_m"] - told["travel_m"] <= 0.0
