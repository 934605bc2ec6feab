from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from hrcreplay.human.fusion.fuse import fuse, process_noise, start
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.fusion.smoother import smooth
from hrcreplay.human.model import skeleton
from hrcreplay.limits import load_limits
from hrcreplay.records import Floats
from hrcreplay.settings.sections import Fusion
from tests.human.sightings import CAMERAS, LENGTHS_M, NEUTRAL, frames_of

LIMITS = load_limits("human")
T = np.tile(np.eye(4), (2, 1, 1))


def moving(seconds: NDArray[np.floating[Any]]) -> Floats:
    p = np.tile(NEUTRAL, (len(seconds), 1))
    p[:, 2] += 0.4 * np.sin(2.0 * seconds)
    p[:, 9] += 0.5 * np.sin(3.0 * seconds)
    return p


def test_it_is_the_least_squares_estimate_given_all_measurements() -> None:
    """One joint, written as one linear system over all ticks: prior, motions and measurements weighed by variance."""
    settings = Fusion(
        delay="ignore",
        outlier_m=1e6,
        bone_m=1e6,
        coast_s=1e3,
        memory_s=1e3,
        sigma_position=(1e3, 300.0, 100.0, 30.0),
        sigma_angle=(3e3, 1e3, 300.0, 100.0),
    )
    rng = np.random.default_rng(1)
    capture = np.arange(0, 400_000_000, 20_000_000)
    points = skeleton(moving(capture * 1e-9), np.tile(LENGTHS_M, (len(capture), 1)))
    m = measure(
        frames_of(points + rng.normal(0, 0.01, points.shape), capture * 0, capture), T, Fusion(point_std_m=0.01)
    )
    t = np.arange(0, 400_000_000, 10_000_000)
    _, states, _, trace = fuse(start(CAMERAS), t, m.rows(m.arrival_ns <= t[-1]), settings, LIMITS, traced=True)
    smoothed = smooth(states, trace, settings)
    dt, n = 0.01, len(t)
    F = sum(np.eye(4, k=k) * dt**k / (1, 1, 2, 6)[k] for k in range(4))
    scale = 0.05 ** np.arange(4.0)
    for j, sigmas in ((0, settings.sigma_position), (2, settings.sigma_angle), (9, settings.sigma_angle)):
        variance = np.array(sigmas) ** 2 * np.array([dt**4 / 24, dt**3 / 6, dt**2 / 2, dt])
        first = np.array([states.p[0, j], states.v[0, j], states.a[0, j], states.j[0, j]])
        rows, right = [np.zeros((4, 4 * n))], [first / np.sqrt(np.diag(trace.cov[0, j]))]
        rows[0][:, :4] = np.diag(1.0 / np.sqrt(np.diag(trace.cov[0, j])))
        for k in range(1, n):
            step = np.zeros((4, 4 * n))
            step[:, 4 * k : 4 * k + 4], step[:, 4 * k - 4 : 4 * k] = np.eye(4), -F
            rows.append(step / np.sqrt(variance)[:, None])
            right.append(np.zeros(4))
        for z, std, at in zip(m.angles[1:, j], m.angles_std[1:, j], capture[1:], strict=True):
            row = np.zeros((1, 4 * n))
            row[0, 4 * np.searchsorted(t, at)] = 1.0 / std
            rows.append(row)
            right.append(np.array([z / std]))
        A, b = np.vstack(rows) / np.tile(scale, n), np.concatenate(right)
        best = (np.linalg.lstsq(A, b, rcond=None)[0] / np.tile(scale, n)).reshape(n, 4)
        np.testing.assert_allclose(smoothed.p[:, j], best[:, 0], atol=1e-6)
        np.testing.assert_allclose(smoothed.v[:, j], best[:, 1], atol=1e-4)


def test_it_is_nearer_to_the_truth_than_the_filter_and_surer() -> None:
    rng = np.random.default_rng(2)
    capture = np.arange(0, 4_000_000_000, 20_000_000)
    points = skeleton(moving(capture * 1e-9), np.tile(LENGTHS_M, (len(capture), 1)))
    frames = frames_of(points + rng.normal(0, 0.015, points.shape), capture * 0, capture, 30_000_000)
    t = np.arange(0, 4_000_000_000, 10_000_000)
    settings = Fusion(spread_least=1.0, spread_most=1.0)
    m = measure(frames, T, Fusion(point_std_m=0.015))
    _, states, _, trace = fuse(start(CAMERAS), t, m.rows(m.arrival_ns <= t[-1]), settings, LIMITS, traced=True)
    smoothed = smooth(states, trace, settings)
    truth = moving(t * 1e-9)
    live = np.isfinite(states.p[:, 0])
    np.testing.assert_array_equal(np.isfinite(smoothed.p[:, 0]), live)

    def error(p: Floats) -> float:
        return float(np.sqrt(np.mean((p - truth)[live][20:, [2, 9]] ** 2)))

    assert error(smoothed.p) < 0.75 * error(states.p)
    assert (smoothed.p_std[live] <= states.p_std[live] * (1 + 1e-6)).all()


def test_it_follows_an_arm_that_changes_its_name() -> None:
    seconds = np.arange(0.0, 4.0, 0.02)
    p = np.tile(NEUTRAL, (len(seconds), 1))
    p[:, 8], p[:, 9] = np.radians(20.0 - 80.0 * np.clip((seconds - 1.0) / 2.0, 0.0, 1.0)), np.radians(55.0)
    capture = np.round(seconds * 1e9).astype(np.int64)
    points = skeleton(p, np.tile(LENGTHS_M, (len(p), 1)))
    m = measure(frames_of(points, capture * 0, capture), T, Fusion(point_std_m=0.01))
    settings = Fusion()
    _, states, _, trace = fuse(start(CAMERAS), capture, m, settings, LIMITS, traced=True)
    assert np.abs(np.diff(states.p[:, 8])).max() > 3.0
    smoothed = smooth(states, trace, settings)
    assert np.abs(np.diff(smoothed.p[:, 8])).max() < 0.1
    np.testing.assert_allclose(smoothed.p[20:, 8:10], p[20:, 8:10], atol=0.03)


def test_without_anybody_there_is_nothing_to_smooth() -> None:
    t = np.arange(0, 50_000_000, 10_000_000)
    points = skeleton(NEUTRAL[None], LENGTHS_M[None])
    none = measure(frames_of(points, np.zeros(1, np.int64), np.zeros(1, np.int64)), T, Fusion())
    none = replace(none).rows(slice(0, 0))
    _, states, _, trace = fuse(start(CAMERAS), t, none, Fusion(), LIMITS, traced=True)
    assert np.isnan(smooth(states, trace, Fusion()).p).all()
    assert np.isnan(fuse(start(CAMERAS), t, none, Fusion(), LIMITS)[1].p).all()


@pytest.mark.parametrize("gap", [False, True], ids=["seen", "unseen for a time"])
def test_it_is_filterpys_smoother(gap: bool) -> None:
    rng = np.random.default_rng(3)
    capture = np.arange(0, 2_000_000_000, 20_000_000)
    points = skeleton(moving(capture * 1e-9), np.tile(LENGTHS_M, (len(capture), 1)))
    m = measure(frames_of(points + rng.normal(0, 0.01, points.shape), capture * 0, capture), T, Fusion())
    if gap:
        m = m.rows((m.capture_ns < 700_000_000) | (m.capture_ns > 1_300_000_000))
    t, settings = np.sort(rng.integers(0, 1_990_000_000, 300)), Fusion()
    _, states, _, trace = fuse(start(CAMERAS), t, m.rows(m.arrival_ns <= t[-1]), settings, LIMITS, traced=True)
    smoothed, first = smooth(states, trace, settings), int(np.flatnonzero(np.isfinite(states.p[:, 0]))[0])
    assert (trace.damping < 1.0).any() == gap
    unit = 0.05 ** np.arange(4.0)
    dt = np.diff(t[first:], prepend=t[first]) * 1e-9
    for j in (0, 2, 3, 7, 12):  # of joints whose angle has one name all along
        mean = np.stack([states.p, states.v, states.a, states.j], axis=2)[first:, j] * unit
        F, Q = [], []
        for step, damping in zip(dt, trace.damping[first:, j], strict=True):
            powers = sum(np.eye(4, k=k) * step**k / (1, 1, 2, 6)[k] for k in range(4))
            F.append(np.diag([1.0, damping, damping, damping]) @ powers * (unit[:, None] / unit))
            Q.append(np.diag(process_noise(settings, j, step, damping) * unit**2))
        cov = trace.cov[first:, j] * (unit[:, None] * unit)
        x, P, _, _ = KalmanFilter(4, 1).rts_smoother(mean, cov, F, Q)
        for k, name in enumerate("pvaj"):
            np.testing.assert_allclose(getattr(smoothed, name)[first:, j] * unit[k], x[:, k], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(smoothed.p_std[first:, j], np.sqrt(P[:, 0, 0]), rtol=1e-6)
        np.testing.assert_allclose(smoothed.v_std[first:, j] * unit[1], np.sqrt(P[:, 1, 1]), rtol=1e-6)
