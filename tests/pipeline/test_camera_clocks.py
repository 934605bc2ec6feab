"""Runs on the demo's log with cameras whose clocks are wrong, whose frames stop, or whose image trembles.

What is spoilt is what a stamp means; the fused person is compared with that of the log as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.calibration.calibrate import calibrate
from hrcreplay.calibration.cell import Cell, write_cell
from hrcreplay.commands import replay, report
from hrcreplay.errors import LogError
from hrcreplay.human.model import skeleton
from hrcreplay.logs.reader import open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import POINTS, CameraFrames, Floats
from hrcreplay.reporting.metrics.series import columns
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states

BEGIN_S, END_S = 10.0, 18.0
WRISTS = [POINTS.index(name) for name in ("wrist_l", "wrist_r")]
Spoil = Callable[[CameraFrames], CameraFrames]


def _spoilt(path: Path, spoil: Spoil) -> Path:
    """Eight seconds of the demo's log, spoilt."""
    log = open_log(replay.demo_log())
    begin_ns = log.header.start_ns
    table = CameraFrames.join(list(log.frames(begin_ns + int(BEGIN_S * 1e9), begin_ns + int(END_S * 1e9))))
    table = spoil(table)
    with LogWriter(path) as writer:
        for name, T in log.header.T_world_camera.items():
            writer.camera(name, T)
        assert log.header.task is not None and log.header.T_world_base is not None  # noqa: PT018 - for the type checker
        writer.task(log.header.task)
        writer.base(log.header.T_world_base)
        writer.frames(table)
    return path


def _of(table: CameraFrames, camera: str) -> np.ndarray:
    return np.asarray(table.camera == table.cameras.index(camera))


def _later(camera: str, by_s: float) -> Spoil:
    """The clock of a camera set by so much [s]."""

    def spoil(table: CameraFrames) -> CameraFrames:
        return replace(table, capture_ns=table.capture_ns + int(by_s * 1e9) * _of(table, camera))

    return spoil


def _fused(tmp_path: Path, spoil: Spoil, name: str = "log", cell: Path | None = None) -> run_folder.Run:
    log = tmp_path / f"{name}.mcap"
    if not log.exists():
        _spoilt(log, spoil)
    folder = replay.run("fuse", log, out=tmp_path / f"{name}-{cell.stem if cell else 'run'}", cell_file=cell)
    return run_folder.read(folder)


def _wrists(run: run_folder.Run) -> Floats:
    """(n, 2, 3) fused wrists, NaN at ticks at which the person is not known."""
    (states,) = read_states(run.folder / "state.parquet", 10**6)
    points = skeleton(states.p, states.lengths_m)[:, WRISTS]
    return np.where((states.frame_age_s <= 0.3)[:, None, None], points, np.nan)


def _apart_m(one: run_folder.Run, other: run_folder.Run) -> Floats:
    return np.asarray(np.linalg.norm(_wrists(one) - _wrists(other), axis=2))


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> run_folder.Run:
    return _fused(tmp_path_factory.mktemp("clean"), lambda table: table)


def test_nothing_is_told_of_a_clean_log(clean: run_folder.Run) -> None:
    assert [note for note in clean.meta["notes"] if note.startswith("camera ")] == []
    assert not [name for name in clean.counts if name.startswith(("frames_late", "frames_stamp"))]


def test_clocks_that_are_set_back_in_mid_recording(tmp_path: Path, clean: run_folder.Run) -> None:
    def spoil(table: CameraFrames) -> CameraFrames:
        later = table.arrival_ns > table.arrival_ns[len(table) // 2]
        return replace(table, capture_ns=table.capture_ns - 3 * 10**9 * later)

    run = _fused(tmp_path, spoil)
    apart_m = _apart_m(run, clean)
    assert np.isfinite(apart_m).all(axis=1).mean() > 0.97
    assert np.nanpercentile(apart_m, 99) < 0.05
    assert {camera for camera in ("kinect", "xtion") for note in run.meta["notes"] if f"camera {camera}: " in note} == {
        "kinect",
        "xtion",
    }


def test_a_clock_of_a_simulation_and_one_ahead(tmp_path: Path, clean: run_folder.Run) -> None:
    """The two have their arrivals, so what is captured 40 ms before is taken for now."""

    def spoil(table: CameraFrames) -> CameraFrames:
        ahead = table.capture_ns + 4 * 10**9
        return replace(table, capture_ns=np.where(_of(table, "kinect"), ahead, table.capture_ns - table.capture_ns[0]))

    run = _fused(tmp_path, spoil)
    assert np.nanpercentile(_apart_m(run, clean), 95) < 0.05
    assert np.isfinite(_wrists(run)).all(axis=(1, 2)).mean() > 0.97
    assert [note for note in run.meta["notes"] if "xtion" in note and "simulation" in note]
    assert [note for note in run.meta["notes"] if "kinect" in note and "after their arrival" in note]


@pytest.mark.parametrize("behind_s", [3.0, 0.3])
def test_a_camera_that_is_behind_is_left_out_and_mended_by_what_is_told(
    tmp_path: Path, clean: run_folder.Run, behind_s: float
) -> None:
    run = _fused(tmp_path, _later("xtion", -behind_s))
    assert run.counts["frames_late_xtion"] > 180
    assert "frames_late_kinect" not in run.counts
    assert run.state is not None
    assert not run.state["valid_xtion"].mean() > 0.02
    (note,) = (note for note in run.meta["notes"] if "clock_offset_s = " in note)
    offset_s = float(note.partition("clock_offset_s = ")[2].split()[0])
    assert offset_s == pytest.approx(-behind_s, abs=0.05)
    poses = open_log(replay.demo_log()).header.T_world_camera
    write_cell(Cell(T_world_camera=poses, clock_offset_s={"xtion": offset_s}), tmp_path / "cell.toml")
    mended = _fused(tmp_path, _later("xtion", -behind_s), cell=tmp_path / "cell.toml")
    assert not [note for note in mended.meta["notes"] if "clock_offset_s = " in note or "not used" in note]
    assert np.nanpercentile(_apart_m(mended, clean), 99) < 0.05


@pytest.mark.parametrize("by_s", [-3.0, 2.5])
def test_calibrate_finds_clocks_that_are_seconds_apart(tmp_path: Path, by_s: float) -> None:
    """As the remedy that is told promises. Captures ahead of arrival are read as arrivals: 40 ms after them."""
    log = open_log(_spoilt(tmp_path / "log.mcap", _later("xtion", by_s)))
    cell = calibrate(log, up=(0.0, -1.0, 0.0), height_m=2.0)
    between_s = cell.clock_offset_s["xtion"] - cell.clock_offset_s["kinect"]
    assert between_s == pytest.approx(by_s if by_s < 0.0 else 0.045, abs=0.02)


def test_all_clocks_behind_are_named_where_nobody_is_known(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"frames_late_kinect \d+.*frames_late_xtion \d+.*clock_offset_s"):
        _fused(tmp_path, lambda table: replace(table, capture_ns=table.capture_ns - 2 * 10**9))


def test_a_camera_that_only_trembles_is_silent(tmp_path: Path, clean: run_folder.Run) -> None:
    """Its image froze for three seconds, and noise of 0.1 mm makes each frame a new one."""
    begin_s, end_s = 2.0, 5.0

    def spoil(table: CameraFrames) -> CameraFrames:
        at_s = (table.arrival_ns - table.arrival_ns[0]) / 1e9
        stuck = np.flatnonzero(_of(table, "xtion") & (at_s > begin_s) & (at_s < end_s))
        points = table.points_m.copy()
        points[stuck] = points[stuck[0]] + np.random.default_rng(3).normal(0.0, 1e-4, (len(stuck), 20, 3))
        return replace(table, points_m=points)

    run = _fused(tmp_path, spoil)
    (told,) = (note for note in run.meta["notes"] if "tremble" in note)
    assert "camera xtion" in told
    assert float(told.partition("for ")[2].split()[0]) == pytest.approx(end_s - begin_s, abs=0.15)
    assert run.counts["frames_trembling"] == pytest.approx((end_s - begin_s - 0.5) * 25, abs=8)
    assert run.state is not None and clean.state is not None  # noqa: PT018 - for the type checker
    at_s = run.state["t_ns"].to_numpy() / 1e9 - run.state["t_ns"].iloc[0] / 1e9
    silent = (at_s > begin_s + 0.6) & (at_s < end_s - 0.1)
    assert not run.state["valid_xtion"][silent].any()
    assert run.state["valid_kinect"][silent].any()
    assert np.nanpercentile(_apart_m(run, clean)[silent[: len(clean.state)]], 50) < 0.05


def test_a_person_whose_frames_are_old_is_not_known(tmp_path: Path) -> None:
    """Nothing from any camera for 0.6 s: the robot brakes once the newest capture is 0.3 s old, and says why."""

    def spoil(table: CameraFrames) -> CameraFrames:
        at_s = (table.arrival_ns - table.arrival_ns[0]) / 1e9
        return table.rows(np.asarray((at_s < 4.0) | (at_s > 4.6)))

    log = _spoilt(tmp_path / "log.mcap", spoil)
    folder = replay.run("plan", log, out=tmp_path / "run", overrides=("plan.baselines=[]",), start_s=3.0, end_s=5.5)
    run = run_folder.read(folder)
    assert run.state is not None and run.motion is not None  # noqa: PT018 - for the type checker
    t_ns = run.state["t_ns"].to_numpy()
    frames = CameraFrames.join(list(open_log(log).frames()))
    newest_ns = np.array([frames.capture_ns[frames.arrival_ns <= t].max() for t in t_ns])
    old = (t_ns - newest_ns) / 1e9 > 0.3
    assert 40 < old.sum() < 100
    reason = run.motion["reason"].to_numpy()
    late = slice(25, None)  # at the start the person has yet to be seen
    np.testing.assert_array_equal(reason[late] == "no human state", old[late])
    assert (run.motion["status"][old] == "braking").all()
    found = report.compute(run, near_m=0.5, stationary_m_per_s=0.001)
    assert found["ticks_person_unknown"]["value"] == pytest.approx(old.sum(), abs=15)
    assert found["person_known_share"]["value"] == 1.0 - found["ticks_person_unknown"]["value"] / len(t_ns)
    for limb in ("HD", "LRA", "LEGS"):
        known = (run.state["frame_age_s"] <= 0.3) & (run.state[f"unseen_{limb}"] <= 0.3)
        assert found[f"limb_{limb}_known_share"]["value"] == known.mean() <= found["person_known_share"]["value"]
    assert np.isfinite(columns(run.state)[old]).all()  # the filter goes on, for as long as its memory
