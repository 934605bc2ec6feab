"""Peers against motions that obey their own assumptions, drawn and followed with steps of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.audit import baselines
from hrcreplay.errors import SettingsError
from hrcreplay.geometry.inflated_hull import InflatedHull
from hrcreplay.human.model import skeleton
from hrcreplay.human.prediction.swept_volumes import limb_radii
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, LENGTHS, LIMBS, POINTS, Floats, HumanStates, SweptVolumes
from hrcreplay.settings.sections import Prediction
from tests.facts import facts
from tests.human.people import random_states, states

RADII_M, HAND_M, HORIZON_S = limb_radii(Prediction()), 0.19, 0.377
AXES = {
    "HD": ("neck", "head"),
    "THX": ("pelvis", "shoulder_r", "shoulder_l"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "wrist_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "wrist_l"),
}


def _axes(people: HumanStates, limb: str, later_s: float = 0.0) -> Floats:
    """(n, k, 3) the limb's points after moving on at constant joint rates for so long."""
    points = skeleton(people.p + later_s * people.v, people.lengths_m)
    return points[:, [POINTS.index(name) for name in AXES[limb]]]


def _predict(people: HumanStates, method: str, horizon_s: float = HORIZON_S) -> SweptVolumes:
    return baselines.predict(people, horizon_s=horizon_s, radii_m=RADII_M, hand_m=HAND_M, method=method)


def _solid(volumes: SweptVolumes, tick: int, limb: str) -> InflatedHull:
    i = volumes.limbs.index(limb)
    return InflatedHull.around(volumes.vertices(tick, i), float(volumes.radius_m[tick, i]))


def _walk(start: Floats, v0: Floats, horizon_s: float, rng: np.random.Generator) -> Floats:
    """(steps, 3) a point driven at 50 m/s^2 in directions that change now and then, its speed held at 2 m/s."""
    dt = horizon_s / 200
    p, v, track = start.copy(), v0.copy(), []
    push = rng.normal(size=3)
    for step in range(200):
        if step % int(rng.integers(5, 80)) == 0:
            push = rng.normal(size=3)
        wanted = 2.0 * push / np.linalg.norm(push)
        change = wanted - v
        change *= min(1.0, 50.0 * dt / max(float(np.linalg.norm(change)), 1e-12))
        p, v = p + (v + 0.5 * change) * dt, v + change
        track.append(p)
    return np.array(track)


@pytest.mark.parametrize("horizon_s", [0.02, 0.05, 0.377])
def test_v2_a50_holds_every_motion_with_its_speed_and_acceleration(horizon_s: float) -> None:
    rng = np.random.default_rng(1)
    people = random_states(load_limits("paper"), 6, seed=2)
    people = replace(people, v=0.5 * people.v)
    volumes = _predict(people, "v2_a50", horizon_s)
    tightest = np.inf
    for tick in range(len(people)):
        for i, limb in enumerate(LIMBS):
            radius = RADII_M[i]
            solid = _solid(volumes, tick, limb)
            velocity = (_axes(people, limb, 1e-6) - _axes(people, limb, -1e-6))[tick] / 2e-6
            for k, start in enumerate(_axes(people, limb)[tick]):
                assert np.linalg.norm(velocity[k]) < 2.0
                for _ in range(4):
                    track = _walk(start, velocity[k], horizon_s, rng)
                    room = solid.radius_m - radius + 1e-9
                    beyond = solid.distances_m(track)
                    assert beyond.max() <= room
                    tightest = min(tightest, room - beyond.max())
    assert tightest < 0.25 * 2.0 * horizon_s  # and it is no larger than it has to be


def test_a_faster_person_than_the_peer_believes_in_counts_as_2_m_per_s() -> None:
    p, v = np.zeros((1, DOF)), np.zeros((1, DOF))
    p[0, [7, 11]], v[0, 0] = np.pi, 5.0
    head = _predict(states(p, v), "v2_a50").vertices(0, 0)
    still = _predict(states(p, 0 * v), "v2_a50").vertices(0, 0)
    np.testing.assert_allclose(head - still, [[0.08, 0, 0]] * 2, atol=1e-12)


def test_constant_velocity_holds_ends_that_go_on_as_they_do() -> None:
    people = random_states(load_limits("paper"), 12, seed=5)
    volumes = _predict(people, "constant_velocity")
    for limb in LIMBS:
        now, velocity = _axes(people, limb), (_axes(people, limb, 1e-6) - _axes(people, limb, -1e-6)) / 2e-6
        for tick in range(len(people)):
            solid = _solid(volumes, tick, limb)
            track = now[tick] + velocity[tick] * np.linspace(0.0, HORIZON_S, 20)[:, None, None]
            assert solid.distances_m(track.reshape(-1, 3)).max() < 1e-6
            assert solid.radius_m == pytest.approx(RADII_M[LIMBS.index(limb)])


def test_iso_13855_is_the_limb_with_its_approach_speed_around() -> None:
    people = random_states(load_limits("paper"), 3, seed=8)
    volumes = _predict(people, "iso_13855")
    np.testing.assert_allclose(volumes.radius_m[0] - RADII_M, np.array([1.6, 1.6, 2.0, 2.0, 2.0, 2.0]) * HORIZON_S)
    length = people.lengths_m[0, LENGTHS.index("pi_upper_arm_r")]
    r = 0.07 + 2.0 * HORIZON_S
    capsule = np.pi * r**2 * length + 4.0 / 3.0 * np.pi * r**3
    assert _solid(volumes, 0, "URA").volume_m3() == pytest.approx(capsule)


@pytest.mark.parametrize("method", baselines.BASELINES)
def test_the_lower_arm_ends_at_the_tip_of_the_hand(method: str) -> None:
    people = random_states(load_limits("paper"), 4, seed=9)
    volumes = _predict(people, method)
    for tick in range(len(people)):
        elbow, wrist = _axes(people, "LLA")[tick]
        tip = wrist + HAND_M * (wrist - elbow) / np.linalg.norm(wrist - elbow)
        solid = _solid(volumes, tick, "LLA")
        assert solid.distances_m(tip[None])[0] <= solid.radius_m - 0.07 + 1e-9


@pytest.mark.parametrize("method", baselines.BASELINES)
def test_a_person_not_known_yet_has_no_volume(method: str) -> None:
    people = states(np.full((2, DOF), np.nan), np.full((2, DOF), np.nan))
    volumes = _predict(people, method)
    assert len(volumes) == 2
    assert all(np.isnan(volumes.vertices(tick, i)).any() for tick in range(2) for i in range(6))
    one = _predict(random_states(load_limits("paper"), 5, seed=3), method)
    for tick in range(5):
        alone = _predict(random_states(load_limits("paper"), 5, seed=3).rows(slice(tick, tick + 1)), method)
        for i in range(6):
            np.testing.assert_array_equal(alone.vertices(0, i), one.vertices(tick, i))


def test_an_unknown_peer_is_named() -> None:
    with pytest.raises(SettingsError, match=facts("'magic'", "constant_velocity", "v2_a50", "iso_13855")):
        _predict(random_states(load_limits("paper"), 1, seed=3), "magic")
