"""Each default stands once: nothing beside the sections of the settings falls back to a number of its own."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from hrcreplay.settings.sections import Settings, setting

PACKAGE = Path(__file__).parents[2] / "hrcreplay"
#: What a task file says, not a settings file, though a word is the same.
OTHERS = {("robot/task.py", "acceleration"), ("logs/table_files.py", "unit")}


def defaults(section: BaseModel) -> dict[str, list[Any]]:
    """Name -> its defaults, in whatever section it is."""
    found: dict[str, list[Any]] = {}
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            for inner, values in defaults(value).items():
                found.setdefault(inner, []).extend(values)
        found.setdefault(name, []).append(value)
    return found


NAMES = defaults(Settings())


def repeats(name: str, node: ast.expr | None) -> bool:
    """Whether a literal stands for the setting of that name: a word, or a number other than the neutral 0."""
    if not isinstance(node, ast.Constant) or isinstance(node.value, bool) or not node.value:
        return False
    kinds = {float if isinstance(value, int) else type(value) for value in NAMES.get(name, ())}
    return (float if isinstance(node.value, int) else type(node.value)) in kinds


def looked_up(node: ast.expr) -> str | None:
    """The setting that an expression takes by name: x["name"], x.name, x.get("name", ...), getattr(x, "name", ...)."""
    key: object = None
    if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
        key = node.slice.value
    elif isinstance(node, ast.Attribute):
        key = node.attr
    elif isinstance(node, ast.Call):
        function = node.func
        method = function.attr if isinstance(function, ast.Attribute) else None
        at = (
            0
            if method in ("get", "pop")
            else 1
            if isinstance(function, ast.Name) and function.id == "getattr"
            else None
        )
        named = node.args[at] if at is not None and len(node.args) > at else None
        key = named.value if isinstance(named, ast.Constant) else None
    return key if isinstance(key, str) and key in NAMES else None


def fallbacks(tree: ast.AST) -> Iterator[str]:
    """Names of settings that a source has a default of its own for: of a look-up, an argument or a field."""
    for node in ast.walk(tree):
        if isinstance(node, ast.BoolOp) and isinstance(node.op, ast.Or):
            yield from (key for key in map(looked_up, node.values[:-1]) if key and repeats(key, node.values[-1]))
        elif isinstance(node, ast.IfExp):
            keys = {looked_up(part) for part in ast.walk(node.body) if isinstance(part, ast.expr)}
            yield from sorted(key for key in keys if key and repeats(key, node.orelse))
        elif isinstance(node, ast.Call) and (key := looked_up(node)):
            own = node.args[-1] if len(node.args) > 1 else None
            truth = isinstance(own, ast.Constant) and own.value is True
            if repeats(key, own) or truth:
                yield key
        elif isinstance(node, ast.FunctionDef):
            given = node.args.posonlyargs + node.args.args
            pairs = [*zip(reversed(given), reversed(node.args.defaults), strict=False)]
            pairs += [*zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)]  # type: ignore[list-item]
            yield from (arg.arg for arg, own in pairs if repeats(arg.arg, own))
        elif isinstance(node, ast.ClassDef):
            fields = [
                part for part in node.body if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name)
            ]
            yield from (part.target.id for part in fields if repeats(part.target.id, part.value))  # type: ignore[union-attr]


def test_no_source_has_a_default_of_its_own() -> None:
    sources = [path for path in sorted(PACKAGE.rglob("*.py")) if "settings" not in path.parts]
    assert len(sources) > 100
    found = {
        (path.relative_to(PACKAGE).as_posix(), name)
        for path in sources
        for name in fallbacks(ast.parse(path.read_text()))
    }
    assert found - OTHERS == set()


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('plan.get("max_reference_lead_m", 0.25)', ["max_reference_lead_m"]),
        ('plan.get("certify", True)', ["certify"]),
        ('zenoh.get("mode", "peer")', ["mode"]),
        ('plan.get("max_reference_lead_m")', []),
        ('fusion.pop("memory_s", 0.5)', ["memory_s"]),
        ('getattr(fusion, "memory_s", 0.5)', ["memory_s"]),
        ('getattr(fusion, "memory_s")', []),
        ('fusion.get("memory_s") or 0.5', ["memory_s"]),
        ("fusion.memory_s if fusion else 0.5", ["memory_s"]),
        ('float(fusion["memory_s"]) if "memory_s" in fusion else 0.5', ["memory_s"]),
        ('fusion["memory_s"] if fusion else None', []),
        ('other.get("height", 3.0)', []),
        ("def f(run, gap_s=0.2): ...", ["gap_s"]),
        ("def f(run, *, near_m: float = 0.5, gap_s: float): ...", ["near_m"]),
        ("def f(run, gap_s=Logs().gap_s, latency_s=0.0, rows=1): ...", []),
        ("class A:\n    stop_s: float = 0.377\n    hand_m: float\n", ["stop_s"]),
    ],
)
def test_a_default_of_its_own_is_found(source: str, found: list[str]) -> None:
    assert list(fallbacks(ast.parse(source))) == found


def test_a_setting_is_what_was_recorded_else_the_default() -> None:
    assert setting({"plan": {"max_reference_lead_m": 0.7}}, "plan", "max_reference_lead_m") == 0.7
    assert setting({"plan": {"max_reference_lead_m": 0.7}}, "logs", "gap_s") == Settings().logs.gap_s
    assert setting({}, "plan", "certify") is Settings().plan.certify
    with pytest.raises(AttributeError):
        setting({}, "plan", "no_such_setting")
