"""Distances between the robot's links and the swept volumes of one tick, and the speed limits from them, Eq. (12)-(16).

The right-hand side of the safety constraints is corrected as docs/paper.md explains. Every vertex of every limb has
rows; a row is computed only when a velocity violates it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.distances import distances
from hrcreplay.geometry.vectors import dot3
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints, SweptVolumes
from hrcreplay.robot.kinematics import RobotPose


class Obstacles(NamedTuple):
    """The swept volumes of one tick: per limb the convex hull of its vertices + a ball. Built once per tick."""

    vertices_m: Floats  #: (m, 3) world, limb after limb [m]
    offsets: Ints  #: (l + 1,) index of each limb's first vertex
    radius_m: Floats  #: (l,) of the balls [m]
    boxes_m: Floats  #: (l, 2, 3) lowest and highest corner around each limb's vertices [m]
    known: bool  #: False if a limb could not be predicted; the robot must then brake
    horizon_s: float = math.inf  #: time for which the volumes are valid, from their tick on [s]
    first: int = 0  #: index of the first volume among all possible volumes: the person's limbs, then the walls
    numbers: Ints | None = None  #: (l,) index of each volume among all possible ones; None: from ``first`` on

    def among_all(self, volume: int) -> int:
        """Index of one of the volumes among all possible volumes."""
        return self.first + volume if self.numbers is None else int(self.numbers[volume])


def obstacles(volumes: SweptVolumes, tick: int, horizon_s: float = math.inf) -> Obstacles:
    """The obstacles of one tick.

    Args:
        volumes: Swept volumes of any number of ticks.
        tick: Index of the tick in ``volumes``.
        horizon_s: Time for which the volumes are valid, from that tick on [s].
    """
    limbs = len(volumes.limbs)
    offsets = volumes.offsets[tick * limbs : (tick + 1) * limbs + 1]
    # copies, as a table's arrays are protected: kernels are compiled for arrays of ticks, which are not
    vertices, radius = volumes.vertices_m[offsets[0] : offsets[-1]].copy(), volumes.radius_m[tick].copy()
    offsets = offsets - offsets[0]
    around, known = boxes(vertices, offsets, radius)
    return Obstacles(vertices, offsets, radius, around, known, horizon_s)


@cache
def no_obstacles() -> Obstacles:
    """No volumes, and it is known that there are none."""
    return Obstacles(np.empty((0, 3)), np.zeros(1, np.int64), np.empty(0), np.empty((0, 2, 3)), known=True)


def unknown_obstacles(horizon_s: float) -> Obstacles:
    """What is known of a tick if somebody is not: nothing, so the robot stands, and no volume is looked at."""
    return no_obstacles()._replace(known=False, horizon_s=horizon_s)


def join_obstacles(people: Sequence[Obstacles]) -> Obstacles:
    """The volumes of several people of one tick as those of one, person after person; one or more."""
    if len(people) == 1:
        return people[0]
    ends = np.cumsum([0, *(one.offsets[-1] for one in people)])
    offsets = [one.offsets[1:] + end for one, end in zip(people, ends[:-1], strict=True)]
    return Obstacles(
        np.concatenate([one.vertices_m for one in people]),
        np.concatenate([np.zeros(1, np.int64), *offsets]),
        np.concatenate([one.radius_m for one in people]),
        np.concatenate([one.boxes_m for one in people]),
        all(one.known for one in people),
        min(one.horizon_s for one in people),
    )


@njit(cache=True)
def boxes(vertices: Floats, offsets: Ints, radius: Floats) -> tuple[Floats, bool]:
    """Boxes around the limbs, and whether every limb has vertices and all numbers are finite."""
    found = np.empty((len(radius), 2, 3))
    known = True
    for i in range(len(radius)):
        known = known and math.isfinite(radius[i]) and offsets[i] < offsets[i + 1]
        for k in range(3):
            low, high = np.inf, -np.inf
            for j in range(offsets[i], offsets[i + 1]):
                known = known and math.isfinite(vertices[j, k])
                low, high = min(low, vertices[j, k]), max(high, vertices[j, k])
            found[i, 0, k], found[i, 1, k] = low, high
    return found, known


class Separation(NamedTuple):
    """Distances between the axes of the links and the hulls of the limbs in one tick."""

    distance_m: Floats  #: (s, l) proven lower bound, tight to rounding, 0 in penetration [m]
    clearance_m: Floats  #: (s, l) Delta of Eq. (2) [m]

    def constraint_rhs_m2(self, form: str, give_way_m: float = 0.0) -> Floats:
        """(s, l) right-hand side of Eq. (14), corrected (docs/paper.md), Eq. (6), (10) [m^2].

        Args:
            form: ``square`` is (distance - clearance)^2, as printed; ``product`` is distance (distance - clearance),
                which is sufficient for (3).
            give_way_m: For ``product``: if the gap to a volume is smaller than this, the right-hand side is negative
                and the link must move away [m].
        """
        return constraint_rhs(self, form == "square", give_way_m)


@njit(cache=True)
def constraint_rhs(pairs: Separation, square: bool, give_way_m: float) -> Floats:
    """Computes the right-hand side of Eq. (14), corrected; see ``Separation.constraint_rhs_m2`` [m^2]."""
    found = np.empty_like(pairs.distance_m)
    for s in range(found.shape[0]):
        for k in range(found.shape[1]):
            room = max(0.0, pairs.distance_m[s, k] - pairs.clearance_m[s, k])  # Eq. (6), (10)
            found[s, k] = room * room if square else pairs.distance_m[s, k] * (room - give_way_m)
    return found


class NearestLink(NamedTuple):
    """Distances of all pairs, and the pair whose surfaces are nearest."""

    pairs: Separation
    surface_m: float  #: distance between the surfaces, negative if they overlap; NaN without a pair or if any is [m]
    link: int  #: -1 without a pair
    limb: int  #: -1 without a pair


class Gap(NamedTuple):
    """The nearest pair, as the record of a tick says it."""

    distance_m: float  #: surface to surface; 0 in contact, NaN where not known [m]
    overlap_m: float  #: depth of the link inside the volume, radii included; NaN where not known [m]
    limb: int  #: -1 without a pair
    link: int  #: -1 without a pair


@njit(cache=True, inner=True)
def gap_of(nearest: NearestLink) -> Gap:
    """The nearest pair as it is recorded."""
    if math.isnan(nearest.surface_m):
        return Gap(np.nan, np.nan, -1, -1)
    apart_m = nearest.surface_m
    return Gap(apart_m if apart_m > 0.0 else 0.0, -apart_m if apart_m < 0.0 else 0.0, nearest.limb, nearest.link)


@njit(cache=True)
def measure(
    ends: Floats, link_radius: Floats, vertices: Floats, offsets: Ints, radius: Floats, clearance_m: float
) -> NearestLink:
    """Proven lower bounds of the distances of all pairs, and the nearest pair.

    A plane between link and limb bounds their distance from below, even if the search for the distance has not
    converged. Thus every pair has a bound; without convergence the bound is only less tight.

    Args:
        ends: (s, 2, 3) ends of the links' axes [m].
        link_radius: (s,) [m].
        vertices: (m, 3) of all limbs, which are known [m].
        offsets: (l + 1,) index of each limb's first vertex.
        radius: (l,) of the limbs' balls [m].
        clearance_m: Clearance beyond limb radius + link radius [m].
    """
    low, _, _ = distances(ends, vertices, offsets)
    clearance = np.empty_like(low)
    surface, link, limb = np.inf if low.size else np.nan, -1, -1
    for s in range(low.shape[0]):
        for k in range(low.shape[1]):
            clearance[s, k] = link_radius[s] + radius[k] + clearance_m
            gap = low[s, k] - clearance[s, k]
            if gap < surface or (math.isnan(gap) and not math.isnan(surface)):
                surface, link, limb = gap, s, k
    return NearestLink(Separation(low, clearance), surface, link, limb)


class Approach(NamedTuple):
    """Data of a tick's approach rows."""

    ends_m: Floats  #: (s, 2, 3) ends of the links' axes [m]
    J_ends: Floats  #: (s, 2, 3, nv) their position Jacobians [m/rad]
    vertices_m: Floats  #: (m, 3) of all limbs [m]
    offsets: Ints  #: (l + 1,) index of each limb's first vertex
    boxes_m: Floats  #: (l, 2, 3) lowest and highest corner around each limb's vertices [m]
    rhs_m2: Floats  #: (s, l) right-hand side of Eq. (14) for every pair of link and limb [m^2]
    per_speed: Floats  #: (s, l) left-hand side of Eq. (14) for a link that approaches at 1 m/s [m s]
    stop_s: float  #: T_s of Eq. (70), or the time that the rows look ahead [s]
    planes: Floats  #: (p, nv) rows of planes: speed of an end towards a plane for each joint's velocity [m/rad]
    plane_high: Floats  #: (p,) bound on ``planes @ dq`` [m/s]


#: Smallest distance between link and limb that is used to convert a row to a speed [m].
_LEAST_M = 1e-3


class PlaneRows(NamedTuple):
    """Bounds on the speed of ends of links towards planes: Eq. (16) where a plane takes the place of the vertices."""

    A: Floats  #: (p, nv) speed towards the plane for each joint's velocity [m/rad]
    high: Floats  #: (p,) largest speed [m/s]


def no_planes(nv: int) -> PlaneRows:
    """No rows, for a robot of ``nv`` axes."""
    return PlaneRows(np.empty((0, nv)), np.empty(0))


@njit(cache=True)
def tick_rows(
    pose: RobotPose,
    vertices: Floats,
    offsets: Ints,
    boxes_m: Floats,
    rhs_m2: Floats,
    distance_m: Floats,
    stop_s: float,
    planes: PlaneRows,
) -> Approach:
    """The data of the approach rows of a tick; the rows themselves are not computed.

    Args:
        pose: The robot.
        vertices: (m, 3) of all limbs, which are known [m].
        offsets: (l + 1,) index of each limb's first vertex.
        boxes_m: (l, 2, 3) boxes around the limbs' vertices [m].
        rhs_m2: (s, l) right-hand side of Eq. (14) for every pair of link and limb [m^2].
        distance_m: (s, l) between the link's axis and the limb's hull [m].
        stop_s: T_s of Eq. (70), or the time that the rows look ahead [s].
        planes: Rows of what stands in the cell.
    """
    per_speed = stop_s * np.maximum(distance_m, _LEAST_M)
    around = vertices, offsets, boxes_m
    return Approach(pose.ends_m, pose.J_ends, *around, rhs_m2, per_speed, stop_s, planes.A, planes.high)


def rows_of_people(pose: RobotPose, obstacles: Obstacles, pairs: Separation, rhs_m2: Floats, stop_s: float) -> Approach:
    """The data of the approach rows of people alone; see ``tick_rows``.

    Args:
        pose: The robot.
        obstacles: The swept volumes, all known.
        pairs: Distances of all pairs of link and limb.
        rhs_m2: (s, l) right-hand side of Eq. (14) for every pair of link and limb [m^2].
        stop_s: T_s of Eq. (70), or the time that the rows look ahead [s].
    """
    around = obstacles.vertices_m, obstacles.offsets, obstacles.boxes_m
    return tick_rows(pose, *around, rhs_m2, pairs.distance_m, stop_s, no_planes(pose.J_tcp.shape[1]))


@njit(cache=True)
def worst_rows(rows: Approach, dq_next: Floats, above_m2: float) -> tuple[Ints, Floats, Floats]:
    """The row of Eq. (16) that a velocity violates most, for every pair and each end of the link; Eq. (66i), corrected.

    The rows are linear in the vertex, so the worst vertex is the one furthest along the end's velocity. One pass over
    the vertices checks all rows without computing them. For a vertex r and an end's velocity v, Eq. (15), (16) times
    the joint velocity is T_s (r @ v + rest), and rest does not depend on r.

    Args:
        rows: Approach rows of the tick.
        dq_next: (nv,) [rad/s].
        above_m2: Rows that exceed their right-hand side by no more than this hold [m^2].

    Returns:
        For the n violated rows: ``which`` (n, 4) link, limb, row of Eq. (12), row of ``vertices_m``; ``A`` (n, nv)
        [m^2 s/rad]; ``A @ dq_next`` (n,) [m^2]. Rows of planes are not among them.
    """
    ends, J_ends, vertices, offsets, boxes, rhs_m2, _, stop_s, _, _ = rows
    links, limbs = rhs_m2.shape
    which = np.empty((2 * links * limbs, 4), dtype=np.int64)
    A, values = np.empty((len(which), len(dq_next))), np.empty(len(which))
    n = 0
    for s in range(links):
        for end in range(2):  # Eq. (7)-(9), (11): linear along the link, so s = 0 and s = 1 bound all points between
            v = _times(J_ends[s, end], dq_next)
            rest = -dot3(ends[s, 0], v)  # Eq. (15): E_1 @ dq
            if end == 1:
                rest -= dot3(ends[s, 1] - ends[s, 0], _times(J_ends[s, 0], dq_next))
            for k in range(limbs):
                bound = rhs_m2[s, k] + above_m2
                if stop_s * (_box_top(boxes[k], v) + rest) <= bound:
                    continue
                best, top = offsets[k], -np.inf
                for i in range(offsets[k], offsets[k + 1]):
                    along = dot3(vertices[i], v)
                    if along > top:
                        best, top = i, along
                value = stop_s * (top + rest)  # Eq. (66i), corrected: T_s belongs here
                if value > bound:
                    which[n] = s, k, end, best
                    A[n] = stop_s * _row(ends[s], J_ends[s], vertices[best], end)
                    values[n] = value
                    n += 1
    return which[:n], A[:n], values[:n]


@njit(cache=True, inner=True)
def _row(ends: Floats, J_ends: Floats, vertex: Floats, end: int) -> Floats:
    """(nv,) one row of E of Eq. (12), without T_s."""
    row = np.zeros(J_ends.shape[2])
    for j in range(len(row)):
        for i in range(3):
            row[j] += (vertex[i] - ends[0, i]) * J_ends[end, i, j]
            if end == 1:
                row[j] -= (ends[1, i] - ends[0, i]) * J_ends[0, i, j]
    return row


@njit(cache=True, inner=True)
def _box_top(box: Floats, v: Floats) -> float:
    """Largest extent of the box along v."""
    top = 0.0
    for i in range(3):
        top += max(box[0, i] * v[i], box[1, i] * v[i])
    return top


@njit(cache=True, inner=True)
def _times(J: Floats, dq: Floats) -> Floats:
    v = np.zeros(3)
    for i in range(3):
        for j in range(len(dq)):
            v[i] += J[i, j] * dq[j]
    return v
