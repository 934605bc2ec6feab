from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from hrcreplay.errors import SettingsError
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.reader import open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import NOBODY, CameraFrames
from tests.facts import facts
from tests.logs import own
from tests.visits import visit_log

POSE = np.array([[0.0, -1.0, 0.0, 1.5], [1.0, 0.0, 0.0, -0.25], [0.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 1.0]])
TASK = {"name": "pick", "waypoints": [{"joints_deg": [0, 10.5, -3], "speed_m_per_s": 0.25}]}


def test_all_that_is_written_is_read_back(tmp_path: Path) -> None:
    frames = own.frames(300)
    truth_ns = frames.capture_ns[::3]
    truth_m = np.random.default_rng(1).normal(size=(100, 20, 3)).astype(np.float32).astype(np.float64)
    q = np.random.default_rng(2).normal(size=(300, 6))
    with LogWriter(tmp_path / "session.mcap") as writer:
        writer.camera("right", POSE)
        writer.task(TASK)
        writer.frames(frames.rows(slice(0, 100)))
        writer.frames(frames.rows(slice(100, 300)))
        writer.truth(truth_ns, truth_m)
        writer.joints([f"joint_{i}" for i in range(6)], frames.capture_ns, q)
        writer.base(POSE)

    log = open_log(tmp_path / "session.mcap")
    assert log.header.kind == "hrcreplay"
    assert log.header.cameras == ("right", "left")  # in the order in which they were declared
    assert set(log.header.T_world_camera) == {"right"}
    np.testing.assert_array_equal(log.header.T_world_camera["right"], POSE)
    assert log.header.task == TASK
    assert log.header.T_world_base is not None
    np.testing.assert_array_equal(log.header.T_world_base, POSE)
    assert log.header.has_truth
    assert log.header.joint_topics == ("/robot/joints",)
    assert log.header.end_ns == frames.arrival_ns[-1]

    back = own.read(log)
    for name in ("capture_ns", "arrival_ns", "body", "points_m"):
        np.testing.assert_array_equal(getattr(back, name), getattr(frames, name))
    np.testing.assert_array_equal(back.confidence, frames.confidence)
    assert [back.cameras[i] for i in back.camera] == [frames.cameras[i] for i in frames.camera]
    truth = list(log.truth())
    np.testing.assert_array_equal(np.concatenate([t.t_ns for t in truth]), truth_ns)
    np.testing.assert_array_equal(np.concatenate([t.points_m for t in truth]), truth_m)
    track = log.joints([f"joint_{i}" for i in range(6)])
    assert track is not None
    np.testing.assert_array_equal(track.q, q)
    np.testing.assert_array_equal(track.t_ns, frames.capture_ns)


def test_missing_points_stay_missing(tmp_path: Path) -> None:
    frames = own.frames(2)
    points, confidence = frames.points_m.copy(), frames.confidence.copy()
    points[0, 3] = np.nan
    confidence[0, 3] = 0.0
    table = CameraFrames(
        frames.capture_ns, frames.arrival_ns, frames.camera, frames.body, points, confidence, frames.cameras
    )
    log = open_log(own.write(tmp_path / "a.mcap", table))
    back = own.read(log)
    assert np.isnan(back.points_m[0, 3]).all()
    assert np.isfinite(back.points_m).sum() == 2 * 60 - 3
    assert log.defects["points_not_finite"] == 0  # it is said to be missing


def test_camera_that_never_delivers_is_in_the_header(tmp_path: Path) -> None:
    path = own.write(tmp_path / "a.mcap", own.frames(4), cameras={"third": None})
    assert open_log(path).header.cameras == ("third", "left", "right")


def test_first_capture_at_zero_is_a_time(tmp_path: Path) -> None:
    frames = own.frames(3, cameras=("one",))
    table = CameraFrames(
        frames.capture_ns - own.BEGIN_NS, frames.arrival_ns - own.BEGIN_NS, frames.camera, frames.body,
        frames.points_m, frames.confidence, frames.cameras,
    )  # fmt: skip
    log = open_log(own.write(tmp_path / "a.mcap", table))
    assert own.read(log).capture_ns.tolist() == [0, own.PERIOD_NS, 2 * own.PERIOD_NS]
    assert log.defects["frames_header_stamp_zero"] == 0


def test_same_calls_give_same_bytes(tmp_path: Path) -> None:
    one, two = (own.write(tmp_path / name, own.frames(500), cameras={"left": POSE}) for name in ("1.mcap", "2.mcap"))
    assert one.read_bytes() == two.read_bytes()


def test_file_is_zstd_with_an_index_and_keeps_both_clocks(tmp_path: Path) -> None:
    frames = own.frames(2000)
    path = own.write(tmp_path / "a.mcap", frames)
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        assert len(summary.chunk_indexes) > 1
        first = next(message for _, channel, message in reader.iter_messages() if "skeleton" in channel.topic)
        assert (first.log_time, first.publish_time) == (frames.arrival_ns[0], frames.capture_ns[0])


def test_existing_file_is_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("mine")
    with pytest.raises(SettingsError, match=facts("a.mcap", "exists")):
        LogWriter(path)
    assert path.read_text() == "mine"


def test_file_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = LogWriter(path)
    with pytest.raises(SettingsError, match=facts("a.mcap", "exists")), writer:
        writer.frames(own.frames(4))
        path.write_text("mine")
    assert path.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_left_after_an_error(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "a.mcap")
    with pytest.raises(KeyError), writer:
        writer.frames(own.frames(4))
        raise KeyError
    assert list(tmp_path.iterdir()) == []


def test_folder_that_is_not_there(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "none" / "a.mcap")
    with pytest.raises(SettingsError, match=facts("none/a.mcap", "cannot be written")), writer:
        pass


@pytest.mark.parametrize("name", ["", "a/b"])
def test_camera_names_that_make_no_topic(tmp_path: Path, name: str) -> None:
    with LogWriter(tmp_path / "a.mcap") as writer, pytest.raises(SettingsError, match="camera"):
        writer.camera(name)


def test_generated_messages_are_those_of_the_schema() -> None:
    text = Path(pb.__file__).with_name("skeleton.proto").read_text()
    told = {
        name: re.findall(r"(\w+) = (\d+);", body)
        for name, body in re.findall(r"message (\w+) {(.*?)\n}", text, re.DOTALL)
    }
    made = {
        name: [(field.name, str(field.number)) for field in message.fields]
        for name, message in pb.DESCRIPTOR.message_types_by_name.items()
    }
    assert made == told


def test_frames_of_nobody_come_back_to_who_asks_for_them(tmp_path: Path) -> None:
    log = visit_log(tmp_path / "a.mcap", lambda s: {} if s < 0.5 else {3: (2.0, 0.0)}, 1.0)
    assert {*CameraFrames.join(list(open_log(log).frames())).body.tolist()} == {3}
    frames = CameraFrames.join(list(open_log(log).frames(nobody=True)))
    assert {*frames.body.tolist()} == {3, NOBODY}
    assert (frames.body == NOBODY).sum() == 2 * 16
    with LogWriter(tmp_path / "again.mcap") as writer:
        writer.frames(frames)
    again = CameraFrames.join(list(open_log(tmp_path / "again.mcap").frames(nobody=True)))
    np.testing.assert_array_equal(again.body, frames.body)
    np.testing.assert_array_equal(again.capture_ns, frames.capture_ns)


def test_a_body_with_the_id_of_nobody_is_a_body(tmp_path: Path) -> None:
    table = CameraFrames.join(list(open_log(visit_log(tmp_path / "a.mcap", lambda _s: {3: (2.0, 0.0)}, 0.2)).frames()))
    with LogWriter(tmp_path / "b.mcap") as writer:
        writer.frames(replace(table, body=np.full(len(table), NOBODY)))
    found = CameraFrames.join(list(open_log(tmp_path / "b.mcap").frames()))
    assert len(found) == len(table)
    assert (found.body != NOBODY).all()


def test_an_empty_table_adds_nothing(tmp_path: Path) -> None:
    full, table = tmp_path / "full.mcap", own.frames(12)
    own.write(full, table)
    own.write(tmp_path / "also.mcap", table, table.rows(slice(0, 0)))
    assert (tmp_path / "also.mcap").read_bytes() == full.read_bytes()
