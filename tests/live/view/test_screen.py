"""What a person sees of a session: on a terminal, in a pipe, as JSON."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from io import StringIO

from rich.console import Console

from hrcreplay.live.processes import ControlChannel
from hrcreplay.live.view.screen import Lines, clock, line, panel, serve
from hrcreplay.live.view.status import RecorderStatus, Status
from tests.facts import tells
from tests.live.statuses import status


def shown(now: Status) -> dict[str, str]:
    """The rows of the panel by their names; cameras by theirs."""
    console = Console(file=StringIO(), width=100)
    console.print(panel(now))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    inside = [row.strip("│").strip() for row in text.splitlines()[1:-1]]
    rows = {row.split()[0]: " ".join(row.split()[1:]) for row in inside}
    return rows | {"title": text.splitlines()[0], "subtitle": text.splitlines()[-1]}


# --- panel and lines ---


def test_the_panel_shows_all_that_is_known() -> None:
    rows = shown(status())
    assert "hrcreplay live · following" in rows["title"]
    assert "1:23.4" in rows["subtitle"]
    assert rows["robot"] == "192.168.125.1:6511 sending TCP 0.51 m/s"
    assert rows["status"] == "limited"
    assert rows["separation"] == "0.423 m LRA - forearm"
    assert rows["answers"] == "248.0 Hz after p50 0.41 p99 0.80 p99.9 1.19 ms"
    assert rows["cameras"] == "kinect 42 ms old 30.0 Hz"
    assert rows["[x]tion"] == "never seen 0.0 Hz"  # brackets are no markup
    assert rows["recorder"] == "writing"
    assert rows["stops"] == "none"


def test_the_panel_shows_a_stop_and_what_led_to_it() -> None:
    rows = shown(
        status(
            phase="holding",
            sending=False,
            status="braking",
            reason="no fresh frame",
            stops={"no fresh frame": 2, "tick overrun": 1},
            recorder=RecorderStatus(alive=False, dropped=12),
            note="camera kinect: 1 undecodable",
        )
    )
    assert rows["status"] == "braking no fresh frame"
    assert rows["stops"] == "no fresh frame x2, tick overrun"
    assert rows["recorder"] == "dead 12 messages lost"
    assert tells(rows["robot"], "shadow")
    assert rows["camera"] == "kinect: 1 undecodable"


def test_the_panel_of_a_session_that_waits() -> None:
    unknown = dict.fromkeys(("robot", "latency_us", "distance_m", "limb", "link", "tcp_speed", "status"))
    rows = shown(status(phase="waiting", cameras=[], rate_hz=0.0, **unknown))
    assert rows["robot"] == "not heard yet sending"
    assert (rows["status"], rows["separation"], rows["answers"], rows["cameras"]) == ("-", "-", "0.0 Hz", "none")


def test_a_line_tells_the_same() -> None:
    said = line(status())
    assert said.startswith("1:23.4  following  limited  0.423 m LRA")
    assert tells(said, "forearm", "248 Hz", "p99 0.80 ms", "kinect 42 ms", "[x]tion never")
    stopped = status(status="braking", reason="tick overrun", recorder=RecorderStatus(alive=False, dropped=0))
    assert "braking (tick overrun)" in line(stopped)
    assert line(stopped).endswith("recorder dead")


def test_the_clock_never_runs_ahead() -> None:
    assert [clock(t) for t in (0.0, 59.99, 60.0, 3599.95)] == ["0:00.0", "0:59.9", "1:00.0", "59:59.9"]


def test_a_pipe_gets_a_line_a_second_and_one_at_each_change() -> None:
    written: list[str] = []
    lines = Lines(written.append)
    times = [(i / 10, "") for i in range(25)] + [(2.5, "tick overrun"), (2.6, "tick overrun"), (2.7, "")]
    for t_s, reason in times:
        lines.show(status(t_s=t_s, reason=reason))
    assert [text.split()[0] for text in written] == ["0:00.0", "0:01.0", "0:02.0", "0:02.5", "0:02.7"]


def test_a_pipe_gets_each_remark_and_what_a_standing_robot_waits_for_once() -> None:
    written: list[str] = []
    lines = Lines(written.append)
    for t_s, note, outlook in ((0.0, "", ""), (0.1, "a", "w"), (0.2, "a", "w"), (0.3, "b", ""), (0.4, "b", "w")):
        lines.show(status(t_s=t_s, note=note, outlook=outlook))
    assert [text.strip() for text in written[1:]] == ["0:00.1  a", "0:00.1  w", "0:00.3  b", "0:00.4  w"]


# --- the process ---


def test_of_what_has_piled_up_the_newest_is_shown_and_the_last_always() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for i in range(5):
        ours.send(b"S" + json.dumps(status(t_s=float(i))).encode())
    ours.send(b"?nobody knows")
    ours.close()
    seen: list[float] = []
    serve(ControlChannel(theirs.detach()), lambda now: seen.append(now["t_s"]), None)
    assert seen == [4.0]


def run(*arguments: str, send: list[Status]) -> subprocess.CompletedProcess[str]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for now in send:
        ours.send(b"S" + json.dumps(now).encode())
    ours.close()
    with theirs:
        command = [sys.executable, "-m", "hrcreplay.live.view.screen", "--fd", str(theirs.fileno()), *arguments]
        return subprocess.run(
            command, pass_fds=(theirs.fileno(),), capture_output=True, text=True, timeout=600.0, check=True
        )


def test_the_process_writes_json_to_standard_output() -> None:
    done = run("--json", send=[status(t_s=1.0), status(t_s=2.0)])
    assert json.loads(done.stdout.splitlines()[-1]) == status(t_s=2.0)
    assert done.stderr == ""


def test_the_process_writes_lines_where_there_is_no_terminal() -> None:
    done = run(send=[status()])
    assert done.stdout == ""
    assert done.stderr == line(status()) + "\n"


def test_the_process_draws_on_a_terminal() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.send(b"S" + json.dumps(status()).encode())
    ours.close()
    leader, follower = os.openpty()
    with theirs:
        command = [sys.executable, "-m", "hrcreplay.live.view.screen", "--fd", str(theirs.fileno())]
        environment = os.environ | {"TERM": "xterm", "COLUMNS": "100"}
        process = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stderr=follower, env=environment)
        assert process.wait(600.0) == 0
    os.close(follower)
    drawn = os.read(leader, 1 << 16).decode()
    os.close(leader)
    assert "192.168.125.1:6511" in drawn
    assert "╭" in drawn
