"""The people in a recording as tracks of body points, from its ground truth or its cameras: the reference for contact.

The robot plans for every person tracked. All other bodies in a frame also count for contact, although there is no
prediction for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hrcreplay.human.model import part_axes, skeleton
from hrcreplay.records import POINTS, Bools, Floats, HumanStates, Ints, find_neighbours
from hrcreplay.store.stored_array import Rows, SomeRows

TRUTH, CAMERAS, SMOOTHED = "ground truth", "camera points", "smoothed estimate"

#: Recorded points of a limb. The first two, its ends, must have been seen near the end of the horizon, or the limb is
#: not checked.
LIMB_POINTS = {
    "HD": ("neck", "head"),
    "THX": ("pelvis", "shoulder_r", "shoulder_l"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "wrist_r", "hand_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "wrist_l", "hand_l"),
    "LEGS": tuple(f"{part}_{side}" for part in ("hip", "knee", "ankle", "foot") for side in "rl"),
}
#: Maximum time between two samples of a body for interpolation [s].
GAP_S = 0.1
#: Time before and after a frame for which a camera's point counts if no neighbouring frame shows it: half a period of a
#: slow camera [s].
HOLD_S = 0.02


@dataclass(frozen=True)
class SmoothedPeople:
    """Joints and lengths of the smoothed people: what is needed of their states here, an eighth of the memory."""

    t_ns: Ints  #: (n,)
    p: Rows  #: (n, 13) JOINTS [m, m, rad..., m]
    lengths_m: Rows  #: (n, 7) LENGTHS [m]
    used: Bools  #: (n,) whether the update of the tick used a camera
    person: Ints | None = None  #: (n,) number of the person, from 1; None: person 1 in all rows

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def of(cls, states: HumanStates) -> SmoothedPeople:
        """Selects it from smoothed states."""
        return cls(states.t_ns, states.p, states.lengths_m, np.asarray(states.valid.any(axis=1)), states.person)

    def of_person(self, number: int) -> SmoothedPeople:
        """The rows of one person, as if there were no other."""
        if self.person is None:
            return self
        mine = np.flatnonzero(self.person == number)
        return SmoothedPeople(self.t_ns[mine], SomeRows(self.p, mine), SomeRows(self.lengths_m, mine), self.used[mine])


@dataclass(frozen=True)
class ModelPoints:
    """The model's points (n, 20, 3) of a person, computed for the rows that are asked for [m]; NaN where not known."""

    p: Rows  #: (n, 13) JOINTS [m, m, rad..., m]
    lengths_m: Rows  #: (n, 7) LENGTHS [m]
    known: Bools  #: (n,)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of rows, points and coordinates."""
        return len(self.known), len(POINTS), 3

    def __getitem__(self, rows: slice | Ints) -> Floats:
        """The points of some rows."""
        points_m = skeleton(self.p[rows], self.lengths_m[rows])
        points_m[~self.known[rows]] = np.nan
        return points_m


class CameraPoints(SomeRows):
    """The points (n, 20, 3) of a person that one camera shows, among those of all cameras [m]; NaN where not known.

    The neck is the middle of the shoulders, if they are known.
    """

    def __getitem__(self, rows: slice | Ints) -> Floats:
        return with_middle_neck(super().__getitem__(rows))


@dataclass(frozen=True)
class BodyTrack:
    """Points of one body over time, from one source."""

    source: str  #: TRUTH, SMOOTHED, or a camera; for another body, the camera and the tracker's id
    t_ns: Ints  #: (n,) increasing
    points_m: Rows  #: (n, 20, 3) POINTS, world [m]; NaN if unknown
    hold_s: float = 0.0  #: time around a sample for which a point counts if the neighbouring sample lacks it [s]

    @cached_property
    def period_ns(self) -> int:
        """Median time between two samples; 0 for a single one [ns]."""
        return int(np.median(np.diff(self.t_ns))) if len(self.t_ns) > 1 else 0

    def axes_m(self, at_ns: Ints, hand_m: float) -> Floats:
        """(m, 14, 2, 3) axes of the capsules of ``PARTS`` at some instants; with one known end, a ball [m]."""
        axes = part_axes(at_instants(self.t_ns, self.points_m, at_ns, GAP_S, self.hold_s), hand_m)
        known: Bools = np.isfinite(axes)
        known = known[..., 0] & known[..., 1] & known[..., 2]  # sooner than along so short an axis
        return np.where(known[..., None], axes, axes[:, :, ::-1])

    def is_near(self, first_ns: int, last_ns: int) -> bool:
        """Returns True if the track has a sample near enough to a time span to count in it."""
        margin_ns = round(GAP_S * 1e9)
        return bool(len(self.t_ns)) and self.t_ns[0] - margin_ns <= last_ns and first_ns <= self.t_ns[-1] + margin_ns


@dataclass(frozen=True)
class RecordedPerson:
    """One person that the robot plans for, as recorded."""

    number: int  #: from 1
    source: str  #: TRUTH, CAMERAS or SMOOTHED: source of ``points_m``
    t_ns: Ints  #: (m,) instants of the person's recorded points, increasing
    points_m: Rows  #: (m, 20, 3) POINTS of the person, of all cameras in order of time, world [m]; NaN: rejected
    tracks: tuple[BodyTrack, ...]  #: only the truth; else the smoothed person and each camera's points


@dataclass(frozen=True)
class RecordedPeople:
    """All people in a log."""

    people: tuple[RecordedPerson, ...]  #: one or more, in the order of their numbers
    others: tuple[BodyTrack, ...]  #: every other body of every camera

    @property
    def source(self) -> str:
        """Source of the points: TRUTH if that of any person is."""
        sources = [one.source for one in self.people]
        return TRUTH if TRUTH in sources else sources[0]

    @property
    def person(self) -> tuple[BodyTrack, ...]:
        """Tracks of all people that the robot plans for."""
        return tuple(track for one in self.people for track in one.tracks)

    @property
    def tracks(self) -> tuple[BodyTrack, ...]:
        """Tracks of these people, then those of all others."""
        return (*self.person, *self.others)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of the source of each track of ``tracks``, with the person's number where there are several people."""
        if len(self.people) == 1:
            return tuple(track.source for track in self.tracks)
        named = [f"person {one.number}, {track.source}" for one in self.people for track in one.tracks]
        return (*named, *(track.source for track in self.others))

    @property
    def numbers(self) -> Ints:
        """(k,) number of the person of each track of ``person``."""
        return np.array([one.number for one in self.people for _ in one.tracks], dtype=np.int64)


def at_instants(t_ns: Ints, points_m: Rows, at_ns: Ints, gap_s: float, hold_s: float = 0.0) -> Floats:
    """Interpolates body points at some instants: linear between two samples, or constant for a short time.

    Args:
        t_ns: (n,) instants of the samples, increasing [ns].
        points_m: (n, 20, 3) samples, world [m].
        at_ns: (m,) instants asked for [ns].
        gap_s: Maximum time between two samples for interpolation [s].
        hold_s: Time before and after a sample for which its points count without interpolation [s].

    Returns:
        (m, 20, 3); NaN if unknown. An instant equal to that of a sample gets that sample.
    """
    if not len(t_ns):
        return np.full((len(at_ns), *points_m.shape[1:]), np.nan)
    before, after, share, known = find_neighbours(t_ns, at_ns, gap_s)
    found = points_m[before]
    if (share > 0.0).any():
        share = share[:, None, None]
        found = np.where(share > 0.0, (1.0 - share) * found + share * points_m[after], found)
    found[~known] = np.nan
    if hold_s > 0.0:
        for side in (before, after):
            near = np.abs(at_ns - t_ns[side]) * 1e-9 <= hold_s
            found = np.where(np.isnan(found) & near[:, None, None], points_m[side], found)
    return found


def from_states(states: SmoothedPeople, memory_s: float) -> BodyTrack:
    """Returns the smoothed person, without the times at which no camera saw the person.

    Args:
        states: The smoothed person.
        memory_s: Maximum time between two ticks that used a camera; the person is unknown in a longer gap [s].
    """
    points_m = ModelPoints(states.p, states.lengths_m, _find_seen(states, memory_s))
    return BodyTrack(SMOOTHED, states.t_ns, points_m)


def _find_seen(states: SmoothedPeople, memory_s: float) -> Bools:
    """(n,) True for ticks between two ticks with a camera at most ``memory_s`` [s] apart, both included."""
    used = np.flatnonzero(states.used)
    if not len(used):
        return np.zeros(len(states), dtype=np.bool_)
    ticks = np.arange(len(states))
    before = used[np.maximum(np.searchsorted(used, ticks, side="right") - 1, 0)]
    after = used[np.minimum(np.searchsorted(used, ticks, side="left"), len(used) - 1)]
    apart_s = (states.t_ns[after] - states.t_ns[before]) * 1e-9
    return np.asarray((before <= ticks) & (ticks <= after) & (apart_s <= memory_s))


def with_middle_neck(points_m: Floats) -> Floats:
    """Puts the neck of bodies (n, 20, 3) in the middle of the shoulders, if they are known; returns the same array."""
    neck, right, left = (POINTS.index(name) for name in ("neck", "shoulder_r", "shoulder_l"))
    middle = 0.5 * (points_m[:, right] + points_m[:, left])
    points_m[:, neck] = np.where(np.isnan(middle), points_m[:, neck], middle)
    return points_m
