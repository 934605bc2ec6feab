"""Dirt of real logs: each kind is handled here and counted under the name that DEFECTS gives it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from hrcreplay.logs.skeletons import Row
from hrcreplay.records import Bools, CameraFrames

#: Every name in ``Log.defects``, with what was done about it. <camera> stands for a camera's name.
DEFECTS: Mapping[str, str] = {
    "chunks_unreadable": "damaged chunks of an MCAP file; left out",
    "files_empty": "files of 0 bytes in a folder; left out",
    "files_missing": "files that metadata.yaml names and the folder lacks",
    "frames_<camera>": "no defect: rows delivered, one a body a frame",
    "frames_duplicate": "rows of the same camera, body and capture as the one before; dropped",
    "frames_header_stamp_zero": "rows with a capture time of zero; their arrival is used",
    "frames_out_of_order": "rows captured before an earlier delivered one of the same camera and body; dropped",
    "gaps_<camera>": "silences of a camera longer than logs.gap_s",
    "joints_incomplete": "joint states that lack a joint of the first; left out",
    "joints_out_of_order": "joint states not later than the one before; dropped",
    "messages_missing": "messages that metadata.yaml promises and the files do not give",
    "messages_undecodable": "messages that do not follow their type; left out",
    "points_not_finite": "points with a coordinate that is no number; made missing, with confidence 0",
    "truncated_at_ns": "an instant: the last arrival before the file breaks off; what is whole is used",
    "unindexed": "a ROS 1 bag without a usable index; read by going through it",
}

_ALWAYS = ("frames_duplicate", "frames_header_stamp_zero", "frames_out_of_order", "points_not_finite")
_CHUNK_NS = 10**9


class Cleaner:
    """Takes rows in order of arrival, drops and mends them, and hands them out in chunks of at most a second."""

    def __init__(self, cameras: tuple[str, ...], gap_s: float, defects: Counter[str]) -> None:
        self._cameras = cameras
        self._index = {name: i for i, name in enumerate(cameras)}
        self._gap_ns = round(gap_s * 1e9)
        self._defects = defects
        self._newest: dict[tuple[str, int], int] = {}
        self._rows: list[tuple[int, int, Row]] = []
        self.heard: dict[str, tuple[int, int]] = {}  #: camera -> first and last arrival
        for name in (*_ALWAYS, *(f"{kind}_{camera}" for kind in ("frames", "gaps") for camera in cameras)):
            defects[name] += 0

    def hear(self, camera: str, arrival_ns: int) -> None:
        """Notes that a camera is alive."""
        first, last = self.heard.get(camera, (arrival_ns, arrival_ns))
        if arrival_ns - last > self._gap_ns:
            self._defects[f"gaps_{camera}"] += 1
        self.heard[camera] = (first, arrival_ns)

    def add(self, row: Row, arrival_ns: int) -> CameraFrames | None:
        """Takes a row; gives the chunk that ends before it, if one does."""
        self.hear(row.camera, arrival_ns)
        self._defects["frames_header_stamp_zero"] += row.stamp_zero
        capture_ns = arrival_ns if row.capture_ns is None else row.capture_ns
        newest_ns = self._newest.get((row.camera, row.body))
        if newest_ns is not None and capture_ns <= newest_ns:
            self._defects["frames_duplicate" if capture_ns == newest_ns else "frames_out_of_order"] += 1
            return None
        self._newest[(row.camera, row.body)] = capture_ns
        self._defects[f"frames_{row.camera}"] += 1
        chunk = self.rest() if self._rows and arrival_ns - self._rows[0][1] >= _CHUNK_NS else None
        self._rows.append((capture_ns, arrival_ns, self._mended(row)))
        return chunk

    def _mended(self, row: Row) -> Row:
        missing: Bools = ~np.logical_and.reduce(np.isfinite(row.points_m), axis=1)
        infinite: Bools = np.logical_or.reduce(np.isinf(row.points_m), axis=1)
        self._defects["points_not_finite"] += int(np.count_nonzero(infinite | (missing & (row.confidence > 0))))
        confidence = np.where(missing, 0.0, np.fmin(np.fmax(row.confidence, 0.0), 1.0))  # 0 also where it is NaN
        return row._replace(points_m=np.where(missing[:, None], np.nan, row.points_m), confidence=confidence)

    def rest(self) -> CameraFrames | None:
        """What is not handed out yet."""
        rows, self._rows = self._rows, []
        if not rows:
            return None
        return CameraFrames(
            capture_ns=np.array([capture_ns for capture_ns, _, _ in rows], dtype=np.int64),
            arrival_ns=np.array([arrival_ns for _, arrival_ns, _ in rows], dtype=np.int64),
            camera=np.array([self._index[row.camera] for _, _, row in rows], dtype=np.int64),
            body=np.array([row.body for _, _, row in rows], dtype=np.int64),
            points_m=np.array([row.points_m for _, _, row in rows], dtype=np.float64),
            confidence=np.array([row.confidence for _, _, row in rows], dtype=np.float64),
            cameras=self._cameras,
        )
