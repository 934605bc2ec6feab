"""The reported standard deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.human.fusion.fuse import Trace, fuse, process_noise, start
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.fusion.reported_deviations import FIRST_SPREAD, FITTED, KIND
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, POINTS, Floats, Ints, Measurements
from hrcreplay.settings.sections import Fusion
from tests.human.fusion.one_camera import FRAMES_HZ, POSE, RATE_HZ, frames_of, measured, ticks

HUMAN = load_limits("human")
FREE = Fusion(spread_least=1.0, spread_most=1.0)
SWAY = np.array([0.05, 0.05, 0.1, 0.1, *[0.3, 0.2, 0.2, 0.3] * 2, 0.03])


def swaying(frames: int) -> Floats:
    """(frames, 13) a person whose joints all move, each at its own pace."""
    t = np.arange(frames)[:, None] / FRAMES_HZ
    return POSE + SWAY * np.sin((1.0 + 0.13 * np.arange(DOF)) * t)


def factors(m: Measurements, t: Ints, settings: Fusion | None = None) -> Floats:
    """(n, 13) the reported variances of v over those of P."""
    _, states, _, trace = fuse(start(("one",)), t, m, settings or Fusion(), HUMAN, traced=True)
    return np.asarray(states.v_std**2 / trace.cov[:, :, 1, 1])


def test_the_estimate_is_the_same_whatever_is_told_of_it() -> None:
    sway = POSE + 0.3 * np.sin(np.arange(150) / 8.0)[:, None] * (np.arange(DOF) >= 4)
    m = measured(frames_of(sway, 0.01))
    scaled, plain = (fuse(start(("one",)), ticks(2.9), m, s, HUMAN)[1] for s in (Fusion(), FREE))
    for name in ("p", "v", "a", "j", "lengths_m", "residual_m"):
        np.testing.assert_array_equal(getattr(scaled, name), getattr(plain, name))
    assert np.nanmax(np.abs(scaled.v_std / plain.v_std - 1.0)) > 0.3


def test_spread_and_correlation_are_those_of_the_innovations() -> None:
    """The innovations are computed here again, from the state and covariance of the tick before, with matrices."""
    m, t, settings = measured(frames_of(swaying(150), 0.015)), ticks(2.9), Fusion()
    _, states, _, trace = fuse(start(("one",)), t, m, settings, HUMAN, traced=True)
    dt, d = 1.0 / RATE_HZ, 1.0 / RATE_HZ  # a frame is used by the tick after its capture
    F = np.array([[1.0, dt, dt**2 / 2.0, dt**3 / 6.0], [0.0, 1.0, dt, dt**2 / 2.0], [0.0, 0.0, 1.0, dt], [0, 0, 0, 1]])
    h = np.array([1.0, -d, d**2 / 2.0, -(d**3) / 6.0])
    used = np.searchsorted(t, m.arrival_ns[m.arrival_ns <= t[-1]])[1:]  # the first only starts the filter
    for j in (0, 2, 3, 4, 7, 9, 12):
        G = np.diag(process_noise(settings, j, dt, 1.0))
        found = []
        for k, i in enumerate(used, start=1):
            before = np.array([states.p[i - 1, j], states.v[i - 1, j], states.a[i - 1, j], states.j[i - 1, j]])
            S = h @ (F @ trace.cov[i - 1, j] @ F.T + G) @ h + m.z_std[k, j] ** 2
            found.append((m.z[k, j] - h @ F @ before) / np.sqrt(S))
        nu, at_s = np.array(found), t[used] * 1e-9
        for n in (10, 60, len(nu) - 1):
            ago_s = at_s[n] - at_s[: n + 1]
            first = FIRST_SPREAD * np.exp(-(at_s[n] - t[used[0] - 5] * 1e-9))
            highest = max(first, (nu[: n + 1] ** 2 * np.exp(-ago_s)).max())
            assert trace.spread[used[n], j] == pytest.approx(highest, rel=1e-9)
            kept = np.exp(-ago_s / 2.0)
            agree = (kept[1:] * nu[1 : n + 1] * nu[:n]).sum() / (kept * nu[: n + 1] ** 2).sum()
            assert trace.autocorrelation[used[n], j] == pytest.approx(agree, rel=1e-6, abs=1e-9)
            for a, std in enumerate((states.p_std, states.v_std)):
                offset, slope = FITTED[KIND[j], a]
                scale = np.clip(highest * np.exp(offset + slope * agree), 0.01, 30.0)
                assert std[used[n], j] ** 2 == pytest.approx(scale * trace.cov[used[n], j, a, a], rel=1e-6)


def test_cameras_that_stand_apart_have_innovations_that_agree_with_their_own() -> None:
    """In turn two cameras show a person who stands still, the second one 4 cm further in x: each is off one way."""
    frames = frames_of(np.tile(POSE, (200, 1)))
    second = np.arange(200) % 2
    points = frames.points_m + np.multiply.outer(0.04 * second, np.array([1.0, 0.0, 0.0]))[:, None]
    both = replace(frames, points_m=points, camera=second, cameras=("one", "two"))
    m = measure(both, np.tile(np.eye(4), (2, 1, 1)), Fusion())
    _, states, _, trace = fuse(start(("one", "two")), ticks(3.9), m, Fusion(), HUMAN, traced=True)
    assert trace.autocorrelation[-1, 0] > 0.8
    assert states.p_std[-200:, 0].min() > 0.01  # whichever camera is right


def test_a_joint_that_was_lost_starts_anew() -> None:
    frames = frames_of(swaying(200), 0.02)
    points = frames.points_m.copy()
    points[60:110, POINTS.index("wrist_r")] = np.nan  # for 1 s: lost after 0.5 s
    t = ticks(3.9)
    _, _, _, trace = fuse(start(("one",)), t, measured(replace(frames, points_m=points)), Fusion(), HUMAN, traced=True)
    again = round(110 / FRAMES_HZ * RATE_HZ)
    assert trace.autocorrelation[again - 1, 7] != 0.0
    assert trace.autocorrelation[again, 7] == 0.0
    assert trace.spread[again, 7] == FIRST_SPREAD
    assert trace.autocorrelation[again, 11] != 0.0


def test_no_factor_is_beyond_its_bounds() -> None:
    m, t = measured(frames_of(swaying(150), 0.03)), ticks(2.9)
    bounded = Fusion(spread_least=0.5, spread_most=0.8, coast_s=10.0)
    _, states, _, trace = fuse(start(("one",)), t, m, bounded, HUMAN, traced=True)
    known = np.isfinite(states.p[:, 0])
    factor = (states.p_std**2 / trace.cov[:, :, 0, 0])[known]
    assert factor.min() == pytest.approx(0.5)
    assert factor.max() == pytest.approx(0.8)


def test_a_trace_cut_and_joined_is_the_same() -> None:
    m, t = measured(frames_of(swaying(50), 0.03)), ticks(0.9)
    trace = fuse(start(("one",)), t, m, Fusion(), HUMAN, traced=True)[-1]
    joined = Trace.join([trace.rows(slice(0, 70)), trace.rows(slice(70, None))])
    for name in ("cov", "damping", "spread", "autocorrelation"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(trace, name))


def test_both_arms_are_told_alike() -> None:
    np.testing.assert_array_equal(KIND[4:8], KIND[8:12])
    assert len(set(KIND[:8])) == len(FITTED) - 1


def test_before_any_innovation_the_deviations_are_about_those_of_the_filter() -> None:
    m = measured(frames_of(np.tile(POSE, (3, 1))))
    _, states, _, trace = fuse(start(("one",)), ticks(0.02), m, Fusion(), HUMAN, traced=True)
    first = np.flatnonzero(np.isfinite(states.p[:, 0]))[0]
    factor = states.p_std[first] ** 2 / trace.cov[first, :, 0, 0]
    assert ((factor > 0.5) & (factor < 1.5)).all()


@pytest.mark.parametrize("lingers_s", [0.0, 0.05])
@pytest.mark.parametrize("noise_m", [0.005, 0.02])
def test_errors_are_as_large_as_the_deviations_that_are_told(noise_m: float, lingers_s: float) -> None:
    """Over 20 s of a moving person, whether the noise is new in each frame or lingers for some frames."""
    n = 20 * FRAMES_HZ
    true = swaying(n)
    frames, random = frames_of(true), np.random.default_rng(8)
    kept = np.exp(-1.0 / (FRAMES_HZ * lingers_s)) if lingers_s else 0.0
    noise = np.zeros((n, len(POINTS), 3))
    noise[0] = random.normal(0.0, noise_m, noise[0].shape)
    for k in range(1, n):
        noise[k] = kept * noise[k - 1] + random.normal(0.0, noise_m * np.sqrt(1.0 - kept**2), noise[0].shape)
    m, t = measured(replace(frames, points_m=frames.points_m + noise)), ticks(19.9)
    _, states, _, _ = fuse(start(("one",)), t, m, Fusion(), HUMAN)
    at = POSE + SWAY * np.sin((1.0 + 0.13 * np.arange(DOF)) * t[:, None] * 1e-9)
    late = slice(3 * RATE_HZ, None)
    in_deviations = np.sqrt(np.mean(((states.p - at) / states.p_std)[late] ** 2, axis=0))
    assert 0.8 < np.sqrt(np.mean(in_deviations**2)) < 1.4
    assert (in_deviations > 0.6).all()
    assert (in_deviations < 1.8).all()


def test_a_person_at_rest_is_known_well_and_one_who_sets_off_is_not() -> None:
    p = np.tile(POSE, (400, 1))
    swing = np.clip(np.arange(400) / FRAMES_HZ - 6.0, 0.0, 0.4)
    p[:, 9] += 6.0 * swing  # at 6 rad/s from one frame to the next
    factor = factors(measured(frames_of(p)), ticks(7.9))
    at = round(6.0 * RATE_HZ)
    assert (factor[at - 10, 4:] < 0.05).all()
    assert factor[at - 10, 9] == pytest.approx(0.01)
    assert factor[at : at + RATE_HZ // 5, 9].max() > 10.0 * factor[at - 10, 9]
    held = factor[at + RATE_HZ // 5 :, 9]
    assert held[RATE_HZ // 4] > np.exp(-0.3) * held[0]


def test_what_coasts_is_as_uncertain_as_the_filter_says_at_least() -> None:
    frames = frames_of(np.tile(POSE, (300, 1)))
    points = frames.points_m.copy()
    points[200:, POINTS.index("wrist_r")] = np.nan
    factor = factors(measured(replace(frames, points_m=points)), ticks(5.9))
    before, after = round(3.9 * RATE_HZ), round(4.3 * RATE_HZ)
    assert (factor[before, [7, 11]] < 0.05).all()
    assert factor[after, 7] == pytest.approx(1.0)
    assert factor[after, 11] < 0.05
