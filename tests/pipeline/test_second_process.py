"""A run by two processes writes the same bytes as by one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hrcreplay.commands import replay
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.pipeline.second_process import second_process


def _fail() -> None:
    raise LookupError("as it does")


def test_two_processes_write_the_same_bytes_as_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[str] = []

    class Watched:
        """Gives the second process its work, and notes which."""

        def __init__(self, pool: Any) -> None:
            self.pool = pool

        def submit(self, work: Any, *given: Any, **named: Any) -> Any:
            taken.append(work.__name__)
            return self.pool.submit(work, *given, **named)

    rest: Any = replay.complete

    def complete(*given: Any) -> None:
        *before, second, seen = given
        rest(*before, second and Watched(second), seen)

    run_stages: Any = replay.run_stages

    def stages(*given: Any, second: Any, **named: Any) -> Any:
        return run_stages(*given, second=second and Watched(second), **named)

    monkeypatch.setattr(replay, "MANY", 100)
    monkeypatch.setattr(replay, "complete", complete)
    monkeypatch.setattr(replay, "run_stages", stages)
    how: Any = {"cell_file": replay.demo_cell(), "start_s": 8.0, "end_s": 9.0}
    found = []
    for processes in (1, 2):
        assert not taken
        folder = replay.execute(
            resolve("report", replay.demo_log(), **how), tmp_path / str(processes), processes=processes
        )
        found.append(json.loads((folder / "run.json").read_text())["outputs"])
        assert {"plan none", "plan qp", "plan scaling"} <= set(json.loads((folder / "timing.json").read_text()))
    assert found[0] == found[1]
    assert {"contact.parquet", "severity.parquet", "motion_none.parquet", "motion_scaling.parquet"} <= set(found[0])
    assert set(taken) == {"_start", "_take", "_finish", "_take_there", "_coverages_there", "_tables_there"} | {
        "_forget_there",
        "_write_scene",
        "draw_there",
    }


def test_an_error_of_the_second_process_is_that_of_the_run() -> None:
    with pytest.raises(LookupError, match="as it does"), second_process() as pool:
        pool.submit(_fail).result()
