"""The programmed task: waypoints, joint positions that reach them, and the reference, which is the path over time.

The reference is the motion of the robot when no person is present.

A task comes from a task file (TOML) or from a log, with the same structure; ``hrcreplay init`` writes a file that
explains every key (``commands/task_template.toml``).

The robot stops at every waypoint. It stands at the first waypoint for its dwell before it starts. It moves from the
first to the last waypoint ``cycles`` times; between two cycles it goes back to the first by the ``move`` of the first.
On a straight line the TCP turns by at most 2 pi rad for every 2.5 m of the TCP speed, so this also limits a pure turn.

Inverse kinematics is damped least squares from fixed seeds, so it is deterministic: the same pose from the same joint
positions gives the same solution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from hrcreplay.geometry import small_matrices
from hrcreplay.geometry.small_matrices import apply, multiply
from hrcreplay.geometry.vectors import dot_n, norm_n, speed_of, turn_between
from hrcreplay.kernels import njit
from hrcreplay.records import Floats
from hrcreplay.robot.kinematics import Chain, axis_frames, tcp_jacobian
from hrcreplay.robot.model import RobotModel
from hrcreplay.settings.sections import Plan
from hrcreplay.toml_file import validate

#: The longest cycle of a task [s].
CYCLE_S = 7200.0

_Share = Annotated[float, Field(gt=0, le=1)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Three = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
_Quaternion = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class Waypoint(_Strict):
    """A place where the robot stops, as joint angles or as a pose of the TCP in the robot's base frame."""

    name: str = ""
    """Shown in messages."""
    joints_deg: tuple[FiniteFloat, ...] | None = None
    """An angle an axis [deg]."""
    joints_rad: tuple[FiniteFloat, ...] | None = None
    """An angle an axis [rad]."""
    position_m: _Three | None = None
    """TCP in the base frame [m]."""
    rpy_deg: _Three | None = None
    """Its orientation, Rz(yaw) Ry(pitch) Rx(roll) [deg]."""
    quaternion_wxyz: _Quaternion | None = None
    """Its orientation, scalar first."""
    move: Literal["joint", "linear"] = "joint"
    """How the robot gets here: every axis on its own way, or the TCP on a straight line."""
    tcp_speed_m_per_s: _Positive | None = None
    """Top speed of the TCP on the way here; none: the task's [m/s]."""
    dwell_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    """How long the robot stands here [s]."""

    @model_validator(mode="after")
    def _one_place(self) -> Waypoint:
        places = [n for n in ("joints_deg", "joints_rad", "position_m") if getattr(self, n) is not None]
        turns = [n for n in ("rpy_deg", "quaternion_wxyz") if getattr(self, n) is not None]
        if len(places) != 1:
            raise ValueError(f"found {_listed(places)}; give exactly one of joints_deg, joints_rad, position_m")
        if (places == ["position_m"]) != (len(turns) == 1) or len(turns) > 1:
            raise ValueError(
                f"found {places[0]} with {_listed(turns)}; "
                "position_m takes one of rpy_deg, quaternion_wxyz, and joints take none"
            )
        if self.quaternion_wxyz is not None and sum(v * v for v in self.quaternion_wxyz) < 1e-6:
            raise ValueError(f"found quaternion_wxyz {list(self.quaternion_wxyz)}; its length must not be 0")
        return self


class Task(_Strict):
    """The waypoints of a cycle and how fast to pass them."""

    name: str = "task"
    """Shown in the report."""
    waypoints: Annotated[tuple[Waypoint, ...], Field(min_length=2, max_length=1000)]
    """In order; the first is the start."""
    repeat: bool = False
    """Start over until the log ends."""
    cycles: Annotated[int, Field(ge=1)] = 1
    """How often to run the waypoints, unless they repeat."""
    speed: _Share = 0.5
    """Share of every axis' top speed."""
    acceleration: _Share = 0.5
    """Share of every axis' acceleration limit."""
    tcp_speed_m_per_s: _Positive = 1.0
    """Top speed of the TCP [m/s]."""
    tcp_acceleration_m_per_s2: _Positive = 4.0
    """Top acceleration of the TCP on linear moves [m/s^2]."""

    @model_validator(mode="after")
    def _not_endless(self) -> Task:
        dwell_s = sum(waypoint.dwell_s for waypoint in self.waypoints)
        if dwell_s > CYCLE_S:
            raise ValueError(f"found dwells of {dwell_s:.0f} s in all; a cycle takes at most {CYCLE_S:.0f} s")
        return self

    @model_validator(mode="after")
    def _repeat_or_cycles(self) -> Task:
        if self.repeat and "cycles" in self.model_fields_set:
            raise ValueError(f"found repeat = true and cycles = {self.cycles}; give one of them")
        return self

    def label(self, index: int) -> str:
        """Name of a waypoint in messages, counted from 1."""
        name = self.waypoints[index].name
        return f"waypoint {index + 1}" + (f" ({name})" if name else "")


def parse_task(table: dict[str, Any], where: str = "task") -> Task:
    """Makes a task from the parsed task file.

    Args:
        table: Table that ``tomllib`` reads from a task file.
        where: Prefix of error messages, e.g. the file's path.

    Raises:
        SettingsError: A key is unknown or a value is invalid; the message names the waypoint.
    """
    return validate(Task, table, where)


def _listed(names: list[str]) -> str:
    return " and ".join(names) or "none"


_SEEDS = 16
_ITERATIONS = 80
_TOLERANCE = 1e-9  # of position [m] and orientation [rad]


@dataclass(frozen=True)
class Missed:
    """Pose error of the best attempt when no joint position reaches the pose [m, rad]."""

    position_m: float
    angle_rad: float


def solve(model: RobotModel, T_world_tcp: Floats, near: Floats) -> Floats | Missed:
    """The joint position within the limits that reaches a pose and takes the least time from ``near``.

    Args:
        model: The robot.
        T_world_tcp: (4, 4) pose to reach, world frame [m].
        near: (nv,) joint positions before the move [rad].

    Returns:
        (nv,) [rad], or the pose error of the best attempt.
    """
    found: list[Floats] = []
    missed = Missed(np.inf, np.inf)
    for seed in (near, *_seeds(model)):
        q, error = descend(model, T_world_tcp, seed)
        if np.abs(error).max() <= _TOLERANCE:
            found.append(_unwind(model, q, near))
        else:
            missed = min(
                missed,
                Missed(norm_n(error[:3]), norm_n(error[3:])),
                key=lambda m: m.position_m + m.angle_rad,
            )
    return min(found, key=lambda q: float(np.abs((q - near) / model.dq_max).max())) if found else missed


def descend(model: RobotModel, T_world_tcp: Floats, seed: Floats) -> tuple[Floats, Floats]:
    """Runs damped least squares within the limits from one seed.

    Args:
        model: The robot.
        T_world_tcp: (4, 4) pose to reach, world frame [m].
        seed: (nv,) [rad].

    Returns:
        (nv,) last joint positions [rad] and their (6,) pose error [m, rad].
    """
    q, still = seed, np.zeros(model.nv)
    for _ in range(_ITERATIONS):
        pose = model.pose(q, still)
        q_next, error = _step(q, pose.J_tcp, pose.T_world_tcp, T_world_tcp, model.q_min, model.q_max)
        if np.abs(error).max() <= _TOLERANCE * 1e-2 or np.array_equal(q_next, q):
            break
        q = q_next
    return q, error


def _step(q: Floats, J: Floats, T: Floats, T_goal: Floats, q_min: Floats, q_max: Floats) -> tuple[Floats, Floats]:
    error = np.empty(6)
    error[:3] = T_goal[:3, 3] - T[:3, 3]
    error[3:] = turn_between(T, T_goal)
    damping = 0.1 * dot_n(error, error) + 1e-12  # goes to zero at the solution, for fast convergence
    dq = apply(J.T, small_matrices.solve(multiply(J, J.T) + damping * np.eye(6), error))
    return np.minimum(np.maximum(q + dq, q_min), q_max), error


def _seeds(model: RobotModel) -> Floats:
    """(n, nv) joint positions, spread evenly over the ranges with the generalised golden ratio."""
    ratio = 2.0
    for _ in range(60):
        ratio = (1 + ratio) ** (1 / (model.nv + 1))
    share = (0.5 + np.outer(np.arange(1, _SEEDS + 1), [ratio**-axis for axis in range(1, model.nv + 1)])) % 1
    low, high = np.maximum(model.q_min, -np.pi), np.minimum(model.q_max, np.pi)
    return np.where(low < high, low + share * (high - low), model.q_min)


def _unwind(model: RobotModel, q: Floats, near: Floats) -> Floats:
    """Shifts every axis by full turns to the position nearest to ``near`` within its range."""
    turn = 2 * np.pi
    turns = np.round((near - q) / turn)
    fewest = np.ceil((model.q_min - q) / turn)
    most = np.floor((model.q_max - q) / turn)
    return q + turn * np.clip(turns, fewest, most)


#: Step of a reference's time grid; between grid points the reference is a cubic [s].
STEP_S = 0.004

#: Rounding tolerance: a programmed time within this share of a step of a grid point counts as that grid point.
_ON_GRID = 1e-6


class ReferencePoint(NamedTuple):
    """The reference at one instant, world frame."""

    q: Floats  #: (nv,) [rad]
    dq: Floats  #: (nv,) [rad/s]
    ddq: Floats  #: (nv,) [rad/s^2]
    T_world_tcp: Floats  #: (4, 4)
    twist: Floats  #: (6,) linear and angular velocity of the TCP [m/s, rad/s]

    @property
    def tcp_speed(self) -> float:
        """Speed of the TCP [m/s]."""
        return speed_of(self.twist)


class Grid(NamedTuple):
    """A path on the time grid without the robot, for kernels; see ``Reference``."""

    q: Floats  #: (n, nv) [rad]
    dq: Floats  #: (n, nv) [rad/s]
    end: int  #: grid point of the last waypoint
    duration_s: float  #: from the start to the end of the last cycle [s]
    waypoints_s: Floats  #: (w,) arrival at each waypoint of the first cycle [s]
    tcp_speed_max: Floats  #: (n,) limit at each grid point [m/s]


@dataclass(frozen=True)
class Reference:
    """A path over time that starts at ``q[0]``, runs ``cycles`` times and stops at its end.

    A cycle is the whole grid; the last cycle ends at grid point ``end``, before the move back to the start.
    """

    model: RobotModel
    q: Floats  #: (n, nv) on the grid [rad]
    dq: Floats  #: (n, nv) [rad/s]
    end: int  #: grid point of the last waypoint
    cycles: float  #: inf: until the log ends
    waypoints_s: tuple[float, ...]  #: arrival at each waypoint of the first cycle [s]
    tcp_speed_max: Floats  #: (n,) limit at each grid point: that of its move, or of the move before its dwell [m/s]

    @property
    def q0(self) -> Floats:
        """(nv,) joint positions at the start [rad]."""
        return self.q[0]

    @property
    def cycle_s(self) -> float:
        """Duration of one cycle, including the move back [s]."""
        return (len(self.q) - 1) * STEP_S

    @property
    def duration_s(self) -> float:
        """Time from the start to the end of the last cycle; inf if the task repeats [s]."""
        return (self.cycles - 1) * self.cycle_s + self.end * STEP_S

    @cached_property
    def grid(self) -> Grid:
        """The path for kernels."""
        waypoints_s = np.array(self.waypoints_s, dtype=float)
        return Grid(self.q, self.dq, self.end, float(self.duration_s), waypoints_s, self.tcp_speed_max)

    def next_waypoint(self, s_s: float) -> float:
        """Programmed time of the next arrival at a waypoint, at or after ``s_s``; inf after the last one [s]."""
        return next_waypoint(self.grid, float(s_s))

    def tcp_speed_limit(self, s_s: float) -> float:
        """Programmed speed limit of the TCP at a programmed time [s]; valid until the next move begins [m/s].

        A task gives a limit for each move; for other paths the limit is their greatest speed.
        """
        return tcp_speed_limit(self.grid, float(s_s))

    def sample(self, s_s: float) -> ReferencePoint:
        """The reference ``s_s`` seconds of programmed time after its start.

        The position is a cubic through the grid points. Velocity and acceleration are its exact derivatives. Pose and
        twist of the TCP follow from position and velocity. Before the start and after the end the reference is at rest.
        """
        return sample(self.grid, self.model.chain, float(s_s))


@njit(cache=True)
def sample(grid: Grid, chain: Chain, s_s: float) -> ReferencePoint:
    """Samples a path for a robot; see ``Reference.sample``."""
    q, dq, ddq = place(grid, s_s)
    T, J = tcp_jacobian(chain, axis_frames(chain, q))
    return ReferencePoint(q, dq, ddq, T, apply(J, dq))


@njit(cache=True)
def next_waypoint(grid: Grid, s_s: float) -> float:
    """Programmed time of the next arrival at a waypoint; see ``Reference.next_waypoint`` [s]."""
    if not len(grid.waypoints_s) or s_s > grid.duration_s:
        return np.inf
    cycle_s = (len(grid.q) - 1) * STEP_S
    cycle = math.floor(s_s / cycle_s)
    for n in (cycle, cycle + 1):
        for at_s in grid.waypoints_s:
            if n * cycle_s + at_s >= s_s:
                return n * cycle_s + at_s
    return np.inf


@njit(cache=True)
def tcp_speed_limit(grid: Grid, s_s: float) -> float:
    """Programmed speed limit of the TCP; see ``Reference.tcp_speed_limit`` [m/s]."""
    if not 0.0 <= s_s < grid.duration_s:
        return float(grid.tcp_speed_max[0 if s_s < 0.0 else grid.end])
    at = math.ceil(s_s % ((len(grid.q) - 1) * STEP_S) / STEP_S - _ON_GRID)
    return float(grid.tcp_speed_max[min(at, len(grid.q) - 1)])


@njit(cache=True)
def place(grid: Grid, s_s: float) -> tuple[Floats, Floats, Floats]:
    """Position, velocity and acceleration (nv,) each, ``s_s`` seconds of programmed time after a path's start."""
    nv = grid.q.shape[1]
    q, dq, ddq = np.empty(nv), np.empty(nv), np.empty(nv)
    write_place(grid, s_s, q, dq, ddq)
    return q, dq, ddq


@njit(cache=True, inner=True)
def write_place(grid: Grid, s_s: float, q: Floats, dq: Floats, ddq: Floats) -> None:
    """Writes what ``place`` returns: the cubic through the grid points around a time, and its two derivatives.

    Args:
        grid: The path.
        s_s: Programmed time [s].
        q: (nv,) receives the position [rad].
        dq: (nv,) receives the velocity [rad/s].
        ddq: (nv,) receives the acceleration [rad/s^2].
    """
    if not 0.0 <= s_s < grid.duration_s:
        q[:], dq[:], ddq[:] = grid.q[0 if s_s < 0.0 else grid.end], 0.0, 0.0
        return
    at = s_s % ((len(grid.q) - 1) * STEP_S) / STEP_S
    i = min(int(at), len(grid.q) - 2)
    share = at - i
    for j in range(len(q)):
        way, m0, m1 = grid.q[i + 1, j] - grid.q[i, j], grid.dq[i, j] * STEP_S, grid.dq[i + 1, j] * STEP_S
        b, a = 3 * way - 2 * m0 - m1, m0 + m1 - 2 * way
        q[j] = grid.q[i, j] + share * (m0 + share * (b + share * a))
        dq[j] = (m0 + share * (2 * b + share * 3 * a)) / STEP_S
        ddq[j] = (2 * b + share * 6 * a) / STEP_S**2


class Waits(NamedTuple):
    """Settings of a reference that waits for the robot, as numbers for kernels."""

    by_path: bool  #: False: the programmed time runs with the clock
    lead_m: float  #: the reference stops if the TCP is this far away [m]
    waypoint_m: float  #: it leaves a waypoint once the TCP is this close [m]
    catch_up_m_per_s: float  #: TCP speed that is always allowed; inf: any [m/s]


def waits(plan: Plan) -> Waits:
    """The settings of the reference as numbers."""
    free = plan.catch_up_speed_m_per_s == "free"
    return Waits(
        plan.reference == "path",
        float(plan.max_reference_lead_m),
        float(plan.waypoint_m),
        math.inf if free else float(plan.catch_up_speed_m_per_s),
    )


@njit(cache=True)
def advance(grid: Grid, s_s: float, dt_s: float, tcp_error_m: float, rules: Waits) -> tuple[float, float]:
    """Advances the programmed time by one tick.

    With ``time`` the programmed time runs with the clock, so a robot that must wait falls behind the reference.
    With ``path`` it runs with the clock while the TCP is within half of ``max_reference_lead_m`` of the reference. With
    a larger error it slows down smoothly, and it stops at ``max_reference_lead_m`` or if the error is unknown. It also
    stops at every waypoint until the TCP is within ``waypoint_m``, so the robot never skips a waypoint. In both modes
    the programmed time never runs backwards.

    Args:
        grid: The programmed path.
        s_s: Programmed time [s].
        dt_s: Length of the tick [s].
        tcp_error_m: Distance from the TCP to the reference at ``s_s`` [m].
        rules: Mode of the reference and when it waits.

    Returns:
        Programmed time at the next tick [s] and the rate in [0, 1]: the reference's velocity is ``rate * twist``.
    """
    if not rules.by_path:
        return s_s + dt_s, 1.0
    slack = 2.0 - 2.0 * tcp_error_m / rules.lead_m  # 1 at half the allowed lead, 0 at the full lead
    if not slack > 0.0:
        return s_s, 0.0
    rate = 1.0 if slack >= 1.0 else slack * slack * (3.0 - 2.0 * slack)
    ahead_s = s_s + rate * dt_s
    if not tcp_error_m <= rules.waypoint_m:
        ahead_s = min(ahead_s, next_waypoint(grid, s_s))
    return ahead_s, (ahead_s - s_s) / dt_s


@njit(cache=True)
def tcp_speed_cap(grid: Grid, s_s: float, rules: Waits) -> float:
    """Largest allowed TCP speed of a robot that follows a reference, also while it catches up [m/s].

    A reference that waits leaves a waypoint only after the TCP is near it. Robot and reference are then on the same
    move, and the limit of that move applies. A reference that runs with the clock may be several moves ahead; then the
    greatest limit of all moves applies.

    Args:
        grid: The programmed path.
        s_s: Programmed time [s].
        rules: Mode of the reference and the allowed speed for catching up.
    """
    if rules.catch_up_m_per_s == np.inf:
        return np.inf
    limit = tcp_speed_limit(grid, s_s) if rules.by_path else grid.tcp_speed_max.max()
    return max(limit, rules.catch_up_m_per_s)


@njit(cache=True)
def follow(
    grid: Grid, chain: Chain, s_s: float, T_world_ref: Floats, T_world_tcp: Floats, dt_s: float, rules: Waits
) -> tuple[float, float, ReferencePoint, float]:
    """One tick of the reference of a robot.

    Args:
        grid: The programmed path.
        chain: The robot.
        s_s: Programmed time [s].
        T_world_ref: (4, 4) the reference at that time.
        T_world_tcp: (4, 4) the TCP.
        dt_s: Length of the tick [s].
        rules: When the reference waits.

    Returns:
        Programmed time at the next tick [s], the rate, the reference at that time, and the allowed TCP speed [m/s].
    """
    s_s, rate = advance(grid, s_s, dt_s, norm_n(T_world_tcp[:3, 3] - T_world_ref[:3, 3]), rules)
    return s_s, rate, sample(grid, chain, s_s), tcp_speed_cap(grid, s_s, rules)
