"""Calibration end to end: text files of two cameras, import, calibrate, and the truth of how the second stood."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.calibration.calibrate import calibrate, collect_tracks, survey
from hrcreplay.calibration.registration import Disagreement, Registration, rigid, transform
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs.importers import import_azure, import_keraal, import_kinect2
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import POINTS, CameraFrames, Floats, SkeletonTrack
from tests.facts import facts, tells
from tests.realdata import data_path
from tests.reobserve import POSE, Truth, angle_deg, read_azure, reobserve, walker, write_azure

OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x right, y down, z ahead
T_WORLD_A = rigid(OPTICAL @ Rotation.from_euler("x", -10, degrees=True).as_matrix(), np.array([0.0, 0.0, 1.6]))


def _by_camera_a(shift_m: Floats | None = None) -> SkeletonTrack:
    """The walker, 3 m in front of camera a."""
    person = walker(15.0)
    place = np.array([3.0, 0.0, 0.0]) if shift_m is None else shift_m
    there = transform(np.asarray(np.linalg.inv(T_WORLD_A)), person.points_m + place)
    noise = np.random.default_rng(9).normal(0, 0.01, there.shape)
    return SkeletonTrack(person.t_ns, there + noise, person.confidence)


def _log(path: Path, tracks: dict[str, SkeletonTrack]) -> Log:
    """A log of the tracks, one body a camera, arrival 10 ms after capture."""
    cameras = tuple(tracks)
    tables = [
        CameraFrames(
            capture_ns=track.t_ns,
            arrival_ns=track.t_ns + 10_000_000,
            camera=np.full(len(track), i, dtype=np.int64),
            body=np.zeros(len(track), dtype=np.int64),
            points_m=track.points_m,
            confidence=track.confidence,
            cameras=cameras,
        )
        for i, track in enumerate(tracks.values())
    ]
    frames = CameraFrames.join(tables)
    with LogWriter(path) as writer:
        for name in cameras:
            writer.camera(name, None)
        writer.frames(frames.rows(np.argsort(frames.arrival_ns, kind="stable")))
    return open_log(path)


def _check(T_a_b: Floats, truth: Floats) -> None:
    assert angle_deg((np.linalg.inv(truth) @ T_a_b)[:3, :3]) < 0.5
    assert np.linalg.norm(T_a_b[:3, 3] - truth[:3, 3]) < 0.015


@pytest.mark.parametrize(("seed", "offset_s"), [(11, 0.0), (12, 0.085), (13, 0.4)])
def test_two_azure_files_of_one_movement(seed: int, offset_s: float, tmp_path: Path) -> None:
    source = data_path("pymocapviewer/azure_positions.csv.gz")
    write_azure(reobserve(read_azure(source), Truth(POSE, offset_s), seed), tmp_path / "b.csv")
    import_azure({"a": source, "b": tmp_path / "b.csv"}, tmp_path / "log.mcap")
    cell = calibrate(open_log(tmp_path / "log.mcap"))
    _check(np.asarray(np.linalg.inv(cell.T_world_camera["a"])) @ cell.T_world_camera["b"], POSE)
    assert cell.clock_offset_s["a"] == 0.0
    assert cell.clock_offset_s["b"] == pytest.approx(offset_s, abs=0.005)
    (rest,) = cell.residuals
    assert (rest.a, rest.b) == ("a", "b")
    assert 0.017 < rest.median_m < 0.036
    assert 0.05 < rest.p95_m < 0.6
    assert 0.01 < rest.mirrored < 0.15


def test_keraal_pair(tmp_path: Path) -> None:
    name = "keraal_kinect_vicon/G3-{}-CTK-P1T1-Unknown-C-0.txt"
    kinect, optical = data_path(name.format("Kinect")), data_path(name.format("Vicon"))
    import_keraal(kinect, optical, tmp_path / "log.mcap", 30.0)
    cell = calibrate(open_log(tmp_path / "log.mcap"), reference="optical", up=(0, 0, 1), height_m=0.0)
    (rest,) = cell.residuals
    assert rest.median_m < 0.050
    assert rest.p95_m < 0.140
    assert abs(cell.clock_offset_s["kinect"]) < 0.034  # one Kinect frame, as others found by hand
    np.testing.assert_allclose(cell.T_world_camera["optical"], np.eye(4), atol=1e-9)
    position = cell.T_world_camera["kinect"][:3, 3]
    assert 1.0 < position[2] < 2.5
    (note,) = cell.notes  # the Kinect shows the feet of the seated person above the floor of the mocap room
    assert tells(note, "kinect", "foot", "9 cm")


def test_a_seated_person_leaves_up_in_doubt(tmp_path: Path) -> None:
    import_keraal(data_path("keraal_kinect_vicon/G3-Kinect-CTK-P1T1-Unknown-C-0.txt"), None, tmp_path / "k.mcap", 30.0)
    cell = calibrate(open_log(tmp_path / "k.mcap"))
    assert tells(cell.notes[0], "up", "kinect")
    assert cell.T_world_camera["kinect"][2, 1] > 0.95  # y up all the same


@pytest.mark.parametrize(
    ("name", "up_axis", "sign", "stature"),
    [
        ("sevivi_azure_single/walking_positions_3d.csv.gz", 1, -1, 1.71),
        ("pymocapviewer/azure_positions.csv.gz", 1, -1, 1.64),
        ("labanotation_kinect_v2/Ges01_wavehand.csv", 1, 1, 1.55),
    ],
)
def test_floor_of_one_camera(name: str, up_axis: int, sign: int, stature: float, tmp_path: Path) -> None:
    run = import_azure if "azure" in name else import_kinect2
    run({"only": data_path(name)}, tmp_path / "log.mcap")
    log = open_log(tmp_path / "log.mcap")
    T = calibrate(log).T_world_camera["only"]
    assert sign * T[2, up_axis] > 0.95
    (track,) = collect_tracks(log, 0.8, 2.0)
    heads = transform(T, track.points_m)[:, 3, 2]
    assert np.nanpercentile(heads, 90) == pytest.approx(stature, abs=0.08)
    np.testing.assert_allclose(T[:2, 3], 0.0, atol=1e-12)


def test_world_is_under_the_reference_camera(tmp_path: Path) -> None:
    a = _by_camera_a()
    log = _log(tmp_path / "log.mcap", {"a": a, "b": reobserve(a, Truth(POSE, 0.03), 1)})
    by_a, by_b = calibrate(log, "a"), calibrate(log, "b")
    np.testing.assert_allclose(by_a.T_world_camera["a"][:3, 3], [0, 0, 1.6], atol=0.03)
    assert angle_deg(by_a.T_world_camera["a"][:3, :3] @ T_WORLD_A[:3, :3].T) < 1.0
    np.testing.assert_allclose(by_b.T_world_camera["b"][:2, 3], 0, atol=1e-12)
    assert by_b.T_world_camera["b"][1, 2] == pytest.approx(0, abs=1e-12)  # looks along x
    assert by_b.T_world_camera["b"][0, 2] > 0.5
    assert by_b.clock_offset_s["a"] == pytest.approx(-by_a.clock_offset_s["b"], abs=0.003)
    T_a_b, T_b_a = (
        np.linalg.inv(cell.T_world_camera[x]) @ cell.T_world_camera[y]
        for cell, x, y in ((by_a, "a", "b"), (by_b, "b", "a"))
    )
    np.testing.assert_allclose(T_a_b @ T_b_a, np.eye(4), atol=5e-3)


def test_given_up_and_height_hold(tmp_path: Path) -> None:
    log = _log(tmp_path / "log.mcap", {"a": _by_camera_a()})
    cell = calibrate(log, up=(0, -1, 0), height_m=2.0)
    np.testing.assert_allclose(cell.T_world_camera["a"], rigid(OPTICAL, np.array([0, 0, 2.0])), atol=1e-9)


def test_cameras_that_never_met_are_tied_by_a_third(tmp_path: Path) -> None:
    a = _by_camera_a()
    b = reobserve(a, Truth(POSE, 0.03), 2)
    T_b_c = np.asarray(np.linalg.inv(POSE))
    c = reobserve(SkeletonTrack(b.t_ns, b.points_m, b.confidence), Truth(T_b_c, -0.1), 3)
    early, late = a.rows(a.t_ns < a.t_ns[0] + 7e9), c.rows(c.t_ns > a.t_ns[0] + 8e9)
    cell = calibrate(_log(tmp_path / "log.mcap", {"a": early, "b": b, "c": late}))
    T_a_c = np.asarray(np.linalg.inv(cell.T_world_camera["a"])) @ cell.T_world_camera["c"]
    assert angle_deg(T_a_c[:3, :3]) < 1.0
    assert np.linalg.norm(T_a_c[:3, 3]) < 0.040
    assert cell.clock_offset_s["c"] == pytest.approx(-0.07, abs=0.008)
    assert [(rest.a, rest.b) for rest in cell.residuals] == [("a", "b"), ("b", "c")]


def test_a_second_person_does_not_disturb(tmp_path: Path) -> None:
    a = _by_camera_a()
    b = reobserve(a, Truth(POSE, 0.0), 4)
    write_azure(a, tmp_path / "a.csv")
    write_azure(b, tmp_path / "b.csv")
    rows = (tmp_path / "b.csv").read_text().splitlines()
    ghost = SkeletonTrack(b.t_ns, b.points_m * [0.9, 1, 1] + [2.5, 0, 2.0], b.confidence)
    write_azure(ghost, tmp_path / "ghost.csv", body=2)
    both = [
        line
        for pair in zip(rows[1:], (tmp_path / "ghost.csv").read_text().splitlines()[1:], strict=True)
        for line in pair
    ]
    (tmp_path / "b.csv").write_text("\n".join([rows[0], *both]))
    import_azure({"a": tmp_path / "a.csv", "b": tmp_path / "b.csv"}, tmp_path / "log.mcap")
    cell = calibrate(open_log(tmp_path / "log.mcap"))
    _check(np.asarray(np.linalg.inv(cell.T_world_camera["a"])) @ cell.T_world_camera["b"], POSE)


def test_a_long_log_is_looked_at_in_windows(tmp_path: Path) -> None:
    a = walker(20.0)
    hours = SkeletonTrack(a.t_ns * 200, a.points_m, a.confidence)  # 600 frames, 6.7 s apart: 67 minutes
    (track,) = collect_tracks(_log(tmp_path / "log.mcap", {"a": hours}), 10.0, 2.0)
    assert 60 <= len(track) <= 120
    assert track.t_ns[-1] - track.t_ns[0] > 0.95 * (hours.t_ns[-1] - hours.t_ns[0])


def test_what_cannot_be_calibrated_is_told(tmp_path: Path) -> None:
    a = _by_camera_a()
    other = walker(15.0)
    blind = SkeletonTrack(a.t_ns, a.points_m, np.where(np.arange(20) < 12, a.confidence, 0.0))
    rng = np.random.default_rng(5)
    strange = SkeletonTrack(
        other.t_ns, other.points_m + np.cumsum(rng.normal(0, 0.05, (len(a), 1, 3)), 0), a.confidence
    )
    later = SkeletonTrack(a.t_ns + 10**12, a.points_m, a.confidence)
    log = _log(tmp_path / "one.mcap", {"a": a})
    with pytest.raises(SettingsError, match=facts("reference", "'z'", "a")):
        calibrate(log, "z")
    with pytest.raises(SettingsError, match=facts("up", "0")):
        calibrate(log, up=(0, 0, 0))
    with pytest.raises(LogError, match=facts("camera b", "together")):
        calibrate(_log(tmp_path / "later.mcap", {"a": a, "b": later}))
    with pytest.raises(LogError, match=r"\d{2,} mm apart"):
        calibrate(_log(tmp_path / "strange.mcap", {"a": a, "b": strange}))
    with pytest.raises(LogError, match=r"no feet .*--height"):
        calibrate(_log(tmp_path / "blind.mcap", {"a": blind}))
    assert calibrate(_log(tmp_path / "told.mcap", {"a": blind}), height_m=1.6).T_world_camera["a"][2, 3] == 1.6


def test_a_log_that_does_not_show_where_up_is_says_so() -> None:
    demo = open_log(Path(__file__).parents[2] / "datasets" / "demo.mcap")
    with pytest.raises(LogError, match=facts("--height", "up")):
        calibrate(demo, jump_m=0.8, memory_s=2.0)


def test_it_tells_where_the_person_stood_and_which_way_x_points(tmp_path: Path) -> None:
    """By the truth of the walker: a figure of eight about (3, 0), before a camera 1.6 m up that looks along x."""
    cell, lines = survey(_log(tmp_path / "log.mcap", {"a": _by_camera_a()}))
    assert tells(lines[0], "world", "under a", "z up", "where a looks", "y to the left")
    found = [float(number) for number in re.findall(r"-?\d+\.\d+", lines[1])]
    pelvis = walker(15.0).points_m[:, 0] + [3.0, 0.0, 0.0]
    low, high = np.percentile(pelvis, [5, 95], axis=0)
    truth = [*np.median(pelvis, axis=0)[:2], low[0], high[0], low[1], high[1], 1.65]
    np.testing.assert_allclose(found, truth, atol=0.06)
    assert lines[2].startswith("a: at x = 0.00, y = ")
    assert cell.T_world_camera["a"][2, 3] == pytest.approx(1.6, abs=0.03)


def test_x_of_a_camera_that_looks_down_is_its_own(tmp_path: Path) -> None:
    down = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 4.0]))
    person = walker(15.0)
    track = SkeletonTrack(person.t_ns, transform(np.asarray(np.linalg.inv(down)), person.points_m), person.confidence)
    _, lines = survey(_log(tmp_path / "log.mcap", {"a": track}))
    assert tells(lines[0], "world", "a's own x")


@pytest.mark.parametrize(("a", "b"), [("walking", "squatting"), ("squatting", "walking")])
def test_recordings_of_different_movements_are_refused(a: str, b: str, tmp_path: Path) -> None:
    files = {name: data_path(f"sevivi_azure_single/{name}_positions_3d.csv.gz") for name in (a, b)}
    import_azure(files, tmp_path / "log.mcap")
    with pytest.raises(LogError, match=r"\d{2,} mm apart .* clock offset of [+-]\d") as refused:
        calibrate(open_log(tmp_path / "log.mcap"))
    assert refused.value.exit_code == 3


def test_clocks_further_apart_than_searched_are_refused(tmp_path: Path) -> None:
    """A movement that repeats fits at another lap too, but no clock may be that far off."""
    a = _by_camera_a()
    b = reobserve(a, Truth(POSE, 0.0), 4)
    far = Registration(POSE, -3.1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hrcreplay.calibration.calibrate.register", lambda *_, **__: far)
        patch.setattr("hrcreplay.calibration.calibrate.disagreement", lambda *_: Disagreement(0.03, 0.1, 1000, 0.0))
        with pytest.raises(LogError, match=facts("a", "b", "30 mm", "offset of -3.10 s")):
            calibrate(_log(tmp_path / "log.mcap", {"a": a, "b": b}))


def test_cameras_that_hardly_fit_are_doubted(tmp_path: Path) -> None:
    """One that errs by 8 cm at every point, as none does about the same movement."""
    a = _by_camera_a()
    b = reobserve(a, Truth(POSE, 0.0), 5)
    noise = np.random.default_rng(6).normal(0.0, 0.06, b.points_m.shape)
    cell = calibrate(
        _log(tmp_path / "log.mcap", {"a": a, "b": SkeletonTrack(b.t_ns, b.points_m + noise, b.confidence)})
    )
    (rest,) = cell.residuals
    assert 0.06 < rest.median_m < 0.15
    assert tells(cell.notes[-1], "a", "b", f"{1e3 * rest.median_m:.0f} mm")


@pytest.mark.parametrize("off_m", [0.0, 0.3])
def test_limbs_on_which_cameras_differ_are_told_with_floor_and_height(off_m: float, tmp_path: Path) -> None:
    """Arms and trunk fit, the legs of one camera are elsewhere; the figures against a comparison of every frame."""
    a = _by_camera_a()
    noise = np.random.default_rng(5).normal(0.0, 0.008, a.points_m.shape)
    points = (a.points_m + noise - POSE[:3, 3]) @ POSE[:3, :3]
    b = SkeletonTrack(a.t_ns + 30_000_000, points, a.confidence)
    legs = [i for i, name in enumerate(POINTS) if name.split("_")[0] in ("hip", "knee", "ankle", "foot")]
    points[:, legs] += [0.0, 0.6 * off_m, 0.8 * off_m]
    cell, lines = survey(_log(tmp_path / "log.mcap", {"a": a, "b": SkeletonTrack(b.t_ns, points, b.confidence)}), "a")
    (line,) = [line for line in lines if line.startswith("a - b, legs")]
    median_m = float(line.split("apart by ")[1].split(" mm")[0]) / 1e3
    T_a_b = np.linalg.inv(cell.T_world_camera["a"]) @ cell.T_world_camera["b"]
    there = transform(np.asarray(T_a_b), points)
    nearest = np.abs(b.t_ns - 30_000_000 - a.t_ns[:, None]).argmin(axis=1)
    apart_m = np.linalg.norm(a.points_m[:, legs] - there[nearest][:, legs], axis=2)
    assert median_m == pytest.approx(np.median(apart_m), abs=0.01)  # it interpolates
    assert (median_m > 0.15) == bool(off_m)  # the poses are fitted to the legs, too, and take a part of 0.3 m
    told = [note for note in cell.notes if "cameras a and b show a limb apart" in note]
    assert ["legs" in note for note in told] == ([True] if off_m else [])
    (floor,) = [line for line in lines if line.startswith("a: lowest foot")]
    assert abs(float(re.findall(r"[-+]\d+\.\d", floor)[0])) < 2.0
    assert float(re.findall(r"head (\d\.\d\d) m above the floor", floor)[0]) == pytest.approx(1.65, abs=0.06)


def test_millimetres_are_no_person_to_calibrate_by(tmp_path: Path) -> None:
    a = _by_camera_a()
    log = _log(tmp_path / "log.mcap", {"a": SkeletonTrack(a.t_ns, 1e3 * a.points_m, a.confidence)})
    with pytest.raises(LogError, match=facts("millimetres", "metres")):
        calibrate(log)


@pytest.mark.parametrize("height_m", [np.nan, np.inf, -0.1])
def test_a_height_that_is_none_is_refused(height_m: float, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=facts("height", f"{height_m:g}", "metres", "0 or more")):
        calibrate(_log(tmp_path / "log.mcap", {"a": _by_camera_a()}), height_m=height_m)
