"""Logs in the demo's cell of people who come and go, as two cameras see them: frames that show nobody, too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from hrcreplay.calibration.cell import Cell, Watched, write_cell
from hrcreplay.commands import replay
from hrcreplay.human.model import skeleton
from hrcreplay.logs.reader import open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import NOBODY, POINTS, CameraFrames, Floats

BEGIN_NS = 1_700_000_000_000_000_000
FRAME_NS = 33_000_000
DELAY_NS = 30_000_000
LENGTHS_M = np.array([[0.50, 0.20, 0.18, 0.36, 0.36, 0.29, 0.29]])
#: Who is where at a time: body id -> (x, y) from the robot's base [m].
Visitors = Callable[[float], dict[int, tuple[float, float]]]


def body(x_m: float, y_m: float, at_s: float) -> Floats:
    """(20, 3) POINTS of somebody who stands at a place and breathes, world [m]."""
    bend = 0.1 + 0.05 * np.sin(np.pi * at_s)
    joints = np.array([[x_m, y_m, np.pi, bend, *(0.1, 0.5, 0.0, 1.8) * 2, 0.94]])
    return np.asarray(skeleton(joints, LENGTHS_M)[0])


def visit_log(
    path: Path,
    visitors: Visitors,
    seconds: float,
    *,
    silent: Callable[[str, float], bool] | None = None,
    frozen: Mapping[int, float] = MappingProxyType({}),
) -> Path:
    """A log of the demo's cell and task.

    Args:
        path: File to write.
        visitors: Who is there.
        seconds: How long it lasts [s].
        silent: Camera and time -> whether that camera gives no frame at all then.
        frozen: Body -> from then on its track shows it as it was [s].
    """
    header = open_log(replay.demo_log()).header
    assert header.T_world_base is not None and header.task is not None  # noqa: PT018 - for the type checker
    base = header.T_world_base[:3, 3]
    rows = []
    for number in range(int(seconds * 1e9 / FRAME_NS)):
        at_s = number * FRAME_NS / 1e9
        for c, camera in enumerate(header.cameras):
            if silent is not None and silent(camera, at_s):
                continue
            to_camera = np.linalg.inv(header.T_world_camera[camera])
            capture_ns = BEGIN_NS + number * FRAME_NS + c * 5_000_000
            there = visitors(at_s)
            for name, (x_m, y_m) in sorted(there.items()):
                breath_s = min(at_s, frozen.get(name, at_s))
                points = body(base[0] + x_m, base[1] + y_m, breath_s) @ to_camera[:3, :3].T + to_camera[:3, 3]
                rows.append((capture_ns, c, name, points, np.isfinite(points[:, 0]).astype(float)))
            if not there:
                rows.append((capture_ns, c, NOBODY, np.full((len(POINTS), 3), np.nan), np.zeros(len(POINTS))))
    captures, cameras, bodies, points_m, confidences = (np.array(column) for column in zip(*rows, strict=True))
    with LogWriter(path) as writer:
        for camera, T in header.T_world_camera.items():
            writer.camera(camera, T)
        writer.task(header.task)
        writer.base(header.T_world_base)
        writer.frames(
            CameraFrames(captures, captures + DELAY_NS, cameras, bodies, points_m, confidences, header.cameras)
        )
    return path


def cell_around(path: Path, half_m: float, **how: float) -> Path:
    """A cell file whose cameras watch a square around the robot's base, of which this is half a side [m]."""
    T_world_base = open_log(replay.demo_log()).header.T_world_base
    assert T_world_base is not None
    x_m, y_m = T_world_base[:2, 3].tolist()
    corners = [[x_m + half_m * x, y_m + half_m * y] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    write_cell(Cell(watched=Watched(corners_m=corners, **how)), path)
    return path
