"""The command ``fit-limits``: velocity and acceleration bounds fitted to logs, written as a limit set.

With ``cover = "limbs"`` it also bounds the departure of whole limbs from constant velocity (``departures``), so that
the swept volumes, not only the joint intervals, contain the people of the logs in the required share of the ticks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple, Unpack

import numpy as np

from hrcreplay.audit import COVER, COVERAGE, HELD_BACK, fit_limits
from hrcreplay.audit.departure_fit import EACH, counted, others_need, widen
from hrcreplay.audit.departure_fit import fit as fit_departures
from hrcreplay.audit.departures import EXACT, LimbDepartures, capsules_m3, departures, find_unrecorded_limbs, union_m3
from hrcreplay.audit.fit_limits import Fit, Futures
from hrcreplay.audit.measures import Estimate, block_ticks, resample
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.evaluation.recorded_person import SMOOTHED, TRUTH
from hrcreplay.evaluation.recording import Recording, read_recording
from hrcreplay.human.model import Departure, LimitSet
from hrcreplay.human.prediction.velocity_tube import FASTEST_M_PER_S
from hrcreplay.limits import load_limits, write_limits
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.kernel_build import ensure_compiled
from hrcreplay.pipeline.progress import ProgressBar
from hrcreplay.pipeline.run_config import RunConfig, RunOptions, resolve
from hrcreplay.pipeline.stages import NS, span_ns, tick_times
from hrcreplay.pipeline.surroundings import PredictionStage
from hrcreplay.records import BODY, JOINTS, Floats
from hrcreplay.reporting.tables import share_text
from hrcreplay.version import __version__


def lines(found: Fit, limits: LimitSet, facts: dict[str, Any], standard: str) -> list[str]:
    """Returns the lines on a fit for the user.

    Args:
        found: The fit.
        limits: The limit set made of it.
        facts: Its provenance.
        standard: Limit set whose positions are used if no recorded posture is outside of them.
    """
    told = [
        f"{joint}: velocity {limits.v_min[j]:g} to {limits.v_max[j]:g}, acceleration {limits.a_min[j]:g} to "
        f"{limits.a_max[j]:g}; held back {_text(facts['joints'][joint]['held_back'])}"
        for j, joint in enumerate(JOINTS)
        if not found.kept[j]
    ]
    if facts["kept"]:
        told.append(
            f"too little motion for a result (under {fit_limits.EXCURSIONS} horizons with motion), so the bounds of "
            f"{facts['kept_from']} stay: {', '.join(facts['kept'])}"
        )
    if len(facts["kept"]) == len(JOINTS):
        told.append(f"no joint was fitted: these are the rates of {facts['kept_from']} under another name")
    if "and" in facts["positions"]:
        told.append(f"recorded postures leave the positions of {standard}: written are {facts['positions']}")
    for log in facts["logs"]:
        left_out = f"; fitted to the other logs {_text(log['left_out'])}" if "left_out" in log else ""
        told.append(f"{log['name']}: training {_text(log['training'])}; held back {_text(log['held_back'])}{left_out}")
    total = facts["total"]
    told.append(f"all joints: training {_text(total['training'])}; held back {_text(total['held_back'])}")
    if "departures" in facts:
        told += _departure_lines(facts["departures"])
    told[-1] = f"fit-limits: {limits.name}: {told[-1]}"
    return told


def _text(share: dict[str, Any]) -> str:
    if "share" not in share:
        return "unknown"
    numbers = share_text(share["share"])
    if "low" in share:
        numbers += f" ({share_text(share['low'])} to {share_text(share['high'])})"
    return f"{numbers} of {share['ticks']} ticks"


def _departure_lines(found: dict[str, Any]) -> list[str]:
    gaps = found["not_checked"]
    told = [f"not checked, so there is no result: {', '.join(gaps)}"] if gaps else []
    for log in found["logs"]:
        sizes, best = (", ".join(f"{size:.1f}" for size in log[name]) for name in ("union_m3", "fitted_to_it_m3"))
        held = f"{log['name']}: {found['unknown_are']}: {_by_horizon(found, log['shares'])}"
        told.append(f"{held}; union {sizes} m3, fitted to it alone {best} m3")
    told += [f"{group['name']}: {_by_horizon(found, group['shares'])}" for group in found["groups"]]
    training, unknown = (_by_horizon(found, found[part]) for part in ("training", "unknown"))
    return [*told, f"whole limbs, {found['pooled_are']}: training {training}; {found['unknown_are']} {unknown}"]


def _by_horizon(found: dict[str, Any], shares: Sequence[dict[str, Any]]) -> str:
    each = zip(found["horizon_s"], shares, strict=True)
    return ", ".join(f"{h:g} s {_text(share).split(' of ')[0]}" for h, share in each)


class FitReport(NamedTuple):
    """Report of a fit."""

    lines: list[str]  #: notes for the user
    missed: str  #: cases in which whole limbs in held-out recordings are covered less than requested; empty: none


#: Rate of the fitted ticks [Hz]; maximum time since a camera saw a fitted joint [s]; seed of the bootstrap.
FIT_HZ, SEEN_S, SEED = 25.0, 0.25, 3
#: Limit set with the standard positions, one with wider positions, and one for joints that cannot be fitted.
STANDARD, WIDE, KEPT = "paper", "human", "human"
#: Kinds of coverage: joints in their intervals, or limbs in their volumes.
COVERS = ("joints", "limbs")


@dataclass(frozen=True)
class FitSample:
    """One log's ticks: the first part to fit on, the last part to test the fit on."""

    run_config: RunConfig
    name: str
    source: str
    training: Futures
    held_back: Futures
    outside: bool  #: True: a training posture is outside the standard positions
    prediction_stage: PredictionStage
    limbs: LimbDepartures  #: departures of the whole log; empty if not requested
    cut_ns: int  #: end of the first part


#: Rate of the ticks whose departures are measured [Hz]; not a multiple of camera rates of 25, 30 and 50 Hz, so that all
#: ages of the last frame occur.
DEPARTURES_HZ = 27.8


def run(
    logs: Sequence[Path],
    *,
    out: Path,
    coverage: float = COVERAGE,
    held_back: float = HELD_BACK,
    cover: str = COVER,
    groups: Sequence[str] | None = None,
    checked: Sequence[str] = (),
    **options: Unpack[RunOptions],
) -> FitReport:
    """Fits velocity and acceleration bounds to logs and writes them as a limit set.

    The last part of every log is held back from the fit. With several logs, each is also left out once as a whole, to
    measure the coverage of its person by bounds fitted to the others. For the departures of limbs, all logs of a group
    are left out together.

    Args:
        logs: Logs, or run folders whose logs, settings and cells are taken.
        out: Limit set to write (TOML), with provenance.
        coverage: Required share of the ticks in which all fitted joints stay inside their intervals.
        held_back: Share of every log's time that is held back, at its end.
        cover: ``joints``: bounds on the joints, whose intervals of Alg. 1 cover that share. ``limbs``: also bounds on
            the departure of whole limbs, including the lower body, from constant velocity in that share of the ticks.
        groups: Name of the tracker and person of each log; None: every log has its own.
        checked: Groups that are not fitted; with ``limbs`` their coverage is measured.
        **options: Settings, cell and span, as ``run_config.resolve`` takes them.

    Returns:
        Notes for the user, and the cases in which the share was missed.

    Raises:
        SettingsError: A setting cannot be used, or ``out`` exists.
        LogError: A log cannot be read, is too short, or shows no arm motion.
    """
    _refuse(logs, out, coverage, held_back, cover)
    ensure_compiled()
    run_configs = [resolve("fit-limits", log, **options) for log in logs]
    horizon_s = _horizon_s(run_configs)
    samples = [_sample(run_config, horizon_s, held_back, cover == "limbs") for run_config in run_configs]
    names = [sample.name for sample in samples] if groups is None else groups
    fitted = [sample for sample, name in zip(samples, names, strict=True) if name not in checked]
    found = _fit(fitted, coverage, horizon_s)
    limits = _limits(found, fitted, out.stem)
    facts = _facts(fitted, found, limits, coverage, horizon_s, held_back) | {"covers": cover}
    missed = ""
    if cover == "limbs":
        departure, facts["departures"], missed = _departures(samples, coverage, names, checked)
        limits = replace(limits, departure=departure)
    write_limits(limits, facts, out)
    return FitReport(lines(found, limits, facts, STANDARD), missed)


def _refuse(logs: Sequence[Path], out: Path, coverage: float, held_back: float, cover: str) -> None:
    """Raises SettingsError for invalid arguments."""
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


def _horizon_s(run_configs: Sequence[RunConfig]) -> float:
    horizons = {assembly.prediction_stage(run_config).horizon_s for run_config in run_configs}
    if len(horizons) > 1:
        raise SettingsError(f"prediction.stop_s: found {sorted(horizons)} s; all logs need one horizon, set it")
    return horizons.pop()


def _sample(run_config: RunConfig, horizon_s: float, held_back: float, limbs: bool) -> FitSample:
    log = open_log(run_config.log, run_config.settings.logs)
    begin_ns, end_ns = span_ns(run_config, log)
    cut_ns = end_ns - round(held_back * (end_ns - begin_ns))
    if min(cut_ns - begin_ns, end_ns - cut_ns) / NS <= horizon_s:
        raise LogError(
            f"{run_config.log}: found {max(0.0, (end_ns - begin_ns) / NS):.2f} s; the part to fit on and the part held "
            f"back both need more than the horizon of {horizon_s:g} s"
        )
    rate_hz = run_config.settings.fusion.rate_hz
    ticks_ns = tick_times(begin_ns, end_ns, rate_hz)
    stage = f"reading {run_config.log.name}"
    with ProgressBar(stage, len(ticks_ns)) as bar:
        recording = read_recording(
            log, ticks_ns, assembly.fusion_stage(run_config, log), lambda n: bar.advance(stage, n)
        )
    states, joints = recording.states, recording.joints
    if recording.source != TRUTH:
        joints = fit_limits.recently_seen(joints, states.unseen_s, SEEN_S)
    every = max(1, round(rate_hz / FIT_HZ))
    ticks = np.arange(0, len(states), every)
    ticks = ticks[np.isfinite(states.p[ticks]).all(axis=1)]
    some = fit_limits.futures(states, ticks, recording.joints_t_ns, joints, horizon_s=horizon_s, memory_s=SEEN_S)
    training = states.rows(states.t_ns <= cut_ns)
    return FitSample(
        run_config,
        run_config.log.name,
        TRUTH if recording.source == TRUTH else SMOOTHED,
        some.rows(some.t_ns + round(horizon_s * NS) <= cut_ns),
        some.rows(some.t_ns > cut_ns),
        bool(fit_limits.outside_positions(training.p, load_limits(STANDARD)).any()),
        assembly.prediction_stage(run_config),
        _limbs(run_config, recording, limbs),
        cut_ns,
    )


def _limbs(run_config: RunConfig, recording: Recording, wanted: bool) -> LimbDepartures:
    """Measures the departures in a recording; at no tick if not requested."""
    stage, states = assembly.prediction_stage(run_config), recording.states
    horizon_ns = round(stage.horizon_s * NS)
    ticks = np.arange(0, len(states), max(1, round(run_config.settings.fusion.rate_hz / DEPARTURES_HZ)))
    known = np.isfinite(states.p[ticks]).all(axis=1)
    ticks = ticks[known & (states.frame_age_s[ticks] <= run_config.settings.fusion.fresh_s)]
    ticks = ticks[states.t_ns[ticks] + horizon_ns <= recording.t_ns[-1]] if wanted else ticks[:0]
    return departures(stage, recording, ticks)


def _parts(sample: FitSample) -> tuple[LimbDepartures, LimbDepartures]:
    """Returns the ticks of the first part of a log, horizon included, and of the last part."""
    whole, t_ns = sample.limbs, sample.limbs.states.t_ns
    first = t_ns + round(sample.prediction_stage.horizon_s * NS) <= sample.cut_ns
    return whole.rows(np.flatnonzero(first)), whole.rows(np.flatnonzero(t_ns > sample.cut_ns))


def _departures(
    samples: Sequence[FitSample], coverage: float, groups: Sequence[str], checked: Sequence[str]
) -> tuple[Departure, dict[str, Any], str]:
    """Returns the departures fitted to all logs, the coverage by them and by fits without a group, and the misses."""
    apart = len(set(groups) - set(checked)) > 1
    divided = _leave_out_groups(samples, coverage, groups, checked) if apart else _hold_back(samples, coverage)
    fitted, known, folds, factors = divided
    found = widen(fit_departures(fitted, coverage), factors)
    horizons = range(len(found.horizon_s))
    inside = [[one.inside(fold, k) for k in horizons] for one, fold in zip(known, folds, strict=True)]
    recorded = counted(known)

    def shares(hits: Sequence[Floats], k: int) -> dict[str, Any]:
        return _plain(_share([of[:, None] for of in hits], found.horizon_s[k], DEPARTURES_HZ))

    logs: list[dict[str, Any]] = [
        {
            "name": sample.name,
            "group": group,
            "shares": [shares([hits[k]], k) for k in horizons],
            **_sizes(sample.prediction_stage, one, fold, coverage),
            "misses": _misses(one, fold, hits, coverage),
        }
        for sample, group, one, fold, hits in zip(samples, groups, known, folds, inside, strict=True)
    ]

    def pooled(every: Sequence[Sequence[Floats]], which: Sequence[bool]) -> list[dict[str, Any]]:
        return [shares(list(compress((hits[k] for hits in every), which)), k) for k in horizons]

    facts = {
        "horizon_s": found.horizon_s.tolist(),
        "ticks_hz": DEPARTURES_HZ,
        "widened": factors.tolist(),
        "unknown_are": "each tracker and person left out once" if apart else "the part held back",
        "pooled_are": "all logs" if all(recorded) else "logs without the truth",
        "training": pooled([[one.inside(found, k) for k in horizons] for one in fitted], counted(fitted)),
        "not_fitted": list(checked),
        "unknown": pooled(inside, recorded),
        "groups": [
            {
                "name": name,
                "shares": pooled(inside, [own == name for own in groups]),
                "union_m3": np.mean([log["union_m3"] for log in logs if log["group"] == name], axis=0)
                .round(3)
                .tolist(),
            }
            for name in dict.fromkeys(groups)
        ],
        "of_recordings": _of_recordings(fitted, found, coverage),
        "not_checked": find_unrecorded_limbs(known),
        "logs": logs,
    }
    return found, facts, _missed(facts, coverage)


class _Division(NamedTuple):
    """What is fitted, and what is judged by fits that have not seen it."""

    fitted: list[LimbDepartures]
    known: list[LimbDepartures]  #: judged, one per log
    folds: list[Departure]  #: the fit that judges each of them
    factors: Floats  #: by which the fit to all is wider, one a horizon or one for all


def _leave_out_groups(
    samples: Sequence[FitSample], coverage: float, groups: Sequence[str], checked: Sequence[str]
) -> _Division:
    """Divides logs by trackers and persons: each of these is judged by a fit to the others."""
    known = [sample.limbs for sample in samples]
    named = [(name, _settled(of)) for name, of in zip(groups, known, strict=True) if name not in checked]
    others = {name: [of for own, of in named if own != name] for name in groups}
    each = {name: fit_departures(rest, coverage) for name, rest in others.items()}
    left_out = [(own, of, each[own]) for own, of in zip(groups, known, strict=True) if own not in checked]
    folds = [widen(each[name], _factors(left_out, name, coverage)) for name in groups]
    return _Division([of for _, of in named], known, folds, _factors(left_out, None, coverage))


def _hold_back(samples: Sequence[FitSample], coverage: float) -> _Division:
    """Divides each log in time: its end is judged by a fit to the beginnings."""
    parts = [_parts(sample) for sample in samples]
    fitted, known = [_settled(first) for first, _ in parts], [last for _, last in parts]
    return _Division(fitted, known, [fit_departures(fitted, coverage)] * len(known), np.ones(1))


def _factors(left_out: Sequence[tuple[str, LimbDepartures, Departure]], group: str | None, coverage: float) -> Floats:
    """Returns the factors that people of other groups than one need on lines fitted without them."""
    others = [(of, fold) for name, of, fold in left_out if name != group]
    return others_need([of for of, _ in others], [fold for _, fold in others], coverage)


def _settled(of: LimbDepartures) -> LimbDepartures:
    """Returns the ticks for the fit: later than a person's first second, which the unknown residual bounds."""
    return of.rows(np.flatnonzero(of.settled))


def _of_recordings(fitted: Sequence[LimbDepartures], found: Departure, coverage: float) -> dict[str, Any]:
    """Returns the share of the bounds, for a limb at rest and at full speed, that logs without ground truth alone give.

    The rest comes from simulated people. Empty if all logs are of one kind.
    """
    recorded = [of for of in fitted if not of.true]
    if len(recorded) in (0, len(fitted)):
        return {}
    alone = fit_departures(recorded, coverage)

    def reached_m(departure: Departure, speed_m_per_s: float) -> Floats:
        swings = 0.0 if departure.swings_s is None else departure.swings_s
        return np.asarray(departure.beyond_m + speed_m_per_s * swings)

    def parts(speed_m_per_s: float) -> dict[str, list[float]]:
        share = reached_m(alone, speed_m_per_s) / np.maximum(reached_m(found, speed_m_per_s), EXACT)
        return {limb: np.round(np.minimum(share[k], 1.0), 2).tolist() for k, limb in enumerate(BODY)}

    return {"at_rest": parts(0.0), "at_full_speed": parts(FASTEST_M_PER_S)}


def _misses(one: LimbDepartures, fold: Departure, hits: Sequence[Floats], coverage: float) -> list[dict[str, Any]]:
    """Returns the limbs that left at the horizons at which a recording stays under its share, tick by tick.

    Of each: time since the log's first tick, horizon [s], distance from where its velocity takes it [m], and that
    distance over the horizon [m/s]: the speed, beside its own, at which people move or a tracker throws a limb.
    """
    found = []
    for k, held in enumerate(hits):
        if one.true or (held == 0.0).sum() <= EACH * (1.0 - coverage) * np.isfinite(held).sum():
            continue
        horizon_s = float(fold.horizon_s[k])
        departed = one.beyond_m(k, float(fold.rise_m[k]), float(fold.sink_m[k]))
        for tick, limb in np.argwhere(one.factors(fold, k) > 1.0 + EXACT).tolist():
            far = float(departed[tick, limb])
            at_s = float(one.states.t_ns[tick] - one.states.t_ns[0]) / NS
            row = {"at_s": round(at_s, 2), "horizon_s": horizon_s, "limb": BODY[limb]}
            found.append(row | {"departed_m": round(far, 2), "m_per_s": round(far / horizon_s, 1)})
    return found


def _sizes(stage: PredictionStage, one: LimbDepartures, fold: Departure, coverage: float) -> dict[str, list[float]]:
    """Volumes [m^3] of a log's people: by the fold; without the lower body, like the capsules; by its own fit."""
    found = {
        "union_m3": union_m3(stage, one, fold),
        "union_without_legs_m3": union_m3(stage, one, fold, legs=False),
        "capsules_m3": capsules_m3(stage, one),
        "fitted_to_it_m3": union_m3(stage, one, fit_departures([_settled(one)], coverage)),
    }
    return {name: [round(size, 3) for size in sizes] for name, sizes in found.items()}


def _missed(facts: dict[str, Any], coverage: float) -> str:
    """Returns the cases of held-out whole limbs with less than the required coverage."""
    wanted = [(facts["pooled_are"], facts["unknown"], coverage)]
    fitted = [log for log in facts["logs"] if log["group"] not in facts["not_fitted"]]
    wanted += [(log["name"], log["shares"], 1.0 - EACH * (1.0 - coverage)) for log in fitted]
    return "; ".join(
        f"{name}: found {share_text(share['share'])} at {h:g} s; would be right: at least {share_text(least)}"
        for name, shares, least in wanted
        for h, share in zip(facts["horizon_s"], shares, strict=True)
        if share.get("share", 1.0) < least
    )


def _fit(samples: Sequence[FitSample], coverage: float, horizon_s: float) -> Fit:
    training = Futures.join([sample.training for sample in samples])
    try:
        return fit_limits.fit(training, load_limits(KEPT), coverage, horizon_s)
    except LogError as error:
        raise LogError(f"{', '.join(sample.name for sample in samples)}: {error}") from error


def _limits(found: Fit, samples: Sequence[FitSample], name: str) -> LimitSet:
    """Returns the limits, with the standard positions or, if a posture exceeds them, the outer of both sets."""
    standard, wide = load_limits(STANDARD), load_limits(WIDE)
    if any(sample.outside for sample in samples):
        p_min, p_max = np.minimum(standard.p_min, wide.p_min), np.maximum(standard.p_max, wide.p_max)
        standard = replace(standard, p_min=p_min, p_max=p_max, coupled=False)
    return found.onto(standard, name)


def _share(within: Sequence[Floats], horizon_s: float, rate_hz: float = FIT_HZ) -> Estimate:
    """Returns the share of the ticks of some logs in which all joints stayed inside, with its interval."""
    hits = [fit_limits.are_all_inside(part) for part in within]
    lengths = [len(part) for part in hits]
    drawn = resample(lengths, block_ticks(horizon_s, rate_hz, max(lengths)), horizon_s * rate_hz, SEED)
    return drawn.share(np.concatenate(hits))


def _facts(
    samples: Sequence[FitSample], found: Fit, limits: LimitSet, coverage: float, horizon_s: float, held_back: float
) -> dict[str, Any]:
    """Returns the limit set's provenance."""
    fitted = ~found.kept
    trained = [fit_limits.inside_intervals(sample.training, found, horizon_s) for sample in samples]
    held = [fit_limits.inside_intervals(sample.held_back, found, horizon_s) for sample in samples]

    def shares(training: Sequence[Floats], rest: Sequence[Floats]) -> dict[str, Any]:
        return {
            "training": _plain(_share([part[:, fitted] for part in training], horizon_s)),
            "held_back": _plain(_share([part[:, fitted] for part in rest], horizon_s)),
            "held_back_all_joints": _plain(_share(rest, horizon_s)),
        }

    logs = []
    for i, sample in enumerate(samples):
        facts: dict[str, Any] = {
            "name": sample.name,
            "sha256": sample.run_config.log_sha256,
            "recorded_future": sample.source,
        }
        facts |= {
            key: s
            for key, s in (("start_s", sample.run_config.start_s), ("end_s", sample.run_config.end_s))
            if s is not None
        }
        facts |= shares(trained[i : i + 1], held[i : i + 1])
        others = [*samples[:i], *samples[i + 1 :]]
        if any(fit_limits.arms_move(other.training).any() for other in others):
            foreign = _fit(others, coverage, horizon_s)
            both = [
                fit_limits.inside_intervals(part, foreign, horizon_s) for part in (sample.training, sample.held_back)
            ]
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
    """Returns a share with its interval and its number of ticks; without unknown values."""
    numbers = {"share": share.value, "low": share.low, "high": share.high}
    return {key: round(value, 4) for key, value in numbers.items() if np.isfinite(value)} | {"ticks": share.samples}
