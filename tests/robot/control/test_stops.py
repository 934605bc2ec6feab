"""When the controller finds no motion, or cannot know: the robot brakes, and says why."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hrcreplay.records import Floats
from hrcreplay.robot.control import control_step, qp_controller
from hrcreplay.robot.control.approach_rows import SOLVED, Optimum, optimum
from hrcreplay.robot.control.control_step import RobotState
from hrcreplay.robot.control.qp_controller import Solution, Unsolved, solve, step
from hrcreplay.robot.control.separation import obstacles
from hrcreplay.robot.model import RobotModel
from tests.geometry.quadratic import minimiser
from tests.robot.people import volumes
from tests.robot.swinging import DT_S, HOME, SETTINGS, moving, random_tick, robot, swing

__all__ = ["robot"]  # the fixture


def test_a_stop_is_as_fast_as_each_axis_can_and_exact(robot: RobotModel) -> None:
    unknown = obstacles(volumes([np.full((1, 3), np.nan)]), 0)
    state = moving(robot)
    T, twist = swing(robot, 0.0)
    for tick in range(200):
        made = step(robot, state, T, twist, unknown, SETTINGS)
        assert (made.status, made.reason) == (control_step.BRAKING, control_step.NO_HUMAN)
        expected = np.minimum(robot.ddq_max, np.maximum(-state.dq / DT_S, -robot.ddq_max))  # Eq. (67)
        np.testing.assert_allclose(made.u, expected, atol=1e-9)
        started = moving(robot).dq
        speed = np.maximum(0.0, np.abs(started) - (tick + 1) * DT_S * robot.ddq_max)
        np.testing.assert_allclose(np.abs(made.next.dq), speed, atol=1e-12)
        state = made.next
    assert np.all(state.dq == 0.0)
    assert np.all(made.u == 0.0)
    np.testing.assert_array_equal(made.next.q, state.q)


def test_it_goes_on_when_the_person_is_known_again(robot: RobotModel) -> None:
    unknown = obstacles(volumes([np.full((1, 3), np.nan)]), 0)
    nobody = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    T, twist = swing(robot, 0.0)
    stopped = step(robot, RobotState(HOME, np.zeros(6)), T, twist, unknown, SETTINGS)
    assert np.isnan(stopped.distance_m)
    assert (stopped.link, stopped.limb) == (-1, -1)
    again = step(robot, stopped.next, T, twist, nobody, SETTINGS)
    assert again.status == control_step.TRACKING
    assert np.any(again.next.dq != 0.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("where", ["q", "dq", "reference", "rotation", "twist", "vertices"])
def test_bad_numbers_brake_with_a_reason(robot: RobotModel, where: str, bad: float) -> None:
    state, (T, twist), limb = moving(robot), swing(robot, 0.0), np.full((4, 3), 5.0)
    q, dq, T = state.q.copy(), state.dq.copy(), T.copy()
    changed = {"q": q[2:3], "dq": dq[1:2], "reference": T[:1, 3], "rotation": T[0, :1], "twist": twist[4:5]}
    changed.get(where, limb[0, :1])[:] = bad
    made = step(robot, RobotState(q, dq), T, twist, obstacles(volumes([limb]), 0), SETTINGS)
    assert np.all(np.isfinite(made.u))
    if bad != 1e300:
        assert made.status == control_step.BRAKING
        assert made.reason == (control_step.NO_HUMAN if where == "vertices" else control_step.NOT_FINITE)
        others = np.arange(6) != 1
        np.testing.assert_array_equal(made.next.dq[others], control_step.braked(state, robot.ddq_max, DT_S)[others])


def test_an_unsolved_qp_is_a_stop(robot: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    state = moving(robot)
    monkeypatch.setattr(qp_controller, "solve", lambda _: Unsolved("PROXQP_MAX_ITER_REACHED"))
    made = step(robot, state, *swing(robot, 0.0), seen, SETTINGS)
    assert (made.status, made.reason) == (control_step.BRAKING, control_step.NO_SOLUTION)
    np.testing.assert_array_equal(made.next.dq, control_step.braked(state, robot.ddq_max, DT_S))


def test_a_solver_that_says_solved_is_not_believed(robot: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """A candidate that breaks a row although the row is in the problem is no solution."""

    def careless(H: Floats, g: Floats, *given: Any) -> Optimum:
        found = optimum(H, g, *given)
        return found._replace(w=minimiser(H, g), outcome=SOLVED)

    monkeypatch.setattr(qp_controller, "optimum", careless)
    rng = np.random.default_rng(12)
    found = [solve(random_tick(robot, rng).task) for _ in range(60)]
    assert Unsolved("residual") in found


def test_a_solution_without_proof_is_not_believed(robot: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Standing still keeps all rows, yet is seldom the minimiser."""

    def lazy(H: Floats, g: Floats, *given: Any) -> Optimum:
        found = optimum(H, g, *given)
        return found._replace(w=0.999 * found.w) if found.outcome == SOLVED else found

    rng = np.random.default_rng(13)
    ticks = [random_tick(robot, rng).task for _ in range(60)]
    solved = [isinstance(solve(task), Solution) for task in ticks]
    monkeypatch.setattr(qp_controller, "optimum", lazy)
    found = [solve(task) for task in ticks]
    assert sum(solved) > 20
    assert Unsolved("unproven") in found
    assert not any(isinstance(solution, Solution) and np.any(solution.dq_next) for solution in found)
