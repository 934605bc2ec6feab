"""Postures, skeletons and measurements for the tests of the person."""

from __future__ import annotations

import numpy as np

from hrcreplay.human.model import LimitSet, clamp
from hrcreplay.records import DOF, LENGTHS, POINTS, CameraFrames, Floats, Ints, Measurements

NEUTRAL = np.array([0.3, -0.2, 0.4, 0.1, 0.3, 0.6, 0.1, 1.9, 0.2, 0.5, -0.1, 2.1, 0.94])
LENGTHS_M = np.array([0.5, 0.22, 0.19, 0.31, 0.32, 0.27, 0.26])
CAMERAS = ("left", "right")


def postures(limits: LimitSet, n: int, seed: int) -> Floats:
    """(n, 13) uniform in the limits' box, then put inside the coupled limits."""
    rng = np.random.default_rng(seed)
    low = np.where(np.isfinite(limits.p_min), limits.p_min, -3.0)
    high = np.where(np.isfinite(limits.p_max), limits.p_max, 3.0)
    return clamp(rng.uniform(low, high, (n, DOF)), limits)


def lengths(n: int, seed: int) -> Floats:
    return np.random.default_rng(seed).uniform(0.15, 1.0, (n, len(LENGTHS)))


def frames_of(
    points_m: Floats, camera: Ints, capture_ns: Ints, delay_ns: int = 0, cameras: tuple[str, ...] = CAMERAS
) -> CameraFrames:
    """World points as frames of cameras that stand at the world's origin."""
    seen = np.isfinite(points_m[:, :, 0])
    return CameraFrames(
        capture_ns=capture_ns,
        arrival_ns=capture_ns + delay_ns,
        camera=camera,
        body=np.zeros_like(camera),
        points_m=points_m,
        confidence=seen.astype(np.float64),
        cameras=cameras,
    )


def random_measurements(n: int, seed: int, *, missing: float = 0.3, noise: float = 0.02) -> Measurements:
    """n frames of a person about NEUTRAL at random instants, angles with noise of their own, confidences random."""
    rng = np.random.default_rng(seed)
    capture = np.sort(rng.integers(0, n * 15_000_000, n))
    arrival = np.maximum.accumulate(capture + rng.integers(0, 30_000_000, n))
    std = rng.uniform(0.5, 2.0, (n, 20)) * noise
    confidence = np.where(rng.random((n, len(POINTS))) < missing / 5.0, 0.1, 1.0)
    z = np.concatenate([NEUTRAL, LENGTHS_M]) + rng.normal(0.0, noise, (n, 20))
    z[rng.random((n, 20)) < missing] = np.nan
    std[np.isnan(z)] = np.nan
    return Measurements(
        capture_ns=capture,
        arrival_ns=arrival,
        camera=rng.integers(0, 2, n),
        z=z,
        z_std=std,
        points_m=np.zeros((n, len(POINTS), 3)),
        confidence=confidence,
        cameras=CAMERAS,
    )
