"""Certified motions against a brute force that shares nothing with the certificate."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import nnls

from hrcreplay.records import Floats
from hrcreplay.robot.control import certificate
from hrcreplay.robot.control.certificate import NO_PLANES, clear, separating_normal
from hrcreplay.robot.control.control_step import RobotState, observe
from hrcreplay.robot.control.motion_check import CLEAR, OPEN, REFUSED, check
from hrcreplay.robot.control.separation import rows_of_people, worst_rows
from hrcreplay.robot.control.stops import Stop, at_rest, stop_axis_by_axis, stop_straight
from hrcreplay.robot.model import RobotModel, irb140
from tests.tools.random_stops import DT_S, TOOL_M, Box, as_obstacles, deepest_m, link_points, random_step, run

#: STOP.md's case: joint velocities at which the stop (67) was found to enter deepest [rad/s].
FAST = np.radians([200.0, -34.0, -50.0, -360.0, -360.0, 450.0])


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return irb140(np.eye(4), stop_s=0.377, tool_m=TOOL_M)


def test_no_certified_stop_ever_enters() -> None:
    found = run(20_000, seed=7)
    assert found.entered == 0, found
    assert found.deepest_m > -0.002, "stops near the volumes are among them"
    assert found.refused_in_vain < 0.1 * (found.certified + found.refused), "nor does it refuse what is clear"


def _ball(centre_m: Floats, radius_m: float = 0.05) -> Box:
    return Box(centre_m, np.eye(3), np.zeros(3), radius_m)


def test_the_stop_that_the_rows_allow_and_that_enters_is_refused(robot: RobotModel) -> None:
    """Every row of (2) holds with 30 mm between wrist and ball, and the stop (67) ends nearly 5 cm inside it."""
    q = np.array([-0.54, -0.349, -1.529, -1.409, 2.005, 1.335])  # the worst that a search of a minute found
    stop = stop_axis_by_axis(q, FAST, robot.ddq_max, DT_S)
    start, velocities = link_points(q[None])[0, 3], robot.pose(q, FAST).J_ends[3] @ FAST
    along = velocities[1] / np.linalg.norm(velocities[1])
    way = link_points(stop.q[-1:])[0, 3, -1] - start[-1]
    aside = way - (way @ along) * along  # the wrist does not move there at first
    aside /= np.linalg.norm(aside)
    aside = np.cos(0.085) * aside + np.sin(0.085) * np.cross(along, aside)
    ball = _ball(start[-1] + aside * (0.077 + 0.05 + 0.03))
    seen = as_obstacles([ball])
    sight = observe(robot, RobotState(q, FAST), seen, 0.0)
    assert sight.pairs is not None
    assert sight.distance_m == pytest.approx(0.03, abs=1e-3)
    rows = rows_of_people(sight.pose, seen, sight.pairs, sight.pairs.constraint_rhs_m2("square"), 0.377)
    assert not len(worst_rows(rows, FAST, 0.0)[0]), "all rows hold"
    assert np.all(np.abs(FAST) <= robot.dq_max)
    going = Stop(q[None], FAST[None], np.full((1, 2), np.nan))
    assert deepest_m(going, stop, [ball]) > 0.045
    assert clear(robot, going, stop, seen, 0.0, DT_S, NO_PLANES)[0] == REFUSED
    together = stop_straight(q, FAST, robot.ddq_max, DT_S)
    entered = deepest_m(going, together, [ball])
    assert (clear(robot, going, together, seen, 0.0, DT_S, NO_PLANES)[0] == CLEAR) <= (entered <= 0.0)


def test_a_robot_at_rest_is_certified_outside_and_refused_inside(robot: RobotModel) -> None:
    q = np.array([0.1, 0.2, -0.3, 0.0, 0.8, 0.0])
    tip = link_points(q[None])[0, 4, -1]
    for gap_m, expected in ((1e-6, True), (-1e-6, False)):
        seen = as_obstacles([_ball(tip + np.array([0.0, 0.0, -(0.045 + 0.05 + gap_m)]))])
        below = clear(robot, at_rest(q), at_rest(q), seen, 0.0, DT_S, NO_PLANES)[0]
        nearest = deepest_m(at_rest(q), at_rest(q), [_ball(tip + np.array([0.0, 0.0, -(0.095 + gap_m)]))])
        assert below == (nearest < 0.0)
        if nearest == pytest.approx(-gap_m, abs=1e-9):
            assert below == expected
        assert not clear(robot, at_rest(q), at_rest(q), seen, 0.05, DT_S, NO_PLANES)[0], "nor with more clearance"


def test_what_is_not_known_or_not_finite_is_refused(robot: RobotModel) -> None:

    q, far = np.zeros(6), as_obstacles([_ball(np.array([5.0, 5.0, 5.0]))])
    assert clear(robot, at_rest(q), at_rest(q), far, 0.0, DT_S, NO_PLANES)[0]
    assert not clear(robot, at_rest(q), at_rest(q), far._replace(known=False), 0.0, DT_S, NO_PLANES)[0]
    assert not clear(robot, at_rest(q), at_rest(np.full(6, np.nan)), far, 0.0, DT_S, NO_PLANES)[0]
    beyond = np.where(np.arange(6) == 2, robot.q_max + 1e-6, 0.0)
    assert not clear(robot, at_rest(q), at_rest(beyond), far, 0.0, DT_S, NO_PLANES)[0]
    _, planes = clear(robot, at_rest(q), at_rest(q), far, 0.0, DT_S, NO_PLANES)
    for vertex in range(len(far.vertices_m)):
        spoiled = far.vertices_m.copy()
        spoiled[vertex, 0] = np.nan
        for known in (NO_PLANES, planes, np.full_like(planes, 3**-0.5)):
            hidden = far._replace(vertices_m=spoiled)
            assert not clear(robot, at_rest(q), at_rest(q), hidden, 0.0, DT_S, known)[0], vertex


def unsearched(*given: Any) -> Any:
    """The check as if the search for planes had found none: every pair is left to coal."""
    done, course, planes, people, beside = check(*given)
    links, limbs = planes.shape[:2]
    every = np.array([(link, limb) for link in range(links) for limb in range(limbs)])
    people = people._replace(pairs=every, results=np.full(len(every), OPEN))
    return done, course, np.zeros_like(planes), people, beside


def test_coal_finds_the_planes_that_the_search_does_not(robot: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, verdicts, calls = np.random.default_rng(9), [], [0]
    really = certificate.separating_normal

    def counted(*given: Any) -> Any:
        calls[0] += 1
        return really(*given)

    monkeypatch.setattr(certificate, "separating_normal", counted)
    for _ in range(150):
        going, stop = random_step(rng, robot, together=bool(rng.integers(2)))
        near = as_obstacles([_ball(link_points(stop.q[-1:])[0, 3, -1] + rng.normal(size=3) * 0.15)])
        monkeypatch.setattr(certificate, "check", check)
        calls[0] = 0
        searched = clear(robot, going, stop, near, 0.0, DT_S, NO_PLANES)[0]
        assert calls[0] == 0, "what the search proves or refutes needs no coal"
        monkeypatch.setattr(certificate, "check", unsearched)
        verdicts.append((searched, clear(robot, going, stop, near, 0.0, DT_S, NO_PLANES)[0]))
    found, by_coal = np.array(verdicts).T
    assert np.mean(found == by_coal) > 0.97, "they differ only where a stop is hardly clear"
    assert 0.2 < np.mean(found == CLEAR) < 0.9


@pytest.mark.parametrize("error", [RuntimeError, ValueError])
def test_where_coal_fails_the_motion_is_refused(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    q = np.array([0.3, 0.5, -0.4, 0.5, 0.8, 0.0])
    forearm = link_points(q[None])[0, 2]
    across = np.cross(forearm[-1] - forearm[0], [0.0, 1.0, 0.0])
    beside = forearm.mean(axis=0) + across / np.linalg.norm(across) * (0.118 + 0.05 + 0.001)
    near = as_obstacles([_ball(beside)])  # too near for the boxes around them to tell
    assert clear(robot, at_rest(q), at_rest(q), near, 0.0, DT_S, NO_PLANES)[0]

    def fails(*_: object) -> None:
        raise error("GJK did not converge")

    monkeypatch.setattr(certificate, "_gjk", fails)
    assert clear(robot, at_rest(q), at_rest(q), near, 0.0, DT_S, NO_PLANES)[0], "the search needs no coal"
    monkeypatch.setattr(certificate, "check", unsearched)
    assert not clear(robot, at_rest(q), at_rest(q), near, 0.0, DT_S, NO_PLANES)[0]


def test_the_verdict_does_not_depend_on_planes_that_are_wrong(robot: RobotModel) -> None:
    rng = np.random.default_rng(5)
    q = np.array([0.1, 0.2, -0.3, 0.0, 0.8, 0.0])
    box = Box(link_points(q[None])[0, 4, -1] + np.array([0.3, 0.0, 0.0]), np.eye(3), np.full(3, 0.05), 0.05)
    wrong = rng.normal(size=(5, 1, 3))
    wrong /= np.linalg.norm(wrong, axis=2, keepdims=True)
    given = wrong.copy()
    for planes in (NO_PLANES, wrong, np.zeros((5, 1, 3))):
        ok, kept = clear(robot, at_rest(q), at_rest(q), as_obstacles([box]), 0.0, DT_S, planes)
        assert ok
        assert kept.shape == (5, 1, 3)
    np.testing.assert_array_equal(wrong, given)


def test_the_separating_normal_is_that_of_least_squares() -> None:
    rng = np.random.default_rng(6)
    for _ in range(300):
        points = rng.normal(size=(int(rng.integers(1, 60)), 3)) * rng.uniform(0.0, 0.3, 3)
        a, b = rng.normal(size=(2, 3)) * 0.5
        differences = np.concatenate([points - a, points - b])
        weights, _ = nnls(np.vstack([differences.T, np.full(len(differences), 1e3)]), np.array([0, 0, 0, 1e3]))
        expected = float(np.linalg.norm(weights / weights.sum() @ differences))
        normal = separating_normal(a, b, points)
        if expected < 1e-3:
            continue
        assert normal is not None
        gap = (points @ normal).min() - max(a @ normal, b @ normal)
        assert expected - 2e-3 <= gap <= expected + 1e-6


def test_a_stop_that_ends_a_little_inside_is_refused(robot: RobotModel) -> None:
    """The tip ends in the ball by up to 8 mm, or short of it by as much."""
    rng, short_of, inside = np.random.default_rng(6), [], 0
    for _ in range(400):
        going, stop = random_step(rng, robot, together=bool(rng.integers(2)))
        tips = link_points(np.vstack((going.q[:1], stop.q)))[:, 4, -1]
        ahead = tips[-1] - tips[0]
        if not stop.ticks or np.linalg.norm(ahead) < 0.01:
            continue
        depth = rng.choice([-0.008, -0.003, 0.001, 0.003, 0.008])
        ball = _ball(tips[-1] + ahead / np.linalg.norm(ahead) * (0.045 + 0.05 - depth))
        deepest = deepest_m(going, stop, [ball])
        verdict = clear(robot, going, stop, as_obstacles([ball]), 0.0, DT_S, NO_PLANES)[0]
        if deepest > 0.0:
            inside += 1
            assert verdict == REFUSED
        elif deepest < -0.002:
            short_of.append(verdict == CLEAR)
    assert inside > 100
    assert np.mean(short_of) > 0.7


def test_a_leap_is_refused_however_clear_the_way(robot: RobotModel) -> None:
    q, far = np.array([0.1, 0.2, -0.3, 0.0, 0.8, 0.0]), as_obstacles([_ball(np.array([5.0, 5.0, 5.0]))])
    there = q + np.array([0.0, 0.001, 0.0, 0.0, 0.0, 0.0])
    assert clear(robot, at_rest(q), at_rest(there), far, 0.0, DT_S, NO_PLANES)[0] == REFUSED
    dq = np.array([0.0, 0.5 * DT_S * robot.ddq_max[1], 0.0, 0.0, 0.0, 0.0])
    further = stop_straight(q + 3.0 * DT_S * dq, dq, robot.ddq_max, DT_S)
    assert clear(robot, at_rest(q), further, far, 0.0, DT_S, NO_PLANES)[0] == REFUSED
    dq = np.array([0.0, 1.2 * DT_S * robot.ddq_max[1], 0.0, 0.0, 0.0, 0.0])
    sudden = stop_straight(q + 0.5 * DT_S * dq, dq, robot.ddq_max, DT_S)
    assert clear(robot, at_rest(q), sudden, far, 0.0, DT_S, NO_PLANES)[0] == REFUSED
    slow = stop_straight(q + 0.5 * DT_S * dq / 1.2, dq / 1.2, robot.ddq_max, DT_S)
    assert clear(robot, at_rest(q), slow, far, 0.0, DT_S, NO_PLANES)[0] == CLEAR
