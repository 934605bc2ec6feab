"""Comparison of the cameras' clocks by what the cameras see of one person, while a log is read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hrcreplay.calibration.calibrate import in_window
from hrcreplay.calibration.registration import ClockOffset, SkeletonTrack, find_clock_offset, transform
from hrcreplay.records import CameraFrames, Floats

#: Clocks that differ by more frames of the slower camera, and by more than this, are told [frames], [s].
_FRAMES, _LEAST_S = 3.0, 0.1
#: With the offset the movements must be nearer to one another by this share, and by this.
_NEARER, _NEARER_M = 0.7, 0.01
#: Offsets are searched so far beyond those of the stamps from their arrivals [s].
_SEARCH_S = 1.0


@dataclass(frozen=True)
class CameraDelay:
    """What one camera delivered, alone in its frames."""

    name: str
    track: SkeletonTrack
    delay_s: float  #: median from capture to arrival [s]


class ClockCheck:
    """The frames of each camera with one body in them; of a long log, in evenly spaced windows.

    Frames with several bodies are left out: which of them two cameras have in common is not known yet.
    """

    def __init__(self, cameras: tuple[str, ...], T_world_camera: Floats, start_ns: int, end_ns: int) -> None:
        self._cameras = cameras
        self._poses = T_world_camera
        self._span_ns = start_ns, end_ns
        self._kept: list[CameraFrames] = []

    def add(self, frames: CameraFrames) -> None:
        """Takes frames in order of arrival, with all bodies of a frame in one table."""
        rows = frames.rows(in_window(frames, *self._span_ns))
        key = np.stack([rows.camera, rows.capture_ns], axis=1)
        _, index, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        alone = rows.rows(np.asarray(count[index.reshape(-1)] == 1))
        if len(self._cameras) > 1 and len(alone):
            self._kept.append(alone)

    def remarks(self) -> Iterator[str]:
        """Notes on cameras whose clocks differ from that of the camera with the least delay."""
        found = sorted(self._delays(), key=lambda camera: abs(camera.delay_s))
        for other in found[1:]:
            search_s = abs(other.delay_s - found[0].delay_s) + _SEARCH_S
            offset = find_clock_offset(found[0].track, other.track, search_s=search_s)
            if offset is not None and _disagrees(offset):
                yield _remark(found[0], other, offset)

    def _delays(self) -> Iterator[CameraDelay]:
        table = CameraFrames.join(self._kept) if self._kept else None
        for i, name in enumerate(self._cameras):
            mine = table.rows(table.camera == i) if table is not None else None
            if mine is None or not len(mine):
                continue
            _, first = np.unique(mine.capture_ns, return_index=True)  # in order of capture
            mine = mine.rows(first.astype(np.int64))
            delay_s = float(np.median(mine.arrival_ns - mine.capture_ns)) / 1e9
            yield CameraDelay(
                name, SkeletonTrack(mine.capture_ns, transform(self._poses[i], mine.points_m), mine.confidence), delay_s
            )


def _disagrees(offset: ClockOffset) -> bool:
    far = abs(offset.offset_s) > max(_LEAST_S, _FRAMES * offset.frame_s)
    nearer = offset.apart_m < min(_NEARER * offset.without_m, offset.without_m - _NEARER_M)
    return far and (nearer or np.isnan(offset.without_m))


def _remark(reference: CameraDelay, other: CameraDelay, offset: ClockOffset) -> str:
    without = "" if np.isnan(offset.without_m) else f", {100 * offset.without_m:.1f} cm without"
    behind = "behind" if offset.offset_s < 0.0 else "ahead of"
    return (
        f"camera {other.name}: by what both see, its clock is {abs(offset.offset_s):.2f} s {behind} that of "
        f"{reference.name} (frames arrive {other.delay_s:.2f} and {reference.delay_s:.2f} s after their stamps; the "
        f"movements are {100 * offset.apart_m:.1f} cm apart with this offset{without}); would be right: "
        f"clock_offset_s = {offset.offset_s:.2f} for {other.name} in the cell file; hrcreplay calibrate finds it to a "
        "few milliseconds"
    )
