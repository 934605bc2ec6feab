"""A tick in one kernel decides what a tick in Python decides, step by step, to the last bit."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from hrcreplay.robot.control.control_step import (
    BRAKING,
    INSIDE,
    LIMITED,
    NO_HUMAN,
    NOT_CERTIFIED,
    RETREATING,
    TRACKING,
    PlanSettings,
    Step,
)
from hrcreplay.robot.control.controllers import Controller, QpController
from hrcreplay.robot.control.qp_tick import decide_held
from hrcreplay.robot.control.separation import Obstacles, no_obstacles, obstacles
from hrcreplay.robot.control.static_obstacles import StaticObstacles
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import parse_task
from hrcreplay.settings.sections import Plan
from tests.robot.people import person
from tests.robot.tasks import TO_AND_FRO
from tests.tools.random_stops import DT_S, TOOL_M, Box, as_static

TICKS, STOP_S = 500, 0.377


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    T_world_base = np.eye(4)
    T_world_base[2, 3] = 0.65
    return irb140(T_world_base, stop_s=STOP_S, tool_m=TOOL_M)


def pieces(value: Any) -> Iterator[Any]:
    """Every array and number of a record, in order."""
    if isinstance(value, tuple | list):
        for part in value:
            yield from pieces(part)
    elif hasattr(value, "__dataclass_fields__"):
        yield from pieces([getattr(value, field.name) for field in fields(value)])
    elif not callable(value):
        yield value


def assert_same(one: Any, other: Any) -> None:
    mine, yours = list(pieces(one)), list(pieces(other))
    assert len(mine) == len(yours)
    for a, b in zip(mine, yours, strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.signbit(np.asarray(a, float)).tolist() == np.signbit(np.asarray(b, float)).tolist()


def in_python(controller: QpController, seen: Obstacles) -> tuple[Step, QpController]:
    """The step, and the state after a tick that is taken part by part."""
    other = copy.copy(controller)
    with np.errstate(all="ignore"):
        return Controller.decide(other, lambda _: seen), other


def run(controller: QpController, people: list[Obstacles]) -> Counter[tuple[bool, int, int]]:
    """Compares every tick; counts (decided by the kernel, reason, status)."""
    counts: Counter[tuple[bool, int, int]] = Counter()
    asked = []

    def listening(*given: Any) -> Any:
        asked.append(decide_held(*given))
        return asked[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hrcreplay.robot.control.controllers.decide_held", listening)
        for seen in people:
            expected, after = in_python(controller, seen)
            with np.errstate(all="ignore"):
                own = copy.copy(controller)
                mine = own.decide(lambda _, seen=seen: seen)  # type: ignore[misc]
            assert_same(mine, expected)
            assert_same((own.planes, own.s_s, own.point), (after.planes, after.s_s, after.point))
            controller.step(lambda _, seen=seen: seen)  # type: ignore[misc]
            counts[asked[-1].decided, mine.reason, mine.status] += 1
    return counts


def approaching(near_m: float = 1.55) -> list[Obstacles]:
    volumes = person(TICKS, DT_S, (near_m, 0.0), 0.35, seed=4)
    return [obstacles(volumes, tick, 0.4) for tick in range(TICKS)]


def beside(robot: RobotModel) -> StaticObstacles:
    table = Box(np.array([0.6, 0.0, 0.3]), np.eye(3), np.array([0.3, 0.6, 0.02]), 0.0)
    return as_static(robot, [table])


@pytest.mark.parametrize(
    ("plan", "certified", "objects"),
    [
        ({}, True, False),
        ({}, True, True),
        ({"retreat_m": 0.3}, True, False),
        ({"rows": "hard", "jerk_s": 0.0, "smooth_s": 0.0, "give_way_m": 0.0}, True, False),
        ({"constraint_rhs": "square", "reference": "time", "lead_s": 0.2}, True, False),
        ({"horizon": "fixed"}, False, False),
    ],
)
def test_a_tick_in_one_kernel_is_the_tick_in_python(
    robot: RobotModel, plan: dict[str, Any], certified: bool, objects: bool
) -> None:
    how = Plan(**plan)
    settings = PlanSettings(how, dt_s=DT_S, stop_s=STOP_S, certified=certified, retreat_m=how.retreat_m)
    path = plan_programme(parse_task(TO_AND_FRO), robot)
    counts = run(QpController(robot, path, settings, static=beside(robot) if objects else None), approaching())
    assert sum(counts.values()) == TICKS
    at_once = Counter({(reason, status): count for (decided, reason, status), count in counts.items() if decided})
    if certified:
        assert TICKS - 5 > at_once.total() > 0.9 * TICKS, counts
        assert at_once[0, TRACKING] > 50 < max(at_once[INSIDE, LIMITED], at_once[0, RETREATING]), counts
        assert at_once[0, RETREATING] > 0 or plan.get("rows") == "hard", counts
        assert at_once[NOT_CERTIFIED, BRAKING] + at_once[NOT_CERTIFIED, LIMITED] > 0, counts
    else:
        assert not any(reason == 0 for reason, _ in at_once), counts


def test_unknown_people_and_nobody_are_those_of_python(robot: RobotModel) -> None:
    path, near = plan_programme(parse_task(TO_AND_FRO), robot), approaching()
    unknown = near[0]._replace(known=False)
    outside = near[0]._replace(horizon_s=0.001)  # no stop ends in time
    lost = near[0]._replace(vertices_m=np.full_like(near[0].vertices_m, np.nan))
    people = [no_obstacles()] * 60 + near[:60] + [unknown] * 20 + [outside] * 20 + [lost] * 20 + near[60:120]
    settings = PlanSettings(Plan(), dt_s=DT_S, stop_s=STOP_S, retreat_m=0.03)
    counts = run(QpController(robot, path, settings), people)
    assert {reason for _, reason, _ in counts} >= {0, NO_HUMAN, NOT_CERTIFIED}, counts
