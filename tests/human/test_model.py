from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.human.model import alpha_2_bounds, alpha_3_bounds, clamp, skeleton
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, JOINTS, LENGTHS, POINTS, Floats
from tests.human.sightings import LENGTHS_M, lengths, postures


def chain(p: Floats, pi: Floats) -> dict[str, Floats]:
    """The model's points by composed rotations, straight from the definition of the frames."""
    q, length = dict(zip(JOINTS, p, strict=True)), dict(zip(LENGTHS, pi, strict=True))
    torso = Rotation.from_euler("Z", q["theta"]) * Rotation.from_euler("Y", q["rho"])
    points = {"pelvis": np.array([q["x"], q["y"], q["z"]])}
    points["neck"] = points["pelvis"] + torso.apply([0, 0, length["pi_torso"]])
    points["head"] = points["neck"] + torso.apply([0, 0, length["pi_head"]])
    for side, s in (("l", 1), ("r", -1)):
        a = [q[f"a{side}{k}"] for k in (1, 2, 3, 4)]
        upper = torso * Rotation.from_euler("X", s * a[0]) * Rotation.from_euler("Y", -a[1])
        fore = upper * Rotation.from_euler("Z", s * a[2]) * Rotation.from_euler("Y", -(np.pi - a[3]))
        shoulder = points["neck"] + torso.apply([0, s * length["pi_half_shoulder"], 0])
        elbow = shoulder + upper.apply([0, 0, -length[f"pi_upper_arm_{side}"]])
        points |= {f"shoulder_{side}": shoulder, f"elbow_{side}": elbow}
        points[f"wrist_{side}"] = elbow + fore.apply([0, 0, -length[f"pi_forearm_{side}"]])
    return points


def test_the_skeleton_is_the_chain_of_rotations_that_defines_it() -> None:
    p = np.random.default_rng(1).uniform(-3.0, 3.0, (50, DOF))
    pi = lengths(50, 2)
    found = skeleton(p, pi)
    for i in range(len(p)):
        expected = chain(p[i], pi[i])
        for k, name in enumerate(POINTS):
            if name in expected:
                np.testing.assert_allclose(found[i, k], expected[name], atol=1e-12)
            else:
                assert np.isnan(found[i, k]).all()


def test_named_postures_point_where_their_names_say() -> None:
    """Arms hanging at zero, forward at alpha_2 = 90 degrees, outward at alpha_1 = 90; the forearm likewise."""
    right = np.pi / 2

    def bones(ar: tuple[float, ...], al: tuple[float, ...]) -> tuple[Floats, ...]:
        points = skeleton(np.array([[0.0, 0.0, 0.0, 0.0, *ar, *al, 0.0]]), LENGTHS_M[None])[0]
        at = {name: points[k] for k, name in enumerate(POINTS)}
        ways = [at[f"{b}_{s}"] - at[f"{a}_{s}"] for s in "rl" for a, b in (("shoulder", "elbow"), ("elbow", "wrist"))]
        return tuple(way / np.linalg.norm(way) for way in ways)

    upper_r, fore_r, upper_l, fore_l = bones((0, right, 0, np.pi), (right, 0, 0, np.pi))
    np.testing.assert_allclose([upper_r, fore_r, upper_l, fore_l], [[1, 0, 0]] * 2 + [[0, 1, 0]] * 2, atol=1e-12)
    upper_r, fore_r, upper_l, fore_l = bones((right, 0, 0, np.pi), (0, 0, right, right))
    np.testing.assert_allclose([upper_r, fore_r], [[0, -1, 0]] * 2, atol=1e-12)
    np.testing.assert_allclose([upper_l, fore_l], [[0, 0, -1], [0, 1, 0]], atol=1e-12)  # outward is to the left
    _, fore_r, _, fore_l = bones((0, 0, 0, right), (0, 0, 0, right))
    np.testing.assert_allclose([fore_r, fore_l], [[1, 0, 0]] * 2, atol=1e-12)


def degrees_34(a1: float, a2: float) -> tuple[float, float, float, float]:
    """Eq. (34b), (34c) as printed, in degrees."""
    return (
        -43 + a1 / 3,
        153 - a1 / 6,
        -90 + 7 * a1 / 9 - a2 / 9 + 2 * a1 * a2 / 810,
        60 + 4 * a1 / 9 - 5 * a2 / 9 + 5 * a1 * a2 / 810,
    )


def test_coupled_bounds_are_those_printed() -> None:
    for a1, a2 in np.random.default_rng(3).uniform(-50, 160, (50, 2)):
        r1, r2 = np.radians([a1, a2])
        found = np.degrees([*alpha_2_bounds(r1, r1), *alpha_3_bounds(r1, r1, r2, r2)])
        np.testing.assert_allclose(found, degrees_34(a1, a2), atol=1e-9)


def test_coupled_bounds_of_a_box_enclose_those_of_its_points_tightly() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        (l1, h1), (l2, h2) = np.sort(rng.uniform(-50, 160, (2, 2)), axis=1)
        grid = [degrees_34(a, b) for a in np.linspace(l1, h1, 9) for b in np.linspace(l2, h2, 9)]
        low_2, high_2, low_3, high_3 = np.transpose(grid)
        box = np.radians([l1, h1, l2, h2])
        np.testing.assert_allclose(np.degrees(alpha_2_bounds(*box[:2])), [low_2.min(), high_2.max()], atol=1e-9)
        np.testing.assert_allclose(np.degrees(alpha_3_bounds(*box)), [low_3.min(), high_3.max()], atol=1e-9)


@pytest.mark.parametrize("name", ["paper", "human"])
def test_clamped_postures_obey_every_limit_and_inner_ones_are_untouched(name: str) -> None:
    limits = load_limits(name)
    p = np.random.default_rng(5).uniform(-6.0, 6.0, (500, DOF))
    inside = clamp(p, limits)
    np.testing.assert_array_equal(inside[:, :3], p[:, :3])  # no stop for x, y and heading
    assert (inside >= limits.p_min - 1e-12).all()
    assert (inside <= limits.p_max + 1e-12).all()
    if limits.coupled:
        for first in (4, 8):
            for a1, a2, a3 in np.degrees(inside[:, first : first + 3]):
                low_2, high_2, low_3, high_3 = degrees_34(a1, a2)
                assert low_2 - 1e-9 <= a2 <= high_2 + 1e-9
                assert low_3 - 1e-9 <= a3 <= high_3 + 1e-9
    np.testing.assert_array_equal(clamp(inside, limits), inside)
    np.testing.assert_array_equal(clamp(postures(limits, 50, 6), limits), postures(limits, 50, 6))


def test_one_row_and_many_give_the_same_bits() -> None:
    p, pi = np.random.default_rng(7).uniform(-3.0, 3.0, (20, DOF)), lengths(20, 8)
    one_by_one = np.concatenate([skeleton(p[i : i + 1], pi[i : i + 1]) for i in range(20)])
    np.testing.assert_array_equal(skeleton(p, pi), one_by_one)
