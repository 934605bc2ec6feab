"""No method carries the TCP faster than the programme's speed limit, by velocities of another kinematics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from hrcreplay.commands import replay
from hrcreplay.logs.reader import open_log
from hrcreplay.records import Floats
from hrcreplay.settings.sections import Logs
from hrcreplay.store import run_folder
from tests.robot.checker import links

#: Beyond a limit, of it: the programme itself keeps its own only at its grid points.
TOLERANCE = 1e-3


def tcp(folder: Path, motion: pd.DataFrame) -> tuple[Floats, Floats]:
    """(n, 3) TCP and (n,) its speed by the DH table, from positions and velocities of the axes alone."""
    base = np.array(run_folder.read_meta(folder)["T_world_base"])
    q, dq = (motion[[f"{name}{i}" for i in range(1, 7)]].to_numpy() for name in ("q", "dq"))
    ends, moving = links(q, dq, base, 0.10)
    return ends[:, -1, 1], np.linalg.norm(moving[:, -1, 1], axis=1)


def task() -> dict[str, Any]:
    found = open_log(replay.demo_log(), Logs()).header.task
    assert found is not None
    return found


def limits(folder: Path, motion: pd.DataFrame) -> Floats:
    """(n,) the task's limit of the move that the reference is on, from where the reference is [m/s].

    It is on the way to a waypoint once it has left the one before, and stays on it while it dwells there.
    """
    base = np.array(run_folder.read_meta(folder)["T_world_base"])
    waypoints, fastest = task()["waypoints"], task()["tcp_speed_m_per_s"]
    places = np.array([base[:3, :3] @ w["position_m"] + base[:3, 3] for w in waypoints])
    at, found = 0, np.empty(len(motion))
    going = False
    for i, here in enumerate(motion[["ref_x", "ref_y", "ref_z"]].to_numpy()):
        away = float(np.linalg.norm(here - places[at]))
        following = (at + 1) % len(waypoints)
        going = going or away > 1e-4
        if going and np.linalg.norm(here - places[following]) <= 1e-4:
            at, going = following, False
        move = waypoints[(at + 1) % len(waypoints) if going else at]
        found[i] = min(fastest, move.get("tcp_speed_m_per_s", np.inf))
    return found


@pytest.mark.parametrize("table", ["motion", "motion_scaling", "motion_none"])
def test_no_tick_of_the_demo_is_faster_than_the_move_allows(demo_folder: Path, table: str) -> None:
    motion = pq.read_table(demo_folder / f"{table}.parquet").to_pandas()
    _, speed = tcp(demo_folder, motion)
    np.testing.assert_allclose(speed, motion["tcp_speed"], atol=1e-6)
    allowed = limits(demo_folder, motion)
    assert sorted(set(allowed)) == [0.35, 0.5, 0.9]
    assert (speed <= allowed * (1 + TOLERANCE)).all()
    assert speed.max() > 0.85  # which is not for want of catching up


@pytest.mark.parametrize("method", ["shield", "ssm"])
def test_nor_is_one_of_the_other_methods(tmp_path: Path, method: str) -> None:
    settings = (f"plan.method={method}", "plan.baselines=[]", "prediction.store_hz=1")
    folder = replay.run("plan", replay.demo_log(), out=tmp_path / "run", end_s=5.0, overrides=settings)
    motion = pq.read_table(folder / "motion.parquet").to_pandas()
    assert tcp(folder, motion)[1].max() <= 0.9 * (1 + TOLERANCE)


@pytest.mark.parametrize(("allowed", "least", "most"), [('"free"', 1.3, 4.4), ("1.1", 1.05, 1.1)])
def test_a_setting_lets_it_catch_up_faster(tmp_path: Path, allowed: str, least: float, most: float) -> None:
    settings = (f"plan.catch_up_speed_m_per_s={allowed}", "plan.baselines=[]", "prediction.store_hz=1")
    folder = replay.run("plan", replay.demo_log(), out=tmp_path / "run", end_s=5.0, overrides=settings)
    motion = pq.read_table(folder / "motion.parquet").to_pandas()
    assert least < tcp(folder, motion)[1].max() <= most * (1 + TOLERANCE)
