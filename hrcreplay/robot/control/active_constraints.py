"""Constraints that limit a step: active rows of Eq. (66), rows that contradict each other, and refused stops.

From the solver only the solution is used. Non-negative least squares computes the multipliers from the rows, and
linear programs find rows that contradict each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linprog, nnls

from hrcreplay.geometry.distances import distances, segment_distance
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control import qp_controller
from hrcreplay.robot.control.control_step import PlanSettings, Proposal, Proposals
from hrcreplay.robot.control.controllers import (
    Controller,
    Observation,
    PathController,
    PflController,
    QpController,
    ScalingController,
    SsmController,
)
from hrcreplay.robot.control.metric_rows import Problem
from hrcreplay.robot.control.minimiser import Solution, minimise
from hrcreplay.robot.control.motion_check import MARGIN_M
from hrcreplay.robot.control.row_search import SLACK
from hrcreplay.robot.control.separation import Approach, Obstacles, rows_of_people
from hrcreplay.robot.control.static_obstacles import StaticObstacles, plane_rows
from hrcreplay.robot.control.stops import Stop
from hrcreplay.robot.model import RobotModel

#: A row is active if its link could approach faster by no more than this [m/s].
ACTIVE = 1e-6
#: A row whose multiplier is below this share of the largest one does not hold the robot back.
SHARE = 1e-3
#: Rows, scaled to length 1, contradict each other if their smallest violation is larger than this.
APART = 1e-9
#: Weight of the multipliers, relative to the rows.
RIDGE = 1e-6
#: Number of further rows that are reported in addition to the binding ones.
NEXT = 3


class TickContext(NamedTuple):
    """State of a controller before a tick, and its observation at the tick."""

    current_stop: Stop
    u_before: Floats
    s_s: float
    seen: Observation


class LinearRows(NamedTuple):
    """Bounds ``A @ w <= b`` on the next joint velocity, each with the name of its constraint."""

    A: Floats  #: (m, nv)
    b: Floats  #: (m,)
    names: tuple[dict[str, Any], ...]


def propose_explained(controller: Controller, context: TickContext) -> tuple[Proposals, dict[str, Any]]:
    """Proposals of a method at a tick, and the constraints that bound them.

    Args:
        controller: The controller; its state is set back to the tick.
        context: The tick.
    """
    controller.stop, controller.u, controller.s_s = context.current_stop, context.u_before, context.s_s
    controller.point = controller.reference.sample(context.s_s)
    if isinstance(controller, QpController):
        return _by_program(controller, context.seen)
    proposals = controller.propose(context.seen)
    if isinstance(controller, PflController):
        return proposals, {"binding": controller.slowest(context.seen)}
    if isinstance(controller, SsmController):
        return proposals, _protective(controller, context.seen)
    if isinstance(controller, ScalingController):
        dq = context.current_stop.rest().dq[0] if isinstance(proposals, int) else proposals[0].stop.dq[0]
        margins = margins_of(_rows(controller, context.seen, 0.0), dq, 0.0)
        broken = [row for row in margins if row["margin_m_per_s"] < -ACTIVE]
        if isinstance(proposals, int):  # even the hardest braking along the path violates a row
            stop = {"kind": "path", "what": "the hardest braking along the path"}
            return proposals, {"conflict": [*broken[:1], stop], "next": margins[len(broken) :][:NEXT]}
        active = [row for row in margins if row["margin_m_per_s"] <= 1e-4]
        return proposals, {"binding": active, "next": margins[len(active) :][:NEXT]}
    return proposals, {}


def _by_program(controller: QpController, seen: Observation) -> tuple[Proposals, dict[str, Any]]:
    """The proposals of Eq. (66), and the active rows of its solution or the rows that exclude a solution."""
    settings = controller.settings
    with np.errstate(all="ignore"):
        qp = controller.qp_context(seen)
        proposals = qp_controller.propose(qp, settings)
        task = qp_controller.problem(qp, settings)
        solved = minimise(task)
        if not isinstance(solved, Solution) and settings.plan.jerk_s > 0.0:
            task = qp_controller.problem(qp, settings.without_jerk())
            solved = minimise(task)
    if isinstance(solved, Solution):
        found = find_holding_rows(task, solved)
    else:
        found = {"unsolved": solved.status, "conflict": conflict(all_rows(task))}
    if controller.static is None:
        return proposals, found
    pose = seen.sight.pose
    which, _ = plane_rows(controller.static.shapes, pose.ends_m, pose.J_ends, 1.0)
    return proposals, name_planes(found, which, controller.static)


def name_planes(found: dict[str, Any], which: Ints, static: StaticObstacles) -> dict[str, Any]:
    """Says of each row of a plane which link it keeps off which object or link.

    Args:
        found: Result of ``find_holding_rows``.
        which: (n, 4) of ``plane_rows``.
        static: Objects of the cell and pairs of links.
    """
    named = dict(found)
    for key in ("binding", "next", "conflict"):
        rows: list[dict[str, Any]] = []
        for row in found.get(key, ()):
            if row["kind"] == "plane":
                link, end, hull, other = which[row["plane"]].tolist()
                more = {"kind": "object", "object": static.names[hull]}
                if hull < 0:
                    more = {"kind": "self", "other_link": other // 2}
                row = (
                    {name: value for name, value in row.items() if name != "plane"} | more | {"link": link, "end": end}
                )
            rows.append(row)
        if key in found:
            named[key] = rows
    return named


def _rows(controller: Controller, seen: Observation, give_way_m: float) -> Approach:
    """The approach rows of a tick."""
    pairs, plan = seen.sight.pairs, controller.settings.plan
    if pairs is None:
        raise ValueError("why: the distances from people are not known")
    rhs_m2 = pairs.constraint_rhs_m2(plan.constraint_rhs, give_way_m)
    return rows_of_people(seen.sight.pose, seen.obstacles, pairs, rhs_m2, seen.horizon_s + plan.lead_s)


def _protective(controller: SsmController, seen: Observation) -> dict[str, Any]:
    """Distances that speed and separation monitoring compares: the present and the protective distance."""
    proposals = PathController.propose(controller, seen)
    if isinstance(proposals, int):
        return {}
    now, needed_m = controller.protective(seen, proposals[0])
    pair = {"link": now.link, "limb": now.limb, "distance_m": now.distance_m}
    return {"protective": {**pair, "needed_m": needed_m}}


def find_holding_rows(task: Problem, solved: Solution) -> dict[str, Any]:
    """Active rows of people, sorted by their multipliers, active limits of the robot, and the next rows.

    Args:
        task: Eq. (66).
        solved: Minimiser of Eq. (66).
    """
    w, slack = solved.dq_next, solved.slack
    every, margins = all_rows(task), margins_of(task.rows, w, slack)
    loose = np.array([name["kind"] in ("approach", "plane") for name in every.names], dtype=float)
    active = np.flatnonzero(every.b + slack * loose - every.A @ w <= ACTIVE)
    A, pull = every.A[active], task.H @ w + task.g
    if task.soft:
        A, pull = np.column_stack([A, -loose[active]]), np.append(pull, SLACK * slack)
        if slack <= ACTIVE:  # the slack is at its bound 0
            A = np.vstack([A, -np.eye(len(pull))[-1]])
    weights = _least_weights(A, -pull)[: len(active)] if len(A) else np.zeros(0)
    limits, weight_of, vertex_of = [], dict[tuple[int, ...], float](), dict[tuple[int, ...], Any]()
    for i, weight in zip(active.tolist(), weights.tolist(), strict=True):
        name = every.names[i]
        if name["kind"] not in ("approach", "plane"):
            limits += [name] if weight > ACTIVE * np.abs(pull).max() else []
        elif solved.held and weight > 0.0:
            key = _key(name)
            vertex_of[key] = max(vertex_of.get(key, (-1.0, name)), (weight, name), key=lambda found: found[0])
            weight_of[key] = weight_of.get(key, 0.0) + weight
    least = SHARE * max(weight_of.values(), default=0.0)
    binding, others = [], []
    for row in margins:
        key = _key(row)
        if weight_of.get(key, 0.0) > least:
            binding.append({**row, **vertex_of[key][1], "multiplier": weight_of[key]})
        else:
            others.append(row)
    binding.sort(key=lambda row: -row["multiplier"])
    return {"binding": binding, "limits": limits, "next": others[:NEXT], "slack_m_per_s": slack}


def _key(row: dict[str, Any]) -> tuple[int, ...]:
    """Link, limb and row of Eq. (12) of a row of people; the index of a row of a plane."""
    return (row["plane"],) if row["kind"] == "plane" else (row["link"], row["limb"], row["end"])


def _least_weights(A: Floats, pull: Floats) -> Floats:
    """(m,) the smallest non-negative multipliers of rows (m, n) whose weighted sum is a pull (n,).

    If rows repeat each other, many multipliers give the same sum; the smallest are unique.
    """
    small = RIDGE * np.abs(A).max()
    return np.asarray(nnls(np.vstack([A.T, small * np.eye(len(A))]), np.append(pull, np.zeros(len(A))))[0])


def margins_of(rows: Approach, w: Floats, slack: float) -> list[dict[str, Any]]:
    """Worst vertex and speed margin of the link towards it, for each link, limb and row of Eq. (12).

    Args:
        rows: Approach rows of the tick.
        w: (nv,) next joint velocity [rad/s].
        slack: Slack that is added to the bound of every row [m/s].
    """
    found = []
    for link in range(len(rows.ends_m)):
        J_a, J_b = rows.J_ends[link]
        (a, b), v_a = rows.ends_m[link], J_a @ w
        for end, (v, rest) in enumerate(((v_a, -a @ v_a), (J_b @ w, -a @ (J_b @ w) - (b - a) @ v_a))):
            for limb in range(len(rows.offsets) - 1):
                first, last = rows.offsets[limb : limb + 2]
                vertex = int(first + np.argmax(rows.vertices_m[first:last] @ v))
                value = rows.stop_s * (rows.vertices_m[vertex] @ v + rest)
                margin = (rows.rhs_m2[link, limb] - value) / rows.per_speed[link, limb] + slack
                found.append(
                    {"kind": "approach", "link": link, "limb": limb, "end": end, "vertex": vertex - int(first)}
                    | {"vertex_m": rows.vertices_m[vertex].tolist(), "margin_m_per_s": float(margin)}
                )
    for i, margin in enumerate((rows.plane_high + slack - rows.planes @ w).tolist()):
        found.append({"kind": "plane", "plane": i, "margin_m_per_s": margin})
    return sorted(found, key=lambda row: (row["margin_m_per_s"], *_key(row)))


def _limits(task: Problem) -> tuple[Floats, Floats, tuple[dict[str, Any], ...]]:
    """The bounds of axes and TCP as rows."""
    limits = task.limits
    nv = len(limits.low)
    A = np.vstack([np.eye(nv), -np.eye(nv), limits.J, -limits.J])
    b = np.concatenate([limits.high, -limits.low, limits.J_high, -limits.J_low])
    names = [{"kind": "axis", "axis": j + 1, "side": side} for side in ("upper", "lower") for j in range(nv)]
    names += [
        {"kind": "tcp", "direction": j, "side": side} if j < 6 else {"kind": "speed"}
        for side in ("upper", "lower")
        for j in range(len(limits.J))
    ]
    kept = np.isfinite(b) & (A.any(axis=1))
    return A[kept], b[kept], tuple(name for name, keep in zip(names, kept, strict=True) if keep)


def all_rows(task: Problem) -> LinearRows:
    """Every row of Eq. (66), including the rows of all vertices."""
    A, b, names = _limits(task)
    rows, bounds, named = [A], [b], list(names)
    of = task.rows
    for link in range(len(of.ends_m)):
        (start, stop), (J_a, J_b) = of.ends_m[link], of.J_ends[link]
        for limb in range(len(of.offsets) - 1):
            vertices = of.vertices_m[of.offsets[limb] : of.offsets[limb + 1]]
            scale = of.stop_s / of.per_speed[link, limb]
            from_a = vertices - start
            for end, written in ((0, from_a @ J_a), (1, from_a @ J_b - (stop - start) @ J_a)):
                rows.append(scale * written)
                bounds.append(np.full(len(vertices), of.rhs_m2[link, limb] / of.per_speed[link, limb]))
                named += [
                    {"kind": "approach", "link": link, "limb": limb, "end": end, "vertex": j, "vertex_m": r.tolist()}
                    for j, r in enumerate(vertices)
                ]
    named += [{"kind": "plane", "plane": i} for i in range(len(of.plane_high))]
    return LinearRows(np.concatenate([*rows, of.planes]), np.concatenate([*bounds, of.plane_high]), tuple(named))


def conflict(rows: LinearRows) -> list[dict[str, Any]]:
    """A minimal set of rows that no velocity satisfies together; empty if a velocity satisfies all rows.

    Args:
        rows: All rows.
    """
    length = np.linalg.norm(rows.A, axis=1)
    empty = length < APART
    for i in np.flatnonzero(empty & (rows.b < -APART)).tolist():
        return [rows.names[i]]
    kept = np.flatnonzero(~empty)
    A, b = rows.A[kept] / length[kept, None], rows.b[kept] / length[kept]
    chosen = list(range(len(A)))
    broken, weights = _least_broken(A, b, chosen)
    if broken <= APART:
        return []
    chosen = [i for i in chosen if weights[i] > 0.0]
    if _least_broken(A, b, chosen)[0] <= APART:  # the multipliers missed a necessary row
        chosen = list(range(len(A)))
    for i in list(chosen):
        fewer = [j for j in chosen if j != i]
        if fewer and _least_broken(A, b, fewer)[0] > APART:
            chosen = fewer
    return [rows.names[kept[i]] for i in chosen]


def _least_broken(A: Floats, b: Floats, chosen: Sequence[int]) -> tuple[float, Floats]:
    """The smallest possible violation of the worst of the chosen rows, and the multipliers of the rows.

    Args:
        A: (m, nv) rows of length 1.
        b: (m,) bounds of the rows.
        chosen: Indices of the chosen rows.
    """
    n = A.shape[1]
    cost = np.append(np.zeros(n), 1.0)
    bounds = [(None, None)] * n + [(0.0, None)]
    left = np.hstack([A[chosen], -np.ones((len(chosen), 1))])
    found = linprog(cost, A_ub=left, b_ub=b[chosen], bounds=bounds, method="highs-ds")
    weights = np.zeros(len(A))
    weights[list(chosen)] = -found.ineqlin.marginals
    return float(found.fun), weights


def explain_refusal(
    robot: RobotModel,
    current_stop: Stop,
    proposal: Proposal,
    obstacles: Obstacles,
    horizon_s: float,
    settings: PlanSettings,
    static: StaticObstacles | None = None,
) -> dict[str, Any]:
    """First instant at which the step and the stop after it are not clear, with link and limb, object or other link.

    Args:
        robot: The manipulator.
        current_stop: The current stop; its row 0 is the present state of the robot.
        proposal: The proposal that was not certified.
        obstacles: The swept volumes of the tick.
        horizon_s: Time from the tick on for which the volumes are valid [s].
        settings: Settings of the method.
        static: Objects of the cell and pairs of links; None: there are none.
    """
    stop, last = proposal.stop, proposal.stop.q[-1]
    ends_s = (stop.ticks + 1) * settings.dt_s
    found: dict[str, Any] = {"stop_s": ends_s}
    if ends_s > horizon_s + 1e-9:
        return {**found, "why": "longer than the volumes hold"}
    beyond = np.flatnonzero((last < robot.q_min) | (last > robot.q_max))
    if len(beyond):
        return {**found, "why": "out of range", "axis": int(beyond[0]) + 1}
    radius = np.array([segment.radius_m for segment in robot.segments])
    keep_m = radius[:, None] + obstacles.radius_m + settings.plan.clearance_m + MARGIN_M
    q, dq = np.vstack((current_stop.q[:1], stop.q)), np.abs(np.vstack((current_stop.dq[:1], stop.dq)))
    turned = np.maximum(np.abs(np.diff(q, axis=0)), settings.dt_s * np.maximum(dq[:-1], dq[1:]))
    travel_m = np.vstack((turned @ robot.axis_reach_m, np.zeros((1, len(radius)))))
    worst = np.inf, 0, 0, 0, 0, 0.0
    for i in range(len(q)):  # until the next tick a link moves by at most its travel
        low, _, near = distances(robot.ends_m(q[i]), obstacles.vertices_m, obstacles.offsets)
        left = low - keep_m - travel_m[i][:, None]
        link, limb = divmod(int(np.argmin(left)), left.shape[1])
        if left[link, limb] < worst[0]:
            gap_m = float(low[link, limb] - keep_m[link, limb])
            worst = float(left[link, limb]), i, link, limb, int(near[link, limb, 0]), gap_m
        if worst[0] <= 0.0:
            break
    left_m, i, link, limb, vertex, gap_m = worst
    beside = None if static is None else _static_refusal(robot, static, q, dq, settings.dt_s)
    if beside is not None and beside["left_m"] < left_m:
        left = beside.pop("left_m")
        return found | beside | {"why": "not clear" if beside["gap_m"] <= 0.0 else _unproven(left)}
    why = "not clear" if gap_m <= 0.0 else _unproven(left_m)
    found |= {"why": why, "failed_s": i * settings.dt_s, "link": link, "limb": limb, "gap_m": gap_m}
    found["travel_m"] = float(travel_m[i, link])
    return found | {"vertex_m": obstacles.vertices_m[vertex].tolist()}


def _unproven(left_m: float) -> str:
    """Why a stop with a gap was refused."""
    return "not proven until the next tick" if left_m <= 0.0 else "hardly clear"


def _static_refusal(robot: RobotModel, static: StaticObstacles, q: Floats, dq: Floats, dt_s: float) -> dict[str, Any]:
    """The row of a motion at which a link is least clear of objects and links, up to the first one that is not clear.

    Args:
        robot: The manipulator.
        static: Objects of the cell and pairs of links.
        q: (n, nv) rows of the motion [rad].
        dq: (n, nv) speeds of the axes [rad/s].
        dt_s: Length of a tick [s].
    """
    turned = np.maximum(np.abs(np.diff(q, axis=0)), dt_s * np.maximum(dq[:-1], dq[1:]))
    none = np.zeros((1, len(q[0])))
    travel, between = np.vstack((turned, none)) @ robot.axis_reach_m, np.vstack((turned, none)) @ static.pair_reach_m
    worst: dict[str, Any] = {"left_m": np.inf, "gap_m": np.inf}
    for i in range(len(q)):
        ends = robot.ends_m(q[i])
        gaps = [
            (float(low), float(travel[i, s]), {"link": s, "object": static.names[k]})
            for s, row in enumerate(distances(ends, static.vertices_m, static.offsets)[0] - static.keep_m)
            for k, low in enumerate(row)
        ]
        for p, (one, two) in enumerate(static.pairs.tolist()):
            apart = segment_distance(ends[one], ends[two])[0] - static.pair_keep_m[p]
            gaps.append((float(apart), float(between[i, p]), {"link": one, "other_link": two}))
        for gap, travelled, of in gaps:
            if gap - MARGIN_M - travelled < worst["left_m"]:
                worst = {"left_m": gap - MARGIN_M - travelled, "gap_m": gap - MARGIN_M, "travel_m": travelled}
                worst |= of | {"failed_s": i * dt_s}
        if worst["left_m"] <= 0.0:
            break
    return worst
