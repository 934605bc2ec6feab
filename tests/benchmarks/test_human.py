"""The fusion against filterpy's dense filter over the same states, two cameras at 30 Hz, ticks at 250 Hz.

Run: pytest tests/benchmarks/test_human.py --benchmark-only
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.linalg import block_diag

from hrcreplay.human.fusion.fuse import fuse, start
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.model import skeleton
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, LENGTHS, CameraFrames, Ints, Measurements
from hrcreplay.settings.sections import Fusion
from tests.human.sightings import CAMERAS, LENGTHS_M, NEUTRAL, frames_of

SECONDS = 4.0
TICKS = (np.arange(0.1, SECONDS, 0.004) * 1e9).astype(np.int64)
T_WORLD_CAMERA = np.tile(np.eye(4), (2, 1, 1))
LIMITS = load_limits("human")


def frames() -> CameraFrames:
    capture = np.sort(np.concatenate([np.arange(c, SECONDS, 1 / 30) for c in (0.0, 0.015)]) * 1e9).astype(np.int64)
    points = np.repeat(skeleton(NEUTRAL[None], LENGTHS_M[None]), len(capture), axis=0)
    noisy = points + np.random.default_rng(1).normal(0.0, 0.01, points.shape)
    return frames_of(noisy, np.arange(len(capture)) % 2, capture)


def measured() -> Measurements:
    m = measure(frames(), T_WORLD_CAMERA, Fusion())
    return m.rows(m.arrival_ns <= TICKS[-1])


def dense_us_per_tick(measurements: Measurements, ticks: Ints) -> float:
    """The same run with filterpy: predict every tick, update with the rows of the frames that arrived."""
    states = 4 * DOF + len(LENGTHS)
    dense = KalmanFilter(states, 1)
    dense.P = np.eye(states)
    F = block_diag(
        np.kron(sum(np.eye(4, k=k) * 0.004**k / (1, 1, 2, 6)[k] for k in range(4)), np.eye(DOF)), np.eye(len(LENGTHS))
    )
    Q = np.diag(np.repeat([0.0, 1e-4, 0.0, 0.0, 0.0], [DOF] * 4 + [len(LENGTHS)]))
    H = np.zeros((20, states))
    H[:DOF, :DOF], H[DOF:, 4 * DOF :] = np.eye(DOF), np.eye(len(LENGTHS))
    z, R = measurements.z, measurements.z_std**2
    begun, seen = time.perf_counter(), 0
    for now in ticks:
        dense.predict(F=F, Q=Q)
        while seen < len(z) and measurements.arrival_ns[seen] <= now:
            dense.update(z[seen][:, None], R=np.diag(R[seen]), H=H)
            seen += 1
    return (time.perf_counter() - begun) / len(ticks) * 1e6


def test_fuse_a_recording(benchmark: Any) -> None:
    measurements = measured()
    fuse(start(CAMERAS), TICKS, measurements, Fusion(), LIMITS)
    benchmark(lambda: fuse(start(CAMERAS), TICKS, measurements, Fusion(), LIMITS))
    ours, theirs = benchmark.stats.stats.median / len(TICKS) * 1e6, dense_us_per_tick(measurements, TICKS[:250])
    benchmark.extra_info |= {"us_per_tick": ours, "filterpy_us_per_tick": theirs, "times_faster": theirs / ours}


def test_fuse_one_tick(benchmark: Any) -> None:
    """A live tick: a table of one row, with everything Python does around it."""
    measurements = measured()
    state, _, _, _ = fuse(start(CAMERAS), TICKS[:-1], measurements, Fusion(), LIMITS)
    none = measurements.rows(slice(0, 0))
    benchmark(lambda: fuse(state, TICKS[-1:], none, Fusion(), LIMITS))


def test_measure_one_frame(benchmark: Any) -> None:
    one = frames().rows(slice(0, 1))
    measure(one, T_WORLD_CAMERA, Fusion())
    benchmark(lambda: measure(one, T_WORLD_CAMERA, Fusion()))
