"""The links' meshes in the 3-D replay: where pinocchio's geometry has them, and no coarser than they must be."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import expm
from scipy.spatial import ConvexHull

from hrcreplay.pipeline.run_config import read_urdf
from hrcreplay.records import Floats, Ints
from hrcreplay.reporting.page.replay_page import replay_part
from hrcreplay.reporting.replay_scene import LinkMesh, ReplayScene, coarser, robot_geometry
from hrcreplay.robot.model import from_urdf
from hrcreplay.settings.sections import Robot
from tests.commands.arms import ARMS
from tests.reporting.browser import chromium, opened
from tests.reporting.moving import moving_run, moving_scene

PROGRAM = chromium()


def box_on(seed: int) -> Floats:
    """(8, 3) corners of a box about the origin, of its own size and turn."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * rng.uniform(0.05, 0.2, 3) @ turn.T


def with_meshes(scene: ReplayScene, corners_m: Mapping[int, Floats]) -> ReplayScene:
    """The same scene with a convex mesh about the middle of some links."""
    meshes = tuple(
        LinkMesh(link, corners + scene.robot.ends_m[link].mean(axis=0), ConvexHull(corners).simplices.astype(np.int64))
        for link, corners in corners_m.items()
    )
    return dataclasses.replace(scene, robot=dataclasses.replace(scene.robot, meshes=meshes))


def ball(rings: int) -> tuple[Floats, Ints]:
    """A closed unit ball of 2 rings (rings - 1) triangles."""
    polar, around = np.meshgrid(
        np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(rings) / rings, indexing="ij"
    )
    points = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=2)
    vertices = np.vstack([points.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    at = np.arange((rings - 1) * rings).reshape(rings - 1, rings)
    after = np.roll(at, -1, axis=1)
    sides = [(at[:-1], at[1:], after[:-1]), (after[:-1], at[1:], after[1:])]
    caps = [
        (np.full(rings, len(vertices) - 2), at[0], after[0]),
        (at[-1], np.full(rings, len(vertices) - 1), after[-1]),
    ]
    return vertices, np.vstack([np.stack(corners, axis=-1).reshape(-1, 3) for corners in (*sides, *caps)])


def volume_m3(vertices: Floats, triangles: Ints) -> float:
    """What a closed surface holds, by the divergence theorem."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return abs(float(np.einsum("ij,ij->", a, np.cross(b, c)))) / 6.0


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_meshes_move_with_the_links_as_pinocchio_has_them(name: str) -> None:
    path = ARMS[name].path
    files = read_urdf(Robot(urdf=path))
    assert files is not None
    T_world_base = np.eye(4)
    T_world_base[:3, 3] = 0.3, -0.2, 0.65
    model = from_urdf(files.text, T_world_base, stop_s=0.4, meshes=dict(files.meshes))
    shape = robot_geometry(model)
    whole = pin.buildModelFromUrdf(str(path))
    theirs = pin.buildGeomFromUrdf(whole, str(path), pin.GeometryType.COLLISION, package_dirs=[str(path.parents[4])])
    q = 0.3 * np.arange(1.0, model.nv + 1.0)
    whole_q = pin.neutral(whole)
    for joint, angle in zip(model.joint_names, q, strict=True):
        whole_q[whole.joints[whole.getJointId(joint)].idx_q] = angle
    placed = pin.GeometryData(theirs)
    data = whole.createData()
    pin.forwardKinematics(whole, data, whole_q)
    pin.updateGeometryPlacements(whole, data, theirs, placed)
    T = [np.eye(4)]
    for turned, (vx, vy, vz, x, y, z) in zip(q, shape.screws, strict=True):
        T.append(T[-1] @ expm(turned * np.array([[0, -z, y, vx], [z, 0, -x, vy], [-y, x, 0, vz], [0, 0, 0, 0]])))
    base = next(T for T, one in zip(placed.oMg, theirs.geometryObjects, strict=True) if one.parentJoint == 0)
    assert np.allclose(base.rotation, np.eye(3))
    assert len(shape.meshes) > 5
    for mesh in shape.meshes:
        body = model.segments[mesh.link].body
        number = next(i for i, one in enumerate(theirs.geometryObjects) if one.name == f"{body}_0")
        want = np.asarray(theirs.geometryObjects[number].geometry.vertices())
        want = want @ placed.oMg[number].rotation.T + placed.oMg[number].translation + T_world_base[:3, 3]
        moved = T[shape.moved_by[mesh.link]]
        ours = mesh.vertices_m @ moved[:3, :3].T + moved[:3, 3]
        assert len(ours) == len(want)
        apart = np.linalg.norm(ours[:, None] - want[None], axis=2)
        assert apart.min(axis=0).max() < 1e-4
        assert apart.min(axis=1).max() < 1e-4


def test_a_fine_mesh_is_drawn_coarser_and_stays_where_it_is() -> None:
    vertices, triangles = ball(160)
    assert len(triangles) > 50_000
    fewer, corners = coarser(vertices, triangles, 8000)
    assert 2000 < len(corners) <= 8000
    assert (corners != np.roll(corners, 1, axis=1)).all(), "a triangle of two corners"
    assert np.abs(np.linalg.norm(fewer, axis=1) - 1.0).max() < 0.01
    assert volume_m3(fewer, corners) == pytest.approx(volume_m3(vertices, triangles), rel=0.02)
    assert volume_m3(vertices, triangles) == pytest.approx(4.0 / 3.0 * np.pi, rel=0.002)


def test_a_small_mesh_keeps_its_triangles() -> None:
    vertices, triangles = ball(20)
    soup = vertices[triangles].reshape(-1, 3)  # as an STL has them: each corner anew
    same, corners = coarser(soup, np.arange(len(soup)).reshape(-1, 3), 8000)
    assert len(same) == len(vertices)
    assert len(corners) == len(triangles)
    assert volume_m3(same, corners) == pytest.approx(volume_m3(vertices, triangles), rel=1e-9)


@pytest.mark.skipif(PROGRAM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_the_page_draws_a_mesh_where_its_link_is(tmp_path: Path) -> None:
    scene = with_meshes(moving_scene(moving_run(4.0)), {1: box_on(1), 4: box_on(4)})
    part = replay_part(scene)
    assert 'data-show="meshes"' in part.html
    file = tmp_path / "page.html"
    file.write_text(f"<html><head><style>{part.style}</style></head><body>{part.html}</body></html>", encoding="utf-8")
    assert PROGRAM is not None
    with opened(PROGRAM, tmp_path / "profile") as tab:
        tab.open(file, 900, 700)
        row = 61
        tab.evaluate(f"replay.seek({scene.seconds[row]})")
        for number, mesh in enumerate(scene.robot.meshes):
            drawn = np.array(
                tab.evaluate(
                    f"(mesh => {{ mesh.updateMatrixWorld(true); const p = mesh.geometry.getAttribute('position');"
                    "return Array.from({length: p.count}, (_, k) => replay.view.camera.position.clone()"
                    ".fromBufferAttribute(p, k).applyMatrix4(mesh.matrixWorld).toArray()) })"
                    f"(replay.view.surfaces.group.children[{number}])"
                )
            )
            T = np.eye(4)
            for turned, (vx, vy, vz, x, y, z) in list(zip(scene.methods["qp"].q[row], scene.robot.screws, strict=True))[
                : scene.robot.moved_by[mesh.link]
            ]:
                T = T @ expm(turned * np.array([[0, -z, y, vx], [z, 0, -x, vy], [-y, x, 0, vz], [0, 0, 0, 0]]))
            np.testing.assert_allclose(drawn, mesh.vertices_m @ T[:3, :3].T + T[:3, 3], atol=1e-3)
        tab.evaluate("document.querySelector('input[data-show=meshes]').click()")
        assert tab.evaluate("replay.view.surfaces.group.visible") is False
        assert tab.trouble == []


def test_a_robot_without_meshes_has_no_switch_for_them() -> None:
    part = replay_part(with_meshes(moving_scene(moving_run(4.0)), {}))
    assert 'data-show="meshes"' not in part.html
    assert 'data-show="meshes"' in replay_part(with_meshes(moving_scene(moving_run(4.0)), {1: box_on(1)})).html
