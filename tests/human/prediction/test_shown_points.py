"""Volumes of a body by its points alone, against points that move as fast as people do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.geometry.inflated_hull import InflatedHull, union_volume_m3
from hrcreplay.human.prediction.swept_volumes import predict
from hrcreplay.human.prediction.velocity_tube import HAND_M_PER_S
from hrcreplay.limits import load_limits
from hrcreplay.records import LIMBS, POINTS, Floats, HumanStates, SweptVolumes
from hrcreplay.settings.sections import Prediction
from tests.human.people import states

HORIZON_S = 0.2


def seen(points_m: Floats, age_s: float = 0.05) -> HumanStates:
    """A known person, and a body that has only these points."""
    both = states(np.tile([1.0, 0, 0, 0, 0.2, 0.5, 0, 2, 0.2, 0.5, 0, 2, 0.9], (2, 1)), np.zeros((2, 13)))
    p, shown, age = both.p.copy(), both.points_m.copy(), both.frame_age_s.copy()
    p[1], shown[1], age[1] = np.nan, points_m, age_s
    return replace(both, t_ns=both.t_ns[[0, 0]], p=p, points_m=shown, frame_age_s=age, person=np.array([1, 2]))


def volumes(people: HumanStates, settings: Prediction) -> SweptVolumes:
    return predict(people, load_limits("people"), settings, horizon_s=HORIZON_S, memory_s=0.5)


@pytest.mark.parametrize("method", ["sound", "paper"])
def test_points_that_move_as_fast_as_people_stay_inside(method: str) -> None:
    settings = Prediction(method=method, latency_s=0.03)
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.4, 0.4, (20, 3)) + np.array([2.0, 1.0, 1.1])
    found = volumes(seen(points), settings).at(1)
    assert all(volume.known for volume in found.values())
    span_s = 0.05 + HORIZON_S + 0.03
    way = rng.normal(size=(500, 20, 3))
    way *= HAND_M_PER_S * span_s / np.linalg.norm(way, axis=2, keepdims=True)
    moved = points + way
    radii = {"HD": settings.radius_head_m, "THX": settings.radius_thorax_m}
    for limb, of in (("HD", ("neck", "head")), ("THX", ("pelvis", "chest")), ("LLA", ("elbow_l", "wrist_l"))):
        solid = InflatedHull.around(*found[limb])
        for name in of:
            off = solid.distances_m(moved[:, POINTS.index(name)])
            assert off.max() + radii.get(limb, settings.radius_lower_arm_m) <= solid.radius_m + 1e-9
            assert off.max() > HAND_M_PER_S * span_s - 0.5  # the check would see a volume that is far too large


def test_a_limb_without_points_gets_those_of_the_body_and_the_known_person_stays_as_it_was() -> None:
    points = np.full((20, 3), np.nan)
    points[POINTS.index("pelvis")], points[POINTS.index("neck")] = (2.0, 1.0, 1.0), (2.0, 1.0, 1.5)
    people, settings = seen(points), Prediction()
    found = volumes(people, settings)
    alone = predict(people.of_person(1), load_limits("people"), settings, horizon_s=HORIZON_S, memory_s=0.5)
    assert found.vertices_m[: found.offsets[len(found.limbs)]].tobytes() == alone.vertices_m.tobytes()
    assert found.radius_m[0].tobytes() == alone.radius_m[0].tobytes()
    body = found.at(1)
    assert {tuple(v) for v in body["LLA"].vertices_m} == {(2.0, 1.0, 1.0), (2.0, 1.0, 1.5)}
    assert body["LEGS"].vertices_m[:, 2].min() == 0.0  # down to the floor
    assert set(body) == {*LIMBS, "LEGS"}


def test_a_body_without_any_point_stays_unknown() -> None:
    assert not any(volume.known for volume in volumes(seen(np.full((20, 3), np.nan)), Prediction()).at(1).values())


#: Bones by their ends and length [m]: those of ``tests.human.people`` and of legs.
BONES = {
    ("pelvis", "neck"): 0.5,
    ("neck", "head"): 0.21,
    ("neck", "shoulder_r"): 0.19,
    ("neck", "shoulder_l"): 0.19,
    ("shoulder_l", "elbow_l"): 0.33,
    ("shoulder_r", "elbow_r"): 0.34,
    ("elbow_l", "wrist_l"): 0.26,
    ("elbow_r", "wrist_r"): 0.27,
    ("pelvis", "hip_l"): 0.235,
    ("hip_l", "knee_l"): 0.47,
}
#: What must stay inside of each limb, and its thickness [m].
INSIDE = {
    "HD": (("neck", "head"), 0.12),
    "THX": (("pelvis", "shoulder_r", "shoulder_l"), 0.15),
    "URA": (("shoulder_r", "elbow_r"), 0.07),
    "LLA": (("elbow_l", "wrist_l"), 0.07),
    "LEGS": (("pelvis",), 0.08),
}


def behind_a_table(shown: tuple[str, ...], seed: int = 1) -> HumanStates:
    """People whose torsos went out of sight 0.6 s ago, while one of two cameras shows some points of theirs."""
    rng = np.random.default_rng(seed)
    p = np.tile([1.0, 0, 0, 0, 0.2, 0.5, 0, 2, 0.2, 0.5, 0, 2, 0.9], (4, 1))
    p[:, 4:12] += rng.uniform(-0.3, 0.3, (4, 8))
    of = states(p, np.zeros((4, 13)))
    camera = np.full((4, 2, len(POINTS), 3), np.nan)
    rows = [POINTS.index(name) for name in shown]
    there = np.where(np.isfinite(of.points_m), of.points_m, [1.1, 0.1, 0.5])
    camera[:, 1, rows] = there[:, rows]
    unseen = of.unseen_s.copy()
    unseen[:, LIMBS.index("THX")] = 0.6
    return replace(of, camera_points_m=camera, unseen_s=unseen, p_std=np.full_like(p, 0.05))


def along(start: str, longer_m: float) -> dict[str, float]:
    """Shortest way from a point to every other one along the bones, and from the pelvis straight to the shoulders [m].

    The bones of the model are that much longer.
    """
    ways = {ends: long + (0.0 if {"hip_l", "knee_l"} & set(ends) else longer_m) for ends, long in BONES.items()} | {
        ("pelvis", f"shoulder_{side}"): float(np.hypot(0.5 + longer_m, 0.19 + longer_m)) for side in "rl"
    }
    found = dict.fromkeys({name for ends in BONES for name in ends}, np.inf) | {start: 0.0}
    for _ in found:
        for (a, b), long in ways.items():
            found[a], found[b] = min(found[a], found[b] + long), min(found[b], found[a] + long)
    return found


@pytest.mark.parametrize(
    "shown", [("elbow_r", "wrist_r", "elbow_l", "wrist_l"), ("wrist_l",), ("head", "knee_l"), ("shoulder_r", "neck")]
)
@pytest.mark.parametrize("std_m", [0.0, 0.03])
def test_the_rest_of_somebody_is_no_further_than_the_bones_from_what_is_seen(
    shown: tuple[str, ...], std_m: float
) -> None:
    """Places that every seen point allows, as it moved at walking speed since: all in the volumes.

    The bones may be longer by two standard deviations.
    """
    of, settings, rng = behind_a_table(shown), Prediction(), np.random.default_rng(2)
    of = replace(of, lengths_std_m=np.full_like(of.lengths_m, std_m))
    found = predict(of, load_limits("people"), settings, horizon_s=HORIZON_S, memory_s=0.5)
    plain = replace(of, camera_points_m=None)
    joints = predict(plain, load_limits("people"), settings, horizon_s=HORIZON_S, memory_s=0.5)
    bounded, cameras = 0, of.camera_points_m
    assert cameras is not None
    for tick in range(len(of)):
        for limb, (names, thick_m) in INSIDE.items():
            solid = InflatedHull.around(*found.at(tick)[limb])
            of_joints = InflatedHull.around(*joints.at(tick)[limb])
            if np.array_equal(solid.vertices_m, of_joints.vertices_m):
                continue
            bounded += 1
            for name in names:
                reach = {s: along(s, 2.0 * std_m)[name] + 1.6 * (HORIZON_S + settings.latency_s) for s in shown}
                nearest = min(reach, key=lambda s: reach[s])
                seen_m = {s: cameras[tick, 1, POINTS.index(s)] for s in shown}
                way = rng.normal(size=(4000, 3))
                way *= reach[nearest] * rng.random((4000, 1)) ** 0.1 / np.linalg.norm(way, axis=1, keepdims=True)
                places = seen_m[nearest] + way
                for s in shown:
                    places = places[np.linalg.norm(places - seen_m[s], axis=1) <= reach[s]]
                places = places[of_joints.distances_m(places) <= of_joints.radius_m - thick_m]
                assert solid.distances_m(places).max(initial=0.0) + thick_m <= solid.radius_m + 1e-9, (limb, name)
    assert bounded >= 4  # not the volumes of the joints alone


def test_somebody_whose_arms_alone_are_seen_is_much_smaller_than_joints_alone_say() -> None:
    """Whose trunk is out of sight for longer than the filter continues: anywhere within the limits of the joints."""
    hidden, sizes = behind_a_table(("elbow_r", "wrist_r", "elbow_l", "wrist_l")), []
    for of in (hidden, replace(hidden, camera_points_m=None)):
        found = predict(of, load_limits("people"), Prediction(), horizon_s=0.377, memory_s=0.5)
        solids = [{limb: InflatedHull.around(*part) for limb, part in found.at(t).items()} for t in range(len(of))]
        heads = [union_volume_m3([one["HD"]], 2048)[0] for one in solids]
        sizes.append((np.mean([union_volume_m3([*one.values()], 2048)[0] for one in solids]), np.mean(heads)))
    (whole, head), (joints, heads_of_joints) = sizes
    assert whole < joints / 3.0
    assert head < heads_of_joints / 7.0
