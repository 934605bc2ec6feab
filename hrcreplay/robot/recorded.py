"""The robot as recorded: its joints at any instant, where they are known, and the standstills that were its own.

Between two rows of the track that are not separated by a gap, a position is interpolated linearly; at the instant of a
row it is that row. Inside a gap, before the first row and after the last, nothing is known: no position is made up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hrcreplay.records import Bools, Floats, Ints, Table, find_neighbours

#: A robot stands if no axis moves further than this [rad] within this time around an instant [s].
REST_RAD, REST_S = 1e-3, 0.1
#: Time over which a velocity is computed from positions, where the record has none [s].
SLOPE_S = 0.05
#: Reasons for which the robot is not known at an instant; the first one is for known instants.
UNKNOWN = ("", "before the first robot state", "gap in the robot states", "after the last robot state")
_KNOWN, _BEFORE, _GAP, _AFTER = range(4)

#: Time before and after a standstill over which the directions of motion are compared [s], the smallest way there
#: [rad], and the smallest cosine of the angle between both directions of a robot that goes on as it came.
_ACROSS_S, _LEAST_RAD, _SAME_COSINE = 0.3, 5e-3, 0.9
#: Grid on which standstills are searched [s].
_GRID_S = 0.02
_NS = 1_000_000_000


class JointSample(NamedTuple):
    """Joints at some instants."""

    q: Floats  #: (m, nv) NaN where not known [rad]
    dq: Floats  #: (m, nv) 0 while the robot stands, NaN where not known [rad/s]
    reason: Ints  #: (m,) index into ``UNKNOWN``


@dataclass(frozen=True)
class RecordedJoints(Table):
    """A joint track, and the times at which it is not known."""

    t_ns: Ints  #: (n,) increasing
    q: Floats  #: (n, nv); endless axes without jumps by full turns [rad]
    dq: Floats  #: (n, nv) as recorded; NaN where the log gives none [rad/s]
    gaps_ns: tuple[tuple[int, int], ...]  #: begin and end of each silence of an axis, in order of their begins

    def sample(self, at_ns: Ints) -> JointSample:
        """Joints at some instants.

        The velocity is the recorded one, interpolated linearly; where the record has none, it is the mean over
        ``SLOPE_S`` around the instant. It is 0 while the robot stands.

        Args:
            at_ns: (m,) [ns].
        """
        begins_ns, ends_ns = self._stretches()
        stretch = np.maximum(np.searchsorted(begins_ns, at_ns, side="right") - 1, 0)
        first, last = begins_ns[stretch], ends_ns[stretch]
        reason = np.where(at_ns > last, np.where(at_ns > self.t_ns[-1], _AFTER, _GAP), _KNOWN)
        reason = np.where(at_ns < begins_ns[0], _BEFORE, reason)
        known = (reason == _KNOWN)[:, None]
        q = np.where(known, self._linear(self.q, at_ns), np.nan)
        dq = self._linear(self.dq, at_ns)
        dq = np.where(np.isfinite(dq), dq, self._slope(at_ns, first, last))
        dq[self._stands(at_ns, first, last)] = 0.0
        return JointSample(q, np.where(known, dq, np.nan), reason)

    def _stretches(self) -> tuple[Ints, Ints]:
        """First and last instants of the stretches between gaps, in order; overlapping gaps are one."""
        begins, ends = [int(self.t_ns[0])], []
        for begin, end in self.gaps_ns:
            if begin < begins[-1]:
                begins[-1] = max(begins[-1], end)
            else:
                ends.append(begin)
                begins.append(end)
        return np.array(begins, dtype=np.int64), np.array([*ends, int(self.t_ns[-1])], dtype=np.int64)

    def _linear(self, values: Floats, at_ns: Ints) -> Floats:
        """(m, nv) between the two rows around each instant; at the instant of a row, that row."""
        row, after, share, _ = find_neighbours(self.t_ns, at_ns)
        return np.where(
            row[:, None] == after[:, None], values[row], values[row] + share[:, None] * (values[after] - values[row])
        )

    def _slope(self, at_ns: Ints, first: Ints, last: Ints) -> Floats:
        """(m, nv) mean velocity around each instant, within its stretch [rad/s]."""
        half = round(SLOPE_S * _NS / 2)
        early, late = np.maximum(at_ns - half, first), np.minimum(at_ns + half, last)
        way = self._linear(self.q, late) - self._linear(self.q, early)
        return np.asarray(way / (np.maximum(late - early, 1) * 1e-9)[:, None])

    def _stands(self, at_ns: Ints, first: Ints, last: Ints) -> Bools:
        """(m,) True where no axis moves further than ``REST_RAD`` within ``REST_S`` around the instant."""
        half = round(REST_S * _NS / 2)
        around = (np.maximum(at_ns - half, first), at_ns, np.minimum(at_ns + half, last))
        q = np.stack([self._linear(self.q, instants) for instants in around])
        return np.asarray((np.ptp(q, axis=0) <= REST_RAD).all(axis=1))

    def waits(self, least_s: float) -> tuple[tuple[int, int], ...]:
        """Begins and ends of the standstills in the middle of a move [ns]: the robot goes on in the way it came.

        A programme stands where its motion ends; a stop of the robot's own safety function interrupts a motion. A
        standstill next to a gap, or at an end of the track, is not counted.

        Args:
            least_s: Shortest standstill that counts [s].
        """
        grid_ns = np.arange(self.t_ns[0], self.t_ns[-1] + 1, round(_GRID_S * _NS))
        sample = self.sample(grid_ns)
        stands = (sample.reason == _KNOWN) & ~sample.dq.any(axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], stands.astype(np.int8), [0]])))
        found = []
        for begin, end in zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True):
            if (grid_ns[end] - grid_ns[begin]) * 1e-9 < least_s:
                continue
            if self._goes_on(int(grid_ns[begin]), int(grid_ns[end])):
                found.append((int(grid_ns[begin]), int(grid_ns[end])))
        return tuple(found)

    def _goes_on(self, begin_ns: int, end_ns: int) -> bool:
        """Returns True if the robot leaves a standstill in the direction in which it came."""
        across = round(_ACROSS_S * _NS)
        q = self.sample(np.array([begin_ns - across, begin_ns, end_ns, end_ns + across])).q
        came, goes = q[1] - q[0], q[3] - q[2]
        lengths = np.linalg.norm(came), np.linalg.norm(goes)
        if not min(lengths) >= _LEAST_RAD:  # NaN: not known there
            return False
        return bool(came @ goes >= _SAME_COSINE * lengths[0] * lengths[1])

    def without(self, cuts_ns: Sequence[tuple[int, int]]) -> tuple[Ints, Floats]:
        """Instants (m,) [ns] and positions (m, nv) [rad] of the track without some spans of time.

        Args:
            cuts_ns: Begins and ends of the spans, in order; later rows move to the begin [ns].
        """
        kept = np.ones(len(self.t_ns), dtype=np.bool_)
        for begin, end in cuts_ns:
            kept &= (self.t_ns <= begin) | (self.t_ns >= end)
        return np.array([t - time_cut_ns(cuts_ns, t) for t in self.t_ns[kept].tolist()], dtype=np.int64), self.q[kept]


class CapsuleSample(NamedTuple):
    """Capsules of the robot's links at some instants, in the world."""

    ends_m: Floats  #: (m, s, 2, 3) NaN where not known
    velocity: Floats  #: (m, s, 2, 3) of the ends; 0 while the robot stands [m/s]
    radius_m: Floats  #: (m, s)
    reason: Ints  #: (m,) index into ``UNKNOWN``


@dataclass(frozen=True)
class RecordedCapsules:
    """The robot as recorded by the capsules of its links: no joints, so neither limits nor stops."""

    numbers: RecordedJoints  #: ``q`` (n, 7 s): for each capsule both ends in the frame of the base, and the radius [m]
    names: tuple[str, ...]  #: (s,)
    T_world_base: Floats  #: (4, 4)

    def sample(self, at_ns: Ints) -> CapsuleSample:
        """Capsules at some instants; between two rows the ends move on straight lines.

        Args:
            at_ns: (m,) [ns].
        """
        found = self.numbers.sample(at_ns)
        q, dq = (values.reshape(len(at_ns), len(self.names), 7) for values in (found.q, found.dq))
        R, at_m = self.T_world_base[:3, :3], self.T_world_base[:3, 3]
        ends, velocity = (values[:, :, :6].reshape(len(at_ns), -1, 2, 3) @ R.T for values in (q, dq))
        return CapsuleSample(ends + at_m, velocity, q[:, :, 6], found.reason)


def time_cut_ns(cuts_ns: Sequence[tuple[int, int]], until_ns: int) -> int:
    """Total time of the cuts before an instant [ns]."""
    return sum(max(0, min(end, until_ns) - begin) for begin, end in cuts_ns)


def waiting_remarks(cuts_ns: Sequence[tuple[int, int]], start_ns: int, least_s: float) -> list[str]:
    """Remark on the standstills that were cut from a recorded programme.

    Args:
        cuts_ns: Begins and ends of the standstills [ns].
        start_ns: Begin of the track [ns].
        least_s: Shortest standstill that counts [s].
    """
    if not cuts_ns:
        return []
    begin, end = max(cuts_ns, key=lambda cut: cut[1] - cut[0])
    count = f"{len(cuts_ns)} standstill{'' if len(cuts_ns) == 1 else 's'}"
    words = (
        f"robot joints: {count} in the middle of a move, {time_cut_ns(cuts_ns, cuts_ns[-1][1]) / _NS:.2f} s in all, "
        f"the longest of {(end - begin) / _NS:.2f} s from {(begin - start_ns) / _NS:.2f} s after their begin on, count "
        "as waiting of the robot's own safety function and are cut from the programme (plan.waiting_s = "
        f"{least_s:g}; keep: none). Standstills at which the direction of motion changes are kept, and so is every "
        "slower stretch"
    )
    return [words]
