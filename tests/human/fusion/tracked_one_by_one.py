"""The tracking of all people once more, in Python: tick by tick, body by body, with scipy's assignment.

It shares with ``people`` the settings and ``fuse``, which moves each person's filter by one tick.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from hrcreplay.human.fusion import fuse
from hrcreplay.human.fusion.assignment import (
    APART_M,
    APART_S,
    BORN_FRAMES,
    BORN_S,
    SAME_M,
    WALKS_M_PER_S,
    WALKS_ON_S,
)
from hrcreplay.human.fusion.fuse import FusionState
from hrcreplay.human.fusion.people import PeopleRules
from hrcreplay.human.model import LimitSet, skeleton
from hrcreplay.records import MIRROR, POINTS, Floats, HumanStates, Ints, Measurements
from hrcreplay.settings.sections import Fusion

_NEVER, _LONG_AGO = 1e6, 1e3
_TORSO = [POINTS.index(name) for name in POINTS if name.startswith(("pelvis", "chest", "neck", "sho", "hip"))]
_BY_THE_FILTER = ("p", "v", "a", "j", "p_std", "v_std", "lengths_m", "lengths_std_m", "residual_m", "legs_sway_m")


@dataclass(eq=False)
class Body:
    """A person, or a body that may become one."""

    number: int
    filter: FusionState
    is_person: bool = False
    shown: list[tuple[int, int]] = field(default_factory=list)  #: camera and capture of all its frames
    ids: dict[int, int] = field(default_factory=dict)  #: camera -> the tracker's last id
    seen_ns: int = -(10**18)
    newest_ns: int = -(10**18)
    newest_m: Floats | None = None
    place_m: Floats | None = None
    posture: tuple[Floats, Floats] | None = None  #: p and lengths at the last tick
    walk: tuple[Floats, Floats] | None = None  #: x and y, and their velocity, at the tick of the last frame


class Found(NamedTuple):
    """What the tracking has found."""

    numbers: Ints
    states: HumanStates
    counts: Counter[str]


def follow(
    ticks_ns: Ints, measured: Measurements, bodies: Ints, rules: PeopleRules, settings: Fusion, limits: LimitSet
) -> Found:
    """See ``people.follow``."""
    people, spent = [Body(1, fuse.start(measured.cameras), is_person=True)], {1}
    numbers, counts, parts = np.zeros(len(measured), np.int64), Counter[str](), []
    for now_ns, before_ns in zip(ticks_ns, [-(10**18), *ticks_ns[:-1]], strict=True):
        due = np.flatnonzero((measured.arrival_ns > before_ns) & (measured.arrival_ns <= now_ns))
        frames: dict[tuple[int, int], list[int]] = {}
        for row in due.tolist():
            frames.setdefault((int(measured.camera[row]), int(measured.capture_ns[row])), []).append(row)
        for frame in frames.values():
            _assign(people, spent, frame, measured, bodies, rules, numbers, counts)
        for one in sorted(people, key=lambda one: one.number):
            parts += _move(one, people, int(now_ns), measured, due, numbers, rules, settings, limits, counts)
        there = _there(people, int(now_ns), rules, settings)
        counts["bodies_seen_briefly"] += sum(not one.is_person for one in people if one.number not in there)
        people[:] = [one for one in people if one.number in there]
    return Found(numbers, HumanStates.join(parts), +counts)


def _move(
    one: Body,
    people: list[Body],
    now_ns: int,
    measured: Measurements,
    due: Ints,
    numbers: Ints,
    rules: PeopleRules,
    settings: Fusion,
    limits: LimitSet,
    counts: Counter[str],
) -> list[HumanStates]:
    mine = due[numbers[due] == one.number]
    one.filter, states, some, _ = fuse.fuse(one.filter, np.array([now_ns]), measured.rows(mine), settings, limits)
    counts.update(some)
    if np.isfinite(states.p[0, 0]):
        one.posture = states.p[0], states.lengths_m[0]
        if len(mine):
            one.walk = states.p[0, :2], states.v[0, :2]
    if one.number not in _there(people, now_ns, rules, settings):
        return []
    if not one.is_person:
        unknown = {name: np.full_like(getattr(states, name), np.nan) for name in _BY_THE_FILTER}
        states = replace(
            states,
            **unknown,
            valid=np.zeros_like(states.valid),
            unseen_s=np.full_like(states.unseen_s, np.inf),
            frame_age_s=np.array([(now_ns - one.newest_ns) * 1e-9]),
            points_m=np.asarray(one.newest_m)[None],
        )
    return [replace(states, person=np.array([one.number]))]


def _there(people: list[Body], now_ns: int, rules: PeopleRules, settings: Fusion) -> set[int]:
    remembered = {one.number for one in people if one.is_person and now_ns - one.seen_ns <= rules.memory_s * 1e9}
    last = max((one for one in people if one.is_person), key=lambda one: (one.seen_ns, -one.number))
    young = {one.number for one in people if not one.is_person and now_ns - one.newest_ns <= settings.fresh_s * 1e9}
    return (remembered or {last.number}) | young


def _assign(
    people: list[Body],
    spent: set[int],
    frame: list[int],
    measured: Measurements,
    bodies: Ints,
    rules: PeopleRules,
    numbers: Ints,
    counts: Counter[str],
) -> None:
    camera, capture_ns = int(measured.camera[frame[0]]), int(measured.capture_ns[frame[0]])
    points = {row: np.where(measured.confidence[row][:, None] > 0.0, measured.points_m[row], np.nan) for row in frame}
    known = [row for row in frame if np.isfinite(points[row]).all(axis=1).any()]
    people.sort(key=lambda one: one.number)
    cost = np.array(
        [[_cost(one, camera, capture_ns, row, points[row], measured, rules) for one in people] for row in known]
    )
    whose: dict[int, Body] = {}
    if known:
        for i, k in zip(*linear_sum_assignment(cost), strict=True):
            if cost[i, k] < _NEVER:
                whose[known[i]] = people[k]
    for row in known:
        if row not in whose:
            near = sorted((_apart(points[other], points[row]), other) for other in frame if other in whose)
            if near and near[0][0] < SAME_M:
                numbers[row] = -whose[near[0][1]].number
                continue
            taken = spent | {one.number for one in people}
            whose[row] = Body(min(set(range(1, len(taken) + 2)) - taken), fuse.start(measured.cameras))
            people.append(whose[row])
        one = whose[row]
        counts["person_id_switches"] += one.ids.get(camera, bodies[row]) != bodies[row]
        one.ids[camera], one.seen_ns, one.place_m = bodies[row], int(measured.arrival_ns[row]), _place(points[row])
        one.shown.append((camera, capture_ns))
        if capture_ns >= one.newest_ns:
            one.newest_ns, one.newest_m = capture_ns, points[row]
        grown = len(one.shown) >= BORN_FRAMES and (capture_ns - one.shown[0][1]) * 1e-9 >= BORN_S
        one.is_person = one.is_person or grown
        if one.is_person:
            spent.add(one.number)
        numbers[row] = one.number
    counts["person_bodies_dropped"] += int((numbers[frame] <= 0).sum())
    counts["person_frames_without"] += bool((numbers[frame] <= 0).all())


def _cost(
    one: Body, camera: int, capture_ns: int, row: int, points: Floats, measured: Measurements, rules: PeopleRules
) -> float:
    place_m = _place(points)
    if one.place_m is None or one.newest_m is None:
        return float(_LONG_AGO + np.linalg.norm(place_m - rules.eyes_m[camera]))
    walked_m, expected_m = np.zeros(3), one.newest_m
    if one.walk is not None and one.posture is not None:
        speed = float(np.linalg.norm(one.walk[1]))
        slower = min(1.0, WALKS_M_PER_S / speed) if speed else 0.0
        walked_m[:2] = one.walk[1] * slower * np.clip((capture_ns - one.newest_ns) * 1e-9, 0.0, WALKS_ON_S)
        p = one.posture[0].copy()
        p[:2] = one.walk[0] + walked_m[:2]
        expected_m = skeleton(p[None], one.posture[1][None])[0]
    off_m = float(np.linalg.norm(place_m - one.place_m))
    ahead_m = float(np.linalg.norm(place_m - one.place_m - walked_m))
    if one.is_person and measured.arrival_ns[row] - one.seen_ns > rules.memory_s * 1e9:
        return _LONG_AGO + off_m
    last = dict(one.shown)  # of each camera
    apart_m = _apart(points, expected_m)
    apart_m = ahead_m if np.isnan(apart_m) else apart_m
    elsewhere = any(other != camera and abs(capture_ns - ns) <= APART_S * 1e9 for other, ns in last.items())
    impossible = min(off_m, ahead_m) > rules.jump_m or last.get(camera) == capture_ns
    return _NEVER if impossible or (elsewhere and apart_m > APART_M) else apart_m


def _place(points: Floats) -> Floats:
    torso = points[_TORSO]
    shown = torso if np.isfinite(torso).all(axis=1).any() else points
    return np.asarray(shown[np.isfinite(shown).all(axis=1)].mean(axis=0))


def _apart(points: Floats, expected_m: Floats) -> float:
    """Mean distance, either side being left; NaN without a common point."""
    ways = [np.linalg.norm(points[list(order)] - expected_m, axis=1) for order in (range(len(POINTS)), MIRROR)]
    means = [way[np.isfinite(way)].mean() for way in ways if np.isfinite(way).any()]
    return float(min(means)) if means else np.nan
