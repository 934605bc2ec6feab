"""The lines after a command, against figures counted out here from the tables themselves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest

from hrcreplay.records import LIMBS
from hrcreplay.reporting import summary_text
from hrcreplay.reporting.summary_text import lines
from hrcreplay.store.run_folder import Run
from tests.facts import tells
from tests.reporting.synthetic import frame_of, make_run, metrics_of


@pytest.fixture(scope="module")
def run() -> Run:
    made = make_run()
    meta = {**made.meta, "limits": {"prediction": {"name": "people"}}}
    return dataclasses.replace(made, meta=meta, counts={"outlier_points_kinect": 1200, "outlier_points_xtion": 34})


def _lines(run: Run) -> dict[str, str]:
    found = lines(run, metrics_of(run))
    return dict(line.split(": ", 1) for line in found)


def test_fuse(run: Run) -> None:
    assert run.state is not None
    assert run.measurements is not None
    n = len(run.state)
    age_s = np.where(np.arange(n) < n // 4, 0.5, 0.02)  # of the first quarter too old
    unseen_s = np.where(np.arange(n) < n // 2, 0.5, 0.02)
    run = dataclasses.replace(run, state=run.state.assign(frame_age_s=age_s, unseen_LEGS=unseen_s, unseen_HD=age_s))
    run.meta["settings"]["fusion"]["fresh_s"] = 0.3
    assert run.measurements is not None
    frames = frame_of(run.measurements).groupby("camera").size()
    said = _lines(run)["fuse"]
    assert tells(said, "1,200 ticks", "75.0 % (LEGS 50.0 %)", "1,234 outlier points")
    assert tells(said, f"kinect {frames['kinect']}", f"xtion {frames['xtion']}")


def test_predict(run: Run) -> None:
    assert run.occupancy is not None
    total = run.occupancy[run.occupancy["limb"].isin(LIMBS)]["volume_m3"].sum() / run.occupancy["t_ns"].nunique()
    assert tells(_lines(run)["predict"], "paper", "people", f"six limbs {total:.3f} m³")
    assert not tells(_lines(run)["predict"], "1.250 m³")
    legs = run.occupancy[run.occupancy["limb"] == "HD"].assign(limb="LEGS", volume_m3=1.25)
    walking = dataclasses.replace(run, occupancy=pd.concat([frame_of(run.occupancy), frame_of(legs)]))
    assert tells(_lines(walking)["predict"], f"six limbs {total:.3f} m³", "lower body 1.250 m³")


def test_plan(run: Run) -> None:
    motion = run.motion
    assert motion is not None
    near = motion["distance_m"] <= 0.5
    stands = near & (motion["tcp_speed"] < 0.001)
    late = ((motion["status"] == "braking") & (motion["tcp_speed"] >= 0.001)).sum()
    mine, other = _lines(run)["plan"].split("; ")
    parts = mine.split(", ")
    assert tells(parts, "standing", f"{100.0 * stands.sum() / near.sum():.1f} %", "near")
    assert tells(parts, f"{late} ticks", f"{100.0 * late / len(motion):.1f} %", "full stops")
    assert other.startswith("scaling: ")
    pace = metrics_of(run)["plan_progress_share"]["value"]
    assert tells(parts, "qp", f"{100.0 * pace:.1f} %", "pace")


def test_a_programme_that_never_waits_has_a_pace_too(run: Run) -> None:
    settings = {**run.meta["settings"], "plan": {"method": "qp", "reference": "time"}}
    timed = dataclasses.replace(run, meta={**run.meta, "settings": settings})
    assert _lines(timed)["plan"] == _lines(run)["plan"]


def test_only_what_the_run_holds(run: Run) -> None:
    fused = dataclasses.replace(
        run, meta={**run.meta, "command": "fuse"}, occupancy=None, motion=None, baselines={}, truth=None
    )
    assert list(_lines(fused)) == ["fuse"]
    assert list(_lines(run)) == ["fuse", "predict", "plan", "report"]
    answer = summary_text.answers(run, metrics_of(run))[0]
    assert answer.short.rstrip(".").replace("\u202f", ",") in _lines(run)["report"]
