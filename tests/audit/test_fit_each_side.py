"""Bounds fitted to each side of a joint, against motions whose accelerations were drawn."""

from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.audit.fit_limits import Futures, fit_each_side, inside_intervals
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF

PAPER = load_limits("paper")
T_S, N = 0.4, 4000


def pushed(at_rest: tuple[int, ...] = ()) -> Futures:
    """Joints with velocities in +-2 and accelerations in -3 to 5, even; each keeps its acceleration for the horizon."""
    rng = np.random.default_rng(8)
    v, a = rng.uniform(-2.0, 2.0, (N, DOF)), rng.uniform(-3.0, 5.0, (N, DOF))
    t = np.linspace(0.0, T_S, 41)[1:, None, None]
    path = v * t + 0.5 * a * t**2
    low, high = path.min(axis=0), path.max(axis=0)
    for j in at_rest:
        v[:, j], low[:, j], high[:, j] = 0.0, 0.0, 0.0
    return Futures(np.arange(N) * 100_000_000, v, low, high)


def test_the_bounds_are_those_that_hold_the_share_of_each_side() -> None:
    found = fit_each_side(pushed(), PAPER, 0.9, T_S)
    assert not found.kept.any()
    assert (found.a_max < 5.0).all()
    assert (found.a_max > 3.0).all()
    within = inside_intervals(pushed(), found, T_S)
    assert within.mean(axis=0) == pytest.approx(0.8, abs=0.03)  # each side may miss a tenth


def test_velocities_are_as_fast_as_people_are_so_that_they_hold_nothing_back() -> None:
    found = fit_each_side(pushed(), PAPER, 0.9, T_S)
    assert (found.v_max >= 1.95).all()
    assert (found.v_max <= 2.0 + 5.0 * T_S / 2.0).all()
    assert (found.v_min <= -1.95).all()


def test_joints_at_rest_keep_the_standard_bounds() -> None:
    found = fit_each_side(pushed((3, 7)), PAPER, 0.9, T_S)
    assert np.flatnonzero(found.kept).tolist() == [3, 7]
    for name in ("v_min", "v_max", "a_min", "a_max"):
        assert getattr(found, name)[[3, 7]] == pytest.approx(getattr(PAPER, name)[[3, 7]])
