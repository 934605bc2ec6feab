"""The command line in a process of its own: exit code, what it printed, and the most memory it ever held."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from threading import Timer
from typing import NamedTuple

#: What a bomb may cost.
MEMORY_BYTES = 1_000_000_000
_GUARD_S = 120.0  # a guard, no measure: the machine may be busy
_ADDRESSES_BYTES = 16 << 30


class Outcome(NamedTuple):
    """How a command ended."""

    code: int
    text: str
    memory_bytes: int


def run_bounded(*arguments: str | Path) -> Outcome:
    """Runs ``hrcreplay`` with these arguments; kills it when it takes two minutes or 16 GB of addresses."""
    with tempfile.TemporaryFile() as output, tempfile.NamedTemporaryFile("r") as ending:
        subprocess.run(
            [sys.executable, "-m", "tests.bounded", ending.name, *map(str, arguments)],
            stdout=output,
            stderr=subprocess.STDOUT,
            check=True,
        )
        output.seek(0)
        code, memory_bytes = map(int, ending.read().split())
        return Outcome(code, output.read().decode(), memory_bytes)


def _run(ending: Path, *arguments: str) -> None:
    """What ``run_bounded`` starts: a small process, as what it held at the fork counts as its child's."""
    process = subprocess.Popen([sys.executable, "-m", "hrcreplay", *arguments], preexec_fn=_limit)
    guard = Timer(_GUARD_S, process.kill)
    guard.start()
    _, status, usage = os.wait4(process.pid, 0)
    guard.cancel()
    ending.write_text(f"{os.waitstatus_to_exitcode(status)} {usage.ru_maxrss * 1024}")


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESSES_BYTES, _ADDRESSES_BYTES))


def assert_one_line(outcome: Outcome, code: int, *facts: str) -> None:
    """One line, the code, the facts in it, and no more memory than a bomb may cost."""
    assert outcome.code == code, outcome.text
    assert len(outcome.text.strip().splitlines()) == 1, outcome.text
    assert len(outcome.text) < 1000
    assert all(fact in outcome.text for fact in facts), outcome.text
    assert outcome.memory_bytes < MEMORY_BYTES, outcome.memory_bytes


if __name__ == "__main__":
    _run(Path(sys.argv[1]), *sys.argv[2:])
