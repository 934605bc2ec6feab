"""All bodies that cameras show in a run, from which the recorded people are made."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hrcreplay.pipeline.fusion_stage import Sightings, as_frames
from hrcreplay.records import CameraFrames, Growing, Ints
from hrcreplay.store.stored_array import Rows, SomeRows, StoredArray


@dataclass(frozen=True)
class Bodies:
    """Bodies in frames of cameras, in the world; the points of some are read when they are asked for."""

    about: CameraFrames  #: (n,) the frames without points
    points_m: Rows  #: (n, 20, 3) world [m]
    confidence: Rows  #: (n, 20)

    @classmethod
    def of(cls, frames: CameraFrames) -> Bodies:
        """Bodies in memory."""
        return cls(_without_points(frames), frames.points_m, frames.confidence)

    def __len__(self) -> int:
        return len(self.about)

    def rows(self, which: slice | Ints) -> CameraFrames:
        """Some of them, with their points."""
        return replace(self.about.rows(which), points_m=self.points_m[which], confidence=self.confidence[which])

    def some(self, which: Ints) -> Bodies:
        """Some of them, by their places."""
        return Bodies(self.about.rows(which), SomeRows(self.points_m, which), SomeRows(self.confidence, which))


class SeenBodies:
    """Collects all bodies, the people's and all others, while a log is read."""

    def __init__(self, folder: Path | None = None) -> None:
        """Starts without bodies.

        Args:
            folder: Folder for files of their points, until ``close``; None: they stay in memory.
        """
        self._files = None if folder is None else TemporaryDirectory(prefix=".seen_", dir=folder)
        inside = None if self._files is None else Path(self._files.name)
        self._people, self._others = _Collected(inside), _Collected(inside)

    def add(self, sightings: Sightings) -> None:
        """Adds those of some frames; points in the world."""
        self._people.add(as_frames(sightings.measured))  # their number as body id
        self._others.add(sightings.others)

    def take(self) -> tuple[Bodies | None, Bodies | None]:
        """Returns the people and all others, None for no rows; it is empty then."""
        return self._people.take(), self._others.take()

    def close(self) -> None:
        """Removes the files."""
        if self._files is not None:
            self._files.cleanup()


class _Collected:
    """Bodies of which many come; in memory they are in arrays that grow."""

    def __init__(self, folder: Path | None) -> None:
        self._folder, self._frames = folder, Growing[CameraFrames]()
        self._points: StoredArray | None = None
        self._confidence: StoredArray | None = None

    def add(self, frames: CameraFrames) -> None:
        """Adds some."""
        if self._folder is None or not len(frames):
            self._frames.add(frames)
            return
        if self._points is None or self._confidence is None:
            self._points = StoredArray(self._folder, frames.points_m.shape[1:])
            self._confidence = StoredArray(self._folder, frames.confidence.shape[1:])
        self._points.append(frames.points_m)
        self._confidence.append(frames.confidence)
        self._frames.add(_without_points(frames))

    def take(self) -> Bodies | None:
        """Returns them all, None without any."""
        frames, points, confidence = self._frames.take(), self._points, self._confidence
        self._points, self._confidence = None, None
        if frames is None:
            return None
        if points is None or confidence is None:
            return Bodies.of(frames)
        return Bodies(frames, points, confidence)


def _without_points(frames: CameraFrames) -> CameraFrames:
    return replace(frames, points_m=np.empty((len(frames), 0, 3)), confidence=np.empty((len(frames), 0)))
