from __future__ import annotations

import os
import resource
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from hrcreplay.live.record import codec, recorder
from hrcreplay.live.record.recorder import SessionLogReader
from hrcreplay.logs.reader import open_log
from tests.facts import tells
from tests.live import made
from tests.live.human import PATIENCE_S


@pytest.fixture(scope="module")
def messages() -> list[bytes]:
    return list(made.session(60))


def test_recorder_and_screen_start_without_the_robot() -> None:
    code = "import sys\nfrom hrcreplay.live.record import recorder\nfrom hrcreplay.live.view import screen\n"
    code += "sys.exit(3 if {'numba', 'pinocchio', 'pydantic', 'scipy'} & set(sys.modules) else 0)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def _by_hand(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Topic, log time, publish time and content in file order, by the library's own reader."""
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, m.log_time, m.publish_time, m.data) for _, channel, m in found]


def test_the_record_is_a_log_of_ours(tmp_path: Path, messages: list[bytes]) -> None:
    log = open_log(made.record(tmp_path / "log.mcap", messages))
    assert log.header.kind == "hrcreplay"
    assert log.header.cameras == ("left", "right")
    assert set(log.header.T_world_camera) == {"left"}
    assert log.header.task == made.START["task"]
    np.testing.assert_array_equal(log.header.T_world_base, np.eye(4))
    frames = next(iter(log.frames()))
    assert len(frames) == 12  # that of nobody's camera is none of the log's
    assert frames.arrival_ns.tolist() == [made.START_NS + (k + 1) * made.TICK_NS + 500_000 for k in range(0, 60, 5)]
    assert frames.capture_ns.tolist() == [made.START_NS + k * made.TICK_NS - 20_000_000 for k in range(0, 60, 5)]
    assert [frames.cameras[i] for i in frames.camera] == ["left", "right"] * 6


def test_datagrams_lie_raw_on_their_topics_even_garbage(tmp_path: Path, messages: list[bytes]) -> None:
    rows = _by_hand(made.record(tmp_path / "log.mcap", messages))
    robot = [data for topic, _, _, data in rows if topic == "/egm/robot"]
    assert robot == [codec.body(m) for m in messages if codec.kind(m) == codec.ROBOT]
    assert b"\xff garbage" in robot
    assert b"" in robot
    replies = [m for m in messages if codec.kind(m) == codec.REPLY]
    assert [d for t, _, _, d in rows if t == "/egm/correction"] == [codec.decode_reply(m)[1] for m in replies[3:]]
    assert [d for t, _, _, d in rows if t == "/egm/correction/unsent"] == [
        codec.decode_reply(m)[1] for m in replies[:3]
    ]
    assert {t for t, _, _, _ in rows if t.startswith("/live/")} == {
        f"/live/{name}" for name in ("answer", "event", "frame", "look", "silence", "volumes")
    }


def test_skeletons_that_cannot_be_read_are_on_record(tmp_path: Path) -> None:
    messages = [codec.encode_event(5, made.START), codec.encode_skeleton(7, b"\xff\xff"), codec.encode_skeleton(8, b"")]
    path = made.record(tmp_path / "log.mcap", messages)
    assert [row for row in _by_hand(path) if row[0] == codec.STRAY_TOPIC] == [
        (codec.STRAY_TOPIC, 7, 7, b"\xff\xff"),
        (codec.STRAY_TOPIC, 8, 8, b""),
    ]
    assert list(SessionLogReader(path).messages()) == messages


class Process:
    """The recorder as control sees it."""

    def __init__(self, path: Path, before: Callable[[], None] | None = None, low_bytes: int = 0) -> None:
        self.control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [
            sys.executable,
            "-m",
            "hrcreplay.live.record.recorder",
            "--fd",
            str(theirs.fileno()),
            "--path",
            str(path),
            "--low",
            str(low_bytes),
        ]
        self.popen = subprocess.Popen(
            command,
            pass_fds=(theirs.fileno(),),
            start_new_session=True,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=before,
        )
        theirs.close()

    def end(self) -> tuple[int, str]:
        """Exit code and what was said, after it has ended by itself."""
        said = self.popen.communicate(timeout=600)[1]
        return self.popen.returncode, said


@contextmanager
def recording(path: Path, before: Callable[[], None] | None = None, low_bytes: int = 0) -> Iterator[Process]:
    process = Process(path, before, low_bytes)
    try:
        yield process
    finally:
        process.control.close()
        process.popen.kill()
        process.popen.communicate()


def _on_disk(path: Path, number: int) -> list[bytes]:
    """The messages in a file that is being written, once there are so many."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        found = list(SessionLogReader(path).messages()) if path.exists() and path.stat().st_size else []
        if len(found) >= number:
            return found
        assert time.monotonic() < end_s, f"{len(found)} of {number} messages"
        select.select([], [], [], 0.02)


def test_the_file_is_finished_when_control_is_gone(tmp_path: Path, messages: list[bytes]) -> None:
    path = tmp_path / "log.mcap"
    with recording(path) as process:
        assert process.control.recv(10) == recorder.READY
        for message in messages:
            process.control.send(message)
        os.kill(process.popen.pid, signal.SIGTERM)  # it is not the terminal's, nor the system's, to end a record
        os.kill(process.popen.pid, signal.SIGINT)
        process.control.close()
        assert process.end() == (0, "")
    log = SessionLogReader(path)
    assert list(log.messages()) == messages
    assert log.finished
    assert not log.flaws


def test_a_killed_recorder_leaves_a_file_that_opens(tmp_path: Path, messages: list[bytes]) -> None:
    path = tmp_path / "log.mcap"
    with recording(path) as process:
        for message in messages[:200]:
            process.control.send(message)
        assert _on_disk(path, 200) == messages[:200]  # without an end of the session: it is there within a moment
        process.popen.kill()
        process.popen.wait()
        with pytest.raises(OSError):  # noqa: PT011 - a pipe or a connection
            process.control.send(messages[0])
    log = SessionLogReader(path)
    assert list(log.messages()) == messages[:200]
    assert not log.finished
    assert not log.flaws
    assert len(next(iter(open_log(path).frames()))) > 1


def test_a_full_disk_ends_the_recorder_with_one_line(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    limit = 20_000
    noise = np.random.default_rng(0)
    with recording(path, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))) as process:
        process.control.recv(10)
        for k in range(20):
            process.control.send(codec.encode_robot_packet(1000 + k, noise.bytes(5000)))
        code, said = process.end()
        words = process.control.recv(1000).decode()
        assert process.control.recv(10) == b""  # this is how control knows
    assert (code, said) == (1, "")
    assert words.startswith("X")
    assert tells(words[1:], str(path), "File too large")


def test_little_space_is_told_once(tmp_path: Path) -> None:
    with recording(tmp_path / "log.mcap", low_bytes=1 << 62) as process:
        assert process.control.recv(10) == b"K"
        assert process.control.recv(10) == b"L"
        process.control.settimeout(1.0)
        with pytest.raises(TimeoutError):
            process.control.recv(10)


def test_an_existing_file_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_text("precious")
    with recording(path) as process:
        code, _ = process.end()
        assert b"File exists" in process.control.recv(1000)
    assert code == 1
    assert path.read_text() == "precious"
