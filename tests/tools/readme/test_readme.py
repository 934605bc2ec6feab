"""The README's figures are those of docs/figures.json, and the quick ones of these are still what comes out."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from hrcreplay.cli.app import app
from hrcreplay.commands import replay, report
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import Run
from tests.tools import coverage_cost, oracle, partly_seen
from tests.tools.readme import __main__ as readme
from tests.tools.readme.blocks import BLOCK, BLOCKS, fill
from tests.tools.readme.measurements import (
    BASELINES,
    COMPARED,
    COST_FACTORS,
    COST_HORIZONS,
    DEMO,
    HORIZONS_MS,
    ORACLED,
    PARTLY_SEEN_OF,
    RECORDINGS,
    ROOT,
    VARIANTS,
    Measurement,
    load,
    measurements,
    of_report,
)
from tests.tools.soundness import __main__ as soundness

FACTS = load(readme.FACTS)
TEXTS = [page.read_text() for page in readme.PAGES]
CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
#: What is measured and not given: a share, a volume, a depth, how many times.
MEASURED = re.compile(r"\d(?:[\d.,]*) (?:%|mm\b|m\u00b3|times\b|million\b)|\d\.\d+ of\b")


def test_the_readme_holds_the_figures_that_were_measured() -> None:
    assert sorted(name for text in TEXTS for _, name, _, _ in BLOCK.findall(text)) == sorted(BLOCKS)
    for text in TEXTS:
        assert fill(text, FACTS) == text, "make readme"


def test_the_guide_lists_the_settings_as_they_are() -> None:
    text = readme.GUIDE.read_text()
    assert readme.with_settings(text) == text, "make readme"


def test_the_readme_is_short() -> None:
    assert len(TEXTS[0].splitlines()) <= 110


def test_every_figure_was_measured() -> None:
    known = {measurement.name: measurement for measurement in measurements()}
    assert set(FACTS) == set(known)
    for name, measurement in known.items():
        assert FACTS[name]["command"] == " && ".join(measurement.commands)


def test_no_figure_stands_outside_of_what_is_measured() -> None:
    for text in TEXTS:
        assert not MEASURED.findall(BLOCK.sub("", CODE.sub("", text)))
    assert len(MEASURED.findall("".join(TEXTS))) > 30


def _same(name: str, found: dict[str, Any]) -> None:
    """To the digits that a machine of another kind may round otherwise."""
    stated = FACTS[name]["figures"]
    assert set(found) <= set(stated)
    for key, value in found.items():
        assert stated[key] == (value if value is None else pytest.approx(value, rel=1e-6)), key


def test_the_demo_by_default(demo_with_objects: Path) -> None:
    _same("demo", of_report(json.loads((demo_with_objects / "metrics.json").read_text())))


def test_the_demo_as_printed(printed: Run) -> None:
    _same("demo, as printed", of_report(report.compute(printed, near_m=0.5, stationary_m_per_s=0.001)))


@pytest.mark.parametrize("measurement", measurements(), ids=lambda measurement: measurement.name)
def test_the_commands_parse(measurement: Measurement) -> None:
    commands: Any = typer.main.get_command(app)
    for command in measurement.commands:
        module, *words = shlex.split(command.format(tmp="tmp", data="data"))
        if module == "hrcreplay":
            commands.commands[words[0]].make_context(words[0], words[1:])
        elif module == "tests.tools.oracle":
            assert oracle.parser().parse_args(words).names == [*ORACLED]
        elif module == "tests.tools.partly_seen":
            assert partly_seen.parser().parse_args(words).names == [*PARTLY_SEEN_OF]
        elif module == "tests.tools.coverage_cost":
            assert coverage_cost.parser().parse_args(words).names == [*RECORDINGS.values()]
        else:
            assert module == "tests.tools.soundness"
            soundness._parser().parse_args(words)


def _made_up() -> dict[str, Any]:
    """Facts of which every figure can be told from every other."""
    numbers = iter(np.linspace(0.1, 0.9, 2000).tolist())
    facts: dict[str, Any] = {}
    for measurement in measurements():
        kinds = {"compare": _compared, "oracle": _oracled, "partly seen": _partly_seen, "coverage cost": _cost}
        made = kinds.get(measurement.name, _Numbers)
        found = measurement.keep(made(numbers))
        facts[measurement.name] = {"figures": dict(found)}
    return facts


def _compared(numbers: Any) -> dict[str, Any]:
    return {"total": {name: {key: next(numbers) for key in COMPARED} for name in VARIANTS}}


def _oracled(numbers: Any) -> dict[str, Any]:
    keys = [f"{who}_{what}" for who in ("qp", "oracle") for what in ("pace", "standing")]
    return {name: {**{key: next(numbers) for key in keys}, "near_ticks": 1} for name in ORACLED}


def _partly_seen(numbers: Any) -> dict[str, Any]:
    cases = [f"{case} {when}" for case in partly_seen.CASES for when in partly_seen.WHEN]
    each = [f"{case}_{what}" for case in cases for what in partly_seen.WHAT]
    keys = [*(f"{one}_{what}" for one in each for what in ("held", "m3", "median_m3")), "arms long_slow_m3"]
    return {name: {key: next(numbers) for key in keys} for name in PARTLY_SEEN_OF}


def _cost(numbers: Any) -> dict[str, Any]:
    keys = ("shares", "union_m3")
    return {
        f"{factor:g}": {key: [next(numbers) for _ in range(COST_HORIZONS)] for key in keys} for factor in COST_FACTORS
    }


AUDIT_KEYS = [
    *(
        f"audit_{method}_all_{key}"
        for method in ("sound", "paper", "positions")
        for key in ("points_share", "union_m3")
    ),
    *(
        f"audit_{method}_{until}ms_{key}"
        for method in ("sound", "v2_a50")
        for until in HORIZONS_MS
        for key in ("covered_share", "union_m3")
    ),
]


class _Numbers(dict[str, Any]):
    """Metrics with a number of their own for each name that is asked for."""

    def __init__(self, numbers: Any) -> None:
        self._numbers = numbers

    def __contains__(self, key: object) -> bool:
        return True

    def __missing__(self, key: str) -> Any:
        number = next(self._numbers)
        return number if key in ("samples", "states", "states_let_out", "share", "worst_mm") else {"value": number}


def test_a_column_holds_its_own_method() -> None:
    facts = _made_up()
    text = BLOCKS["demo"](facts)
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[:9]]
    assert [re.findall(r"`([\w-]+)", cell)[0] for cell in head[1:]] == ["qp", *BASELINES, "--config"]
    prefixes = ["plan", *(f"baseline_{name}" for name in BASELINES), "plan"]
    for column, prefix in enumerate(prefixes, start=1):
        run = facts["demo, as printed" if column == len(prefixes) else "demo"]["figures"]
        assert rows[1][column] == f"{run[f'{prefix}_touch_contact_speed_max_m_per_s']:.2f} m/s"
        assert rows[3][column] == f"{100 * run[f'{prefix}_progress_share']:.1f} %"
        assert rows[4][column] == f"{100 * run[f'{prefix}_stationary_share']:.1f} %"


def test_a_row_holds_its_own_variant() -> None:
    facts = _made_up()
    figures = facts["compare"]["figures"]
    _, _, *rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in BLOCKS["compare"](facts).splitlines()
    ]
    assert [row[0] for row in rows] == [f"`{name}`" for name in VARIANTS]
    for name, row in zip(VARIANTS, rows, strict=True):
        assert row[3] == f"{100 * figures[f'{name} pace']:.1f} %"
        assert row[5] == f"{100 * figures[f'{name} standing_share']:.1f} %"


def test_a_recording_holds_its_own_predictions() -> None:
    facts = _made_up()
    line = next(line for line in BLOCKS["recordings"](facts).splitlines() if line.startswith("| demo (simulated)"))
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    audit = facts["audit demo"]["figures"]
    for column, (method, until) in enumerate(((m, h) for h in HORIZONS_MS for m in ("sound", "v2_a50")), start=1):
        share, size = (audit[f"{method}_{until}ms_{key}"] for key in ("covered_share", "union_m3"))
        assert cells[column] == f"{100 * share:.1f} %, {size:.2f} m\u00b3"
    assert cells[5] == f"{100 * audit['sound_points_share']:.1f} %"


@pytest.mark.parametrize(
    ("share", "text"), [(1.0, "100 %"), (0.99999, "99.9 %"), (0.0, "0 %"), (1e-9, "0.1 %"), (None, "\u2013")]
)
def test_all_and_none_are_said_of_all_and_none_alone(share: float | None, text: str) -> None:
    facts = _made_up()
    facts["audit demo"]["figures"]["sound_100ms_covered_share"] = share
    assert f"| demo (simulated) | {text}, " in BLOCKS["recordings"](facts)


def test_a_block_of_which_a_figure_is_missing_stays() -> None:
    text = "<!-- figures: margins -->\nold\n<!-- end -->\n<!-- figures: demo -->\nold\n<!-- end -->\n"
    facts = _made_up()
    del facts["audit excerpt, joints"]
    kept, written = fill(text, facts).split("<!-- end -->\n")[:2]
    assert kept == "<!-- figures: margins -->\nold\n"
    assert "old" not in written


def test_only_the_figures_asked_for_are_measured_and_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And without the recordings of others their figures stay."""
    for name, path in (
        ("FACTS", "figures.json"),
        ("GUIDE", "guide.md"),
        ("REFERENCE", "reference.md"),
        ("CACHE", ".readme"),
    ):
        monkeypatch.setattr(readme, name, tmp_path / path)
    monkeypatch.setattr(readme, "PAGES", (tmp_path / "README.md",))
    (tmp_path / "guide.md").write_text("<!-- settings -->\n<!-- end of settings -->\n")
    (tmp_path / "reference.md").write_text("")
    monkeypatch.delenv("HRCREPLAY_DATA", raising=False)
    (tmp_path / "README.md").write_text("<!-- figures: recordings -->\n<!-- end -->\n")
    old = _made_up()
    (tmp_path / "figures.json").write_text(json.dumps(old))
    asked: list[str] = []
    audit = next(m for m in measurements() if m.name == "audit demo")

    def measure(measurement: Measurement, _data: str, _picture: Path) -> Any:
        asked.append(measurement.name)
        return {**{name: {"value": 0.5} for name in AUDIT_KEYS}, "audit_ticks": {"value": 7}}

    monkeypatch.setattr(readme, "_measure", measure)
    for _ in range(2):
        assert readme.main(["audit demo", "recording"]) == 0
    assert asked == [audit.name]
    new = json.loads((tmp_path / "figures.json").read_text())
    assert new["audit demo"]["figures"]["ticks"] == 7
    assert new["demo"] == old["demo"]
    assert "recording, Kinect v2, waving: left as it was, for HRCREPLAY_DATA is not set" in capsys.readouterr().out
    assert "| demo (simulated) | 50.0 %, 0.50 m\u00b3 |" in (tmp_path / "README.md").read_text()


def test_the_shipped_log_is_the_one_that_is_measured() -> None:
    assert run_folder.sha256(replay.demo_log()) == run_folder.sha256(ROOT / DEMO)
