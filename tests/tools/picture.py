"""Draws the README's moving picture from the demo log: ``python -m tests.tools.picture``.

Replays the demo to the end of a stretch and writes that stretch as an animated WebP: person, swept volumes, robot and
paths. The same run and the same versions of the libraries give the same bytes.
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image

from hrcreplay.commands.report import scene_of
from hrcreplay.pipeline.run_config import read_run_config
from hrcreplay.records import FLOOR_Z_M, Floats
from hrcreplay.reporting.figures import drawing
from hrcreplay.reporting.figures.scene import RenderedHull, View, bounds_of, view_from
from hrcreplay.reporting.page.replay_page import draw_instant, legend, reach, solids
from hrcreplay.reporting.replay_scene import RATE_HZ, ReplayScene
from hrcreplay.store import run_folder

ROOT = Path(__file__).parents[2]
OUT = ROOT / "docs" / "demo.webp"
#: The stretch, by the report's clock: two hands come into the robot's way, and it goes round them [s].
START_S, END_S = 5.4, 12.4
#: Instants of the replay from one frame to the next.
EVERY = 2
#: Width of the picture [pixels], and of the figure [in].
WIDTH, WIDTH_IN, HEIGHT_IN = 800, 6.4, 4.0
#: Where the viewer stands.
AZIMUTH_RAD, ELEVATION_RAD = np.radians(-60.0), np.radians(28.0)
_QUALITY = 70
_SCENE = 0.62  #: share of the width that shows the scene; the curves take the rest
_MORE_S = 1.0  #: the log's clock is ahead of the report's, which begins with the first frame
#: Between two lines of the floor, and half the width of what the robot stands on.
_FLOOR_M, _PEDESTAL_M = 0.5, 0.14


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes the picture."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.picture", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--start", type=float, default=START_S, help=f"start of the stretch [s] ({START_S:g})")
    parser.add_argument("--end", type=float, default=END_S, help=f"end of the stretch [s] ({END_S:g})")
    parser.add_argument("--run", type=Path, help="a run folder to draw; without it the demo log is replayed")
    parser.add_argument("--out", type=Path, default=OUT, help="WebP to write (docs/demo.webp)")
    given = parser.parse_args(arguments)
    if given.run is not None:
        given.out.write_bytes(picture(given.run, given.start, given.end))
        return 0
    with tempfile.TemporaryDirectory(prefix="hrcreplay-picture-") as folder:
        run = Path(folder) / "run"
        options = ("--end", f"{given.end + _MORE_S}", "--set", "plan.baselines=[]", "--out", run)
        log = ROOT / "datasets" / "demo.mcap"
        subprocess.run([sys.executable, "-m", "hrcreplay", "report", log, *options], check=True)
        given.out.write_bytes(picture(run, given.start, given.end))
    return 0


def picture(folder: Path, start_s: float, end_s: float) -> bytes:
    """An animated WebP of a stretch of a run, at the pace of the recording.

    Args:
        folder: A run folder whose run moved a robot.
        start_s: Start of the stretch, by the report's clock [s].
        end_s: End of it [s].
    """
    scene = scene_of(read_run_config(folder), run_folder.read(folder))
    if scene is None:
        raise SystemExit(f"{folder} moved no robot")
    rows = np.flatnonzero((scene.seconds >= start_s) & (scene.seconds < end_s))[::EVERY].tolist()
    if not rows:
        raise SystemExit(f"{folder} has no instant from {start_s:g} to {end_s:g} s")
    first, *others = frames(scene, rows)
    stream = io.BytesIO()
    duration_ms = round(1000.0 * EVERY / RATE_HZ)
    first.save(
        stream, "webp", save_all=True, append_images=others, duration=duration_ms, loop=0, quality=_QUALITY, method=6
    )
    return stream.getvalue()


def frames(scene: ReplayScene, rows: Sequence[int]) -> Iterator[Image.Image]:
    """The scene at some instants, in one window that holds all of them, beside distance and speed over time."""
    view = view_from(float(AZIMUTH_RAD), float(ELEVATION_RAD))
    edges = [solid.outline(view) for row in rows for solid in (*solids(scene, row), *reach(scene, row))]
    low, high = bounds_of(edges, 0.02)
    with drawing.style():
        for row in rows:
            figure = drawing.new_figure(HEIGHT_IN, WIDTH_IN)
            axes = figure.add_axes((0.0, 0.08, _SCENE, 0.91))
            drawing.set_window(axes, low.tolist(), high.tolist())
            drawing.no_axes(axes)
            _draw_floor(axes, view)
            _draw_pedestal(axes, view, scene.robot.base_m)
            draw_instant(axes, scene, row, view, since=rows[0])
            _draw_curves(figure, scene, rows, row)
            figure.legend(handles=legend(), loc="lower center", ncols=5, bbox_to_anchor=(0.5, 0.02))
            figure.set_facecolor("white")
            yield Image.open(io.BytesIO(drawing.png_bytes(figure, round(WIDTH / WIDTH_IN))))


def _draw_curves(figure: Figure, scene: ReplayScene, rows: Sequence[int], row: int) -> None:
    """Distance and speeds over the stretch, up to the instant, with their numbers at it above."""
    track = next(iter(scene.methods.values()))
    stretch = slice(rows[0], rows[-1] + 1)
    known, seconds = slice(rows[0], row + 1), scene.seconds
    left = _SCENE + 0.07
    above, below = (figure.add_axes((left, bottom, 0.98 - left, 0.27)) for bottom in (0.57, 0.17))
    above.plot(seconds[known], track.body_m[known], color=drawing.INK)
    above.plot(seconds[row], track.body_m[row], "o", color=drawing.INK, ms=3.5, clip_on=False)
    above.set_ylim(0.0, 1.15 * float(np.nanmax(track.body_m[stretch])))
    above.set_title(f"{track.body_m[row]:.2f} m to the person")
    below.plot(seconds[known], track.ref_speed[known], color=drawing.NOMINAL, lw=0.8)
    below.plot(seconds[known], track.tcp_speed[known], color=drawing.ACTUAL)
    below.plot(seconds[row], track.tcp_speed[row], "o", color=drawing.ACTUAL, ms=3.5, clip_on=False)
    below.set_ylim(0.0, 1.0)
    below.set_title(f"tool {track.tcp_speed[row]:.2f} of {track.ref_speed[row]:.2f} m/s")
    below.set_xlabel("time [s]")
    for axes in (above, below):
        axes.set_xlim(seconds[rows[0]], seconds[rows[-1]])
    figure.text(left, 0.955, f"{seconds[row]:.1f} s", fontsize=13.0, fontweight="bold", va="top")


def _draw_floor(axes: Axes, view: View) -> None:
    """Lines on the floor, half a metre apart."""
    ends: Floats = np.arange(-1.5, 3.01, _FLOOR_M)
    for at in ends.tolist():
        for line in ([[at, -1.5], [at, 1.5]], [[-1.5, at], [3.0, at]]):
            if abs(line[0][1]) <= 1.5:
                points = np.column_stack([np.array(line), np.full(2, FLOOR_Z_M)])
                axes.plot(*view.flat(points).T, color=drawing.GRID, lw=0.6, zorder=0)


def _draw_pedestal(axes: Axes, view: View, base_m: Floats) -> None:
    """What the robot stands on: a block from its base down to the floor."""
    sides = [[x, y] for x in (-_PEDESTAL_M, _PEDESTAL_M) for y in (-_PEDESTAL_M, _PEDESTAL_M)]
    corners = [[base_m[0] + x, base_m[1] + y, z] for x, y in sides for z in (FLOOR_Z_M, base_m[2])]
    edge = RenderedHull(np.array(corners), 0.005, to_rgb(drawing.FAINT)).outline(view)
    axes.add_patch(Polygon(edge, facecolor=drawing.GRID, edgecolor=drawing.FAINT, lw=0.7, zorder=0.5))


if __name__ == "__main__":
    sys.exit(main())
