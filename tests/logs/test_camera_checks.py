"""What cameras and bodies say of themselves: floor, height, bones, left and right, and how far two cameras differ."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.commands import inputs, replay
from hrcreplay.logs.camera_checks import LIMB_POINTS, CameraChecks
from hrcreplay.logs.info import Summary, lines, summarize
from hrcreplay.logs.reader import open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import BODY, MIRROR, POINTS, CameraFrames, Floats, SkeletonTrack
from hrcreplay.store import run_folder
from tests.facts import tells
from tests.logs import own
from tests.realdata import data_path
from tests.reobserve import walker
from tests.test_recordings import IMPORTS, SARA, SARA_CELL

#: Two cameras 4 m from the walker, on two sides: T_world_camera, x right, y down, z ahead.
POSES = {
    "left": np.array([[0.0, 0, 1, -4], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]]),
    "right": np.array([[1.0, 0, 0, 0], [0, 0, 1, -4], [0, -1, 0, 1.8], [0, 0, 0, 1]]),
}
Spoil = Callable[[Floats], Floats]


def _same(points: Floats) -> Floats:
    return points


def at(*names: str) -> list[int]:
    return [POINTS.index(name) for name in names]


def seen(camera: str, spoil: Spoil = _same, period_ns: int = 33_333_333, seconds: float = 6.0) -> CameraFrames:
    """The walker as one of POSES sees it; ``spoil`` changes the points (n, 20, 3) in the world."""
    person = walker(seconds, 300.0)
    t_ns = np.arange(person.t_ns[0], person.t_ns[-1], period_ns)
    rows = np.searchsorted(person.t_ns, t_ns)
    T = np.linalg.inv(POSES[camera])
    points = spoil(person.points_m[rows].copy()) @ T[:3, :3].T + T[:3, 3]
    points += np.random.default_rng(len(camera)).normal(0.0, 0.003, points.shape)
    capture_ns, zeros = own.BEGIN_NS + person.t_ns[rows] - person.t_ns[0], np.zeros(len(rows), dtype=np.int64)
    return CameraFrames(
        capture_ns, capture_ns + 5_000_000, zeros, zeros, points, np.ones((len(rows), 20)), (camera,)
    )  # fmt: skip


def log_of(path: Path, lift_m: float = 0.0, later_ns: int = 0, *, left: Spoil = _same, right: Spoil = _same) -> Path:
    """Both cameras; ``lift_m``: how far their poses are wrong in height; ``later_ns``: clock of the right one."""
    one, other = seen("left", left), seen("right", right, 40_000_000)
    other = replace(other, capture_ns=other.capture_ns + later_ns)
    with LogWriter(path) as writer:
        for name, T in POSES.items():
            wrong = T.copy()
            wrong[2, 3] += lift_m
            writer.camera(name, wrong)
        for frames in (one, other):
            writer.frames(frames)
    return path


def found(tmp_path: Path, lift_m: float = 0.0, *, left: Spoil = _same, right: Spoil = _same) -> Summary:
    return summarize(open_log(log_of(tmp_path / "a.mcap", lift_m, left=left, right=right)))


def legs_away(points: Floats) -> Floats:
    points[:, at(*LIMB_POINTS["LEGS"])] += [0.24, 0.0, 0.32]  # 0.40 m
    return points


def exchanged(points: Floats) -> Floats:
    return points[:, list(MIRROR)]


def short_forearm(points: Floats) -> Floats:
    """A third of it, and of the hand beyond."""
    elbow = points[:, at("elbow_r")]
    points[:, at("wrist_r", "hand_r")] = elbow + (points[:, at("wrist_r", "hand_r")] - elbow) / 3.0
    return points


def short_trunk(points: Floats) -> Floats:
    points[:, at("pelvis")] += [0.0, 0.0, 0.13]  # 0.45 - 0.13 m
    return points


def long_arm(points: Floats) -> Floats:
    points[:, at("elbow_l")] += 0.35 * (points[:, at("elbow_l")] - points[:, at("shoulder_l")])
    return points


def no_feet(points: Floats) -> Floats:
    points[:, at("foot_l", "foot_r")] = np.nan
    return points


def crouched(points: Floats) -> Floats:
    """Knees 10 cm ahead of the line from hip to ankle."""
    ahead = points[:, POINTS.index("foot_l")] - points[:, POINTS.index("ankle_l")]
    ahead[:, 2] = 0.0
    points[:, at("knee_l", "knee_r")] += 0.15 * (ahead / np.linalg.norm(ahead, axis=1, keepdims=True))[:, None]
    return no_feet(points)


def hips_exchanged(points: Floats) -> Floats:
    legs = at(*LIMB_POINTS["LEGS"])
    points[:, legs] = points[:, list(MIRROR)][:, legs]
    return points


def told(summary: Summary, *words: str) -> list[str]:
    return [note for note in summary.notes if all(word in note for word in words)]


def test_a_person_as_two_cameras_see_them_is_not_remarked(tmp_path: Path) -> None:
    summary = found(tmp_path)
    assert summary.notes == ()
    assert [(pair.a, pair.b, pair.limb) for pair in summary.agreements] == [("left", "right", limb) for limb in BODY]
    for pair in summary.agreements:
        assert pair.median_m < 0.02
        assert pair.mirrored == 0.0
    for body in summary.bodies:
        assert body.floor_m == pytest.approx(0.0, abs=0.006)  # the walker's lower foot rests at 3 cm
        assert body.head_m == pytest.approx(1.65, abs=0.01)
        assert body.bones_m == pytest.approx(1.65, abs=0.05)
    text = "\n".join(lines(summary))
    for words in ("left: lowest foot", "head 1.65 m above the floor", "left - right, legs: apart by"):
        assert words in text


def test_legs_that_one_camera_shows_elsewhere_are_told(tmp_path: Path) -> None:
    summary = found(tmp_path, right=legs_away)
    by_limb = {pair.limb: pair for pair in summary.agreements}
    assert by_limb["LEGS"].median_m == pytest.approx(0.40, abs=0.01)
    assert by_limb["LEGS"].p95_m > 0.40
    assert by_limb["LRA"].p95_m < 0.05
    (line,) = told(summary, "cameras left and right", "limb", "apart")
    assert f"legs {by_limb['LEGS'].p95_m:.2f} m" in line
    assert "arm" not in line
    assert told(summary, "camera right", "foot", "32 cm above")
    assert not told(summary, "camera left")


def test_a_camera_that_exchanges_left_and_right_is_told(tmp_path: Path) -> None:
    summary = found(tmp_path, right=exchanged)
    assert summary.agreements[0].mirrored == 1.0
    assert told(summary, "cameras left and right", "exchanged", "100 % of the frames")
    assert told(summary, "camera right", "left and right", "exchanged", "feet")
    assert not told(summary, "camera left:")


@pytest.mark.parametrize(("spoil", "exchange"), [(crouched, False), (crouched, True), (no_feet, True)])
def test_knees_tell_left_from_right_where_no_foot_is_seen(spoil: Spoil, exchange: bool, tmp_path: Path) -> None:
    summary = found(tmp_path, left=lambda points: exchanged(spoil(points)) if exchange else spoil(points))
    bent = spoil is crouched
    assert summary.cameras[0].side_cue == ("knees bend" if bent else None)
    assert bool(told(summary, "camera left", "exchanged", "knees")) == (bent and exchange)
    assert tells(lines(summary), "left and right not checked", "(left)") != bent


def test_legs_that_are_exchanged_against_the_arms_are_told(tmp_path: Path) -> None:
    summary = found(tmp_path, left=hips_exchanged)
    assert told(summary, "camera left", "shoulders' left", "hips' right")
    assert not told(summary, "camera right", "shoulders' left")


@pytest.mark.parametrize(
    ("spoil", "bone", "length_m", "low_m", "high_m"),
    # The walker's forearm is 0.24 m down and 0.05 to 0.17 m ahead, 0.26 m in the middle; the trunk 0.45 m.
    # Winter's shares of a stature, of women of 1.52 m less a quarter to men of 1.87 m and a quarter more
    [
        (short_forearm, "right forearm", 0.09, 0.146 * 1.14, (0.146 + 0.108 / 2) * 2.3375),
        (short_trunk, "trunk", 0.32, 0.288 * 1.14, 0.288 * 2.3375),
    ],
)
def test_a_bone_of_no_adult_is_told(
    spoil: Spoil, bone: str, length_m: float, low_m: float, high_m: float, tmp_path: Path
) -> None:
    summary = found(tmp_path, right=spoil)
    (line,) = told(summary, "camera right", bone)
    assert f"{length_m:.2f} m (an adult's: {low_m:.2f} to {high_m:.2f})" in line
    assert "left" not in line
    assert not told(summary, "camera left", "adult")


def test_a_wrist_in_the_middle_of_the_hand_is_not_told(tmp_path: Path) -> None:
    """As trackers after OpenNI give it, also of a tall person: 0.36 m from the elbow."""

    def in_the_hand(points: Floats) -> Floats:
        elbow, wrist = points[:, at("elbow_l", "elbow_r")], points[:, at("wrist_l", "wrist_r")]
        length_m = np.linalg.norm(wrist - elbow, axis=2, keepdims=True)
        points[:, at("wrist_l", "wrist_r")] = elbow + 0.36 / length_m * (wrist - elbow)
        points[:, at("hand_l", "hand_r")] = np.nan
        return points

    assert not told(found(tmp_path, left=in_the_hand, right=in_the_hand), "forearm")


def test_arms_of_two_lengths_are_told(tmp_path: Path) -> None:
    summary = found(tmp_path, left=long_arm)
    points = walker(6.0, 300.0).points_m
    right_m = float(np.median(np.linalg.norm(points[:, at("elbow_r")] - points[:, at("shoulder_r")], axis=2)))
    assert told(summary, "camera left", "upper arm", f"{1.35 * right_m:.2f} m left", f"{right_m:.2f} m right")


@pytest.mark.parametrize("lift_m", [0.2, -0.2])
def test_a_floor_that_is_elsewhere_is_told_by_info_and_a_run(lift_m: float, tmp_path: Path) -> None:
    summary = found(tmp_path, lift_m)
    folder = replay.run("fuse", tmp_path / "a.mcap", out=tmp_path / "run")
    notes = run_folder.read(folder).notes
    for name, body in zip(POSES, summary.bodies, strict=True):
        assert body.floor_m == pytest.approx(lift_m, abs=0.006)
        (line,) = told(summary, f"camera {name}", "foot", "20 cm")
        assert ("above" in line) == (lift_m > 0)
        assert line in notes


def test_ankles_stand_in_for_feet(tmp_path: Path) -> None:
    """Some trackers give no feet; ankles are 8 to 18 cm above the floor, so only a larger error is told."""
    assert not told(found(tmp_path, left=no_feet, right=no_feet), "lowest ankle")
    (tmp_path / "a.mcap").unlink()
    summary = found(tmp_path, -0.2, left=no_feet, right=no_feet)
    assert {body.by_ankles for body in summary.bodies} == {True}
    assert told(summary, "camera left", "lowest ankle", "below")


def test_a_cell_corrects_clocks_and_poses_in_info(tmp_path: Path) -> None:
    """The right camera's clock is 0.4 s behind: the walker is a step away until the cell says so."""
    log = log_of(tmp_path / "a.mcap", later_ns=-400_000_000)
    cell = tmp_path / "cell.toml"
    cell.write_text(
        f"[cameras.right]\nT_world_camera = {POSES['right'].tolist()}\nclock_offset_s = -0.4\n"
        f"[cameras.attic]\nT_world_camera = {np.eye(4).tolist()}\n"
    )
    without, corrected = inputs.describe(log, None, ()), inputs.describe(log, None, (), cell)
    apart = ("cameras left and right", "limb", "apart")
    assert tells(without, *apart)
    assert not tells(corrected, *apart)
    assert tells(corrected, "right", "extrinsics in the cell")
    assert tells(corrected, "attic", "not in the log", "left, right")


def test_a_run_keeps_the_figures_in_tables_metrics_and_page(tmp_path: Path) -> None:
    summary = found(tmp_path, right=legs_away)
    cell, task = _base_and_task(tmp_path)
    folder = replay.run(
        "report", tmp_path / "a.mcap", out=tmp_path / "run", cell_file=cell, overrides=(f"plan.task={task}",)
    )
    run = run_folder.read(folder)
    metrics = json.loads((run.folder / "metrics.json").read_text())
    page = (run.folder / "report.html").read_text()
    assert run.agreement is not None
    for pair in summary.agreements:
        for name in ("median_m", "p95_m"):
            value = metrics[f"cameras_{pair.limb}_apart_{name}"]["value"]
            assert value == pytest.approx(getattr(pair, name), abs=1e-6)
    assert metrics["camera_right_floor_m"]["value"] == pytest.approx(0.32, abs=0.01)
    legs = next(pair for pair in summary.agreements if pair.limb == "LEGS")
    assert f"{legs.median_m:.3f} / {legs.p95_m:.3f} m" in page
    assert tells(run.notes, "cameras left and right", "limb", "apart")


def _base_and_task(tmp_path: Path) -> tuple[Path, Path]:
    cell, task = tmp_path / "cell.toml", tmp_path / "task.toml"
    cell.write_text("T_world_base = { position_m = [0.0, 3.0, 0.65], yaw_deg = 0.0 }\n")
    task.write_text(
        "tcp_speed_m_per_s = 0.5\n"
        + "".join(f"[[waypoints]]\nposition_m = [0.45, {y}, 0.3]\nrpy_deg = [180, 0, 0]\n" for y in (0.2, -0.2))
    )
    return cell, task


@pytest.mark.parametrize("size", [7, 400, 10**6])
def test_the_figures_do_not_depend_on_how_the_frames_are_cut(size: int) -> None:
    """Ten minutes, compared piece by piece, against numpy's interpolation of whole tracks, one coordinate at a time."""
    rng = np.random.default_rng(3)
    t_a, t_b = np.arange(0, 600 * 10**9, 10**8), np.arange(0, 600 * 10**9, 90_000_000)
    t_b = t_b[(t_b < 2e11) | (t_b > 3e11)]  # silent for 100 s
    a, b = (rng.normal(size=(len(t), 20, 3)) for t in (t_a, t_b))
    t_ns = np.concatenate([t_a, t_b])
    order = np.argsort(t_ns + rng.integers(0, 2 * 10**9, len(t_ns)))  # frames arrive up to 2 s late
    camera = np.repeat([0, 1], [len(t_a), len(t_b)])[order]
    frames = SkeletonTrack(t_ns[order], np.concatenate([a, b])[order], np.ones((len(t_ns), 20)))
    checks = CameraChecks(("a", "b"))
    for first in range(0, len(t_ns), size):
        checks.add(camera[first : first + size], frames.rows(slice(first, first + size)))
    _, agreements = checks.figures()
    there = np.stack(
        [np.interp(t_a, t_b, column) for column in b.reshape(len(t_b), -1).T], axis=1
    ).reshape(len(t_a), 20, 3)  # fmt: skip
    shown = (t_a <= t_b[-1]) & ~((t_a > t_b[t_b < 2e11][-1]) & (t_a < t_b[t_b > 3e11][0]))
    assert {pair.limb for pair in agreements} == set(LIMB_POINTS)
    for pair in agreements:
        apart_m = np.linalg.norm(a - there, axis=2)[shown][:, at(*LIMB_POINTS[pair.limb])]
        assert pair.pairs == apart_m.size
        assert pair.median_m == pytest.approx(np.median(apart_m), rel=1e-6)
        assert pair.p95_m == pytest.approx(np.percentile(apart_m, 95), rel=1e-6)


def test_each_point_is_compared_once() -> None:
    assert sorted(name for names in LIMB_POINTS.values() for name in names) == sorted(POINTS)
    assert set(LIMB_POINTS) == set(BODY)


def _recorded(tmp_path: Path) -> Iterator[tuple[str, list[str]]]:
    for name, (kind, files, options) in IMPORTS.items():
        log, cell = tmp_path / f"{name}.mcap", tmp_path / f"{name}.toml"
        paths = [str(data_path(file)) if kind == "keraal" else f"{c}={data_path(file)}" for c, file in files.items()]
        inputs.import_files(kind, paths, log, 30.0)
        place = {"reference": None, "up": None, "height_m": None, "base": None, **options}
        inputs.calibrate(log, cell, None, (), **place)
        yield name, inputs.describe(log, None, (), cell)
    settings, cell = tmp_path / "s.toml", tmp_path / "sara_cell.toml"
    settings.write_text(SARA)
    cell.write_text(SARA_CELL)
    for name in ("exp_appraoching", "exp_box"):
        yield name, inputs.describe(data_path(f"sara_human_robot_bags/{name}.bag"), settings, (), cell)
    yield "demo", inputs.describe(replay.demo_log(), None, ())


def test_real_people_have_no_odd_bones_and_no_exchanged_sides(tmp_path: Path) -> None:
    """The floor is told of two alone: of one its height was guessed (sitting), of the other it is the mocap room's."""
    floors = set()
    for name, text in _recorded(tmp_path):
        for words in ("an adult's", "m left, ", "exchanged", "shoulders' left", "add up to"):
            assert not [line for line in text if words in line], name
        floors |= {name} if any("the person's lowest" in line for line in text) else set()
    assert floors == {"kinect 2 sitting", "keraal pair"}
