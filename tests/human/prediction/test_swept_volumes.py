from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from hrcreplay.errors import SettingsError
from hrcreplay.geometry.convex_hull import sphere_swept_volume_m3
from hrcreplay.human.model import LimitSet, clamp, skeleton
from hrcreplay.human.prediction.swept_volumes import METHODS, PRINTED, limb_radii
from hrcreplay.limits import load_limits
from hrcreplay.records import BODY, DOF, JOINTS, LIMBS, Floats, HumanStates, SweptVolumes
from hrcreplay.settings.sections import Prediction
from tests.facts import facts
from tests.human import predictions
from tests.human.people import LENGTHS_M, directions, limb_points, random_states, raw_cloud, states
from tests.human.predictions import reachable

T = 0.377
PAPER, HUMAN = load_limits("paper"), load_limits("human")
ALONG = directions(1500, 1)


def predict(people: HumanStates, limits: LimitSet = PAPER, method: str = "paper", horizon_s: float = T) -> SweptVolumes:
    return predictions.predict(people, limits, horizon_s=horizon_s, method=method)


def support(points: Floats) -> Floats:
    largest: Floats = (points @ ALONG.T).max(axis=0)
    return largest


@pytest.mark.parametrize("method", PRINTED)
def test_the_hulls_are_those_of_algorithm_2(method: str) -> None:
    people = random_states(PAPER, 12, 11)
    volumes, reach = predict(people, method=method), reachable(people, PAPER, T, method)
    for i in range(len(people)):
        for k, limb in enumerate(LIMBS):
            expected = support(raw_cloud(limb, reach.low[i], reach.high[i]))
            assert support(volumes.vertices(i, k)) == pytest.approx(expected, abs=1e-12), (i, limb)


def test_no_true_corner_is_missing_and_few_points_are_more() -> None:
    people = random_states(PAPER, 25, 12)
    volumes, reach = predict(people), reachable(people, PAPER, T, "paper")
    corners = kept = 0
    for i in range(len(people)):
        for k, limb in enumerate(LIMBS):
            cloud, some = raw_cloud(limb, reach.low[i], reach.high[i]), volumes.vertices(i, k)
            true = cloud[ConvexHull(cloud).vertices]
            gaps = np.linalg.norm(true[:, None] - some[None], axis=2).min(axis=1)
            assert (gaps < 1e-8).all()  # Qhull may name a neighbour closer than that
            corners, kept = corners + len(true), kept + len(some)
    assert kept < 1.25 * corners


def test_wide_limits_turn_joints_all_the_way_around() -> None:
    people = random_states(HUMAN, 4, 13)
    volumes, reach = predict(people, HUMAN), reachable(people, HUMAN, T, "paper")
    rng = np.random.default_rng(0)
    for i in range(len(people)):
        p = rng.uniform(reach.low[i], reach.high[i], (2000, DOF))
        points = skeleton(p, np.tile(LENGTHS_M, (len(p), 1)))
        for k, limb in enumerate(LIMBS):
            reached = np.concatenate([limb_points(point, limb) for point in points])
            assert (support(reached) <= support(volumes.vertices(i, k)) + 1e-12).all()


@pytest.mark.parametrize("method", PRINTED)
def test_every_posture_in_the_reachable_sets_is_inside(method: str) -> None:
    """Random postures, postures with every joint at an end, and the way of one joint between its ends."""
    people = random_states(PAPER, 30, 14)
    volumes, reach = predict(people, method=method), reachable(people, PAPER, T, method)
    rng = np.random.default_rng(1)
    for i in range(len(people)):
        low, high = reach.low[i], reach.high[i]
        anywhere = rng.uniform(low, high, (300, DOF))
        ends = np.where(rng.random((300, DOF)) < 0.5, low, high)
        arcs = np.where(rng.random((300, DOF)) < 0.2, anywhere, ends)
        points = skeleton(np.concatenate([anywhere, ends, arcs, people.p[i : i + 1]]), np.tile(LENGTHS_M, (901, 1)))
        for k, limb in enumerate(LIMBS):
            solid = ConvexHull(volumes.vertices(i, k))
            reached = np.concatenate([limb_points(point, limb) for point in points])
            outside = reached @ solid.equations[:, :3].T + solid.equations[:, 3]
            assert outside.max() <= 1e-12, (i, limb)


def test_the_older_method_needs_more_room() -> None:
    """Fig. 17."""
    people = random_states(PAPER, 60, 15)
    radii = limb_radii(Prediction())
    paper, positions = (
        np.array(
            [
                [sphere_swept_volume_m3(volumes.vertices(i, k), radii[k]) for k in range(len(LIMBS))]
                for i in range(len(people))
            ]
        )
        for volumes in (predict(people, method=method) for method in PRINTED)
    )
    assert (positions >= paper * (1 - 1e-9)).all()
    assert positions.sum() > 1.3 * paper.sum()


def frozen(**speeds: tuple[float, float]) -> LimitSet:
    """Limits under which only the named joints move."""
    v_min, v_max = np.zeros(DOF), np.zeros(DOF)
    for name, (low, high) in speeds.items():
        v_min[JOINTS.index(name)], v_max[JOINTS.index(name)] = low, high
    return dataclasses.replace(PAPER, v_min=v_min, v_max=v_max)


def standing(**joints: float) -> HumanStates:
    p = np.zeros((1, DOF))
    p[0, [7, 11]], p[0, 12] = np.pi, 1.0
    for name, value in joints.items():
        p[0, JOINTS.index(name)] = value
    return states(p, np.zeros((1, DOF)))


def in_order(points: Floats) -> Floats:
    rounded = points.round(12) + 0.0
    return rounded[np.lexsort(rounded.T)]


def test_a_person_who_cannot_move() -> None:
    volumes = predict(standing(x=1.0, y=2.0), frozen(), "positions")
    shoulder, elbow, wrist = 1.5, 1.5 - 0.33, 1.5 - 0.33 - 0.26
    assert in_order(volumes.vertices(0, LIMBS.index("HD"))).tolist() == [[1, 2, 1.5], [1, 2, 1.71]]
    assert in_order(volumes.vertices(0, LIMBS.index("ULA"))) == pytest.approx(
        np.array([[1, 2.19, elbow], [1, 2.19, shoulder]])
    )
    assert in_order(volumes.vertices(0, LIMBS.index("LLA"))) == pytest.approx(
        np.array([[1, 2.19, wrist], [1, 2.19, elbow]])
    )
    assert in_order(volumes.vertices(0, LIMBS.index("URA")))[0] == pytest.approx([1, 1.81, 1.5 - 0.34])


def test_pure_translation_by_hand() -> None:
    volumes = predict(standing(theta=np.pi / 2), frozen(x=(0.0, 0.8), y=(-0.5, 0.5)), "positions")
    head = volumes.vertices(0, LIMBS.index("HD"))
    expected = [[x, y, z] for z in (1.5, 1.71) for y in (0.0, 0.8 * T) for x in (-0.5 * T, 0.5 * T)]
    assert in_order(head) == pytest.approx(np.array(expected), abs=1e-12)


def test_a_bent_elbow_alone_by_hand() -> None:
    limits = frozen(ar4=(-0.5, 0.0))
    volumes = predict(standing(), limits, "positions")
    lower = in_order(volumes.vertices(0, LIMBS.index("LRA")))
    bend, elbow = 0.5 * T, 1.5 - 0.34
    apex = 0.27 / np.cos(bend / 2)
    expected = [
        [0.27 * np.sin(0), -0.19, elbow - 0.27],
        [apex * np.sin(bend / 2), -0.19, elbow - apex * np.cos(bend / 2)],
        [0.27 * np.sin(bend), -0.19, elbow - 0.27 * np.cos(bend)],
        [0, -0.19, elbow],
    ]
    assert lower == pytest.approx(in_order(np.array(expected)), abs=1e-12)
    assert len(volumes.vertices(0, LIMBS.index("LLA"))) == 2


def test_a_limb_without_a_state_has_one_nan_vertex() -> None:
    p = np.tile(standing().p, (3, 1))
    p[0, JOINTS.index("ar3")] = np.nan
    p[2] = np.nan
    people = states(p, np.zeros((3, DOF)))
    lengths = people.lengths_m.copy()
    lengths[1, 1] = np.nan  # head
    volumes = predict(dataclasses.replace(people, lengths_m=lengths))
    lost = [[limb for k, limb in enumerate(LIMBS) if np.isnan(volumes.vertices(i, k)).all()] for i in range(3)]
    assert lost == [["LRA"], ["HD"], list(LIMBS)]
    assert all(len(volumes.vertices(2, k)) == 1 for k in range(len(LIMBS)))
    assert not np.isnan(volumes.vertices(0, LIMBS.index("URA"))).any()


def test_one_tick_has_the_bits_of_many() -> None:
    people = random_states(PAPER, 50, 16)
    whole = predict(people)
    alone = [predict(people.rows(slice(i, i + 1))) for i in range(len(people))]
    assert np.concatenate([tick.vertices_m for tick in alone]).tobytes() == whole.vertices_m.tobytes()
    assert np.concatenate([np.diff(tick.offsets) for tick in alone]).tolist() == np.diff(whole.offsets).tolist()


def test_table_2_and_the_frame_of_the_record() -> None:
    people = random_states(PAPER, 2, 17)
    volumes = predict(people)
    assert volumes.radius_m.tolist() == [[0.12, 0.15, 0.07, 0.07, 0.07, 0.07]] * 2
    assert (volumes.limbs, volumes.method, len(volumes)) == (LIMBS, "paper", 2)
    assert volumes.t_ns.tolist() == people.t_ns.tolist()
    assert len(predict(people.rows(slice(0, 0)))) == 0


def test_an_unknown_method_is_named() -> None:
    with pytest.raises(SettingsError, match=facts("prediction.method", "'sphere'")):
        predict(standing(), method="sphere")


@pytest.mark.parametrize("method", METHODS)
def test_an_arm_that_nobody_measured_may_be_anywhere_within_its_limits(method: str) -> None:
    """Forward kinematics of random arms at the torso that is known, against the arm's volumes."""
    people = random_states(PAPER, 3, 15)
    unseen = np.zeros((3, len(BODY)))
    arm = [LIMBS.index("URA"), LIMBS.index("LRA")]
    unseen[:, arm] = np.inf
    known = predict(people, method=method)
    volumes = predict(dataclasses.replace(people, unseen_s=unseen), method=method)
    rng = np.random.default_rng(1)
    for i in range(len(people)):
        p = np.tile(people.p[i], (4000, 1))
        p[:, 4:8] = rng.uniform(PAPER.p_min[4:8], PAPER.p_max[4:8], (len(p), 4))
        points = skeleton(clamp(p, PAPER), np.tile(LENGTHS_M, (len(p), 1)))
        for k, limb in enumerate(LIMBS):
            swept = volumes.vertices(i, k)
            if k in arm:
                reached = np.concatenate([limb_points(point, limb) for point in points])
                assert (support(reached) <= support(swept) + 1e-12).all(), limb
            else:
                np.testing.assert_array_equal(swept, known.vertices(i, k))
