"""Limits from logs, from the log to the file that every stage takes."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.audit import fit
from hrcreplay.commands import replay
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.limits import load_limits
from hrcreplay.records import JOINTS
from hrcreplay.store import run_folder
from tests.audit.standing import log_of_one_who_does_not_stir
from tests.cli.test_app import Run, run
from tests.facts import facts, tells
from tests.realdata import data_path
from tests.test_recordings import SARA, SARA_CELL

__all__ = ["run"]  # the fixture


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    out = tmp_path_factory.mktemp("fit") / "worker.toml"
    return out, fit.run([replay.demo_log()], out=out, coverage=0.99, cover="joints").lines


@pytest.fixture(scope="module")
def provenance(fitted: tuple[Path, list[str]]) -> dict[str, Any]:
    found: dict[str, Any] = tomllib.loads(fitted[0].read_text())["provenance"]
    return found


def test_the_file_is_a_limit_set(fitted: tuple[Path, list[str]]) -> None:
    limits, human = load_limits(fitted[0]), load_limits("human")
    assert limits.name == "worker"
    assert not limits.coupled  # the worker's arms leave what (34) allows
    np.testing.assert_array_equal(limits.p_min, human.p_min)
    assert (limits.v_min < 0).all()
    assert (limits.v_max > 0).all()
    assert limits.v_max[0] < 2.0


def test_provenance_tells_the_log_and_what_was_reached(provenance: dict[str, Any]) -> None:
    (log,) = provenance["logs"]
    assert log["sha256"] == run_folder.sha256(replay.demo_log())
    assert log["recorded_future"] == "ground truth"
    assert provenance["coverage_requested"] == 0.99
    assert provenance["total"]["training"]["share"] >= 0.99
    held_back = provenance["total"]["held_back"]
    assert held_back["share"] > 0.9
    assert held_back["low"] <= held_back["share"] <= held_back["high"]
    # 60 s at 25 Hz, seven tenths of them to fit on, a horizon before the end of each part without its whole future
    assert provenance["total"]["training"]["ticks"] == pytest.approx(0.7 * 1500 - 9, abs=15)
    assert held_back["ticks"] == pytest.approx(0.3 * 1500 - 9, abs=3)


def test_the_user_is_told(fitted: tuple[Path, list[str]], provenance: dict[str, Any]) -> None:
    text = "\n".join(fitted[1])
    for joint in JOINTS:
        assert f"{joint}: velocity" in text or joint in provenance["kept"]
    assert "demo.mcap: training 99." in text
    assert tells(fitted[1], "postures", "positions", "paper")


def test_a_stage_takes_the_file(tmp_path: Path, fitted: tuple[Path, list[str]]) -> None:
    folder = replay.run(
        "predict",
        replay.demo_log(),
        out=tmp_path / "run",
        overrides=(f"limits.prediction={fitted[0]}",),
        start_s=10.0,
        end_s=11.0,
    )
    assert run_folder.read(folder).meta["limits"]["prediction"]["name"] == "worker"


def test_the_same_logs_give_the_same_bytes(tmp_path: Path, fitted: tuple[Path, list[str]]) -> None:
    fit.run([replay.demo_log()], out=tmp_path / "again.toml", cover="joints")
    assert (tmp_path / "again.toml").read_bytes() == fitted[0].read_bytes()


def test_the_part_held_back_changes_no_bound(tmp_path: Path, fitted: tuple[Path, list[str]]) -> None:
    """Cut at 42 s, where the held-back part of 60 s begins, with no more than a horizon held back."""
    fit.run([replay.demo_log()], out=tmp_path / "cut.toml", cover="joints", end_s=43.0, held_back=0.9999 / 43.0)
    cut, whole = load_limits(tmp_path / "cut.toml"), load_limits(fitted[0])
    for name in ("v_min", "v_max", "a_min", "a_max"):
        np.testing.assert_array_equal(getattr(cut, name), getattr(whole, name))


def test_several_logs_are_each_left_out_once(tmp_path: Path) -> None:
    shutil.copy(replay.demo_log(), tmp_path / "copy.mcap")
    out = tmp_path / "two.toml"
    lines = fit.run(
        [replay.demo_log(), tmp_path / "copy.mcap"], out=out, cover="joints", end_s=20.0, coverage=0.95
    ).lines
    logs = tomllib.loads(out.read_text())["provenance"]["logs"]
    assert [log["name"] for log in logs] == ["demo.mcap", "copy.mcap"]
    for log in logs:
        # the copy fits the original as well as itself: its own training part, then the part that neither saw
        assert log["left_out"]["ticks"] == log["training"]["ticks"] + log["held_back"]["ticks"]
        assert log["left_out"]["share"] > 0.8
        assert log["end_s"] == 20.0
    assert sum(tells(line, log["name"], "other logs") for line in lines for log in logs) == 2


@pytest.fixture(scope="module")
def of_limbs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, fit.FitReport]:
    folder = tmp_path_factory.mktemp("limbs")
    shutil.copy(replay.demo_log(), folder / "copy.mcap")
    out = folder / "limbs.toml"
    return out, fit.run([replay.demo_log(), folder / "copy.mcap"], out=out, cover="limbs", end_s=30.0)


def test_covering_the_limbs_bounds_their_departures(of_limbs: tuple[Path, fit.FitReport]) -> None:
    out, report = of_limbs
    departure, found = load_limits(out).departure, tomllib.loads(out.read_text())["provenance"]
    assert departure is not None
    assert departure.horizon_s.tolist() == [0.02, 0.05, 0.1, 0.2, 0.377] == found["departures"]["horizon_s"]
    reach = departure.beyond_m + 0.08 * departure.residuals
    assert (np.diff(reach[:6, 1:], axis=1) > -0.01).all()  # further in more time; at 20 ms noise decides
    assert (reach[:6, 4] > reach[:6, 0] + 0.03).all()
    np.testing.assert_array_equal(departure.beyond_m[[2, 3]], departure.beyond_m[[4, 5]])  # both sides alike
    assert found["covers"] == "limbs"
    training = [share["share"] for share in found["departures"]["training"]]
    assert min(training) >= 0.99
    for log in found["departures"]["logs"]:
        # the copy is the original, so what is fitted to one holds the other, but for its first second
        assert [share["share"] for share in log["shares"]] == pytest.approx(training, abs=0.01)
        assert (np.diff(log["union_m3"][1:]) > 0.0).all()  # at 20 ms noise decides
        assert log["union_m3"][-1] < 1.3 * log["capsules_m3"][-1]
        less = [log[name][-1] for name in ("union_without_legs_m3", "fitted_to_it_m3")]
        assert max(less) < 1.02 * log["union_m3"][-1]  # fitted to the copy, it is fitted to it
        assert less[0] < 0.95 * log["union_m3"][-1]
    assert report.missed == ""
    assert tells(report.lines[-1], "limbs", "all logs", "training 0.02 s", "left out")


def test_a_share_that_others_miss_is_told_and_fails(tmp_path: Path, run: Run) -> None:
    """Bounds of somebody who does not stir hold nobody else."""
    still = log_of_one_who_does_not_stir(tmp_path / "still.mcap")
    out = tmp_path / "two.toml"
    code, printed, err = run("fit-limits", still, replay.demo_log(), "--end", 9, "--out", out)
    assert code == 5
    assert printed.strip() == str(out)
    assert load_limits(out).departure is not None
    assert tells(err.splitlines()[-1], "demo.mcap", "97.0 %")
    demo = next(
        one for one in tomllib.loads(out.read_text())["provenance"]["departures"]["logs"] if "demo" in one["name"]
    )
    assert demo["fitted_to_it_m3"][-1] > 1.2 * demo["union_m3"][-1] > 1.2 * demo["union_without_legs_m3"][-1]


def test_another_kind_of_coverage_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=facts("--cover", "toes", "joints", "limbs")):
        fit.run([replay.demo_log()], out=tmp_path / "x.toml", cover="toes")


def test_an_existing_file_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text("mine")
    with pytest.raises(SettingsError, match=facts("x.toml", "exists")):
        fit.run([replay.demo_log()], out=tmp_path / "x.toml", cover="joints")
    assert (tmp_path / "x.toml").read_text() == "mine"


@pytest.mark.parametrize("end_s", [0.2, 1.0])
def test_a_log_shorter_than_its_parts_need_is_refused(tmp_path: Path, end_s: float) -> None:
    with pytest.raises(LogError, match=facts("0.377 s")):
        fit.run([replay.demo_log()], out=tmp_path / "x.toml", cover="joints", end_s=end_s)
    assert not list(tmp_path.iterdir())


def test_no_arm_motion_is_refused_in_one_line(tmp_path: Path) -> None:
    log = log_of_one_who_does_not_stir(tmp_path / "still.mcap")
    with pytest.raises(LogError, match=facts("still.mcap", "no arm motion")) as caught:
        fit.run([log], out=tmp_path / "x.toml", cover="joints")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "x.toml").exists()


@pytest.mark.parametrize("name", ["exp_appraoching", "exp_box"])
def test_a_real_recording(tmp_path: Path, name: str) -> None:
    bag = data_path(f"sara_human_robot_bags/{name}.bag")
    settings, cell, out = tmp_path / "s.toml", tmp_path / "cell.toml", tmp_path / "person.toml"
    settings.write_text(SARA)
    cell.write_text(SARA_CELL)
    lines = fit.run([bag], out=out, cover="joints", config=settings, cell_file=cell).lines
    limits, human = load_limits(out), load_limits("human")
    found = tomllib.loads(out.read_text())["provenance"]
    assert found["logs"][0]["recorded_future"] == "smoothed estimate"
    assert found["total"]["training"]["share"] >= 0.99
    assert found["total"]["held_back"]["share"] > 0.6  # 20 s are few: the interval says so
    assert found["total"]["held_back"]["low"] < 0.8
    assert "rho" in found["kept"]  # the person walks upright
    assert tells(lines, "too little motion", "rho")
    for joint in found["kept"]:
        j = JOINTS.index(joint)
        assert (limits.v_max[j], limits.a_max[j]) == (human.v_max[j], human.a_max[j])
