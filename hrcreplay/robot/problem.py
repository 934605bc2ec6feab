"""The trajectory generator's quadratic program, Eq. (66), of one tick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.records import Floats, Ints
from hrcreplay.robot.bounds import cartesian_bounds, joint_bounds
from hrcreplay.robot.constraints import worst_rows
from hrcreplay.robot.model import RobotModel, RobotPose
from hrcreplay.robot.obstacles import Obstacles
from hrcreplay.robot.separation import Separation
from hrcreplay.robot.stepping import PlanSettings, RobotState
from hrcreplay.robot.tracking import pose_error, tracking_cost

#: Names one row: link, limb, row of Eq. (12), vertex; or (-1, axis) for a limit of the TCP.
Key = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class BoundedRows:
    """Rows ``low <= A @ w <= high`` and their names."""

    keys: tuple[Key, ...]
    A: Floats  #: (m, nv)
    low: Floats  #: (m,)
    high: Floats  #: (m,)

    def only(self, which: Ints) -> BoundedRows:
        """Some of these rows."""
        keys = tuple(self.keys[i] for i in which.tolist())
        return BoundedRows(keys, self.A[which], self.low[which], self.high[which])

    def joined(self, other: BoundedRows) -> BoundedRows:
        """These rows and those of the other that are not among them."""
        new = other.only(np.array([i for i, key in enumerate(other.keys) if key not in self.keys], dtype=np.int64))
        return BoundedRows(
            self.keys + new.keys,
            np.concatenate([self.A, new.A]),
            np.concatenate([self.low, new.low]),
            np.concatenate([self.high, new.high]),
        )


@dataclass(frozen=True, slots=True)
class Problem:
    """Minimise ``w @ H @ w / 2 + g @ w`` over the next joint velocity w [rad/s], within limits and clear of people."""

    H: Floats  #: (nv, nv)
    g: Floats  #: (nv,)
    low: Floats  #: (nv,) Eq. (66d)-(66f) [rad/s]
    high: Floats  #: (nv,) [rad/s]
    J_low: Floats  #: (6,) Eq. (66g), (66h): bounds on ``J_tcp @ w`` [m/s, rad/s]
    J_high: Floats  #: (6,) [m/s, rad/s]
    pose: RobotPose
    obstacles: Obstacles
    room_m2: Floats  #: (s, l) right-hand sides of Eq. (66i) [m^2]
    stop_s: float  #: T_s [s]
    dq: Floats  #: (nv,) at the tick [rad/s]

    def broken_rows(self, w: Floats, above: float) -> BoundedRows:
        """Limits of the TCP and, per pair and end of the link, the worst approach row that a velocity breaks.

        Args:
            w: (nv,) next joint velocity [rad/s].
            above: Rows broken by no more than this hold [m^2; m/s, rad/s].
        """
        twist = self.pose.J_tcp @ w
        tcp = np.flatnonzero((twist > self.J_high + above) | (twist < self.J_low - above))
        keys: list[Key] = [(-1, i) for i in tcp.tolist()]
        which, A, _ = worst_rows(self.pose, self.obstacles, w, self.room_m2, self.stop_s, above)
        keys.extend(map(tuple, which.tolist()))
        return BoundedRows(
            tuple(keys),
            np.concatenate([self.pose.J_tcp[tcp], A]),
            np.concatenate([self.J_low[tcp], np.full(len(which), -np.inf)]),
            np.concatenate([self.J_high[tcp], self.room_m2[which[:, 0], which[:, 1]]]),
        )


def problem(
    robot: RobotModel,
    state: RobotState,
    pose: RobotPose,
    T_world_ref: Floats,
    twist_ref: Floats,
    obstacles: Obstacles,
    pairs: Separation,
    settings: PlanSettings,
) -> Problem:
    """Eq. (66) at one instant; building it is separate from solving it. Arguments as of ``controller.step``."""
    dt_s, J, dJdq = settings.dt_s, pose.J_tcp, pose.dJdq_tcp
    H, g = tracking_cost(
        pose_error(pose.T_world_tcp, T_world_ref),
        J,
        dJdq,
        state.dq,
        twist_ref,
        settings.q_p,
        settings.q_v,
        settings.path_gain_per_s,
        dt_s,
    )
    low, high = joint_bounds(state.q, state.dq, robot.q_min, robot.q_max, robot.dq_max, robot.ddq_max, dt_s)
    J_low, J_high = cartesian_bounds(J, dJdq, state.dq, settings.tcp_speed_max, settings.tcp_acceleration_max, dt_s)
    return Problem(H, g, low, high, J_low, J_high, pose, obstacles, pairs.room_m2(), settings.stop_s, state.dq)
