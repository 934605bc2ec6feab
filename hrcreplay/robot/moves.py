"""One move from standstill to standstill on a regular time grid, within the limits of the axes and of the TCP."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from ruckig import InputParameter, Result, Ruckig, Trajectory

from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.robot.inverse import descend
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.rotation import from_vector, to_vector

#: Limits rise to their full acceleration in this time: jerk limit = acceleration limit / RAMP_S [s].
RAMP_S = 0.1

#: On a straight line the TCP turns by at most this for a metre, ABB's 2 pi rad/s for 2.5 m/s [rad/m].
TURN_RAD_PER_M = 2 * math.pi / 2.5

#: A line that must be slower by more than this for the axes' sake passes a singular posture.
_SLOWEST = 20.0


@dataclass(frozen=True)
class Pace:
    """How fast a move may be."""

    dq_max: Floats  #: (nv,) [rad/s]
    ddq_max: Floats  #: (nv,) [rad/s^2]
    tcp_speed: float  #: [m/s]
    tcp_acceleration: float  #: along straight lines [m/s^2]
    step_s: float  #: time grid [s]


@dataclass(frozen=True)
class Track:
    """Joint positions and velocities on the time grid, first and last at rest."""

    q: Floats  #: (n, nv) [rad]
    dq: Floats  #: (n, nv) [rad/s]


def joint_move(model: RobotModel, start: Floats, end: Floats, pace: Pace) -> Track:
    """Every axis at the same share of its way, so that all start and stop together.

    Args:
        model: The robot.
        start: (nv,) [rad].
        end: (nv,) [rad].
        pace: Limits of axes and TCP.
    """
    way = end - start
    if not np.any(way):
        return Track(start[None], np.zeros_like(start)[None])
    with np.errstate(divide="ignore"):
        speed, acceleration = (float((limit / np.abs(way)).min()) for limit in (pace.dq_max, pace.ddq_max))

    def along(share: Floats, rate: Floats) -> Track:
        return Track(start + np.outer(share, way), np.outer(rate, way))

    return _paced(model, pace, along, 1.0, speed, acceleration, "")


def linear_move(model: RobotModel, start: Floats, T_world_end: Floats, pace: Pace, where: str) -> Track:
    """The TCP on a straight line, turning evenly about one axis.

    Args:
        model: The robot.
        start: (nv,) [rad].
        T_world_end: (4, 4) pose of the TCP to reach, world frame [m].
        pace: Limits of axes and TCP.
        where: What messages begin with.

    Raises:
        SettingsError: The line leaves the arm's range or passes a singular posture.
    """
    T_start = model.pose(start, np.zeros(model.nv)).T_world_tcp
    way_m = T_world_end[:3, 3] - T_start[:3, 3]
    turn_rad = to_vector(T_world_end[:3, :3] @ T_start[:3, :3].T)
    length = max(float(np.linalg.norm(way_m)), float(np.linalg.norm(turn_rad)) / TURN_RAD_PER_M)
    if length < 1e-9:
        return Track(start[None], np.zeros_like(start)[None])
    twist_per_m = np.concatenate([way_m, turn_rad]) / length

    def along(s_m: Floats, rate: Floats) -> Track:
        q, dq = np.empty((len(s_m), model.nv)), np.zeros((len(s_m), model.nv))
        now = start
        T = np.eye(4)
        for i, s in enumerate(s_m):
            T[:3, 3] = T_start[:3, 3] + s / length * way_m
            T[:3, :3] = from_vector(s / length * turn_rad) @ T_start[:3, :3]
            now, error = descend(model, T, now)
            if np.abs(error).max() > 1e-6:
                raise SettingsError(
                    f"{where}: the straight line to it leaves the arm's range after {s:.3f} m of {length:.3f} m; "
                    'use move = "joint" or start from another posture'
                )
            q[i] = now
            dq[i] = np.linalg.pinv(model.pose(now, np.zeros(model.nv)).J_tcp, rcond=1e-9) @ twist_per_m * rate[i]
        return Track(q, dq)

    return _paced(model, pace, along, length, pace.tcp_speed, pace.tcp_acceleration, where)


def _paced(
    model: RobotModel,
    pace: Pace,
    along: Callable[[Floats, Floats], Track],
    length: float,
    speed: float,
    acceleration: float,
    where: str,
) -> Track:
    """A path run by a jerk-limited profile as fast as the axes and the TCP allow.

    The profile's own speed and acceleration are lowered by what its axes exceed. Where that does not help against an
    acceleration, it stems from the path's curvature, which only less speed can mend.
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
    """Position and speed along a path on the time grid, stretched to a whole number of its steps."""
    task = InputParameter(1)
    task.current_position, task.target_position = [0.0], [length]
    task.max_velocity, task.max_acceleration, task.max_jerk = [speed], [acceleration], [acceleration / RAMP_S]
    fastest = Trajectory(1)
    result = Ruckig(1).calculate(task, fastest)
    if result != Result.Working:
        raise RuntimeError(f"ruckig: {result} for {length} m or rad at {speed}, {acceleration}")
    steps = max(1, math.ceil(fastest.duration / step_s))
    stretch = steps * step_s / fastest.duration
    states = [fastest.at_time(fastest.duration * i / steps) for i in range(steps + 1)]
    s, ds = (np.array([state[order][0] for state in states]) for order in (0, 1))
    s[0], s[-1], ds[0], ds[-1] = 0.0, length, 0.0, 0.0
    return np.clip(s, 0.0, length), ds / stretch


def _excess(model: RobotModel, track: Track, pace: Pace) -> tuple[float, float]:
    """By which factors the path's speed and its acceleration exceed what axes and TCP allow."""
    way, first, last = np.diff(track.q, axis=0) / pace.step_s, track.dq[:-1], track.dq[1:]
    speeds = np.concatenate([track.dq, 1.5 * way - 0.25 * (first + last)])  # of the cubics between grid points
    accelerations = np.concatenate([6 * way - 4 * first - 2 * last, 2 * first + 4 * last - 6 * way]) / pace.step_s
    tcp = [np.linalg.norm(model.pose(q, dq).J_tcp[:3] @ dq) for q, dq in zip(track.q, track.dq, strict=True)]
    return (
        max(float((np.abs(speeds) / pace.dq_max).max()), float(max(tcp)) / pace.tcp_speed),
        float((np.abs(accelerations) / pace.ddq_max).max()),
    )
