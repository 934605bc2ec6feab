"""Paths of references: from a programmed task, from recorded joint positions, and the approach to a path's start.

Every move of a task starts and ends at rest. It is sampled on a regular time grid and keeps the limits of the axes and
of the TCP.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from ruckig import InputParameter, Result, Ruckig, Trajectory
from scipy.spatial.transform import Rotation

from hrcreplay.errors import LogError, SettingsError
from hrcreplay.geometry.small_matrices import least_norm, multiply
from hrcreplay.geometry.vectors import norm_n, turn_between
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.task import CYCLE_S, STEP_S, Missed, Reference, Task, Waypoint, descend, solve

#: The acceleration rises from zero to its limit in this time: jerk limit = acceleration limit / RAMP_S [s].
RAMP_S = 0.1

#: On a straight line the TCP turns by at most this much per metre; ABB allows 2 pi rad/s at 2.5 m/s [rad/m].
TURN_RAD_PER_M = 2 * math.pi / 2.5

#: If the axis limits slow a straight line down by more than this factor, it passes a singular posture.
_SLOWEST = 20.0


@dataclass(frozen=True)
class Pace:
    """Speed limits of a move."""

    dq_max: Floats  #: (nv,) [rad/s]
    ddq_max: Floats  #: (nv,) [rad/s^2]
    tcp_speed: float  #: [m/s]
    tcp_acceleration: float  #: along straight lines [m/s^2]
    step_s: float  #: time grid [s]


#: Longest duration of a move [s].
MOVE_S = 300.0


class _TooSlow(Exception):
    """A move would take too long."""

    def __init__(self, duration_s: float) -> None:
        super().__init__()
        self.duration_s = duration_s


@dataclass(frozen=True)
class JointTrajectory:
    """Joint positions and velocities on the time grid; the first and the last row are at rest."""

    q: Floats  #: (n, nv) [rad]
    dq: Floats  #: (n, nv) [rad/s]


def joint_move(model: RobotModel, start: Floats, end: Floats, pace: Pace) -> JointTrajectory:
    """Moves all axes in proportion, so that they start and stop together.

    Args:
        model: The robot.
        start: (nv,) [rad].
        end: (nv,) [rad].
        pace: Limits of axes and TCP.
    """
    way = end - start
    if not np.any(way):
        return JointTrajectory(start[None], np.zeros_like(start)[None])
    with np.errstate(divide="ignore"):
        speed, acceleration = (float((limit / np.abs(way)).min()) for limit in (pace.dq_max, pace.ddq_max))

    def along(share: Floats, rate: Floats) -> JointTrajectory:
        return JointTrajectory(start + np.outer(share, way), np.outer(rate, way))

    return _paced(model, pace, along, 1.0, speed, acceleration, "")


def linear_move(model: RobotModel, start: Floats, T_world_end: Floats, pace: Pace, where: str) -> JointTrajectory:
    """Moves the TCP on a straight line while it turns evenly about one axis.

    Args:
        model: The robot.
        start: (nv,) [rad].
        T_world_end: (4, 4) pose of the TCP to reach, world frame [m].
        pace: Limits of axes and TCP.
        where: Prefix of error messages.

    Raises:
        SettingsError: The line leaves the arm's range or passes a singular posture.
    """
    T_start = model.pose(start, np.zeros(model.nv)).T_world_tcp
    way_m = T_world_end[:3, 3] - T_start[:3, 3]
    turn_rad = turn_between(T_start, T_world_end)
    length = max(norm_n(way_m), norm_n(turn_rad) / TURN_RAD_PER_M)
    if length < 1e-9:
        return JointTrajectory(start[None], np.zeros_like(start)[None])
    twist_per_m = np.concatenate([way_m, turn_rad]) / length

    def along(s_m: Floats, rate: Floats) -> JointTrajectory:
        q, dq = np.empty((len(s_m), model.nv)), np.zeros((len(s_m), model.nv))
        now = start
        T = np.eye(4)
        for i, s in enumerate(s_m):
            T[:3, 3] = T_start[:3, 3] + s / length * way_m
            T[:3, :3] = multiply(Rotation.from_rotvec(s / length * turn_rad).as_matrix(), T_start[:3, :3])
            now, error = descend(model, T, now)
            if np.abs(error).max() > 1e-6:
                raise SettingsError(
                    f"{where}: the straight line to it leaves the arm's range after {s:.3f} m of {length:.3f} m; "
                    'use move = "joint" or start from another posture'
                )
            q[i] = now
            dq[i] = least_norm(model.pose(now, np.zeros(model.nv)).J_tcp, twist_per_m, 1e-9) * rate[i]
        return JointTrajectory(q, dq)

    return _paced(model, pace, along, length, pace.tcp_speed, pace.tcp_acceleration, where)


def _paced(
    model: RobotModel,
    pace: Pace,
    along: Callable[[Floats, Floats], JointTrajectory],
    length: float,
    speed: float,
    acceleration: float,
    where: str,
) -> JointTrajectory:
    """Runs a path with a jerk-limited profile, as fast as the axes and the TCP allow.

    While an axis exceeds its limits, speed and acceleration of the profile are divided by the excess. If this does not
    reduce an axis acceleration, the curvature of the path causes it; then the speed is lowered further.
    """
    slowest, softest, before = speed / _SLOWEST, acceleration / _SLOWEST**2, math.inf
    while True:
        track = along(*_profile(length, speed, acceleration, pace.step_s))
        faster, harder = _excess(model, track, pace)
        if max(faster, harder) <= 1.0 + 1e-9:
            return track
        curved = math.sqrt(harder) if harder > max(1.0, 0.9 * before) else 1.0
        speed /= max(1.0, faster) * curved * 1.0001
        acceleration /= max(1.0, harder) * 1.0001
        before = harder
        if where and (speed < slowest or acceleration < softest):
            raise SettingsError(
                f"{where}: on the straight line to it an axis would have to be {_SLOWEST:.0f} times as fast as it is; "
                'the arm passes a singular posture: use move = "joint" or start from another posture'
            )


def _profile(length: float, speed: float, acceleration: float, step_s: float) -> tuple[Floats, Floats]:
    """Position and speed along a path on the time grid; the duration is stretched to a whole number of steps.

    Raises:
        _TooSlow: The path takes longer than MOVE_S.
    """
    least_s = max(length / speed, math.sqrt(length / acceleration))  # before the grid and ruckig
    if not least_s <= MOVE_S:
        raise _TooSlow(least_s)
    task = InputParameter(1)
    task.current_position, task.target_position = [0.0], [length]
    task.max_velocity, task.max_acceleration, task.max_jerk = [speed], [acceleration], [acceleration / RAMP_S]
    fastest = Trajectory(1)
    result = Ruckig(1).calculate(task, fastest)
    if result != Result.Working:
        raise RuntimeError(f"ruckig: {result} for {length} m or rad at {speed}, {acceleration}")
    if fastest.duration > MOVE_S:
        raise _TooSlow(fastest.duration)
    steps = max(1, math.ceil(fastest.duration / step_s))
    stretch = steps * step_s / fastest.duration
    states = [fastest.at_time(fastest.duration * i / steps) for i in range(steps + 1)]
    s, ds = (np.array([state[order][0] for state in states]) for order in (0, 1))
    s[0], s[-1], ds[0], ds[-1] = 0.0, length, 0.0, 0.0
    return np.clip(s, 0.0, length), ds / stretch


def _excess(model: RobotModel, track: JointTrajectory, pace: Pace) -> tuple[float, float]:
    """Largest ratios of the path's speed and acceleration to the limits of axes and TCP."""
    way, first, last = np.diff(track.q, axis=0) / pace.step_s, track.dq[:-1], track.dq[1:]
    speeds = np.concatenate([track.dq, 1.5 * way - 0.25 * (first + last)])  # extremes of the cubics between grid points
    accelerations = np.concatenate([6 * way - 4 * first - 2 * last, 2 * first + 4 * last - 6 * way]) / pace.step_s
    tcp = [model.pose(q, dq).tcp_speed for q, dq in zip(track.q, track.dq, strict=True)]
    return (
        max(float((np.abs(speeds) / pace.dq_max).max()), max(tcp) / pace.tcp_speed),
        float((np.abs(accelerations) / pace.ddq_max).max()),
    )


#: Window of the cubics that smooth a recorded track [s].
_SMOOTH_S = 0.1

#: A recorded position may be this far outside the range, because encoders are noisy at a mechanical stop [rad].
_NOISE_RAD = math.radians(1.0)

#: A recorded axis may exceed its speed limit by this share, because time stamps jitter. A remark reports it.
_NOISE_SPEED = 0.1

#: Positions look like degrees if more than this share of the rows is out of range as radians and none as degrees.
_MOSTLY = 0.1

#: An endless axis that turns further than this in one direction was probably recorded in degrees [rad].
_TURNS_RAD = 6 * math.pi


def plan_programme(task: Task, model: RobotModel, where: str = "task") -> Reference:
    """The path of a task, time-parametrised within the limits of the axes.

    Args:
        task: The waypoints.
        model: The robot; the task's poses are in its base frame.
        where: Prefix of error messages.

    Raises:
        SettingsError: A waypoint is out of reach or range, or the robot cannot follow a straight line; the message
            names the waypoint.
    """
    start = _joints(model, task, 0, np.clip(np.zeros(model.nv), model.q_min, model.q_max), where)
    tracks = [_stand(start, task.waypoints[0].dwell_s)]
    arrivals_s, limits, end = [0.0], [_speed_limit(task, 0)], 0
    for index in range(1, len(task.waypoints)):
        tracks.append(_timed_move(model, task, index, tracks[-1].q[-1], where))
        if _steps(tracks) * STEP_S > CYCLE_S:
            raise SettingsError(
                f"{where}: a cycle of over {CYCLE_S:.0f} s at {task.label(index)}; at most that is planned, so make it "
                "faster or shorter"
            )
        arrivals_s.append(_steps(tracks) * STEP_S)
        tracks.append(_stand(tracks[-1].q[-1], task.waypoints[index].dwell_s))
        limits += 2 * [_speed_limit(task, index)]
        end = _steps(tracks)
    if task.repeat or task.cycles > 1:
        tracks.append(_timed_move(model, task, 0, tracks[-1].q[-1], where, start))
        limits.append(limits[0])
    if _steps(tracks) == 0:
        raise SettingsError(f"{where}: every waypoint is where the robot starts; at least one must differ")
    return Reference(
        model=model,
        q=np.concatenate([start[None], *(track.q[1:] for track in tracks)]),
        dq=np.concatenate([np.zeros((1, model.nv)), *(track.dq[1:] for track in tracks)]),
        end=end,
        cycles=math.inf if task.repeat else float(task.cycles),
        waypoints_s=tuple(arrivals_s),
        tcp_speed_max=np.repeat([limits[0], *limits], [1, *(len(track.q) - 1 for track in tracks)]),
    )


def smooth_recorded(t_ns: Ints, q: Floats, model: RobotModel) -> Reference:
    """The path of a recorded joint track, smoothed by cubics over 0.1 s on a regular time grid.

    Programmed time 0 is ``t_ns[0]``. Gaps are interpolated linearly. Positions and velocities are checked against the
    robot's limits. Accelerations are not checked, because the controller keeps its own limits when it follows;
    ``recorded_remarks`` reports them.

    Args:
        t_ns: (n,) instants, in any order; of several rows with the same instant the first is used.
        q: (n, nv) [rad]; rows that are not finite are left out.
        model: The robot that follows the path.

    Raises:
        LogError: The number of axes differs, there are too few rows, a position is more than one degree outside the
            range of its axis, or a speed is more than 10 % above its limit.
    """
    from scipy.signal import savgol_filter  # the import takes 1 s; few logs have a joint track

    instants, rows = check_recorded(t_ns, q, model)
    seconds = (instants - instants[0]) * 1e-9
    grid = np.arange(max(2, math.ceil(seconds[-1] / STEP_S) + 1)) * STEP_S
    even = np.column_stack([np.interp(grid, seconds, rows[:, axis]) for axis in range(model.nv)])
    window = min(2 * round(_SMOOTH_S / STEP_S / 2) + 1, 2 * ((len(grid) - 1) // 2) + 1)
    order = min(3, window - 1)
    smooth = np.clip(savgol_filter(even, window, order, axis=0), model.q_min, model.q_max)
    dq = (
        savgol_filter(even, window, order, deriv=1, delta=STEP_S, axis=0)
        if order
        else np.gradient(even, STEP_S, axis=0)
    )
    _check(model, grid * 1e9, dq, "speed", "rad/s", (-model.dq_max, model.dq_max, _NOISE_SPEED * model.dq_max))
    fastest = max(float(model.pose(*row).tcp_speed) for row in zip(smooth, dq, strict=True))
    return _by_itself(model, smooth, dq, (), fastest)


def check_recorded(t_ns: Ints, q: Floats, model: RobotModel) -> tuple[Ints, Floats]:
    """Checks a recorded joint track against the range of the robot's axes.

    Args:
        t_ns: (n,) instants, in any order [ns].
        q: (n, nv) [rad]; rows that are not finite are left out.
        model: The robot.

    Returns:
        (m,) instants, increasing [ns], and (m, nv) positions, of endless axes without jumps by full turns [rad].

    Raises:
        LogError: The number of axes differs, there are too few rows, or a position is more than one degree outside the
            range of its axis.
    """
    if q.ndim != 2 or q.shape[1] != model.nv:
        raise LogError(f"joint track: found {q.shape[-1]} joints; {model.name} has {model.nv} axes")
    whole = np.isfinite(q).all(axis=1)
    instants, first = np.unique(t_ns[whole], return_index=True)
    if len(instants) < 2:
        raise LogError(f"joint track: found {len(instants)} instants with finite positions; a path needs two")
    rows = q[whole][first]
    endless = np.isinf(model.q_max)
    rows[:, endless] = np.unwrap(rows[:, endless], axis=0)
    margin = np.full(model.nv, _NOISE_RAD)
    _check(model, instants - t_ns[0], rows, "position", "rad", (model.q_min, model.q_max, margin))
    return instants, rows


#: Number of points of an approach at which the TCP speed is computed, each with the largest speed of the profile.
_STATIONS = 9


def approach(model: RobotModel, start: Floats, goal: Floats, speed: float) -> Reference:
    """Moves all axes together from the robot's position to the start of a path, with minimum jerk.

    The duration is in closed form, because a live robot waits for it: the quintic 10 r^3 - 15 r^4 + 6 r^5 has the
    largest velocity 15/8 and the largest acceleration 10/sqrt(3).

    Args:
        model: The robot.
        start: (nv,) [rad].
        goal: (nv,) [rad].
        speed: Share of the axes' top speeds and accelerations, in (0, 1].
    """
    way = goal - start
    for_speed_s = (15 / 8 * np.abs(way) / (speed * model.dq_max)).max()
    for_acceleration_s = math.sqrt((10 / math.sqrt(3) * np.abs(way) / (speed * model.ddq_max)).max())
    end = max(1, math.ceil(max(for_speed_s, for_acceleration_s) / STEP_S))
    r = np.arange(end + 1) / end
    share, rate = r * r * r * (10 - 15 * r + 6 * r**2), 30 * r**2 * (1 - r) ** 2 / (end * STEP_S)
    q, dq = start + np.outer(share, way), np.outer(rate, way)
    stations = (start + s * way for s in np.linspace(0.0, 1.0, _STATIONS))  # few points, because a live robot waits
    fastest = float(rate.max()) * max(model.pose(station, way).tcp_speed for station in stations)
    return _by_itself(model, q, dq, (end * STEP_S,), fastest)


def _by_itself(
    model: RobotModel, q: Floats, dq: Floats, waypoints_s: tuple[float, ...], fastest_m_per_s: float
) -> Reference:
    """A path that runs once. It has no programmed speed limit, so its greatest speed is the limit."""
    return Reference(
        model,
        q,
        dq,
        end=len(q) - 1,
        cycles=1.0,
        waypoints_s=waypoints_s,
        tcp_speed_max=np.full(len(q), fastest_m_per_s),
    )


def recorded_remarks(path: Reference) -> list[str]:
    """Remarks on a recorded path that the robot cannot follow, or that seems to be in another unit.

    Args:
        path: Result of ``smooth_recorded``.
    """
    model, found = path.model, []
    turned_rad = np.where(np.isinf(model.q_max), np.abs(path.q).max(axis=0), 0.0)
    axis = int(np.argmax(turned_rad))
    if turned_rad[axis] > _TURNS_RAD:
        found.append(
            f"robot joints: {model.joint_names[axis]} turns to {turned_rad[axis]:.1f} rad; if the log is in degrees, "
            "set logs.joints_unit = deg"
        )
    lag = min(round(_SMOOTH_S / STEP_S), len(path.dq) - 1)  # cubics overshoot at a kink, so take mean accelerations
    ddq = (path.dq[lag:] - path.dq[:-lag]) / (lag * STEP_S)
    for what, unit, rows, limit, setting in (
        ("move", "rad/s", path.dq, model.dq_max, "limit of the robot"),
        ("speed up or brake", "rad/s^2", ddq, model.ddq_max, "limit, robot.acceleration"),
    ):
        share = np.abs(rows) / limit
        row, axis = divmod(int(np.argmax(share)), model.nv)
        if share[row, axis] > 1.0 + 1e-9:
            found.append(
                f"robot joints: they {what} faster than the robot may, {model.joint_names[axis]} by up to "
                f"{abs(rows[row, axis]):.2f} {unit} {row * STEP_S:.2f} s after their begin ({setting}: "
                f"{limit[axis]:.2f}), {(share.max(axis=1) > 1.0).mean():.1%} of the time; the replayed robot stays "
                "within its limits and lags behind there"
            )
    return found


def _check(
    model: RobotModel, t_ns: Ints | Floats, rows: Floats, what: str, unit: str, limits: tuple[Floats, Floats, Floats]
) -> None:
    """Raises if a row is outside its limits by more than the margin; ``limits`` is (low, high, margin)."""
    low, high, margin = limits
    over = np.argwhere((rows < low - margin) | (rows > high + margin))
    if not len(over):
        return
    row, axis = over[0]
    as_degrees = np.radians(rows)
    many = len(np.unique(over[:, 0])) > _MOSTLY * len(rows) and np.abs(rows).max() > 2 * math.pi
    remedy = (
        "divided by 57.3 all fit: if they are degrees, set logs.joints_unit = deg"
        if many and ((as_degrees >= low) & (as_degrees <= high)).all()
        else "is it another robot (robot.urdf), other joints (logs.joint_names), or a wrong stamp or position?"
    )
    raise LogError(
        f"joint track: {model.joint_names[axis]} has {what} {rows[row, axis]:.3f} {unit} "
        f"after {t_ns[row] * 1e-9:.3f} s; {model.name} allows {low[axis]:.3f} to {high[axis]:.3f}; {remedy}"
    )


def _steps(tracks: list[JointTrajectory]) -> int:
    return sum(len(track.q) - 1 for track in tracks)


def _stand(q: Floats, dwell_s: float) -> JointTrajectory:
    rows = np.repeat(q[None], round(dwell_s / STEP_S) + 1, axis=0)
    return JointTrajectory(rows, np.zeros_like(rows))


def _timed_move(
    model: RobotModel, task: Task, index: int, now: Floats, where: str, goal: Floats | None = None
) -> JointTrajectory:
    """Plans ``_move`` and raises a SettingsError if it takes longer than MOVE_S."""
    try:
        return _move(model, task, index, now, where, goal)
    except _TooSlow as error:
        waypoint = task.waypoints[index]
        tcp_m_per_s = min(task.tcp_speed_m_per_s, waypoint.tcp_speed_m_per_s or math.inf)
        raise SettingsError(
            f"{where}: {task.label(index)}: the move to it takes over {error.duration_s:.3g} s with speed "
            f"{task.speed:g}, acceleration {task.acceleration:g}, tcp_speed_m_per_s {tcp_m_per_s:g} and "
            f"tcp_acceleration_m_per_s2 {task.tcp_acceleration_m_per_s2:g}; at most {MOVE_S:.0f} s are planned, so "
            "raise the smallest"
        ) from error


def _move(
    model: RobotModel, task: Task, index: int, now: Floats, where: str, goal: Floats | None = None
) -> JointTrajectory:
    """The move to a waypoint; with ``goal``, the move back to the joint positions of the start."""
    waypoint = task.waypoints[index]
    at = f"{where}: {task.label(index)}"
    pace = Pace(
        dq_max=task.speed * model.dq_max,
        ddq_max=task.acceleration * model.ddq_max,
        tcp_speed=_speed_limit(task, index),
        tcp_acceleration=task.tcp_acceleration_m_per_s2,
        step_s=STEP_S,
    )
    if goal is None and (waypoint.move == "joint" or waypoint.position_m is None):
        goal = _joints(model, task, index, now, where)
    if goal is not None and waypoint.move == "joint":
        return joint_move(model, now, goal, pace)
    T_end = _target(model, waypoint, at) if goal is None else model.pose(goal, np.zeros(model.nv)).T_world_tcp
    track = linear_move(model, now, T_end, pace, at)
    if goal is not None and np.abs(track.q[-1] - goal).max() > 1e-6:
        axis = int(np.argmax(np.abs(track.q[-1] - goal)))
        raise SettingsError(
            f"{at}: the straight line to it ends with axis {axis + 1} at {math.degrees(track.q[-1, axis]):.1f} deg "
            f'and not at {math.degrees(goal[axis]):.1f} deg; use move = "joint"'
        )
    return track


def _speed_limit(task: Task, index: int) -> float:
    """Programmed speed limit of the TCP on the way to a waypoint [m/s]."""
    return min(task.tcp_speed_m_per_s, task.waypoints[index].tcp_speed_m_per_s or math.inf)


def _joints(model: RobotModel, task: Task, index: int, near: Floats, where: str) -> Floats:
    """Joint positions of a waypoint; for a waypoint with a pose, the solution nearest to ``near``."""
    waypoint = task.waypoints[index]
    at = f"{where}: {task.label(index)}"
    if waypoint.position_m is not None:
        return _reached(model, _target(model, waypoint, at), near, at)
    degrees = waypoint.joints_deg
    q = np.array(waypoint.joints_rad if degrees is None else np.radians(degrees), dtype=float)
    if q.shape != model.q_min.shape:
        raise SettingsError(f"{at}: found {len(q)} joints; {model.name} has {model.nv} axes")
    for axis in np.flatnonzero((q < model.q_min - 1e-9) | (q > model.q_max + 1e-9)):
        raise SettingsError(
            f"{at}: found axis {axis + 1} at {math.degrees(q[axis]):.1f} deg; its range is "
            f"{math.degrees(model.q_min[axis]):.1f} to {math.degrees(model.q_max[axis]):.1f} deg"
        )
    return np.clip(q, model.q_min, model.q_max)


def _target(model: RobotModel, waypoint: Waypoint, at: str) -> Floats:
    """(4, 4) pose of the TCP that a waypoint gives, world frame."""
    T_base_tcp = np.eye(4)
    T_base_tcp[:3, 3] = waypoint.position_m
    if waypoint.rpy_deg is not None:
        turn = Rotation.from_euler("xyz", waypoint.rpy_deg, degrees=True)
    else:
        turn = Rotation.from_quat(waypoint.quaternion_wxyz, scalar_first=True)
    T_base_tcp[:3, :3] = turn.as_matrix()
    T_world_tcp = multiply(model.T_world_base, T_base_tcp)
    distance_m = norm_n(T_world_tcp[:3, 3] - model.shoulder_m)
    if distance_m > model.reach_m:
        raise SettingsError(
            f"{at}: out of reach, {distance_m:.3f} m from the first axis; "
            f"the TCP of {model.name} reaches {model.reach_m:.3f} m"
        )
    return T_world_tcp


def _reached(model: RobotModel, T_world_tcp: Floats, near: Floats, at: str) -> Floats:
    solution = solve(model, T_world_tcp, near)
    if isinstance(solution, Missed):
        distance_m = norm_n(T_world_tcp[:3, 3] - model.shoulder_m)
        raise SettingsError(
            f"{at}: no joint position within the limits reaches it; the nearest misses it by "
            f"{solution.position_m * 1e3:.0f} mm and {math.degrees(solution.angle_rad):.0f} deg. "
            f"It is {distance_m:.3f} m from the first axis and the TCP of {model.name} reaches {model.reach_m:.3f} m; "
            "move it or turn it"
        )
    return solution
