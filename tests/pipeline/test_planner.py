"""A batch of ticks in one kernel is the motion that the same method makes tick by tick in Python, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from hrcreplay.geometry.polygon import ConvexPolygon
from hrcreplay.human.fusion.vacancy import WatchedArea
from hrcreplay.limits import load_limits
from hrcreplay.pipeline.batch.ticks import LEFT, MotionColumns, run_blindly
from hrcreplay.pipeline.planner import Planner
from hrcreplay.pipeline.surroundings import Forecast, PredictionStage, Surroundings, WatchedBorder
from hrcreplay.records import STATUSES, HumanStates, Motion, MotionRow
from hrcreplay.robot.control.border import Border
from hrcreplay.robot.control.control_step import (
    INSIDE,
    NO_HUMAN,
    NOT_CERTIFIED,
    NOT_FINITE,
    REASONS,
    RETREATING,
    PlanSettings,
)
from hrcreplay.robot.control.controllers import CONTROLLERS
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.robot.control.stops import at_rest
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import parse_task
from hrcreplay.settings.sections import Plan, Prediction
from tests.human.people import states
from tests.robot.control.test_qp_tick import beside
from tests.robot.tasks import TO_AND_FRO
from tests.tools.random_stops import DT_S, TOOL_M

TICKS, STOP_S, FRESH_S = 900, 0.377, 0.3
STAGE = PredictionStage(load_limits("people"), Prediction(), 0.5)


@cache
def robot() -> RobotModel:
    T_world_base = np.eye(4)
    T_world_base[2, 3] = 0.65
    return irb140(T_world_base, stop_s=STOP_S, tool_m=TOOL_M)


@cache
def visitors() -> HumanStates:
    """One person comes to the robot and leaves; another one is there for a while, behind the first one."""
    t_s = DT_S * np.arange(TICKS)
    p = np.tile([0, 0, np.pi, 0.1, 0.2, 0.5, 0, 1.8, 0.2, 0.5, 0, 1.8, 0.9], (TICKS, 1))
    v = np.zeros_like(p)
    turn = 2.0 * np.pi / t_s[-1]
    p[:, 0], v[:, 0] = 1.7 + 1.0 * np.cos(turn * t_s), -turn * np.sin(turn * t_s)
    p[:, 2], v[:, 2] = np.pi + np.sin(turn * t_s), turn * np.cos(turn * t_s)
    other = p[250:650] + np.array([-0.5, 0.3] + [0.0] * 11)
    found = states(np.concatenate((p, other)), np.concatenate((v, v[250:650])))
    t_ns = (1e9 * np.concatenate((t_s, t_s[250:650]))).astype(np.int64)
    person = np.repeat([1, 3], [TICKS, len(other)])
    age_s = np.full(len(t_ns), 0.02)
    age_s[200:210] = 0.4  # nobody knows where the first one is
    age_s[TICKS + 100] = 0.4
    found = replace(found, t_ns=t_ns, person=person, frame_age_s=age_s)
    return found.rows(np.lexsort((person, t_ns)))


def _with_every_kind(people: HumanStates) -> HumanStates:
    """The same, with bodies that count by their points, of no known place, and with a torso out of sight."""
    p, unseen_s = people.p.copy(), people.unseen_s.copy()
    p[100:105] = np.nan  # and no points
    p[800:805] = np.nan  # by points
    points_m = people.points_m.copy()
    points_m[100:105] = np.nan
    unseen_s[600:640, 1] = 0.4
    camera_points_m = np.full((len(people), 1, *points_m.shape[1:]), np.nan)
    camera_points_m[:, 0] = points_m
    return replace(people, p=p, unseen_s=unseen_s, points_m=points_m, camera_points_m=camera_points_m)


def planner(method: str, plan: dict[str, Any], *, objects: bool = False) -> Planner:
    how = Plan(method=method, **plan)
    certified = how.certify and method not in ("none", "pfl")
    settings = PlanSettings(
        how, dt_s=DT_S, stop_s=STOP_S, certified=certified, retreat_m=how.retreat_m if method == "qp" else 0.0
    )
    path = plan_programme(parse_task(TO_AND_FRO), robot())
    static = beside(robot()) if objects else None
    return Planner(CONTROLLERS[method](robot(), path, settings, static=static), chosen=True)


def tick_by_tick(
    one: Planner,
    around: Surroundings,
    people: HumanStates,
    names: tuple[str, ...],
    outlook: type[Forecast] = Forecast,
) -> Motion:
    forecast = outlook(around, people, most_ahead=0)
    rows = [one.controller.step(forecast.predict(tick)).row for tick in range(len(forecast.t_ns))]
    links = tuple(segment.name for segment in robot().segments)
    return Motion.of_rows(forecast.t_ns, rows, limbs=names, links=links, reasons=REASONS)


def assert_same(found: Motion, expected: Motion) -> None:
    for name, value in vars(expected).items():
        mine = getattr(found, name)
        np.testing.assert_array_equal(mine, value, name)
        if isinstance(value, np.ndarray):
            assert mine.dtype == value.dtype, name
            if value.dtype == float:
                assert np.signbit(mine).tolist() == np.signbit(value).tolist(), name


def followed(
    one: Planner, around: Surroundings, people: HumanStates, names: tuple[str, ...], sizes: tuple[int, ...]
) -> tuple[Motion, int]:
    """The motion in batches of so many ticks, and how many ticks Python took, or looked at people in."""
    by_hand, parts = 0, []

    def counted(own: Callable[..., None]) -> Callable[..., None]:
        def call(self: Planner, outlook: Forecast, tick: int, columns: MotionColumns) -> None:
            nonlocal by_hand
            by_hand += 1
            own(self, outlook, tick, columns)

        return call

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Planner, "_step", counted(Planner._step))
        patch.setattr(Planner, "_look", counted(Planner._look))
        _, first = people.ticks()
        begin = 0
        for size in sizes:
            batch = people.rows(slice(int(first[begin]), int(first[begin + size])))
            forecast = Forecast(around, batch)
            parts.append(one.follow(forecast.t_ns, forecast, names))
            begin += size
    assert begin == len(first) - 1
    return Motion.join(parts), by_hand


@pytest.mark.parametrize(
    ("method", "plan", "objects", "most_by_hand"),
    [
        ("qp", {}, False, 20),
        ("qp", {}, True, 20),
        ("qp", {"retreat_m": 0.3, "constraint_rhs": "square", "reference": "time"}, False, 20),
        ("qp", {"horizon": "fixed", "rows": "hard", "jerk_s": 0.0}, False, 20),
        ("qp", {"certify": False}, False, TICKS),
        ("scaling", {}, False, 20),
        ("scaling", {}, True, 20),
        ("scaling", {"horizon": "fixed", "constraint_rhs": "square"}, False, 20),
        ("scaling", {"certify": False, "horizon": "fixed"}, False, 20),
        ("shield", {}, False, 20),
        ("shield", {"certify": False}, True, 20),
        ("none", {}, False, 0),
        ("none", {"horizon": "fixed"}, True, 0),
        ("ssm", {}, False, TICKS),
    ],
)
def test_in_batches_every_method_moves_as_tick_by_tick(
    method: str, plan: dict[str, Any], objects: bool, most_by_hand: int
) -> None:
    around, people = Surroundings(STAGE, FRESH_S), visitors()
    names = around.names_of(3)
    expected = tick_by_tick(planner(method, plan, objects=objects), around, people, names)
    found, by_hand = followed(planner(method, plan, objects=objects), around, people, names, (1, 7, 242, 650))
    assert_same(found, expected)
    assert by_hand <= most_by_hand
    assert np.abs(expected.dq).max() > 0.1
    assert len(set(expected.limb.tolist())) > 2
    if method != "none":
        assert NO_HUMAN in expected.reason


class _EveryVolume(Forecast):
    """Obstacles from the volumes of all people, also of those who are not known."""

    def obstacles(self, tick: int, horizon_s: float) -> Obstacles:
        rows = self.rows(tick)
        volumes = self.around.prediction.volumes(self.states.rows(rows), horizon_s)
        people = [obstacles(volumes, row, horizon_s) for row in range(len(volumes))]
        return self.around.obstacles(self.states, rows, people)


@pytest.mark.parametrize("method", ["qp", "scaling", "shield", "ssm", "none"])
def test_volumes_of_people_who_are_not_known_make_no_difference(method: str) -> None:
    around, people = Surroundings(STAGE, FRESH_S), _with_every_kind(visitors())
    names, every = around.names_of(3), _EveryVolume(around, people)
    unknown = [tick for tick in range(TICKS) if not every.obstacles(tick, 0.1).known]
    assert len(unknown) > 10
    expected = tick_by_tick(planner(method, {}), around, people, names, _EveryVolume)
    assert_same(tick_by_tick(planner(method, {}), around, people, names), expected)
    assert_same(followed(planner(method, {}), around, people, names, (250, 650))[0], expected)


def test_the_motions_compared_hold_what_makes_a_difference() -> None:
    around, people = Surroundings(STAGE, FRESH_S), visitors()
    names = around.names_of(3)
    qp, shield = (tick_by_tick(planner(method, {}), around, people, names) for method in ("qp", "shield"))
    assert {INSIDE, NO_HUMAN} <= set(qp.reason.tolist())
    assert RETREATING in qp.status
    assert {INSIDE, NO_HUMAN, NOT_CERTIFIED} <= set(shield.reason.tolist())
    assert max(qp.limb) >= len(around.names)  # the other person is the nearest one at times


@pytest.mark.parametrize("method", ["qp", "scaling", "none"])
def test_what_the_kernel_cannot_predict_is_left_to_python(method: str) -> None:
    around, people = Surroundings(STAGE, FRESH_S), _with_every_kind(visitors())
    names = around.names_of(3)
    expected = tick_by_tick(planner(method, {}), around, people, names)
    found, by_hand = followed(planner(method, {}), around, people, names, (250, 650))
    assert_same(found, expected)
    ahead = Forecast(around, people).ahead
    assert ahead is not None
    assert 20 <= np.count_nonzero(ahead.what == LEFT) <= by_hand < TICKS // 2


@pytest.mark.parametrize("prediction", ["paper", "positions"])
def test_printed_predictions_and_watched_areas_are_left_to_python(prediction: str) -> None:
    people = visitors().of_person(1)
    polygon = ConvexPolygon.of_corners(np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]]))
    area = WatchedArea(polygon, margin_m=0.1, clear_s=0.5, gap_s=0.3, speed_m_per_s=1.6)
    border = WatchedBorder(area, Border.around(robot(), polygon), 0.0)
    watched = replace(people, nobody_s=np.full(TICKS, 0.1), nobody_else_s=np.full(TICKS, 0.1))
    for around, seen in (
        (Surroundings(STAGE.by(prediction), FRESH_S), people),
        (Surroundings(STAGE, 0.3, border), watched),
    ):
        assert Forecast(around, seen).ahead is None
        names = around.names_of(1)
        for method in ("scaling", "none"):
            expected = tick_by_tick(planner(method, {}), around, seen, names)
            found, by_hand = followed(planner(method, {}), around, seen, names, (250, 650))
            assert_same(found, expected)
            assert by_hand == TICKS


class _Hidden(Forecast):
    """People at whom nobody may look."""

    person = ahead = property(lambda _: pytest.fail("looked at people"))

    def obstacles(self, tick: int, horizon_s: float) -> Obstacles:
        pytest.fail(f"looked at people at tick {tick} until {horizon_s} s")


def test_a_robot_that_ignores_people_moves_before_anybody_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    around, people = Surroundings(STAGE, FRESH_S), _with_every_kind(visitors())
    names = around.names_of(3)
    expected = tick_by_tick(planner("none", {}), around, people, names)
    moved: list[dict[str, Any]] = []

    def driven(scene: Any, moving: Any, found: MotionColumns, tick: int) -> Any:
        done = run_blindly(scene, moving, found, tick)
        moved.append({name: column.copy() for name, column in found._asdict().items()})
        return done

    monkeypatch.setattr("hrcreplay.pipeline.planner.run_blindly", driven)
    hidden = _Hidden(around, people)
    with pytest.raises(pytest.fail.Exception, match="looked at people"):
        planner("none", {}).follow(hidden.t_ns, hidden, names)
    (columns,) = moved
    for name in set(MotionColumns._fields) - {"distance_m", "overlap_m", "limb", "link"}:
        np.testing.assert_array_equal(columns[name], getattr(expected, name), name)


@pytest.mark.parametrize("method", ["scaling", "none"])
def test_a_robot_that_is_not_on_its_path_first_ends_the_stop_of_another_method(method: str) -> None:
    around, people = Surroundings(STAGE, FRESH_S), visitors()
    names = around.names_of(3)
    found = []
    for in_batches in (False, True):
        one = planner(method, {})
        qp = planner("qp", {})
        forecast = Forecast(around, people)
        qp.follow(forecast.t_ns[:60], forecast, names)
        assert qp.controller.stop.ticks > 2
        one.controller.take_over(qp.controller.stop)
        given = one, around, people, names
        found.append(followed(*given, (100, 800))[0] if in_batches else tick_by_tick(*given))
    assert_same(found[1], found[0])
    assert len(found[0]) == TICKS


def test_the_kernel_fills_the_fields_of_a_row() -> None:
    assert MotionColumns._fields == MotionRow._fields


def test_a_robot_at_rest_stays_where_it_is_beside_somebody_unknown() -> None:
    around, people = Surroundings(STAGE, FRESH_S), visitors()
    unknown = replace(people, frame_age_s=np.full(len(people), 1.0))
    for method in ("qp", "scaling"):
        one = planner(method, {})
        one.controller.take_over(at_rest(one.controller.point.q, np.array([0.0, 0.0])))
        motion, by_hand = followed(one, around, unknown, around.names_of(3), (TICKS,))
        assert by_hand == 0
        assert not motion.dq.any()
        assert set(motion.reason.tolist()) == {NO_HUMAN}
        assert np.isnan(motion.distance_m).all()
        assert set(motion.limb.tolist()) == set(motion.link.tolist()) == {-1}


@pytest.mark.parametrize("method", ["qp", "scaling", "none"])
def test_a_robot_without_finite_joints_stands_and_the_record_says_why(method: str) -> None:
    around, people = Surroundings(STAGE, FRESH_S), visitors().rows(slice(0, 20))
    names = around.names_of(3)
    found = []
    for in_batches in (False, True):
        one = planner(method, {})
        one.controller.take_over(at_rest(np.full(6, np.nan), np.array([0.0, 0.0])))
        given = one, around, people, names
        found.append(followed(*given, (20,))[0] if in_batches else tick_by_tick(*given))
    for motion in found:
        assert set(motion.reason.tolist()) == {NOT_FINITE}
        assert np.isnan(motion.distance_m).all()
        assert set(motion.limb.tolist()) == {-1}
        assert set(motion.status.tolist()) == {STATUSES.index("braking")}
    np.testing.assert_array_equal(found[1].programme_s, found[0].programme_s)
    np.testing.assert_array_equal(found[1].q, found[0].q)
