"""The audit from log to page, and its parts where a whole log would hide a mistake."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hrcreplay import audit, recorded, replay, runs
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.follow import hold, joints_inside, travel, window
from hrcreplay.human import peers, reach
from hrcreplay.human.angles import PointNoise
from hrcreplay.human.fusion import FusionSettings
from hrcreplay.human.model import skeleton
from hrcreplay.limits import load_limits
from hrcreplay.logs.writer import LogWriter
from hrcreplay.pipeline import Eyes
from hrcreplay.recorded import Recording
from hrcreplay.records import (
    JOINTS,
    LIMBS,
    POINTS,
    Bools,
    CameraFrames,
    Floats,
    HumanStates,
    Measurements,
    SweptVolumes,
)
from tests.human.people import LENGTHS_M, states
from tests.realdata import data_path
from tests.test_recordings import SARA, SARA_CELL

START_S, END_S = 8.0, 14.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return audit.run([replay.demo_log()], out=tmp_path_factory.mktemp("audit") / "run", start_s=START_S, end_s=END_S)


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
    assert set(table["method"]) == {*reach.METHODS, *peers.PEERS}
    assert set(table["limb"]) >= set(LIMBS)
    assert found["logs"][0]["recorded_future"] == "ground truth"
    assert found["total"]["ticks"] == 140  # (6 s - 0.377 s) at 25 Hz; the first tick is before the first frame
    page = (folder / "report.html").read_text()
    assert not re.search(r"\b(nan|inf|None)\b", re.sub(r"base64,[^\"]*", "", page))
    assert "every limb" in page


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
    six = table[table["limb"].isin(LIMBS)]
    whole = six.groupby(["method", "t_ns"])["escape_m"].max().groupby("method").agg(lambda worst: (worst == 0).mean())
    for method, share in whole.items():
        figures = found["total"]["methods"][method]["all"]
        assert figures["covered_share"]["value"] == pytest.approx(share)
        assert figures["covered_share"]["low"] <= share <= figures["covered_share"]["high"]
        assert figures["union_m3"]["value"] < figures["sum_m3"]["value"]


def test_what_must_hold_between_methods(found: dict[str, Any]) -> None:
    methods = found["total"]["methods"]
    share = {name: parts["all"]["covered_share"]["value"] for name, parts in methods.items()}
    room = {name: parts["all"]["union_m3"]["value"] for name, parts in methods.items()}
    assert share["paper"] < 0.7  # Table 1 is far below what people do
    assert share["v2_a50"] == share["iso_13855"] == 1.0
    assert share["constant_velocity"] < share["positions"]
    assert room["constant_velocity"] < room["paper"] < room["positions"] < room["v2_a50"]
    for method, curve in found["total"]["curve"].items():
        shares = [point["covered_share"]["value"] for point in curve]
        assert all(b >= a - 0.1 for a, b in pairwise(shares)), method
    standard = next(point for point in found["total"]["curve"]["paper"] if point["factor"] == 1.0)
    assert standard["covered_share"]["value"] == pytest.approx(share["paper"])


def test_escapes_name_their_time_and_limb(folder: Path, found: dict[str, Any]) -> None:
    table = pd.read_parquet(folder / "audit.parquet")
    rows = table[(table["method"] == "paper") & (table["escape_m"] > 0)]
    listed = found["logs"][0]["escapes"]["paper"]
    assert sum(e["ticks"] for e in listed) == len(rows)
    deepest = max(listed, key=lambda e: e["deepest_m"])
    worst = rows.sort_values("escape_m").iloc[-1]
    assert deepest["limb"] == worst["limb"]
    start_ns = table["t_ns"].min()
    assert deepest["deepest_at_s"] == pytest.approx((worst["t_ns"] - start_ns) * 1e-9, abs=0.05)


def test_same_bytes_again_and_logs_together(folder: Path, found: dict[str, Any], tmp_path: Path) -> None:
    again = audit.run([replay.demo_log()], out=tmp_path / "again", start_s=START_S, end_s=END_S)
    assert runs.read_meta(again)["outputs"] == runs.read_meta(folder)["outputs"]
    fused = replay.run("fuse", replay.demo_log(), out=tmp_path / "fused", start_s=20.0, end_s=22.0)
    both = audit.run([folder, fused], out=tmp_path / "both")
    together = json.loads((both / "audit.json").read_text())
    assert [log["ticks"] for log in together["logs"]] == [140, 40]  # each with the span of its own run
    assert [log["log"] for log in together["logs"]] == ["demo (1)", "demo (2)"]
    first = together["logs"][0]["methods"]["paper"]["LRA"]["covered_share"]["value"]
    assert first == found["total"]["methods"]["paper"]["LRA"]["covered_share"]["value"]
    second = together["logs"][1]["methods"]["paper"]["LRA"]["covered_share"]["value"]
    whole = together["total"]["methods"]["paper"]["LRA"]["covered_share"]["value"]
    assert whole == pytest.approx((140 * first + 40 * second) / 180)


def test_a_log_shorter_than_the_horizon_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"demo\.mcap: found 0\.30 s; an audit needs more than the horizon of 0\.377 s"):
        audit.run([replay.demo_log()], out=tmp_path / "x", start_s=8.0, end_s=8.3)
    with pytest.raises(SettingsError, match="exists already"):
        audit.run([replay.demo_log()], out=tmp_path, start_s=8.0, end_s=8.3)
    assert list(tmp_path.iterdir()) == []


def _frames(points: Floats, rate_hz: float = 30.0) -> CameraFrames:
    n = len(points)
    t_ns = 1_000_000_000 + np.round(np.arange(n) / rate_hz * 1e9).astype(np.int64)
    return CameraFrames(
        capture_ns=t_ns,
        arrival_ns=t_ns + 5_000_000,
        camera=np.zeros(n, np.int64),
        body=np.zeros(n, np.int64),
        points_m=points,
        confidence=np.where(np.isfinite(points).all(axis=2), 1.0, 0.0),
        cameras=("cam",),
    )


def _standing(n: int) -> Floats:
    p = np.zeros((n, 12))
    p[:, [4, 8]], p[:, [7, 11]] = 0.2, 2.5
    return skeleton(p, np.tile(LENGTHS_M, (n, 1)))


def test_a_person_who_stands_still_is_said_to(tmp_path: Path) -> None:
    path = tmp_path / "still.mcap"
    with LogWriter(path) as writer:
        writer.camera("cam", np.eye(4))
        writer.frames(_frames(_standing(60)))
    found = json.loads((audit.run([path], out=tmp_path / "run") / "audit.json").read_text())
    notes = found["logs"][0]["notes"]
    assert "no arm motion: the shares of the arms say nothing of a person at work" in notes
    assert any(note.startswith("hardly moved") and "ar1 (0 deg)" in note for note in notes)
    assert any("the intervals are wide" in note for note in notes)
    assert found["logs"][0]["recorded_future"] == "camera points"
    share = found["total"]["methods"]["paper"]["all"]["covered_share"]
    assert share["value"] == 1.0
    assert share["low"] < 0.7  # 1.6 s are no proof


def _seen(points: Floats) -> Measurements:
    frames = _frames(points)
    return Measurements(
        capture_ns=frames.capture_ns,
        arrival_ns=frames.arrival_ns,
        camera=frames.camera,
        angles=np.zeros((len(points), 12)),
        angles_std=np.zeros((len(points), 12)),
        lengths_m=np.zeros((len(points), 8)),
        lengths_std_m=np.zeros((len(points), 8)),
        points_m=points,
        confidence=frames.confidence,
        cameras=("cam",),
    )


def _eyes() -> Eyes:
    return Eyes(
        T_world_camera=np.eye(4)[None],
        clock_offset_ns=np.zeros(1, np.int64),
        noise=PointNoise(),
        filter=FusionSettings(),
        limits=load_limits("human"),
        person_jump_m=0.8,
        person_memory_s=2.0,
    )


def test_a_teleport_is_thrown_out_and_a_squat_is_not() -> None:
    points = _standing(4)
    wrist, pelvis = POINTS.index("wrist_l"), POINTS.index("pelvis")
    points[1, wrist] += [0.6, 0.0, 0.3]  # the marker jumps
    points[2, :, 2] -= 0.4  # the whole person goes down, which the model cannot
    points[3, pelvis] += [0.0, 1.0, 0.0]
    best = states(np.zeros((4, 12)), np.zeros((4, 12)))
    p = np.zeros((4, 12))
    p[:, [4, 8]], p[:, [7, 11]] = 0.2, 2.5
    best = replace(best, p=p, t_ns=_frames(points).capture_ns)
    believed, counts = recorded._believed(_seen(points), best, _eyes())
    gone: Bools = np.asarray(np.isfinite(points).all(axis=2) & np.isnan(believed).any(axis=2))
    assert [POINTS[k] for k in np.flatnonzero(gone[1])] == ["wrist_l"]
    assert [POINTS[k] for k in np.flatnonzero(gone[3])] == ["pelvis"]
    assert not gone[[0, 2]].any()
    assert counts == Counter(audit_rejected_points_cam=2, audit_rejected_frames_cam=2)


def _recording(points: Floats, joints: Floats, people: HumanStates) -> Recording:
    t_ns = people.t_ns[0] + np.arange(len(points)) * 100_000_000
    return Recording(people, t_ns, points, t_ns, joints, recorded.TRUTH, {})


def _balls(people: HumanStates, radius_m: float) -> SweptVolumes:
    """A ball at the world's origin for every limb."""
    n = len(people) * len(LIMBS)
    radius = np.full((len(people), len(LIMBS)), radius_m)
    return SweptVolumes(people.t_ns, np.arange(n + 1), np.zeros((n, 3)), radius, LIMBS, "balls")


def test_the_future_is_after_the_tick_and_within_the_horizon() -> None:
    """A point that moves 1 m a sample along x, sampled every 0.1 s."""
    people = states(np.zeros((1, 12)), np.zeros((1, 12)))
    points = np.zeros((10, len(POINTS), 3))
    points[:, :, 0] = np.arange(10)[:, None]
    future = window(_recording(points, np.zeros((10, 12)), people), np.array([0]), 0.4)
    outcome = hold(_balls(people, 1.5), future, np.array([True]))
    np.testing.assert_allclose(outcome.beyond_m, 4.0)  # the sample at the horizon counts, the next does not
    np.testing.assert_allclose(outcome.escape_m(), 2.5)
    assert outcome.union_m3[0] == pytest.approx(4.0 / 3.0 * np.pi * 1.5**3, rel=0.05)
    points[4, POINTS.index("wrist_l")] = np.nan  # not seen near the end: the lower arm cannot be audited
    future = window(_recording(points, np.zeros((10, 12)), people), np.array([0]), 0.4)
    outcome = hold(_balls(people, 1.5), future, np.array([False]))
    assert np.isnan(outcome.beyond_m[0]).tolist() == [limb == "LLA" for limb in LIMBS]
    assert outcome.worst_m()[0] == pytest.approx(2.5)
    assert np.isnan(outcome.union_m3[0])


def test_a_joint_stays_inside_whatever_its_name_and_turn() -> None:
    people = states(np.zeros((2, 12)), np.zeros((2, 12)))
    people = replace(people, t_ns=np.array([0, 300_000_000]))
    joints = np.zeros((8, 12))
    joints[:, 2] = 2.0 * np.pi + 0.01 * np.arange(8)  # heading, a turn later
    joints[:, 4] = 0.02 * np.arange(8)
    joints[6:, 5] = np.nan
    low, high = np.full((2, 12), -0.05), np.full((2, 12), 0.05)
    recording = _recording(np.zeros((8, len(POINTS), 3)), joints, people)
    inside = joints_inside(recording, people, reach.Reach(people.t_ns, low, high), 0.2)
    assert inside[0, JOINTS.index("theta")] == 1.0  # 0.01, 0.02
    assert inside[1, JOINTS.index("theta")] == 1.0  # 0.04, 0.05
    assert inside[0, 4] == 1.0  # 0.02, 0.04
    assert inside[1, 4] == 0.0  # 0.08, 0.10
    late = joints_inside(
        recording, replace(people, t_ns=people.t_ns + 600_000_000), reach.Reach(people.t_ns, low, high), 0.2
    )
    assert late[0, 4] == 0.0
    assert np.isnan(late[1]).all()  # the recording is over
    assert travel(joints[:6])[4] == pytest.approx(0.09)


@pytest.mark.parametrize("name", ["exp_appraoching", "exp_box"])
def test_teleports_of_a_real_bag_do_not_count_as_motion(tmp_path: Path, name: str) -> None:
    settings, cell = tmp_path / "s.toml", tmp_path / "cell.toml"
    settings.write_text(SARA)
    cell.write_text(SARA_CELL)
    bag = data_path(f"sara_human_robot_bags/{name}.bag")
    folder = audit.run([bag], out=tmp_path / "run", config=settings, cell_file=cell, end_s=6.0)
    found = json.loads((folder / "audit.json").read_text())
    log = found["logs"][0]
    assert log["recorded_future"] == "camera points"
    assert log["counts"]["audit_rejected_frames_mocap"] >= 0
    assert found["total"]["methods"]["v2_a50"]["all"]["covered_share"]["value"] > 0.9
    for method in reach.METHODS:
        assert all(e["deepest_m"] < 1.0 for e in log["escapes"][method])
    assert found["total"]["methods"]["paper"]["all"]["escape_max_m"] < 1.0
