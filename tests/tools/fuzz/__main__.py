"""Spoilt logs through the commands: ``python -m tests.tools.fuzz --logs 500 --live 100 --seed 1``.

Each log has a seed of its own, ``seed * 1000000 + i``; ``--only`` runs that of one seed again.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.live.sessions import Twin, free_port
from tests.tools.fuzz.trial import LIVE, OFFLINE, PORT, Trial, trial

_EACH = 1_000_000


def main(arguments: list[str] | None = None) -> int:
    """Runs and prints; 1 where something is not as it must be."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.fuzz", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--logs", type=int, default=500, help=f"logs through {', '.join(OFFLINE)}")
    parser.add_argument("--live", type=int, default=100, help="logs through live, beside a robot double")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, metavar="SEED", help="the log of this seed alone")
    parser.add_argument("--commands", nargs="+", default=[*OFFLINE], choices=OFFLINE)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="the result is the same")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the logs that failed")
    given = parser.parse_args(arguments)
    first = given.seed * _EACH
    logs = range(first, first + given.logs) if given.only is None else [given.only]
    live = range(first, first + given.live) if given.only is None else [given.only]
    found = Counter[tuple[str, int]]()
    wrong = 0
    for one in _all(list(logs), list(live) if given.live else [], given.commands, given.processes, given.keep):
        found[one.command, one.code] += 1
        wrong += bool(one.wrong)
        if one.wrong or given.only is not None:
            sys.stdout.write(f"{one}\n")
            sys.stdout.write(one.err if given.only is not None else "")
            sys.stdout.flush()
    for command in (*given.commands, LIVE):
        codes = {code: count for (name, code), count in sorted(found.items()) if name == command}
        told = ", ".join(f"exit code {code}: {count}" for code, count in codes.items())
        sys.stdout.write(f"{command}: {sum(codes.values())} logs; {told}\n" if codes else "")
    sys.stdout.write(f"{wrong} of {found.total()} went wrong\n")
    return int(wrong > 0)


def _all(logs: list[int], live: list[int], commands: list[str], processes: int, keep: Path | None) -> Iterator[Trial]:
    for command in commands:
        run_config = partial(trial, command=command, keep=keep)
        if processes == 1:
            yield from map(run_config, logs)
            continue
        with ProcessPoolExecutor(processes) as pool:
            yield from pool.map(run_config, logs, chunksize=4)
    if live:
        with robot():  # one after the other: they share it
            for number in live:
                yield trial(number, LIVE, keep)


@contextmanager
def robot() -> Iterator[None]:
    """A robot double that calls at the port of the live sessions for as long as they last."""
    port = free_port()
    os.environ[PORT] = str(port)
    try:
        with TemporaryDirectory() as folder, Twin(Path(folder) / "twin", port):
            yield
    finally:
        del os.environ[PORT]


if __name__ == "__main__":
    sys.exit(main())
