"""Departures measured on a made-up recording whose person does what is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.audit.departures import LimbDepartures, _some, departures
from hrcreplay.commands import replay
from hrcreplay.evaluation.recorded_person import CAMERAS, TRUTH
from hrcreplay.evaluation.recording import Recording
from hrcreplay.human.model import LEG_POINTS, PELVIS, Departure, skeleton
from hrcreplay.limits import load_limits
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.records import BODY, DOF, LIMBS, Floats, HumanStates
from hrcreplay.settings.sections import Prediction
from tests.human.people import random_states, states

#: What people do upwards [m/s], how often it is recorded [s], and the residual that they are said to have [m].
UP_M_PER_S, EVERY_S, RESIDUAL_M = 1.6, 0.02, 0.02
#: As far as arms rise with the body in the volumes [m].
ARMS_RISE_M = 0.06


def standing() -> HumanStates:
    """Somebody who stands still by the filter."""
    posture = np.zeros((1, DOF))
    posture[0, [4, 6, 8, 10, 7, 11, 12]] = 0.3, 0.1, 0.3, 0.1, 1.8, 1.8, 0.9
    people = states(posture, np.zeros((1, DOF)))
    return replace(
        people,
        residual_m=np.full((1, len(BODY)), RESIDUAL_M),
        unseen_s=np.zeros((1, len(BODY))),
        points_m=skeleton(posture, people.lengths_m),
    )


def moved(people: HumanStates, by_m_per_s: tuple[float, float, float], source: str = TRUTH) -> LimbDepartures:
    """Of somebody who is recorded to go straight somewhere."""
    after_s = EVERY_S * np.arange(1, 25)
    points = np.repeat(people.points_m, len(after_s), axis=0) + np.multiply.outer(after_s, by_m_per_s)[:, None]
    t_ns = people.t_ns[0] + np.round(after_s * 1e9).astype(np.int64)
    recording = Recording(people, t_ns, points, t_ns, np.repeat(people.p, len(after_s), axis=0), source, {})
    return departures(assembly.prediction_stage(resolve("audit", replay.demo_log())), recording, np.array([0]))


def risen(up_m_per_s: float) -> LimbDepartures:
    return moved(standing(), (0.0, 0.0, up_m_per_s))


def gone_m(of: LimbDepartures) -> Floats:
    """(h,) how far until each horizon, by what was recorded until then."""
    return np.asarray(UP_M_PER_S * EVERY_S * np.floor(of.horizon_s / EVERY_S + 1e-9))


def lines(of: LimbDepartures, rise_m: Floats) -> Departure:
    """Nothing but that rise."""
    nothing = np.zeros((len(BODY), len(of.horizon_s)))
    return Departure(of.horizon_s, nothing, nothing, rise_m, 0.0 * rise_m)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_body_that_rises_departs_by_what_the_rise_does_not_hold(sign: float) -> None:
    of = risen(sign * UP_M_PER_S)
    far = gone_m(of)
    ways = np.stack([far, 0.0 * far][:: int(sign)])
    np.testing.assert_allclose(of.height_m[..., 0], ways, atol=1e-9)
    for k, moved in enumerate(far):
        found = of.beyond_m(k, 0.0, 0.0)[0, : len(LIMBS)]
        np.testing.assert_allclose(found[[0, 1, 2, 4]], moved, atol=1e-6)
        assert (0.9 * moved <= found).all()  # a forearm leaves by its wrist, which the hand's tube holds a little
        assert (found <= moved + 1e-6).all()
        held = (moved, 0.0) if sign > 0.0 else (0.0, moved)
        left = of.beyond_m(k, *held)[0, : len(LIMBS)]
        np.testing.assert_allclose(left[:2], 0.0, atol=1e-6)
        np.testing.assert_allclose(left[[2, 4]], max(0.0, moved - ARMS_RISE_M), atol=1e-6)
        assert (left[[3, 5]] <= max(0.0, moved - ARMS_RISE_M) + 1e-6).all()
        assert np.isnan(of.beyond_m(k, 0.0, 0.0)[0, BODY.index("LEGS")])  # no camera has shown them


def test_who_rises_by_more_than_the_rise_and_the_residual_is_outside() -> None:
    of = risen(UP_M_PER_S)
    far = gone_m(of)
    assert far[0] < ARMS_RISE_M < far[-1]
    for more_m, inside in ((0.9 * RESIDUAL_M, True), (1.1 * RESIDUAL_M, False)):
        for k, moved in enumerate(far):
            rising = lines(of, np.maximum(far - more_m, 0.0))
            assert (of.factors(rising, k)[0, :2] <= 1.0).tolist() == [inside, inside]
            assert of.inside(rising, k).tolist() == [inside and moved < ARMS_RISE_M + RESIDUAL_M]


def test_a_limb_seen_longer_ago_is_not_measured_and_the_truth_is_known_as_such() -> None:
    unseen = replace(standing(), unseen_s=np.full((1, len(BODY)), 0.3))
    of = moved(unseen, (0.0, 0.0, UP_M_PER_S), CAMERAS)
    assert np.isnan(of.height_m).all()
    assert all(np.isnan(of.beyond_m(k, 0.0, 0.0)).all() for k in range(len(of.horizon_s)))
    assert np.isnan(of.inside(lines(of, np.zeros(len(of.horizon_s))), 0)).all()
    assert not of.true
    assert risen(UP_M_PER_S).true


def test_legs_of_somebody_new_depart_from_where_they_may_be() -> None:
    """Both step to the left, where nothing but the unknown distance from the model holds the legs of somebody new."""
    points_m = standing().points_m.copy()
    points_m[:, list(LEG_POINTS)] = points_m[:, [PELVIS]] * [1.0, 1.0, 0.5]
    known = replace(standing(), points_m=points_m)
    new = replace(known, residual_m=np.full((1, len(BODY)), np.nan))
    unknown_m = Prediction().residual_unknown_m
    for people, held_m in ((known, 0.0), (new, unknown_m)):
        of = moved(people, (0.0, UP_M_PER_S, 0.0))
        far = gone_m(of)
        assert far[0] < unknown_m < far[-1]
        for k, left_m in enumerate(far):
            found = of.beyond_m(k, 0.0, 0.0)[0, BODY.index("LEGS")]
            assert found == pytest.approx(max(0.0, left_m - held_m), abs=1e-6)


def test_volumes_are_those_of_evenly_spread_ticks() -> None:
    """The first tick, at which cameras have shown the person once, counts as any other."""
    every = random_states(load_limits("people"), 1000, 1)
    np.testing.assert_array_equal(_some(every).p, every.p[5::10])
    assert len(_some(every.rows(slice(0, 7)))) == 7
    assert len(_some(every.rows(slice(0, 0)))) == 0
