"""Kernel of the tracking: which body of a frame is whom, and one tick after another for all of them.

``people`` says what the tracking does. People and bodies that may become people have a slot each, in arrays that have
the slots as their first axis. A slot is used once; when there are too few, or too few rows for the states, the kernel
returns and goes on with larger arrays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.vectors import distance
from hrcreplay.human.fusion.kalman import NEVER_NS, Filter, Frames, Rules, StateEstimate, Track, one_of
from hrcreplay.human.fusion.kernel import step, store, write_unknown
from hrcreplay.human.model import skeleton_row
from hrcreplay.kernels import njit
from hrcreplay.records import MIRROR, POINTS, Bools, Floats, Ints

#: Time for which a body must be seen to be a person [s], and number of frames that must show it.
BORN_S, BORN_FRAMES = 0.3, 3
#: Mean distance below which two bodies in one place are the same person twice; people need more room [m].
SAME_M = 0.25
#: Mean distance beyond which a body is not the person that another camera shows at the same time, and that time [m, s].
APART_M, APART_S = 0.5, 0.1
#: Longest time for which a hidden person is expected to walk on, and the largest speed of that [s, m/s].
WALKS_ON_S, WALKS_M_PER_S = 1.0, 2.0
#: Number of a slot that has not been used, and of one whose body or person was forgotten.
FREE, GONE = 0, -1
#: Counts of events, in the order of ``ShownBodies.counts``: bodies without a point or shown twice, frames with nobody,
#: changes of the tracker's id, bodies that were never a person.
EVENTS = ("person_bodies_dropped", "person_frames_without", "person_id_switches", "bodies_seen_briefly")
_DROPPED, _WITHOUT, _SWITCHES, _BRIEFLY = range(len(EVENTS))
#: Cost of an assignment that is not allowed, and of one to a person unseen for the memory [m].
_NEVER, _LAST = 1e6, 1e3
#: (2, 20) all points, and those of the other side.
_ORDERS = np.array([range(len(POINTS)), MIRROR])
_IS_TORSO = np.array([name.startswith(("pelvis", "chest", "neck", "sho", "hip")) for name in POINTS])


class TrackedBodies(NamedTuple):
    """People, and bodies that may become people, one a slot."""

    number: Ints  #: (s,) from 1; ``FREE`` or ``GONE``: there is nobody
    is_person: Bools  #: (s,)
    born_ns: Ints  #: (s,) capture of the first frame
    frames: Ints  #: (s,) number of frames that showed it
    seen_ns: Ints  #: (s,) arrival of the last frame
    place_m: Floats  #: (s, 3) middle of the torso in it, world [m]; NaN: never seen
    shown_ns: Ints  #: (s,) capture of the newest frame
    shown_m: Floats  #: (s, 20, 3) POINTS in it, world [m]
    walk: Floats  #: (s, 2, 2) x, y and their velocities at the tick of the last frame [m, m/s]; NaN: not known
    view_ns: Ints  #: (s, c) capture of the last frame of each camera that showed it
    view_id: Ints  #: (s, c) the tracker's id in it


class TrackingRules(NamedTuple):
    """Settings of the tracking as the kernel needs them."""

    jump_m: float
    memory_ns: float
    eyes_m: Floats  #: (c, 3) positions of the cameras, world [m]
    fresh_s: float


class ShownBodies(NamedTuple):
    """All bodies of a call in order of arrival, and what the kernel finds out."""

    frames: Frames
    ids: Ints  #: (n,) the tracker's ids
    number: Ints  #: (n,) number of each body's person; 0: nobody; negative: the person shown twice
    done: Bools  #: (n,) True once its frame is assigned
    counts: Ints  #: (4,) EVENTS


class StateRows(NamedTuple):
    """Rows of states, one per tick and person."""

    track: Track
    t_ns: Ints  #: (m,)
    number: Ints  #: (m,)


@njit(cache=True)
def follow_ticks(
    ticks_ns: Ints,
    bodies: ShownBodies,
    tracks: TrackedBodies,
    filters: Filter,
    spent: Bools,
    tracking: TrackingRules,
    rules: Rules,
    rows: StateRows,
    done: Ints,
) -> int:
    """Follows everybody tick after tick, until the last or until slots or rows run out; changes the state in place.

    Args:
        ticks_ns: (k,) instants.
        bodies: All that arrive by the last tick.
        tracks: Before the tick; a free slot is as it was made.
        filters: Of the slots, which are the first axis of all arrays.
        spent: (p,) True for numbers (index + 1) of people so far; at least one is neither spent nor used by a slot.
        tracking: Settings of the tracking.
        rules: Settings of the filter.
        rows: Receives the states.
        done: (2,) ticks done, and bodies that arrived by them; both are advanced.

    Returns:
        The number of rows written.
    """
    written = 0
    for k in range(done[0], len(ticks_ns)):
        first, now = done[1], ticks_ns[k]
        last = first
        while last < len(bodies.ids) and bodies.frames.arrival_ns[last] <= now:
            last += 1
        if written + np.sum(tracks.number > FREE) + last - first > len(rows.t_ns):
            return written
        for row in range(first, last):
            if not bodies.done[row] and not _assign(
                row, last, bodies, tracks, filters, spent, tracking, rows.track.superseded
            ):
                return written
        slots = _in_order(tracks.number)
        kept = _kept(slots, tracks, now, tracking)
        for slot in slots:
            filter_ = one_of(filters, slot)
            step(filter_, now, rules, rows.track, written)
            written += _write(now, slot, kept[slot], bodies.number[first:last], tracks, filter_.estimate, rows, written)
        _forget(tracks, kept, bodies.counts)
        done[0], done[1] = k + 1, last
    return written


@njit(cache=True, inner=True)
def _write(
    now: int,
    slot: int,
    kept: bool,
    numbers: Ints,
    tracks: TrackedBodies,
    estimate: StateEstimate,
    rows: StateRows,
    at: int,
) -> int:
    """Completes row ``at`` after the tick of a slot's filter; returns 1, or 0 if nobody is there and the row is free.

    ``numbers`` are those of the bodies that the tick's frames showed.
    """
    if (numbers == tracks.number[slot]).any() and estimate.started[0]:
        tracks.walk[slot] = estimate.mean[:2, :2].T
    if not kept:
        return 0
    if not tracks.is_person[slot]:
        write_unknown(rows.track, at)
        rows.track.frame_age[at] = (now - tracks.shown_ns[slot]) * 1e-9
        rows.track.points[at] = tracks.shown_m[slot]
    rows.t_ns[at], rows.number[at] = now, tracks.number[slot]
    return 1


@njit(cache=True, inner=True)
def _kept(slots: Ints, tracks: TrackedBodies, now: int, tracking: TrackingRules) -> Bools:
    """(s,) true for people who are remembered, at least the last one, and for bodies that a camera has just shown.

    There is always a person, as the last one is kept.
    """
    kept, last = np.zeros(len(tracks.number), np.bool_), -1
    for slot in slots:
        if not tracks.is_person[slot]:
            kept[slot] = (now - tracks.shown_ns[slot]) * 1e-9 <= tracking.fresh_s
            continue
        kept[slot] = now - tracks.seen_ns[slot] <= tracking.memory_ns
        if last < 0 or tracks.seen_ns[slot] > tracks.seen_ns[last]:
            last = slot
    kept[last] = True
    return kept


@njit(cache=True, inner=True)
def _forget(tracks: TrackedBodies, kept: Bools, counts: Ints) -> None:
    """Removes who is not there any more."""
    for slot in range(len(kept)):
        if tracks.number[slot] > FREE and not kept[slot]:
            tracks.number[slot] = GONE
            counts[_BRIEFLY] += not tracks.is_person[slot]


@njit(cache=True, inner=True)
def _in_order(number: Ints) -> Ints:
    """The slots with somebody, by their numbers."""
    slots = np.flatnonzero(number > FREE)
    return slots[np.argsort(number[slots])] if len(slots) > 1 else slots


@njit(cache=True, inner=True)
def _assign(
    row: int,
    last: int,
    bodies: ShownBodies,
    tracks: TrackedBodies,
    filters: Filter,
    spent: Bools,
    tracking: TrackingRules,
    superseded: Ints,
) -> bool:
    """Assigns the bodies of the frame that begins at a row, and stores each for its filter.

    Returns False, with nothing changed, if there are fewer free slots than bodies that belong to nobody.
    """
    frames = bodies.frames
    rest = slice(row, last)
    frame = row + np.flatnonzero(
        (frames.camera[rest] == frames.camera[row]) & (frames.capture_ns[rest] == frames.capture_ns[row])
    )
    points_m, places_m = _shown(frames, frame)
    of_body = _whose(frames, row, points_m, places_m, tracks, filters.estimate, tracking)
    known = np.isfinite(places_m[:, 0])
    if np.sum(known & (of_body < 0)) > np.sum(tracks.number == FREE):
        return False
    for b in np.flatnonzero(known):
        if of_body[b] < 0:
            same = _shown_twice(points_m[b], points_m, of_body)
            if same >= 0:
                bodies.number[frame[b]] = -tracks.number[same]
                continue
            of_body[b] = _add(tracks, spent, frames.capture_ns[row])
        slot = of_body[b]
        bodies.counts[_SWITCHES] += _see(tracks, slot, bodies, frame[b], points_m[b], places_m[b])
        if tracks.is_person[slot]:
            spent[tracks.number[slot] - 1] = True
        store(frames, frame[b], one_of(filters, slot).gate, superseded)
        bodies.number[frame[b]] = tracks.number[slot]
    bodies.done[frame] = True
    without = np.sum(bodies.number[frame] <= 0)
    bodies.counts[_DROPPED] += without
    bodies.counts[_WITHOUT] += without == len(frame)
    return True


@njit(cache=True, inner=True)
def _shown(frames: Frames, frame: Ints) -> tuple[Floats, Floats]:
    """The points (b, 20, 3) of the bodies of a frame, NaN without a confidence, and their places (b, 3) [m].

    The place is the middle of the torso, or of all points if no torso is shown; NaN without a point.
    """
    points_m, places_m = np.full((len(frame), len(_IS_TORSO), 3), np.nan), np.empty((len(frame), 3))
    for b, row in enumerate(frame):
        for k in range(len(_IS_TORSO)):
            if frames.confidence[row, k] > 0.0:
                points_m[b, k] = frames.points[row, k]
        places_m[b] = _middle(points_m[b], of_torso=True)
        if np.isnan(places_m[b, 0]):
            places_m[b] = _middle(points_m[b], of_torso=False)
    return points_m, places_m


@njit(cache=True, inner=True)
def _middle(points_m: Floats, of_torso: bool) -> Floats:
    """The mean (3,) of the points (20, 3) that are known, or of those of the torso; NaN without one."""
    total, count = np.zeros(3), 0
    for k in range(len(points_m)):
        if (_IS_TORSO[k] or not of_torso) and np.isfinite(points_m[k]).all():
            total += points_m[k]
            count += 1
    return total / (count if count > 0 else np.nan)


@njit(cache=True, inner=True)
def _whose(
    frames: Frames,
    row: int,
    points_m: Floats,
    places_m: Floats,
    tracks: TrackedBodies,
    estimate: StateEstimate,
    tracking: TrackingRules,
) -> Ints:
    """(b,) slot of each body of the frame that begins at a row; -1: nobody's."""
    of_body = np.full(len(points_m), -1)
    known, slots = np.flatnonzero(np.isfinite(places_m[:, 0])), _in_order(tracks.number)
    if len(known) == 0:
        return of_body
    cost = np.full((len(known), len(slots) + len(known)), _NEVER)  # the last columns are nobody
    for column, slot in enumerate(slots):
        expected_m, walked_m = _expected(tracks, slot, estimate, frames.capture_ns[row])
        for i, b in enumerate(known):
            cost[i, column] = _cost(frames, row, points_m[b], places_m[b], tracks, slot, expected_m, walked_m, tracking)
    chosen = least_sum(cost)
    for i, b in enumerate(known):
        if chosen[i] < len(slots) and cost[i, chosen[i]] < _NEVER:
            of_body[b] = slots[chosen[i]]
    return of_body


@njit(cache=True, inner=True)
def _cost(
    frames: Frames,
    row: int,
    points_m: Floats,
    place_m: Floats,
    tracks: TrackedBodies,
    slot: int,
    expected_m: Floats,
    walked_m: Floats,
    tracking: TrackingRules,
) -> float:
    """Mean distance of a body of the frame that begins at a row from a person [m]; ``_NEVER`` if it cannot be this."""
    camera, capture_ns = frames.camera[row], frames.capture_ns[row]
    last_m = tracks.place_m[slot]
    if np.isnan(last_m[0]):
        return _LAST + distance(place_m, tracking.eyes_m[camera])
    off_m, ahead_m = distance(place_m, last_m), distance(place_m - walked_m, last_m)
    if tracks.is_person[slot] and frames.arrival_ns[row] - tracks.seen_ns[slot] > tracking.memory_ns:
        return _LAST + off_m
    if min(off_m, ahead_m) > tracking.jump_m or tracks.view_ns[slot, camera] == capture_ns:  # a frame in parts
        return _NEVER
    apart_m = apart(points_m, expected_m, ahead_m)
    for other in range(tracks.view_ns.shape[1]):
        at_once = other != camera and abs(capture_ns - tracks.view_ns[slot, other]) <= APART_S * 1e9
        if at_once and apart_m > APART_M:
            return _NEVER
    return apart_m


@njit(cache=True, inner=True)
def _expected(tracks: TrackedBodies, slot: int, estimate: StateEstimate, capture_ns: int) -> tuple[Floats, Floats]:
    """The points (20, 3) expected, of the fused skeleton, else those last shown; and the way (3,) there [m]."""
    walk, walked_m = tracks.walk[slot], np.zeros(3)
    if np.isnan(walk[0, 0]):
        return tracks.shown_m[slot].copy(), walked_m
    speed = np.hypot(walk[1, 0], walk[1, 1])
    if speed > 0.0:
        after_s = min(max((capture_ns - tracks.shown_ns[slot]) * 1e-9, 0.0), WALKS_ON_S)
        walked_m[:2] = walk[1] * (min(speed, WALKS_M_PER_S) / speed) * after_s
    p, expected_m = estimate.mean[slot, :, 0].copy(), np.full(tracks.shown_m[slot].shape, np.nan)
    p[:2] = walk[0] + walked_m[:2]
    skeleton_row(p, estimate.lengths[slot], expected_m)
    return expected_m, walked_m


@njit(cache=True)
def apart(points_m: Floats, expected_m: Floats, otherwise_m: float) -> float:
    """Mean distance of a body's points (20, 3) from others (20, 3), either side being left [m].

    ``otherwise_m`` is for a body without a common point.
    """
    least = np.inf
    for way in range(2):
        total, count = 0.0, 0
        for k in range(len(expected_m)):
            off = distance(points_m[_ORDERS[way, k]], expected_m[k])
            if np.isfinite(off):
                total, count = total + off, count + 1
        least = min(least, total / count if count > 0 else otherwise_m)
    return least


@njit(cache=True)
def least_sum(cost: Floats) -> Ints:
    """Chooses a column for each row of costs (n, m), n <= m, none twice, so that the sum of their costs is smallest.

    Rows are added one by one; each time the shortest way leads from the new row over columns that are taken to one that
    is not, and prices of rows and columns keep all costs left above 0 (Kuhn, 1955; Crouse, 2016, has the notation).

    Returns:
        (n,) the columns.
    """
    n, m = cost.shape
    of_row, of_column = np.full(n, -1), np.full(m, -1)
    row_price, column_price = np.zeros(n), np.zeros(m)
    for new in range(n):
        way, before, reached = np.full(m, np.inf), np.full(m, -1), np.zeros(m, np.bool_)
        row, length = new, 0.0
        while row >= 0:
            end = -1
            for column in range(m):
                if not reached[column]:
                    through = length + cost[row, column] - row_price[row] - column_price[column]
                    if through < way[column]:
                        way[column], before[column] = through, row
                    if end < 0 or way[column] < way[end]:
                        end = column
            length, reached[end] = way[end], True
            row = int(of_column[end])
        row_price[new] += length
        for taken in np.flatnonzero(reached):
            if of_column[taken] >= 0:
                row_price[of_column[taken]] += length - way[taken]
            column_price[taken] -= length - way[taken]
        while row != new:
            row = int(before[end])
            of_column[end] = row
            of_row[row], end = end, of_row[row]
    return of_row


@njit(cache=True, inner=True)
def _shown_twice(points_m: Floats, all_m: Floats, of_body: Ints) -> int:
    """Slot of the person whose body is where a body (20, 3) of the same frame (b, 20, 3) is; -1: none."""
    nearest_m, same = SAME_M, -1
    for b in range(len(all_m)):
        if of_body[b] >= 0:
            off_m = apart(all_m[b], points_m, np.inf)
            if off_m < nearest_m:
                nearest_m, same = off_m, int(of_body[b])
    return same


@njit(cache=True, inner=True)
def _add(tracks: TrackedBodies, spent: Bools, born_ns: int) -> int:
    """Gives a free slot to a body that belongs to nobody, with the smallest number that is neither spent nor used."""
    number = 1
    while spent[number - 1] or (tracks.number == number).any():
        number += 1
    slot = int(np.argmax(tracks.number == FREE))
    tracks.number[slot], tracks.born_ns[slot] = number, born_ns
    return slot


@njit(cache=True, inner=True)
def _see(tracks: TrackedBodies, slot: int, bodies: ShownBodies, row: int, points_m: Floats, place_m: Floats) -> bool:
    """Notes a frame that shows a person or body; returns True if the camera's id of it has changed."""
    camera, capture_ns = bodies.frames.camera[row], bodies.frames.capture_ns[row]
    switched = tracks.view_ns[slot, camera] != NEVER_NS and tracks.view_id[slot, camera] != bodies.ids[row]
    tracks.view_ns[slot, camera], tracks.view_id[slot, camera] = capture_ns, bodies.ids[row]
    tracks.frames[slot] += 1
    if tracks.frames[slot] >= BORN_FRAMES and (capture_ns - tracks.born_ns[slot]) * 1e-9 >= BORN_S:
        tracks.is_person[slot] = True
    tracks.seen_ns[slot] = bodies.frames.arrival_ns[row]
    tracks.place_m[slot] = place_m
    if capture_ns >= tracks.shown_ns[slot]:
        tracks.shown_ns[slot], tracks.shown_m[slot] = capture_ns, points_m
    return switched
