"""Random steps and stops beside random volumes: does one that was certified ever enter?

The check shares nothing with the certificate: kinematics of its own from the axes of the data sheet, the motion within
a tick as the parabola it is, 50 instants, 20 points a link, and the distance from a point to a box in closed form.

    python -m tests.tools.random_stops --count 1000000 --seed 1

With ``--objects`` about half of the boxes stand in the cell instead of being limbs, and the links of the robot keep off
each other.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from hrcreplay.kernels import njit
from hrcreplay.records import LIMBS, Floats, SweptVolumes
from hrcreplay.robot.control.certificate import NO_PLANES, clear
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.robot.control.static_obstacles import StaticHull, StaticObstacles, static_obstacles
from hrcreplay.robot.control.stops import Stop, at_rest, stop_axis_by_axis, stop_straight
from hrcreplay.robot.model import RobotModel, irb140

DT_S, TOOL_M = 0.004, 0.10
INSTANTS, POINTS = 50, 20

#: Offset of each axis from the one before at zero [m], and which of x, y and z it is, as the data sheet has them.
_OFFSETS = np.array([[0, 0, 0.352], [0.07, 0, 0], [0, 0, 0.36], [0.38, 0, 0], [0, 0, 0], [0.065, 0, 0]])
_ABOUT = np.array([2, 1, 1, 0, 1, 0])
#: Links: axis that carries them and where they begin, other end in its frame at zero [m], radius [m].
_CARRIER = np.array([0, 1, 2, 4, 5])
_ENDS = np.array([[0.07, 0, 0], [0, 0, 0.36], [0.38, 0, 0], [0.065, 0, 0], [TOOL_M, 0, 0]])
RADII_M = np.array([0.219, 0.152, 0.118, 0.077, 0.045])
#: Links that are kept apart: more than one axis turns between them, and they do not always overlap.
PAIRS = np.array([(0, 2), (0, 3), (0, 4), (1, 3), (1, 4)])
#: Of the corners of a box.
_SIGNS = np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, -1).T


@dataclass
class Box:
    """An oriented box, of any thickness down to none, and the ball around it."""

    centre_m: Floats  #: (3,)
    turn: Floats  #: (3, 3)
    half_m: Floats  #: (3,)
    radius_m: float

    def corners(self) -> Floats:
        """(8, 3) [m]."""
        return self.centre_m + _SIGNS * self.half_m @ self.turn.T

    def distance_m(self, points_m: Floats) -> Floats:
        """(n,) from points (n, 3) to the box, without the ball [m]."""
        outside = np.maximum(np.abs((points_m - self.centre_m) @ self.turn) - self.half_m, 0.0)
        return np.asarray(np.linalg.norm(outside, axis=1))


@njit(cache=True)
def _turn(turn: Floats, about: int, angle: float) -> None:
    """Follows a rotation (3, 3) by one about its own x, y or z."""
    one, two = (about + 1) % 3, (about + 2) % 3
    cos, sin = np.cos(angle), np.sin(angle)
    for i in range(3):
        along, across = turn[i, one], turn[i, two]
        turn[i, one], turn[i, two] = cos * along + sin * across, cos * across - sin * along


@njit(cache=True)
def link_points(q: Floats) -> Floats:
    """(n, 5, POINTS, 3) points on the links' axes, for joint positions (n, 6), base at the origin [m]."""
    found = np.empty((len(q), len(_CARRIER), POINTS, 3))
    for n in range(len(q)):
        turn, origin = np.eye(3), np.zeros(3)
        for axis in range(6):
            for i in range(3):
                origin[i] += _along(turn, i, _OFFSETS[axis])
            _turn(turn, _ABOUT[axis], q[n, axis])
            for link in range(len(_CARRIER)):
                if _CARRIER[link] == axis:
                    for i in range(3):
                        way = _along(turn, i, _ENDS[link])
                        for k in range(POINTS):
                            found[n, link, k, i] = origin[i] + k / (POINTS - 1) * way
    return found


@njit(cache=True)
def _along(turn: Floats, i: int, v: Floats) -> float:
    """Coordinate of a vector after a rotation."""
    return turn[i, 0] * v[0] + turn[i, 1] * v[1] + turn[i, 2] * v[2]


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
    return max(_deepest(points, box.centre_m, box.turn, box.half_m, box.radius_m) for box in boxes)


def deepest_pair_m(going: Stop, stop: Stop) -> float:
    """How far two links enter each other at most during step and stop [m]."""
    points = link_points(instants(going, stop))
    return max(_deepest_pair(points, one, two) for one, two in PAIRS.tolist())


@njit(cache=True)
def _deepest_pair(points: Floats, one: int, two: int) -> float:
    """The same for two links, point by point."""
    least = np.inf
    for n in range(points.shape[0]):
        for i in range(points.shape[2]):
            for k in range(points.shape[2]):
                square = 0.0
                for c in range(3):
                    square += (points[n, one, i, c] - points[n, two, k, c]) ** 2
                least = min(least, square)
    return RADII_M[one] + RADII_M[two] - np.sqrt(least)


@njit(cache=True)
def _deepest(points: Floats, centre: Floats, turn: Floats, half: Floats, radius: float) -> float:
    """The same for one box, from its points' coordinates in the box."""
    depth = -np.inf
    for n in range(points.shape[0]):
        for link in range(points.shape[1]):
            for k in range(points.shape[2]):
                square = 0.0
                for axis in range(3):
                    along = 0.0
                    for i in range(3):
                        along += (points[n, link, k, i] - centre[i]) * turn[i, axis]
                    square += max(abs(along) - half[axis], 0.0) ** 2
                depth = max(depth, RADII_M[link] + radius - np.sqrt(square))
    return depth


def random_turn(rng: np.random.Generator) -> Floats:
    """(3, 3) any rotation: two directions, and the one across them."""
    one, two = rng.normal(size=(2, 3))
    one /= np.linalg.norm(one)
    two -= (two @ one) * one
    two /= np.linalg.norm(two)
    (a, b, c), (d, e, f) = one.tolist(), two.tolist()  # np.cross takes as long as all the rest of a box
    return np.array([[a, d, b * f - c * e], [b, e, c * d - a * f], [c, f, a * e - b * d]])


def random_boxes(rng: np.random.Generator, near_m: Floats) -> list[Box]:
    """One to three boxes around points near the robot."""
    found = []
    for _ in range(rng.integers(1, 4)):
        half = rng.uniform(0.0, 0.25, 3) * (rng.random(3) < 0.8)
        centre = near_m[rng.integers(len(near_m))] + rng.normal(0.0, 0.4, 3)
        found.append(Box(centre, random_turn(rng), half, float(rng.uniform(0.0, 0.2))))
    return found


def as_static(robot: RobotModel, boxes: list[Box]) -> StaticObstacles:
    """The boxes as objects of the cell, and the pairs of links whose capsules do not always overlap."""
    hulls = [StaticHull(f"box {i}", box.corners(), box.radius_m) for i, box in enumerate(boxes)]
    keep_m = RADII_M[:, None] + np.array([box.radius_m for box in boxes])
    pair_keep_m = RADII_M[PAIRS].sum(axis=1)
    return static_obstacles(robot, hulls, keep_m, np.ones(keep_m.shape, bool), PAIRS, pair_keep_m)


def as_obstacles(boxes: list[Box]) -> Obstacles:
    """The boxes as limbs."""
    corners = np.concatenate([np.empty((0, 3)), *(box.corners() for box in boxes)])
    radius = np.array([[box.radius_m for box in boxes]], dtype=float)
    offsets, names = np.arange(len(boxes) + 1) * 8, LIMBS[: len(boxes)]
    return obstacles(SweptVolumes(np.array([0]), offsets, corners, radius, names, "sound"), 0)


def random_step(rng: np.random.Generator, robot: RobotModel, *, together: bool) -> tuple[Stop, Stop]:
    """Where a robot is, and a step within the limits of the axes with the stop after it."""
    q = rng.uniform(np.maximum(robot.q_min, -np.pi), np.minimum(robot.q_max, np.pi))
    dq = rng.uniform(-1.0, 1.0, 6) * robot.dq_max * rng.choice((0.02, 0.2, 1.0))
    dq_next = np.clip(dq + rng.uniform(-1.0, 1.0, 6) * DT_S * robot.ddq_max, -robot.dq_max, robot.dq_max)
    going = at_rest(q)
    going.dq[0] = dq
    brake = stop_straight if together else stop_axis_by_axis
    return going, brake(q + 0.5 * DT_S * (dq + dq_next), dq_next, robot.ddq_max, DT_S)


@dataclass
class Outcome:
    """What came of many random stops."""

    certified: int = 0
    refused: int = 0
    refused_in_vain: int = 0  #: although nothing was entered
    entered: int = 0  #: certified stops that entered
    deepest_m: float = -np.inf  #: of certified ones


def run(count: int, seed: int, *, objects: bool = False) -> Outcome:
    """Tries random stops until ``count`` have been certified; with ``objects`` beside objects and other links."""
    rng, found = np.random.default_rng(seed), Outcome()
    robots = [irb140(np.eye(4), stop_s=stop_s, tool_m=TOOL_M) for stop_s in (0.1, 0.377, 0.8)]
    planes = NO_PLANES
    while found.certified < count:
        robot = robots[rng.integers(len(robots))]
        going, stop = random_step(rng, robot, together=rng.random() < 0.7)
        boxes = random_boxes(rng, link_points(stop.q[-1:]).reshape(-1, 3))
        planes = NO_PLANES if rng.random() < 0.5 else planes  # also those of another scene
        limbs = int(rng.integers(len(boxes) + 1)) if objects else len(boxes)
        static = as_static(robot, boxes[limbs:]) if objects else None
        ok, planes = clear(robot, going, stop, as_obstacles(boxes[:limbs]), 0.0, DT_S, planes, static=static)
        depth = deepest_m(going, stop, boxes)
        if objects:
            depth = max(depth, deepest_pair_m(going, stop))
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
    parser = argparse.ArgumentParser(prog="python -m tests.tools.random_stops", description=__doc__)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--objects", action="store_true")
    given = parser.parse_args()
    print(run(given.count, given.seed, objects=given.objects))  # noqa: T201


if __name__ == "__main__":
    main()
