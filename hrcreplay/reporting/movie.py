"""The tour of a replay as a moving picture: MP4 by ffmpeg where it is installed, else GIF by Pillow."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hrcreplay.errors import SettingsError
from hrcreplay.records import FLOOR_Z_M, Floats
from hrcreplay.reporting.figures.scene import RenderedHull, View, bounds_of, render_hulls, view_from
from hrcreplay.reporting.page.replay_page import ELEVATION_RAD, clearest_azimuth, reach, solids
from hrcreplay.reporting.replay_scene import ReplayScene
from hrcreplay.reporting.tour import TourStop, tour

#: Size of the scene of one method [pixels], and of the lines of text above and below.
_WIDE, _TALL, _BAR, _CAPTION = 560, 480, 34, 56
#: Instants of the replay from one frame to the next, by the format.
_EVERY = {".mp4": 1, ".gif": 2}
_INK, _PAPER, _LINE = (37, 49, 60), (255, 255, 255), (223, 229, 234)
_RED, _BLUE, _ORANGE, _OBJECT, _VOLUME = (198, 40, 40), (0, 114, 178), (213, 94, 0), (139, 152, 165), (230, 159, 0)
#: Maps points of a view (n, 2) [m] to pixels.
_Project = Callable[[Floats], list[tuple[float, float]]]
_PATH_S = 4.0
_MARGIN_M, _PEDESTAL_M, _GREY, _FONT = 0.06, 0.12, (0.62, 0.66, 0.70), 16


def write_movie(path: Path, scene: ReplayScene) -> None:
    """Writes the tour of a scene at the pace of the recording.

    Args:
        path: File to create: ``.mp4`` or ``.gif``.
        scene: The scene.

    Raises:
        SettingsError: The suffix is another, ffmpeg is missing or fails, or there is nothing to show.
    """
    if path.suffix not in _EVERY:
        raise SettingsError(f"--movie: {path} is neither .mp4 nor .gif; name one of them with --out")
    stops = tour(scene)
    if not stops:
        raise SettingsError("--movie: the run has no contact, no approach and no stop to show; a report needs a person")
    every = _EVERY[path.suffix]
    pictures = frames(scene, stops, every)
    if path.suffix == ".mp4":
        _write_mp4(path, pictures, scene.rate_hz / every)
        return
    first, *others = [one.quantize(96, dither=Image.Dither.NONE) for one in pictures]
    first.save(path, save_all=True, append_images=others, duration=round(1000.0 * every / scene.rate_hz), loop=0)


def default_name() -> str:
    """Returns the name of the file where none is given: MP4 if ffmpeg is installed, else GIF."""
    return "tour.mp4" if shutil.which("ffmpeg") else "tour.gif"


def _write_mp4(path: Path, pictures: Iterator[Image.Image], rate_hz: float) -> None:
    """Sends the frames to ffmpeg."""
    program = shutil.which("ffmpeg")
    if program is None:
        raise SettingsError(f"--movie: {path} needs ffmpeg, which is not installed; install it, or name a .gif")
    first = next(pictures)
    size = f"{first.width}x{first.height}"
    command = [program, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{rate_hz:g}"]
    command += ["-i", "-", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-movflags", "+faststart", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:  # noqa: S603
        assert process.stdin is not None  # noqa: S101  opened above
        try:
            for picture in (first, *pictures):
                process.stdin.write(picture.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # ffmpeg has ended; its message follows
        assert process.stderr is not None  # noqa: S101  opened above
        said = process.stderr.read().decode(errors="replace").strip()
        if process.wait() != 0:
            raise SettingsError(
                f"--movie: ffmpeg failed: {said.splitlines()[-1] if said else 'no message'}; name a .gif"
            )


def frames(scene: ReplayScene, stops: Sequence[TourStop], every: int) -> Iterator[Image.Image]:
    """Yields the pictures of a tour, all of one size.

    Args:
        scene: The scene.
        stops: Its tour.
        every: Instants of the replay from one picture to the next.
    """
    own = next(iter(scene.methods))
    columns = max(1 if stop.beside is None else 2 for stop in stops)
    for stop in stops:
        methods = [own, stop.beside][:columns] if stop.beside is not None else [own]
        shown = [method for method in methods if method is not None]
        rows = np.flatnonzero((scene.seconds >= stop.from_s) & (scene.seconds < stop.until_s))[::every].tolist()
        key = rows[:: max(1, len(rows) // 4)]
        view = view_from(clearest_azimuth(scene, key, shown), ELEVATION_RAD)
        edges = [solid.outline(view) for row in key for method in shown for solid in solids(scene, row, method)]
        low, high = _window(*bounds_of(edges, _MARGIN_M))
        for row in rows:
            picture = Image.new("RGB", (columns * _WIDE, _TALL + _BAR + _CAPTION), _PAPER)
            for column, method in enumerate(shown):
                picture.paste(_scene(scene, row, method, view, low, high), (column * _WIDE, _BAR))
                _title(picture, scene, row, method, column)
            _caption(picture, f"{scene.seconds[row]:.2f} s   {stop.words}")
            yield picture


def _window(low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Widens a box in the view to the shape of a picture [m]."""
    size = high - low
    middle, pixel_m = 0.5 * (low + high), float(max(size[0] / _WIDE, size[1] / _TALL))
    half = 0.5 * pixel_m * np.array([_WIDE, _TALL])
    return middle - half, middle + half


def _scene(scene: ReplayScene, row: int, method: str, view: View, low: Floats, high: Floats) -> Image.Image:
    """Draws one method at an instant."""
    picture = Image.new("RGBA", (_WIDE, _TALL), (*_PAPER, 255))
    pixel_m = float(high[0] - low[0]) / _WIDE

    def at(points: Floats) -> list[tuple[float, float]]:
        return [((x - low[0]) / pixel_m, (high[1] - y) / pixel_m) for x, y in points.tolist()]

    _floor(picture, scene, view, at)
    flat = [(RenderedHull(one.vertices_m, one.radius_m, (0.0, 0.0, 0.0)), _OBJECT, 60) for one in scene.objects]
    flat += [(solid, _VOLUME, 34) for solid in reach(scene, row)]
    for solid, colour, opacity in flat:
        edge = solid.outline(view)
        if len(edge) > 2:
            layer = Image.new("RGBA", picture.size, (0, 0, 0, 0))
            ImageDraw.Draw(layer).polygon(at(edge), fill=(*colour, opacity), outline=(*colour, 150))
            picture.alpha_composite(layer)
    image = render_hulls([*_pedestal(scene), *solids(scene, row, method)], view, low, high, pixel_m)[:_TALL, :_WIDE]
    shaded = Image.fromarray(np.ascontiguousarray(np.round(255.0 * image[::-1]).astype(np.uint8)), "RGBA")
    picture.alpha_composite(shaded, (0, _TALL - shaded.height))
    draw, track = ImageDraw.Draw(picture), scene.methods[method]
    near = round(_PATH_S * scene.rate_hz)
    for points_m, first, last, colour in (
        (track.ref_m, row - near, row + near, _BLUE),
        (track.tcp_m, row - near, row, _ORANGE),
    ):
        path = points_m[max(0, first) : last + 1]
        path = path[np.isfinite(path).all(axis=1)]
        if len(path) > 1:
            draw.line(at(view.flat(path)), fill=colour, width=2)
    return picture.convert("RGB")


def _floor(picture: Image.Image, scene: ReplayScene, view: View, at: _Project) -> None:
    """Draws lines on the floor, half a metre apart."""
    draw = ImageDraw.Draw(picture)
    x, y, _ = np.round(2.0 * scene.robot.base_m) / 2.0
    for k in np.arange(-3.0, 3.01, 0.5).tolist():
        for ends in ([[x + k, y - 3.0], [x + k, y + 3.0]], [[x - 3.0, y + k], [x + 3.0, y + k]]):
            draw.line(at(view.flat(np.column_stack([ends, np.full(2, FLOOR_Z_M)]))), fill=_LINE)


def _title(picture: Image.Image, scene: ReplayScene, row: int, method: str, column: int) -> None:
    """Writes the method, its distance and its speed above its scene; in red in contact."""
    track = scene.methods[method]
    touches = bool(track.body_m[row] <= 0.0)
    words = f"{method}   {track.tcp_speed[row]:.3f} m/s"
    if np.isfinite(track.body_m[row]):
        words += "   in contact" if touches else f"   {track.body_m[row]:.3f} m to a person"
    _write(picture, (column * _WIDE + 10, 8), words, _RED if touches else _INK)


def _caption(picture: Image.Image, words: str) -> None:
    """Writes what the stop shows below, in at most two lines."""
    font, lines = ImageFont.load_default(_FONT), [""]
    for word in words.split(" "):
        longer = f"{lines[-1]} {word}".strip()
        if font.getlength(longer) > picture.width - 20 and len(lines) < 2:
            lines.append(word)
        else:
            lines[-1] = longer
    for k, line in enumerate(lines):
        _write(picture, (10, _TALL + _BAR + 6 + 22 * k), line, _INK)


def _pedestal(scene: ReplayScene) -> list[RenderedHull]:
    """Returns a block under a base that stands above the floor."""
    x, y, z = scene.robot.base_m.tolist()
    if z <= FLOOR_Z_M + 0.02:
        return []
    sides = [(x + dx, y + dy) for dx in (-_PEDESTAL_M, _PEDESTAL_M) for dy in (-_PEDESTAL_M, _PEDESTAL_M)]
    corners = np.array([(*side, at) for side in sides for at in (FLOOR_Z_M, z)])
    return [RenderedHull(corners, 0.005, _GREY)]


def _write(picture: Image.Image, at: tuple[int, int], words: str, colour: tuple[int, int, int]) -> None:
    ImageDraw.Draw(picture).text(at, words, fill=colour, font=ImageFont.load_default(_FONT))
