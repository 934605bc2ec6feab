"""Speed limits of a robot that may touch people, pair by pair."""

from __future__ import annotations

import math

import numpy as np
from numpy.testing import assert_array_equal

from hrcreplay.records import Floats
from hrcreplay.robot.control.contact_speed import ContactSpeeds, end_speeds, largest_rate, pair_speeds, select
from hrcreplay.robot.control.separation import Obstacles, Separation, boxes, join_obstacles
from hrcreplay.robot.model import RobotModel, irb140


def volumes(rng: np.random.Generator, limbs: int, numbers: list[int] | None = None) -> Obstacles:
    counts = rng.integers(4, 9, limbs)
    offsets, vertices = np.concatenate([[0], np.cumsum(counts)]), rng.normal(size=(counts.sum(), 3))
    radius = rng.uniform(0.05, 0.1, limbs)
    around, known = boxes(vertices, offsets, radius)
    which = None if numbers is None else np.array(numbers)
    return Obstacles(vertices, offsets, radius, around, known, 0.1, numbers=which)


def test_each_volume_has_the_speed_of_its_limb_and_a_border_none() -> None:
    limbs = np.array([math.nan, 0.3, 0.5])
    of = ContactSpeeds(limbs, 2)
    rng = np.random.default_rng(0)
    assert_array_equal(of.speeds(volumes(rng, 3)), limbs)
    # limbs of person 1, two sides of a border, limbs of person 2, then of person 4 alone
    assert_array_equal(of.speeds(volumes(rng, 8, list(range(8)))), [*limbs, math.nan, math.nan, *limbs])
    assert_array_equal(of.speeds(volumes(rng, 3, [11, 12, 13])), limbs)
    assert_array_equal(of.speeds(volumes(rng, 2, [3, 4])), [math.nan, math.nan])


def test_a_link_is_as_fast_as_its_tightest_limb_allows() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        links, limbs, horizon_s = 4, 5, rng.uniform(0.01, 0.4)
        pairs = Separation(rng.uniform(0.0, 0.6, (links, limbs)), rng.uniform(0.1, 0.3, (links, limbs)))
        speeds = np.where(rng.random(limbs) < 0.3, math.nan, rng.uniform(0.1, 1.0, limbs))
        found = pair_speeds(pairs, speeds, horizon_s)
        for i in range(links):
            for k in range(limbs):
                gap_m = max(0.0, pairs.distance_m[i, k] - pairs.clearance_m[i, k])
                expected = math.inf if math.isnan(speeds[k]) else max(speeds[k], gap_m / horizon_s)
                assert found[i, k] == expected
                # a link with that speed touches the limb within the horizon at no more than its contact speed
                assert math.isnan(speeds[k]) or found[i, k] <= speeds[k] or found[i, k] * horizon_s <= gap_m + 1e-12


def moved(robot: RobotModel, q: Floats, dq: Floats) -> Floats:
    """(s,) speed of the faster end of each link by two poses a microsecond apart."""
    step_s = 1e-6
    way = robot.ends_m(q + step_s * dq) - robot.ends_m(q - step_s * dq)
    return np.asarray((np.linalg.norm(way, axis=2) / (2.0 * step_s)).max(axis=1))


def test_at_the_largest_rate_one_link_has_its_limit_and_none_is_faster() -> None:
    robot, rng = irb140(np.eye(4), stop_s=0.4), np.random.default_rng(2)
    for _ in range(50):
        q, towards = rng.uniform(-1.0, 1.0, 6), rng.uniform(-2.0, 2.0, 6)
        limits, pose = rng.uniform(0.05, 1.0, 5), robot.pose(q, towards)
        np.testing.assert_allclose(end_speeds(pose, towards), moved(robot, q, towards), rtol=1e-5, atol=1e-7)
        rate = largest_rate(pose, towards, limits)
        reached = moved(robot, q, rate * towards) / limits
        assert 1.0 - 1e-4 < reached.max() < 1.0 + 1e-4
    assert largest_rate(robot.pose(q, np.zeros(6)), np.zeros(6), limits) == math.inf
    for link in range(5):
        unknown = limits.copy()
        unknown[link] = math.nan
        assert math.isnan(largest_rate(pose, towards, unknown)), "no rate is known to be slow enough"


def test_some_volumes_are_those_volumes() -> None:
    rng = np.random.default_rng(3)
    both = join_obstacles([volumes(rng, 3), volumes(rng, 3)])
    kept = select(both, np.array([False, True, False, True, True, False]))
    assert [kept.among_all(k) for k in range(3)] == [1, 3, 4]
    for k, whole in enumerate((1, 3, 4)):
        mine = kept.vertices_m[kept.offsets[k] : kept.offsets[k + 1]]
        assert_array_equal(mine, both.vertices_m[both.offsets[whole] : both.offsets[whole + 1]])
        assert kept.radius_m[k] == both.radius_m[whole]
        assert_array_equal(kept.boxes_m[k], both.boxes_m[whole])
    assert len(select(both, np.zeros(6, dtype=np.bool_)).radius_m) == 0
