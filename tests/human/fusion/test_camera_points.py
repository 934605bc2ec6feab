"""Two cameras that disagree about a limb, each steadily: both are in the volumes, and a broken leg is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.geometry.inflated_hull import InflatedHull
from hrcreplay.human.fusion.fuse import fuse, start
from hrcreplay.human.prediction.swept_volumes import predict
from hrcreplay.limits import load_limits
from hrcreplay.records import POINTS, Measurements
from hrcreplay.settings.sections import Fusion, Prediction
from tests.human import rising
from tests.human.filtered import WIDE, fused, ticks
from tests.human.sightings import CAMERAS

END_S = 1.9  #: standing still at the end of a squat's way down is later


def apart(names: tuple[str, ...], by_m: tuple[float, float, float], camera: int = 1) -> Measurements:
    """Somebody who stands, and of whom one camera shows some points elsewhere."""
    found, _ = rising.seen(1.0, "chair", 3)
    found = found.rows(found.arrival_ns <= round(END_S * 1e9))
    points = found.points_m.copy()
    rows = np.flatnonzero(found.camera == camera)
    points[rows[:, None], [POINTS.index(name) for name in names]] += np.array(by_m)
    return replace(found, points_m=points)


LEG = ("knee_l", "ankle_l", "foot_l")


@pytest.mark.parametrize(("limb", "names"), [("LEGS", LEG), ("LLA", ("wrist_l", "hand_l")), ("HD", ("head",))])
def test_what_any_camera_shows_is_in_the_volume(limb: str, names: tuple[str, ...]) -> None:
    by_m = (0.0, 0.35, 0.0) if limb == "LEGS" else (0.0, 0.15, 0.0)
    seen = apart(names, by_m)
    states = fused(seen, ticks(END_S), Fusion())
    for tick in (350, 400, 449):
        volume = InflatedHull.around(
            *predict(
                states.rows(slice(tick, tick + 1)), load_limits("people"), Prediction(), horizon_s=0.02, memory_s=0.5
            ).at(0)[limb]
        )
        thick = {"LEGS": 0.08, "LLA": 0.07, "HD": 0.12}[limb]
        late = seen.arrival_ns <= states.t_ns[tick]
        for camera in range(2):
            newest = np.flatnonzero(late & (seen.camera == camera))[-1]
            shown = seen.points_m[newest, [POINTS.index(name) for name in names if name != "hand_l"]]
            assert volume.distances_m(shown).max() + thick <= volume.radius_m


def test_each_cameras_points_are_beside_the_fused_ones_and_are_forgotten_after_a_fifth_of_a_second() -> None:
    knee, hip = POINTS.index("knee_l"), POINTS.index("hip_l")
    seen = apart(LEG, (0.0, 0.35, 0.0))
    gone_ns = 1_200_000_000
    seen = seen.rows((seen.camera == 0) | (seen.capture_ns < gone_ns))
    states = fused(seen, ticks(END_S), Fusion())
    assert states.camera_points_m is not None
    true = rising.body(np.array([1.0]), 1.0, "chair")[0]
    at = int(np.searchsorted(states.t_ns, gone_ns))
    off = np.linalg.norm(states.camera_points_m[at, :, knee] - states.points_m[at, knee], axis=1)
    places = {tuple(np.round(states.points_m[at, knee] - true[knee], 1) + 0.0)}
    for camera in np.flatnonzero(np.isfinite(off)):
        assert off[camera] == pytest.approx(0.35, abs=0.05)
        places.add(tuple(np.round(states.camera_points_m[at, camera, knee] - true[knee], 1) + 0.0))
    assert len(places) == 2
    later = np.searchsorted(states.t_ns, gone_ns + 260_000_000)
    assert np.isnan(states.camera_points_m[later:, 1]).all()
    np.testing.assert_allclose(states.points_m[later, knee], true[knee], atol=0.03)
    assert np.isnan(states.camera_points_m[at, :, hip]).all()  # both show the hip alike


def test_a_leg_that_falls_apart_before_it_is_lost_is_not_believed_and_told() -> None:
    """Within a tenth of a second a shank is twice as long: the knee stays, ankle and foot are left out."""
    whole, _ = rising.seen(1.0, "chair", 3)
    broken_ns, ankle = 1_500_000_000, POINTS.index("ankle_l")
    seen = whole.rows(whole.arrival_ns <= broken_ns + 100_000_000)
    points = seen.points_m.copy()
    late = np.flatnonzero((seen.capture_ns >= broken_ns) & (seen.camera == 1))
    points[late[:, None], [ankle, POINTS.index("foot_l")]] += [0.0, 0.6, 0.0]
    t_ns = ticks(1.6)
    _, told, counts, _ = fuse(start(CAMERAS), t_ns, replace(seen, points_m=points), Fusion(), WIDE)
    _, plain, none, _ = fuse(start(CAMERAS), t_ns, seen, Fusion(), WIDE)
    name = f"outlier_points_{CAMERAS[1]}"
    arrived = int((seen.arrival_ns[late] <= t_ns[-1]).sum())
    assert counts[name] >= 2 * arrived > 2 * none[name]
    assert told.camera_points_m is not None
    shown = np.concatenate([told.points_m[:, None], told.camera_points_m], axis=1)[:, :, ankle]
    true = plain.points_m[350, ankle]
    assert np.nanmax(np.linalg.norm(shown[350:] - true, axis=2)) < 0.1


def test_a_new_length_that_stays_is_another_opinion_of_the_leg() -> None:
    """The volumes hold it from a fifth of a second on; until then it is left out."""
    whole, _ = rising.seen(1.0, "chair", 3)
    changed_ns, ankle = 1_400_000_000, POINTS.index("ankle_l")  # the old length is known by then
    seen = whole.rows(whole.arrival_ns <= round(END_S * 1e9))
    points = seen.points_m.copy()
    late = np.flatnonzero((seen.capture_ns >= changed_ns) & (seen.camera == 1))
    by_m = [0.0, 0.0, 0.3]  # a shank of half the length, within reach of the pelvis
    points[late[:, None], [ankle, POINTS.index("foot_l")]] += by_m
    states = fused(replace(seen, points_m=points), ticks(END_S), Fusion())
    assert states.camera_points_m is not None
    shown = np.concatenate([states.points_m[:, None], states.camera_points_m], axis=1)[:, :, ankle]
    there = seen.points_m[late[-1], ankle] + by_m
    nearest = np.nanmin(np.linalg.norm(shown[300:] - there, axis=2), axis=1)
    assert nearest[:95].min() > 0.2
    assert nearest[130:].max() < 0.1
