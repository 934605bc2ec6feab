"""Results of a run in words: answers, headline numbers, defects of the log, and one line per stage.

They state only results of the replay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from hrcreplay.logs.cleaning import DEFECTS
from hrcreplay.records import BODY
from hrcreplay.reporting import verdict
from hrcreplay.reporting.metrics.fusion import cameras
from hrcreplay.reporting.metrics.series import Metric
from hrcreplay.reporting.tables import counted, limb_names_text, percent, reason_text, share_text, text_of
from hrcreplay.reporting.verdict import unmeasured
from hrcreplay.settings.sections import setting, with_new_names
from hrcreplay.store.run_folder import Run

#: Separator between groups of digits.
NARROW = "\u202f"
_CAMERA = "_<camera>"
#: Prefixes in ``DEFECTS`` of entries that are not a defect, and not a count.
_NONE, _INSTANT = "no defect", "an instant"


def defect_notes(counts: Mapping[str, int], notes: Sequence[str]) -> tuple[str, ...]:
    """Returns the notes of a run, then the count of each defect of its log; nothing for a clean log.

    Args:
        counts: ``counts`` of run.json; entries that are not defects of the log are left out.
        notes: ``notes`` of run.json.
    """
    found = [(_text(name), count) for name, count in sorted(counts.items()) if count]
    return (*notes, *(f"{text}: {f'{count:,}'.replace(',', NARROW)}" for text, count in found if text))


def _text(name: str) -> str:
    """Returns the text of ``DEFECTS`` for a counter; empty if it counts no defect. The instant is in a note."""
    for known, text in DEFECTS.items():
        stem = known.removesuffix(_CAMERA)
        of_camera = stem != known and name.startswith(f"{stem}_")
        if (name == known or (of_camera and name not in DEFECTS)) and not text.startswith((_NONE, _INSTANT)):
            return f"camera {name.removeprefix(f'{stem}_')}, {text}" if of_camera else text
    return ""


@dataclass(frozen=True)
class Card:
    """A headline number."""

    value: str
    label: str
    detail: str


@dataclass(frozen=True)
class Answer:
    """One of the questions, the answer in a few words, and its explanation: one paragraph per line."""

    question: str
    short: str
    words: str


RAN = "Was it safe as it ran?"
SAFE = "Could the robot always have stopped before it reached the person?"
COST = "What would it have cost the task?"


def answers(run: Run, metrics: Mapping[str, Metric]) -> tuple[Answer, ...]:
    """Answers the questions of the page; the first one only for a log with the joints of the robot."""
    if run.motion is None:
        stage = "predicted what the person could reach" if run.occupancy is not None else "fused the cameras"
        words = f"This run {stage} and moved no robot. Run plan or report on the same log to have it answered."
        return (Answer(SAFE, "Not asked in this run.", words), Answer(COST, "Not asked in this run.", ""))
    ran: tuple[Answer, ...] = ()
    if run.recorded is not None and run.contact is not None:
        ran = (Answer(RAN, verdict.in_short_as_it_ran(metrics), verdict.detailed_as_it_ran(metrics)),)
    return (*ran, _with_unmeasured(_safety(run, metrics), metrics), _cost(run, metrics))


def _with_unmeasured(safe: Answer, metrics: Mapping[str, Metric]) -> Answer:
    """Adds the unmeasured limbs of the person before the answer, as an unseen limb is not safe."""
    never, mostly = unmeasured(metrics)
    if not never and not mostly:
        return safe
    parts = [f"the {limb_names_text(never)}: never measured"] if never else []
    parts += [
        f"the {limb_names_text([limb])}: not measured at {share_text(share, 0)} of the ticks"
        for limb, share in mostly.items()
    ]
    short = f"Not known of {'; '.join(parts)}."
    words = (
        "For a limb that no camera measured, the prediction uses only the joints' limits, and this recording cannot "
        f"confirm it.\nFor the measured limbs: {safe.short[0].lower()}{safe.short[1:]} "
    )
    return Answer(safe.question, short, words + safe.words)


def _safety(run: Run, metrics: Mapping[str, Metric]) -> Answer:
    if metrics["plan_uncertified_moving_ticks"]["value"] is None or not _certifies(run):
        answer = _by_inequality(metrics)
    else:
        answer = _by_certificate(metrics)
    more = (_nearest(run, metrics), _braked(metrics))
    return Answer(SAFE, answer[0], "\n".join(part for part in (answer[1], *more) if part))


def _certifies(run: Run) -> bool:
    """Returns True if the plan took only certified steps."""
    plan = run.meta.get("settings", {}).get("plan", {})
    return bool(plan.get("certify")) and plan.get("method") != "none"


def _by_certificate(metrics: Mapping[str, Metric]) -> tuple[str, str]:
    """Returns the short and the long answer for a plan with certified steps."""
    ticks, moving = text_of(metrics["plan_ticks"]), text_of(metrics["plan_moving_ticks"])
    if not metrics["plan_moving_ticks"]["value"]:
        return "The robot never moved.", f"It stood at all {ticks} ticks."
    without = metrics["plan_uncertified_moving_ticks"]["value"]
    kept = (
        "its step and the stop after it were clear of all that the person was predicted to reach until that stop had "
        "ended: as long as that person stays within it, no moving link touches them"
    )
    if metrics["watched_vacant_share"]["value"] is not None:
        kept += (
            ", nor anybody else as long as they come over the border of the watched area and no faster than "
            f"{text_of(metrics['watched_speed_m_per_s'])}"
        )
    if others := metrics["others_frames"]["value"]:
        kept += f". There was no prediction for the other bodies in {others:,} frames".replace(",", NARROW)
    stops = (
        f"It was in a full stop at {text_of(metrics['plan_braking_moving_ticks'])} ticks "
        f"({percent(metrics['plan_full_stop_share'])}), each of them certified before it began."
    )
    if without:
        short = (
            f"Not at every tick: {text_of(metrics['plan_uncertified_moving_ticks'])} of {moving} had no certificate."
        )
        return short, f"At the other ticks at which it moved, {kept}."
    retreat = metrics["plan_retreating_share"]
    away = (
        f" But at {percent(retreat)} of all ticks it retreated: that step began inside a volume, with a link up to "
        f"{text_of(metrics['plan_retreating_overlap_max_m'])} deep where the person could reach, and moved slowly, so "
        "that no point of it approached any point there."
        if retreat["value"]
        else ""
    )
    deep = text_of(metrics["plan_retreating_overlap_max_m"])
    begun = (
        f"; the retreating ones ({percent(retreat)} of all ticks) began inside a volume, up to {deep} deep"
        if retreat["value"]
        else ""
    )
    return (
        f"Certified at every moving tick against what was predicted{begun}.",
        f"At each of the {moving} ticks (of {ticks}) at which the robot moved, {kept}.{away} {stops}",
    )


def _by_inequality(metrics: Mapping[str, Metric]) -> tuple[str, str]:
    """Returns the short and the long answer for a plan with inequality (2) only."""
    ticks, moving = text_of(metrics["plan_ticks"]), text_of(metrics["plan_moving_ticks"])
    late = metrics["plan_braking_moving_ticks"]["value"]
    kept = (
        "the controller kept every link slow enough to stop within the stopping time short of all that the person "
        "was predicted to reach (inequality 2)"
    )
    if not metrics["plan_moving_ticks"]["value"]:
        short = "The robot never moved."
        words = f"It stood at all {ticks} ticks."
    elif late == 0:
        short = "By the paper's criterion at every moving tick, against what was predicted."
        words = f"At each of the {moving} ticks (of {ticks}) at which the robot moved, {kept}."
    else:
        share = share_text(late / metrics["plan_moving_ticks"]["value"], 2)
        short = (
            f"Not at every tick: at {text_of(metrics['plan_braking_moving_ticks'])} of {moving}, it was still braking."
        )
        words = (
            f"At {share} of the ticks at which the robot moved it was still braking, as hard as its joints can. "
            f"At the other ticks, {kept}."
        )
    return short, words


def _nearest(run: Run, metrics: Mapping[str, Metric]) -> str:
    """Returns the smallest distance, with its definition."""
    nearest, late = metrics["plan_separation_min_moving_m"], metrics["plan_braking_moving_separation_min_m"]
    if nearest["value"] is None:
        return ""
    within = _horizon(run, metrics)
    words = (
        f"The smallest distance while it moved was {text_of(nearest)}: from the surface of a link to the surface of "
        f"all that the person could reach within {within}, not to the body"
    )
    if late["value"] is not None:
        words += f"; while it was still braking, {text_of(late)}"
    words += "."
    if nearest["value"] < 0.0005 and not _certifies(run):
        words += " At 0 the constraint lets a link move along that space or away from it, but not into it."
    return words


def _horizon(run: Run, metrics: Mapping[str, Metric]) -> str:
    """Describes the horizon of the prediction in words."""
    settings, _ = with_new_names(run.meta.get("settings", {}))
    median, most = metrics["plan_horizon_median_s"], metrics["plan_horizon_max_s"]
    if settings.get("plan", {}).get("horizon") == "adaptive" and median["value"] is not None:
        return f"the horizon of the tick (median {text_of(median)}, at most {text_of(most)})"
    stop_s = settings.get("prediction", {}).get("stop_s")
    return "the stopping time" if stop_s is None else f"T_s = {stop_s:g} s"


def _braked(metrics: Mapping[str, Metric]) -> str:
    """Returns the reasons for braking and for standing, the most frequent first."""
    mark, stood = "plan_braking_ticks_", "plan_standing_share_"
    held = [(m["value"], name.removeprefix(stood)) for name, m in metrics.items() if name.startswith(stood)]
    why = [
        f"{share_text(share)} of the ticks {reason_text(slug.replace('_', ' '))}"
        for share, slug in sorted(held, key=lambda part: (-part[0], part[1]))
    ]
    rest = f" Why it stood at rest: at {'; at '.join(why)}." if why else ""
    found = [(m["value"], name.removeprefix(mark)) for name, m in metrics.items() if name.startswith(mark)]
    parts = [
        f"at {counted(count, 'tick')} {reason_text(slug.replace('_', ' '))}"
        for count, slug in sorted(found, key=lambda part: (-part[0], part[1]))
    ]
    return ((f"Why it braked, moving or standing: {'; '.join(parts)}." if parts else "") + rest).strip()


def _cost(run: Run, metrics: Mapping[str, Metric]) -> Answer:
    progress, lost = metrics["plan_progress_share"], metrics["plan_time_lost_s"]
    if progress["value"] is None:
        short = f"The TCP was {text_of(metrics['plan_tracking_error_mean_m'])} from its reference on average."
    else:
        short = (
            f"It lost {text_of(lost)} of {text_of(metrics['span_s'])}: the task ran at {percent(progress)} of its pace."
        )
    words = (
        f"The TCP left the programmed path by {text_of(metrics['plan_deviation_mean_m'])} on average and "
        f"{text_of(metrics['plan_deviation_max_m'])} at most. {_standing(metrics, 'plan', 'it')}"
    )
    for name in sorted(run.baselines):
        prefix = f"baseline_{name}"
        words += " " + _standing(metrics, prefix, f"the baseline '{name}'")
        if metrics[f"{prefix}_progress_share"]["value"] is not None:
            words = words[:-1] + f"; it ran at {percent(metrics[f'{prefix}_progress_share'])} of the pace."
    return Answer(COST, short, words)


def _standing(metrics: Mapping[str, Metric], prefix: str, who: str) -> str:
    if metrics[f"{prefix}_stationary_share"]["value"] is None:
        return f"The person never came near {who}."
    return (
        f"Of the {text_of(metrics[f'{prefix}_near_ticks'])} ticks near the person, {who} stood still in "
        f"{percent(metrics[f'{prefix}_stationary_share'], 2)}."
    )


def cards(run: Run, metrics: Mapping[str, Metric]) -> tuple[Card, ...]:
    """Returns the four headline numbers of a run with any stages."""
    if run.motion is None:
        return _human_cards(run, metrics)
    late, ticks = metrics["plan_braking_moving_ticks"]["value"], metrics["plan_ticks"]["value"]
    pair = [metrics[f"plan_separation_min_{part}"]["value"] for part in ("limb", "link")]
    others = ", ".join(
        f"{name} {percent(metrics[f'baseline_{name}_progress_share'])}" for name in sorted(run.baselines)
    )
    stood = ", ".join(f"{n} {percent(metrics[f'baseline_{n}_stationary_share'], 2)}" for n in sorted(run.baselines))
    near, never = text_of(metrics["plan_near_ticks"]), ", ".join(unmeasured(metrics)[0])
    kept = "ticks with the constraint kept, or the robot standing"
    if _certifies(run) and metrics["plan_uncertified_moving_ticks"]["value"] is not None:
        late, kept = (
            metrics["plan_uncertified_moving_ticks"]["value"],
            "ticks with a certificate, or the robot standing",
        )
    return (
        Card(
            share_text(1 - late / ticks, 2) if ticks else "\u2013",
            kept,
            f"{text_of(metrics['plan_braking_moving_ticks'])} of {text_of(metrics['plan_ticks'])} ticks still braking"
            + (f"; {never} never measured" if never else ""),
        ),
        Card(
            text_of(metrics["plan_separation_min_moving_m"]),
            "smallest distance from a link's surface to the space that the person could reach within "
            f"{'the horizon' if metrics['plan_horizon_max_s']['value'] else 'T_s'}, while it moved",
            "not to the body"
            + (f"; at all: {text_of(metrics['plan_separation_min_m'])}, {pair[0]} \u2013 {pair[1]}" if pair[0] else ""),
        ),
        Card(
            percent(metrics["plan_progress_share"]),
            "of the programmed pace, by the way that the robot made",
            f"baseline: {others}" if others else "",
        ),
        Card(
            percent(metrics["plan_stationary_share"], 2),
            f"standing still, of {near} ticks near the person",
            (f"{stood}; " if stood else "") + "the paper's own: 30.06 %, scaling 86.44 %",
        ),
    )


def _human_cards(run: Run, metrics: Mapping[str, Metric]) -> tuple[Card, ...]:
    seen = cameras(run)
    found = [Card(text_of(metrics["span_s"]), "of recording", f"{text_of(metrics['ticks'])} ticks")]
    detail = ", ".join(f"{name} {percent(metrics[f'camera_{name}_available_share'])}" for name in seen)
    found.append(
        Card(str(len(seen)), "camera" if len(seen) == 1 else "cameras", f"available: {detail}" if seen else "")
    )
    if metrics["fusion_angle_rmse_ratio"]["value"] is not None:
        better = metrics["fusion_angle_better_camera"]["value"]
        found.append(
            Card(
                text_of(metrics["fusion_angle_rmse_ratio"]),
                "of the better camera's angle error",
                f"against {better}",
            )
        )
    else:
        longest = text_of(metrics.get("longest_without_camera_s"))
        found.append(Card(longest, "longest stretch without a camera", ""))
    method = next((n.split("_")[1] for n in metrics if n.startswith("occupancy_") and n.endswith("_sum_m3")), None)
    if method is not None:
        total = text_of(metrics[f"occupancy_{method}_sum_m3"])
        found.append(Card(total, "mean sum of the six swept volumes", f"method '{method}'"))
    return tuple(found)


Metrics = Mapping[str, Metric]


def lines(run: Run, metrics: Metrics) -> list[str]:
    """Returns the main figures of each stage of the run; for a report also its answers.

    Args:
        run: The run's tables.
        metrics: Result of :func:`hrcreplay.commands.report.compute`.
    """
    found = []
    if run.state is not None:
        found.append(f"fuse: {_fuse(run, metrics)}")
    if run.occupancy is not None:
        found.append(f"predict: {_predict(run, metrics)}")
    if run.motion is not None:
        others = {name: f"baseline_{name}" for name in sorted(run.baselines)}
        plans = {str(metrics["plan_method"]["value"]): "plan", **others}
        found.append("plan: " + "; ".join(f"{name}: {_plan(metrics, prefix)}" for name, prefix in plans.items()))
    if run.meta.get("command") == "report":
        touched = verdict.line(run, metrics)
        found.append(
            "report: " + " ".join([*([touched] if touched else []), *(a.short for a in answers(run, metrics))])
        )
    return [line.replace("\u202f", ",") for line in found]  # some terminal fonts lack the page's separator


def _fuse(run: Run, metrics: Metrics) -> str:
    known = metrics["person_known_share"]["value"]
    limbs = {limb: metrics[f"limb_{limb}_known_share"]["value"] for limb in BODY}
    less = [
        f"{limb} {share_text(share)}" for limb, share in limbs.items() if share is not None and share < known - 0.005
    ]
    of_limbs = f" ({', '.join(less)})" if less else ""
    frames = ", ".join(f"{name} {text_of(metrics[f'camera_{name}_frames'])}" for name in cameras(run))
    outliers = sum(count for name, count in run.counts.items() if name.startswith("outlier_points_"))
    return (
        f"{text_of(metrics['ticks'])} ticks, person known from fresh frames in {percent(metrics['person_known_share'])}"
        f"{of_limbs}; {_vacant(metrics)}"
        f"frames with the person: {frames}; {outliers:,} outlier points"
    )


def _vacant(metrics: Metrics) -> str:
    share = metrics["watched_vacant_share"]
    return "" if share["value"] is None else f"nobody in the watched area in another {percent(share)}; "


def _predict(run: Run, metrics: Metrics) -> str:
    method = setting(run.meta["settings"], "prediction", "method")
    limits = run.meta["limits"]["prediction"]["name"]
    name = f"occupancy_{method}"
    words = f"{method}, {limits}: the six limbs {text_of(metrics.get(f'{name}_sum_m3'))}"
    if f"{name}_LEGS_m3" in metrics:
        words += f", lower body {text_of(metrics[f'{name}_LEGS_m3'])}"
    return words + " (means of the stored ticks, above the floor; overlaps of limbs count twice)"


def _plan(metrics: Metrics, prefix: str) -> str:
    share = percent(metrics[f"{prefix}_full_stop_share"])
    words = [f"{text_of(metrics[f'{prefix}_braking_moving_ticks'])} ticks ({share}) in full stops"]
    if metrics[f"{prefix}_stationary_share"]["value"] is not None:
        words.insert(0, f"standing in {percent(metrics[f'{prefix}_stationary_share'])} of the near ticks")
    if metrics[f"{prefix}_progress_share"]["value"] is not None:
        words.insert(0, f"{percent(metrics[f'{prefix}_progress_share'])} of the programmed pace")
    return ", ".join(words)
