from __future__ import annotations

import time

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from hrcreplay.geometry.distances import distances
from hrcreplay.robot.control.separation import obstacles
from hrcreplay.robot.model import RobotModel
from tests.robot.distances import by_coal
from tests.robot.people import cloud, volumes
from tests.robot.swinging import HOME, robot

__all__ = ["robot"]  # the fixture


@pytest.mark.benchmark
def test_all_distances_of_a_tick_beside_coal(benchmark: BenchmarkFixture, robot: RobotModel) -> None:
    """As many vertices as ``sound`` has."""
    rng = np.random.default_rng(1)
    pose = robot.pose(HOME, np.zeros(6))
    limbs = [cloud(rng, 140, rng.uniform(0.2, 0.5, 3)) + np.array([1.2, 0.0, 0.8]) for _ in range(6)]
    seen = obstacles(volumes(limbs), 0)
    benchmark.pedantic(distances, (pose.ends_m, seen.vertices_m, seen.offsets), rounds=200, warmup_rounds=5)  # type: ignore[no-untyped-call]
    if benchmark.stats is None:
        return
    started = time.perf_counter()
    for _ in range(20):
        by_coal(pose, seen)
    benchmark.extra_info["coal / ours"] = (time.perf_counter() - started) / 20 / benchmark.stats.stats.mean
