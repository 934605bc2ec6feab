"""The moments of a replay that tell most: the one that a page opens with, and a tour of ten seconds of the worst."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hrcreplay.records import RECORDED, Floats
from hrcreplay.reporting.metrics.contact import StopEvent
from hrcreplay.reporting.replay_scene import MethodTrack, ReplayScene
from hrcreplay.reporting.tables import part_name_text, reason_text

#: Length of the tour [s], its largest number of stops, and the share of a stop before its moment.
TOUR_S, STOPS, _BEFORE = 10.0, 5, 0.6
#: Methods that take no care of people, the nearest to what a reader knows first.
_CARELESS = (RECORDED, "none")


class Moment(NamedTuple):
    """An instant of the replay."""

    row: int  #: index of the instant
    beside: str | None  #: method to show beside the run's own; None: there is no other


@dataclass(frozen=True)
class TourStop:
    """A stretch of the replay around one of its worst moments."""

    from_s: float  #: on the report's clock [s]
    until_s: float
    at_s: float  #: the moment
    beside: str | None  #: method to show beside the run's own
    words: str


def telling_moment(scene: ReplayScene) -> Moment:
    """Finds the instant that tells most, and the method to see it beside.

    It is the deepest contact of the run's own method, else that of a robot without care for people, else the smallest
    known distance of the run's own, else the first instant.
    """
    own, *others = scene.methods
    careless = [name for name in _CARELESS if name in others]
    beside = next((name for name in careless if _touches(scene.methods[name])), next(iter([*careless, *others]), None))
    for name in (own, *careless):
        if _touches(scene.methods[name]):
            return Moment(_lowest(scene.methods[name].body_m), name if name != own else beside)
    track = scene.methods[own]
    for distance_m in (track.body_m, track.distance_m):
        if np.isfinite(distance_m).any():
            return Moment(_lowest(distance_m), beside)
    return Moment(0, beside)


def tour(scene: ReplayScene) -> tuple[TourStop, ...]:
    """Makes a tour of ``TOUR_S``, or of the whole replay if that is shorter, in order of time."""
    own, *others = scene.methods
    beside = telling_moment(scene).beside
    found: dict[int, tuple[str, str | None]] = {}
    for name in (own, *(name for name in (*_CARELESS, *others) if name in others)):
        for row, words in _worst_of(scene, name):
            if len(found) < STOPS and all(abs(row - other) > scene.rate_hz for other in found):
                found[row] = f"{name}: {words}", name if name != own else beside
    rows = sorted(found)
    return tuple(
        TourStop(round(from_s, 3), round(until_s, 3), round(float(scene.seconds[row]), 3), found[row][1], found[row][0])
        for row, (from_s, until_s) in zip(rows, _stretches(scene.seconds, rows), strict=True)
    )


def _stretches(seconds: Floats, rows: Sequence[int]) -> list[tuple[float, float]]:
    """Returns a stretch [s, s] around each of some instants, equally long where their distances permit.

    Each lies between the middles to the instants before and after it; together they last ``TOUR_S`` if there is time.
    """
    if not rows:
        return []
    at_s, (first, last) = seconds[list(rows)], seconds[[0, -1]]
    edges = np.concatenate([[first], 0.5 * (at_s[1:] + at_s[:-1]), [last]])
    room, left_s, length_s = np.diff(edges), min(TOUR_S, float(last - first)), np.zeros(len(rows))
    for count, k in zip(range(len(rows), 0, -1), np.argsort(room).tolist(), strict=True):  # the narrowest first
        length_s[k] = min(room[k], left_s / count)
        left_s -= length_s[k]
    start = np.clip(at_s - _BEFORE * length_s, edges[:-1], edges[1:] - length_s)
    return list(zip(start.tolist(), (start + length_s).tolist(), strict=True))


def _worst_of(scene: ReplayScene, name: str) -> list[tuple[int, str]]:
    """Returns the worst moments of a method, the worst first: contacts, its nearest approach, its longest stop."""
    track = scene.methods[name]
    found = []
    for event in sorted(_touches(track), key=lambda event: event.distance_m):
        start = int(np.searchsorted(scene.seconds, event.at_s))
        rows = slice(start, max(start + 1, int(np.searchsorted(scene.seconds, event.at_s + event.moving_s))))
        row = min(start + _lowest(track.body_m[rows]), len(scene.seconds) - 1)
        found.append((row, f"contact of {event.link.replace('_', ' ') or 'the robot'} and {_part(event.limb)}"))
    if np.isfinite(track.body_m).any():
        row = _lowest(track.body_m)
        if track.body_m[row] > 0.0:
            found.append((row, f"nearest to a person, {track.body_m[row]:.3f} m"))
    stops = [event for event in track.events if event.kind == "stop"]
    if stops:
        longest = max(stops, key=lambda event: event.moving_s + event.rest_s)
        row = min(int(np.searchsorted(scene.seconds, longest.at_s)), len(scene.seconds) - 1)
        why = f": {reason_text(longest.reason)}" if longest.reason else ""
        found.append((row, f"its longest stop, {longest.moving_s + longest.rest_s:.1f} s{why}"))
    return found


def _touches(track: MethodTrack) -> list[StopEvent]:
    return [event for event in track.events if event.kind == "touch"]


def _part(limb: str) -> str:
    return part_name_text(limb) if limb else "a person"


def _lowest(values: Floats) -> int:
    """Returns the index of the smallest known value; 0 without one."""
    return int(np.argmin(np.where(np.isfinite(values), values, np.inf)))
