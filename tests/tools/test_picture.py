"""The README's moving picture: as wide as it says, in motion, the same each time, and small enough for a page."""

from __future__ import annotations

from PIL import Image

from tests.reporting.moving import moving_run, moving_scene
from tests.tools.picture import HEIGHT_IN, OUT, WIDTH, WIDTH_IN, frames


def test_frames_move_and_are_the_same_each_time() -> None:
    scene = moving_scene(moving_run(3.0))
    drawn = [[frame.tobytes() for frame in frames(scene, [30, 60])] for _ in range(2)]
    assert drawn[0] == drawn[1]
    assert drawn[0][0] != drawn[0][1]


def test_the_picture_in_the_readme_moves() -> None:
    assert OUT.stat().st_size < 1_500_000
    with Image.open(OUT) as picture:
        assert picture.size == (WIDTH, round(WIDTH * HEIGHT_IN / WIDTH_IN))
        assert getattr(picture, "n_frames", 1) > 50
