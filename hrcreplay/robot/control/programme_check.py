"""Checks a programme against the objects of the cell, once, and finds which pairs of link and object are kept apart.

The same for pairs of the robot's own links.

The programme is sampled with conservative advancement: from a sample with a gap, nothing is reached before a link has
travelled the gap, so the next sample is there.

Rules for the pairs, which notes tell:

- A link that no axis moves, and a link that only the first axis turns and that overlaps an object at every angle of
  that axis, stand on the object or beside it. They are not checked against it.
- A link that may approach an object keeps the distance to which the programme brings it, less SPARE_M. If the programme
  brings its axis into the object, the pair is not checked.
- Every other link keeps the full distance, and a programme that does not is refused, unless the object allows it.
- Two links are kept apart unless at most one axis turns between them, an SRDF disables the pair, or their capsules
  overlap in every posture. If the programme brings them nearer, the capsules are wider than the links: the two keep the
  distance to which the programme brings them, less SPARE_M.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import NamedTuple

import numpy as np

from hrcreplay.errors import SettingsError
from hrcreplay.geometry.distances import distances, segment_distance
from hrcreplay.records import Bools, Floats, Ints
from hrcreplay.robot.control.static_obstacles import (
    UNCHECKED,
    StaticHull,
    StaticObstacles,
    link_radii,
    pair_reach,
    static_obstacles,
)
from hrcreplay.robot.model import RobotModel, Segment
from hrcreplay.robot.task import STEP_S, Reference

#: A link that may approach an object may come nearer than the programme brings it by this much, because the robot does
#: not follow its programme exactly [m].
SPARE_M = 0.01

#: Smallest travel of a link between two samples, unless the time grid of the programme is coarser [m].
SAMPLE_M = 1e-3

#: Number of angles of the first axis at which the first link is compared with an object.
_ANGLES = 72

#: Number of postures in which two links are compared, to find those that always overlap.
POSTURES = 2000

#: Name for all links that turn with the last axis.
TOOL = "tool"


class _Closest(NamedTuple):
    """Smallest distances between the links' axes and the hulls along a path."""

    distance_m: Floats  #: (s, o) lower bound, 0 in penetration [m]
    row: Ints  #: (s, o) of the path, at or next to that place


def check_programme(
    robot: RobotModel,
    path: Reference,
    hulls: list[StaticHull],
    clearance_m: float,
    begin_q: Floats,
    disabled: Collection[frozenset[str]] = (),
) -> StaticObstacles:
    """Checks a programme against objects and links and returns what the robot keeps clear of.

    Args:
        robot: The manipulator.
        path: Its programme.
        hulls: Parts of the objects.
        clearance_m: Clearance beyond the radii of link and object [m].
        begin_q: (nv,) joint positions at which the robot begins [rad].
        disabled: Pairs of URDF links or capsules that are not kept apart.

    Raises:
        SettingsError: An object names a link that the robot does not have, the robot begins inside an object, or its
            programme touches one that does not allow it.
    """
    names = [segment.name for segment in robot.segments]
    full_m = link_radii(robot)[:, None] + np.array([hull.radius_m for hull in hulls], dtype=float) + clearance_m
    near = np.array([_may_approach(robot, hull) for hull in hulls], dtype=bool).reshape(len(hulls), len(names)).T
    standing = _stands_on(robot, hulls, full_m, begin_q)
    closest = _along(
        path, partial(_distances, robot, hulls), robot.axis_reach_m, np.where(standing, UNCHECKED, full_m), near
    )
    keep_m = np.where(standing, UNCHECKED, full_m)
    notes = [
        f"object {hulls[k].name}: {names[s]} overlaps it at every angle of the first axis, or does not move: it is "
        "taken to stand on it and is not checked against it"
        for s, k in np.argwhere(standing).tolist()
    ]
    begin_m = _distances(robot, hulls, begin_q) - full_m
    held_off = ~standing & ~near
    for s, k in np.argwhere(held_off & (begin_m <= 0.0)).tolist():
        raise SettingsError(
            f"cell: object {hulls[k].name}: {names[s]} begins {_deep(begin_m[s, k], clearance_m)}; would be right: the "
            "object, the base or the first waypoint elsewhere, or may_approach with the link's name"
        )
    for s, k in np.argwhere(near & ~standing).tolist():
        least_m = float(closest.distance_m[s, k]) - SPARE_M
        keep_m[s, k] = min(full_m[s, k], least_m) if least_m > 0.0 else UNCHECKED
        at = _when(path, int(closest.row[s, k]))
        notes += _approach_note(f"object {hulls[k].name}: {names[s]}", "it", least_m, float(full_m[s, k]), at)
    notes += _touches(path, hulls, names, closest, full_m, held_off, clearance_m)
    pairs, pair_keep_m, more = _link_pairs(robot, path, clearance_m, disabled)
    return static_obstacles(robot, hulls, keep_m, held_off, pairs, pair_keep_m, (*notes, *more))


def _link_pairs(
    robot: RobotModel, path: Reference, clearance_m: float, disabled: Collection[frozenset[str]]
) -> tuple[Ints, Floats, list[str]]:
    """Pairs (p, 2) of links that are kept apart, the distance that their axes keep (p,) [m], and notes."""
    links, radius = robot.segments, link_radii(robot)
    apart = (robot.moves[:, None] != robot.moves[None, :]).sum(axis=2)
    off = {frozenset((one.name, two.name)) for one in links for two in links if _is_disabled(one, two, disabled)}
    pairs = np.array(
        [
            (s, k)
            for s in range(len(links))
            for k in range(s + 1, len(links))
            if apart[s, k] > 1 and frozenset((links[s].name, links[k].name)) not in off
        ],
        dtype=np.int64,
    ).reshape(-1, 2)
    full_m = radius[pairs].sum(axis=1) + clearance_m
    always = _always_overlap(robot, pairs, radius[pairs].sum(axis=1))
    notes = [
        f"links {links[s].name} and {links[k].name} overlap in every posture: they are not kept apart"
        for s, k in pairs[always].tolist()
    ]
    pairs, full_m = pairs[~always], full_m[~always]
    if not len(pairs):
        return pairs, full_m, notes
    measure = partial(_pair_distances, robot, pairs)
    near = np.ones((len(pairs), 1), dtype=bool)
    closest = _along(path, measure, pair_reach(robot, pairs), full_m[:, None], near)
    least_m = closest.distance_m[:, 0] - SPARE_M
    needed = closest.distance_m[:, 0] < full_m  # the programme is right, so the capsules are too wide there
    for p in np.flatnonzero(needed).tolist():
        one, two = (links[i].name for i in pairs[p].tolist())
        at = _when(path, int(closest.row[p, 0]))
        notes += _approach_note(f"links: {one}", two, float(least_m[p]), float(full_m[p]), at)
    keep_m = np.where(needed, least_m, full_m)
    kept = keep_m > 0.0
    return pairs[kept], keep_m[kept], notes


def _is_disabled(one: Segment, two: Segment, disabled: Collection[frozenset[str]]) -> bool:
    """Return whether a pair of capsules is among those that are not kept apart, by their names or their links'."""
    return any(frozenset((a, b)) in disabled for a in (one.name, one.body) for b in (two.name, two.body))


def _always_overlap(robot: RobotModel, pairs: Ints, radius_m: Floats) -> Bools:
    """(p,) pairs whose capsules overlap in all of POSTURES postures, spread evenly over the ranges of the axes."""
    always = np.ones(len(pairs), dtype=bool)
    ratio = 2.0
    for _ in range(60):  # the generalised golden ratio
        ratio = (1.0 + ratio) ** (1.0 / (robot.nv + 1.0))
    low, high = np.maximum(robot.q_min, -np.pi), np.minimum(robot.q_max, np.pi)
    for i in range(POSTURES):
        share = (0.5 + (i + 1) * ratio ** -np.arange(1.0, robot.nv + 1.0)) % 1.0
        always &= _pair_distances(robot, pairs, low + share * (high - low))[:, 0] <= radius_m
        if not always.any():
            break
    return always


def _pair_distances(robot: RobotModel, pairs: Ints, q: Floats) -> Floats:
    """(p, 1) distances between the axes of two links [m]."""
    ends = robot.ends_m(q)
    return np.array([[segment_distance(ends[one], ends[two])[0]] for one, two in pairs.tolist()]).reshape(-1, 1)


def _touches(
    path: Reference,
    hulls: list[StaticHull],
    names: list[str],
    closest: _Closest,
    full_m: Floats,
    held_off: Bools,
    clearance_m: float,
) -> list[str]:
    """Notes on links that the programme brings into objects; raises if one of the objects does not allow it."""
    gap_m = np.where(held_off, closest.distance_m - full_m, np.inf)
    told: dict[tuple[str, str], tuple[float, str]] = {}
    for s, k in np.argwhere(gap_m <= 0.0).tolist():
        text = (
            f"the programme brings {names[s]} {_deep(gap_m[s, k], clearance_m)} {_when(path, int(closest.row[s, k]))}"
        )
        known = told.get((hulls[k].name, names[s]))
        if known is None or gap_m[s, k] < known[0]:
            told[hulls[k].name, names[s]] = float(gap_m[s, k]), text
    allowed = {hull.name for hull in hulls if hull.programme_may_touch}
    refused = [f"object {name}: {text}" for (name, _), (_, text) in told.items() if name not in allowed]
    if refused:
        raise SettingsError(
            f"cell: {'; '.join(refused)}; would be right: a way around, may_approach with the link's name, or "
            "programme_may_touch = true, and then the robot stops before it"
        )
    return [f"object {name}: {text}; the robot does not follow it there" for (name, _), (_, text) in told.items()]


def _deep(gap_m: float, clearance_m: float) -> str:
    """Depth of a link in an object, in words."""
    beyond = f", clearance of {1e3 * clearance_m:.0f} mm included" if clearance_m else ""
    return f"{1e3 * max(0.0, -gap_m):.0f} mm inside it{beyond}"


def _when(path: Reference, row: int) -> str:
    """Place of a row of a path, in words."""
    at_s = row * STEP_S
    if not path.waypoints_s:
        return f"at {at_s:.2f} s of it"
    at = int(np.searchsorted(path.waypoints_s, at_s - 1e-9))
    to = "on the way back to waypoint 1" if at == len(path.waypoints_s) else f"at or on the way to waypoint {at + 1}"
    return f"at {at_s:.2f} s of it, {to}"


def _approach_note(link: str, other: str, least_m: float, full_m: float, at: str) -> list[str]:
    """Note on a link that may approach an object or another link as far as the programme needs it."""
    if least_m <= 0.0:
        return [f"{link}: the programme brings its axis into {other} {at}; the two are not kept apart"]
    if least_m >= full_m:
        return []
    return [f"{link} may approach {other} by {1e3 * (full_m - least_m):.0f} mm more, as the programme needs it {at}"]


def _may_approach(robot: RobotModel, hull: StaticHull) -> list[bool]:
    """(s,) links that may come as near to an object as the programme brings them."""
    names = [segment.name for segment in robot.segments]
    for name in hull.may_approach:
        if name not in (*names, TOOL):
            raise SettingsError(
                f"cell: object {hull.name}: may_approach: found {name}; would be right: {TOOL} for what turns with the "
                f"last axis, or links of {robot.name}: {', '.join(names)}"
            )
    last = robot.moves.astype(np.int64).sum(axis=1) == robot.nv
    return [name in hull.may_approach or (TOOL in hull.may_approach and bool(last[s])) for s, name in enumerate(names)]


def _stands_on(robot: RobotModel, hulls: list[StaticHull], full_m: Floats, q: Floats) -> Bools:
    """(s, o) links that stand on an object; see the rules of this module."""
    axes = robot.moves.astype(np.int64).sum(axis=1)
    standing: Bools = np.repeat((axes == 0)[:, None], len(hulls), axis=1)
    first = robot.moves[:, 0] & (axes == 1)
    if not first.any():
        return standing
    low, high = max(robot.q_min[0], -np.pi), min(robot.q_max[0], np.pi)
    always = np.repeat(first[:, None], len(hulls), axis=1)
    for angle in np.linspace(low, high, _ANGLES):
        turned = q.copy()
        turned[0] = angle
        always &= _distances(robot, hulls, turned) <= full_m
    return standing | always


def _distances(robot: RobotModel, hulls: list[StaticHull], q: Floats) -> Floats:
    """(s, o) distances between the axes of links and hulls, lower bounds [m]."""
    offsets = np.cumsum([0, *(len(hull.vertices_m) for hull in hulls)])
    vertices = np.concatenate([np.empty((0, 3)), *(hull.vertices_m for hull in hulls)])
    return distances(robot.ends_m(q), np.ascontiguousarray(vertices), offsets)[0]


def _along(
    path: Reference, measure: Callable[[Floats], Floats], reach_m: Floats, full_m: Floats, near: Bools
) -> _Closest:
    """Smallest distances of pairs along a path: of those that are ``near`` the smallest, of others whether they touch.

    Args:
        path: The path.
        measure: Distances (a, b) between axes at joint positions (nv,) [rad].
        reach_m: (nv, a) largest distance from an axis that moves the first of a pair against the second [m].
        full_m: (a, b) distance at which a pair touches; UNCHECKED for pairs that do not matter [m].
        near: (a, b).
    """
    way, first, last = np.diff(path.q, axis=0) / STEP_S, path.dq[:-1], path.dq[1:]
    fastest = np.maximum.reduce([np.abs(first), np.abs(last), np.abs(1.5 * way - 0.25 * (first + last)), np.abs(way)])
    travel_m = np.concatenate([np.zeros((1, full_m.shape[0])), np.cumsum(STEP_S * fastest @ reach_m, axis=0)])
    near = near & np.isfinite(full_m)
    least, rows = np.full(full_m.shape, np.inf), np.zeros(full_m.shape, dtype=np.int64)
    row, before, before_row = 0, measure(path.q[0]), 0
    while full_m.size:
        now = measure(path.q[row])
        travelled = (travel_m[row] - travel_m[before_row])[:, None]
        bound = np.minimum(np.minimum(before, now), 0.5 * (before + now - travelled))
        lower = bound < least
        least, rows = np.where(lower, bound, least), np.where(lower, row, rows)
        if row == len(path.q) - 1:
            break
        room_m = np.maximum(now - np.where(near, least, full_m), SAMPLE_M).min(axis=1)
        reached = np.flatnonzero((travel_m[row:] - travel_m[row] >= room_m).any(axis=1))
        before, before_row = now, row
        row += max(1, int(reached[0]) - 1) if len(reached) else len(path.q) - 1 - row
    return _Closest(np.maximum(least, 0.0), rows)
