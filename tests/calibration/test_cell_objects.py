"""Objects of a cell file: what they are, how they come back, and what is refused."""

from __future__ import annotations

import base64
import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import coal
import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from hrcreplay.calibration.cell import Cell, load_cell, write_cell
from hrcreplay.calibration.cell_objects import MOST_VERTICES, CellObject
from hrcreplay.calibration.meshes import read_parts
from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats, Ints

#: Position of the node in files that have nodes.
SHIFT = np.array([3.0, -1.0, 2.0])
MOST = {"most_parts": 64, "most_vertices": MOST_VERTICES}
CELL = """
[[objects]]
name = "table"
shape = "box"
size_m = [1.0, 0.6, 0.04]
position_m = [0.7, 0.0, 0.8]
rpy_deg = [0, 0, 30]
frame = "base"
may_approach = ["tool"]

[[objects]]
name = "floor"
shape = "half_space"
normal = [0, 0, 1]

[[objects]]
name = "post"
shape = "cylinder"
radius_m = 0.05
length_m = 1.2
programme_may_touch = true

[[objects]]
name = "pipe"
shape = "capsule"
radius_m = 0.03
length_m = 0.5

[[objects]]
name = "ball"
shape = "sphere"
radius_m = 0.1

[[objects]]
name = "wedge"
shape = "hulls"
parts_m = [[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]]
"""


def cell(tmp_path: Path, text: str) -> Cell:
    (tmp_path / "cell.toml").write_text(text)
    return load_cell(tmp_path / "cell.toml")


def test_objects_come_back_through_a_file_and_through_json(tmp_path: Path) -> None:
    read = cell(tmp_path, CELL)
    assert [one.name for one in read.objects] == ["table", "floor", "post", "pipe", "ball", "wedge"]
    write_cell(read, tmp_path / "again.toml")
    assert load_cell(tmp_path / "again.toml") == read
    assert Cell.from_dict(json.loads(json.dumps(read.to_dict()))) == read
    assert read.objects[0].to_dict()["may_approach"] == ["tool"]
    assert "frame" not in read.objects[1].to_dict(), "what is not said is not written"


def test_a_cell_without_objects_is_written_as_before() -> None:
    assert "objects" not in Cell().to_dict()


def test_the_pose_is_that_of_the_angles(tmp_path: Path) -> None:
    T = cell(tmp_path, CELL).objects[0].T_frame_object()
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    np.testing.assert_allclose(T, [[c, -s, 0, 0.7], [s, c, 0, 0], [0, 0, 1, 0.8], [0, 0, 0, 1]], atol=1e-12)


def test_parts_enclose_the_shape_as_coal_has_it_and_little_more(tmp_path: Path) -> None:
    shapes = {
        "table": coal.Box(1.0, 0.6, 0.04),
        "post": coal.Cylinder(0.05, 1.2),
        "pipe": coal.Capsule(0.03, 0.5),
        "ball": coal.Sphere(0.1),
    }
    rng = np.random.default_rng(0)
    probe = coal.Sphere(1e-6)
    for one in cell(tmp_path, CELL).objects:
        if one.name not in shapes:
            continue
        ((points, radius),) = one.parts()
        for direction in rng.normal(size=(50, 3)):
            u = direction / np.linalg.norm(direction)
            far = coal.Transform3s(np.eye(3), 10.0 * u)
            extent = float((points @ u).max()) + radius
            result = coal.DistanceResult()
            coal.distance(shapes[one.name], coal.Transform3s(), probe, far, coal.DistanceRequest(), result)
            nearest = np.asarray(result.getNearestPoint1())
            assert (nearest @ u) <= extent + 1e-6
            assert extent <= (nearest @ u) + 0.0021 or one.shape in ("box", "cylinder")
        if one.shape == "cylinder":
            assert np.hypot(points[:, 0], points[:, 1]).max() == pytest.approx(0.05 / np.cos(np.pi / 16))
            flat = points[np.isclose(points[:, 2], 0.6)][:, :2]
            sides = zip(flat, np.roll(flat, -1, 0), strict=True)
            assert min(abs(a[0] * b[1] - a[1] * b[0]) / np.linalg.norm(b - a) for a, b in sides) >= 0.05 - 1e-12


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("shape = 'box'", {"size_m", "box"}),
        ("shape = 'box'\nsize_m = [1, 1]", {"size_m"}),
        ("shape = 'box'\nsize_m = [1, 1, -1]", {"size_m", "0"}),
        ("shape = 'ball'\nradius_m = 1", {"shape", "sphere", "half_space"}),
        ("shape = 'sphere'\nradius_m = 1\nlength_m = 1", {"length_m", "sphere", "radius_m"}),
        ("shape = 'half_space'\nnormal = [0, 0, 0]", {"normal"}),
        ("shape = 'sphere'\nradius_m = 1\nradius = 1", {"radius", "radius_m", "may_approach"}),
        ("shape = 'mesh'\nfile = 'nowhere.stl'", {"nowhere.stl", ".stl", "one"}),
        ("shape = 'sphere'\nradius_m = 1\n[[objects]]\nname = 'one'\nshape = 'sphere'\nradius_m = 1", {"one", "twice"}),
    ],
)
def test_a_wrong_object_is_told_in_a_line(tmp_path: Path, text: str, told: set[str]) -> None:
    with pytest.raises(SettingsError) as refused:
        cell(tmp_path, f"[[objects]]\nname = 'one'\n{text}")
    assert "\n" not in str(refused.value)
    assert all(word in str(refused.value) for word in told), str(refused.value)


def stl(path: Path, vertices: Floats, triangles: Ints) -> Path:
    body = b"".join(
        struct.pack("<12fH", *np.zeros(3), *vertices[triangle].astype(np.float32).ravel(), 0) for triangle in triangles
    )
    path.write_bytes(b"\0" * 80 + struct.pack("<I", len(triangles)) + body)
    return path


def obj(path: Path, vertices: Floats, triangles: Ints) -> Path:
    lines = [f"v {x} {y} {z}" for x, y, z in vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles.tolist()]
    path.write_text("\n".join(lines))
    return path


def gltf(path: Path, vertices: Floats, triangles: Ints) -> Path:
    """One node, which moves the mesh back to where the vertices say; glTF has 32 bits a number."""
    points, faces = (vertices - SHIFT).astype("<f4").tobytes(), triangles.astype("<u2").tobytes()
    low, high = (vertices - SHIFT).min(axis=0).tolist(), (vertices - SHIFT).max(axis=0).tolist()
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": len(points)},
        {"buffer": 0, "byteOffset": len(points), "byteLength": len(faces)},
    ]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": SHIFT.tolist()}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3", "min": low, "max": high},
            {"bufferView": 1, "componentType": 5123, "count": triangles.size, "type": "SCALAR"},
        ],
        "bufferViews": views,
    }
    data = points + faces
    if path.suffix == ".gltf":
        uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
        path.write_text(json.dumps({**document, "buffers": [{"byteLength": len(data), "uri": uri}]}))
        return path
    text = json.dumps({**document, "buffers": [{"byteLength": len(data)}]}).encode()
    text, data = text + b" " * (-len(text) % 4), data + b"\0" * (-len(data) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(head + chunks)
    return path


def dae(path: Path, vertices: Floats, triangles: Ints, unit: str = "1", up: str = "Z_UP") -> Path:
    """One node, which moves the mesh back to where the vertices say."""
    numbers, faces, way = (" ".join(map(str, array.ravel().tolist())) for array in (vertices - SHIFT, triangles, SHIFT))
    axes = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    path.write_text(
        '<?xml version="1.0" encoding="utf-8"?>\n'
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">\n'
        f'<asset><unit name="own" meter="{unit}"/><up_axis>{up}</up_axis></asset>\n'
        '<library_geometries><geometry id="g"><mesh><source id="p">'
        f'<float_array id="a" count="{vertices.size}">{numbers}</float_array><technique_common>'
        f'<accessor source="#a" count="{len(vertices)}" stride="3">{axes}</accessor></technique_common></source>'
        '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
        f'<triangles count="{len(triangles)}"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p>'
        "</triangles></mesh></geometry></library_geometries>\n"
        f'<library_visual_scenes><visual_scene id="s"><node id="n"><translate>{way}</translate>'
        '<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>\n'
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>\n'
    )
    return path


def turned_out(vertices: Floats, triangles: Ints) -> Ints:
    """Triangles of a convex mesh, counterclockwise from outside."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * (a - vertices.mean(axis=0))).sum(axis=1) < 0.0
    return np.where(inward[:, None], triangles[:, ::-1], triangles)


def solid(points: Floats) -> tuple[Floats, Ints]:
    hull = ConvexHull(points)
    return points, turned_out(points, hull.simplices.astype(np.int64))


def ell() -> tuple[Floats, Ints]:
    """An L: a prism over six corners, whose volume is three quarters of a box and 6/7 of its hull."""
    flat = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], dtype=float)
    vertices = np.vstack([np.column_stack([flat, np.full(6, z)]) for z in (0.0, 1.0)])
    top = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    sides = [t for i in range(6) for t in ([i, (i + 1) % 6, 6 + (i + 1) % 6], [i, 6 + (i + 1) % 6, 6 + i])]
    return vertices, np.vstack([top[:, ::-1], top + 6, sides])


@pytest.mark.parametrize(
    ("write", "ending"), [(stl, "stl"), (obj, "obj"), (gltf, "gltf"), (gltf, "glb"), (dae, "dae"), (dae, "DAE")]
)
def test_a_convex_mesh_is_its_corners(tmp_path: Path, write: Callable[..., Path], ending: str) -> None:
    corners = np.array([[x, y, z] for x in (0, 10) for y in (0, 20) for z in (0, 5)], dtype=float)
    path = write(tmp_path / f"box.{ending}", *solid(corners))
    (part,) = read_parts(path, 0.001, "refuse", "cell", **MOST)
    assert sorted(part.tolist()) == sorted((0.001 * corners).tolist())


@pytest.mark.parametrize(
    ("said", "scale", "unit_m"), [("0.001", None, 0.001), ("1", None, 1.0), ("0.0254", 0.5, 0.5), ("1e-2", None, 0.01)]
)
def test_a_collada_mesh_is_in_its_own_unit_unless_a_scale_is_given(
    tmp_path: Path, said: str, scale: float | None, unit_m: float
) -> None:
    corners = np.array([[x, y, z] for x in (0, 10) for y in (0, 20) for z in (0, 5)], dtype=float)
    for up in ("Z_UP", "Y_UP"):  # the axes are those of the file
        path = dae(tmp_path / f"{up}.dae", *solid(corners), unit=said, up=up)
        (part,) = read_parts(path, scale, "refuse", "cell", **MOST)
        assert sorted(part.tolist()) == sorted((unit_m * corners).tolist())


def test_a_unit_that_is_no_length_is_refused(tmp_path: Path) -> None:
    for said in ("0", "-1", "inf", "mm"):
        path = dae(tmp_path / "a.dae", *ell(), unit=said)
        with pytest.raises(SettingsError) as refused:
            read_parts(path, None, "hull", "cell", **MOST)
        assert "a.dae" in str(refused.value)


def test_a_mesh_of_many_corners_is_enclosed_by_few(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(1500, 3))
    points *= np.array([0.5, 0.3, 0.2]) / np.linalg.norm(points, axis=1, keepdims=True)
    (part,) = read_parts(stl(tmp_path / "egg.stl", *solid(points)), 1.0, "refuse", "cell", **MOST)
    assert len(part) <= MOST_VERTICES
    assert (Delaunay(part).find_simplex(points.astype(np.float32), tol=1e-7) >= 0).all()
    assert ConvexHull(part).volume < 1.35 * ConvexHull(points).volume


def test_a_concave_mesh_is_refused_unless_its_hull_is_wanted(tmp_path: Path) -> None:
    path = obj(tmp_path / "ell.obj", *ell())
    with pytest.raises(SettingsError) as refused:
        read_parts(path, 1.0, "refuse", "cell: object ell", **MOST)
    assert all(word in str(refused.value) for word in ("ell.obj", "86%", "decompose")), str(refused.value)
    (part,) = read_parts(path, 1.0, "hull", "cell", **MOST)
    assert ConvexHull(part).volume == pytest.approx(3.5)


def test_a_mesh_of_a_cell_file_becomes_hulls_that_need_no_file(tmp_path: Path) -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    stl(tmp_path / "part.stl", *solid(corners))
    read = cell(tmp_path, "[[objects]]\nname = 'part'\nshape = 'mesh'\nfile = 'part.stl'\nscale = 0.5\n")
    (one,) = read.objects
    assert one.shape == "hulls"
    (tmp_path / "part.stl").unlink()
    again = Cell.from_dict(json.loads(json.dumps(read.to_dict())))
    ((points, radius),) = again.objects[0].parts()
    assert radius == 0.0
    assert sorted(points.tolist()) == sorted((0.5 * corners).tolist())


def test_packed_and_unknown_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(b"PK\x03\x04" + b"\0" * 100)
    (tmp_path / "a.step").write_text("ISO-10303-21;")
    (tmp_path / "b.stl").write_text("solid nothing\nendsolid nothing\n")
    for name in ("a.stl", "a.step", "b.stl"):
        with pytest.raises(SettingsError, match=name):
            read_parts(tmp_path / name, 1.0, "refuse", "cell", **MOST)


def test_an_object_has_what_its_shape_needs() -> None:
    with pytest.raises(ValueError, match="no radius_m"):
        CellObject(name="a", shape="sphere")


def test_a_decomposed_mesh_is_its_parts_and_may_miss_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, wide = (
        obj(tmp_path / "ell.obj", *ell()),
        [np.array([[x, y, z] for x in (0, 2) for y in (0, 1) for z in (0, 1)])],
    )
    tall = [np.array([[x, y, z] for x in (0, 1) for y in (0.5, 2) for z in (0, 1)])]
    for parts in (wide + tall, wide):
        made = [(points.astype(float), np.zeros((0, 3))) for points in parts]
        fake = SimpleNamespace(Mesh=lambda *_: None, run_coacd=lambda *_, made=made, **__: made)
        monkeypatch.setitem(sys.modules, "coacd", fake)
        if len(parts) == 2:
            found = read_parts(path, 0.1, "decompose", "cell", **MOST)
            assert [ConvexHull(part).volume for part in found] == pytest.approx([0.002, 0.0015])
        else:
            with pytest.raises(SettingsError, match="miss 1 of it"):
                read_parts(path, 0.1, "decompose", "cell", **MOST)
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(SettingsError, match="CoACD"):
        read_parts(path, 0.1, "decompose", "cell", **MOST)


def test_the_parts_of_a_decomposition_contain_every_corner_and_are_no_larger(tmp_path: Path) -> None:
    vertices, triangles = ell()
    parts = read_parts(obj(tmp_path / "ell.obj", vertices, triangles), 0.1, "decompose", "cell", **MOST)
    planes = [ConvexHull(part).equations for part in parts]
    outside = np.min([(0.1 * vertices @ p[:, :3].T + p[:, 3]).max(axis=1) for p in planes], axis=0)
    assert len(parts) == 2
    assert outside.max() < 1e-9
    assert sum(ConvexHull(part).volume for part in parts) == pytest.approx(0.003, rel=0.02)
    again = read_parts(tmp_path / "ell.obj", 0.1, "decompose", "cell", **MOST)
    assert all(one.tobytes() == two.tobytes() for one, two in zip(parts, again, strict=True))
