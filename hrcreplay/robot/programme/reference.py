"""A path over time: what the robot would do if nobody were there, and how far it has got."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from hrcreplay.records import Floats
from hrcreplay.robot.model import RobotModel
from hrcreplay.settings.sections import Plan

#: Time grid that a reference is computed on once; between its points it is a cubic [s].
STEP_S = 0.004


@dataclass(frozen=True, slots=True)
class ReferencePoint:
    """The reference at one instant, world frame."""

    q: Floats  #: (nv,) [rad]
    dq: Floats  #: (nv,) [rad/s]
    ddq: Floats  #: (nv,) [rad/s^2]
    T_world_tcp: Floats  #: (4, 4)
    twist: Floats  #: (6,) linear and angular velocity of the TCP [m/s, rad/s]


class Grid(NamedTuple):
    """A path over time on the grid; see ``Reference``."""

    q: Floats  #: (n, nv) [rad]
    dq: Floats  #: (n, nv) [rad/s]
    end: int  #: grid point of the last waypoint
    duration_s: float  #: from the start to the end of the last cycle [s]


@dataclass(frozen=True)
class Reference:
    """A path over time that starts at ``q[0]``, runs ``cycles`` times and stands at its end.

    A cycle is the whole grid; the last one ends at ``end`` of the grid, before the way back to the start.
    """

    model: RobotModel
    q: Floats  #: (n, nv) on the grid [rad]
    dq: Floats  #: (n, nv) [rad/s]
    end: int  #: grid point of the last waypoint
    cycles: float  #: inf: until the log ends
    waypoints_s: tuple[float, ...]  #: arrival at each waypoint of the first cycle [s]

    @property
    def q0(self) -> Floats:
        """(nv,) where the robot starts [rad]."""
        return self.q[0]

    @property
    def cycle_s(self) -> float:
        """One cycle with the way back [s]."""
        return (len(self.q) - 1) * STEP_S

    @property
    def duration_s(self) -> float:
        """From the start to the end of the last cycle; inf when it repeats [s]."""
        return (self.cycles - 1) * self.cycle_s + self.end * STEP_S

    @property
    def grid(self) -> Grid:
        """The path without the robot, for kernels."""
        return Grid(self.q, self.dq, self.end, self.duration_s)

    def next_waypoint(self, s_s: float) -> float:
        """Programmed time of the first arrival at a waypoint that is not before ``s_s``; inf after the last [s]."""
        if not self.waypoints_s or s_s > self.duration_s:
            return math.inf
        cycle = math.floor(s_s / self.cycle_s)
        arrivals = (n * self.cycle_s + at_s for n in (cycle, cycle + 1) for at_s in self.waypoints_s)
        return next((arrival for arrival in arrivals if arrival >= s_s), math.inf)

    def sample(self, s_s: float) -> ReferencePoint:
        """The reference ``s_s`` seconds of programmed time after its start.

        Position is a cubic through the grid, velocity and acceleration its derivatives, pose and twist those of
        position and velocity: each is exactly the derivative of the one before. Before the start and after the end
        it stands.
        """
        q, dq, ddq = place(self.grid, s_s)
        pose = self.model.pose(q, dq)
        return ReferencePoint(q, dq, ddq, pose.T_world_tcp, pose.J_tcp @ dq)


@njit(cache=True)
def place(grid: Grid, s_s: float) -> tuple[Floats, Floats, Floats]:
    """Position, velocity and acceleration (nv,) each, ``s_s`` seconds of programmed time after a path's start."""
    if not 0.0 <= s_s < grid.duration_s:
        row = 0 if s_s < 0.0 else grid.end
        return grid.q[row].copy(), np.zeros(grid.q.shape[1]), np.zeros(grid.q.shape[1])
    at = s_s % ((len(grid.q) - 1) * STEP_S) / STEP_S
    i = min(int(at), len(grid.q) - 2)
    return _cubic(grid.q[i], grid.q[i + 1], grid.dq[i], grid.dq[i + 1], at - i, STEP_S)


@njit(cache=True)
def _cubic(
    q0: Floats, q1: Floats, dq0: Floats, dq1: Floats, share: float, step_s: float
) -> tuple[Floats, Floats, Floats]:
    """The cubic with given ends and end velocities, and its derivatives."""
    way, m0, m1 = q1 - q0, dq0 * step_s, dq1 * step_s
    b, a = 3 * way - 2 * m0 - m1, m0 + m1 - 2 * way
    q = q0 + share * (m0 + share * (b + share * a))
    dq = (m0 + share * (2 * b + share * 3 * a)) / step_s
    return q, dq, (2 * b + share * 6 * a) / step_s**2


def advance(reference: Reference, s_s: float, dt_s: float, tcp_error_m: float, plan: Plan) -> tuple[float, float]:
    """Programmed time after one tick, and the rate at which it ran.

    ``time`` runs with the clock: a robot that was held back then faces a reference that ran away.
    ``path`` runs with the clock while the TCP is within half the leash of the reference, slows down smoothly beyond
    and stands when the leash is taut (or the error is not known). It stops at every waypoint until the TCP has come
    as near as ``waypoint_m``: however far the robot evades on the way, it never skips one. Neither runs backwards.

    Args:
        reference: The programmed path.
        s_s: Programmed time [s].
        dt_s: Length of the tick [s].
        tcp_error_m: Distance from the TCP to the reference at ``s_s`` [m].
        plan: When the reference waits.

    Returns:
        Programmed time at the next tick [s] and the rate in [0, 1]: the reference's velocity is ``rate * twist``.
    """
    if plan.reference == "time":
        return s_s + dt_s, 1.0
    slack = 2.0 - 2.0 * tcp_error_m / plan.leash_m  # 1 at half the leash, 0 where it is taut
    if not slack > 0.0:
        return s_s, 0.0
    rate = 1.0 if slack >= 1.0 else slack * slack * (3.0 - 2.0 * slack)
    ahead_s = s_s + rate * dt_s
    if not tcp_error_m <= plan.waypoint_m:
        ahead_s = min(ahead_s, reference.next_waypoint(s_s))
    return ahead_s, (ahead_s - s_s) / dt_s
