"""Markers whose meaning is spoilt, a test a kind: ids, namespaces, frames, types, units, alpha. Nothing is misread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.errors import LogError
from hrcreplay.logs.messages import AZURE_INDEX
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.records import NOBODY, POINTS, CameraFrames, Floats
from hrcreplay.settings.sections import Decoder, Logs
from tests.facts import facts, tells
from tests.logs import own
from tests.logs.bags import OPENNI, bag, define, header, make, point, transform
from tests.reobserve import walker

BEGIN, PERIOD = own.BEGIN_NS, own.PERIOD_NS
TOPIC, TYPE = "/people", "visualization_msgs/msg/MarkerArray"
SPHERE, CUBE_LIST, CYLINDER, TEXT = 2, 6, 3, 9
ELBOW_R = 13
FRAMES = 40


def people(count: int) -> list[Floats]:
    """(frames, 20, 3) points [m] of people who walk behind one another, 1 m apart."""
    return [walker(FRAMES / 30.0).points_m + np.array([0.0, 1.0 * number, 2.0]) for number in range(count)]


def joints(points: Floats) -> Iterator[tuple[int, Floats]]:
    """Joint of the Azure Kinect and place of each point of a body (20, 3)."""
    for joint, at in AZURE_INDEX.items():
        yield joint, points[at]


def marker(store: Any, stamp_ns: int, at: Any, **given: Any) -> Any:
    values: dict[str, Any] = {"frame": "camera_link", "ns": "", "id": 0, "type": SPHERE, "alpha": 1.0}
    values |= given
    return make(
        store,
        "visualization_msgs/msg/Marker",
        header=header(store, stamp_ns, values["frame"]),
        ns=values["ns"],
        id=values["id"],
        type=values["type"],
        color=make(store, "std_msgs/msg/ColorRGBA", a=values["alpha"]),
        pose=make(store, "geometry_msgs/msg/Pose", position=point(store, at)),
    )


Spec = Callable[[int], Iterator[tuple[Any, dict[str, Any]]]]  #: frame -> places and fields of its markers


def written(path: Path, spec: Spec, topic: str = TOPIC, kind: str = "mcap") -> Path:
    with bag(path, kind) as (write, store):
        for frame in range(FRAMES):
            stamp_ns = BEGIN + frame * PERIOD
            found = [marker(store, stamp_ns, at, **given) for at, given in spec(frame)]
            write(topic, TYPE, stamp_ns + 5_000_000, make(store, TYPE, markers=found))
    return path


def by_ids(bodies: list[Floats], ids_per_body: int, first: int = 0, **given: Any) -> Spec:
    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        for number, points in enumerate(bodies):
            for joint, at in joints(points[frame]):
                yield at, {"id": (first + number) * ids_per_body + joint} | given

    return spec


def assert_bodies(log: Log, bodies: dict[int, Floats], camera: int = 0) -> None:
    """The log holds exactly these bodies, every point in its place."""
    frames = own.read(log)
    mine = frames.rows(frames.camera == camera)
    assert set(mine.body.tolist()) == set(bodies)
    for number, points in bodies.items():
        np.testing.assert_allclose(mine.points_m[mine.body == number], points, atol=1e-12)
    log.check()


def told(log: Log) -> str:
    own.read(log)
    return "\n".join(log.notes)


@pytest.mark.parametrize("ids_per_body", [100, 33, 32])
@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_ids_of_three_bodies(ids_per_body: int, kind: str, tmp_path: Path) -> None:
    bodies = people(3)
    path = written(tmp_path / "a.bag", by_ids(bodies, ids_per_body), kind=kind)
    assert_bodies(open_log(path), dict(enumerate(bodies)))


@pytest.mark.parametrize("gone", [None, 2, 3], ids=["an empty array", "DELETE", "DELETEALL"])
def test_an_array_without_markers_shows_nobody(gone: int | None, tmp_path: Path) -> None:
    """Delivered to who asks for it, captured the camera's usual delay before it came; and no body to anybody else."""
    bodies, path = people(1), tmp_path / "a"
    with bag(path, "mcap") as (write, store):
        for frame in range(FRAMES):
            stamp_ns = BEGIN + frame * PERIOD
            found = [marker(store, stamp_ns, at, **given) for at, given in by_ids(bodies, 100)(frame)]
            if frame >= 30:
                found = [] if gone is None else [make(store, "visualization_msgs/msg/Marker", action=gone)]
            write(TOPIC, TYPE, stamp_ns + 5_000_000, make(store, TYPE, markers=found))
    assert_bodies(open_log(path), {0: bodies[0][:30]})
    frames = CameraFrames.join(list(open_log(path).frames(nobody=True)))
    empty = frames.rows(frames.body == NOBODY)
    np.testing.assert_array_equal(empty.capture_ns, BEGIN + np.arange(30, FRAMES) * PERIOD)
    assert np.isnan(empty.points_m).all()
    assert not empty.confidence.any()
    assert (frames.body != NOBODY).sum() == 30


def test_an_array_of_two_cameras_without_markers_says_nothing(tmp_path: Path) -> None:
    bodies = people(2)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        if frame < 30:
            yield from by_ids(bodies[:1], 100, frame="left")(frame)
            yield from by_ids(bodies[1:], 100, first=1, frame="right")(frame)

    frames = list(open_log(written(tmp_path / "a", spec)).frames(nobody=True))
    assert not (CameraFrames.join(frames).body == NOBODY).any()


def test_second_body_that_comes_late_decides_the_ids(tmp_path: Path) -> None:
    bodies = people(2)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        yield from by_ids(bodies if frame > 30 else bodies[:1], 33)(frame)

    log = open_log(written(tmp_path / "a", spec))
    frames = own.read(log)
    assert (frames.body == 1).sum() == FRAMES - 31
    first = open_log(tmp_path / "a")
    early = own.read(first, end_ns=BEGIN + 20 * PERIOD)  # a span knows of the whole
    np.testing.assert_array_equal(early.points_m, bodies[0][:20])


def test_ids_that_fit_no_known_number_need_the_setting(tmp_path: Path) -> None:
    bodies = people(2)
    path = written(tmp_path / "a", by_ids(bodies, 40), topic="/body_tracking_data")
    with pytest.raises(LogError, match=facts("66", "logs.marker_ids_per_body")):
        open_log(path)
    assert_bodies(open_log(path, Logs(marker_ids_per_body=40)), dict(enumerate(bodies)))


@pytest.mark.parametrize("names", [("body_3", "body_8"), ("3", "8"), ("tracker/user3", "tracker/user8")])
def test_bodies_in_numbered_namespaces(names: tuple[str, ...], tmp_path: Path) -> None:
    bodies = people(2)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        for name, points in zip(names, bodies, strict=True):
            yield from by_ids([points], 100, ns=name)(frame)

    assert_bodies(open_log(written(tmp_path / "a", spec)), {3: bodies[0], 8: bodies[1]})


def test_bodies_in_named_namespaces(tmp_path: Path) -> None:
    bodies = people(2)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        for name, points in zip(("worker", "visitor"), bodies, strict=True):
            yield from by_ids([points], 100, ns=name)(frame)

    log = open_log(written(tmp_path / "a", spec))
    frames = own.read(log)
    numbers = frames.body.tolist()
    assert len(set(numbers)) == 2
    assert numbers[::2] == numbers[:1] * FRAMES  # each name keeps its number
    for number in set(numbers):
        points = frames.points_m[frames.body == number]
        assert any(np.array_equal(points, body) for body in bodies)


def test_two_bodies_under_the_same_ids_are_refused(tmp_path: Path) -> None:
    bodies = people(2)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        for points in bodies:
            yield from by_ids([points], 100)(frame)

    with pytest.raises(LogError, match=r"two .*\bid \d+"):
        open_log(written(tmp_path / "a", spec))


def test_two_bodies_under_the_same_ids_in_two_messages_are_refused(tmp_path: Path) -> None:
    bodies = people(2)
    with bag(tmp_path / "a", "mcap") as (write, store):
        for frame in range(FRAMES):
            stamp_ns = BEGIN + frame * PERIOD
            for later_ns, points in enumerate(bodies):
                found = [marker(store, stamp_ns, at, id=joint) for joint, at in joints(points[frame])]
                write(TOPIC, TYPE, stamp_ns + 5_000_000 + later_ns, make(store, TYPE, markers=found))
    log = open_log(tmp_path / "a")
    own.read(log)
    assert log.defects["frames_contradicting"] == FRAMES
    with pytest.raises(LogError, match=facts("camera people", f"{FRAMES} of {2 * FRAMES}")):
        log.check()


def test_two_cameras_on_one_topic(tmp_path: Path) -> None:
    left, right = people(2)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        name, points = ("left_link", left) if frame % 2 == 0 else ("right_link", right)
        yield from by_ids([points], 100, frame=name)(frame)

    log = open_log(written(tmp_path / "a", spec))
    assert log.header.cameras == ("left_link", "right_link")
    assert_bodies(log, {0: left[::2]}, camera=0)
    assert_bodies(log, {0: right[1::2]}, camera=1)


def test_a_second_camera_that_starts_late_names_both(tmp_path: Path) -> None:
    (points,) = people(1)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        yield from by_ids([points], 100, frame="right_link" if frame == FRAMES - 1 else "left_link")(frame)

    assert open_log(written(tmp_path / "a", spec)).header.cameras == ("left_link", "right_link")


def test_two_cameras_under_one_frame_are_refused(tmp_path: Path) -> None:
    left, right = people(2)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        yield from by_ids([left if frame % 2 == 0 else right], 100)(frame)

    log = open_log(written(tmp_path / "a", spec))
    own.read(log)
    with pytest.raises(LogError, match=r"camera people: .*\b1\.0\d m"):
        log.check()


def test_two_people_whose_ids_are_exchanged_are_no_two_cameras(tmp_path: Path) -> None:
    bodies = people(2)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        yield from by_ids(bodies if frame % 2 == 0 else bodies[::-1], 100)(frame)

    log = open_log(written(tmp_path / "a", spec))
    assert len(own.read(log)) == 2 * FRAMES
    log.check()


def test_bones_and_texts_beside_the_joints_are_no_people(tmp_path: Path) -> None:
    (points,) = people(1)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        yield from by_ids([points], 100)(frame)
        yield from by_ids([points + 0.1], 100, ns="bones", type=CYLINDER)(frame)
        yield from by_ids([points + 0.2], 100, ns="names", type=TEXT)(frame)

    assert_bodies(open_log(written(tmp_path / "a", spec)), {0: points})


@pytest.mark.parametrize("kind", [SPHERE, CUBE_LIST])
def test_markers_that_are_no_people_are_left_out_and_told(kind: int, tmp_path: Path) -> None:
    (points,) = people(1)
    cells = np.random.default_rng(3).uniform(-2, 2, size=(1, 20, 3)).repeat(FRAMES, axis=0)
    with bag(tmp_path / "a", "mcap") as (write, store):
        for frame in range(FRAMES):
            stamp_ns = BEGIN + frame * PERIOD
            for topic, body, of in ((TOPIC, points, SPHERE), ("/occupied_cells", cells, kind)):
                found = [marker(store, stamp_ns, at, id=joint, type=of) for joint, at in joints(body[frame])]
                write(topic, TYPE, stamp_ns + 5_000_000, make(store, TYPE, markers=found))
    log = open_log(tmp_path / "a")
    assert log.header.cameras == ("people",)
    assert tells(told(log), "/occupied_cells", "left out")
    assert_bodies(log, {0: points})
    with pytest.raises(LogError, match=facts("no skeletons", "/occupied_cells")):
        open_log(tmp_path / "a", Logs(topics=("/occupied_cells",)))


def test_joints_in_another_order_are_refused(tmp_path: Path) -> None:
    (points,) = people(1)
    order = np.random.default_rng(5).permutation(20)
    path = written(tmp_path / "a", by_ids([points[:, order]], 100), topic="/body_tracking_data")
    with pytest.raises(LogError, match=facts("/body_tracking_data", "no person")):
        open_log(path)


def test_alpha_that_differs_is_the_confidence(tmp_path: Path) -> None:
    (points,) = people(1)

    def spec(frame: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        for joint, at in joints(points[frame]):
            yield at, {"id": joint, "alpha": 0.0 if joint == ELBOW_R else 0.5 if joint == 0 and frame > 20 else 1.0}

    log = open_log(written(tmp_path / "a", spec))
    frames = own.read(log)
    elbow, pelvis = POINTS.index("elbow_r"), POINTS.index("pelvis")
    assert (frames.confidence[:, elbow] == 0).all()
    assert np.isnan(frames.points_m[:, elbow]).sum() in (0, 3 * FRAMES)
    assert (frames.confidence[:, pelvis] == np.where(np.arange(FRAMES) > 20, 0.5, 1.0)).all()
    assert "alpha" in "".join(log.notes)


@pytest.mark.parametrize("alpha", [0.0, 0.3])
def test_one_alpha_for_all_says_nothing(alpha: float, tmp_path: Path) -> None:
    frames = own.read(open_log(written(tmp_path / "a", by_ids(people(1), 100, alpha=alpha))))
    assert (frames.confidence == 1.0).all()


def test_millimetres_are_refused_and_the_remedy_works(tmp_path: Path) -> None:
    (points,) = people(1)
    path = written(tmp_path / "a", by_ids([1e3 * points], 100))
    log = open_log(path)
    own.read(log)
    with pytest.raises(LogError, match=facts("millimetres", "logs.unit=mm")):
        log.check()
    assert_bodies(open_log(path, Logs(unit="mm")), {0: points})


# --- transforms and described messages ---


def test_transforms_in_millimetres(tmp_path: Path) -> None:
    with bag(tmp_path / "a", "mcap") as (write, store):
        for i, joint in enumerate(OPENNI):
            sent = transform(store, BEGIN, "cam", f"{joint}_1", [1000.0 * i, 500.0, 2000.0])
            message = make(store, "tf2_msgs/msg/TFMessage", transforms=[sent])
            write("/tf", "tf2_msgs/msg/TFMessage", BEGIN + i, message)
    frames = own.read(open_log(tmp_path / "a", Logs(unit="mm")))
    np.testing.assert_allclose(frames.points_m[0, POINTS.index("head")], [OPENNI.index("head"), 0.5, 2.0])


def test_transforms_of_unknown_names_are_told_with_those_that_are_known(tmp_path: Path) -> None:
    with bag(tmp_path / "a", "mcap") as (write, store):
        for i, joint in enumerate(("Kopf", "Hals", "Rumpf", "Schulter_l", "Schulter_r", "Hand_l", "Hand_r")):
            message = make(
                store, "tf2_msgs/msg/TFMessage", transforms=[transform(store, BEGIN, "cam", joint, [i, 0, 1])]
            )
            write("/tf", "tf2_msgs/msg/TFMessage", BEGIN + i, message)
    with pytest.raises(LogError, match=facts("/tf", "Kopf, Hals", "head_1")):
        open_log(tmp_path / "a")


DEFINITION = "std_msgs/Header header\ngeometry_msgs/Point[] joints\ngeometry_msgs/Pose[] poses\nfloat32[] scores"


def lab_bag(path: Path, scores: list[float]) -> Path:
    with bag(path, "mcap") as (write, store):
        define(store, "lab/msg/Person", DEFINITION)
        places = [point(store, at) for at in people(1)[0][0]]
        person = make(
            store, "lab/msg/Person", header=header(store, BEGIN), joints=places, scores=np.array(scores, np.float32)
        )
        write("/lab", "lab/msg/Person", BEGIN + 9_000_000, person)
    return path


def described(**given: Any) -> Logs:
    index = {name: i for i, name in enumerate(POINTS)}
    return Logs(decoders=(Decoder(topic="/lab", camera="c", points="joints", index=index, **given),))


def test_arrays_that_a_decoder_could_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=facts("/lab (lab/Person)", "'joints' (up to 20)")):
        open_log(lab_bag(tmp_path / "a", []))


def test_no_stamp_takes_the_arrival(tmp_path: Path) -> None:
    path = lab_bag(tmp_path / "a", [])
    assert own.read(open_log(path, described())).capture_ns.tolist() == [BEGIN]
    for none in ("none", None):
        assert own.read(open_log(path, described(stamp=none))).capture_ns.tolist() == [BEGIN + 9_000_000]


def test_confidences_in_percent_are_refused(tmp_path: Path) -> None:
    path = lab_bag(tmp_path / "a", [88.0] * 20)
    with pytest.raises(LogError, match=facts("88", "'scores'")):
        own.read(open_log(path, described(confidence="scores")))
    assert (own.read(open_log(path, described(confidence="none"))).confidence == 1.0).all()
