"""Percentiles of many short times in little memory."""

from __future__ import annotations

import numpy as np

_BIN_NS = 5_000
_BINS = 20_000  # up to 0.1 s; the last one holds all that took longer


class Durations:
    """A histogram in steps of 5 us."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, dtype=np.int64)

    def add(self, duration_ns: int) -> None:
        """One more."""
        self._counts[min(max(duration_ns, 0) // _BIN_NS, _BINS - 1)] += 1

    def quantiles_us(self, *shares: float) -> list[float] | None:
        """Upper ends of the steps in which these shares of all lie; None where there is nothing [us]."""
        total = np.cumsum(self._counts)
        if not total[-1]:
            return None
        places = np.searchsorted(total, np.ceil(np.array(shares) * total[-1]))
        return [float((place + 1) * _BIN_NS / 1e3) for place in places]
