"""Hidden floor against rays that are cut into small steps."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from hrcreplay.calibration.hidden_areas import (
    CROUCHED_M,
    HEIGHTS_M,
    STEP_M,
    CameraView,
    HiddenFloor,
    hidden_floor,
    hidden_notes,
)
from hrcreplay.records import Floats
from tests.facts import tells

BASE_M = np.array([0.3, -0.2, 0.6])
#: A camera at 2 m before the robot that looks along the world's x axis, and one with a narrow view from above.
EYE = np.array([[0.0, 0.0, 1.0, -2.0], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
ABOVE = np.array([[1.0, 0.0, 0.0, 0.8], [0.0, -1.0, 0.0, 0.5], [0.0, 0.0, -1.0, 4.0], [0.0, 0.0, 0.0, 1.0]])


def crate(middle_m: tuple[float, float, float], half_m: float) -> tuple[Floats, float]:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.array(middle_m) + half_m * signs, 0.0


def sees(view: CameraView, place: Floats, solids: list[tuple[Delaunay | Floats, float]]) -> bool:
    local = np.linalg.inv(view.T_world_camera) @ [*place, 1.0]
    angles = np.arctan2(np.abs(local[:2]), local[2])
    if not (0.0 < local[2] <= view.range_m and (angles <= view.half_view_rad).all()):
        return False
    ray = view.T_world_camera[:3, 3] + np.linspace(0.0, 1.0, 2000)[:, None] * (place - view.T_world_camera[:3, 3])
    for solid, radius in solids:
        blocked = (
            solid.find_simplex(ray) >= 0
            if isinstance(solid, Delaunay)
            else np.linalg.norm(ray - solid, axis=1) <= radius
        )
        if blocked.any():
            return False
    return True


def test_what_is_seen_is_what_rays_reach() -> None:
    views = [CameraView(EYE, (0.6, 0.5), 3.5), CameraView(ABOVE, (0.15, 0.2), 10.0)]
    hulls = [crate((0.2, 0.3, 0.5), 0.5), (np.array([[0.0, -0.6, 1.0]]), 0.3)]
    found = hidden_floor(views, hulls, BASE_M)
    solids: list[tuple[Delaunay | Floats, float]] = [(Delaunay(hulls[0][0]), 0.0), (hulls[1][0][0], 0.3)]
    rng = np.random.default_rng(0)
    rows = rng.choice(len(found.points_m), 150, replace=False)
    wrong = 0
    for row in rows.tolist():
        for k, height in enumerate(HEIGHTS_M.tolist()):
            place = np.array([*found.points_m[row], height])
            wrong += bool(found.seen[row, k]) != any(sees(view, place, solids) for view in views)
    assert wrong <= 2, "but for rays that graze an edge"
    assert found.seen.any()
    assert not found.seen.all()
    inside = (np.abs(found.points_m - [0.2, 0.3]) < 0.49).all(axis=1)
    assert not inside.any(), "nobody stands in the crate"


def test_areas_and_the_nearest_place_are_told() -> None:
    points = np.array([[1.0, 0.0], [1.5, 0.0], [0.0, 2.0]])
    seen = np.ones((3, len(HEIGHTS_M)), dtype=bool)
    seen[0, HEIGHTS_M <= CROUCHED_M + 1e-9] = False
    seen[1] = False
    found = HiddenFloor(points, seen)
    assert found.area_m2(1.8) == STEP_M**2
    assert found.area_m2(CROUCHED_M) == 2 * STEP_M**2
    notes = hidden_notes(found, np.zeros(3))
    assert tells(notes[0], "stands", "(1.5, 0.0)")
    assert tells(notes[1], "crouches", "(1.0, 0.0)")
    seen[:] = True
    assert hidden_notes(found, np.zeros(3)) == []
