"""Real recordings by others, from import to page: had a robot stood there, would the person have been safe?"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from hrcreplay.commands import inputs, replay
from hrcreplay.store import run_folder
from tests.coverage_figures import assert_one_coverage
from tests.facts import tells
from tests.realdata import data_path

TASK = """
repeat = true
tcp_speed_m_per_s = 0.8
[[waypoints]]
position_m = [0.45, 0.26, 0.30]
rpy_deg = [180, 0, 0]
[[waypoints]]
position_m = [0.45, -0.26, 0.30]
rpy_deg = [180, 0, 0]
[[waypoints]]
position_m = [0.45, -0.26, 0.20]
rpy_deg = [180, 0, 0]
move = "linear"
dwell_s = 0.3
"""

#: The mocap joints of the bags: a message type of their own, z up, robot base about 1 m above the floor.
SARA = """
[[logs.decoders]]
topic = "/SaRA_demo_human_capsules"
camera = "mocap"
points = "positions"
[logs.decoders.index]
shoulder_l = 0
elbow_l = 1
wrist_l = 2
shoulder_r = 3
elbow_r = 4
wrist_r = 5
head = 6
chest = 8
pelvis = 9
"""
SARA_CELL = """
[cameras.mocap]
T_world_camera = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.0], [0, 0, 0, 1]]
[T_world_base]
position_m = [0, 0, 1.0]
"""

#: name -> kind, files by camera, options of calibrate.
IMPORTS: dict[str, tuple[str, dict[str, str], dict[str, Any]]] = {
    "azure walking": ("azure", {"azure": "sevivi_azure_single/walking_positions_3d.csv.gz"}, {}),
    "azure squatting": ("azure", {"azure": "sevivi_azure_single/squatting_positions_3d.csv.gz"}, {}),
    "azure moving": ("azure", {"azure": "pymocapviewer/azure_positions.csv.gz"}, {}),
    "kinect 2 wave": ("kinect2", {"kinect": "labanotation_kinect_v2/Ges01_wavehand.csv"}, {}),
    "kinect 2 lines": ("kinect2", {"kinect": "labanotation_kinect_v2/Ges03_drawlines.csv"}, {}),
    "kinect 2 sitting": ("kinect2", {"kinect": "labanotation_kinect_v2/joints.csv"}, {"height_m": 1.0}),
    "keraal pair": (
        "keraal",
        {
            "kinect": "keraal_kinect_vicon/G3-Kinect-CTK-P1T1-Unknown-C-0.txt",
            "optical": "keraal_kinect_vicon/G3-Vicon-CTK-P1T1-Unknown-C-0.txt",
        },
        {"reference": "optical", "up": "0,0,1", "height_m": 0.0},
    ),
}


def _check(folder: Path, seconds: float) -> dict[str, Any]:
    """What every report must hold; returns its metrics."""
    run = run_folder.read(folder)
    assert run.motion is not None
    assert run.occupancy is not None
    assert run.meta["complete"] is True
    metrics: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    assert metrics["span_s"]["value"] == pytest.approx(seconds, abs=0.5)
    assert metrics["plan_ticks"]["value"] == len(run.motion)
    page = re.sub(r"<script.*?</script>", "", (folder / "report.html").read_text(), flags=re.DOTALL)
    assert "Fig. 17" in page
    assert "ground truth" in page
    assert not re.search(r"\b(nan|inf|None)\b", page)
    return metrics


@pytest.mark.parametrize("name", IMPORTS)
def test_an_imported_recording_from_import_to_page(tmp_path: Path, name: str) -> None:
    kind, files, options = IMPORTS[name]
    log, cell, task = tmp_path / "log.mcap", tmp_path / "cell.toml", tmp_path / "task.toml"
    task.write_text(TASK)
    paths = [
        f"{camera}={data_path(file)}" if kind != "keraal" else str(data_path(file)) for camera, file in files.items()
    ]
    inputs.import_files(kind, paths, log, 30.0)
    place = {"reference": None, "up": None, "height_m": None, "base": "1.0,0,0.65,0", **options}
    inputs.calibrate(log, cell, None, (), **place)
    folder = replay.run(
        "report", log, out=tmp_path / "run", cell_file=cell, end_s=4.0, overrides=(f"plan.task={task}",)
    )
    metrics = _check(folder, 4.0)
    assert assert_one_coverage(folder, tmp_path) > 0
    for camera in files:
        assert metrics[f"camera_{camera}_frames"]["value"] > 80
        assert metrics[f"camera_{camera}_valid_share"]["value"] > 0.05


@pytest.mark.parametrize("name", ["exp_appraoching", "exp_box"])
def test_a_bag_with_a_message_type_of_its_own_to_page(tmp_path: Path, name: str) -> None:
    settings, cell, task = tmp_path / "s.toml", tmp_path / "cell.toml", tmp_path / "task.toml"
    settings.write_text(SARA)
    cell.write_text(SARA_CELL)
    task.write_text(TASK)
    bag = data_path(f"sara_human_robot_bags/{name}.bag")
    folder = replay.run(
        "report",
        bag,
        out=tmp_path / "run",
        config=settings,
        cell_file=cell,
        end_s=6.0,
        overrides=(f"plan.task={task}",),
    )
    metrics = _check(folder, 6.0)
    assert assert_one_coverage(folder, tmp_path) > 0
    assert metrics["camera_mocap_rate_hz"]["value"] == pytest.approx(60.0, rel=0.02)
    assert metrics["count_frames_header_stamp_zero"]["value"] > 300
    assert tells(run_folder.read(folder).notes, "stamps", "zero")
