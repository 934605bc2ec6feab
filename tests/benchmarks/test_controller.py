"""A tick of the controllers beside people, and the QP beside daqp with all rows written down, in the same run."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from hrcreplay.robot.control.control_step import RobotState
from hrcreplay.robot.control.minimiser import minimise
from hrcreplay.robot.control.separation import obstacles
from hrcreplay.robot.model import RobotModel
from tests.robot.people import person
from tests.robot.swinging import DT_S, HOME, SETTINGS, Asked, asked, dense, robot, run, step, swing

__all__ = ["robot"]  # the fixture

TICKS = 300


@pytest.mark.benchmark
@pytest.mark.parametrize(("name", "at_m"), [("far", 4.0), ("near", 1.5), ("in contact", 1.1)])
def test_a_tick(benchmark: BenchmarkFixture, robot: RobotModel, name: str, at_m: float) -> None:
    people = person(TICKS, DT_S, (at_m, 0.0), 0.35, seed=1)
    states = [state for state, _ in run(robot, people)]

    def replay() -> None:
        for tick, state in enumerate(states):
            step(robot, state, *swing(robot, (tick + 1) * DT_S), obstacles(people, tick), SETTINGS)

    benchmark.pedantic(replay, rounds=3, warmup_rounds=1)  # type: ignore[no-untyped-call]
    if benchmark.stats is not None:
        benchmark.extra_info["us_per_tick"] = benchmark.stats.stats.mean / TICKS * 1e6


def tasks(robot: RobotModel) -> Iterator[Asked]:
    people = person(TICKS, DT_S, (1.3, 0.0), 0.35, seed=1)
    state = RobotState(HOME, np.zeros(6))
    for tick in range(TICKS):
        reference, seen = swing(robot, (tick + 1) * DT_S), obstacles(people, tick)
        yield asked(robot, state, *reference, seen)
        state = step(robot, state, *reference, seen, SETTINGS).next


@pytest.mark.benchmark
@pytest.mark.parametrize("soft", [False, True])
def test_few_rows_beside_all_rows_by_daqp(benchmark: BenchmarkFixture, robot: RobotModel, soft: bool) -> None:
    problems = [tick._replace(task=tick.task._replace(soft=soft)) for tick in tasks(robot)]
    benchmark.pedantic(lambda: [minimise(tick.task) for tick in problems], rounds=3, warmup_rounds=1)  # type: ignore[no-untyped-call]
    if benchmark.stats is None:
        return
    started = time.perf_counter()
    for tick in problems:
        dense(robot, tick)
    all_s, few_s = time.perf_counter() - started, benchmark.stats.stats.mean
    benchmark.extra_info["us_per_tick"] = few_s / TICKS * 1e6
    benchmark.extra_info["all rows by daqp / few rows"] = all_s / few_s
    assert few_s < all_s
