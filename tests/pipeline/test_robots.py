"""Other robots, other programmes: what a user sets beside the default cell."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.commands import replay
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs.reader import open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.robot import irb140
from hrcreplay.store import run_folder
from tests.facts import facts

AXES = [f"q{i}" for i in range(1, 7)]


def _plan(log: Path, out: Path, *overrides: str) -> run_folder.Run:
    return run_folder.read(replay.run("plan", log, out=out, start_s=8.0, end_s=10.0, overrides=overrides))


#: The prediction with which the robot moves most.
PRINTED = ("prediction.method=paper", "limits.prediction=paper")


def _without_task(path: Path, **joints: Any) -> Path:
    """The demo log's frames from 8 s to 10.5 s, without its task, with a joint track where one is given."""
    demo = open_log(replay.demo_log())
    begin = demo.header.start_ns
    with LogWriter(path) as writer:
        for camera in demo.header.cameras:
            writer.camera(camera, demo.header.T_world_camera[camera])
        assert demo.header.T_world_base is not None
        writer.base(demo.header.T_world_base)
        for frames in demo.frames(begin + 8_000_000_000, begin + 10_500_000_000):
            writer.frames(frames)
        if joints:
            writer.joints(joints["names"], joints["t_ns"] + begin, joints["q"])
    return path


def test_another_urdf_with_given_links_moves_as_the_built_in_robot(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(irb140.urdf())
    links = ", ".join(
        f'{{name = "{name}", body = "{body}", start_m = {list(start_m)}, end_m = {list(end_m)}, radius_m = {radius_m}}}'
        for name, body, start_m, end_m, radius_m in irb140.capsules(0.10)
    )
    mine = _plan(replay.demo_log(), tmp_path / "mine", f"robot.urdf={tmp_path / 'arm.urdf'}", f"robot.links=[{links}]")
    built_in = _plan(replay.demo_log(), tmp_path / "built_in")
    assert mine.motion is not None
    assert built_in.motion is not None
    np.testing.assert_allclose(mine.motion[AXES], built_in.motion[AXES], atol=1e-9)


def test_links_without_a_urdf_are_refused(tmp_path: Path) -> None:
    link = '{name = "a", body = "b", start_m = [0,0,0], end_m = [0,0,1], radius_m = 0.1}'
    with pytest.raises(SettingsError, match=facts("robot.links", "IRB 140", "robot.urdf")):
        _plan(replay.demo_log(), tmp_path / "x", f"robot.links=[{link}]")


def test_a_recorded_joint_track_is_the_programme_where_there_is_no_task(tmp_path: Path) -> None:
    t_s = np.arange(8.0, 10.5, 0.01)
    rest, swing = np.array([0, 0.3, 0.1, 0, 0.9, 0]), np.array([1, 0.3, -0.2, 0.5, 0.4, 1])
    q = rest + np.outer(0.2 * np.sin(1.5 * (t_s - 8.0)), swing)
    names = [f"joint_{i}" for i in range(1, 7)]
    log = _without_task(tmp_path / "track.mcap", names=names, t_ns=np.round(t_s * 1e9).astype(np.int64), q=q)
    run = run_folder.read(replay.run("plan", log, out=tmp_path / "run", overrides=("plan.method=scaling", *PRINTED)))
    assert run.motion is not None
    t_ns = run.motion["t_ns"].to_numpy()
    expected = np.column_stack([np.interp(run.motion["programme_s"] + 8.0, t_s, column) for column in q.T])
    np.testing.assert_allclose(run.motion[AXES], expected, atol=2e-3)
    assert run.motion["programme_s"].iloc[-1] > 0.5 * (t_ns[-1] - t_ns[0]) * 1e-9


def test_the_order_of_a_message_changes_nothing_and_gaps_are_told(tmp_path: Path) -> None:
    """Alphabetical order, and one that drivers have: the same motion to the last bit, as names decide."""
    t_s = np.concatenate([np.arange(8.0, 8.3, 0.01), np.arange(8.6, 9.5, 0.01)])
    q = np.array([0, 0.3, 0.1, 0, 0.9, 0]) + np.outer(0.2 * np.sin(1.5 * (t_s - 8.0)), [1, 0.3, -0.2, 0.5, 0.4, 1])
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    motions, notes = [], []
    for name, order in (
        ("right", [0, 1, 2, 3, 4, 5]),
        ("shuffled", [0, 1, 3, 4, 2, 5]),
        ("turned", [5, 4, 3, 2, 1, 0]),
    ):
        log = _without_task(
            tmp_path / f"{name}.mcap", names=[f"joint_{i + 1}" for i in order], t_ns=t_ns, q=q[:, order]
        )
        folder = replay.run(
            "plan", log, out=tmp_path / name, overrides=("plan.method=none", "plan.baselines=[]"), end_s=1.0
        )
        run = run_folder.read(folder)
        assert run.motion is not None
        motions.append(run.motion[AXES].to_numpy())
        notes.append(run.meta["notes"])
    np.testing.assert_array_equal(motions[1], motions[0])
    np.testing.assert_array_equal(motions[2], motions[0])
    assert all(any("of 0.30 s from 0.30 s" in note for note in told) for told in notes)


def test_a_joint_track_of_another_robot_is_refused(tmp_path: Path) -> None:
    track = {"names": ["a", "b"], "t_ns": np.arange(100) * 10_000_000 + 8_000_000_000, "q": np.zeros((100, 2))}
    log = _without_task(tmp_path / "track.mcap", **track)
    with pytest.raises(LogError, match="2"):
        replay.run("plan", log, out=tmp_path / "run")


def test_no_programme_at_all_says_how_to_give_one(tmp_path: Path) -> None:
    log = _without_task(tmp_path / "bare.mcap")
    with pytest.raises(SettingsError, match=facts("task", "joint track", "--set", "plan.task")):
        replay.run("plan", log, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_joint_states_without_usable_positions_are_no_programme_and_named(tmp_path: Path) -> None:
    """Three names and two positions: which joint has none, nobody can say."""
    track = {"names": ["a", "b", "c"], "t_ns": np.arange(100) * 10_000_000 + 8_000_000_000, "q": np.zeros((100, 2))}
    log = _without_task(tmp_path / "track.mcap", **track)
    with pytest.raises(SettingsError, match=r"/robot/joints.*plan\.task"):
        replay.run("plan", log, out=tmp_path / "run")


def test_the_reference_runs_with_the_clock_where_asked(tmp_path: Path) -> None:
    run = _plan(replay.demo_log(), tmp_path / "run", "plan.reference=time")
    assert run.motion is not None
    np.testing.assert_allclose(np.diff(run.motion["programme_s"]), 0.004, atol=1e-12)


def test_a_filter_of_another_rate_has_its_own_ticks(tmp_path: Path) -> None:
    run = _plan(replay.demo_log(), tmp_path / "run", "fusion.rate_hz=100")
    assert run.state is not None
    assert run.motion is not None
    assert set(np.diff(run.state["t_ns"])) == {10_000_000}
    limit = np.radians([200, 200, 260, 360, 360, 450]) / 0.377
    assert (np.abs(run.motion[[f"u{i}" for i in range(1, 7)]]) <= limit + 1e-9).all(axis=None)
