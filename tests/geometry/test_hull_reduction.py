from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from hrcreplay.geometry.hull_reduction import keep_corners, surface
from hrcreplay.records import Floats
from tests.human.people import directions

WORK = surface()
ALONG = directions(3000, 0)
NUMBER = st.floats(-3, 3) | st.integers(-2, 2).map(float) | st.sampled_from([1e-12, 1e-9, 1 / 3, 1.0 + 1e-13])


def kept(points: Floats) -> Floats:
    room = points.copy()
    count, _ = keep_corners(room, len(room), WORK)
    return room[:count]


def deepest_loss(points: Floats, some: Floats) -> float:
    """Largest loss of a support function, beyond the rounding of the products here [m]."""
    loss = float(((points @ ALONG.T).max(axis=0) - (some @ ALONG.T).max(axis=0)).max())
    return max(0.0, loss - 1e-15 * float(np.abs(points).max()))


def clouds() -> dict[str, Floats]:
    rng = np.random.default_rng(4)
    ball = rng.normal(size=(300, 3))
    sphere = ball / np.linalg.norm(ball, axis=1)[:, None]
    grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 3)
    box = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], dtype=float)
    return {
        "ball": ball,
        "sphere": sphere,
        "crowded sphere": np.concatenate([sphere * (1 + 1e-13 * k) for k in range(3)]),
        "far away": ball + np.array([1e3, -1e3, 0]),
        "grid": grid,
        "grid, one plane": grid[grid[:, 2] == 0],
        "grid, one line": grid[(grid[:, 2] == 0) & (grid[:, 1] == 0)],
        "one point often": np.tile(box[5], (30, 1)),
        "box, rotated, with its edges' middles": np.concatenate([box, (box[:, None] + box[None]).reshape(-1, 3) / 2])
        @ np.linalg.qr(rng.normal(size=(3, 3)))[0],
        "wafer": ball * [1, 1, 1e-8],
        "thin wafer": ball * [1, 1, 1e-13],
        "needle": ball * [1, 1e-9, 1e-9],
        "tiny": ball * 1e-9,
        "two clusters": np.concatenate([box, box * 1e-8 + 2.0]),
        "three points": box[:3],
    }


@pytest.mark.parametrize("name", clouds())
def test_no_corner_is_lost(name: str) -> None:
    points = clouds()[name]
    some = kept(points)
    assert deepest_loss(points, some) == 0.0
    assert len(np.unique(some, axis=0)) == len(some)
    rows = {row.tobytes() for row in points}
    assert all(row.tobytes() in rows for row in some)


@pytest.mark.parametrize("name", ["ball", "sphere", "grid", "box, rotated, with its edges' middles", "far away"])
def test_little_else_is_kept(name: str) -> None:
    points = clouds()[name]
    corners = {row.tobytes() for row in points[ConvexHull(points).vertices]}
    some = {row.tobytes() for row in kept(points)}
    assert corners <= some or name == "box, rotated, with its edges' middles"
    surfaced = 6**3 - 4**3 if name == "grid" else len(corners) + 26  # a point on a face cannot be proven inside
    assert len(some) <= surfaced


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(NUMBER, NUMBER, NUMBER), min_size=1, max_size=40))
def test_no_corner_of_anything_is_lost(rows: list[tuple[float, float, float]]) -> None:
    points = np.array(rows)
    assert deepest_loss(points, kept(points)) == 0.0


def test_more_corners_than_room_stay() -> None:
    rng = np.random.default_rng(5)
    ball = rng.normal(size=(1500, 3))
    sphere = ball / np.linalg.norm(ball, axis=1)[:, None]
    assert len(kept(sphere)) == 1500
    assert len(kept(np.concatenate([sphere, 0.3 * sphere]))) == 1500
