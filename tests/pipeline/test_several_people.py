"""What a robot keeps clear of beside several people: one after another, nearest by name, unknown if one is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hrcreplay.geometry.polygon import ConvexPolygon
from hrcreplay.human.fusion.vacancy import WatchedArea
from hrcreplay.limits import load_limits
from hrcreplay.pipeline.surroundings import Forecast, PredictionStage, Surroundings, WatchedBorder
from hrcreplay.records import BODY, BORDER, HumanStates
from hrcreplay.robot.control.border import Border
from hrcreplay.robot.control.control_step import NO_HUMAN, RobotState, observe
from hrcreplay.robot.control.separation import obstacles
from hrcreplay.robot.model import irb140
from hrcreplay.settings.sections import Prediction
from tests.human.people import states

STAGE = PredictionStage(load_limits("people"), Prediction(), 0.5)
HORIZON_S = 0.2
ROBOT = irb140(np.eye(4), stop_s=0.377)
AT_REST = RobotState(np.zeros(6), np.zeros(6))
CORNERS = np.array([[-3.0, -3.0], [3.0, -3.0], [3.0, 3.0], [-3.0, 3.0]])


@cache
def crowd(*numbers: int) -> HumanStates:
    """People at two ticks, further and further from the robot in the order of the arguments."""
    p = np.tile([0, 0, 0, 0, 0.2, 0.5, 0, 2.6, 0.2, 0.5, 0, 2.6, 0.9], (2 * len(numbers), 1))
    p[:, 0] = np.tile([1.2 + 0.8 * k for k in range(len(numbers))], 2)
    found = states(p, np.zeros_like(p))
    t_ns = np.repeat(np.array([10, 14]) * 1_000_000, len(numbers))
    found = replace(found, t_ns=t_ns, person=np.tile(numbers, 2), frame_age_s=np.full(len(p), 0.02))
    return found.rows(np.lexsort((found.numbers, t_ns)))


@pytest.mark.parametrize("numbers", [(1, 2), (2, 1), (3, 1, 2), (4, 2)])
def test_the_volumes_are_those_of_each_person_and_the_nearest_names_its_person(numbers: tuple[int, ...]) -> None:
    around = Surroundings(STAGE, fresh_s=0.3)
    people = crowd(*numbers)
    found = Forecast(around, people).obstacles(1, HORIZON_S)
    alone = [obstacles(STAGE.volumes(people.of_person(number), HORIZON_S), 1, HORIZON_S) for number in sorted(numbers)]
    parts = np.split(found.vertices_m, found.offsets[1:-1])
    each = [part for one in alone for part in np.split(one.vertices_m, one.offsets[1:-1])]
    assert [part.tolist() for part in parts] == [part.tolist() for part in each]
    assert found.radius_m.tolist() == np.concatenate([one.radius_m for one in alone]).tolist()
    assert found.known
    names = around.names_of(max(numbers))
    sight = observe(ROBOT, AT_REST, found, 0.0)
    by_person = {number: observe(ROBOT, AT_REST, one, 0.0) for number, one in zip(sorted(numbers), alone, strict=True)}
    nearest = min(by_person, key=lambda number: by_person[number].distance_m)
    assert nearest == numbers[0]
    limb = BODY[by_person[nearest].limb]
    assert names[sight.limb] == (limb if nearest == 1 else f"{limb} of person {nearest}")
    assert sight.distance_m == by_person[nearest].distance_m


def test_one_person_who_is_unknown_makes_all_of_them_unknown() -> None:
    people = crowd(1, 2)
    age_s = people.frame_age_s.copy()
    age_s[3] = 0.4  # of person 2 at the second tick
    forecast = Forecast(Surroundings(STAGE, fresh_s=0.3), replace(people, frame_age_s=age_s))
    assert forecast.obstacles(0, HORIZON_S).known
    unknown = forecast.obstacles(1, HORIZON_S)
    assert not unknown.known
    assert observe(ROBOT, AT_REST, unknown, 0.0).reason == NO_HUMAN


def test_a_watched_area_keeps_the_walls_after_all_people_and_their_names() -> None:
    polygon = ConvexPolygon.of_corners(CORNERS)
    area = WatchedArea(polygon, margin_m=0.1, clear_s=0.5, gap_s=0.3, speed_m_per_s=1.6)
    around = Surroundings(STAGE, 0.3, WatchedBorder(area, Border.around(ROBOT, polygon), 0.0))
    people = crowd(1, 2)
    people = replace(people, nobody_s=np.full(4, 5.0), nobody_else_s=np.full(4, 0.1))
    found, names = Forecast(around, people).obstacles(0, HORIZON_S), around.names_of(2)
    assert [names[found.among_all(k)] for k in range(len(found.radius_m))] == [
        *BODY,
        *(f"{limb} of person 2" for limb in BODY),
        *(BORDER,) * 4,
    ]
    age_s = people.frame_age_s.copy()
    age_s[1] = 0.4  # person 2 is unknown, but neither inside nor able to be deeper inside than the walls
    lost = replace(people, frame_age_s=age_s, nobody_s=np.full(4, 0.2))
    found = Forecast(around, lost).obstacles(0, HORIZON_S)
    assert [names[found.among_all(k)] for k in range(len(found.radius_m))] == [*BODY, *(BORDER,) * 4]
    assert found.known
    walls = np.split(found.vertices_m, found.offsets[1:-1])[len(BODY) :]
    deep_m = 0.1 + 1.6 * (0.2 + HORIZON_S)
    assert max(wall[:, 0].min() for wall in walls) == pytest.approx(3.0 - deep_m)
