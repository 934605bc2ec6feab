"""Verdict at the top of the page: contact of the robot with the recorded person, and its cost; one row per method.

It includes remarks on limbs that were not measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hrcreplay.human.fusion.disbelief import disbelieved
from hrcreplay.records import ALLOWING_CONTACT, LIMBS, RECORDED
from hrcreplay.reporting.metrics.contact import PERSONS, SHOWN_PARTS, method_prefixes
from hrcreplay.reporting.metrics.fusion import add_limbs
from hrcreplay.reporting.metrics.people import TRACKED
from hrcreplay.reporting.metrics.series import Metric, MetricTable
from hrcreplay.reporting.tables import (
    PageTable,
    centimetres,
    counted,
    limb_names_text,
    part_name_text,
    percent,
    share_text,
    text_of,
)
from hrcreplay.settings.sections import setting, with_new_names
from hrcreplay.store.run_folder import Run

Metrics = Mapping[str, Metric]
#: Name in contact.parquet of a person from the log's ground truth.
TRUTH = "ground truth"
#: Minimum share of the time at which a limb counts as always seen.
_WHOLE = 0.995
_COLUMNS = (
    "",
    "touched while moving",
    "fastest touch",
    "nearest while moving",
    "link / TCP speed there",
    "nearest at rest",
    "pace kept",
    "standing, of near ticks",
    "full stops",
)


@dataclass(frozen=True)
class ContactSummary:
    """The chosen method in a few sentences, and a table of all methods."""

    sentences: tuple[str, ...]  #: contact, then cost
    speeds: str  #: maximum speeds, and the definition of standing
    scope: tuple[str, ...]  #: scope: considered and ignored parts
    held: str  #: coverage of the prediction behind them; empty: unknown
    details: tuple[str, ...]  #: the same with positions, instants and causes
    table: PageTable


def verdict(run: Run, metrics: Metrics) -> ContactSummary | None:
    """Returns the result of the comparison with all recorded people; None without one."""
    if run.motion is None or metrics["contact_person"]["value"] is None:
        return None
    return ContactSummary(
        (*_as_it_ran(run, metrics), _contact(metrics), _cost_in_short(run, metrics)),
        _speeds(run, metrics),
        scope(run, metrics),
        _held(metrics),
        (_contact(metrics, detailed=True), _cost(run, metrics)),
        _table(run, metrics),
    )


def _contact(metrics: Metrics, *, detailed: bool = False) -> str:
    """States if the robot would have touched a person, at the ticks at which one is known; detailed: also where."""
    touch, near = metrics["plan_touch_moving_ticks"]["value"], metrics["plan_body_distance_min_moving_m"]["value"]
    if touch is None:
        return "It is not known whether the robot would have touched anybody: the recording shows nobody."
    if touch:
        speed = text_of(metrics["plan_touch_contact_speed_max_m_per_s"])
        seconds = text_of(metrics["plan_touch_moving_s"])
        words = f"With this controller the moving robot would have touched {_whom(metrics)}: {seconds}, up to {speed}"
        if detailed:
            words += f"; the deepest contact was of its {_pair(metrics)}, {_when(metrics)}{_fault(metrics)}"
    elif near is None:
        words = "With this controller the robot would not have moved while anybody was known to be there"
    else:
        kept = f"it kept {centimetres(near)} away or more"
        if detailed:
            nearest = text_of(metrics["plan_body_distance_min_moving_m"])
            speed = text_of(metrics["plan_body_distance_min_moving_contact_speed_m_per_s"])
            kept = f"the smallest distance was {nearest}, between its {_pair(metrics)}, {_when(metrics)}"
            kept += f"; that link then moved at {speed}"
        words = (
            f"With this controller{_as_far_as(metrics)} the moving robot would not have touched anybody "
            f"{_at_known_ticks(metrics)}: {kept}"
        )
    return f"{words}.{_at_rest(metrics)}"


def _as_far_as(metrics: Metrics) -> str:
    """Returns the qualification of "touched nobody" if a limb was not seen."""
    return ", as far as the person was seen," if unseen_limbs(metrics) else ""


def _whom(metrics: Metrics, prefix: str = "plan") -> str:
    """Describes the people touched by the moving robot."""
    person, other = (metrics[f"{prefix}_touch_{who}_ticks"]["value"] for who in ("person", "other"))
    if person and other:
        return f"the person ({_count(person)}) and another body ({_count(other)})"
    return f"another body than the considered person ({_count(other)})" if other else f"the person ({_count(person)})"


def _count(ticks: int) -> str:
    return counted(ticks, "tick")


def _at_known_ticks(metrics: Metrics) -> str:
    """Describes the ticks of the comparison, and the source of the person."""
    known, ticks = metrics["plan_body_known_ticks"], metrics["plan_ticks"]
    which = f"at the {text_of(known)} of {text_of(ticks)} ticks" if known["value"] != ticks["value"] else "at any tick"
    where = " at which the person is known" if known["value"] != ticks["value"] else ""
    return f"{which}{where}, judged by the {metrics['contact_person']['value']}"


def _at_rest(metrics: Metrics, prefix: str = "plan") -> str:
    """Describes contacts of a robot at rest."""
    rest, deep = (metrics[f"{prefix}_{name}"]["value"] for name in ("touch_rest_ticks", "body_distance_min_rest_m"))
    if not rest:
        return ""
    return f" The robot at rest was in contact at {_count(rest)}, up to {-100 * deep:.0f} cm deep."


def _speeds(run: Run, metrics: Metrics) -> str:
    """Describes the maximum speeds, with the programme's, and the share of standstill by two definitions."""
    fastest, near, programmed = (
        metrics[f"plan_{name}_max_m_per_s"] for name in ("tcp_speed", "tcp_speed_near_body", "ref_speed")
    )
    words = f"The TCP moved at up to {text_of(fastest)} (its programme at up to {text_of(programmed)})"
    if near["value"] is not None:
        near_m = setting(run.meta.get("settings", {}), "report", "near_m")
        words += f", and with anybody within {near_m:g} m at up to {text_of(near)}"
    stood, null = metrics["plan_stationary_share"], metrics["plan_null_speed_share"]
    if stood["value"] is not None:
        words += (
            f". Near the volumes it stood at {percent(stood)} of the ticks while its programme moved or waited for it, "
            f"and at {percent(null)} with the programme's own dwells"
        )
    return f"{words}."


#: Not considered in a run whose cell names no objects, and in one whose cell does.
NO_OBJECTS = ("objects, table and fixtures", "the robot's own links")
OTHER_OBJECTS = ("objects that the cell file does not name", "what the robot holds")
#: Not considered in any run.
NOT_CONSIDERED = (
    "people whom no camera tracked",
    "different reactions of people to another motion",
)


def scope(run: Run, metrics: Metrics) -> tuple[str, ...]:
    """Describes the scope of the verdict: considered and ignored parts."""
    others = metrics["others_frames"]["value"]
    people = "One person is planned for"
    if (tracked := metrics.get(TRACKED)) is not None:
        people = f"{tracked['value']} people are planned for, each by a prediction of its own"
        if brief := metrics["bodies_seen_briefly"]["value"]:
            bodies = "1 further body was" if brief == 1 else f"{brief} further bodies were"
            people += f"; {bodies} seen too briefly for that and counted by the points alone"
    if others:
        people += (
            f"; {counted(others, 'frame')} show at least one other body, which counts for contact, but the robot did "
            "not react to it and there was no prediction for it"
        )
    gaps_s, programme = metrics["programme_gaps_s"]["value"], []
    if gaps_s:
        programme.append(
            f"The programme is the recorded robot's motion; {gaps_s:.2f} s of it were not recorded and are "
            "replaced by a straight line."
        )
    beside = _beside(run)
    ignored = (*(OTHER_OBJECTS if beside else NO_OBJECTS), *NOT_CONSIDERED, *unseen_limbs(metrics))
    considered = (f"{people}.", *_watched(metrics), *_disbelieved(run), *programme, *beside)
    return (*considered, f"Not considered: {', '.join(ignored)}.")


def _beside(run: Run) -> list[str]:
    """Describes the distances from the objects of the cell and between the robot's own links."""
    if run.motion is None or "object_distance_m" not in run.motion:
        return []
    parts = []
    for name, column in (("an object of its cell", "object_distance_m"), ("each other", "self_distance_m")):
        apart = run.motion[column].to_numpy(dtype=float)
        if np.isfinite(apart).any():
            parts.append(f"{1e3 * np.nanmin(apart):.0f} mm of {name}")
    words = f"Its links came within {' and within '.join(parts)}" if parts else "No link is kept off an object"
    return [f"{words}; notes say which links are not kept apart, or may approach an object."]


def _watched(metrics: Metrics) -> list[str]:
    """Describes the results that rely on the cell's claim that its cameras see all people in an area."""
    share, refuting = metrics["watched_vacant_share"]["value"], metrics["watched_frames_refuting"]["value"]
    if share is None:
        return []
    words = (
        "Other people are assumed to enter over the border of the watched area at up to "
        f"{text_of(metrics['watched_speed_m_per_s'])}, because the cell states that its cameras see everybody within; "
        f"at {percent(metrics['watched_vacant_share'])} of the ticks no camera showed anybody there and safety relied "
        "only on this statement"
    )
    if refuting:
        words += (
            f". The recording contradicts it: {counted(refuting, 'frame')} show a person deeper inside than people can "
            "walk since all cameras showed the area without people"
        )
    return [f"{words}."]


def _disbelieved(run: Run) -> list[str]:
    """Names the points of each camera to which the robot did not react, as there was evidence against them."""
    return [
        f"The robot did not react to {', '.join(points)} where camera {camera} showed them, in up to "
        f"{counted(max(points.values()), 'frame')}: another camera showed them elsewhere, and there was evidence "
        "against this one. Contact and coverage count them there only if they fit the rest of the body."
        for camera, points in disbelieved(run.counts).items()
    ]


def unseen_limbs(metrics: Metrics) -> list[str]:
    """Lists limbs of the recorded person that were not seen, or only part of the time, each in words."""
    shares = {f"the {limb}": metrics[f"contact_{limb}_known_share"]["value"] for limb in SHOWN_PARTS}
    found = {limb: share for limb, share in shares.items() if share is not None and share < _WHOLE}
    if metrics["contact_person"]["value"] != TRUTH:
        never, mostly = unmeasured(metrics)
        found |= {f"the {part_name_text(limb)}": 0.0 for limb in never}
        found |= {f"the {part_name_text(limb)}": 1.0 - share for limb, share in mostly.items()}
    return [
        f"{limb} (never seen)" if share == 0.0 else f"{limb} (not seen {share_text(1 - share, 0)} of the time)"
        for limb, share in found.items()
    ]


def _cost_in_short(run: Run, metrics: Metrics) -> str:
    """Describes the cost to the task, and contacts without a controller."""
    pace = metrics["plan_progress_share"]["value"]
    cost = _UNKNOWN_COST
    if pace is not None:
        cost = f"The task would have run at {share_text(pace, 0)} of its pace"
        if 0.05 < pace < 0.95:
            cost = f"The task would have taken {1 / pace:.1f} times as long ({share_text(pace, 0)} of its pace)"
    return f"{cost}{_without_controller(run, metrics)}."


#: Cost of a run without a programme.
_UNKNOWN_COST = "What it would have cost the task is not known"


def _without_controller(run: Run, metrics: Metrics) -> str:
    """Returns the part of a sentence on contacts of the programme without reaction; empty if it was not compared."""
    if "none" not in run.baselines or metrics["baseline_none_touch_moving_ticks"]["value"] is None:
        return ""
    if not metrics["baseline_none_touch_moving_ticks"]["value"]:
        return "; without a controller the robot would not have touched anybody at these ticks either"
    seconds, speed = (
        text_of(metrics[f"baseline_none_touch_{name}"]) for name in ("moving_s", "contact_speed_max_m_per_s")
    )
    whom = _whom(metrics, "baseline_none")
    return f"; without a controller the robot would have touched {whom}: {seconds}, up to {speed}"


def _held(metrics: Metrics) -> str:
    """Describes the coverage of the recorded person by the prediction, as in ``audit``."""
    parts = []
    for prefix, until in (("volumes", "their horizon"), ("volumes_full", "the braking time")):
        checked, left = metrics[f"{prefix}_checked_ticks"]["value"], metrics[f"{prefix}_left_ticks"]["value"]
        if checked and left is not None:
            share = f"all {checked}" if left == 0 else f"{share_text(1 - left / checked)} of {checked}"
            parts.append(f"until {until} at {share} checked ticks")
    if not parts:
        return ""
    judge = metrics["contact_person"]["value"]
    return f"The predicted volumes held every limb that was seen ({judge}) {', and '.join(parts)}.{_held_each(metrics)}"


#: Number of people up to which the verdict names each.
_NAMED = 8


def _held_each(metrics: Metrics) -> str:
    """Describes the coverage of each of several people until the horizon."""
    shares = {
        int(name.split("_")[1]): metric["value"]
        for name, metric in metrics.items()
        if name.startswith("person_") and name.endswith("_volumes_held_share") and metric["value"] is not None
    }
    texts = {number: f"person {number} at {share_text(share)}" for number, share in sorted(shares.items())}
    each = ", ".join(texts.values())
    if len(shares) > _NAMED:
        first, *others = texts
        least = min(others, key=lambda number: (shares[number], number))
        each = f"{texts[first]} and the {len(others)} others at {share_text(shares[least])} (person {least}) or more"
    return f" Until their horizon they held {each} of the ticks checked of each." if each else ""


def _pair(metrics: Metrics) -> str:
    link, limb, source = (
        metrics[f"plan_body_distance_min_moving_{part}"]["value"] for part in ("link", "limb", "source")
    )
    if ", body " in source:
        return f"{link} and the {part_name_text(limb)} of another body ({source})"
    if source.startswith("person "):
        return f"{link} and the {part_name_text(limb)} of {source.partition(',')[0]}"
    return f"{link} and the person's {part_name_text(limb)}"


def _when(metrics: Metrics) -> str:
    return f"{metrics['plan_body_distance_min_moving_at_s']['value']:.1f} s after the start"


def _fault(metrics: Metrics) -> str:
    """Describes the faults behind the contacts."""
    inside, retreating, outside, unknown = (
        metrics[f"plan_touch_{name}_ticks"]["value"] for name in ("inside", "retreating", "outside", "unpredicted")
    )
    if inside is None:
        may = metrics["plan_method"]["value"] in ALLOWING_CONTACT
        return "; it may touch people, slowly" if may else "; it does not react to people"
    parts = []
    if other := metrics["plan_touch_other_ticks"]["value"]:
        parts.append(f"at {other} it touched a body that it did not consider")
    if inside:
        parts.append(f"at {inside} of these ticks the person was where the prediction said, so the robot is at fault")
    if retreating:
        parts.append(f"at {retreating} the robot was moving away, and the person came after it")
    if outside:
        parts.append(f"at {outside} the person was not where the prediction said, so the prediction is at fault")
    if unknown:
        parts.append(f"at {unknown} nothing was predicted")
    return "".join(f"; {part}" for part in parts)


def _cost(run: Run, metrics: Metrics) -> str:
    """Returns the second sentence: the cost, and the contacts of the programme without reaction."""
    words = []
    if metrics["plan_progress_share"]["value"] is not None:
        words.append(f"kept {percent(metrics['plan_progress_share'])} of the programmed pace")
    if metrics["plan_stationary_share"]["value"] is not None:
        words.append(f"stood still in {percent(metrics['plan_stationary_share'])} of the time near the person")
    cost = f"It would have {' and '.join(words)}" if words else _UNKNOWN_COST
    return f"{cost}{_without_controller(run, metrics)}."


def _table(run: Run, metrics: Metrics) -> PageTable:
    """Makes one row per method."""
    rows = []
    for method, prefix in method_prefixes(run).items():
        near = f"{prefix}_body_distance_min_moving"
        speeds = [text_of(metrics[f"{near}_{of}_speed_m_per_s"]) for of in ("contact", "tcp")]
        rows.append(
            (
                method + _ROLES.get(prefix, "") + (" (run blind)" if method == "none" else ""),
                _ticks(metrics[f"{prefix}_touch_moving_ticks"]),
                text_of(metrics[f"{prefix}_touch_contact_speed_max_m_per_s"]),
                _signed(metrics[f"{near}_m"]),
                " / ".join(speed.removesuffix(" m/s") for speed in speeds) + (" m/s" if "m/s" in speeds[0] else ""),
                _signed(metrics[f"{prefix}_body_distance_min_rest_m"]),
                percent(metrics.get(f"{prefix}_progress_share")),
                percent(metrics.get(f"{prefix}_stationary_share")),
                percent(metrics.get(f"{prefix}_full_stop_share")),
            )
        )
    return PageTable("Robot against everybody recorded", _COLUMNS, tuple(rows), _note(run, metrics))


#: Prefix of the metrics of a method -> its role, behind its name.
_ROLES = {"plan": " (this plan)", RECORDED: " (as it ran)"}


def _as_it_ran(run: Run, metrics: Metrics) -> tuple[str, ...]:
    """Returns the answer for the robot as recorded, with what it covers; none without its joints."""
    return () if run.recorded is None else (f"{in_short_as_it_ran(metrics)} {_covered_as_it_ran(metrics)}",)


def in_short_as_it_ran(metrics: Metrics) -> str:
    """States if the robot was safe as it ran, at the ticks that ``detailed_as_it_ran`` names.

    Args:
        metrics: Metrics of a run with the robot as recorded.
    """
    touch, near = metrics["recorded_touch_moving_ticks"], metrics["recorded_body_distance_min_moving_m"]["value"]
    if touch["value"] is None:
        return "It is not known whether the robot touched anybody as it ran."
    if touch["value"]:
        seconds, speed = (text_of(metrics[f"recorded_touch_{w}"]) for w in ("moving_s", "contact_speed_max_m_per_s"))
        words = f"As it ran, the moving robot touched {_whom(metrics, RECORDED)}: {seconds}, up to {speed}"
    elif near is None:
        words = "As it ran, the robot did not move while anybody was known to be there"
    else:
        kept = f"it kept {centimetres(near)} away or more"
        words = f"As it ran{_as_far_as(metrics)} the moving robot touched nobody: {kept}"
    return f"{words}.{_at_rest(metrics, RECORDED)}"


def detailed_as_it_ran(metrics: Metrics) -> str:
    """States what ``in_short_as_it_ran`` covers, and if the robot could have stopped in time."""
    words = [_covered_as_it_ran(metrics)]
    late, known = (metrics[f"recorded_{name}_moving_ticks"] for name in ("contact", "separation"))
    if late["value"] is not None:
        words.append(
            f"At {_count(late['value'])} of {text_of(known)} in motion with a known prediction, a link was where the "
            "person was predicted to reach before it could have stopped."
        )
    elif metrics["recorded_moving_ticks"]["value"]:
        words.append("Whether it could have stopped before it reached the person is not known.")
    return " ".join(words)


def _covered_as_it_ran(metrics: Metrics) -> str:
    """Describes the ticks at which robot and person are both known, and all that was not looked at."""
    known, both, ticks = (metrics[f"recorded_{name}"]["value"] for name in ("known_ticks", "body_known_ticks", "ticks"))
    unknown = {n.removeprefix(_UNKNOWN): m["value"] for n, m in metrics.items() if n.startswith(_UNKNOWN)}
    missing = []
    if known < ticks:
        why = ", ".join(f"{reason.replace('_', ' ')}: {count}" for reason, count in unknown.items() if count)
        missing.append(f"{_count(ticks - known)} at which the robot is not known ({why})")
    if both < known:
        missing.append(f"{_count(known - both)} at which the person is not known")
    missing += unseen_limbs(metrics)
    left = f"; not looked at: {', '.join(missing)}" if missing else ""
    which = f"the {both:,} of {ticks:,} ticks".replace(",", "\u202f") if both < ticks else "all ticks"
    return f"Judged at {which} by the {metrics['contact_person']['value']}{left}."


#: Prefix of the numbers of ticks at which the robot is not known, before the reason.
_UNKNOWN = "recorded_unknown_ticks_"


def _signed(metric: Metric) -> str:
    """Formats a number with a minus as wide as a digit."""
    return text_of(metric).replace("-", "\u2212")


def _ticks(metric: Metric) -> str:
    return "\u2013" if metric["value"] is None else _count(metric["value"])


def _note(run: Run, metrics: Metrics) -> str:
    """Describes the person and the body in the comparison."""
    settings, _ = with_new_names(run.meta.get("settings", {}))
    hand_m, leg_m = settings.get("prediction", {}).get("hand_m"), settings.get("report", {}).get("leg_radius_m")
    person = str(metrics["contact_person"]["value"])
    hand = "" if hand_m is None else f", the forearms prolonged by a hand of {hand_m:g} m"
    leg = "" if leg_m is None else f" with a radius of {leg_m:g} m"
    words = (
        f"The person is {PERSONS.get(person, person)}: head, trunk and arms with the radii of Table 2{hand}, and "
        f"thighs, shanks and feet{leg} where they were seen"
    )
    if gaps := unseen_limbs(metrics):
        words += f"; not known: {', '.join(gaps)}"
    if metrics["others_frames"]["value"]:
        words += "; every other body of every camera counts, too"
    words += (
        ". Distances are between surfaces, at the ticks; negative in overlap. The person is known at "
        f"{text_of(metrics['plan_body_known_ticks'])} of {text_of(metrics['plan_ticks'])} ticks."
    )
    return words + _left(metrics)


def _left(metrics: Metrics) -> str:
    """Describes how often the person left the volumes."""
    checked, left = metrics["volumes_checked_ticks"]["value"], metrics["volumes_left_ticks"]["value"]
    if checked is None or left is None:
        return ""
    words = f" A limb left the predicted volumes before their horizon at {left} of {checked} checked ticks"
    if left:
        parts = [found.split(" ") for found in str(metrics["volumes_left_limbs"]["value"]).split(", ")]
        names = ", ".join(f"{part_name_text(part)} {count}" for part, count in parts)
        words += f", by up to {text_of(metrics['volumes_left_max_m'])} ({names})"
    return words + "."


def line(run: Run, metrics: Metrics) -> str:
    """Returns the verdict in one line for the terminal; empty without a comparison."""
    if run.motion is None or metrics["contact_person"]["value"] is None:
        return ""
    parts = []
    for method, prefix in method_prefixes(run).items():
        touch, near = metrics[f"{prefix}_touch_moving_ticks"], metrics[f"{prefix}_body_distance_min_moving_m"]
        if touch["value"]:
            speed = text_of(metrics[f"{prefix}_touch_contact_speed_max_m_per_s"])
            parts.append(f"{method} touched {_whom(metrics, prefix)}, at up to {speed}")
        elif near["value"] is not None:
            parts.append(f"{method} touched nobody (nearest {text_of(near)})")
        else:
            parts.append(f"{method} did not move beside a known person")
    known = f"{text_of(metrics['plan_body_known_ticks'])} of {text_of(metrics['plan_ticks'])} ticks"
    judged = f"moving robot against everybody recorded ({metrics['contact_person']['value']}, person known at {known})"
    return f"{judged}: {'; '.join(parts)}. {' '.join(scope(run, metrics))}"


#: Share of the time without measurement above which a limb gets a remark.
_MOST = 0.5


def unmeasured(metrics: Metrics) -> tuple[list[str], dict[str, float]]:
    """Returns limbs that were never measured, and limbs unmeasured most of the time with that share."""
    shares = {limb: metrics[f"limb_{limb}_unmeasured_share"]["value"] for limb in LIMBS}
    never = [limb for limb, share in shares.items() if share == 1.0]
    return never, {limb: share for limb, share in shares.items() if share is not None and _MOST < share < 1.0}


def limb_remarks(run: Run, told: Sequence[str] = ()) -> list[str]:
    """Returns remarks on limbs that were not measured, or only in part; one line each.

    Args:
        run: Tables of stage 1.
        told: Notes on the log, which may already name limbs without points from any camera.
    """
    table = MetricTable()
    add_limbs(table, run)
    metrics = table.sorted()
    never, mostly = unmeasured(metrics)
    lines = []
    for limb in never:
        begin = f"limb {limb} was never measured"
        if not any(note.startswith(begin) for note in told):
            lines.append(
                f"{begin}: its points never agreed, or not with the confidence fusion.confidence_min; its volume "
                "contains all postures within the joint limits"
            )
    lines += [
        f"the {limb_names_text([limb])} was not measured at {share_text(share, 0)} of the ticks with the person in view"
        for limb, share in mostly.items()
    ]
    for limb in LIMBS:
        joints = metrics[f"limb_{limb}_joints_unmeasured"]["value"]
        if joints is not None and limb not in never and limb != "HD":  # the head depends on the trunk's joints
            lines.append(f"the {limb_names_text([limb])} was measured only in part: never its {joints}")
    return lines
