"""A known motion, written in each format by another writer, comes back within 1 mm; what cannot be read says why."""

from __future__ import annotations

import csv
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import typer

from hrcreplay.cli.app import app
from hrcreplay.commands.inputs import import_files
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs.dataset_files import unpickle_arrays
from hrcreplay.logs.formats import FORMATS
from hrcreplay.logs.messages import AZURE_INDEX, AZURE_JOINTS, KINECT2_INDEX
from hrcreplay.logs.reader import open_log
from hrcreplay.records import NOBODY, POINTS, CameraFrames, Floats
from tests.facts import facts, tells
from tests.logs import motion_writers as writers
from tests.realdata import data_path
from tests.reobserve import walker

RATE = 30.0
MOTION = walker(1.0, RATE).points_m
ALL = frozenset(POINTS)
BARE = frozenset(POINTS) - {"chest", "hand_l", "hand_r"}


def at(name: str) -> int:
    return POINTS.index(name)


def of(name: str) -> Floats:
    return MOTION[:, at(name)]


def imported(kind: str, path: Path, tmp_path: Path, **given: Any) -> tuple[CameraFrames, list[str]]:
    out = tmp_path / "log.mcap"
    if "mapping" in given:
        (tmp_path / "mapping.toml").write_text(given["mapping"])
        given["mapping"] = tmp_path / "mapping.toml"
    notes = import_files(kind, [f"cam={path}"], out, **given)
    log = open_log(out)
    frames = CameraFrames.join(list(log.frames(nobody=True)))
    log.check()
    return frames, notes


def check(
    frames: CameraFrames, has: frozenset[str] | set[str] = ALL, rate_hz: float = RATE, motion: Floats = MOTION
) -> None:
    """The log holds these points of the motion within 1 mm, at its rate, and no others."""
    mine = frames.rows(frames.body != NOBODY)
    steps = np.round((mine.capture_ns - mine.capture_ns[0]) * 1e-9 * rate_hz).astype(int)
    np.testing.assert_allclose((mine.capture_ns - mine.capture_ns[0]) * 1e-9, steps / rate_hz, atol=1.1e-3)
    assert len(mine) == len(motion)
    known = [at(name) for name in POINTS if name in has]
    np.testing.assert_allclose(mine.points_m[:, known], motion[steps][:, known], atol=1e-3)
    assert np.isnan(np.delete(mine.points_m, known, axis=1)).all()


# --- tables ---

WIDE = 'time = "t"\nunit = "m"\n'


def write_table(path: Path, records: list[dict[str, Any]]) -> Path:
    if path.suffix == ".parquet":
        pq.write_table(pa.Table.from_pylist(records), path)
    elif path.suffix == ".json":
        path.write_text(json.dumps({"take": {"rows": records}}))
    elif path.suffix == ".jsonl":
        path.write_text("\n".join(map(json.dumps, records)))
    else:
        with path.open("w", newline="") as file:
            write = csv.DictWriter(file, list(records[0]), delimiter=";")
            write.writeheader()
            write.writerows(records)
    return path


@pytest.mark.parametrize(
    ("ending", "more"), [("csv", 'separator = ";"'), ("parquet", ""), ("json", 'records = "take.rows"'), ("jsonl", "")]
)
def test_tables_with_a_row_per_frame(ending: str, more: str, tmp_path: Path) -> None:
    records = writers.wide(MOTION, [i / RATE for i in range(len(MOTION))])
    path = write_table(tmp_path / f"a.{ending}", records)
    frames, notes = imported("table", path, tmp_path, mapping=WIDE + more)
    check(frames)
    assert tells(notes, "times", "1", "added")
    assert not tells(notes, "lack")


@pytest.mark.parametrize("ending", ["json", "jsonl", "parquet"])
def test_records_with_lists_of_points(ending: str, tmp_path: Path) -> None:
    records = [{"t": i / RATE, "person": {"points": MOTION[i].tolist()}} for i in range(len(MOTION))]
    mapping = WIDE + 'columns = "person.points.{point}.{axis}"\naxis_names = ["0", "1", "2"]\nindex = "points"\n'
    more = 'records = "take.rows"' if ending == "json" else ""
    frames, _ = imported("table", write_table(tmp_path / f"a.{ending}", records), tmp_path, mapping=mapping + more)
    check(frames)


def test_table_of_other_columns_units_axes_and_names(tmp_path: Path) -> None:
    """y up, mm, times in us since 1970, confidence in percent, columns as 'pos.x(Kopf)'; NaN is missing."""
    words = {"Kopf": "head", "Hals": "neck", "Becken": "pelvis", "SchulterL": "shoulder_l", "SchulterR": "shoulder_r"}
    words |= {"EllbogenL": "elbow_l", "HandgelenkL": "wrist_l"}
    records = []
    for i in range(len(MOTION)):
        row: dict[str, Any] = {"zeit": 1_700_000_000_000_000 + round(1e6 * i / RATE)}
        for word, name in words.items():
            x, y, z = 1000 * MOTION[i, at(name)]
            row |= {f"pos.x({word})": x, f"pos.y({word})": z, f"pos.z({word})": -y, f"sicher({word})": 80}
        if i == 3:
            row["pos.x(Kopf)"] = "nan"
        records.append(row)
    index = ", ".join(f'{name} = "{word}"' for word, name in words.items())
    mapping = f"""
time = "zeit"
time_unit = "us"
separator = ";"
columns = "pos.{{axis}}({{point}})"
confidence = "sicher({{point}})"
confidence_max = 100.0
unit = "mm"
axes = ["x", "-z", "y"]
index = {{ {index} }}
"""
    frames, notes = imported("table", write_table(tmp_path / "a.csv", records), tmp_path, mapping=mapping)
    assert np.isnan(frames.points_m[3, at("head")]).all()
    frames.points_m.flags.writeable = False
    whole = frames.rows(np.arange(len(frames)) != 3)
    assert len(whole) == len(MOTION) - 1
    known = [at(name) for name in words.values()]
    steps = np.round((whole.capture_ns - 1_700_000_000_000_000_000) * 1e-9 * RATE).astype(int)
    np.testing.assert_allclose(whole.points_m[:, known], MOTION[steps][:, known], atol=1e-3)
    np.testing.assert_allclose(whole.confidence[:, known], 0.8)
    assert tells(notes, "lack", "chest", "hips", "knees", "ankles", "feet", "hands", "elbow_r", "wrist_r")


def test_table_with_a_row_per_point_and_two_bodies(tmp_path: Path) -> None:
    rows = [
        {"ms": round(1000 * i / RATE), "id": body, "joint": name, "X": xyz[0] + 3 * body, "Y": xyz[1], "Z": xyz[2]}
        for i in range(len(MOTION))
        for body in (0, 1)
        for name, xyz in zip(POINTS, MOTION[i], strict=True)
    ]
    mapping = """
time = "ms"
time_unit = "ms"
body = "id"
name = "joint"
columns = "{axis}"
axis_names = ["X", "Y", "Z"]
confidence = 0.5
separator = ";"
"""
    frames, notes = imported("table", write_table(tmp_path / "a.csv", rows), tmp_path, mapping=mapping)
    check(frames.rows(frames.body == 0))
    check(frames.rows(frames.body == 1), motion=MOTION + np.array([3.0, 0.0, 0.0]))
    assert (frames.confidence == 0.5).all()
    assert tells(notes, "unit", "m")


@pytest.mark.parametrize(
    ("mapping", "told"),
    [
        (None, ("--mapping",)),
        ('time = "when"\nseparator = ";"', ("'when'", "t", "pelvis_x")),
        ('separator = ";"', ("--rate",)),
        ('time = "t"\nseparator = ";"\ncolumns = "{point}.{axis}"', ("'{point}.{axis}'", "pattern")),
        ('time = "t"\nseparator = ";"\nindex = { head = "Kopf" }', ("pelvis", "index")),
        ('time = "t"\nseparator = ";"\nindex = "body99"', ("'body99'", "body25")),
        ('axes = ["y", "x", "z"]', ("mirror",)),
        ('columns = "{point}"', ("{axis}",)),
        ("hertz = 3", ("hertz",)),
    ],
)
def test_mappings_that_do_not_fit(mapping: str | None, told: tuple[str, ...], tmp_path: Path) -> None:
    path = write_table(tmp_path / "a.csv", writers.wide(MOTION, [i / RATE for i in range(len(MOTION))]))
    given = {} if mapping is None else {"mapping": mapping}
    with pytest.raises((LogError, SettingsError), match=facts(*told)):
        imported("table", path, tmp_path, **given)
    assert not (tmp_path / "log.mcap").exists()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"head_x": "north"}, ("row 5", "head_x", "'north'")),
        ({"t": 0.01}, ("time goes back",)),
        ({"t": ""}, ("row 5", "t")),
    ],
)
def test_spoilt_tables_say_where(change: dict[str, Any], told: tuple[str, ...], tmp_path: Path) -> None:
    records = writers.wide(MOTION, [i / RATE for i in range(len(MOTION))])
    records[4] |= change
    with pytest.raises(LogError, match=facts("a.csv", *told)):
        imported("table", write_table(tmp_path / "a.csv", records), tmp_path, mapping=WIDE + 'separator = ";"')


# --- MediaPipe ---

#: MediaPipe's landmark -> body point at which the test puts it.
LANDMARKS = {
    11: "shoulder_l", 12: "shoulder_r", 13: "elbow_l", 14: "elbow_r", 15: "wrist_l", 16: "wrist_r", 17: "hand_l",
    18: "hand_r", 19: "hand_l", 20: "hand_r", 23: "hip_l", 24: "hip_r", 25: "knee_l", 26: "knee_r", 27: "ankle_l",
    28: "ankle_r", 29: "ankle_l", 30: "ankle_r", 31: "foot_l", 32: "foot_r",
}  # fmt: skip


def landmarks(offset: Floats | float = 0.0) -> list[dict[str, Any]]:
    return [
        {"frame": i, "timestamp_ms": round(1000 * i / RATE), "landmark": k, "visibility": 0.9}
        | dict(zip("xyz", MOTION[i, at(LANDMARKS.get(k, "head"))] - np.asarray(offset)[..., :], strict=True))
        for i in range(len(MOTION))
        for k in range(33)
    ]


def middles(motion: Floats) -> Floats:
    """The motion with pelvis and neck where trackers without them have them."""
    found = motion.copy()
    found[:, at("pelvis")] = motion[:, [at("hip_l"), at("hip_r")]].mean(axis=1)
    found[:, at("neck")] = motion[:, [at("shoulder_l"), at("shoulder_r")]].mean(axis=1)
    return found


def write_landmarks(path: Path, rows: list[dict[str, Any]]) -> Path:
    with path.open("w", newline="") as file:
        write = csv.DictWriter(file, list(rows[0]))
        write.writeheader()
        write.writerows(rows)
    return path


def test_mediapipe(tmp_path: Path) -> None:
    path = write_landmarks(tmp_path / "a.csv", landmarks(np.zeros(3)))
    frames, notes = imported("mediapipe", path, tmp_path)
    check(frames, ALL - {"chest"}, motion=middles(MOTION))
    np.testing.assert_allclose(frames.confidence[:, at("wrist_l")], 0.9, atol=1e-6)
    assert tells(notes, "lack", "chest")


def test_mediapipe_about_the_hips_needs_a_place(tmp_path: Path) -> None:
    rows = landmarks(np.zeros(3))
    hips = MOTION[:, [at("hip_l"), at("hip_r")]].mean(axis=1)
    for row in rows:
        for j, axis in enumerate("xyz"):
            row[axis] -= hips[row["frame"], j]
    path = write_landmarks(tmp_path / "a.csv", rows)
    with pytest.raises(LogError, match=facts("hips", "origin", "offset_m")):
        imported("mediapipe", path, tmp_path)
    frames, _ = imported("mediapipe", path, tmp_path, mapping="offset_m = [1.0, 2.0, 0.95]")
    still = middles(MOTION) - hips[:, None] + [1.0, 2.0, 0.95]
    check(frames, ALL - {"chest"}, motion=still)


# --- JSON of trackers ---


def joints_of(count: int, index: dict[int, int], frame: int) -> Floats:
    """Joints of a sensor (count, 3) for a frame; those that are no body points lie beside the head."""
    joints = np.tile(MOTION[frame, at("head")] + [0.1, 0.1, 0.1], (count, 1))
    for joint, point in index.items():
        joints[joint] = MOTION[frame, point]
    return joints


def test_k4abt_json_with_two_bodies_and_an_empty_frame(tmp_path: Path) -> None:
    frames_: list[dict[int, Floats]] = []
    for i in range(len(MOTION)):
        joints = joints_of(32, dict(AZURE_INDEX), i)
        frames_.append({1: joints, 2: joints + np.array([2.0, 0.0, 0.0])})
    frames_[5] = {}
    writers.k4abt(
        tmp_path / "a.json", list(AZURE_JOINTS), [round(1e6 * i / RATE) - 5 for i in range(len(MOTION))], frames_
    )
    frames, notes = imported("k4abt", tmp_path / "a.json", tmp_path)
    there = np.arange(len(MOTION)) != 5
    assert (frames.body == NOBODY).sum() == 1
    mine = frames.rows(frames.body == 2)
    np.testing.assert_allclose(mine.points_m, MOTION[there] + np.array([2.0, 0.0, 0.0]), atol=1e-3)
    np.testing.assert_allclose(frames.rows(frames.body == 1).points_m, MOTION[there], atol=1e-3)
    assert tells(notes, "no confidence")


@pytest.mark.parametrize("count", [18, 38])
def test_zed_json(count: int, tmp_path: Path) -> None:
    from tests.logs.test_presets import BODY_18, BODY_38, PLAIN, of_sdk

    order = {18: BODY_18, 38: BODY_38}[count]
    content = {
        str(i): {
            "timestamp": 1_700_000_000_000_000_000 + round(1e9 * i / RATE),
            "body_list": [
                {
                    "id": 3,
                    "keypoint": [of_sdk(name, dict(zip(POINTS, MOTION[i], strict=True))).tolist() for name in order],
                    "keypoint_confidence": [50.0] * count,
                }
            ],
        }
        for i in range(len(MOTION))
    }
    (tmp_path / "a.json").write_text(json.dumps(content))
    frames, _ = imported("zed", tmp_path / "a.json", tmp_path)
    motion = MOTION.copy()
    if count == 18:
        motion[:, at("pelvis")] = middles(MOTION)[:, at("pelvis")]
    check(frames, ALL if count == 38 else PLAIN | {"ankle_l", "ankle_r"}, motion=motion)
    assert (frames.confidence[:, at("neck")] == 0.5).all()
    assert frames.capture_ns[0] == 1_700_000_000_000_000_000


def openpose_folder(folder: Path, *, flat: bool) -> Path:
    from tests.logs.test_presets import BODY_25, of_sdk

    folder.mkdir()
    for i in range(len(MOTION)):
        points = dict(zip(POINTS, MOTION[i], strict=True))
        person: dict[str, Any] = {"pose_keypoints_2d": [1.0] * 75, "pose_keypoints_3d": []}
        if not flat:
            person["pose_keypoints_3d"] = [v for name in BODY_25 for v in (*(1000 * of_sdk(name, points)), 0.7)]
        (folder / f"take_{i:012d}_keypoints.json").write_text(json.dumps({"version": 1.3, "people": [person]}))
    return folder


def test_openpose_in_space(tmp_path: Path) -> None:
    frames, notes = imported("openpose", openpose_folder(tmp_path / "a", flat=False), tmp_path, rate_hz=RATE)
    check(frames, BARE)
    assert tells(notes, "unit", "mm")
    assert tells(notes, "lack", "chest", "hands")
    with pytest.raises(SettingsError, match=facts("--rate")):
        import_files("openpose", [str(tmp_path / "a")], tmp_path / "b.mcap")


def test_openpose_in_the_image_is_refused(tmp_path: Path) -> None:
    folder = openpose_folder(tmp_path / "a", flat=True)
    with pytest.raises(LogError, match=facts("take_000000000000_keypoints.json", "triangulation", "pose_keypoints_3d")):
        imported("openpose", folder, tmp_path, rate_hz=RATE)


def test_ntu(tmp_path: Path) -> None:
    ids = (72057594037931101, 72057594037931102)
    frames_ = [{ids[0]: joints_of(25, dict(KINECT2_INDEX), i)} for i in range(len(MOTION))]
    frames_[4][ids[1]] = frames_[4][ids[0]] + 1.0
    frames_[9] = {}
    writers.ntu(tmp_path / "a.skeleton", frames_)
    frames, notes = imported("ntu", tmp_path / "a.skeleton", tmp_path)
    mine = frames.rows(frames.body == 0)
    np.testing.assert_allclose(mine.points_m, MOTION[np.arange(len(MOTION)) != 9], atol=1e-3)
    assert frames.body.tolist().count(1) == frames.body.tolist().count(NOBODY) == 1
    assert tells(notes, "30 Hz")
    text = (tmp_path / "a.skeleton").read_text()
    short = text.rsplit("\n", 10)[0]
    for spoilt, told in (
        (short, ("whole file",)),
        (text.replace("0.9 2", "0.9 7"), ("tracking state", "7", "0, 1 or 2")),
        ("x" + text, ("'x30'",)),
    ):
        (tmp_path / "b.skeleton").write_text(spoilt)
        with pytest.raises(LogError, match=facts("b.skeleton", *told)):
            import_files("ntu", [str(tmp_path / "b.skeleton")], tmp_path / "b.mcap")


@pytest.mark.parametrize(
    ("kind", "content", "told"),
    [
        ("k4abt", {"frames": 3}, ("frames", "'3'", "list")),
        ("k4abt", {"frames": [{"timestamp_usec": "now", "bodies": []}]}, ("frame 1", "timestamp_usec", "'now'")),
        ("k4abt", {"frames": [{"timestamp_usec": 1, "bodies": [{"body_id": 1, "joint_positions": [[1, 2]]}]}]}, ("3",)),
        ("k4abt", {"frames": [{"timestamp_usec": 1, "bodies": []}]}, ("no body",)),
        ("k4abt", {"frames": [{"timestamp_usec": 1 << 60, "bodies": []}]}, ("frame 1", "time")),
        ("k4abt", [1], ("frames", "list")),
        ("zed", {"1": {"timestamp": 1}}, ("frame 1", "body_list", "timestamp")),
        ("zed", {"1": {"timestamp": 1, "body_list": [{"id": 1, "keypoint": [[1, 2, 3]]}]}}, ("18, 34 or 38",)),
        ("openpose", {"people": [{"pose_keypoints_3d": [1, 2, 3]}]}, ("rows of 4",)),
        ("openpose", {"people": [{"pose_keypoints_3d": [0.1] * 72}]}, ("18", "BODY_25")),
        ("mediapipe", [{"a": 1}], ("a", "timestamp_ms", "landmark")),
    ],
)
def test_spoilt_json_says_where(kind: str, content: Any, told: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(LogError, match=facts("a.json", *told)):
        import_files(kind, [str(tmp_path / "a.json")], tmp_path / "b.mcap")
    for text in ("", "{", "[" * 100_000, "\0\xff"):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(LogError, match=facts("a.json")):
            import_files(kind, [str(tmp_path / "a.json")], tmp_path / "b.mcap")
    with pytest.raises(LogError, match=facts("none.json")):
        import_files(kind, [str(tmp_path / "none.json")], tmp_path / "b.mcap")


# --- motion capture ---


def test_trc(tmp_path: Path) -> None:
    """Names of joints, with a subject before; a lost marker is an empty field."""
    motion = MOTION.copy()
    motion[7, at("wrist_r")] = np.nan
    writers.trc(tmp_path / "a.trc", [f"Ann:{name}" for name in POINTS], motion)
    frames, _ = imported("trc", tmp_path / "a.trc", tmp_path)
    check(frames, ALL, motion=np.where(np.isnan(motion), np.nan, motion))
    assert frames.confidence[7, at("wrist_r")] == 0.0


GAIT = {"LASI": "hip_l", "RASI": "hip_r", "LPSI": "hip_l", "RPSI": "hip_r", "C7": "neck", "CLAV": "neck"} | {
    "LSHO": "shoulder_l", "RSHO": "shoulder_r", "LELB": "elbow_l", "RELB": "elbow_r", "LWRA": "wrist_l",
    "LWRB": "wrist_l", "RWRA": "wrist_r", "RWRB": "wrist_r", "LKNE": "knee_l", "RKNE": "knee_r",
    "LANK": "ankle_l", "RANK": "ankle_r",
}  # fmt: skip


def test_trc_of_markers_on_the_skin(tmp_path: Path) -> None:
    writers.trc(tmp_path / "a.trc", list(GAIT), np.stack([of(name) for name in GAIT.values()], axis=1), unit="m")
    frames, notes = imported("trc", tmp_path / "a.trc", tmp_path)
    check(frames, set(GAIT.values()) | {"pelvis"}, motion=middles(MOTION))
    assert set(np.unique(frames.confidence)) == {0.0, 0.5}
    assert tells(notes, "skin", "0.5")
    assert tells(notes, "lack", "chest", "head", "hands", "feet")


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_c3d(unit: str, tmp_path: Path) -> None:
    motion = MOTION.copy()
    motion[7, at("wrist_r")] = np.nan
    writers.c3d(tmp_path / "a.c3d", list(POINTS), motion, unit=unit)
    frames, _ = imported("c3d", tmp_path / "a.c3d", tmp_path)
    check(frames, ALL, motion=motion)
    (tmp_path / "b.c3d").write_bytes((tmp_path / "a.c3d").read_bytes()[:600])
    with pytest.raises(LogError, match=facts("b.c3d", "C3D")):
        import_files("c3d", [str(tmp_path / "b.c3d")], tmp_path / "b.mcap")


#: A skeleton in MotionBuilder's names: joint -> joint above, offset [cm], y up.
BVH = {
    "Hips": ("", (0.0, 0.0, 0.0)),
    "Spine": ("Hips", (0.0, 10.0, 0.0)),
    "Spine1": ("Spine", (0.0, 15.0, 1.0)),
    "Neck": ("Spine1", (0.0, 22.0, -1.0)),
    "Head": ("Neck", (0.0, 12.0, 2.0)),
    **{
        f"{side}{joint}": (f"{side}{above}" if above not in ("Hips", "Spine1") else above, (s * x, y, z))
        for side, s in (("Left", 1.0), ("Right", -1.0))
        for joint, above, (x, y, z) in (
            ("Shoulder", "Spine1", (3.0, 18.0, 0.0)),
            ("Arm", "Shoulder", (15.0, 0.0, 0.0)),
            ("ForeArm", "Arm", (29.0, 0.0, 0.0)),
            ("Hand", "ForeArm", (25.0, 0.0, 1.0)),
            ("UpLeg", "Hips", (9.0, -3.0, 0.0)),
            ("Leg", "UpLeg", (0.0, -43.0, 1.0)),
            ("Foot", "Leg", (0.0, -42.0, -1.0)),
            ("ToeBase", "Foot", (0.0, -6.0, 14.0)),
        )
    },
}
BVH_POINTS = {"pelvis": "Hips", "chest": "Spine1", "neck": "Neck", "head": "Head"} | {
    f"{point}_{side[0].lower()}": f"{side}{joint}"
    for side in ("Left", "Right")
    for point, joint in (
        *(("shoulder", "Arm"), ("elbow", "ForeArm"), ("wrist", "Hand"), ("hip", "UpLeg"), ("knee", "Leg")),
        *(("ankle", "Foot"), ("foot", "ToeBase"), ("hand", "Hand_end")),
    )
}


def turn(axis: str, degrees: float) -> Floats:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


def test_bvh(tmp_path: Path) -> None:
    """Angles drawn at random in each joint's own order of axes; places by matrices of this test."""
    rng = np.random.default_rng(3)
    orders = {joint: "".join(rng.permutation(list("XYZ"))) for joint in BVH}
    children: dict[str, list[str]] = {joint: [c for c, (above, _) in BVH.items() if above == joint] for joint in BVH}
    listed: list[str] = []

    def block(joint: str, depth: int) -> list[str]:
        listed.append(joint)
        pad = "\t" * depth
        word = "ROOT" if not BVH[joint][0] else "JOINT"
        turns = " ".join(f"{axis}rotation" for axis in orders[joint])
        channels = f"6 Xposition Yposition Zposition {turns}" if word == "ROOT" else f"3 {turns}"
        offset = " ".join(map(str, BVH[joint][1]))
        text = [f"{pad}{word} {joint}", f"{pad}{{", f"{pad}\tOFFSET {offset}", f"{pad}\tCHANNELS {channels}"]
        for child in children[joint]:
            text += block(child, depth + 1)
        if not children[joint]:
            text += [f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET 4 0 0", f"{pad}\t}}"]
        return [*text, f"{pad}}}"]

    hierarchy = block("Hips", 0)
    rows, right = [], []
    for i in range(40):
        root = np.array([5.0 * i, 95.0, 20.0])
        numbers = [*root]
        places: dict[str, tuple[Floats, Floats]] = {}
        for joint in listed:
            angles = dict(zip(orders[joint], rng.uniform(-40, 40, size=3), strict=True))
            numbers += list(angles.values())
            R = np.linalg.multi_dot([turn(axis, angle) for axis, angle in angles.items()])
            above, offset = BVH[joint]
            if above:
                R_above, p_above = places[above]
                places[joint] = (R_above @ R, p_above + R_above @ np.array(offset))
            else:
                places[joint] = (R, root)
        for side in ("Left", "Right"):
            R, p = places[f"{side}Hand"]
            places[f"{side}Hand_end"] = (R, p + R @ [4.0, 0.0, 0.0])
        rows.append(" ".join(f"{v:.6f}" for v in numbers))
        right.append([places[BVH_POINTS[name]][1] / 100.0 for name in POINTS])
    text = "\n".join(["HIERARCHY", *hierarchy, "MOTION", "Frames: 40", "Frame Time: 0.0333333", *rows])
    (tmp_path / "a.bvh").write_text(text)
    frames, notes = imported("bvh", tmp_path / "a.bvh", tmp_path)
    check(frames, ALL, motion=np.array(right))
    assert tells(notes, "unit", "cm")
    for spoilt, told in (
        (text.replace("MOTION", "MOVES"), ("'MOVES'", "MOTION")),
        (text.replace("Frames: 40", "Frames: 41"), ("40", "41")),
        (text.replace("0.0333333", "0"), ("Frame Time", "0")),
        (text.rpartition(" ")[0], ("columns",)),
        (text.replace("OFFSET 4 0 0", "OFFSET 4 0", 1), ("2 columns", "3")),
        (text.replace("6 Xposition", "5 Xposition"), ("channels",)),
    ):
        (tmp_path / "b.bvh").write_text(spoilt)
        with pytest.raises(LogError, match=facts("b.bvh", *told)):
            import_files("bvh", [str(tmp_path / "b.bvh")], tmp_path / "b.mcap")


MOTIVE = {"Hip": "pelvis", "Ab": "pelvis", "Chest": "chest", "Neck": "neck", "Head": "head"} | {
    f"{s}{bone}": f"{point}_{s.lower()}"
    for s in "LR"
    for bone, point in (
        *(("UArm", "shoulder"), ("FArm", "elbow"), ("Hand", "wrist"), ("Thigh", "hip"), ("Shin", "knee")),
        *(("Foot", "ankle"), ("Toe", "foot")),
    )
}


def test_optitrack_with_two_skeletons(tmp_path: Path) -> None:
    bodies = {
        who: {bone: of(name) + shift for bone, name in MOTIVE.items()} for who, shift in (("Ann", 0.0), ("Bob", 2.0))
    }
    bodies["Bob"] = {
        bone: np.where(np.arange(len(MOTION))[:, None] < 5, np.nan, xyz) for bone, xyz in bodies["Bob"].items()
    }
    writers.optitrack(tmp_path / "a.csv", bodies)
    frames, notes = imported("optitrack", tmp_path / "a.csv", tmp_path)
    check(frames.rows(frames.body == 0), ALL - {"hand_l", "hand_r"}, rate_hz=120.0)
    assert (frames.body == 1).sum() == len(MOTION) - 5
    bob = frames.rows(frames.body == 1)
    np.testing.assert_allclose(bob.points_m[:, at("neck")], of("neck")[5:] + 2.0, atol=1e-3)
    assert tells(notes, "lack", "hands")


SEGMENTS = {
    "Pelvis": "pelvis", "L5": "pelvis", "L3": "pelvis", "T12": "chest", "T8": "chest", "Neck": "neck", "Head": "head",
} | {
    f"{side}{segment}": f"{point}_{side[0].lower()}" if point else "neck"
    for side in ("Right", "Left")
    for segment, point in (("Shoulder", ""), ("UpperArm", "shoulder"), ("ForeArm", "elbow"), ("Hand", "wrist"))
} | {
    f"{side}{segment}": f"{point}_{side[0].lower()}"
    for side in ("Right", "Left")
    for segment, point in (("UpperLeg", "hip"), ("LowerLeg", "knee"), ("Foot", "ankle"), ("Toe", "foot"))
}  # fmt: skip


@pytest.mark.parametrize("listed", [True, False])
def test_mvnx(listed: bool, tmp_path: Path) -> None:
    places = np.stack([of(name) for name in SEGMENTS.values()], axis=1)
    writers.mvnx(tmp_path / "a.mvnx", list(SEGMENTS), places, listed=listed)
    frames, notes = imported("mvnx", tmp_path / "a.mvnx", tmp_path)
    check(frames, ALL - {"hand_l", "hand_r"}, rate_hz=60.0)
    assert tells(notes, "lack", "hands")
    (tmp_path / "b.mvnx").write_text((tmp_path / "a.mvnx").read_text()[:-30])
    with pytest.raises(LogError, match=facts("b.mvnx", "MVNX")):
        import_files("mvnx", [str(tmp_path / "b.mvnx")], tmp_path / "b.mcap")


# --- research sets ---

CHICO = (
    *("pelvis", "hip_r", "knee_r", "ankle_r", "hip_l", "knee_l", "ankle_l", "head", "neck"),
    *("shoulder_r", "elbow_r", "wrist_r", "shoulder_l", "elbow_l", "wrist_l"),
)


def test_chico(tmp_path: Path) -> None:
    """Lists of lists in mm, as the set's loader expects, and arrays."""
    robot = np.arange(27.0).reshape(9, 3)
    places = 1000 * np.stack([of(name) for name in CHICO], axis=1)
    for data in ([[frame.tolist(), robot.tolist()] for frame in places], [(frame, robot) for frame in places]):
        (tmp_path / "log.mcap").unlink(missing_ok=True)
        (tmp_path / "lift.pkl").write_bytes(pickle.dumps(data))
        frames, notes = imported("chico", tmp_path / "lift.pkl", tmp_path)
        check(frames, set(CHICO), rate_hz=25.0)
        assert tells(notes, "robot's 9 points", "angles")
        assert tells(notes, "lack", "chest", "hands", "feet")


def test_the_arm_of_chico_becomes_capsules(tmp_path: Path) -> None:
    """Where somebody says how thick it is, in the unit and axes of the person."""
    arm_m = np.cumsum(np.random.default_rng(3).normal(0.0, 0.1, (len(MOTION), 9, 3)), axis=1)
    places = np.stack([of(name) for name in CHICO], axis=1)
    turned = [1000 * points[..., [1, 2, 0]] * [1, -1, -1] for points in (places, arm_m)]
    (tmp_path / "lift.pkl").write_bytes(pickle.dumps(list(zip(*turned, strict=True))))
    mapping = 'robot_radius_m = 0.08\naxes = ["-z", "x", "-y"]\noffset_m = [0.5, 0.0, 0.1]'
    frames, notes = imported("chico", tmp_path / "lift.pkl", tmp_path, mapping=mapping)
    check(frames, set(CHICO), rate_hz=25.0, motion=MOTION + np.array([0.5, 0.0, 0.1]))
    assert tells(notes, "8 capsules", "robot_radius_m", "T_world_base")
    log = open_log(tmp_path / "log.mcap")
    track = log.capsules()
    assert track is not None
    numbers = track.numbers.q.reshape(len(MOTION), 8, 7)
    np.testing.assert_allclose(numbers[..., 0:3], arm_m[:, :-1] + [0.5, 0.0, 0.1], atol=1e-9)
    np.testing.assert_allclose(numbers[..., 3:6], arm_m[:, 1:] + [0.5, 0.0, 0.1], atol=1e-9)
    assert set(numbers[..., 6].ravel()) == {0.08}
    np.testing.assert_array_equal(track.numbers.t_ns, frames.capture_ns)


HARPER = (
    *("pelvis", "pelvis", "chest", "neck", "head", "neck", "shoulder_l", "elbow_l", "wrist_l"),
    *("neck", "shoulder_r", "elbow_r", "wrist_r", "hip_l", "knee_l", "ankle_l", "foot_l"),
    *("hip_r", "knee_r", "ankle_r", "foot_r"),
)


def test_harper(tmp_path: Path) -> None:
    places = np.stack([of(name) for name in HARPER], axis=1)
    data = {
        4 * i: {
            "frame": 4 * i,
            "subject": "a",
            "action": "b",
            "human_joints_3d": places[i],
            "spot_joints_3d": np.zeros((22, 3)),
        }
        for i in range(len(MOTION))
    }
    (tmp_path / "cun_act1_30hz.pkl").write_bytes(pickle.dumps(data))
    frames, notes = imported("harper", tmp_path / "cun_act1_30hz.pkl", tmp_path)
    check(frames, set(HARPER))
    assert tells(notes, "robot's 22 points")
    (tmp_path / "other.pkl").write_bytes(pickle.dumps(data))
    with pytest.raises(SettingsError, match=facts("other.pkl", "--rate")):
        import_files("harper", [str(tmp_path / "other.pkl")], tmp_path / "b.mcap")


class Evil:
    """Runs a command where it is unpickled without care."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


def test_absurd_coordinates_are_made_missing(tmp_path: Path) -> None:
    records = writers.wide(MOTION, [i / RATE for i in range(len(MOTION))])
    records[4]["head_y"] = 1e200
    frames, notes = imported("table", write_table(tmp_path / "a.jsonl", records), tmp_path, mapping=WIDE)
    assert np.isnan(frames.points_m[4, at("head")]).all()
    assert frames.confidence[4, at("head")] == 0.0
    assert np.isfinite(frames.points_m[5, at("head")]).all()
    assert tells(notes, "1 points", "missing")


@pytest.mark.parametrize("kind", ["chico", "harper"])
def test_pickles_run_nothing(kind: str, tmp_path: Path) -> None:
    touched = tmp_path / "touched"
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps([Evil(touched)]))
    with pytest.raises(LogError, match=facts("evil.pkl", "safely")):
        import_files(kind, [str(tmp_path / "evil.pkl")], tmp_path / "b.mcap")
    assert not touched.exists()
    pickle.loads((tmp_path / "evil.pkl").read_bytes())  # noqa: S301 - shows that it would
    assert touched.exists()
    for data in (b"", b"\x80\x05garbage", pickle.dumps({"a": object()})):
        (tmp_path / "bad.pkl").write_bytes(data)
        with pytest.raises(LogError, match=facts("bad.pkl")):
            unpickle_arrays(tmp_path / "bad.pkl")
    for protocol in range(3, pickle.HIGHEST_PROTOCOL + 1):  # those of Python 3
        (tmp_path / "good.pkl").write_bytes(pickle.dumps([np.arange(6.0).reshape(2, 3), np.float64(3.0)], protocol))
        np.testing.assert_array_equal(unpickle_arrays(tmp_path / "good.pkl")[0], np.arange(6.0).reshape(2, 3))


# --- files as users reported them ---


@pytest.mark.parametrize(
    ("kind", "name", "told"),
    [
        ("openpose", "000000000000_keypoints.json", ("0.5 to 2.3 m",)),
        ("mediapipe", "mediapipe.csv", ("times as tall", "index")),
        ("optitrack", "optitrack.csv", ("Skel:Hip", "X, Y", "Z")),
        ("mvnx", "take.mvnx", ("frame 0", "3", "69")),
        ("bvh", "walk.bvh", ("0.5 to 2.3 m",)),
        ("zed", "zed_bodies.json", ("0.5 to 2.3 m",)),
    ],
)
def test_reported_files_are_refused_with_the_reason(
    kind: str, name: str, told: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(LogError, match=facts(name, *told)):
        import_files(kind, [str(data_path(f"reported/txt/{name}"))], tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()


def test_reported_c3d_without_content_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=facts("walk.c3d", "C3D")):
        import_files("c3d", [str(data_path("reported/txt/walk.c3d"))], tmp_path / "a.mcap")


@pytest.mark.parametrize(
    ("kind", "name", "rows"),
    [
        ("k4abt", "azure_offline.json", 60),
        ("azure", "azure_timestamp_ms.csv", 60),
        ("azure", "azure_timestamp_s.csv", 60),
        ("ntu", "S001C001P001R001A001.skeleton", 1),
        ("trc", "walk.trc", 1),
    ],
)
def test_reported_files_are_read(kind: str, name: str, rows: int, tmp_path: Path) -> None:
    import_files(kind, [str(data_path(f"reported/txt/{name}"))], tmp_path / "a.mcap")
    log = open_log(tmp_path / "a.mcap")
    frames = CameraFrames.join(list(log.frames()))
    assert len(frames) == rows
    if rows > 1:
        (stature,) = log.stature_m.values()
        assert 1.6 < stature < 1.95


def test_mediapipe_as_reported_is_read_with_the_order_of_its_points(tmp_path: Path) -> None:
    """The reported file holds Azure joints in MediaPipe's columns."""
    frames, _ = imported("mediapipe", data_path("reported/txt/mediapipe.csv"), tmp_path, mapping='index = "points"')
    assert len(frames) > 20


@pytest.mark.parametrize(
    ("name", "kinds"),
    [("walk.bvh", "bvh"), ("walk.c3d", "c3d"), ("azure_offline.json", "k4abt"), ("optitrack.csv", "optitrack")],
)
def test_opening_such_a_file_as_a_log_names_the_import(name: str, kinds: str) -> None:
    with pytest.raises(LogError, match=facts("hrcreplay import", kinds, name)):
        open_log(data_path(f"reported/txt/{name}"))


def test_help_and_guide_name_every_kind() -> None:
    command = typer.main.get_command(app).commands["import"]  # type: ignore[attr-defined]
    kinds = next(parameter for parameter in command.params if parameter.name == "kind").help
    guide = (Path(__file__).parents[2] / "docs" / "guide.md").read_text()
    for kind in FORMATS:
        assert tells(kinds, kind)
        assert f"`{kind}`" in guide
    with pytest.raises(SettingsError, match=facts("'abc'", *FORMATS, "azure", "kinect2", "keraal")):
        import_files("abc", ["a"], Path("b.mcap"))
