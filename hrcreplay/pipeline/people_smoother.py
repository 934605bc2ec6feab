"""The smoothed people of a run, person by person and stretch by stretch, so that a long run needs little memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hrcreplay.human.fusion import fuse, smoother
from hrcreplay.records import Growing, HumanStates
from hrcreplay.settings.sections import Fusion


class PeopleSmoother:
    """Smooths each person of a run; rows of one person are in order of time.

    No person who is forgotten comes back under the same number, so the memory is that of the people who are there.
    """

    def __init__(self, settings: Fusion) -> None:
        self._settings = settings
        self._each: dict[int, StretchSmoother] = {}

    def add(self, states: HumanStates, trace: fuse.Trace) -> list[HumanStates]:
        """Adds the next ticks; returns the stretches that they complete, smoothed, and people who are gone."""
        found = []
        for number in sorted(set(states.numbers.tolist())):
            mine = np.flatnonzero(states.numbers == number)
            one = self._each.setdefault(number, StretchSmoother(self._settings))
            found += _numbered(one.add(states.of_person(number), trace.rows(mine)), number)
        if len(states):  # else nobody was seen yet
            there = states.numbers[states.t_ns == states.t_ns[-1]]
            for number in sorted(self._each.keys() - set(there.tolist())):
                found += _numbered(self._each.pop(number).finish(), number)
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
        self._states = Growing[HumanStates]()
        self._trace = Growing[fuse.Trace]()

    def add(self, states: HumanStates, trace: fuse.Trace) -> list[HumanStates]:
        """Adds the next ticks; returns the stretches that they complete, smoothed."""
        self._states.add(states)
        self._trace.add(trace)
        found = []
        while len(self._states) >= self.TICKS + self.LATER:
            found.append(self._smooth(self.TICKS))
        return found

    def finish(self) -> list[HumanStates]:
        """Returns the remaining ticks, smoothed."""
        found = []
        while len(self._states):
            found.append(self._smooth(min(len(self._states), self.TICKS)))
        return found

    def _smooth(self, count: int) -> HumanStates:
        """Smooths the next ``count`` ticks and removes them from memory."""
        states, trace = self._states.take(), self._trace.take()
        assert states is not None and trace is not None  # noqa: PT018, S101 - for the type checker
        known, rest = slice(0, count + self.LATER), slice(count, len(states))
        self._states.add(states.rows(rest))
        self._trace.add(trace.rows(rest))
        return smoother.smooth(states.rows(known), trace.rows(known), self._settings).rows(slice(0, count))
