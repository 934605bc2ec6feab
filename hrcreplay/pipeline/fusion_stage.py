"""Stage 1 with its settings: which bodies of the cameras' frames are people, and their measurements."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hrcreplay.human.fusion import inverse_kinematics
from hrcreplay.human.fusion.vacancy import WatchedArea
from hrcreplay.human.model import LimitSet
from hrcreplay.logs.cleaning import PersonMemory, select_person
from hrcreplay.records import NOBODY, Bools, CameraFrames, Floats, Ints, Measurements
from hrcreplay.settings.sections import Fusion


class Sightings(NamedTuple):
    """Content of some frames."""

    measured: Measurements  #: measurements of the people; of all bodies until they are assigned to people
    everybody: CameraFrames  #: all bodies, and frames without a body; points in the world [m]
    person: Ints  #: (n,) number of each body's person; 0: nobody, or not assigned yet; negative: shown twice
    counts: Counter[str]  #: counts of ``select_person``, and ``frames_late_<camera>``

    @property
    def mine(self) -> Bools:
        """Rows of ``everybody`` that show a person."""
        return np.asarray(self.person > 0)

    @property
    def others(self) -> CameraFrames:
        """Bodies that are none of the people."""
        return self.everybody.rows((self.person == 0) & (self.everybody.body != NOBODY))


def as_frames(measured: Measurements) -> CameraFrames:
    """Measurements as frames, their points in the world, with the number of the person as body id."""
    return CameraFrames(
        capture_ns=measured.capture_ns,
        arrival_ns=measured.arrival_ns,
        camera=measured.camera,
        body=measured.numbers,
        points_m=measured.points_m,
        confidence=measured.confidence,
        cameras=measured.cameras,
    )


@dataclass(frozen=True)
class FusionStage:
    """Stage 1: camera poses and clocks, point noise, and the settings of filter and person selection."""

    T_world_camera: Floats  #: (c, 4, 4)
    clock_offset_ns: Ints  #: (c,) camera's clock minus the reference camera's
    filter: Fusion
    limits: LimitSet
    person_jump_m: float
    person_memory_s: float
    people: str  #: of ``logs.people``
    watched: WatchedArea | None = None  #: area in which every person is seen by a camera

    def measure_all(self, frames: CameraFrames) -> Sightings:
        """Measures all bodies of frames, on the clock of the reference camera; they are not assigned to people yet."""
        frames, counts = self._current(frames)
        nobody = np.zeros(len(frames), np.int64)
        measured = inverse_kinematics.measure(frames.rows(frames.body != NOBODY), self.T_world_camera, self.filter)
        return Sightings(measured, self._in_world(frames), nobody, counts)

    def measure(self, frames: CameraFrames, memory: PersonMemory) -> tuple[PersonMemory, Sightings]:
        """Measures frames on the clock of the reference camera; see ``clean.select_person``.

        A frame that was captured more than ``fresh_s`` before its arrival is outdated: it is dropped and counted as
        ``frames_late_<camera>``.
        """
        frames, counts = self._current(frames)
        bodies = frames.body != NOBODY
        mine = np.zeros(len(frames), dtype=np.bool_)
        memory, mine[bodies], found = select_person(
            frames.rows(bodies), memory, self.T_world_camera, self.person_jump_m, self.person_memory_s
        )
        measured = inverse_kinematics.measure(frames.rows(mine), self.T_world_camera, self.filter)
        return memory, Sightings(measured, self._in_world(frames), mine.astype(np.int64), found + counts)

    def _current(self, frames: CameraFrames) -> tuple[CameraFrames, Counter[str]]:
        """The frames on the clock of the reference camera, without the outdated ones, and the counts of those."""
        frames = self.on_one_clock(frames)
        late = np.asarray(frames.arrival_ns - frames.capture_ns > self.filter.fresh_s * 1e9)
        bodies = frames.body != NOBODY
        counts = Counter(f"frames_late_{frames.cameras[camera]}" for camera in frames.camera[late & bodies])
        return frames.rows(~late), counts

    def _in_world(self, frames: CameraFrames) -> CameraFrames:
        """The frames with their points in the world."""
        T = self.T_world_camera[frames.camera]
        points_m = np.einsum("nij,npj->npi", T[:, :3, :3], frames.points_m) + T[:, None, :3, 3]
        return replace(frames, points_m=points_m)

    def on_one_clock(self, frames: CameraFrames) -> CameraFrames:
        """Converts the capture times to the clock of the reference camera, none later than its arrival."""
        capture_ns = frames.capture_ns - self.clock_offset_ns[frames.camera]
        return replace(frames, capture_ns=np.minimum(capture_ns, frames.arrival_ns))
