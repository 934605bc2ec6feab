"""Random faults against the controller, session by session: ``python -m tests.tools.campaign --sessions 200``.

In counted time, so a session is the same on every machine. What must never happen is looked for in every answer.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from hrcreplay.egm.codec import BadPacket, decode_robot
from hrcreplay.egm.robot_double.faults import KINDS, Fault, random_faults
from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.egm.step_gate import StepGate, UnsafeCommandError
from hrcreplay.live.record.codec import PHASES
from tests.live.attacks import checker
from tests.live.flights import CYCLE_S, Flight, is_a_stop, steps_keep_the_limits
from tests.live.made import record

SECONDS = 6.0


def walk(s: float) -> tuple[float, float]:
    """Somebody who comes near and goes away."""
    return 1.3 + 0.7 * float(np.cos(1.1 * s)), 0.3 * float(np.sin(0.7 * s))


def session(seed: int, faults: tuple[Fault, ...] | None = None, seconds: float = SECONDS) -> Flight:
    """A session with faults of its own, every second one with motion that resumes."""
    found = random_faults(seed, duration_s=seconds - 0.5, count=4) if faults is None else faults
    overrides = ("live.resume=true", "live.resume_s=0.5") if seed % 2 else ()
    return Flight(overrides=("live.approach_speed=1.0", *overrides), walk=walk, faults=found, seed=seed).fly(seconds)


def violations(flight: Flight) -> list[str]:
    """What a session did that none may do."""
    found = []
    if flight.controller.fault is not None:
        found.append(f"crash: {flight.controller.fault!r}")
    try:
        steps_keep_the_limits(flight)
    except AssertionError:
        found.append("a step beyond the limits")
    gate = StepGate(flight.robot.dq_max, CYCLE_S)
    for answer in flight.answers:
        if answer.datagram is not None and answer.row is not None:
            try:
                gate.check(answer.datagram, answer.measured, answer.t_ns)
            except UnsafeCommandError as error:
                found.append(f"withheld: {error}")
    return [*found, *_motion_after_stops(flight), *_unanswered(flight)]


def _motion_after_stops(flight: Flight) -> list[str]:
    """Whether each stop is a certified one to standstill, straight or Eq. (67), within T_s and two cycles."""
    found = []
    stop_s = flight.start["settings"]["prediction"]["stop_s"]
    ddq_max, dt_s = flight.robot.ddq_max, flight.controller.setup.plan.dt_s
    for at_ns, reason in flight.controller.stops:
        rows = [answer for answer in flight.answers if answer.t_ns >= at_ns and answer.row is not None]
        speeds: list[np.ndarray] = []
        for answer in rows:
            if answer.row is None or PHASES[answer.phase] in ("echo", "approach", "following"):
                break
            speeds.append(answer.row.dq)
        moving = [speed for speed in speeds if np.any(speed)]
        if len(moving) * CYCLE_S > stop_s + 2 * CYCLE_S:
            found.append(f"{reason}: moves for {len(moving) * CYCLE_S:.3f} s")
        if speeds and not is_a_stop(np.array(speeds), ddq_max, dt_s):
            found.append(f"{reason}: moves after the stop")
        if any(np.any(answer.row.dq) and not answer.row.certified for answer in rows if answer.row is not None):
            found.append(f"{reason}: a stop that was not certified")
    return found


def _unanswered(flight: Flight) -> list[str]:
    """Packets that nobody answered although the robot had sent none later; but for those in doubt, after an answer."""
    missed, newest_ns, answered_ns = 0, 0, 0
    for answer, datagrams, alarmed in flight.heard:
        fresh = False
        for data in datagrams:
            try:
                clock_ns = decode_robot(data).clock_ns or 0
            except BadPacket:
                continue
            if clock_ns > newest_ns:
                fresh, newest_ns = True, clock_ns
        doubted = alarmed and answer.t_ns - answered_ns < PERIOD_NS
        missed += fresh and answer.datagram is None and not doubted
        answered_ns = answer.t_ns if answer.datagram is not None else answered_ns
    return [f"{missed} packets unanswered"] if missed else []


class Judged(NamedTuple):
    """What became of a session."""

    wrong: list[str]
    faults: Counter[str]
    stops: Counter[str]
    greatest: checker.Step | None  #: by a checker that reads the session's log alone; None where nothing was sent


def judge(seed: int) -> Judged:
    """Runs a session, and looks at its answers and at its log."""
    flight = session(seed)
    wrong, greatest = violations(flight), None
    with TemporaryDirectory() as folder:
        log = record(Path(folder) / "log.mcap", flight.messages, chunk=500)
        steps = list(checker.steps(log))
    if steps:
        greatest = max(steps, key=lambda step: step.share)
        if greatest.share > 1.0 + 1e-6:
            wrong.append(f"a step of {greatest.step_deg:.4f} deg, {greatest.share:.3f} of what the axis can go")
    faults = Counter(fault.kind for fault in flight.faults)
    return Judged(wrong, faults, Counter(reason for _, reason in flight.controller.stops), greatest)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.campaign", description=__doc__)
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first session")
    parser.add_argument("--processes", type=int, default=1)
    given = parser.parse_args()
    faults: Counter[str] = Counter()
    stops: Counter[str] = Counter()
    bad, worst = 0, checker.Step(0, 0, 0.0, 0.0)
    seeds = range(given.first, given.first + given.sessions)
    with ProcessPoolExecutor(given.processes) as pool:
        for seed, found in zip(seeds, pool.map(judge, seeds), strict=True):
            faults, stops, bad = faults + found.faults, stops + found.stops, bad + bool(found.wrong)
            worst = max(worst, found.greatest or worst, key=lambda step: step.share)
            for line in found.wrong:
                sys.stdout.write(f"session {seed}: {line}\n")
            if (seed + 1) % 100 == 0:
                sys.stderr.write(f"{seed + 1 - given.first} sessions done\n")
    missing = sorted(set(KINDS) - set(faults))
    sys.stdout.write(f"{given.sessions} sessions, {sum(faults.values())} faults: {dict(sorted(faults.items()))}\n")
    sys.stdout.write(f"kinds that did not come up: {', '.join(missing) or 'none'}\n")
    sys.stdout.write(f"stops: {dict(sorted(stops.items()))}\n")
    sys.stdout.write(
        f"greatest step, from the logs alone: {worst.step_deg:.4f} deg of joint {worst.axis + 1}, {worst.share:.3f} of "
        f"what it can go\n{bad} sessions with a violation\n"
    )
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
