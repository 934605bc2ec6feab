from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from hrcreplay.errors import SettingsError
from hrcreplay.human.model import LimitSet
from hrcreplay.human.prediction.swept_volumes import PRINTED
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, JOINTS, Floats
from tests.facts import facts
from tests.human.people import random_states, states
from tests.human.predictions import reachable

T = 0.377
PAPER = load_limits("paper")
HANGING = np.array([0.0] * 7 + [np.pi] + [0.0] * 3 + [np.pi, 0.94])


def one(p: Floats, v: Floats, limits: LimitSet = PAPER, method: str = "paper") -> tuple[Floats, Floats]:
    reach = reachable(states(p[None], v[None]), limits, T, method)
    return reach.low[0], reach.high[0]


def posture(**joints: float) -> Floats:
    p = HANGING.copy()
    for name, value in joints.items():
        p[JOINTS.index(name)] = value
    return p


def velocity(**joints: float) -> Floats:
    v = np.zeros(DOF)
    for name, value in joints.items():
        v[JOINTS.index(name)] = value
    return v


def bang(p: float, v: float, v_bound: float, a_bound: float, steps: int = 200_000) -> float:
    """Alg. 1 by small steps: accelerates at its bound, holds its velocity bound."""
    dt = T / steps
    speeds = v + a_bound * dt * (np.arange(steps) + 0.5)
    speeds = np.minimum(speeds, v_bound) if a_bound > 0 else np.maximum(speeds, v_bound)
    return p + float(speeds.sum()) * dt


@pytest.mark.parametrize("name", ["rho", "ar1", "al4"])
@pytest.mark.parametrize("share", [-1.0, -0.9, -0.2, 0.0, 0.5, 0.95, 1.0])
def test_alg_1_is_where_a_simulated_joint_gets(name: str, share: float) -> None:
    free = dataclasses.replace(PAPER, p_min=np.full(DOF, -99.0), p_max=np.full(DOF, 99.0), coupled=False)
    j = JOINTS.index(name)
    p, v = posture(**{name: 0.4}), velocity(**{name: share * PAPER.v_max[j]})
    low, high = one(p, v, free)
    assert high[j] == pytest.approx(max(p[j], bang(p[j], v[j], PAPER.v_max[j], PAPER.a_max[j])), abs=1e-6)
    assert low[j] == pytest.approx(min(p[j], bang(p[j], v[j], PAPER.v_min[j], PAPER.a_min[j])), abs=1e-6)


def test_an_estimate_over_its_velocity_bound_is_taken_at_the_bound() -> None:
    j = JOINTS.index("rho")
    low, high = one(posture(rho=0.2), velocity(rho=PAPER.v_max[j] + 0.1))
    braking = 0.2 + (PAPER.v_max[j] + 0.1) * T + 0.5 * PAPER.a_min[j] * T**2  # farther than the bound allows
    assert high[j] == pytest.approx(max(0.2 + PAPER.v_max[j] * T, braking))
    assert low[j] == 0.2


def test_angles_stay_in_their_limits_but_hold_the_current_posture() -> None:
    rho, ar1 = JOINTS.index("rho"), JOINTS.index("ar1")
    low, high = one(posture(rho=PAPER.p_max[rho] - 0.01, ar1=PAPER.p_min[ar1] - 0.3), velocity(rho=0.3))
    assert high[rho] == PAPER.p_max[rho]
    assert low[ar1] == PAPER.p_min[ar1] - 0.3
    assert high[ar1] == pytest.approx(PAPER.p_min[ar1])


def test_coupled_limits_are_the_widest_over_the_interval() -> None:
    wild = velocity(ar1=1.5, ar2=1.2, ar3=1.5, al1=-1.5, al2=-1.4, al3=-1.5)
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(200):
        p = HANGING.copy()
        for a in (4, 8):
            p[a], p[a + 1] = rng.uniform(-0.1, 2.7), rng.uniform(-0.6, 2.3)
            p[a + 2] = rng.uniform(-0.3, 0.3)
        low, high = one(p, wild)
        for a in (4, 8):
            a1 = np.degrees(np.linspace(low[a], high[a], 60))
            a2 = np.degrees(np.linspace(low[a + 1], high[a + 1], 60))
            x, y = np.meshgrid(a1, a2)
            top_2, top_3 = (153 - a1 / 6).max(), (60 + 4 * x / 9 - 5 * y / 9 + 5 * x * y / 810).max()
            bottom_2, bottom_3 = (-43 + a1 / 3).min(), (-90 + 7 * x / 9 - y / 9 + 2 * x * y / 810).min()
            for j, bottom, top in ((a + 1, bottom_2, top_2), (a + 2, bottom_3, top_3)):
                inside = bottom < np.degrees(p[j]) < top
                assert not inside or (np.degrees(high[j]) <= top + 1e-9 and np.degrees(low[j]) >= bottom - 1e-9)
                held += inside and np.isclose(np.degrees(high[j]), top)
    assert held > 20  # the coupling was what held them


def test_walking_straight_ahead_by_hand() -> None:
    low, high = one(posture(), velocity(x=0.5, theta=0.3))
    assert (low[0], high[0]) == pytest.approx((0.0, (0.5 + 0.1 * T) * T))
    assert (low[1], high[1]) == pytest.approx((-0.1 * T * T, 0.1 * T * T))
    assert (low[2], high[2]) == pytest.approx((0.0, (0.3 + np.pi / 8 * T) * T))  # beta = omega T_s; the pose stays in


def test_top_speed_and_the_other_headings() -> None:
    low, high = one(posture(theta=np.pi / 2), velocity(y=0.79))
    assert (low[1], high[1]) == pytest.approx((0.0, 0.8 * T))
    assert (low[0], high[0]) == pytest.approx((-0.1 * T * T, 0.1 * T * T))
    low, high = one(posture(theta=np.pi), velocity(x=-0.6, y=0.7))
    assert (low[0], high[0]) == pytest.approx((-(0.6 + 0.1 * T) * T, 0.0))
    assert (low[1], high[1]) == pytest.approx((0.0, (0.7 + 0.1 * T) * T))


def test_every_straight_walk_is_in_the_box() -> None:
    rng = np.random.default_rng(3)
    people = random_states(PAPER, 200, 3)
    reach = reachable(people, PAPER, T, "paper")
    for i in range(len(people)):
        c, s = np.cos(people.p[i, 2]), np.sin(people.p[i, 2])
        forward = c * people.v[i, 0] + s * people.v[i, 1]
        left = -s * people.v[i, 0] + c * people.v[i, 1]
        v = rng.uniform(0, min(0.8, forward + 0.1 * T), 50)
        v_perp = rng.uniform(max(-0.8, left - 0.1 * T), min(0.8, left + 0.1 * T), 50)
        ends = people.p[i, :2] + T * np.column_stack([c * v - s * v_perp, s * v + c * v_perp])
        assert (ends >= reach.low[i, :2] - 1e-12).all()
        assert (ends <= reach.high[i, :2] + 1e-12).all()


def test_positions_is_the_velocity_bounds_alone() -> None:
    low, high = one(posture(rho=0.3), velocity(x=0.5, rho=0.1), method="positions")
    j = JOINTS.index("rho")
    assert (low[j], high[j]) == pytest.approx((0.3 - np.pi / 10 * T, 0.3 + np.pi / 10 * T))
    assert (low[0], high[0], low[1], high[1]) == pytest.approx((0.0, 0.8 * T, -0.8 * T, 0.8 * T))


@pytest.mark.parametrize("limits", [PAPER, load_limits("human")], ids=lambda limits: limits.name)
def test_positions_holds_paper_and_both_hold_the_posture(limits: LimitSet) -> None:
    people = random_states(limits, 500, 5)
    paper, positions = (reachable(people, limits, T, method) for method in PRINTED)
    assert (positions.low <= paper.low + 1e-12).all()
    assert (positions.high >= paper.high - 1e-12).all()
    assert (paper.low <= people.p).all()
    assert (paper.high >= people.p).all()


def test_what_is_missing_stays_missing() -> None:
    p, v = np.tile(HANGING, (3, 1)), np.zeros((3, DOF))
    p[0, JOINTS.index("theta")] = np.nan
    v[1, JOINTS.index("ar4")] = np.nan
    p[2, JOINTS.index("al1")] = np.nan
    reach = reachable(states(p, v), PAPER, T, "paper")
    missing = [[JOINTS[j] for j in np.flatnonzero(np.isnan(row))] for row in reach.low]
    assert missing[0] == ["x", "y", "theta"]
    assert missing[1] == ["ar4"]
    assert missing[2][0] == "al1"
    assert set(missing[2]) <= {"al1", "al2", "al3"}
    assert (np.isnan(reach.low) == np.isnan(reach.high)).all()


def test_one_row_has_the_bits_of_many() -> None:
    people = random_states(PAPER, 64, 7)
    whole = reachable(people, PAPER, T, "paper")
    for i in range(len(people)):
        alone = reachable(people.rows(slice(i, i + 1)), PAPER, T, "paper")
        assert alone.low.tobytes() == whole.low[i].tobytes()
        assert alone.high.tobytes() == whole.high[i].tobytes()


def test_an_unknown_method_is_named() -> None:
    with pytest.raises(SettingsError, match=facts("prediction.method", "'guess'", "paper", "positions")):
        one(HANGING, np.zeros(DOF), method="guess")
