"""``report RUN --snapshot SECONDS``; the runs themselves are looked at in test_replay.py."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hrcreplay.errors import SettingsError
from hrcreplay.report import drawing
from hrcreplay.report.snapshot import snapshot
from hrcreplay.run.still import take_still
from tests.report.moving import moving_run, moving_scene


def picture(row: int) -> np.ndarray:
    with drawing.style():
        figure = snapshot(moving_scene(moving_run(3.0)), row)
        figure.set_facecolor("white")
        content = drawing.png_bytes(figure)
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def share_of(image: np.ndarray, colour: tuple[int, int, int]) -> float:
    """How much of a picture has about that hue: its channels in about these proportions."""
    total = image.sum(axis=2)
    apart = np.abs(image / np.maximum(total, 1)[..., None] - np.array(colour) / sum(colour)).max(axis=2)
    return float(((apart < 0.03) & (total < 690)).mean())


def test_a_still_shows_robot_and_person_and_changes_with_the_instant() -> None:
    first, later = picture(30), picture(60)
    for image in (first, later):
        assert share_of(image, (217, 130, 59)) > 0.005
        assert share_of(image, (127, 178, 217)) > 0.01
    assert first.shape != later.shape or (first != later).any()
    np.testing.assert_array_equal(picture(30), first)


def test_what_no_still_can_be_taken_of_is_told(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"--snapshot: .* is no run folder; make one with: hrcreplay report"):
        take_still(tmp_path, 1.0, None)
