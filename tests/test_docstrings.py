"""Docstrings: every public function with many parameters documents each of them, and names are unique."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

import hrcreplay

PACKAGE = Path(hrcreplay.__file__).parent
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if not path.name.endswith("_pb2.py"))
#: A function with at least so many parameters needs an Args section.
MANY = 4
#: The command line: here the help of each option documents it, and a docstring is the text of --help.
COMMANDS = ("cli/app.py", "cli/live.py", "cli/scale.py")

_SECTIONS = re.compile(r"^(Returns|Raises|Yields|Attributes):$", re.MULTILINE)


def _functions(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef, bool]]:
    """Functions of a module and methods of its classes, with whether they are methods."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, node, False
        elif isinstance(node, ast.ClassDef):
            for method in node.body:
                if isinstance(method, ast.FunctionDef):
                    yield f"{node.name}.{method.name}", method, True


def _parameters(function: ast.FunctionDef, *, method: bool) -> list[str]:
    given = function.args
    names = [argument.arg for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    names += [argument.arg for argument in (given.vararg, given.kwarg) if argument is not None]
    return names[1:] if method and names and names[0] in ("self", "cls") else names


def undocumented(source: str) -> list[str]:
    """Functions and parameters of a module's source that lack an entry in an Args section."""
    found = []
    for name, function, method in _functions(ast.parse(source)):
        parameters = _parameters(function, method=method)
        if len(parameters) < MANY or function.name.startswith("_"):
            continue
        _, head, arguments = (ast.get_docstring(function) or "").partition("Args:\n")
        if not head:
            found.append(f"{name}: no Args")
            continue
        arguments = _SECTIONS.split(arguments)[0]
        documented = {
            part.strip().lstrip("*")
            for line in re.findall(r"^ {4}(\*{0,2}\w[\w, *]*):", arguments, re.MULTILINE)
            for part in line.split(",")
        }
        found += [f"{name}: {parameter}" for parameter in parameters if parameter not in documented]
    return found


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_functions_with_many_parameters_document_each(module: Path) -> None:
    name = module.relative_to(PACKAGE).as_posix()
    if name in COMMANDS:
        pytest.skip("documented by the help of the options")
    assert undocumented(module.read_text()) == []


def test_a_missing_section_and_a_missing_parameter_are_found() -> None:
    assert undocumented("def f(a, b, c, d):\n    '''Text.'''\n") == ["f: no Args"]
    args = "def f(a, b, *, c, d):\n    '''Text.\n\n    Args:\n        a, b: Both.\n        c: [m].\n    '''\n"
    assert undocumented(args) == ["f: d"]
    returns = args.replace("    '''\n", "\n    Returns:\n        d: Not a parameter.\n    '''\n")
    assert undocumented(returns) == ["f: d"]
    assert undocumented("class A:\n    def f(self, a, b, c):\n        '''Text.'''\n") == []


def test_every_module_has_a_docstring() -> None:
    texts = {path: ast.get_docstring(ast.parse(path.read_text())) for path in MODULES}
    assert [path.relative_to(PACKAGE).as_posix() for path, text in texts.items() if not text] == []


def test_no_two_classes_share_a_name() -> None:
    """Within; whoever uses the library calls its classes ``hr.Robot`` and meets no other."""
    places = defaultdict(list)
    for path in MODULES:
        if path.name == "api.py":
            continue
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef):
                places[node.name].append(path.relative_to(PACKAGE).as_posix())
    shared = {name: paths for name, paths in places.items() if len(paths) > 1}
    assert shared == {}
