"""The prediction of one joint beside matrices."""

from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.human.fusion.kalman import predict, process_variance
from hrcreplay.kernels import njit
from hrcreplay.records import Floats


@njit()
def _predict(mean: Floats, P: Floats, dt: float, damping: float, sigma: Floats, rest_std: Floats) -> None:
    predict(mean, P, dt, damping, sigma, rest_std)


@pytest.mark.parametrize("damping", [1.0, 0.7])
def test_the_prediction_is_that_of_the_matrices(damping: float) -> None:
    """Also of a joint that comes to rest, whose derivatives are damped: D F P F' D + G."""
    rng, dt = np.random.default_rng(9), 0.03
    mean, root, sigma, rest_std = rng.normal(size=4), rng.normal(size=(4, 4)), rng.random(4), rng.random(3)
    P = root @ root.T
    F = np.array([[1.0, dt, dt**2 / 2, dt**3 / 6], [0, 1.0, dt, dt**2 / 2], [0, 0, 1.0, dt], [0, 0, 0, 1.0]])
    DF = np.diag([1.0, damping, damping, damping]) @ F
    G = np.diag([process_variance(a, dt, damping, sigma, rest_std) for a in range(4)])
    found, cov = mean.copy(), P.copy()
    _predict(found, cov, dt, damping, sigma, rest_std)
    np.testing.assert_allclose(found, DF @ mean, rtol=1e-13)
    np.testing.assert_allclose(cov, DF @ P @ DF.T + G, rtol=1e-12)
    np.testing.assert_array_equal(cov, cov.T)
