"""Makes hrcreplay/limits/people.toml again: ``python -m tests.tools.people``, with the recordings by others at hand."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hrcreplay.audit import fit
from hrcreplay.commands import inputs, replay
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import CameraFrames, Floats, Ints
from tests.human import reaching, rising, stepping
from tests.realdata import data_path
from tests.test_recordings import IMPORTS, SARA, SARA_CELL

PEOPLE = Path(__file__).parents[2] / "hrcreplay/limits/people.toml"
#: Who gets up, sits down and squats is rare in the recordings: simulated, in so many seconds, with noise of a seed.
RISES_S, KINDS, SEED = (0.6, 1.0, 2.0), ("squat", "chair"), 11
_CAMERA_HZ, _LATE_NS = 30.0, 20_000_000
#: How often each does it in a log.
_TIMES = 3
#: Who begins to reach from rest within the horizon cannot be bounded without a ball of the arm's length around all:
#: fast arms are not fitted, their coverage is measured. So is that of people who begin to walk.
FAST, STEPS = "simulated, fast arms", "simulated, steps"
#: Recordings of one tracker and person, by the beginnings of their names, and people simulated in one way.
GROUPS = {
    "Azure Kinect, sevivi": ("azure walking", "azure squatting"),
    "Azure Kinect, pymocapviewer": ("azure moving",),
    "Kinect 2, labanotation": ("kinect 2",),
    "Kinect 2 and Vicon, Keraal": ("keraal",),
    "motion capture, SARA": ("exp_",),
    "simulated, demo": ("demo",),
    "simulated, rising": tuple(f"simulated, {kind}" for kind in KINDS),
    FAST: tuple(f"simulated, {kind}" for kind in reaching.KINDS),
    STEPS: tuple(f"simulated, {kind}" for kind in stepping.KINDS),
}


def simulated(path: Path, end_s: float, body: Callable[[Floats], Floats]) -> Path:
    """A log of somebody before two cameras, with the true points, which ``body`` gives at instants [s]."""
    instants = np.arange(0.0, end_s, 1.0 / _CAMERA_HZ)
    capture: Ints = np.concatenate([np.round((instants + 0.013 * c) * 1e9).astype(np.int64) for c in range(2)])
    order = np.argsort(capture, kind="stable")
    capture, camera = capture[order] + 1_000_000_000, np.repeat(np.arange(2), len(instants))[order]
    true = body(np.asarray((capture - 1_000_000_000) * 1e-9, dtype=np.float64))
    points = true + np.random.default_rng(SEED).normal(0.0, 0.005, true.shape)
    with LogWriter(path) as writer:
        for name in ("left", "right"):
            writer.camera(name, np.eye(4))
        writer.frames(
            CameraFrames(
                capture_ns=capture,
                arrival_ns=capture + _LATE_NS,
                camera=camera.astype(np.int64),
                body=np.zeros(len(capture), np.int64),
                points_m=points,
                confidence=np.isfinite(points).all(axis=2).astype(float),
                cameras=("left", "right"),
            )
        )
        writer.truth(capture, true)
    return path


def rise(path: Path, duration_s: float, kind: str) -> Path:
    """A log of somebody who gets up and goes down again, _TIMES."""
    once_s = 3.0 * rising.STILL_S + 2.0 * duration_s
    return simulated(path, _TIMES * once_s, lambda t_s: rising.body(t_s % once_s, duration_s, kind))


def reach(path: Path, kind: str) -> Path:
    """A log of somebody who moves the arms fast, _TIMES."""
    return simulated(path, _TIMES * reaching.period_s(kind), lambda t_s: reaching.body(t_s, kind))


def step(path: Path, kind: str) -> Path:
    """A log of somebody who walks to another place and back, _TIMES."""
    return simulated(path, _TIMES * stepping.period_s(kind), lambda t_s: stepping.body(t_s, kind))


def fused(folder: Path) -> dict[str, Path]:
    """Name of a log -> a run of ``fuse`` on it, which holds its cell and settings."""
    runs = {replay.demo_log().name: replay.run("fuse", replay.demo_log(), out=folder / "demo")}
    for name, (kind, files, options) in IMPORTS.items():
        log, cell = folder / f"{name}.mcap", folder / f"{name}.toml"
        paths = [str(data_path(f)) if kind == "keraal" else f"{c}={data_path(f)}" for c, f in files.items()]
        inputs.import_files(kind, paths, log, 30.0)
        place = {"reference": None, "up": None, "height_m": None, "base": "1.0,0,0.65,0", **options}
        inputs.calibrate(log, cell, None, (), **place)
        runs[log.name] = replay.run("fuse", log, out=folder / name, cell_file=cell)
    settings, cell = folder / "sara.toml", folder / "sara_cell.toml"
    settings.write_text(SARA)
    cell.write_text(SARA_CELL)
    for bag in ("exp_box", "exp_appraoching"):
        log = data_path(f"sara_human_robot_bags/{bag}.bag")
        runs[log.name] = replay.run("fuse", log, out=folder / bag, cell_file=cell, config=settings)
    for duration_s in RISES_S:
        for kind in KINDS:
            log = rise(folder / f"simulated, {kind}, {duration_s:g} s.mcap", duration_s, kind)
            runs[log.name] = replay.run("fuse", log, out=folder / f"{kind} {duration_s:g}")
    for kinds, made in ((reaching.KINDS, reach), (stepping.KINDS, step)):
        for kind in kinds:
            log = made(folder / f"simulated, {kind}.mcap", kind)
            runs[log.name] = replay.run("fuse", log, out=folder / kind)
    return runs


def group_of(log: str) -> str:
    """Tracker and person of a recording, or what is simulated."""
    return next((group for group, names in GROUPS.items() if any(log.startswith(name) for name in names)), log)


def main() -> None:
    """Fits and tells what each left-out recording gave; exit code 5 where that is less than was asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.people", description=__doc__)
    parser.add_argument("--out", type=Path, default=PEOPLE)
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as folder:
        new = Path(folder) / out.name
        runs = fused(Path(folder))
        found = fit.run(
            [*runs.values()], out=new, cover="limbs", groups=[group_of(log) for log in runs], checked=(FAST, STEPS)
        )
        out.write_bytes(new.read_bytes())
    sys.stdout.write("".join(f"{line}\n" for line in found.lines))
    if found.missed:
        sys.stdout.write(f"missed: {found.missed}\n")
        sys.exit(5)


if __name__ == "__main__":
    main()
