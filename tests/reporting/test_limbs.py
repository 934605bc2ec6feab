"""Limbs that no camera measured: what is told of them, and where."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.commands import replay
from hrcreplay.logs.reader import open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import LIMBS, POINTS, CameraFrames, Floats
from hrcreplay.reporting import summary_text, verdict
from hrcreplay.reporting.metrics import fusion
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import Run
from tests.facts import tells
from tests.reporting.reading import read, rendered
from tests.reporting.synthetic import make_run, metrics_of

MEMORY_S = 0.5


def by_counting(unseen_s: Floats) -> list[float]:
    """The shares, tick by tick."""
    lost, in_view = [0] * 6, 0
    for row in unseen_s.tolist():
        late = [not seconds <= MEMORY_S for seconds in row]
        if not all(late):
            in_view += 1
            lost = [n + one for n, one in zip(lost, late, strict=True)]
    return [n / in_view for n in lost]


def test_shares_are_of_the_ticks_with_the_person_in_view() -> None:
    rng = np.random.default_rng(2)
    unseen_s = rng.uniform(0.0, 1.0, (400, 6)) * np.array([0.2, 0.2, 1.2, 0.9, 0.7, 1.0])
    unseen_s[:, 5] = np.inf  # never
    unseen_s[:50] = np.inf  # nobody yet
    unseen_s[200:260] = 3.0  # gone for a while
    found = fusion.unmeasured_shares(unseen_s, MEMORY_S)
    assert found == pytest.approx(by_counting(unseen_s))
    assert found[5] == 1.0
    assert 0.0 < found[2] < 1.0
    assert np.isnan(fusion.unmeasured_shares(np.full((9, 6), np.inf), MEMORY_S)).all()


def seen(run: Run, **unseen_s: float | Floats) -> Run:
    """The made-up run with these limbs unseen for so long, all others seen."""
    assert run.state is not None
    columns = {f"unseen_{limb}": unseen_s.get(limb, 0.0) for limb in LIMBS}
    return dataclasses.replace(run, state=run.state.assign(**columns))


def kept(run: Run) -> Run:
    assert run.motion is not None
    return dataclasses.replace(run, motion=run.motion.assign(status="tracking", reason=""))


def answered(run: Run) -> summary_text.Answer:
    return summary_text.answers(run, metrics_of(run))[0]


def test_the_verdict_says_first_which_limb_nobody_measured() -> None:
    run = kept(make_run(4.0))
    assert tells(answered(seen(run)).short, "paper's", "every")
    safe = answered(seen(run, LLA=np.inf, LRA=np.inf))
    assert tells(safe.short, "Not known", "right lower arm (LRA)", "left lower arm (LLA)", "never")
    assert tells(safe.words, "paper's", "every")
    card = summary_text.cards(seen(run, LLA=np.inf), metrics_of(seen(run, LLA=np.inf)))[0]
    assert tells(card.detail, "LLA never")


def test_the_verdict_gives_the_share_of_a_limb_that_was_hidden_most_of_the_time() -> None:
    run = kept(make_run(4.0))
    assert run.state is not None
    n = len(run.state)
    hidden = seen(run, ULA=np.where(np.arange(n) < 0.73 * n, 2.0, 0.1), HD=np.where(np.arange(n) < 0.4 * n, 2.0, 0.1))
    (remark,) = verdict.limb_remarks(hidden)
    for text in (answered(hidden).short, remark):
        assert tells(text, "left upper arm (ULA)", "73 %")
        assert not tells(text, "HD")


def test_a_limb_measured_in_part_is_told() -> None:
    run = seen(make_run(4.0))
    assert run.measurements is not None
    assert verdict.limb_remarks(run) == []
    part = dataclasses.replace(run, measurements=run.measurements.assign(al3=np.nan))
    (remark,) = verdict.limb_remarks(part)
    assert tells(remark, "left lower arm (LLA)", "al3")


def test_the_page_lists_every_limb(tmp_path: Path) -> None:
    run = seen(make_run(2.0), LLA=np.inf)
    text = " ".join(read(rendered(run, tmp_path)).text)
    assert re.search(r"left lower arm \(LLA\)\s+100\.0 %", text)
    assert re.search(r"right lower arm \(LRA\)\s+0\.0 %", text)


def _without(frames: Iterator[CameraFrames], gone: list[int]) -> Iterator[CameraFrames]:
    for table in frames:
        points, confidence = table.points_m.copy(), table.confidence.copy()
        points[:, gone], confidence[:, gone] = np.nan, 0.0
        yield dataclasses.replace(table, points_m=points, confidence=confidence)


@pytest.fixture
def wristless(tmp_path: Path) -> Path:
    """A second of the demo log as trackers give it that know hands but no wrists."""
    log = open_log(replay.demo_log())
    begin_ns = log.header.start_ns + 8_000_000_000
    with LogWriter(tmp_path / "wristless.mcap") as writer:
        for name, T in log.header.T_world_camera.items():
            writer.camera(name, T)
        for frames in _without(log.frames(begin_ns, begin_ns + 10**9), [POINTS.index(f"wrist_{s}") for s in "lr"]):
            writer.frames(frames)
    return tmp_path / "wristless.mcap"


def test_fusing_a_log_without_wrists_says_so_on_the_terminal_and_in_the_record(
    wristless: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [
        f"limb {limb} was never measured: no camera gave wrist_{side}; "
        "its volume contains all postures within the joint limits"
        for side, limb in (("r", "LRA"), ("l", "LLA"))
    ]
    fused = replay.run("fuse", wristless, out=tmp_path / "fused")
    assert capsys.readouterr().err.splitlines() == [f"hrcreplay: {line}" for line in lines]
    assert run_folder.read_meta(fused)["notes"] == lines
    predicted = replay.run("fuse", fused, out=tmp_path / "again")  # taken over: said again, and once
    assert capsys.readouterr().err.splitlines()[1:] == [f"hrcreplay: {line}" for line in lines]
    assert run_folder.read_meta(predicted)["notes"] == lines
