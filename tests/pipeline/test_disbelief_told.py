"""A run and its verdict tell which camera shows which points wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from hrcreplay.commands import replay
from hrcreplay.records import POINTS
from tests import crowd

FOOT = ("ankle_l", "foot_l")


def test_a_run_tells_which_camera_shows_a_foot_below_the_floor(tmp_path: Path) -> None:
    made = crowd.record(*crowd.people(1, 6.0))
    points, mine = made.frames.points_m.copy(), np.flatnonzero(made.frames.camera == 1)
    down = crowd.SENSORS[1].T_world_camera[:3, :3].T @ [0.0, 0.0, -0.3]
    points[mine[:, None], [POINTS.index(name) for name in FOOT]] += down
    frames = replace(made.frames, points_m=points)
    log = crowd.write(tmp_path / "low.mcap", made._replace(frames=frames))
    out = replay.run("report", log, out=tmp_path / "run", overrides=("plan.baselines=[]",))
    told = json.loads((out / "run.json").read_text())
    name = crowd.SENSORS[1].name
    (line,) = [note for note in told["notes"] if "wrong over time" in note]
    assert line.startswith(f"camera {name} shows")
    assert all(f"{point} {told['counts'][f'disbelieved_{point}_{name}']}" in line for point in FOOT)
    assert "knee" not in line
    page = (out / "report.html").read_text()
    assert f"The robot did not react to ankle_l, foot_l where camera {name} showed them, in up to" in page
