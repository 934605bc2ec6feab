"""Summary of a run of the robot double: reply times, what was commanded, and how it came to rest after faults."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hrcreplay.egm.robot_double.faults import Fault
from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.egm.robot_double.twin import TwinCore, TwinRecord, columns
from hrcreplay.errors import SettingsError
from hrcreplay.records import Bools, Floats, Ints

#: Slower than this on every axis is standstill [rad/s] ...
REST_RAD_PER_S = 0.01
#: ... once it has lasted for so many cycles.
REST_CYCLES = 25
#: A packet with another so close behind may go unanswered: a guide that drains its socket answers the newest [ns].
DRAINED_NS = 500_000


@dataclass(frozen=True)
class Answers:
    """Counts and times of the answers to the packets."""

    packets: int
    before_first: int
    """Packets that left before the guide said anything at all."""
    answered: int
    missed: int
    """Of the others."""
    doubled: int
    """Messages for which no packet was waiting."""
    garbage: int
    seqno_steps: int
    """Steps of the guide's counter other than 1 within a session."""
    latency_us: dict[str, float]
    """From a packet's departure to its answer's arrival: p50, p99, p99.9, max [us]; empty without answers."""


@dataclass(frozen=True)
class Commanded:
    """Largest commanded jumps, speeds and accelerations, for each axis."""

    start_jump_rad: list[float]
    """From the measured joints to a session's first reference [rad]."""
    jump_rad: list[float]
    """From one reference to the next [rad]."""
    speed_rad_per_s: list[float]
    """That jump over the cycles between their arrivals [rad/s]."""
    speed_ref_rad_per_s: list[float]
    """Speed reference [rad/s]."""
    acceleration_rad_per_s2: list[float]
    """Change of the speed reference over the cycles between their arrivals [rad/s^2]."""
    speed_limit_rad_per_s: list[float]
    acceleration_limit_rad_per_s2: list[float]


@dataclass(frozen=True)
class FaultOutcome:
    """A fault and what came after its onset. None: not within the run."""

    fault: Fault
    told_rest_s: float | None
    """Until the references stood still, or no longer counted [s]."""
    robot_rest_s: float | None
    """Until the robot stood still [s]."""
    coast_s: float | None
    """Of it after the last reference that moved [s]."""

    def line(self) -> str:
        """The fault as text."""
        rests = (("told", self.told_rest_s), ("robot", self.robot_rest_s), ("coasting", self.coast_s))
        times = ", ".join(f"{name} {'-' if rest_s is None else f'{rest_s:.3f} s'}" for name, rest_s in rests)
        return f"{self.fault.kind} at {self.fault.at_s:.3f} s: standstill after {times}"


@dataclass(frozen=True)
class TwinReport:
    """The report of a run, with the record that it was made from."""

    duration_s: float
    cycles: int
    overruns: int
    """Cycles that the machine kept from happening in time."""
    sessions: list[str]
    """How each session ended; empty for one that was cut off."""
    answers: Answers
    commanded: Commanded
    faults: list[FaultOutcome]
    record: TwinRecord

    def as_json(self) -> dict[str, Any]:
        """All but the record, ready for JSON."""
        names = ("duration_s", "cycles", "overruns", "sessions")
        parts = {"answers": asdict(self.answers), "commanded": asdict(self.commanded)}
        return (
            {name: getattr(self, name) for name in names} | parts | {"faults": [asdict(seen) for seen in self.faults]}
        )

    def lines(self) -> list[str]:
        """The report as text."""
        answers, told = self.answers, self.commanded
        ends = ", ".join(end or "cut off" for end in self.sessions)
        latency = ", ".join(f"{name} {value:.0f}" for name, value in answers.latency_us.items()) or "none"
        counts = (
            f"packets {answers.packets}, of these {answers.before_first} before the first answer; "
            f"answered {answers.answered}, missed {answers.missed}, doubled {answers.doubled}; "
            f"no message {answers.garbage}, odd steps of seqno {answers.seqno_steps}"
        )
        lines = [
            f"{self.duration_s:.1f} s, {self.cycles} cycles, {self.overruns} overrun; sessions: {ends}",
            counts,
            f"response [us]: {latency}",
            "axis  start [rad]   jump [rad]  speed [rad/s] of   speed ref  acceleration [rad/s^2] of",
        ]
        rows = zip(*asdict(told).values(), strict=True)
        for axis, (start, jump, speed, speed_ref, push, speed_limit, push_limit) in enumerate(rows, start=1):
            lines.append(
                f"{axis:4}  {start:11.6f}  {jump:11.6f}  {speed:10.4f} {speed_limit:7.3f}  {speed_ref:9.4f}"
                f"  {push:19.3f} {push_limit:6.2f}"
            )
        return lines + [seen.line() for seen in self.faults]

    def write(self, folder: Path) -> None:
        """Writes twin.json, twin_cycles.csv and twin_arrivals.csv.

        Raises:
            SettingsError: The folder cannot be written.
        """
        try:
            (folder / "twin.json").write_text(json.dumps(self.as_json(), indent=2) + "\n", encoding="utf-8")
            for name, table in (("cycles", self.record.cycles()), ("arrivals", self.record.arrivals())):
                heads, values = columns(table)
                formats = ["%d" if not np.any(column % 1) else "%.9g" for column in values.T]
                np.savetxt(folder / f"twin_{name}.csv", values, formats, ",", header=",".join(heads), comments="")
        except OSError as error:
            raise SettingsError(f"{folder}: cannot be written ({error.strerror}); name another folder") from error


def report_of(core: TwinCore, faults: Sequence[Fault], *, overruns: int = 0) -> TwinReport:
    """The report of a run of the robot double."""
    cycles, arrivals = core.record.cycles(), core.record.arrivals()
    return TwinReport(
        duration_s=len(cycles) and float(cycles["t_ns"][-1] - cycles["t_ns"][0] + PERIOD_NS) * 1e-9,
        cycles=len(cycles),
        overruns=overruns,
        sessions=core.ends,
        answers=_answers(core.record.departures(), arrivals, core.record.garbage),
        commanded=_commanded(cycles, arrivals, core.servo.speed_max, core.servo.acceleration_max),
        faults=[_seen(fault, cycles) for fault in faults],
        record=core.record,
    )


def _answers(departed_ns: Ints, arrivals: NDArray[Any], garbage: int) -> Answers:
    """Pairs packets and answers.

    Between two departures come as many answers as packets wait: then each has its own. Fewer: the newest were
    answered, as a guide does that has fallen behind. More: those were doubled.
    """
    arrived_ns = arrivals["t_ns"]
    windows = np.split(arrived_ns, np.searchsorted(arrived_ns, departed_ns))
    latencies_ns: list[int] = []
    doubled, waiting = len(windows[0]), []
    answered = np.zeros(len(departed_ns), bool)
    for number, window in enumerate(windows[1:]):
        waiting.append(number)
        if len(window):
            waiting = waiting[-len(window) :]
            answered[waiting] = True
            latencies_ns += [int(a - departed_ns[n]) for a, n in zip(window, waiting, strict=False)]
            doubled += max(0, len(window) - len(waiting))
            waiting = []
    before = max(0, int(np.searchsorted(departed_ns, arrived_ns[0])) - 1) if len(arrived_ns) else len(departed_ns)
    alone = np.diff(departed_ns, append=np.inf) > DRAINED_NS
    steps = np.diff(arrivals["seqno"])[np.diff(arrivals["session"]) == 0]
    latency_us = np.array(latencies_ns) * 1e-3
    shares = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
    return Answers(
        packets=len(departed_ns),
        before_first=before,
        answered=int(np.sum(answered)),
        missed=int(np.sum(alone[before:] & ~answered[before:])),
        doubled=doubled,
        garbage=garbage,
        seqno_steps=int(np.sum(steps != 1)),
        latency_us={name: float(np.quantile(latency_us, share)) for name, share in shares.items() if len(latency_us)},
    )


def _commanded(cycles: NDArray[Any], arrivals: NDArray[Any], speed_max: Floats, acceleration_max: Floats) -> Commanded:
    """Largest jumps, speeds and accelerations of what arrived, within sessions."""
    session = arrivals["session"]
    same = np.diff(session) == 0
    count = np.maximum(1, np.rint(np.diff(arrivals["t_ns"])[same] / PERIOD_NS))[:, None]
    span_s = count * PERIOD_NS * 1e-9
    jump = np.abs(np.diff(arrivals["ref_rad"], axis=0)[same])
    change = np.abs(np.diff(arrivals["ref_rad_per_s"], axis=0)[same])
    first = arrivals[np.flatnonzero(np.diff(session, prepend=0))]
    answered = cycles[np.maximum(np.searchsorted(cycles["t_ns"], first["t_ns"], side="right") - 1, 0)]
    start = np.abs(first["ref_rad"] - answered["q_rad"])
    return Commanded(
        start_jump_rad=_largest(start),
        jump_rad=_largest(jump),
        speed_rad_per_s=_largest(jump / span_s),
        speed_ref_rad_per_s=_largest(np.abs(arrivals["ref_rad_per_s"])),
        acceleration_rad_per_s2=_largest(change / span_s),
        speed_limit_rad_per_s=speed_max.tolist(),
        acceleration_limit_rad_per_s2=acceleration_max.tolist(),
    )


def _largest(values: Floats) -> list[float]:
    return [float(value) for value in values.max(axis=0, initial=0.0)]


def _seen(fault: Fault, cycles: NDArray[Any]) -> FaultOutcome:
    """How long it took from the onset of a fault until everything stood still."""
    since_s = (cycles["t_ns"] - cycles["t_ns"][:1]) * 1e-9
    told = _told_still(cycles)
    robot_s = _rest_s(fault, since_s, np.all(np.abs(cycles["planned_rad_per_s"]) < REST_RAD_PER_S, axis=1))
    coast_s = None
    if robot_s is not None:
        moved = np.flatnonzero(~told & (since_s < fault.at_s + robot_s))
        last_s = float(since_s[moved[-1]]) if len(moved) else fault.at_s
        coast_s = min(robot_s, fault.at_s + robot_s - last_s)
    return FaultOutcome(fault, _rest_s(fault, since_s, told), robot_s, coast_s)


def _told_still(cycles: NDArray[Any]) -> Bools:
    """Cycles whose reference neither moves nor says so (n,); without a reference there is nothing that moves."""
    reference = cycles["ref_rad"]
    step = np.diff(reference, axis=0, prepend=reference[:1]) / (PERIOD_NS * 1e-9)
    moves = (np.abs(step) >= REST_RAD_PER_S) | (np.abs(cycles["ref_rad_per_s"]) >= REST_RAD_PER_S)
    return ~np.any(moves, axis=1)


def _rest_s(fault: Fault, since_s: Floats, still: Bools) -> float | None:
    """Time from the onset of a fault to the first cycle of a standstill that lasts; None without one."""
    if len(still) < REST_CYCLES:
        return None
    lasting = np.convolve(still, np.ones(REST_CYCLES), mode="valid") > REST_CYCLES - 0.5
    resting = np.flatnonzero(lasting & (since_s[: len(lasting)] >= fault.at_s))
    return float(since_s[resting[0]]) - fault.at_s if len(resting) else None
