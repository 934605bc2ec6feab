"""Sessions that were flown: several side by side, and what all of them must show."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.live.verify import verify
from tests.live.flights import start
from tests.live.sessions import PATIENT, Session, Twin, alive, children, free_port, wait_for

#: Goes on where the machine has stopped it, and leaves it time for others.
QUICK = (
    *PATIENT,
    "prediction.method=paper",
    "limits.prediction=paper",
    "live.approach_speed=1.0",
    "live.resume=true",
    "live.resume_s=0.1",
)
FILES = {"run.json", "log.mcap", "state.parquet", "motion.parquet", "occupancy.parquet", "report.html", "metrics.json"}
CYCLE_S = PERIOD_NS * 1e-9
STALL_S = 1.0  # beyond the pauses that the machine makes of its own; a loop that waits for a dead process makes longer
MOVING = ("approach", "following")


@dataclass
class Flown:
    """A session that is over, with its robot double."""

    session: Session
    twin: Twin
    helpers: dict[str, int]
    code: int = 0
    report: dict[str, Any] = field(default_factory=dict)

    def end(self) -> None:
        """Waits for the session, then ends the double."""
        self.code = self.session.end()
        self.report = self.twin.report()

    @property
    def folder(self) -> Path:
        return self.session.folder


class Group:
    """Sessions side by side, which is quicker than one after the other; all end with the group."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder = folder
        self._stack = stack
        self._sessions: dict[str, Session] = {}

    def prepare(
        self,
        name: str,
        *arguments: object,
        settings: tuple[str, ...] = (),
        port: int | None = None,
        bug: str = "",
        figures: bool = False,
    ) -> None:
        """Starts a session."""
        changed = (*QUICK, *settings)
        made = Session(self.folder / name, port or free_port(), *arguments, settings=changed, bug=bug, figures=figures)
        self._sessions[name] = self._stack.enter_context(made)

    def robot(self, name: str, *arguments: object) -> Flown:
        """Starts the double of a session as soon as that listens."""
        session = self._sessions[name]
        session.until("a status", lambda status: status["t_s"] >= 0)
        twin = self._stack.enter_context(Twin(self.folder / f"twin-{name}", session.port, *arguments))
        return Flown(session, twin, children(session.pid))


def read_json(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text())
    return found


def stops(folder: Path) -> dict[str, int]:
    """Why a session was stopped, and when, by its record [ns]."""
    return {stop["reason"]: stop["t_ns"] for stop in read_json(folder / "run.json")["stops"]}


def brakes_for(reason: str, folder: Path) -> None:
    """The robot was moving; from the reason on it was told to brake, for no longer than T_s and two cycles."""
    motion = pq.read_table(folder / "motion.parquet").to_pandas()
    moving = motion[[f"dq{axis}" for axis in range(1, 7)]].to_numpy().any(axis=1)
    after = (motion["t_ns"] >= stops(folder)[reason]).to_numpy()
    assert moving[~after].any()
    assert np.count_nonzero(moving[after]) * CYCLE_S <= start()["settings"]["prediction"]["stop_s"] + 2 * CYCLE_S
    assert not moving[-1]
    assert set(motion["phase"][after]) <= {"stopping", "holding", "echo"}  # a robot that timed out begins anew


def verified(folder: Path) -> str:
    """What verify says of a run that comes out the same again."""
    verdict = verify(folder)
    assert verdict.identical, verdict.lines
    return verdict.lines[0]


def never_stalls(flown: Flown) -> None:
    """Answers came without a longer pause than the robot made, in steps that the robot can take."""
    arrived, sent = (
        np.genfromtxt(flown.twin.folder / f"twin_{name}.csv", delimiter=",", names=True)["t_ns"] * 1e-9
        for name in ("arrivals", "cycles")
    )
    assert np.diff(arrived).max() < STALL_S + np.diff(sent).max()
    answers, told = flown.report["answers"], flown.report["commanded"]
    assert (answers["garbage"], answers["seqno_steps"]) == (0, 0)
    most = np.array(told["speed_limit_rad_per_s"]) * CYCLE_S
    assert np.all(np.array(told["jump_rad"]) <= most * (1 + 1e-9))
    assert np.all(np.array(told["start_jump_rad"]) < 1e-6)  # it began with an echo


def leaves_nobody(helpers: dict[str, int]) -> None:
    wait_for("the helpers' end", lambda: not any(alive(pid) for pid in helpers.values()))


def told(one: Flown) -> str:
    """The one line on standard error."""
    (line,) = one.session.err
    return line
