from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import daqp
import numpy as np
import pytest

from hrcreplay.records import Floats, SweptVolumes
from hrcreplay.robot import controller, stepping
from hrcreplay.robot.active_set import minimiser
from hrcreplay.robot.constraints import approach_rows, link_segment
from hrcreplay.robot.controller import Solution, Unsolved, solve, step
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.robot.obstacles import Obstacles, obstacles
from hrcreplay.robot.problem import Problem, problem
from hrcreplay.robot.rotation import from_vector
from hrcreplay.robot.separation import Separation, separation
from hrcreplay.robot.sight import observe
from hrcreplay.robot.stepping import PlanSettings, RobotState, Step
from hrcreplay.robot.tracking import pose_error
from tests.robot.checker import links, violation
from tests.robot.people import cloud, person, volumes

STOP_S, DT_S = 0.377, 0.004
SETTINGS = PlanSettings(dt_s=DT_S, stop_s=STOP_S)
HOME = np.deg2rad([10.0, 20.0, -20.0, 0.0, 60.0, 0.0])


def base() -> Floats:
    T_world_base = np.eye(4)
    T_world_base[2, 3] = 0.65
    return T_world_base


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return irb140(base(), stop_s=STOP_S)


def swing(robot: RobotModel, t_s: float) -> tuple[Floats, Floats]:
    """A reference that swings sideways, and its twist."""
    T = robot.pose(HOME, np.zeros(6)).T_world_tcp.copy()
    T[1, 3] += 0.3 * np.sin(1.5 * t_s)
    return T, np.array([0.0, 0.45 * np.cos(1.5 * t_s), 0.0, 0.0, 0.0, 0.0])


def run(
    robot: RobotModel, people: SweptVolumes, settings: PlanSettings = SETTINGS
) -> Iterator[tuple[RobotState, Step]]:
    state = RobotState(HOME, np.zeros(6))
    for tick in range(len(people)):
        made = step(robot, state, *swing(robot, (tick + 1) * DT_S), obstacles(people, tick), settings)
        yield state, made
        state = made.next


def all_rows(robot: RobotModel, task: Problem) -> tuple[Floats, Floats, Floats]:
    """Every row of Eq. (66g)-(66i), written down."""
    A, low, high = [task.pose.J_tcp], [task.J_low], [task.J_high]
    distance, offsets = separation(task.pose, task.obstacles), task.obstacles.offsets
    for link, segment in enumerate(robot.segments):
        for limb, radius in enumerate(task.obstacles.radius_m):
            vertices = task.obstacles.vertices_m[offsets[limb] : offsets[limb + 1]]
            rows = approach_rows(
                link_segment(task.pose, link),
                vertices,
                distance[link, limb],
                clearance_m=segment.radius_m + radius,
                stop_s=STOP_S,
            )
            A.append(rows.A)
            high.append(rows.b)
            low.append(np.full(len(rows.b), -1e30))
    every: Floats = np.concatenate(A)
    every[np.abs(every) < 1e-13] = 0.0  # rounding errors of axes that do not move the link: daqp scales them up to rows
    return np.ascontiguousarray(every), np.concatenate(low), np.concatenate(high)


def dense(robot: RobotModel, task: Problem) -> tuple[Floats, bool]:
    """The same problem with all rows, by another solver."""
    A, low, high = all_rows(robot, task)
    upper, lower = np.concatenate([task.high, high]), np.concatenate([task.low, low])
    found = daqp.solve(task.H, task.g, A, upper, lower, primal_tol=1e-11, dual_tol=1e-12)
    return found[0], found[2] == 1


def asked(robot: RobotModel, state: RobotState, T: Floats, twist: Floats, seen: Obstacles) -> Problem:
    pairs = observe(robot, state, seen, 0.0).pairs
    assert isinstance(pairs, Separation)
    return problem(robot, state, robot.pose(state.q, state.dq), T, twist, seen, pairs, SETTINGS)


def random_tick(robot: RobotModel, rng: np.random.Generator) -> Problem:
    """Anything: singular wrists, robots at rest, people far and in contact."""
    q = rng.uniform(robot.q_min, robot.q_max) * 0.6
    q[4] *= rng.choice([0.0, 1e-4, 1.0, 1.0, 1.0])
    state = RobotState(q, rng.normal(size=6) * rng.choice([0.0, 0.1, 0.5]))
    pose = robot.pose(q, state.dq)
    T = pose.T_world_tcp.copy()
    T[:3, 3] += rng.normal(size=3) * 0.02
    T[:3, :3] = from_vector(rng.normal(size=3) * 0.05) @ T[:3, :3]
    centre = pose.T_world_tcp[:3, 3] + rng.normal(size=3) * 0.6
    limbs = [cloud(rng, 40, rng.uniform(0.02, 0.3, 3)) + centre + rng.normal(size=3) * 0.25 for _ in range(6)]
    twist = pose.J_tcp @ (state.dq + rng.normal(size=6) * 0.1)
    return asked(robot, state, T, twist, obstacles(volumes(limbs), 0))


def test_the_solution_is_that_of_another_solver_with_all_rows(robot: RobotModel) -> None:
    rng = np.random.default_rng(1)
    outcomes = []
    for _ in range(400):
        task = random_tick(robot, rng)
        mine, (expected, feasible) = solve(task), dense(robot, task)
        assert isinstance(mine, Solution) == feasible
        if isinstance(mine, Solution):
            np.testing.assert_allclose(mine.dq_next, expected, atol=1e-6)
        outcomes.append("stop" if isinstance(mine, Unsolved) else "held" if mine.held else "free")
    counts = {outcome: outcomes.count(outcome) for outcome in ("stop", "held", "free")}
    assert min(counts.values()) >= 50, counts


@pytest.mark.parametrize(("at_m", "seed"), [((1.5, 0.0), 1), ((1.2, 0.0), 2)])
def test_every_tick_of_a_replay_is_that_of_another_solver(
    robot: RobotModel, at_m: tuple[float, float], seed: int
) -> None:
    people = person(600, DT_S, at_m, 0.35, seed=seed)
    for tick, (state, made) in enumerate(run(robot, people)):
        if tick % 3:
            continue
        task = asked(robot, state, *swing(robot, (tick + 1) * DT_S), obstacles(people, tick))
        expected, feasible = dense(robot, task)
        assert (made.status != stepping.BRAKING) == feasible
        if feasible:
            np.testing.assert_allclose(state.dq + DT_S * made.u, expected, atol=1e-6)


@pytest.mark.parametrize(("at_m", "seed"), [((1.5, 0.0), 3), ((1.1, 0.1), 4)])
def test_inequality_2_holds_wherever_the_robot_does_not_brake(
    robot: RobotModel, at_m: tuple[float, float], seed: int
) -> None:
    people = person(700, DT_S, at_m, 0.35, seed=seed)
    states, made = zip(*run(robot, people), strict=True)
    status = np.array([m.status for m in made])
    worst = violation(
        np.array([s.q for s in states]),
        np.array([s.dq for s in states]),
        np.array([m.u for m in made]),
        status,
        people,
        base(),
        dt_s=DT_S,
        stop_s=STOP_S,
    )
    assert worst.metres <= 1e-6, worst
    assert np.count_nonzero(status == stepping.LIMITED) > 100


def test_the_checker_is_no_friend_of_anyone(robot: RobotModel) -> None:
    """It finds what a controller without people does, and its arm is the robot's."""
    people = person(400, DT_S, (1.1, 0.1), 0.35, seed=4)
    nobody = volumes([np.full((1, 3), 50.0)])
    state, rows = RobotState(HOME, np.zeros(6)), []
    for tick in range(400):
        made = step(robot, state, *swing(robot, (tick + 1) * DT_S), obstacles(nobody, 0), SETTINGS)
        rows.append((state.q, state.dq, made.u))
        state = made.next
    q, dq, u = (np.array(column) for column in zip(*rows, strict=True))
    assert violation(q, dq, u, np.zeros(400), people, base(), dt_s=DT_S, stop_s=STOP_S).metres > 0.05
    for q_k, dq_k in zip(q[::50], dq[::50], strict=True):
        ends, speeds = links(q_k, dq_k, base(), 0.10)
        pose = robot.pose(q_k, dq_k)
        np.testing.assert_allclose(ends, pose.ends_m, atol=1e-12)
        np.testing.assert_allclose(speeds, pose.J_ends @ dq_k, atol=1e-12)


def test_a_free_robot_follows_its_reference(robot: RobotModel) -> None:
    nobody = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    state = RobotState(HOME + 0.02, np.zeros(6))
    for tick in range(800):
        T, twist = swing(robot, (tick + 1) * DT_S)
        made = step(robot, state, T, twist, nobody, SETTINGS)
        state = made.next
    assert made.status == stepping.TRACKING
    error = pose_error(robot.pose(state.q, state.dq).T_world_tcp, T)
    assert np.abs(error[:3]).max() < 1e-4
    assert np.abs(error[3:]).max() < 1e-4


def test_as_printed_a_position_error_does_not_decay(robot: RobotModel) -> None:
    nobody = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    T = robot.pose(HOME, np.zeros(6)).T_world_tcp.copy()
    T[0, 3] += 0.01
    left = {}
    for gain in (0.0, 5.0):
        state = RobotState(HOME, np.zeros(6))
        for _ in range(500):
            state = step(robot, state, T, np.zeros(6), nobody, replace(SETTINGS, path_gain_per_s=gain)).next
        left[gain] = T[0, 3] - robot.pose(state.q, state.dq).T_world_tcp[0, 3]
    assert left[0.0] > 0.0099
    assert abs(left[5.0]) < 1e-5


def moving(robot: RobotModel) -> RobotState:
    return RobotState(HOME, np.array([0.5, -0.3, 0.2, -1.0, 0.8, 0.001]))


def test_a_stop_is_as_fast_as_each_axis_can_and_exact(robot: RobotModel) -> None:
    unknown = obstacles(volumes([np.full((1, 3), np.nan)]), 0)
    state = moving(robot)
    T, twist = swing(robot, 0.0)
    for tick in range(200):
        made = step(robot, state, T, twist, unknown, SETTINGS)
        assert (made.status, made.reason) == (stepping.BRAKING, stepping.NO_HUMAN)
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
    assert again.status == stepping.TRACKING
    assert np.any(again.next.dq != 0.0)


def test_distance_and_pair_are_those_of_all_pairs(robot: RobotModel) -> None:
    people = person(40, DT_S * 20, (1.3, 0.0), 0.4, seed=5)
    for tick, (state, made) in enumerate(run(robot, people)):
        seen = obstacles(people, tick)
        radius = np.array([segment.radius_m for segment in robot.segments])
        surface = separation(robot.pose(state.q, state.dq), seen) - (radius[:, None] + seen.radius_m)
        assert made.distance_m == max(0.0, surface.min())
        assert surface[made.link, made.limb] == surface.min()


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
        assert made.status == stepping.BRAKING
        assert made.reason == (stepping.NO_HUMAN if where == "vertices" else stepping.NOT_FINITE)
        others = np.arange(6) != 1
        np.testing.assert_array_equal(made.next.dq[others], stepping.braked(state, robot.ddq_max, DT_S)[others])


def test_an_unsolved_qp_is_a_stop(robot: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = obstacles(volumes([np.full((1, 3), 50.0)]), 0)
    state = moving(robot)
    monkeypatch.setattr(controller, "solve", lambda _: Unsolved("PROXQP_MAX_ITER_REACHED"))
    made = step(robot, state, *swing(robot, 0.0), seen, SETTINGS)
    assert (made.status, made.reason) == (stepping.BRAKING, stepping.NO_SOLUTION)
    np.testing.assert_array_equal(made.next.dq, stepping.braked(state, robot.ddq_max, DT_S))


def test_a_solver_that_says_solved_is_not_believed(robot: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """A candidate that breaks a row although the row is in the problem is no solution."""

    def careless(H: Floats, g: Floats, A: Floats, _: Floats) -> tuple[Floats, Floats]:
        return minimiser(H, g), np.zeros(len(A))

    monkeypatch.setattr(controller, "active_set", careless)
    rng = np.random.default_rng(12)
    found = [solve(random_tick(robot, rng)) for _ in range(60)]
    assert Unsolved("residual") in found


def test_without_limbs_there_is_no_distance(robot: RobotModel) -> None:
    empty = SweptVolumes(
        np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64), np.zeros((0, 3)), np.zeros((1, 0)), (), "paper"
    )
    made = step(robot, moving(robot), *swing(robot, 0.0), obstacles(empty, 0), SETTINGS)
    assert np.isnan(made.distance_m)
    assert (made.link, made.limb) == (-1, -1)
    assert made.status != stepping.BRAKING


def test_the_same_ticks_give_the_same_bits(robot: RobotModel) -> None:
    """Also with another robot object, ticks in another order, and memory that lies elsewhere."""
    people = person(150, DT_S * 4, (1.2, 0.0), 0.35, seed=6)
    first, other, ballast = list(run(robot, people)), irb140(base(), stop_s=STOP_S), []
    for tick in reversed(range(150)):
        ballast.append(np.zeros(tick * 3 + 1))
        state, made = first[tick]
        again = step(other, state, *swing(other, (tick + 1) * DT_S), obstacles(people, tick), SETTINGS)
        assert again.u.tobytes() == made.u.tobytes()
        assert again.distance_m == made.distance_m
        assert (again.status, again.reason) == (made.status, made.reason)
