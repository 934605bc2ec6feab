"""The pauses that the bars of a session count, on records that are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from tests.tools.bars import paused


def test_pauses_of_both_are_counted_and_those_at_the_same_time(tmp_path: Path) -> None:
    """Answers every 4 ms; the loop is late by 9 ms once, the session three times, once within 20 ms of the loop."""
    late_ms = {"echo": {100: 9}, "twin": {40: 9, 102: 9, 200: 9, 300: 1}}
    for name, late in late_ms.items():
        step_ms = np.full(400, 4)
        step_ms[list(late)] += list(late.values())
        (tmp_path / name).mkdir()
        pd.DataFrame({"t_ns": np.cumsum(step_ms) * 1_000_000}).to_csv(
            tmp_path / name / "twin_arrivals.csv", index=False
        )
    assert [line.split()[-2:] for line in paused(tmp_path)] == [["1", "3"], ["1", "1"]]
