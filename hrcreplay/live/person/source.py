"""The process that sends skeletons to the control process, from a recording or from Zenoh.

Messages to control: ``H`` heartbeat every 20 ms, whatever else happens; ``F`` + a serialized Skeleton, captured in
session time, ``f`` where another body of the same frame follows; ``N`` + a note in UTF-8; ``Z`` end of the recording.
The first note is ``ready {"cameras": [...]}``; a note that begins with ``failed`` is the reason why the process ends.
From control: ``G`` + the session's start as 8 bytes, little-endian [ns], before which no frame is sent. The process
ends when control does.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NoReturn, Protocol

from hrcreplay.errors import HrcReplayError
from hrcreplay.live.person.log_playback import Message, play
from hrcreplay.live.person.zenoh_source import ZenohSource
from hrcreplay.live.processes import ControlChannel, ControlGoneError

BEAT_NS = 20_000_000
_NICE = -10  # where that is permitted: right after control, before recorder and screen
_SWITCH_S = 0.0005  # a thread that decodes gives way to one whose time has come after this long


class SkeletonSource(Protocol):
    """A source of skeletons: a recording or Zenoh."""

    def go(self, start_ns: int) -> None:
        """Starts the flow at ``start_ns`` of session time."""

    def due(self, now_ns: int) -> Iterator[Message]:
        """The messages to send now. Raises LogError, SettingsError."""

    def next_ns(self, now_ns: int) -> int | None:
        """When the next message is due; None: not known, or woken otherwise."""


class SendSchedule:
    """Schedule of the messages to control: heartbeats at fixed instants, and what is due. No clock, no socket."""

    def __init__(self, source: SkeletonSource, now_ns: int) -> None:
        self._source = source
        self._beat_ns = now_ns

    def receive(self, message: bytes) -> None:
        """Handles a message from control."""
        if message[:1] == b"G" and len(message) == 9:
            self._source.go(int.from_bytes(message[1:], "little"))

    def send(self, now_ns: int) -> Iterator[Message]:
        """What is due. Raises LogError, SettingsError."""
        if now_ns >= self._beat_ns:
            self._beat_ns += BEAT_NS * ((now_ns - self._beat_ns) // BEAT_NS + 1)  # missed beats are not made up for
            yield b"H", b""
        yield from self._source.due(now_ns)

    def next_ns(self, now_ns: int) -> int:
        """When something is due again."""
        due_ns = self._source.next_ns(now_ns)
        return self._beat_ns if due_ns is None else min(self._beat_ns, due_ns)


def run(channel: ControlChannel, source: SkeletonSource, anchor_ns: int) -> NoReturn:
    """Serves until control is gone.

    Raises:
        ControlGoneError: It is.
        HrcReplayError: The source cannot go on.
    """
    pace = SendSchedule(source, time.monotonic_ns() + anchor_ns)
    told = 0
    while True:
        now_ns = time.monotonic_ns() + anchor_ns
        for kind, payload in pace.send(now_ns):
            channel.send(kind, payload)
        lost = channel.dropped
        if lost != told and channel.send(b"N", f"{lost} messages lost so far: control did not read them".encode()):
            told = lost
        now_ns = time.monotonic_ns() + anchor_ns
        message = channel.receive((pace.next_ns(now_ns) - now_ns) / 1e9)
        if message is not None:
            pace.receive(message)


def main(arguments: Sequence[str] | None = None) -> int:
    """The process; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m hrcreplay.live.person.source", description=__doc__)
    parser.add_argument("--fd", type=int, required=True, help="socket to control")
    parser.add_argument("--anchor", type=int, required=True, help="session time minus monotonic time [ns]")
    parser.add_argument("--options", type=json.loads, default={}, help='JSON: "topics", "decoders" as in [logs]')
    parser.add_argument("--repeat", action="store_true", help="start the recording again at its end")
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument("--log", type=Path, help="recording to play")
    kind.add_argument("--zenoh", type=json.loads, help="JSON of the settings' section live.zenoh")
    given = parser.parse_args(arguments)
    sys.setswitchinterval(_SWITCH_S)
    with suppress(PermissionError):
        os.nice(_NICE)
    channel = ControlChannel(given.fd)
    try:
        source = _source(given, channel)
        gc.freeze()
        run(channel, source, given.anchor)
    except ControlGoneError:
        return 0
    except HrcReplayError as error:
        channel.send(b"N", f"failed {error}".encode())
        return error.exit_code


def _source(given: argparse.Namespace, channel: ControlChannel) -> SkeletonSource:
    if given.log is not None:
        return play(given.log, given.options, repeat=given.repeat)
    return ZenohSource(given.zenoh, channel.send, lambda: time.monotonic_ns() + int(given.anchor))


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    os._exit(code)  # Zenoh's threads may be about to call back; an interpreter that unwinds meanwhile aborts
