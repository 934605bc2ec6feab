"""Bounds fitted to motions whose bounds are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.audit import fit_limits
from hrcreplay.audit.fit_limits import Futures
from hrcreplay.errors import LogError
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, Floats, HumanStates, Ints
from tests.human.people import random_states, states
from tests.human.predictions import reachable

PAPER, HUMAN = load_limits("paper"), load_limits("human")
T_S, STEP_S = 0.377, 0.004
#: Joint -> velocity and acceleration bounds downward and upward; all others rest.
KNOWN = {3: (-1.0, 1.5, -4.0, 3.0), 4: (-2.0, 2.0, -6.0, 6.0), 7: (-3.0, 2.5, -8.0, 10.0), 9: (-1.2, 1.2, -3.0, 5.0)}


def bang_bang(seconds: float, seed: int) -> HumanStates:
    """A person whose joints are always pushed to a bound, for random spans, about a posture."""
    rng = np.random.default_rng(seed)
    n = round(seconds / STEP_S)
    p, v = np.zeros((n, DOF)), np.zeros((n, DOF))
    p[:] = (PAPER.p_min.clip(-1.0) + PAPER.p_max.clip(None, 1.0)) / 2.0
    for j, (v_min, v_max, a_min, a_max) in KNOWN.items():
        push, until = 0.0, 0
        for k in range(1, n):
            if k >= until:
                push, until = float(rng.choice([a_min, 0.0, a_max])), k + int(rng.integers(20, 200))
            if abs(p[k - 1, j] - p[0, j]) > 0.6:  # turn round
                push = a_min if p[k - 1, j] > p[0, j] else a_max
            v[k, j] = min(max(v[k - 1, j] + push * STEP_S, v_min), v_max)
            p[k, j] = p[k - 1, j] + 0.5 * (v[k - 1, j] + v[k, j]) * STEP_S
    return states(p, v)


def seen(person: HumanStates, every: int = 10) -> Futures:
    ticks = np.arange(0, len(person), every)
    return fit_limits.futures(person, ticks, person.t_ns, person.p, horizon_s=T_S, memory_s=0.5)


@pytest.fixture(scope="module")
def training() -> Futures:
    return seen(bang_bang(240.0, seed=1))


def test_known_bounds_are_found_and_hold_on_a_motion_that_was_not_used(training: Futures) -> None:
    found = fit_limits.fit(training, PAPER, 0.9999, T_S)
    for j, bounds in KNOWN.items():
        fitted = [found.v_min[j], found.v_max[j], found.a_min[j], found.a_max[j]]
        # trapezoids of the made motion against Alg. 1's parabolas, and the grid of velocity bounds
        np.testing.assert_allclose(fitted, bounds, rtol=0.12)
    held_back = fit_limits.inside_intervals(seen(bang_bang(120.0, seed=2)), found, T_S)
    share = np.nanmean(fit_limits.are_all_inside(held_back[:, list(KNOWN)]))
    assert share > 0.99


def test_joints_at_rest_keep_the_standard_bounds(training: Futures) -> None:
    found = fit_limits.fit(training, PAPER, 0.99, T_S)
    still = [j for j in range(DOF) if j not in KNOWN]
    assert found.kept.tolist() == [j in still for j in range(DOF)]
    for name in ("v_min", "v_max", "a_min", "a_max"):
        np.testing.assert_array_equal(getattr(found, name)[still], getattr(PAPER, name)[still])
    assert (found.excursions[still] == 0).all()


@pytest.mark.parametrize("share", [0.8, 0.9])
def test_the_share_is_reached_by_all_joints_together_and_hardly_exceeded(training: Futures, share: float) -> None:
    found = fit_limits.fit(training, PAPER, share, T_S)
    reached = np.nanmean(fit_limits.are_all_inside(fit_limits.inside_intervals(training, found, T_S)[:, ~found.kept]))
    assert share <= reached <= share + 0.3 * (1.0 - share)


def test_less_coverage_needs_shorter_intervals(training: Futures) -> None:
    def length(share: float) -> float:
        found = fit_limits.fit(training, PAPER, share, T_S)
        return float(fit_limits.largest_displacement(training.v, found.v_max, found.a_max, T_S)[:, list(KNOWN)].mean())

    assert length(0.8) < length(0.95) < length(0.999)


def test_no_pair_of_bounds_that_misses_no_tick_has_clearly_shorter_intervals(training: Futures) -> None:
    found = fit_limits.fit(training, PAPER, 0.9999, T_S)
    j = 4
    v, gone = training.v[:, j], training.up[:, j]
    v, gone = v[np.isfinite(gone)], gone[np.isfinite(gone)]
    fitted = fit_limits.largest_displacement(v[:, None], found.v_max[j : j + 1], found.a_max[j : j + 1], T_S).mean()
    shortest = np.inf
    for v_max in np.linspace(1.5, 5.0, 71):
        for a_max in np.geomspace(1.0, 100.0, 81):
            reach = fit_limits.largest_displacement(v[:, None], np.array([v_max]), np.array([a_max]), T_S)[:, 0]
            if (gone <= reach).all():
                shortest = min(shortest, float(reach.mean()))
    assert fitted <= 1.08 * shortest  # 5 % are spent on less acceleration, some on the grid


def test_a_glitch_is_given_up_rather_than_fitted(training: Futures) -> None:
    up = training.up.copy()
    up[700:705, 4] += 5.0
    glitch = replace(training, up=up)
    honest, found = (fit_limits.fit(some, PAPER, 0.998, T_S) for some in (training, glitch))
    assert found.v_max[4] < 1.2 * honest.v_max[4]
    assert (fit_limits.inside_intervals(glitch, found, T_S)[700:705, 4] == 0.0).all()


def test_farthest_is_alg_1() -> None:
    person = random_states(HUMAN, 500, seed=3)
    wide = replace(HUMAN, p_min=np.full(DOF, -1e9), p_max=np.full(DOF, 1e9))
    reach = reachable(person, wide, T_S, "paper")
    high = fit_limits.largest_displacement(person.v, HUMAN.v_max, HUMAN.a_max, T_S)
    low = -fit_limits.largest_displacement(-person.v, -HUMAN.v_min, -HUMAN.a_min, T_S)
    turning = slice(3, 12)
    np.testing.assert_allclose((reach.high - person.p)[:, turning], high[:, turning], atol=1e-12)
    np.testing.assert_allclose((reach.low - person.p)[:, turning], low[:, turning], atol=1e-12)


def test_x_and_y_are_those_of_the_body() -> None:
    t = np.arange(400) * STEP_S
    heading = np.radians(110.0)
    p, v = np.zeros((400, DOF)), np.zeros((400, DOF))
    p[:, 2], p[:, 7] = heading, 1.0
    p[:, 0], p[:, 1] = 0.8 * t * np.cos(heading), 0.8 * t * np.sin(heading)
    v[:, 0], v[:, 1] = 0.8 * np.cos(heading), 0.8 * np.sin(heading)
    found = seen(states(p, v))
    whole = np.isfinite(found.up).all(axis=1)
    assert whole.sum() > 20
    np.testing.assert_allclose(found.v[:, :2], [[0.8, 0.0]] * len(found), atol=1e-12)
    last = np.floor(T_S / STEP_S) * STEP_S
    np.testing.assert_allclose(found.up[whole][:, :2], [[0.8 * last, 0.0]] * whole.sum(), atol=1e-9)


def test_an_arm_that_changes_its_name_has_not_moved() -> None:
    person = states(np.tile([0, 0, 0, 0, 2.7, 0.4, 0.1, 2.0, 0, 0, 0, 2.0, 0.9], (200, 1)), np.zeros((200, DOF)))
    other = person.p.copy()
    other[:, 4:7] = other[:, 4:7] * [1, -1, 1] + [-np.pi, np.pi, np.pi]
    other[:, 2] += 2.0 * np.pi
    found = fit_limits.futures(person, np.arange(0, 100), person.t_ns, other, horizon_s=T_S, memory_s=0.5)
    np.testing.assert_allclose(found.up[:50], 0.0, atol=1e-9)


def test_what_is_not_recorded_to_the_end_is_not_counted() -> None:
    person = bang_bang(4.0, seed=4)
    found = seen(person, every=1)
    late = person.t_ns > person.t_ns[-1] - round(T_S * 1e9)
    assert np.isnan(found.up[late]).all()
    assert np.isfinite(found.up[~late]).all()


def test_what_no_camera_sees_says_nothing() -> None:
    person = bang_bang(4.0, seed=4)
    unseen_s = np.zeros((len(person), 6))
    unseen_s[100:, 3] = 1.0  # LRA: alpha_3, alpha_4 of the right arm
    found = seen(replace(person, unseen_s=unseen_s), every=1)
    assert np.isnan(found.up[100:, 6:8]).all()
    assert np.isfinite(found.up[100:800, [0, 5, 8]]).all()
    assert np.isfinite(found.up[:100]).all()


def test_no_arm_motion_is_refused() -> None:
    person = bang_bang(30.0, seed=6)
    p, v = person.p.copy(), person.v.copy()
    p[:, 4:], v[:, 4:] = p[0, 4:], 0.0
    with pytest.raises(LogError, match="no arm motion"):
        fit_limits.fit(seen(states(p, v)), PAPER, 0.99, T_S)


def test_postures_outside_the_positions_are_seen() -> None:
    inside = random_states(PAPER, 50, seed=7).p.copy()
    assert not fit_limits.outside_positions(inside, PAPER).any()
    inside[10, 3] = np.radians(-60.0)
    inside[20] = np.nan
    rows: Ints = np.flatnonzero(fit_limits.outside_positions(inside, PAPER))
    assert rows.tolist() == [10]


def test_together_counts_a_tick_where_any_joint_was_recorded() -> None:
    within: Floats = np.array([[1.0, 1.0], [1.0, np.nan], [0.0, np.nan], [np.nan, np.nan], [1.0, 0.0]])
    np.testing.assert_array_equal(fit_limits.are_all_inside(within), [1.0, 1.0, 0.0, np.nan, 0.0])
