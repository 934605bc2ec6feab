"""The table that metrics.json holds: name -> value, unit and meaning; null with a reason where one does not apply."""

from __future__ import annotations

from typing import Any

import numpy as np

Metric = dict[str, Any]


class MetricTable:
    """Collects metrics. A number that is not finite becomes null, and then the reason is written beside it."""

    def __init__(self) -> None:
        self._metrics: dict[str, Metric] = {}

    def add(self, name: str, value: float | str | None, unit: str, meaning: str, *, reason: str = "no samples") -> None:
        """Adds one metric; ``reason`` says why it is null, if it is."""
        if not isinstance(value, str) and value is not None:
            number = value.item() if isinstance(value, np.generic) else value
            value = number if np.isfinite(number) else None
        metric: Metric = {"value": value, "unit": unit, "meaning": meaning}
        if value is None:
            metric["reason"] = reason
        self._metrics[name] = metric

    def sorted(self) -> dict[str, Metric]:
        """All metrics, by name."""
        return dict(sorted(self._metrics.items()))
