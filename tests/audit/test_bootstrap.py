from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.audit import metrics as audit_checked
from hrcreplay.audit import metrics as audit_metrics
from hrcreplay.audit.measures import Resampling, block_ticks, resample
from hrcreplay.evaluation.containment import Outcome
from hrcreplay.records import BODY, Floats
from tests.facts import tells


def _once(n: int) -> Resampling:
    """Every tick once in every draw: no spread, so the figures themselves can be computed by hand."""
    return Resampling(np.ones((4, n)), 3, 1.0)


def _outcome(beyond: Floats, radius: float = 0.1, flesh: float = 0.0) -> Outcome:
    n, limbs = beyond.shape
    return Outcome(
        t_ns=np.arange(n) * 40_000_000,
        beyond_m=beyond,
        radius_m=np.full((n, limbs), radius),
        volume_m3=np.full((n, limbs), 0.5),
        union_m3=np.where(np.arange(n) % 2 == 0, 2.0, np.nan),
        union_std_m3=np.where(np.arange(n) % 2 == 0, 0.02, np.nan),
        upper_m3=np.where(np.arange(n) % 2 == 0, 1.5, np.nan),
        upper_std_m3=np.where(np.arange(n) % 2 == 0, 0.015, np.nan),
        limbs=BODY[:limbs],
        limb_radius_m=(flesh,) * limbs,
    )


def test_a_block_is_three_horizons_or_the_cube_root_of_a_long_log() -> None:
    assert block_ticks(0.377, 25.0, 1500) == 29
    assert block_ticks(0.377, 25.0, 1_000_000) == 100
    assert block_ticks(0.01, 25.0, 1) == 1


def test_a_draw_keeps_the_length_of_each_log_and_takes_whole_blocks() -> None:
    drawn = resample([10, 7], 4, 4.0, seed=1, draws=200)
    assert drawn.weights.shape == (200, 17)
    assert (drawn.weights[:, :10].sum(axis=1) == 10).all()
    assert (drawn.weights[:, 10:].sum(axis=1) == 7).all()
    one = resample([12], 4, 4.0, seed=1, draws=50).weights
    changes = (one != np.roll(one, 1, axis=1)).sum(axis=1)
    assert changes.max() <= 6  # three blocks have six ends
    np.testing.assert_array_equal(resample([12], 4, 4.0, seed=1, draws=50).weights, one)
    assert (resample([12], 4, 4.0, seed=2, draws=50).weights != one).any()
    mean = resample([40], 8, 4.0, seed=0, draws=4000).weights.mean(axis=0)
    np.testing.assert_allclose(mean, 1.0, atol=0.1)  # going round, no tick is rarer than another


def test_shares_means_and_quantiles_by_hand() -> None:
    values = np.array([4.0, np.nan, 1.0, 3.0, 2.0])
    once = _once(5)
    assert once.mean(values).value == 2.5
    assert once.mean(values).samples == 4
    assert [once.quantile(values, q).value for q in (0.25, 0.5, 0.51, 0.95, 1.0)] == [1.0, 2.0, 3.0, 4.0, 4.0]
    assert once.quantile(values, 0.5).low == 2.0
    assert once.share(np.array([1.0, 0.0, 1.0, np.nan, 1.0])).value == 0.75
    nothing = once.share(np.full(5, np.nan))
    assert nothing.samples == 0
    assert nothing.to_dict() == {"value": None, "low": None, "high": None, "samples": 0}


def test_a_weighted_quantile_is_that_of_the_rows_repeated() -> None:
    rng = np.random.default_rng(5)
    values = rng.normal(size=60)
    drawn = resample([60], 7, 4.0, seed=4, draws=120)
    repeated = [np.sort(np.repeat(values, w.astype(int)))[int(np.ceil(0.9 * 60)) - 1] for w in drawn.weights]
    found = drawn.quantile(values, 0.9)
    assert (found.low, found.high) == pytest.approx(tuple(np.quantile(repeated, [0.025, 0.975])))
    means = [np.repeat(values, w.astype(int)).mean() for w in drawn.weights]
    found = drawn.mean(values)
    assert (found.low, found.high) == pytest.approx(tuple(np.quantile(means, [0.025, 0.975])))


def test_no_escape_is_not_certainty() -> None:
    whole = resample([1000], 30, 10.0, seed=0).share(np.ones(1000))
    assert (whole.value, whole.high) == (1.0, 1.0)
    assert whole.low == pytest.approx(0.025 ** (1 / 100))
    none = resample([1000], 30, 10.0, seed=0).share(np.zeros(1000))
    assert none.high == pytest.approx(1 - 0.025 ** (1 / 100))
    almost = np.ones(1000)
    almost[500] = 0.0
    one = resample([1000], 30, 10.0, seed=0).share(almost)
    assert one.low < whole.low < one.value < one.high  # one escape more is never better


def _ar1(n: int, phi: float, rng: np.random.Generator) -> Floats:
    steps = rng.normal(size=n) * np.sqrt(1.0 - phi**2)
    series = np.empty(n)
    series[0] = rng.normal()
    for i in range(1, n):
        series[i] = phi * series[i - 1] + steps[i]
    return series


def test_intervals_hold_the_truth_of_a_series_with_memory() -> None:
    """AR(1) with a memory like that of overlapping horizons: 95 % intervals hold about 95 % of the time."""
    rng = np.random.default_rng(11)
    means = shares = naive = 0
    trials = 200
    for k in range(trials):
        series = _ar1(1500, 0.8, rng)
        drawn = resample([1500], 29, 9.4, seed=k, draws=200)
        mean = drawn.mean(series)
        share = drawn.share((series < 1.0).astype(float))
        alone = resample([1500], 1, 1.0, seed=k, draws=200).mean(series)
        means += mean.low <= 0.0 <= mean.high
        shares += share.low <= 0.841345 <= share.high
        naive += alone.low <= 0.0 <= alone.high
    assert 0.87 <= means / trials <= 0.98
    assert shares / trials >= 0.93
    assert naive / trials < 0.65  # what the blocks are for


def test_escapes_by_hand() -> None:
    beyond = np.full((8, 6), 0.05)
    beyond[2:4, 3] = 0.13, 0.16
    beyond[5, 3] = 0.11  # one tick between: the same escape
    beyond[7, 0] = 0.30
    beyond[0, 1] = np.nan
    outcome = _outcome(beyond)
    assert outcome.escape_m()[3, 3] == pytest.approx(0.06)
    np.testing.assert_allclose(outcome.worst_m(), [0, 0, 0.03, 0.06, 0, 0.01, 0, 0.2], atol=1e-12)
    found = audit_metrics.escapes(outcome, 0)
    assert [(e["limb"], e["from_s"], e["to_s"], e["ticks"]) for e in found] == [
        ("LRA", 0.08, 0.2, 3),
        ("HD", 0.28, 0.28, 1),
    ]
    assert found[0]["deepest_m"] == pytest.approx(0.06)
    assert found[0]["deepest_at_s"] == 0.12
    figures = audit_metrics.method_figures([outcome], _once(8))
    assert figures["all"]["covered_share"]["value"] == 0.5
    assert figures["LRA"]["covered_share"]["value"] == pytest.approx(5 / 8)
    assert figures["LRA"]["escape_p50_m"]["value"] == pytest.approx(0.03)
    assert figures["LRA"]["escape_max_m"] == pytest.approx(0.06)
    assert figures["THX"]["covered_share"]["samples"] == 7
    assert figures["THX"]["points_share"] == figures["THX"]["covered_share"]  # without flesh
    fleshy = audit_metrics.method_figures([_outcome(beyond, flesh=0.04)], _once(8))
    assert fleshy["THX"]["covered_share"]["value"] == 1.0  # 0.05 within 0.10 - 0.04
    thick = audit_metrics.method_figures([_outcome(beyond, flesh=0.06)], _once(8))
    assert (thick["all"]["covered_share"]["value"], thick["all"]["points_share"]["value"]) == (0.0, 0.5)
    assert thick["LRA"]["escape_max_m"] == pytest.approx(0.12)
    assert figures["THX"]["escape_max_m"] is None
    assert figures["all"]["union_m3"]["value"] == 2.0
    assert figures["all"]["union_m3"]["samples"] == 4
    assert figures["all"]["union_counting_error"] == pytest.approx(0.01)
    assert figures["all"]["sum_m3"]["value"] == 3.0


def test_every_limb_is_every_limb_that_was_checked() -> None:
    """The lower body leaves at one tick and is not seen at another; an arm is never seen."""
    beyond = np.full((8, 7), 0.05)
    beyond[3, 6], beyond[4, 6], beyond[5, 0] = 0.25, np.nan, 0.12
    beyond[:, 5] = np.nan
    beyond[7] = np.nan
    outcome = _outcome(beyond)
    np.testing.assert_allclose(outcome.worst_m(), [0, 0, 0, 0.15, 0, 0.02, 0, np.nan], atol=1e-12)
    figures = audit_metrics.method_figures([outcome], _once(8))
    assert figures["all"]["covered_share"]["value"] == pytest.approx(5 / 7)
    assert figures["all"]["escape_max_m"] == pytest.approx(0.15)
    assert figures["all"]["union_m3"]["value"] == 2.0
    assert figures["all"]["sum_m3"]["value"] == 3.5
    assert figures["upper"]["covered_share"]["value"] == pytest.approx(6 / 7)
    assert figures["upper"]["escape_max_m"] == pytest.approx(0.02)
    assert figures["upper"]["union_m3"]["value"] == 1.5
    assert figures["upper"]["sum_m3"]["value"] == 3.0
    assert [figures[limb]["covered_share"]["samples"] for limb in BODY] == [7, 7, 7, 7, 7, 0, 6]
    assert audit_metrics.curve_point([outcome], _once(8))["covered_share"]["value"] == pytest.approx(6 / 7)

    points = {limb: dict.fromkeys(names, count) for limb, (names, count) in _POINTS.items()}
    part = {"ticks": 8, "points": points, "methods": {"sound": figures}}
    assert audit_checked.never_checked(part, "sound") == ["LLA", "hand_r of LRA"]
    assert audit_checked.checked_scope(part, "sound") == "not LLA"
    never, late = audit_checked.unchecked_notes(part, "sound")
    assert never.endswith(": LLA, hand_r of LRA")
    assert late.endswith("8 ticks: HD 1, THX 1, URA 1, LRA 1, ULA 1, LEGS 2, foot_l of LEGS 5")
    rows = {row[0]: row[1] for row in audit_checked.checked_table(part, "sound").rows}
    assert (rows["HD"], rows["LLA"], rows["LRA: hand_r"]) == ("7", "not checked", "not checked")
    assert (rows["LEGS: foot_l"], rows["THX: shoulder_l"]) == ("3", "7")
    found = {"total": part, "method": "sound"}
    horizon = audit_metrics.horizon_point([outcome], _once(8))
    assert horizon["covered_share"] == figures["all"]["covered_share"]
    assert horizon["union_m3"] == figures["all"]["union_m3"]
    total = part | {"horizons": [{"horizon_s": 0.1, "methods": {"sound": horizon}}]}
    metrics = audit_metrics.headline_metrics(found | {"total": total})
    assert metrics["audit_sound_100ms_covered_share"]["value"] == pytest.approx(5 / 7)
    assert metrics["audit_sound_100ms_union_m3"]["value"] == 2.0
    assert metrics["audit_not_checked"]["value"] == "LLA, hand_r of LRA"
    assert metrics["audit_sound_LLA_covered_share"]["value"] is None
    for name in ("audit_sound_LLA_covered_share", "audit_sound_LLA_escape_max_m"):
        assert tells(metrics[name]["reason"], "not checked")
    assert metrics["audit_sound_LEGS_ticks"]["value"] == 6


#: Limb -> points beyond its ends, and at how many ticks they were seen.
_POINTS = {
    "HD": ((), 0),
    "THX": (("shoulder_l",), 7),
    "URA": ((), 0),
    "LRA": (("hand_r",), 0),
    "ULA": ((), 0),
    "LLA": (("hand_l",), 0),
    "LEGS": (("foot_l",), 3),
}


def test_logs_together_are_their_ticks_together() -> None:
    good, bad = _outcome(np.zeros((6, 6))), _outcome(np.full((2, 6), 0.2))
    figures = audit_metrics.method_figures([good, bad], _once(8))
    assert figures["all"]["covered_share"]["value"] == 0.75


def test_the_volume_at_a_coverage_lies_between_the_curves_points() -> None:
    def point(share: float | None, room: float) -> dict[str, dict[str, float | None]]:
        return {"covered_share": {"value": share}, "union_m3": {"value": room}}

    curve = [point(0.5, 1.0), point(None, 5.0), point(0.9, 4.0), point(1.0, 9.0)]
    assert audit_metrics.volume_at(curve, 0.7) == pytest.approx(2.0)  # half way, on a logarithmic axis
    assert audit_metrics.volume_at(curve, 0.3) == 1.0
    assert audit_metrics.volume_at(curve[:3], 0.95) is None


def test_first_movements_by_hand() -> None:
    beyond = np.full((8, 6), 0.05)  # ticks of 40 ms, radius 0.1
    beyond[2:4, 3] = 0.13, 0.16
    beyond[7, 3] = 0.30
    beyond[:, 1] = np.nan
    outcome = _outcome(beyond)
    moved: dict[str, int | None] = dict.fromkeys(outcome.limbs) | {"LRA": 120_000_000, "THX": 80_000_000, "HD": 0}
    found = audit_metrics.first_movements(outcome, moved, 0.08, 0)
    assert [(one["limb"], one["at_s"], one["ticks"], one["escaped_ticks"]) for one in found] == [
        ("HD", 0.0, 3, 0),
        ("THX", 0.08, 0, 0),
        ("LRA", 0.12, 5, 2),
    ]
    assert found[2]["deepest_m"] == pytest.approx(0.06)
    assert found[1]["deepest_m"] is None
