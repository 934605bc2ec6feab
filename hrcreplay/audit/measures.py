"""Shares, means and quantiles over ticks with bootstrap intervals.

Neighbouring ticks share most of their future, and a motion lasts longer than a tick, so n ticks hold much less
information than n independent samples. The intervals come from a circular moving-block bootstrap: each log is
resampled from blocks of consecutive ticks, three horizons long (longer for long logs, as the cube root of the ticks),
the quantity is estimated on each resampled log, and the interval holds the middle 95 % of these estimates. Blocks do
not cross from one log to another, and each log keeps its length.

With few escapes, or none, resampling shows little variation. So the interval of a share also holds the exact binomial
interval for as many independent samples as there are horizons in the logs: an excursion affects only the ticks of one
horizon before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import betaincinv

from hrcreplay.records import Floats

LEVEL = 0.95
DRAWS = 500
_CHUNK = 50


@dataclass(frozen=True)
class Estimate:
    """A figure with its interval; NaN without data."""

    value: float
    low: float
    high: float
    samples: int  #: number of ticks behind it

    def to_dict(self) -> dict[str, Any]:
        """Returns the JSON form; unknown values are null."""
        numbers = {"value": self.value, "low": self.low, "high": self.high}
        return {k: float(v) if np.isfinite(v) else None for k, v in numbers.items()} | {"samples": self.samples}


@dataclass(frozen=True)
class Resampling:
    """Weight of each tick in each resampled log: the number of its occurrences."""

    weights: Floats  #: (draws, n) integers
    block: int  #: number of ticks of a block
    sample_ticks: float  #: number of ticks for one independent sample of a share: those of a horizon

    def of(self, which: slice) -> Resampling:
        """Selects some of the ticks."""
        return Resampling(self.weights[:, which], self.block, self.sample_ticks)

    def share(self, hits: Floats) -> Estimate:
        """Estimates the share of ticks with 1 among those with 0 or 1, (n,); NaN is ignored."""
        found = self.mean(hits)
        if found.samples == 0:
            return found
        trials = max(1.0, found.samples / self.sample_ticks)
        low, high = _binomial(found.value * trials, trials)
        return Estimate(found.value, min(found.low, low), max(found.high, high), found.samples)

    def mean(self, values: Floats) -> Estimate:
        """Estimates the mean of (n,); NaN is ignored."""
        known = np.isfinite(values)
        if not known.any():
            return Estimate(np.nan, np.nan, np.nan, 0)
        weights = self.weights[:, known]
        total = weights.sum(axis=1)
        means = (weights @ values[known])[total > 0] / total[total > 0]
        return _estimate(float(values[known].mean()), means, int(known.sum()))

    def quantile(self, values: Floats, q: float) -> Estimate:
        """Estimates the smallest value of (n,) that at least a share ``q`` does not exceed; NaN is ignored."""
        known = np.isfinite(values)
        if not known.any():
            return Estimate(np.nan, np.nan, np.nan, 0)
        order = np.argsort(values[known], kind="stable")
        ordered = values[known][order]
        weights = self.weights[:, known]
        found = []
        for first in range(0, len(weights), _CHUNK):
            sums = np.cumsum(weights[first : first + _CHUNK][:, order], axis=1)
            some = sums[sums[:, -1] > 0]
            found.append(ordered[np.argmax(some >= q * some[:, -1:] - 1e-9, axis=1)])
        rank = max(0, int(np.ceil(q * len(ordered) - 1e-9)) - 1)
        return _estimate(float(ordered[rank]), np.concatenate(found), len(ordered))


def _estimate(value: float, resampled: Floats, samples: int) -> Estimate:
    if not len(resampled):
        return Estimate(value, np.nan, np.nan, samples)
    tail = 0.5 * (1.0 - LEVEL)
    low, high = np.quantile(resampled, [tail, 1.0 - tail])
    return Estimate(value, min(float(low), value), max(float(high), value), samples)


def _binomial(hits: float, trials: float) -> tuple[float, float]:
    """Computes the Clopper-Pearson interval of a share; the counts need not be integers."""
    tail = 0.5 * (1.0 - LEVEL)
    misses = trials - hits
    low = betaincinv(hits, misses + 1.0, tail) if hits > 0.0 else 0.0
    high = betaincinv(hits + 1.0, misses, 1.0 - tail) if misses > 0.0 else 1.0
    return float(low), float(high)


def block_ticks(horizon_s: float, rate_hz: float, ticks: int) -> int:
    """Computes the length of a block: three horizons, or the cube root of the ticks of the longest log if larger."""
    return max(1, int(np.ceil(3.0 * horizon_s * rate_hz)), int(np.ceil(ticks ** (1.0 / 3.0))))


def resample(lengths: Sequence[int], block: int, sample_ticks: float, seed: int, draws: int = DRAWS) -> Resampling:
    """Computes weights of the ticks in logs resampled block by block.

    Args:
        lengths: Number of ticks of each log, in the order of the values.
        block: Number of ticks of a block; limited to the length of a log.
        sample_ticks: Number of ticks for one independent sample of a share.
        seed: Seed of the random numbers; the same seed and lengths give the same weights.
        draws: Number of resampled logs.
    """
    random = np.random.default_rng(seed)
    parts = []
    for n in lengths:
        if n == 0:
            continue
        size = min(block, n)
        pieces = -(-n // size)
        starts = random.integers(0, n, size=(draws, pieces))
        weights = np.zeros((draws, n))
        for row, first in zip(weights, starts, strict=True):
            ticks = (first[:, None] + np.arange(size)).ravel()[:n]  # the last block is cut: a log keeps its length
            row[:] = np.bincount(ticks % n, minlength=n)
        parts.append(weights)
    return Resampling(np.concatenate(parts, axis=1) if parts else np.zeros((draws, 0)), block, sample_ticks)
