from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hrcreplay.human.fusion.inverse_kinematics import DEPENDS, inverse, inverse_jacobian, measure
from hrcreplay.human.model import canonical, nearest, skeleton
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, JOINTS, POINTS, Bools, Floats
from hrcreplay.settings.sections import Fusion
from tests.human.sightings import CAMERAS, LENGTHS_M, NEUTRAL, frames_of, lengths, postures

NOISE = Fusion(point_std_m=0.02)
AT = {name: k for k, name in enumerate(POINTS)}


def person(**joints: float) -> Floats:
    p = NEUTRAL.copy()
    for name, value in joints.items():
        p[JOINTS.index(name)] = value
    return p


def stds(p: Floats, confidence: float = 1.0, noise: Fusion = NOISE) -> Floats:
    frames = frames_of(skeleton(p[None], LENGTHS_M[None]), np.zeros(1, np.int64), np.zeros(1, np.int64))
    frames = type(frames)(**{**vars(frames), "confidence": frames.confidence * confidence})
    return measure(frames, np.tile(np.eye(4), (2, 1, 1)), noise).angles_std[0]


@pytest.mark.parametrize("name", ["paper", "human"])
def test_forward_and_inverse_kinematics_are_each_others_inverse(name: str) -> None:
    """Over all postures inside the limits; where two names are admissible the canonical one is found."""
    p, pi = postures(load_limits(name), 5000, 1), lengths(5000, 2)
    if name == "paper":
        np.testing.assert_array_equal(canonical(p), p)
    points = skeleton(p, pi)
    found, found_pi = inverse(points)
    np.testing.assert_allclose(found, canonical(p), atol=1e-9)
    np.testing.assert_allclose(found_pi, pi, atol=1e-9)
    np.testing.assert_allclose(skeleton(found, found_pi), points, atol=1e-9)


def test_both_names_of_an_arm_are_the_same_posture_and_nearest_finds_either() -> None:
    p = postures(load_limits("human"), 500, 3)
    other = p.copy()
    for first in (4, 8):
        other[:, first] += np.pi
        other[:, first + 1] = np.pi - p[:, first + 1]
        other[:, first + 2] -= np.pi
    pi = lengths(500, 4)
    np.testing.assert_allclose(skeleton(other, pi), skeleton(p, pi), atol=1e-12)
    np.testing.assert_allclose(canonical(other), canonical(p), atol=1e-9)
    other[:, 2] += 4.0 * np.pi
    np.testing.assert_allclose(nearest(other, p), p, atol=1e-9)
    np.testing.assert_allclose(nearest(p, other), other, atol=1e-9)


@pytest.mark.parametrize(
    ("joints", "lost"),
    [
        ({"al4": np.pi}, "al3"),  # straight elbow
        ({"ar2": np.pi / 2}, "ar1"),  # arm forward: the axis of alpha_1
    ],
)
def test_towards_a_singular_posture_the_noise_grows_and_the_rest_stays(joints: dict[str, float], lost: str) -> None:
    (name, at), k = next(iter(joints.items())), JOINTS.index(lost)
    noise = [stds(person(**{name: at - away}))[k] for away in (0.8, 0.4, 0.2, 0.1, 0.0)]
    assert (np.diff(noise) > 0).all()
    assert noise[-1] > 100.0
    exact = person(**joints)
    found = inverse(skeleton(exact[None], LENGTHS_M[None]))[0][0]
    assert np.isfinite(found).all()
    observed = [j for j in range(DOF) if JOINTS[j] not in (lost, f"{lost[:2]}{4 - int(lost[2])}")]
    np.testing.assert_allclose(found[observed], exact[observed], atol=1e-6)


def test_heading_is_lost_where_the_shoulder_line_is_vertical() -> None:
    points = skeleton(NEUTRAL[None], LENGTHS_M[None])[0]
    neck = points[AT["neck"]]
    half_line = np.array([0.0, 0.0, 0.19])
    points[AT["shoulder_l"]], points[AT["shoulder_r"]] = neck + half_line, neck - half_line
    frames = frames_of(points[None], np.zeros(1, np.int64), np.zeros(1, np.int64))
    found = measure(frames, np.tile(np.eye(4), (2, 1, 1)), NOISE)
    assert np.isfinite(found.angles).all()
    assert found.angles_std[0, 2] > 100.0


def test_the_jacobian_undoes_that_of_the_forward_kinematics() -> None:
    """J_inverse J_forward = 1, the latter by Richardson's extrapolation of the forward kinematics."""
    for p in postures(load_limits("paper"), 20, 5):
        if abs(np.sin(p[7]) * np.cos(p[5])) < 0.2 or abs(np.sin(p[11]) * np.cos(p[9])) < 0.2:
            continue  # too near to a singular posture for differences
        state = np.concatenate([p, LENGTHS_M])
        forward = np.zeros((60, 20))
        known = np.isfinite(skeleton(p[None], LENGTHS_M[None])[0].ravel())

        def points(x: Floats, known: Bools = known) -> Floats:
            return np.where(known, skeleton(x[None, :DOF], x[None, DOF:])[0].ravel(), 0.0)

        for j in range(20):
            step = np.zeros(20)
            step[j] = 1e-3
            near = (points(state + step) - points(state - step)) / 2e-3
            far = (points(state + 2 * step) - points(state - 2 * step)) / 4e-3
            forward[:, j] = (4 * near - far) / 3
        inverse_rows = inverse_jacobian(points(state).reshape(20, 3)).reshape(20, 60)
        name = np.ones(20)
        name[[k for first in (4, 8) if np.cos(p[first + 1]) < 0 for k in [first + 1]]] = -1.0
        np.testing.assert_allclose(name[:, None] * inverse_rows @ forward, np.eye(20), atol=1e-6)


def test_a_row_is_the_joints_and_then_the_lengths_of_the_person_seen() -> None:
    frames = frames_of(skeleton(NEUTRAL[None], LENGTHS_M[None]), np.zeros(1, np.int64), np.zeros(1, np.int64))
    found = measure(frames, np.tile(np.eye(4), (2, 1, 1)), NOISE)
    np.testing.assert_allclose(found.angles[0], canonical(NEUTRAL[None])[0], atol=1e-9)
    np.testing.assert_allclose(found.lengths_m[0], LENGTHS_M, atol=1e-9)
    np.testing.assert_array_equal(found.z_std, np.hstack((found.angles_std, found.lengths_std_m)))


def test_the_noise_is_that_of_sampled_points() -> None:
    rng = np.random.default_rng(6)
    points = skeleton(NEUTRAL[None], LENGTHS_M[None])
    samples = np.repeat(points, 20_000, axis=0) + rng.normal(0.0, 0.004, (20_000, 20, 3))
    found, found_pi = inverse(samples)
    measured = measure(
        frames_of(points, np.zeros(1, np.int64), np.zeros(1, np.int64)),
        np.tile(np.eye(4), (2, 1, 1)),
        Fusion(point_std_m=0.004),
    )
    np.testing.assert_allclose(measured.angles_std[0], found.std(axis=0), rtol=0.03)
    np.testing.assert_allclose(measured.lengths_std_m[0], found_pi.std(axis=0), rtol=0.03)


def test_noise_grows_with_the_range_and_as_confidence_falls() -> None:
    np.testing.assert_allclose(
        stds(NEUTRAL, 0.5, Fusion(point_std_m=1e-4)), 2.0 * stds(NEUTRAL, 1.0, Fusion(point_std_m=1e-4)), rtol=1e-3
    )
    assert (stds(NEUTRAL, noise=Fusion(point_std_m=0.02, point_std_per_m=0.01)) > stds(NEUTRAL)).all()


def test_cameras_see_the_same_person_in_one_world() -> None:
    rng = np.random.default_rng(7)
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[1, :3, :3] *= np.linalg.det(T[1, :3, :3])
    T[1, :3, 3] = rng.normal(size=3)
    world = skeleton(NEUTRAL[None], LENGTHS_M[None])
    seen = np.concatenate([world, (world - T[1, :3, 3]) @ T[1, :3, :3]])
    found = measure(frames_of(seen, np.arange(2), np.zeros(2, np.int64)), T, NOISE)
    assert found.cameras == CAMERAS
    np.testing.assert_allclose(found.angles, [NEUTRAL, NEUTRAL], atol=1e-9)
    np.testing.assert_allclose(found.points_m[1], world[0], atol=1e-12)


@pytest.mark.parametrize("missing", ["pelvis", "head", "elbow_l", "wrist_r", "shoulder_r"])
def test_a_missing_point_takes_only_what_rests_on_it(missing: str) -> None:
    """Without one shoulder, the measured neck gives the heading; the lengths that rest on the middle are gone."""
    points = skeleton(NEUTRAL[None], LENGTHS_M[None])
    points[0, AT[missing]] = np.nan
    found = measure(
        frames_of(points, np.zeros(1, np.int64), np.zeros(1, np.int64)), np.tile(np.eye(4), (2, 1, 1)), NOISE
    )
    rows, std = found.z[0], found.z_std[0]
    gone = DEPENDS[:, AT[missing]].copy()
    if missing.startswith("shoulder"):
        gone[[2, 3, 8, 9, 10, 11]] = False
    np.testing.assert_array_equal(np.isnan(rows), gone)
    np.testing.assert_array_equal(np.isnan(std), gone)
    np.testing.assert_allclose(rows[~gone], np.concatenate([NEUTRAL, LENGTHS_M])[~gone], atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(arrays(np.float64, (1, 20, 3), elements=st.floats(-5, 5, allow_nan=False)))
def test_any_finite_points_have_finite_angles_that_reproduce_the_arms(points: Floats) -> None:
    """Where the two ends of a bone are apart; see test_degenerate for those that are not."""
    points = points + np.outer(np.arange(20), [0.011, 0.007, 0.013])
    middle = 0.5 * (points[0, AT["shoulder_l"]] + points[0, AT["shoulder_r"]])
    bones = [points[0, AT["shoulder_l"]] - middle, points[0, AT["pelvis"]] - middle, points[0, AT["head"]] - middle]
    for side in "rl":
        shoulder, elbow, wrist = (points[0, AT[f"{name}_{side}"]] for name in ("shoulder", "elbow", "wrist"))
        bones += [elbow - shoulder, wrist - elbow]
    assume(min(np.linalg.norm(bones, axis=1)) > 1e-3)
    found, found_pi = inverse(points)
    assert np.isfinite(found).all()
    assert np.isfinite(found_pi).all()
    again = skeleton(found, found_pi)[0]
    for side in "rl":
        bone = points[0, AT[f"elbow_{side}"]] - points[0, AT[f"shoulder_{side}"]]
        np.testing.assert_allclose(again[AT[f"elbow_{side}"]] - again[AT[f"shoulder_{side}"]], bone, atol=1e-6)
