"""Kinect v2 CSV: no header, 100-ns ticks, metres, a tracking state for each of 25 joints, one file a camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.logs.rows import Row, import_cameras, instant, lines, numbers, row

#: Confidence of the tracking states 'not tracked', 'inferred' and 'tracked'.
CONFIDENCE = np.array([0.0, 0.5, 1.0])

#: Body point -> joint of the Kinect v2. Its SpineShoulder is the middle of the shoulder line, its Neck lies higher.
JOINTS = {
    "pelvis": 0,
    "chest": 1,
    "neck": 20,
    "head": 3,
    **{
        f"{point}_{side}": first + step
        for side, arm, leg in (("l", 4, 12), ("r", 8, 16))
        for first, points in ((arm, ("shoulder", "elbow", "wrist", "hand")), (leg, ("hip", "knee", "ankle", "foot")))
        for step, point in enumerate(points)
    },
}

_COUNT = 25


def import_kinect2(paths: Mapping[str, Path], out: Path) -> list[str]:
    """Makes our log from Kinect v2 CSV files (.csv or .csv.gz): ``import_cameras``, with its remarks and errors.

    Points stay in each camera's own frame (x to the sensor's left, y up, z forward) [m]. Tracking states 0, 1, 2
    become confidence 0, 0.5, 1. The sensor's time is the capture time.
    """
    return import_cameras(paths, out, _rows)


def _rows(path: Path) -> Iterator[Row]:
    before_ns = 0
    for where, text in lines(path):
        fields = text.removesuffix(",").split(",")
        values = numbers(where, fields, 1 + 4 * _COUNT)
        before_ns = instant(where, fields[0], 100, before_ns)
        table = values[1:].reshape(_COUNT, 4)
        state = table[:, 3]
        wrong = ~np.isin(state, (0, 1, 2))
        if wrong.any():
            raise LogError(f"{where}: tracking state: found {state[wrong][0]:g}; would be right: 0, 1 or 2")
        yield row(before_ns, 0, JOINTS, table[:, :3].copy(), CONFIDENCE[state.astype(int)])
