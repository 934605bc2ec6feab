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
from typing import Any, NamedTuple, TypeVar

import numpy as np

from hrcreplay.human.fusion import fuse
from hrcreplay.human.fusion.assignment import (
    EVENTS,
    FREE,
    ShownBodies,
    StateRows,
    TrackedBodies,
    TrackingRules,
    follow_ticks,
)
from hrcreplay.human.fusion.fuse import Trace
from hrcreplay.human.fusion.kalman import NEVER_NS, Filter
from hrcreplay.human.model import LimitSet
from hrcreplay.records import POINTS, Bools, Floats, HumanStates, Ints, Measurements
from hrcreplay.settings.sections import Fusion


class PeopleRules(NamedTuple):
    """Settings of the tracking."""

    jump_m: float  #: a body further than this from a person's last and expected position is another person [m]
    memory_s: float  #: time for which an unseen person is remembered [s]
    eyes_m: Floats  #: (c, 3) positions of the cameras, world [m]


class PeopleState(NamedTuple):
    """State of the tracking between two ticks."""

    tracks: TrackedBodies  #: one slot for each person, body that may become one, and some that are free
    filters: Filter  #: those of the slots, their first axis
    spent: Bools  #: (p,) True for the numbers (index + 1) of all people so far


class Followed(NamedTuple):
    """Result of the tracking for some ticks."""

    state: PeopleState
    numbers: Ints  #: (n,) number of each measured body's person; 0: nobody; negative: the person shown twice
    states: HumanStates
    counts: Counter[str]
    trace: Trace


def start(cameras: tuple[str, ...]) -> PeopleState:
    """Makes the state before the first frame: one person, whom no camera has seen yet."""
    tracks, filters = _free_slots(len(cameras), 1)
    tracks.number[0], tracks.is_person[0] = 1, True
    return PeopleState(tracks, filters, np.array([True, False]))


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
        state: From ``start`` or the previous call. It is not changed.
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
    n, cameras = len(measured), measured.cameras
    frames = fuse.as_frames(measured)
    seen = ShownBodies(
        frames, np.array(bodies), np.zeros(n, np.int64), np.zeros(n, np.bool_), np.zeros(len(EVENTS), np.int64)
    )
    tracking = TrackingRules(float(rules.jump_m), rules.memory_s * 1e9, np.array(rules.eyes_m), settings.fresh_s)
    filter_rules, ticks_ns, done = fuse.as_rules(settings, limits), np.array(ticks_ns), np.zeros(2, np.int64)
    tracks = TrackedBodies._make(array.copy() for array in state.tracks)
    state = PeopleState(tracks, fuse.copied(state.filters), state.spent.copy())
    parts: list[tuple[HumanStates, Counter[str], Trace]] = []
    while True:
        rows = _empty_rows(state, len(ticks_ns) - done[0], n - done[1], len(cameras), traced=traced)
        m = follow_ticks(ticks_ns, seen, *state, tracking, filter_rules, rows, done)
        number = rows.number[:m]
        parts.append(fuse.written(rows.track, m, rows.t_ns[:m], number if (number != 1).any() else None, cameras))
        if done[0] == len(ticks_ns):
            break
        waiting = np.searchsorted(frames.arrival_ns, ticks_ns[done[0]], side="right") - done[1]
        state = _with_free_slots(state, len(cameras), int(waiting))
    found = Counter(dict(zip(EVENTS, seen.counts.tolist(), strict=True)))
    for _, some, _ in parts:
        found.update(some)
    states, _, trace = parts[0]
    if len(parts) > 1:
        states, trace = HumanStates.join([part[0] for part in parts]), Trace.join([part[2] for part in parts])
    return Followed(state, seen.number, states, +found, trace)


def _empty_rows(state: PeopleState, ticks: int, bodies: int, cameras: int, *, traced: bool) -> StateRows:
    """Makes rows for all ticks, if no more bodies are followed than now; the kernel asks for some more at each tick."""
    n = ticks * int((state.tracks.number > FREE).sum()) + bodies
    return StateRows(fuse.empty_track(n, cameras, traced=traced), np.empty(n, np.int64), np.empty(n, np.int64))


def _with_free_slots(state: PeopleState, cameras: int, free: int) -> PeopleState:
    """The state with so many free slots, and without those of bodies and people who were forgotten."""
    used = np.flatnonzero(state.tracks.number > FREE)
    tracks, filters = _free_slots(cameras, free)
    more = max(0, int(state.spent.sum()) + len(used) + free - len(state.spent))  # a number for each slot
    return PeopleState(
        _joined(state.tracks, tracks, used),
        Filter(
            _joined(state.filters.estimate, filters.estimate, used),
            _joined(state.filters.gate, filters.gate, used),
            _joined(state.filters.model, filters.model, used),
        ),
        np.append(state.spent, np.zeros(more, np.bool_)),
    )


_Slots = TypeVar("_Slots", bound=tuple[Any, ...])


def _joined(ours: _Slots, more: _Slots, used: Ints) -> _Slots:
    """The slots that are used, and more behind them."""
    return type(ours)(*(np.concatenate([a[used], b]) for a, b in zip(ours, more, strict=True)))


def _free_slots(cameras: int, free: int) -> tuple[TrackedBodies, Filter]:
    """So many slots that nobody has used."""
    tracks = TrackedBodies(
        number=np.full(free, FREE),
        is_person=np.zeros(free, np.bool_),
        born_ns=np.full(free, NEVER_NS),
        frames=np.zeros(free, np.int64),
        seen_ns=np.full(free, NEVER_NS),
        place_m=np.full((free, 3), np.nan),
        shown_ns=np.full(free, NEVER_NS),
        shown_m=np.full((free, len(POINTS), 3), np.nan),
        walk=np.full((free, 2, 2), np.nan),
        view_ns=np.full((free, cameras), NEVER_NS),
        view_id=np.zeros((free, cameras), np.int64),
    )
    estimate, gate, model = fuse.start(("",) * cameras)
    return tracks, Filter(_repeated(estimate, free), _repeated(gate, free), _repeated(model, free))


def _repeated(part: _Slots, times: int) -> _Slots:
    """The same arrays for so many slots."""
    return type(part)(*(np.repeat(array[None], times, axis=0) for array in part))
