"""The HTML page of an audit."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path, PurePath
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from hrcreplay.audit.figures import METHODS, in_order
from hrcreplay.audit.metrics import (
    checked_cameras,
    checked_scope,
    checked_table,
    text_with_interval,
    unchecked_notes,
    volume_at,
)
from hrcreplay.records import JOINTS, LIMBS
from hrcreplay.reporting.metrics.series import ANGLES, Metric
from hrcreplay.reporting.page.report_page import PageFigure, PageSection
from hrcreplay.reporting.summary_text import Answer, Card
from hrcreplay.reporting.tables import PageTable, percent, share_text, text_of

CAPTIONS = {
    "audit_coverage": (
        "Share of the ticks at which every limb that was checked, the lower body left out, stayed in its own volume "
        "for the whole horizon, against the size of these volumes: not all methods have a lower body. "
        "Diamonds: our methods with the limit set as given; lines: its velocities, accelerations and departures times "
        "the factors written beside them. Squares: peers. Bars: 95 % intervals. Faint: each log."
    ),
    "audit_limbs": "Coverage, where checked, and mean volume of each limb, with 95 % intervals.",
    "audit_joints": (
        "Share of the ticks at which a joint's recorded future stayed inside its reachable interval: the bound that "
        "fails shows here."
    ),
}
_CLAIMS = (
    "A limb or a point that was not checked may have been anywhere.",
    "Coverage on these logs is not valid for other people, other tasks or faster motion than those recorded.",
    "Recorded points are points of a skeleton. The share with the limb's own thickness is given per limb.",
    "Intervals rest on the ticks of these logs alone; where a log is short or the person still, they are wide.",
    "hrcreplay is a research tool. It is not certified, and no page of it makes a robot cell safe or compliant.",
)
_MOST_ESCAPES = 25


def render(found: Mapping[str, Any], metrics: Mapping[str, Metric], meta: Mapping[str, Any], figures_dir: Path) -> str:
    """Renders the page of an audit.

    Args:
        found: The content of audit.json.
        metrics: The content of metrics.json.
        meta: The content of run.json.
        figures_dir: Folder of the figures from ``figures.draw_all``.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(
        resources.files("hrcreplay.reporting.page").joinpath("page.html.j2").read_text("utf-8")
    )
    names = [log["log"] for log in found["logs"]]
    total = found["total"]
    return template.render(
        title="Audit: " + ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else ""),
        subtitle=f"{total['ticks']} ticks at {found['audit_hz']:g} Hz, horizon {found['horizon_s']:g} s",
        verdict=None,  # an audit has no robot
        answers=(_answer(found),),
        cards=_cards(found),
        parts=(_coverage(found, figures_dir), _limbs(found, figures_dir), _joints(found, figures_dir), _data(found)),
        settings=_settings(meta.get("settings", {})),
        inputs=[{"name": PurePath(str(i["path"])).name, "sha256": i["sha256"]} for i in meta.get("inputs", [])],
        versions=sorted(meta.get("versions", {}).items()),
        stages=[],
        flaws=(),  # notes of each log are in the section on the data
        command=str(meta.get("command", "")),
        not_claimed=_CLAIMS,
        metrics=[
            (name, text_of(m) if m["value"] is not None else m["reason"], m["value"] is None, m["meaning"])
            for name, m in metrics.items()
        ],
    )


def _answer(found: Mapping[str, Any]) -> Answer:
    method = found["method"]
    whole = found["total"]["methods"][method]["all"]
    share = whole["covered_share"]
    if share["value"] is None:
        return Answer("Did the person stay in the predicted volumes?", "No limb could be checked.", "")
    sources = sorted({log["recorded_future"] for log in found["logs"]})
    limits = sorted({log["limits"] for log in found["logs"]})
    words = (
        f"Method {METHODS.get(method, method)}, limits {', '.join(limits)}: at this share of {share['samples']} ticks "
        f"every limb that was checked ({checked_scope(found['total'], method)}) stayed, limb radius included, around "
        f"its recorded points ({', '.join(sources)}) in its own volume for all of the next {found['horizon_s']:g} s. "
        f"95 % interval {share_text(share['low'])} to {share_text(share['high'])}. For skeleton points only, "
        f"limb thickness ignored, it is {percent(whole['points_share'])}."
    )
    deepest = whole["escape_max_m"]
    if deepest is not None:
        words += f" The deepest escape was {100 * deepest:.1f} cm."
    for note in unchecked_notes(found["total"], method):
        words += f" {note[0].upper()}{note[1:]}."
    return Answer("Did the person stay in the predicted volumes?", f"At {percent(share, 2)} of the ticks.", words)


def _cards(found: Mapping[str, Any]) -> tuple[Card, ...]:
    cards = []
    for method in in_order(found["total"]["methods"]):
        whole = found["total"]["methods"][method]["all"]
        if whole["covered_share"]["value"] is not None:
            room = text_with_interval(whole["union_m3"], decimals=2)
            value = percent(whole["covered_share"])
            cards.append(Card(value, METHODS.get(method, method), f"union {room} m\u00b3"))
    return tuple(cards)


def _figure(folder: Path, name: str) -> PageFigure:
    """Embeds an SVG as an image on white; its caption describes it."""
    data = base64.b64encode((folder / f"{name}.svg").read_bytes()).decode()
    look = "display: block; width: 100%; background: #fff; border-radius: 6px"
    label = Markup.escape(CAPTIONS[name])
    image = Markup(f'<img style="{look}" alt="{label}" src="data:image/svg+xml;base64,{data}">')  # noqa: S704 (our own)
    return PageFigure(name, CAPTIONS[name], image)


def _named(methods: Sequence[str]) -> tuple[str, ...]:
    return tuple(METHODS.get(method, method) for method in methods)


def _coverage(found: Mapping[str, Any], folder: Path) -> PageSection:
    methods = in_order(found["total"]["methods"])
    rows = [(log["log"], log) for log in found["logs"]]
    if len(rows) > 1:
        rows.append(("total", found["total"]))

    every = "Ticks with every whole limb that was checked"

    def table(title: str, key: str, scale: float, decimals: int, note: str, limbs: str = "all") -> PageTable:
        body = tuple(
            (name, *(text_with_interval(part["methods"][m][limbs][key], scale, decimals) for m in methods))
            for name, part in rows
        )
        return PageTable(title, ("log", *_named(methods)), body, note)

    blocks = found["interval"]
    way = (
        f"95 % intervals from a circular moving-block bootstrap, blocks of {blocks['block_ticks']} ticks "
        f"({blocks['block_ticks'] / found['audit_hz']:.2f} s), {blocks['draws']} draws; of shares, "
        f"wide enough for a binomial with one look a horizon too. {_equal(found)}"
    )
    if len(found["logs"]) > 1:
        way += " The total counts every tick once: a long log weighs more than a short one."
    error = max(found["total"]["methods"][m]["all"]["union_counting_error"] or 0.0 for m in methods)
    return PageSection(
        "coverage",
        "Coverage",
        "Did the recorded person stay in the predicted volumes, and how large were these volumes?",
        (_figure(folder, "audit_coverage"),),
        (
            table(f"{every} covered [%]", "covered_share", 100.0, 1, f"{_lower(found)} {way}"),
            table("Union of all the limbs' volumes, mean [m\u00b3]", "union_m3", 1.0, 2, _counted(error)),
            table("Escape depth where a limb escaped, median [mm]", "escape_p50_m", 1e3, 0, ""),
            table("Escape depth where a limb escaped, 95th percentile [mm]", "escape_p95_m", 1e3, 0, ""),
            table("Ticks with the points alone of every limb covered [%]", "points_share", 100.0, 1, ""),
            *_by_horizon(found, every),
            table(f"{every} covered, the lower body left out [%]", "covered_share", 100.0, 1, "", "upper"),
            table("Union of the volumes, the lower body left out, mean [m\u00b3]", "union_m3", 1.0, 2, "", "upper"),
        ),
    )


def _by_horizon(found: Mapping[str, Any], every: str) -> tuple[PageTable, ...]:
    """Makes the table of coverage and volume at horizons up to that of the audit, for all logs together."""
    points = found["total"]["horizons"]
    compared = tuple(points[0]["methods"])
    head = ("until after the tick", *_named(compared))

    def table(title: str, key: str, scale: float, decimals: int, note: str) -> PageTable:
        body = tuple(
            (
                f"{point['horizon_s']:g} s",
                *(text_with_interval(point["methods"][m][key], scale, decimals) for m in compared),
            )
            for point in points
        )
        return PageTable(title, head, body, note)

    note = "A robot that is slow beside people stops long before the braking time, so it is predicted for less."
    return (
        table(f"{every} covered, by horizon [%]", "covered_share", 100.0, 1, note),
        table("Union of all the limbs' volumes by horizon, mean [m\u00b3]", "union_m3", 1.0, 2, ""),
    )


def _counted(error: float) -> str:
    return f"Counted out with evenly spread points; standard error at most {100 * error:.1f} % a tick."


def _lower(found: Mapping[str, Any]) -> str:
    """Returns a sentence on the methods with a volume for the lower body."""
    methods = found["total"]["methods"]
    have = [METHODS.get(m, m) for m in in_order(methods) if "LEGS" in methods[m]]
    if not have:
        return "No method has a volume for the lower body."
    return f"The lower body is among the limbs of {', '.join(have)} alone: others have no volume for it."


def _equal(found: Mapping[str, Any]) -> str:
    """Returns volumes of hrcreplay's methods where their curves reach a baseline's coverage less half a percent."""
    peer = found["total"]["methods"].get("v2_a50")
    if peer is None or peer["upper"]["covered_share"]["value"] is None or not peer["upper"]["union_m3"]["value"]:
        return ""
    target = peer["upper"]["covered_share"]["value"] - 0.005
    parts = []
    for method, curve in found["total"]["curve"].items():
        room = volume_at(curve, target)
        if room is not None:
            parts.append(f"{METHODS.get(method, method)} {100 * room / peer['upper']['union_m3']['value']:.0f} %")
    if not parts:
        return ""
    peers = METHODS["v2_a50"]
    at = f"At the coverage of {peers} less half a percent, along the curves"
    return f"{at}, the lower body left out, of its volume: {', '.join(parts)}."


def _limbs(found: Mapping[str, Any], folder: Path) -> PageSection:
    methods = in_order(found["total"]["methods"])
    figures = found["total"]["methods"]
    limbs = [limb for limb in (*LIMBS, "LEGS") if any(limb in figures[m] for m in methods)]

    def table(title: str, key: str, scale: float, decimals: int, note: str = "") -> PageTable:
        body = []
        for limb in limbs:
            cells = [figures[m].get(limb, {}).get(key) for m in methods]
            if any(cell is not None for cell in cells):
                body.append((limb, *("\u2013" if c is None else _cell(c, scale, decimals) for c in cells)))
        return PageTable(title, ("limb", *_named(methods)), tuple(body), note)

    deepest = [(limb, *(_millimetres(figures[m].get(limb, {}).get("escape_max_m")) for m in methods)) for limb in limbs]
    return PageSection(
        "limbs",
        "Limbs",
        "Each limb in its own volume. A dash: the method has no volume for it, or nobody left it.",
        (_figure(folder, "audit_limbs"),),
        (
            checked_table(found["total"], found["method"]),
            table("Ticks with the whole limb covered, of those checked [%]", "covered_share", 100.0, 1),
            table("Ticks with its points alone covered [%]", "points_share", 100.0, 1),
            PageTable("Deepest escape [mm]", ("limb", *_named(methods)), tuple(deepest)),
            table("Volume, mean [m\u00b3]", "volume_m3", 1.0, 2),
        ),
    )


def _cell(figure: Mapping[str, Any], scale: float, decimals: int) -> str:
    return text_with_interval(figure, scale, decimals) if figure["samples"] else "not checked"


def _millimetres(value: float | None) -> str:
    return "\u2013" if value is None else f"{1e3 * value:.0f}"


def _joints(found: Mapping[str, Any], folder: Path) -> PageSection:
    tables = found["total"]["joints"]
    methods = in_order(tables)
    body = []
    for joint in JOINTS:
        went = tables[methods[0]][joint]["travel"]
        moved = "\u2013" if went is None else f"{went:.2f} m" if joint not in ANGLES else f"{went * 57.29578:.0f}\u00b0"
        body.append((joint, moved, *(text_with_interval(tables[m][joint]["inside_share"], 100.0) for m in methods)))
    table = PageTable(
        "Ticks with the joint in its reachable interval [%]", ("joint", "moved", *_named(methods)), tuple(body)
    )
    figures = (_figure(folder, "audit_joints"),)
    return PageSection("joints", "Joints", "Which bound fails.", figures, (table, _deviations(found["total"])))


def _deviations(total: Mapping[str, Any]) -> PageTable:
    rows = []
    for joint in JOINTS:
        cells = []
        for name in ("position", "velocity"):
            one = total["deviations"][joint][name]
            within = " / ".join("\u2013" if share is None else f"{100 * share:.0f}" for share in one["within"])
            cells += ["\u2013" if one["rms"] is None else f"{one['rms']:.2f}", within]
        rows.append((joint, *cells))
    note = (
        "Consistency of the filter. For normal errors with the right deviations the root mean square is 1, and 68, 95 "
        "and 99.7 % are within 1, 2 and 3 of them; a smaller root mean square: the reported deviations are too large."
    )
    head = ("joint", "position, rms", "within 1 / 2 / 3 [%]", "velocity, rms", "within 1 / 2 / 3 [%]")
    return PageTable("Errors of the fused person, in their standard deviations", head, tuple(rows), note)


def _data(found: Mapping[str, Any]) -> PageSection:
    tables = []
    for log in found["logs"]:
        rows = [(f"limits of the prediction: {log['limits']}",), *((note,) for note in log["notes"])]
        tables.append(PageTable(f"{log['log']}: {log['ticks']} ticks", ("",), tuple(rows)))
        tables.append(checked_cameras(log))
        counts = tuple((name.replace("_", " "), str(count)) for name, count in log["counts"].items())
        tables.append(PageTable(f"{log['log']}: what was counted on the way", ("", "count"), counts))
        tables.append(_first_movements(log, found["method"]))
        tables += [_escapes(log, method) for method in found["own_methods"]]
    return PageSection(
        "data",
        "Logs and escapes",
        "Reference of each log, rejected points, and times at which a person left a volume.",
        (),
        tuple(table for table in tables if table.rows),
    )


def _first_movements(log: Mapping[str, Any], method: str) -> PageTable:
    rows = tuple(
        (
            f"{one['at_s']:.2f} s",
            one["limb"],
            str(one["ticks"]) if one["ticks"] else "not checked",
            str(one["escaped_ticks"]) if one["ticks"] else "\u2013",
            _millimetres(one["deepest_m"] if one["escaped_ticks"] else None),
        )
        for one in log["first_movements"]
    )
    note = (
        "When an end of the limb was first 10 cm from where it had been: a movement that the filter could not predict. "
        "The ticks up to a horizon before and after it are counted."
    )
    title = f"{log['log']}: first movements, and {METHODS.get(method, method)} then"
    return PageTable(title, ("first", "limb", "ticks checked", "of these outside", "deepest [mm]"), rows, note)


def _escapes(log: Mapping[str, Any], method: str) -> PageTable:
    every = log["escapes"][method]
    deepest = sorted(every, key=lambda e: -e["deepest_m"])[:_MOST_ESCAPES]
    rows = tuple(
        (
            f"{e['from_s']:.2f} s",
            f"{e['to_s']:.2f} s",
            e["limb"],
            str(e["ticks"]),
            f"{1e3 * e['deepest_m']:.0f}",
            f"{e['deepest_at_s']:.2f} s",
        )
        for e in sorted(deepest, key=lambda e: (e["from_s"], e["limb"]))
    )
    note = (
        ""
        if len(every) <= _MOST_ESCAPES
        else f"The deepest {_MOST_ESCAPES} of {len(every)}; all are in escapes.parquet."
    )
    title = f"{log['log']}: escapes from {METHODS.get(method, method)}"
    return PageTable(title, ("predicted from", "to", "limb", "ticks", "deepest [mm]", "at"), rows, note)


def _settings(settings: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Returns the settings that an audit depends on."""
    return [
        (section, [(key, str(value)) for key, value in sorted(settings[section].items())])
        for section in ("fusion", "limits", "occupancy")
        if section in settings
    ]
