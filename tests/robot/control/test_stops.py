"""When the controller finds no motion, or cannot know: the robot brakes, and says why."""

from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.records import Floats
from hrcreplay.robot.control import control_step, qp_controller
from hrcreplay.robot.control.control_step import RobotState
from hrcreplay.robot.control.minimiser import Unsolved
from hrcreplay.robot.control.separation import obstacles
from hrcreplay.robot.model import RobotModel
from tests.robot.people import volumes
from tests.robot.swinging import DT_S, HOME, SETTINGS, moving, robot, step, swing

__all__ = ["robot"]  # the fixture


def braked(state: RobotState, robot: RobotModel) -> Floats:
    """Velocities one tick later, Eq. (67)."""
    gain = DT_S * robot.ddq_max
    return state.dq - np.clip(state.dq, -gain, gain)


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
        np.testing.assert_array_equal(made.next.dq[others], braked(state, robot)[others])


def test_an_unsolved_qp_is_a_stop(robot: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    state = moving(robot)
    monkeypatch.setattr(qp_controller, "propose_stops", lambda *_: (False, False, None))
    monkeypatch.setattr(qp_controller, "minimise", lambda _: Unsolved("PROXQP_MAX_ITER_REACHED"))
    made = step(robot, state, *swing(robot, 0.0), seen, SETTINGS)
    assert (made.status, made.reason) == (control_step.BRAKING, control_step.NO_SOLUTION)
    np.testing.assert_array_equal(made.next.dq, braked(state, robot))
