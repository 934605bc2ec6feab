"""The fit of departures against brute force, on departures that are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from hrcreplay.audit import departure_fit
from hrcreplay.audit.departure_fit import fit
from hrcreplay.audit.departures import LimbDepartures, find_unrecorded_limbs
from hrcreplay.human.model import Departure
from hrcreplay.human.prediction.velocity_tube import NOISE_M
from hrcreplay.limits import load_limits
from hrcreplay.records import BODY, LIMBS, Floats
from tests.human.people import random_states

HORIZONS_S = np.array([0.1, 0.4])
HUMAN = load_limits("human")


def given(beyond: Floats, residual: Floats, seed: int = 1, height: Floats | None = None) -> LimbDepartures:
    """Departures (2, n, 7) that do not mind how far the pelvis may rise and sink."""
    count = len(residual)
    height = np.zeros((2, 2, count)) if height is None else height
    return departures_of(seed, height, lambda k, *_: np.asarray(beyond[k]), residual)


def departures_of(
    seed: int, height: Floats, beyond: Callable[[int, float, float], Floats], residual: Floats
) -> LimbDepartures:
    """Of a person who stands still and is known, without ground truth."""
    states, known = random_states(HUMAN, len(residual), seed), np.ones(len(residual), dtype=bool)
    return LimbDepartures(states, HORIZONS_S, height, beyond, residual, np.zeros_like(residual), known, False)


def log(count: int, seed: int, scale: float = 1.0) -> LimbDepartures:
    """Departures of 2 cm and 0.3 times the residual, three times that at the longer horizon, and some luck."""
    rng = np.random.default_rng(seed)
    residual = rng.uniform(0.01, 0.15, (count, len(BODY)))
    luck = scale * rng.uniform(0.2, 1.0, (2, count, len(BODY)))
    return given(luck * (0.02 + 0.3 * residual) * np.array([1.0, 3.0])[:, None, None], residual, seed)


def table(of: LimbDepartures) -> Floats:
    """(2, n, 7)"""
    return np.stack([of.beyond_m(k, 0.0, 0.0) for k in range(2)])


def plain_share(of: LimbDepartures, departure: Departure, k: int) -> float:
    hits, beyond = [], of.beyond_m(k, 0.0, 0.0)
    for tick in range(len(of.residual_m)):
        inside = True
        for limb in range(len(BODY)):
            far, residual = beyond[tick, limb], of.residual_m[tick, limb]
            most = departure.beyond_m[limb, k] + departure.residuals[limb, k] * min(residual, NOISE_M)
            inside &= not far > max(residual, most + max(0.0, residual - NOISE_M))
        if np.isfinite(beyond[tick]).any():
            hits.append(inside)
    return float(np.mean(hits))


def loss(offset: float, slope: float, far: Floats, residual: Floats) -> float:
    over = far - offset - slope * residual
    return float(np.where(over > 0.0, departure_fit._BELOW * over, (departure_fit._BELOW - 1.0) * over).mean())


def test_a_line_has_the_least_loss_of_all_on_a_grid() -> None:
    one = log(400, seed=1)
    far, residual = one.beyond_m(0, 0.0, 0.0)[:, 0], one.residual_m[:, 0]
    line = departure_fit._line([far[:, None]], [[residual[:, None]]], (np.inf, np.inf))
    least = min(loss(a, b, far, residual) for a, b in product(np.arange(0.0, 0.1, 0.002), np.arange(0.0, 3.0, 0.02)))
    assert loss(float(line[0]), float(line[1]), far, residual) <= least + 1e-9
    assert line[0] == pytest.approx(0.02, abs=0.01)
    assert line[1] == pytest.approx(0.3, abs=0.1)


def test_the_share_is_reached_by_whole_people_and_hardly_exceeded() -> None:
    logs = [log(400, seed) for seed in (2, 3, 4)]
    for share in (0.95, 0.99):
        found = fit(logs, share)
        for k in range(2):
            together = [plain_share(one, found, k) for one in logs]
            assert np.mean(together) >= share
            assert min(together) >= 1.0 - departure_fit._FITTED * (1.0 - share)
            smaller = replace(found, beyond_m=0.9 * found.beyond_m, residuals=0.9 * found.residuals)
            assert np.mean([plain_share(one, smaller, k) for one in logs]) < share
            for one in logs:
                assert np.nanmean(one.inside(found, k)) == plain_share(one, found, k)
    np.testing.assert_array_equal(found.beyond_m[[2, 3]], found.beyond_m[[4, 5]])
    np.testing.assert_array_equal(found.residuals[[2, 3]], found.residuals[[4, 5]])


def test_where_the_residual_says_a_limb_may_be_it_is_inside() -> None:
    one = log(50, seed=8)
    nothing = Departure(HORIZONS_S, *np.zeros((2, len(BODY), 2)), *np.zeros((2, 2)))
    for share, held in ((0.99, 1.0), (1.01, 0.0)):
        there = given(np.stack([share * one.residual_m] * 2), one.residual_m)
        assert all((there.inside(nothing, k) == held).all() for k in range(2))


def test_a_residual_that_is_another_place_counts_once() -> None:
    """Beyond NOISE_M it is not noise that is multiplied, but a place that is added."""
    residual = np.random.default_rng(15).uniform(0.0, 0.6, (300, len(BODY)))
    beyond = np.random.default_rng(16).uniform(0.0, 0.7, (2, 300, len(BODY))) * (0.2 + residual)
    of, some = given(beyond, residual), fit([log(400, seed=2)], 0.99)
    some = replace(some, beyond_m=np.full_like(some.beyond_m, 0.05), residuals=np.full_like(some.residuals, 0.8))
    for k in range(2):
        assert 0.05 < plain_share(of, some, k) < 0.95
        assert of.inside(some, k).mean() == pytest.approx(plain_share(of, some, k), abs=1e-12)


def test_departures_that_do_not_grow_with_the_residual_get_no_slope() -> None:
    one = log(400, seed=6)
    beyond = np.random.default_rng(7).uniform(0.0, 0.3, (2, *one.residual_m.shape))
    found = fit([given(beyond, one.residual_m)], 0.99)
    assert (found.residuals < 0.15).all()
    np.testing.assert_allclose(found.beyond_m, 0.3, atol=0.02)


def test_lines_that_hold_too_few_are_raised_and_no_steeper(monkeypatch: pytest.MonkeyPatch) -> None:
    logs = [log(400, seed) for seed in (2, 3, 4)]
    monkeypatch.setattr(departure_fit, "_BELOW", 0.8)
    found = fit(logs, 0.9)
    for k in range(2):
        assert np.mean([plain_share(one, found, k) for one in logs]) >= 1.0 - 0.1 * departure_fit._TOGETHER
    plain = departure_fit._lines(logs, HORIZONS_S, np.zeros(2), np.zeros(2))
    np.testing.assert_array_equal(found.residuals, plain.residuals)
    assert (found.beyond_m[:-1] > plain.beyond_m[:-1]).any(axis=1).all()


def test_a_person_who_departs_further_counts_as_much_as_the_others() -> None:
    """A quarter of the ticks of one log: without it the bounds are what the others need."""
    logs = [log(400, seed) for seed in (2, 3, 4)]
    wild = log(100, seed=5, scale=1.4)
    with_wild, without = fit([*logs, wild], 0.95), fit(logs, 0.95)
    assert plain_share(wild, without, 0) < 0.6
    assert plain_share(wild, with_wild, 0) >= 1.0 - departure_fit._FITTED * 0.05


def test_a_log_may_miss_a_few_times_as_many_ticks_as_all() -> None:
    """Of 100 ticks six are further out than any line needs, too few among 1,300 for the line itself to mind."""
    logs = [log(300, seed) for seed in (2, 3, 4, 5)]
    rare = log(100, seed=6, scale=0.5)
    beyond = table(rare)
    beyond[:, :6] = 1.25 * (0.02 + 0.3 * rare.residual_m[:6]) * np.array([1.0, 3.0])[:, None, None]
    rare = given(beyond, rare.residual_m)
    found = fit([*logs, rare], 0.99)
    for k in range(2):
        assert plain_share(rare, found, k) >= 1.0 - 0.01 * departure_fit._FITTED


def test_a_camera_that_loses_the_legs_does_not_drive_the_others_up() -> None:
    """Five of its hundred ticks, when three may miss: no factor holds them, so it asks for none."""
    logs = [log(100, seed) for seed in range(12)]
    beyond = table(logs[0])
    beyond[:, :5, BODY.index("LEGS")] = 50.0
    found, plain = fit([given(beyond, logs[0].residual_m), *logs[1:]], 0.99), fit(logs, 0.99)
    assert found.beyond_m.max() < 5.0
    np.testing.assert_allclose(found.beyond_m[:6], plain.beyond_m[:6], rtol=0.2)
    np.testing.assert_allclose(found.residuals[:6], plain.residuals[:6], rtol=0.2)


def test_ticks_of_simulated_people_are_not_counted_with_those_of_recorded_ones() -> None:
    """Of these the simulated are twice as many and hardly depart, and yet the recorded ones are inside."""
    recorded, simulated = log(400, seed=2), replace(log(800, seed=3, scale=0.2), true=True)
    assert departure_fit.counted([recorded, simulated]) == [True, False]
    assert departure_fit.counted([simulated, simulated]) == [True, True]
    found = fit([recorded, simulated], 0.95)
    for k in range(2):
        assert plain_share(recorded, found, k) >= 1.0 - 0.05 * departure_fit._TOGETHER


def test_a_limb_that_was_never_recorded_has_no_departure_and_is_named() -> None:
    logs = [log(200, seed) for seed in (2, 3)]
    blind = []
    for one in logs:
        beyond = table(one)
        beyond[..., BODY.index("LEGS")] = np.nan
        blind.append(given(beyond, one.residual_m))
    assert find_unrecorded_limbs(blind) == ["LEGS"]
    assert find_unrecorded_limbs(logs) == []
    found = fit(blind, 0.95)
    assert found.beyond_m[BODY.index("LEGS")].tolist() == [0.0, 0.0]
    assert np.isfinite(found.beyond_m).all()
    nobody = [given(np.full_like(table(one), np.nan), one.residual_m) for one in logs]
    assert fit(nobody, 0.95).beyond_m.max() == 0.0


def test_no_line_is_steeper_than_the_steepest() -> None:
    """Beyond that it is the offset that grows, not what everybody pays by their cameras' noise."""
    residual = np.random.default_rng(3).uniform(0.01, 0.15, (400, len(BODY)))
    found = fit([given(np.stack([3.0 * residual] * 2), residual)], 0.99)
    upper, legs = slice(len(BODY) - 1), BODY.index("LEGS")
    assert found.residuals[upper].min() >= 1.0
    assert found.residuals[upper].max() < 1.05
    np.testing.assert_allclose(found.beyond_m[upper] + 0.15 * found.residuals[upper], 0.45, atol=0.02)
    np.testing.assert_allclose(found.residuals[legs], 3.0, atol=0.05)  # their sway, which is small
    np.testing.assert_allclose(found.beyond_m[legs], 0.0, atol=0.01)


def test_rise_and_sink_are_a_quantile_in_which_each_log_weighs_as_its_root() -> None:
    rng = np.random.default_rng(12)
    heights = [rng.uniform(0.0, most, (2, 2, count)) for most, count in ((0.1, 10_000), (0.4, 100))]
    heights[0][:, :, ::7] = np.nan  # not recorded then
    residual = [np.full((height.shape[2], len(BODY)), 0.05) for height in heights]
    logs = [
        given(np.zeros((2, len(r), len(BODY))), r, height=height) for r, height in zip(residual, heights, strict=True)
    ]
    found = fit(logs, 0.99)
    for row, way in ((found.rise_m, 0), (found.sink_m, 1)):
        for k in range(2):
            known = [height[way, k][np.isfinite(height[way, k])] for height in heights]
            if k == 0:  # at most who accelerates evenly until the last horizon, seen 50 ms late, rounded up to 1 cm
                assert row[0] == pytest.approx(np.ceil(100.0 * row[1] / 9.0 - 1.0) / 100.0, abs=0.0101)
                continue
            above = sum(len(h) ** -0.5 * (h > row[k]).sum() for h in known) / sum(len(h) ** 0.5 for h in known)
            lower = sum(len(h) ** -0.5 * (h > row[k] - 0.01).sum() for h in known) / sum(len(h) ** 0.5 for h in known)
            assert above <= 1.0 - departure_fit._RISEN < lower
            assert row[k] == pytest.approx(round(row[k], 2), abs=1e-12)


def test_departures_are_beside_the_rise_and_sink_that_are_fitted() -> None:
    """The body rises with the pelvis: what is left of 0.1 m, later 0.5 m, is what rise and sink do not hold."""
    residual, height = np.full((200, len(BODY)), 0.02), np.full((2, 2, 200), 0.2)
    asked: list[tuple[float, float]] = []

    def beyond(k: int, rise_m: float, sink_m: float) -> Floats:
        asked.append((rise_m, sink_m))
        return np.full((200, len(BODY)), (0.1, 0.5)[k] - min(rise_m, sink_m))

    found = fit([departures_of(1, height, beyond, residual)], 0.99)
    assert set(asked) == {(0.03, 0.03), (0.2, 0.2)}
    assert found.rise_m.tolist() == found.sink_m.tolist() == [0.03, 0.2]
    reach = found.beyond_m + 0.02 * found.residuals
    np.testing.assert_allclose(reach[:-1], np.tile([0.07, 0.3], (len(LIMBS), 1)), atol=2e-3)
    np.testing.assert_allclose(reach[-1], [0.07 + begun_m(0.1), 0.3], atol=2e-3)


@pytest.mark.parametrize("true", [False, True])
def test_what_is_raised_is_what_costs_the_least(true: bool) -> None:
    """In three of 1,000 ticks a head is 1.5 times, in another one a lower arm 1.4 times as far out as ever else.

    A log with the truth may miss three of these: one line is enough for that, the head's, for arms are two.
    """
    residual = np.full((1000, len(BODY)), 0.02)
    beyond = np.tile(np.random.default_rng(14).uniform(0.05, 0.1, (1000, len(BODY))), (2, 1, 1))
    plain = fit([given(beyond, residual)], 0.99)
    beyond[:, ::400, BODY.index("HD")], beyond[:, 100, BODY.index("LLA")] = 0.15, 0.14
    found = fit([replace(given(beyond, residual), true=true)], 0.99)
    before, after = (of.beyond_m + 0.02 * of.residuals for of in (plain, found))
    np.testing.assert_allclose(after[0], [0.15] * 2 if true else before[0], atol=4e-3)
    np.testing.assert_allclose(after[1:], before[1:], atol=2e-3)


def test_the_same_way_costs_more_around_a_wide_limb() -> None:
    """Two ticks with a head 6 cm and two with a trunk 5 cm further out than ever else: three of them may be missed."""
    residual = np.full((1000, len(BODY)), 0.02)
    beyond = np.tile(np.random.default_rng(14).uniform(0.05, 0.1, (1000, len(BODY))), (2, 1, 1))
    beyond[..., BODY.index("THX")] *= 3.0
    plain = fit([given(beyond, residual)], 0.99)
    beyond[:, [0, 400], BODY.index("HD")], beyond[:, [100, 500], BODY.index("THX")] = 0.16, 0.35
    found = fit([replace(given(beyond, residual), true=True)], 0.99)
    before, after = (of.beyond_m + 0.02 * of.residuals for of in (plain, found))
    np.testing.assert_allclose(after[0], 0.16, atol=4e-3)
    np.testing.assert_allclose(after[1:], before[1:], atol=6e-3)


def test_who_moves_already_may_depart_further_and_who_stands_still_may_not() -> None:
    """0.1 m for everybody and, at the longer horizon, up to 0.2 m more for each m/s."""
    rng, residual = np.random.default_rng(21), np.full((2000, len(BODY)), 0.02)
    speed = rng.uniform(0.0, 1.0, residual.shape)
    beyond = rng.uniform(0.0, 1.0, (2, *residual.shape)) ** 0.2 * (0.1 + np.array([0.0, 0.2])[:, None, None] * speed)
    found = fit([replace(given(beyond, residual), speed_m_per_s=speed)], 0.99)
    assert found.swings_s is not None
    np.testing.assert_allclose(found.swings_s, np.tile([0.0, 0.2], (len(BODY), 1)), atol=0.03)
    reach = found.beyond_m + 0.02 * found.residuals
    np.testing.assert_allclose(reach[:-1], 0.1, atol=0.02)
    assert reach[-1, 0] <= 0.12 + begun_m(0.1)


def begun_m(after_s: float) -> float:
    """The way of legs at rest that begin to move by 5 m/s^2; their lines are at least as high [m]."""
    return 2.5 * after_s**2


def test_lines_fitted_to_others_are_widened_until_enough_of_these_people_are_inside() -> None:
    logs = [log(400, seed, scale) for seed, scale in ((2, 1.0), (3, 1.1), (4, 1.3))]
    folds = [fit([other for other in logs if other is not one], 0.95) for one in logs]
    factors = departure_fit.others_need(logs, folds, 0.95)

    def share(by: float, k: int) -> float:
        grown = [replace(f, beyond_m=by * f.beyond_m, residuals=by * f.residuals) for f in folds]
        return float(np.mean([plain_share(one, f, k) for one, f in zip(logs, grown, strict=True)]))

    assert {h > 0.25 for h in folds[0].horizon_s.tolist()} == {False, True}
    for k, (factor, horizon_s) in enumerate(zip(factors.tolist(), folds[0].horizon_s.tolist(), strict=True)):
        margin = 0.8 if horizon_s < 0.25 else 1.0  # by whose end robots beside people have stopped
        assert 1.0 < factor < 1.5
        assert share(factor, k) >= 1.0 - margin * 0.05 > share(factor - 0.0101, k)
    wide = departure_fit.widen(folds[0], factors)
    np.testing.assert_allclose(wide.beyond_m, factors * folds[0].beyond_m, atol=1e-3)
    assert (wide.residuals >= factors * folds[0].residuals - 1e-9).all()
    true = replace(logs[2], true=True)  # simulated people do not count beside recorded ones
    assert (departure_fit.others_need([*logs[:2], true], folds, 0.95) < factors).all()
