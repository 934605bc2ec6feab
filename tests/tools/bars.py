"""What a session must show on this machine, as a table: ``python -m tests.tools.bars``.

At the same time, under the same load: a bare echo loop with its robot double, and the whole session on the demo log
with its own. ``--faults`` lets everything that the double knows go wrong; ``--people`` puts simulated people beside the
demo's worker, who cross and hide each other. For a time that is longer than the demo log, all people are simulated: at
the seam of a repeated recording a person is lost, and the robot would stand from then on. Not part of the suite.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hrcreplay.records import Ints
from tests import crowd
from tests.live.flights import DEMO
from tests.live.sessions import Session, Twin, every_fault, free_port

_SHARES = ("p50", "p99", "p99.9", "max")
P50_US = 1000.0
RECORDED_S = 50.0  #: the demo log's
TAIL_US = 1500.0  #: over the echo loop's
#: Answers further apart than a cycle and a half are a pause. Pauses of both within ``TOGETHER_NS`` are the computer's,
#: which let neither run. A pause of a loop together with its double loses no packet, as none was sent.
PAUSE_NS, TOGETHER_NS = 6_000_000, 20_000_000


def measure(out: Path, seconds: float, human: Path, *, faults: bool) -> tuple[dict[str, Any], dict[str, Any], Session]:
    """Runs both; reports of the doubles, the echo loop's first."""
    wrong = ("--faults", every_fault(out, seconds)) if faults else ()
    ports = free_port(), free_port()
    echo = [sys.executable, "-m", "tests.egm.echo", "--port", str(ports[0]), "--fifo", "50"]
    settings = ("live.resume=true",) if faults else ()
    with Session(out / "session", ports[1], "--send", settings=settings, human=human) as session:
        session.until("a status", lambda status: status["phase"] == "waiting")
        with subprocess.Popen([*echo, "--duration", str(seconds + 5.0)], stdout=subprocess.PIPE) as loop:
            kept = ("--duration", seconds, *wrong)
            with Twin(out / "echo", ports[0], *kept) as first, Twin(out / "twin", ports[1], *kept) as second:
                assert first.end(seconds + 60.0) == 0, first.err
                load = os.getloadavg()[0]
                assert second.end(seconds + 60.0) == 0, second.err
            loop.communicate()
        session.interrupt()
        session.end(patience_s=600.0)
    sys.stdout.write(f"load {load:.1f} on {os.cpu_count()} cores\n")
    bare, live = (json.loads((out / name / "twin.json").read_text()) for name in ("echo", "twin"))
    return bare, live, session


def stops(folder: Path) -> list[str]:
    """The stops of a session while its robot was there: the last is that the double's time was over."""
    meta = json.loads((folder / "run.json").read_text())
    told = [stop["reason"] for stop in meta["stops"]]
    return told[:-1] if told[-1:] == ["robot silent"] else told


def moving(folder: Path) -> float:
    """Share of the ticks of a session in which the robot moved."""
    columns = [f"dq{axis}" for axis in range(1, 7)]
    return float((pd.read_parquet(folder / "motion.parquet", columns=columns) != 0.0).any(axis=1).mean())


def verdict(folder: Path) -> str:
    """What `hrcreplay verify` says."""
    command = [sys.executable, "-m", "hrcreplay", "verify", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return f"{done.stdout.strip()} (exit code {done.returncode}){done.stderr}"


def table(bare: dict[str, Any], live: dict[str, Any]) -> Iterator[str]:
    """Both side by side."""
    yield f"{'':24}{'echo loop':>12}{'session':>12}{'more':>12}"
    for share in _SHARES:
        mine, yours = live["answers"]["latency_us"][share], bare["answers"]["latency_us"][share]
        yield f"response {share:<5} [us]     {yours:>12.0f}{mine:>12.0f}{mine - yours:>+12.0f}"
    for name in ("packets", "before_first", "answered", "missed", "doubled", "seqno_steps"):
        yield f"{name:24}{bare['answers'][name]:>12}{live['answers'][name]:>12}"
    yield f"{'overruns of the double':24}{bare['overruns']:>12}{live['overruns']:>12}"


def stolen_s() -> float:
    """CPU time that the host of a virtual machine has given to others since its start, in all cores; NaN: not known."""
    try:
        counts = Path("/proc/stat").read_text().splitlines()[0].split()
    except OSError:
        return math.nan
    return int(counts[8]) / os.sysconf("SC_CLK_TCK")  # user, nice, system, idle, iowait, irq, softirq, steal


def pauses_ns(folder: Path) -> Ints:
    """When a pause between two answers began, on the clock that all doubles share."""
    t_ns = pd.read_csv(folder / "twin_arrivals.csv", usecols=["t_ns"])["t_ns"].to_numpy()
    return np.asarray(t_ns[:-1][np.diff(t_ns) > PAUSE_NS])


def together(mine_ns: Ints, yours_ns: Ints) -> int:
    """How many of the first pauses began while one of the others did."""
    return sum(bool((np.abs(yours_ns - at_ns) <= TOGETHER_NS).any()) for at_ns in mine_ns)


def paused(out: Path) -> Iterator[str]:
    """Pauses of both, and those that came to both at the same time."""
    yours, mine = pauses_ns(out / "echo"), pauses_ns(out / "twin")
    yield f"{'pauses over 6 ms':24}{len(yours):>12}{len(mine):>12}"
    yield f"{'at the same time':24}{together(yours, mine):>12}{together(mine, yours):>12}"


def short(bare: dict[str, Any], live: dict[str, Any], verified: str, found: list[str], *, faults: bool) -> list[str]:
    """The bars that are not reached."""
    mine, yours = live["answers"]["latency_us"], bare["answers"]["latency_us"]
    wrong = [] if mine["p50"] < P50_US else [f"p50 {mine['p50']:.0f} us"]
    wrong += [
        f"{share} {mine[share] - yours[share]:+.0f} us" for share in ("p99", "p99.9") if _above(mine, yours, share)
    ]
    if live["answers"]["missed"] > bare["answers"]["missed"]:
        wrong.append("packets missed beyond those of the echo loop")
    if not verified.startswith("identical"):
        wrong.append("verify")
    return wrong if faults or not found else [*wrong, "stops"]


def _above(mine: dict[str, float], yours: dict[str, float], share: str) -> bool:
    return mine[share] - yours[share] > TAIL_US


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.bars", description=__doc__)
    parser.add_argument("--seconds", type=float, default=RECORDED_S)
    parser.add_argument("--faults", action="store_true", help="every fault of the double once, in both")
    parser.add_argument("--people", type=int, choices=(1, 2, 3), default=1, help="how many the cameras show")
    parser.add_argument("--out", type=Path, default=None, help="where all is left")
    given = parser.parse_args()
    out = given.out or Path(tempfile.mkdtemp(prefix="bars-"))
    out.mkdir(parents=True, exist_ok=True)
    human = DEMO
    if given.people > 1 or given.seconds > RECORDED_S:
        people = crowd.there_and_back(*crowd.people(given.people, math.inf), given.seconds + 30.0)
        human = crowd.write(out / "people.mcap", crowd.record(*people))
    before_s = stolen_s()
    bare, live, session = measure(out, given.seconds, human, faults=given.faults)
    stolen_ms = 1e3 * (stolen_s() - before_s)
    verified, found = verdict(session.folder), stops(session.folder)
    sys.stdout.write("\n".join([*table(bare, live), *paused(out)]) + "\n")
    sys.stdout.write(f"the host took {stolen_ms:.0f} ms of CPU time for others\n")
    sys.stdout.write(f"stops of the session: {', '.join(found) or 'none'}\n")
    sys.stdout.write(f"the robot moved in {moving(session.folder):.0%} of the ticks\n")
    sys.stdout.write(f"sessions of the double: {live['sessions']}\nverify: {verified}\nall of it: {out}\n")
    wrong = short(bare, live, verified, found, faults=given.faults)
    sys.stdout.write(f"{'short of the bar: ' + '; '.join(wrong) if wrong else 'every bar is reached'}\n")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
