"""The certificate on the steps of a robot beside people, beside coal's distances at every tick of the same stops."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from hrcreplay.robot.control import certificate
from hrcreplay.robot.control.certificate import clear
from hrcreplay.robot.control.control_step import PlanSettings
from hrcreplay.robot.control.controllers import Controller, QpController
from hrcreplay.robot.control.separation import obstacles
from hrcreplay.robot.model import irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import parse_task
from hrcreplay.settings.sections import Plan
from tests.robot.distances import by_coal
from tests.robot.people import person
from tests.robot.swinging import DT_S, STOP_S, base
from tests.robot.tasks import TO_AND_FRO

TICKS = 600


@pytest.mark.benchmark
@pytest.mark.parametrize(("name", "at_m"), [("far", 4.0), ("near", 1.6)])
def test_the_certificate(benchmark: BenchmarkFixture, monkeypatch: pytest.MonkeyPatch, name: str, at_m: float) -> None:
    robot = irb140(base(), stop_s=STOP_S)
    people = person(TICKS, DT_S, (at_m, 0.0), 0.35, seed=1)
    asked: list[tuple[Any, ...]] = []

    def listening(*given: Any) -> Any:
        asked.append(given)
        return clear(*given)

    monkeypatch.setattr(certificate, "clear", listening)
    controller = QpController(
        robot, plan_programme(parse_task(TO_AND_FRO), robot), PlanSettings(Plan(), dt_s=DT_S, stop_s=STOP_S)
    )
    monkeypatch.setattr(QpController, "decide", Controller.decide)  # the kernel of the whole tick does not call it
    for tick in range(TICKS):
        controller.step(lambda _, tick=tick: obstacles(people, tick))  # type: ignore[misc]
    took_us: list[float] = []

    def certify() -> None:
        took_us.clear()
        for given in asked:
            began = time.perf_counter()
            clear(*given)
            took_us.append(1e6 * (time.perf_counter() - began))

    benchmark.pedantic(certify, rounds=3, warmup_rounds=1)  # type: ignore[no-untyped-call]
    if benchmark.stats is None:
        return
    began = time.perf_counter()
    for _, _, stop, seen, *_ in asked[::10]:
        for q in stop.q:
            by_coal(robot.pose(q, np.zeros(6)), seen)
    brute_us = 1e6 * (time.perf_counter() - began) / len(asked[::10])
    benchmark.extra_info["median_us"] = float(np.median(took_us))
    benchmark.extra_info["p99_us"] = float(np.quantile(took_us, 0.99))
    benchmark.extra_info["brute_force_us"] = brute_us
    benchmark.extra_info["brute_force_over_mean"] = brute_us / float(np.mean(took_us))
