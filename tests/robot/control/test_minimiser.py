from __future__ import annotations

import itertools
import platform
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from hrcreplay.records import Floats
from hrcreplay.robot.control import minimiser
from hrcreplay.robot.control.metric_rows import Limits, Metric, Problem
from hrcreplay.robot.control.minimiser import Solution, Unsolved, minimise
from hrcreplay.robot.control.row_search import SLACK, SOLVED, UNPROVEN, Search, search
from hrcreplay.robot.control.separation import Approach, no_planes
from hrcreplay.robot.model import RobotModel
from tests.robot.swinging import STOP_S, dense, random_tick, robot

__all__ = ["robot"]  # the fixture

WIDE = np.full(3, 10.0)
FREE = Limits(-WIDE, WIDE, np.zeros((6, 3)), np.full(6, -1.0), np.ones(6))


def people(A: Floats, high: Floats, per_speed: float = 1.0) -> Approach:
    """Rows ``A @ w <= high`` of three velocities as a link that is a point, and limbs of one vertex each."""
    J_ends, m, A = np.zeros((1, 2, 3, 3)), len(A), A.copy()
    A.flags.writeable = False  # as vertices are: so the kernels are those that a run has
    J_ends[0, :] = np.eye(3)
    boxes = np.stack([A, A], axis=1)
    per = np.full((1, m), per_speed)
    return Approach(np.zeros((1, 2, 3)), J_ends, A, np.arange(m + 1), boxes, high[None], per, 1.0, *no_planes(3))


def asked(
    wish: Floats, A: Floats, high: Floats, *, soft: bool = False, limits: Limits = FREE, per_speed: float = 1.0
) -> Problem:
    """As near to a wish as the rows allow."""
    return Problem(np.eye(3), -wish, limits, people(A, high, per_speed), soft)


def solved(task: Problem) -> Solution:
    found = minimise(task)
    assert isinstance(found, Solution), found
    return found


def enumerated(H: Floats, g: Floats, A: Floats, high: Floats) -> Floats | None:
    """Every set of up to three rows is tried; the best point that keeps all rows is the minimiser."""
    best: Floats | None = None
    least, n = np.inf, len(g)
    for count in range(n + 1):
        rows = np.array(list(itertools.combinations(range(len(A)), count)), int)
        K = np.zeros((len(rows), n + count, n + count))
        K[:, :n, :n], K[:, n:, :n], K[:, :n, n:] = H, A[rows], A[rows].transpose(0, 2, 1)
        right = np.hstack([np.tile(-g, (len(rows), 1)), high[rows]])[..., None]
        solvable = np.linalg.cond(K) <= 1e12
        w = np.linalg.solve(K[solvable], right[solvable])[:, :n, 0]
        w = w[np.all(w @ A.T <= high + 1e-9, axis=1)]
        cost = 0.5 * ((w @ H) * w).sum(axis=1) + w @ g
        if len(w) and cost.min() < least:
            best, least = w[np.argmin(cost)], cost.min()
    return best


def test_small_problems_are_solved_as_by_trying_every_set_of_rows() -> None:
    rng = np.random.default_rng(1)
    outcomes = []
    for _ in range(150):
        root, g = rng.normal(size=(3, 3)), rng.normal(size=3)
        H, J, A, high = root @ root.T + 0.1 * np.eye(3), rng.normal(size=(6, 3)), rng.normal(size=(5, 3)), np.empty(5)
        high[:] = rng.normal(size=5) * 0.3 + 0.1
        limits = Limits(-rng.uniform(0, 0.5, 3), rng.uniform(0, 0.5, 3), J, -rng.uniform(0, 1, 6), rng.uniform(0, 1, 6))
        found = minimise(Problem(H, g, limits, people(A, high), soft=False))
        every = np.concatenate([A, np.eye(3), -np.eye(3), J, -J])
        bounds = np.concatenate([high, limits.high, -limits.low, limits.J_high, -limits.J_low])
        expected = enumerated(H, g, every, bounds)
        if expected is None:
            assert found == Unsolved("infeasible")
        else:
            assert isinstance(found, Solution)
            np.testing.assert_allclose(found.dq_next, expected, atol=1e-6)
        outcomes.append(expected is None)
    assert 20 < sum(outcomes) < 130


def test_soft_ticks_are_those_of_another_solver_with_all_rows(robot: RobotModel) -> None:
    rng = np.random.default_rng(2)
    slack = []
    for _ in range(500):
        tick = random_tick(robot, rng)
        if tick.task.rows.per_speed.min() < STOP_S * 0.01:  # inside people a speed of approach has no meaning
            continue
        tick = tick._replace(task=tick.task._replace(soft=True))
        found, (expected, feasible) = minimise(tick.task), dense(robot, tick)
        assert isinstance(found, Solution) == feasible
        if isinstance(found, Solution):
            np.testing.assert_allclose([*found.dq_next, found.slack], expected, atol=1e-6)
            slack.append(found.slack)
    assert sum(s > 1e-3 for s in slack) > 50


def test_a_row_holds_where_the_wish_breaks_it() -> None:
    found = solved(asked(np.array([1.0, 2.0, 3.0]), np.eye(3)[:2], np.array([0.5, 5.0])))
    np.testing.assert_allclose(found.dq_next, [0.5, 2.0, 3.0], atol=1e-9)
    assert found.held
    assert found.slack == 0.0


@pytest.mark.parametrize("soft", [False, True])
def test_a_row_that_is_only_touched_does_not_hold(soft: bool) -> None:
    found = solved(asked(np.array([0.5, 0.0, 0.0]), np.eye(3)[:1], np.array([0.5]), soft=soft))
    np.testing.assert_allclose(found.dq_next, [0.5, 0.0, 0.0], atol=1e-9)
    assert not found.held


def test_a_limit_that_holds_is_no_person() -> None:
    limits = FREE._replace(high=np.array([0.3, 10.0, 10.0]))
    found = solved(asked(np.array([1.0, 0.0, 0.0]), np.eye(3)[:1], np.array([0.5]), limits=limits))
    np.testing.assert_allclose(found.dq_next, [0.3, 0.0, 0.0], atol=1e-9)
    assert not found.held


def test_the_slack_is_the_speed_by_which_a_row_is_broken() -> None:
    """By hand: w = 1 - p m and slack = m p / SLACK of the multiplier m of p w - p slack <= p / 2."""
    p = 0.2
    found = solved(asked(np.array([1.0, 0.0, 0.0]), p * np.eye(3)[:1], np.array([0.5 * p]), soft=True, per_speed=p))
    pull = 0.5 / (1.0 + 1.0 / SLACK)
    assert found.dq_next[0] == pytest.approx(1.0 - pull, abs=1e-9)
    assert found.slack == pytest.approx(pull / SLACK, abs=1e-9)
    assert found.dq_next[0] - found.slack == pytest.approx(0.5, abs=1e-9)
    assert found.held


@pytest.mark.parametrize(
    ("A", "high"),
    [
        ([[1.0, 0, 0], [-1, 0, 0]], [-0.1, 0.0]),
        ([[1.0, 0, 0]], [-10.1]),
        ([[1.0, 1, 0], [-1, 1, 0], [0, -1, 0]], [-1e-3, -1e-3, 0]),
        ([[0.0, 0, 0]], [-0.1]),
    ],
)
def test_rows_that_leave_nothing_are_told_from_a_failure(A: list[list[float]], high: list[float]) -> None:
    rows, bounds = np.array(A), np.array(high)
    assert minimise(asked(np.ones(3), rows, bounds)) == Unsolved("infeasible")
    found = solved(asked(np.ones(3), rows, bounds, soft=True))
    assert found.slack == pytest.approx((rows @ found.dq_next - bounds).max(), abs=1e-6)
    assert found.slack > 0.0


def test_limits_that_leave_nothing_are_infeasible_also_where_people_are_soft() -> None:
    crossed = FREE._replace(J_low=np.full(6, 1.0), J_high=np.full(6, -1.0))
    apart = FREE._replace(J=np.eye(6, 3), J_low=np.full(6, -30.0), J_high=np.full(6, -20.0))
    for limits in (crossed, apart):
        assert minimise(asked(np.ones(3), np.eye(3), np.ones(3), soft=True, limits=limits)) == Unsolved("infeasible")


def test_what_no_velocity_keeps_is_proven_after_one_try(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that is too fast for a retreat asks such things; six tries took longer than a live cycle."""
    rng, tries, infeasible = np.random.default_rng(11), [0], 0
    really = minimiser._by_proxqp

    def counted(*given: Any) -> Any:
        tries[0] += 1
        return really(*given)

    monkeypatch.setattr(minimiser, "_by_proxqp", counted)
    for _ in range(300):
        J, middle = rng.normal(size=(6, 3)), rng.normal(size=6)
        room = rng.uniform(0.2, 2.0, 6)
        limits = Limits(-WIDE, WIDE, J, middle - room, middle + room)
        known = linprog(
            np.zeros(3), np.vstack([J, -J]), np.concatenate([middle + room, room - middle]), bounds=[(-10.0, 10.0)] * 3
        )
        tries[0] = 0
        found = minimise(asked(rng.normal(size=3), np.eye(3), np.ones(3), soft=True, limits=limits))
        assert (found == Unsolved("infeasible")) == (known.status == 2)
        if known.status == 2:
            infeasible += 1
            assert tries[0] <= 1
    assert 50 < infeasible < 250


def test_rows_without_room_leave_what_lies_across_them() -> None:
    """As in contact: many rows through 0, most of them redundant."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        across = rng.normal(size=3)
        across /= np.linalg.norm(across)
        span = rng.normal(size=(20, 3))
        A = span - np.outer(span @ across, across)
        wish = rng.normal(size=3)
        found = solved(asked(wish, np.concatenate([A, -A]), np.zeros(40)))
        np.testing.assert_allclose(found.dq_next, across * (across @ wish), atol=1e-6)


def test_repeated_empty_and_unbounded_rows_are_harmless() -> None:
    A = np.array([[1.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 0], [0, 1, 0]])
    limits = FREE._replace(low=np.full(3, -np.inf), high=np.full(3, np.inf), J_high=np.full(6, np.inf))
    found = solved(asked(np.array([2.0, 1.0, 0.0]), A, np.array([0.5, 0.5, 1.0, 0.0, np.inf]), limits=limits))
    np.testing.assert_allclose(found.dq_next, [0.5, 1.0, 0.0], atol=1e-9)


def test_without_people_it_is_the_wish() -> None:
    found = solved(asked(np.array([0.1, 0.2, 0.3]), np.zeros((0, 3)), np.zeros(0)))
    np.testing.assert_allclose(found.dq_next, [0.1, 0.2, 0.3], atol=1e-12)


def test_a_cost_that_is_not_convex_has_no_minimiser() -> None:
    task = asked(np.ones(3), np.eye(3), np.ones(3))
    assert minimise(task._replace(H=np.diag([1.0, -1.0, 1.0]))) == Unsolved("not finite")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, -1e300, 1e150, 1e12])
@pytest.mark.parametrize("soft", [False, True])
def test_no_number_makes_it_raise(robot: RobotModel, soft: bool, bad: float) -> None:
    task = random_tick(robot, np.random.default_rng(5)).task._replace(soft=soft)
    limits = Limits(*(np.array(field) for field in task.limits))
    own: dict[str, Any] = {name: np.array(field) for name, field in task.rows._asdict().items() if name != "stop_s"}
    own |= {"planes": np.eye(2, 6), "plane_high": np.full(2, 0.1)}
    rows = task.rows._replace(**own | {"vertices_m": own["vertices_m"].view()})
    rows.vertices_m.flags.writeable = False  # as vertices are: so the kernels are those that a run has
    task = task._replace(H=task.H.copy(), g=task.g.copy(), limits=limits, rows=rows)
    fields = [task.H, task.g, *limits, *(field for field in own.values() if field.dtype == float)]
    for field in fields:
        before = field.copy()
        field.flat[field.size // 2] = bad
        with np.errstate(all="ignore"):
            found = minimise(task)
        if np.isnan(bad):
            assert found == Unsolved("not finite")
        assert isinstance(found, Unsolved) or np.isfinite([*found.dq_next, found.slack]).all()
        field[:] = before


def unproven(task: Problem) -> Search:
    """The search as if coordinate descent had not proven its last candidate, so that ProxQP is asked."""
    found = search(task)
    return found._replace(outcome=UNPROVEN) if found.outcome == SOLVED else found


@pytest.mark.parametrize("failing", [1, len(minimiser.TRIES)])
def test_a_solver_that_says_solved_is_not_believed(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    """Nearly the minimiser is not enough; where a try fails another counts."""
    rng = np.random.default_rng(6)
    tasks = [random_tick(robot, rng).task for _ in range(40)]
    before, really = [minimise(task) for task in tasks], minimiser._by_proxqp
    spoilt = {(penalty, rounds) for _, penalty, rounds in minimiser.TRIES[:failing]}

    def careless(problem: Metric, y: Floats, z: Floats, penalty: float, rounds: int) -> tuple[Floats, Floats, str]:
        y, z, status = really(problem, y, z, penalty, rounds)
        return (0.999 * y + 1e-3 if (penalty, rounds) in spoilt else y), z, status

    monkeypatch.setattr(minimiser, "_by_proxqp", careless)
    monkeypatch.setattr(minimiser, "search", unproven)
    for task, expected in zip(tasks, before, strict=True):
        found = minimise(task)
        if failing > 1 or isinstance(expected, Unsolved):
            assert isinstance(found, Unsolved)
        else:
            assert isinstance(found, Solution)
            np.testing.assert_allclose(found.dq_next, expected.dq_next, atol=1e-6)


HASH = """
import hashlib, sys
import numpy as np
from hrcreplay.robot.control.minimiser import Solution, minimise
from hrcreplay.robot.model import irb140
from tests.robot.swinging import STOP_S, base, random_tick
ballast = [np.zeros(int(sys.argv[1]) * i + 1) for i in range(50)]
robot, rng, total = irb140(base(), stop_s=STOP_S), np.random.default_rng(7), hashlib.sha256()
for _ in range(100):
    found = minimise(random_tick(robot, rng).task)
    total.update(found.dq_next.tobytes() if isinstance(found, Solution) else found.status.encode())
    ballast.append(np.zeros(1 + int(sys.argv[1]) * len(ballast)))
print(total.hexdigest())
"""


def test_two_processes_find_the_same_bits() -> None:
    said = []
    for ballast in (0, 13):
        command = [sys.executable, "-c", HASH, str(ballast)]
        said.append(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert said[0] == said[1]
    assert len(said[0].strip()) == 64


_WIDEST = """
import sys, types
every = types.ModuleType("proxsuite.instructionset")  # of a processor that does it all
every.has_AVX2 = every.has_AVX512F = lambda: True
sys.modules["proxsuite.instructionset"] = every
from hrcreplay.robot.control import minimiser
import proxsuite
print(proxsuite._submodule.__name__)
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="proxsuite has one library here")
def test_proxsuite_is_the_same_library_on_every_processor_of_today() -> None:
    told = subprocess.run([sys.executable, "-c", _WIDEST], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "proxsuite.proxsuite_pywrap_avx2"
