"""What a robot keeps clear of beside people: the objects of its cell, which stand, and its own links.

An object is a convex hull of a few vertices with a ball, valid for ever. Its rows are those of Eq. (16) with a plane in
place of the vertices: between link and object lies a plane, and each end of the link approaches its own foot on that
plane. By Eq. (14) with the right-hand side ``distance (distance - clearance)`` this bounds the speed of the end towards
the plane by its gap over the time that the row looks ahead. The gap is linear along the link, so the two ends cover all
its points, as in Eq. (11). A vertex of a table that is far from the link would bound motions along the table too; the
plane does not. Two links have the same rows, with the speed of an end of one relative to an end of the other.

Objects stand, so the rows need no horizon of people: they look ahead half the stop, which is the way of a stop at
constant deceleration, and the time in which the robot follows its target velocity. The certificate proves every step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.distances import segment_distance, separating_planes
from hrcreplay.geometry.vectors import dot3
from hrcreplay.kernels import njit
from hrcreplay.records import Bools, Floats, Ints
from hrcreplay.robot.control.separation import PlaneRows, boxes
from hrcreplay.robot.model import RobotModel

#: Rows keep this much more distance than the certificate, so that the certificate lets a robot turn back that has come
#: as near as the rows allow [m].
ROWS_KEEP_M = 2e-3

#: There is no row between a link and an object that are further apart than this beyond the kept distance [m].
ROWS_WITHIN_M = 0.5

#: Kept distance of a pair that is not checked [m].
UNCHECKED = -math.inf


class StaticHull(NamedTuple):
    """A convex part of an object: the hull of its vertices + a ball."""

    name: str  #: of the object
    vertices_m: Floats  #: (m, 3) world [m]
    radius_m: float  #: of the ball [m]
    may_approach: tuple[str, ...] = ()  #: links that may come as near as the programme brings them
    programme_may_touch: bool = False  #: whether a programme that touches it is planned all the same


class StaticShapes(NamedTuple):
    """Hulls and pairs of links as numbers for kernels; shapes as in ``StaticObstacles``."""

    vertices: Floats
    offsets: Ints
    boxes: Floats
    keep: Floats
    pairs: Ints
    pair_keep: Floats
    pair_reach: Floats


@lru_cache
def no_shapes(links: int, axes: int) -> StaticShapes:
    """Nothing to keep clear of beside people, for a robot with so many links and axes."""
    hulls = np.empty((0, 3)), np.zeros(1, np.int64), np.empty((0, 2, 3)), np.empty((links, 0))
    return StaticShapes(*hulls, np.empty((0, 2), np.int64), np.empty(0), np.empty((axes, 0)))


def shapes_of(robot: RobotModel, static: StaticObstacles | None) -> StaticShapes:
    """What a robot keeps clear of beside people as numbers for kernels; None: nothing."""
    return no_shapes(len(robot.segments), robot.nv) if static is None else static.shapes


@dataclass(frozen=True)
class StaticObstacles:
    """The objects of a cell and the pairs of links of one robot that are kept apart."""

    names: tuple[str, ...]  #: (o,) object of each hull
    vertices_m: Floats  #: (m, 3) world, hull after hull [m]
    offsets: Ints  #: (o + 1,) index of each hull's first vertex
    radius_m: Floats  #: (o,) of the balls [m]
    boxes_m: Floats  #: (o, 2, 3) lowest and highest corner around each hull's vertices [m]
    keep_m: Floats  #: (s, o) distance to keep between axis and hull; UNCHECKED: none [m]
    link_radius_m: Floats  #: (s,) of the links [m]
    held_off: Bools  #: (s, o) pairs that keep the full distance
    pairs: Ints  #: (p, 2) links that are kept apart, the one nearer to the base first
    pair_keep_m: Floats  #: (p,) distance to keep between their axes [m]
    pair_reach_m: Floats  #: (nv, p) largest distance from an axis that turns one of the two against the other [m]
    notes: tuple[str, ...]  #: on pairs that are not checked, or not at the full distance, and on the programme

    @cached_property
    def shapes(self) -> StaticShapes:
        """Hulls and pairs of links as numbers for kernels."""
        hulls = self.vertices_m, self.offsets, self.boxes_m, self.keep_m
        return StaticShapes(*hulls, self.pairs, self.pair_keep_m, self.pair_reach_m)


def static_obstacles(
    robot: RobotModel,
    hulls: list[StaticHull],
    keep_m: Floats,
    held_off: Bools,
    pairs: Ints,
    pair_keep_m: Floats,
    notes: tuple[str, ...] = (),
) -> StaticObstacles:
    """Prepares hulls and pairs of links for a robot.

    Args:
        robot: The manipulator.
        hulls: Parts of the objects.
        keep_m: (s, o) distance to keep between the axis of each link and each hull; UNCHECKED: none [m].
        held_off: (s, o) pairs that keep the full distance.
        pairs: (p, 2) links that are kept apart.
        pair_keep_m: (p,) distance to keep between their axes [m].
        notes: On the pairs and the programme.
    """
    offsets = np.cumsum([0, *(len(hull.vertices_m) for hull in hulls)])
    vertices = np.concatenate([hull.vertices_m for hull in hulls]) if hulls else np.empty((0, 3))
    radius, link_radius = np.array([hull.radius_m for hull in hulls], dtype=float), link_radii(robot)
    vertices, around = np.ascontiguousarray(vertices, dtype=float), boxes(vertices, offsets, radius)[0]
    return StaticObstacles(
        names=tuple(hull.name for hull in hulls),
        vertices_m=vertices,
        offsets=offsets,
        radius_m=radius,
        boxes_m=around,
        keep_m=keep_m,
        link_radius_m=link_radius,
        held_off=held_off,
        pairs=pairs,
        pair_keep_m=pair_keep_m,
        pair_reach_m=pair_reach(robot, pairs),
        notes=notes,
    )


def pair_reach(robot: RobotModel, pairs: Ints) -> Floats:
    """(nv, p) largest distance from an axis that turns one link of a pair (p, 2) against the other; else 0 [m]."""
    moves, reach_m = robot.moves, robot.axis_reach_m.T
    apart = moves[pairs[:, 0]] != moves[pairs[:, 1]]
    reach = np.where(moves[pairs[:, 1]], reach_m[pairs[:, 1]], reach_m[pairs[:, 0]])
    return np.ascontiguousarray((apart * reach).T)


def link_radii(robot: RobotModel) -> Floats:
    """(s,) radii of the links [m]."""
    return robot.arm.radius_m


def half_space(robot: RobotModel, point_m: Floats, normal: Floats) -> Floats:
    """(8, 3) vertices of a box that is the part of a half-space that a robot can reach, world [m].

    Args:
        robot: The manipulator.
        point_m: (3,) a point of its plane, world [m].
        normal: (3,) unit vector out of the half-space.
    """
    reach_m = robot.span_m + 2.0 * float(link_radii(robot).max())
    base_m = robot.T_world_base[:3, 3]
    along = np.eye(3)[np.argmin(np.abs(normal))]
    one = np.cross(normal, along)
    one /= np.linalg.norm(one)
    two = np.cross(normal, one)
    depth_m = float((base_m - point_m) @ normal)  # of the base in front of the plane
    front = base_m - depth_m * normal
    thick_m = max(reach_m - depth_m, 0.05)
    corners = [front + a * reach_m * one + b * reach_m * two for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    return np.array([*corners, *(corner - thick_m * normal for corner in corners)])


@njit(cache=True)
def plane_rows(static: StaticShapes, ends: Floats, J_ends: Floats, ahead_s: float) -> tuple[Ints, PlaneRows]:
    """The rows of objects and links at a pose, and what each is of.

    Args:
        static: Objects and pairs of links.
        ends: (s, 2, 3) ends of the links [m].
        J_ends: (s, 2, 3, nv) their position Jacobians [m/rad].
        ahead_s: Time that the rows look ahead [s].

    Returns:
        For n rows: (n, 4) link, its end, hull or -1, and for a pair of links the other link times two plus its end;
        and the rows.
    """
    objects, A, high = _object_rows(ends, J_ends, static, ahead_s)
    links, B, low = _link_rows(ends, J_ends, static.pairs, static.pair_keep, ahead_s)
    return np.concatenate((objects, links)), PlaneRows(np.concatenate((A, B)), np.concatenate((high, low)))


@njit(cache=True, inner=True)
def _object_rows(ends: Floats, J_ends: Floats, static: StaticShapes, ahead_s: float) -> tuple[Ints, Floats, Floats]:
    vertices, offsets, keep = static.vertices, static.offsets, static.keep
    links, hulls = keep.shape
    which, A, high = _no_rows(2 * links * hulls, J_ends.shape[3])
    n = 0
    low, normals = separating_planes(ends, vertices, offsets, _within(ends, static.boxes, keep, ROWS_WITHIN_M))
    for s in range(links):
        for k in range(hulls):
            normal = normals[s, k]
            if not low[s, k] - keep[s, k] < ROWS_WITHIN_M or not dot3(normal, normal) > 0.0:
                continue
            depth = np.inf
            for j in range(offsets[k], offsets[k + 1]):
                depth = min(depth, dot3(normal, vertices[j]))
            for end in range(2):
                gap = depth - dot3(normal, ends[s, end]) - keep[s, k] - ROWS_KEEP_M
                which[n, 0], which[n, 1], which[n, 2], which[n, 3] = s, end, k, -1
                high[n] = max(0.0, gap) / ahead_s
                _add(A[n], normal, J_ends[s, end], 1.0)
                n += 1
    return which[:n], A[:n], high[:n]


@njit(cache=True, inner=True)
def _link_rows(ends: Floats, J_ends: Floats, pairs: Ints, keep: Floats, ahead_s: float) -> tuple[Ints, Floats, Floats]:
    which, A, high = _no_rows(4 * len(pairs), J_ends.shape[3])
    n, normal = 0, np.empty(3)
    for p in range(len(pairs)):
        one, two = pairs[p, 0], pairs[p, 1]
        apart, share, other = segment_distance(ends[one], ends[two])
        if not apart > 0.0 or not apart - keep[p] < ROWS_WITHIN_M:
            continue
        for c in range(3):
            at = ends[one, 0, c] + share * (ends[one, 1, c] - ends[one, 0, c])
            normal[c] = (ends[two, 0, c] + other * (ends[two, 1, c] - ends[two, 0, c]) - at) / apart
        for ends_of_both in range(4):
            e, f = ends_of_both // 2, ends_of_both % 2
            gap = dot3(normal, ends[two, f]) - dot3(normal, ends[one, e]) - keep[p] - ROWS_KEEP_M
            which[n, 0], which[n, 1], which[n, 2], which[n, 3] = one, e, -1, 2 * two + f
            high[n] = max(0.0, gap) / ahead_s
            _add(A[n], normal, J_ends[one, e], 1.0)
            _add(A[n], normal, J_ends[two, f], -1.0)
            n += 1
    return which[:n], A[:n], high[:n]


@njit(cache=True, inner=True)
def _no_rows(most: int, nv: int) -> tuple[Ints, Floats, Floats]:
    """Space for rows."""
    return np.empty((most, 4), np.int64), np.zeros((most, nv)), np.empty(most)


@njit(cache=True, inner=True)
def _add(row: Floats, normal: Floats, J: Floats, sign: float) -> None:
    """Adds the speed of a point with the Jacobian J (3, nv) along a normal to a row (nv,)."""
    for j in range(len(row)):
        for c in range(3):
            row[j] += sign * normal[c] * J[c, j]


@njit(cache=True, inner=True)
def _within(ends: Floats, around: Floats, keep: Floats, most: float) -> Bools:
    """(s, o) checked pairs whose boxes are no further apart than the kept distance + ``most`` [m]."""
    links, hulls = keep.shape
    found = np.zeros((links, hulls), np.bool_)
    for s in range(links):
        for k in range(hulls):
            if keep[s, k] == UNCHECKED:
                continue
            square = 0.0
            for c in range(3):
                low, high = min(ends[s, 0, c], ends[s, 1, c]), max(ends[s, 0, c], ends[s, 1, c])
                away = max(around[k, 0, c] - high, low - around[k, 1, c], 0.0)
                square += away * away
            found[s, k] = square <= (keep[s, k] + most) ** 2
    return found


def pair_too_near(robot: RobotModel, static: StaticObstacles, q: Floats) -> str:
    """Names a link that does not keep its distance from an object or another link; empty if all do.

    Args:
        robot: The manipulator.
        static: Objects and pairs of links.
        q: (nv,) joint positions [rad].
    """
    ends, names = robot.ends_m(q), [segment.name for segment in robot.segments]
    low, _ = separating_planes(ends, static.vertices_m, static.offsets, static.keep_m != UNCHECKED)
    for link, hull in np.argwhere((static.keep_m != UNCHECKED) & ~(low > static.keep_m)).tolist():
        return f"{names[link]} at object {static.names[hull]}"
    for (one, two), keep_m in zip(static.pairs.tolist(), static.pair_keep_m.tolist(), strict=True):
        if not segment_distance(ends[one], ends[two])[0] > keep_m:
            return f"{names[one]} at {names[two]}"
    return ""


class NearestStatic(NamedTuple):
    """The nearest pair of link and object, and the nearest pair of links, one row per pose."""

    object_m: Floats  #: (n,) surface to surface, of links that keep the full distance; negative in overlap [m]
    object: Ints  #: (n,) index of the hull; -1 without one
    object_link: Ints  #: (n,) index of the link; -1 without one
    links_m: Floats  #: (n,) surface to surface, of links that are kept apart; negative in overlap [m]
    links: Ints  #: (n, 2) indices of the two; -1 without a pair


def nearest(robot: RobotModel, static: StaticObstacles, q: Floats) -> NearestStatic:
    """The nearest pairs at many poses.

    A distance is a proven lower bound, tight to rounding, and at least minus the radii of link and object.

    Args:
        robot: The manipulator.
        static: Objects and pairs of links.
        q: (n, nv) joint positions; rows that are not finite have no nearest pair [rad].
    """
    n = len(q)
    found = NearestStatic(np.full(n, np.nan), np.full(n, -1), np.full(n, -1), np.full(n, np.nan), np.full((n, 2), -1))
    pair_radius = static.link_radius_m[static.pairs].sum(axis=1)
    for i in np.flatnonzero(np.isfinite(q).all(axis=1)).tolist():
        ends = robot.ends_m(q[i])
        low, _ = separating_planes(ends, static.vertices_m, static.offsets, static.held_off)
        surface = low - static.link_radius_m[:, None] - static.radius_m
        if np.isfinite(surface).any():
            link, hull = divmod(int(np.argmin(surface)), surface.shape[1])
            found.object_m[i], found.object_link[i], found.object[i] = surface[link, hull], link, hull
        if len(static.pairs):
            apart = np.array([segment_distance(ends[one], ends[two])[0] for one, two in static.pairs]) - pair_radius
            found.links[i] = static.pairs[int(np.argmin(apart))]
            found.links_m[i] = apart.min()
    return found
