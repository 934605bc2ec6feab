"""The human side: what it sends when, and that it is the recording."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.errors import LogError
from hrcreplay.live.person.log_playback import Frame, Item, Note, Opened, Playback, play, playback_items
from hrcreplay.live.person.source import BEAT_NS, SendSchedule, run
from hrcreplay.live.processes import ControlChannel, ControlGoneError
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.reader import open_log
from hrcreplay.records import CameraFrames
from tests.live.human import Human
from tests.logs import own
from tests.logs.bags import bag, write_openni

START_NS = 1_800_000_000_000_000_000


def drained(playback: Playback, now_ns: int) -> list[tuple[bytes, bytes]]:
    """What is due; the thread that reads ahead has had its time."""
    while any(t.name == "reading ahead" for t in threading.enumerate()):
        time.sleep(0.001)
    return list(playback.due(now_ns))


def shorter(path: Path, n: int = 12) -> tuple[Path, CameraFrames]:
    """A log of a few frames of two cameras."""
    frames = own.frames(n)
    return own.write(path, frames), frames


def skeletons(messages: list[tuple[bytes, bytes]]) -> list[Any]:
    return [pb.Skeleton.FromString(payload) for kind, payload in messages if kind in (b"f", b"F")]


def test_frames_go_when_their_arrival_is_due_and_captures_move_with_them(tmp_path: Path) -> None:
    path, frames = shorter(tmp_path / "a.mcap")
    playback = play(path, {}, repeat=False)
    first = drained(playback, START_NS)
    assert [kind for kind, _ in first] == [b"N"]
    assert first[0][1].startswith(b"ready ")
    assert json.loads(first[0][1].removeprefix(b"ready ")) == {"cameras": ["left", "right"]}
    assert playback.next_ns(START_NS) is None
    playback.go(START_NS)
    begin_ns = int(frames.arrival_ns[0])
    for i in range(len(frames)):
        due_ns = START_NS + int(frames.arrival_ns[i]) - begin_ns
        assert list(playback.due(due_ns - 1)) == []
        assert playback.next_ns(due_ns - 1) == due_ns
        (sent,) = skeletons(list(playback.due(due_ns)))
        assert sent.capture_ns == START_NS + int(frames.capture_ns[i]) - begin_ns
        assert sent.camera == frames.cameras[frames.camera[i]]
        assert sent.body == frames.body[i]
        np.testing.assert_array_equal(np.reshape(sent.points, (20, 3)), frames.points_m[i])
        np.testing.assert_array_equal(sent.confidence, frames.confidence[i])


def test_the_end_is_told_when_it_is_due_and_once(tmp_path: Path) -> None:
    path, frames = shorter(tmp_path / "a.mcap")
    playback = play(path, {}, repeat=False)
    drained(playback, 0)
    playback.go(0)
    last_ns = int(frames.arrival_ns[-1] - frames.arrival_ns[0])
    assert len(skeletons(drained(playback, last_ns - 1))) == len(frames) - 1
    end = list(playback.due(last_ns))
    kinds = [kind for kind, _ in end]
    assert (kinds[0], kinds[-1]) == (b"F", b"Z")
    assert set(kinds[1:-1]) == {b"N"}  # remarks on the recording, among them that its random points are no person
    assert list(playback.due(last_ns + 10**9)) == []
    assert playback.next_ns(last_ns) is None


def test_a_process_that_slept_sends_what_it_owes_with_the_old_captures(tmp_path: Path) -> None:
    path, frames = shorter(tmp_path / "a.mcap")
    playback = play(path, {}, repeat=False)
    drained(playback, 0)
    playback.go(START_NS)
    sent = skeletons(drained(playback, START_NS + 10**10))
    shift_ns = START_NS - int(frames.arrival_ns[0])
    assert [s.capture_ns for s in sent] == (frames.capture_ns + shift_ns).tolist()


def test_a_repeated_recording_goes_on_rising(tmp_path: Path) -> None:
    frames = own.frames(12)
    # The last frame was quick and the first slow: shifted alone, the second pass would begin before the first ends.
    slow = CameraFrames(
        **{**vars(frames), "capture_ns": frames.capture_ns - np.where(np.arange(12) < 4, 60_000_000, 0)}
    )
    log = open_log(own.write(tmp_path / "a.mcap", slow))
    items = playback_items(log, repeat=True)
    sent: list[Frame] = []
    opened = next(items)
    assert isinstance(opened, Opened)
    while len(sent) < 36:
        item = next(items)
        sent += item if isinstance(item, list) else []
    newest: dict[str, int] = {}
    for frame in sent:
        assert frame.skeleton.capture_ns > newest.get(frame.skeleton.camera, 0)
        newest[frame.skeleton.camera] = frame.skeleton.capture_ns
    arrivals = [frame.arrival_ns for frame in sent]
    assert arrivals == sorted(arrivals)
    period_ns = opened.end_ns - opened.start_ns + 40_000_000
    assert arrivals[11] + period_ns in arrivals
    assert all(frame.skeleton.capture_ns <= frame.arrival_ns for frame in sent)


def test_two_bodies_of_a_frame_of_a_repeated_recording_both_stay(tmp_path: Path) -> None:
    one = own.frames(6, ("left",))
    other = CameraFrames(**{**vars(one), "body": one.body + 1})
    both = CameraFrames.join([one, other])
    log = open_log(own.write(tmp_path / "a.mcap", both.rows(np.argsort(both.arrival_ns, kind="stable"))))
    items = playback_items(log, repeat=True)
    bodies = [frame.skeleton.body for _ in range(9) if isinstance(item := next(items), list) for frame in item]
    assert bodies[:24] == [7, 8] * 12


def test_reading_that_is_too_slow_is_told_once_and_nothing_waits_for_it() -> None:
    gate = threading.Event()

    def reading() -> Iterator[Item]:
        yield Opened(("left",), 0, 100)
        gate.wait(600.0)
        yield [Frame(10, pb.Skeleton(capture_ns=5, camera="left"))]
        yield Note("that was all")
        yield None

    playback = Playback(reading)
    while not list(playback.due(0)):
        time.sleep(0.001)
    playback.go(START_NS)
    told = [payload for now in (20, 40) for _, payload in playback.due(START_NS + now)]
    assert told == [b"recording: reading is slower than its pace; frames come late"]
    assert playback.next_ns(START_NS + 40) == START_NS + 40 + 1_000_000  # looks again soon
    gate.set()
    late = drained(playback, START_NS + 60)
    assert [kind for kind, _ in late] == [b"F", b"N"]
    assert skeletons(late)[0].capture_ns == START_NS + 5
    assert [kind for kind, _ in playback.due(START_NS + 100)] == [b"N", b"Z"]


def test_what_stops_the_reading_is_raised_where_messages_are_taken(tmp_path: Path) -> None:
    playback = play(tmp_path / "none.mcap", {}, repeat=False)
    with pytest.raises(LogError, match="no such file"):
        drained(playback, 0)


class Nothing:
    """A source that never has anything."""

    started: int | None = None

    def go(self, start_ns: int) -> None:
        self.started = start_ns

    def due(self, now_ns: int) -> Iterator[tuple[bytes, bytes]]:  # noqa: ARG002
        return iter(())

    def next_ns(self, now_ns: int) -> int | None:  # noqa: ARG002
        return None


def test_heartbeats_keep_to_their_instants_and_missed_ones_are_not_made_up_for() -> None:
    source = Nothing()
    pace = SendSchedule(source, 0)
    assert list(pace.send(0)) == [(b"H", b"")]
    assert pace.next_ns(0) == BEAT_NS
    assert list(pace.send(BEAT_NS - 1)) == []
    assert list(pace.send(BEAT_NS + 5_000_000)) == [(b"H", b"")]
    assert pace.next_ns(BEAT_NS + 5_000_000) == 2 * BEAT_NS  # no drift
    assert list(pace.send(10 * BEAT_NS + 1)) == [(b"H", b"")]
    assert pace.next_ns(10 * BEAT_NS + 1) == 11 * BEAT_NS
    pace.receive(b"G" + (12345).to_bytes(8, "little"))
    assert source.started == 12345
    pace.receive(b"Gnonsense!")
    pace.receive(b"?")
    assert source.started == 12345


def test_a_full_socket_drops_and_counts_and_a_closed_one_ends() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    channel = ControlChannel(theirs.detach())
    assert channel.receive(0.0) is None
    taken = 0
    while channel.send(b"F", bytes(1000)):
        taken += 1
    assert not channel.send(b"F")
    assert channel.dropped == 2
    got = [ours.recv(2000) for _ in range(taken)]
    assert {len(message) for message in got} == {1001}  # whole messages
    assert channel.send(b"H")
    ours.send(b"G12345678")
    assert channel.receive(0.0) == b"G12345678"
    ours.close()
    with pytest.raises(ControlGoneError):
        channel.receive(1.0)
    with pytest.raises(ControlGoneError):
        channel.send(b"H")


class Deaf(ControlChannel):
    """A channel to a control process that does not read for a while."""

    def __init__(self) -> None:
        self.dropped = 0
        self.rounds = 0
        self.heard: list[bytes] = []

    def send(self, kind: bytes, payload: bytes = b"") -> bool:
        reads = self.rounds != 1
        self.dropped += not reads
        if reads and kind == b"N":
            self.heard.append(payload)
        return reads

    def receive(self, timeout_s: float) -> bytes | None:  # noqa: ARG002
        self.rounds += 1
        if self.rounds == 6:
            raise ControlGoneError
        return None


class Chatter(Nothing):
    """A source that always has three frames."""

    def due(self, now_ns: int) -> Iterator[tuple[bytes, bytes]]:  # noqa: ARG002
        return iter([(b"F", b"")] * 3)


def test_what_control_did_not_read_is_told_once_when_it_reads_again() -> None:
    channel = Deaf()
    with pytest.raises(ControlGoneError):
        run(channel, Chatter(), 0)
    (told,) = channel.heard
    assert int(told.split()[0]) == channel.dropped >= 3
    assert b"messages lost so far: control did not read them" in told


def test_the_process_plays_a_log_and_ends_with_control(tmp_path: Path) -> None:
    path, frames = shorter(tmp_path / "a.mcap")
    with Human("--log", str(path)) as human:
        human.until(b"N", text=b"ready")
        human.until(b"H", 3)
        assert not human.skeletons()  # not before go
        start_ns = human.now_ns() + 20_000_000
        human.go(start_ns)
        human.until(b"Z")
        human.until(b"H", 3)  # still alive
        sent, shift_ns = human.skeletons(), start_ns - int(frames.arrival_ns[0])
        assert [s.capture_ns for s in sent] == (frames.capture_ns + shift_ns).tolist()
        came_ns = [t for t, message in human.heard if message[:1] in b"fF"]
        assert all(came >= due for came, due in zip(came_ns, (frames.arrival_ns + shift_ns).tolist(), strict=True))
        human.socket.close()
        assert human.process.wait(600.0) == 0


def test_the_process_plays_a_ros2_bag(tmp_path: Path) -> None:
    with bag(tmp_path / "bag", "mcap") as (write, store):
        write_openni(write, store, frames=4, start_ns=own.BEGIN_NS)
    with Human("--log", str(tmp_path / "bag")) as human:
        (told,) = human.until(b"N", text=b"ready")
        assert json.loads(told.removeprefix(b"ready ")) == {"cameras": ["openni_depth_frame"]}
        human.go(human.now_ns())
        human.until(b"F", 3)


def test_the_process_tells_why_it_cannot_play(tmp_path: Path) -> None:
    with Human("--log", str(tmp_path / "none.mcap")) as human:
        (told,) = human.until(b"N", text=b"failed")
        assert b"there is no such file" in told
        assert human.process.wait(600.0) == LogError.exit_code
