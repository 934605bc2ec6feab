"""Makes the demo log: ``python -m datasets.make_demo [PATH]``. The same bytes every time."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from datasets.recipe import cameras, scene, worker
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import Floats

SEED = 2024
START_NS = 1_600_000_000_000_000_000  #: no clock is read
TRUTH_EVERY = 2  #: rows of the simulation: 100 Hz


def make(path: Path, T_world_base: Floats = scene.T_WORLD_BASE, task: dict[str, Any] = scene.TASK) -> None:
    """Simulates the session and writes it.

    Args:
        path: Log to make.
        T_world_base: (4, 4) where the robot stands; the worker does not mind.
        task: What it does there.

    Raises:
        SettingsError: The file exists, or its folder cannot be written.
    """
    t_s, points_m = worker.simulate(SEED)
    frames = cameras.record(t_s, points_m, START_NS, SEED)
    t_ns = START_NS + np.round(t_s[::TRUTH_EVERY] * 1e9).astype(np.int64)
    truth_m = np.round(points_m[::TRUTH_EVERY], 5)
    with LogWriter(path) as log:
        for sensor in cameras.SENSORS:
            log.camera(sensor.name, np.round(sensor.T_world_camera, 9))
        log.base(T_world_base)
        log.task(task)
        for second in range(int(t_s[-1]) + 1):  # side by side in the file, as in time
            first, last = START_NS + second * 10**9, START_NS + (second + 1) * 10**9
            arrived = (frames.arrival_ns >= first) & (frames.arrival_ns < last)
            if arrived.any():
                log.frames(frames.rows(arrived))
            now = (t_ns >= first) & (t_ns < last)
            log.truth(t_ns[now], truth_m[now])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", nargs="?", type=Path, default=Path(__file__).with_name("demo.mcap"))
    target = parser.parse_args().path
    make(target)
    print(target)
