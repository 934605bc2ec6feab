"""Live sessions in a cell with objects: where the robot may start, and what the run folder tells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hrcreplay.egm.robot_double.robot_simulator import SimulatorSettings
from hrcreplay.live.control import session_controller
from hrcreplay.live.control.setup import build_scene
from hrcreplay.live.record import codec, folder
from hrcreplay.robot.control.static_obstacles import nearest
from tests.facts import tells
from tests.live import made
from tests.live.counted import counted
from tests.live.flights import BEGIN_NS, Flight

CELL = Path(__file__).parents[3] / "datasets" / "demo_cell.toml"
FAST = "live.approach_speed=1.0"
ON_THE_TABLE = SimulatorSettings(start_deg=(0.0, 60.0, 40.0, 0.0, 0.0, 0.0))


def test_a_robot_that_begins_at_an_object_waits_and_says_where() -> None:
    loop = counted(flight := Flight((FAST,), cell=CELL, twin=ON_THE_TABLE)).fly(1.5)
    assert flight.controller.waiting == session_controller.TOO_NEAR
    assert flight.controller.phase == codec.WAITING
    (note,) = loop.notes
    assert tells(note, "forearm", "table", "by hand")


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> tuple[Flight, Path]:
    flight = Flight((FAST,), cell=CELL).fly(3.0)
    partial = folder.make_partial(tmp_path_factory.mktemp("runs") / "session")
    start = codec.encode_event(BEGIN_NS - 1, {"what": "start", **flight.start})
    made.record(partial / "log.mcap", [start, *flight.messages], chunk=500)
    return flight, folder.finish(partial)


def test_a_robot_elsewhere_moves(stored: tuple[Flight, Path]) -> None:
    flight, _ = stored
    assert flight.phases()[-1] in ("approach", "following")
    assert not flight.controller.too_near


def test_motion_has_the_nearest_object_and_link(stored: tuple[Flight, Path]) -> None:
    flight, run = stored
    table = pd.read_parquet(run / "motion.parquet")
    robot, _, static = build_scene(flight.start)
    assert static is not None
    q = table[[f"q{axis}" for axis in range(1, 7)]].to_numpy()
    found = nearest(robot, static, q)
    np.testing.assert_array_equal(table["object_distance_m"], found.object_m)
    np.testing.assert_array_equal(table["self_distance_m"], found.links_m)
    assert table["object"].tolist() == [static.names[k] for k in found.object]
    assert (table["object_distance_m"] > 0.0).all()
