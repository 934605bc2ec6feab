from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial import ConvexHull

from hrcreplay.commands import replay
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.geometry.convex_hull import hull
from hrcreplay.geometry.inflated_hull import InflatedHull
from hrcreplay.human.model import skeleton
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly, stages
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.records import JOINTS, LENGTHS, LIMBS, STATUSES, Floats, SweptVolumes
from hrcreplay.robot.control.control_step import RobotState
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.robot.control.stops import Stop, stop_along_path, stop_axis_by_axis, stop_straight
from hrcreplay.robot.model import irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import parse_task
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from hrcreplay.store.run_folder import Run
from tests.facts import facts, tells
from tests.reporting.synthetic import frame_of
from tests.robot import checker
from tests.robot.distances import by_coal
from tests.robot.swinging import asked, dense


def _short(command: str, source: Path, out: Path, **options: Any) -> Path:
    """Three seconds of the demo log, in which the person reaches in for the first time."""
    return replay.run(command, source, out=out, start_s=8.0, end_s=11.0, **options)


def _meta(folder: Path) -> dict[str, Any]:
    return run_folder.read_meta(folder)


def test_a_run_leaves_what_the_contract_says(demo_folder: Path, demo: Run) -> None:
    assert demo.state is not None
    assert demo.occupancy is not None
    assert demo.motion is not None
    assert demo.state["t_ns"].dtype == np.int64
    wanted = [f"{joint}{suffix}" for joint in JOINTS for suffix in ("", "_vel", "_acc", "_jerk", "_std")]
    assert set(wanted) | set(LENGTHS) | {"valid_kinect", "valid_xtion"} <= set(demo.state.columns)
    assert set(demo.occupancy.columns) == {"t_ns", "limb", "method", "radius_m", "volume_m3", "vertices", "horizon_s"}
    assert set(demo.occupancy["limb"]) == {*LIMBS, "LEGS"}
    axes = [f"{name}{axis}" for name in ("q", "dq", "u") for axis in range(1, 7)]
    places = [f"{name}_{axis}" for name in ("ref", "tcp") for axis in "xyz"]
    others = ["tcp_speed", "ref_speed", "programme_s", "distance_m", "overlap_m", "limb", "link", "status", "reason"]
    stops = ["horizon_s", "tau_s", "certified"]
    assert list(demo.motion.columns) == ["t_ns", *axes, *places, *others, *stops]
    assert set(demo.motion["status"]) == {"tracking", "limited", "braking", "retreating"}
    for name in ("run.json", "metrics.json", "timing.json", "report.html"):
        assert (demo_folder / name).stat().st_size > 0
    assert {p.suffix for p in (demo_folder / "figures").iterdir()} == {".png", ".svg"}
    meta = demo.meta
    assert meta["complete"] is True
    assert np.array(meta["T_world_base"]).shape == (4, 4)
    assert meta["inputs"][0]["sha256"] == run_folder.sha256(replay.demo_log())
    made = {p.relative_to(demo_folder).as_posix() for p in demo_folder.rglob("*") if p.is_file()}
    assert set(meta["outputs"]) == made - {"run.json", "timing.json"}


def test_ticks_are_the_filters_rate(demo: Run) -> None:
    assert demo.state is not None
    assert set(np.diff(demo.state["t_ns"])) == {4_000_000}
    assert len(demo.state) == 15_001


def test_a_span_of_more_than_a_day_is_refused() -> None:
    day_ns = 24 * 3600 * stages.NS
    assert len(stages.tick_times(5, day_ns + 5, 0.01)) == 865
    with pytest.raises(LogError, match=facts("arrivals", "36 h", "24 h", "--start")):
        stages.tick_times(5, 3 * day_ns // 2, 0.01)


def test_fusion_meets_its_bars_on_the_demo(demo_folder: Path, demo: Run) -> None:
    metrics = json.loads((demo_folder / "metrics.json").read_text())
    assert metrics["fusion_angle_rmse_ratio"]["value"] <= 0.6
    assert metrics["fusion_velocity_rmse_ratio"]["value"] <= 0.4
    assert demo.state is not None
    assert demo.measurements is not None
    numbers = demo.state[[f"{j}{s}" for j in JOINTS for s in ("", "_vel", "_acc", "_jerk", "_std")]].to_numpy()
    seen = demo.state["t_ns"] >= demo.measurements["arrival_ns"].min()
    assert np.isfinite(numbers[seen]).all()
    assert np.isnan(numbers[~seen]).all()  # and nothing is made up before


def test_stop_share_of_the_qp_is_below_that_of_scaling(demo_folder: Path) -> None:
    metrics = json.loads((demo_folder / "metrics.json").read_text())
    assert metrics["plan_near_ticks"]["value"] > 3000
    assert metrics["baseline_scaling_near_ticks"]["value"] > 3000
    assert metrics["plan_stationary_share"]["value"] < metrics["baseline_scaling_stationary_share"]["value"]


def _predicted(run: Run, ticks: Sequence[int], horizon_s: Floats | None) -> list[SweptVolumes]:
    """The volumes of some ticks, predicted anew from the run's own table of states; NaN where nobody is known."""
    stage = assembly.prediction_stage(resolve("predict", run.folder))
    (people,) = read_states(run.folder / "state.parquet", 1_000_000)
    states = people.of_person(1)
    horizons = np.full(len(states), stage.horizon_s) if horizon_s is None else horizon_s
    return [stage.volumes(states.rows(slice(k, k + 1)), float(horizons[k])) for k in ticks]


def _volumes(run: Run) -> SweptVolumes:
    """Those of every tick until the braking time."""
    stage = assembly.prediction_stage(resolve("predict", run.folder))
    (people,) = read_states(run.folder / "state.parquet", 1_000_000)
    states = people.of_person(1)
    return stage.volumes(states)


def _assert_stored_are(run: Run) -> None:
    """The run's stored hulls have corners among the vertices of these volumes, and reach as far in any direction."""
    assert run.occupancy is not None
    assert run.motion is not None
    t_ns, horizon_s = run.motion["t_ns"].to_numpy(), run.motion["horizon_s"].to_numpy()
    directions = np.random.default_rng(0).normal(size=(50, 3))
    ticks = range(0, len(t_ns), 10)
    by_tick = dict(iter(frame_of(run.occupancy).groupby("t_ns", sort=True)))
    for k, volumes in zip(ticks, _predicted(run, ticks, horizon_s), strict=True):
        if np.isnan(volumes.vertices(0, 0)).any():
            assert t_ns[k] not in by_tick
            continue
        rows = by_tick.pop(t_ns[k])
        assert tuple(rows["limb"]) == volumes.limbs
        assert list(rows["radius_m"]) == volumes.radius_m[0].tolist()
        assert (rows["horizon_s"] == horizon_s[k]).all()
        for limb, stored in enumerate(rows["vertices"]):
            vertices, corners = volumes.vertices(0, limb), np.asarray(stored).reshape(-1, 3)
            assert set(map(bytes, corners)) <= set(map(bytes, vertices))
            reach, expected = ((points @ directions.T).max(axis=0) for points in (corners, vertices))
            np.testing.assert_allclose(reach, expected, rtol=0, atol=1e-9)
    assert not by_tick


@pytest.fixture(scope="module")
def printed_volumes(printed: Run) -> SweptVolumes:
    return _volumes(printed)


def test_the_stored_volumes_are_those_of_their_ticks(demo: Run) -> None:
    assert demo.motion is not None
    assert demo.motion["horizon_s"].nunique() > 20
    _assert_stored_are(demo)


def test_the_stored_volumes_are_those_of_their_ticks_as_printed(printed: Run) -> None:
    assert printed.motion is not None
    assert set(printed.motion["horizon_s"]) == {0.377}
    _assert_stored_are(printed)


def test_volumes_of_every_tick_are_stored_where_asked(tmp_path: Path) -> None:
    folder = replay.run(
        "predict",
        replay.demo_log(),
        out=tmp_path / "run",
        start_s=8.0,
        end_s=9.0,
        overrides=("prediction.store_hz=all",),
    )
    run = run_folder.read(folder)
    assert run.state is not None
    assert run.occupancy is not None
    volumes = _volumes(run)
    known = [k for k in range(len(volumes)) if not np.isnan(volumes.vertices(k, 0)).any()]
    assert len(known) > 200
    assert list(run.occupancy["t_ns"]) == np.repeat(volumes.t_ns[known], len(volumes.limbs)).tolist()
    for (k, limb), stored in zip(itertools.product(known, range(7)), run.occupancy["vertices"], strict=True):
        np.testing.assert_array_equal(np.asarray(stored).reshape(-1, 3), hull(volumes.vertices(k, limb))[0])


def _worst_m(run: Run, volumes: SweptVolumes, name: str) -> float:
    """The worst violation of inequality (2) [m], by a checker with its own kinematics, from the run's tables."""
    table = run.motion if name == "qp" else run.baselines[name]
    assert table is not None
    assert run.T_world_base is not None
    status = np.array([STATUSES.index(name) for name in table["status"]])
    q, dq, u = (table[[f"{kind}{i}" for i in range(1, 7)]].to_numpy() for kind in ("q", "dq", "u"))
    return checker.violation(q, dq, u, status, volumes, run.T_world_base, dt_s=0.004, stop_s=0.377).metres


@pytest.mark.parametrize("name", ["qp", "scaling"])
def test_every_step_and_the_stop_after_it_keep_clear_of_the_volumes_of_its_tick(demo: Run, name: str) -> None:
    """By coal alone, at every tick of the stop: 400 of the steps that were taken, the nearest ones among them."""
    table = demo.motion if name == "qp" else demo.baselines[name]
    assert table is not None
    assert demo.T_world_base is not None
    task = open_log(replay.demo_log()).header.task
    assert task is not None
    robot = irb140(demo.T_world_base, stop_s=0.377)
    path, radius = plan_programme(parse_task(task), robot), np.array([segment.radius_m for segment in robot.segments])
    q, dq = (table[[f"{kind}{i}" for i in range(1, 7)]].to_numpy() for kind in ("q", "dq"))
    moving = (dq != 0.0).any(axis=1)
    assert table["certified"].to_numpy()[moving].all()
    status, s = table["status"].to_numpy(), table["programme_s"].to_numpy()
    taken = np.flatnonzero(moving[1:] & np.isin(status[:-1], ("tracking", "limited")))
    nearest = taken[np.argsort(table["distance_m"].to_numpy()[taken], kind="stable")[:200]]
    ticks = np.union1d(nearest, taken[:: len(taken) // 200]).tolist()
    for k, volumes in zip(ticks, _predicted(demo, ticks, table["horizon_s"].to_numpy()), strict=True):
        seen = obstacles(volumes, 0)

        def gap_m(stop: Stop, seen: Obstacles = seen) -> float:
            rows = [*stop.q[:: max(1, len(stop.q) // 6)], stop.q[-1]]
            apart = [by_coal(robot.pose(row, np.zeros(6)), seen) - radius[:, None] - seen.radius_m for row in rows]
            return float(np.min(apart))

        if name == "qp":
            after = (brake(q[k + 1], dq[k + 1], robot.ddq_max, 0.004) for brake in (stop_straight, stop_axis_by_axis))
            assert max(gap_m(stop) for stop in after) > 0.0
        else:
            rate = float(np.linalg.norm(dq[k + 1]) / np.linalg.norm(path.sample(s[k + 1]).dq))
            stop = stop_along_path(path.grid, float(s[k + 1]), rate, robot.ddq_max, 0.004)
            assert stop is not None
            assert gap_m(stop) > -1e-6


@pytest.mark.parametrize("name", ["qp", "scaling"])
def test_every_tick_not_in_braking_keeps_inequality_2_as_printed(
    printed: Run, printed_volumes: SweptVolumes, name: str
) -> None:
    assert _worst_m(printed, printed_volumes, name) <= 1e-6


@pytest.mark.parametrize("name", ["qp"])
def test_a_braking_robot_decelerates_every_joint_at_its_limit(printed: Run, name: str) -> None:
    assert printed.motion is not None
    braking = printed.motion[printed.motion["status"] == "braking"]
    assert len(braking) > 50
    dq, u = (braking[[f"{kind}{i}" for i in range(1, 7)]].to_numpy() for kind in ("dq", "u"))
    limit = np.radians([200, 200, 260, 360, 360, 450]) / 0.377
    expected = np.minimum(limit, np.maximum(-dq / 0.004, -limit))  # Eq. (67)
    np.testing.assert_allclose(u, expected, atol=1e-9)
    assert (braking["reason"] != "").all()


def test_same_bytes_with_other_chunks_and_threads(tmp_path: Path) -> None:
    first = _short("report", replay.demo_log(), tmp_path / "a")
    again = _short("report", replay.demo_log(), tmp_path / "b", chunk_ticks=61)
    one = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    arguments = ["--start", "8", "--end", "11", "--chunk-ticks", "1000", "--out", str(tmp_path / "c")]
    command = [sys.executable, "-m", "hrcreplay", "report", str(replay.demo_log()), *arguments]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, **one})
    digests = _meta(first)["outputs"]
    assert len(digests) > 15
    assert _meta(again)["outputs"] == digests
    assert _meta(tmp_path / "c")["outputs"] == digests


def test_a_stage_takes_over_an_earlier_run_or_says_why_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = _short("plan", replay.demo_log(), tmp_path / "whole")
    fused = _short("fuse", replay.demo_log(), tmp_path / "fused")
    planned = replay.run("plan", fused, out=tmp_path / "planned")
    assert tells(capsys.readouterr().err.splitlines(), "fuse", "taken over", str(fused))
    assert _meta(planned)["outputs"] == _meta(whole)["outputs"]
    assert _meta(planned)["counts"] == _meta(whole)["counts"]
    other = replay.run("plan", planned, out=tmp_path / "other", overrides=("plan.clearance_m=0.1",))
    said = capsys.readouterr().err.splitlines()
    assert tells(said, "fuse", "taken over", str(planned))
    assert tells(said, "plan", "settings plan", str(planned), "computed again")
    mine, theirs = _meta(other)["outputs"], _meta(planned)["outputs"]
    assert mine["state.parquet"] == theirs["state.parquet"]
    assert mine["motion.parquet"] != theirs["motion.parquet"]


def test_smooth_comes_nearer_to_the_truth_than_the_filter(tmp_path: Path) -> None:
    folder = _short("fuse", replay.demo_log(), tmp_path / "s", smooth=True)
    run = run_folder.read(folder)
    assert run.truth is not None
    assert run.state is not None
    smooth = pq.read_table(folder / "smooth.parquet").to_pandas()
    at = np.searchsorted(run.state["t_ns"], run.truth["t_ns"])
    inside = at < len(run.state)
    joints = list(JOINTS[4:])

    def error(table: Any) -> float:
        apart = table[joints].to_numpy()[at[inside]] - run.truth[joints].to_numpy()[inside]  # type: ignore[index]
        return float(np.nanmedian(np.abs((apart + np.pi) % (2 * np.pi) - np.pi)))

    assert error(smooth) < error(run.state)


def test_what_the_volumes_hold_is_the_person(demo: Run) -> None:
    """The wrist, where cameras show it, lies in the hull of its own lower arm; the fused skeleton's in its volume."""
    assert demo.state is not None
    assert demo.occupancy is not None
    arm = demo.occupancy[demo.occupancy["limb"] == "LRA"].iloc[::50]
    state = frame_of(demo.state).set_index("t_ns")
    for t, vertices, radius in zip(arm["t_ns"], arm["vertices"], arm["radius_m"], strict=True):
        row = state.loc[t]
        wrist = skeleton(row[list(JOINTS)].to_numpy(dtype=float)[None], row[list(LENGTHS)].to_numpy(dtype=float)[None])[
            0, 10
        ]
        corners = np.asarray(vertices, dtype=float).reshape(-1, 3)
        directions = np.random.default_rng(0).normal(size=(200, 3))
        far = (directions @ corners.T).max(axis=1)
        shown = row[[f"point_wrist_r_{axis}" for axis in "xyz"]].to_numpy(dtype=float)
        assert (directions @ shown <= far + 1e-9).all()
        assert (directions @ wrist <= far + radius * np.linalg.norm(directions, axis=1)).all()


def test_the_size_of_a_volume_is_what_of_it_is_above_the_floor(demo: Run) -> None:
    """Against random points around the stored hull; the other limbs are above the floor and lose nothing."""
    assert demo.occupancy is not None
    rng = np.random.default_rng(9)
    for _, row in demo.occupancy[demo.occupancy["limb"] == "LEGS"].iloc[::200].iterrows():
        solid = InflatedHull.around(np.asarray(row["vertices"]).reshape(-1, 3), row["radius_m"])
        low, high = solid.vertices_m.min(axis=0) - solid.radius_m, solid.vertices_m.max(axis=0) + solid.radius_m
        assert low[2] < -0.1
        low[2] = 0.0
        share = (solid.distances_m(rng.uniform(low, high, size=(20_000, 3))) <= solid.radius_m).mean()
        assert row["volume_m3"] == pytest.approx(share * np.prod(high - low), rel=0.03)
        assert row["volume_m3"] < 0.95 * solid.volume_m3()
    row = demo.occupancy[demo.occupancy["limb"] == "HD"].iloc[0]
    head = ConvexHull(_grown(np.asarray(row["vertices"]).reshape(-1, 3), row["radius_m"]))
    assert row["volume_m3"] == pytest.approx(head.volume, rel=0.05)


def _grown(vertices: Floats, radius: float) -> Floats:
    unit = np.random.default_rng(2).normal(size=(400, 3))
    return (vertices[:, None] + radius * unit / np.linalg.norm(unit, axis=1, keepdims=True)).reshape(-1, 3)


def test_nothing_of_a_span_outside_the_log_is_replayed(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=facts("--start 70", "60.0 s")):
        replay.run("fuse", replay.demo_log(), out=tmp_path / "x", start_s=70.0)
    assert list(tmp_path.iterdir()) == []


def test_a_tick_uses_no_frame_that_was_still_on_the_wire(tmp_path: Path) -> None:
    """Cutting the log right after a tick changes nothing of what the ticks before knew."""
    log = open_log(replay.demo_log())
    assert log.header.end_ns - log.header.start_ns == 60_000_000_000
    short = run_folder.read(replay.run("fuse", replay.demo_log(), out=tmp_path / "short", end_s=3.0))
    longer = run_folder.read(replay.run("fuse", replay.demo_log(), out=tmp_path / "longer", end_s=4.0))
    assert short.state is not None
    assert longer.state is not None
    assert frame_of(short.state).equals(longer.state.iloc[: len(short.state)])


def test_a_thousand_ticks_of_the_demo_are_those_of_another_solver(printed: Run, printed_volumes: SweptVolumes) -> None:
    """With all rows, by daqp: every stop with a person in sight, the nearest ticks, and others evenly."""
    assert printed.motion is not None
    assert printed.T_world_base is not None
    task = open_log(replay.demo_log()).header.task
    assert task is not None
    robot = irb140(printed.T_world_base, stop_s=0.377)
    path, volumes = plan_programme(parse_task(task), robot), printed_volumes
    q, dq, u = (printed.motion[[f"{kind}{i}" for i in range(1, 7)]].to_numpy() for kind in ("q", "dq", "u"))
    s, status = printed.motion["programme_s"].to_numpy(), printed.motion["status"].to_numpy()
    known = np.flatnonzero(printed.motion["distance_m"].notna().to_numpy()[:-1])
    stops = known[status[known] == "braking"]
    nearest = known[np.argsort(printed.motion["distance_m"].to_numpy()[known], kind="stable")[:350]]
    ticks = np.unique(np.concatenate([stops[:300], nearest, known[:: len(known) // 500]]))
    assert len(ticks) >= 1000
    assert (status[ticks] == "braking").sum() >= 200
    for k in ticks.tolist():
        ahead = path.sample(s[k + 1])
        rate = (s[k + 1] - s[k]) / 0.004
        made = asked(robot, RobotState(q[k], dq[k]), ahead.T_world_tcp, rate * ahead.twist, obstacles(volumes, k))
        expected, feasible = dense(robot, made)
        assert (status[k] != "braking") == feasible
        if feasible:
            np.testing.assert_allclose(dq[k] + 0.004 * u[k], expected, atol=1e-6)
