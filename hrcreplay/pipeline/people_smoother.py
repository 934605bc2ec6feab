"""The smoothed people of a run, person by person and stretch by stretch, so that a long run needs little memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hrcreplay.human.fusion import fuse, smoother
from hrcreplay.records import HumanStates
from hrcreplay.settings.sections import Fusion


class PeopleSmoother:
    """Smooths each person of a run; rows of one person are in order of time."""

    def __init__(self, settings: Fusion) -> None:
        self._settings = settings
        self._each: dict[int, StretchSmoother] = {}

    def add(self, states: HumanStates, trace: fuse.Trace) -> list[HumanStates]:
        """Adds the next ticks; returns the stretches that they complete, smoothed."""
        found = []
        for number in sorted(set(states.numbers.tolist())):
            mine = np.flatnonzero(states.numbers == number)
            one = self._each.setdefault(number, StretchSmoother(self._settings))
            found += _numbered(one.add(states.of_person(number), trace.rows(mine)), number)
        return found

    def finish(self) -> list[HumanStates]:
        """Returns the remaining ticks, smoothed."""
        return [part for number, one in sorted(self._each.items()) for part in _numbered(one.finish(), number)]


def _numbered(parts: list[HumanStates], number: int) -> list[HumanStates]:
    """The states of one person with its number; person 1 needs none."""
    return parts if number == 1 else [replace(part, person=np.full(len(part), number)) for part in parts]


class StretchSmoother:
    """Smooths a run stretch by stretch: each tick uses all measurements of its stretch and some later ones.

    A stretch uses 500 ticks of the next one; later ticks have no effect. The result does not depend on the batches of
    the ticks. A trace takes 1.5 kB per tick, so at most two stretches are kept in memory.
    """

    TICKS, LATER = 15_000, 500

    def __init__(self, settings: Fusion) -> None:
        self._settings = settings
        self._parts: list[tuple[HumanStates, fuse.Trace]] = []
        self._count = 0

    def add(self, states: HumanStates, trace: fuse.Trace) -> list[HumanStates]:
        """Adds the next ticks; returns the stretches that they complete, smoothed."""
        self._parts.append((states, trace))
        self._count += len(states)
        found = []
        while self._count >= self.TICKS + self.LATER:
            found.append(self._smooth(self.TICKS))
        return found

    def finish(self) -> list[HumanStates]:
        """Returns the remaining ticks, smoothed."""
        found = []
        while self._count:
            found.append(self._smooth(min(self._count, self.TICKS)))
        return found

    def _smooth(self, count: int) -> HumanStates:
        """Smooths the next ``count`` ticks and removes them from memory."""
        states = HumanStates.join([part for part, _ in self._parts])
        trace = fuse.Trace.join([part for _, part in self._parts])
        known, rest = slice(0, count + self.LATER), np.arange(count, len(states))
        self._parts = [(states.rows(rest), trace.rows(rest))]  # copies: views would keep the whole stretch in memory
        self._count -= count
        return smoother.smooth(states.rows(known), trace.rows(known), self._settings).rows(slice(0, count))
