"""Described and shipped message types: a known motion written by rosbags' types comes back within 1 mm."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from hrcreplay.calibration.cell import Cell
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs import presets
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.records import NOBODY, POINTS, CameraFrames, Floats
from hrcreplay.settings.sections import Decoder, Logs
from tests.facts import facts, tells
from tests.logs import own
from tests.logs.bags import KINDS, bag, define, header, make, point, transform
from tests.realdata import data_path
from tests.reobserve import walker

BEGIN, STEP = own.BEGIN_NS, 33_000_000
MOTION = walker(1.0).points_m
FAR = np.array([0.5, -0.4, 3.0])  # from the camera, so that no point is at its origin


def at(name: str) -> int:
    return POINTS.index(name)


def body(frame: int, other: int = 0) -> dict[str, Floats]:
    """Points of a person in a frame, by name; another person is 2 m beside."""
    return dict(zip(POINTS, MOTION[frame] + FAR + [2.0 * other, 0.0, 0.0], strict=True))


def truth(frames: CameraFrames, number: int = 0, other: int = 0) -> tuple[Floats, Floats]:
    """Points that a body of the log has, and those it should have."""
    mine = frames.rows(frames.body == number)
    step = (mine.capture_ns - BEGIN) // STEP
    return mine.points_m, np.array([MOTION[k] + FAR + [2.0 * other, 0.0, 0.0] for k in step])


def check(frames: CameraFrames, has: set[str], number: int = 0, other: int = 0, rows: int = 20) -> None:
    """The body has these points within 1 mm, and no others."""
    found, right = truth(frames, number, other)
    assert len(found) == rows
    if "chest" not in has and "foot_l" not in has:  # such trackers have no pelvis: it is the middle of the hips
        right[:, at("pelvis")] = right[:, [at("hip_l"), at("hip_r")]].mean(axis=1)
    known = [at(name) for name in POINTS if name in has]
    np.testing.assert_allclose(found[:, known], right[:, known], atol=1e-3)
    assert np.isnan(np.delete(found, known, axis=1)).all()


def write_frames(path: Path, kind: str, topic: str, msgtype: str, one: Callable[[Typestore, int], Any]) -> Path:
    with bag(path, kind) as (write, store):
        for frame in range(20):
            stamp = BEGIN + frame * STEP
            write(topic, msgtype, stamp + 5_000_000, one(store, stamp))
    return path


def frame_at(stamp: int) -> int:
    return (stamp - BEGIN) // STEP


# --- ZED ---

ZED = (
    ("zed_msgs/msg/Keypoint3D", "float32[3] kp"),
    ("zed_msgs/msg/Skeleton3D", "zed_msgs/Keypoint3D[70] keypoints"),
    (
        "zed_msgs/msg/Object",
        """string label
        int16 label_id
        float32 confidence
        bool skeleton_available
        int8 body_format
        zed_msgs/Skeleton3D skeleton_3d
        float32[70] skeleton_keypoint_confidence""".replace("  ", ""),
    ),
    ("zed_msgs/msg/ObjectsStamped", "std_msgs/Header header\nzed_msgs/Object[] objects"),
)
#: Names of the SDK in its own order, left and right in pairs.
_PAIRS_38 = (
    *("EYE", "EAR", "CLAVICLE", "SHOULDER", "ELBOW", "WRIST", "HIP", "KNEE", "ANKLE", "BIG_TOE", "SMALL_TOE", "HEEL"),
    *("HAND_THUMB_4", "HAND_INDEX_1", "HAND_MIDDLE_4", "HAND_PINKY_1"),
)
BODY_38 = (
    *("PELVIS", "SPINE_1", "SPINE_2", "SPINE_3", "NECK", "NOSE"),
    *(f"{side}_{name}" for name in _PAIRS_38 for side in ("LEFT", "RIGHT")),
)
BODY_18 = (
    *("NOSE", "NECK", "RIGHT_SHOULDER", "RIGHT_ELBOW", "RIGHT_WRIST", "LEFT_SHOULDER", "LEFT_ELBOW", "LEFT_WRIST"),
    *("RIGHT_HIP", "RIGHT_KNEE", "RIGHT_ANKLE", "LEFT_HIP", "LEFT_KNEE", "LEFT_ANKLE"),
    *("RIGHT_EYE", "LEFT_EYE", "RIGHT_EAR", "LEFT_EAR"),
)
BODY_25 = (
    *(*BODY_18[:8], "MID_HIP", *BODY_18[8:]),
    *("LEFT_BIG_TOE", "LEFT_SMALL_TOE", "LEFT_HEEL", "RIGHT_BIG_TOE", "RIGHT_SMALL_TOE", "RIGHT_HEEL"),
)
PLAIN = {"pelvis", "neck", "head", *(f"{j}_{s}" for j in ("shoulder", "elbow", "wrist", "hip", "knee") for s in "lr")}
ANKLES = {"ankle_l", "ankle_r"}
FEET = {"foot_l", "foot_r"}
HANDS = {"hand_l", "hand_r"}


def of_sdk(name: str, points: dict[str, Floats]) -> Floats:
    """Where a keypoint of such a name is on a person: ears beside the head, knuckles beside the hand."""
    side, _, rest = name.partition("_")
    s, sign = {"LEFT": ("l", 1.0), "RIGHT": ("r", -1.0)}.get(side, ("", 0.0))
    aside = sign * np.array([0.0, 0.08, 0.0])
    known = {"PELVIS": "pelvis", "MID_HIP": "pelvis", "SPINE_3": "chest", "NECK": "neck"}
    if name in known:
        return points[known[name]]
    if rest == "EAR":
        return points["head"] + aside
    if rest in ("HAND_INDEX_1", "HAND_PINKY_1"):
        return points[f"hand_{s}"] + (0.03 if "INDEX" in rest else -0.03) * np.array([1.0, 0.5, 0.0])
    if rest == "BIG_TOE":
        return points[f"foot_{s}"]
    return points.get(f"{rest.lower()}_{s}", points["head"] + np.array([0.3, 0.3, 0.3]))


def zed_object(store: Typestore, stamp: int, order: tuple[str, ...], body_format: int, other: int) -> Any:
    points = body(frame_at(stamp), other)
    places = [of_sdk(name, points) for name in order] + [np.full(3, np.nan)] * (70 - len(order))
    keypoints = [make(store, "zed_msgs/msg/Keypoint3D", kp=xyz.astype(np.float32)) for xyz in places]
    certain = np.full(70, 75.0, dtype=np.float32)
    certain[len(order) :] = np.nan
    return make(
        store,
        "zed_msgs/msg/Object",
        label="Person",
        label_id=10 + other,
        skeleton_available=True,
        body_format=body_format,
        skeleton_3d=make(store, "zed_msgs/msg/Skeleton3D", keypoints=keypoints),
        skeleton_keypoint_confidence=certain,
    )


@pytest.mark.parametrize(
    ("order", "body_format", "has"),
    [(BODY_18, 0, PLAIN | ANKLES), (BODY_38, 2, set(POINTS))],
)
def test_zed_bodies_of_several_people(order: tuple[str, ...], body_format: int, has: set[str], tmp_path: Path) -> None:
    def message(store: Typestore, stamp: int) -> Any:
        if "zed_msgs/msg/Object" not in store.types:
            for name, definition in ZED:
                define(store, name, definition)
        objects = [zed_object(store, stamp, order, body_format, other) for other in (0, 1)]
        if frame_at(stamp) == 7:
            objects = []
        return make(store, "zed_msgs/msg/ObjectsStamped", header=header(store, stamp, "zed_left"), objects=objects)

    with bag(tmp_path / "a", "mcap") as (write, store):
        for name, definition in ZED:
            define(store, name, definition)
        for frame in range(20):
            stamp = BEGIN + frame * STEP
            write("/zed/body_trk", "zed_msgs/msg/ObjectsStamped", stamp, message(store, stamp))
    log = open_log(tmp_path / "a")
    frames = CameraFrames.join(list(log.frames(nobody=True)))
    assert frames.cameras == ("zed_body_trk",)
    check(frames, has, 10, 0, rows=19)
    check(frames, has, 11, 1, rows=19)
    assert (frames.body == NOBODY).sum() == 1
    np.testing.assert_allclose(frames.confidence[0, at("knee_l")], 0.75)
    if has != set(POINTS):
        assert tells(log.notes, "/zed/body_trk", "chest", "hands", "feet")


def test_zed_body_of_an_unknown_format_is_somebody(tmp_path: Path) -> None:
    """An object without a readable skeleton gives no row, and does not show that nobody is there."""
    with bag(tmp_path / "a", "mcap") as (write, store):
        for name, definition in ZED:
            define(store, name, definition)
        for frame in range(20):
            stamp = BEGIN + frame * STEP
            objects = [zed_object(store, stamp, BODY_38, 3 if frame % 2 else 2, 0)]
            content = make(store, "zed_msgs/msg/ObjectsStamped", header=header(store, stamp), objects=objects)
            write("/zed", "zed_msgs/msg/ObjectsStamped", stamp, content)
    frames = CameraFrames.join(list(open_log(tmp_path / "a").frames(nobody=True)))
    assert frames.body.tolist() == [10] * 10


# --- other types ---


def test_ros_openpose(tmp_path: Path) -> None:
    def message(store: Typestore, stamp: int) -> Any:
        persons = []
        for other in (0, 1):
            points = body(frame_at(stamp), other)
            parts = [
                make(store, "ros_openpose/msg/BodyPart", score=0.5, point=point(store, of_sdk(name, points), "Point32"))
                for name in BODY_25
            ]
            persons.append(make(store, "ros_openpose/msg/Person", bodyParts=parts))
        return make(store, "ros_openpose/msg/Frame", header=header(store, stamp, "cam"), persons=persons)

    with bag(tmp_path / "a.bag", "ros1") as (write, store):
        define(store, "ros_openpose/msg/BodyPart", "float32 score\ngeometry_msgs/Point32 point")
        define(store, "ros_openpose/msg/Person", "ros_openpose/BodyPart[] bodyParts")
        define(store, "ros_openpose/msg/Frame", "std_msgs/Header header\nros_openpose/Person[] persons")
        for frame in range(20):
            write("/frame", "ros_openpose/msg/Frame", BEGIN + frame * STEP, message(store, BEGIN + frame * STEP))
    log = open_log(tmp_path / "a.bag")
    frames = own.read(log)
    for other in (0, 1):
        check(frames, PLAIN | ANKLES | FEET, other, other)
    assert (frames.confidence[:, at("neck")] == 0.5).all()
    assert tells(log.notes, "/frame", "chest", "hands")


HIROS_1 = (
    ("skeleton_msgs/msg/Point", "geometry_msgs/Point position\ngeometry_msgs/Vector3 velocity"),
    ("skeleton_msgs/msg/Marker", "int32 id\nfloat64 confidence\nskeleton_msgs/Point point"),
    ("skeleton_msgs/msg/MarkerGroup", "int32 id\nskeleton_msgs/Marker[] markers"),
    ("skeleton_msgs/msg/Skeleton", "int32 id\nskeleton_msgs/MarkerGroup[] marker_groups"),
    ("skeleton_msgs/msg/SkeletonGroup", "std_msgs/Header header\nskeleton_msgs/Skeleton[] skeletons"),
)
HIROS_2 = (
    ("hiros_skeleton_msgs/msg/KinematicState", "geometry_msgs/Pose pose"),
    (
        "hiros_skeleton_msgs/msg/Marker",
        "int32 id\nstring name\nfloat64 confidence\nhiros_skeleton_msgs/KinematicState center",
    ),
    ("hiros_skeleton_msgs/msg/Skeleton", "int32 id\nhiros_skeleton_msgs/Marker[] markers"),
    ("hiros_skeleton_msgs/msg/SkeletonGroup", "std_msgs/Header header\nhiros_skeleton_msgs/Skeleton[] skeletons"),
)


def write_hiros_1(path: Path) -> Path:
    with bag(path, "ros1") as (write, store):
        for name, definition in HIROS_1:
            define(store, name, definition)
        for frame in range(20):
            stamp, kind = BEGIN + frame * STEP, "skeleton_msgs/msg/"
            markers = [
                make(
                    store,
                    kind + "Marker",
                    id=k,
                    confidence=1.0,
                    point=make(store, kind + "Point", position=point(store, xyz)),
                )
                for k, xyz in enumerate(body(frame).values())
            ]
            halves = [make(store, kind + "MarkerGroup", id=i, markers=markers[i * 10 : i * 10 + 10]) for i in (0, 1)]
            skeleton = make(store, kind + "Skeleton", id=4, marker_groups=halves)
            group = make(store, kind + "SkeletonGroup", header=header(store, stamp), skeletons=[skeleton])
            write("/skeletons", kind + "SkeletonGroup", stamp, group)
    return path


def test_hiros_by_names(tmp_path: Path) -> None:
    with bag(tmp_path / "a", "mcap") as (write, store):
        for name, definition in HIROS_2:
            define(store, name, definition)
        for frame in range(20):
            stamp, kind = BEGIN + frame * STEP, "hiros_skeleton_msgs/msg/"
            named = {
                f"{'Left' if n[-1] == 'l' else 'Right'} {n[:-2]}" if n[-2:-1] == "_" else n: xyz
                for n, xyz in body(frame).items()
            }
            markers = []
            for k, (name, xyz) in enumerate(reversed(named.items())):
                pose = make(store, "geometry_msgs/msg/Pose", position=point(store, xyz))
                center = make(store, kind + "KinematicState", pose=pose)
                markers.append(make(store, kind + "Marker", id=k, name=name, confidence=0.9, center=center))
            skeleton = make(store, kind + "Skeleton", id=4, markers=markers)
            group = make(store, kind + "SkeletonGroup", header=header(store, stamp), skeletons=[skeleton])
            write("/skeletons", kind + "SkeletonGroup", stamp, group)
    frames = own.read(open_log(tmp_path / "a"))
    check(frames, set(POINTS), 4)
    assert (frames.confidence == 0.9).all()


def test_hiros_by_ids_needs_an_index(tmp_path: Path) -> None:
    path = write_hiros_1(tmp_path / "a.bag")
    with pytest.raises(LogError, match=facts("/skeletons", "0, 1, 2, 3, 4, 5", "index")):
        open_log(path)
    index: dict[str, int | str] = {name: k for k, name in enumerate(POINTS)}
    decoder = Decoder(topic="/skeletons", preset="hiros", index=index)
    check(own.read(open_log(path, Logs(decoders=(decoder,)))), set(POINTS), 4)


def test_arrays_of_poses_by_order_unit_and_axes(tmp_path: Path) -> None:
    """The message is in cm, y down: x of the log is x of the message, y is z, z is -y."""

    def message(store: Typestore, stamp: int) -> Any:
        poses = []
        for x, y, z in body(frame_at(stamp)).values():
            poses.append(make(store, "geometry_msgs/msg/Pose", position=point(store, (100 * x, -100 * z, 100 * y))))
        return make(store, "geometry_msgs/msg/PoseArray", header=header(store, stamp, "cam"), poses=poses)

    path = write_frames(tmp_path / "a", "db3", "/skeleton", "geometry_msgs/msg/PoseArray", message)
    with pytest.raises(LogError, match=facts("no skeleton", "/skeleton", "'poses' (up to 20)", "[[logs.decoders]]")):
        open_log(path)
    how = Decoder(
        topic="/skeleton", preset="posearray", index="points", unit="cm", axes=("x", "z", "-y"), confidence=0.4
    )
    log = open_log(path, Logs(decoders=(how,)))
    frames = own.read(log)
    assert log.header.cameras == ("skeleton",)
    check(frames, set(POINTS))
    assert (frames.confidence == 0.4).all()


def test_numbers_one_after_another(tmp_path: Path) -> None:
    def message(store: Typestore, stamp: int) -> Any:
        rows = [[*xyz, 0.8] for xyz in body(frame_at(stamp)).values()]
        return make(store, "std_msgs/msg/Float32MultiArray", data=np.array(rows, dtype=np.float32).ravel())

    path = write_frames(tmp_path / "a", "mcap", "/landmarks", "std_msgs/msg/Float32MultiArray", message)
    given = {"topic": "/landmarks", "points": "data", "index": "points", "stamp": None, "confidence": "3"}
    frames = own.read(open_log(path, Logs(decoders=(Decoder(**given, numbers=4),))))
    np.testing.assert_allclose(frames.points_m[11], MOTION[11] + FAR, atol=1e-3)
    np.testing.assert_allclose(frames.confidence, 0.8, atol=1e-6)
    with pytest.raises(LogError, match=facts("'data'", "80", "7", "numbers")):
        own.read(open_log(path, Logs(decoders=(Decoder(**given, numbers=7),))))


@pytest.mark.parametrize(
    "change", [{"confidence": "poses.orientation"}, {"confidence": "header"}, {"body": "orientation"}]
)
def test_parts_of_another_kind_say_where(change: dict[str, Any], tmp_path: Path) -> None:
    def message(store: Typestore, stamp: int) -> Any:
        poses = [make(store, "geometry_msgs/msg/Pose", position=point(store, xyz)) for xyz in body(0).values()]
        return make(store, "geometry_msgs/msg/PoseArray", header=header(store, stamp, "cam"), poses=poses)

    path = write_frames(tmp_path / "a", "mcap", "/skeleton", "geometry_msgs/msg/PoseArray", message)
    how = Decoder(topic="/skeleton", points="poses", index="points", **change)
    with pytest.raises(LogError, match=facts("/skeleton (geometry_msgs/PoseArray)")):
        own.read(open_log(path, Logs(decoders=(how,))))


def test_markers_by_namespace_and_alpha(tmp_path: Path) -> None:
    """Markers of a layout of one's own: bodies by namespace, names in the text, confidence in the alpha."""

    def message(store: Typestore, stamp: int) -> Any:
        markers = []
        for other in (0, 1):
            for k, (name, xyz) in enumerate(body(frame_at(stamp), other).items()):
                markers.append(
                    make(
                        store, "visualization_msgs/msg/Marker", header=header(store, stamp, "cam"), ns=f"{other + 5}",
                        id=1000 + 7 * k, text=name,
                        pose=make(store, "geometry_msgs/msg/Pose", position=point(store, xyz)),
                        color=make(store, "std_msgs/msg/ColorRGBA", a=0.25),
                    )
                )  # fmt: skip
        return make(store, "visualization_msgs/msg/MarkerArray", markers=markers)

    path = write_frames(tmp_path / "a", "mcap", "/m", "visualization_msgs/msg/MarkerArray", message)
    how = Decoder(
        topic="/m", camera="c", points="markers", body="ns", name="text", position="pose", index="names",
        stamp="markers.0.header.stamp | header.stamp", confidence="color.a",
    )  # fmt: skip
    frames = own.read(open_log(path, Logs(decoders=(how,))))
    for other in (0, 1):
        check(frames, set(POINTS), other + 5, other)
    assert (frames.confidence == 0.25).all()


# --- the language ---


def test_middles_and_alternatives() -> None:
    found = presets.places({"pelvis": "Left_Hip + right hip", "head": "Nose | 7"})
    assert found == {"pelvis": (("lefthip", "righthip"),), "head": (("nose",), ("7",))}


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"points": "p", "index": {"nose": 1}}, "nose"),
        ({"points": "p", "axes": ("x", "y", "-z")}, "mirror"),
        ({"points": "p", "axes": ("x", "x", "z")}, "each axis once"),
        ({}, "neither points, frames nor preset"),
    ],
)
def test_descriptions_that_cannot_be_right(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        Decoder(topic="/a", **given)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"preset": "kinect9"}, ("'kinect9'", "zed", "hiros")),
        ({"points": "poses", "index": "body99"}, ("'body99'", "body25")),
    ],
)
def test_unknown_presets_and_orders(given: dict[str, Any], told: tuple[str, ...], tmp_path: Path) -> None:
    def message(store: Typestore, stamp: int) -> Any:
        return make(store, "geometry_msgs/msg/PoseArray", header=header(store, stamp))

    path = write_frames(tmp_path / "a", "mcap", "/p", "geometry_msgs/msg/PoseArray", message)
    with pytest.raises(SettingsError, match=facts("/p", *told)):
        own.read(open_log(path, Logs(decoders=(Decoder(topic="/p", **given),))))


def test_shipped_orders_name_every_side_right() -> None:
    """Left points of named orders name left joints; numbered ones have left and right apart."""
    for name in (
        "names",
        "hri",
        "mediapipe",
        "body25",
        "coco17",
        "zed18",
        "zed34",
        "zed38",
        "azure",
        "kinect2",
        "points",
    ):
        index = presets.order(name, "here")
        assert set(index) <= set(POINTS)
        for given, expression in index.items():
            for key in str(expression).replace("+", "|").split("|"):
                key = key.strip()
                if key.isdigit():
                    assert given[-2:] not in ("_l", "_r") or key != str(
                        index[given[:-1] + {"l": "r", "r": "l"}[given[-1]]]
                    )
                elif given[-2:] in ("_l", "_r"):
                    assert ("right" in key or key.startswith("r_") or key.endswith("_r")) == (given[-1] == "r"), key
    names = {"LEFT": "l", "RIGHT": "r"}
    for order, sdk in (("zed38", BODY_38), ("zed18", BODY_18), ("body25", BODY_25)):
        for given, expression in presets.order(order, "here").items():
            for key in str(expression).split("+"):
                side = sdk[int(key)].partition("_")[0]
                assert given[-2:] not in ("_l", "_r") or names[side] == given[-1]


# --- transforms ---

JOINTS = {"torso": "chest", "neck": "neck", "head": "head"} | {
    f"{side}_{joint}": f"{joint}_{side[0]}"
    for side in ("left", "right")
    for joint in ("shoulder", "elbow", "hand", "hip", "knee", "foot")
}
KINECT_2 = {"SpineMid": "chest", "SpineShoulder": "neck", "Neck": "head", "Head": "head", "SpineBase": "pelvis"} | {
    f"{joint.title()}{side}": f"{joint}_{side[0].lower()}"
    for side in ("Left", "Right")
    for joint in ("shoulder", "elbow", "wrist", "hand", "hip", "knee", "ankle", "foot")
}


def write_tf(path: Path, kind: str, name: Callable[[str], str], joints: dict[str, str], parent: str = "cam") -> Path:
    msgtype = "tf2_msgs/msg/TFMessage"
    with bag(path, kind) as (write, store):
        for frame in range(20):
            stamp, points = BEGIN + frame * STEP, body(frame)
            sent = [transform(store, stamp, parent, name(joint), points[at_]) for joint, at_ in joints.items()]
            write("/tf", msgtype, stamp + 5_000_000, make(store, msgtype, transforms=sent))
            robot = [transform(store, stamp, "base_link", f"link_{k}", (0, 0, k)) for k in range(1, 8)]
            write("/tf", msgtype, stamp + 6_000_000, make(store, msgtype, transforms=robot))
    return path


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("pattern", "number"),
    [
        ("{}_3", 3),
        ("kinect/{}_3", 3),
        ("/cob_body_tracker/user_3/{}", 3),
        ("tracker/user_3/{}", 3),
        ("user_3/{}", 3),
        ("3/{}", 3),
        ("user_3_{}", 3),
        ("{}", 0),
    ],
)
def test_frames_by_pattern(pattern: str, number: int, kind: str, tmp_path: Path) -> None:
    path = write_tf(tmp_path / ("a.bag" if kind == "ros1" else "a"), kind, pattern.format, JOINTS)
    frames = own.read(open_log(path))
    assert frames.cameras == ("cam",)
    mine = frames.rows(frames.body == number)
    assert len(mine) in (19, 20)  # the last frame of unknown joints is complete with the next one
    right = MOTION[(mine.capture_ns - BEGIN) // STEP] + FAR
    for name in JOINTS.values():
        np.testing.assert_allclose(mine.points_m[:, at(name)], right[:, at(name)], atol=1e-3)
    hips = right[:, [at("hip_l"), at("hip_r")]].mean(axis=1)
    np.testing.assert_allclose(mine.points_m[:, at("pelvis")], hips, atol=1e-3)
    np.testing.assert_allclose(mine.points_m[:, at("wrist_l")], right[:, at("hand_l")], atol=1e-3)


def test_kinect2_frames(tmp_path: Path) -> None:
    log = open_log(write_tf(tmp_path / "a", "mcap", "{}_1".format, KINECT_2))
    mine = own.read(log)
    right = MOTION[(mine.capture_ns - BEGIN) // STEP] + FAR
    np.testing.assert_allclose(mine.points_m, right, atol=1e-3)  # all points, and the shoulder line for the neck


def test_frames_of_other_names_by_a_decoder(tmp_path: Path) -> None:
    words = {
        "busto": "chest",
        "testa": "head",
        "collo": "neck",
        "spalla_sinistra": "shoulder_l",
        "mano_sinistra": "wrist_l",
    }
    words |= {"spalla_destra": "shoulder_r", "gomito_sinistro": "elbow_l", "gomito_destro": "elbow_r"}
    path = write_tf(tmp_path / "a", "mcap", "p/{}_12".format, words)
    with pytest.raises(LogError, match=facts("no skeleton", "p/busto_12", "frames", "index")):
        open_log(path)
    index: dict[str, int | str] = {point_: word for word, point_ in words.items()}
    how = Decoder(topic="/tf", frames=("*/{joint}_{user}",), index=index)
    frames = own.read(open_log(path, Logs(decoders=(how,))))
    check(frames, set(words.values()), 12, rows=len(frames))
    with pytest.raises(LogError, match=facts("/tf", "six joints", "p/busto_12")):
        open_log(path, Logs(decoders=(Decoder(topic="/tf", frames=("{joint}",), index=index),)))


def chained(store: Typestore, stamp: int, links: dict[str, tuple[str, Any, Any]]) -> list[Any]:
    """Transforms with rotations: child -> parent, position, rotation vector."""
    sent = []
    for child, (parent, xyz, turn) in links.items():
        one = transform(store, stamp, parent, child, xyz)
        x, y, z, w = (float(v) for v in Rotation.from_rotvec(turn).as_quat())
        one.transform.rotation = make(store, "geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        sent.append(one)
    return sent


def test_ros4hri_chain_with_fixed_joints(tmp_path: Path) -> None:
    """Joints in one another, turned; wrists fixed to elbows on /tf_static; compared with matrices."""
    rng = np.random.default_rng(1)
    who, msgtype = "hxtbq", "tf2_msgs/msg/TFMessage"
    tree = {"waist": "body", "torso": "waist", "r_head": "torso", "head": "r_head"}
    for s in "lr":
        tree |= {f"{s}_y_shoulder": "torso", f"{s}_shoulder": f"{s}_y_shoulder", f"{s}_elbow": f"{s}_shoulder"}
        tree |= {f"{s}_hip": "body", f"{s}_knee": f"{s}_hip"}
    fixed = {f"{s}_wrist": f"{s}_elbow" for s in "lr"}
    offset = {joint: rng.normal(scale=0.2, size=3) for joint in (*tree, *fixed)}
    right = []
    with bag(tmp_path / "a", "mcap") as (write, store):
        still = {f"{j}_{who}": (f"{p}_{who}", offset[j], [0.0, 0.0, 0.0]) for j, p in fixed.items()}
        write("/tf_static", msgtype, BEGIN, make(store, msgtype, transforms=chained(store, BEGIN, still)))
        for frame in range(20):
            stamp = BEGIN + frame * STEP
            turn = {joint: rng.normal(scale=0.5, size=3) for joint in ("body", *tree)}
            root = np.array([0.1 * frame, 0.2, 3.0])
            poses = {"body": (Rotation.from_rotvec(turn["body"]).as_matrix(), root)}
            for joint, parent in tree.items():
                R, p = poses[parent]
                poses[joint] = (R @ Rotation.from_rotvec(turn[joint]).as_matrix(), R @ offset[joint] + p)
            for joint, parent in fixed.items():
                R, p = poses[parent]
                poses[joint] = (R, R @ offset[joint] + p)
            right.append({joint: p for joint, (_, p) in poses.items()})
            links = {f"body_{who}": ("cam", root, turn["body"])}
            write("/tf", msgtype, stamp + 1, make(store, msgtype, transforms=chained(store, stamp, links)))
            links = {f"{j}_{who}": (f"{p}_{who}", offset[j], turn[j]) for j, p in tree.items()}
            write("/tf", msgtype, stamp + 2, make(store, msgtype, transforms=chained(store, stamp, links)))
    log = open_log(tmp_path / "a")
    assert log.header.cameras == ("cam",)
    frames = own.read(log)
    assert len(frames) in (19, 20)
    names = {"pelvis": "waist", "neck": "torso", "head": "head"}
    names |= {f"{j}_{s}": f"{s}_{j}" for j in ("shoulder", "elbow", "wrist", "hip", "knee") for s in "lr"}
    for k, stamp in enumerate(frames.capture_ns):
        for name, joint in names.items():
            wanted = right[frame_at(int(stamp))][joint]
            np.testing.assert_allclose(frames.points_m[k, at(name)], wanted, atol=1e-3, err_msg=name)
    assert np.isnan(frames.points_m[:, at("ankle_l")]).all()
    assert tells(log.notes, "/tf", "chest", "ankles", "feet")


# --- /tf_static ---


def with_static(path: Path, links: dict[str, tuple[str, Any, Any]], parent: str = "cam_optical") -> Path:
    msgtype = "tf2_msgs/msg/TFMessage"
    with bag(path, "mcap") as (write, store):
        write("/tf_static", msgtype, BEGIN, make(store, msgtype, transforms=chained(store, BEGIN, links)))
        for frame in range(20):
            stamp, points = BEGIN + frame * STEP, body(frame)
            sent = [transform(store, stamp, parent, f"{joint}_1", points[name]) for joint, name in JOINTS.items()]
            write("/tf", msgtype, stamp, make(store, msgtype, transforms=sent))
    return path


def test_static_transforms_place_cameras_and_robot(tmp_path: Path) -> None:
    links = {
        "cam_link": ("world", [1.0, 2.0, 1.5], [0.0, 0.3, 0.2]),
        "cam_optical": ("cam_link", [0.0, 0.05, 0.0], [1.0, -0.5, 0.0]),
        "base_link": ("world", [0.2, 0.0, 0.65], [0.0, 0.0, np.pi / 2]),
    }
    log = open_log(with_static(tmp_path / "a", links))
    a, b = (np.eye(4) for _ in range(2))
    a[:3, :3], a[:3, 3] = Rotation.from_rotvec(links["cam_link"][2]).as_matrix(), links["cam_link"][1]
    b[:3, :3], b[:3, 3] = Rotation.from_rotvec(links["cam_optical"][2]).as_matrix(), links["cam_optical"][1]
    np.testing.assert_allclose(log.header.T_world_camera["cam_optical"], a @ b, atol=1e-12)
    base = [[0.0, -1.0, 0.0, 0.2], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.65], [0.0, 0.0, 0.0, 1.0]]
    assert log.header.T_world_base is not None
    np.testing.assert_allclose(log.header.T_world_base, base, atol=1e-12)
    assert tells(log.notes, "/tf_static", "cam_optical", "base_link", "world", "floor")


def test_static_poses_do_not_count_beside_a_cells_cameras(tmp_path: Path) -> None:
    """A cell's world is another one than that of /tf_static."""
    links = {"cam_optical": ("world", [1.0, 2.0, 1.5], [0, 0, 0]), "base_link": ("world", [0.2, 0.0, 0.65], [0, 0, 0])}
    header_ = open_log(with_static(tmp_path / "a", links)).header
    assert header_.poses_beside({"cam_optical": np.eye(4)}) == ({}, None)
    cameras, base = header_.poses_beside(Cell().T_world_camera)
    assert list(cameras) == ["cam_optical"]
    assert base is header_.T_world_base is not None


@pytest.mark.parametrize(
    "links",
    [
        {"cam_optical": ("camera_link", [0, 0, 0], [0, 0, 0])},  # its root is no world
        {"cam_optical": ("gripper", [0, 0, 0], [0, 0, 0]), "base_link": ("cell", [0, 0, 0], [0, 0, 0])},
    ],
)
def test_static_transforms_that_lead_to_no_world(links: dict[str, Any], tmp_path: Path) -> None:
    log = open_log(with_static(tmp_path / "a", links))
    assert log.header.T_world_camera == {}
    assert log.header.T_world_base is None
    with pytest.raises(LogError, match=facts("logs.world_frame", "'hall'", "cam_optical")):
        open_log(tmp_path / "a", Logs(world_frame="hall"))


def test_world_and_base_frames_of_the_settings(tmp_path: Path) -> None:
    links = {"cam_optical": ("cell", [1, 0, 2], [0, 0, 0]), "panda_link0": ("cell", [0, 1, 0], [0, 0, 0])}
    header_ = open_log(with_static(tmp_path / "a", links), Logs(world_frame="cell", base_frame="panda_link0")).header
    assert header_.T_world_camera["cam_optical"][:3, 3].tolist() == [1.0, 0.0, 2.0]
    assert header_.T_world_base is not None
    assert header_.T_world_base[:3, 3].tolist() == [0.0, 1.0, 0.0]


# --- logs as users reported them ---


def opened(name: str, **given: Any) -> tuple[Log, CameraFrames]:
    log = open_log(data_path(f"reported/{name}"), Logs(**given))
    frames = own.read(log)
    log.check()
    return log, frames


REPORTED = {  # whole bodies of 8 s at 30 Hz, or 3 s
    "tf_azure_names": 240, "tf_cob_user": 240, "tf_kinect2": 240, "tf_kinect_prefix": 240, "tf_ros4hri": 240,
    "tf_tracker_user": 240, "dec_hiros": 90,
}  # fmt: skip


@pytest.mark.parametrize("name", REPORTED)
def test_reported_logs_are_read(name: str) -> None:
    log, frames = opened(name)
    assert abs(len(frames) - REPORTED[name]) <= 1
    (stature,) = log.stature_m.values()
    assert 1.6 < stature < 1.95


@pytest.mark.parametrize(
    ("name", "decoder"),
    [
        ("dec_zed", {"topic": "/zed/zed_node/body_trk/skeletons", "preset": "zed", "index": "points"}),
        ("dec_ros_openpose", {"topic": "/frame", "preset": "ros_openpose", "index": "points"}),
        ("dec_posearray", {"topic": "/skeleton", "preset": "posearray", "index": "points"}),
        (
            "dec_float_array",
            {"topic": "/mediapipe/world_landmarks", "points": "data", "numbers": 4, "index": "points", "stamp": None},
        ),
    ],
)
def test_reported_messages_are_read_by_a_decoder(name: str, decoder: dict[str, Any]) -> None:
    """Without one they are left out with the reason: the points are not in the order that the type says."""
    with pytest.raises(LogError, match=facts("no skeleton", "[[logs.decoders]]")):
        open_log(data_path(f"reported/{name}"))
    log, frames = opened(name, decoders=(Decoder(**decoder),))
    assert len(frames) == 90
    (stature,) = log.stature_m.values()
    assert 1.6 < stature < 1.95
    hiros = opened("dec_hiros")[1]  # the same motion
    np.testing.assert_allclose(frames.points_m[:, at("neck")], hiros.points_m[:, at("neck")], atol=1e-3)


def test_reported_static_extrinsics() -> None:
    log, _ = opened("tf_static_extrinsics")
    assert sorted(log.header.T_world_camera) == ["cam_a_depth_frame", "cam_b_depth_frame"]
    assert log.header.T_world_base is not None
    np.testing.assert_allclose(log.header.T_world_base[:3, 3], [0.2, 0.0, 0.65])
    with pytest.raises(LogError, match=facts("two cameras")):
        opened("tf_same_parent_two_cameras")
    assert set(opened("tf_two_users")[1].body) == {1, 2}
