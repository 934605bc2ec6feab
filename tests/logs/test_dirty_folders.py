from __future__ import annotations

import io
import shutil
import sqlite3
from pathlib import Path

import pytest
from mcap.writer import Writer
from ruamel.yaml import YAML

from hrcreplay.errors import LogError
from hrcreplay.logs.log_files import open_source
from hrcreplay.logs.reader import open_log
from tests.facts import facts, tells
from tests.logs import own
from tests.logs.bags import bag, write_openni
from tests.realdata import data_path

BEGIN = own.BEGIN_NS
RESOURCES = "ros_bags/rosbag2/rosbag2_py/test/resources"


# --- what is no log, or an empty one ---


@pytest.mark.parametrize(
    "name", ["ros_bags/empty-file.bag", "ros_bags/no-messages.bag", "ros_bags/rosbag2/ros2bag/test/resources/empty_bag"]
)
def test_empty_logs(name: str) -> None:
    with pytest.raises(LogError, match=facts(Path(name).name, "no messages")):
        open_log(data_path(name))


def test_empty_mcap(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    writer = Writer(buffer)
    writer.start()
    writer.finish()  # type: ignore[no-untyped-call]
    (tmp_path / "a.mcap").write_bytes(buffer.getvalue())
    with pytest.raises(LogError, match=facts("a.mcap", "no messages")):
        open_log(tmp_path / "a.mcap")


def test_paths_that_are_no_log(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "image.bag").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "folder").mkdir()
    (tmp_path / "wrong").mkdir()
    (tmp_path / "wrong" / "metadata.yaml").write_text("a: [")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "metadata.yaml").write_text("a: 1")
    for name, found_and_right in {
        "none.mcap": ("no such file",),
        "notes.txt": ("known", "MCAP"),
        "image.bag": ("known", "MCAP"),
        "folder": ("metadata.yaml", "MCAP"),
        "wrong": ("metadata.yaml", "ROS 2 bag"),
        "other": ("metadata.yaml", "ROS 2 bag"),
    }.items():
        with pytest.raises(LogError, match=facts(str(tmp_path / name), *found_and_right)) as caught:
            open_log(tmp_path / name)
        assert "\n" not in str(caught.value)


# --- ROS 2 folders that promise more than they hold ---


def promise(folder: Path, n: int) -> None:
    yaml = YAML()
    metadata = yaml.load(folder / "metadata.yaml")
    metadata["rosbag2_bagfile_information"]["message_count"] = n
    yaml.dump(metadata, folder / "metadata.yaml")


def test_messages_that_rosbags_loses_in_silence_are_read() -> None:
    source = open_source(data_path(f"{RESOURCES}/sqlite3/talker"))
    assert {t.name: t.count for t in source.topics()} == {"/topic": 10, "/rosout": 10, "/parameter_events": 0}
    assert len(list(source.messages(["/topic", "/rosout"]))) == 20
    texts = [message.read().data for message in source.messages(["/topic"])]
    assert texts == [f"Hello, world! {k}" for k in range(10)]


def test_promise_of_messages_where_none_are(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    shutil.copytree(data_path(f"{RESOURCES}/sqlite3/talker"), folder)
    folder.chmod(0o755)
    for file in folder.iterdir():
        file.chmod(0o644)
    database = sqlite3.connect(folder / "talker.db3")
    with database:
        database.execute("update messages set topic_id = 99")  # they are there, but belong to nothing
    assert tells(open_source(folder).damage().notes, "talker.db3-wal", "left out")
    database.close()
    with pytest.raises(LogError, match=facts("metadata.yaml", "20 messages", "none")):
        open_log(folder)


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_promise_of_more_messages_than_there_are(tmp_path: Path, kind: str) -> None:
    with bag(tmp_path / "a", kind) as (write, store):
        write_openni(write, store, frames=20, start_ns=BEGIN)
    promise(tmp_path / "a", 320)
    log = open_log(tmp_path / "a")
    assert log.defects["messages_missing"] == 20
    assert tells(log.notes, "metadata.yaml", "320", "300")


def test_split_with_a_file_missing_and_one_broken(tmp_path: Path) -> None:
    folder = tmp_path / "wbag"
    shutil.copytree(data_path(f"{RESOURCES}/mcap/wbag"), folder)
    folder.chmod(0o755)
    (folder / "wbag_2.mcap").unlink()
    last = folder / "wbag_4.mcap"
    last.chmod(0o644)
    last.write_bytes(b"")
    source = open_source(folder)
    damage = source.damage()
    assert damage.defects == {"files_missing": 1, "files_empty": 1, "messages_missing": 1240 + 1108}
    assert tells(damage.notes, "metadata.yaml", "1 of the 5 files")
    assert tells(damage.notes, "wbag_4.mcap", "0 bytes")
    assert source.end_ns == 2623


def test_recorder_killed_before_it_wrote_metadata(tmp_path: Path) -> None:
    for kind in ("db3", "mcap"):
        with bag(tmp_path / kind, kind) as (write, store):
            write_openni(write, store, frames=20, start_ns=BEGIN)
        (tmp_path / kind / "metadata.yaml").unlink()
        log = open_log(tmp_path / kind)
        assert len(own.read(log)) == 20
        assert tells(log.notes[0], "metadata.yaml", "missing")


def test_truncated_ros2_mcap(tmp_path: Path) -> None:
    with bag(tmp_path / "a", "mcap") as (write, store):
        write_openni(write, store, frames=2000, start_ns=BEGIN)
    path = tmp_path / "a" / "a.mcap"
    data = path.read_bytes()
    path.write_bytes(data[: int(0.7 * len(data))])
    log = open_log(tmp_path / "a")
    frames = own.read(log)
    assert 200 < len(frames) < 2000
    assert log.defects["messages_missing"] > 0
    assert log.defects["truncated_at_ns"] == log.header.end_ns
