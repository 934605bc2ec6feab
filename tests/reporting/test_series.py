from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.records import DOF
from hrcreplay.reporting.metrics import series


def test_interpolation_of_angles_goes_the_short_way_round() -> None:
    values = np.zeros((2, DOF))
    values[0, 2], values[1, 2] = np.pi - 0.1, -np.pi + 0.1
    values[:, 0] = [1.0, 3.0]
    found = series.interpolate(np.array([0, 100]), values, np.array([25, 50]), angles=True)
    assert found[:, 2] == pytest.approx([np.pi - 0.05, np.pi])
    assert found[:, 0] == pytest.approx([1.5, 2.0])


def test_interpolation_of_rates_does_not_wrap() -> None:
    values = np.zeros((2, DOF))
    values[1, 2] = 10.0
    assert series.interpolate(np.array([0, 10]), values, np.array([5]), angles=False)[0, 2] == pytest.approx(5.0)


def test_interpolation_is_missing_outside_and_beside_a_missing_sample() -> None:
    values = np.zeros((4, DOF))
    values[2] = np.nan
    at = np.array([-1, 0, 10, 15, 25, 30, 31])
    found = series.interpolate(np.array([0, 10, 20, 30]), values, at, angles=True)
    assert np.isnan(found).all(axis=1).tolist() == [True, False, False, True, True, False, True]


def test_central_differences_of_a_turning_heading() -> None:
    t_ns = np.arange(0, 3_000_000_000, 10_000_000)
    values = np.zeros((len(t_ns), DOF))
    values[:, 2] = series.wrap(2.0 * series.seconds_from(t_ns, 0) + 3.0)
    values[:, 1] = -0.5 * t_ns * 1e-9
    rate = series.central_differences(t_ns, values)
    assert np.isnan(rate[[0, -1]]).all()
    assert rate[1:-1, 2] == pytest.approx(2.0)
    assert rate[1:-1, 1] == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("mask", "expected"),
    [([], []), ([0, 0], []), ([1, 1], [[0, 2]]), ([0, 1, 1, 0, 1], [[1, 3], [4, 5]])],
)
def test_stretches(mask: list[int], expected: list[list[int]]) -> None:
    assert series.true_runs(np.array(mask, dtype=bool)).tolist() == expected


def test_envelope_keeps_every_extreme_and_every_gap() -> None:
    rng = np.random.default_rng(1)
    y = rng.standard_normal(20_000)
    y[7_000:7_003] = np.nan
    y[12_345], y[3] = 99.0, -99.0
    x = np.arange(len(y), dtype=float)
    thin_x, thin_y = series.envelope(x, y, bins=100)
    assert len(thin_x) <= 300
    assert np.nanmax(thin_y) == 99.0
    assert np.nanmin(thin_y) == -99.0
    assert np.isnan(thin_y).sum() == 1
    assert (np.diff(thin_x) > 0).all()
    assert (y[thin_x.astype(int)[np.isfinite(thin_y)]] == thin_y[np.isfinite(thin_y)]).all()


def test_envelope_leaves_short_lines_alone() -> None:
    x = np.arange(10.0)
    assert series.envelope(x, x)[0] is x


def test_broken_lines_get_a_gap() -> None:
    x, y = series.break_at_gaps(np.array([0.0, 0.1, 5.0]), np.array([1.0, 2.0, 3.0]), 0.2)
    assert x.tolist() == [0.0, 0.1, 0.1, 5.0]
    assert np.isnan(y).tolist() == [False, False, True, False]


def test_thinned_path_stays_within_its_tolerance() -> None:
    angle = np.linspace(0, 2 * np.pi, 5000)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    thin = series.thin_path(circle, 0.01)
    assert len(thin) < 700
    assert (thin[0] == circle[0]).all()
    assert (thin[-1] == circle[-1]).all()
    assert np.linalg.norm(np.diff(thin, axis=0), axis=1).max() < 0.012


def test_no_line_of_a_path_crosses_a_gap() -> None:
    points = np.column_stack([np.arange(12.0), np.zeros(12), np.zeros(12)])
    points[[3, 4, 8]] = np.nan
    first, second, third = series.thin_stretches(points, 1e-3)
    assert [part[:, 0].tolist() for part in (first, second, third)] == [
        [0.0, 1.0, 2.0],
        [5.0, 6.0, 7.0],
        [9.0, 10.0, 11.0],
    ]
    assert series.thin_stretches(points[3:5], 1e-3) == []


@pytest.mark.parametrize("dimensions", [2, 3])
def test_the_way_along_a_path_has_the_bits_of_numpys_norm(dimensions: int) -> None:
    """And a thinned path keeps the first point of every piece of the way, and the last."""
    points = np.cumsum(np.random.default_rng(3).normal(0.0, 0.01, (500, dimensions)), axis=0)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_array_equal(series.step_lengths(points), steps)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    np.testing.assert_array_equal(series.way_along(points), way)
    _, first = np.unique(np.floor(way / 0.05), return_index=True)
    np.testing.assert_array_equal(series.thin_path(points, 0.05), points[np.union1d(first, [499])])
