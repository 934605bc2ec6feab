"""Sessions with a bug in one place: stands in for the entry of hrcreplay and for that of its helper processes.

``$HRCREPLAY_TEST_BUG`` says where: ``part/module:attribute[.attribute]@file``; it strikes as soon as there is the file.
Where ``$HRCREPLAY_TEST_UNDRAWN`` is set, the run folder has no figures, which take longer than all else after a session
and at which most tests do not look.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

BUG, UNDRAWN = "HRCREPLAY_TEST_BUG", "HRCREPLAY_TEST_UNDRAWN"


def failing(function: Callable[..., Any], fails: Callable[[], bool]) -> Callable[..., Any]:
    """The function, which fails as soon as it is time to."""

    def called(*arguments: Any, **named: Any) -> Any:
        if fails():
            raise ZeroDivisionError("put there\nby a test")
        return function(*arguments, **named)

    return called


def plant(bug: str) -> None:
    """Puts the bug into this process."""
    where, _, sign = bug.partition("@")
    module, _, path = where.partition(":")
    owner: Any = import_module(module)
    *owners, name = path.split(".")
    for step in owners:
        owner = getattr(owner, step)
    setattr(owner, name, failing(getattr(owner, name), Path(sign).exists))


def main() -> None:
    """Control where the arguments are a command line; else one of the helpers, of those the one with the bug."""
    from hrcreplay.live import processes

    bug = os.environ[BUG]
    if bug and __spec__ is not None:
        processes.ENTRY = __spec__.name
    helper = sys.argv[1:2] != ["live"]
    part, _, where = bug.partition("/")
    if part == (sys.argv[2] if helper else processes.CONTROL):
        plant(where)
    if helper:
        processes.main()
        return
    from hrcreplay.cli.app import main as command_line
    from tests.undrawn import undrawn

    with undrawn() if os.environ[UNDRAWN] else nullcontext():
        command_line()


if __name__ == "__main__":
    main()
