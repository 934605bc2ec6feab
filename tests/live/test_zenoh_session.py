"""A session whose person comes over Zenoh, published by another process that dies and comes back."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.calibration.cell import Cell, write_cell
from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import PHASES
from hrcreplay.live.record.recorder import SessionLogReader
from hrcreplay.live.verify import verify
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.robot.model import irb140
from tests.facts import tells
from tests.live.person.test_zenoh import free_endpoint
from tests.live.sessions import PATIENT, Session, Twin, free_port
from tests.live.zenoh_worker import MARKERS, OWN, POSES

FRESH_S = 0.5
MOVING = ("approach", "following")
CYCLE_S = PERIOD_NS * 1e-9
SETTINGS = """
[live]
approach_speed = 1.0
resume = true
resume_s = 0.2
[live.zenoh]
listen = ["{endpoint}"]
[live.zenoh.keys]
kinect = {{ key = "{markers}", payload = "cdr" }}
xtion = {{ key = "{own}" }}
[plan]
task = "{task}"
"""
TASK = """
name = "to and fro"
speed = 0.6
acceleration = 0.7
repeat = true
[[waypoints]]
position_m = [0.45, -0.3, 0.3]
rpy_deg = [180.0, 0.0, 0.0]
[[waypoints]]
position_m = [0.45, 0.3, 0.3]
rpy_deg = [180.0, 0.0, 0.0]
"""


@contextmanager
def worker(endpoint: str) -> Iterator[subprocess.Popen[bytes]]:
    """Somebody before the cameras; leaving is a ``kill -9`` of what publishes them."""
    process = subprocess.Popen([sys.executable, "-m", "tests.live.zenoh_worker", endpoint])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def cell(folder: Path, endpoint: str) -> list[object]:
    """Arguments for a session in a cell whose cameras are on another computer."""
    base = np.diag([1.0, 1.0, 1.0, 1.0])
    write_cell(Cell(T_world_camera=POSES, T_world_base=base), folder / "cell.toml")
    (folder / "task.toml").write_text(TASK)
    text = SETTINGS.format(endpoint=endpoint, markers=MARKERS, own=OWN, task=folder / "task.toml")
    (folder / "settings.toml").write_text(text)
    return ["--config", folder / "settings.toml", "--cell", folder / "cell.toml"]


def test_a_publisher_that_dies_stops_the_robot_and_one_that_comes_back_does_not_make_it_jump(tmp_path: Path) -> None:
    pytest.importorskip("zenoh")
    endpoint, port = free_endpoint(), free_port()
    patient = (*PATIENT, f"fusion.fresh_s={FRESH_S}")
    arguments = [*cell(tmp_path, endpoint), "--send"]
    with Session(tmp_path / "run", port, *arguments, settings=patient, human=None, figures=False) as session:
        session.until("no frame yet", lambda status: status["phase"] == "waiting")
        with Twin(tmp_path / "twin", port) as twin:
            with worker(endpoint):
                session.until_phase(*MOVING)
            session.until_phase("holding")
            with worker(endpoint):
                session.until_phase(*MOVING)
                session.interrupt()
                assert session.end() == 4
            report = twin.report()
    assert tells(session.err[0], "stopped by", "Ctrl-C")
    assert report["answers"]["seqno_steps"] == 0
    assert verify(session.folder).identical
    meta = json.loads((session.folder / "run.json").read_text())
    assert {stop["reason"] for stop in meta["stops"]} >= {"no fresh frame", "Ctrl-C"}
    moves_only_while_seen(session.folder / "log.mcap", stop_s=meta["settings"]["prediction"]["stop_s"])


def moves_only_while_seen(log: Path, stop_s: float) -> None:
    """What the robot was told, by the record: never to go on without a fresh frame, nor to jump."""
    robot = irb140(np.eye(4), stop_s=stop_s)
    captured = dict.fromkeys(POSES, 0)
    rows: list[codec.RecordedDecision] = []
    for message in SessionLogReader(log).messages():
        if codec.kind(message) == codec.SKELETON:
            skeleton = pb.Skeleton.FromString(codec.body(message))
            captured[skeleton.camera] = skeleton.capture_ns
        elif codec.kind(message) == codec.DECISION:
            rows.append(codec.decode_decision(message))
            if PHASES[rows[-1].phase] in MOVING:
                assert rows[-1].t_ns - max(captured.values()) <= FRESH_S * 1e9
    assert all(captured.values())  # both came through
    told = [(PHASES[row.phase], row.row) for row in rows]
    braking = 0
    for (_, one), (phase, two) in pairwise(told):
        assert one is not None
        assert two is not None
        assert np.all(np.abs(two.q - one.q) <= robot.dq_max * CYCLE_S * (1 + 1e-9)) or phase == "echo"
        assert np.all(np.abs(two.dq - one.dq) <= robot.ddq_max * CYCLE_S * (1 + 1e-9)) or phase == "echo"
        braking = braking + 1 if np.any(two.dq) and phase in ("stopping", "holding") else 0
        assert braking * CYCLE_S <= stop_s + 2 * CYCLE_S
