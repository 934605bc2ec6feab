from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.errors import LogError
from hrcreplay.live.record import codec
from hrcreplay.live.record.recorder import SessionLogReader
from hrcreplay.logs.writer import LogWriter
from tests.facts import facts
from tests.live import made
from tests.logs import own


@pytest.fixture(scope="module")
def messages() -> list[bytes]:
    return list(made.session(40))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, messages: list[bytes]) -> Path:
    return made.record(tmp_path_factory.mktemp("log") / "log.mcap", messages, chunk=30)


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory: pytest.TempPathFactory, messages: list[bytes]) -> Path:
    return made.record(tmp_path_factory.mktemp("log") / "log.mcap", messages, chunk=30, finish=False)


def _chunks(data: bytes | bytearray) -> list[int]:
    """Where the chunks begin: opcode 6, 40 bytes of numbers, the compression."""
    found, at = [], -1
    while (at := data.find(b"\x04\0\0\0zstd", at + 1)) >= 0:
        found.append(at - 37)
    return found


def _changed(path: Path, target: Path, data: bytes | bytearray) -> SessionLogReader:
    shutil.copyfile(path, target)
    target.write_bytes(data)
    return SessionLogReader(target)


def test_messages_come_back_in_order(finished: Path, unfinished: Path, messages: list[bytes]) -> None:
    for path in (finished, unfinished):
        log = SessionLogReader(path)
        assert list(log.messages()) == messages
        assert log.flaws == []
        assert log.finished == (path is finished)
        assert log.start() == made.START


@pytest.mark.parametrize("kind", ["finished", "unfinished"])
def test_every_flipped_bit_is_found(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path, messages: list[bytes]
) -> None:
    path: Path = request.getfixturevalue(kind)
    data = path.read_bytes()
    chunks = _chunks(data)
    frames = [at + i for at in (0, chunks[0], chunks[1], chunks[-2]) for i in range(54)]  # heads of file and chunks
    tail = list(range(len(data) - 300, len(data)))  # finished: footer, summary; unfinished: the last indices
    everywhere = np.random.default_rng(4).integers(0, len(data), 250).tolist()
    for at in frames + (tail if kind == "finished" else []) + everywhere:
        bad = bytearray(data)
        bad[at] ^= 1 << (at % 8)
        log = _changed(path, tmp_path / "log.mcap", bad)
        read = list(log.messages())
        if kind == "unfinished" and at >= chunks[-1]:  # a length there may look like a file that was cut
            assert log.flaws or read == [m for m in messages if m in set(read)]
            continue
        assert log.flaws or read == messages, at  # some bits of a compressed chunk mean nothing
        remaining = iter(messages)
        assert all(message in remaining for message in read), at  # what is left is as it was, in order


def test_a_damaged_chunk_is_named_and_read_past(finished: Path, tmp_path: Path, messages: list[bytes]) -> None:
    data = bytearray(finished.read_bytes())
    third = _chunks(data)[2]
    data[third + 200] ^= 16
    log = _changed(finished, tmp_path / "log.mcap", data)
    until = len(messages[:60])
    read: list[bytes] = []
    for message in log.messages():
        assert bool(log.flaws) == (len(read) >= until)  # known before anything behind it is handed out
        read.append(message)
    assert read == messages[:60] + messages[90:]
    (flaw,) = log.flaws
    assert flaw.at_byte == third
    last, following = ((codec.clock_ns(messages[i]) - made.START_NS) / 1e9 for i in (59, 90))
    assert (flaw.after_s, flaw.before_s) == (last, following)
    assert str(flaw).startswith(f"byte {third}, between {last:.3f} s and {following:.3f} s: ")


def test_a_chunk_that_is_gone_is_missed(finished: Path, tmp_path: Path) -> None:
    data = finished.read_bytes()
    chunks = _chunks(data)
    log = _changed(finished, tmp_path / "log.mcap", data[: chunks[1]] + data[chunks[2] :])
    list(log.messages())
    assert "message 34 is missing" in str(log.flaws[0])  # 30 and the four that hold for the whole session


def test_a_file_that_breaks_off_is_read_to_its_last_whole_chunk(
    finished: Path, tmp_path: Path, messages: list[bytes]
) -> None:
    data = finished.read_bytes()
    chunks = _chunks(data)
    for number, end in ((3, chunks[3] + 5), (3, chunks[3] + 100), (4, chunks[4]), (4, chunks[4] - 10)):
        log = _changed(finished, tmp_path / "log.mcap", data[:end])
        assert list(log.messages()) == messages[: 30 * number]
        assert not log.flaws
        assert not log.finished


def test_what_is_no_session_says_so(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with pytest.raises(LogError, match=facts("log.mcap", "cannot be read")):
        list(SessionLogReader(path).messages())
    path.write_bytes(b"")
    with pytest.raises(LogError, match=facts("log.mcap", "nothing")):
        list(SessionLogReader(path).messages())
    path.write_bytes(b"something else")
    with pytest.raises(LogError, match=facts("log.mcap", "no log")):
        list(SessionLogReader(path).messages())
    path.unlink()
    with LogWriter(path) as writer:
        writer.frames(own.frames(10))
    with pytest.raises(LogError, match=facts("log.mcap", "start")):
        SessionLogReader(path).start()
