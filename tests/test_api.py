"""The library gives what the commands give, and tick by tick what it gives at once."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

import hrcreplay as hr
from hrcreplay.commands import replay
from hrcreplay.errors import SettingsError
from hrcreplay.records import HumanStates
from hrcreplay.store.run_folder import NOT_DETERMINISTIC
from tests.commands.arms import ARMS
from tests.facts import facts

BEGIN_S, END_S = 8.0, 9.2
EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
CELL = Path(__file__).parents[1] / "datasets" / "demo_cell.toml"


@pytest.fixture(scope="module")
def log() -> hr.Recording:
    return hr.open_log(replay.demo_log())


@pytest.fixture(scope="module")
def people(log: hr.Recording) -> hr.People:
    return hr.fuse(log, start_s=BEGIN_S, end_s=END_S)


@pytest.fixture(scope="module")
def plan(people: hr.People) -> hr.Plan:
    return hr.plan(people)


def test_a_report_is_that_of_the_command(log: hr.Recording, people: hr.People, plan: hr.Plan, tmp_path: Path) -> None:
    ours = hr.report(log, people, plan, tmp_path / "ours")
    theirs = replay.run("report", replay.demo_log(), out=tmp_path / "theirs", start_s=BEGIN_S, end_s=END_S)
    files = sorted(path.relative_to(theirs) for path in theirs.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(ours) for path in ours.rglob("*") if path.is_file())
    differ = [path for path in files if (ours / path).read_bytes() != (theirs / path).read_bytes()]
    assert {path.name for path in differ} <= NOT_DETERMINISTIC
    mine, wanted = (json.loads((folder / "run.json").read_text()) for folder in (ours, theirs))
    for key in ("counts", "notes", "found_by", "settings", "stages", "depends_on", "outputs", "arguments"):
        assert mine[key] == wanted[key], key


def test_tables_are_those_of_a_run_folder(people: hr.People, plan: hr.Plan, tmp_path: Path) -> None:
    folder = replay.run("plan", replay.demo_log(), out=tmp_path / "run", start_s=BEGIN_S, end_s=END_S)
    for table, name in (
        (people.to_pandas(), "state"),
        (plan.to_pandas(), "motion"),
        (plan.to_pandas("none"), "motion_none"),
    ):
        pd.testing.assert_frame_equal(table, pq.read_table(folder / f"{name}.parquet").to_pandas())


def test_tick_by_tick_is_the_whole_bit_for_bit(log: hr.Recording, people: hr.People, plan: hr.Plan) -> None:
    table = log.to_pandas()
    fusion, controller = hr.Fusion(log), hr.Controller(log)
    states, steps, before_ns = [], [], 0
    first_ns = int(people.states.t_ns[0])
    for t_ns in people.states.t_ns.tolist():
        arrived = table[
            (table["arrival_ns"] > before_ns) & (table["arrival_ns"] <= t_ns) & (table["arrival_ns"] >= first_ns)
        ]
        states.append(fusion.update(arrived if len(arrived) else None, t_ns))
        steps.append(controller.step(states[-1]))
        before_ns = t_ns
    together = HumanStates.join(states)
    for name, column in vars(people.states).items():
        if isinstance(column, np.ndarray):
            np.testing.assert_array_equal(getattr(together, name), column, err_msg=name)
    pd.testing.assert_frame_equal(controller.to_pandas(steps), plan.to_pandas())


def test_steps_beside_objects_have_their_columns() -> None:
    log = hr.open_log(hr.demo_log(), cell=CELL)
    people = hr.fuse(log, start_s=BEGIN_S, end_s=BEGIN_S + 0.2)
    plan, controller = hr.plan(people, baselines=()), hr.Controller(log)
    steps = [controller.step(people.states.rows(slice(i, i + 1))) for i in range(len(people.states))]
    table = controller.to_pandas(steps)
    assert {"object_distance_m", "object", "object_link", "self_distance_m"} <= {*table.columns}
    pd.testing.assert_frame_equal(table, plan.to_pandas())


def test_a_data_frame_is_a_log(log: hr.Recording, people: hr.People) -> None:
    """The demo's frames as a DataFrame give the person of the demo; so do its columns in another order of rows."""
    poses = log.log.header.T_world_camera
    table = log.to_pandas()
    again = hr.frames(table.sample(frac=1.0, random_state=3), poses, T_world_base=log.T_world_base, task=log.task)
    assert again.cameras == log.cameras
    np.testing.assert_array_equal(again.T_world_base, log.T_world_base)
    begin_s = (int(people.states.t_ns[0]) - again.log.header.start_ns) / 1e9
    found = hr.fuse(again, start_s=begin_s, end_s=begin_s + END_S - BEGIN_S)
    np.testing.assert_array_equal(found.states.p, people.states.p)
    np.testing.assert_array_equal(found.states.lengths_m, people.states.lengths_m)


def test_volumes_hold_the_person_s_wrist(people: hr.People) -> None:
    """By the distance from each volume to where the fused person's points are at the same tick."""
    some = people.rows(slice(200, 260, 20))
    volumes = hr.predict(some, horizon_s=0.2)
    assert len(volumes) == 3
    shown = some.states.points_m
    for tick in range(len(volumes)):
        for limb, point in (("LRA", 10), ("LLA", 6), ("HD", 3)):
            solid = volumes[tick][limb]
            if np.isfinite(shown[tick, point]).all():
                assert solid.distances_m(shown[tick, point][None])[0] <= solid.radius_m
    table = volumes.to_pandas()
    assert list(table["limb"][:7]) == ["HD", "THX", "URA", "LRA", "ULA", "LLA", "LEGS"]
    assert (table["horizon_s"] == 0.2).all()
    larger = hr.predict(some, horizon_s=0.4)
    assert larger[0]["LRA"].volume_m3() > volumes[0]["LRA"].volume_m3()


def test_settings_and_methods_are_taken(log: hr.Recording, people: hr.People) -> None:
    slow = hr.fuse(hr.open_log(replay.demo_log(), settings={"fusion": {"rate_hz": 50.0}}), start_s=8.0, end_s=8.2)
    assert np.diff(slow.states.t_ns).tolist() == [20_000_000] * 10
    stands = hr.plan(people.rows(slice(0, 50)), method="ssm", baselines=())
    assert set(stands.tables) == {"motion", "occupancy"}
    with pytest.raises(SettingsError, match="method"):
        hr.plan(people, method="wish")
    with pytest.raises(SettingsError, match=facts("robot", "'wish'")):
        hr.Robot.irb140(wish=1.0)


def test_another_robot_moves_as_by_the_command(people: hr.People, log: hr.Recording, tmp_path: Path) -> None:
    arm = ARMS["ur5"]
    robot = hr.Robot.from_urdf(arm.path, T_world_base=log.T_world_base, tool_m=arm.tool_m)
    found = hr.plan(people, robot, hr.load_task(arm.task(tmp_path)), baselines=())
    overrides = (*arm.overrides(tmp_path), "plan.baselines=[]")
    folder = replay.run(
        "plan", replay.demo_log(), out=tmp_path / "run", start_s=BEGIN_S, end_s=END_S, overrides=overrides
    )
    pd.testing.assert_frame_equal(found.to_pandas(), pq.read_table(folder / "motion.parquet").to_pandas())


def test_no_report_is_made_of_a_part(log: hr.Recording, people: hr.People, plan: hr.Plan, tmp_path: Path) -> None:
    some = people.rows(slice(0, 20))
    for person, motion in ((some, plan), (people, hr.plan(some, baselines=()))):
        with pytest.raises(SettingsError, match="ticks"):
            hr.report(log, person, motion, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_used_is_told(log: hr.Recording) -> None:
    table = log.to_pandas().head(5)
    with pytest.raises(SettingsError, match=facts("arrival_ns")):
        hr.frames(table.drop(columns="arrival_ns"), log.log.header.T_world_camera)
    with pytest.raises(SettingsError, match=facts("kinect", "pose")):
        hr.frames(table.assign(camera="kinect"), {"other": np.eye(4)})
    with pytest.raises(SettingsError, match="pelvis_y"):
        hr.frames(table.drop(columns="pelvis_y"), log.log.header.T_world_camera)
    with pytest.raises(AttributeError, match=facts("'wish'")):
        hr.wish  # noqa: B018


@pytest.mark.parametrize("notebook", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda path: path.stem)
def test_the_examples_run(notebook: Path, tmp_path: Path) -> None:
    cells: list[dict[str, Any]] = json.loads(notebook.read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)
