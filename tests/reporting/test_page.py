from __future__ import annotations

import dataclasses
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.records import DOF
from hrcreplay.reporting import summary_text, tables
from hrcreplay.reporting import tables as wording
from hrcreplay.reporting.figures import catalogue
from hrcreplay.reporting.figures.catalogue import FigureData
from hrcreplay.reporting.page import report_page
from hrcreplay.reporting.page.replay_page import replay_part
from hrcreplay.robot.control import control_step
from tests.facts import tells
from tests.reporting.moving import moving_run, moving_scene
from tests.reporting.reading import PAPER, RADII, page_lines, read, rendered
from tests.reporting.synthetic import make_run, metrics_of


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, run = tmp_path_factory.mktemp("figures"), make_run(8.0)
    metrics = metrics_of(run)
    assert catalogue.draw_all(FigureData(run, metrics, near_m=0.5, stationary_m_per_s=0.001), folder)
    return folder


@pytest.fixture(scope="module")
def html(drawn: Path) -> str:
    return rendered(make_run(8.0), drawn)


def test_page_is_self_contained_and_well_formed(html: str) -> None:
    reader = read(html)
    assert len(html) < 6_000_000
    assert reader.tags & {"script", "iframe", "img"} == {"script"}  # for the theme; links says that it names no source
    assert {link.startswith(("#", "data:")) for link in reader.links} == {True}
    assert len(reader.ids) == len(set(reader.ids))
    assert {link[1:] for link in reader.links if link.startswith("#")} <= set(reader.ids)
    assert not re.search(r"url\((?!#)", html)


def test_page_shows_every_figure_drawn_under_its_caption(html: str, drawn: Path) -> None:
    kinds = [kind for kind in catalogue.FIGURES if (drawn / f"{kind.name}.svg").exists()]
    assert len(kinds) > 8
    assert html.count("<figure>") == len(kinds)
    text = " ".join(read(html).text)
    for kind in kinds:
        assert kind.caption in text


def test_page_answers_with_the_metrics_values(html: str) -> None:
    metrics = metrics_of(make_run(8.0))
    text = " ".join(read(html).text)
    for name in ("plan_braking_moving_ticks", "plan_near_ticks", "plan_separation_min_m", "plan_deviation_max_m"):
        assert tables.text_of(metrics[name]) in text, name
    for name in ("plan_stationary_share", "baseline_scaling_stationary_share"):
        assert tables.percent(metrics[name], 2) in text, name
    assert tables.percent(metrics["plan_progress_share"]) in text
    assert tells(text, "30.06 %", "86.44 %")  # the paper's own


def test_page_says_nothing_missing_as_nan_and_no_paths_or_times(html: str) -> None:
    text = " ".join(read(html).text)
    assert not re.search(r"\b(nan|NaN|None|inf)\b", text)
    assert "/somewhere" not in html
    assert "demo.mcap" in text
    assert "ab" * 32 in text


def test_page_has_every_section_and_what_it_does_not_claim(html: str) -> None:
    keys = ("safety", "cost", "prediction", "fusion", "data", "settings", "provenance", "claims")
    assert [i for i in read(html).ids if i in keys] == list(keys)
    assert "not certified" in html


def test_the_same_run_renders_the_same_page_wherever_its_figures_are(html: str, drawn: Path, tmp_path: Path) -> None:
    for path in drawn.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    assert rendered(make_run(8.0), tmp_path) == html


def test_a_robot_that_kept_the_constraint_throughout(tmp_path: Path) -> None:
    run = make_run(4.0)
    assert run.motion is not None
    kept = dataclasses.replace(run, motion=run.motion.assign(status="tracking", reason=""))
    short = summary_text.answers(kept, metrics_of(kept))[0].short
    assert tells(short, "paper's", "every")
    broken = summary_text.answers(run, metrics_of(run))[0].short
    assert tells(broken, "Not")
    assert not tells(short, "Not")
    page = rendered(kept, tmp_path)
    assert short in page_lines(page)


def test_every_reason_to_brake_has_its_words() -> None:
    assert set(control_step.REASONS[1:]) <= set(wording.REASONS)
    assert len({wording.reason_text(reason) for reason in control_step.REASONS[1:]}) == len(control_step.REASONS) - 1
    assert tells(wording.reason_text("no oil"), "'no oil'")


def test_the_verdict_says_by_reason_what_happened(tmp_path: Path) -> None:
    """Where the distance failed somebody knew where the person was."""
    run = make_run(4.0)
    assert run.motion is not None
    n = len(run.motion)
    reason = np.where(np.arange(n) < 30, "separation failed", np.where(np.arange(n) == 30, "no oil", ""))
    status = np.where(reason == "", "tracking", "braking")
    braked = dataclasses.replace(run, motion=run.motion.assign(status=status, reason=reason, tcp_speed=0.2))
    text = " ".join(read(rendered(braked, tmp_path)).text)
    said = wording.REASONS["separation failed"]
    assert re.search(rf"\b30 ticks {re.escape(said)}; [^;.]*\b1 tick [^;.]*'no oil'", text)
    assert wording.REASONS["no human state"] not in text


def test_the_smallest_distance_says_which_it_is() -> None:
    run = make_run(4.0)
    assert run.motion is not None
    touching = dataclasses.replace(run, motion=run.motion.assign(distance_m=0.0, status="limited", reason=""))
    metrics = metrics_of(touching)
    safe, _ = summary_text.answers(touching, metrics)
    assert tells(safe.words, "0.000 m", "surface", "T_s = 0.377 s", "not to the body")
    card = summary_text.cards(touching, metrics)[1]
    assert card.value == "0.000 m"
    assert tells(card.label, "surface", "T_s")
    assert tells(card.detail, "not to the body")


def test_times_below_a_second_are_not_rounded_to_nothing() -> None:
    def metric(value: float) -> dict[str, object]:
        return {"value": value, "unit": "s", "meaning": ""}

    assert tables.text_of(metric(0.0337)) == "34 ms"
    assert tables.text_of(metric(0.0001)) == "below 1 ms"
    assert tables.text_of(metric(0.0)) == "0.0 s"
    assert tables.text_of(metric(1.25)) == "1.2 s"


def test_a_tables_cells_wrap_rather_than_be_cut_off(html: str) -> None:
    style = html[html.index("<style>") : html.index("</style>")]
    assert "nowrap" not in style
    assert re.search(r"\.scroll \{[^}]*overflow-x: auto", style)


def test_the_page_gives_the_command_that_makes_it_again(tmp_path: Path) -> None:
    run = make_run(2.0)
    arguments = ["report", "demo.mcap", "--start", "8", "--cell", "CELL.toml", "--set", 'logs.topics=["/a b"]']
    again = dataclasses.replace(run, meta={**run.meta, "arguments": arguments})
    text = " ".join(read(rendered(again, tmp_path)).text)
    assert shlex.join(["hrcreplay", *arguments]) in text
    assert tells(page_lines(rendered(again, tmp_path)), "CELL.toml", "run.json", "cell")
    assert "hrcreplay report" in " ".join(read(rendered(run, tmp_path)).text)  # a run of an earlier version


def test_a_fused_run_explains_what_is_missing(tmp_path: Path) -> None:
    lines = page_lines(rendered(make_run(4.0, human=False, robot=False), tmp_path))
    assert tells(lines, "swept volumes", "predict", "plan", "report")
    assert tells(lines, "robot", "plan", "report")
    assert tells(lines, "no ground truth")


def test_table_1_reads_as_the_paper_prints_it() -> None:
    rows = {row[0]: row[1:] for row in tables.limit_table(PAPER, use="prediction").rows}
    assert rows["x"] == ("\u2212\u221e", "\u221e", "0.00", "0.80", "\u22120.10", "0.10")
    assert rows["\u03c1"] == (
        "\u2212\u03c0/6",
        "\u03c0/2",
        "\u2212\u03c0/10",
        "\u03c0/10",
        "\u2212\u03c0/20",
        "\u03c0/20",
    )
    assert rows["\u03b1 r,1"][:2] == ("\u2212\u03c0/20", "8\u03c0/9")
    assert rows["\u03b1 l,2"][:2] == ("(34b)", "(34b)")
    assert rows["\u03b1 r,3"][:2] == ("(34c)", "(34c)")
    assert rows["\u03b1 l,4"] == (
        "\u03c0/9",
        "\u03c0",
        *["\u22123\u03c0/10", "3\u03c0/10", "\u22123\u03c0/20", "3\u03c0/20"],
    )


def test_bounds_that_are_no_fraction_of_pi_stay_numbers() -> None:
    odd = dataclasses.replace(PAPER, v_max=np.full(DOF, 12.6), coupled=False)
    rows = {row[0]: row[1:] for row in tables.limit_table(odd, use="tracking").rows}
    assert rows["\u03b1 r,2"][3] == "12.60"
    assert rows["\u03b1 r,2"][:2] == ("\u2212\u03c0", "\u03c0")


def test_table_2() -> None:
    assert tables.radius_table(RADII).rows[1] == ("thorax", "0.15")


def test_a_robot_that_was_never_let_go_is_said_to_have_stood() -> None:
    run = make_run(4.0)
    assert run.motion is not None
    still = dataclasses.replace(run, motion=run.motion.assign(tcp_speed=0.0))
    safe, _ = summary_text.answers(still, metrics_of(still))
    assert tells(safe.short, "never moved")
    assert tells(safe.words, "all 400 ticks")


def test_an_interval_does_not_break_at_its_dash(tmp_path: Path) -> None:
    run = make_run(2.0)
    shown = tables.PageTable("shares", ("", "here"), (("limb", "99.5 (97.1\u2013100.0)"),))
    html = report_page.render(run, metrics_of(run), tmp_path, [shown])
    assert "<td>99.5 (97.1\u2013\u2060100.0)</td>" in html


def test_a_page_of_ten_minutes_stays_small(tmp_path: Path) -> None:
    """Even with noise of a millimetre on every vertex, which deflates badly; figures add at most 4 MB."""
    run = make_run(2.0)
    scene = moving_scene(moving_run(600.0))
    assert len(scene.t_ns) == 15_000
    noise = np.random.default_rng(2).normal(scale=1e-3, size=scene.volumes.vertices_m.shape)
    volumes = dataclasses.replace(scene.volumes, vertices_m=scene.volumes.vertices_m + noise)
    html = report_page.render(
        run, metrics_of(run), tmp_path, replay=replay_part(dataclasses.replace(scene, volumes=volumes))
    )
    assert len(html) < 11_000_000
