"""A tool that no capsule guards is told before a session waits for the robot."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest

from hrcreplay.live import session
from tests.live.flights import DEMO

TASK = "[[waypoints]]\njoints_deg = [0,0,0,0,30,0]\n[[waypoints]]\njoints_deg = [9,0,0,0,30,0]\n"


@pytest.mark.parametrize("guarded", [False, True])
def test_a_bare_tool_is_told_before_the_session_waits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], *, guarded: bool
) -> None:
    (tmp_path / "task.toml").write_text(TASK)
    capsule = '{name="mounted", body="flange", start_m=[0,0,0], end_m=[0.1,0.2,0.35], radius_m=0.05}'
    overrides = (
        f"plan.task={tmp_path / 'task.toml'}",
        "robot.tcp_offset={position_m=[0.1,0.2,0.25]}",
        f"robot.tool_links=[{capsule if guarded else ''}]",
    )
    request = session.Request(
        human=DEMO,
        repeat=False,
        port=0,
        duration_s=1.0,
        out=tmp_path / "out",
        send=False,
        json_lines=False,
        foxglove=None,
        config=None,
        overrides=overrides,
        cell=None,
    )
    with ExitStack() as stack:
        prepared = session._prepare(request, tmp_path, stack)
        told = capsys.readouterr().err
    assert ("robot.tool_links" in told) is not guarded
    assert ("0.290 m outside" in told) is not guarded
    assert ("mounted" in prepared.start["links"]) is guarded
