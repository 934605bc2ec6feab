"""The trajectory generator's quadratic program, Eq. (66), of one tick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.records import Floats
from hrcreplay.robot.bounds import cartesian_bounds, joint_bounds
from hrcreplay.robot.constraints import Approach, tick_rows, worst_rows
from hrcreplay.robot.model import RobotModel, RobotPose
from hrcreplay.robot.obstacles import Obstacles
from hrcreplay.robot.optimum import Limits
from hrcreplay.robot.separation import Separation
from hrcreplay.robot.stepping import PlanSettings, RobotState
from hrcreplay.robot.tracking import pose_error, tracking_cost


@dataclass(frozen=True, slots=True)
class Problem:
    """Minimise ``w @ H @ w / 2 + g @ w`` over the next joint velocity w [rad/s], within limits and clear of people."""

    H: Floats  #: (nv, nv)
    g: Floats  #: (nv,)
    limits: Limits
    rows: Approach  #: Eq. (66i)

    def keeps(self, w: Floats, within: float) -> bool:
        """Whether a velocity breaks no row by more than ``within`` [m^2; m/s, rad/s]."""
        low, high, J, J_low, J_high = self.limits
        twist = J @ w
        fits = np.all((low <= w) & (w <= high)) and np.all((J_low - within <= twist) & (twist <= J_high + within))
        return bool(fits) and not len(worst_rows(self.rows, w, within)[0])


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
    rows = tick_rows(pose, obstacles, pairs.room_m2(), settings.stop_s)
    return Problem(H, g, Limits(low, high, J, J_low, J_high), rows)
