"""Who may import whom. Data flows one way, and the law of the house keeps it so."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import hrcreplay

PACKAGE = Path(hrcreplay.__file__).parent

FOUNDATION = {"errors", "records", "toml_file"}
#: Rooms that compute the stages, and what they are set by.
STAGES = {"kernels", "geometry", "human", "robot", "logs", "settings", "limits", "calibration"}
#: Sections of settings may be passed to these rooms as they are; none of them loads a setting.
TAKERS = ("human", "robot", "logs", "egm", "calibration", "reporting")
#: Room -> the rooms that it may import.
MAY_IMPORT = {
    "errors": set(),
    "records": set(),
    "toml_file": {"errors"},
    "kernels": set(),
    "version": set(),
    "geometry": {"records", "kernels"},
    "human": FOUNDATION | {"kernels", "geometry", "settings"},
    "robot": FOUNDATION | {"kernels", "geometry", "settings"},
    "logs": FOUNDATION | {"settings"},
    "egm": FOUNDATION | {"robot", "settings"},
    "settings": FOUNDATION,
    "store": FOUNDATION,
    "limits": FOUNDATION | {"human", "store"},
    "calibration": FOUNDATION | {"kernels", "geometry", "logs", "settings", "store"},
    "pipeline": FOUNDATION | STAGES | {"store", "version"},
    "evaluation": FOUNDATION | STAGES | {"store", "pipeline"},
    "reporting": FOUNDATION | STAGES | {"store", "pipeline", "evaluation"},
    "audit": FOUNDATION | STAGES | {"store", "version", "pipeline", "evaluation", "reporting"},
    "commands": FOUNDATION | STAGES | {"store", "version", "pipeline", "evaluation", "reporting", "audit"},
    "live": FOUNDATION | STAGES | {"egm", "store", "version", "pipeline", "evaluation", "reporting", "commands"},
    "api": FOUNDATION | {"geometry", "robot", "logs", "settings", "store", "calibration", "pipeline", "commands"},
    "cli": FOUNDATION | {"egm", "settings", "pipeline", "commands", "audit", "live", "version"},
    "__main__": {"cli"},
    "__init__": {"api", "version"},
}
#: Libraries that these modules alone may import.
ALONE = {
    "pinocchio": ("robot/model.py",),
    "coal": ("robot/control/certificate.py", "calibration/meshes.py"),
    "proxsuite": ("robot/control/minimiser.py",),
}
#: Modules of these rooms open no file, read no clock, draw no random number, print and log nothing.
PURE = ("geometry", "human", "robot")
IMPURE_MODULES = {"io", "logging", "os", "pathlib", "random", "socket", "sys", "tempfile", "time", "datetime"}
IMPURE_CALLS = {"open", "print", "input"}
MOST_ROOMS = 22

MODULES = sorted(PACKAGE.rglob("*.py"))


def _imports(tree: ast.AST) -> set[str]:
    """Dotted names that a module imports; ``from a import b`` counts as a.b."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the room"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def _name(path: Path) -> str:
    return "hrcreplay." + path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")


@pytest.mark.parametrize("path", MODULES, ids=lambda p: p.relative_to(PACKAGE).as_posix())
def test_a_module_imports_only_what_its_room_may(path: Path) -> None:
    room = _room(path)
    imports = _imports(ast.parse(path.read_text()))
    ours = {name.split(".")[1] for name in imports if name.startswith("hrcreplay.")}
    allowed = MAY_IMPORT[room] | {room}
    assert ours <= allowed, f"{room} may not import {sorted(ours - allowed)}"
    if room == "egm":  # the link knows the robot's data sheet, and nothing that computes with it
        assert {name for name in imports if name.startswith("hrcreplay.robot")} <= {"hrcreplay.robot.irb140"}
    if room in TAKERS:
        assert not any(name.startswith("hrcreplay.settings.load") for name in imports), "pass the section instead"
    for library, homes in ALONE.items():
        if any(name.split(".")[0] == library for name in imports):
            assert path.relative_to(PACKAGE).as_posix() in homes


@pytest.mark.parametrize("path", [p for p in MODULES if _room(p) in PURE], ids=lambda p: p.name)
def test_geometry_human_and_robot_are_pure(path: Path) -> None:
    tree = ast.parse(path.read_text())
    assert not {name.split(".")[0] for name in _imports(tree)} & IMPURE_MODULES
    assert not {n for n in _imports(tree) if n.startswith(("numpy.random", "scipy.io"))}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            owner = ast.unparse(node.func.value) if isinstance(node.func, ast.Attribute) else ""
            assert name not in IMPURE_CALLS or owner
            assert owner != "np.random"


def test_no_module_imports_itself_by_way_of_others() -> None:
    graph: dict[str, set[str]] = {_name(path): set() for path in MODULES}
    for path in MODULES:
        for imported in _imports(ast.parse(path.read_text())):
            within = imported.rpartition(".")[0]
            names = (imported, within, f"{imported}.__init__", f"{within}.__init__")
            graph[_name(path)] |= {next(iter(name for name in names if name in graph), _name(path))} - {_name(path)}
    assert len(list(TopologicalSorter(graph).static_order())) == len(MODULES)  # CycleError names a circle


def test_the_rooms_stand_on_floors() -> None:
    """No room imports one above it: the law itself has no circle, and names every room there is."""
    assert {_room(path) for path in MODULES} == set(MAY_IMPORT)
    rooms = {room: allowed & set(MAY_IMPORT) for room, allowed in MAY_IMPORT.items()}
    assert list(TopologicalSorter(rooms).static_order())
    assert len([room for room in MAY_IMPORT if not room.startswith("__")]) <= MOST_ROOMS
