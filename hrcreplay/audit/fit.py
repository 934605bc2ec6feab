"""``fit-limits``: from logs of people to the limit set that holds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay import __version__, wiring
from hrcreplay.audit import tightening
from hrcreplay.audit.fit_words import lines
from hrcreplay.audit.recording import SMOOTHED, TRUTH, Recording, record
from hrcreplay.audit.window import standstill_s, window
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.human import fitting
from hrcreplay.human.ballistic import ballistic
from hrcreplay.human.fitting import Fit, Futures
from hrcreplay.human.model import LimitSet
from hrcreplay.job import Job, resolve
from hrcreplay.limits import load_limits, write_limits
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import NS, tick_times
from hrcreplay.progress import Bar
from hrcreplay.records import JOINTS, LIMBS, Floats
from hrcreplay.report.coverage import Estimate, block_ticks, resample
from hrcreplay.wiring import log_options

#: Ticks a second that are fitted to [Hz]; what no camera has seen for longer is no evidence [s]; of the bootstrap.
FIT_HZ, SEEN_S, SEED = 25.0, 0.25, 3
#: The limit sets that joints keep which cannot be fitted, and whose positions hold more than those.
STANDARD, WIDE, KEPT = "paper", "human", "people"
#: What the coverage is of: joints in their intervals, or limbs in their volumes.
COVERS = ("joints", "limbs")


@dataclass(frozen=True)
class Sample:
    """One log's ticks, the first part to fit on, the last to try the fit on."""

    job: Job
    name: str
    source: str
    training: Futures
    held_back: Futures
    outside: bool  #: whether a training posture is outside the standard positions
    limbs: tightening.Held


def run(
    logs: Sequence[Path],
    *,
    out: Path,
    coverage: float = 0.99,
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    cell_file: Path | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    held_back: float = 0.3,
    cover: str = "joints",
) -> list[str]:
    """Fits velocity and acceleration bounds to logs and writes them as a limit set.

    The last part of every log is held back: nothing is fitted to it. With several logs each is also left out as a
    whole once, to tell how far bounds fitted to the others hold the person of this one.

    Args:
        logs: Logs, or run folders whose logs, settings and cells are taken.
        out: Limit set to write (TOML), with provenance.
        coverage: Share of the ticks in which all fitted joints shall stay inside their intervals.
        config: Settings file.
        overrides: ``section.key=value``.
        cell_file: Poses of the cameras.
        start_s: First second of every log.
        end_s: Last one.
        held_back: Share of every log's time, its end.
        cover: ``joints``: of ticks with all fitted joints in their intervals of Alg. 1. ``limbs``: of ticks with
            all limbs that were seen, the lower body too, in the volumes of ``occupancy.method``, margins and all.

    Returns:
        What the user should know, line by line.

    Raises:
        SettingsError: A setting cannot be used, or ``out`` exists.
        LogError: A log cannot be read, is too short, or shows no arm motion.
    """
    _refuse(logs, out, coverage, held_back, cover)
    shared = {"config": config, "overrides": overrides, "cell_file": cell_file, "start_s": start_s, "end_s": end_s}
    jobs = [resolve("fit-limits", log, **shared) for log in logs]  # type: ignore[arg-type]
    horizon_s = _horizon_s(jobs)
    samples = [_sample(job, horizon_s, held_back) for job in jobs]
    found = _fit(samples, coverage, horizon_s)
    limits = _limits(found, samples, out.stem)
    limbs: dict[str, Any] = {}
    if cover == "limbs":
        training = Futures.join([sample.training for sample in samples])
        found = ballistic(training, load_limits(KEPT), tightening.BEFORE, horizon_s)
        found, limbs = _tightened([sample.limbs for sample in samples], found, limits, coverage, horizon_s)
        limits = found.onto(limits, out.stem)
    facts = _facts(samples, found, limits, coverage, horizon_s, held_back) | {"covers": cover} | limbs
    write_limits(limits, facts, out)
    return lines(found, limits, facts, STANDARD)


def _refuse(logs: Sequence[Path], out: Path, coverage: float, held_back: float, cover: str) -> None:
    """Raises SettingsError for what cannot be used."""
    if not 0.0 < coverage < 1.0:
        raise SettingsError(f"--coverage {coverage:g}: would be right: a share above 0 and below 1, e.g. 0.99")
    if held_back == 0.0:
        raise SettingsError("--held-back 0: nothing is left to try the fit on; would be right: a share, e.g. 0.3")
    if held_back == 1.0:
        raise SettingsError("--held-back 1: nothing is left to fit to; would be right: a share, e.g. 0.3")
    if not 0.0 < held_back < 1.0:
        raise SettingsError(f"--held-back {held_back:g}: would be right: a share above 0 and below 1, e.g. 0.3")
    if cover not in COVERS:
        raise SettingsError(f"--cover {cover}: would be right: {', '.join(COVERS)}")
    if not logs:
        raise SettingsError("fit-limits: found no log; give at least one")
    if out.exists():
        raise SettingsError(f"{out}: exists already; name another file, or remove it")


def _horizon_s(jobs: Sequence[Job]) -> float:
    horizons = {wiring.foresight(job).horizon_s for job in jobs}
    if len(horizons) > 1:
        raise SettingsError(f"occupancy.stop_s: found {sorted(horizons)} s; all logs need one horizon, set it")
    return horizons.pop()


def _sample(job: Job, horizon_s: float, held_back: float) -> Sample:
    log = open_log(job.log, log_options(job.settings))
    first_ns = log.header.start_ns
    begin_ns = first_ns + round((job.start_s or 0.0) * NS)
    end_ns = log.header.end_ns if job.end_s is None else min(log.header.end_ns, first_ns + round(job.end_s * NS))
    cut_ns = end_ns - round(held_back * (end_ns - begin_ns))
    if min(cut_ns - begin_ns, end_ns - cut_ns) / NS <= horizon_s:
        raise LogError(
            f"{job.log}: found {max(0.0, (end_ns - begin_ns) / NS):.2f} s; the part to fit on and the part held back "
            f"both need more than the horizon of {horizon_s:g} s"
        )
    rate_hz = job.settings.fusion.rate_hz
    ticks_ns = tick_times(begin_ns, end_ns, rate_hz)
    stage = f"reading {job.log.name}"
    with Bar(stage, len(ticks_ns)) as bar:
        recording = record(log, ticks_ns, wiring.eyes(job, log), lambda n: bar.advance(stage, n))
    states, joints = recording.states, recording.joints
    if recording.source != TRUTH:
        joints = fitting.believed(joints, states.unseen_s, SEEN_S)
    every = max(1, round(rate_hz / FIT_HZ))
    ticks = np.arange(0, len(states), every)
    some = fitting.futures(
        states,
        ticks[np.isfinite(states.p[ticks]).all(axis=1)],
        recording.joints_t_ns,
        joints,
        horizon_s=horizon_s,
        memory_s=SEEN_S,
    )
    training = states.rows(states.t_ns <= cut_ns)
    return Sample(
        job,
        job.log.name,
        TRUTH if recording.source == TRUTH else SMOOTHED,
        some.rows(some.t_ns + round(horizon_s * NS) <= cut_ns),
        some.rows(some.t_ns > cut_ns),
        bool(fitting.leave(training.p, load_limits(STANDARD)).any()),
        _limbs(job, recording, cut_ns),
    )


def _limbs(job: Job, recording: Recording, cut_ns: int) -> tightening.Held:
    foresight, states = wiring.foresight(job), recording.states
    horizon_s = standstill_s(foresight)
    horizon_ns = round(horizon_s * NS)
    ticks = np.arange(0, len(states), max(1, round(job.settings.fusion.rate_hz / tightening.TIGHTEN_HZ)))
    ticks = ticks[np.isfinite(states.residual_m[ticks, : len(LIMBS)]).all(axis=1)]  # the filter has found the person
    end_ns = states.t_ns[ticks] + horizon_ns
    parts = ticks[end_ns <= cut_ns], ticks[(states.t_ns[ticks] > cut_ns) & (end_ns <= recording.t_ns[-1])]
    return tightening.Held(foresight, *(window(recording, part, horizon_s) for part in parts))


def _tightened(
    people: Sequence[tightening.Held], found: Fit, limits: LimitSet, coverage: float, horizon_s: float
) -> tuple[Fit, dict[str, Any]]:
    """The fit with the accelerations that hold the limbs, and what it holds of all logs together and of each."""
    factor = tightening.factor(people, found, limits, coverage)
    found = tightening.scaled(found, factor)
    limits = found.onto(limits, limits.name)
    shares: dict[str, Any] = {}
    for name in ("training", "held_back"):
        parts = [tightening.stayed(one.foresight, getattr(one, name), limits)[:, None] for one in people]
        shares[name] = _plain(_share(parts, horizon_s, tightening.TIGHTEN_HZ))
        shares[f"{name}_by_log"] = [_plain(_share([part], horizon_s, tightening.TIGHTEN_HZ)) for part in parts]
    method, gaps = people[0].foresight.method, tightening.unchecked(people)
    return found, {"factor": round(factor, 4), "method": method, "not_checked": gaps, "limbs": shares}


def _fit(samples: Sequence[Sample], coverage: float, horizon_s: float) -> Fit:
    training = Futures.join([sample.training for sample in samples])
    try:
        return fitting.fit(training, load_limits(KEPT), coverage, horizon_s)
    except LogError as error:
        raise LogError(f"{', '.join(sample.name for sample in samples)}: {error}") from error


def _limits(found: Fit, samples: Sequence[Sample], name: str) -> LimitSet:
    """Positions are the standard ones, or where somebody was outside of these, the outer of both sets."""
    standard, wide = load_limits(STANDARD), load_limits(WIDE)
    if any(sample.outside for sample in samples):
        p_min, p_max = np.minimum(standard.p_min, wide.p_min), np.maximum(standard.p_max, wide.p_max)
        standard = replace(standard, p_min=p_min, p_max=p_max, coupled=False)
    return found.onto(standard, name)


def _share(within: Sequence[Floats], horizon_s: float, rate_hz: float = FIT_HZ) -> Estimate:
    """Share of the ticks of some logs in which all joints stayed inside, with its interval."""
    hits = [fitting.together(part) for part in within]
    lengths = [len(part) for part in hits]
    drawn = resample(lengths, block_ticks(horizon_s, rate_hz, max(lengths)), horizon_s * rate_hz, SEED)
    return drawn.share(np.concatenate(hits))


def _facts(
    samples: Sequence[Sample], found: Fit, limits: LimitSet, coverage: float, horizon_s: float, held_back: float
) -> dict[str, Any]:
    """The limit set's provenance."""
    fitted = ~found.kept
    trained = [fitting.inside(sample.training, found, horizon_s) for sample in samples]
    held = [fitting.inside(sample.held_back, found, horizon_s) for sample in samples]

    def shares(training: Sequence[Floats], rest: Sequence[Floats]) -> dict[str, Any]:
        return {
            "training": _plain(_share([part[:, fitted] for part in training], horizon_s)),
            "held_back": _plain(_share([part[:, fitted] for part in rest], horizon_s)),
            "held_back_all_joints": _plain(_share(rest, horizon_s)),
        }

    logs = []
    for i, sample in enumerate(samples):
        facts: dict[str, Any] = {"name": sample.name, "sha256": sample.job.log_sha256, "recorded_future": sample.source}
        facts |= {key: s for key, s in (("start_s", sample.job.start_s), ("end_s", sample.job.end_s)) if s is not None}
        facts |= shares(trained[i : i + 1], held[i : i + 1])
        others = [*samples[:i], *samples[i + 1 :]]
        if any(fitting.arms_move(other.training).any() for other in others):
            foreign = _fit(others, coverage, horizon_s)
            both = [fitting.inside(part, foreign, horizon_s) for part in (sample.training, sample.held_back)]
            facts["left_out"] = _plain(_share([np.concatenate(both)[:, ~foreign.kept]], horizon_s))
        logs.append(facts)
    each = {
        joint: {
            "kept": bool(found.kept[j]),
            "excursions": int(found.excursions[j]),
            "training": _plain(_share([part[:, j : j + 1] for part in trained], horizon_s)),
            "held_back": _plain(_share([part[:, j : j + 1] for part in held], horizon_s)),
        }
        for j, joint in enumerate(JOINTS)
    }
    return {
        "made_by": f"hrcreplay {__version__} fit-limits",
        "coverage_requested": coverage,
        "horizon_s": horizon_s,
        "held_back_share": held_back,
        "ticks_hz": FIT_HZ,
        "kept": [joint for j, joint in enumerate(JOINTS) if found.kept[j]],
        "kept_from": KEPT,
        "positions": STANDARD if limits.coupled else f"{STANDARD} and {WIDE}, the outer of both",
        "total": shares(trained, held),
        "joints": each,
        "logs": logs,
    }


def _plain(share: Estimate) -> dict[str, Any]:
    """A share with its interval and its ticks; without what is not known."""
    numbers = {"share": share.value, "low": share.low, "high": share.high}
    return {key: round(value, 4) for key, value in numbers.items() if np.isfinite(value)} | {"ticks": share.samples}
