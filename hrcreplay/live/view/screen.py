"""The screen process: shows the status of a live session on a terminal, in a pipe or in Foxglove.

A process of its own, so that a terminal that blocks cannot delay the control loop.

From control: ``S`` + a Status as JSON, ten times a second; with ``--foxglove`` also ``J`` + the SceneNames as JSON,
once, and ``P`` + a packed Scene. On a terminal one panel follows the session; a pipe gets a line a second and one at
every change; ``--json`` writes each status as a line to standard output. The process ends when control does.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from hrcreplay.errors import SettingsError
from hrcreplay.live.processes import ControlChannel, ControlGoneError
from hrcreplay.live.view.status import CameraStatus, Status

_COLOUR = {"tracking": "green", "limited": "yellow", "braking": "bold red", "retreating": "magenta"}
_STALE_S = 0.2  # as logs.gap_s: a longer pause of a camera is a gap
_WIDTH = 84


def panel(status: Status) -> RenderableType:
    """Panel for a terminal."""
    rows = Table.grid(padding=(0, 2))
    rows.add_column(style="dim", min_width=10)
    rows.add_column()
    rows.add_row("robot", _robot(status))
    rows.add_row("status", _decision(status))
    rows.add_row("separation", _separation(status))
    rows.add_row("answers", _answers(status))
    rows.add_row("cameras", _cameras(status["cameras"]))
    rows.add_row("recorder", _recorder(status))
    rows.add_row("stops", _stops(status))
    if status["outlook"]:
        rows.add_row("next", Text(status["outlook"], style="yellow"))
    parts: list[RenderableType] = [rows]
    if status["note"]:
        parts.append(Text(status["note"], style="dim italic", no_wrap=True, overflow="ellipsis"))
    return Panel(
        Group(*parts),
        title=Text.assemble(("hrcreplay live", "bold"), f" · {status['phase']}"),
        title_align="left",
        subtitle=clock(status["t_s"]),
        subtitle_align="right",
        border_style="red" if status["reason"] else "cyan",
        width=_WIDTH,
    )


def line(status: Status) -> str:
    """Line for a pipe."""
    parts = [clock(status["t_s"]), status["phase"], *_some(status["status"])]
    if status["reason"]:
        parts[-1] += f" ({status['reason']})"
    if status["distance_m"] is not None:
        parts.append(f"{status['distance_m']:.3f} m" + _pair(status))
    parts.append(f"{status['rate_hz']:.0f} Hz")
    if status["latency_us"] is not None:
        parts.append(f"p99 {status['latency_us']['p99'] / 1e3:.2f} ms")
    parts += [f"{camera['name']} {_age(camera)}" for camera in status["cameras"]]
    if not status["recorder"]["alive"]:
        parts.append("recorder dead")
    return "  ".join(parts)


def clock(t_s: float) -> str:
    """Minutes and seconds with one decimal, rounded down."""
    tenths = int(t_s * 10)
    return f"{tenths // 600}:{tenths // 10 % 60:02d}.{tenths % 10}"


def _robot(status: Status) -> Text:
    text = Text(status["robot"] or "not heard yet")
    text.append(
        "   sending" if status["sending"] else "   shadow mode: nothing is sent", "" if status["sending"] else "magenta"
    )
    if status["tcp_speed"] is not None:
        text.append(f"   TCP {status['tcp_speed']:.2f} m/s")
    return text


def _decision(status: Status) -> Text:
    name = status["status"]
    text = Text(name or "-", style=_COLOUR.get(name or "", ""))
    if status["reason"]:
        text.append(f"   {status['reason']}", "bold red")
    return text


def _separation(status: Status) -> Text:
    return Text("-" if status["distance_m"] is None else f"{status['distance_m']:.3f} m" + _pair(status, "   "))


def _pair(status: Status, gap: str = " ") -> str:
    return f"{gap}{status['limb']} - {status['link']}" if status["limb"] and status["link"] else ""


def _answers(status: Status) -> str:
    found = f"{status['rate_hz']:5.1f} Hz"
    latency = status["latency_us"]
    if latency is None:
        return found
    shown = (("p50", latency["p50"]), ("p99", latency["p99"]), ("p99.9", latency["p99_9"]))
    return found + "   after " + "  ".join(f"{name} {value / 1e3:.2f}" for name, value in shown) + " ms"


def _cameras(cameras: list[CameraStatus]) -> RenderableType:
    if not cameras:
        return "none"
    rows = Table.grid(padding=(0, 2))
    rows.add_column()
    rows.add_column(justify="right", min_width=9)
    rows.add_column(justify="right", min_width=7)
    for camera in cameras:
        stale = camera["age_s"] is None or camera["age_s"] > _STALE_S
        age = f"{_age(camera)} old" if camera["age_s"] is not None else _age(camera)
        rows.add_row(Text(camera["name"]), Text(age, style="red" if stale else ""), f"{camera['rate_hz']:.1f} Hz")
    return rows


def _age(camera: CameraStatus) -> str:
    age_s = camera["age_s"]
    if age_s is None:
        return "never seen"
    return f"{age_s * 1e3:.0f} ms" if age_s < 1.0 else f"{age_s:.1f} s"


def _recorder(status: Status) -> Text:
    recorder = status["recorder"]
    text = Text("writing") if recorder["alive"] else Text("dead", style="bold red")
    if recorder["dropped"]:
        text.append(f"   {recorder['dropped']} messages lost", "red")
    return text


def _stops(status: Status) -> Text:
    if not status["stops"]:
        return Text("none")
    return Text(", ".join(reason + (f" x{count}" if count > 1 else "") for reason, count in status["stops"].items()))


def _some(text: str | None) -> list[str]:
    return [text] if text else []


if TYPE_CHECKING:
    from hrcreplay.live.view.foxglove import FoxgloveStream

_WAIT_S = 1.0
Show = Callable[[Status], None]


class Lines:
    """Writes one line per second and one at every change of phase or reason; writes each remark once."""

    def __init__(self, write: Callable[[str], object]) -> None:
        self._write = write
        self._next_s = 0.0
        self._last: tuple[str, str] | None = None
        self._told = ("", "")

    def show(self, status: Status) -> None:
        """Writes the lines that are due."""
        told = (status["note"], status["outlook"])
        for text in (new for new, old in zip(told, self._told, strict=True) if new and new != old):
            self._write(f"{clock(status['t_s'])}  {text}\n")
        self._told = told
        now = (status["phase"], status["reason"])
        if status["t_s"] < self._next_s and now == self._last:
            return
        self._next_s, self._last = status["t_s"] + 1.0, now
        self._write(line(status) + "\n")


def serve(channel: ControlChannel, show: Show, stream: FoxgloveStream | None) -> None:
    """Shows messages until control has ended; of several waiting messages it shows only the newest."""
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
                newest.clear()  # drop messages of unknown kinds
            else:
                newest[message[:1]] = message[1:]
    except ControlGoneError:
        flush()  # show the last messages


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the process and returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m hrcreplay.live.view.screen", description=__doc__)
    parser.add_argument("--fd", type=int, required=True, help="socket to control")
    parser.add_argument("--json", action="store_true", help="one JSON object a line instead of a panel")
    parser.add_argument("--foxglove", type=int, metavar="PORT", help="stream the scene to Foxglove on this port")
    given = parser.parse_args(arguments)
    channel = ControlChannel(given.fd)
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
        return 0  # the reader of the pipe has closed it
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
    from hrcreplay.live.view import foxglove

    logging.getLogger("foxglove").addHandler(logging.NullHandler())  # keep viewers' messages off the panel's terminal
    logging.getLogger("foxglove").propagate = False
    try:
        return foxglove.FoxgloveStream(port)
    except SettingsError as error:
        _write_line(f"hrcreplay: {error}; the session goes on without it\n")
        return None


if __name__ == "__main__":
    sys.exit(main())
