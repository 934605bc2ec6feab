"""The drawn IRB 140: closed convex solids on the axes of the specification."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from hrcreplay.robot.irb140_shape import Solid, solids
from hrcreplay.robot.model import irb140


@pytest.mark.parametrize("solid", solids(), ids=lambda solid: f"axes {solid.axes}")
def test_each_solid_is_closed_convex_and_looks_outward(solid: Solid) -> None:
    a, b, c = (solid.vertices_m[solid.triangles[:, k]] for k in range(3))
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0
    assert volume == pytest.approx(ConvexHull(solid.vertices_m).volume, rel=0.02)
    edges = np.sort(np.concatenate([solid.triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_the_bodies_sit_on_the_axes_of_the_model() -> None:
    """Frames by pinocchio: every axis runs through the solids of the bodies on both its sides."""
    robot = irb140(np.eye(4), stop_s=0.377, tool_m=0.0)
    ends, flange = robot.ends_m(np.zeros(6)), robot.pose(np.zeros(6), np.zeros(6)).T_world_tcp[:3, 3]
    joints = {1: ends[0, 0], 2: ends[1, 0], 3: ends[2, 0], 4: ends[2, 1], 5: ends[2, 1]}
    along = {1: [0, 0, 1], 2: [0, 1, 0], 3: [0, 1, 0], 4: [1, 0, 0], 5: [0, 1, 0]}
    for axis, at in joints.items():
        line = at + np.linspace(-0.6, 0.6, 1201)[:, None] * np.array(along[axis])
        for body in (axis - 1, axis):
            assert any(_holds(one, line).any() for one in solids() if one.axes == body), (axis, body)
    disc = max((one for one in solids() if one.axes == 6), key=lambda one: one.vertices_m[:, 0].max())
    np.testing.assert_allclose(disc.vertices_m[:, 0].max(), flange[0], atol=1e-9)
    np.testing.assert_allclose(disc.vertices_m.mean(axis=0)[1:], flange[1:], atol=1e-9)
    assert min(one.vertices_m[:, 2].min() for one in solids()) == 0.0


def test_it_is_about_as_big_as_its_capsules() -> None:
    """No body reaches further than 6 cm out of the capsule around it: the picture does not hide a contact."""
    robot = irb140(np.eye(4), stop_s=0.377)
    ends = robot.ends_m(np.zeros(6))
    for axes, link in ((1, 0), (2, 1), (3, 2), (5, 3)):
        a, b = ends[link]
        for one in (one for one in solids() if one.axes == axes):
            share = np.clip((one.vertices_m - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-12), 0.0, 1.0)
            off = np.linalg.norm(one.vertices_m - a - share[:, None] * (b - a), axis=1)
            assert off.max() <= robot.segments[link].radius_m + 0.06, (axes, off.max())


def _holds(solid: Solid, points: np.ndarray) -> np.ndarray:
    hull = ConvexHull(solid.vertices_m)
    return np.asarray((points @ hull.equations[:, :3].T + hull.equations[:, 3] <= 1e-9).all(axis=1))
