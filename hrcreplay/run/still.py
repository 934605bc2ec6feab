"""A still of a run's replay, from its folder alone."""

from __future__ import annotations

from pathlib import Path

from hrcreplay.errors import SettingsError
from hrcreplay.report import drawing
from hrcreplay.report.snapshot import snapshot
from hrcreplay.run.job import resolve
from hrcreplay.run.report import scene_of
from hrcreplay.store import run_folder


def take_still(folder: Path, at_s: float, out: Path | None) -> Path:
    """Draws a run at the instant of its replay that is nearest to ``at_s``.

    Args:
        folder: A run folder whose run moved a robot.
        at_s: By the report's clock [s].
        out: PNG file to make; None: ``snapshot-<seconds>.png`` in the folder that one works in.

    Raises:
        SettingsError: No run folder, no such instant, or the file is there or cannot be written.
    """
    if not run_folder.is_run(folder):
        raise SettingsError(f"--snapshot: {folder} is no run folder; make one with: hrcreplay report {folder}")
    run = run_folder.read(folder)
    scene = scene_of(resolve("report", folder), run)
    if scene is None:
        raise SettingsError(f"--snapshot: {folder} moved no robot; make a report of it first")
    first, last = scene.seconds[[0, -1]].tolist()
    if not first <= at_s <= last:
        raise SettingsError(f"--snapshot {at_s:g}: found an instant outside the run; from {first:g} to {last:g} s")
    row = int(abs(scene.seconds - at_s).argmin())
    path = out or Path(f"snapshot-{scene.seconds[row]:.2f}.png")
    with drawing.style():
        figure = snapshot(scene, row)
        figure.set_facecolor("white")
        run_folder.write_whole(path, drawing.png_bytes(figure))
    return path
