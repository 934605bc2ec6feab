"""The stages of ``hrcreplay bench`` on a stretch of the demo, beside the references of the same run."""

from __future__ import annotations

from typing import Any

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from hrcreplay.commands import bench, replay

#: Our part -> the reference of the same run.
BESIDE = {"fuse": "filterpy: dense filter", "volumes of one person alone": "qhull: hulls of their vertices"}


@pytest.mark.benchmark(group="stages of the demo")
def test_the_stages_beside_the_references(benchmark: BenchmarkFixture) -> None:
    how: Any = {"seconds": 2.0, "start_s": 8.0, "cell_file": replay.demo_cell()}
    found = benchmark.pedantic(bench.run, (replay.demo_log(),), how, rounds=1)  # type: ignore[no-untyped-call]
    rows = {row.name: row for row in found.rows}
    for name, row in rows.items():
        benchmark.extra_info[name] = {"median_us": row.median_us, "p99_us": row.p99_us, "mean_us": row.mean_us}
    for ours, theirs in BESIDE.items():
        benchmark.extra_info[f"{theirs} / {ours}"] = rows[theirs].mean_us / rows[ours].mean_us
