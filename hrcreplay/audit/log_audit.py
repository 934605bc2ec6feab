"""One log held against the predictions of all methods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hrcreplay import wiring
from hrcreplay.audit.recording import Recording, record
from hrcreplay.audit.window import Window, hold, joints_inside, standstill_s, travel, window
from hrcreplay.errors import LogError
from hrcreplay.human import peers, reach
from hrcreplay.human.model import LimitSet
from hrcreplay.job import Job
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import NS, Foresight, tick_times
from hrcreplay.progress import Bar
from hrcreplay.records import JOINTS, Floats, Ints, SweptVolumes
from hrcreplay.report.audit_metrics import Outcome
from hrcreplay.runs import Stopwatch
from hrcreplay.wiring import log_options

#: Ticks a second that are audited [Hz]; the union is counted out at, and the curve rests on, one in so many.
AUDIT_HZ, EVERY = 25.0, 5
#: Factors on the limit set's velocities and accelerations along the curve; ``positions`` grows with their cube.
_FACTORS = {"positions": (0.25, 0.5, 1.0, 2.0)}
_STANDARD_FACTORS = (0.5, 1.0, 2.0, 4.0, 8.0)
#: A joint that went less than this says little about its bounds [m, m, rad...].
LITTLE = np.array([0.05] * 2 + [np.radians(10.0)] * 10)
_BATCH = 100


@dataclass(frozen=True)
class LogAudit:
    """What one log showed."""

    job: Job
    name: str
    recording: Recording
    outcomes: dict[str, Outcome]  #: by method, our own first
    joints: dict[str, Floats]  #: by method of ours: (n, 12) of ``joints_inside``
    curve: dict[str, dict[float, Outcome]]  #: by method of ours and factor
    points: dict[str, dict[str, int]]  #: limb -> each point beyond its ends -> at how many ticks it was checked
    notes: tuple[str, ...]


def methods() -> tuple[str, ...]:
    """Our own methods, then the peers."""
    return (*reach.METHODS, *peers.PEERS)


def factors(method: str) -> tuple[float, ...]:
    """Factors on the limit set's rates along a method's curve, growing, 1 among them."""
    return _FACTORS.get(method, _STANDARD_FACTORS)


def volumes(foresight: Foresight, window: Window, method: str) -> SweptVolumes:
    """Swept volumes by any method, ours or a peer's."""
    if method in peers.PEERS:
        return peers.predict(
            window.states,
            horizon_s=standstill_s(foresight),
            radii=foresight.radii,
            hand_m=foresight.margins.hand_m,
            method=method,
        )
    return foresight.volumes(window.states, method)


def scaled(limits: LimitSet, factor: float) -> LimitSet:
    """A limit set whose velocities and accelerations are ``factor`` times as large."""
    grown = {name: factor * getattr(limits, name) for name in ("v_min", "v_max", "a_min", "a_max")}
    return replace(limits, name=f"{limits.name} x {factor:g}", **grown)


def audit_log(job: Job, name: str, watch: Stopwatch) -> LogAudit:
    """Audits one log by all methods.

    Raises:
        SettingsError: The cell does not fit the log.
        LogError: The log cannot be read, is shorter than the horizon, or shows nobody.
    """
    log = open_log(job.log, log_options(job.settings))
    foresight = wiring.foresight(job)
    horizon_s = standstill_s(foresight)
    first_ns, last_ns = log.header.start_ns, log.header.end_ns
    begin_ns = first_ns + round((job.start_s or 0.0) * NS)
    end_ns = last_ns if job.end_s is None else min(last_ns, first_ns + round(job.end_s * NS))
    if (end_ns - begin_ns) / NS <= horizon_s:
        raise LogError(
            f"{job.log}: found {max(0.0, (end_ns - begin_ns) / NS):.2f} s; an audit needs more than the horizon of "
            f"{horizon_s:g} s"
        )
    ticks_ns = tick_times(begin_ns, end_ns, job.settings.fusion.rate_hz)
    with Bar(f"reading {name}", len(ticks_ns)) as bar, watch.stage("record", len(ticks_ns)):
        recording = record(log, ticks_ns, wiring.eyes(job, log), lambda n: bar.advance(f"reading {name}", n))
    rows = _audited(recording, job.settings.fusion.rate_hz, horizon_s)
    if not len(rows):
        raise LogError(f"{job.log}: nobody was seen for longer than the horizon of {horizon_s:g} s")
    future = window(recording, rows, horizon_s)
    outcomes, curve = {}, {}
    stage = f"auditing {name}"
    more = sum(len(factors(method)) - 1 for method in reach.METHODS)
    work = len(rows) * len(methods()) + more * len(rows[::EVERY])
    with Bar(stage, work) as bar:
        progress = partial(bar.advance, stage)
        for method in methods():
            with watch.stage(f"audit {method}", len(rows)):
                outcomes[method] = _hold(foresight, future, method, EVERY, progress)
        if not np.isfinite(outcomes[foresight.method].beyond_m).any():
            raise LogError(
                f"{job.log}: nothing to check: no limb was both predicted and seen to the end of the horizon of "
                f"{horizon_s:g} s"
            )
        for method in reach.METHODS:
            with watch.stage(f"curve {method}", len(rows)):
                curve[method] = _curve(foresight, future, method, outcomes[method], progress)
    joints = {}
    for method in reach.METHODS:
        interval = reach.reachable(future.states, foresight.limits, foresight.horizon_s, method, foresight.margins)
        joints[method] = joints_inside(recording, future.states, interval, horizon_s)
    notes = (*log.notes, *_remarks(recording, len(rows) / AUDIT_HZ, horizon_s))
    return LogAudit(job, name, recording, outcomes, joints, curve, future.points(), notes)


def _audited(recording: Recording, rate_hz: float, horizon_s: float) -> Ints:
    """Rows of the states that are audited: one in so many, with a person, and a whole horizon before the end."""
    every = max(1.0, rate_hz / AUDIT_HZ)
    number = np.arange(len(recording.states))
    chosen = np.floor(number / every) != np.floor((number - 1) / every)
    chosen &= np.isfinite(recording.states.p).all(axis=1)
    chosen &= recording.states.t_ns + round(horizon_s * NS) <= max(recording.states.t_ns[-1], recording.t_ns[-1])
    return np.flatnonzero(chosen)


def _hold(
    foresight: Foresight, future: Window, method: str, union_every: int, progress: Callable[[int], None]
) -> Outcome:
    n = len(future.states)
    parts = []
    for first in range(0, n, _BATCH):
        some = future.rows(slice(first, first + _BATCH))
        counted = np.arange(first, first + len(some.states)) % union_every == 0
        parts.append(hold(volumes(foresight, some, method), some, counted, first))
        progress(len(some.states))
    return Outcome.join(parts)


def _curve(
    foresight: Foresight, future: Window, method: str, standard: Outcome, progress: Callable[[int], None]
) -> dict[float, Outcome]:
    """The method under scaled limits, at fewer ticks; factor 1 is its ``standard`` outcome with all ticks."""
    some = future.rows(np.arange(0, len(future.states), EVERY))
    found = {1.0: standard}
    for factor in factors(method):
        if factor not in found:
            wider = replace(foresight, limits=scaled(foresight.limits, factor))
            found[factor] = _hold(wider, some, method, 2, progress)
    return dict(sorted(found.items()))


def _remarks(recording: Recording, audited_s: float, horizon_s: float) -> tuple[str, ...]:
    """What the reader of one log's figures must know."""
    notes = [f"the recorded future is the {recording.source}"]
    went = travel(recording.joints)
    still = [
        f"{joint} ({went[j]:.2f} m)" if j < 2 else f"{joint} ({np.degrees(went[j]):.0f} deg)"
        for j, joint in enumerate(JOINTS)
        if not went[j] >= LITTLE[j]
    ]
    if still:
        notes.append(f"hardly moved, so the audit says little of their bounds: {', '.join(still)}")
    if (went[4:] < LITTLE[4:]).all():
        notes.append("no arm motion: the shares of the arms say nothing of a person at work")
    if audited_s < 10.0 * horizon_s:
        notes.append(f"only {audited_s:.1f} s audited: the intervals are wide")
    return tuple(notes)
