"""Hands and legs, which the model has not: where a camera last showed them, carried along, and not for long."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hrcreplay.records import BODY, POINTS, CameraFrames, HumanStates
from hrcreplay.settings.sections import Fusion
from tests.human.bent import bent, fused, measured, ticks

SPEED_M_PER_S = 0.8
LEGS_M = {
    f"{part}_{side}": (ahead, s * 0.12, up)
    for side, s in (("l", 1.0), ("r", -1.0))
    for part, ahead, up in (("hip", 0.0, 0.92), ("knee", 0.1, 0.5), ("ankle", 0.0, 0.08), ("foot", 0.15, 0.02))
}
HAND_M = np.array([0.02, 0.07, -0.05])
LEGS = [POINTS.index(name) for name in LEGS_M]
HANDS = [POINTS.index(f"hand_{side}") for side in "lr"]
WRISTS = [POINTS.index(f"wrist_{side}") for side in "lr"]


def walking(seconds: float) -> CameraFrames:
    """The bent person with legs and hands, who slides along x."""
    frames = bent(seconds)
    points, confidence = frames.points_m.copy(), frames.confidence.copy()
    for name, point in LEGS_M.items():
        points[:, POINTS.index(name)] = point
    points[:, HANDS] = points[:, WRISTS] + HAND_M
    points[..., 0] += SPEED_M_PER_S * (frames.capture_ns * 1e-9)[:, None]
    confidence[:, [*LEGS, *HANDS]] = 1.0
    return replace(frames, points_m=points, confidence=confidence)


def hidden(frames: CameraFrames, points: list[int], from_s: float) -> CameraFrames:
    confidence = frames.confidence.copy()
    late = np.flatnonzero(frames.capture_ns > from_s * 1e9)
    confidence[late[:, None], points] = 0.0
    return replace(frames, confidence=confidence)


def at(states: HumanStates, seconds: float) -> int:
    return int(np.searchsorted(states.t_ns, round(seconds * 1e9)))


def test_they_are_where_they_are_shown_now() -> None:
    states = fused(measured(walking(3.0)), ticks(3.0))
    truth = walking(3.0).points_m[-1] + [SPEED_M_PER_S * (3.0 - walking(3.0).capture_ns[-1] * 1e-9), 0.0, 0.0]
    np.testing.assert_allclose(states.points_m[-1, [*LEGS, *HANDS]], truth[[*LEGS, *HANDS]], atol=0.01)


def test_legs_go_along_with_the_pelvis_over_the_floor_and_are_forgotten() -> None:
    states = fused(measured(hidden(walking(4.0), LEGS, 3.0)), ticks(4.0))
    shown, later = at(states, 3.02), at(states, 3.18)
    went = states.points_m[later, 0] - states.points_m[shown, 0]
    assert np.hypot(*went[:2]) > 0.1
    moved = states.points_m[later, LEGS] - states.points_m[shown, LEGS]
    np.testing.assert_allclose(moved, np.tile([went[0], went[1], 0.0], (len(LEGS), 1)), atol=1e-9)
    assert np.isnan(states.points_m[at(states, 3.24) :, LEGS]).all()
    assert np.isfinite(states.points_m[at(states, 3.24) :, HANDS]).all()


def test_hands_go_along_with_the_wrist_and_are_forgotten() -> None:
    states = fused(measured(hidden(walking(4.0), HANDS, 3.0)), ticks(4.0))
    shown, later = at(states, 3.02), at(states, 3.18)
    for hand, wrist in zip(HANDS, WRISTS, strict=True):
        off = states.points_m[:, hand] - states.points_m[:, wrist]
        np.testing.assert_allclose(off[later], off[shown], atol=1e-9)
        np.testing.assert_allclose(off[later], HAND_M, atol=0.01)
    assert np.isnan(states.points_m[at(states, 3.24) :, HANDS]).all()


def test_what_is_too_far_to_be_a_leg_or_a_hand_is_none() -> None:
    """A knee at the origin of the world, and a hand half a metre from its wrist."""
    frames = walking(4.0)
    points = frames.points_m.copy()
    knee, hand = POINTS.index("knee_l"), POINTS.index("hand_l")
    points[frames.capture_ns > 2e9, knee] = 0.0
    points[frames.capture_ns > 2e9, hand] += 0.5
    states = fused(measured(replace(frames, points_m=points)), ticks(4.0))
    assert np.isnan(states.points_m[at(states, 2.3) :, [knee, hand]]).all()
    others = [k for k in (*LEGS, *HANDS) if k not in (knee, hand)]
    assert np.isfinite(states.points_m[at(states, 2.3) :, others]).all()


def test_legs_have_been_unseen_since_a_frame_showed_both_knees_and_ankles() -> None:
    frames = hidden(walking(3.0), [POINTS.index("knee_l")], 2.0)
    states = fused(measured(frames), ticks(3.0))
    unseen_s, legs = states.unseen_s[:, BODY.index("LEGS")], BODY.index("LEGS")
    last_ns = frames.capture_ns[frames.capture_ns <= 2_000_000_000].max()
    late = slice(at(states, 2.1), None)
    np.testing.assert_allclose(unseen_s[late], (states.t_ns[late] - last_ns) * 1e-9, atol=1e-12)
    assert (states.unseen_s[late, :legs] < 0.05).all()
    assert (unseen_s[at(states, 1.0) : at(states, 1.9)] < 0.06).all()
    assert np.isinf(unseen_s[0])


def turning(frames: CameraFrames, rate_rad_per_s: float) -> CameraFrames:
    """The same who turns on the spot, about the origin."""
    angle = rate_rad_per_s * frames.capture_ns * 1e-9
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    points = frames.points_m.copy()
    x, y = frames.points_m[..., 0], frames.points_m[..., 1]
    points[..., 0], points[..., 1] = c * x - s * y, s * x + c * y
    return replace(frames, points_m=points)


def test_a_hidden_foot_is_before_its_ankle_and_turns_with_the_body() -> None:
    """Seen for two seconds, then not for two, in which the body turns by 70 degrees."""
    feet, ankles = ([POINTS.index(f"{part}_{side}") for side in "lr"] for part in ("foot", "ankle"))
    frames = walking(4.0)
    frames = turning(replace(frames, points_m=frames.points_m - frames.points_m[:, :1] * [1.0, 1.0, 0.0]), 0.6)
    states = fused(measured(hidden(frames, feet, 2.0)), ticks(4.0))
    off = states.points_m[:, feet] - states.points_m[:, ankles]
    angle = 0.6 * states.t_ns[at(states, 2.3) :] * 1e-9
    expected = np.stack([0.15 * np.cos(angle), 0.15 * np.sin(angle), np.full(len(angle), -0.06)], axis=1)
    for foot in range(2):
        np.testing.assert_allclose(off[at(states, 2.3) :, foot], expected, atol=0.02)


def test_without_its_ankle_a_hidden_foot_is_nowhere() -> None:
    feet, ankles = ([POINTS.index(f"{part}_{side}") for side in "lr"] for part in ("foot", "ankle"))
    gone = fused(measured(hidden(walking(4.0), [*feet, *ankles], 2.0)), ticks(4.0))
    assert np.isnan(gone.points_m[at(gone, 2.3) :, [*feet, *ankles]]).all()


def test_a_foot_that_was_never_shown_is_ahead_of_its_ankle() -> None:
    feet, ankles = ([POINTS.index(f"{part}_{side}") for side in "lr"] for part in ("foot", "ankle"))
    states = fused(measured(hidden(walking(3.0), feet, -1.0)), ticks(3.0))
    off = states.points_m[at(states, 1.0) :, feet] - states.points_m[at(states, 1.0) :, ankles]
    np.testing.assert_allclose(np.hypot(off[..., 0], off[..., 1]), 0.2, atol=1e-9)
    heading = np.repeat(states.p[at(states, 1.0) :, 2:3], 2, axis=1)
    np.testing.assert_allclose(np.arctan2(off[..., 1], off[..., 0]), heading, atol=1e-9)


def test_what_no_camera_trusts_is_not_shown() -> None:
    frames = walking(3.0)
    confidence = frames.confidence.copy()
    confidence[:, LEGS] = 0.5 * Fusion().confidence_min
    states = fused(measured(replace(frames, confidence=confidence)), ticks(3.0))
    assert np.isnan(states.points_m[:, LEGS]).all()
