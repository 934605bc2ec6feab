"""What of an earlier run is taken over: all that a change does not touch, and nothing that it does."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hrcreplay.calibration.cell import Cell, pose_from_position
from hrcreplay.commands import replay
from hrcreplay.errors import SettingsError
from hrcreplay.limits import load_limits
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.pipeline import assembly, reuse
from hrcreplay.pipeline.run_config import STAGES, RunConfig, resolve
from hrcreplay.pipeline.stages import tick_times
from hrcreplay.pipeline.stored_volumes import store_every
from hrcreplay.settings.load import Settings
from hrcreplay.store import run_folder
from tests.facts import tells
from tests.robot.test_model import ONE_AXIS

ALL = "fuse predict plan"
#: Every setting and the stages whose result depends on it. A new setting has to be put here by hand: think which.
#: With ``plan.horizon`` adaptive the volumes that are stored beside a plan depend on all that the plan depends on.
STALE = {
    "logs.topics": ALL,
    "logs.decoders": ALL,
    "logs.unit": ALL,
    "logs.world_frame": ALL,
    "logs.base_frame": ALL,
    "logs.marker_ids_per_body": ALL,
    "logs.joints_topic": "plan",  # where the log has no task
    "logs.joint_names": "plan",
    "logs.joints_unit": "plan",
    "logs.joints_offset_s": "plan",
    "logs.robot_capsules": ALL,
    "logs.people": ALL,
    "logs.person_jump_m": ALL,
    "logs.person_memory_s": ALL,
    "logs.gap_s": "fuse",  # its counts
    "fusion.rate_hz": ALL,
    "fusion.stale": ALL,
    "fusion.delay": ALL,
    "fusion.confidence_min": ALL,
    "fusion.outlier_m": ALL,
    "fusion.relearn_s": ALL,
    "fusion.bone_m": ALL,
    "fusion.bone_memory_s": ALL,
    "fusion.point_std_m": ALL,
    "fusion.point_std_per_m": ALL,
    "fusion.sigma_position": ALL,
    "fusion.sigma_height": ALL,
    "fusion.sigma_angle": ALL,
    "fusion.coast_s": ALL,
    "fusion.delay_max_s": ALL,
    "fusion.residual_quantile": ALL,
    "fusion.residual_memory_s": ALL,
    "fusion.residual_hold_s": ALL,
    "fusion.offset_memory_s": ALL,
    "fusion.spread_memory_s": ALL,
    "fusion.spread_least": ALL,
    "fusion.spread_most": ALL,
    "fusion.memory_s": ALL,
    "fusion.fresh_s": ALL,
    "limits.tracking": ALL,
    "limits.prediction": "predict plan",
    "prediction.method": "predict plan",
    "prediction.stop_s": "predict plan",
    "prediction.store_hz": "predict",
    "prediction.radius_head_m": "predict plan",
    "prediction.radius_thorax_m": "predict plan",
    "prediction.radius_upper_arm_m": "predict plan",
    "prediction.radius_lower_arm_m": "predict plan",
    "prediction.sigmas": "predict plan",
    "prediction.latency_s": "predict plan",
    "prediction.hand_m": "predict plan",
    "prediction.legs_radius_m": "predict plan",
    "prediction.legs": "predict plan",
    "prediction.residual": "predict plan",
    "prediction.residual_unknown_m": "predict plan",
    "robot.urdf": "plan",
    "robot.srdf": "plan",
    "robot.packages": "",  # what they hold counts, by the digests of its files
    "robot.base_frame": "plan",
    "robot.tcp_frame": "plan",
    "robot.tool_m": "plan",
    "robot.tcp_offset": "plan",
    "robot.links": "plan",
    "robot.tool_links": "plan",
    "robot.acceleration": "plan",
    "robot.mass_kg": "plan",
    "robot.payload_kg": "plan",
    "plan.method": "plan",
    "plan.baselines": "plan",
    "plan.horizon": "predict plan",
    "plan.certify": "plan",
    "plan.rows": "plan",
    "plan.constraint_rhs": "plan",
    "plan.lead_s": "plan",
    "plan.give_way_m": "plan",
    "plan.jerk_s": "plan",
    "plan.smooth_s": "plan",
    "plan.retreat_m": "plan",
    "plan.posture": "plan",
    "plan.human_speed": "plan",
    "plan.contact_limbs": "plan",
    "plan.task": "plan",
    "plan.waiting_s": "plan",
    "plan.reference": "plan",
    "plan.max_reference_lead_m": "plan",
    "plan.catch_up_speed_m_per_s": "plan",
    "plan.waypoint_m": "plan",
    "plan.q_p": "plan",
    "plan.q_v": "plan",
    "plan.path_gain_per_s": "plan",
    "plan.clearance_m": "plan",
    "plan.tcp_speed_max": "plan",
    "plan.tcp_acceleration_max": "plan",
    "report.near_m": "",
    "report.stationary_m_per_s": "",
    "report.leg_radius_m": "",
    "live.port": "",
    "live.robot_address": "",
    "live.listen_address": "",
    "live.joint_order": "",
    "live.cycle_s": "",
    "live.reaction_s": "",
    "live.perception_max_age_s": "",
    "live.approach_speed": "",
    "live.resume": "",
    "live.resume_s": "",
    "live.uncertain_m": "",
    "live.uncertain_rad": "",
    "live.person_late_s": "",
    "live.overrun_s": "",
    "live.silent_s": "",
    "live.tracking_rad": "",
    "live.utilization_max": "",
    "live.keep_recorder": "",
    "live.disk_start_mb": "",
    "live.disk_low_mb": "",
    "live.real_time": "",
    "live.zenoh": "",
}
#: Another value, where none follows from the default by itself.
OTHER: dict[str, Any] = {
    "logs.topics": ("/camera/kinect/skeleton",),
    "logs.decoders": ({"topic": "/a", "camera": "a", "points": "p", "index": {"neck": 0}},),
    "logs.people": "nearest",
    "logs.unit": "mm",
    "logs.marker_ids_per_body": 33,
    "logs.joints_topic": "/robot/joints",
    "logs.joint_names": ("a", "b", "c", "d", "e", "f"),
    "logs.joints_unit": "deg",
    "logs.joints_offset_s": 0.5,
    "logs.robot_capsules": {"topic": "/a"},
    "fusion.stale": "reuse",
    "fusion.delay": "ignore",
    "limits.tracking": "paper",
    "limits.prediction": "paper",
    "prediction.method": "paper",
    "prediction.store_hz": "all",
    "robot.urdf": "robot.urdf",
    "robot.srdf": "robot.srdf",
    "robot.base_frame": "base",
    "robot.packages": ("meshes",),
    "robot.tcp_offset": {"position_m": (0.1, 0.0, 0.0)},
    "robot.tcp_frame": "tool",
    "robot.links": ({"name": "a", "body": "b", "start_m": (0, 0, 0), "end_m": (0, 0, 1), "radius_m": 0.1},),
    "robot.acceleration": (10.0,) * 6,
    "robot.mass_kg": 40.0,
    "robot.payload_kg": 2.0,
    "robot.tool_links": ({"name": "t", "body": "b", "start_m": (0, 0, 0), "end_m": (0, 0, 1), "radius_m": 0.1},),
    "logs.world_frame": "cell",
    "logs.base_frame": "robot_stand",
    "plan.method": "scaling",
    "plan.baselines": (),
    "plan.task": "task.toml",
    "plan.reference": "time",
    "plan.horizon": "fixed",
    "plan.rows": "hard",
    "plan.constraint_rhs": "square",
    "plan.contact_limbs": ("LRA", "LLA"),
    "live.robot_address": "10.0.0.1",
    "live.listen_address": "10.0.0.2",
    "live.joint_order": (1, 2, 4, 5, 6, 7, 3),
    "live.zenoh": {"mode": "client"},
}


def _settings() -> Iterator[str]:
    for section, field in Settings.model_fields.items():
        for key in field.annotation.model_fields:  # type: ignore[union-attr]
            yield f"{section}.{key}"


def _fixed(settings: Settings) -> Settings:
    """The same with volumes that always reach to the braking time."""
    return settings.model_copy(update={"plan": settings.plan.model_copy(update={"horizon": "fixed"})})


def _changed(name: str) -> Settings:
    """The default settings but for one."""
    section, key = name.split(".")
    value = getattr(getattr(Settings(), section), key)
    if name in OTHER:
        other = OTHER[name]
    elif isinstance(value, bool):
        other = not value
    elif isinstance(value, tuple):
        other = tuple(0.5 * number for number in value)
    else:
        other = value + 1 if isinstance(value, int) else 0.5 * value or 0.1
    assert other != value
    return Settings.model_validate({section: {key: other}})


@pytest.fixture(scope="module")
def log() -> Log:
    return open_log(replay.demo_log())


def _run_config(settings: Settings, tmp: Path, **changes: Any) -> RunConfig:
    (tmp / "task.toml").write_text('[[waypoints]]\nname = "other"\n')
    if settings.plan.task is not None:
        settings = settings.model_copy(update={"plan": settings.plan.model_copy(update={"task": tmp / "task.toml"})})
    known: dict[str, Any] = {"config": None, "overrides": (), "cell_file": None, "start_s": 2.0, "end_s": 4.0}
    overrides = () if settings.plan.task is None else (f"plan.task={settings.plan.task}",)
    run_config = resolve("report", replay.demo_log(), **{**known, "overrides": overrides})
    tracking, prediction = load_limits(settings.limits.tracking), load_limits(settings.limits.prediction)
    return replace(run_config, settings=settings, tracking_limits=tracking, prediction_limits=prediction, **changes)


def _ticks(run_config: RunConfig, log: Any) -> Any:
    start_ns = log.header.start_ns
    return tick_times(
        start_ns + round(1e9 * (run_config.start_s or 0.0)),
        start_ns + round(1e9 * (run_config.end_s or 60.0)),
        run_config.settings.fusion.rate_hz,
    )


def _stages(run_config: RunConfig, log: Any) -> dict[str, str]:
    return reuse.stage_digests(run_config, reuse.dependencies(run_config, log, _ticks(run_config, log)))


def _stale(a: tuple[RunConfig, Any], b: tuple[RunConfig, Any]) -> str:
    mine, theirs = _stages(*a), _stages(*b)
    return " ".join(stage for stage in STAGES if mine[stage] != theirs[stage])


def test_every_setting_is_in_the_table() -> None:
    assert list(_settings()) == list(STALE)


@pytest.mark.parametrize("name", STALE)
def test_a_setting_makes_the_stages_stale_that_depend_on_it(
    log: Log, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("robot.urdf").write_text(ONE_AXIS)
    Path("robot.srdf").write_text("<robot name='a'><disable_collisions link1='a' link2='b'/></robot>")
    source: Any = log
    if name.startswith("logs.joint"):  # nobody asks for joints where there is a task
        source = SimpleNamespace(header=replace(log.header, task=None))
    before, after = _run_config(Settings(), tmp_path), _run_config(_changed(name), tmp_path)
    expected = "predict plan" if STALE[name] in ("plan", "predict") else STALE[name]
    found = _stale((before, source), (after, source))
    assert found == (STALE[name] if name == "prediction.store_hz" else expected)
    if name != "plan.horizon":
        before, after = _run_config(_fixed(Settings()), tmp_path), _run_config(_fixed(_changed(name)), tmp_path)
        assert _stale((before, source), (after, source)) == STALE[name]


def _handed(run_config: RunConfig, log: Log) -> dict[str, str]:
    """What the first two stages are handed, however it came about, and how the third weighs."""
    fusion_stage, prediction_stage = (
        asdict(assembly.fusion_stage(run_config, log)),
        asdict(assembly.prediction_stage(run_config)),
    )
    for limits in (fusion_stage["limits"], prediction_stage["limits"]):
        del limits["name"]
    reading = {
        key: value for key, value in run_config.settings.logs.model_dump().items() if not key.startswith("joint")
    }
    first = repr((fusion_stage, reading, _ticks(run_config, log).tolist()))
    second = repr((prediction_stage, store_every(run_config)))
    return {
        "fuse": first,
        "predict": second,
        "plan": repr(assembly.plan_settings(run_config, 0.004, run_config.settings.plan.method)),
    }


@pytest.mark.parametrize("name", STALE)
def test_what_a_stage_is_handed_changes_where_the_table_says_so(log: Log, tmp_path: Path, name: str) -> None:
    """The table again, from what the wiring makes of a setting rather than from the digests."""
    before, after = (_handed(_run_config(settings, tmp_path), log) for settings in (Settings(), _changed(name)))
    different = {stage for stage in STAGES if before[stage] != after[stage]}
    assert different <= set(STALE[name].split())
    if STALE[name] in (ALL, "fuse", "predict", "predict plan") or name.startswith("plan."):
        assert different or name in ("plan.method", "plan.task")


def _copy(path: Path, to: Path) -> Path:
    shutil.copyfile(path, to)
    return to


def test_files_count_by_what_they_hold(log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.urdf").write_text(ONE_AXIS)
    limits = _copy(Path(load_limits.__code__.co_filename).parent / "people.toml", tmp_path / "own.toml")

    def run_config(urdf: str, limit_set: str) -> RunConfig:
        return _run_config(
            Settings.model_validate({"robot": {"urdf": tmp_path / urdf}, "limits": {"prediction": limit_set}}), tmp_path
        )

    first = run_config("a.urdf", "people")
    assert _stale((first, log), (run_config("a.urdf", str(limits)), log)) == ""
    _copy(tmp_path / "a.urdf", tmp_path / "b.urdf")
    assert _stale((first, log), (run_config("b.urdf", "people"), log)) == ""
    (tmp_path / "b.urdf").write_text(ONE_AXIS + "\n")
    assert _stale((first, log), (run_config("b.urdf", "people"), log)) == "predict plan"


def test_the_cell_counts_by_poses_clocks_and_base(log: Log, tmp_path: Path) -> None:
    poses = log.header.T_world_camera
    base = log.header.T_world_base
    assert base is not None
    moved = {**poses, "kinect": pose_from_position(np.array([0.0, 0.0, 2.0]), 0.1)}
    plain = _run_config(Settings(), tmp_path)
    for cell, stale in (
        (Cell(), ""),
        (Cell(T_world_camera=poses, T_world_base=base, notes=("up is known to about 8 degrees only",)), ""),
        (Cell(T_world_base=pose_from_position(np.array([1.0, 0.0, 0.65]), 0.0)), "predict plan"),
        (Cell(T_world_camera=moved), ALL),
        (Cell(T_world_camera=poses, clock_offset_s={"kinect": 0.01}), ALL),
    ):
        assert _stale((plain, log), (replace(plain, cell=cell), log)) == stale


def test_log_span_task_and_versions_count(log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = _run_config(Settings(), tmp_path, start_s=None)
    assert _stale((plain, log), (replace(plain, start_s=0.0), log)) == ""
    assert _stale((plain, log), (replace(plain, start_s=1.0), log)) == ALL
    assert _stale((plain, log), (replace(plain, log_sha256="0"), log)) == ALL
    assert _stale((plain, log), (replace(plain, task=log.header.task), log)) == ""
    assert _stale((plain, log), (replace(plain, task={"waypoints": []}), log)) == "predict plan"
    before = _stages(plain, log)
    monkeypatch.setattr("hrcreplay.pipeline.reuse.versions", lambda: {"hrcreplay": "9"})
    assert all(_stages(plain, log)[stage] != before[stage] for stage in STAGES)


def test_a_stage_that_does_not_run_asks_for_nothing(log: Log, tmp_path: Path) -> None:
    lost = Settings.model_validate({"robot": {"urdf": tmp_path / "none.urdf"}})
    with pytest.raises(SettingsError, match="not a file"):
        _stages(_run_config(lost, tmp_path), log)
    assert list(_stages(_run_config(lost, tmp_path, command="predict"), log)) == ["fuse", "predict"]


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("reuse") / "run"
    return replay.run("report", replay.demo_log(), out=out, start_s=9.0, end_s=9.6)


def _same(a: Path, b: Path) -> bool:
    mine, theirs = run_folder.read_meta(a), run_folder.read_meta(b)
    return all(mine[key] == theirs[key] for key in mine if key != "created")


def test_another_base_takes_over_the_person_and_comes_out_like_a_fresh_run(
    reported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text("T_world_base = { position_m = [0.3, 0.1, 0.65], yaw_deg = 10 }\n")
    moved = replay.run("report", reported, out=tmp_path / "moved", cell_file=cell)
    said = capsys.readouterr().err.splitlines()
    assert tells(said[0], "fuse", "taken over", str(reported))
    for line, stage in zip(said[1:3], ("predict", "plan"), strict=True):
        assert tells(line, stage, "base", str(reported), "computed again")
    assert tells(said[-1], "T_world_base"), "the robot stands among the person's limbs there"
    fresh = replay.run("report", replay.demo_log(), out=tmp_path / "fresh", cell_file=cell, start_s=9.0, end_s=9.6)
    assert _same(moved, fresh)
    mine, theirs = run_folder.read_meta(moved)["outputs"], run_folder.read_meta(reported)["outputs"]
    assert mine["motion.parquet"] != theirs["motion.parquet"]
    assert all(mine[name] == theirs[name] for name in ("measurements.parquet", "state.parquet"))


@pytest.mark.parametrize(
    ("override", "again"),
    [
        ("prediction.store_hz=50", "predict plan"),
        ("logs.gap_s=0.01", "fuse"),
        ("plan.max_reference_lead_m=0.1", "predict plan"),
    ],
)
def test_only_what_a_setting_touches_is_computed_again(
    reported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], override: str, again: str
) -> None:
    other = replay.run("plan", reported, out=tmp_path / "other", overrides=(override,))
    said = capsys.readouterr().err
    assert [stage for stage in STAGES if f"{stage}: taken over" not in said] == again.split()
    fresh = replay.run("plan", replay.demo_log(), out=tmp_path / "fresh", overrides=(override,), start_s=9.0, end_s=9.6)
    assert _same(other, fresh)


def _with_joints(path: Path, log: Log) -> Path:
    """Half a second of the demo's frames beside a robot's joint track; two of its messages repeat an instant."""
    begin_ns = log.header.start_ns + 9_000_000_000
    t_ns = begin_ns + 10_000_000 * np.array([0, 5, 10, 10, 15, 20, 20, 50])
    q = np.zeros((len(t_ns), 6))
    q[:, 0], q[:, 4] = np.linspace(0.0, 0.3, len(t_ns)), 0.5 * np.pi
    with LogWriter(path) as writer:
        for name, T in log.header.T_world_camera.items():
            writer.camera(name, T)
        assert log.header.T_world_base is not None
        writer.base(log.header.T_world_base)
        writer.joints([f"joint_{i}" for i in range(1, 7)], t_ns, q)
        for frames in log.frames(begin_ns, begin_ns + 500_000_000):
            writer.frames(frames)
    return path


def test_what_each_stage_found_in_the_log_stays_with_it(log: Log, tmp_path: Path) -> None:
    """The joint track's flaws are the plan's, also beside a task file, as the recorded robot is judged in any case."""
    path = _with_joints(tmp_path / "log.mcap", log)
    joints = replay.run("plan", path, out=tmp_path / "joints")
    counts = run_folder.read_meta(joints)["counts"]
    assert counts["joints_out_of_order"] == 2
    task = tmp_path / "task.toml"
    task.write_text(
        "[[waypoints]]\njoints_deg = [0, 0, 0, 0, 90, 0]\n[[waypoints]]\njoints_deg = [9, 0, 0, 0, 90, 0]\n"
    )
    with_task = replay.run("plan", joints, out=tmp_path / "task", overrides=(f"plan.task={task}",))
    fresh = replay.run("plan", path, out=tmp_path / "fresh", overrides=(f"plan.task={task}",))
    assert _same(with_task, fresh)
    assert run_folder.read_meta(fresh)["counts"]["joints_out_of_order"] == 2
    fused = replay.run("fuse", path, out=tmp_path / "fused")
    assert "joints_out_of_order" not in run_folder.read_meta(fused)["counts"]
    again = replay.run("plan", fused, out=tmp_path / "again")
    assert _same(again, joints)
