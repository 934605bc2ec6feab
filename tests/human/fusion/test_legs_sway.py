"""How far legs are seen to go, against a plain list of ways."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hrcreplay.human.model import LEG_POINTS
from hrcreplay.records import CameraFrames, Floats, Ints, Measurements
from tests.human.bent import fused, measured, ticks
from tests.human.fusion.test_model_residual_legs import STANDING_M, with_legs

STEP_S, LONGEST_S, MEAN_S = 0.025, 0.2, 0.5


def lively(seconds: float, seed: int) -> CameraFrames:
    """Legs that shake, more from the middle on, in frames at odd times; points come and go, and nothing for 0.3 s."""
    rng, frames = np.random.default_rng(seed), with_legs(seconds, STANDING_M)
    capture = frames.capture_ns + rng.integers(0, 18_000_000, len(frames))
    size = np.where(capture > 0.5e9 * seconds, 0.03, 0.004)[:, None, None]
    points = frames.points_m.copy()
    legs = list(LEG_POINTS)
    points[:, legs] += size * rng.normal(size=(len(frames), len(legs), 3))
    points[:, legs] = np.where(rng.random((len(frames), len(legs), 1)) < 0.2, np.nan, points[:, legs])
    kept = (capture < 1.1e9) | (capture > 1.4e9)
    shown = np.isfinite(points[:, :, 0]).astype(np.float64)
    whole = replace(frames, capture_ns=capture, arrival_ns=capture + 1_000_000, points_m=points, confidence=shown)
    return whole.rows(np.flatnonzero(kept)[np.argsort(capture[kept], kind="stable")])


def plain_sway(m: Measurements, t_ns: Ints) -> Floats:
    """(n,): from each place of a point to the first that comes 25 ms later or more, if that is within 0.2 s."""
    squares, latest = np.zeros((2, len(m.cameras), len(LEG_POINTS), len(t_ns)))
    latest -= np.inf
    for c in range(len(m.cameras)):
        for n, k in enumerate(LEG_POINTS):
            mine = np.flatnonzero((m.camera == c) & np.isfinite(m.points_m[:, k, 0]))
            turns = [int(mine[0])]
            for i in mine[1:].tolist():
                if m.capture_ns[i] - m.capture_ns[turns[-1]] >= round(STEP_S * 1e9):
                    turns.append(i)
            square = 0.0
            latest[c, n, t_ns >= m.arrival_ns[turns[0]]] = m.capture_ns[turns[0]]
            for i, j in pairwise(turns):
                took_s = float(m.capture_ns[j] - m.capture_ns[i]) * 1e-9
                if took_s <= LONGEST_S:
                    way = np.linalg.norm(m.points_m[j, k] - m.points_m[i, k])
                    square += (1.0 - np.exp(-took_s / MEAN_S)) * (way**2 - square)
                there = t_ns >= m.arrival_ns[j]
                squares[c, n, there], latest[c, n, there] = square, m.capture_ns[j]
    counts = t_ns - latest <= (LONGEST_S + STEP_S) * 1e9
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt((squares * counts).sum(axis=(0, 1)) / counts.sum(axis=(0, 1))))


def test_it_is_the_mean_of_the_recent_ways() -> None:
    m, t_ns = measured(lively(3.0, seed=3)), ticks(3.0)
    found = fused(m, t_ns).legs_sway_m
    assert found is not None
    settled = t_ns > 0.3e9  # the filter has found the pelvis
    found, expected, t_ns = found[settled], plain_sway(m, t_ns)[settled], t_ns[settled]
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    np.testing.assert_allclose(found, expected, atol=2e-4)  # of the pelvis' own motion in the filter
    assert np.nanmax(found[t_ns < 1.4e9]) < 0.02 < 0.05 < np.nanmax(found)
    assert np.isnan(found[(t_ns > 1.33e9) & (t_ns < 1.39e9)]).all(), "nobody has shown them for 0.2 s"


@pytest.mark.parametrize("every", [1, 2])
def test_a_camera_s_rate_matters_little(every: int) -> None:
    """Feet that swing at 1 m/s, beside a pelvis that stands, in 40 or 80 ms: twice as far, not more."""
    frames = with_legs(3.0, STANDING_M)
    points = frames.points_m.copy()
    points[:, list(LEG_POINTS), 0] += 0.1 * np.sin(10.0 * frames.capture_ns[:, None] * 1e-9)
    frames = replace(frames, points_m=points).rows(np.flatnonzero((np.arange(len(frames)) // 2) % every == 0))
    found = fused(measured(frames), ticks(3.0)).legs_sway_m
    assert found is not None
    assert found[-1] == pytest.approx(0.04 * every / np.sqrt(2.0), rel=0.2)


def test_who_walks_on_standing_legs_does_not_sway() -> None:
    """Legs that stand below a pelvis that moves go backwards below it; legs that go along do not."""
    along = fused(measured(with_legs(3.0, STANDING_M, speed=0.5)), ticks(3.0)).legs_sway_m
    still = fused(measured(with_legs(3.0, STANDING_M)), ticks(3.0)).legs_sway_m
    assert along is not None
    assert still is not None
    assert along[-1] < 0.003
    assert still[-1] == pytest.approx(0.0, abs=1e-6)
