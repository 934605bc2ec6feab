"""A long session on the demo log against the robot double: ``python -m tests.tools.soak --minutes 30``.

Memory and file handles of the control process over time, which must stay flat. Not part of the suite.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.live.sessions import Session, Twin, children, free_port

GROWTH_KB = 2048
WARM_S = 60.0  #: the first pass of the recording: buffers reach their size


def memory_kb(pid: int) -> int:
    """Resident memory; all that is mapped is, where the system lets it be locked."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:"))


def handles(pid: int) -> int:
    """Open file handles."""
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def watch(session: Session, minutes: float, every_s: float) -> list[tuple[float, int, int]]:
    """Time [s], memory [kB] and handles of control, from the first answers to the end; prints them as they come."""
    session.until("a robot that is answered", lambda status: status["rate_hz"] > 0)
    begun_s = time.monotonic()
    helpers = children(session.pid)
    found = []
    sys.stdout.write("    s   control kB  handles  " + "  ".join(f"{name} kB" for name in helpers) + "\n")
    while (at_s := time.monotonic() - begun_s) < 60.0 * minutes and session.process.poll() is None:
        found.append((at_s, memory_kb(session.pid), handles(session.pid)))
        others = "  ".join(f"{memory_kb(pid):>{len(name) + 3}}" for name, pid in helpers.items())
        sys.stdout.write(f"{at_s:5.0f}  {found[-1][1]:11}  {found[-1][2]:7}  {others}\n")
        sys.stdout.flush()
        time.sleep(every_s)
    return found


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--every", type=float, default=15.0, metavar="S")
    parser.add_argument("--out", type=Path, default=None, help="where session and double are left")
    given = parser.parse_args()
    out = given.out or Path(tempfile.mkdtemp(prefix="soak-"))
    port = free_port()
    arguments = ("--send", "--repeat", "--duration", 60.0 * given.minutes + 30.0)
    with (
        Session(out / "session", port, *arguments, settings=("live.resume=true",)) as session,
        Twin(out / "twin", port) as twin,
    ):
        rows = np.array(watch(session, given.minutes, given.every))
        status = session.status
        session.interrupt()
        session.end(patience_s=3600.0)  # all tables and figures of so many ticks
        report = twin.report()
    warm = rows[rows[:, 0] >= min(WARM_S, 0.5 * rows[-1, 0])]
    growth_kb, more = warm[-1, 1:] - warm[0, 1:]
    sys.stdout.write(f"last status: {json.dumps(status)}\n{''.join(session.err)}")
    sys.stdout.write(f"double: {json.dumps(report['answers'])}\nin {out}\n")
    sys.stdout.write(f"after warm-up: memory {growth_kb:+.0f} kB, handles {more:+.0f}, in {rows[-1, 0] / 60:.1f} min\n")
    return int(growth_kb >= GROWTH_KB or more > 0 or rows[-1, 0] < 59.0 * given.minutes)


if __name__ == "__main__":
    sys.exit(main())
