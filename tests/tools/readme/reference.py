"""The parts of docs/reference.md that the code already holds: the figures of a run, and the error lines."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import hrcreplay
from hrcreplay.reporting.figures.catalogue import FIGURES, NEEDS, label

PACKAGE = Path(hrcreplay.__file__).parent
BLOCK = re.compile(r"(<!-- from the code: (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)

#: Group of error lines -> files and folders of the package that have them; a file belongs to the first that names it.
ERRORS = {
    "settings": ("settings", "toml_file.py", "human"),
    "limits": ("limits",),
    "cell": ("calibration",),
    "task": ("robot/task.py", "robot/path.py"),
    "robot": ("robot", "pipeline/run_config.py"),
    "import": ("logs/importers.py", "logs/writer.py", "logs/frame_table.py"),
    "log": ("logs", "pipeline"),
    "audit": ("audit", "evaluation", "commands/audit.py"),
    "live": ("live", "egm/link.py"),
    "twin": ("egm",),
    "command": ("commands", "reporting", "cli", "store", "api.py"),
}
_ERRORS = ("SettingsError", "LogError")
#: What these say is wrong with a value is shown behind the place of the value.
_VALIDATORS = ("settings/sections.py", "robot/task.py", "calibration/cell.py")
#: A value that a message shows.
_VALUE = "\u2026"


def fill(text: str) -> str:
    """docs/reference.md with its blocks as the code has them now."""

    def block(found: re.Match[str]) -> str:
        lines = _figures() if found[2] == "figures" else (f"- `{line}`" for line in error_lines()[found[2]])
        return "".join((found[1], *(f"{line}\n" for line in lines), found[4]))

    return BLOCK.sub(block, text)


@cache
def error_lines() -> dict[str, list[str]]:
    """Group of ERRORS -> its messages, in the order of their first words."""
    groups: dict[str, set[str]] = {name: set() for name in ERRORS}
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE).as_posix()
        for message in _messages(path, (*_ERRORS, "ValueError") if place in _VALIDATORS else _ERRORS):
            name = next(
                name for name, places in ERRORS.items() if f"{place}/".startswith(tuple(f"{p}/" for p in places))
            )
            groups[name].add(message)
    return {name: sorted(lines, key=lambda line: line.strip(f"{_VALUE}:. ").lower()) for name, lines in groups.items()}


def _figures() -> Iterator[str]:
    yield from ("| name | `--figure` | what it shows | left out where |", "|---|---|---|---|")
    for kind in FIGURES:
        lacking = ", or ".join(NEEDS[need][1].split(";")[0] for need in kind.needs)
        yield f"| `{kind.name}` | {label(kind)} | {kind.title}. {kind.caption} | {lacking} |"


def _messages(path: Path, kinds: tuple[str, ...]) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in kinds and node.args:
            text = _text(node.args[0])
            if len(re.findall(r"[A-Za-z]{2,}", text)) > 1:  # else all of it is filled in
                yield text


def _text(node: ast.expr) -> str:
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return re.sub(f"{_VALUE}+", _VALUE, "".join(map(_text, node.values)))
    return _VALUE
