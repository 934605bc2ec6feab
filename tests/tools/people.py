"""Makes hrcreplay/limits/people.toml again: ``python -m tests.tools.people``, with the recordings by others at hand."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from hrcreplay.audit import fit
from hrcreplay.commands import inputs, replay
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import CameraFrames, Ints
from tests.human import rising
from tests.realdata import data_path
from tests.test_recordings import IMPORTS, SARA, SARA_CELL

PEOPLE = Path(__file__).parents[2] / "hrcreplay/limits/people.toml"
#: Who gets up, sits down and squats is rare in the recordings: simulated, in so many seconds, with noise of a seed.
RISES_S, KINDS, SEED = (0.6, 1.0, 2.0), ("squat", "chair"), 11
_CAMERA_HZ, _LATE_NS = 30.0, 20_000_000
#: How often each does it in a log.
_TIMES = 3


def rise(path: Path, duration_s: float, kind: str) -> Path:
    """A log of somebody who gets up and goes down again, _TIMES, before two cameras, with the true points."""
    once_s = 3.0 * rising.STILL_S + 2.0 * duration_s
    instants = np.arange(0.0, _TIMES * once_s, 1.0 / _CAMERA_HZ)
    capture: Ints = np.concatenate([np.round((instants + 0.013 * c) * 1e9).astype(np.int64) for c in range(2)])
    order = np.argsort(capture, kind="stable")
    capture, camera = capture[order] + 1_000_000_000, np.repeat(np.arange(2), len(instants))[order]
    at_s = np.asarray((capture - 1_000_000_000) * 1e-9, dtype=np.float64)
    true = rising.body(at_s % once_s, duration_s, kind)
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


def fused(folder: Path) -> list[Path]:
    """A run of ``fuse`` on every recording, which holds its cell and settings."""
    runs = [replay.run("fuse", replay.demo_log(), out=folder / "demo")]
    for name, (kind, files, options) in IMPORTS.items():
        log, cell = folder / f"{name}.mcap", folder / f"{name}.toml"
        paths = [str(data_path(f)) if kind == "keraal" else f"{c}={data_path(f)}" for c, f in files.items()]
        inputs.import_files(kind, paths, log, 30.0)
        place = {"reference": None, "up": None, "height_m": None, "base": "1.0,0,0.65,0", **options}
        inputs.calibrate(log, cell, None, (), **place)
        runs.append(replay.run("fuse", log, out=folder / name, cell_file=cell))
    settings, cell = folder / "sara.toml", folder / "sara_cell.toml"
    settings.write_text(SARA)
    cell.write_text(SARA_CELL)
    for bag in ("exp_box", "exp_appraoching"):
        log = data_path(f"sara_human_robot_bags/{bag}.bag")
        runs.append(replay.run("fuse", log, out=folder / bag, cell_file=cell, config=settings))
    for duration_s in RISES_S:
        for kind in KINDS:
            log = rise(folder / f"simulated, {kind}, {duration_s:g} s.mcap", duration_s, kind)
            runs.append(replay.run("fuse", log, out=folder / f"{kind} {duration_s:g}"))
    return runs


def main() -> None:
    """Fits and tells what each left-out recording gave; exit code 5 where that is less than was asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.people", description=__doc__)
    parser.add_argument("--out", type=Path, default=PEOPLE)
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as folder:
        new = Path(folder) / out.name
        found = fit.run(fused(Path(folder)), out=new, cover="limbs")
        out.write_bytes(new.read_bytes())
    sys.stdout.write("".join(f"{line}\n" for line in found.lines))
    if found.missed:
        sys.stdout.write(f"missed: {found.missed}\n")
        sys.exit(5)


if __name__ == "__main__":
    main()
