"""What a report shows of the run's own method."""

from __future__ import annotations

import re

import pytest

from hrcreplay.limits import load_limits
from hrcreplay.records import LIMBS
from hrcreplay.run import replay, report
from hrcreplay.run.prediction import PredictionStage
from hrcreplay.settings.sections import Occupancy
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import Run


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Run:
    out = tmp_path_factory.mktemp("sound") / "run"
    overrides = ("occupancy.method=sound", "occupancy.store_hz=5")
    return run_folder.read(
        replay.run("report", replay.demo_log(), out=out, overrides=overrides, start_s=8.0, end_s=12.0)
    )


def test_the_figure_of_volumes_holds_the_runs_own_method(sound: Run) -> None:
    prediction_stage = PredictionStage(load_limits("paper"), Occupancy(sigmas=3.0), memory_s=0.5)
    (_, methods), *others = report._instants(prediction_stage, sound)
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
