"""Every tool answers ``--help``."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
#: A tool is a module that runs by itself, or a folder with a ``__main__``.
TOOLS = sorted(
    [path.stem for path in HERE.glob("*.py") if "__main__" in path.read_text() and not path.name.startswith("test_")]
    + [path.parent.name for path in HERE.glob("*/__main__.py")]
)


@pytest.mark.parametrize("tool", TOOLS)
def test_a_tool_says_what_it_does(
    tool: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [tool, "--help"])
    for module in (f"tests.tools.{tool}", f"tests.tools.{tool}.__main__"):  # another tool may have imported it
        monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(f"tests.tools.{tool}", run_name="__main__", alter_sys=False)
    assert ended.value.code == 0
    said = capsys.readouterr().out
    assert said.startswith(f"usage: python -m tests.tools.{tool} ")
    assert len(said.splitlines()) > 4


def test_all_tools_are_there() -> None:
    wanted = {
        "bars",
        "bases",
        "campaign",
        "deviations",
        "fuzz",
        "people",
        "random_stops",
        "readme",
        "soak",
        "soundness",
    }
    assert wanted <= set(TOOLS)
