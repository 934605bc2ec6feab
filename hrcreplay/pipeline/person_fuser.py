"""Incremental stage 1: frames to the fused people, for replay, live, audit and the library."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hrcreplay.human.fusion import fuse, inverse_kinematics, people, vacancy
from hrcreplay.human.fusion.fuse import Trace
from hrcreplay.human.fusion.people import PeopleRules
from hrcreplay.logs.cleaning import PersonMemory
from hrcreplay.pipeline.fusion_stage import FusionStage, Sightings
from hrcreplay.records import NOBODY, CameraFrames, HumanStates, Ints, Measurements


class FusedTicks(NamedTuple):
    """Result of stage 1 for some ticks."""

    states: HumanStates
    counts: Counter[str]  #: states from ``fuse``, ``follow`` and ``watch``
    trace: Trace  #: input of ``smooth``; without rows unless traced


@dataclass
class PersonFuser:
    """Finds the people, runs their filters and tracks the vacancy of a watched area, update by update.

    The result does not depend on the division of ticks and frames into updates, bit for bit.
    """

    stage: FusionStage
    cameras: tuple[str, ...]
    traced: bool = False  #: True: keep the input of ``smooth``, 1.5 kB per tick and person

    def __post_init__(self) -> None:
        self._memory = PersonMemory()
        self._filter = fuse.start(self.cameras)
        self._people = people.start(self.cameras)
        self.area = vacancy.start(len(self.cameras))
        self.nothing = no_sightings(self.cameras)

    @property
    def _all(self) -> bool:
        return self.stage.people == "all"

    def measure(self, frames: CameraFrames | None) -> Sightings:
        """Computes joint angles in the frames that arrived since the last call, in order of arrival.

        They are those of the nearest person, or of all bodies, which are not assigned to people yet.
        """
        if frames is None:
            return self.nothing
        if self._all:
            return self.stage.measure_all(frames)
        self._memory, seen = self.stage.measure(frames, self._memory)
        return seen

    def advance(self, ticks_ns: Ints, seen: Sightings) -> tuple[FusedTicks, Sightings]:
        """Computes the fused people at ticks (n,), increasing and after those of the last call [ns].

        Args:
            ticks_ns: The ticks.
            seen: From ``measure``, for all frames that arrived after the last tick of the last call and up to the last
                of these ticks.

        Returns:
            The fused people, and the sightings with each body assigned to a person.
        """
        if self._all:
            seen, (states, counts, trace) = self._follow(ticks_ns, seen)
        else:
            self._filter, states, counts, trace = fuse.fuse(
                self._filter, ticks_ns, seen.measured, self.stage.filter, self.stage.limits, traced=self.traced
            )
        if self.stage.watched is not None:
            self.area, states, refuted = vacancy.watch(
                self.area, states, seen.everybody, seen.person, self.stage.watched
            )
            counts = counts + refuted
        return FusedTicks(states, counts, trace), seen

    def _follow(self, ticks_ns: Ints, seen: Sightings) -> tuple[Sightings, FusedTicks]:
        stage, bodies = self.stage, seen.everybody.body != NOBODY
        rules = PeopleRules(stage.person_jump_m, stage.person_memory_s, stage.T_world_camera[:, :3, 3])
        self._people, numbers, states, counts, trace = people.follow(
            self._people,
            ticks_ns,
            seen.measured,
            seen.everybody.body[bodies],
            rules,
            stage.filter,
            stage.limits,
            traced=self.traced,
        )
        person = np.zeros(len(bodies), np.int64)
        person[bodies] = numbers
        measured = seen.measured if (numbers > 0).all() else seen.measured.rows(numbers > 0)
        if (numbers > 1).any():
            measured = replace(measured, person=numbers[numbers > 0])
        return seen._replace(measured=measured, person=person), FusedTicks(states, counts, trace)

    def update(self, ticks_ns: Ints, frames: CameraFrames | None) -> tuple[FusedTicks, Sightings]:
        """Calls ``measure`` and ``advance``."""
        return self.advance(ticks_ns, self.measure(frames))


def no_sightings(cameras: tuple[str, ...]) -> Sightings:
    """Returns the sightings of zero frames."""
    none, points, confidence = np.zeros(0, np.int64), np.zeros((0, 20, 3)), np.zeros((0, 20))
    rows = np.zeros((0, inverse_kinematics.ROWS))
    measured = Measurements(none, none, none, rows, rows, points, confidence, cameras)
    everybody = CameraFrames(none, none, none, none, points, confidence, cameras)
    return Sightings(measured, everybody, none, Counter())
