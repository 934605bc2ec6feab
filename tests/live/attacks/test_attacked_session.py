"""A session as a user runs it, attacked on loopback from the robot's address and from others; judged by log.mcap."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.live.attacks import checker, robot
from tests.live.attacks.forged import KINDS
from tests.live.flown import QUICK, verified
from tests.live.sessions import Session, free_port

#: A silence is one, and a robot far off is; the machine's own pauses are left room.
SETTINGS = (*QUICK, "live.silent_s=0.4", "live.tracking_rad=0.2")


def test_nothing_that_others_send_leads_the_robot_astray(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    with Session(tmp_path / "run", port, "--send", "--repeat", settings=SETTINGS, figures=False) as session:
        session.until("a status", lambda status: status["t_s"] >= 0)
        code = robot.main(["--port", str(port), "--patience", "120"])
        said = capsys.readouterr().out
        session.interrupt()
        session.end()
    assert code == 0, said
    assert len(re.findall(r"^stranger at 127\.0\.0\.[12]: not answered$", said, flags=re.MULTILINE)) == 2
    assert [line.split(":")[0] for line in said.splitlines()[2:]] == list(KINDS)
    found = checker.greatest(tmp_path / "run" / "log.mcap")
    assert 0.05 < found.share <= 1.0 + 1e-6
    assert verified(tmp_path / "run")
    notes = (tmp_path / "run" / "run.json").read_text()
    assert "127.0.0.2:" in notes
    assert "are not heard: live.robot_address is 127.0.0.1" in notes
    assert '"datagrams_of_others"' in notes
