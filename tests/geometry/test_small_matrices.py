"""Kernels of small matrices against LAPACK and exact fractions, and that no processor's order of sums is in them."""

from __future__ import annotations

import os
import subprocess
import sys
from fractions import Fraction
from typing import Literal

import numpy as np
import pytest
from scipy.optimize import nnls

from hrcreplay.geometry import small_matrices as sm
from hrcreplay.records import Floats


def _random(seed: int, *shape: int) -> Floats:
    return np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("seed", range(5))
def test_products_are_sums_from_the_left(seed: int) -> None:
    A, B, x = _random(seed, 6, 7), _random(seed + 9, 7, 3), _random(seed + 99, 7)
    for i in range(6):
        total = 0.0
        for k in range(7):
            total += A[i, k] * x[k]
        assert sm.apply(A, x)[i] == total
        for j in range(3):
            assert sm.multiply(A, B)[i, j] == pytest.approx(
                float(sum(Fraction(float(A[i, k])) * Fraction(float(B[k, j])) for k in range(7))), abs=1e-14
            )
    assert np.array_equal(sm.multiply(A.T, A), sm.multiply(np.ascontiguousarray(A.T), A))


@pytest.mark.parametrize("n", [1, 2, 3, 6, 7])
def test_solutions(n: int) -> None:
    A, b = _random(n, n, n), _random(n + 50, n)
    A[0, 0] = 0.0 if n > 1 else 2.0  # without pivots there is no solution
    np.testing.assert_allclose(sm.solve(A, b), np.linalg.solve(A, b), rtol=1e-11)
    H = A @ A.T + np.eye(n)
    L = sm.cholesky(H)
    np.testing.assert_allclose(L, np.linalg.cholesky(H), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(sm.solve_transposed(L, sm.solve_lower(L, b)), np.linalg.solve(H, b), rtol=1e-10)


def test_what_has_no_solution_is_not_finite() -> None:
    assert not np.isfinite(sm.solve(np.ones((3, 3)), np.arange(3.0))).all()
    assert np.isnan(sm.cholesky(np.diag([1.0, -1.0]))).any()


@pytest.mark.parametrize("shape", [(6, 6), (6, 7), (7, 6), (6, 2), (3, 3), (40, 3), (2, 3), (1, 3)])
def test_singular_values(shape: tuple[int, int]) -> None:
    A = _random(sum(shape), *shape)
    U, s, V = sm.singular_values(A)
    expected = np.linalg.svd(A, compute_uv=False)
    np.testing.assert_allclose(s[: len(expected)], expected, rtol=1e-12)
    assert (np.abs(s[len(expected) :]) < 1e-12).all()
    np.testing.assert_allclose((U * s) @ V.T, A, atol=1e-13)
    np.testing.assert_allclose(V.T @ V, np.eye(shape[1]), atol=1e-13)
    assert (np.diff(s) <= 0.0).all()


@pytest.mark.parametrize("shape", [(6, 6), (6, 7), (6, 4)])
@pytest.mark.parametrize("rank", [6, 5, 3])
def test_least_norm_is_the_pseudoinverse(shape: tuple[int, int], rank: int) -> None:
    A, b = _random(rank, *shape), _random(rank + 7, shape[0])
    A[rank:] = 2.0 * A[: 6 - rank]
    np.testing.assert_allclose(sm.least_norm(A, b, 1e-9), np.linalg.pinv(A, rcond=1e-9) @ b, rtol=1e-9, atol=1e-11)


def test_small_singular_values_count_until_they_are_too_small() -> None:
    A = np.diag([1.0, 1e-8, 1e-10])
    np.testing.assert_allclose(sm.least_norm(A, np.ones(3), 1e-9), [1.0, 1e8, 0.0])


@pytest.mark.parametrize("shape", [(8, 1), (8, 3), (7, 7), (9, 30)])
@pytest.mark.parametrize("seed", range(6))
def test_least_squares(shape: tuple[int, int], seed: int) -> None:
    A, b = _random(seed, *shape), _random(seed + 3, shape[0])
    if shape[1] <= shape[0]:
        np.testing.assert_allclose(sm.least_squares(A, b), np.linalg.lstsq(A, b)[0], rtol=1e-9, atol=1e-11)
    found, proven = sm.nonnegative_least_squares(A, b, 100)
    assert proven
    np.testing.assert_allclose(found, nnls(A, b)[0], atol=1e-10)
    slopes = A.T @ (b - A @ found)  # the conditions of Kuhn and Tucker
    assert (found >= 0.0).all()
    assert (slopes < 1e-12).all()
    assert np.abs(slopes[found > 0.0]).max(initial=0.0) < 1e-12


def test_columns_that_repeat_one_another() -> None:
    A = np.repeat(np.abs(_random(4, 7, 5)), 3, axis=1)
    b = A @ np.abs(_random(5, 15))
    found, proven = sm.nonnegative_least_squares(A, b, 100)
    assert proven
    assert (found >= 0.0).all()
    np.testing.assert_allclose(A @ found, b, atol=1e-10)
    assert not np.isfinite(sm.least_squares(np.zeros((3, 2)), np.ones(3))).all()
    assert not sm.nonnegative_least_squares(A, b, 1)[1]


@pytest.mark.parametrize("order", ["C", "F"])
def test_arguments_stay_as_they_are(order: Literal["C", "F"]) -> None:
    A, b = np.array(_random(2, 6, 6), order=order), _random(3, 6)
    before = A.copy(), b.copy()
    sm.singular_values(A), sm.solve(A, b), sm.least_norm(A, b, 1e-9), sm.least_squares(A, b)
    sm.nonnegative_least_squares(A, b, 20)
    assert np.array_equal(A, before[0])
    assert np.array_equal(b, before[1])


_PRINT = """
import numpy as np
from hrcreplay.geometry import small_matrices as sm
A, b = np.random.default_rng(1).normal(size=(6, 6)), np.arange(6.0)
H = sm.multiply(A, A.T)
parts = [H, sm.solve(A, b), sm.cholesky(H), *sm.singular_values(A), sm.least_norm(A, b, 1e-9)]
parts += [sm.least_squares(A, b), sm.nonnegative_least_squares(A, b, 20)[0]]
print(b"".join(part.tobytes() for part in parts).hex())
"""


def test_other_kernels_of_blas_and_numpy_give_the_same_bits() -> None:
    told = set()
    for chosen in ({}, {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3"}):
        command = [sys.executable, "-W", "ignore", "-c", _PRINT]
        done = subprocess.run(command, env={**os.environ, **chosen}, capture_output=True, text=True, check=True)
        told.add(done.stdout)
    assert len(told) == 1
