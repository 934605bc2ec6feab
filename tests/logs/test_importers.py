"""Imported logs hold what the text files hold; bad files give one line that says where."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs.importers import find_pivot, import_azure, import_keraal, import_kinect2, rotations
from hrcreplay.logs.log_files import open_source
from hrcreplay.logs.reader import open_log
from hrcreplay.records import POINTS, CameraFrames
from tests.facts import facts, tells
from tests.realdata import data_path
from tests.reobserve import AZURE, read_azure, walker, write_azure


def _frames(path: Path) -> CameraFrames:
    return CameraFrames.join(list(open_log(path).frames()))


def _azure_row(t_us: int | str, body: int = 1, confidence: str = "2") -> str:
    joints = [value for joint in range(32) for value in (confidence, f"{100.0 + 10 * joint}", "-200.0", "3000.0")]
    return ";".join([str(t_us), str(body), *joints])


def _azure_header() -> str:
    return ";".join(["timestamp", "body_idx", *(f"{joint} ({axis})" for joint in AZURE for axis in "cxyz")])


def _kinect_row(ticks: int, state: int = 2) -> str:
    return f"{ticks}," + ",".join(["0.1", "0.2", "3.0", str(state)] * 25) + ",\r\n"


@pytest.mark.parametrize(
    "name",
    [
        "pymocapviewer/azure_positions",
        "sevivi_azure_single/walking_positions_3d",
        "sevivi_azure_single/squatting_positions_3d",
    ],
)
def test_azure_files(name: str, tmp_path: Path) -> None:
    source = data_path(f"{name}.csv.gz")
    notes = import_azure({"left": source}, tmp_path / "log.mcap")
    track, frames = read_azure(source), _frames(tmp_path / "log.mcap")
    assert tells(notes[0], "arrival", "capture")
    assert frames.cameras == ("left",)
    new = np.ones(len(track), dtype=bool)  # these files repeat a row here and there where the sensor lost a frame
    new[1:] = (np.diff(track.points_m.astype(np.float32), axis=0) != 0.0).any(axis=(1, 2))
    assert new.mean() > 0.97
    np.testing.assert_array_equal(frames.capture_ns, track.t_ns[new])
    np.testing.assert_array_equal(frames.arrival_ns, track.t_ns[new])
    np.testing.assert_allclose(frames.points_m, track.points_m[new], atol=1e-6)
    np.testing.assert_array_equal(frames.confidence, track.confidence[new])


def test_azure_confidence_and_bodies(tmp_path: Path) -> None:
    source = tmp_path / "a.csv"
    rows = [_azure_row(10, body=3, confidence=str(level)) for level in range(4)]
    rows = [row.replace("10;3", f"10;{i}", 1) for i, row in enumerate(rows)]
    source.write_text("\n".join([_azure_header(), *rows]))
    import_azure({"a": source}, tmp_path / "log.mcap")
    frames = _frames(tmp_path / "log.mcap")
    np.testing.assert_array_equal(frames.body, [0, 1, 2, 3])
    np.testing.assert_array_equal(frames.confidence[:, 0], [0.0, 0.5, 1.0, 1.0])
    np.testing.assert_allclose(frames.points_m[0, 0], [0.1, -0.2, 3.0], atol=1e-6)


def test_azure_missing_point_has_no_confidence(tmp_path: Path) -> None:
    source = tmp_path / "a.csv"
    source.write_text("\n".join([_azure_header(), _azure_row(10).replace("100.0", "nan", 1)]))
    import_azure({"a": source}, tmp_path / "log.mcap")
    frames = _frames(tmp_path / "log.mcap")
    assert np.isnan(frames.points_m[0, 0]).all()
    assert frames.confidence[0, 0] == 0.0
    assert np.isfinite(frames.points_m[0, 1:]).all()


def test_two_azure_files_are_merged_by_time(tmp_path: Path) -> None:
    track = walker(2.0)
    write_azure(track, tmp_path / "a.csv")
    write_azure(type(track)(track.t_ns + 7_000_000, track.points_m, track.confidence), tmp_path / "b.csv")
    notes = import_azure({"b": tmp_path / "b.csv", "a": tmp_path / "a.csv"}, tmp_path / "log.mcap")
    frames = _frames(tmp_path / "log.mcap")
    assert len(notes) == 1
    assert frames.cameras == ("b", "a")
    assert (np.diff(frames.arrival_ns) >= 0).all()
    np.testing.assert_array_equal(np.bincount(frames.camera), [60, 60])


def test_clocks_of_different_sessions_are_told(tmp_path: Path) -> None:
    track = walker(1.0)
    write_azure(track, tmp_path / "a.csv")
    write_azure(type(track)(track.t_ns + 10**12, track.points_m, track.confidence), tmp_path / "b.csv")
    notes = import_azure({"a": tmp_path / "a.csv", "b": tmp_path / "b.csv"}, tmp_path / "log.mcap")
    assert tells(notes[1], "camera b", "overlap", "a")


@pytest.mark.parametrize("name", ["joints", "Ges01_wavehand", "Ges03_drawlines"])
def test_kinect2_files(name: str, tmp_path: Path) -> None:
    source = data_path(f"labanotation_kinect_v2/{name}.csv")
    import_kinect2({"kinect": source}, tmp_path / "log.mcap")
    table = np.genfromtxt(source, delimiter=",", usecols=range(101))
    joints = table[:, 1:].reshape(-1, 25, 4)
    frames = _frames(tmp_path / "log.mcap")
    np.testing.assert_array_equal(frames.capture_ns, table[:, 0].astype(np.int64) * 100)
    for point, joint in (("pelvis", 0), ("neck", 20), ("head", 3), ("wrist_l", 6), ("hand_r", 11), ("foot_r", 19)):
        i = POINTS.index(point)
        np.testing.assert_allclose(frames.points_m[:, i], joints[:, joint, :3], atol=1e-6)
        np.testing.assert_array_equal(frames.confidence[:, i], joints[:, joint, 3] / 2)


def _keraal() -> tuple[Path, Path]:
    name = "keraal_kinect_vicon/G3-{}-CTK-P1T1-Unknown-C-0.txt"
    return data_path(name.format("Kinect")), data_path(name.format("Vicon"))


def test_keraal_pair(tmp_path: Path) -> None:
    kinect, optical = _keraal()
    notes = import_keraal(kinect, optical, tmp_path / "log.mcap", 30.0)
    frames = _frames(tmp_path / "log.mcap")
    assert "30 Hz" in notes[0]
    assert "60 Hz" in notes[0]
    assert "knee_l" in notes[1]  # the person sits
    assert frames.cameras == ("kinect", "optical")
    by_kinect, by_optical = (frames.rows(frames.camera == i) for i in (0, 1))
    joints = np.loadtxt(kinect).reshape(-1, 25, 7)
    targets = np.loadtxt(optical).reshape(-1, 17, 7)
    np.testing.assert_allclose(by_kinect.points_m[:, POINTS.index("elbow_r")], joints[:, 9, :3], atol=1e-6)
    np.testing.assert_allclose(by_optical.points_m[:, POINTS.index("head")], targets[:, 14, :3] * 1e-3, atol=1e-6)
    assert np.median(np.diff(by_kinect.capture_ns)) == pytest.approx(1e9 / 30, abs=1)
    assert np.median(np.diff(by_optical.capture_ns)) == pytest.approx(1e9 / 60, abs=1)
    assert np.isnan(by_optical.points_m[:, POINTS.index("knee_l")]).all()


def test_keraal_centres_are_those_of_bones(tmp_path: Path) -> None:
    """Between centres the bones keep their length, which neither targets nor the Kinect's joints do."""
    kinect, optical = _keraal()
    import_keraal(kinect, optical, tmp_path / "log.mcap", 30.0)
    frames = _frames(tmp_path / "log.mcap").rows(slice(None))
    points = frames.points_m[frames.camera == 1]
    for side in "lr":
        shoulder, elbow, wrist = (points[:, POINTS.index(f"{name}_{side}")] for name in ("shoulder", "elbow", "wrist"))
        for upper, lower, low, high in ((shoulder, elbow, 0.24, 0.36), (elbow, wrist, 0.20, 0.30)):
            length = np.linalg.norm(upper - lower, axis=1)
            assert low < np.median(length) < high
            assert length.std() < 0.010


def test_pivot_of_two_turning_bodies() -> None:
    rng = np.random.default_rng(3)
    above, below = np.array([0.10, 0.05, -0.08]), np.array([-0.12, 0.04, 0.02])
    turns_a, turns_b = Rotation.random(300, rng=rng), Rotation.random(300, rng=rng)
    centre = rng.normal(size=(300, 3))
    places_a = centre - turns_a.apply(above)
    places_b = centre - turns_b.apply(below) + rng.normal(0, 0.002, (300, 3))
    pivot = find_pivot(turns_a.as_matrix(), places_a, turns_b.as_matrix(), places_b)
    assert pivot is not None
    np.testing.assert_allclose(pivot.above_m, above, atol=1e-3)
    np.testing.assert_allclose(pivot.below_m, below, atol=1e-3)
    found = pivot.at(turns_a.as_matrix()[0], places_a[0], turns_b.as_matrix()[0], places_b[0])
    np.testing.assert_allclose(found, centre[0], atol=5e-3)


def test_no_pivot_without_a_swing() -> None:
    turns = np.broadcast_to(np.eye(3), (50, 3, 3))
    places = np.zeros((50, 3))
    assert find_pivot(turns, places, turns, places + 0.1) is None
    assert find_pivot(turns[:5], places[:5], turns[:5], places[:5]) is None


def test_a_target_that_was_not_seen_has_no_rotation() -> None:
    quaternions = np.random.default_rng(4).normal(size=(20, 4))
    expected = Rotation.from_quat(quaternions).as_matrix()
    quaternions[3], quaternions[7, 2] = np.nan, np.inf
    expected[[3, 7]] = np.nan
    np.testing.assert_array_equal(rotations(quaternions), expected)


def _azure(path: Path, out: Path) -> None:
    import_azure({"a": path}, out)


HEADER = _azure_header()


@pytest.mark.parametrize(
    ("step", "unit_ns", "name"),
    [
        ("33333", 1000, None),
        ("200000", 1000, None),
        ("1000000", 1000, None),
        ("33", 10**6, "ms"),
        ("0.033", 10**9, "s"),
        ("33333333", 1, "ns"),
    ],
)
def test_azure_times_in_other_units(step: str, unit_ns: int, name: str | None, tmp_path: Path) -> None:
    rows = [_azure_row(str(Decimal(7000) + number * Decimal(step))) for number in range(30)]
    (tmp_path / "a.csv").write_text("\n".join([HEADER, *rows]))
    notes = import_azure({"a": tmp_path / "a.csv"}, tmp_path / "log.mcap")
    times = [message.arrival_ns for message in open_source(tmp_path / "log.mcap").messages(["/camera/a/skeleton"])]
    assert times == [int((7000 + number * Decimal(step)) * unit_ns) for number in range(30)]
    told = [note for note in notes if "camera a: its times" in note]
    assert [f"as {name}," in note for note in told] == ([] if name is None else [True])


def test_times_of_no_camera_are_refused(tmp_path: Path) -> None:
    rows = [_azure_row(7000 + 3 * number) for number in range(30)]
    (tmp_path / "a.csv").write_text("\n".join([HEADER, *rows]))
    with pytest.raises(LogError, match=facts("a.csv", "time", "steps of 3", "us", "ms")):
        import_azure({"a": tmp_path / "a.csv"}, tmp_path / "log.mcap")
    assert not (tmp_path / "log.mcap").exists()


def _kinect2(path: Path, out: Path) -> None:
    import_kinect2({"k": path}, out)


def _kinect_text(path: Path, out: Path) -> None:
    import_keraal(path, None, out, 30.0)


@pytest.mark.parametrize(
    ("run", "text", "where_found_right"),
    [
        (_azure, "", ("bad.csv", "empty")),
        (_azure, HEADER, ("camera a", "no row")),
        (_azure, "a;b;c\n1;2;3", ("bad.csv:1", "column 1", "'a'", "'timestamp'")),
        (_azure, HEADER.replace("ELBOW_LEFT", "ELBO_LEFT"), ("bad.csv:1", "'ELBOW_LEFT (c)'")),
        (_azure, HEADER.replace("HEAD (x)", "HEAD (q)"), ("bad.csv:1", "column 108", "'HEAD (q)'")),
        (_azure, f"{HEADER}\n1;2;3", ("bad.csv:2", "3 columns", "130")),
        (_azure, f"{HEADER}\n{_azure_row(5).replace('100.0', 'x', 1)}", ("bad.csv:2", "column 4", "'x'")),
        (_azure, f"{HEADER}\n{_azure_row('5.5')}", ("bad.csv:2", "time", "'5.5'")),
        (_azure, f"{HEADER}\n{_azure_row(-5)}", ("bad.csv:2", "time", "'-5'", "0")),
        (_azure, f"{HEADER}\n{_azure_row(500)}\n{_azure_row(300)}", ("bad.csv:3", "back", "0.0002 s")),
        (_azure, f"{HEADER}\n{_azure_row(5, confidence='7')}", ("bad.csv:2", "confidence", "7")),
        (_kinect2, "", ("bad.csv", "empty")),
        (_kinect2, _kinect_row(20) + _kinect_row(10), ("bad.csv:2", "back", "1e-06 s")),
        (_kinect2, _kinect_row(20, state=3), ("bad.csv:1", "tracking state", "3", "0, 1 or 2")),
        (_kinect2, "1,2,3,\r\n", ("bad.csv:1", "3 columns", "101")),
        (_kinect_text, "1 2 3", ("bad.csv:1", "3 columns", "175")),
        (_kinect_text, "\n \n", ("camera kinect", "no row")),
    ],
)
def test_bad_text(
    run: Callable[[Path, Path], None], text: str, where_found_right: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(LogError, match=facts(*where_found_right)) as caught:
        run(tmp_path / "bad.csv", tmp_path / "log.mcap")
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["bad.csv"]


def test_bad_files(tmp_path: Path) -> None:
    out = tmp_path / "log.mcap"
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00\x81")
    (tmp_path / "cut.csv.gz").write_bytes(b"\x1f\x8b\x08\x00\x00\x00\x00\x00")
    (tmp_path / "plain.csv.gz").write_text("timestamp")
    with pytest.raises(LogError, match=facts("none.csv", "no such file")):
        import_azure({"a": tmp_path / "none.csv"}, out)
    with pytest.raises(LogError, match=facts("bytes.csv", "not text")):
        import_azure({"a": tmp_path / "bytes.csv"}, out)
    for name in ("cut", "plain"):
        with pytest.raises(LogError, match=facts(f"{name}.csv.gz", "cannot be read")):
            import_azure({"a": tmp_path / f"{name}.csv.gz"}, out)
    with pytest.raises(LogError, match=facts(str(tmp_path), "cannot be read")):
        import_azure({"a": tmp_path}, out)
    assert not out.exists()


def test_existing_log_is_kept(tmp_path: Path) -> None:
    write_azure(walker(1.0), tmp_path / "a.csv")
    (tmp_path / "log.mcap").write_text("precious")
    with pytest.raises(SettingsError, match=facts("log.mcap", "exists")):
        import_azure({"a": tmp_path / "a.csv"}, tmp_path / "log.mcap")
    assert (tmp_path / "log.mcap").read_text() == "precious"


@pytest.mark.parametrize("rate_hz", [0.0, -30.0, float("nan")])
def test_keraal_needs_a_rate(rate_hz: float, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=facts("rate", f"{rate_hz:g}")):
        import_keraal(tmp_path / "none", None, tmp_path / "log.mcap", rate_hz)


def test_import_is_deterministic(tmp_path: Path) -> None:
    write_azure(walker(1.0), tmp_path / "a.csv")
    for name in ("one", "two"):
        import_azure({"a": tmp_path / "a.csv"}, tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert np.isfinite(_frames(tmp_path / "one").points_m).all()


def test_a_quaternion_without_a_length_is_a_rotation_nobody_knows() -> None:
    found = rotations(np.array([[0, 0, 0, 2.0], [0, 0, 0, 0], [1e-200, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]]))
    np.testing.assert_array_equal(found[0], np.eye(3))
    assert np.isnan(found[1:]).all()
