"""Runs of simulated people who cross: tables and metrics of each, no contact, the same again from the tables."""

from __future__ import annotations

import json
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from hrcreplay import api
from hrcreplay.commands import audit, replay
from hrcreplay.commands.explain import explain, sentences
from hrcreplay.store.columns import read_states
from tests import crowd
from tests.undrawn import undrawn

FAST = ("plan.baselines=['none']", "prediction.store_hz=5")


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report on two people, who cross at about 3 s."""
    folder = tmp_path_factory.mktemp("pair")
    t_s, bodies = crowd.people(2, 6.0)
    log = crowd.write(folder / "pair.mcap", crowd.record(t_s, bodies))
    return replay.run("report", log, out=folder / "run", overrides=FAST, start_s=2.0)


@cache
def table(folder: Path, name: str) -> pd.DataFrame:
    return pq.read_table(folder / f"{name}.parquet").to_pandas()


def test_every_table_names_its_people_in_order(pair: Path) -> None:
    state, occupancy = table(pair, "state"), table(pair, "occupancy")
    ticks = len(table(pair, "motion"))
    assert state["person"].value_counts().to_dict() == {1: ticks, 2: ticks - 2}  # the second came a frame later
    order = state[["t_ns", "person"]].to_numpy()
    assert (np.lexsort((order[:, 1], order[:, 0])) == np.arange(len(order))).all()
    assert set(occupancy["person"]) == set(table(pair, "measurements")["person"]) == {1, 2}
    limbs = set(table(pair, "motion")["limb"].dropna())
    assert all(limb.removesuffix(" of person 2") in ("HD", "THX", "URA", "LRA", "ULA", "LLA", "LEGS") for limb in limbs)
    chunks = list(read_states(pair / "state.parquet", 77))
    assert len(chunks) > 10
    assert all(a.t_ns[-1] < b.t_ns[0] for a, b in pairwise(chunks))  # no tick is divided


def test_no_contact_and_each_person_has_figures(pair: Path) -> None:
    metrics = json.loads((pair / "metrics.json").read_text())
    contact = table(pair, "contact")
    own = contact[contact["method"] == "qp"]
    assert metrics["people_tracked"]["value"] == 2
    assert metrics["plan_touch_moving_ticks"]["value"] == 0
    assert metrics["plan_uncertified_moving_ticks"]["value"] == 0
    for k in (1, 2):
        held = own[f"left_person_{k}_m"].dropna()
        assert metrics[f"person_{k}_volumes_held_share"]["value"] == pytest.approx((held <= 0.0).mean())
        near = own.loc[own["moving"], f"person_{k}_m"].min()
        assert metrics[f"plan_person_{k}_distance_min_moving_m"]["value"] == pytest.approx(near)
    both = own[["person_1_m", "person_2_m"]].min(axis=1)
    np.testing.assert_array_equal(own["person_m"], both)
    worst = own[["left_person_1_m", "left_person_2_m"]].max(axis=1)
    np.testing.assert_array_equal(own["left_m"], worst)
    assert "2 people are planned for" in (pair / "report.html").read_text()


def test_why_names_the_people(pair: Path, tmp_path: Path) -> None:
    log, lone = pair.parent / "pair.mcap", ("plan.baselines=[]",)
    begun = replay.run("plan", log, out=tmp_path / "begun", overrides=lone, end_s=1.5)  # the second comes nearer
    motion = table(begun, "motion")
    k = int(np.flatnonzero(motion["limb"].fillna("").str.endswith("person 2").to_numpy())[-1])
    at_s = (motion["t_ns"].iloc[k] - motion["t_ns"].iloc[0]) * 1e-9
    found = explain(begun, float(at_s))
    assert found["nearest"]["limb"] == motion["limb"].iloc[k]
    assert [one["person"] for one in found["people"]] == [1, 2]
    assert "of person 2" in " ".join(sentences(found))
    assert "Person 2: only just seen" in " ".join(sentences(explain(pair, 0.012)))
    assert "Person 2: known" in " ".join(sentences(explain(pair, 1.0)))


def test_a_plan_from_the_tables_and_one_from_python_have_the_same_bytes(pair: Path, tmp_path: Path) -> None:
    again = replay.run("plan", pair, out=tmp_path / "again", overrides=("plan.baselines=[]",), start_s=2.0)
    assert (again / "state.parquet").read_bytes() == (pair / "state.parquet").read_bytes()
    assert (again / "motion.parquet").read_bytes() == (pair / "motion.parquet").read_bytes()
    recording = api.open_log(pair.parent / "pair.mcap")
    people = api.fuse(recording, start_s=2.0, smooth=False)
    assert people.numbers == (1, 2)
    pd.testing.assert_frame_equal(people.to_pandas(), table(pair, "state"))
    planned = api.plan(people, baselines=()).to_pandas()
    pd.testing.assert_frame_equal(planned, table(pair, "motion"))


def test_with_people_nearest_the_robot_heeds_one(pair: Path, tmp_path: Path) -> None:
    log = pair.parent / "pair.mcap"
    one = replay.run("fuse", log, out=tmp_path / "one", overrides=("logs.people=nearest",), start_s=2.0, end_s=4.0)
    assert "person" not in pq.read_schema(one / "state.parquet").names
    notes = json.loads((one / "run.json").read_text())["notes"]
    assert any("the robot does not react to it" in note for note in notes)


def test_audit_judges_each_person_as_the_report_does(pair: Path, tmp_path: Path) -> None:
    with undrawn():
        folder = audit.run([pair], out=tmp_path / "audit", start_s=2.0)
    found = json.loads((folder / "audit.json").read_text())
    metrics = json.loads((pair / "metrics.json").read_text())
    assert [log["log"] for log in found["logs"]] == ["pair, person 1", "pair, person 2"]
    for k, log in enumerate(found["logs"], start=1):
        whole = log["methods"]["sound"]["all"]["covered_share"]
        assert whole["value"] == pytest.approx(metrics[f"person_{k}_volumes_full_held_share"]["value"])
        assert whole["samples"] == metrics[f"person_{k}_volumes_full_checked_ticks"]["value"]
