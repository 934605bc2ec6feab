"""The safety file: four pages with a text that can be searched, and with the limits of what was checked."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from pypdf import PdfReader

from hrcreplay.cli import app
from hrcreplay.commands import replay
from hrcreplay.reporting.safety_file import CAUTION, PAGES, QUESTION, safety_file
from hrcreplay.reporting.tables import NOT_CLAIMED
from hrcreplay.reporting.verdict import verdict
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import Run
from tests.facts import tells
from tests.reporting.synthetic import contact_run, contact_table, frame_of, metrics_of
from tests.undrawn import undrawn


def picture(seed: int) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.random.default_rng(seed).integers(0, 255, (60, 100, 3)).astype(np.uint8)).save(stream, "png")
    return stream.getvalue()


STILLS = (("A still at 1.00 s.", picture(0)), ("A still at 2.00 s.", picture(1)))


def pages(pdf: bytes) -> list[str]:
    """Text of each page, its words one space apart."""
    return [" ".join(page.extract_text().split()) for page in PdfReader(io.BytesIO(pdf)).pages]


def plain(text: str) -> str:
    return " ".join(text.split())


@pytest.fixture(scope="module")
def run() -> Run:
    made = contact_run()
    return replace(made, meta=made.meta | {"created": "2026-03-04T05:06:07Z", "outputs": {"motion.parquet": "cd" * 32}})


def test_four_pages_say_what_was_found_and_what_was_not_checked(run: Run) -> None:
    metrics = metrics_of(run)
    first, limits, methods, proof = found = pages(safety_file(run, metrics, STILLS))
    assert len(found) == PAGES
    judged = verdict(run, metrics)
    assert judged is not None
    for sentence in (QUESTION, *judged.sentences):
        assert plain(sentence) in first
    for claim in (*NOT_CLAIMED, judged.scope[-1]):
        assert plain(claim) in limits
    for row in judged.table.rows:
        assert plain(row[0]) in methods
    assert all(caption in methods for caption, _ in STILLS)
    assert "ab" * 32 in first
    assert "ab" * 32 in proof
    assert "cd" * 32 in proof
    assert "Prepared by, date, signature" in proof
    for number, page in enumerate(found, start=1):
        assert CAUTION in page
        assert f"page {number} of {PAGES}" in page
    assert not any("/somewhere/on/disk" in page for page in found)


def test_the_same_run_gives_the_same_bytes_with_the_time_of_the_run(run: Run) -> None:
    metrics = metrics_of(run)
    made = safety_file(run, metrics, STILLS)
    assert made == safety_file(run, metrics, STILLS)
    about = PdfReader(io.BytesIO(made)).metadata
    assert about is not None
    assert str(about.creation_date).startswith("2026-03-04 05:06:07")
    assert about.title == "Safety file: demo.mcap"


def test_however_much_there_is_to_say_it_fits_and_no_limit_is_left_out(run: Run) -> None:
    long = tuple(f"remark {k}: " + "something that the recording lacks, at length; " * 6 for k in range(40))
    methods = {f"method{k}": run.baselines["none"] for k in range(7)}
    contact = pd.concat([frame_of(run.contact), *(contact_table(run, name, range(90, 150)) for name in methods)])
    much = replace(run, notes=long, baselines=methods, contact=contact)
    metrics = metrics_of(much)
    found = pages(safety_file(much, metrics, STILLS))
    assert len(found) == PAGES
    for claim in NOT_CLAIMED:
        assert plain(claim) in found[1]
    left = sum(f"remark {k}:" not in found[1] for k in range(40))
    assert 0 < left < 40
    assert tells(found[1], f"{left + 2} more remarks", "run.json")  # two counters are told, too
    for k in range(7):
        assert f"method{k}" in found[2]


def test_settings_that_are_not_the_defaults_are_listed_without_folders(run: Run) -> None:
    settings = {"plan": {"method": "qp", "human_speed": 2.5, "task": "/home/me/task.toml"}, "report": {"near_m": 0.5}}
    changed = replace(run, meta=run.meta | {"settings": run.meta["settings"] | settings})
    *_, proof = pages(safety_file(changed, metrics_of(changed), ()))
    assert tells(proof, "plan.human_speed", "2.5")
    assert tells(proof, "plan.task", "task.toml")
    assert "/home/me" not in proof
    assert "report.near_m" not in proof


def test_the_command_writes_the_file_of_a_run_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with undrawn():
        overrides = ('plan.baselines=["none"]', "fusion.rate_hz=125")
        folder = replay.run(
            "report", replay.demo_log(), out=tmp_path / "run", start_s=10.0, end_s=11.5, overrides=overrides
        )
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["hrcreplay", "report", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            app.main()
        return int(left.value.code or 0), *capsys.readouterr()

    refuses: Callable[..., str] = lambda *arguments: call(*arguments)[2]  # noqa: E731
    assert call(folder, "--pdf")[:2] == (0, "demo-safety-file.pdf\n")
    found = pages(Path("demo-safety-file.pdf").read_bytes())
    assert len(found) == PAGES
    assert run_folder.sha256(folder / "run.json") in found[3]
    assert tells(found[2], "Severity of contact, estimated", "ISO/TS 15066", "ISO 10218-2:2025")
    assert len(PdfReader("demo-safety-file.pdf").pages[2].images) in (1, 2)  # as many as there are moments to show
    assert "exists already" in refuses(folder, "--pdf")
    assert tells(refuses(replay.demo_log(), "--pdf", "--out", "b.pdf"), "--pdf", "no run folder")
    assert call(folder, "--pdf", "--out", "again.pdf")[0] == 0
    assert Path("again.pdf").read_bytes() == Path("demo-safety-file.pdf").read_bytes()
