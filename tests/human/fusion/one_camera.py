"""One camera at the world's origin, for the tests."""

from __future__ import annotations

import numpy as np

from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.model import skeleton
from hrcreplay.records import CameraFrames, Floats, Ints, Measurements
from hrcreplay.settings.sections import Fusion

POSE = np.array([0.2, 0.1, 0.3, 0.1, 0.4, 0.6, 0.1, 1.7, 0.4, 0.6, 0.1, 1.7, 0.94])
LENGTHS_M = np.array([0.5, 0.2, 0.18, 0.3, 0.3, 0.26, 0.26])
RATE_HZ, FRAMES_HZ = 250, 50


def ticks(seconds: float) -> Ints:
    return np.arange(1, round(seconds * RATE_HZ) + 1) * (1_000_000_000 // RATE_HZ)


def frames_of(p: Floats, noise_m: float = 0.0, lengths_m: Floats = LENGTHS_M) -> CameraFrames:
    """One camera at the world's origin, p (n, 13) at FRAMES_HZ."""
    points = skeleton(p, np.tile(lengths_m, (len(p), 1)))
    points = points + np.random.default_rng(4).normal(0.0, 1.0, points.shape) * noise_m
    capture = np.arange(len(p)) * (1_000_000_000 // FRAMES_HZ)
    return CameraFrames(
        capture_ns=capture,
        arrival_ns=capture + 1,
        camera=np.zeros(len(p), np.int64),
        body=np.zeros(len(p), np.int64),
        points_m=points,
        confidence=np.isfinite(points[:, :, 0]).astype(np.float64),
        cameras=("one",),
    )


def measured(frames: CameraFrames, std_m: float = 0.02) -> Measurements:
    return measure(frames, np.eye(4)[None], Fusion(point_std_m=std_m))
