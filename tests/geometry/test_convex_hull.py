from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from hrcreplay.geometry.convex_hull import above, hull, sphere_swept_volume_m3
from hrcreplay.limits import load_limits
from hrcreplay.records import Floats, Ints
from tests.human.people import random_states
from tests.human.predictions import predict

BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], dtype=float)
TRIANGLE = np.array([[0, 0, 0], [3, 0, 0], [0, 4, 0]], dtype=float)
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
INNER = 0.5 * SQUARE + np.array([0.25, 0.25, 0.0])
R = 0.3
BALL = 4 / 3 * np.pi * R**3
TILTED = Rotation.from_rotvec([0.3, -1.1, 0.7])


def tilted(points: Floats) -> Floats:
    placed: Floats = TILTED.apply(points) + np.array([5.0, -2.0, 1.0])
    return placed


@pytest.mark.parametrize(
    ("points", "volume"),
    [
        (BOX, 6 + 22 * R + 6 * np.pi * R**2 + BALL),
        (BOX[[0, 7]], np.pi * np.sqrt(14) * R**2 + BALL),
        (np.linspace(BOX[0], BOX[7], 5), np.pi * np.sqrt(14) * R**2 + BALL),
        (TRIANGLE, 12 * R + 0.5 * np.pi * 12 * R**2 + BALL),
        (SQUARE, 2 * R + 0.5 * np.pi * 4 * R**2 + BALL),
        (BOX[:1], BALL),
        (np.tile(BOX[3], (4, 1)), BALL),
    ],
    ids=["box", "segment", "collinear", "triangle", "square", "point", "one point many times"],
)
def test_closed_forms(points: Floats, volume: float) -> None:
    for place in (points, tilted(points)):
        assert sphere_swept_volume_m3(place, R) == pytest.approx(volume, rel=1e-9)
        assert sphere_swept_volume_m3(*_with_radius(place)) == pytest.approx(volume, rel=1e-9)


#: What has no body or no face, beside solids, with volume, area and mean width's integral of Steiner's formula.
SHAPES = {
    "point": (BOX[:1], 0.0, 0.0, 0.0),
    "point many times": (np.tile(BOX[3], (40, 1)), 0.0, 0.0, 0.0),
    "segment": (BOX[[0, 7]], 0.0, 0.0, np.pi * np.sqrt(14)),
    "line": (np.linspace(BOX[0], BOX[7], 40), 0.0, 0.0, np.pi * np.sqrt(14)),
    "triangle": (TRIANGLE, 0.0, 12.0, 0.5 * np.pi * 12),
    "square": (SQUARE, 0.0, 2.0, 0.5 * np.pi * 4),
    "square with points inside": (np.concatenate([SQUARE, INNER]), 0.0, 2.0, 0.5 * np.pi * 4),
    "box": (BOX, 6.0, 22.0, 6 * np.pi),
}
#: Places and how exact coordinates are there; the last two are the numbers that trackers write for what they lost.
PLACES_M = (0.0, -3.0, 1e3, 1e6, 1e9)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("place_m", PLACES_M)
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
def test_every_shape_anywhere_has_its_closed_form(shape: str, place_m: float, scale: float) -> None:
    """Neither flat nor far nor small sets raise; they are as exact as their coordinates."""
    points, volume, area, bend = SHAPES[shape]
    r = R * scale
    exact = volume * scale**3 + area * scale**2 * r + bend * scale * r**2 + 4 / 3 * np.pi * r**3
    coarse = 1e-9 + 20.0 * float(np.spacing(abs(place_m) + 5.0 * scale)) / scale
    for place in (scale * points, scale * TILTED.apply(points)):
        found = sphere_swept_volume_m3(place + place_m, r)
        if coarse < 0.01:  # else the coordinates no longer tell the shape
            assert found == pytest.approx(exact, rel=20.0 * coarse)
        assert 0.9 * 4 / 3 * np.pi * r**3 < found < np.inf


@pytest.mark.parametrize("far_m", [1e9, 3e38])
def test_a_hull_with_one_corner_far_away_is_still_one(far_m: float) -> None:
    """Of who has one point at 1e9: a cone with its tip out there."""
    points = np.concatenate([BOX, [[far_m, 0.0, 0.0]]])
    vertices, faces = hull(points)
    assert np.isin([0.0, far_m], vertices[:, 0]).all()
    assert np.isfinite(sphere_swept_volume_m3(points, R))
    assert faces.max(initial=0) < len(vertices)


@pytest.mark.parametrize("thin_m", [0.0, 1e-17, 1e-15, 1e-14, 1e-12, 2e-9, 1e-6])
@pytest.mark.parametrize("far_m", [1.0, 1e5, 1e9])
def test_thin_sets_do_not_raise(thin_m: float, far_m: float) -> None:
    rng = np.random.default_rng(4)
    for thickness in ([1.0, 1.0, thin_m], [1.0, thin_m, thin_m], [thin_m] * 3):
        for across in (1.0, 1e3):
            cloud = across * rng.uniform(-1.0, 1.0, (30, 3)) * thickness
            for points in (cloud, TILTED.apply(cloud) + far_m):
                vertices, faces = hull(points)
                assert 1 <= len(vertices) <= len(points)
                volume = sphere_swept_volume_m3(points, R, None)
                assert volume >= (1.0 - 1e-9) * BALL
                edges = [(int(face[k]), int(face[(k + 1) % 3])) for face in faces for k in range(3)]
                assert {(j, i) for i, j in edges} == set(edges)


def test_what_qhull_calls_flat_is_flat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where Qhull finds a set thinner than we do, the thinnest direction goes."""

    class Solids(ConvexHull):
        def __init__(self, points: Floats) -> None:
            if points.shape[1] == 3:
                raise QhullError("QH6154")
            super().__init__(points)

    monkeypatch.setattr("hrcreplay.geometry.convex_hull.ConvexHull", Solids)
    vertices, faces = hull(np.concatenate([SQUARE, SQUARE + np.array([0.0, 0.0, 1e-8])]))
    assert len(vertices) == 4
    assert len(faces) == 4


def _with_radius(points: Floats) -> tuple[Floats, float, Ints]:
    vertices, faces = hull(points)
    return vertices, R, faces


def test_against_throwing_darts() -> None:
    rng = np.random.default_rng(0)
    vertices, _ = hull(rng.normal(size=(30, 3)))
    low, high = vertices.min(axis=0) - R, vertices.max(axis=0) + R
    darts = rng.uniform(low, high, (20_000, 3))
    share = (_distances(darts, vertices) <= R).mean()
    assert sphere_swept_volume_m3(vertices, R) == pytest.approx(share * np.prod(high - low), rel=0.02)


def _distances(points: Floats, vertices: Floats) -> Floats:
    """Distance to a hull, or -depth, as the largest separation over many directions: at most the true one."""
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(4000, 3))
    normals = np.concatenate(
        [normals / np.linalg.norm(normals, axis=1)[:, None], ConvexHull(vertices).equations[:, :3]]
    )
    support = (normals @ vertices.T).max(axis=1)
    best = np.full(len(points), -np.inf)
    for chunk in range(0, len(normals), 500):
        best = np.maximum(best, (points @ normals[chunk : chunk + 500].T - support[chunk : chunk + 500]).max(axis=1))
    return best


def test_corners_come_in_the_order_of_the_points_and_faces_look_outward() -> None:
    rng = np.random.default_rng(2)
    inner = rng.uniform(0.2, 0.8, (20, 3))
    points = np.concatenate([inner[:10], BOX, inner[10:]])
    vertices, faces = hull(points)
    assert vertices.tolist() == BOX.tolist()
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a - BOX.mean(axis=0)) > 0).all()
    assert hull(points)[1].tolist() == faces.tolist()


def test_a_flat_set_has_both_sides() -> None:
    vertices, faces = hull(tilted(np.concatenate([SQUARE, [[0.5, 0.5, 0.0]]])))
    assert vertices == pytest.approx(tilted(SQUARE))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a) / 2
    assert np.linalg.norm(areas, axis=1).sum() == pytest.approx(2.0)
    assert areas.sum(axis=0) == pytest.approx(0.0, abs=1e-12)


def test_thin_sets_have_no_faces() -> None:
    for points, count in ((BOX[[0, 7]], 2), (BOX[:1], 1)):
        vertices, faces = hull(points)
        assert (len(vertices), faces.shape) == (count, (0, 3))


def test_the_surface_is_closed_even_with_slivers() -> None:
    """Volumes of a very short horizon are full of nearly equal points; Qhull's slivers have no normal to trust."""
    rng = np.random.default_rng(3)
    limits = load_limits("paper")
    volumes = predict(random_states(limits, 5, 56), limits, horizon_s=1e-5, method="paper")
    clouds = [volumes.vertices(i, k) for i in range(5) for k in range(6)]
    clouds += [tilted(rng.integers(0, 3, (40, 3)).astype(float)) for _ in range(20)]
    for points in clouds:
        _, faces = hull(points)
        edges = [(int(face[k]), int(face[(k + 1) % 3])) for face in faces for k in range(3)]
        assert len(set(edges)) == len(edges)
        assert {(j, i) for i, j in edges} == set(edges)


def is_closed(faces: Ints) -> bool:
    """Each edge of the triangles once in either direction."""
    ways = [(int(face[k]), int(face[(k + 1) % 3])) for face in faces for k in range(3)]
    return len(set(ways)) == len(ways) and {(j, i) for i, j in ways} == set(ways)


@pytest.mark.parametrize(("height", "volume"), [(-1.0, 6.0), (0.0, 6.0), (1.0, 4.0)])
def test_a_box_is_cut_above_its_bottom_alone(height: float, volume: float) -> None:
    corners, faces = above(*hull(BOX), height)
    assert corners[:, 2].min() == max(height, 0.0)
    assert is_closed(faces)
    assert sphere_swept_volume_m3(corners, 0.0, faces) == pytest.approx(volume)


def test_of_a_box_below_its_top_the_top_is_left() -> None:
    corners, faces = above(*hull(BOX), 3.0)
    assert sorted(map(tuple, corners.tolist())) == [(x, y, 3.0) for x in (0.0, 1.0) for y in (0.0, 2.0)]
    assert sphere_swept_volume_m3(corners, 0.0, faces) == pytest.approx(0.0)


def test_a_cut_through_corners_keeps_them() -> None:
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    corners, faces = above(*hull(octahedron), 0.0)
    assert len(corners) == 5
    assert is_closed(faces)
    assert sphere_swept_volume_m3(corners, 0.0, faces) == pytest.approx(2.0 / 3.0)


def test_a_hull_above_a_height_holds_the_points_that_do_both() -> None:
    """Against qhull's own planes: a random point is in the part if it is in the hull and not below."""
    rng = np.random.default_rng(11)
    for height in (-0.4, 0.0, 0.3):
        points = rng.normal(size=(40, 3))
        whole, (corners, faces) = ConvexHull(points), above(points, hull(points)[1][:0], height)
        assert len(corners) == len(faces) == 0  # no surface, nothing above
        vertices, triangles = hull(points)
        corners, faces = above(vertices, triangles, height)
        assert corners[:, 2].min() == height
        asked = rng.uniform(-2.0, 2.0, size=(4000, 3))
        wanted = (asked @ whole.equations[:, :3].T + whole.equations[:, 3] <= 0.0).all(axis=1) & (asked[:, 2] >= height)
        part = ConvexHull(corners)
        found = (asked @ part.equations[:, :3].T + part.equations[:, 3] <= 1e-12).all(axis=1)
        np.testing.assert_array_equal(found, wanted)
        assert wanted.any()
        outward = np.cross(corners[faces[:, 1]] - corners[faces[:, 0]], corners[faces[:, 2]] - corners[faces[:, 0]])
        assert ((corners[faces[:, 0]] - corners.mean(axis=0)) * outward).sum(axis=1).min() > 0.0
        assert is_closed(faces)
        assert sphere_swept_volume_m3(corners, 0.0, faces) == pytest.approx(part.volume, rel=1e-12)
    corners, faces = above(vertices, triangles, 9.0)
    assert corners.shape == faces.shape == (0, 3)
