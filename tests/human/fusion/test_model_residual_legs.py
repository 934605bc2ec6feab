"""How far legs are from the line below the pelvis, against plain geometry: the nearest of many points on the line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.human.fusion.model_residual import LEAST
from hrcreplay.human.model import HEIGHT
from hrcreplay.records import BODY, POINTS, CameraFrames, Floats, HumanStates, Measurements
from hrcreplay.settings.sections import Fusion
from tests.human.bent import RATE_HZ, bent, fused, measured, predicted, ticks, used_frames

Legs = dict[str, tuple[float, float, float]]
LEGS = BODY.index("LEGS")
PELVIS = POINTS.index("pelvis")
BELOW = [f"{part}_{side}" for part in ("knee", "ankle", "foot") for side in "lr"]
LEG_POINTS = ["hip_l", "hip_r", *BELOW]
#: Legs from the middle of the pelvis, left ones; right ones are mirrored.
STANDING_M = {"hip": (0.0, 0.09, -0.02), "knee": (0.03, 0.11, -0.45), "ankle": (0.0, 0.12, -0.87)}
STANDING_M |= {"foot": (0.14, 0.14, -0.93)}
SITTING_M = {"hip": (0.02, 0.09, -0.01), "knee": (0.44, 0.17, 0.02), "ankle": (0.40, 0.16, -0.41)}
SITTING_M |= {"foot": (0.53, 0.18, -0.47)}


def with_legs(seconds: float, legs_m: Legs, speed: float = 0.0) -> CameraFrames:
    """The bent person on legs, at a pelvis height of theirs, who goes sideways."""
    frames = bent(seconds)
    points = frames.points_m.copy()
    for part, at in legs_m.items():
        for side, sign in (("l", 1.0), ("r", -1.0)):
            points[:, POINTS.index(f"{part}_{side}")] = points[:, PELVIS] + np.array([1.0, sign, 1.0]) * at
    points[:, :, 2] -= points[0, POINTS.index("foot_l"), 2] - 0.02
    points[:, :, 1] += speed * frames.capture_ns[:, None] * 1e-9
    return replace(frames, points_m=points, confidence=np.isfinite(points[:, :, 0]).astype(np.float64))


def rows(*names: str) -> list[int]:
    return [POINTS.index(name) for name in names]


def off_the_line(points_m: Floats, pelvis_m: Floats) -> Floats:
    """(k,) of points (k, 3) from the line between the floor and a pelvis, by looking along it in steps of 0.1 mm."""
    heights = np.arange(0.0, pelvis_m[2] + 1e-4, 1e-4).clip(max=pelvis_m[2])
    line = np.column_stack([np.full((len(heights), 2), pelvis_m[:2]), heights])
    nearest: Floats = np.linalg.norm(points_m[:, None] - line, axis=2).min(axis=1)
    return nearest


def plain_samples(m: Measurements, states: HumanStates, settings: Fusion) -> list[tuple[int, float]]:
    """(tick, sample) of every frame that shows pelvis and a leg, later than half a second after the pelvis was found.

    It is found with the first frame that shows it, and with the first after more than half a second without one.
    """
    samples: list[tuple[int, float]] = []
    found_ns = seen_ns = -(10**12)
    for k, i in used_frames(m, states.t_ns):
        age = (states.t_ns[k] - m.capture_ns[i]) * 1e-9
        p = states.p[k] - age * states.v[k] + age**2 / 2 * states.a[k] - age**3 / 6 * states.j[k]
        pelvis = np.array([p[0], p[1], p[HEIGHT]])
        trusted = {
            name
            for name in ("pelvis", *LEG_POINTS)
            if m.confidence[i, POINTS.index(name)] >= settings.confidence_min
            and np.linalg.norm(m.points_m[i, POINTS.index(name)] - pelvis) <= 1.2
        }
        if "pelvis" in trusted:
            found_ns = states.t_ns[k] if states.t_ns[k] - seen_ns > 500_000_000 else found_ns
            seen_ns = states.t_ns[k]
        if states.t_ns[k] - found_ns > 500_000_000 and "pelvis" in trusted and trusted & set(BELOW):
            points = m.points_m[i, rows(*sorted(trusted - {"pelvis"}))]
            samples.append((k, float(off_the_line(points, pelvis).max())))
    return samples


def plain_residual(m: Measurements, states: HumanStates, settings: Fusion) -> Floats:
    """(n,): all samples kept, each forgotten by its age, a pause counting half a second; the quantile exact."""
    found = np.full(len(states), np.nan)
    samples = plain_samples(m, states, settings)
    times_s = np.array([states.t_ns[k] * 1e-9 for k, _ in samples])
    passed_s = np.concatenate([[0.0], np.cumsum(np.minimum(np.diff(times_s), settings.memory_s))])
    for many in range(LEAST, len(samples) + 1):
        sizes = np.array([size for _, size in samples[:many]])
        weights = np.exp((passed_s[:many] - passed_s[many - 1]) / settings.residual_memory_s)
        order = np.argsort(sizes)
        share = np.cumsum(weights[order]) / weights.sum()
        found[samples[many - 1][0] :] = sizes[order][np.searchsorted(share, settings.residual_quantile)]
    return found


def lived() -> CameraFrames:
    """Stands, sits down elsewhere, walks off; points come and go, confidences too, and noise everywhere."""
    rng = np.random.default_rng(17)
    parts = [with_legs(2.0, STANDING_M), with_legs(2.0, SITTING_M), with_legs(2.0, STANDING_M, 0.4)]
    shifts = [round(s * 1e9) for s in (0.0, 2.0, 7.0)]  # 3 s of nothing before the last
    frames = CameraFrames.join(
        [
            replace(part, capture_ns=part.capture_ns + shift, arrival_ns=part.arrival_ns + shift)
            for part, shift in zip(parts, shifts, strict=True)
        ]
    )
    points = frames.points_m + rng.normal(0.0, 0.01, frames.points_m.shape)
    confidence = frames.confidence.copy()
    for name in LEG_POINTS:
        confidence[rng.random(len(frames)) < 0.3, POINTS.index(name)] = 0.1
        points[rng.random(len(frames)) < 0.2, POINTS.index(name)] = np.nan
        points[rng.random(len(frames)) < 0.05, POINTS.index(name), 0] += 1.3  # a leg of something else
    hips_only = np.flatnonzero(rng.random(len(frames)) < 0.2)
    confidence[hips_only[:, None], rows(*BELOW)] = 0.0  # nothing but hips
    confidence[rng.random(len(frames)) < 0.1, PELVIS] = 0.1
    return replace(frames, points_m=points, confidence=confidence)


@pytest.mark.parametrize(("quantile", "memory_s"), [(0.95, 20.0), (0.6, 1.0)])
def test_it_is_the_weighted_quantile_of_all_samples(quantile: float, memory_s: float) -> None:
    m = measured(lived())
    settings = Fusion(
        outlier_m=1e6, bone_m=1e6, residual_quantile=quantile, residual_memory_s=memory_s, residual_hold_s=0.0
    )
    states, prior = predicted(m, ticks(9.0), settings)
    expected = plain_residual(m, prior, settings)
    residual = states.residual_m[:, LEGS]
    np.testing.assert_array_equal(np.isnan(residual), np.isnan(expected))
    known = np.isfinite(expected)
    assert known.mean() > 0.85
    assert len(np.unique(residual[known])) > 5
    above_mm = (residual[known] - expected[known]) * 1e3  # by the millimetre, rounded up
    assert above_mm.min() > -1e-2  # what the steps along the line are coarse by
    assert above_mm.max() <= 1.0 + 1e-6


@pytest.mark.parametrize(("legs_m", "expected_m"), [(STANDING_M, (0.14, 0.14)), (SITTING_M, (0.53, 0.18))])
def test_standing_and_sitting_people(legs_m: Legs, expected_m: tuple[float, float]) -> None:
    """Feet and knees are the furthest, and both are between the floor and the pelvis."""
    states = fused(measured(with_legs(3.0, legs_m)), ticks(3.0))
    assert states.residual_m[-1, LEGS] == pytest.approx(np.hypot(*expected_m), abs=2e-3)
    assert states.residual_m[-1, LEGS] == pytest.approx(off_the_line(*_seated(legs_m)).max(), abs=2e-3)


def _seated(legs_m: Legs) -> tuple[Floats, Floats]:
    points = with_legs(0.1, legs_m).points_m[0]
    return points[rows(*LEG_POINTS)], points[PELVIS]


def test_knees_above_the_pelvis_and_feet_below_the_floor_count_upright() -> None:
    frames = with_legs(3.0, {"hip": (0.0, 0.0, 0.0), "knee": (0.03, 0.0, 0.30), "foot": (0.0, 0.02, -0.47)})
    up = fused(measured(frames), ticks(3.0)).residual_m[-1, LEGS]
    assert up == pytest.approx(np.hypot(0.03, 0.30), abs=2e-3)
    points = frames.points_m.copy()
    points[:, rows("foot_l", "foot_r"), 2] = -0.40
    down = fused(measured(replace(frames, points_m=points)), ticks(3.0)).residual_m[-1, LEGS]
    assert down == pytest.approx(np.hypot(0.02, 0.40), abs=2e-3)


@pytest.mark.parametrize(
    ("hidden", "known"),
    [((), True), (LEG_POINTS, False), (BELOW, False), (LEG_POINTS[:-1], True), (("pelvis",), False)],
)
def test_it_is_known_where_the_pelvis_and_a_point_below_the_hips_are_seen(hidden: tuple[str, ...], known: bool) -> None:
    frames = with_legs(2.0, STANDING_M)
    points, confidence = frames.points_m.copy(), frames.confidence.copy()
    points[:, rows(*hidden)] = np.nan
    gone = fused(measured(replace(frames, points_m=points)), ticks(2.0))
    confidence[:, rows(*hidden)] = 0.19
    vague = fused(measured(replace(frames, confidence=confidence)), ticks(2.0))
    for states in (gone, vague):
        assert np.isfinite(states.residual_m[:, LEGS]).any() == known


@pytest.mark.parametrize("shoulders_s", [0.0, 0.7])
def test_it_is_not_known_before_enough_samples(shoulders_s: float) -> None:
    """Legs hang from the pelvis: when shoulders are seen, and turn a torso nobody knew, makes no difference."""
    frames = with_legs(2.0, STANDING_M)
    points = frames.points_m.copy()
    hidden = np.flatnonzero(frames.capture_ns < shoulders_s * 1e9)
    points[hidden[:, None], rows("shoulder_l", "shoulder_r")] = np.nan
    frames = replace(frames, points_m=points)
    states = fused(measured(frames), ticks(2.0))
    used = np.array([k for k, _ in used_frames(measured(frames), states.t_ns)])
    settled = used[states.t_ns[used] > states.t_ns[used[0]] + 500_000_000]  # found, not lost again
    known = np.isfinite(states.residual_m[:, LEGS])
    np.testing.assert_array_equal(known, np.arange(len(states)) >= settled[LEAST - 1])


def test_frames_with_another_pelvis_and_points_out_of_reach_are_no_samples() -> None:
    frames = with_legs(3.0, STANDING_M)
    clean = fused(measured(frames), ticks(3.0)).residual_m[-1, LEGS]
    jumped, torn = frames.points_m.copy(), frames.points_m.copy()
    jumped[50::9] += [0.6, 0.0, 0.0]  # all of the person, for a frame
    torn[50::9, rows("ankle_l")] += [1.3, 0.0, 0.0]
    for points in (jumped, torn):
        found = fused(measured(replace(frames, points_m=points)), ticks(3.0)).residual_m[-1, LEGS]
        assert found == pytest.approx(clean, abs=5e-3)
    near = frames.points_m.copy()
    near[50::9, rows("ankle_l")] += [0.6, 0.0, 0.0]  # as far as a leg may be
    assert fused(measured(replace(frames, points_m=near)), ticks(3.0)).residual_m[-1, LEGS] > 0.55


def test_legs_change_nothing_else() -> None:
    there, blind = with_legs(3.0, SITTING_M, 0.3), with_legs(3.0, SITTING_M, 0.3)
    points = blind.points_m.copy()
    points[1:, rows(*LEG_POINTS)] = np.nan  # the first frame's tell where the person starts
    one, other = (fused(measured(f), ticks(3.0)) for f in (there, replace(blind, points_m=points)))
    for name in ("p", "v", "a", "j", "p_std", "v_std", "lengths_m", "lengths_std_m"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
    for name in ("residual_m", "unseen_s"):
        assert getattr(one, name)[:, :LEGS].tobytes() == getattr(other, name)[:, :LEGS].tobytes()
    assert np.isfinite(one.residual_m[2 * RATE_HZ :, LEGS]).all()
    assert np.isnan(other.residual_m[:, LEGS]).all()
