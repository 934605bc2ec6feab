"""Random steps and stops beside random volumes: does one that was certified ever enter?

The check shares nothing with the certificate: kinematics of its own from the axes of the data sheet, the motion within
a tick as the parabola it is, 50 instants, 20 points a link, and the distance from a point to a box in closed form.

    python -m tests.robot.control.random_stops --count 1000000 --seed 1
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.records import LIMBS, Floats, SweptVolumes
from hrcreplay.robot.control.certificate import NO_PLANES, clear
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.robot.control.stopping import Stop, at_rest, axis_by_axis, straight
from hrcreplay.robot.model import RobotModel, irb140

DT_S, TOOL_M = 0.004, 0.10
INSTANTS, POINTS = 50, 20

#: Offset of each axis from the one before at zero [m], and its direction, as the data sheet has them.
_AXES = (
    ((0.0, 0.0, 0.352), (0, 0, 1)),
    ((0.070, 0.0, 0.0), (0, 1, 0)),
    ((0.0, 0.0, 0.360), (0, 1, 0)),
    ((0.380, 0.0, 0.0), (1, 0, 0)),
    ((0.0, 0.0, 0.0), (0, 1, 0)),
    ((0.065, 0.0, 0.0), (1, 0, 0)),
)
#: Links: axis that carries them, ends in its frame at zero [m], radius [m].
_LINKS = (
    (0, (0.0, 0.0, 0.0), (0.070, 0.0, 0.0), 0.219),
    (1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.360), 0.152),
    (2, (0.0, 0.0, 0.0), (0.380, 0.0, 0.0), 0.118),
    (4, (0.0, 0.0, 0.0), (0.065, 0.0, 0.0), 0.077),
    (5, (0.0, 0.0, 0.0), (TOOL_M, 0.0, 0.0), 0.045),
)


@dataclass
class Box:
    """An oriented box, of any thickness down to none, and the ball around it."""

    centre_m: Floats  #: (3,)
    turn: Floats  #: (3, 3)
    half_m: Floats  #: (3,)
    radius_m: float

    def corners(self) -> Floats:
        """(8, 3) [m]."""
        signs = np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, -1).T
        return self.centre_m + signs * self.half_m @ self.turn.T

    def distance_m(self, points_m: Floats) -> Floats:
        """(n,) from points (n, 3) to the box, without the ball [m]."""
        outside = np.maximum(np.abs((points_m - self.centre_m) @ self.turn) - self.half_m, 0.0)
        return np.asarray(np.linalg.norm(outside, axis=1))


def link_points(q: Floats) -> Floats:
    """(n, 5, POINTS, 3) points on the links' axes, for joint positions (n, 6), base at the origin [m]."""
    turn, origin = np.tile(np.eye(3), (len(q), 1, 1)), np.zeros((len(q), 3))
    frames = []
    for j, (offset, axis) in enumerate(_AXES):
        origin = origin + turn @ np.array(offset)
        turn = turn @ Rotation.from_rotvec(q[:, j, None] * np.array(axis)).as_matrix()
        frames.append((turn, origin))
    share = np.linspace(0.0, 1.0, POINTS)[:, None]
    found = np.empty((len(q), len(_LINKS), POINTS, 3))
    for i, (axis_no, start, end, _) in enumerate(_LINKS):
        turn, origin = frames[axis_no]
        along = np.array(start) + share * (np.array(end) - np.array(start))
        found[:, i] = np.einsum("nij,pj->npi", turn, along) + origin[:, None]
    return found


def instants(going: Stop, stop: Stop) -> Floats:
    """(INSTANTS, 6) joint positions from the step's beginning to standstill: parabolas between the ticks."""
    q, dq = np.vstack((going.q[:1], stop.q)), np.vstack((going.dq[:1], stop.dq))
    at = np.linspace(0.0, len(q) - 1.0, INSTANTS)
    row = np.minimum(at.astype(int), len(q) - 2) if len(q) > 1 else np.zeros(INSTANTS, int)
    t = ((at - row) * DT_S)[:, None]
    following = np.minimum(row + 1, len(q) - 1)
    u = (dq[following] - dq[row]) / DT_S
    return np.asarray(q[row] + t * dq[row] + 0.5 * t**2 * u)


def deepest_m(going: Stop, stop: Stop, boxes: list[Box]) -> float:
    """How far a link enters a volume at most during step and stop; negative: how far all stay away [m]."""
    points = link_points(instants(going, stop))
    radius = np.array([link[3] for link in _LINKS])[:, None, None]
    depth = -np.inf
    for box in boxes:
        flat = np.moveaxis(points, 1, 0)
        away = box.distance_m(flat.reshape(-1, 3)).reshape(flat.shape[:3])
        depth = max(depth, float((radius + box.radius_m - away).max()))
    return depth


def random_boxes(rng: np.random.Generator, near_m: Floats) -> list[Box]:
    """One to three boxes around points near the robot."""
    found = []
    for _ in range(rng.integers(1, 4)):
        half = rng.uniform(0.0, 0.25, 3) * (rng.random(3) < 0.8)
        centre = near_m[rng.integers(len(near_m))] + rng.normal(0.0, 0.4, 3)
        found.append(Box(centre, Rotation.random(random_state=rng).as_matrix(), half, float(rng.uniform(0.0, 0.2))))
    return found


def as_obstacles(boxes: list[Box]) -> Obstacles:
    """The boxes as limbs."""
    corners, radius = np.concatenate([box.corners() for box in boxes]), np.array([[box.radius_m for box in boxes]])
    offsets, names = np.arange(len(boxes) + 1) * 8, LIMBS[: len(boxes)]
    return obstacles(SweptVolumes(np.array([0]), offsets, corners, radius, names, "sound"), 0)


def random_step(rng: np.random.Generator, robot: RobotModel, *, together: bool) -> tuple[Stop, Stop]:
    """Where a robot is, and a step within the limits of the axes with the stop after it."""
    q = rng.uniform(np.maximum(robot.q_min, -np.pi), np.minimum(robot.q_max, np.pi))
    dq = rng.uniform(-1.0, 1.0, 6) * robot.dq_max * rng.choice((0.02, 0.2, 1.0))
    dq_next = np.clip(dq + rng.uniform(-1.0, 1.0, 6) * DT_S * robot.ddq_max, -robot.dq_max, robot.dq_max)
    going = at_rest(q)
    going.dq[0] = dq
    brake = straight if together else axis_by_axis
    return going, brake(q + 0.5 * DT_S * (dq + dq_next), dq_next, robot.ddq_max, DT_S)


@dataclass
class Outcome:
    """What came of many random stops."""

    certified: int = 0
    refused: int = 0
    refused_in_vain: int = 0  #: although nothing was entered
    entered: int = 0  #: certified stops that entered
    deepest_m: float = -np.inf  #: of certified ones


def run(count: int, seed: int) -> Outcome:
    """Tries random stops until ``count`` have been certified."""
    rng, found = np.random.default_rng(seed), Outcome()
    robots = [irb140(np.eye(4), stop_s=stop_s, tool_m=TOOL_M) for stop_s in (0.1, 0.377, 0.8)]
    planes = NO_PLANES
    while found.certified < count:
        robot = robots[rng.integers(len(robots))]
        going, stop = random_step(rng, robot, together=rng.random() < 0.7)
        boxes = random_boxes(rng, link_points(stop.q[-1:]).reshape(-1, 3))
        planes = NO_PLANES if rng.random() < 0.5 else planes  # also those of another scene
        ok, planes = clear(robot, going, stop, as_obstacles(boxes), 0.0, DT_S, planes)
        depth = deepest_m(going, stop, boxes)
        if ok:
            found.certified += 1
            found.deepest_m = max(found.deepest_m, depth)
            found.entered += depth > 0.0
        else:
            found.refused += 1
            found.refused_in_vain += depth < 0.0
    return found


def main() -> None:
    """Prints the outcome."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print(run(given.count, given.seed))  # noqa: T201


if __name__ == "__main__":
    main()
