"""What a report shows of the run's own method, and ``report RUN --snapshot SECONDS`` (whole runs: test_replay.py)."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hrcreplay.errors import SettingsError
from hrcreplay.records import LIMBS
from hrcreplay.report import drawing
from hrcreplay.report.snapshot import snapshot
from hrcreplay.run import figure_data, replay, report
from hrcreplay.run.job import job_of_run
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import Run
from tests.report.moving import moving_run, moving_scene


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Run:
    out = tmp_path_factory.mktemp("sound") / "run"
    overrides = ("occupancy.method=sound", "occupancy.store_hz=5")
    return run_folder.read(
        replay.run("report", replay.demo_log(), out=out, overrides=overrides, start_s=8.0, end_s=12.0)
    )


def test_the_figure_of_volumes_holds_the_runs_own_method(sound: Run) -> None:
    people = figure_data._states(job_of_run(sound.folder), sound)
    assert people is not None
    (_, methods), *others = figure_data.volumes_by_method(job_of_run(sound.folder), sound, people)
    assert len(others) == 3
    assert list(methods) == ["paper", "positions", "sound"]
    assert list(methods["paper"]) == list(LIMBS)
    assert list(methods["sound"]) == [*LIMBS, "LEGS"]
    assert methods["paper"]["HD"][1] == 0.12
    assert methods["sound"]["HD"][1] > 0.12  # the residual


def test_the_page_has_the_lower_body(sound: Run) -> None:
    page = re.sub(r"<script.*?</script>", "", (sound.folder / "report.html").read_text(), flags=re.DOTALL)
    assert re.search(r"<t[hd][^>]*>\s*LEGS\s*</t[hd]>", page)
    assert "legs, of sound" in page
    assert not re.search(r"\b(nan|inf|None)\b", page)


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
        report.take_still(tmp_path, 1.0, None)
