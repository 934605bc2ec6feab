from __future__ import annotations

import daqp
import numpy as np
import pytest

from hrcreplay.records import Floats
from tests.geometry.quadratic import active_set, minimiser


def random_problem(rng: np.random.Generator, rows: int, flat: float) -> tuple[Floats, Floats, Floats, Floats]:
    J = rng.normal(size=(6, 6)) * np.array([1, 1, 1, 1, 1, flat])
    A = rng.normal(size=(rows, 6))
    return J.T @ J + 1e-6 * np.eye(6), -J.T @ rng.normal(size=6), A, rng.normal(size=rows) * 0.3 + 0.2


def optimal(H: Floats, g: Floats, A: Floats, high: Floats, w: Floats, z: Floats) -> bool:
    """The conditions of Karush, Kuhn and Tucker: sufficient for a convex problem."""
    lacking = high - A @ w
    return bool(
        np.abs(H @ w + g + A.T @ z).max() < 1e-9
        and z.min() >= 0.0
        and lacking.min() > -1e-10
        and np.abs(z * lacking).max() < 1e-8
    )


@pytest.mark.parametrize("flat", [1.0, 1e-2, 0.0])
def test_solutions_are_optimal_and_denied_only_where_daqp_denies_them(flat: float) -> None:
    rng = np.random.default_rng(1)
    denied = 0
    for _ in range(300):
        H, g, A, high = random_problem(rng, int(rng.integers(1, 40)), flat)
        w, z = active_set(H, g, A, high)
        feasible = daqp.solve(H, g, A, high, np.full(len(high), -1e30), primal_tol=1e-11)[2] == 1
        assert np.isfinite(w).all() == feasible
        if feasible:
            assert optimal(H, g, A, high, w, z)
        denied += not feasible
    assert denied > 20


def test_rows_that_leave_no_room_hold_exactly() -> None:
    """A cone with its tip at 0 and no inside, as in contact: many rows, most of them redundant."""
    rng = np.random.default_rng(2)
    for _ in range(200):
        H, g, _, _ = random_problem(rng, 1, 1.0)
        span = rng.normal(size=(5, 6)) * np.array([1, 1, 1, 1, 1, 0])
        A = rng.normal(size=(40, 5)) @ span
        A = np.concatenate([A, -A[:10]])
        w, z = active_set(H, g, A, np.zeros(50))
        assert optimal(H, g, A, np.zeros(50), w, z)
        np.testing.assert_allclose(w[:5], 0.0, atol=1e-11)
        assert w[5] == pytest.approx(-(g[5] + H[5, :5] @ w[:5]) / H[5, 5], rel=1e-6)


def test_repeated_zero_and_unbounded_rows_are_harmless() -> None:
    H, g = np.eye(2), np.array([-2.0, -1.0])
    A = np.array([[1.0, 0], [1, 0], [2, 0], [0, 0], [0, 1]])
    high = np.array([0.5, 0.5, 1.0, 0.0, np.inf])
    w, z = active_set(H, g, A, high)
    np.testing.assert_allclose(w, [0.5, 1.0])
    assert np.all(z[[3, 4]] == 0.0)


def test_without_broken_rows_it_is_the_free_minimiser() -> None:
    rng = np.random.default_rng(3)
    H, g, A, _ = random_problem(rng, 5, 1.0)
    w, z = active_set(H, g, A, np.full(5, 1e3))
    np.testing.assert_array_equal(w, minimiser(H, g))
    np.testing.assert_allclose(H @ w, -g, atol=1e-12)
    assert np.all(z == 0.0)


def test_a_matrix_that_is_not_positive_definite_gives_no_number() -> None:
    assert np.isnan(minimiser(np.diag([1.0, -1.0]), np.ones(2))).any()
