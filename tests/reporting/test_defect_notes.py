"""The defects of a log on the page and on the terminal."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from hrcreplay.logs.cleaning import DEFECTS
from hrcreplay.reporting.summary_text import defect_notes
from tests.facts import tells
from tests.reporting.reading import page_lines, rendered
from tests.reporting.synthetic import make_run


def test_every_kind_of_defect_is_told_in_the_words_of_the_reader_and_nothing_else_is() -> None:
    """Generically: a defect that the reader learns to count is told without a word here."""
    counts = {name.replace("<camera>", "left"): 1234 for name in DEFECTS}
    told = defect_notes({**counts, "outlier_points_left": 7, "frames_right": 3}, ("a remark",))
    assert told[0] == "a remark"
    silent = [name for name, text in DEFECTS.items() if text.startswith(("no defect", "an instant"))]
    assert set(silent) == {"frames_<camera>", "truncated_at_ns"}
    for name, text in DEFECTS.items():
        line = (f"camera left, {text}" if name.endswith("<camera>") else text) + ": 1\u202f234"
        assert (line in told) == (name not in silent), name
    assert len(told) == 1 + len(DEFECTS) - len(silent)


def test_a_clean_log_has_no_flaws() -> None:
    counts = {"frames_left": 100, "frames_duplicate": 0, "gaps_left": 0, "outlier_points_left": 7}
    assert defect_notes(counts, ()) == ()


def test_the_first_screen_tells_what_was_wrong_and_only_then(tmp_path: Path) -> None:
    run = dataclasses.replace(make_run(2.0), counts={"chunks_unreadable": 2, "frames_kinect": 60})
    html = rendered(run, tmp_path)
    first = page_lines(html[: html.index("<main>")])
    assert f"{DEFECTS['chunks_unreadable']}: 2" in first
    assert run.notes[0] in first
    assert not tells(first, "60")  # delivered rows are no defect
    clean = dataclasses.replace(run, counts={"frames_kinect": 60}, notes=())
    assert 'class="flaws"' in html
    assert 'class="flaws"' not in rendered(clean, tmp_path)
