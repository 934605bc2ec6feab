"""Somebody who stands still, before one camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hrcreplay.human.model import skeleton
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import DOF, CameraFrames, Floats
from tests.human.people import LENGTHS_M


def frames(points: Floats, rate_hz: float = 30.0) -> CameraFrames:
    """Frames of one camera that sees these (n, 20, 3) points [m]."""
    n = len(points)
    t_ns = 1_000_000_000 + np.round(np.arange(n) / rate_hz * 1e9).astype(np.int64)
    return CameraFrames(
        capture_ns=t_ns,
        arrival_ns=t_ns + 5_000_000,
        camera=np.zeros(n, np.int64),
        body=np.zeros(n, np.int64),
        points_m=points,
        confidence=np.where(np.isfinite(points).all(axis=2), 1.0, 0.0),
        cameras=("cam",),
    )


def standing(n: int) -> Floats:
    """(n, 20, 3) points of the model with slightly bent arms, swaying by 3 mm within a second, as people do [m]."""
    p = np.zeros((n, DOF))
    p[:, 0] = 3e-3 * np.sin(0.2 * np.arange(n))
    p[:, [4, 8]], p[:, [7, 11]], p[:, 12] = 0.2, 2.5, 1.0
    return skeleton(p, np.tile(LENGTHS_M, (n, 1)))


def log_of_one_who_does_not_stir(path: Path, seconds: float = 10.0) -> Path:
    """A log of one camera at 30 Hz whose pose is known."""
    with LogWriter(path) as writer:
        writer.camera("cam", np.eye(4))
        writer.frames(frames(standing(round(30.0 * seconds))))
    return path
