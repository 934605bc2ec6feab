"""A robot that swings beside people, and its problem written down in full for another solver."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import daqp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.records import Floats, SweptVolumes
from hrcreplay.robot.control.certificate import NO_PLANES, decide
from hrcreplay.robot.control.control_step import (
    PlanSettings,
    RobotState,
    Step,
    make_step,
    observe,
    standstill_reason,
)
from hrcreplay.robot.control.metric_rows import Problem
from hrcreplay.robot.control.qp_controller import QpContext, Target, problem, propose
from hrcreplay.robot.control.row_search import SLACK
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.robot.control.stops import stop_axis_by_axis
from hrcreplay.robot.kinematics import RobotPose
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.settings.load import load_settings
from tests.robot.distances import by_coal
from tests.robot.people import cloud, volumes
from tests.robot.plain_rows import approach_rows, link_segment

STOP_S, DT_S = 0.377, 0.004
#: The paper as printed.
PRINTED = load_settings(Path("paper")).plan
SETTINGS = PlanSettings(PRINTED, dt_s=DT_S, stop_s=STOP_S, certified=False)
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


def step(
    robot: RobotModel, state: RobotState, T: Floats, twist: Floats, seen: Obstacles, settings: PlanSettings = SETTINGS
) -> Step:
    """One tick without a past: the acceleration before was 0, and where nothing is proposed Eq. (67) brakes."""
    going = stop_axis_by_axis(state.q, state.dq, robot.ddq_max, DT_S)
    horizon_s = settings.horizon_s(going)
    with np.errstate(all="ignore"):
        sight = observe(robot, state, seen, settings.plan.clearance_m)
        wanted = standstill_reason(sight, settings) or propose(
            QpContext(robot, state, np.zeros(6), Target(T, twist, HOME), sight, seen, horizon_s), settings
        )
        taken, _ = decide(robot, going, wanted, seen, horizon_s, NO_PLANES, settings)
    return make_step(sight, going, taken, horizon_s, DT_S)


def run(
    robot: RobotModel, people: SweptVolumes, settings: PlanSettings = SETTINGS
) -> Iterator[tuple[RobotState, Step]]:
    state = RobotState(HOME, np.zeros(6))
    for tick in range(len(people)):
        made = step(robot, state, *swing(robot, (tick + 1) * DT_S), obstacles(people, tick), settings)
        yield state, made
        state = made.next


class Asked(NamedTuple):
    """A problem and what it is about."""

    task: Problem
    pose: RobotPose
    seen: Obstacles


def all_rows(robot: RobotModel, tick: Asked) -> tuple[Floats, Floats, Floats]:
    """Every row of Eq. (66g)-(66i), written down; the last column is that of the slack."""
    task, pose, seen = tick
    limits = task.limits
    A, low, high = [np.hstack([limits.J, np.zeros((len(limits.J), 1))])], [limits.J_low], [limits.J_high]
    distance, offsets = by_coal(pose, seen), seen.offsets
    for link, segment in enumerate(robot.segments):
        for limb, radius in enumerate(seen.radius_m):
            vertices = seen.vertices_m[offsets[limb] : offsets[limb + 1]]
            rows = approach_rows(
                link_segment(pose, link),
                vertices,
                distance[link, limb],
                clearance_m=segment.radius_m + radius,
                stop_s=STOP_S,
            )
            speed = np.full((len(rows.A), 1), -STOP_S * max(distance[link, limb], 1e-3))
            A.append(np.hstack([rows.A, speed]))
            high.append(rows.b)
            low.append(np.full(len(rows.b), -1e30))
    every: Floats = np.concatenate(A)
    every[np.abs(every) < 1e-13] = 0.0  # rounding errors of axes that do not move the link: daqp scales them up to rows
    return every, np.concatenate(low), np.concatenate(high)


def dense(robot: RobotModel, tick: Asked) -> tuple[Floats, bool]:
    """The same problem with all rows, by another solver; where they are soft, the slack follows the velocities."""
    A, low, high = all_rows(robot, tick)
    task = tick.task
    top, bottom, H, g = task.limits.high, task.limits.low, task.H, task.g
    if task.soft:
        top, bottom, g = np.append(top, 1e30), np.append(bottom, 0.0), np.append(g, 0.0)
        H = np.zeros((7, 7))
        H[:6, :6], H[6, 6] = task.H, SLACK
    upper, lower = np.concatenate([top, high]), np.concatenate([bottom, low])
    found = daqp.solve(H, g, np.ascontiguousarray(A[:, : len(g)]), upper, lower, primal_tol=1e-11, dual_tol=1e-12)
    return found[0], found[2] == 1


def asked(
    robot: RobotModel, state: RobotState, T: Floats, twist: Floats, seen: Obstacles, settings: PlanSettings = SETTINGS
) -> Asked:
    sight = observe(robot, state, seen, 0.0)
    task = problem(QpContext(robot, state, np.zeros(6), Target(T, twist, HOME), sight, seen, STOP_S), settings)
    return Asked(task, sight.pose, seen)


def random_tick(robot: RobotModel, rng: np.random.Generator) -> Asked:
    """Anything: singular wrists, robots at rest, people far and in contact."""
    q = rng.uniform(robot.q_min, robot.q_max) * 0.6
    q[4] *= rng.choice([0.0, 1e-4, 1.0, 1.0, 1.0])
    state = RobotState(q, rng.normal(size=6) * rng.choice([0.0, 0.1, 0.5]))
    pose = robot.pose(q, state.dq)
    T = pose.T_world_tcp.copy()
    T[:3, 3] += rng.normal(size=3) * 0.02
    T[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * 0.05).as_matrix() @ T[:3, :3]
    centre = pose.T_world_tcp[:3, 3] + rng.normal(size=3) * 0.6
    limbs = [cloud(rng, 40, rng.uniform(0.02, 0.3, 3)) + centre + rng.normal(size=3) * 0.25 for _ in range(6)]
    twist = pose.J_tcp @ (state.dq + rng.normal(size=6) * 0.1)
    return asked(robot, state, T, twist, obstacles(volumes(limbs), 0))


def moving(robot: RobotModel) -> RobotState:
    return RobotState(HOME, np.array([0.5, -0.3, 0.2, -1.0, 0.8, 0.001]))
