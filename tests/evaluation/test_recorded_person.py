"""Everybody in a recording: whole runs on logs with a second person, and one coverage for report, compare and audit."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from hrcreplay.commands import replay
from hrcreplay.commands.report import summary
from hrcreplay.evaluation import recording
from hrcreplay.evaluation.judging import read_recorded_people
from hrcreplay.evaluation.recorded_person import CameraPoints, SmoothedPeople, at_instants
from hrcreplay.geometry.distances import segment_distance
from hrcreplay.logs.reader import open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.records import POINTS, CameraFrames, Floats
from hrcreplay.robot.model import irb140
from hrcreplay.store.run_folder import RunWriter
from tests.coverage_figures import assert_one_coverage
from tests.facts import tells
from tests.undrawn import undrawn

SPAN = {"start_s": 8.0, "end_s": 12.0}
ONE = "logs.people=nearest"
BLIND = ("plan.method=none", "plan.baselines=[]")
#: Where the bystander stands beside the worker in the world: nearer to both cameras, out of the robot's reach [m].
ASIDE_M = np.array([-2.4, 0.0, 0.0])


def rewritten(
    path: Path, *, bystander: bool = False, legs: bool = True, truth: bool = False, apart_m: float = 0.0
) -> Path:
    """The demo log anew, by default without ground truth.

    With a second person, with cameras that see no legs, or with a second camera that shows forearms nearer to the robot
    than the first does.
    """
    log = open_log(replay.demo_log())
    first_ns = log.header.start_ns
    frames = CameraFrames.join(list(log.frames(first_ns + 7_900_000_000, first_ns + 12_100_000_000)))
    if not legs:
        hidden = [POINTS.index(f"{point}_{side}") for point in ("knee", "ankle", "foot") for side in "lr"]
        points, confidence = frames.points_m.copy(), frames.confidence.copy()
        points[:, hidden], confidence[:, hidden] = np.nan, 0.0
        frames = replace(frames, points_m=points, confidence=confidence)
    if apart_m:
        points = frames.points_m.copy()
        second = np.flatnonzero(frames.camera == 1)
        nearer = log.header.T_world_camera[frames.cameras[1]][:3, :3].T @ [-apart_m, 0.0, 0.0]
        for name in ("wrist_l", "hand_l", "wrist_r", "hand_r"):
            points[second, POINTS.index(name)] += nearer
        frames = replace(frames, points_m=points)
    if bystander:
        T = np.array([log.header.T_world_camera[camera] for camera in frames.cameras])[frames.camera]
        aside = np.einsum("nji,j->ni", T[:, :3, :3], ASIDE_M)
        others = replace(frames, points_m=frames.points_m + aside[:, None], body=frames.body + 50)
        order = np.argsort(np.concatenate([others.arrival_ns, frames.arrival_ns]), kind="stable")
        frames = CameraFrames.join([others, frames]).rows(order)
    with LogWriter(path) as writer:
        for camera, pose in log.header.T_world_camera.items():
            writer.camera(camera, pose)
        assert log.header.task is not None
        assert log.header.T_world_base is not None
        writer.task(log.header.task)
        writer.base(log.header.T_world_base)
        writer.frames(frames)
        if truth:
            for part in log.truth():
                rows = (part.t_ns >= first_ns + 7_900_000_000) & (part.t_ns <= first_ns + 12_100_000_000)
                writer.truth(part.t_ns[rows], part.points_m[rows])
    return path


def reported(log: Path, out: Path, *overrides: str) -> tuple[dict[str, object], pd.DataFrame, pd.DataFrame]:
    """Metrics, contact and motion of a report without figures."""
    with undrawn():
        replay.run("report", log, out=out, overrides=overrides)
    metrics = {name: metric["value"] for name, metric in json.loads((out / "metrics.json").read_text()).items()}
    return metrics, *(pq.read_table(out / f"{name}.parquet").to_pandas() for name in ("contact", "motion"))


def nearest_by_hand(log: Path, motion: pd.DataFrame, *, bodies: range) -> dict[int, float]:
    """Tick -> smallest distance between the robot's links and the bodies' upper limbs, at ticks that meet a frame."""
    header = open_log(log).header
    robot = irb140(header.T_world_base, stop_s=0.377) if header.T_world_base is not None else None
    assert robot is not None
    t_ns = motion["t_ns"].to_numpy()
    found: dict[int, float] = {}
    for frames in open_log(log).frames():
        for i in range(len(frames)):
            tick = int(np.argmin(np.abs(t_ns - frames.capture_ns[i])))
            if frames.body[i] not in bodies or abs(int(t_ns[tick]) - int(frames.capture_ns[i])) > 300_000:
                continue
            T = header.T_world_camera[frames.cameras[frames.camera[i]]]
            points = frames.points_m[i] @ T[:3, :3].T + T[:3, 3]
            q = motion[[f"q{k}" for k in range(1, 7)]].to_numpy(dtype=float)[tick]
            found[tick] = min(found.get(tick, np.inf), _links_to_arms(robot.ends_m(q), robot.segments, points))
    return found


def _links_to_arms(ends_m: Floats, segments: object, points: Floats) -> float:
    """Smallest distance of links and forearms with hands of 0.19 m, a radius of 0.07 m."""
    least = np.inf
    for side in "lr":
        elbow, wrist = (points[POINTS.index(f"{name}_{side}")] for name in ("elbow", "wrist"))
        if not np.isfinite(elbow + wrist).all():
            continue
        hand = wrist + 0.19 * (wrist - elbow) / np.linalg.norm(wrist - elbow)
        for segment, link in zip(segments, ends_m, strict=True):  # type: ignore[call-overload]
            gap, _, _ = segment_distance(np.ascontiguousarray(link), np.array([elbow, hand]))
            least = min(least, gap - segment.radius_m - 0.07)
    return float(least)


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rewritten(tmp_path_factory.mktemp("beside") / "beside.mcap", bystander=True)


def test_a_worker_whom_a_bystander_hides_is_touched_all_the_same(beside: Path, tmp_path: Path) -> None:
    """The bystander is nearer to the cameras, so the robot's person is that one: the worker is another body."""
    metrics, contact, motion = reported(beside, tmp_path / "run", *BLIND, ONE)
    alone, _, _ = reported(rewritten(tmp_path / "alone.mcap"), tmp_path / "alone", *BLIND)
    frames = sum(len(part) for part in open_log(beside).frames())
    assert metrics["others_frames"] == pytest.approx(frames / 2, abs=3)
    assert metrics["plan_touch_person_ticks"] == 0
    assert metrics["plan_touch_other_ticks"] == metrics["plan_touch_moving_ticks"]
    # the smoothed person counts beside the cameras' points where the worker is the person
    assert 20 < int(str(metrics["plan_touch_moving_ticks"])) <= int(str(alone["plan_touch_person_ticks"]))
    by_hand = nearest_by_hand(beside, motion, bodies=range(50))
    assert len(by_hand) > 10
    for tick, least_m in by_hand.items():
        if least_m <= 0.2:
            assert contact["other_m"].iloc[tick] <= least_m + 0.02
    said = summary(tmp_path / "run")[-1]
    assert tells(
        said, "another body", f"{metrics['plan_touch_other_ticks']} ticks", f"{metrics['others_frames']} frames"
    )


def test_a_robot_that_heeds_all_people_has_no_other_bodies(beside: Path, tmp_path: Path) -> None:
    metrics, contact, motion = reported(beside, tmp_path / "run", *BLIND)
    assert metrics["people_tracked"] == 2
    assert metrics["others_frames"] == metrics["plan_touch_other_ticks"] == 0
    assert 20 < int(str(metrics["plan_touch_person_ticks"])) == metrics["plan_touch_moving_ticks"]
    by_hand = nearest_by_hand(beside, motion, bodies=range(50))
    for tick, least_m in by_hand.items():
        if least_m <= 0.2:
            assert contact["person_m"].iloc[tick] <= least_m + 0.02


def test_with_ground_truth_whoever_stands_elsewhere_is_another_body(tmp_path: Path) -> None:
    log = rewritten(tmp_path / "both.mcap", bystander=True, truth=True)
    metrics, contact, _ = reported(log, tmp_path / "run", *BLIND, ONE)
    assert metrics["contact_person"] == "ground truth"
    assert int(str(metrics["plan_touch_person_ticks"])) > 20
    assert metrics["plan_touch_other_ticks"] == 0
    assert contact["other_m"].notna().mean() > 0.9  # the chosen bystander
    assert contact["other_m"].min() > 0.3


def test_legs_that_no_camera_shows_are_told_and_those_it_shows_count(tmp_path: Path) -> None:
    shown, _, _ = reported(rewritten(tmp_path / "legs.mcap"), tmp_path / "legs", *BLIND)
    hidden, _, _ = reported(rewritten(tmp_path / "none.mcap", legs=False), tmp_path / "none", *BLIND)
    assert float(str(shown["contact_legs_known_share"])) > 0.9
    assert hidden["contact_legs_known_share"] == 0.0
    assert "the legs (never seen)" in summary(tmp_path / "none")[-1]
    assert "the legs (never seen)" not in summary(tmp_path / "legs")[-1]


def test_of_two_cameras_that_disagree_both_count(tmp_path: Path) -> None:
    """Contact and coverage are asked of what each camera shows, not of their mean."""
    log = rewritten(tmp_path / "apart.mcap", apart_m=0.18)
    metrics, contact, motion = reported(log, tmp_path / "run", "plan.baselines=[]")
    by_hand = nearest_by_hand(log, motion, bodies=range(50))
    near = {tick: least_m for tick, least_m in by_hand.items() if least_m <= 0.3}
    assert len(near) > 5
    for tick, least_m in near.items():
        assert contact["person_m"].iloc[tick] <= least_m + 0.02
    assert contact["source"].isin(["xtion"]).sum() > 100  # it shows the forearms nearest
    together, _, _ = reported(rewritten(tmp_path / "together.mcap"), tmp_path / "together", "plan.baselines=[]")
    shares = [float(str(found["volumes_full_held_share"])) for found in (metrics, together)]
    assert shares[0] <= shares[1]


def test_report_compare_and_audit_have_one_coverage(tmp_path: Path) -> None:
    """On a log without ground truth, until the braking time, to the last digit."""
    log = rewritten(tmp_path / "log.mcap")
    reported(log, tmp_path / "report")
    assert assert_one_coverage(tmp_path / "report", tmp_path) > 40


def test_the_points_of_a_camera_are_its_rows_with_the_neck_between_the_shoulders() -> None:
    all_m = np.random.default_rng(3).normal(size=(30, len(POINTS), 3))
    neck, right, left = (POINTS.index(name) for name in ("neck", "shoulder_r", "shoulder_l"))
    all_m[5, left], all_m[6, neck] = np.nan, np.nan
    before, mine = all_m.copy(), np.array([1, 5, 6, 20])
    points = CameraPoints(all_m, mine)
    assert points.shape == (4, len(POINTS), 3)
    for rows in (slice(None), slice(1, 3), np.array([3, 0, 0])):
        for found, row in zip(points[rows], mine[rows].tolist(), strict=True):
            expected = before[row].copy()
            if row != 5:  # a shoulder is not shown there
                expected[neck] = 0.5 * (before[row, left] + before[row, right])
            np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(all_m, before)


@pytest.mark.parametrize("truth", [False, True])
def test_people_are_the_same_from_files_and_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, truth: bool
) -> None:
    """Two people, in batches that end within the recording; the files hold what is large."""
    monkeypatch.setattr(recording, "_BATCH", 37)
    ran = replay.run("fuse", rewritten(tmp_path / "log.mcap", bystander=True, truth=truth), out=tmp_path / "run")
    run_config, kept = resolve("report", ran), tmp_path / "kept"
    log = open_log(run_config.log, run_config.settings.logs)
    kept.mkdir()
    writer = RunWriter(ran)
    monkeypatch.setattr(RunWriter, "partial", property(lambda writer: writer.folder))
    plain, stored = (
        read_recorded_people(run_config, log, writer),
        read_recorded_people(run_config, log, writer, folder=kept),
    )
    assert [one.number for one in plain.people] == [one.number for one in stored.people] == [1, 2]
    assert plain.names == stored.names
    for one, other in zip(plain.people, stored.people, strict=True):
        assert one.source == other.source
        np.testing.assert_array_equal(one.t_ns, other.t_ns)
        np.testing.assert_array_equal(one.points_m[:], other.points_m[:])
    for track, again in zip(plain.tracks, stored.tracks, strict=True):
        np.testing.assert_array_equal(track.t_ns, again.t_ns)
        np.testing.assert_array_equal(track.points_m[:], again.points_m[:])
    if truth:
        (true,) = (one for one in plain.people if one.source == "ground truth")
        (other,) = (one for one in plain.people if one.source != "ground truth")
        apart = np.linalg.norm(at_instants(true.t_ns, true.points_m, other.t_ns, 0.1) - other.points_m[:], axis=2)
        assert np.nanmedian(apart) > 2.0, "the ground truth is that of the worker, not of the bystander"
    in_files = sum(path.stat().st_size for path in kept.iterdir())
    assert in_files >= sum(8 * one.points_m[:].size for one in stored.people)
    assert len(pickle.dumps(stored)) < 0.2 * len(pickle.dumps(plain))


def test_a_report_leaves_no_file_of_the_people(beside: Path, tmp_path: Path) -> None:
    reported(beside, tmp_path / "run", *BLIND)
    assert [path.name for path in (tmp_path / "run").iterdir() if path.name.startswith(".")] == []


def test_a_smoothed_person_has_the_rows_of_its_number() -> None:
    rng, person = np.random.default_rng(6), np.array([1, 2, 2, 1, 3, 2])
    t_ns, used = np.array([0, 0, 4, 4, 4, 8]), np.array([True, False, True, True, False, True])
    people = SmoothedPeople(t_ns, rng.normal(size=(6, 13)), rng.normal(size=(6, 7)), used, person)
    for number in (1, 2, 3):
        one, mine = people.of_person(number), person == number
        assert len(one) == mine.sum()
        assert one.person is None
        for got, want in ((one.t_ns, t_ns), (one.p[:], people.p[:]), (one.lengths_m[:], people.lengths_m[:])):
            np.testing.assert_array_equal(got, want[mine])
        assert one.used.tolist() == used[mine].tolist()
