"""Runs in a cell that says what its cameras watch: nobody there, people who come, cameras that fall silent."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from hrcreplay.calibration.cell import Cell, Watched, write_cell
from hrcreplay.commands import replay, report
from hrcreplay.commands.explain import explain, sentences
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline.assembly import robot as build_robot
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.records import BORDER
from tests.facts import facts, tells
from tests.visits import Visitors, cell_around, visit_log

ALONE = ("plan.baselines=[]", "prediction.store_hz=1")
#: A robot that heeds one person, beside whom the border is all that keeps it clear of others.
ONE = "logs.people=nearest"
HALF_M = 2.5


def run(folder: Path, visitors: Visitors, seconds: float, *more: str, command: str = "plan", **how: Any) -> Path:
    """A run on a made log; ``watched``: None for a cell that says nothing; some more is as of ``visit_log``."""
    watched, spoilt = how.pop("watched", {}), {name: how.pop(name) for name in ("silent", "frozen") if name in how}
    log = visit_log(folder / "visit.mcap", visitors, seconds, **spoilt)
    cell = None if watched is None else cell_around(folder / "cell.toml", HALF_M, **watched)
    return replay.run(command, log, out=folder / "run", cell_file=cell, overrides=(*ALONE, *more))


def tables(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Motion and state, with seconds from the first tick."""
    found = [pq.read_table(folder / f"{name}.parquet").to_pandas() for name in ("motion", "state")]
    for table in found:
        table["s"] = (table["t_ns"] - table["t_ns"].iloc[0]) / 1e9
    return found[0], found[1]


def nobody(_s: float) -> dict[int, tuple[float, float]]:
    """An empty cell."""
    return {}


@cache
def passing(speed: float, back_s: float) -> Visitors:
    """Somebody who comes over the border and goes straight to the robot, then leaves."""

    def visitors(s: float) -> dict[int, tuple[float, float]]:
        x_m = HALF_M + 0.6 - speed * max(0.0, s - 3.5)
        if s > back_s:
            x_m = max(0.55, HALF_M + 0.6 - speed * (back_s - 3.5)) + speed * (s - back_s)
        x_m = max(x_m, 0.55)
        return {} if x_m > HALF_M + 0.5 else {1: (x_m, 0.0)}

    return visitors


def test_without_a_word_of_the_cell_a_robot_in_an_empty_cell_stands(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=facts("nobody", "seen")):
        run(tmp_path, nobody, 4.0, watched=None)


def test_in_an_empty_cell_that_is_watched_the_robot_does_its_work(tmp_path: Path) -> None:
    motion, state = tables(run(tmp_path, nobody, 8.0))
    first = motion["s"] < 2.0  # watched.clear_s
    assert (motion["tcp_speed"][first] == 0.0).all()
    assert (motion["reason"][first] == "no human state").all()
    later = motion[motion["s"] > 2.5]
    assert (later["status"] == "tracking").all()
    assert (later["limb"] == BORDER).all()
    assert later["certified"].all()
    assert later["tcp_speed"].max() > 0.85
    np.testing.assert_allclose(state["nobody_s"][later.index], state["nobody_else_s"][later.index])
    assert state["nobody_s"][later.index].between(0.03, 0.08).all()  # the wire and up to a frame's period
    # the nearest link is as far from a wall as the area's side less what people walk until the robot has stopped
    run_config = resolve("plan", tmp_path / "visit.mcap", cell_file=tmp_path / "cell.toml")
    base = open_log(run_config.log).header.T_world_base
    assert base is not None
    robot = build_robot(run_config, base)
    radius = np.array([segment.radius_m for segment in robot.segments])
    for tick in later.index[::150]:
        row = motion.loc[tick]
        ends = robot.ends_m(row[[f"q{i}" for i in range(1, 7)]].to_numpy(dtype=float))
        out = np.abs(ends[..., :2] - base[:2, 3]).max(axis=(1, 2))
        walked = 1.6 * (state["nobody_s"][tick] + row["horizon_s"] + run_config.settings.prediction.latency_s)
        expected = (HALF_M - out - radius).min() - walked - run_config.settings.plan.clearance_m
        assert row["distance_m"] == pytest.approx(expected, abs=1e-6)


def test_somebody_who_walks_in_is_met_by_a_robot_that_stands(tmp_path: Path) -> None:
    folder = run(tmp_path, passing(1.6, 7.0), 11.0, command="report")
    motion, state = tables(folder)
    contact = pq.read_table(folder / "contact.parquet").to_pandas()
    assert not (contact["moving"] & (contact["distance_m"] < 0.0)).any()
    assert contact["distance_m"].min() < 0.3  # they came
    fresh = state["frame_age_s"] <= 0.3
    assert set(motion["limb"][fresh & (motion["s"].between(5.0, 7.0))].dropna()) - {BORDER}
    assert motion["tcp_speed"][motion["s"] > 10.0].max() > 0.3  # they have gone
    metrics = json.loads((folder / "metrics.json").read_text())
    unseen = ~fresh & (state["nobody_s"] <= 0.3)
    assert metrics["watched_vacant_share"]["value"] == pytest.approx(unseen.mean())
    assert metrics["watched_frames_refuting"]["value"] == 0
    page = (folder / "report.html").read_text()
    assert tells(page, "cell", f"{100.0 * unseen.mean():.1f} %")
    assert tells(report.summary(folder), "watched area", f"{100.0 * unseen.mean():.1f} %")


@pytest.mark.parametrize("side", [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.7, -0.7)])
def test_a_second_person_who_comes_in_unheeded_is_not_touched(tmp_path: Path, side: tuple[float, float]) -> None:
    """The first is planned for; the second comes over the border at 1.6 m/s, which no prediction tells."""

    def visitors(s: float) -> dict[int, tuple[float, float]]:
        away_m = 3.4 - 1.6 * max(0.0, s - 3.5)
        first = {1: (-1.6 * side[0], -1.6 * side[1] - 0.3)}
        return first | ({2: (max(away_m, 0.6) * side[0], max(away_m, 0.6) * side[1])} if s > 3.5 else {})

    folder = run(tmp_path, visitors, 6.5, "plan.method=qp", ONE, command="report")
    motion, state = tables(folder)
    contact = pq.read_table(folder / "contact.parquet").to_pandas()
    assert not (contact["moving"] & (contact["distance_m"] < 0.0)).any()
    standing = motion[motion["s"] > 5.4]
    assert (standing["tcp_speed"] < 1e-9).all()
    assert (state["nobody_else_s"][motion["s"] > 5.4] > 1.0).all()
    assert motion["tcp_speed"][motion["s"] < 4.0].max() > 0.3


def test_a_second_person_who_is_tracked_is_not_touched_without_a_border(tmp_path: Path) -> None:
    """The visitors of the next test; the robot heeds both of them."""
    folder = run(tmp_path, second_comes_in, 9.0, command="report", watched=None)
    contact = pq.read_table(folder / "contact.parquet").to_pandas()
    assert contact["distance_m"].min() < 0.3  # they came
    assert not (contact["moving"] & (contact["distance_m"] < 0.0)).any()


def test_two_tracked_people_in_a_watched_area_do_not_make_the_border_come_in(tmp_path: Path) -> None:
    folder = run(tmp_path, lambda _s: {1: (-1.8, -0.4), 2: (1.8, 1.2)}, 6.0)
    motion, state = tables(folder)
    assert set(state["person"]) == {1, 2}
    assert (state["nobody_else_s"][state["s"] > 4.0] < 0.2).all()
    assert motion["tcp_speed"][motion["s"] > 4.0].max() > 0.2


def second_comes_in(s: float) -> dict[int, tuple[float, float]]:
    """Somebody who stays behind the robot, and a second one who walks up to it."""
    first = {1: (-1.6, -0.3)}
    return first | ({2: (max(3.4 - 1.6 * (s - 3.5), 0.45), 0.0)} if s > 3.5 else {})


def test_without_a_border_the_second_person_is_touched(tmp_path: Path) -> None:
    """What the border is worth: the same visitors in a cell that says nothing, beside a robot that heeds one."""
    folder = run(tmp_path, second_comes_in, 9.0, ONE, command="report", watched=None)
    contact = pq.read_table(folder / "contact.parquet").to_pandas()
    assert (contact["moving"] & (contact["distance_m"] < 0.0)).any()


@pytest.mark.parametrize("which", ["one camera", "both"])
def test_as_cameras_fall_silent_the_border_comes_in_and_the_robot_stops(tmp_path: Path, which: str) -> None:
    def silent(camera: str, s: float) -> bool:
        return s > 4.0 and (which == "both" or camera == "xtion")

    motion, state = tables(run(tmp_path, nobody, 7.0, silent=silent))
    assert motion["tcp_speed"][motion["s"] < 4.0].max() > 0.5
    assert motion["certified"].all()
    late = motion["s"] > 5.7  # 1.7 s at 1.6 m/s: from the border to the base
    assert (motion["tcp_speed"][late] == 0.0).all()
    assert (motion["reason"][late] == "no human state").all()
    np.testing.assert_allclose(np.diff(state["nobody_s"][late]), 0.004, atol=1e-9)


def test_somebody_lost_in_the_middle_is_not_gone(tmp_path: Path) -> None:
    """The trackers lose a person who stays: the robot stands for watched.clear_s."""

    def visitors(s: float) -> dict[int, tuple[float, float]]:
        return {} if 3.0 < s < 4.5 else {1: (1.2, 0.0)}

    folder = run(tmp_path, visitors, 6.0)
    motion, _ = tables(folder)
    lost = motion[motion["s"].between(3.4, 4.5)]
    assert (lost["tcp_speed"] == 0.0).all()
    assert (lost["reason"] == "no human state").all()
    short = {"clear_s": 0.2}
    (tmp_path / "short").mkdir()
    folder = run(tmp_path / "short", visitors, 6.0, watched=short)
    meta = json.loads((folder / "run.json").read_text())
    assert meta["counts"]["watched_frames_refuting"] > 0  # whoever says 0.2 s is told that it was wrong
    assert any("a larger watched.margin_m" in note for note in meta["notes"])


def test_a_body_whose_track_is_frozen_is_not_gone(tmp_path: Path) -> None:
    """The trackers go on with somebody outside, and with a person at the robot as they were a while ago."""

    def visitors(s: float) -> dict[int, tuple[float, float]]:
        return {1: (0.9, 0.3), 2: (HALF_M + 0.3 + 0.1 * np.sin(3.0 * s), 0.0)}

    def gone(s: float) -> dict[int, tuple[float, float]]:
        return visitors(s) if s < 3.0 else {2: visitors(s)[2]}

    motion, state = tables(run(tmp_path, visitors, 9.0, frozen={1: 3.0}))
    assert (motion["tcp_speed"][motion["s"] > 3.4] == 0.0).all()
    assert np.isinf(state["nobody_s"]).all()
    (tmp_path / "gone").mkdir()
    motion, _ = tables(run(tmp_path / "gone", gone, 9.0))
    assert motion["tcp_speed"][motion["s"] > 6.0].max() > 0.2


def test_an_area_that_is_never_without_others_is_told_and_the_robot_stands(tmp_path: Path) -> None:
    folder = run(tmp_path, lambda _s: {1: (-1.8, -0.4), 2: (1.8, 1.2)}, 3.5, ONE)
    motion, state = tables(folder)
    assert np.isinf(state["nobody_else_s"]).all()
    assert (motion["tcp_speed"] == 0.0).all()
    notes = json.loads((folder / "run.json").read_text())["notes"]
    assert tells(notes, "watched", "another body")


def test_an_area_without_the_robot_is_refused(tmp_path: Path) -> None:
    log = visit_log(tmp_path / "visit.mcap", nobody, 1.0)
    write_cell(Cell(watched=Watched(corners_m=[[5.0, 5.0], [9.0, 5.0], [9.0, 9.0]])), tmp_path / "far.toml")
    with pytest.raises(SettingsError, match=facts("watched.corners_m", "[0.2, 0.0] m")):
        replay.run("plan", log, out=tmp_path / "run", cell_file=tmp_path / "far.toml", overrides=ALONE)


def test_why_names_the_border(tmp_path: Path) -> None:
    folder = run(tmp_path, nobody, 4.0)
    found = explain(folder, 3.5)
    assert found["nearest"]["limb"] == BORDER
    assert found["watched"]["nobody_s"] == pytest.approx(found["watched"]["nobody_else_s"])
    text = "\n".join(sentences(found))
    assert tells(text, "border", "watched area", "last known")
    assert tells(sentences(explain(folder, 1.0)), "Cause", "unknown")


def test_a_run_of_another_area_is_not_taken_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = run(tmp_path, nobody, 3.0, command="fuse")
    same = replay.run("fuse", first, out=tmp_path / "same")
    assert "taken over" in capsys.readouterr().err
    for name in ("nobody_s", "nobody_else_s"):
        one, two = (pq.read_table(folder / "state.parquet")[name].to_numpy() for folder in (first, same))
        np.testing.assert_array_equal(one, two)
    other = cell_around(tmp_path / "other.toml", 3.0)
    replay.run("fuse", first, out=tmp_path / "again", cell_file=other)
    assert tells(capsys.readouterr().err.splitlines(), "fuse", "watched", "computed again")


def test_a_plan_from_a_fused_run_is_the_same(tmp_path: Path) -> None:
    fused = run(tmp_path, passing(1.6, 5.0), 6.0, command="fuse")
    (tmp_path / "whole").mkdir()
    whole = run(tmp_path / "whole", passing(1.6, 5.0), 6.0)
    later = replay.run("plan", fused, out=tmp_path / "later", overrides=ALONE)
    assert (whole / "motion.parquet").read_bytes() == (later / "motion.parquet").read_bytes()
