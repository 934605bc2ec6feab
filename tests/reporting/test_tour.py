"""The moment that a page opens with, and the tour of the worst moments."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from hrcreplay.reporting.replay_scene import MethodTrack, ReplayScene
from hrcreplay.reporting.tour import STOPS, TOUR_S, telling_moment, tour
from tests.reporting.moving import moving_run, moving_scene

SCENE = moving_scene(moving_run(30.0))


def changed(scene: ReplayScene, **tracks: MethodTrack) -> ReplayScene:
    return dataclasses.replace(scene, methods={**scene.methods, **tracks})


def without_touch(track: MethodTrack) -> MethodTrack:
    events = tuple(event for event in track.events if event.kind != "touch")
    return dataclasses.replace(track, events=events, body_m=np.abs(track.body_m))


def test_it_opens_with_the_deepest_contact_of_a_robot_without_care() -> None:
    """The made-up scaling touches from 3.0 to 3.5 s, deeper and deeper; here it goes by the name none."""
    scene = dataclasses.replace(SCENE, methods={"qp": SCENE.methods["qp"], "none": SCENE.methods["scaling"]})
    row, beside = telling_moment(scene)
    assert beside == "none"
    assert scene.methods["none"].body_m[row] == np.nanmin(scene.methods["none"].body_m) < 0.0
    assert 3.0 <= scene.seconds[row] < 3.5


def test_a_contact_of_the_runs_own_method_comes_first() -> None:
    own = dataclasses.replace(SCENE.methods["scaling"])
    scene = dataclasses.replace(SCENE, methods={"qp": own, "none": without_touch(SCENE.methods["qp"])})
    row, beside = telling_moment(scene)
    assert own.body_m[row] == np.nanmin(own.body_m)
    assert beside == "none"


def test_without_a_contact_it_opens_where_the_robot_is_nearest() -> None:
    track = without_touch(SCENE.methods["qp"])
    body_m = 0.4 + 0.3 * np.cos(0.4 * SCENE.seconds)
    scene = changed(SCENE, qp=dataclasses.replace(track, body_m=body_m))
    row, beside = telling_moment(scene)
    assert row == int(np.argmin(body_m))
    assert beside == "scaling"  # the only other one
    unknown = np.full(len(body_m), np.nan)
    nobody = dataclasses.replace(track, body_m=unknown, distance_m=unknown)
    assert telling_moment(dataclasses.replace(SCENE, methods={"qp": nobody})) == (0, None)


def test_a_tour_lasts_ten_seconds_and_goes_forward() -> None:
    stops = tour(SCENE)
    assert 2 <= len(stops) <= STOPS
    assert sum(stop.until_s - stop.from_s for stop in stops) == pytest.approx(TOUR_S, abs=0.05)
    for stop in stops:
        assert stop.from_s <= stop.at_s < stop.until_s
    assert all(one.until_s <= after.from_s + 1e-9 for one, after in itertools.pairwise(stops))
    contact = next(stop for stop in stops if "contact" in stop.words)
    assert contact.words == "scaling: contact of tool and right lower arm"
    assert contact.beside == "scaling"
    assert 3.0 <= contact.at_s < 3.5


def test_the_tour_of_a_short_replay_is_all_of_it() -> None:
    scene = moving_scene(moving_run(4.0))
    assert sum(stop.until_s - stop.from_s for stop in tour(scene)) <= float(scene.seconds[-1]) + 1e-9
