"""Skeletons as a DataFrame: one row per body and frame, three columns per body point."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from hrcreplay.errors import SettingsError
from hrcreplay.records import POINTS, CameraFrames

#: Required columns of a table, in addition to at least one body point.
_COLUMNS = ("arrival_ns", "camera", "pelvis_x", "pelvis_y", "pelvis_z")


def frames_of_table(table: pd.DataFrame, cameras: tuple[str, ...]) -> CameraFrames:
    """Reads the rows of a DataFrame in the form of ``api.frames``, in order of arrival.

    Args:
        table: One row per body and frame.
        cameras: Names of the cameras.

    Raises:
        SettingsError: A column is missing, or names an unknown camera.
    """
    for name in ("arrival_ns", "camera"):
        if name not in table:
            raise SettingsError(f"frames: column {name} is missing; would be right: {', '.join(_COLUMNS)}, ...")
    points = {point for point in POINTS if f"{point}_x" in table}
    for name in (f"{point}_{axis}" for point in sorted(points) for axis in "yz"):
        if name not in table:
            raise SettingsError(f"frames: column {name} is missing; would be right: x, y and z of a point")
    if not points:
        raise SettingsError(f"frames: no body point; would be right: columns such as pelvis_x, of {', '.join(POINTS)}")
    unknown = sorted(set(table["camera"].astype(str)) - set(cameras))
    if unknown:
        raise SettingsError(f"frames: camera {unknown[0]} has no pose; cameras are {', '.join(cameras)}")
    table = table.sort_values("arrival_ns", kind="stable")
    places, confidence = np.full((len(table), len(POINTS), 3), np.nan), np.zeros((len(table), len(POINTS)))
    for i, point in enumerate(POINTS):
        if point in points:
            places[:, i] = table[[f"{point}_{axis}" for axis in "xyz"]].to_numpy(dtype=float)
            seen = np.isfinite(places[:, i]).all(axis=1).astype(float)
            told = f"{point}_confidence"
            confidence[:, i] = table[told].to_numpy(dtype=float) if told in table else seen
    arrival_ns = table["arrival_ns"].to_numpy(dtype=np.int64)
    return CameraFrames(
        capture_ns=table["capture_ns"].to_numpy(dtype=np.int64) if "capture_ns" in table else arrival_ns,
        arrival_ns=arrival_ns,
        camera=np.array([cameras.index(name) for name in table["camera"].astype(str)], dtype=np.int64),
        body=table["body"].to_numpy(dtype=np.int64) if "body" in table else np.zeros(len(table), np.int64),
        points_m=places,
        confidence=confidence,
        cameras=cameras,
    )


def table_of_frames(parts: list[CameraFrames], cameras: tuple[str, ...]) -> pd.DataFrame:
    """Makes this DataFrame from tables of frames of some cameras."""
    if not parts:
        return pd.DataFrame(columns=list(_COLUMNS))
    whole = CameraFrames.join(parts)
    columns: dict[str, Any] = {
        "arrival_ns": whole.arrival_ns,
        "capture_ns": whole.capture_ns,
        "camera": np.array(cameras, dtype=object)[whole.camera],
        "body": whole.body,
    }
    for i, point in enumerate(POINTS):
        columns |= {f"{point}_{axis}": whole.points_m[:, i, k] for k, axis in enumerate("xyz")}
        columns[f"{point}_confidence"] = whole.confidence[:, i]
    return pd.DataFrame(columns)
