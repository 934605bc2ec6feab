"""The audit of one log: the volumes that each method predicted, compared with the recorded future of the person."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hrcreplay.audit import baselines
from hrcreplay.audit.fit_limits import ARMS
from hrcreplay.audit.recorded_motion import errors_in_deviations
from hrcreplay.errors import LogError
from hrcreplay.evaluation.containment import (
    AUDIT_HZ,
    Outcome,
    RecordedFuture,
    body_radii_m,
    check_containment,
    recorded_future,
    select_rows,
)
from hrcreplay.evaluation.recording import Recording, read_recordings
from hrcreplay.human.model import LimitSet
from hrcreplay.human.prediction import swept_volumes
from hrcreplay.human.prediction.swept_volumes import Reach, limb_radii
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.progress import ProgressBar
from hrcreplay.pipeline.run_config import RunConfig
from hrcreplay.pipeline.stages import NS, span_ns, tick_times
from hrcreplay.pipeline.surroundings import PredictionStage
from hrcreplay.records import DOF, JOINTS, Floats, HumanStates, Ints, SweptVolumes
from hrcreplay.reporting.metrics.series import ANGLES, difference
from hrcreplay.store.run_folder import Stopwatch


def standstill_s(prediction_stage: PredictionStage) -> float:
    """Time for which the prediction must contain the person: the robot's reaction and braking [s]."""
    return prediction_stage.horizon_s + prediction_stage.settings.latency_s


def joints_inside(recording: Recording, states: HumanStates, reach: Reach, horizon_s: float) -> Floats:
    """(n, 13) 1 if the joint's recorded future stayed in its reachable interval, else 0; NaN if not recorded.

    Args:
        recording: The log.
        states: (n,) the fused person at the ticks.
        reach: Reachable intervals at the same ticks.
        horizon_s: T, the sum of T_s and the latency [s].
    """
    t_ns = recording.joints_t_ns
    first = np.searchsorted(t_ns, states.t_ns, side="right")
    last = np.searchsorted(t_ns, states.t_ns + round(horizon_s * 1e9), side="right")
    count = last - first
    tick = np.repeat(np.arange(len(states)), count)
    row = np.arange(len(tick)) - np.repeat(np.cumsum(count) - count, count) + first[tick]
    moved = difference(recording.joints[row], states.p[tick])
    low, high = reach.low - states.p, reach.high - states.p
    out = ((moved < low[tick] - 1e-9) | (moved > high[tick] + 1e-9)).astype(float)
    known = np.isfinite(moved) & np.isfinite(low[tick])
    left, seen = np.zeros((len(states), DOF)), np.zeros((len(states), DOF))
    np.add.at(left, tick, np.where(known, out, 0.0))
    np.add.at(seen, tick, known.astype(float))
    return np.where(seen > 0.0, (left == 0.0).astype(float), np.nan)


def joint_travel(joints: Floats) -> Floats:
    """(13,) range of each joint, between the 5th and the 95th percentile of its values [m, m, rad..., m]."""
    known = joints[np.isfinite(joints).all(axis=1)]
    if len(known) < 2:
        return np.full(joints.shape[1], np.nan)
    from_first = difference(known, np.repeat(known[:1], len(known), axis=0))
    low, high = np.quantile(from_first, [0.05, 0.95], axis=0)
    found: Floats = high - low
    return found


#: One in this number of audited ticks is used for the union and the curve. One in the second number is used for shorter
#: horizons; it is not in step with 30 Hz cameras, which might otherwise never have a frame near the end.
EVERY, EVERY_SHORTER = 5, 4
#: Factors on the limit set's velocities and accelerations along the curve; ``positions`` grows with their cube.
_FACTORS = {"positions": (0.25, 0.5, 1.0, 2.0)}
_STANDARD_FACTORS = (0.5, 1.0, 2.0, 4.0, 8.0)
#: Minimum range of a joint for a statement on its bounds [m, m, rad..., m].
LITTLE = np.array([0.05] * 2 + [np.radians(10.0)] * 10 + [0.05])
_BATCH = 100


#: Horizons shorter than the braking time, at which a robot near people stops [s]; and methods compared there in
#: addition to the audited one.
SHORTER_S = (0.05, 0.1, 0.2)
_PEERS = ("v2_a50", "iso_13855")


@dataclass(frozen=True)
class LogAudit:
    """Results of the audit of one log."""

    run_config: RunConfig
    name: str
    recording: Recording
    outcomes: dict[str, Outcome]  #: by method, hrcreplay's own first
    joints: dict[str, Floats]  #: by own method: (n, 13) of ``joints_inside``
    curve: dict[str, dict[float, Outcome]]  #: by own method and factor
    horizons: dict[float, dict[str, Outcome]]  #: by shorter horizon [s] and method, at fewer ticks
    errors: Floats  #: (2, n, 13) of ``errors_in_deviations``
    points: dict[str, dict[str, int]]  #: limb -> each point other than its ends -> number of its checked ticks
    notes: tuple[str, ...]


def methods() -> tuple[str, ...]:
    """Hrcreplay's own methods, then the baselines."""
    return (*swept_volumes.METHODS, *baselines.BASELINES)


def factors(method: str) -> tuple[float, ...]:
    """Factors on the limit set's rates along a method's curve, increasing, including 1."""
    return _FACTORS.get(method, _STANDARD_FACTORS)


def volumes(prediction_stage: PredictionStage, window: RecordedFuture, method: str) -> SweptVolumes:
    """Computes swept volumes by any method, own or baseline."""
    if method in baselines.BASELINES:
        return baselines.predict(
            window.states,
            horizon_s=standstill_s(prediction_stage),
            radii_m=limb_radii(prediction_stage.settings),
            hand_m=prediction_stage.settings.hand_m,
            method=method,
        )
    return prediction_stage.volumes(window.states, method=method)


def scale_rates(limits: LimitSet, factor: float) -> LimitSet:
    """Returns a limit set with velocities, accelerations and departures scaled by ``factor``."""
    grown = {name: factor * getattr(limits, name) for name in ("v_min", "v_max", "a_min", "a_max")}
    known = limits.departure
    if known is not None:
        named = ("beyond_m", "residuals", "rise_m", "sink_m", "swings_s")
        scaled = {name: factor * value for name in named if (value := getattr(known, name)) is not None}
        known = replace(known, **scaled)
    return replace(limits, name=f"{limits.name} x {factor:g}", departure=known, **grown)


def compared_methods(prediction_stage: PredictionStage) -> tuple[str, ...]:
    """Methods that are also compared at shorter horizons."""
    return (prediction_stage.method, *_PEERS)


def shorter(prediction_stage: PredictionStage) -> tuple[float, ...]:
    """Those of SHORTER_S below the horizon of an audit [s]."""
    return tuple(h for h in SHORTER_S if h < standstill_s(prediction_stage))


def audit_log(run_config: RunConfig, name: str, watch: Stopwatch) -> list[LogAudit]:
    """Audits each person of one log by all methods.

    Returns:
        One audit a person, named after the log; with several people also after the person. A person who was seen too
        briefly is left out, with a note of the first audit.

    Raises:
        SettingsError: The cell does not fit the log.
        LogError: The log cannot be read, is shorter than the horizon, or shows no person.
    """
    log = open_log(run_config.log, run_config.settings.logs)
    prediction_stage = assembly.prediction_stage(run_config)
    horizon_s = standstill_s(prediction_stage)
    begin_ns, end_ns = span_ns(run_config, log)
    if (end_ns - begin_ns) / NS <= horizon_s:
        raise LogError(
            f"{run_config.log}: found {max(0.0, (end_ns - begin_ns) / NS):.2f} s; an audit needs more than the horizon "
            f"of {horizon_s:g} s"
        )
    ticks_ns = tick_times(begin_ns, end_ns, run_config.settings.fusion.rate_hz)
    with ProgressBar(f"reading {name}", len(ticks_ns)) as bar, watch.stage("record", len(ticks_ns)):
        recordings = read_recordings(
            log, ticks_ns, assembly.fusion_stage(run_config, log), lambda n: bar.advance(f"reading {name}", n)
        )
    found, left_out = [], []
    for number, recording in recordings.items():
        whose = name if len(recordings) == 1 else f"{name}, person {number}"
        try:
            found.append(_audit_person(run_config, whose, recording, tuple(log.notes), watch))
        except LogError as error:
            left_out.append((number, error))
    if not found:
        raise left_out[0][1]
    more = tuple(f"person {number} is not audited: {error}" for number, error in left_out)
    return [replace(found[0], notes=(*found[0].notes, *more)), *found[1:]]


def _audit_person(
    run_config: RunConfig, name: str, recording: Recording, told: tuple[str, ...], watch: Stopwatch
) -> LogAudit:
    """Audits one person by all methods.

    Raises:
        LogError: The person was not seen for longer than the horizon, or nothing can be checked.
    """
    prediction_stage = assembly.prediction_stage(run_config)
    horizon_s = standstill_s(prediction_stage)
    fusion, end_ns = run_config.settings.fusion, int(max(recording.states.t_ns[-1], recording.t_ns[-1]))
    rows = select_rows(recording.states, end_ns, fusion.rate_hz, horizon_s, fusion.fresh_s)
    if not len(rows):
        raise LogError(f"{run_config.log}: nobody was seen for longer than the horizon of {horizon_s:g} s")
    future = recorded_future(recording.t_ns, recording.points_m, recording.states.rows(rows), horizon_s)
    outcomes, curve = {}, {}
    stage = f"auditing {name}"
    more = sum(len(factors(method)) - 1 for method in swept_volumes.METHODS)
    few = len(shorter(prediction_stage)) * len(compared_methods(prediction_stage)) * len(rows[::EVERY_SHORTER])
    work = len(rows) * len(methods()) + more * len(rows[::EVERY]) + few
    with ProgressBar(stage, work) as bar:
        progress = partial(bar.advance, stage)
        for method in methods():
            with watch.stage(f"audit {method}", len(rows)):
                outcomes[method] = _hold(prediction_stage, future, method, EVERY, progress)
        if not np.isfinite(outcomes[prediction_stage.method].beyond_m).any():
            raise LogError(
                f"{run_config.log}: nothing to check: no limb was both predicted and seen to the end of the horizon of "
                f"{horizon_s:g} s"
            )
        for method in swept_volumes.METHODS:
            with watch.stage(f"curve {method}", len(rows)):
                curve[method] = _curve(prediction_stage, future, method, outcomes[method], progress)
        with watch.stage("shorter horizons", len(rows)):
            horizons = _shorter(prediction_stage, recording, rows[::EVERY_SHORTER], progress)
    joints = {}
    for method in swept_volumes.METHODS:
        interval = prediction_stage.by(method).reachable(future.states)
        joints[method] = joints_inside(recording, future.states, interval, horizon_s)
    notes = (*told, *_remarks(recording, len(rows) / AUDIT_HZ, horizon_s))
    errors = errors_in_deviations(recording, rows)
    return LogAudit(run_config, name, recording, outcomes, joints, curve, horizons, errors, future.points(), notes)


def _hold(
    prediction_stage: PredictionStage,
    future: RecordedFuture,
    method: str,
    union_every: int,
    progress: Callable[[int], None],
) -> Outcome:
    n = len(future.states)
    parts = []
    for first in range(0, n, _BATCH):
        some = future.rows(slice(first, first + _BATCH))
        counted = np.arange(first, first + len(some.states)) % union_every == 0
        swept, limb_radius = volumes(prediction_stage, some, method), body_radii_m(prediction_stage)
        parts.append(check_containment(swept, some, limb_radius, counted, first))
        progress(len(some.states))
    return Outcome.join(parts)


def _curve(
    prediction_stage: PredictionStage,
    future: RecordedFuture,
    method: str,
    standard: Outcome,
    progress: Callable[[int], None],
) -> dict[float, Outcome]:
    """Evaluates the method with scaled limits, at fewer ticks; factor 1 is its ``standard`` outcome with all ticks."""
    some = future.rows(np.arange(0, len(future.states), EVERY))
    found = {1.0: standard}
    for factor in factors(method):
        if factor not in found:
            wider = replace(prediction_stage, limits=scale_rates(prediction_stage.limits, factor))
            found[factor] = _hold(wider, some, method, 2, progress)
    return dict(sorted(found.items()))


def _shorter(
    prediction_stage: PredictionStage, recording: Recording, rows: Ints, progress: Callable[[int], None]
) -> dict[float, dict[str, Outcome]]:
    """Computes the coverage at shorter horizons: total time from tick to standstill, including the latency."""
    found: dict[float, dict[str, Outcome]] = {}
    for horizon_s in shorter(prediction_stage):
        stop_s = horizon_s - prediction_stage.settings.latency_s
        prediction = prediction_stage.settings.model_copy(update={"stop_s": stop_s})
        stage, states = replace(prediction_stage, settings=prediction), recording.states.rows(rows)
        future = recorded_future(recording.t_ns, recording.points_m, states, horizon_s)
        found[horizon_s] = {m: _hold(stage, future, m, 1, progress) for m in compared_methods(stage)}
    return found


def _remarks(recording: Recording, audited_s: float, horizon_s: float) -> tuple[str, ...]:
    """Returns remarks on one log's figures."""
    notes = [f"the recorded future is the {recording.source}"]
    if others := recording.counts.get("person_frames_beside_others"):
        notes.append(f"{others} frames show at least one other body: nothing was predicted of it, and nothing audited")
    went = joint_travel(recording.joints)
    still = [
        f"{joint} ({went[j]:.2f} m)" if joint not in ANGLES else f"{joint} ({np.degrees(went[j]):.0f} deg)"
        for j, joint in enumerate(JOINTS)
        if not went[j] >= LITTLE[j]
    ]
    if still:
        notes.append(f"hardly moved, so the audit hardly tests their bounds: {', '.join(still)}")
    if (went[ARMS] < LITTLE[ARMS]).all():
        notes.append("no arm motion: the shares of the arms are not valid for a person at work")
    if audited_s < 10.0 * horizon_s:
        notes.append(f"only {audited_s:.1f} s audited: the intervals are wide")
    return tuple(notes)
