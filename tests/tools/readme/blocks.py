"""The parts of README and docs/validation.md that hold figures, written from docs/figures.json."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay import limits
from hrcreplay.reporting.tables import centimetres, share_text
from tests.tools.readme.measurements import (
    BASELINES,
    COST_FACTORS,
    COST_HORIZONS,
    HORIZONS_MS,
    MARGINS,
    ORACLED,
    PARTLY_SEEN_OF,
    PLACES,
    RECORDINGS,
    SLOWLY,
    VARIANTS,
    Figures,
)

Facts = Mapping[str, Any]
Row = Iterable[str]

PEOPLE = Path(limits.__file__).parent / "people.toml"
#: Share of ticks in which whole people are to be held.
_OFTEN = 0.99
BLOCK = re.compile(r"(<!-- figures: (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def fill(text: str, facts: Facts) -> str:
    """The README with its blocks written anew; a block stays as it is where one of its figures was never measured."""

    def block(found: re.Match[str]) -> str:
        try:
            return f"{found[1]}{BLOCKS[found[2]](facts)}\n{found[4]}"
        except KeyError:
            return found[0]

    return BLOCK.sub(block, text)


def demo(facts: Facts) -> str:
    """The demo log by method, and what is to be said of it."""
    run, printed = _of(facts, "demo"), _of(facts, "demo, as printed")
    columns = [("`qp` (default)", run, "plan")]
    columns += [(f"`{name}`", run, f"baseline_{name}") for name in BASELINES]
    columns.append(("as printed (`--config paper`)", printed, "plan"))

    def row(title: str, name: str, text: Callable[[Any], str]) -> list[str]:
        return [title, *(text(of[f"{prefix}_{name}"]) for _, of, prefix in columns)]

    rows = [
        row("ticks moving in contact with the worker", "touch_moving_ticks", lambda n: f"{n:,}"),
        row("fastest contact", "touch_contact_speed_max_m_per_s", lambda v: "\u2013" if v is None else f"{v:.2f} m/s"),
        row("nearest to the worker while moving", "body_distance_min_moving_m", _cm),
        row("pace, of the programmed", "progress_share", _share),
        row("standing still, of the ticks with at most 0.5 m of separation", "stationary_share", _share),
        row("full stops: ticks braking while still moving", "full_stop_share", _share),
        row("ticks moving without a certificate", "uncertified_moving_ticks", lambda n: f"{n:,}"),
        row("greatest TCP speed", "tcp_speed_max_m_per_s", lambda v: f"{v:.2f} m/s"),
        row("standing, with the programme's own dwells", "null_speed_share", _share),
        row("ticks at rest in contact with the worker", "touch_rest_ticks", lambda n: f"{n:,}"),
    ]
    places = {x: _of(facts, f"demo, base at {x} m") for x in PLACES}
    others = [
        f"at x = {x} m `qp` keeps {_share(of['plan_progress_share'])} of the pace and stands in "
        f"{_share(of['plan_stationary_share'])} of the near ticks, `scaling` "
        f"{_share(of['baseline_scaling_progress_share'])} and {_share(of['baseline_scaling_stationary_share'])}"
        for x, of in places.items()
    ]
    paper = [f"{100 * run[f'paper_stationary_share_{name}']:.2f} %" for name in ("qp", "scaling")]
    words = (
        "The worker's hands are on the robot's way all the time, but not where it takes and puts: `scaling` waits on "
        "its path until they leave, `qp` goes round. No contact means: at no tick of the replay, with the worker's "
        "true body, links against limbs; objects and the robot's own links were not looked at. The person was "
        f"predicted for {1000 * run['plan_horizon_median_s']:.0f} ms in the median and "
        f"{1000 * run['plan_horizon_max_s']:.0f} ms at most: as long as the stop from the speed of the tick takes. "
        "Going round helps less where the worker reaches "
        "what the robot wants itself, so that all must wait: beside the same worker, with the box before the robot "
        f"(`tests/data/demo_far.mcap`), with the base {'; '.join(others)}. The paper reports that the robot stood in "
        f"{paper[0]} (QP) and {paper[1]} (scaling) of the time near people, in experiments whose logs were never "
        "published: compare in kind only. Against ground truth the error (RMSE) of the fused joint angles "
        f"is {run['fusion_angle_rmse_ratio']:.2f} of that of the better camera's raw angles, and the error of the "
        f"angular velocities {run['fusion_velocity_rmse_ratio']:.2f} of that of its differenced angles."
    )
    return f"{_table(['', *(title for title, *_ in columns)], rows)}\n\n{_wrapped(words)}"


def headline(facts: Facts) -> str:
    """The demo log by method, in a few rows."""
    run = _of(facts, "demo")
    columns = [("`qp` (default)", "plan"), *((f"`{name}`", f"baseline_{name}") for name in BASELINES)]

    def row(title: str, name: str, text: Callable[[Any], str]) -> list[str]:
        return [title, *(text(run[f"{prefix}_{name}"]) for _, prefix in columns)]

    rows = [
        row("ticks moving in contact with the worker", "touch_moving_ticks", lambda n: f"{n:,}"),
        row("nearest to the worker while moving", "body_distance_min_moving_m", _cm),
        row("pace, of the programmed", "progress_share", _share),
        row("standing still, of the ticks with at most 0.5 m of separation", "stationary_share", _share),
    ]
    return _table(["", *(title for title, _ in columns)], rows)


_ENCLOSES = {
    "sound": "everybody whose limbs keep to the bounds on departures; of a limb out of sight, all within its length of "
    "the one that carries it, or every motion of the model from every state within `prediction.sigmas` of the "
    "estimate, whichever is less; under limits without such bounds the latter; over the braking time and the latency, "
    "with a hand, a lower body, and the measured distance of the body from the model",
    "paper": "Eq. (20)-(30), Alg. 1 and 2 as printed, corrected only where the printed equations cannot be computed",
    "positions": "only bounds of positions and velocities, as printed",
}


def soundness(facts: Facts) -> str:
    """Whether sampled motions got out of each method's volumes."""
    rows = []
    for method, encloses in _ENCLOSES.items():
        cells = []
        for limit_set in ("people", "paper"):
            found = _of(facts, f"soundness, {method}, {limit_set}")
            if found["states_let_out"] == 0:
                cells.append(f"none of {_count(found['samples'])}")
            else:
                cells.append(f"from {_share(found['share'])} of the states, by up to {found['worst_mm']:.0f} mm")
        name = f"`{method}` (default)" if method == "sound" else f"`{method}`"
        rows.append([name, encloses, *cells])
    head = ["method", "what it encloses", "motions that got out, `people`", "Table 1 (`paper`)"]
    bare = _of(facts, "audit excerpt, bare, paper")
    sound, positions = (bare[f"{method}_union_m3"] / bare["paper_union_m3"] for method in ("sound", "positions"))
    words = (
        "`sound` is sampled joint by joint, without departures, with its default margins; the other two know none. "
        "On 15 s of the demo log, with Table 1, exact states and no margins, the volume of `sound` with its lower body "
        f"is {sound:.2f} times that of `paper`, and that of `positions` {positions:.1f} times."
    )
    return f"{_table(head, rows)}\n\n{_wrapped(words)}"


def recordings(facts: Facts) -> str:
    """The demo and the recordings by others: how often everybody stayed inside, and what that took."""
    names = {"demo (simulated)": "audit demo", **{name: f"recording, {name}" for name in RECORDINGS}}
    rows = []
    for name, key in names.items():
        of = _of(facts, key)
        pairs = [f"{method}_{until}ms" for until in HORIZONS_MS for method in ("sound", "v2_a50")]
        cells = [f"{_share(of[f'{pair}_covered_share'])}, {_m3(of[f'{pair}_union_m3'])}" for pair in pairs]
        points = [_share(of[f"{method}_points_share"]) for method in ("sound", "paper")]
        rows.append([name, *cells, points[0], f"{points[1]}, {_m3(of['paper_union_m3'])}"])
    head = [f"{title}, {until} ms" for until in HORIZONS_MS for title in ("`sound`", "capsules")]
    alone = [f"`{method}`, {HORIZONS_MS[-1]} ms, points alone" for method in ("sound", "paper")]
    return _table(["recording", *head, *alone], rows)


def people(facts: Facts) -> str:
    """What each tracker and person, left out of the fit, gave: from the limit set, which ``make people`` makes."""
    found = _departures()
    until = [f"{1000 * horizon_s:.0f} ms" for horizon_s in found["horizon_s"]]
    beside = {"union_without_legs_m3": "no legs", "capsules_m3": "capsules", "fitted_to_it_m3": "fitted to it"}
    head = ["left out", *until, *(f"{title}, {until[-1]}" for title in beside.values())]
    rows = []
    for group in found["groups"]:
        own = [log for log in found["logs"] if log["group"] == group["name"]]
        told = ", not fitted" if group["name"] in found["not_fitted"] else ""
        rows.append([f"**{group['name']}{told}**", *_shares(group), *[""] * len(beside)])
        if len(own) > 1:
            names = [log["name"].rsplit(".", 1)[0] for log in own]
            sizes = [[_m3(log[name][-1]) for name in beside] for log in own]
            rows += [[name, *_shares(log), *size] for name, log, size in zip(names, own, sizes, strict=True)]
        else:
            rows[-1][-len(beside) :] = [_m3(own[0][name][-1]) for name in beside]
    pooled = [f"{_share(one['share'])} ({_share(one['low'])} to {_share(one['high'])})" for one in found["unknown"]]
    together = "recordings together, demo and simulated people not (95 % interval)"
    true = [log for log in found["logs"] if not log["group"].startswith("simulated")]
    means = [_m3(float(size)) for size in np.mean([log["union_m3"] for log in true], axis=0)]
    means += [_m3(float(np.mean([log[name][-1] for log in true]))) for name in beside]
    rest = [share for limb in found["of_recordings"]["at_rest"].values() for share in limb]
    widened = ", ".join(f"{factor:g}" for factor in found["widened"])
    words = (
        f"For people who were not there all lines are wider than the fit by the factors {widened}, one a horizon. "
        f"Of the bounds on limbs at rest the recordings without ground truth alone give {_share(min(rest))} to "
        f"{_share(max(rest))}, {_share(sum(rest) / len(rest))} in the mean; the rest comes from simulated people."
    )
    last = [[together, *pooled, *[""] * len(beside)], ["mean of these recordings", *means]]
    return f"{_table(head, [*rows, *last])}\n\n{_wrapped(words)}"


def misses(facts: Facts) -> str:
    """The limbs that left at horizons at which a recording is inside too rarely, tick by tick, by the limb."""
    found, rows = _departures(), []
    for log in found["logs"]:
        each: dict[tuple[str, float], list[dict[str, Any]]] = {}
        for one in log["misses"]:
            each.setdefault((one["limb"], one["horizon_s"]), []).append(one)
        for (limb, horizon_s), own in each.items():
            at = " ".join(f"{one['at_s']:.2f}" for one in own)
            far, fast = ([one[name] for one in own] for name in ("departed_m", "m_per_s"))
            until = f"{1000 * horizon_s:.0f} ms"
            size, speed = (f"{min(of):.{digits}f} to {max(of):.{digits}f}" for of, digits in ((far, 2), (fast, 1)))
            rows.append([log["name"].rsplit(".", 1)[0], until, f"`{limb}`", size, speed, at])
    return _table(["recording", "horizon", "limb", "departed, m", "over the horizon, m/s", "at, s"], rows)


def oracle(facts: Facts) -> str:
    """Pace of a controller that knows the recorded future beside qp's."""
    of, rows = _of(facts, "oracle"), []
    for name in ORACLED:
        cells = [_share(of[f"{name} {who}_{what}"]) for what in ("pace", "standing") for who in ("qp", "oracle")]
        rows.append([name, *cells, f"{of[f'{name} near_ticks']:,}"])
    head = ["recording", *(f"{what}, `{who}`" for what in ("pace", "standing") for who in ("qp", "oracle"))]
    return _table([*head, "near ticks"], rows)


def partly_seen(facts: Facts) -> str:
    """Whole people inside and volumes, where only the arms are seen and where everything is."""
    of, rows = _of(facts, "partly seen"), []
    for name in PARTLY_SEEN_OF:
        each = [f"{name} arms {when}_{what}" for when in ("just", "long") for what in ("partly", "whole")]
        rows.append([name, *_held_in(of, each), _m3(of[f"{name} arms long_slow_m3"])])
    heads = [f"{when}, {what}" for when in ("0.1 to 0.5 s", "longer") for what in ("arms alone", "everything in sight")]
    return _table(["recording", *heads, f"longer, arms alone, at {SLOWLY:g} of the speeds"], rows)


def without_a_forearm(facts: Facts) -> str:
    """The same, where a forearm is out of sight."""
    of, rows, whats = _of(facts, "partly seen"), [], ("partly", "whole")
    for name in PARTLY_SEEN_OF:
        each = [f"{name} all but a forearm {when}_{what}" for when in ("just", "long") for what in whats]
        rows.append([name, *_held_in(of, each)])
    heads = ("all but a forearm", "everything in sight")
    return _table(["recording", *(f"{when}, {what}" for when in ("0.1 to 0.5 s", "longer") for what in heads)], rows)


def _held_in(of: Mapping[str, Any], each: Sequence[str]) -> list[str]:
    """Shares held, with the mean volume and its median."""
    return [f"{_share(of[f'{one}_held'])}, {_m3(of[f'{one}_m3'])} ({of[f'{one}_median_m3']:.1f})" for one in each]


def coverage_cost(facts: Facts) -> str:
    """Share of people held and mean union, for narrower lines than those shipped."""
    of, until = _of(facts, "coverage cost"), [f"{1000 * h:.0f} ms" for h in _departures()["horizon_s"]]
    rows = []
    for factor in COST_FACTORS:
        pairs = [[of[f"{factor:g} {key} {k}"] for key in ("shares", "union_m3")] for k in range(COST_HORIZONS)]
        rows.append([f"{factor:g}", *(f"{_share(share)}, {_m3(size)}" for share, size in pairs)])
    words = (
        "The narrowest of these lines that hold whole people in 99 % of the ticks take "
        f"{_least_m3(of, until, 2)} and {_least_m3(of, until, COST_HORIZONS - 1)}. All lines were narrowed alike; "
        "other ways to narrow them, or volumes other than balls around limbs, were not tried here."
    )
    return f"{_table(['lines times', *until], rows)}\n\n{_wrapped(words)}"


def _least_m3(of: Figures, until: Sequence[str], k: int) -> str:
    """The smallest mean union that holds people often enough at a horizon."""
    enough = [of[f"{factor:g} union_m3 {k}"] for factor in COST_FACTORS if of[f"{factor:g} shares {k}"] >= _OFTEN]
    return f"{_m3(min(enough))} at {until[k]}" if enough else f"more than all of these at {until[k]}"


def _departures() -> dict[str, Any]:
    return dict(tomllib.loads(PEOPLE.read_text())["provenance"]["departures"])


def _shares(of: Mapping[str, Any]) -> list[str]:
    """Share and volume at each horizon."""
    parts = zip(of["shares"], of["union_m3"], strict=True)
    return [f"{_share(part['share'])}, {_m3(size)}" for part, size in parts]


def margins(facts: Facts) -> str:
    """What the default limits and margins rest on."""
    other = {name: _m3(_of(facts, f"audit excerpt, {name}")["sound_union_m3"]) for name in MARGINS}
    words = (
        f"On 15 s of the demo log the union is {other['default']} at 377 ms. Without the hand it is "
        f"{other['no hand']}, without the residual {other['no residual']}; with joints that are each at their worst, "
        f"as of the limit set `human`, which bounds no departures, {other['joints']}."
    )
    return _wrapped(words, "- ")


def compare(facts: Facts) -> str:
    """The demo log by method, occupancy and horizon."""
    of = _of(facts, "compare")
    columns: tuple[tuple[str, str, Callable[[Any], str]], ...] = (
        ("ticks in contact, moving", "touch_ticks", lambda n: f"{n:,}"),
        ("nearest, moving", "nearest_moving_m", _cm),
        ("pace", "pace", _share),
        ("cycles", "cycles", lambda n: f"{n}"),
        ("stands, of the near ticks", "standing_share", _share),
        ("person held by the volumes", "coverage", _share),
        ("joint jerk", "jerk_rms_rad_per_s3", lambda v: f"{v:.0f} rad/s\u00b3"),
    )
    rows = [[f"`{name}`", *(text(of[f"{name} {key}"]) for _, key, text in columns)] for name in VARIANTS]
    return _table(["method:occupancy:horizon", *(title for title, *_ in columns)], rows)


BLOCKS: dict[str, Callable[[Facts], str]] = {
    "headline": headline,
    "demo": demo,
    "compare": compare,
    "soundness": soundness,
    "recordings": recordings,
    "people": people,
    "misses": misses,
    "oracle": oracle,
    "partly_seen": partly_seen,
    "without_a_forearm": without_a_forearm,
    "coverage_cost": coverage_cost,
    "margins": margins,
}


def _of(facts: Facts, name: str) -> Figures:
    return dict(facts[name]["figures"])


def _table(head: Row, rows: Iterable[Row]) -> str:
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |".replace("|  |", "| |").replace(" --- ", "---") for line in lines)


def _wrapped(text: str, first: str = "") -> str:
    """Lines of at most 120 characters."""
    lines, line = [], first
    for word in text.split(" "):
        if len(line) + len(word) > 120:
            lines.append(line.rstrip())
            line = " " * len(first)
        line += f"{word} "
    return "\n".join([*lines, line.rstrip()])


def _share(value: float | None) -> str:
    """Per cent; 100 only where it is all, 0 only where it is none, a dash where nothing was seen."""
    if value is None:
        return "\u2013"
    if value in (0.0, 1.0):
        return f"{100 * value:.0f} %"
    return share_text(value)


def _cm(value: float | None) -> str:
    """A distance between surfaces; negative in overlap."""
    return "\u2013" if value is None else centimetres(value)


def _m3(value: float | None) -> str:
    if value is None:
        return "\u2013"
    return f"{value:.1f} m\u00b3" if value >= 1.0 else f"{value:.2f} m\u00b3"


def _count(number: float) -> str:
    return f"{number / 1e6:g} million"
