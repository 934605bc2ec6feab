"""scene.rrd as Rerun's own SDK reads it: entities, shapes, transforms, series and blueprint."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.reporting import scene_rerun
from hrcreplay.reporting.replay_scene import CameraSight, ReplayScene
from hrcreplay.reporting.scene_messages import surface_mesh
from hrcreplay.reporting.scene_rerun import TIMELINE, write_scene
from hrcreplay.robot.control.static_obstacles import StaticHull
from tests.reporting.moving import SECOND_M, moving_run, moving_scene, robot, two_people

chunk = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk (extra: rerun)")


@pytest.fixture(scope="module")
def scene() -> ReplayScene:
    sight = CameraSight("kinect", np.eye(4), (0.55, 0.42), True)
    table = np.array([[x, y, z] for x in (0.4, 1.0) for y in (-0.5, 0.5) for z in (0.70, 0.74)])
    found = moving_scene(two_people(moving_run(4.0)))
    horizons_s: Floats = 0.1 + 0.001 * np.arange(len(found.volumes.t_ns), dtype=np.float64)
    volumes = dataclasses.replace(found.volumes, horizon_s=horizons_s)
    return dataclasses.replace(found, volumes=volumes, cameras=(sight,), objects=(StaticHull("table", table, 0.0),))


@pytest.fixture(scope="module")
def file(scene: ReplayScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "scene.rrd"
    write_scene(path, scene, moving_run(4.0).measurements, "a run")
    return path


@pytest.fixture(scope="module")
def entities(file: Path) -> dict[str, list[Any]]:
    """Entity -> its chunks as tables."""
    found: dict[str, list[Any]] = {}
    for one in chunk.RrdReader(file).stream():
        found.setdefault(str(one.entity_path), []).append(one.to_record_batch())
    return found


def column(tables: list[Any], name: str) -> list[Any]:
    """The cells of a column of an entity, in order of time; a static one has one cell."""
    cells = []
    for table in tables:
        if name in table.schema.names:
            at = (
                table.column(TIMELINE).cast("int64").to_pylist()
                if TIMELINE in table.schema.names
                else [0] * table.num_rows
            )
            cells += list(zip(at, table.column(name).to_pylist(), strict=True))
    return [cell for _, cell in sorted(cells, key=lambda cell: cell[0])]


def instants_s(tables: list[Any]) -> np.ndarray:
    moving = [table for table in tables if TIMELINE in table.schema.names]
    return np.sort(np.concatenate([table.column(TIMELINE).cast("int64").to_numpy() for table in moving])) * 1e-9


def test_every_entity_of_the_scene_is_there_at_its_instants(entities: dict[str, list[Any]], scene: ReplayScene) -> None:
    robots = {f"/world/robot/{name}/axis_{axis}" for name in ("qp", "scaling", "qp_stop") for axis in range(1, 7)}
    shapes = {f"/world/robot/{name}/axis_{axis}/mesh_{axis}" for name in ("qp", "scaling") for axis in range(7)}
    shown = {"/world/person_1/body", "/world/person_2/body", "/world/person_1/skeleton", "/world/person_2/skeleton"}
    cell = {"/world/objects/table_0", "/world/cameras/kinect", "/world/distance", "/world/seen/kinect/person_1"}
    volumes = {f"/world/volumes/right_lower_arm{of}" for of in ("", "_of_person_2")}
    assert robots | shapes | shown | cell | volumes <= entities.keys()
    for name in (*robots, "/world/person_1/body", "/plots/qp/speed/driven"):
        np.testing.assert_allclose(instants_s(entities[name]), scene.seconds, atol=1e-6)
    assert not any("log_time" in table.schema.names for tables in entities.values() for table in tables)


def test_a_robot_stands_where_pinocchio_has_it(entities: dict[str, list[Any]], scene: ReplayScene) -> None:
    """Each mesh or capsule of a body, moved by the transform of its axis."""
    row, model = 57, robot(moving_run(2.0))
    for name, q in (("qp", scene.methods["qp"].q), ("qp_stop", scene.methods["qp"].stop_q)):
        want = model.ends_m(q[row])
        for link, axis in zip(scene.robot.links, scene.robot.moved_by.tolist(), strict=True):
            place = f"/world/robot/{name}/axis_{axis}"
            turn = Rotation.from_quat(column(entities[place], "Transform3D:quaternion")[row][0])
            at_m = np.array(column(entities[place], "Transform3D:translation")[row][0])
            if f"{place}/{link}" not in entities:  # shown by a mesh
                continue
            ((start,),) = column(entities[f"{place}/{link}"], "Capsules3D:translations")
            k = scene.robot.links.index(link)
            np.testing.assert_allclose(turn.apply(start) + at_m, want[k, 0], atol=1e-5)
            ((length,),) = column(entities[f"{place}/{link}"], "Capsules3D:lengths")
            assert length == pytest.approx(np.linalg.norm(want[k, 1] - want[k, 0]), abs=1e-6)
    for number, mesh in enumerate(scene.robot.meshes):
        (corners,) = column(entities[f"/world/robot/qp/axis_{mesh.axes}/mesh_{number}"], "Mesh3D:vertex_positions")
        np.testing.assert_allclose(np.reshape(corners, (-1, 3, 3)), mesh.vertices_m[mesh.triangles], atol=1e-6)


def test_bodies_are_capsules_of_all_people(entities: dict[str, list[Any]], scene: ReplayScene) -> None:
    row, half = 40, len(scene.body_parts) // 2
    first, second = (column(entities[f"/world/person_{k}/body"], "Capsules3D:translations")[row] for k in (1, 2))
    np.testing.assert_allclose(first, scene.body_m[row, :half, 0], atol=1e-6)
    np.testing.assert_allclose(np.array(second) - first, np.tile(SECOND_M, (half, 1)), atol=1e-6)
    radii = column(entities["/world/person_1/body"], "Capsules3D:radii")[row]
    np.testing.assert_allclose(radii, scene.body_radius_m[:half], atol=1e-6)
    turns = Rotation.from_quat(column(entities["/world/person_1/body"], "Capsules3D:quaternions")[row])
    lengths = np.array(column(entities["/world/person_1/body"], "Capsules3D:lengths")[row])
    ends = np.array(first) + turns.apply(np.column_stack([np.zeros((half, 2)), lengths]))
    np.testing.assert_allclose(ends, scene.body_m[row, :half, 1], atol=1e-5)


def test_volumes_stand_at_their_instants_with_their_horizons(
    entities: dict[str, list[Any]], scene: ReplayScene
) -> None:
    tables, stored = entities["/world/volumes/trunk"], scene.volumes
    rows = np.flatnonzero((stored.limb == stored.limbs.index("THX")) & np.isin(stored.t_ns, stored_at(tables, scene)))
    corners = [cell for cell in column(tables, "Mesh3D:vertex_positions") if cell]
    horizons = [cell for cell in column(tables, "horizon_s") if cell]
    assert len(corners) == len(rows) == len(horizons)
    for k, row in enumerate(rows.tolist()):
        hull = stored.vertices_m[stored.offsets[row] : stored.offsets[row + 1]]
        points, triangles = surface_mesh(hull, float(stored.radius_m[row]))
        np.testing.assert_allclose(np.reshape(corners[k], (-1, 3, 3)), points[triangles], atol=1e-6)
        assert horizons[k][0] == pytest.approx(stored.horizon_s[row])
    assert any("Clear:is_recursive" in table.schema.names for table in tables)  # and it goes when it is stale


def stored_at(tables: list[Any], scene: ReplayScene) -> np.ndarray:
    shown = [table for table in tables if "Mesh3D:vertex_positions" in table.schema.names]
    return np.asarray(scene.t0_ns + np.round(instants_s(shown) * 1e9).astype(np.int64))


def test_series_and_camera_are_those_of_the_scene(entities: dict[str, list[Any]], scene: ReplayScene) -> None:
    known = np.flatnonzero(np.isfinite(scene.methods["scaling"].distance_m))
    told = column(entities["/plots/scaling/distance/to_volumes"], "Scalars:scalars")
    np.testing.assert_allclose([one[0] for one in told], scene.methods["scaling"].distance_m[known])
    camera = entities["/world/cameras/kinect"]
    ((matrix,),) = column(camera, "Pinhole:image_from_camera")
    ((resolution,),) = column(camera, "Pinhole:resolution")
    assert resolution[0] / 2 / matrix[0] == pytest.approx(0.55, rel=1e-6)
    assert resolution[1] / 2 / matrix[4] == pytest.approx(0.42, rel=1e-6)
    words = [cell[0] for cell in column(entities["/status/qp"], "TextLog:text")]
    known_names, index = scene.methods["qp"].names["status"]
    assert words[0].startswith(known_names[index[0]])


def test_a_blueprint_shows_scene_plots_and_status(file: Path) -> None:
    (entry,) = chunk.RrdReader(file).blueprints()
    origins: set[str] = set()
    classes: set[str] = set()
    for one in chunk.RrdReader(file).stream(store=entry):
        table = one.to_record_batch()
        for name, found in (("ViewBlueprint:space_origin", origins), ("ViewBlueprint:class_identifier", classes)):
            if name in table.schema.names:
                found |= {cell for cells in table.column(name).to_pylist() for cell in cells}
    assert {"/world", "/plots/qp/speed", "/plots/qp/distance", "/status/qp"} <= {
        o if o.startswith("/") else f"/{o}" for o in origins
    }
    assert {"3D", "TimeSeries", "TextLog"} <= classes


def test_without_the_sdk_it_says_what_to_install(
    scene: ReplayScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_rerun, "rr", None)
    with pytest.raises(SettingsError, match=r"rerun-sdk is not installed.*hrcreplay\[rerun\]"):
        write_scene(tmp_path / "scene.rrd", scene, None, "a run")
