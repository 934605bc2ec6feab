"""Logs that show nobody, or nobody who can be: refused whole, or told on the terminal and in run.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.commands import audit, replay
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.records import POINTS, CameraFrames, Floats
from hrcreplay.store import run_folder
from tests.facts import facts, tells
from tests.logs import own
from tests.logs.test_plausibility import CAMERA, seen, with_points

WORLD = np.asarray(np.linalg.inv(CAMERA))


def noisy(n: int = 60) -> CameraFrames:
    table = seen(n)
    return with_points(table, table.points_m + np.random.default_rng(1).normal(0.0, 0.003, table.points_m.shape))


def ran(tmp_path: Path, table: CameraFrames, command: str = "fuse", **options: Any) -> Path:
    log = own.write(tmp_path / "a.mcap", table, cameras={"left": WORLD})
    return replay.run(command, log, out=tmp_path / "run", **options)


def nothing_left(tmp_path: Path) -> bool:
    return sorted(p.name for p in tmp_path.iterdir()) in (["a.mcap"], ["a.mcap", "cell.toml"])


@pytest.mark.parametrize("command", ["fuse", "predict"])
@pytest.mark.parametrize(
    ("points", "why"),
    [
        (np.zeros((40, 20, 3)), ("0 points", "points_at_origin 780")),
        (np.full((40, 20, 3), np.nan), ("0 points",)),
        (np.full((40, 20, 3), 3e38), ("points_too_far 780",)),
    ],
)
def test_a_log_in_which_nobody_was_ever_seen(
    command: str, points: Floats, why: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(LogError, match=facts("a.mcap", "nobody", "39 bodies", "left", *why)) as refused:
        ran(tmp_path, with_points(noisy(40), points), command)
    assert refused.value.exit_code == 3
    assert nothing_left(tmp_path)


def test_nobody_in_sight_refuses_plan_and_report_too(tmp_path: Path) -> None:
    """The demo's person comes later than its first seconds."""
    for command in ("plan", "report"):
        with pytest.raises(LogError, match=facts("nobody", "0 bodies")):
            replay.run(command, replay.demo_log(), out=tmp_path / "run", end_s=0.3)
    assert list(tmp_path.iterdir()) == []


def test_millimetres_are_refused_with_what_would_mend_them(tmp_path: Path) -> None:
    table = noisy()
    with pytest.raises(LogError, match=facts("tall", "0.5 to 2.3 m", "millimetres")):
        ran(tmp_path, with_points(table, 1e3 * table.points_m))
    assert nothing_left(tmp_path)
    with pytest.raises(LogError, match=facts("millimetres", "metres")):
        audit.run([tmp_path / "a.mcap"], out=tmp_path / "audit")
    assert nothing_left(tmp_path)


def test_a_coincident_or_lost_start_is_no_crash(tmp_path: Path) -> None:
    """All points at the origin, an arm in one place, both shoulders in one place, pelvis in the neck, then a person."""
    table = noisy(90)
    points, at = table.points_m.copy(), {name: i for i, name in enumerate(POINTS)}
    points[:8] = 0.0
    for name in ("elbow_r", "wrist_r", "hand_r"):
        points[8:16, at[name]] = points[8:16, at["shoulder_r"]]
    points[16:24, at["shoulder_l"]] = points[16:24, at["shoulder_r"]]
    points[24:32, at["neck"]] = points[24:32, at["pelvis"]]
    points[32:36, at["head"]] = 1e9
    folder = ran(tmp_path, with_points(table, points))
    run = run_folder.read(folder)
    assert run.state is not None
    assert np.isfinite(run.state[["x", "y", "theta", "ar1", "al4"]].to_numpy()[-1]).all()
    assert {name: run.counts[name] for name in run.counts if name.startswith("points_")} == {
        "points_at_origin": 160,
        "points_coincident": 8 * 3 + 8 * 2 + 8 * 2,
        "points_too_far": 4,
    }
    assert tells(run.notes, "56 points")


def test_a_frozen_camera_no_longer_shows_the_person(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = noisy(90)
    points = table.points_m.copy()
    points[40:] = points[39]
    folder = ran(tmp_path, with_points(table, points))
    state = run_folder.read(folder).state
    assert state is not None
    seen_ns = state["t_ns"][state["valid_left"]].to_numpy()
    froze_ns = int(table.arrival_ns[39])
    assert froze_ns <= seen_ns[-1] < froze_ns + 10_000_000  # not once after it froze
    assert state["t_ns"].iloc[-1] - seen_ns[-1] > 1.5e9
    said = "camera left froze: for 1.63 s from 1.30 s on it gave one and the same skeleton"
    assert said in capsys.readouterr().err
    assert any(note.startswith(said) for note in run_folder.read(folder).notes)


def test_an_upside_down_world_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    T = np.diag([1.0, -1.0, -1.0, 1.0]) @ WORLD
    log = own.write(tmp_path / "a.mcap", noisy(), cameras={"left": T})
    folder = replay.run("fuse", log, out=tmp_path / "run")
    assert any("stands upside down" in note for note in run_folder.read(folder).notes)
    assert "stands upside down" in capsys.readouterr().err


@pytest.mark.parametrize(("x", "inside"), [(1.28, True), (-3.0, False)])
def test_a_base_inside_the_person_is_told(x: float, inside: bool, tmp_path: Path) -> None:
    """The demo's person stands about x = 1.28 m, y = 0; see the assertion."""
    cell = tmp_path / "cell.toml"
    cell.write_text(f"T_world_base = {{ position_m = [{x}, 0.0, 0.65], yaw_deg = 0.0 }}\n")
    folder = replay.run("plan", replay.demo_log(), out=tmp_path / "run", cell_file=cell, start_s=8.0, end_s=9.3)
    run = run_folder.read(folder)
    assert run.state is not None
    assert run.state["x"].median() == pytest.approx(1.28, abs=0.1)
    said = [note for note in run.notes if "stands inside the volume of the person's" in note]
    assert bool(said) == inside


def test_a_log_of_one_frame(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=facts("single", "two frames")):
        ran(tmp_path, noisy(2).rows(slice(0, 1)))
    assert nothing_left(tmp_path)


@pytest.mark.parametrize(("span", "option"), [({"start_s": 99.0}, "--start 99"), ({"end_s": -1.0}, "--end -1")])
def test_a_span_without_a_tick_names_the_option_that_was_given(
    span: dict[str, float], option: str, tmp_path: Path
) -> None:
    with pytest.raises(SettingsError, match=facts(option, "nothing")):
        ran(tmp_path, noisy(), "fuse", **span)
