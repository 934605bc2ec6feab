"""Tracking of all people: which body of which frame is which person, each with a filter of its own.

The bodies of a frame are assigned to the people tracked so that the sum of the distances between their points and the
predicted fused skeletons is smallest (a Hungarian assignment). The tracker's body ids are not used: they change, and
every camera has its own. A body that belongs to nobody is followed by its points alone, until it has been seen for
``BORN_S``; then it is a person, with the state of the filter that ran since its first frame. A person unseen for the
memory is forgotten, but for the last one, who stays unknown until a camera shows somebody again.

Numbers are kept through occlusion: a person who is hidden is expected where the last velocity leads. The number of a
body that is not yet a person is used again if it never becomes one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from hrcreplay.human.fusion import fuse
from hrcreplay.human.fusion.fuse import FusionState, Trace
from hrcreplay.human.fusion.kalman import NEVER_NS
from hrcreplay.human.model import LimitSet, skeleton
from hrcreplay.records import MIRROR, POINTS, Bools, Floats, HumanStates, Ints, Measurements
from hrcreplay.settings.sections import Fusion

#: Time for which a body must be seen to be a person [s], and number of frames that must show it.
BORN_S, BORN_FRAMES = 0.3, 3
#: Mean distance below which two bodies in one place are the same person twice; people need more room [m].
SAME_M = 0.25
#: Mean distance beyond which a body is not the person that another camera shows at the same time, and that time [m, s].
APART_M, APART_S = 0.5, 0.1
#: Longest time for which a hidden person is expected to walk on, and the largest speed of that [s, m/s].
WALKS_ON_S, WALKS_M_PER_S = 1.0, 2.0
#: Cost of an assignment that is not allowed, and of one to a person unseen for the memory [m].
_NEVER, _LAST = 1e6, 1e3
#: (2, 20) all points, and those of the other side.
_ORDERS = np.array([range(len(POINTS)), MIRROR])
_TORSO = np.array([POINTS.index(name) for name in POINTS if name.startswith(("pelvis", "chest", "neck", "sho", "hip"))])


class PeopleRules(NamedTuple):
    """Settings of the tracking."""

    jump_m: float  #: a body further than this from a person's last and expected position is another person [m]
    memory_s: float  #: time for which an unseen person is remembered [s]
    eyes_m: Floats  #: (c, 3) positions of the cameras, world [m]


class LastFrame(NamedTuple):
    """The last frame in which a camera showed a body."""

    camera: int
    capture_ns: int
    body: int  #: the tracker's id


@dataclass(frozen=True)
class Tracked:
    """A person, or a body that may become one."""

    number: int  #: from 1
    filter: FusionState
    is_person: bool
    born_ns: int = 0  #: capture of the first frame
    frames: int = 0  #: number of frames that showed it
    seen_ns: int = NEVER_NS  #: arrival of the last frame
    place_m: Floats | None = None  #: (3,) middle of the torso in it, world [m]; None: never seen
    shown_ns: int = NEVER_NS  #: capture of the newest frame
    shown_m: Floats | None = None  #: (20, 3) POINTS in it, world [m]
    walk: Floats | None = None  #: (2, 2) x, y and their velocities at the tick of the last frame [m, m/s]
    walk_ns: int = 0  #: that tick
    p: Floats | None = None  #: (13,) JOINTS at the last tick [m, m, rad..., m]; None or NaN: not known
    lengths: Floats | None = None  #: (7,) LENGTHS at the last tick [m]
    views: tuple[LastFrame, ...] = ()  #: of each camera that showed it

    def is_remembered(self, t_ns: int | Ints, memory_s: float) -> bool | Bools:
        """True where it is still remembered at an instant."""
        return t_ns - self.seen_ns <= memory_s * 1e9


class PeopleState(NamedTuple):
    """State of the tracking between two ticks."""

    tracked: tuple[Tracked, ...]  #: in the order of their numbers
    spent: tuple[int, ...]  #: numbers of all people so far


class Seen(NamedTuple):
    """All bodies of a call, and when they arrived."""

    measured: Measurements
    bodies: Ints  #: (n,) the tracker's ids
    until: Ints  #: (k,) row after the last one that arrived by each tick

    def rows(self, tick: int) -> slice:
        """Rows that arrived after the tick before and up to a tick."""
        return slice(int(self.until[tick - 1]) if tick else 0, int(self.until[tick]))

    def ticks(self) -> list[int]:
        """Ticks of new frames."""
        if not len(self.bodies):
            return []
        return [int(k) for k in np.flatnonzero(np.diff(self.until, prepend=0))]


class Followed(NamedTuple):
    """Result of the tracking for some ticks."""

    state: PeopleState
    numbers: Ints  #: (n,) number of each measured body's person; 0: nobody; negative: the person shown twice
    states: HumanStates
    counts: Counter[str]
    trace: Trace


def start(cameras: tuple[str, ...]) -> PeopleState:
    """Makes the state before the first frame: one person, whom no camera has seen yet."""
    return PeopleState((Tracked(1, fuse.start(cameras), is_person=True),), (1,))


def follow(
    state: PeopleState,
    ticks_ns: Ints,
    measured: Measurements,
    bodies: Ints,
    rules: PeopleRules,
    settings: Fusion,
    limits: LimitSet,
    *,
    traced: bool = False,
) -> Followed:
    """Assigns the bodies of all frames to people, and fuses each person.

    The result does not depend on the division of ticks into calls, bit for bit. While each frame shows at most one
    body, and this is never further than ``jump_m`` from its last position, the states are those of ``fuse``.

    Args:
        state: From ``start`` or the previous call.
        ticks_ns: (k,) instants, increasing and after those of the previous call [ns].
        measured: All bodies that arrived after the previous call and up to the last tick, in order of arrival; the
            bodies of one frame are in one call.
        bodies: (n,) the tracker's ids of them.
        rules: Settings of the tracking.
        settings: Settings of the filter.
        limits: Bounds on the joints for the filter.
        traced: True: keep the input of ``smooth``.

    Returns:
        The new state; the number of each body's person; the states, one row per tick and person; the counts of
        ``fuse`` of all people, ``person_bodies_dropped`` (bodies without a point, or shown twice),
        ``person_frames_without`` (frames that show nobody), ``person_id_switches`` and ``bodies_seen_briefly`` (bodies
        that were never a person); and the trace of the rows of the states.
    """
    seen = Seen(measured, bodies, np.searchsorted(measured.arrival_ns, ticks_ns, side="right"))
    given = _follow_alone(state, ticks_ns, seen, rules, settings, limits, traced=traced)
    if given is not None:
        return given
    numbers, counts = np.zeros(len(measured), np.int64), Counter[str]()
    parts: list[tuple[HumanStates, Trace]] = []
    edges = sorted({0, *seen.ticks(), len(ticks_ns)})
    for begin, end in pairwise(edges):
        ticks, rows = ticks_ns[begin:end], seen.rows(begin)
        state = _assign(state, seen, rows, rules, numbers, counts)
        found, tracked = [], []
        for one in state.tracked:
            mine = rows.start + np.flatnonzero(numbers[rows] == one.number)
            after, states, some, trace = fuse.fuse(
                one.filter, ticks, measured.rows(mine), settings, limits, traced=traced
            )
            counts.update(some)
            found.append((one, states, trace))
            tracked.append(_move_on(replace(one, filter=after), states, 0, len(ticks), seen=len(mine) > 0))
        parts += _present(found, ticks, rules, settings)
        state = _forget(state._replace(tracked=tuple(tracked)), int(ticks[-1]), rules, settings, counts)
    states, trace = HumanStates.join([part for part, _ in parts]), Trace.join([part for _, part in parts])
    if (states.numbers != 1).any():
        order = np.lexsort((states.numbers, states.t_ns))
        return Followed(state, numbers, states.rows(order), +counts, trace.rows(order) if traced else trace)
    return Followed(state, numbers, replace(states, person=None), +counts, trace)


def _follow_alone(
    state: PeopleState,
    ticks_ns: Ints,
    seen: Seen,
    rules: PeopleRules,
    settings: Fusion,
    limits: LimitSet,
    *,
    traced: bool,
) -> Followed | None:
    """Follows one person with a single run of the filter; None if not all bodies are this person.

    The filter runs as if they were. The assignment frame by frame, with its states, then shows whether that is so.
    """
    if len(state.tracked) != 1 or not state.tracked[0].is_person:
        return None
    one, numbers, counts = state.tracked[0], np.zeros(len(seen.measured), np.int64), Counter[str]()
    after, states, found, trace = fuse.fuse(one.filter, ticks_ns, seen.measured, settings, limits, traced=traced)
    counts.update(found)
    edges = [*seen.ticks(), len(ticks_ns)]
    state = state._replace(tracked=(_move_on(one, states, 0, edges[0], seen=False),))
    for begin, end in pairwise(edges):
        rows = seen.rows(begin)
        state = _assign(state, seen, rows, rules, numbers, counts)
        if len(state.tracked) > 1 or (numbers[rows] != one.number).any():
            return None
        state = state._replace(tracked=(_move_on(state.tracked[0], states, begin, end, seen=True),))
    state = state._replace(tracked=(replace(state.tracked[0], filter=after),))
    if one.number != 1:
        states = replace(states, person=np.full(len(states), one.number))
    return Followed(state, numbers, states, +counts, trace)


def _move_on(one: Tracked, states: HumanStates, begin: int, end: int, *, seen: bool) -> Tracked:
    """Notes position and velocity at row ``begin``, the tick of a frame if ``seen``, and the posture at ``end`` - 1."""
    if begin == end:
        return one
    one = replace(one, p=states.p[end - 1], lengths=states.lengths_m[end - 1])
    if not seen or not np.isfinite(states.p[begin, 0]):
        return one
    walk = np.stack([states.p[begin, :2], states.v[begin, :2]])
    return replace(one, walk=walk, walk_ns=int(states.t_ns[begin]))


def _present(
    found: Sequence[tuple[Tracked, HumanStates, Trace]], ticks: Ints, rules: PeopleRules, settings: Fusion
) -> Iterable[tuple[HumanStates, Trace]]:
    """Yields the rows of the people who are there, and of bodies by their points, at ticks without a new frame."""
    live = np.array([one.is_person & one.is_remembered(ticks, rules.memory_s) for one, _, _ in found])
    kept = _last_person([one for one, _, _ in found])
    for k, (one, states, trace) in enumerate(found):
        there = live[k]
        if k == kept:
            there = there | ~live.any(axis=0)
        if not one.is_person:
            states = _by_points(one, states)
            there = np.asarray(states.frame_age_s <= settings.fresh_s)
        if there.any():
            numbered = replace(states, person=np.full(len(states), one.number))
            yield numbered.rows(there), trace.rows(there) if len(trace.cov) else trace


def _last_person(tracked: Sequence[Tracked]) -> int:
    """Index of the person seen last."""
    return max(range(len(tracked)), key=lambda k: (tracked[k].is_person, tracked[k].seen_ns, -tracked[k].number))


def _by_points(one: Tracked, states: HumanStates) -> HumanStates:
    """The rows of a body that counts by the points of its newest frame alone."""
    unknown = {
        name: np.full_like(getattr(states, name), np.nan)
        for name in ("p", "v", "a", "j", "p_std", "v_std", "lengths_m", "lengths_std_m", "residual_m")
    }
    return replace(
        states,
        **unknown,
        valid=np.zeros_like(states.valid),
        unseen_s=np.full_like(states.unseen_s, np.inf),
        frame_age_s=np.asarray((states.t_ns - one.shown_ns) * 1e-9),
        points_m=np.tile(np.asarray(one.shown_m), (len(states), 1, 1)),
        legs_sway_m=np.full(len(states), np.nan),
    )


def _forget(state: PeopleState, t_ns: int, rules: PeopleRules, settings: Fusion, counts: Counter[str]) -> PeopleState:
    """Removes who is not there any more; the last person stays."""
    live = [one for one in state.tracked if one.is_person and one.is_remembered(t_ns, rules.memory_s)]
    kept = live or [state.tracked[_last_person(state.tracked)]]
    young = [one for one in state.tracked if not one.is_person]
    stay = [one for one in young if (t_ns - one.shown_ns) * 1e-9 <= settings.fresh_s]
    counts["bodies_seen_briefly"] += len(young) - len(stay)
    return state._replace(tracked=tuple(sorted([*kept, *stay], key=lambda one: one.number)))


def _assign(
    state: PeopleState, seen: Seen, rows: slice, rules: PeopleRules, numbers: Ints, counts: Counter[str]
) -> PeopleState:
    """Assigns the bodies that arrived in one tick, frame after frame; writes their ``numbers``."""
    measured, bodies = seen.measured, seen.bodies
    for frame in _by_frame(measured, rows):
        points_m = _shown(measured, frame)
        places_m = _places(points_m)
        known = np.isfinite(places_m[:, 0])
        cost = _costs(state.tracked, measured, frame, points_m, places_m, rules)
        of_body = _solve(cost, known)
        for b in np.flatnonzero(known).tolist():
            row, k = frame[b], of_body[b]
            if k < 0 and (same := _shown_twice(points_m[b], points_m, of_body)) >= 0:
                numbers[row] = -state.tracked[same].number
                continue
            if k < 0:
                state, k = _add(state, measured, row)
                of_body = np.where(of_body >= k, of_body + 1, of_body)
                of_body[b] = k
            one = _see(state.tracked[k], measured, int(bodies[row]), row, points_m[b], places_m[b], counts)
            numbers[row] = one.number
            tracked = (*state.tracked[:k], one, *state.tracked[k + 1 :])
            spent = state.spent if not one.is_person else tuple(sorted({*state.spent, one.number}))
            state = PeopleState(tracked, spent)
        counts["person_bodies_dropped"] += int((numbers[frame] <= 0).sum())
        counts["person_frames_without"] += not (numbers[frame] > 0).any()
    return state


def _by_frame(measured: Measurements, rows: slice) -> list[list[int]]:
    """The rows of each frame, frames in order of their first row."""
    found: dict[tuple[int, int], list[int]] = {}
    for row in range(rows.start, rows.stop):
        found.setdefault((int(measured.camera[row]), int(measured.capture_ns[row])), []).append(row)
    return list(found.values())


def _shown(measured: Measurements, frame: list[int]) -> Floats:
    """(b, 20, 3) the points of the bodies of a frame, NaN without a confidence [m]."""
    return np.where(measured.confidence[frame][..., None] > 0.0, measured.points_m[frame], np.nan)


def _places(points_m: Floats) -> Floats:
    """(b, 3) middle of each body's torso, or of all its points if no torso is shown; NaN without a point [m]."""
    seen: Bools = np.asarray(np.isfinite(points_m).all(axis=2))
    torso = np.zeros_like(seen)
    torso[:, _TORSO] = seen[:, _TORSO]
    use: Bools = np.where(torso.any(axis=1, keepdims=True), torso, seen)
    count = use.sum(axis=1, keepdims=True).astype(np.float64)
    total = np.where(use[..., None], points_m, 0.0).sum(axis=1)
    return np.asarray(total / np.where(count > 0, count, np.nan))


def _costs(
    tracked: Sequence[Tracked],
    measured: Measurements,
    frame: list[int],
    points_m: Floats,
    places_m: Floats,
    rules: PeopleRules,
) -> Floats:
    """(b, k) mean distance of each body from each person [m]; ``_NEVER`` if it cannot be this person."""
    camera, capture_ns = int(measured.camera[frame[0]]), int(measured.capture_ns[frame[0]])
    arrival_ns = int(measured.arrival_ns[frame[0]])
    cost = np.full((len(frame), len(tracked)), _NEVER)
    for k, one in enumerate(tracked):
        if one.place_m is None:
            cost[:, k] = _LAST + np.linalg.norm(places_m - rules.eyes_m[camera], axis=1)
            continue
        walked_m = _walked(one, capture_ns)
        off_m = np.linalg.norm(places_m - one.place_m, axis=1)
        ahead_m = np.linalg.norm(places_m - one.place_m - walked_m, axis=1)
        if one.is_person and not one.is_remembered(arrival_ns, rules.memory_s):
            cost[:, k] = _LAST + off_m
            continue
        apart_m = _apart(points_m, _expected(one, walked_m), ahead_m)
        allowed = np.minimum(off_m, ahead_m) <= rules.jump_m
        allowed &= all(view[:2] != (camera, capture_ns) for view in one.views)  # the rest of a frame that came in parts
        if _is_shown_by_another(one, camera, capture_ns):
            allowed &= apart_m <= APART_M
        cost[allowed, k] = apart_m[allowed]
    return cost


def _walked(one: Tracked, capture_ns: int) -> Floats:
    """(3,) way from the last position to the expected one [m]."""
    if one.walk is None:
        return np.zeros(3)
    v = one.walk[1]
    speed = float(np.hypot(v[0], v[1]))
    v = v * (min(speed, WALKS_M_PER_S) / speed) if speed > 0.0 else v
    return np.append(v * min(max((capture_ns - one.shown_ns) * 1e-9, 0.0), WALKS_ON_S), 0.0)


def _expected(one: Tracked, walked_m: Floats) -> Floats:
    """(20, 3) the points expected [m]: of the fused skeleton, else those last shown."""
    if one.walk is None or one.p is None or one.lengths is None or np.isnan(one.p[0]):
        return np.asarray(one.shown_m)
    p = one.p[None].copy()
    p[0, :2] = one.walk[0] + walked_m[:2]
    return np.asarray(skeleton(p, one.lengths[None])[0])


def _apart(points_m: Floats, expected_m: Floats, otherwise_m: Floats) -> Floats:
    """(b,) mean distance of bodies (b, 20, 3) from a skeleton (20, 3), either side being left [m].

    ``otherwise_m`` (b,) is for bodies without a common point.
    """
    off = np.linalg.norm(points_m[:, _ORDERS] - expected_m, axis=3)
    known = np.isfinite(off)
    total, count = np.where(known, off, 0.0).sum(axis=2), known.sum(axis=2)
    ways = np.where(count > 0, total / np.maximum(count, 1), otherwise_m[:, None])
    return np.asarray(ways.min(axis=1))


def _is_shown_by_another(one: Tracked, camera: int, capture_ns: int) -> bool:
    """True if another camera shows the person at the same time."""
    return any(view.camera != camera and abs(capture_ns - view.capture_ns) <= APART_S * 1e9 for view in one.views)


def _solve(cost: Floats, known: Bools) -> Ints:
    """(b,) index of each body's person; -1: none."""
    found = np.full(len(cost), -1)
    rows = np.flatnonzero(known)
    if len(rows):
        chosen, persons = linear_sum_assignment(cost[rows])
        allowed = cost[rows[chosen], persons] < _NEVER
        found[rows[chosen[allowed]]] = persons[allowed]
    return found


def _shown_twice(points_m: Floats, all_m: Floats, of_body: Ints) -> int:
    """Index of the person whose body is where a body (20, 3) of the same frame (b, 20, 3) is; -1: none."""
    off = np.where(of_body >= 0, _apart(all_m, points_m, np.full(len(all_m), np.inf)), np.inf)
    return int(of_body[np.argmin(off)]) if off.min() < SAME_M else -1


def _add(state: PeopleState, measured: Measurements, row: int) -> tuple[PeopleState, int]:
    """Adds a body that belongs to nobody; returns its index, too."""
    taken = {*state.spent, *(one.number for one in state.tracked)}
    number = next(n for n in range(1, len(taken) + 2) if n not in taken)
    one = Tracked(number, fuse.start(measured.cameras), is_person=False, born_ns=int(measured.capture_ns[row]))
    tracked = tuple(sorted([*state.tracked, one], key=lambda some: some.number))
    return state._replace(tracked=tracked), tracked.index(one)


def _see(
    one: Tracked,
    measured: Measurements,
    body: int,
    row: int,
    points_m: Floats,
    place_m: Floats,
    counts: Counter[str],
) -> Tracked:
    """Notes a frame that shows a person or body."""
    camera, capture_ns = int(measured.camera[row]), int(measured.capture_ns[row])
    before = [view for view in one.views if view.camera == camera]
    counts["person_id_switches"] += any(view.body != body for view in before)
    views = (*(view for view in one.views if view.camera != camera), LastFrame(camera, capture_ns, body))
    frames, newer = one.frames + 1, capture_ns >= one.shown_ns
    grown = frames >= BORN_FRAMES and (capture_ns - one.born_ns) * 1e-9 >= BORN_S
    return replace(
        one,
        is_person=one.is_person or grown,
        frames=frames,
        seen_ns=int(measured.arrival_ns[row]),
        place_m=place_m,
        shown_ns=capture_ns if newer else one.shown_ns,
        shown_m=points_m if newer else one.shown_m,
        views=tuple(sorted(views)),
    )
