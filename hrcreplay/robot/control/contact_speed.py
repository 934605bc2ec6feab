"""Speed limits of a robot that may touch people: power and force limiting, ISO/TS 15066, 5.5.5, A.3.

A link that may reach a limb within the horizon moves no faster than a short contact with that limb allows; one that is
further away moves no faster than it would need to get there within the horizon. The speed of the surface along the
normal of a contact is that of the axis of the link, which is at most that of the faster of its ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hrcreplay.geometry.small_matrices import apply
from hrcreplay.geometry.vectors import norm_n
from hrcreplay.kernels import njit
from hrcreplay.records import Bools, Floats
from hrcreplay.robot.control.separation import Obstacles, Separation
from hrcreplay.robot.kinematics import RobotPose


@dataclass(frozen=True)
class ContactSpeeds:
    """Largest speed of a link that may touch a limb, for the volumes beside the robot."""

    limbs: Floats  #: (l,) for each limb of one person; NaN: the limb must not be touched [m/s]
    others: int  #: number of volumes between those of person 1 and person 2 that are no limbs: they must not be touched

    def speeds(self, obstacles: Obstacles) -> Floats:
        """(k,) largest contact speed of each volume; NaN: it must not be touched [m/s]."""
        each = len(self.limbs)
        found = np.full(len(obstacles.radius_m), np.nan)
        for k in range(len(found)):
            index = obstacles.among_all(k)
            if index >= each + self.others:  # of persons 2, 3, ...
                found[k] = self.limbs[(index - each - self.others) % each]
            elif index < each:
                found[k] = self.limbs[index]
        return found


#: A link slower than this counts as at rest [m/s].
SLOW = 1e-9


def pair_speeds(pairs: Separation, speeds: Floats, horizon_s: float) -> Floats:
    """(s, k) largest speed of each link's ends beside each volume; inf beside one that must not be touched [m/s].

    Args:
        pairs: Distances of the links from all volumes, which are known.
        speeds: (k,) of ``ContactSpeeds.speeds``.
        horizon_s: Time until which the volumes are valid [s].
    """
    gap_m = np.maximum(0.0, pairs.distance_m - pairs.clearance_m)
    return np.asarray(np.where(np.isnan(speeds), np.inf, np.maximum(speeds, gap_m / horizon_s)))


@njit(cache=True)
def end_speeds(pose: RobotPose, dq: Floats) -> Floats:
    """(s,) speed of the faster end of each link's axis at joint velocities (nv,) [rad/s] [m/s]."""
    found = np.zeros(len(pose.J_ends))
    for s in range(len(found)):
        for end in range(2):
            found[s] = max(found[s], norm_n(apply(pose.J_ends[s, end], dq)))
    return found


@njit(cache=True)
def largest_rate(pose: RobotPose, towards: Floats, speeds: Floats) -> float:
    """Largest rate at which no end of a link is faster than its limit; NaN, which allows none, if any is not known.

    Args:
        pose: The robot.
        towards: (nv,) velocity at rate 1 [rad/s].
        speeds: (s,) largest speed of each link's ends; inf: not limited [m/s].
    """
    rate = np.inf
    if np.isinf(speeds).all():
        return rate
    moving = end_speeds(pose, towards)
    for s in range(len(speeds)):
        if math.isnan(speeds[s]) or math.isnan(moving[s]):
            return np.nan
        if moving[s] > SLOW:
            rate = min(rate, speeds[s] / moving[s])
    return rate


def select(obstacles: Obstacles, which: Bools) -> Obstacles:
    """Some of the volumes of a tick.

    Args:
        obstacles: All volumes.
        which: (k,) True for those to keep.
    """
    kept = np.flatnonzero(which)
    spans = [slice(obstacles.offsets[k], obstacles.offsets[k + 1]) for k in kept.tolist()]
    lengths = [span.stop - span.start for span in spans]
    return Obstacles(
        np.concatenate([obstacles.vertices_m[span] for span in spans]) if spans else np.empty((0, 3)),
        np.cumsum([0, *lengths]),
        obstacles.radius_m[kept],
        obstacles.boxes_m[kept],
        obstacles.known,
        obstacles.horizon_s,
        numbers=np.array([obstacles.among_all(k) for k in kept.tolist()], dtype=np.int64),
    )
