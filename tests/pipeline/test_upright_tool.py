from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd

from hrcreplay.commands import replay

PLACES = [(0.30, 0.25), (0.30, 0.10), (0.30, 0.25), (-0.30, 0.25), (-0.30, 0.10), (-0.30, 0.25)]


def test_a_tool_that_points_straight_down_beside_a_person_who_stands(tmp_path: Path) -> None:
    """The tool and the lower body's edges are parallel to 1e-9 rad: every distance is known all the same."""
    task = {
        "repeat": True,
        "speed": 0.6,
        "waypoints": [
            {"position_m": [0.45, y, z], "rpy_deg": [180, 0, 0], "move": "linear" if i % 3 else "joint"}
            for i, (y, z) in enumerate(PLACES)
        ],
    }
    (tmp_path / "task.toml").write_text(toml(task))
    (tmp_path / "cell.toml").write_text("T_world_base = { position_m = [-1.2, 0, 0.65], yaw_deg = 0 }\n")
    folder = replay.run(
        "plan",
        replay.demo_log(),
        out=tmp_path / "run",
        cell_file=tmp_path / "cell.toml",
        overrides=(f"plan.task={tmp_path / 'task.toml'}",),
        end_s=5.0,
    )
    for name in ("motion", "motion_scaling"):
        motion = pd.read_parquet(folder / f"{name}.parquet")
        seen = motion["reason"] != "no human state"
        assert "separation failed" not in set(motion["reason"])
        assert np.isfinite(motion["distance_m"][seen]).all()
        assert (motion["distance_m"][seen] > 0.3).all()
        assert motion["tcp_speed"].max() > 0.5, "it works"


def toml(task: dict[str, object]) -> str:
    waypoints = task.pop("waypoints")
    assert isinstance(waypoints, list)
    lines = [f"{key} = {json.dumps(value)}" for key, value in task.items()]
    for waypoint in waypoints:
        lines += ["[[waypoints]]", *(f"{key} = {json.dumps(value)}" for key, value in waypoint.items())]
    return "\n".join(lines)
