"""What of the recording is believed."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from hrcreplay.audit import driver, recording
from hrcreplay.human.angles import PointNoise
from hrcreplay.human.fusion import FusionSettings
from hrcreplay.limits import load_limits
from hrcreplay.logs.writer import LogWriter
from hrcreplay.pipeline import Eyes
from hrcreplay.records import POINTS, Bools, Floats, Measurements
from tests.audit.standing import frames, standing
from tests.human.people import states


def _seen(points: Floats) -> Measurements:
    seen = frames(points)
    return Measurements(
        capture_ns=seen.capture_ns,
        arrival_ns=seen.arrival_ns,
        camera=seen.camera,
        angles=np.zeros((len(points), 12)),
        angles_std=np.zeros((len(points), 12)),
        lengths_m=np.zeros((len(points), 8)),
        lengths_std_m=np.zeros((len(points), 8)),
        points_m=points,
        confidence=seen.confidence,
        cameras=("cam",),
    )


def _eyes() -> Eyes:
    return Eyes(
        T_world_camera=np.eye(4)[None],
        clock_offset_ns=np.zeros(1, np.int64),
        noise=PointNoise(),
        filter=FusionSettings(),
        limits=load_limits("human"),
        person_jump_m=0.8,
        person_memory_s=2.0,
    )


def test_a_teleport_is_thrown_out_and_a_squat_is_not() -> None:
    points = standing(4)
    wrist, pelvis = POINTS.index("wrist_l"), POINTS.index("pelvis")
    points[1, wrist] += [0.6, 0.0, 0.3]  # the marker jumps
    points[2, :, 2] -= 0.4  # the whole person goes down, which the model cannot
    points[3, pelvis] += [0.0, 1.0, 0.0]
    best = states(np.zeros((4, 12)), np.zeros((4, 12)))
    p = np.zeros((4, 12))
    p[:, [4, 8]], p[:, [7, 11]] = 0.2, 2.5
    best = replace(best, p=p, t_ns=frames(points).capture_ns)
    believed, counts = recording._believed(_seen(points), best, _eyes())
    gone: Bools = np.asarray(np.isfinite(points).all(axis=2) & np.isnan(believed).any(axis=2))
    assert [POINTS[k] for k in np.flatnonzero(gone[1])] == ["wrist_l"]
    assert [POINTS[k] for k in np.flatnonzero(gone[3])] == ["pelvis"]
    assert not gone[[0, 2]].any()
    assert counts == Counter(audit_rejected_points_cam=2, audit_rejected_frames_cam=2)


def test_a_teleport_is_counted_and_no_escape(tmp_path: Path) -> None:
    """The marker of a wrist is elsewhere in three frames of a still person's sixty."""
    points = standing(60)
    points[30:33, POINTS.index("wrist_l")] += [0.6, 0.0, 0.3]
    with LogWriter(tmp_path / "jump.mcap") as writer:
        writer.camera("cam", np.eye(4))
        writer.frames(frames(points))
    folder = driver.run([tmp_path / "jump.mcap"], out=tmp_path / "run")
    (log,) = json.loads((folder / "audit.json").read_text())["logs"]
    counts = log["cameras"]["cam"]
    # the last frame arrives after the last tick
    assert (counts["frames"], counts["rejected_frames"], counts["rejected_points"]) == (59, 3, 3)
    assert counts["outlier_points"] >= 3
    assert log["escapes"]["paper"] == []
    table = (folder / "report.html").read_text().split("jump: thrown out")[1].split("</table>")[0]
    assert re.findall(r">\s*([^<\s]+)\s*</t[dh]>", table.split("<tbody>")[-1])[:4] == ["cam", "59", "3", "3"]
