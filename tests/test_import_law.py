"""Who may import whom. Data flows one way, and the law of the house keeps it so."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import hrcreplay

PACKAGE = Path(hrcreplay.__file__).parent

#: Room or module -> what of the package it may import beside itself.
FOUNDATION = {"errors", "records"}
MAY_IMPORT = {
    "errors": set(),
    "records": set(),
    "sections": FOUNDATION,
    "sections_live": FOUNDATION | {"sections"},
    "config": FOUNDATION | {"sections", "sections_live"},
    "human": FOUNDATION,
    "robot": FOUNDATION,
    "logs": FOUNDATION,
    "egm": FOUNDATION,
    "files": FOUNDATION,
    "limits": FOUNDATION | {"files", "human"},
    "cell": FOUNDATION | {"files"},
    "tables": FOUNDATION,
    "runs": FOUNDATION,
    "report": FOUNDATION | {"human", "robot", "logs", "runs"},
    "audit": FOUNDATION
    | {"human", "limits", "logs", "report", "runs"}
    | {"ingest", "job", "pipeline", "progress", "wiring", "__version__"},
}
#: Libraries that one module alone may import.
ALONE = {"pinocchio": "robot/model.py", "coal": "robot/separation.py", "proxsuite": "robot/controller.py"}
#: Modules of these rooms open no file, read no clock, draw no random number, print and log nothing.
PURE = ("human", "robot")
IMPURE_MODULES = {"io", "logging", "os", "pathlib", "random", "socket", "sys", "tempfile", "time", "datetime"}
IMPURE_CALLS = {"open", "print", "input"}

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


@pytest.mark.parametrize("path", MODULES, ids=lambda p: p.relative_to(PACKAGE).as_posix())
def test_a_module_imports_only_what_its_room_may(path: Path) -> None:
    room = _room(path)
    imports = _imports(ast.parse(path.read_text()))
    ours = {name.split(".")[1] for name in imports if name.startswith("hrcreplay.")}
    if room in MAY_IMPORT:
        allowed = MAY_IMPORT[room] | {room}
        assert ours <= allowed, f"{room} may not import {sorted(ours - allowed)}"
    if room not in {"cli", "__main__"}:
        assert "cli" not in ours
    if room not in {"cli", "audit"}:
        assert "audit" not in ours
    for library, home in ALONE.items():
        if any(name.split(".")[0] == library for name in imports):
            assert path.relative_to(PACKAGE).as_posix() == home


@pytest.mark.parametrize("path", [p for p in MODULES if _room(p) in PURE], ids=lambda p: p.name)
def test_human_and_robot_are_pure(path: Path) -> None:
    tree = ast.parse(path.read_text())
    assert not {name.split(".")[0] for name in _imports(tree)} & IMPURE_MODULES
    assert not {n for n in _imports(tree) if n.startswith(("numpy.random", "scipy.io"))}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            owner = ast.unparse(node.func.value) if isinstance(node.func, ast.Attribute) else ""
            assert name not in IMPURE_CALLS or owner
            assert owner != "np.random"


def test_the_law_has_teeth() -> None:
    """Every room of the law exists, so that a renamed room does not slip out of it."""
    assert {_room(path) for path in MODULES} >= set(MAY_IMPORT)
