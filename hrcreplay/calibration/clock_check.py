"""Comparison of the cameras' clocks by their views of one person, while a log is read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hrcreplay.calibration.calibrate import in_window, track_of
from hrcreplay.calibration.registration import ClockOffset, find_clock_offset, transform
from hrcreplay.records import CameraFrames, Floats, SkeletonTrack

#: A clock difference above both is reported: in frames of the slower camera [frames], and [s].
_FRAMES, _LEAST_S = 3.0, 0.1
#: The offset must reduce the distance between the movements by this share, and by this distance.
_NEARER, _NEARER_M = 0.85, 0.003
#: Search range of offsets beyond the difference between stamps and arrivals [s].
_SEARCH_S = 1.0


class ClockCheck:
    """Collects the frames of each camera with one body in them; for a long log, in evenly spaced windows.

    Frames with several bodies are left out, as it is not known yet which of them both cameras see.
    """

    def __init__(self, cameras: tuple[str, ...], T_world_camera: Floats, start_ns: int, end_ns: int) -> None:
        self._cameras = cameras
        self._poses = T_world_camera
        self._span_ns = start_ns, end_ns
        self._kept: list[CameraFrames] = []

    def add(self, frames: CameraFrames) -> None:
        """Adds frames in order of arrival, with all bodies of a frame in one table."""
        rows = frames.rows(in_window(frames, *self._span_ns))
        key = np.stack([rows.camera, rows.capture_ns], axis=1)
        _, index, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        alone = rows.rows(np.asarray(count[index.reshape(-1)] == 1))
        if len(self._cameras) > 1 and len(alone):
            self._kept.append(alone)

    def remarks(self) -> Iterator[str]:
        """Returns notes on cameras whose clocks differ from that of the camera with the smallest delay."""
        tracks = self._tracks()
        first, *others = sorted(tracks, key=lambda name: abs(tracks[name].delay_s)) or [""]
        for name in others:
            a, b = tracks[first], tracks[name]
            offset = find_clock_offset(a, b, search_s=abs(b.delay_s - a.delay_s) + _SEARCH_S)
            if offset is not None and _disagrees(offset):
                yield _remark((first, a.delay_s), (name, b.delay_s), offset)

    def _tracks(self) -> dict[str, SkeletonTrack]:
        """Returns the world track of each camera."""
        found = {}
        for i, name in enumerate(self._cameras):
            own = [frames.rows(frames.camera == i) for frames in self._kept]
            if any(map(len, own)):  # one camera after the other, as the tracks of a long log are large
                track = track_of(CameraFrames.join(own), i)
                found[name] = replace(track, points_m=transform(self._poses[i], track.points_m))
        return found


def _disagrees(offset: ClockOffset) -> bool:
    far = abs(offset.offset_s) > max(_LEAST_S, _FRAMES * offset.frame_s)
    nearer = offset.apart_m < min(_NEARER * offset.without_m, offset.without_m - _NEARER_M)
    return far and (nearer or bool(np.isnan(offset.without_m)))


def _remark(reference: tuple[str, float], other: tuple[str, float], offset: ClockOffset) -> str:
    """Returns the note on a camera; both cameras are given by name and delay [s]."""
    behind = "behind" if offset.offset_s < 0.0 else "ahead of"
    without = "" if np.isnan(offset.without_m) else f", {100 * offset.without_m:.1f} cm without"
    return (
        f"camera {other[0]}: by what both see, its clock is {abs(offset.offset_s):.2f} s {behind} that of "
        f"{reference[0]} (frames arrive {other[1]:.2f} and {reference[1]:.2f} s after their stamps; the movements are "
        f"{100 * offset.apart_m:.1f} cm apart with this offset{without}); would be right: clock_offset_s = "
        f"{offset.offset_s:.2f} for {other[0]} in the cell file; hrcreplay calibrate finds it to a few milliseconds"
    )
