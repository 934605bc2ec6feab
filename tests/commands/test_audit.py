"""The audit from log to page, and its parts where a whole log would hide a mistake."""

from __future__ import annotations

import copy
import json
import re
import warnings
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hrcreplay.audit import baselines
from hrcreplay.audit import figures as figures_audit
from hrcreplay.commands import audit, replay
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.human.prediction import swept_volumes
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import BODY, LIMBS, POINTS
from hrcreplay.store import run_folder
from tests.audit.standing import frames, standing
from tests.facts import facts, tells
from tests.realdata import data_path
from tests.reporting.reading import page_lines
from tests.test_recordings import SARA, SARA_CELL

START_S, END_S = 8.0, 14.0

#: What the paper bounds its people by, which real ones leave.
TABLE_1 = ("limits.prediction=paper",)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return audit.run(
        [replay.demo_log()],
        out=tmp_path_factory.mktemp("audit") / "run",
        start_s=START_S,
        end_s=END_S,
        overrides=TABLE_1,
    )


@pytest.fixture(scope="module")
def found(folder: Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((folder / "audit.json").read_text())
    return result


def test_an_audit_leaves_what_it_promises(folder: Path, found: dict[str, Any]) -> None:
    for name in ("run.json", "audit.json", "metrics.json", "timing.json", "report.html"):
        assert (folder / name).stat().st_size > 0
    for name in ("audit_coverage", "audit_limbs", "audit_joints"):
        assert (folder / "figures" / f"{name}.png").stat().st_size > 5_000
    table = pd.read_parquet(folder / "audit.parquet")
    assert {"t_ns", "log", "method", "limb", "covered", "escape_m", "volume_m3"} <= set(table.columns)
    assert set(table["method"]) == {*swept_volumes.METHODS, *baselines.BASELINES}
    assert set(table["limb"]) >= set(LIMBS)
    assert found["logs"][0]["recorded_future"] == "ground truth"
    assert found["total"]["ticks"] == 140  # (6 s - 0.377 s) at 25 Hz; the first tick is before the first frame
    sound = found["total"]["methods"]["sound"]
    assert sound["LEGS"]["covered_share"]["samples"] == 140
    assert sound["all"]["union_m3"]["value"] > sound["upper"]["union_m3"]["value"]
    page = (folder / "report.html").read_text()
    assert tells(page_lines(page), "every limb", "LEGS included")
    assert not re.search(r"\b(nan|inf|None)\b", re.sub(r"base64,[^\"]*", "", page))


def test_the_figures_are_those_of_the_table(folder: Path, found: dict[str, Any]) -> None:
    """Recomputed from the rows with pandas."""
    table = pd.read_parquet(folder / "audit.parquet")
    for (method, limb), rows in table.groupby(["method", "limb"]):
        figures = found["total"]["methods"][method][limb]
        seen = rows[rows["escape_m"].notna()]
        assert figures["covered_share"]["value"] == pytest.approx(seen["covered"].astype(float).mean())
        assert figures["volume_m3"]["value"] == pytest.approx(rows["volume_m3"].mean())
        deep = np.sort(seen.loc[seen["escape_m"] > 0, "escape_m"].to_numpy())
        if len(deep):
            assert figures["escape_max_m"] == pytest.approx(deep[-1])
            assert figures["escape_p50_m"]["value"] == pytest.approx(deep[int(np.ceil(0.5 * len(deep))) - 1])
    for part, limbs in (("all", BODY), ("upper", LIMBS)):
        rows = table[table["limb"].isin(limbs)]
        worst = rows.groupby(["method", "t_ns"])["escape_m"].max().groupby("method")
        for method, share in worst.agg(lambda escape: (escape == 0).mean()).items():
            figures = found["total"]["methods"][method][part]
            assert figures["covered_share"]["value"] == pytest.approx(share)
            assert figures["covered_share"]["low"] <= share <= figures["covered_share"]["high"]
            assert figures["union_m3"]["value"] < figures["sum_m3"]["value"]


def test_what_must_hold_between_methods(found: dict[str, Any]) -> None:
    methods = found["total"]["methods"]
    share = {name: parts["all"]["points_share"]["value"] for name, parts in methods.items()}
    whole = {name: parts["all"]["covered_share"]["value"] for name, parts in methods.items()}
    room = {name: parts["all"]["union_m3"]["value"] for name, parts in methods.items()}
    assert share["paper"] < 0.7  # Table 1 is far below what people do
    assert whole["v2_a50"] == whole["iso_13855"] == share["v2_a50"] == 1.0
    assert all(whole[name] <= share[name] for name in methods)
    assert whole["paper"] < 0.1  # no room for a body that is not the model
    assert share["constant_velocity"] < share["positions"]
    assert room["constant_velocity"] < room["paper"] < room["positions"] < room["v2_a50"]
    for method, curve in found["total"]["curve"].items():
        shares = [point["covered_share"]["value"] for point in curve]
        assert all(b >= a - 0.1 for a, b in pairwise(shares)), method
    standard = next(point for point in found["total"]["curve"]["paper"] if point["factor"] == 1.0)
    assert standard["covered_share"]["value"] == pytest.approx(whole["paper"])


def test_shorter_horizons_take_less_room_and_the_last_is_the_audits_own(found: dict[str, Any]) -> None:
    points = found["total"]["horizons"]
    assert [point["horizon_s"] for point in points] == [0.05, 0.1, 0.2, 0.377]
    for method in ("sound", "v2_a50", "iso_13855"):
        room = [point["methods"][method]["union_m3"]["value"] for point in points]
        assert all(b > 1.1 * a for a, b in pairwise(room))
        assert (
            points[-1]["methods"][method]["covered_share"] == found["total"]["methods"][method]["all"]["covered_share"]
        )
        assert room[-1] == found["total"]["methods"][method]["all"]["union_m3"]["value"]
        assert all(point["methods"][method]["covered_share"]["samples"] == 35 for point in points[:-1])
    reach_m = [1.6 * h for h in (0.05, 0.1, 0.2)]  # ISO 13855 around the thorax
    assert points[0]["methods"]["iso_13855"]["union_m3"]["value"] > 4.0 / 3.0 * np.pi * (0.15 + reach_m[0]) ** 3
    alone = found["logs"][0]["horizons"]
    assert alone == points


def test_an_audit_of_a_shorter_horizon_has_that_as_its_own(tmp_path: Path, found: dict[str, Any]) -> None:
    """The coverage told for 0.1 s is that of an audit of 0.1 s, at every fifth of its ticks."""
    folder = audit.run(
        [replay.demo_log()],
        out=tmp_path / "run",
        start_s=START_S,
        end_s=END_S,
        overrides=(*TABLE_1, "prediction.stop_s=0.1"),
    )
    short = json.loads((folder / "audit.json").read_text())["total"]
    assert [point["horizon_s"] for point in short["horizons"]] == [0.05, 0.1]
    for method in ("sound", "v2_a50"):
        own, told = short["methods"][method]["all"], found["total"]["horizons"][1]["methods"][method]
        assert own["covered_share"]["value"] == pytest.approx(told["covered_share"]["value"], abs=0.1)
        assert own["union_m3"]["value"] == pytest.approx(told["union_m3"]["value"], rel=0.1)


def test_escapes_name_their_time_and_limb(folder: Path, found: dict[str, Any]) -> None:
    table = pd.read_parquet(folder / "audit.parquet")
    rows = table[(table["method"] == "paper") & (table["escape_m"] > 0)]
    listed = found["logs"][0]["escapes"]["paper"]
    assert sum(e["ticks"] for e in listed) == len(rows)
    deepest = max(listed, key=lambda e: e["deepest_m"])
    worst = rows.sort_values("escape_m").iloc[-1]
    assert deepest["limb"] == worst["limb"]
    start_ns = table["t_ns"].min()
    assert deepest["deepest_t_ns"] == worst["t_ns"]
    assert deepest["deepest_at_s"] == pytest.approx((worst["t_ns"] - start_ns) * 1e-9, abs=0.05)


def test_every_escape_is_a_row_by_every_method(folder: Path) -> None:
    table, rows = pd.read_parquet(folder / "escapes.parquet"), pd.read_parquet(folder / "audit.parquet")
    deep = rows[rows["escape_m"] > 0.0]
    assert set(table["method"]) == set(deep["method"])
    for (method, limb), mine in table.groupby(["method", "limb"]):
        theirs = deep[(deep["method"] == method) & (deep["limb"] == limb)]
        assert mine["ticks"].sum() == len(theirs)
        at = theirs.set_index("t_ns")["escape_m"]
        np.testing.assert_array_equal(mine["deepest_m"], at.loc[mine["deepest_t_ns"]])
        assert mine["deepest_m"].max() == theirs["escape_m"].max()
    page = (folder / "report.html").read_text()
    lines = page_lines(page)
    assert tells(lines, "demo", "escapes", "paper")
    assert tells(lines, "demo", "first movements", "sound")
    assert tells(lines, "Errors", "standard deviations")
    shown = table[table["method"] == "paper"].sort_values("deepest_m").iloc[-1]
    assert f"{shown['deepest_at_s']:.2f} s" in page


def test_same_bytes_again(folder: Path, tmp_path: Path) -> None:
    again = audit.run([replay.demo_log()], out=tmp_path / "again", start_s=START_S, end_s=END_S, overrides=TABLE_1)
    assert run_folder.read_meta(again)["outputs"] == run_folder.read_meta(folder)["outputs"]


@pytest.fixture(scope="module")
def both(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same log with another second of it, each with the span of its own run."""
    out = tmp_path_factory.mktemp("both")
    fused = replay.run("fuse", replay.demo_log(), out=out / "fused", start_s=20.0, end_s=21.0)
    return audit.run([folder, fused], out=out / "run")


def test_a_log_among_others_has_the_figures_it_has_alone(both: Path, found: dict[str, Any]) -> None:
    together = json.loads((both / "audit.json").read_text())
    assert [log["ticks"] for log in together["logs"]] == [140, 15]
    assert [log["log"] for log in together["logs"]] == ["demo (1)", "demo (2)"]
    first = together["logs"][0]["methods"]["paper"]["LRA"]["covered_share"]["value"]
    assert first == found["total"]["methods"]["paper"]["LRA"]["covered_share"]["value"]


def test_the_total_counts_every_tick_once(both: Path) -> None:
    """Recomputed from the rows of both logs."""
    found = json.loads((both / "audit.json").read_text())
    rows = pd.read_parquet(both / "audit.parquet")
    for method in ("paper", "positions"):
        mine = rows[rows["method"] == method]
        worst = mine.groupby(["log", "t_ns"])["escape_m"].max()
        total = found["total"]["methods"][method]["all"]
        assert total["covered_share"]["samples"] == found["total"]["ticks"] == len(worst) == 155
        assert total["covered_share"]["value"] == pytest.approx((worst == 0.0).mean())
        each = [log["methods"][method]["all"] for log in found["logs"]]
        deepest = [part["escape_max_m"] for part in each if part["escape_max_m"] is not None]
        assert total["escape_max_m"] == max(deepest, default=None)
        assert total["union_m3"]["value"] == pytest.approx(
            np.average([p["union_m3"]["value"] for p in each], weights=[p["union_m3"]["samples"] for p in each])
        )
        # 15 ticks are little more than a look: the total knows more than the short log, not more than it should
        width = [part["covered_share"]["high"] - part["covered_share"]["low"] for part in (*each, total)]
        assert width[2] < width[1]
    assert tells(page_lines((both / "report.html").read_text()), "total", "every tick once")


def test_logs_of_two_horizons_have_no_total(tmp_path: Path) -> None:
    short = replay.run(
        "fuse", replay.demo_log(), out=tmp_path / "a", start_s=8.0, end_s=9.0, overrides=("prediction.stop_s=0.2",)
    )
    with pytest.raises(SettingsError, match=facts("prediction.stop_s", "demo.mcap", "differ")):
        audit.run([short, replay.demo_log()], out=tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_a_log_shorter_than_the_horizon_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=facts("demo.mcap", "0.30 s", "0.377 s")):
        audit.run([replay.demo_log()], out=tmp_path / "x", start_s=8.0, end_s=8.3)
    with pytest.raises(SettingsError, match=facts(tmp_path.name, "exists")):
        audit.run([replay.demo_log()], out=tmp_path, start_s=8.0, end_s=8.3)
    assert list(tmp_path.iterdir()) == []


def test_a_person_who_stands_still_is_said_to(tmp_path: Path) -> None:
    path = tmp_path / "still.mcap"
    with LogWriter(path) as writer:
        writer.camera("cam", np.eye(4))
        writer.frames(frames(standing(60)))
    found = json.loads((audit.run([path], out=tmp_path / "run") / "audit.json").read_text())
    notes = found["logs"][0]["notes"]
    assert any(note.startswith("hardly moved") and "ar1 (0 deg)" in note and "z (0.00 m)" in note for note in notes)
    assert tells(notes, "intervals", "wide")
    assert found["logs"][0]["recorded_future"] == "camera points"
    share = found["total"]["methods"]["paper"]["all"]["points_share"]
    assert share["value"] == 1.0
    assert share["low"] < 0.7  # 1.6 s are no proof


def test_limbs_and_points_that_were_not_checked_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A camera that knows neither legs nor the left wrist, and guesses the right hand with confidence 0."""
    seen = frames(standing(60))
    points, confidence = seen.points_m.copy(), seen.confidence.copy()
    hand = POINTS.index("hand_r")
    points[:, hand], confidence[:, hand] = [9.0, 9.0, 9.0], 0.0
    points[30:, POINTS.index("wrist_l")], confidence[30:, POINTS.index("wrist_l")] = np.nan, 0.0
    with LogWriter(tmp_path / "half.mcap") as writer:
        writer.camera("cam", np.eye(4))
        writer.frames(replace(seen, points_m=points, confidence=confidence))
    folder = audit.run([tmp_path / "half.mcap"], out=tmp_path / "run")
    err = capsys.readouterr().err
    said = err.splitlines()
    gaps = "LEGS, hand_r of LRA, hand_l of LLA"
    assert tells(said, "half", "not checked", gaps)
    found = json.loads((folder / "audit.json").read_text())
    arm = found["total"]["methods"]["sound"]["LLA"]["covered_share"]["samples"]
    assert 10 < arm < 35  # seen for the first half of 1.6 s
    assert tells(said, "half", "not checked", "40 ticks", f"LLA {40 - arm}")
    assert tells(said[-1], "half", "sound", "people", "not LEGS", "40 ticks", "100.0 %")
    assert re.search(r"union \d+\.\d m3$", said[-1])
    assert found["logs"][0]["cameras"]["cam"]["rejected_points"] == 0  # no hand jumps that nobody saw
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["audit_not_checked"]["value"] == gaps
    assert metrics["audit_sound_LEGS_covered_share"]["value"] is None
    assert metrics["audit_sound_LLA_ticks"]["value"] == arm
    page = (folder / "report.html").read_text()
    assert tells(page_lines(page), "every limb", "(not LEGS)")
    assert tells(page_lines(page), "Not checked", gaps)
    rows = re.findall(r"<tr><th scope=\"row\">([^<]*)</th><td>([^<]*)</td></tr>", page)
    assert ("LEGS", "not checked") in rows
    assert ("LRA: hand_r", "not checked") in rows
    assert ("LLA", str(arm)) in rows


def test_figures_of_volumes_that_are_nothing_or_unknown(tmp_path: Path, found: dict[str, Any]) -> None:
    """An axis of powers has no place for them, and says nothing about it."""
    for nothing in (0.0, None):
        empty = copy.deepcopy(found)
        parts = [*empty["total"]["methods"].values(), *empty["logs"][0]["methods"].values()]
        figures = [figure for part in parts for figure in part.values()]
        for figure in [*figures, *(point for curve in empty["total"]["curve"].values() for point in curve)]:
            for key in {"union_m3", "volume_m3"} & set(figure):
                figure[key] = {"value": nothing, "low": nothing, "high": nothing, "samples": 0}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            figures_audit.draw_all(empty, tmp_path / str(nothing))
        assert list((tmp_path / str(nothing)).glob("*.svg"))


@pytest.mark.parametrize(("name", "jumps"), [("exp_appraoching", 98), ("exp_box", 34)])
def test_teleports_of_a_real_bag_do_not_count_as_motion(tmp_path: Path, name: str, jumps: int) -> None:
    settings, cell = tmp_path / "s.toml", tmp_path / "cell.toml"
    settings.write_text(SARA)
    cell.write_text(SARA_CELL)
    bag = data_path(f"sara_human_robot_bags/{name}.bag")
    folder = audit.run([bag], out=tmp_path / "run", config=settings, cell_file=cell, end_s=6.0)
    found = json.loads((folder / "audit.json").read_text())
    log = found["logs"][0]
    assert log["recorded_future"] == "camera points"
    assert log["counts"]["audit_rejected_frames_mocap"] == jumps
    assert log["escapes"]["paper"]
    assert found["total"]["methods"]["v2_a50"]["all"]["covered_share"]["value"] > 0.9
    for method in swept_volumes.METHODS:
        assert all(e["deepest_m"] < 1.0 for e in log["escapes"][method])
    deepest = found["total"]["methods"]["paper"]["all"]["escape_max_m"]
    assert deepest is None or deepest < 1.0
