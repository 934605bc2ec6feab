"""The fit of the constants of the deviations, on errors drawn with constants that are known."""

from __future__ import annotations

import numpy as np

from hrcreplay.human.fusion.reported_deviations import FITTED, KIND
from hrcreplay.records import DOF, Floats
from tests.tools.deviations import Sample, fit, pooled


def drawn(seed: int, constants: Floats, n: int = 3000) -> Sample:
    """Normal errors of n ticks; some are not known."""
    random = np.random.default_rng(seed)
    std, spread = random.uniform(0.01, 0.1, (2, n, DOF)), random.uniform(0.1, 5.0, (n, DOF))
    correlation = random.uniform(-0.5, 1.0, (n, DOF))
    offset, slope = (constants[KIND, :, i].T[:, None] for i in range(2))  # (2, 1, 13), of p and of v
    variance = std**2 * spread * np.exp(offset + slope * correlation)
    error = random.normal(0.0, 1.0, std.shape) * np.sqrt(variance)
    error[random.uniform(size=error.shape) < 0.2] = np.nan
    return Sample(f"{seed}", True, error, std, spread, correlation, (1e-9, 1e9))


def test_the_constants_of_the_errors_are_found() -> None:
    constants = np.random.default_rng(3).uniform(-2.0, 2.5, FITTED.shape)
    samples = [drawn(seed, constants) for seed in range(4)]
    np.testing.assert_allclose(fit(samples), constants, atol=0.12)
    rms, within = pooled([of.in_deviations(constants) for of in samples])
    np.testing.assert_allclose(rms, 1.0, atol=0.04)
    np.testing.assert_allclose(within, np.array([0.683, 0.954, 0.997])[:, None, None] * np.ones((3, 2, DOF)), atol=0.02)
