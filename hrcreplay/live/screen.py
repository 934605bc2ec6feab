"""What a person sees of a live session, a process of its own, so that no terminal can hold up the control loop.

From control: ``S`` + a Status as JSON, ten times a second; with ``--foxglove`` also ``J`` + a scene.Cast as JSON, once,
and ``P`` + a scene.Scene as packed. On a terminal one panel follows the session; a pipe gets a line a second and one at
every change; ``--json`` writes each status as a line to standard output. The process ends when control does.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live

from hrcreplay.errors import SettingsError
from hrcreplay.live.channel import Channel, ControlGoneError
from hrcreplay.live.panel import line, panel
from hrcreplay.live.status import Status

if TYPE_CHECKING:
    from hrcreplay.live.foxglove_stream import FoxgloveStream

_WAIT_S = 1.0
Show = Callable[[Status], None]


class Lines:
    """A line a second, and one whenever the session's phase, decision or reason is another."""

    def __init__(self, write: Callable[[str], object]) -> None:
        self._write = write
        self._next_s = 0.0
        self._last: tuple[str, str] | None = None

    def show(self, status: Status) -> None:
        """Writes a line if one is due."""
        now = (status["phase"], status["reason"])
        if status["t_s"] < self._next_s and now == self._last:
            return
        self._next_s, self._last = status["t_s"] + 1.0, now
        self._write(line(status) + "\n")


def serve(channel: Channel, show: Show, stream: FoxgloveStream | None) -> None:
    """Shows what comes until control is gone; of what has piled up, the newest."""
    newest: dict[bytes, bytes] = {}

    def flush() -> None:
        if b"S" in newest:
            status: Status = json.loads(newest.pop(b"S"))
            show(status)
            if stream:
                stream.status(status)
        if stream and b"J" in newest:
            stream.cast(json.loads(newest.pop(b"J")))
        if stream and b"P" in newest:
            stream.scene(newest.pop(b"P"))

    try:
        while True:
            message = channel.receive(0.0 if newest else _WAIT_S)
            if message is None:
                flush()
                newest.clear()  # of kinds that nobody knows
            else:
                newest[message[:1]] = message[1:]
    except ControlGoneError:
        flush()  # the last word


def main(arguments: Sequence[str] | None = None) -> int:
    """The process; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m hrcreplay.live.screen", description=__doc__)
    parser.add_argument("--fd", type=int, required=True, help="socket to control")
    parser.add_argument("--json", action="store_true", help="one JSON object a line instead of a panel")
    parser.add_argument("--foxglove", type=int, metavar="PORT", help="stream the scene to Foxglove on this port")
    given = parser.parse_args(arguments)
    channel = Channel(given.fd)
    stream = _stream(given.foxglove)
    try:
        if given.json:
            serve(channel, _write_json, stream)
            return 0
        console = Console(stderr=True)
        if not console.is_terminal:
            serve(channel, Lines(_write_line).show, stream)
            return 0
        with Live(console=console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
            serve(channel, lambda status: live.update(panel(status), refresh=True), stream)
    except BrokenPipeError:
        return 0  # whoever read has had enough
    return 0


def _write_json(status: Status) -> None:
    sys.stdout.write(json.dumps(status) + "\n")
    sys.stdout.flush()


def _write_line(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()


def _stream(port: int | None) -> FoxgloveStream | None:
    if port is None:
        return None
    from hrcreplay.live import foxglove_stream

    logging.getLogger("foxglove").addHandler(logging.NullHandler())  # what viewers do is not for the panel's terminal
    logging.getLogger("foxglove").propagate = False
    try:
        return foxglove_stream.FoxgloveStream(port)
    except SettingsError as error:
        _write_line(f"hrcreplay: {error}; the session goes on without it\n")
        return None


if __name__ == "__main__":
    sys.exit(main())
