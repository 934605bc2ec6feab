"""Volumes of a body by its points alone, against points that move as fast as people do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.geometry.inflated_hull import InflatedHull
from hrcreplay.human.prediction.shown_points import SPEED_M_PER_S
from hrcreplay.human.prediction.swept_volumes import predict
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
    way *= SPEED_M_PER_S * span_s / np.linalg.norm(way, axis=2, keepdims=True)
    moved = points + way
    radii = {"HD": settings.radius_head_m, "THX": settings.radius_thorax_m}
    for limb, of in (("HD", ("neck", "head")), ("THX", ("pelvis", "chest")), ("LLA", ("elbow_l", "wrist_l"))):
        solid = InflatedHull.around(*found[limb])
        for name in of:
            off = solid.distances_m(moved[:, POINTS.index(name)])
            assert off.max() + radii.get(limb, settings.radius_lower_arm_m) <= solid.radius_m + 1e-9
            assert off.max() > SPEED_M_PER_S * span_s - 0.5  # the check would see a volume that is far too large


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
