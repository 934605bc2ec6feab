"""Time since an area that the cameras watch was certainly empty.

The area is vacant at an instant if all cameras have sent frames up to it, for long enough and without a gap, and every
body seen inside was later seen outside. A body that was lost inside may still be there, but only for a limited time:
trackers lose people and report false ones. After the instant, no person can be deeper inside than people walk in the
time since. A body counts at every place where a camera shows one of its points, for the people that the filters follow
and for others; a body without points may be anywhere. Each person has an instant of its own: the last at which neither
this person nor anybody whom no filter follows was inside.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.polygon import ConvexPolygon
from hrcreplay.records import NOBODY, CameraFrames, Floats, HumanStates, Ints


@dataclass(frozen=True)
class WatchedArea:
    """Area that the cameras see together: every person with a point of the body in it is seen by one of them."""

    polygon: ConvexPolygon  #: on the floor; the height is unlimited
    margin_m: float  #: maximum depth inside the border of a person not seen yet [m]
    clear_s: float  #: time for which a body lost inside is assumed to be there [s]
    gap_s: float  #: maximum time between two frames of a camera without a gap [s]
    speed_m_per_s: float  #: speed of people who walk in, ISO 13855

    def reached_m(self, since_s: float | Floats) -> float | Floats:
        """Depth inside the border that a person outside ``since_s`` [s] ago can have reached; inf for inf [m]."""
        return self.margin_m + self.speed_m_per_s * since_s


class Sighting(NamedTuple):
    """Last place at which a camera showed a body."""

    capture_ns: int
    inside: bool
    person: int  #: number of the person; 0: nobody that a filter follows


class VacancyState(NamedTuple):
    """State between two tables of frames; instants are captures [ns]."""

    newest_ns: tuple[int, ...]  #: camera -> its newest frame; -1 before the first
    begin_ns: tuple[int, ...]  #: camera -> start of its frames without a gap
    bodies: tuple[tuple[tuple[int, int], Sighting], ...]  #: camera and body id -> its last sighting, while relevant
    vacant_ns: tuple[int, int]  #: when the area was last empty, and last without other people; -1 before the first time
    people_ns: tuple[tuple[int, int], ...] = ()  #: person -> when it was last without this person and without others


def start(cameras: int) -> VacancyState:
    """Makes the state before the first frame of ``cameras`` cameras."""
    return VacancyState((-1,) * cameras, (-1,) * cameras, (), (-1, -1))


def watch(
    state: VacancyState, states: HumanStates, frames: CameraFrames, person: Ints, area: WatchedArea
) -> tuple[VacancyState, HumanStates, Counter[str]]:
    """Adds to each row the time since the area was certainly without its person, and since it was so but for people.

    Args:
        state: From the previous table; ``start`` at the beginning.
        states: The fused people at the ticks, increasing.
        frames: All bodies that arrived after the tick before the first and up to the last, in order of arrival, and the
            frames without a body; points in the world [m].
        person: (n,) number of each body's person; 0: another body; negative: the person shown twice.
        area: The watched area.

    Returns:
        The new state; ``states`` with ``nobody_s`` and ``nobody_else_s``; and the count ``watched_frames_refuting``,
        of frames that show a person deeper inside than people can walk since the area was vacant.
    """
    depth_m, numbers = _depths(frames, area), np.abs(person).astype(np.int64).tolist()
    counts: Counter[str] = Counter()
    ages = np.empty((len(states), 2))
    ticks_ns, first = states.ticks()
    there = states.numbers.tolist()
    last = np.searchsorted(frames.arrival_ns, ticks_ns, side="right").tolist()
    row = 0
    for tick, t_ns in enumerate(ticks_ns.tolist()):
        rows = slice(int(first[tick]), int(first[tick + 1]))
        state = _know(state, there[rows])
        for k in range(row, last[tick]):
            who = int(frames.camera[k]), int(frames.body[k])
            followed = numbers[k] if numbers[k] in there[rows] else 0
            seen = Sighting(int(frames.capture_ns[k]), bool(depth_m[k] > 0.0), followed)
            if seen.inside and _refutes(state.vacant_ns[0], seen.capture_ns, float(depth_m[k]), area):
                counts["watched_frames_refuting"] += 1
            state = _met(state, who, seen, round(area.gap_s * 1e9))
        row = last[tick]
        state = _decide_vacancy(state, round(area.clear_s * 1e9))
        known_ns = dict(state.people_ns)
        for k in range(rows.start, rows.stop):
            instants = known_ns[there[k]], state.vacant_ns[1]
            ages[k] = [np.inf if at < 0 else (t_ns - at) / 1e9 for at in instants]
    return state, replace(states, nobody_s=ages[:, 0], nobody_else_s=ages[:, 1]), counts


def _know(state: VacancyState, people: list[int]) -> VacancyState:
    """Returns the state with these people: one that is no more counts among the others, one that is new came later."""
    known, others = dict(state.people_ns), state.vacant_ns[1]
    if list(known) == people:
        return state
    gone = set(known) - set(people)
    bodies = tuple((who, seen._replace(person=0) if seen.person in gone else seen) for who, seen in state.bodies)
    others = min([others, *(known[number] for number in gone)])
    people_ns = tuple((number, min(known.get(number, others), others)) for number in people)
    return state._replace(bodies=bodies, vacant_ns=(state.vacant_ns[0], others), people_ns=people_ns)


def _depths(frames: CameraFrames, area: WatchedArea) -> Floats:
    """(n,) depth of each body's deepest point [m]; -inf for a frame without a body, inf for a body without a point."""
    shown = np.isfinite(frames.points_m).all(axis=2) & (frames.confidence > 0.0)
    depth_m = np.where(shown, area.polygon.depth_m(frames.points_m), -np.inf).max(axis=1, initial=-np.inf)
    depth_m = np.where(shown.any(axis=1), depth_m, np.inf)
    return np.asarray(np.where(frames.body == NOBODY, -np.inf, depth_m))


def _refutes(vacant_ns: int, capture_ns: int, depth_m: float, area: WatchedArea) -> bool:
    """Returns True if a body is deeper inside than people can walk since the area was vacant."""
    since_s = (capture_ns - vacant_ns) / 1e9
    return vacant_ns >= 0 and since_s >= 0.0 and np.isfinite(depth_m) and bool(depth_m > area.reached_m(since_s))


def _met(state: VacancyState, who: tuple[int, int], seen: Sighting, gap_ns: int) -> VacancyState:
    """Returns the state after a body, or after a frame without one."""
    newest, begin, bodies = list(state.newest_ns), list(state.begin_ns), dict(state.bodies)
    camera, body = who
    if newest[camera] < 0 or seen.capture_ns - newest[camera] > gap_ns:
        begin[camera] = seen.capture_ns
    newest[camera] = max(newest[camera], seen.capture_ns)
    if body != NOBODY and (who not in bodies or bodies[who].capture_ns <= seen.capture_ns):
        bodies[who] = seen
    return state._replace(newest_ns=tuple(newest), begin_ns=tuple(begin), bodies=tuple(bodies.items()))


def _decide_vacancy(state: VacancyState, clear_ns: int) -> VacancyState:
    """Updates the state after all frames of a tick: vacancy at the newest capture that all cameras have reached."""
    watched_ns = min(state.newest_ns)
    if watched_ns < 0:
        return state
    bodies = tuple((who, seen) for who, seen in state.bodies if seen.capture_ns >= watched_ns - clear_ns)
    inside = {seen.person for _, seen in bodies if seen.inside}
    anybody, others = state.vacant_ns
    people = dict(state.people_ns)
    if watched_ns - max(state.begin_ns) >= clear_ns:
        anybody = anybody if inside else max(anybody, watched_ns)
        others = others if 0 in inside else max(others, watched_ns)
        people = {number: at if inside & {0, number} else max(at, watched_ns) for number, at in state.people_ns}
    return state._replace(bodies=bodies, vacant_ns=(anybody, others), people_ns=tuple(people.items()))
