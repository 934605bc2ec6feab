"""A batch of ticks in one kernel: in each the people's volumes, the decision of a method, and the row of the motion.

It gives the numbers of the stages in Python, bit by bit, at a quarter of their time: between two ticks nothing is
converted. It ends before the first tick that a kernel does not decide alone, which Python then takes. A robot that
ignores people goes through the whole batch before they are looked at.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hrcreplay.geometry.vectors import norm_n
from hrcreplay.human.prediction.sound_volumes import sweep_sound
from hrcreplay.kernels import Held, njit
from hrcreplay.records import Bools, Floats, Ints
from hrcreplay.robot.control.control_step import (
    Taken,
    TickRules,
    horizon_after,
    look,
)
from hrcreplay.robot.control.path_tick import decide_on_path, go_blindly
from hrcreplay.robot.control.qp_tick import TickHulls, TickStart, decide_at_once
from hrcreplay.robot.control.separation import NearestLink, boxes, gap_of
from hrcreplay.robot.kinematics import RobotPose
from hrcreplay.robot.task import ReferencePoint, sample

#: A tick for the kernel: all people are known, or the newest frame of one is too old; or it is left to Python.
KNOWN, TOO_OLD, LEFT = range(3)


class PeopleAhead(NamedTuple):
    """Who is there at the ticks of a batch."""

    first: Ints  #: (n + 1,) first row of each tick
    number: Ints  #: number of each row's person
    what: Ints  #: (n,) KNOWN, TOO_OLD or LEFT
    latency_s: float  #: from the newest capture to the robot's reaction [s]


class Way(NamedTuple):
    """A method as numbers."""

    by_qp: bool  #: Eq. (66); otherwise along the path
    by_rows: bool  #: whether the rows of Eq. (66i) bound the rate along the path


class Moving(NamedTuple):
    """Robot and reference when a tick begins."""

    start: TickStart
    point: ReferencePoint  #: the reference


class MotionColumns(NamedTuple):
    """Rows of ``Motion`` that are being filled; fields as in ``MotionRow``."""

    q: Floats
    dq: Floats
    u: Floats
    ref_m: Floats
    tcp_m: Floats
    tcp_speed: Floats
    ref_speed: Floats
    programme_s: Floats
    distance_m: Floats
    overlap_m: Floats
    limb: Ints
    link: Ints
    status: Ints
    reason: Ints  #: index into ``REASONS``
    horizon_s: Floats
    tau_s: Floats
    certified: Bools


def empty_columns(ticks: int, axes: int) -> MotionColumns:
    """Columns for so many ticks of a robot with so many axes."""
    numbers: dict[str, Any] = {name: np.empty(ticks) for name in MotionColumns._fields}
    numbers |= {name: np.empty((ticks, axes)) for name in ("q", "dq", "u")}
    numbers |= {name: np.empty((ticks, 3)) for name in ("ref_m", "tcp_m")}
    whole = {name: np.empty(ticks, np.int64) for name in ("limb", "link", "status", "reason")}
    return MotionColumns(**numbers | whole | {"certified": np.empty(ticks, np.bool_)})


@njit(cache=True)
def run_ticks(
    scene: Held,
    way: Way,
    prepared: Held,
    people: PeopleAhead,
    moving: Moving,
    found: MotionColumns,
    tick: int,
) -> tuple[int, Moving]:
    """Moves a robot tick by tick, until the end of the batch or a tick that is left to Python.

    Args:
        scene: Arm, programmed path, rules and objects.
        way: The method.
        prepared: The people of the batch, for ``sweep_sound``.
        people: Who is there at each tick.
        moving: Robot and reference at the first tick; a robot along its path is on it.
        found: Receives the rows.
        tick: First tick.

    Returns:
        The first tick that is not done, and robot and reference then.
    """
    arm, grid, rules, static = scene.value
    while tick < len(found.status) and people.what[tick] != LEFT:
        start = moving.start
        hulls = _hulls_at(prepared, people, tick, horizon_after(len(start.stop.q) - 1, rules.ahead))
        if way.by_qp:
            seen = decide_at_once(arm, grid, rules, static, start, hulls)
            if not seen.decided:
                break
            taken, pose, nearest, planes = seen.taken, seen.pose, seen.nearest, seen.planes
            s_s, point = seen.s_s, seen.point
        else:
            there = decide_on_path(arm, grid, rules, way.by_rows, static, start, hulls)
            if not there.decided:
                break
            taken, pose, nearest, planes = there.taken, there.pose, there.nearest, there.planes
            s_s = taken.stop.along[0, 0]
            point = sample(grid, arm.chain, s_s)
        _write(found, tick, moving, pose, taken, rules)
        _write_gap(found, tick, people, nearest, len(hulls.radius))
        start = TickStart(taken.stop, found.u[tick].copy(), s_s, point.T_world_tcp, planes)
        moving = Moving(start, point)
        tick += 1
    return tick, moving


@njit(cache=True)
def run_blindly(scene: Held, moving: Moving, found: MotionColumns, tick: int) -> Moving:
    """Moves a robot that ignores people to the end of the batch; ``look_after`` measures its distances from them.

    Args:
        scene: Arm, programmed path, rules and objects.
        moving: Robot and reference at the first tick, on the path.
        found: Receives the rows but for the distances.
        tick: First tick.

    Returns:
        Robot and reference at the end.
    """
    arm, grid, rules, _ = scene.value
    for at in range(tick, len(found.status)):
        pose, taken = go_blindly(arm, grid, rules, moving.start.stop)
        _write(found, at, moving, pose, taken, rules)
        s_s = taken.stop.along[0, 0]
        point = sample(grid, arm.chain, s_s)
        moving = Moving(TickStart(taken.stop, found.u[at].copy(), s_s, point.T_world_tcp, moving.start.planes), point)
    return moving


@njit(cache=True)
def look_after(scene: Held, prepared: Held, people: PeopleAhead, found: MotionColumns, tick: int) -> None:
    """Measures the distances of a robot that has moved, at all ticks but those that are left to Python.

    Args:
        scene: Arm, programmed path, rules and objects.
        prepared: The people of the batch, for ``sweep_sound``.
        people: Who is there at each tick.
        found: The motion; receives the distances.
        tick: First tick.
    """
    arm, _, rules, _ = scene.value
    for at in range(tick, len(found.status)):
        if people.what[at] == LEFT:
            continue
        hulls = _hulls_at(prepared, people, at, found.horizon_s[at])
        volumes = hulls.vertices, hulls.offsets, hulls.radius, hulls.known
        _, _, nearest = look(arm, found.q[at], found.dq[at], *volumes, rules.clearance_m)
        _write_gap(found, at, people, nearest, len(hulls.radius))


@njit(cache=True, inner=True)
def _hulls_at(prepared: Held, people: PeopleAhead, tick: int, horizon_s: float) -> TickHulls:
    """The volumes of a tick that is not left to Python, which are valid until ``horizon_s`` after it [s]."""
    rows, known = (people.first[tick], people.first[tick + 1]), people.what[tick] == KNOWN
    return hulls_of(prepared, *rows, (horizon_s, horizon_s + people.latency_s), known)


@njit(cache=True)
def hulls_of(prepared: Held, first: int, last: int, until_s: tuple[float, float], known: bool) -> TickHulls:
    """The volumes of a tick that is not left to Python, as far as they are known.

    Args:
        prepared: The people of the batch, for ``sweep_sound``.
        first: First row of the tick.
        last: Past its last row.
        until_s: Time from the tick on for which the volumes are valid, and that with the latency [s].
        known: Whether all people of the tick are.
    """
    if not known:  # the robot stands, and no volume is looked at
        return TickHulls(np.empty((0, 3)), np.zeros(1, np.int64), np.empty(0), np.empty((0, 2, 3)), False, until_s[0])
    vertices, offsets, radii = sweep_sound(prepared, first, last, np.full(last - first, until_s[1]))
    radius = radii.reshape(-1)
    around, whole = boxes(vertices, offsets, radius)
    return TickHulls(vertices, offsets, radius, around, whole, until_s[0])


@njit(cache=True, inner=True)
def _write(found: MotionColumns, tick: int, moving: Moving, pose: RobotPose, taken: Taken, rules: TickRules) -> None:
    """Writes the row of a tick but for the distances, as ``make_step`` and ``motion_row`` make it.

    Args:
        found: Receives it.
        tick: The tick.
        moving: Robot and reference.
        pose: The robot's pose.
        taken: The motion executed.
        rules: Length of a tick, and how the horizon follows from the stop.
    """
    start, point, dt_s = moving.start, moving.point, rules.qp.dt_s
    ticks = len(start.stop.q) - 1
    found.q[tick], found.dq[tick] = start.stop.q[0], start.stop.dq[0]
    found.u[tick] = (taken.stop.dq[0] - start.stop.dq[0]) / dt_s
    found.ref_m[tick], found.ref_speed[tick] = point.T_world_tcp[:3, 3], norm_n(point.twist[:3])
    found.tcp_m[tick], found.tcp_speed[tick] = pose.T_world_tcp[:3, 3], norm_n(pose.twist_tcp[:3])
    found.programme_s[tick] = start.s_s
    found.status[tick], found.reason[tick], found.certified[tick] = taken.status, taken.reason, taken.certified
    found.horizon_s[tick], found.tau_s[tick] = horizon_after(ticks, rules.ahead), ticks * dt_s


@njit(cache=True, inner=True)
def _write_gap(found: MotionColumns, tick: int, people: PeopleAhead, nearest: NearestLink, count: int) -> None:
    """Writes the distances of a tick, with the place of the nearest volume among all possible ones.

    Args:
        found: Receives them.
        tick: The tick.
        people: Who is there.
        nearest: Distances from their volumes.
        count: Number of the volumes.
    """
    gap = gap_of(nearest)
    found.distance_m[tick], found.overlap_m[tick] = gap.distance_m, gap.overlap_m
    found.limb[tick], found.link[tick] = gap.limb, gap.link
    if gap.limb >= 0:  # as ``names_of`` has them
        each = count // (people.first[tick + 1] - people.first[tick])
        number = people.number[people.first[tick] + gap.limb // each]
        found.limb[tick] = (number - 1) * each + gap.limb % each
