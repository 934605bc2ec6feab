from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from hrcreplay.geometry.convex_hull import sphere_swept_volume_m3
from hrcreplay.geometry.hull_reduction import END, START, is_loop, solid_hull, surface


@pytest.mark.parametrize(
    ("slots", "simple"),
    [
        ("01 12 20", True),
        ("20 12 01", True),
        ("01 30 12 23", True),
        ("01 12 20 34 45 53", False),  # two loops
        ("01 12 20 03 34 40", False),  # two that meet
        ("03 34 40 01 12 20", False),
    ],
)
def test_only_one_simple_loop_is_one(slots: str, simple: bool) -> None:
    faces, edges = surface().faces, slots.split()
    faces[:] = 0
    faces[START, : len(edges)] = [int(edge[0]) for edge in edges]
    faces[END, : len(edges)] = [int(edge[1]) for edge in edges]
    assert is_loop(len(edges), faces) is simple


@pytest.mark.parametrize("seed", range(8))
def test_a_solid_hull_is_that_of_qhull(seed: int) -> None:
    rng, work = np.random.default_rng(seed), surface()
    for _ in range(50):
        points = rng.normal(size=(int(rng.integers(5, 120)), 3)) * rng.uniform(0.05, 1.0, 3) + rng.normal(size=3)
        if seed % 2:  # many in one plane and some twice
            points = np.concatenate([np.round(points, 1), np.round(points[:3], 1)])
        corners, faces = solid_hull(points, work)
        theirs = ConvexHull(points)
        assert set(theirs.vertices) <= set(corners) | {
            i for i in theirs.vertices if (points[corners] == points[i]).all(axis=1).any()
        }
        assert set(faces.ravel()) == set(range(len(corners)))
        a, b, c = (points[corners][faces[:, k]] for k in range(3))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
        assert volume == pytest.approx(theirs.volume, rel=1e-9)
        edges = {(i, j) for face in faces.tolist() for i, j in zip(face, face[1:] + face[:1], strict=True)}
        assert len(edges) == 3 * len(faces)
        assert {(j, i) for i, j in edges} == edges  # closed, each edge once in either direction


def test_of_a_thin_set_nothing_is_proven() -> None:
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.normal(size=(20, 2)), np.zeros(20)])
    for points in (flat, flat + 1e-8 * rng.normal(size=flat.shape), flat[:, [0, 2, 2]], flat[:4] + np.eye(4, 3)):
        assert not len(solid_hull(points, surface())[1])


@pytest.mark.parametrize("moved_m", [1e-8, 1e-7, 1e-6, 1e-5, 1e-4])
def test_a_narrow_triangle_counts_as_much_as_it_turns(moved_m: float) -> None:
    """A trunk that hardly moves has narrow triangles; its volume is that of one at rest, by Steiner's formula."""
    rng = np.random.default_rng(4)
    shoulders_and_pelvis = np.array([[0.14, 0.05, 1.7], [-0.16, -0.03, 1.72], [0.0, 0.0, 1.24]]) + np.array(
        [2.5, 0.2, 0.0]
    )
    for _ in range(200):
        ends = shoulders_and_pelvis + 0.02 * rng.normal(size=(3, 3))
        later = ends + moved_m * np.array([-0.7, 0.3, 0.8]) + 0.3 * moved_m * rng.normal(size=(3, 3))
        still, moved = (
            np.concatenate([points + np.array([0.0, 0.0, 0.05]), points - np.array([0.0, 0.0, 0.52])])
            for points in (ends, np.concatenate([ends, later]))
        )
        want = sphere_swept_volume_m3(still, 1.0)
        assert sphere_swept_volume_m3(moved, 1.0) == pytest.approx(want, abs=20.0 * moved_m + 1e-7)
