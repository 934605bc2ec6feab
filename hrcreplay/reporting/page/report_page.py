"""The HTML page of a run: one self-contained file, the same bytes for the same run."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path, PurePath
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from hrcreplay.records import LIMBS, RECORDED
from hrcreplay.reporting import summary_text
from hrcreplay.reporting.figures.catalogue import FIGURES, FigureKind, file_name
from hrcreplay.reporting.metrics.fusion import cameras
from hrcreplay.reporting.metrics.people import TRACKED
from hrcreplay.reporting.metrics.series import Metric
from hrcreplay.reporting.page.replay_page import ReplayPart
from hrcreplay.reporting.severity import severity_tables
from hrcreplay.reporting.summary_text import defect_notes
from hrcreplay.reporting.tables import (
    CAMERA,
    FUSION,
    NOT_CLAIMED,
    PLAN_COST,
    PLAN_SAFETY,
    PageTable,
    agreement_table,
    compare,
    limb_names_text,
    percent,
    robot_table,
    text_of,
)
from hrcreplay.reporting.verdict import verdict
from hrcreplay.store.run_folder import Run

#: Suffixes of the metrics of each limb.
_LIMB = ("unmeasured_share", "joints_unmeasured")


@dataclass(frozen=True)
class PageFigure:
    """A figure on the page."""

    name: str
    caption: str
    svg: Markup
    wide: bool = True  #: True: wider than one column of a paper


@dataclass(frozen=True)
class PageSection:
    """A section of the page; ``missing`` explains how to obtain its content."""

    key: str
    title: str
    lead: str
    figures: tuple[PageFigure, ...] = ()
    tables: tuple[PageTable, ...] = ()
    missing: str = ""
    unfolded: bool = False


def render(
    run: Run,
    metrics: Mapping[str, Metric],
    figures_dir: Path,
    tables: Sequence[PageTable] = (),
    *,
    stops: Sequence[PageTable] = (),
    title: str = "",
    replay: ReplayPart | None = None,
    people: Sequence[int] = (1,),
) -> str:
    """Renders the page of a run.

    Args:
        run: The run's tables.
        metrics: Result of :func:`hrcreplay.commands.report.compute`.
        figures_dir: Folder of the figures from :func:`hrcreplay.reporting.figures.catalogue.draw_all`.
        tables: Tables 1 and 2 as used, shown with the prediction.
        stops: The longest stops, shown with the safety.
        title: Name of the session; none: the name of the first input.
        replay: The 3-D replay; None: without one.
        people: Numbers of the people who have figures.

    Returns:
        HTML without requests, times or paths.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(
        resources.files("hrcreplay.reporting.page").joinpath("page.html.j2").read_text("utf-8")
    )
    inputs = [{"name": PurePath(str(i["path"])).name, "sha256": i["sha256"]} for i in run.meta.get("inputs", [])]
    return template.render(
        title=title or (inputs[0]["name"] if inputs else "a session"),
        subtitle=_subtitle(run, metrics),
        verdict=verdict(run, metrics),
        replay=replay,
        answers=summary_text.answers(run, metrics),
        cards=summary_text.cards(run, metrics),
        parts=_parts(run, metrics, figures_dir, tables, stops, people),
        settings=_settings(run.meta.get("settings", {})),
        inputs=inputs,
        versions=sorted(run.meta.get("versions", {}).items()),
        stages=sorted((run.meta.get("stages") or {}).items()),
        flaws=defect_notes(run.counts, run.notes),
        command=shlex.join(run.meta.get("arguments") or [str(run.meta.get("command", ""))]),
        not_claimed=NOT_CLAIMED,
        metrics=[
            (name, text_of(m) if m["value"] is not None else m["reason"], m["value"] is None, m["meaning"])
            for name, m in metrics.items()
        ],
    )


def _subtitle(run: Run, metrics: Mapping[str, Metric]) -> str:
    parts = [f"{text_of(metrics['span_s'])} of recording, {text_of(metrics['ticks'])} ticks"]
    names = cameras(run)
    parts.append(f"{len(names)} camera{'' if len(names) == 1 else 's'}: {', '.join(names)}" if names else "no camera")
    if run.motion is not None:
        others = ", ".join(sorted(run.baselines))
        parts.append(f"plan: {metrics['plan_method']['value']}" + (f", beside it {others}" if others else ""))
    return " \u00b7 ".join(parts)


def _parts(
    run: Run,
    metrics: Mapping[str, Metric],
    figures_dir: Path,
    tables: Sequence[PageTable],
    stops: Sequence[PageTable],
    people: Sequence[int],
) -> tuple[PageSection, ...]:
    seen = cameras(run)
    with_truth = metrics["fusion_angle_rmse"]["value"] is not None
    return (
        *_plan(run, metrics, figures_dir, stops, people),
        *_robot(run, _figures(figures_dir, "robot", people)),
        PageSection(
            "prediction",
            "Prediction",
            "The space that the person could reach until the robot would have stopped, and the bounds behind it.",
            _figures(figures_dir, "prediction", people),
            (*_volumes(metrics), *tables),
            ""
            if run.occupancy is not None
            else "No swept volumes in this run. Run predict, plan or report on the log.",
        ),
        PageSection(
            "fusion",
            "Fusion",
            "The person as each camera saw them, and as the filter has them.",
            _figures(figures_dir, "fusion", people),
            (_fusion_table(metrics, seen),) if with_truth else (),
            "" if with_truth else "The log has no ground truth, so there are no errors.",
        ),
        PageSection(
            "data",
            "Data quality",
            "Content of the log, and its defects." + _left_out(metrics, people),
            _figures(figures_dir, "data", people),
            (
                compare("Cameras", metrics, {name: f"camera_{name}" for name in seen}, CAMERA),
                *agreement_table(run.agreement),
                *_limbs(metrics),
                *_counters(run),
            ),
        ),
    )


def _figures(folder: Path, section: str, people: Sequence[int] = (1,)) -> tuple[PageFigure, ...]:
    """Returns the drawn figures of a section; those of one person for each of ``people``."""
    found = [
        (name, _caption(kind, number, len(people)))
        for kind in FIGURES
        if kind.section == section
        for number in people
        if (folder / f"{(name := file_name(kind, number))}.svg").is_file()
    ]
    return tuple(
        PageFigure(name, caption, inline_svg(folder / f"{name}.svg", name, caption), wide=False)
        for name, caption in found
    )


def _left_out(metrics: Mapping[str, Metric], people: Sequence[int]) -> str:
    """Says that not everybody has figures, if that is so."""
    count = int(metrics[TRACKED]["value"]) if TRACKED in metrics else len(people)
    if count <= len(people):
        return ""
    return (
        f" Figures of one person show person {people[0]} and the {len(people) - 1} others tracked longest, of {count}."
    )


def _caption(kind: FigureKind, number: int, count: int) -> str:
    """Returns the caption of a figure, with the person whom it shows if there are several."""
    return f"Person {number}. {kind.caption}" if count > 1 and (kind.one or kind.each) else kind.caption


def _plan(
    run: Run,
    metrics: Mapping[str, Metric],
    figures_dir: Path,
    stops: Sequence[PageTable],
    people: Sequence[int],
) -> tuple[PageSection, ...]:
    """Makes the sections on the plan and its baselines: safety, and cost to the task."""
    plans = {"this plan": "plan", **{name: f"baseline_{name}" for name in sorted(run.baselines)}}
    ran = {} if run.recorded is None else {"as recorded": RECORDED}
    planned = run.motion is not None
    no_plan = "" if planned else "Not in this run: it moved no robot. Run plan or report on the same log."
    return (
        PageSection(
            "safety",
            "Safety",
            "Speed of the robot, distance from the space that the person could reach, and constraints that slowed it.",
            _figures(figures_dir, "safety", people),
            (
                compare("Safety, per method on the same volumes", metrics, ran | plans, PLAN_SAFETY),
                *severity_tables(run),
                *_reasons(metrics, plans),
                *stops,
            )
            if planned
            else (),
            no_plan,
        ),
        PageSection(
            "cost",
            "Cost to the task",
            "Share of standstill, deviation from the path, and time lost.",
            _figures(figures_dir, "cost", people),
            (compare("Cost, per method on the same volumes", metrics, plans, PLAN_COST, _papers(metrics)),)
            if planned
            else (),
            no_plan,
        ),
    )


def _robot(run: Run, drawn: tuple[PageFigure, ...]) -> tuple[PageSection, ...]:
    """Makes the section on the robot, if the run has one."""
    tables = (robot_table(run.meta["robot"]),) if "robot" in run.meta else ()
    return (PageSection("robot", "Robot", "The capsules around its links.", drawn, tables),) if drawn or tables else ()


def _papers(metrics: Mapping[str, Metric]) -> str:
    qp, scaling = (percent(metrics[f"paper_stationary_share_{method}"], 2) for method in ("qp", "scaling"))
    deviation = text_of(metrics["paper_deviation_m"])
    return (
        f"The paper's own, on its own data: stationary share {qp} (QP) and {scaling} (scaling), deviation {deviation}."
    )


def _reasons(metrics: Mapping[str, Metric], plans: Mapping[str, str]) -> tuple[PageTable, ...]:
    rows = []
    for what in ("braking", "standing"):
        mark = f"_{what}_share_"
        found = sorted({name.split(mark)[1] for name in metrics if mark in name})
        rows += [(f"{what}: {slug.replace('_', ' ')}", f"{what}_share_{slug}") for slug in found]
    body = [
        (
            label,
            *(percent(metrics.get(f"{p}_{suffix}"), 2) for p in plans.values()),
        )
        for label, suffix in rows
    ]
    return (PageTable("Why it braked or stood, share of all ticks", ("", *plans), tuple(body)),) if body else ()


def _volumes(metrics: Mapping[str, Metric]) -> tuple[PageTable, ...]:
    methods = [name.split("_")[1] for name in metrics if name.startswith("occupancy_") and name.endswith("_sum_m3")]
    columns = {method: f"occupancy_{method}" for method in methods}
    rows = [(limb, f"{limb}_m3") for limb in LIMBS]
    rows += [("sum of the six", "sum_m3"), ("LEGS", "LEGS_m3")]
    table = compare(
        "Mean swept volume", metrics, columns, rows, "Limb radius included; over the horizon of each stored tick."
    )
    return (table,) if methods else ()


def _fusion_table(metrics: Mapping[str, Metric], seen: Sequence[str]) -> PageTable:
    ratios = [metrics[f"fusion_{kind}_rmse_ratio"]["value"] for kind in ("angle", "velocity")]
    better = metrics["fusion_angle_better_camera"]["value"]
    note = "Cameras: raw angles at the capture, velocities by differences between frames. Fused: at every tick."
    if ratios[0] is not None and ratios[1] is not None:
        note += (
            f" Fused / better camera: {ratios[0]:.2f} (angles, {better}), {ratios[1]:.2f} "
            f"(velocities, {metrics['fusion_velocity_better_camera']['value']})."
        )
    columns = {"fused": "fusion", **{name: f"camera_{name}" for name in seen}}
    return compare("Errors against ground truth", metrics, columns, FUSION, note)


def _limbs(metrics: Mapping[str, Metric]) -> tuple[PageTable, ...]:
    shares, joints = ([metrics[f"limb_{limb}_{what}"] for limb in LIMBS] for what in _LIMB)
    rows = [
        (limb_names_text([limb]), percent(share), text_of(names))
        for limb, share, names in zip(LIMBS, shares, joints, strict=True)
    ]
    if shares[0]["value"] is None:
        return ()
    columns = ("", "ticks without a measurement", "joints never measured")
    return (PageTable("Limbs, while the person was in view", columns, tuple(rows)),)


def _counters(run: Run) -> tuple[PageTable, ...]:
    tables = []
    if run.counts:
        rows = tuple(
            (name.replace("_", " "), f"{count:,}".replace(",", "\u202f")) for name, count in sorted(run.counts.items())
        )
        tables.append(PageTable("Counters of the run", ("", "count"), rows))
    if run.notes:
        tables.append(PageTable("Remarks", ("",), tuple((note,) for note in run.notes)))
    return tuple(tables)


def _settings(settings: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    def write(value: Any) -> str:
        if isinstance(value, str):
            return PurePath(value).name if value.startswith("/") else value
        if isinstance(value, list):
            return ", ".join(write(part) for part in value) or "\u2013"
        if isinstance(value, dict):
            return ", ".join(f"{name} = {write(part)}" for name, part in sorted(value.items()))
        return "\u2013" if value is None else str(value)

    return [
        (section, [(key, write(value)) for key, value in sorted(keys.items())])
        for section, keys in sorted(settings.items())
        if isinstance(keys, dict)
    ]


def inline_svg(path: Path, name: str, caption: str) -> Markup:
    """Embeds an SVG in a page: without prologue and size, with ids unique to the page."""
    svg = path.read_text("utf-8")
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<style[^>]*>.*?</style>", "", svg, flags=re.DOTALL)
    head, body = svg.split(">", 1)
    head = re.sub(r' (width|height|version|xmlns(:xlink)?)="[^"]*"', "", head)
    body = body.replace("xlink:href", "href")
    body = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{name}-", body)
    body = re.sub(r">\s*\n\s*<", "><", body)
    label = Markup.escape(caption)
    return Markup(f'{head} role="img" aria-label="{label}">{body.strip()}')  # noqa: S704 (our own figure)
