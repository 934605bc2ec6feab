"""Programmes beside objects: which are refused, where they touch, and how near a link may come."""

from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.robot.control.programme_check import SPARE_M, check_programme
from hrcreplay.robot.control.static_obstacles import UNCHECKED, StaticHull, link_radii
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import Reference, parse_task
from tests.robot.distances import axis_distance
from tests.tools.random_stops import PAIRS, Box

DOWN = [180.0, 0.0, 0.0]
#: A way from one side to the other, down in the middle.
WAY = [(0.45, -0.25, 0.35), (0.45, 0.0, 0.20), (0.45, 0.25, 0.35)]


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return irb140(np.eye(4), stop_s=0.377, tool_m=0.10)


@pytest.fixture(scope="module")
def path(robot: RobotModel) -> Reference:
    waypoints = [{"position_m": list(place), "rpy_deg": DOWN, "move": "linear"} for place in WAY]
    return plan_programme(parse_task({"waypoints": [waypoints[0] | {"move": "joint"}, *waypoints[1:]]}), robot)


def box(middle_m: tuple[float, float, float], half_m: tuple[float, float, float], **how: object) -> StaticHull:
    shape = Box(np.array(middle_m), np.eye(3), np.array(half_m), 0.0)
    return StaticHull("crate", shape.corners(), 0.0, **how)  # type: ignore[arg-type]


def _apart(ends: Floats, hull: StaticHull) -> float:
    return axis_distance(ends[0], ends[1], hull.vertices_m, [0])


def least_m(robot: RobotModel, path: Reference, link: int, hull: StaticHull) -> tuple[float, float]:
    """Smallest distance between a link's axis and a hull along a path, by coal at every tenth of a step, and when."""
    found = [
        (_apart(robot.ends_m(path.sample(at_s).q)[link], hull), at_s) for at_s in np.arange(0.0, path.duration_s, 0.002)
    ]
    return min(found)


def test_a_programme_clear_of_an_object_keeps_every_link_off_it(robot: RobotModel, path: Reference) -> None:
    static = check_programme(robot, path, [box((0.45, 0.0, -0.2), (0.3, 0.3, 0.05))], 0.02, path.q0)
    np.testing.assert_allclose(static.keep_m[:, 0], link_radii(robot) + 0.02)
    assert static.held_off.all()
    assert static.names == ("crate",)


@pytest.mark.parametrize("top_m", [0.17, 0.21, 0.26])
def test_a_programme_through_an_object_is_refused_and_told_where(
    robot: RobotModel, path: Reference, top_m: float
) -> None:
    hull = box((0.45, 0.0, top_m - 0.05), (0.04, 0.04, 0.05))
    least, at_s = least_m(robot, path, 4, hull)
    assert least < link_radii(robot)[4]
    with pytest.raises(SettingsError) as refused:
        check_programme(robot, path, [hull], 0.0, path.q0)
    text = str(refused.value)
    for word in ("crate", "tool", "may_approach", "programme_may_touch"):
        assert word in text
    told_mm, told_s = (
        float(text.partition("brings tool ")[2].partition(word)[0].split()[-1]) for word in (" mm inside", " s of it")
    )
    assert told_mm == pytest.approx(1e3 * (link_radii(robot)[4] - least), abs=2.0)
    assert told_s == pytest.approx(at_s, abs=0.25) or least == 0.0
    notes = check_programme(robot, path, [hull._replace(programme_may_touch=True)], 0.0, path.q0).notes
    assert any("crate" in note and "tool" in note and "mm inside it" in note for note in notes)


def test_a_touch_between_two_rows_of_a_fast_programme_is_found(robot: RobotModel) -> None:
    """A thin sheet across the way of a fast tool: no row of the programme need lie in it."""
    waypoints = [{"joints_deg": [-40, 20, -10, 0, 60, 0]}, {"joints_deg": [40, 20, -10, 0, 60, 0]}]
    path = plan_programme(
        parse_task({"waypoints": waypoints, "speed": 1.0, "tcp_speed_m_per_s": 3.0, "tcp_acceleration_m_per_s2": 50.0}),
        robot,
    )
    tip = robot.pose(path.sample(0.5 * path.duration_s).q, np.zeros(6)).T_world_tcp[:3, 3]
    for shift in np.linspace(0.0, 0.004, 9):
        speck = StaticHull("speck", (tip + np.array([0.044, shift, 0.0]))[None], 0.0)
        with pytest.raises(SettingsError, match="speck"):
            check_programme(robot, path, [speck], 0.0, path.q0)


def test_a_robot_that_begins_inside_is_refused_even_if_its_programme_may_touch(
    robot: RobotModel, path: Reference
) -> None:
    hull = box((0.45, -0.25, 0.33), (0.05, 0.05, 0.05), programme_may_touch=True)
    with pytest.raises(SettingsError, match=r"object crate: (?:wrist|tool) begins"):
        check_programme(robot, path, [hull], 0.0, path.q0)


def test_a_link_that_may_approach_does_so_as_far_as_the_programme_needs(robot: RobotModel, path: Reference) -> None:
    hull = box((0.45, 0.0, 0.12), (0.2, 0.2, 0.05), may_approach=("tool",))  # its top is 30 mm below the lowest place
    static = check_programme(robot, path, [hull], 0.0, path.q0)
    least, _ = least_m(robot, path, 4, hull)
    assert least == pytest.approx(0.03, abs=1e-3)
    assert static.keep_m[4, 0] == pytest.approx(least - SPARE_M, abs=1.5e-3)
    np.testing.assert_allclose(static.keep_m[:4, 0], link_radii(robot)[:4])
    assert static.held_off[:, 0].tolist() == [True, True, True, True, False]
    deep = box((0.45, 0.0, 0.17), (0.2, 0.02, 0.05), may_approach=("tool",))
    static = check_programme(robot, path, [deep], 0.0, path.q0)
    assert static.keep_m[4, 0] == UNCHECKED
    assert any("its axis into it" in note for note in static.notes)


def test_a_link_that_stands_on_an_object_is_not_checked_and_that_is_told(robot: RobotModel, path: Reference) -> None:
    plinth = box((0.0, 0.0, 0.09), (0.2, 0.2, 0.09))  # reaches up into the shoulder's capsule
    static = check_programme(robot, path, [plinth], 0.0, path.q0)
    assert static.keep_m[0, 0] == UNCHECKED
    assert np.isfinite(static.keep_m[1:, 0]).all()
    assert any("shoulder" in note and "stand on it" in note for note in static.notes)
    wall = box((-0.18, 0.28, 0.35), (0.05, 0.05, 0.05), programme_may_touch=True)  # beside it: not at every angle
    with pytest.raises(SettingsError, match="shoulder begins"):
        check_programme(robot, path, [wall], 0.0, np.array([2.2, *path.q0[1:]]))


def test_a_link_that_the_robot_does_not_have_is_named(robot: RobotModel, path: Reference) -> None:
    hull = box((0.45, 0.0, -0.2), (0.1, 0.1, 0.1), may_approach=("gripper",))
    with pytest.raises(SettingsError) as refused:
        check_programme(robot, path, [hull], 0.0, path.q0)
    for word in ("gripper", "shoulder", "upper_arm", "forearm", "wrist", "tool"):
        assert word in str(refused.value)


def _overlap(ends: Floats, one: int, two: int, radius: Floats) -> bool:
    share = np.linspace(0.0, 1.0, 60)[:, None]
    a, b = (ends[i, 0] + share * (ends[i, 1] - ends[i, 0]) for i in (one, two))
    return bool(np.linalg.norm(a[:, None] - b[None], axis=2).min() < radius[[one, two]].sum())


def test_links_are_kept_apart_unless_they_are_neighbours_or_always_overlap(robot: RobotModel, path: Reference) -> None:
    static = check_programme(robot, path, [], 0.0, path.q0)
    assert static.pairs.tolist() == PAIRS.tolist()
    rng, radius = np.random.default_rng(1), link_radii(robot)
    postures = [robot.ends_m(rng.uniform(robot.q_min, robot.q_max)) for _ in range(300)]
    for one, two in ((2, 3), (2, 4)):
        assert all(_overlap(ends, one, two, radius) for ends in postures)
        assert any(robot.segments[one].name in note and robot.segments[two].name in note for note in static.notes)
    for one, two in PAIRS.tolist():
        assert not all(_overlap(ends, one, two, radius) for ends in postures)


def test_a_disabled_pair_is_not_kept_apart_by_the_names_of_its_links_or_bodies(
    robot: RobotModel, path: Reference
) -> None:
    for disabled in (frozenset(("link_1", "link_3")), frozenset(("shoulder", "forearm"))):
        static = check_programme(robot, path, [], 0.0, path.q0, [disabled])
        assert static.pairs.tolist() == [pair for pair in PAIRS.tolist() if pair != [0, 2]]


def test_two_links_that_the_programme_brings_together_keep_what_it_needs(robot: RobotModel) -> None:
    waypoints = [{"joints_deg": [0, 0, 0, 0, 60, 0]}, {"joints_deg": [0, -60, 30, 0, 60, 0]}]
    path = plan_programme(parse_task({"waypoints": waypoints}), robot)
    static = check_programme(robot, path, [], 0.0, path.q0)
    at = static.pairs.tolist().index([0, 2])
    ends = robot.ends_m(path.q[-1])
    share = np.linspace(0.0, 1.0, 400)[:, None]
    a, b = (ends[i, 0] + share * (ends[i, 1] - ends[i, 0]) for i in (0, 2))
    least = float(np.linalg.norm(a[:, None] - b[None], axis=2).min())
    assert least < link_radii(robot)[[0, 2]].sum()
    assert static.pair_keep_m[at] == pytest.approx(least - SPARE_M, abs=2e-3)
    assert any("shoulder" in note and "forearm" in note for note in static.notes)
