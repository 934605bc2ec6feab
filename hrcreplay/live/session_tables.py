"""The messages of a session's record as the tables of a run folder."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from hrcreplay.egm.codec import AXES
from hrcreplay.errors import LogError
from hrcreplay.live import wire
from hrcreplay.live.records import PHASES, MotionRow
from hrcreplay.pipeline import store as store_volumes
from hrcreplay.records import BODY, LIMBS, Floats, HumanStates, Motion
from hrcreplay.runs import RunWriter, TableWriter
from hrcreplay.tables import Columns, motion_columns, state_columns

_BATCH = TableWriter.ROWS


@dataclass
class SessionTables:
    """Writes state, occupancy and motion of the messages it is given; counts them, and keeps what was remarked."""

    run: RunWriter
    cameras: tuple[str, ...]
    links: tuple[str, ...]
    limbs: tuple[str, ...]  #: that have a swept volume
    method: str  #: of the swept volumes
    counts: Counter[str] = field(default_factory=Counter)
    took_us: list[int] = field(default_factory=list)  #: of every reply
    events: list[dict[str, Any]] = field(default_factory=list)  #: beside the start
    _looks: list[wire.Look] = field(default_factory=list)
    _answers: list[wire.Answered] = field(default_factory=list)

    def add(self, message: bytes) -> None:
        """Takes a message of the record."""
        kind = wire.kind(message)
        self.counts[_COUNTED[kind]] += 1
        if kind == wire.LOOK:
            self._looks.append(wire.read_look(message))
        elif kind == wire.VOLUMES:
            store_volumes(wire.read_whole(message, self.limbs, self.method), np.zeros(1, np.int64), self.run)
        elif kind == wire.ANSWER:
            self._answered(wire.read_answer(message))
        elif kind == wire.EVENT:
            self.events.append(wire.read_event(message))
        if max(len(self._looks), len(self._answers)) >= _BATCH:
            self.flush()

    def flush(self) -> None:
        """Writes what waits."""
        if self._looks:
            self.run.table("state", state_columns(_states(self._looks, self.cameras, self.run.partial)))
        if self._answers:
            self.run.table("motion", _motion(self._answers, self.limbs, self.links))
        self._looks, self._answers = [], []

    def _answered(self, answered: wire.Answered) -> None:
        if answered.row is not None:  # else there was no packet to answer
            self._answers.append(answered)
            self.took_us.append(answered.took_us)

    def timing(self) -> dict[str, Any]:
        """From a packet's arrival to the departure of its reply, as timing.json has it."""
        took = np.array(self.took_us, dtype=np.float64)
        if not len(took):
            return {}
        shares = {"median_us": 0.5, "p99_us": 0.99, "p99_9_us": 0.999, "max_us": 1.0}
        found = {name: float(np.quantile(took, share)) for name, share in shares.items()}
        return {"reply": {"ticks": len(took), **found, "real_time_factor": None}}


_COUNTED = {
    wire.ROBOT: "robot_packets",
    wire.REPLY: "replies",
    wire.FRAME: "skeletons",
    wire.LOOK: "looks",
    wire.VOLUMES: "looks_with_volumes",
    wire.ANSWER: "answers",
    wire.SILENCE: "silences",
    wire.EVENT: "events",
}


def _states(looks: list[wire.Look], cameras: tuple[str, ...], where: Path) -> HumanStates:
    numbers = np.array([look.state for look in looks])
    widths = dict.fromkeys(("p", "v", "a", "j", "p_std", "v_std"), 12)
    widths |= {"lengths_m": 8, "lengths_std_m": 8, "residual_m": len(BODY), "unseen_s": len(LIMBS)}
    ends = np.cumsum(list(widths.values()))
    if numbers.shape[1] != ends[-1]:
        raise LogError(
            f"{where}: found {numbers.shape[1]} numbers a look where this version has {ends[-1]}; "
            "would be right: the version of hrcreplay that recorded the session"
        )
    parts = np.split(numbers, ends[:-1], axis=1)
    return HumanStates(
        t_ns=np.array([look.t_ns for look in looks]),
        **dict(zip(widths, parts, strict=True)),
        valid=np.array([np.frombuffer(look.valid, dtype=bool) for look in looks]),
        cameras=cameras,
    )


def _motion(answers: list[wire.Answered], limbs: tuple[str, ...], links: tuple[str, ...]) -> Columns:
    rows = [row for answered in answers if (row := wire.motion_row(answered)) is not None]
    column: dict[str, Floats] = {f.name: np.array([getattr(row, f.name) for row in rows]) for f in fields(MotionRow)}
    rest = dict(zip(("tcp_speed", "ref_speed", "programme_s", "distance_m"), column["rest"].T, strict=True))
    reasons = ("", *sorted({answered.reason for answered in answers} - {""}))
    motion = Motion(
        t_ns=np.array([answered.t_ns for answered in answers]),
        **{name: column[name] for name in ("q", "dq", "u", "ref_m", "tcp_m")},
        **rest,
        limb=np.array([answered.limb for answered in answers]),
        link=np.array([answered.link for answered in answers]),
        status=np.array([answered.status for answered in answers]),
        reason=np.array([reasons.index(answered.reason) for answered in answers]),
        limbs=limbs,
        links=links,
        reasons=reasons,
    )
    measured = {f"q_measured{i + 1}": np.ascontiguousarray(column["q_measured"][:, i]) for i in range(AXES)}
    phases = pa.array([PHASES[answered.phase] for answered in answers], type=pa.string())
    return {**motion_columns(motion), **measured, "phase": phases}
