"""docs/paper.md against the code: every number has an entry, every place exists and cites its number."""

from __future__ import annotations

import ast
import re
from functools import cache
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "paper.md"
STATUSES = ("as printed", "corrected", "replaced", "not used")
#: Equations whose parts have numbers of their own.
PARTS = {34: "abcd", 59: "ab", 66: "abcdefghi"}
#: All numbers of equations, in the paper's order.
EQUATIONS = [label for n in range(1, 73) for label in (str(n), *(f"{n}{part}" for part in PARTS.get(n, "")))]
KNOWN = {"Eq.": EQUATIONS, "Alg.": ["1", "2", "3"], "Table": ["1", "2"], "Fig.": [str(n) for n in range(1, 19)]}
#: What must have an entry: of an equation with parts, each part.
WANTED = [("Eq.", label) for label in EQUATIONS if label not in map(str, PARTS)]
WANTED += [(kind, label) for kind in ("Alg.", "Table") for label in KNOWN[kind]]

_NUMBER = r"\(\d+[a-z]?\)"
_LISTED = rf"{_NUMBER}(?:(?:-|, (?:and )?| and ){_NUMBER})*"
_PLACE = re.compile(r"`(hrcreplay/[^`]+)` `([\w.]+)`")

Label = tuple[str, str]


def equations(listed: str) -> set[Label]:
    """The equations of a list like ``(12), (14)-(16)``; an equation with parts at a range's end brings them all."""
    found = set()
    for first, last in re.findall(r"\((\w+)\)(?:-\((\w+)\))?", listed):
        if not last or last not in EQUATIONS or first not in EQUATIONS:
            found |= {("Eq.", label) for label in (first, last) if label}
            continue
        start, end = EQUATIONS.index(first), EQUATIONS.index(last)
        assert start < end, f"({first})-({last})"
        end += len(PARTS.get(int(last), "")) if last.isdigit() else 0
        found |= {("Eq.", label) for label in EQUATIONS[start : end + 1]}
    return found


def cited(source: str) -> set[Label]:
    """Every number that a piece of source cites."""
    text = re.sub(r"\s+(#:? )?\s*", " ", source)
    found = set(chain.from_iterable(equations(listed) for listed in re.findall(rf"Eq\. ({_LISTED})", text)))
    for kind in ("Alg.", "Table", "Fig."):
        found |= {(kind, number) for number in re.findall(rf"{re.escape(kind)} (\d+)", text)}
    return found


def entries() -> list[tuple[str, set[Label], list[tuple[str, str]], str]]:
    """Of every row of the page's tables: its first cell, its numbers, its places and its status."""
    found = []
    for line in PAGE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if not line.startswith("|") or len(cells) != 4 or cells[0] in ("number", "---"):
            continue
        labels = equations(cells[0]) | {label for label in cited(cells[0]) if label[0] != "Eq."}
        found.append((cells[0], labels, places(cells[2]), cells[3]))
    return found


def places(cell: str) -> list[tuple[str, str]]:
    """(file, name) of a cell like ``file`` ``name``, ``name``; ``file`` ``name``."""
    found = []
    for group in cell.split(";"):
        file, *names = re.findall(r"`([^`]+)`", group) or [""]
        assert bool(file) == bool(names), f"{cell}: a file goes with names in it"
        found += [(file, name) for name in names]
    return found


@cache
def source_of(file: str, name: str) -> str:
    """What stands for a function, class, constant or field: comments above, the code, the text below a field.

    Of a key of a TOML file: its line and the comment at the file's head.
    """
    text = (ROOT / file).read_text()
    lines = text.splitlines()
    if file.endswith(".toml"):
        head = lines[: next(i for i, line in enumerate(lines) if not line.startswith("#"))]
        return "\n".join(head + [line for line in lines if re.match(rf"{name}\s*=", line)][:1])
    body: list[ast.stmt] = ast.parse(text).body
    node = None
    for part in name.split("."):
        at = [i for i, statement in enumerate(body) if part in names_of(statement)]
        assert at, f"{file} has no {name}"
        node, after = body[at[0]], body[at[0] + 1 : at[0] + 2]
        body = getattr(node, "body", [])
    assert node is not None
    first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))]) - 1
    while first and lines[first - 1].lstrip().startswith("#"):
        first -= 1
    last = node.end_lineno
    if isinstance(node, ast.AnnAssign) and after and isinstance(after[0], ast.Expr):
        last = after[0].end_lineno
    return "\n".join(lines[first:last])


def names_of(statement: ast.stmt) -> set[str]:
    """What a statement defines."""
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return {statement.name}
    if isinstance(statement, ast.AnnAssign):
        return {ast.unparse(statement.target)}
    if isinstance(statement, ast.Assign):
        return {node.id for target in statement.targets for node in ast.walk(target) if isinstance(node, ast.Name)}
    return set()


def test_every_number_has_an_entry() -> None:
    found = set(chain.from_iterable(labels for _, labels, _, _ in entries()))
    assert [label for label in WANTED if label not in found] == []


def test_no_entry_has_a_number_that_the_paper_has_not() -> None:
    for cell, labels, _, _ in entries():
        assert all(label in KNOWN[kind] for kind, label in labels), cell


@pytest.mark.parametrize(("cell", "labels", "where", "status"), entries(), ids=[entry[0] for entry in entries()])
def test_an_entry_leads_to_what_cites_it(
    cell: str, labels: set[Label], where: list[tuple[str, str]], status: str
) -> None:
    assert status.startswith(STATUSES), cell
    assert len(status.split()) > 5 or status.startswith("as printed"), f"{cell}: say how and why"
    assert bool(where) != status.startswith("not used"), f"{cell}: a place, or not used"
    sources = {place: cited(source_of(*place)) for place in where}
    if labels and where:
        assert labels <= set().union(*sources.values()), f"{cell}: not cited by {where}"
        for place, found in sources.items():
            assert labels & found, f"{place} does not cite {cell}"


def test_places_in_the_text_exist() -> None:
    found = _PLACE.findall(PAGE.read_text())
    assert found
    for file, name in found:
        assert source_of(file, name)


@pytest.mark.parametrize("path", sorted((ROOT / "hrcreplay").rglob("*.py")), ids=lambda path: path.name)
def test_what_the_code_cites_is_in_the_paper(path: Path) -> None:
    text = path.read_text()
    assert all(label in KNOWN[kind] for kind, label in cited(text))
    if re.search(rf"(Eq\. {_LISTED}|Alg\. \d),? corrected", text):
        assert "docs/paper.md" in text, "a correction without the page that explains it"
