"""Volumes of many ticks at once, each until its own horizon, are those of each tick alone, bit for bit."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from hrcreplay.commands import replay
from hrcreplay.human.model import skeleton
from hrcreplay.kernels import Held
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly, stages, surroundings
from hrcreplay.pipeline.batch.ticks import hulls_of
from hrcreplay.pipeline.run_config import RunConfig, resolve
from hrcreplay.pipeline.surroundings import Forecast, Surroundings
from hrcreplay.records import POINTS, HumanStates
from hrcreplay.robot.control.qp_tick import TickHulls
from hrcreplay.robot.control.separation import Obstacles, obstacles, unknown_obstacles
from hrcreplay.store.run_folder import Stopwatch
from tests.pipeline.test_several_people import STAGE, crowd


class NoTables:
    """Tables that keep nothing."""

    def table(self, name: str, columns: object, /) -> None:
        """Forgets the rows."""


@cache
def demo(method: str) -> tuple[RunConfig, HumanStates]:
    """A run of a method beside the person of the demo, and that person."""
    overrides = (f"plan.method={method}", "plan.baselines=[]")
    run_config = resolve(
        "plan", replay.demo_log(), cell_file=replay.demo_cell(), overrides=overrides, start_s=8.0, end_s=9.5
    )
    log = open_log(run_config.log, run_config.settings.logs)
    sink = stages.Sink(NoTables(), Stopwatch(time.perf_counter_ns), lambda _, __: None)
    ticks_ns = stages.span_ticks(run_config, log)
    fused = stages.fuse_batches(log, ticks_ns, 250, assembly.fusion_stage(run_config, log), sink)
    return run_config, HumanStates.join(list(fused))


def assert_same(found: Obstacles, expected: Obstacles) -> None:
    for name in ("vertices_m", "offsets", "radius_m", "boxes_m"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    assert (found.known, found.horizon_s, found.first) == (expected.known, expected.horizon_s, expected.first)
    np.testing.assert_array_equal(found.numbers, expected.numbers)


@pytest.mark.parametrize("method", ["sound", "paper", "positions"])
def test_each_tick_has_its_own_horizon(method: str) -> None:
    _, states = demo("none")
    for people in (states.rows(slice(200, 260)), crowd(1, 2), crowd(3, 1, 2)):
        around = Surroundings(STAGE.by(method), fresh_s=0.3)
        forecast = Forecast(around, people)
        horizon_s = np.random.default_rng(2).uniform(0.0, 0.4, len(forecast.t_ns))
        for tick, found in enumerate(forecast.until(horizon_s)):
            assert_same(found, Forecast(around, people).obstacles(tick, float(horizon_s[tick])))


def test_a_tick_alone_is_computed_in_one_kernel_and_has_the_same_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    _, states = demo("none")
    alone: list[int] = []
    compute = hulls_of

    def listening(person: Held, first: int, *given: Any) -> TickHulls:
        alone.append(first)
        return compute(person, first, *given)

    monkeypatch.setattr(surroundings, "hulls_of", listening)
    late = replace(STAGE, settings=STAGE.settings.model_copy(update={"latency_s": 0.05}))
    for people, stage in ((states.rows(slice(200, 260)), STAGE), (crowd(1, 2), late), (crowd(3, 1, 2), STAGE)):
        age_s = np.where(np.arange(len(people)) % 7 == 3, 9.0, people.frame_age_s)
        around, people = Surroundings(stage, fresh_s=0.3), replace(people, frame_age_s=age_s)
        forecast = Forecast(around, people)
        horizon_s = np.random.default_rng(4).uniform(0.0, 0.4, len(forecast.t_ns))
        alone.clear()
        known = []
        for tick, until_s in enumerate(horizon_s.tolist()):
            rows = forecast.rows(tick)
            if (age_s[rows] > 0.3).any():  # the robot stands, so no volume is computed
                assert_same(forecast.obstacles(tick, until_s), unknown_obstacles(until_s))
                continue
            known.append(rows.start)
            volumes = around.prediction.volumes(people.rows(rows), until_s)
            each = [obstacles(volumes, row, until_s) for row in range(len(volumes))]
            assert_same(forecast.obstacles(tick, until_s), around.obstacles(people, rows, each))
        assert alone == known
        assert 0 < len(known) < len(forecast.t_ns)


def test_a_body_that_counts_by_its_points_and_one_partly_seen_have_their_own_horizons() -> None:
    _, states = demo("none")
    people = states.rows(slice(200, 240))
    unseen_s, p, shown_m = people.unseen_s.copy(), people.p.copy(), np.full((40, 2, len(POINTS), 3), np.nan)
    unseen_s[10:20, :2] = 0.4  # the torso is out of sight, but one camera shows the arms
    arms = [POINTS.index(f"{part}_{side}") for part in ("elbow", "wrist") for side in "lr"]
    shown_m[10:20, 0, arms] = skeleton(p, people.lengths_m)[10:20, arms]
    unseen_s[30:], p[30:] = np.inf, np.nan  # a body only just seen
    changed = replace(people, unseen_s=unseen_s, p=p, camera_points_m=shown_m)
    forecast = Forecast(Surroundings(STAGE, fresh_s=0.3), changed)
    assert forecast.person.partly_seen.sum() >= 10
    assert forecast.person.by_points.sum() == 10
    horizon_s = np.linspace(0.0, 0.4, 40)
    for tick, found in enumerate(forecast.until(horizon_s)):
        assert_same(found, Forecast(Surroundings(STAGE, fresh_s=0.3), changed).obstacles(tick, float(horizon_s[tick])))


def test_volumes_computed_ahead_are_those_asked_for() -> None:
    _, states = demo("none")
    around = Surroundings(STAGE, fresh_s=0.3)
    forecast = Forecast(around, states)
    asked = [0.1] * 40 + [0.1, 0.2, 0.2, 0.1] * 10 + [0.3] * (len(states) - 80)
    for _ in range(2):  # two methods ask for the same
        for tick, horizon_s in enumerate(asked):
            assert_same(
                forecast.obstacles(tick, horizon_s), Forecast(around, states, most_ahead=0).obstacles(tick, horizon_s)
            )
