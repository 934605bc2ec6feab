"""Incremental stage 1: frames to the fused person, for replay, live, audit and the library."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hrcreplay.human.fusion import fuse, inverse_kinematics, vacancy
from hrcreplay.human.fusion.fuse import Trace
from hrcreplay.logs.cleaning import PersonMemory
from hrcreplay.pipeline.assembly import FusionStage, Sightings
from hrcreplay.records import CameraFrames, HumanStates, Ints, Measurements


class FusedTicks(NamedTuple):
    """Result of stage 1 for some ticks."""

    states: HumanStates
    counts: Counter[str]  #: states from ``fuse`` and ``watch``
    trace: Trace  #: input of ``smooth``; without rows unless traced


@dataclass
class PersonFuser:
    """Selects the person, runs the filter and tracks the vacancy of a watched area, update by update.

    The result does not depend on the division of ticks and frames into updates, bit for bit.
    """

    stage: FusionStage
    cameras: tuple[str, ...]
    traced: bool = False  #: True: keep the input of ``smooth``, 1.5 kB per tick

    def __post_init__(self) -> None:
        self._memory = PersonMemory()
        self._filter = fuse.start(self.cameras)
        self.area = vacancy.start(len(self.cameras))
        self.nothing = no_sightings(self.cameras)

    def measure(self, frames: CameraFrames | None) -> Sightings:
        """Computes joint angles of the person in the frames that arrived since the last call, in order of arrival."""
        if frames is None:
            return self.nothing
        self._memory, seen = self.stage.measure(frames, self._memory)
        return seen

    def advance(self, ticks_ns: Ints, seen: Sightings) -> FusedTicks:
        """Computes the fused person at ticks (n,), increasing and after those of the last call [ns].

        Args:
            ticks_ns: The ticks.
            seen: From ``measure``, for all frames that arrived after the last tick of the last call and up to the last
                of these ticks.
        """
        self._filter, states, counts, trace = fuse.fuse(
            self._filter, ticks_ns, seen.measured, self.stage.filter, self.stage.limits, traced=self.traced
        )
        if self.stage.watched is not None:
            self.area, states, refuted = vacancy.watch(self.area, states, seen.everybody, seen.mine, self.stage.watched)
            counts = counts + refuted
        return FusedTicks(states, counts, trace)

    def update(self, ticks_ns: Ints, frames: CameraFrames | None) -> tuple[FusedTicks, Sightings]:
        """Calls ``measure`` and ``advance``."""
        seen = self.measure(frames)
        return self.advance(ticks_ns, seen), seen


def no_sightings(cameras: tuple[str, ...]) -> Sightings:
    """Returns the sightings of zero frames."""
    none, points, confidence = np.zeros(0, np.int64), np.zeros((0, 20, 3)), np.zeros((0, 20))
    rows = np.zeros((0, inverse_kinematics.ROWS))
    measured = Measurements(none, none, none, rows, rows, points, confidence, cameras)
    everybody = CameraFrames(none, none, none, none, points, confidence, cameras)
    return Sightings(measured, everybody, np.zeros(0, np.bool_), Counter())
